"""A force in a joint that the catalogue has no name for: some curve of one variable.

candidate = curve(model, 'elbow', 'velocity:elbow', knots)      # its parameters: the force at each knot
"""

import mujoco
import numpy as np

from diagnosis.effects.base import (
    HUGE,
    JOINT_TRANSMISSION,
    Candidate,
    Parameter,
    Place,
    constant_force,
)
from diagnosis.effects.joints import JointEffect


class Unknown(JointEffect):
    """A force in the joint that is some curve of one variable: its values at knots, linear between, flat beyond.

    variable: 'position:<joint>', 'velocity:<joint>', 'control:<actuator>' or 'time'. factor: None, or what the curve is
    multiplied by: 'control:<actuator>' for what it is asked for (see asked), or 'velocity:<joint>' for its sign. wave: a sine
    through two knots, a quarter of its period apart.
    """

    name, kind, simplicity = "unknown", "joint", 3

    def __init__(self, variable, knots, factor=None, wave=False):
        self.variable, self.knots, self.factor, self.wave = (
            variable,
            tuple(float(x) for x in knots),
            factor,
            wave,
        )

    def _key(self):
        return self.variable, self.knots, self.factor, self.wave

    def __eq__(self, other):
        return isinstance(other, Unknown) and self._key() == other._key()

    def __hash__(self):
        return hash(self._key())

    def parameters(self, model, i):
        M = self.scale(model, i)
        force = self.unit(model, i, "N·m", "N")
        return tuple(
            Parameter(f"force {k}", force, 0.0, -HUGE * M, HUGE * M, 0.05 * M)
            for k in range(len(self.knots))
        )

    def at(self, x, values):
        """The curve at x (n,), before its factor, with values (n, k) at the knots of each: (n,)."""
        knots, rows = np.array(self.knots), np.arange(len(x))
        if self.wave:
            turn = np.pi / 2 * (x - knots[0]) / (knots[1] - knots[0])
            return values[:, 0] * np.cos(turn) + values[:, 1] * np.sin(turn)
        k = np.clip(np.searchsorted(knots, x) - 1, 0, len(knots) - 2)
        f = np.clip((x - knots[k]) / (knots[k + 1] - knots[k]), 0.0, 1.0)
        return (1 - f) * values[rows, k] + f * values[rows, k + 1]

    def force(self, models, i, values):
        model = models[0]
        d = model.jnt_dofadr[i]

        def read(variable, qpos, qvel, ctrl, time):
            kind, _, name = variable.partition(":")
            if kind == "time":
                return time
            if kind == "control":
                return ctrl[:, model.actuator_ctrladr[model.actuator(name).id]]
            joint = model.joint(name)
            return qpos[:, joint.qposadr[0]] if kind == "position" else qvel[:, joint.dofadr[0]]

        def curve(*state):
            x, out = read(self.variable, *state), np.zeros_like(state[1])
            out[:, d] = self.at(x, values)
            if self.factor:
                kind, _, name = self.factor.partition(":")
                out[:, d] *= (
                    asked(model, model.actuator(name).id, *state[:3])
                    if kind == "control"
                    else np.sign(read(self.factor, *state))
                )
            return out

        return curve

    def write(self, spec, model, i, values):
        """As a constant and a cubic in the joint's own position or velocity, if that is within 5 % of the curve."""
        joint = spec.joint(model.joint(i).name)
        x, y = np.array(self.knots), np.array(values)
        if self.factor or self.wave:
            return "none"
        if self.variable == f"velocity:{joint.name}":
            powers, field = [x, x * abs(x), x**3], joint.damping
        elif self.variable == f"position:{joint.name}":
            shift = (
                x - spec.copy().compile().joint(joint.name).qpos_spring[0]
            )  # where an offset may have moved it
            powers, field = [shift, shift**2, shift**3], joint.stiffness
        else:
            return "none"
        basis = np.stack([np.ones_like(x), *powers], axis=1)
        size = abs(basis).max(axis=0)
        fit = np.linalg.lstsq(basis / size, y, rcond=None)[0] / size
        if abs(basis @ fit - y).max() > 0.05 * np.ptp(y):
            return "none"
        field[:] = np.array(field) - fit[1:]
        names = [
            f"unknown:{joint.name}",
            *(f"unknown:{joint.name}:{n}" for n in range(2, len(spec.actuators) + 3)),
        ]
        taken = {actuator.name for actuator in spec.actuators}  # by a corrected model's own
        constant_force(
            spec,
            next(name for name in names if name not in taken),
            fit[0],
            JOINT_TRANSMISSION,
            joint.name,
        )
        return "mjcf"


def asked(model, a, qpos, qvel, ctrl):
    """(n,) control of an actuator on a hinge or slide; of a servo, less where it already is: its nominal force over its gain."""
    u, gain, bias = (
        ctrl[..., model.actuator_ctrladr[a]],
        model.actuator_gainprm[a, 0],
        model.actuator_biasprm[a],
    )
    if model.actuator_biastype[a] != mujoco.mjtBias.mjBIAS_AFFINE or not gain:
        return u
    j, gear = model.actuator_trnid[a, 0], model.actuator_gear[a, 0]
    q, v = qpos[..., model.jnt_qposadr[j]], qvel[..., model.jnt_dofadr[j]]
    return u + (bias[0] + gear * (bias[1] * q + bias[2] * v)) / gain


def curve(model, joint, variable, knots, factor=None, wave=False):
    """Candidate for an unknown force in a joint: see Unknown. Parameters: the force at each knot."""
    effect = Unknown(variable, knots, factor, wave)
    return Candidate(effect, Place("joint", joint), effect.parameters(model, model.joint(joint).id))
