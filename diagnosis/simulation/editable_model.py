"""The working model: the nominal one rebuilt so that every effect can be put into a copy of it."""

from collections import OrderedDict
from copy import copy
from typing import NamedTuple

import mujoco
import numpy as np

from diagnosis.effects.actuators import nominal_delay
from diagnosis.effects.base import runge_kutta
from diagnosis.effects.environment import collides
from diagnosis.simulation.control_signal import SLACK, Signal

COPY_BYTES = 50e6  # of edited models, and of sampled controls, kept for the next call
ROTATES = 1  # body_simple of a simple body with rotations; one that only slides is 2
MUSCLE = int(mujoco.mjtDyn.mjDYN_MUSCLE)
FREE, BALL = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)
FILTERS = int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT)


class Drive(NamedTuple):
    """What a simulation runs on: ctrl (count, nu), qfrc (nv,), xfrc (nbody, 6); model None if
    MuJoCo refused it; changed: see Working.changed()."""

    model: mujoco.MjModel
    ctrl: np.ndarray
    qfrc: np.ndarray
    xfrc: np.ndarray
    items: list
    changed: tuple


class Working:
    """The model for a set of candidates that need parts of their own.

    model; q, v: where in its qpos and qvel the nominal model's coordinates are.
    """

    def __init__(self, spec, nominal, structure):
        spec, self.nominal = spec.copy(), nominal
        for body in spec.bodies[1:]:
            # a simple body refuses a shifted centre of mass; one that only slides feels other
            # contacts if not simple
            if nominal.body(body.name).simple[0] == ROTATES:
                body.simple = 0
        for actuator in spec.actuators:
            actuator.delay, actuator.nsample = 0, 0  # Signal delays the control instead
            if actuator.biastype == mujoco.mjtBias.mjBIAS_NONE:
                actuator.type, actuator.biastype = (
                    mujoco.mjtActuator.mjACTUATOR_GENERAL,
                    mujoco.mjtBias.mjBIAS_AFFINE,
                )
        for material in spec.materials:  # never seen, slow to copy
            material.textures = [""] * len(material.textures)
        for texture in spec.textures:
            spec.delete(texture)
        for candidate in sorted(
            structure, key=lambda c: (c.effect.name, c.place.kind, c.place.name)
        ):  # the same in every process
            candidate.effect.build(
                spec, nominal, candidate.effect.id(nominal, candidate.place.name)
            )
        self.model = m = spec.compile()
        idle = mujoco.mjtDisableBit.mjDSBL_ISLAND if m.ntree < 2 else 0
        if not collides(m):
            idle |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        m.opt.disableflags |= int(idle)  # what there is nothing to do for still takes its time
        self.q, self.v = [], []
        for j in range(nominal.njnt):
            k, kind = m.joint(nominal.joint(j).name).id, nominal.jnt_type[j]
            self.q += range(m.jnt_qposadr[k], m.jnt_qposadr[k] + {FREE: 7, BALL: 4}.get(kind, 1))
            self.v += range(m.jnt_dofadr[k], m.jnt_dofadr[k] + {FREE: 6, BALL: 3}.get(kind, 1))
        self.data = mujoco.MjData(m)
        self.muscles = {}
        self.copies, self.most_copies = (
            OrderedDict(),
            max(64, int(COPY_BYTES / mujoco.mj_sizeModel(m))),
        )
        self.controls, self.control_bytes = OrderedDict(), 0

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
        if len(self.copies) > self.most_copies:
            self.copies.popitem(last=False)
        return model

    def drive(self, items, recording, start, step, count, memo):
        """The Drive under items for `count` steps from time `start`. memo keeps what the drives of
        one call share."""
        key = id(items)
        if key not in memo:
            qfrc, xfrc = np.zeros(self.model.nv), np.zeros((self.model.nbody, 6))
            for candidate, values in items:
                i = candidate.effect.id(self.model, candidate.place.name)
                candidate.effect.push(qfrc, xfrc, self.model, i, values)
            memo[key] = self.edited(items, step), qfrc, xfrc, self.changed(items)
        model, qfrc, xfrc, changed = memo[key]
        ctrl = self.control(recording, start, step, count, changed)
        return Drive(model, ctrl, qfrc, xfrc, items, changed)

    @staticmethod
    def changed(items):
        """((actuator, ((effect, values), ...)), ...): the effects of items on the way of the
        controls to the actuators."""
        found = {}
        for candidate, values in items:
            if candidate.effect.overrides("command"):
                found.setdefault(candidate.place.name, []).append((candidate.effect, values))
        return tuple((name, tuple(effects)) for name, effects in found.items())

    def control(self, recording, start, step, count, changed=()):
        """What the actuators see in `count` steps from time `start`, (count, nu), kept for the
        next call; changed: see changed()."""
        key = recording, start, step, count, changed
        if key in self.controls:
            self.controls.move_to_end(key)
            return self.controls[key]
        m, average = self.nominal, runge_kutta(self.nominal)
        ctrl = self.control(recording, start, step, count).copy() if changed else None
        ctrl = np.zeros((count, m.nu)) if ctrl is None else ctrl
        some = [m.actuator(name).id for name, _ in changed] if changed else range(m.nactuator)
        for a in some:
            for u in range(m.actuator_ctrladr[a], m.actuator_ctrladr[a] + m.actuator_ctrlnum[a]):
                signal = self.signal(recording, a, u, changed)
                ctrl[:, u] = signal.sample(start, step, count, average)
        self.controls[key] = ctrl
        self.control_bytes += ctrl.nbytes
        while self.control_bytes > COPY_BYTES and len(self.controls) > 1:
            self.control_bytes -= self.controls.popitem(last=False)[1].nbytes
        return ctrl

    def signal(self, recording, a, u, changed=()):
        """The Signal of control u of actuator a, the nominal one or as effects change it."""
        value, m = recording.ctrl[:, u], self.nominal
        if m.actuator_ctrllimited[u]:
            value = np.clip(value, *m.actuator_ctrlrange[u])
        signal = Signal(recording.time, value, nominal_delay(m, a))
        for name, effects in changed:
            for effect, values in effects if name == m.actuator(a).name else ():
                signal = effect.command(signal, m, a, values)
        return signal

    def activation(self, recording, start, changed=()):
        """Activations (n, na) at times `start` (n,), run on from the recorded control, as effects
        change it."""
        m, start = self.model, np.asarray(start, float)
        act = np.zeros((len(start), m.na))
        for a in np.flatnonzero(self.nominal.actuator_ctrlnum):
            i, kind = m.actuator_actadr[a], m.actuator_dyntype[a]
            if i < 0:
                continue
            signal = self.signal(recording, a, self.nominal.actuator_ctrladr[a], changed)
            t = start - signal.delay
            if kind in FILTERS:
                lag = max(m.actuator_dynprm[a, 0], 1e-10)
                act[:, i] = Signal(signal.time, signal.value, lag=lag).filtered(t)
            elif kind == int(mujoco.mjtDyn.mjDYN_INTEGRATOR):  # from zero at the first row
                limited = m.actuator_actlimited[a]
                limits = m.actuator_actrange[a] if limited else (-np.inf, np.inf)
                act[:, i] = signal.held(np.maximum(t, signal.time[0]), *limits)
            elif kind == MUSCLE:
                act[:, i] = np.interp(t, *self._muscle(recording, a))
        return act

    def _muscle(self, recording, a):
        """Time and activation (n,) of muscle a over a recording, without delay, from its first
        control held for long."""
        if (recording, a) not in self.muscles:
            h, m = self.nominal.opt.timestep, self.nominal
            time = np.arange(recording.time[0], recording.time[-1] + h, h)
            ctrl = np.clip(recording.ctrl[:, m.actuator_ctrladr[a]], 0.0, 1.0)
            ctrl = ctrl[np.searchsorted(recording.time, time + SLACK * h, side="right") - 1]
            act = np.full(len(time), ctrl[0])
            for k in range(len(time) - 1):
                act[k + 1] = act[k] + h * mujoco.mju_muscleDynamics(
                    ctrl[k], act[k], m.actuator_dynprm[a, :3]
                )
            self.muscles[recording, a] = time, act
        return self.muscles[recording, a]
