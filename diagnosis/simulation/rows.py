"""One recorded row ahead, from any state at its beginning, for all rows of recordings in one call.

rows = RowMap(world, recordings, {friction: (0.1,)})
qpos, qvel = rows.ahead(np.arange(len(rows.begin)), qpos, qvel, force)
"""

import mujoco
import numpy as np
from mujoco import rollout

from diagnosis.common.coordinates import difference, integrate
from diagnosis.effects.base import JOINT_TRANSMISSIONS, condition_of, runge_kutta
from diagnosis.simulation.batch import threads
from diagnosis.simulation.control_signal import SLACK
from diagnosis.simulation.simulator import Case

INPUT = int(mujoco.mjtState.mjSTATE_CTRL) | int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)
BODIES = int(mujoco.mjtState.mjSTATE_XFRC_APPLIED)
STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS  # time, qpos, qvel, act, and what else MuJoCo remembers
CHUNK = 40000  # simulations in memory at a time
STEPS = 2  # coarse ones in a row
SWING = 0.3  # rad of phase, or share of the decay, of the fastest joint's motion in a coarse step
SMALL = 1e-6, 1e-5, 1e-3  # steps of the forward differences: rad or m, per second, of the force


def coarse(world, recordings, touching=False):
    """{time_step: seconds}: a few steps in a row, for what is a difference of two simulations.
    touching: short enough for contacts and limits too."""
    own = world.model.opt.timestep
    seconds = np.median(np.concatenate([np.diff(r.time) for r in recordings])) / STEPS
    seconds = min(seconds, SWING / max(_fastest(world.model, touching), 1e-9))
    # never quite the simulator's own, with which Euler's method would be explicit in drives
    return {world.candidate("time_step", "world"): (float(np.nextafter(max(seconds, own), 0)),)}


def _fastest(model, touching):
    """The highest rate, 1/s, at which a joint's springs, dampers and servos act on its inertia, or,
    where something is touching, a contact or a limit gives way."""
    stiff, slow = np.zeros(model.nv), model.dof_damping.copy()
    for j in range(model.njnt):
        stiff[model.jnt_dofadr[j]] = model.jnt_stiffness[j]
    for a in range(model.nactuator):
        if model.actuator_trntype[a] in JOINT_TRANSMISSIONS:
            d = model.jnt_dofadr[model.actuator_trnid[a, 0]]
            gear = model.actuator_gear[a, 0] ** 2
            stiff[d] -= gear * model.actuator_biasprm[a, 1]
            slow[d] -= gear * model.actuator_biasprm[a, 2]
    yields = model.dof_invweight0
    rates = [np.sqrt(np.maximum(stiff, 0.0) * yields), slow * yields]
    if touching:
        rates += [_contact_rates(model.geom_solref), _contact_rates(model.jnt_solref)]
    return float(np.concatenate(rates).max(initial=0))


def _contact_rates(solref):
    """Rates (n,), 1/s, at which contacts or limits give way. solref (n, 2), MuJoCo's: a time
    constant and a damping ratio, or stiffness and damping with a minus."""
    first, second = solref.T
    direct = np.maximum(np.sqrt(np.maximum(-first, 0.0)), -second)
    return np.where(first < 0, direct, 1 / np.maximum(first * np.maximum(second, 1), 1e-9))


def holds(condition, recordings):
    """Share (n,) of every row that has a next one for which a condition holds (see
    Candidate.when)."""
    (low, high), name = condition["time"], condition["recording"]
    each = []
    for r in recordings:
        time = np.minimum(r.time[1:], high) - np.maximum(r.time[:-1], low)
        each.append(np.clip(time / np.diff(r.time), 0.0, 1.0) * (name in (None, r.name)))
    return np.concatenate(each)


