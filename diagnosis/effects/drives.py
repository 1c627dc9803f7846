"""Physics of real drives: gears whose friction follows their load, bearings that run out of true.

Their dry friction depends on the state, so a simulation sets it anew before each step (see
Effect.limit),
and beside corrected.xml a script does the same (corrected.py).
"""

from dataclasses import replace

import mujoco
import numpy as np

from diagnosis.effects.actuators import ActuatorEffect, actuator_force, lost
from diagnosis.effects.base import (
    HUGE,
    JOINT_TRANSMISSION,
    Candidate,
    Parameter,
    Part,
    Place,
    catalogue,
)
from diagnosis.effects.joints import (
    DISSIPATION,
    SOLIMP_FRICTION,
    SOLREF_FRICTION,
    JointEffect,
)

SELF_LOCKING = 2.0  # share of the load beyond which no drive would turn
CYCLES = 1.0, 2.0, 3.0  # of a friction map over the travel, to try first
PHASES = 0.0, np.pi / 2, np.pi, 1.5 * np.pi


def drives_of(model, j):
    """Ids of the actuators of joint j whose force follows from position, speed and control
    alone."""
    return [
        a
        for a in range(model.nactuator)
        if model.actuator_trntype[a] == JOINT_TRANSMISSION
        and model.actuator_trnid[a, 0] == j
        and model.actuator_ctrlnum[a] == 1
        and model.actuator_gaintype[a] in (0, 1)
        and model.actuator_biastype[a] in (0, 1)
        and model.actuator_dyntype[a] == int(mujoco.mjtDyn.mjDYN_NONE)
    ]


def drive_torque(models, j):
    """Function (qpos, qvel, ctrl) -> (S,) force of all the drives of joint j, in its coordinate."""
    model = models[0]
    forces = [(model.actuator_gear[a, 0], actuator_force(models, a)) for a in drives_of(model, j)]
    free = -np.inf, np.inf
    low, high = np.array(
        [m.jnt_actfrcrange[j] if m.jnt_actfrclimited[j] else free for m in models]
    ).T

    def torque(qpos, qvel, ctrl):
        total = sum(gear * force(qpos, qvel, ctrl) for gear, force in forces)
        return np.clip(total, low, high)

    return torque


class DryFriction(JointEffect):
    """Dry friction of a level that depends on the state: |F| ≤ level, added to the joint's
    frictionloss."""

    law = ""  # in corrected.py
    acts_through, simplicity, related = "velocity", 3, ("coulomb_friction", *DISSIPATION, "gain")

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
    Coriolis forces,
    −qfrc_bias; contacts are not counted), both in N·m (N in a slide) of the joint; they press
    from both sides where
    they oppose each other. share is `driving` where the drive moves the joint (τ_drive · v ≥ 0),
    `driven` where the
    load does. external 1 is a train of gears between two loads, 0 counts the drive's side alone.
    All are ratios.
    With both shares equal and a constant load it is `coulomb_friction`; driving alone, without a
    load from outside, is
    in motion a smaller `gain`. Sources: Duclusaud, Passault, Padois, Daniel: Extended Friction
    Models for the Physics
    Simulation of Servo Actuators (2024), models M4 to M6; efficiency forward and backward of
    gears: Linderoth,
    Stolt, Robertsson, Johansson (2013).
    """

    name, law, amplitudes = "load_friction", "load_friction", 2

    def fits(self, model, i):
        return super().fits(model, i) and bool(drives_of(model, i))

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
    rail out of true.
    Without contrast it is `coulomb_friction`. Of any other shape: see FrictionCurve.
    """

    name, law, amplitudes, loaded = "friction_map", "friction_wave", 1, False

    def parameters(self, model, i):
        M, force = self.scale(model, i), self.unit(model, i, "N·m", "N")
        return (
            Parameter("level", force, 0.0, 0.0, HUGE * M, 0.05 * M),
            Parameter("contrast", "1", 0.8, 0.0, 1.0, -0.1),
            Parameter("waves", self.unit(model, i, "1", "rad/m"), 6.0, 0.1, 1e6, 0.1),
            Parameter("phase", "rad", 0.0, -10.0, 10.0, 0.1),
        )

    def suited(self, parameters, model, i, recordings):
        """At least half a wave within the recorded travel."""
        level, contrast, waves, phase = parameters
        least = np.pi / self._travelled(model, i, recordings)
        return level, contrast, replace(waves, low=min(max(waves.low, least), waves.high)), phase

    def _travelled(self, model, i, recordings):
        position, _ = self.travel(model, i, recordings)
        return np.ptp(np.quantile(position, [0.02, 0.98])) + 1e-6 if len(position) else 1.0

    def probes(self, model, i, recordings):
        level, travel = 0.1 * self.scale(model, i), self._travelled(model, i, recordings)
        waves = [2 * np.pi * cycles / travel for cycles in CYCLES]
        return np.array([(level, 0.8, n, phase) for n in waves for phase in PHASES])

    def possible(self, values, nominal):
        return values[0] > 0 and values[1] > 0.05

    def canonical(self, values):
        level, contrast, waves, phase = values
        return level, contrast, waves, phase % (2 * np.pi)

    def level(self, models, i, values):
        q = models[0].jnt_qposadr[i]
        level, contrast, waves, phase = values.T

        def at(qpos, qvel, ctrl, time, qfrc_bias):
            return level * (1 + contrast * np.sin(waves * qpos[:, q] + phase))

        return at


