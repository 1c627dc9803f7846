"""Runs S windows at once on one working model: what World.simulate is made of.

The working model is the nominal one, rebuilt so that every effect can be put into
a copy of it. Effects change such copies, or the control signal before the run, so
that a whole window is one call of mujoco.batch.Batch; only forces that depend on
the state and effects under a condition are worked out step by step.
"""

from collections import OrderedDict
from copy import copy
from typing import NamedTuple

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from readout import read
from signals import Signal
from surroundings import touchable

COPY_BYTES = 50e6  # of edited models kept for the next call
ROTATES = 1  # body_simple of a simple body with rotations; one that only slides is 2, and feels contacts differently if not simple
STATE = mujoco.mjtState.mjSTATE_INTEGRATION
FREE, BALL = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)
FILTERS = int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT)


class Drive(NamedTuple):
    """What a simulation runs on: model, ctrl (count, nu), qfrc (nv,), xfrc (nbody, 6), and the effects in it."""
    model: mujoco.MjModel
    ctrl: np.ndarray
    qfrc: np.ndarray
    xfrc: np.ndarray
    items: list


class Engine:
    """The working model for a set of candidates that need parts of their own, its edited copies and its Batch."""

    def __init__(self, spec, nominal, structure):
        spec, self.nominal = spec.copy(), nominal
        for body in spec.bodies[1:]:
            if nominal.body(body.name).simple[0] == ROTATES:  # a simple body refuses a shifted centre of mass
                body.simple = 0
        for actuator in spec.actuators:
            actuator.delay, actuator.nsample = 0, 0  # Signal delays the control instead
            if actuator.biastype == mujoco.mjtBias.mjBIAS_NONE:
                actuator.type, actuator.biastype = mujoco.mjtActuator.mjACTUATOR_GENERAL, mujoco.mjtBias.mjBIAS_AFFINE
        for material in spec.materials:  # never seen, slow to copy
            material.textures = [''] * len(material.textures)
        for texture in spec.textures:
            spec.delete(texture)
        for candidate in structure:
            candidate.effect.build(spec, nominal, candidate.effect.id(nominal, candidate.place.name))
        self.model = m = spec.compile()
        idle = mujoco.mjtDisableBit.mjDSBL_ISLAND if m.ntree < 2 else 0
        if not (m.npair or m.nflex or any(touchable(m, i).any() for i in range(m.ngeom))):
            idle |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        m.opt.disableflags |= int(idle)  # what there is nothing to do for still takes its time
        # where the nominal model's coordinates are in the working model, which may have more joints
        self.q, self.v = [], []
        for j in range(nominal.njnt):
            k, kind = self.model.joint(nominal.joint(j).name).id, nominal.jnt_type[j]
            self.q += range(self.model.jnt_qposadr[k], self.model.jnt_qposadr[k] + {FREE: 7, BALL: 4}.get(kind, 1))
            self.v += range(self.model.jnt_dofadr[k], self.model.jnt_dofadr[k] + {FREE: 6, BALL: 3}.get(kind, 1))
        self.data = mujoco.MjData(self.model)
        self.rest = np.empty(mujoco.mj_stateSize(self.model, STATE))
        mujoco.mj_getState(self.model, self.data, self.rest, STATE)
        self.copies, self.batch = OrderedDict(), None
        self.most_copies = max(64, int(COPY_BYTES / mujoco.mj_sizeModel(self.model)))

    def run(self, cases, start_qpos, start_qvel, windows, rows, step, count, stepwise, sensors):
        """World.simulate for simulations that share structure, time step and way of stepping."""
        n = len(cases)
        memo = {}
        on = [self._drive(c.on, w, step, count, memo) for c, w in zip(cases, windows)]
        off = [self._drive(c.off, w, step, count, memo) if c.when else d for c, w, d in zip(cases, windows, on)]
        failed = np.array([a.model is None or b.model is None for a, b in zip(on, off)])

        joint, sensor = self._measures(cases)
        offset, ratio, delay = joint
        simple_q, simple_v = self._simple()
        true_q, true_v = start_qpos.copy(), start_qvel.copy()
        true_v[:, simple_v] /= ratio
        true_q[:, simple_q] = (true_q[:, simple_q] - offset) / ratio + delay * true_v[:, simple_v]

        if self.batch is None or self.batch.nsim < n:
            self.batch = Batch(self.model, 1 << (n - 1).bit_length())
        batch = self.batch
        batch.warning[:] = 0
        batch.state[:n] = self.rest
        batch.bind('qpos')[:n, self.q], batch.bind('qvel')[:n, self.v] = true_q, true_v
        if self.model.na:
            batch.bind('act')[:n] = [self._activation(w) for w in windows]
        record = ('qpos', 'qvel', 'sensordata') if sensors else ('qpos', 'qvel')
        # sensordata belongs to the state before a step, so sensors need one step more
        out = {f: np.full((n, count + sensors, getattr(self.data, f).size), np.nan) for f in record}
        if stepwise:
            failed |= self._step(batch, cases, windows, on, off, step, out)
        else:
            failed |= self._rollout(batch, on, out)
        failed |= batch.warning[:n, :, 1].any(axis=1)

        q = np.concatenate([true_q[:, None], out['qpos'][:, :count, self.q]], axis=1)
        v = np.concatenate([true_v[:, None], out['qvel'][:, :count, self.v]], axis=1)
        q[failed, 1:] = v[failed, 1:] = np.nan
        time = np.full((n, rows), np.nan)
        for s, w in enumerate(windows):
            time[s, :w.last - w.first + 1] = w.recording.time[w.first:w.last + 1] - w.recording.time[w.first]
        qpos, qvel = read(self.nominal, q, v, time, step, simple_q, simple_v, delay)
        qpos[..., simple_q] = qpos[..., simple_q] * ratio[:, None] + offset[:, None]
        qvel[..., simple_v] *= ratio[:, None]
        qpos[:, 0], qvel[:, 0] = start_qpos, start_qvel
        if not sensors:
            return qpos, qvel
        offset, ratio, delay = sensor
        out['sensordata'][failed] = np.nan
        late = np.maximum(time[..., None] - delay[:, None], 0.0) / step
        k = np.clip(np.nan_to_num(late).astype(int), 0, count - 1)
        f, s, c = late - k, np.arange(n)[:, None, None], np.arange(delay.shape[1])
        data = (1 - f) * out['sensordata'][s, k, c] + f * out['sensordata'][s, k + 1, c]
        return qpos, qvel, data * ratio[:, None] + offset[:, None]

    def _edited(self, items, step):
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
        if len(self.copies) > self.most_copies:
            self.copies.popitem(last=False)
        return model

    def _drive(self, items, window, step, count, memo):
        """The Drive of a window under items. memo keeps what simulations of one call share."""
        key = id(items)
        if key not in memo:
            changed, qfrc, xfrc = {}, np.zeros(self.model.nv), np.zeros((self.model.nbody, 6))
            for candidate, values in items:
                if candidate.effect.overrides('command'):
                    changed.setdefault(candidate.place.name, []).append((candidate.effect, values))
                candidate.effect.push(qfrc, xfrc, self.model, candidate.effect.id(self.model, candidate.place.name), values)
            memo[key] = self._edited(items, step), qfrc, xfrc, {name: tuple(effects) for name, effects in changed.items()}
        model, qfrc, xfrc, changed = memo[key]
        recording, m = window.recording, self.nominal
        key = id(recording), window.first
        if key not in memo:
            memo[key] = np.zeros((count, m.nu))
            for a in range(m.nactuator):
                for u in range(m.actuator_ctrladr[a], m.actuator_ctrladr[a] + m.actuator_ctrlnum[a]):
                    memo[key][:, u] = self._sample(self._signal(recording, a, u), window, step, count)
        ctrl = memo[key]
        if changed:
            ctrl = ctrl.copy()
            for name, effects in changed.items():
                a = m.actuator(name).id
                u = m.actuator_ctrladr[a]
                key = id(recording), window.first, u, effects
                if key not in memo:
                    signal = self._signal(recording, a, u)
                    for effect, values in effects:
                        signal = effect.command(signal, m, a, values)
                    memo[key] = self._sample(signal, window, step, count)
                ctrl[:, u] = memo[key]
        return Drive(model, ctrl, qfrc, xfrc, items)

    def _signal(self, recording, a, u):
        """The nominal Signal of control u of actuator a."""
        value, m = recording.ctrl[:, u], self.nominal
        if m.actuator_ctrllimited[a] and m.actuator_ctrlnum[a] == 1:
            value = np.clip(value, *m.actuator_ctrlrange[a])
        return Signal(recording.time, value, max(m.actuator_delay[a], m.opt.timestep) if m.actuator_delay[a] > 0 else 0.0)

    def _sample(self, signal, window, step, count):
        return signal.sample(window.recording.time[window.first], step, count, self.nominal.opt.integrator == int(mujoco.mjtIntegrator.mjINT_RK4))

    def _activation(self, window):
        """Activations (na,) at a window's first row, run on from the recorded control."""
        act, m = np.zeros(self.model.na), self.model
        for a in range(self.nominal.nactuator):
            i, kind = m.actuator_actadr[a], m.actuator_dyntype[a]
            signal = self._signal(window.recording, a, self.nominal.actuator_ctrladr[a])
            t = np.array([window.recording.time[window.first] - signal.delay])
            if i >= 0 and kind in FILTERS:
                act[i] = Signal(signal.time, signal.value, lag=max(m.actuator_dynprm[a, 0], 1e-10)).filtered(t)[0]
            elif i >= 0 and kind == int(mujoco.mjtDyn.mjDYN_INTEGRATOR):  # from zero at the first row
                limits = m.actuator_actrange[a] if m.actuator_actlimited[a] else (-np.inf, np.inf)
                act[i] = np.clip(signal.integral(np.maximum(t, signal.time[0]))[0], *limits)
        return act

    def _rollout(self, batch, drives, out):
        """Run all steps in one call; fill out, return which simulations failed (n,)."""
        n, failed = len(drives), np.zeros(len(drives), bool)
        batch.set_models([d.model or self.model for d in drives] + [self.model] * (batch.nsim - n))
        batch.bind('qfrc_applied')[:n] = [d.qfrc for d in drives]
        batch.bind('xfrc_applied')[:n] = [d.xfrc for d in drives]
        ctrl, count = np.array([d.ctrl for d in drives]), out['qpos'].shape[1]
        ctrl = np.pad(ctrl, ((0, 0), (0, count - ctrl.shape[1]), (0, 0)), mode='edge')
        try:
            batch.rollout(count, ctrl if self.nominal.nu else None, record=tuple(out), ids=np.arange(n), out=out)
        except SimulationError as error:
            failed[error.ids] = True
        return failed

    def _step(self, batch, cases, windows, on, off, step, out):
        """As _rollout, with forces that depend on the state and conditions looked at before each step."""
        n, failed = len(cases), np.zeros(len(cases), bool)
        ids, spare = np.arange(n), [self.model] * (batch.nsim - n)
        live = {f: batch.bind(f) for f in {'qpos', 'qvel', 'ctrl', 'qfrc_applied', 'xfrc_applied', *out}}
        ctrl, qfrc, xfrc = ([np.array([getattr(d, f) for d in drives]) for drives in (on, off)] for f in ('ctrl', 'qfrc', 'xfrc'))
        forces = [self._forces(drives) for drives in (on, off)]
        holds, active = self._conditions(cases, windows), None
        start = np.array([w.recording.time[w.first] for w in windows])
        for k in range(out['qpos'].shape[1]):
            time = start + k * step
            now = holds(live['qpos'][:n], live['qvel'][:n], time)
            if active is None or (now != active).any():
                active = now
                batch.set_models([(a if yes else b).model or self.model for a, b, yes in zip(on, off, active)] + spare)
            j, yes = min(k, ctrl[0].shape[1] - 1), active[:, None]
            live['ctrl'][:n] = np.where(yes, ctrl[0][:, j], ctrl[1][:, j])
            push = np.where(yes, *qfrc)
            for functions, chosen in zip(forces, (active, ~active)):
                for members, function in functions:
                    added = function(live['qpos'][members], live['qvel'][members], live['ctrl'][members], time[members])
                    push[members] += np.where(chosen[members, None], added, 0.0)
            live['qfrc_applied'][:n] = push
            live['xfrc_applied'][:n] = np.where(yes[..., None], *xfrc)
            try:
                batch.step(ids)
            except SimulationError as error:
                failed[error.ids] = True
            for f in out:
                out[f][:, k] = live[f][:n]
        return failed

    def _forces(self, drives):
        """[(members, function)] of the state-dependent forces of simulations."""
        groups = {}
        for s, drive in enumerate(drives):
            for candidate, values in drive.items:
                if candidate.effect.overrides('force') and drive.model is not None:
                    groups.setdefault(candidate, []).append((s, values))
        forces = []
        for candidate, members in groups.items():
            ids, values = np.array([s for s, _ in members]), np.array([v for _, v in members])
            function = candidate.effect.force([drives[s].model for s in ids], candidate.effect.id(self.model, candidate.place.name), values)
            if function is not None:
                forces.append((ids, function))
        return forces

    def _conditions(self, cases, windows):
        """A function (qpos, qvel, time) -> (n,): whether each simulation's conditional effects act."""
        always, groups = np.ones(len(cases), bool), {}
        for s, (case, window) in enumerate(zip(cases, windows)):
            for key, bounds in (case.when or {}).items():
                if key == 'recording':
                    always[s] = bounds == window.recording.name
                else:
                    groups.setdefault(key, []).append((s, *bounds))
        groups = {key: [np.array(x) for x in zip(*members)] for key, members in groups.items()}

        def holds(qpos, qvel, time):
            active = always.copy()
            for key, (ids, low, high) in groups.items():
                kind, _, joint = key.partition(':')
                x = time if kind == 'time' else qpos[:, self.model.joint(joint).qposadr[0]] if kind == 'qpos' else qvel[:, self.model.joint(joint).dofadr[0]]
                active[ids] &= (x[ids] >= low) & (x[ids] < high)
            return active
        return holds

    def _simple(self):
        """Addresses in qpos and in qvel of the nominal hinges and slides."""
        simple = ~np.isin(self.nominal.jnt_type, (FREE, BALL))
        return self.nominal.jnt_qposadr[simple], self.nominal.jnt_dofadr[simple]

    def _measures(self, cases):
        """(offset, ratio, delay) (3, n, ·) of the hinges and slides, and of sensordata."""
        m = self.nominal
        simple_q, _ = self._simple()
        measures = [np.zeros((3, len(cases), width)) for width in (len(simple_q), m.nsensordata)]
        for measure in measures:
            measure[1] = 1.0
        for s, case in enumerate(cases):
            for candidate, values in case.on:
                if candidate.effect.overrides('measure'):
                    offset, ratio, delay = candidate.effect.measure(values)
                    if candidate.place.kind == 'sensor':
                        i = m.sensor(candidate.place.name).id
                        part = measures[1][:, s, m.sensor_adr[i]:m.sensor_adr[i] + m.sensor_dim[i]]
                    else:
                        part = measures[0][:, s, np.flatnonzero(simple_q == m.joint(candidate.place.name).qposadr[0])[0]]
                    part[0], part[1], part[2] = part[0] + offset, part[1] * ratio, part[2] + delay
        return measures
