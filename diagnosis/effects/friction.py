"""Dry friction of a level that depends on the state: on speed, load or place.

Speed: Stribeck's fall. Load: gears. Place: bearings and rails that run out of true. A simulation
sets the level anew before each step (see Effect.limit), and beside corrected.xml a script does
(corrected.py).
"""

import numpy as np

from diagnosis.effects.base import (
    HUGE,
    Candidate,
    Parameter,
    Part,
    Place,
    catalogue,
)
from diagnosis.effects.drives import controlled, drive_torque, drives_of
from diagnosis.effects.joints import (
    SOLIMP_FRICTION,
    SOLREF_FRICTION,
    CoulombFriction,
    JointEffect,
)

# share by which friction at rest is larger than that of motion, at least, that it is called
# Stribeck's
MOST_FALL = 5.0  # times the friction of motion, that of rest at most: dry surfaces reach 2 to 3
FALLS = 0.05
SELF_LOCKING = 2.0  # share of the load beyond which no drive would turn
# radians that a friction map's wave turns over the travel, to try first: so close to each other
# that one of them stays in step with the true wave from end to end
TURNS = np.arange(6.5, 40.0, 3.0)


@catalogue
class StribeckFriction(JointEffect):
    """Dry friction that falls from `static` at rest to `coulomb` when moving faster than
    `velocity`.

    |F| ≤ coulomb + (static − coulomb) exp(−(v/velocity)²); N·m (N), velocity in rad/s (m/s).
    corrected.xml has its frictionloss `coulomb`, the rest stands in corrected.py: the LuGre
    bristles of
    MuJoCo's dcmotor fall alike in steady motion, but stick and slip otherwise. Source: Stribeck
    (1902);
    Armstrong-Hélouvry, Dupont, Canudas de Wit (1994).
    """

    name, simplicity, amplitudes = "stribeck_friction", 3, 2
    acts_through = "velocity"

    def parameters(self, model, i):
        M, force = self.scale(model, i), self.unit(model, i, "N·m", "N")
        held = float(model.dof_frictionloss[model.jnt_dofadr[i]])
        return (
            Parameter("coulomb", force, held, 0.0, HUGE * M, 0.05 * M),
            Parameter("static", force, held, 0.0, HUGE * M, 0.05 * M),
            Parameter("velocity", self.unit(model, i, "rad/s", "m/s"), 0.1, 1e-4, 100.0, 0.01),
        )

    def probes(self, model, i, recordings):
        step, (_, speed) = 0.05 * self.scale(model, i), self.travel(model, i, recordings)
        slow = np.quantile(speed, [0.2, 0.5]) + 1e-4
        held = self.parameters(model, i)[0].nominal
        return np.array([(held + step, held + r * step, v) for v in slow for r in (1.5, 3.0)])

    def possible(self, values, nominal):
        """It falls with speed, by enough to matter, and not to nothing."""
        return (1 + FALLS) * values[0] < values[1] <= MOST_FALL * values[0]

    def edit(self, model, i, values):
        CoulombFriction().edit(model, i, values[1:2])

    def force(self, models, i, values):
        """What frictionloss `static` holds too much once moving is given back."""
        d = models[0].jnt_dofadr[i]
        coulomb, static, velocity = values.T

        def released(qpos, qvel, ctrl, time):
            v, out = qvel[:, d], np.zeros_like(qvel)
            out[:, d] = (coulomb - static) * np.expm1(-((v / velocity) ** 2)) * np.sign(v)
            return out

        return released

    def write(self, spec, model, i, values):
        CoulombFriction().write(spec, model, i, values[:1])
        return "mjcf" if values[1] <= values[0] else "python"

    def part(self, model, i, values):
        coulomb, static, velocity = map(float, values)
        name, fall = model.joint(i).name, static - coulomb
        return (
            Part("stribeck_rest", name, {"fall": fall}),
            Part("stribeck_release", name, {"fall": fall, "velocity": velocity}),
        )


