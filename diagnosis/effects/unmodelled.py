"""A force in a joint that the catalogue has no name for: some curve of one variable.

candidate = curve(model, 'elbow', 'velocity:elbow', knots)      # its parameters: the force at
each knot
"""

import mujoco
import numpy as np

from diagnosis.effects.base import (
    HUGE,
    JOINT_TRANSMISSION,
    Candidate,
    Parameter,
    Part,
    Place,
    constant_force,
)
from diagnosis.effects.drives import drive_torque
from diagnosis.effects.joints import JointEffect

CLOSE = 0.05  # of a curve's range, by which a polynomial may miss it
BEYOND = 3.0  # times its largest force, at most, at half the travel beyond it
BETWEEN = 10  # points looked at between two knots
MOVING = {"velocity": np.sign, "speed": np.abs, "damping": np.array}  # of a joint's velocity
FAR = 1e3  # times the travel, where the highest power decides


class Unknown(JointEffect):
    """A force in the joint that is some curve of one variable: its values at knots, linear
    between, flat beyond.

    variable: 'position:<joint>', 'velocity:<joint>', 'control:<actuator>', 'load:<joint>' (the
    force of its drives) or 'time'. factor: None, or what the curve is multiplied by:
    'control:<actuator>' for what it is asked for (see asked), 'velocity:<joint>' for its sign,
    'speed:<joint>' for its size, or 'damping:<joint>' for both. wave: a sine through two knots, a
    quarter of its period apart.
    """

    name, kind, simplicity = "unknown", "joint", 4

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

    @property
    def depends_on(self):
        """What the force varies with, in the contract's words."""
        kind, _, name = (self.factor or "").partition(":")
        factor = f"velocity:{name}" if kind in MOVING else self.factor
        return tuple(dict.fromkeys(v for v in (self.variable, factor) if v))

    def parameters(self, model, i):
        M = self.scale(model, i)
        force = self.unit(model, i, "N·m", "N")
        if (self.factor or "").startswith(("speed", "damping")):
            force = self.unit(model, i, "N·m·s/rad", "N·s/m")
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

        read = reader(models)

        def curve(*state):
            x, out = read(self.variable, *state), np.zeros_like(state[1])
            out[:, d] = self.at(x, values)
            if self.factor:
                out[:, d] *= self._times(models, read, state)
            return out

        return curve

    def _times(self, models, read, state):
        """The factor (n,) at states."""
        kind, _, name = self.factor.partition(":")
        if kind == "control":
            return asked(models, models[0].actuator(name).id, *state[:3])
        return MOVING[kind](read(f"velocity:{name}", *state))

    def part(self, model, i, values):
        numbers = {
            "of": _in_script(model, self.variable),
            "knots": list(self.knots),
            "forces": [float(v) for v in values],
            "factor": self.factor and _in_script(model, self.factor),
        }
        return Part("wave" if self.wave else "curve", model.joint(i).name, numbers)

    def write(self, spec, model, i, values):
        """As a constant and a polynomial in the joint's own position or velocity, where one holds
        the curve.

        The lowest order that stays within 5 % of the curve, between the knots too, and beyond them
        does not run away (see holds); else it is left to corrected.py.
        """
        joint = spec.joint(model.joint(i).name)
        if self.factor or self.wave:
            return "python"
        if self.variable == f"velocity:{joint.name}":
            zero, powers, field = (
                0.0,
                (lambda x: x, lambda x: x * abs(x), lambda x: x**3),
                "damping",
            )
        elif self.variable == f"position:{joint.name}":  # from where an offset may have moved it
            written = spec.copy().compile().joint(joint.name)
            by = written.qpos0[0] - model.joint(joint.name).qpos0[0]  # its sensor's bias
            zero = written.qpos_spring[0] - by
            powers, field = (lambda x: x, lambda x: x**2, lambda x: x**3), "stiffness"
        else:
            return "python"
        polynomial = self._polynomial(zero, powers, np.array(values))
        if polynomial is None:
            return "python"
        setattr(joint, field, np.array(getattr(joint, field)) - polynomial[1:])
        names = [
            f"unknown:{joint.name}",
            *(f"unknown:{joint.name}:{n}" for n in range(2, len(spec.actuators) + 3)),
        ]
        taken = {actuator.name for actuator in spec.actuators}  # by a corrected model's own
        name = next(name for name in names if name not in taken)
        constant_force(spec, name, polynomial[0], JOINT_TRANSMISSION, joint.name)
        return "mjcf"

    def _polynomial(self, zero, powers, values):
        """(4,) factors of 1 and the powers of x - zero that hold the curve, or None."""
        low, high = self.knots[0], self.knots[-1]
        x = np.linspace(low, high, BETWEEN * (len(self.knots) - 1) + 1)
        y = self.at(x, np.tile(values, (len(x), 1)))
        for order in range(len(powers) + 1):
            basis = lambda x: np.stack(
                [np.ones_like(x), *(power(x - zero) for power in powers[:order])], axis=1
            )
            size = abs(basis(x)).max(axis=0)
            fit = np.linalg.lstsq(basis(x) / size, y, rcond=None)[0] / size
            if holds(lambda x: basis(x) @ fit, x, y, zero):
                return np.pad(fit, (0, 3 - order))
        return None


