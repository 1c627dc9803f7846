"""What a drive cannot give: dead zones, limits of rate and speed, a strength that falls.

The forces depend on the state: a simulation works them out before each step (see Effect.force),
and beside corrected.xml a script does (corrected.py).
"""

from dataclasses import replace

import mujoco
import numpy as np

from diagnosis.effects.actuators import ActuatorEffect
from diagnosis.effects.base import HUGE, JOINT_TRANSMISSION, Parameter, Part, catalogue
from diagnosis.effects.joints import JointEffect


def actuator_force(models, a):
    """Function (qpos (S,nq), qvel (S,nv), ctrl (S,nu)) -> (S,) force of actuator a on a joint.

    clip((g₀ + g₁ l + g₂ l̇) u + b₀ + b₁ l + b₂ l̇) to its range, l the length gear · q.
    """
    model = models[0]
    joint, u = model.actuator_trnid[a, 0], model.actuator_ctrladr[a]
    q, d, gear = model.jnt_qposadr[joint], model.jnt_dofadr[joint], model.actuator_gear[a, 0]
    gain, bias = (
        np.array([getattr(m, f"actuator_{f}prm")[a, :3] for m in models]).T
        for f in ("gain", "bias")
    )
    gain[1:] *= model.actuator_gaintype[a] == int(mujoco.mjtGain.mjGAIN_AFFINE)
    bias *= model.actuator_biastype[a] == int(mujoco.mjtBias.mjBIAS_AFFINE)
    free = -np.inf, np.inf
    low, high = np.array(
        [m.actuator_forcerange[a] if m.actuator_forcelimited[a] else free for m in models]
    ).T

    def force(qpos, qvel, ctrl):
        at = np.stack([np.ones(len(qpos)), gear * qpos[:, q], gear * qvel[:, d]])
        return np.clip((gain * at).sum(axis=0) * ctrl[:, u] + (bias * at).sum(axis=0), low, high)

    return force


def lost(models, a, change):
    """Function as of Effect.force: what change(force, speed, time) adds to the force of actuator a.

    force, speed (S,) of the actuator; the result acts on its joint, within whose actuatorfrcrange
    the drives stay.
    """
    model, force = models[0], actuator_force(models, a)
    j, gear = model.actuator_trnid[a, 0], model.actuator_gear[a, 0]
    d, within, asked = model.jnt_dofadr[j], joint_limit(models, j), asked_torque(models, j)
    # only where a joint has a range does it matter what all its drives ask for
    limited = any(m.jnt_actfrclimited[j] for m in models)

    def function(qpos, qvel, ctrl, time):
        out, state = np.zeros_like(qvel), (qpos, qvel, ctrl)
        less = gear * change(force(*state), gear * qvel[:, d], time)
        whole = asked(*state) if limited else 0.0
        out[:, d] = within(whole + less) - within(whole)
        return out

    return function


def joint_limit(models, j):
    """Function (S,) -> (S,): the force of joint j's drives within its actuatorfrcrange."""
    free = -np.inf, np.inf
    low, high = np.array(
        [m.jnt_actfrcrange[j] if m.jnt_actfrclimited[j] else free for m in models]
    ).T
    return lambda force: np.clip(force, low, high)


def controlled(model, j):
    """Ids of the actuators of joint j that have a control."""
    own = (model.actuator_trntype == JOINT_TRANSMISSION) & (model.actuator_trnid[:, 0] == j)
    return np.flatnonzero(own & (model.actuator_ctrlnum > 0)).tolist()


def drives_of(model, j):
    """Those of them whose force follows from position, speed and control alone."""
    return [
        a
        for a in controlled(model, j)
        if model.actuator_ctrlnum[a] == 1
        and model.actuator_gaintype[a] in (0, 1)
        and model.actuator_biastype[a] in (0, 1)
        and model.actuator_dyntype[a] == int(mujoco.mjtDyn.mjDYN_NONE)
    ]


def asked_torque(models, j):
    """Function (qpos, qvel, ctrl) -> (S,) force of all the drives of joint j, in its coordinate, as
    if that had no actuatorfrcrange."""
    model = models[0]
    forces = [(model.actuator_gear[a, 0], actuator_force(models, a)) for a in drives_of(model, j)]
    return lambda qpos, qvel, ctrl: sum(g * force(qpos, qvel, ctrl) for g, force in forces)


def drive_torque(models, j):
    """As asked_torque(), within the joint's actuatorfrcrange."""
    within, asked = joint_limit(models, j), asked_torque(models, j)
    return lambda qpos, qvel, ctrl: within(asked(qpos, qvel, ctrl))


