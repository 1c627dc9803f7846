"""A nominal simulator made ready for every effect of the catalogue, many runs at once.

    world = World.load('sim.xml')                       # or World.from_env('Hopper-v5')
    friction = world.candidate('coulomb_friction', 'elbow')
    windows = [Window(recording, 0, 30), Window(recording, 30, 60)]
    qpos, qvel = world.simulate([{}, {friction: (0.1,)}], start_qpos, start_qvel, windows)
    xml, written = world.corrected_xml({friction: (0.1,)})

Effects change copies of the compiled model, or the control signal before the
run, so that a whole window is one call of mujoco.batch.Batch; only forces that
depend on the state and effects with a condition are worked out step by step.
"""

from collections import OrderedDict
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from physics import EFFECTS, Candidate, Effect, Place, Signal

CHUNK_BYTES = 64e6     # of recorded trajectory in memory at a time
GRID = 1e-3            # of a time step: times closer than this are taken as equal
FREE = int(mujoco.mjtJoint.mjJNT_FREE)
BALL = int(mujoco.mjtJoint.mjJNT_BALL)


class Window(NamedTuple):
    """Rows first..last (both included) of a recording."""
    recording: object
    first: int
    last: int


class During(NamedTuple):
    """Values of an effect that acts only under a condition.

    when: {'time': [from, to]} in the recording's time, with 'recording': name if it
    is true of one recording only, or {'qpos:<joint>': [low, high]}, {'qvel:<joint>': …}.
    """
    values: tuple
    when: dict


class World:
    """See the module's docstring. `model` is the nominal MjModel, `candidates` the whole catalogue on it."""

    def __init__(self, spec):
        self.spec = spec.copy()
        model = self.spec.compile()
        for elements in (self.spec.joints, self.spec.actuators, self.spec.bodies[1:], self.spec.geoms, self.spec.sensors):
            taken = {e.name for e in elements}
            for element in elements:  # what has no name goes by its index
                if not element.name:
                    element.name = next(n for n in (f'{p}{element.id}' for p in ('', 'index ')) if n not in taken)
        self.model = self.spec.compile()
        self.candidates = [Candidate(effect, Place(effect.kind, name), tuple(effect.parameters(model, effect.id(self.model, name))))
                           for effect in EFFECTS.values() for name in effect.places(self.model)]
        self._by_name = {(c.effect.name, c.place.name): c for c in self.candidates}
        self._engines = {}

    @classmethod
    def load(cls, path):
        """The World of an MJCF file. ValueError, from MuJoCo, if it does not compile."""
        return cls(mujoco.MjSpec.from_file(str(path)))

    @classmethod
    def from_env(cls, env_id):
        """The World of a gymnasium MuJoCo environment's model file."""
        import gymnasium
        env = gymnasium.make(env_id)
        try:
            return cls.load(env.unwrapped.fullpath)
        finally:
            env.close()

    def candidate(self, effect, place):
        """The Candidate of an effect's and a place's name; KeyError if it cannot sit there."""
        return self._by_name[effect, place]

    def simulate(self, settings, start_qpos, start_qvel, windows, refine=1):
        """Predict what the sensors show in S windows, each under its own setting.

        settings: S dicts {Candidate: values}; values are the candidate's parameters in
            order, absolute, or During(values, when). An empty dict is the nominal model.
            Simulations that share one dict object share the work of preparing it.
        start_qpos (S, nq), start_qvel (S, nv): the state at each window's first row, as
            its sensors would show it (with sensor_bias, _scale and _delay of the setting).
        windows: S Windows. Each runs on its recording's control, held between rows;
            delays, lags and filters run on from the control recorded before the window.
        refine: divide the simulator's time step by this integer.

        Returns qpos (S, T, nq), qvel (S, T, nv) at the rows of each window, T the most rows
        of any; row 0 is the start. NaN where a window has fewer rows, and in all later
        rows of a simulation that became unstable. Time steps that do not meet a row's
        time are interpolated. Works on all CPUs; the same input gives the same output.
        """
        rows = max(w.last - w.first + 1 for w in windows)
        qpos = np.full((len(windows), rows, self.model.nq), np.nan)
        qvel = np.full((len(windows), rows, self.model.nv), np.nan)
        cases, groups = {}, {}
        for s, setting in enumerate(settings):
            if id(setting) not in cases:
                cases[id(setting)] = _Case(self, setting, refine)
            case = cases[id(setting)]
            groups.setdefault((case.structure, case.step, case.stepwise), []).append((s, case))
        start_qpos, start_qvel = np.asarray(start_qpos, float), np.asarray(start_qvel, float)
        with quiet():
            for (structure, step, stepwise), members in groups.items():
                engine = self._engine(structure)
                duration = max(w.recording.time[w.last] - w.recording.time[w.first] for w in (windows[s] for s, _ in members))
                count = max(1, int(np.ceil(duration / step - GRID)))
                chunk = int(np.clip(CHUNK_BYTES / (8 * count * (self.model.nu + engine.model.nq + engine.model.nv)), 1, 1024))
                for k in range(0, len(members), chunk):
                    ids = [s for s, _ in members[k:k + chunk]]
                    qpos[ids], qvel[ids] = engine.run([c for _, c in members[k:k + chunk]], start_qpos[ids], start_qvel[ids],
                                                      [windows[s] for s in ids], rows, step, count, stepwise)
        return qpos, qvel

    def corrected_xml(self, settings):
        """The model with the effects of a setting, as MJCF for stock MuJoCo.

        Returns (xml, {Candidate: 'mjcf' | 'measurement' | 'none'}): where each effect is
        held. Values keep all their digits; mesh and texture paths become absolute.
        """
        spec, written = self.spec.copy(), {}
        for candidate, values, when in _Case(self, settings, 1).items:
            i = candidate.effect.id(self.model, candidate.place.name)
            written[candidate] = 'none' if when else candidate.effect.write(spec, self.model, i, values)
        for candidate in settings:
            written.setdefault(candidate, 'mjcf')  # at its nominal value
        spec.compiler.savecompiled = spec.compiler.savecanonical = False
        spec.compile()
        return spec.to_xml(), written

    def _engine(self, structure):
        if structure not in self._engines:
            self._engines[structure] = _Engine(self, structure)
        return self._engines[structure]