class DryFriction(JointEffect):
    """Dry friction of a level that depends on the state: |F| ≤ level, added to the joint's
    frictionloss."""

    law = ""  # in corrected.py
    acts_through, simplicity = "velocity", 3

    def edit(self, model, i, values):
        d = model.jnt_dofadr[i]
        if not model.dof_frictionloss[d]:  # as CoulombFriction does: a stuck joint must not creep
            model.dof_solref[d], model.dof_solimp[d] = SOLREF_FRICTION, SOLIMP_FRICTION

    def write(self, spec, model, i, values):
        joint = spec.joint(model.joint(i).name)
        if not joint.frictionloss:
            joint.solref_friction, joint.solimp_friction = SOLREF_FRICTION, SOLIMP_FRICTION
        return "python"

    def level(self, models, i, values):
        """Function (qpos, qvel, ctrl, time, qfrc_bias) -> (S,), the level in the joint."""
        raise NotImplementedError

    def part(self, model, i, values):
        numbers = {p.name: float(v) for p, v in zip(self.parameters(model, i), values)}
        return Part(self.law, model.joint(i).name, numbers)

    def limit(self, models, i, values):
        d, level = models[0].jnt_dofadr[i], self.level(models, i, values)

        def limit(qpos, qvel, ctrl, time, qfrc_bias):
            out = np.zeros_like(qvel)
            out[:, d] = level(qpos, qvel, ctrl, time, qfrc_bias)
            return out

        return limit


@catalogue
class LoadFriction(DryFriction):
    """Gear teeth pressed together by what they carry: |F| ≤ share · |τ_drive − external · τ_load|.

    τ_drive is the force of the joint's drives, τ_load what pulls on it from outside (gravity and
    Coriolis forces, −qfrc_bias; contacts are not counted), both in N·m (N in a slide) of the
    joint; they press from both sides where they oppose each other. share is `driving` where the
    drive moves the joint (τ_drive · v ≥ 0), `driven` where the load does. external 1 is a train of
    gears between two loads, 0 counts the drive's side alone. All are ratios. With both shares
    equal and a constant load it is `coulomb_friction`; driving alone, without a load from outside,
    is in motion a smaller `gain`. Source: the load-dependent and directional models M4 to M6 of
    Duclusaud, Passault, Padois, Ly: Extended Friction Models for the Physics Simulation of Servo
    Actuators (arXiv 2410.08650, 2024), here with shares by which side moves the joint.
    """

    name, law, amplitudes = "load_friction", "load_friction", 2

    def fits(self, model, i):
        drives = drives_of(model, i)
        return super().fits(model, i) and bool(drives) and drives == controlled(model, i)

    def parameters(self, model, i):
        return (
            Parameter("driving", "1", 0.0, 0.0, SELF_LOCKING, 0.02),
            Parameter("driven", "1", 0.0, 0.0, SELF_LOCKING, 0.02),
            Parameter("external", "1", 1.0, 0.0, 1.0, -0.1),
        )

    def probes(self, model, i, recordings):
        shares = ((0.2, 0.2), (0.2, 0.0), (0.0, 0.2))
        return np.array([(*share, external) for share in shares for external in (1.0, 0.0)])

    def possible(self, values, nominal):
        return max(values[:2]) > 0

    def level(self, models, i, values):
        d, torque = models[0].jnt_dofadr[i], drive_torque(models, i)
        driving, driven, external = values.T

        def level(qpos, qvel, ctrl, time, qfrc_bias):
            drive = torque(qpos, qvel, ctrl)
            share = np.where(drive * qvel[:, d] >= 0, driving, driven)
            return share * abs(drive + external * qfrc_bias[:, d])

        return level


