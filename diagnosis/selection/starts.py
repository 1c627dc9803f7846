"""Where effects are begun beside a setting.

starts = Starts(world, setting, usual).of(candidates)      # [Start]

Effects are begun at a small step where they act in proportion, at whole values where they do not (a
dead zone, a delay of many rows).
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from diagnosis.effects.unmodelled import Unknown
from diagnosis.estimation import windowing
from diagnosis.selection.plausibility import plausible

FULL = 0.3, 3.0  # amounts of a whole start of values, within which a column stands for it
PROBES = 12  # starts of one candidate that are looked at, but for those that come in groups
LADDER = 0.1, 0.4  # shares of a prior's scale
BEGUN = 0.1  # share of an amplitude's scale, at which effects of several values are begun
WAYS = -1, 1  # in which a usual size is tried where something touches
STATES = 300  # of the motion, at which forces are compared
NEARER = 0.5, 0.25  # of the way to the next group of starts, by which the best is moved
STEP = 0.03  # share of a value's prior scale, or its way from nominal, that a step is at least


@dataclass(frozen=True, eq=False)
class Start:
    """A candidate begun at some values.

    base (k,): its values in the setting; directions (p, k): change of the values per unit of each
    of its p amounts; low, high (p,): bounds of the amounts; prior: a Prior; merges: whether its
    amounts are worked out together, by the effect.
    """

    candidate: object
    base: np.ndarray
    directions: np.ndarray
    low: np.ndarray
    high: np.ndarray
    prior: object
    merges: bool = False

    @property
    def whole(self):
        """Whether these are whole values, of which no small share says anything."""
        return bool((self.low > 0).any())

    @property
    def unnamed(self):
        """Whether it is a curve, which follows anything."""
        return isinstance(self.candidate.effect, Unknown)

    def reach(self):
        """Bounds (low, high) (p,) of the amounts within which the values are plausible; its own
        where no share of it means anything."""
        if self.merges or (self.low >= self.high).any():
            return self.low, self.high
        return _reach(self.base, self.directions, self.prior)

    def settings(self, setting):
        """A setting with each of the directions."""
        return [{**setting, self.candidate: tuple(self.base + row)} for row in self.directions]


class Starts:
    """Where effects are begun beside a setting."""

    def __init__(self, world, setting, usual, seen=None, trajectory=None, touches=False):
        """usual: a Usual; seen: {candidate: which of its parameters show}; trajectory: along which
        starts that come in groups are compared with the located force, and few of them kept;
        touches: whether the motion mostly touches something."""
        self.world, self.setting, self.usual = world, setting, usual
        self.seen, self.trajectory, self.touches = seen or {}, trajectory, touches

    def of(self, candidates):
        """[Start] of all the candidates."""
        return [start for candidate in candidates for start in self._each(candidate)]

    def _each(self, candidate):
        world, recordings = self.world, self.usual.recordings
        prior = plausible(candidate, self.usual)
        inside = candidate in self.setting
        base = np.array(self.setting.get(candidate, candidate.nominal), float)
        if inside or not candidate.effect.overrides("probes"):
            one = _proportional(candidate, base, prior, self.seen.get(candidate, True))
            out = [one] if one else []
            if inside:
                return out
            whole = list(world.far(candidate, recordings)) + _ladder(base, prior)
            whole += _both_ways(base, prior) if self.touches else []
        else:
            out, whole = [], _begun(candidate, world.probes(candidate, recordings), prior)
        together = candidate.effect.together
        if together == 1:
            whole = [whole[i] for i in windowing.evenly(len(whole), PROBES)]
        groups = [np.array(whole[k : k + together]) for k in range(0, len(whole), together)]
        fits = lambda rows: all(map(prior.inside, rows))
        groups = [*filter(fits, groups)]
        if together > 1 and len(groups) > 1 and self.trajectory is not None:
            groups = self._promising(candidate, groups, fits)
        return out + [_full(candidate, base, rows, prior) for rows in groups]

    def curve(self, candidate, values):
        """The Start of a force without a name at the values that were located."""
        prior = plausible(candidate, self.usual)
        return _full(candidate, np.zeros(len(values)), np.array([values]), prior)

    def _promising(self, candidate, groups, fits):
        """Of evenly spaced groups of starts the one whose force is most like the located one, moved
        to where it is even more so, among those inside what is plausible."""
        t, d = self.trajectory, self.usual.dof(candidate.place)
        acts = ~t.free
        if candidate.when:
            acts = acts & windowing.rows_of(candidate.when, self.usual.recordings)
        rows = np.flatnonzero(acts)
        rows = rows[windowing.evenly(len(rows), STATES)]
        if not len(rows):
            return groups
        zero = self._applied(candidate, [0.0, *groups[0][0, 1:]], rows)[:, d]

        def left(group):
            forces = [self._applied(candidate, tuple(values), rows)[:, d] for values in group]
            basis = np.stack(forces, 1) - zero[:, None]
            fit = np.linalg.lstsq(basis, t.force[rows, d], rcond=None)[0]
            return np.sum((t.force[rows, d] - basis @ fit) ** 2)

        best, step = min(groups, key=left), groups[1] - groups[0]
        for share in NEARER:
            moved = filter(fits, (best, best - share * step, best + share * step))
            best = min(moved, key=left)
        return [best]

    def _applied(self, candidate, values, rows):
        """Generalized forces (n, nv) of actuators and joints with a candidate, dry friction
        included, in rows (n,) of the trajectory, but for what is the same at all values."""
        world, t, effect = self.world, self.trajectory, candidate.effect
        if effect.overrides("limit"):
            i = effect.id(world.model, candidate.place.name)
            most = effect.limit([world.model], i, np.array([values], float))
            return -t.direction()[rows] * most(t.qpos[rows], t.qvel[rows], None, None, None)
        structure = [candidate] if effect.overrides("build") else []
        working = world.engine(frozenset(structure)).working
        model = working.edited([(candidate, tuple(values))], world.model.opt.timestep)
        data, out = mujoco.MjData(model), np.empty((len(rows), world.model.nv))
        for row, q, v in zip(out, t.qpos[rows], t.qvel[rows]):
            data.qpos[working.q], data.qvel[working.v] = q, v  # in the nominal coordinates
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_fwdVelocity(model, data)
            mujoco.mj_fwdActuation(model, data)
            row[:] = (data.qfrc_actuator + data.qfrc_passive)[working.v]
        return out


def _full(candidate, base, rows, prior):
    """The Start of a group of whole values (p, k)."""
    finite, together, (low, high) = np.isfinite(base).all(), len(rows), FULL
    start = base if finite else np.zeros_like(base)
    if together > 1:  # waves act in proportion, as far as is plausible
        high = prior.high[0] / rows[0, 0]
        low = -high
    if not finite or candidate.effect.bounds:
        low, high = 1.0, 1.0  # a limit: no share of the way to it means anything
    bounds = np.full(together, low), np.full(together, high)
    return Start(candidate, start, rows - start, *bounds, prior, together > 1)


def _begun(candidate, probes, prior):
    """Starts of an effect, their amplitudes as large as the machine's forces let expect."""
    n, rows = candidate.effect.amplitudes, np.array(probes, float)
    if n and len(rows) and np.isfinite(prior.scale[0]) and len(set(rows[:, 0])) == 1:
        more = rows[:, :n] - prior.centre[:n]
        rows[:, :n] = prior.centre[:n] + BEGUN * prior.scale[0] / more[0, 0] * more
        rows = np.clip(rows, prior.low, prior.high)
    return list(rows)