@catalogue
class DeadZone(ActuatorEffect):
    """Nothing happens below a threshold: y = sign(x) · max(|x| − half_width, 0).

    x is the control of a motor, in its units, the force of a servo, in N·m or N. Where the drive
    pushes the way the joint moves it takes as much as `coulomb_friction`.
    """

    name, simplicity, amplitudes = "dead_zone", 2, 1
    acts_through = "control"

    def fits(self, model, i):
        return bool(super().fits(model, i) and model.actuator_gainprm[i, 0]) and (
            not self.servo(model, i)
            or self.on_joint(model, i)
            and model.actuator_dyntype[i] == int(mujoco.mjtDyn.mjDYN_NONE)
        )

    def parameters(self, model, i):
        F = self.strength(model, i)
        if self.servo(model, i):
            return (Parameter("half_width", self.unit(model, i), 0.0, 0.0, HUGE * F, 0.005 * F),)
        u = F / abs(model.actuator_gainprm[i, 0])
        return (Parameter("half_width", "control", 0.0, 0.0, HUGE * u, 0.01 * u),)

    def probes(self, model, i, recordings):
        used = np.quantile(self.forces(model, i, recordings), 0.9)
        unit = 1.0 if self.servo(model, i) else abs(model.actuator_gainprm[i, 0])
        return used / unit * np.array([[0.03], [0.1], [0.3]]) if used > 0 else np.zeros((0, 1))

    def command(self, signal, model, i, values):
        if self.servo(model, i):
            return signal
        return replace(
            signal, value=np.sign(signal.value) * np.maximum(abs(signal.value) - values[0], 0.0)
        )

    def stepwise(self, model, i):
        return bool(self.servo(model, i))

    def force(self, models, i, values):
        model = models[0]
        if not self.servo(model, i):
            return None

        def absorbed(force, qvel, time):
            return -np.clip(force, -values[:, 0], values[:, 0])

        return lost(models, i, absorbed)

    def write(self, spec, model, i, values):
        """No actuator of MJCF has one: see part()."""
        return "python"

    def part(self, model, i, values):
        law = "dead_zone_of_force" if self.servo(model, i) else "dead_zone"
        return Part(law, model.actuator(i).name, {"half_width": float(values[0])})


class DriveLimit(ActuatorEffect):
    """What a motor or servo on a hinge or slide, without a filter of its own, cannot give.

    Its control alone gives a force, by which sizes are chosen: that of a <damper> gives none.
    """

    law, acts_through = "", "control"

    def fits(self, model, i):
        return bool(
            super().fits(model, i)
            and self.on_joint(model, i)
            and model.actuator_dyntype[i] == int(mujoco.mjtDyn.mjDYN_NONE)
            and model.actuator_gainprm[i, 0]
        )

    def write(self, spec, model, i, values):
        return "python"

    def part(self, model, i, values):
        numbers = {p.name: float(v) for p, v in zip(self.parameters(model, i), values)}
        return Part(self.law, model.actuator(i).name, numbers)


@catalogue
class RateLimit(DriveLimit):
    """The control follows at a limited pace: |ẏ| ≤ rate, in units of the control per second.

    A servo's goal that is ramped by its firmware, a valve that opens slowly. It starts at the
    first control. Small steps pass as they are, unlike with a `lag`.
    """

    name, law, simplicity = "rate_limit", "rate_limit", 2

    def parameters(self, model, i):
        u = self.strength(model, i) / max(abs(model.actuator_gainprm[i, 0]), 1e-12)
        return (Parameter("rate", "control/s", np.inf, 1e-3 * u, HUGE * u, u),)

    def probes(self, model, i, recordings):
        u = model.actuator_ctrladr[i]
        pace = [abs(np.diff(r.ctrl[:, u]) / np.diff(r.time)) for r in recordings]
        pace = np.nan_to_num(np.concatenate(pace))
        fastest = np.quantile(pace[pace > 0], 0.9) if (pace > 0).any() else 0.0
        rates = fastest * np.array([2.0, 0.7, 0.3, 0.1, 0.03])
        rates = [*rates, *self._followed(model, i, recordings)]
        low, high = (getattr(self.parameters(model, i)[0], f) for f in ("low", "high"))
        return np.clip(rates, low, high)[:, None]

    def _followed(self, model, i, recordings):
        """Rates at which the control would have to change for a position servo to move as it did:
        steps of a goal have no pace of their own."""
        stiff = abs(model.actuator_biasprm[i, 1] * model.actuator_gear[i, 0])
        _, speed = JointEffect.travel(model, model.actuator_trnid[i, 0], recordings)
        if not stiff or not len(speed):
            return []
        return stiff / abs(model.actuator_gainprm[i, 0]) * np.quantile(speed, [0.5, 0.95]) + 1e-9

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
        stalls = (used, 0.4 * used) if used > 0 else ()
        rows = [(share * stall / fast, stall) for stall in stalls for share in (0.3, 0.7, 1.0)]
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

    A battery that runs down, a motor that warms up and loses its magnets' strength. A drive that
    is as weak from the beginning has another `gain`.
    """

    name, law, amplitudes, simplicity = "gain_fade", "gain_fade", 1, 2

    def parameters(self, model, i):
        return (Parameter("rate", "1/s", 0.0, 0.0, 10.0, 0.01),)

    def force(self, models, i, values):
        return lost(models, i, lambda force, speed, time: force * np.expm1(-values[:, 0] * time))


@catalogue
class EffortFade(DriveLimit):
    """A motor weakens with what it has done: u exp(−per_effort · ∫ (u/u₀)² dt), per_effort in 1/s.

    u₀ is its largest control, so per_effort is the rate at full control: heat by its current, a
    supply that sags as it is drained. It has the name of GainFade, which falls whatever the motor
    does.
    """

    name, law, amplitudes, simplicity = "gain_fade", "effort_fade", 1, 3

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