@catalogue
class FrictionMap(DryFriction):
    """Coulomb friction that comes and goes along the travel: |F| ≤ level · (1 + contrast ·
    sin(waves·q + phase)).

    level in N·m (N), contrast 0 to 1, waves per rad (m) of the joint, phase in rad: a bearing or
    rail out of true. Without contrast it is `coulomb_friction`. Of any other shape: see
    FrictionCurve.
    """

    name, law, amplitudes, loaded = "friction_map", "friction_wave", 1, False
    together = 3

    def parameters(self, model, i):
        M, force = self.scale(model, i), self.unit(model, i, "N·m", "N")
        return (
            Parameter("level", force, 0.0, 0.0, HUGE * M, 0.05 * M),
            Parameter("contrast", "1", 0.8, 0.0, 1.0, -0.1),
            Parameter("waves", self.unit(model, i, "1", "rad/m"), 6.0, 0.1, 1e6, 0.1),
            Parameter("phase", "rad", 0.0, -10.0, 10.0, 0.1),
        )

    def _travelled(self, model, i, recordings):
        position, _ = self.travel(model, i, recordings)
        return np.ptp(np.quantile(position, [0.02, 0.98])) + 1e-6 if len(position) else 1.0

    def probes(self, model, i, recordings):
        """Of each wave number three that hold any level, contrast and phase together."""
        level, travel = 0.1 * self.scale(model, i), self._travelled(model, i, recordings)
        shapes = (0.0, 0.0), (1.0, 0.0), (1.0, np.pi / 2)
        return np.array([(level, c, turn / travel, phase) for turn in TURNS for c, phase in shapes])

    def merged(self, rows, amounts):
        level = sum(amount * row[0] for row, amount in zip(rows, amounts))
        wave = sum(a * r[0] * r[1] * np.exp(1j * r[3]) for r, a in zip(rows, amounts))
        contrast = min(abs(wave) / max(level, 1e-300), 1.0)
        return (rows[0][0], contrast, rows[0][2], float(np.angle(wave))), level / rows[0][0]

    def possible(self, values, nominal):
        return values[0] > 0 and values[1] > 0.05

    def level(self, models, i, values):
        q = models[0].jnt_qposadr[i]
        level, contrast, waves, phase = values.T

        def at(qpos, qvel, ctrl, time, qfrc_bias):
            return level * (1 + contrast * np.sin(waves * qpos[:, q] + phase))

        return at


class FrictionCurve(DryFriction):
    """Coulomb friction along the travel of any shape: its level at knots, linear between, flat
    beyond. N·m or N.

    As `unknown` it is made for its knots, by friction_curve(); it goes by the name of FrictionMap,
    which has one shape.
    """

    name, kind, loaded = "friction_map", "joint", False

    def __init__(self, knots):
        self.knots = tuple(float(x) for x in knots)
        if len(self.knots) < 2 or (np.diff(self.knots) <= 0).any():
            raise ValueError("knots of a friction map: at least two positions that increase")

    def __eq__(self, other):
        return isinstance(other, FrictionCurve) and self.knots == other.knots

    def __hash__(self):
        return hash(self.knots)

    def parameters(self, model, i):
        M, force = self.scale(model, i), self.unit(model, i, "N·m", "N")
        return tuple(
            Parameter(f"level at {x:.3g}", force, 0.0, 0.0, HUGE * M, 0.05 * M) for x in self.knots
        )

    def part(self, model, i, values):
        numbers = {"knots": list(self.knots), "levels": [float(v) for v in values]}
        return Part("friction_curve", model.joint(i).name, numbers)

    def level(self, models, i, values):
        q, knots, rows = models[0].jnt_qposadr[i], np.array(self.knots), np.arange(len(values))

        def at(qpos, qvel, ctrl, time, qfrc_bias):
            x = qpos[:, q]
            k = np.clip(np.searchsorted(knots, x) - 1, 0, len(knots) - 2)
            f = np.clip((x - knots[k]) / (knots[k + 1] - knots[k]), 0.0, 1.0)
            return (1 - f) * values[rows, k] + f * values[rows, k + 1]

        return at


def friction_curve(model, joint, knots):
    """Candidate for a friction map of any shape in a joint: see FrictionCurve. Parameters: the
    level at each knot."""
    effect = FrictionCurve(knots)
    return Candidate(effect, Place("joint", joint), effect.parameters(model, model.joint(joint).id))