def _ladder(base, prior):
    """Full-size values of a parameter that only goes one way: what sticks or waits shows in no
    small step."""
    if len(base) > 1 or base[0] > prior.low[0] or not np.isfinite(prior.scale[0]):
        return []
    return [base + share * prior.scale for share in LADDER]


def _both_ways(base, prior):
    """A usual size of each parameter that may go either way, or all there is of it: where something
    touches, a small step tells of what it makes and breaks."""
    usual = np.where(np.isfinite(prior.scale) & (base > prior.low), prior.scale, 0.0)
    rows = np.diag(usual)[usual > 0]
    ends = [np.clip(base + way * row, prior.low, prior.high) for row in rows for way in WAYS]
    return [values for values in ends if (values != base).any()]


def _proportional(candidate, base, prior, shown):
    """The Start of small steps of the parameters that show, or None. Where something touches,
    predictions are rough: a tiny step tells of what it makes and breaks, and of no slope."""
    steps = np.array([p.step for p in candidate.parameters])
    finite = np.isfinite(base) & np.isfinite(candidate.nominal)
    way = np.subtract(base, candidate.nominal, out=np.zeros_like(base), where=finite)
    usual = np.where(np.isfinite(prior.scale), prior.scale, 0.0)
    steps = np.sign(steps) * np.maximum(abs(steps), STEP * np.maximum(abs(way), usual))
    steps = np.where((base + steps > prior.high) | ~np.isfinite(steps), -abs(steps), steps)
    steps = np.where(base + steps < prior.low, abs(steps), steps)
    fits = (base + steps <= prior.high) & (base + steps >= prior.low) & np.isfinite(base) & shown
    if not fits.any():
        return None
    directions = np.diag(steps)[fits]
    return Start(candidate, base, directions, *_reach(base, directions, prior), prior)


def _reach(base, directions, prior):
    """Bounds (low, high) (p,) of amounts of directions (p, k) from a base (k,), between which the
    values lie within a Prior."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([prior.low - base, prior.high - base])[:, None] / directions
    ends = np.where(directions == 0, [[[-np.inf]], [[np.inf]]], ends)
    return ends.min(0).max(1), ends.max(0).min(1)