class RowMap:
    """Simulates every row of some recordings under a setting, with a constant extra force in each.

    Effects that add coordinates (backlash) or states (bristles) of their own are left out: a row
    knows the nominal model's coordinates alone. Where a condition holds for a part of a row, so
    much of what acts under it counts.

    begin: the rows (n,) that have a next one, counted through all recordings; seconds (n,).
    """

    def __init__(self, world, recordings, setting, like=None):
        """like: another RowMap of the recordings, whose controls are taken over where they are
        the same."""
        self.world, self.recordings, self.nominal = world, recordings, world.model
        setting = {c: v for c, v in setting.items() if not world.adds_states(c)}
        condition, self.there = condition_of(setting), None
        if condition:
            self.there = RowMap(world, recordings, {c.lasting: v for c, v in setting.items()})
            self.share = holds(condition, recordings)
        setting = {c: v for c, v in setting.items() if not c.when}
        self.case = case = Case(world.model, setting, 1)
        self.working = world.engine(case.structure).working
        model = self.working.edited(case.on, case.step)
        if model is None:
            raise ValueError("MuJoCo refuses these values")
        self.model, self.bias = model, (None, None, None)
        self.rest = np.empty(mujoco.mj_stateSize(model, STATE))
        mujoco.mj_getState(model, mujoco.MjData(model), self.rest, STATE)
        self.constant, self.xfrc = np.zeros(model.nv), np.zeros((model.nbody, 6))
        for c, values in case.on:
            i = c.effect.id(model, c.place.name)
            c.effect.push(self.constant, self.xfrc, model, i, values)
        time = [r.time for r in recordings]
        first = np.cumsum([0] + [len(t) for t in time])
        self.begin = np.concatenate(
            [np.arange(a, b - 1) for a, b in zip(first[:-1], first[1:])]
        ).astype(int)
        self.seconds = np.concatenate([np.diff(t) for t in time])
        steps = np.ceil(self.seconds / case.step - SLACK).astype(int)
        self.needed = np.maximum(steps, 1)  # steps to the end of each row
        self.count = int(self.needed.max())
        self.driven = case.step, case.structure, [x for x in case.on if self._drives(x[0])]
        if like is not None and like.driven == self.driven:
            self.control, self.activation = like.control, like.activation
        else:
            self.control = np.concatenate([self._controls(r) for r in recordings])
            self.activation = self._activations()

    @staticmethod
    def _drives(candidate):
        """Whether an effect may change what the actuators see."""
        return candidate.place.kind == "actuator" and (
            candidate.effect.overrides("command") or candidate.effect.overrides("build")
        )

    def _controls(self, recording):
        """(rows - 1, count, nu): what the actuators see in the steps after each row."""
        model, average = self.nominal, runge_kutta(self.nominal)
        changed = self.working.changed(self.case.on)
        start, out = (
            recording.time[:-1, None],
            np.zeros((len(recording.time) - 1, self.count, model.nu)),
        )
        for a in range(model.nactuator):
            u = model.actuator_ctrladr[a]
            for k in range(u, u + model.actuator_ctrlnum[a]):
                signal = self.working.signal(recording, a, k, changed)
                out[:, :, k] = signal.sample(start, self.case.step, self.count, average)
        return out

    def _activations(self):
        if not self.model.na:
            return np.zeros((len(self.begin), 0))
        changed = self.working.changed(self.case.on)
        each = [self.working.activation(r, r.time[:-1], changed) for r in self.recordings]
        return np.concatenate(each)

    def ahead(self, index, qpos, qvel, force):
        """States after rows begin[index], index (n,), from states (n, nq), (n, nv) under force
        (n, nv).

        Returns qpos (n, nq), qvel (n, nv).
        """
        out = self._ahead(index, qpos, qvel, force)
        some = np.flatnonzero(self.share[index]) if self.there else ()
        if len(some):
            more = self.there.ahead(index[some], qpos[some], qvel[some], force[some])
            share = self.share[index[some], None]
            moved = share * difference(self.nominal, out[0][some], more[0])
            out[0][some] = integrate(self.nominal, out[0][some], moved)
            out[1][some] += share * (more[1] - out[1][some])
        return out

    def _ahead(self, index, qpos, qvel, force):
        """As of ahead(), without what acts under a condition."""
        held, limit = force + self.forces(index, qpos, qvel), self.limits(index, qpos, qvel)
        if limit is not None:  # of friction, which at most stops the joint by the end of the row
            _, free = self._rolled(index, qpos, qvel, held)
            yields = self.seconds[index, None] * self.model.dof_invweight0
            held = held - np.clip(free / np.maximum(yields, 1e-12), -limit, limit)
        return self._rolled(index, qpos, qvel, held)

    def _rolled(self, index, qpos, qvel, force):
        n, m = len(index), self.model
        out_q, out_v = np.empty((n, m.nq)), np.empty((n, m.nv))
        for count, rows in _alike(self.needed[index]):
            for a in range(0, len(rows), CHUNK):
                part = rows[a : a + CHUNK]
                out_q[part], out_v[part] = self._rollout(
                    index[part], qpos[part], qvel[part], force[part], count
                )
        return out_q, out_v

    def _rollout(self, index, qpos, qvel, force, count):
        """As _rolled, of rows that take no more steps than `count`."""
        m, n = self.model, len(index)
        state = np.tile(self.rest, (n, 1))
        state[:, 1 : 1 + m.nq + m.nv + m.na] = np.hstack([qpos, qvel, self.activation[index]])
        control = self.control[index, :count]
        given = [np.repeat(force[:, None], count, 1)]
        given += [np.tile(self.xfrc.ravel(), (n, count, 1))] if self.xfrc.any() else []
        control = np.concatenate([control, *given], 2)
        number = threads() or 2
        path, _ = rollout.rollout(
            m,
            [mujoco.MjData(m) for _ in range(number)],
            state,
            control,
            control_spec=INPUT | BODIES * bool(self.xfrc.any()),
            nstep=count,
        )
        path = np.concatenate([state[:, None], path], 1)
        x = self.seconds[index] / self.case.step
        k = np.clip(np.floor(x + SLACK).astype(int), 0, count)
        f = np.where(abs(x - k) <= 1.5 * SLACK, 0.0, x - k)[:, None]
        rows, after = np.arange(n), np.minimum(k + 1, count)
        here, there = path[rows, k], path[rows, after]
        q0, q1 = here[:, 1 : 1 + m.nq], there[:, 1 : 1 + m.nq]
        v0, v1 = (x[:, 1 + m.nq : 1 + m.nq + m.nv] for x in (here, there))
        return integrate(m, q0, f * difference(m, q0, q1)), v0 + f * (v1 - v0)

    def _stepwise(self, index, qpos, qvel):
        """(effect, its id, models, values) of the setting's effects that depend on the state, and
        the arguments of their functions."""
        n = len(index)
        time = np.concatenate([r.time[:-1] for r in self.recordings])[index]
        some = [(c, v, c.effect.id(self.model, c.place.name)) for c, v in self.case.on]
        some = [
            (c.effect, i, [self.model] * n, np.tile(np.array(v, float), (n, 1)))
            for c, v, i in some
            if c.effect.stepwise(self.model, i)
        ]
        return some, (qpos, qvel, self.control[index, 0], time)

    def forces(self, index, qpos, qvel):
        """(n, nv): forces in the joints of the setting's effects, as at the row's beginning."""
        out = np.tile(self.constant, (len(index), 1))
        some, state = self._stepwise(index, qpos, qvel)
        for effect, i, models, values in some:
            function = effect.force(models, i, values)
            if function is not None:
                out += function(*state)
        return out

    def limits(self, index, qpos, qvel):
        """(n, nv): dry friction that the setting's effects add at most, as at the row's beginning;
        None without such."""
        some, state = self._stepwise(index, qpos, qvel)
        some = [each for each in some if each[0].overrides("limit")]
        if not some:
            return None
        out = np.zeros((len(index), self.model.nv))
        bias = self._bias(qpos, qvel) if any(each[0].loaded for each in some) else out
        for effect, i, models, values in some:
            function = effect.limit(models, i, values)
            out = out + (0.0 if function is None else function(*state, bias))
        return np.maximum(out, 0.0)

    def _bias(self, qpos, qvel):
        """(n, nv): qfrc_bias at states, kept for the next call: derivatives by force ask again."""
        before, after, out = self.bias
        if np.array_equal(before, qpos) and np.array_equal(after, qvel):
            return out
        data, out = mujoco.MjData(self.model), np.zeros((len(qpos), self.model.nv))
        for row, q, v in zip(out, qpos, qvel):
            data.qpos[:], data.qvel[:] = q, v
            mujoco.mj_fwdPosition(self.model, data)
            mujoco.mj_fwdVelocity(self.model, data)
            row[:] = data.qfrc_bias
        self.bias = qpos, qvel, out
        return out

    def linearised(self, qpos, qvel, force, scale, skipped):
        """Derivatives of what comes out of every row, by forward differences.

        qpos (n, nq), qvel (n, nv), force (n, nv) at the rows of `begin`; scale (nv,): usual forces;
        skipped (n,): rows of which nothing is asked, and NaN told.
        Returns A (n, 2 nv, 2 nv), B (n, 2 nv, nv) in tangent coordinates.
        """
        n, nv, asked = len(self.begin), self.model.nv, np.flatnonzero(~skipped)
        out = [np.full((n, 2 * nv, width), np.nan) for width in (2 * nv, nv)]
        if len(asked):
            found = self._differences(asked, qpos[asked], qvel[asked], force[asked], scale)
            for whole, part in zip(out, found):
                whole[asked] = part
        return tuple(out)

    def _differences(self, index, qpos, qvel, force, scale):
        """As linearised(), of rows `index` (n,)."""
        n, nv = len(index), self.model.nv
        q, v = self.ahead(index, qpos, qvel, force)
        A, B = np.empty((n, 2 * nv, 2 * nv)), np.empty((n, 2 * nv, nv))
        # by forces first: these leave the load as it is
        columns = [(B, d, SMALL[2] * scale[d]) for d in range(nv)]
        columns += [(A, k, SMALL[k // nv]) for k in range(2 * nv)]
        for block, k, eps in columns:
            moved, step = [qpos, qvel, force], eps * np.eye(nv)[k % nv]
            which = 2 if block is B else k // nv
            moved[which] = (
                integrate(self.nominal, qpos, np.tile(step, (n, 1)))
                if which == 0
                else moved[which] + step
            )
            q1, v1 = self.ahead(index, *moved)
            block[:, :nv, k] = difference(self.nominal, q, q1) / eps
            block[:, nv:, k] = (v1 - v) / eps
        return A, B


def _alike(needed):
    """[(count, rows)]: rows (n,) of needed steps (n,) together, up to twice the least: where one
    row is long, the others take no more steps."""
    out, left = [], np.arange(len(needed))
    while len(left):
        most = 2 * needed[left].min()
        within = needed[left] < most
        out.append((int(needed[left[within]].max()), left[within]))
        left = left[~within]
    return out
