"""Predictions along the measured motion: what effects do in every row, carried on by the chain of
transitions.

chain = Chain(world, windows, noise)
chain.start(trajectory)
residual = chain.residual([{}, {friction: (0.1,)}])    # (settings, W, T, nv), as Ahead's

Where an effect is the missing one, what it does in a row is what is missing there, whatever its
size: both run on through the same linear transitions.
"""

from functools import partial

import mujoco
import numpy as np

from diagnosis.effects.base import condition_of
from diagnosis.estimation import windowing
from diagnosis.estimation.ahead import Ahead, with_own_step
from diagnosis.simulation.rows import RowMap, coarse, holds
from diagnosis.simulation.simulator import Case

# fields of a model that its inertia hangs by
INERTIAL = (
    "body_mass body_inertia body_ipos body_iquat body_pos dof_armature tendon_armature".split()
)
POSES = 20  # of the motion, at which inertias are compared
ASTRAY = 1e3  # times its travel, to where a chain of transitions at stiff stops may run away


class Chain(Ahead):
    """An Ahead whose predictions are linear in what happens in each row. Windows in which something
    touches or the chain runs away, and effects with states or sensors of their own, are simulated
    as in Ahead."""

    def __init__(self, world, windows, noise):
        super().__init__(world, windows, noise)
        self.glances = {}  # {(number, seconds, rows): (beyond, acts) of such beginnings}
        self.acts = None  # {effects: what they do in the rows (rows, 2 nv)}, where that is kept

    def start(self, trajectory, setting=None):
        super().start(trajectory, setting)
        self.trajectory, self.map = trajectory, None
        last = np.array([w.last - w.first for w in self.windows])
        first = trajectory.begin(self.windows)
        ahead = np.arange(self.known.shape[1])
        self.rows = first[:, None] + np.minimum(ahead, last[:, None])
        follows = ahead[:-1] < last[:, None]
        self.begin = np.unique(self.rows[:, :-1][follows])
        touching = coarse(self.world, trajectory.first, touching=True)
        self.whole = self._begun(self.windows, touching)
        self.carried, touched = follows, (trajectory.free[self.rows[:, :-1]] & follows).any(1)
        with np.errstate(over="ignore", invalid="ignore"):
            near = abs(self._carried_starts()) < ASTRAY * self.whole.travel[:, None]
        touched |= ~near.all((1, 2, 3))
        self.carried, self.touched = follows & ~touched[:, None], np.flatnonzero(touched)
        apart = ~trajectory.free & trajectory.driven.any((1, 2))  # from what touches
        self.used = self.begin[apart[self.begin]]
        beside = windowing.difference(self.model, trajectory.qpos[self.rows], self.measured)
        self.beside = np.where(self.known, beside, 0.0)
        # columns are differences: what a coarse step does wrong it does with an effect and without
        step = {c: v for c, v in self.base.items() if c.effect.numerical}
        self.coarse, self.base = coarse(self.world, trajectory.first), self.plain(self.base)
        rough = self._rows({**self.coarse, **self.base}, self.begin)
        self.inertia = self.map.model
        self.finer, self.beyond = self._rows({**step, **self.base}, self.begin) - rough, {}
        self.contacts = self._begun([self.windows[i] for i in self.touched], touching)
        self.travel = np.where(touched[:, None, None], self.whole.travel, np.inf)

    @property
    def touches(self):
        """Whether the motion mostly touches something."""
        return 2 * len(self.used) < len(self.begin)

    def beginnings(self, number, seconds):
        """A Chain of the first seconds of so many of the windows, evenly chosen, which simulates an
        effect once for all starts: a motion that is located anew hardly moves."""
        chosen = [self.windows[i] for i in windowing.evenly(len(self.windows), number)]
        short = Chain(self.world, [windowing.beginning(w, seconds) for w in chosen], self.noise)
        short.start(self.trajectory, self.base)
        which = number, seconds, short.used.tobytes()
        short.beyond, short.acts = self.glances.setdefault(which, ({}, {}))
        return short

    def _begun(self, windows, step):
        """An Ahead of windows, with a time step for columns; None of no windows."""
        if not windows:
            return None
        ahead = Ahead(self.world, windows, self.noise)
        ahead.coarse = step
        ahead.start(self.trajectory, self.base)
        return ahead

    def residual(self, settings):
        """Measured less predicted, (settings, W, T, nv), as of Ahead."""
        return self._predicted(settings, Ahead.residual)

    def rough(self, settings, begun=None):
        """As of Ahead."""
        simulate = partial(Ahead.rough, begun=begun and with_own_step(begun))
        return self._predicted([with_own_step(s) for s in settings], simulate)

    def _predicted(self, settings, simulate):
        """simulate: the method of Ahead by which windows are simulated that are not carried on."""
        out = np.zeros((len(settings), *self.known.shape))
        if self.carried.any():
            plain = [self.plain(s) for s in settings]
            self._along(plain, out)
            self._beyond(settings, plain, out)
        if self.contacts:
            rest = simulate(self.contacts, settings)
            out[:, self.touched] = 0.0
            out[:, self.touched, : rest.shape[2]] = rest
        return out

    def _moved_starts(self):
        """As of Ahead, along the chain."""
        out = self._carried_starts()
        if self.contacts:
            rest = self.contacts.freedom()
            out[self.touched] = 0.0
            out[self.touched, : rest.shape[1]] = rest
        return out

    def _carried_starts(self):
        """Those of windows that are carried along the chain."""
        nv, T = self.model.nv, self.rows.shape[1]
        out = np.zeros((*self.known.shape, 2 * nv))
        x = self.spread[:, None] * np.eye(2 * nv)
        for t in range(T - 1):
            x = self.trajectory.transition[self.rows[:, t]] @ x * self.carried[:, t, None, None]
            out[:, t + 1] = np.where(self.known[:, t + 1, :, None], x[:, :nv], 0.0)
        return out

    def _along(self, settings, out):
        """Fill in what the chain predicts, the same once."""
        keys = [frozenset(setting.items()) for setting in settings]
        done = {}
        for key, setting in dict(zip(keys, settings)).items():
            done[key] = self._lacking(setting, done)
        grown = {key: self._grown(done[key]) for key in set(keys)}
        out[:] = [grown[key] for key in keys]

    def _lacking(self, setting, done):
        """missing() of a setting in the rows that are used. Where it is kept, what effects do there
        is worked out once, beside whatever of the setting located the motion. done: {items of a
        setting: of those known}."""
        new = frozenset((c, v) for c, v in setting.items() if c not in self.base)
        if self.acts is None or not new:
            return self.missing(setting, self.used)
        old = frozenset(setting.items()) - new
        if old not in done:
            done[old] = self.missing(dict(old), self.used)
        if new not in self.acts:
            self.acts[new] = (self.missing(setting, self.used) - done[old]).astype(np.float32)
        return done[old] + self.acts[new]

    def _beyond(self, settings, plain, out):
        """Add what effects do that are more than what happens within a row, beside the setting that
        located the motion: what else a setting holds hardly changes that."""
        more = [{c: v for c, v in s.items() if c not in p} for s, p in zip(settings, plain)]
        new = {frozenset(m.items()): m for m in more if m}
        new = {key: m for key, m in new.items() if key not in self.beyond}
        numerical = lambda c: c.effect.numerical
        for exact, simulated in ((True, self.whole.residual), (False, self.whole.rough)):
            some = {key: m for key, m in new.items() if exact == any(map(numerical, m))}
            if some:
                every = [self.base, *({**self.base, **m} for m in some.values())]
                first, *rest = simulated(every)
                self.beyond |= {key: both - first for key, both in zip(some, rest)}
        for row, m in zip(out, more):
            if m:
                row += self.beyond[frozenset(m.items())]

    def heavier(self, setting, options):
        """As of Ahead. What rows leave are forces over the inertia of the chain's model: the same
        forces move a lighter joint farther."""
        out, (model, now) = super().heavier(setting, options), self._inertia(setting)
        for option in options:
            if not self.apart(option.candidate):
                for column, values in zip(option.columns, option.base + option.directions):
                    moved = {**setting, option.candidate: tuple(values.tolist())}
                    out[column] = self._inertia(moved, (model, now))[1] / now - 1
        return out

    def _inertia(self, setting, known=None):
        """(model, diagonal of its inertia matrix (nv,), the mean over states) of what is plain in a
        setting; known: these of a model that may be as heavy."""
        case = Case(self.model, self.plain(setting), 1)
        working = self.world.engine(case.structure).working
        model = working.edited(case.on, case.step)
        if known and _as_heavy(known[0], model):
            return known
        data, full = mujoco.MjData(model), np.empty((model.nv, model.nv))
        out, every = np.full(model.nv, 1e-300), windowing.evenly(len(self.used), POSES)
        for row in self.used[every]:
            data.qpos[working.q] = self.trajectory.qpos[row]
            mujoco.mj_fwdKinematics(model, data)
            mujoco.mj_makeM(model, data)
            mujoco.mj_fullM(model, data, full)
            out += np.diag(full)
        return model, out[working.v]

    def apart(self, candidate):
        """Whether an effect is more than what happens within a row."""
        effect = candidate.effect
        wide = effect.overrides("measure") or effect.numerical
        return bool(wide) or self.world.adds_states(candidate)

    def plain(self, setting):
        """What of a setting happens within a row."""
        return {c: v for c, v in setting.items() if not self.apart(c)}

    def missing(self, setting, rows):
        """(rows, 2 nv): the smoothed motion less the predicted one, a row on, of rows (n,), under
        a plain setting, as forces change it in the model of the chain: these superpose."""
        found = self._missing({c: v for c, v in setting.items() if not c.when}, rows)
        condition = condition_of(setting)
        if condition:
            there = self._missing({c.lasting: v for c, v in setting.items()}, rows)
            share = holds(condition, list(self.trajectory.first))
            found += share[np.searchsorted(self.map.begin, rows), None] * (there - found)
        return found

    def _missing(self, setting, rows):
        """As of missing(), of a setting without conditions."""
        found = self._rows({**self.coarse, **setting}, rows)
        found += self.finer[np.searchsorted(self.begin, rows)]
        model = self.map.model
        if not _as_heavy(model, self.inertia):
            gap, t = found[:, self.model.nv :], self.trajectory
            more = _times_mass(model, t.qpos[rows], gap)
            more -= _times_mass(self.inertia, t.qpos[rows], gap)
            more /= self.map.seconds[np.searchsorted(self.map.begin, rows), None]
            found += (t.driven[rows] @ more[..., None])[..., 0]
        return found

    def _rows(self, setting, rows):
        t = self.trajectory
        self.map = RowMap(self.world, list(t.first), setting, like=self.map)
        index, none = np.searchsorted(self.map.begin, rows), np.zeros((len(rows), self.model.nv))
        qpos, qvel = self.map.ahead(index, t.qpos[rows], t.qvel[rows], none)
        gap = windowing.difference(self.model, qpos, t.qpos[rows + 1])
        return np.concatenate([gap, t.qvel[rows + 1] - qvel], 1)

    def _grown(self, missing):
        """(W, T, nv): what is missing in the rows, carried on, and what was measured beside."""
        (W, T), nv = self.rows.shape, self.model.nv
        out, x = self.beside.copy(), np.zeros((W, 2 * nv))
        at = np.searchsorted(self.used, np.minimum(self.rows, self.used[-1]))
        for t in range(T - 1):
            step = self.trajectory.transition[self.rows[:, t]]
            x = (step @ x[..., None])[..., 0] + missing[at[:, t]]
            x = np.where(self.carried[:, t : t + 1], x, 0.0)
            out[:, t + 1] += np.where(self.known[:, t + 1], x[:, :nv], 0.0)
        return out


def _as_heavy(model, other):
    """Whether two models' inertia is the same in every position."""
    return all(np.array_equal(getattr(model, name), getattr(other, name)) for name in INERTIAL)


def _times_mass(model, qpos, qvel):
    """The inertia matrices at positions qpos (n, nq) times velocities qvel (n, nv)."""
    data, out = mujoco.MjData(model), np.empty_like(qvel)
    for row, q, v in zip(out, qpos, qvel):
        data.qpos[:] = q
        mujoco.mj_fwdKinematics(model, data)
        mujoco.mj_makeM(model, data)
        mujoco.mj_mulM(model, data, row, v)
    return out