class _Case:
    """One setting, resolved: items [(candidate, values, when)] in the catalogue's order, nominal ones left out."""

    def __init__(self, world, setting, refine):
        order = {name: k for k, name in enumerate(EFFECTS)}
        self.items = []
        for candidate, values in sorted(setting.items(), key=lambda kv: order[kv[0].effect.name]):
            when = values.when if isinstance(values, During) else None
            values = tuple(float(v) for v in (values.values if when else values))
            if values != candidate.nominal:
                self.items.append((candidate, values, when))
        conditions = [when for _, _, when in self.items if when]
        if any(c != conditions[0] for c in conditions):
            raise ValueError('effects with different conditions cannot be simulated together')
        self.when = conditions[0] if conditions else None
        self.on = [(c, v) for c, v, _ in self.items]
        self.off = [(c, v) for c, v, when in self.items if not when]
        steps = [v[0] for c, v in self.on if c.effect.name == 'time_step']
        self.step = (steps[0] if steps else world.model.opt.timestep) / refine
        self.structure = frozenset(c for c, _ in self.on if type(c.effect).build is not Effect.build)
        self.stepwise = bool(self.when) or any(type(c.effect).force is not Effect.force for c, _ in self.on)


class _Engine:
    """The working model of one structure, its edited copies and its Batch."""

    def __init__(self, world, structure):
        spec, nominal = world.spec.copy(), world.model
        for body in spec.bodies[1:]:
            body.simple = 0  # a simple body refuses a shifted centre of mass
        for actuator in spec.actuators:
            actuator.delay, actuator.nsample = 0, 0  # Signal delays the control instead
            if actuator.biastype == mujoco.mjtBias.mjBIAS_NONE and actuator.gaintype in (0, 1):
                actuator.type, actuator.biastype = mujoco.mjtActuator.mjACTUATOR_GENERAL, mujoco.mjtBias.mjBIAS_AFFINE
        for candidate in structure:
            candidate.effect.build(spec, candidate.place.name)
        self.nominal, self.model = nominal, spec.compile()
        self.q, self.v = [], []  # where the nominal joints' coordinates are in the working model
        for j in range(nominal.njnt):
            k = self.model.joint(nominal.joint(j).name).id
            width = nominal.joint(j).qpos0.size
            self.q += range(self.model.jnt_qposadr[k], self.model.jnt_qposadr[k] + width)
            width -= width in (4, 7)
            self.v += range(self.model.jnt_dofadr[k], self.model.jnt_dofadr[k] + width)
        self.early = nominal.opt.integrator != int(mujoco.mjtIntegrator.mjINT_RK4)
        self.data = mujoco.MjData(self.model)
        self.rest = np.empty(mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_INTEGRATION))
        mujoco.mj_getState(self.model, self.data, self.rest, mujoco.mjtState.mjSTATE_INTEGRATION)
        self.copies, self.batch = OrderedDict(), None

    def edited(self, items, step):
        """A copy of the model with the effects of items, or None if MuJoCo refuses it."""
        key = (step, *((c, v) for c, v in items))
        if key in self.copies:
            self.copies.move_to_end(key)
            return self.copies[key]
        model = copy(self.model)
        for candidate, values in items:
            candidate.effect.edit(model, candidate.effect.id(model, candidate.place.name), values)
        model.opt.timestep = step
        if any(c.effect.constants for c, _ in items):
            try:
                mujoco.mj_setConst(model, self.data)
            except mujoco.FatalError:
                model = None
        self.copies[key] = model
        if len(self.copies) > 64:
            self.copies.popitem(last=False)
        return model

    def run(self, cases, start_qpos, start_qvel, windows, rows, step, count, stepwise):
        """World.simulate for simulations that share structure, time step and way of stepping."""
        n, batch = len(cases), self._batch(len(cases))
        modes = [[self._mode(c.on, w, step, count, memo) for c, w in zip(cases, windows)] for memo in ({},)]
        if stepwise:
            memo = {}
            modes.append([self._mode(c.off, w, step, count, memo) if c.when else on for c, w, on in zip(cases, windows, modes[0])])
        offset, ratio, delay = self._sensors(cases)
        batch.warning[:] = 0
        batch.state[:n] = self.rest
        simple_q, simple_v = self._simple()
        start = np.array(start_qpos)
        start[:, simple_q] = (start[:, simple_q] - offset) / ratio + delay * start_qvel[:, simple_v] / ratio
        velocity = np.array(start_qvel)
        velocity[:, simple_v] /= ratio
        batch.bind('qpos')[:n, self.q], batch.bind('qvel')[:n, self.v] = start, velocity
        if self.model.na:
            batch.bind('act')[:n] = [self._activation(w, step) for w in windows]
        failed = np.array([any(m[k].model is None for m in modes) for k in range(n)])
        if stepwise:
            q, v = self._stepwise(batch, cases, modes, windows, step, count, failed)
        else:
            q, v = self._rollout(batch, modes[0], count, failed)
        failed |= batch.warning[:n, :, 1].any(axis=1)
        q, v = q[..., self.q], v[..., self.v]
        q = np.concatenate([start[:, None], q], axis=1)
        v = np.concatenate([velocity[:, None], v], axis=1)
        q[failed, 1:] = v[failed, 1:] = np.nan
        qpos, qvel = self._read(q, v, windows, rows, step, delay)
        qpos[..., simple_q] = qpos[..., simple_q] * ratio[:, None] + offset[:, None]
        qvel[..., simple_v] *= ratio[:, None]
        qpos[:, 0], qvel[:, 0] = start_qpos, start_qvel
        return qpos, qvel

    def _batch(self, n):
        if self.batch is None or self.batch.nsim < n:
            self.batch = Batch(self.model, 1 << (n - 1).bit_length())
        return self.batch

    def _mode(self, items, window, step, count, memo):
        """What drives a simulation under items: _Mode(model, ctrl (count, nu), qfrc (nv,), xfrc (nbody, 6), items)."""
        model = self.edited(items, step)
        recording = window.recording
        start = recording.time[window.first]
        changed = {}
        for candidate, values in items:
            if type(candidate.effect).command is not Effect.command:
                changed.setdefault(candidate.place.name, []).append((candidate.effect, values))
        ctrl = np.zeros((count, self.nominal.nu))
        for a in range(self.nominal.nactuator):
            name = self.nominal.actuator(a).name
            effects = tuple(changed.get(name, ()))
            for u in range(self.nominal.actuator_ctrladr[a], self.nominal.actuator_ctrladr[a] + self.nominal.actuator_ctrlnum[a]):
                key = id(recording), window.first, u, effects
                if key not in memo:
                    signal = self._signal(recording, a, u)
                    for effect, values in effects:
                        signal = effect.command(signal, self.nominal, a, values)
                    memo[key] = signal.sample(start, step, count, not self.early)
                ctrl[:, u] = memo[key]
        qfrc, xfrc = np.zeros(self.model.nv), np.zeros((self.model.nbody, 6))
        for candidate, values in items:
            candidate.effect.push(qfrc, xfrc, self.model, candidate.effect.id(self.model, candidate.place.name), values)
        return _Mode(model, ctrl, qfrc, xfrc, items)

    def _signal(self, recording, a, u):
        value, m = recording.ctrl[:, u], self.nominal
        if m.actuator_ctrllimited[a] and m.actuator_ctrlnum[a] == 1:
            value = np.clip(value, *m.actuator_ctrlrange[a])
        delay = max(m.actuator_delay[a], m.opt.timestep) if m.actuator_delay[a] > 0 else 0.0
        return Signal(recording.time, value, delay)

    def _activation(self, window, step):
        """Activations (na,) at a window's first row, run on from the recorded control."""
        act, time = np.zeros(self.model.na), window.recording.time
        for a in range(self.nominal.nactuator):
            i, kind = self.model.actuator_actadr[a], self.model.actuator_dyntype[a]
            if i < 0 or not window.first:
                continue
            signal = self._signal(window.recording, a, self.nominal.actuator_ctrladr[a])
            t = time[window.first] - signal.delay
            if kind in (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT)):
                act[i] = Signal(time, signal.value, 0.0, max(self.model.actuator_dynprm[a, 0], 1e-10))._filtered(np.array([t]))[0]
            elif kind == int(mujoco.mjtDyn.mjDYN_INTEGRATOR):
                act[i] = (signal.value * np.diff(np.minimum(np.append(time, time[-1]), max(t, time[0])))).sum()
                if self.model.actuator_actlimited[a]:
                    act[i] = np.clip(act[i], *self.model.actuator_actrange[a])
        return act

    def _rollout(self, batch, modes, count, failed):
        n = len(modes)
        batch.set_models([m.model or self.model for m in modes] + [self.model] * (batch.nsim - n))
        batch.bind('qfrc_applied')[:n] = [m.qfrc for m in modes]
        batch.bind('xfrc_applied')[:n] = [m.xfrc for m in modes]
        control = np.array([m.ctrl for m in modes]) if self.nominal.nu else None
        nq, nv = self.model.nq, self.model.nv
        out = {'qpos': np.full((n, count, nq), np.nan), 'qvel': np.full((n, count, nv), np.nan)}
        try:
            batch.rollout(count, control, record=('qpos', 'qvel'), ids=np.arange(n), out=out)
        except SimulationError as error:
            failed[error.ids] = True
        return out['qpos'], out['qvel']

    def _stepwise(self, batch, cases, modes, windows, step, count, failed):
        """As _rollout, with forces that depend on the state and conditions looked at before each step."""
        n, ids = len(cases), np.arange(len(cases))
        qpos, qvel, ctrl = batch.bind('qpos'), batch.bind('qvel'), batch.bind('ctrl')
        q, v = np.full((n, count, self.model.nq), np.nan), np.full((n, count, self.model.nv), np.nan)
        drive = [np.array([m.ctrl for m in mode]) for mode in modes]
        qfrc, xfrc = ([np.array([getattr(m, f) for m in mode]) for mode in modes] for f in ('qfrc', 'xfrc'))
        forces = [self._forces(mode) for mode in modes]
        holds = self._conditions(cases, windows)
        start = np.array([w.recording.time[w.first] for w in windows])
        active, pad = None, [self.model] * (batch.nsim - n)
        for k in range(count):
            now = holds(qpos[:n], qvel[:n], start + k * step)
            if active is None or (now != active).any():
                active = now
                batch.set_models([(on if a else off).model or self.model for on, off, a in zip(*modes, active)] + pad)
            which = active[:, None]
            ctrl[:n] = np.where(which, drive[0][:, k], drive[1][:, k])
            push = np.where(which, qfrc[0], qfrc[1])
            for mode, chosen in zip(forces, (active, ~active)):
                for members, function in mode:
                    add = function(qpos[members], qvel[members], ctrl[members], start[members] + k * step)
                    push[members] += add * chosen[members, None]
            batch.bind('qfrc_applied')[:n] = push
            batch.bind('xfrc_applied')[:n] = np.where(which[..., None], xfrc[0], xfrc[1])
            try:
                batch.step(ids)
            except SimulationError as error:
                failed[error.ids] = True
            q[:, k], v[:, k] = qpos[:n], qvel[:n]
        return q, v

    def _forces(self, modes):
        """[(members, function)] of the state-dependent forces of simulations in these modes."""
        groups = {}
        for s, mode in enumerate(modes):
            for candidate, values in mode.items:
                if type(candidate.effect).force is not Effect.force and mode.model is not None:
                    groups.setdefault(candidate, []).append((s, values))
        forces = []
        for candidate, members in groups.items():
            ids = np.array([s for s, _ in members])
            function = candidate.effect.force([modes[s].model for s in ids], candidate.effect.id(self.model, candidate.place.name),
                                              np.array([v for _, v in members]))
            if function is not None:
                forces.append((ids, function))
        return forces

    def _conditions(self, cases, windows):
        """A function (qpos, qvel, time) -> (n,) whether each simulation's conditional effects act."""
        groups, always = {}, np.ones(len(cases), bool)
        for s, (case, window) in enumerate(zip(cases, windows)):
            if case.when:
                if case.when.get('recording', window.recording.name) != window.recording.name:
                    always[s] = False
                for key, bounds in case.when.items():
                    if key != 'recording':
                        groups.setdefault(key, []).append((s, *bounds))

        def holds(qpos, qvel, time):
            active = always.copy()
            for key, members in groups.items():
                ids, low, high = (np.array(x) for x in zip(*members))
                kind, _, joint = key.partition(':')
                if kind == 'time':
                    x = time[ids]
                else:
                    address = self.model.joint(joint)
                    x = qpos[ids, address.qposadr[0]] if kind == 'qpos' else qvel[ids, address.dofadr[0]]
                active[ids] &= (x >= low) & (x < high)
            return active
        return holds

    def _simple(self):
        """Addresses in qpos and qvel of the nominal hinges and slides."""
        m = self.nominal
        simple = [j for j in range(m.njnt) if m.jnt_type[j] not in (FREE, BALL)]
        return m.jnt_qposadr[simple], m.jnt_dofadr[simple]

    def _sensors(self, cases):
        """offset, ratio, delay (n, simple joints) of the sensors."""
        m = self.nominal
        column = {m.joint(j).name: k for k, j in enumerate(j for j in range(m.njnt) if m.jnt_type[j] not in (FREE, BALL))}
        offset, ratio, delay = np.zeros((len(cases), len(column))), np.ones((len(cases), len(column))), np.zeros((len(cases), len(column)))
        for s, case in enumerate(cases):
            for candidate, values in case.on:
                if type(candidate.effect).measure is not Effect.measure:
                    o, r, d = candidate.effect.measure(values)
                    k = column[candidate.place.name]
                    offset[s, k], ratio[s, k], delay[s, k] = offset[s, k] + o, ratio[s, k] * r, delay[s, k] + d
        return offset, ratio, delay

    def _read(self, q, v, windows, rows, step, delay):
        """qpos, qvel at the rows' times, (n, rows, ·), from every time step q, v (n, 1 + count, ·)."""
        n, m = len(windows), self.nominal
        time = np.full((n, rows), np.nan)
        for s, w in enumerate(windows):
            time[s, :w.last - w.first + 1] = w.recording.time[w.first:w.last + 1] - w.recording.time[w.first]
        missing = np.isnan(time)
        x = np.where(missing, 0.0, time) / step
        s, k, f = _grid(x, q.shape[1])
        qpos, qvel = q[s, k], v[s, k]
        simple_q, simple_v = self._simple()
        if f.any():
            after, g = np.minimum(k + 1, q.shape[1] - 1), f[..., None]
            qpos, qvel = (1 - g) * qpos + g * q[s, after], (1 - g) * qvel + g * v[s, after]
            for j in range(m.njnt):
                if m.jnt_type[j] in (FREE, BALL):
                    a = m.jnt_qposadr[j] + (3 if m.jnt_type[j] == FREE else 0)
                    qpos[..., a:a + 4] /= np.linalg.norm(qpos[..., a:a + 4], axis=-1, keepdims=True)
                if m.jnt_type[j] == FREE:
                    a, d = m.jnt_qposadr[j] + np.arange(3), m.jnt_dofadr[j] + np.arange(3)
                    qpos[..., a] = _hermite(q[..., a], v[..., d], s[..., None], k[..., None], g, step, np.arange(3))
        if f.any() or delay.any():
            for c, (a, d) in enumerate(zip(simple_q, simple_v)):
                late = x - delay[:, c, None] / step
                s, k, f = _grid(np.maximum(late, 0.0), q.shape[1])
                early = np.minimum(late, 0.0) * step  # before the window: on from its start
                qpos[..., a] = _hermite(q[..., a], v[..., d], s, k, f, step) + early * v[:, :1, d]
                after = np.minimum(k + 1, q.shape[1] - 1)
                qvel[..., d] = (1 - f) * v[s, k, d] + f * v[s, after, d]
        qpos[missing] = qvel[missing] = np.nan
        return qpos, qvel


class _Mode(NamedTuple):
    model: object
    ctrl: np.ndarray
    qfrc: np.ndarray
    xfrc: np.ndarray
    items: list


def _grid(x, length):
    """Simulation, step index and fraction of times x, in steps, (n, rows)."""
    k = np.clip(np.floor(x + GRID).astype(int), 0, length - 1)
    f = np.where(abs(x - k) <= 1.5 * GRID, 0.0, x - k)
    return np.broadcast_to(np.arange(len(x))[:, None], x.shape), k, f


def _hermite(q, v, s, k, f, step, *column):
    """Cubic through positions q and velocities v at steps k and k + 1, at fraction f."""
    after = np.minimum(k + 1, q.shape[1] - 1)
    q0, q1, v0, v1 = q[(s, k, *column)], q[(s, after, *column)], v[(s, k, *column)] * step, v[(s, after, *column)] * step
    return q0 + f * v0 + f**2 * (3 * (q1 - q0) - 2 * v0 - v1) + f**3 * (2 * (q0 - q1) + v0 + v1)


@contextmanager
def quiet():
    """No warnings on the terminal or in MUJOCO_LOG.TXT from simulations that become unstable."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