def _in_script(model, variable):
    """A variable as corrected.py has it. A control is what reaches the actuator: where the model
    has a filter or an integral of its own, what goes into that."""
    kind, _, name = variable.partition(":")
    inside = kind == "control" and model.actuator(name).dyntype[0] != mujoco.mjtDyn.mjDYN_NONE
    return f"command:{name}" if inside else variable


def reader(models):
    """Function (variable, qpos, qvel, ctrl, time) -> (S,) its values; see Unknown."""
    model, torques = models[0], {}

    def read(variable, qpos, qvel, ctrl, time):
        kind, _, name = variable.partition(":")
        if kind == "time":
            return time
        if kind == "control":
            return ctrl[:, model.actuator_ctrladr[model.actuator(name).id]]
        joint = model.joint(name)
        if kind == "load":
            if name not in torques:
                torques[name] = drive_torque(models, joint.id)
            return torques[name](qpos, qvel, ctrl)
        return qpos[:, joint.qposadr[0]] if kind == "position" else qvel[:, joint.dofadr[0]]

    return read


def holds(force, x, y, zero):
    """Whether a function may stand for the curve of forces y (n,) at x (n,), ascending.

    It has to be within 5 % of the curve, and beyond it no more than BEYOND times as large at half
    the travel further, and in the end to push back towards zero: what has left the travel returns.
    """
    if abs(force(x) - y).max() > CLOSE * np.ptp(y) + 1e-12 * abs(y).max():
        return False
    centre, half = (x[0] + x[-1]) / 2, (x[-1] - x[0]) / 2
    further = force(np.array([centre - 1.5 * half, centre + 1.5 * half]))
    if abs(further).max() > BEYOND * abs(y).max():
        return False
    far = max(abs(x - zero).max(), 2 * half) * FAR
    below, above = force(np.array([zero - far, zero + far]))
    most = (1 + CLOSE) * abs(y).max()
    return bool(below >= -most and above <= most)


def asked(models, a, qpos, qvel, ctrl):
    """(n,) control of an actuator on a hinge or slide; of a servo, less where it already is: its
    force without a limit over its gain. models: one for each row, or one for all."""
    model = models[0]
    u = ctrl[..., model.actuator_ctrladr[a]]
    gain = np.array([m.actuator_gainprm[a, 0] for m in models])
    if model.actuator_biastype[a] != mujoco.mjtBias.mjBIAS_AFFINE or not gain.all():
        return u
    bias = np.array([m.actuator_biasprm[a, :3] for m in models]).T
    j, gear = model.actuator_trnid[a, 0], model.actuator_gear[a, 0]
    q, v = qpos[..., model.jnt_qposadr[j]], qvel[..., model.jnt_dofadr[j]]
    return u + (bias[0] + gear * (bias[1] * q + bias[2] * v)) / gain


def curve(model, joint, variable, knots, factor=None, wave=False):
    """Candidate for an unknown force in a joint: see Unknown. Parameters: the force at each
    knot."""
    effect = Unknown(variable, knots, factor, wave)
    return Candidate(effect, Place("joint", joint), effect.parameters(model, model.joint(joint).id))