class FrictionCurve(DryFriction):
    """Coulomb friction along the travel of any shape: its level at knots, linear between, flat
    beyond. N·m or N.

    As `unknown` it is made for its knots, by friction_curve(); it goes by the name of
    FrictionMap, which has one shape.
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


class DriveLimit(ActuatorEffect):
    """What a motor or servo on a hinge or slide, without a filter of its own, cannot give."""

    law, acts_through = "", "control"

    def fits(self, model, i):
        return bool(
            super().fits(model, i)
            and self.on_joint(model, i)
            and model.actuator_dyntype[i] == int(mujoco.mjtDyn.mjDYN_NONE)
        )

    def write(self, spec, model, i, values):
        return "python"

    def part(self, model, i, values):
        numbers = {p.name: float(v) for p, v in zip(self.parameters(model, i), values)}
        return Part(self.law, model.actuator(i).name, numbers)


@catalogue
class RateLimit(DriveLimit):
    """The control follows at a limited pace: |ẏ| ≤ rate, in units of the control per second.

    A servo's goal that is ramped by its firmware, a valve that opens slowly. It starts at the first
    control. Small steps pass as they are, unlike with a `lag`.
    """

    name, law, simplicity, related = "rate_limit", "rate_limit", 2, ("lag", "delay", "gain")

    def parameters(self, model, i):
        u = self.strength(model, i) / max(abs(model.actuator_gainprm[i, 0]), 1e-12)
        return (Parameter("rate", "control/s", np.inf, 1e-3 * u, HUGE * u, u),)

    def probes(self, model, i, recordings):
        u = model.actuator_ctrladr[i]
        pace = [abs(np.diff(r.ctrl[:, u]) / np.diff(r.time)) for r in recordings]
        pace = np.nan_to_num(np.concatenate(pace))
        fastest = np.quantile(pace[pace > 0], 0.9) if (pace > 0).any() else 0.0
        low, high = (getattr(self.parameters(model, i)[0], f) for f in ("low", "high"))
        return np.clip(fastest * np.array([[0.7], [0.3], [0.1]]), low, high)

    def command(self, signal, model, i, values):
        return replace(signal, rate=values[0])


@catalogue
class TorqueSpeed(DriveLimit):
    """The largest force falls with speed: |τ| ≤ stall − slope · |v| where τ v > 0.

    stall in N·m (N), slope in N·m·s/rad (N·s/m), τ and v of the actuator: a motor at the end of its
    voltage. Well below the limit nothing changes, unlike with `back_emf`; without slope it is
    `saturation` of the driving force. Source: the torque–speed line of permanent-magnet motors.
    """

    name, law, simplicity = "torque_speed", "torque_speed", 2
    related = "saturation", "back_emf", "gain"

    def parameters(self, model, i):
        F, unit = self.strength(model, i), self.unit(model, i)
        slope = {"N·m": "N·m·s/rad", "N": "N·s/m"}[unit]
        return (
            Parameter("slope", slope, 0.0, 0.0, HUGE * F, 0.05 * F),
            Parameter("stall", unit, np.inf, 1e-4 * F, HUGE * F, 0.05 * F),
        )

    def probes(self, model, i, recordings):
        used = np.quantile(self.forces(model, i, recordings), 0.98)
        j, gear = model.actuator_trnid[i, 0], abs(model.actuator_gear[i, 0])
        _, speed = JointEffect.travel(model, j, recordings)
        fast = gear * np.quantile(speed, 0.95) + 1e-6 if len(speed) else 1.0
        rows = [(share * used / fast, used) for share in (0.3, 0.7)] if used > 0 else []
        return np.array(rows).reshape(-1, 2)

    def possible(self, values, nominal):
        return values[0] > 0 and np.isfinite(values[1])

    def force(self, models, i, values):
        slope, stall = values.T

        def missing(force, speed, time):
            with np.errstate(invalid="ignore"):
                most = np.maximum(stall - slope * abs(speed), 0.0)
            return np.where(force * speed > 0, np.clip(force, -most, most) - force, 0.0)

        return lost(models, i, missing)


@catalogue
class GainFade(DriveLimit):
    """The drive weakens: τ exp(−rate · t), rate in 1/s, t the recording's time in s.

    A battery that runs down, a motor that warms up and loses its magnets' strength. A drive that is
    as weak from the beginning has another `gain`.
    """

    name, law, amplitudes, simplicity = "gain_fade", "gain_fade", 1, 2
    related = ("gain",)

    def parameters(self, model, i):
        return (Parameter("rate", "1/s", 0.0, 0.0, 10.0, 0.01),)

    def force(self, models, i, values):
        return lost(models, i, lambda force, speed, time: force * np.expm1(-values[:, 0] * time))


@catalogue
class EffortFade(DriveLimit):
    """A motor weakens with what it has done: u exp(−per_effort · ∫ (u/u₀)² dt), per_effort in 1/s.

    u₀ is its largest control, so per_effort is the rate at full control: heat by its current, a
    supply
    that sags as it is drained. It has the name of GainFade, which falls whatever the motor does.
    """

    name, law, amplitudes, simplicity = "gain_fade", "effort_fade", 1, 3
    related = ("gain",)

    def fits(self, model, i):
        return super().fits(model, i) and not model.actuator_biasprm[i, :3].any()

    def parameters(self, model, i):
        return (Parameter("per_effort", "1/s", 0.0, 0.0, 10.0, 0.01),)

    @staticmethod
    def _full(model, i):
        return DriveLimit.strength(model, i) / max(abs(model.actuator_gainprm[i, 0]), 1e-12)

    def command(self, signal, model, i, values):
        return replace(signal, tires=signal.tires + values[0] / self._full(model, i) ** 2)

    def part(self, model, i, values):
        tires = float(values[0] / self._full(model, i) ** 2)
        return Part(self.law, model.actuator(i).name, {"tires": tires})


def friction_curve(model, joint, knots):
    """Candidate for a friction map of any shape in a joint: see FrictionCurve. Parameters: the
    level at each knot."""
    effect = FrictionCurve(knots)
    return Candidate(effect, Place("joint", joint), effect.parameters(model, model.joint(joint).id))
