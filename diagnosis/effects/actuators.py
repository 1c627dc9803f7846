"""Effects in an actuator: motors, position servos and velocity servos alike."""

from dataclasses import replace

import mujoco
import numpy as np

from diagnosis.effects.base import (
    BALL,
    HINGE,
    HUGE,
    JOINT_TRANSMISSION,
    JOINT_TRANSMISSIONS,
    SLIDE,
    Effect,
    Parameter,
    Part,
    catalogue,
    end_of_step,
    runge_kutta,
)


class ActuatorEffect(Effect):
    """An effect on an actuator with one control and an affine force: motors and servos."""

    kinds = ("actuator",)

    def fits(self, model, i):
        affine = model.actuator_gaintype[i] in (0, 1) and model.actuator_biastype[i] in (0, 1)
        return affine and model.actuator_ctrlnum[i] == 1 and model.actuator_outnum[i] == 1

    @staticmethod
    def on_joint(model, i):
        """Whether it acts on a hinge or slide."""
        return model.actuator_trntype[i] == JOINT_TRANSMISSION and model.jnt_type[
            model.actuator_trnid[i, 0]
        ] in (HINGE, SLIDE)

    @staticmethod
    def servo(model, i):
        """Whether its force depends on where it is, or how fast."""
        return model.actuator_biasprm[i, 1:3].any()

    @staticmethod
    def strength(model, i):
        """A typical force of the actuator."""
        if model.actuator_forcelimited[i]:
            return abs(model.actuator_forcerange[i]).max()
        u = model.actuator_ctrladr[i]
        if model.actuator_ctrllimited[u]:
            return abs(model.actuator_gainprm[i, 0]) * abs(model.actuator_ctrlrange[u]).max()
        return abs(model.actuator_gainprm[i, 0])

    @staticmethod
    def forces(model, i, recordings):
        """|force| that the recorded controls asked for, but for velocity feedback, and got within
        the model's limits."""
        asked = [
            model.actuator_gainprm[i, 0] * r.ctrl[:, model.actuator_ctrladr[i]] for r in recordings
        ]
        if model.actuator_biasprm[i, 1] and ActuatorEffect.on_joint(model, i):
            q = model.jnt_qposadr[model.actuator_trnid[i, 0]]
            k = model.actuator_biasprm[i, 1] * model.actuator_gear[i, 0]
            asked = [F + k * r.qpos[:, q] for F, r in zip(asked, recordings)]
        return abs(ActuatorEffect.limited(model, i, np.nan_to_num(np.concatenate(asked))))

    @staticmethod
    def limited(model, i, force):
        """A force of the actuator within its own limits, and those of the joint that it acts on."""
        if model.actuator_forcelimited[i]:
            force = np.clip(force, *model.actuator_forcerange[i])
        j, gear = model.actuator_trnid[i, 0], model.actuator_gear[i, 0]
        if ActuatorEffect.on_joint(model, i) and model.jnt_actfrclimited[j] and gear:
            force = np.clip(force, *np.sort(model.jnt_actfrcrange[j] / gear))
        return force

    @staticmethod
    def unit(model, i):
        """Unit of its force."""
        on_joint = model.actuator_trntype[i] in JOINT_TRANSMISSIONS
        return (
            "N·m"
            if on_joint and model.jnt_type[model.actuator_trnid[i, 0]] in (HINGE, BALL)
            else "N"
        )

    @staticmethod
    def general(spec, model, i):
        """The spec's actuator, in a notation that can hold any gain and bias."""
        actuator = spec.actuator(model.actuator(i).name)
        actuator.type = mujoco.mjtActuator.mjACTUATOR_GENERAL
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        return actuator


def refine(spec, longest):
    """Divide the spec's time step so that it is no longer than `longest`."""
    spec.option.timestep /= max(1, np.ceil(spec.option.timestep / longest - 1e-9))


def set_lag(actuator, seconds, model):
    """Give a spec's actuator a first-order lag: as of the end of a step, or continuous where the
    integrator is."""
    actuator.actdim, actuator.dynprm[0] = 1, seconds
    actuator.dyntype, actuator.actearly = mujoco.mjtDyn.mjDYN_FILTEREXACT, True
    if runge_kutta(model):
        actuator.dyntype, actuator.actearly = mujoco.mjtDyn.mjDYN_FILTER, False


class ServoGain(ActuatorEffect):
    """A gain of a position servo, force = kp (u − q) − kv q̇, apart from the other one.

    Both in the same ratio are `gain`. Ahead of it in the catalogue, so that it scales what these
    set.
    """

    acts_through = "control"

    def fits(self, model, i):
        plain = model.actuator_gaintype[i] == int(mujoco.mjtGain.mjGAIN_FIXED)
        follows = self._follows(model.actuator_gainprm[i], model.actuator_biasprm[i])
        return bool(super().fits(model, i) and plain and follows)

    def _follows(self, gainprm, biasprm):
        """Whether an actuator of these parameters is such a servo."""
        return biasprm[1] < 0 and gainprm[0] != 0


@catalogue
class ServoStiffness(ServoGain):
    """kp in force = kp (u − q) − kv q̇, in N·m/rad or N/m of the actuator's length; kv stays.
    Source: MuJoCo's <position>."""

    name = "servo_stiffness"

    def parameters(self, model, i):
        kp, unit = (
            -model.actuator_biasprm[i, 1],
            {"N·m": "N·m/rad", "N": "N/m"}[self.unit(model, i)],
        )
        return (Parameter("kp", unit, kp, 0.01 * kp, 100 * kp, 0.01 * kp),)

    @staticmethod
    def _scale(actuator_gainprm, actuator_biasprm, kp):
        actuator_gainprm[0] *= kp / -actuator_biasprm[1]
        actuator_biasprm[1] = -kp

    def edit(self, model, i, values):
        self._scale(model.actuator_gainprm[i], model.actuator_biasprm[i], values[0])

    def write(self, spec, model, i, values):
        actuator = self.general(spec, model, i)
        self._scale(actuator.gainprm, actuator.biasprm, values[0])
        return "mjcf"


@catalogue
class ServoDamping(ServoGain):
    """kv in force = kp (u − q) − kv q̇, in N·m·s/rad or N·s/m; kp stays. Or in kv (u − q̇).
    Source: MuJoCo's <position> and <velocity>.

    The same force as `back_emf`, and as `viscous_damping` of the one joint it drives (but for a
    limited force): a class. Of a <velocity> servo, the same as `gain`.
    """

    name = "servo_damping"
    acts_through = "velocity"

    def parameters(self, model, i):
        (damping,) = BackEmf().parameters(model, i)
        return (replace(damping, name="kv"),)

    def _follows(self, gainprm, biasprm):
        return super()._follows(gainprm, biasprm) or self._follows_speed(gainprm, biasprm)

    @staticmethod
    def _follows_speed(gainprm, biasprm):
        return biasprm[1] == 0 and 0 < gainprm[0] == -biasprm[2]

    def _set(self, gainprm, biasprm, kv):
        if self._follows_speed(gainprm, biasprm):
            gainprm[0] = kv
        biasprm[2] = -kv

    def edit(self, model, i, values):
        self._set(model.actuator_gainprm[i], model.actuator_biasprm[i], values[0])

    def write(self, spec, model, i, values):
        actuator = self.general(spec, model, i)
        self._set(actuator.gainprm, actuator.biasprm, values[0])
        return "mjcf"


@catalogue
class Gain(ActuatorEffect):
    """Force gain·F: the actuator is stronger or weaker by a ratio, feedback of a servo included.

    Source: MuJoCo's gainprm and biasprm; a wrong motor constant, ratio or supply.
    """

    name, simplicity = "gain", 0
    acts_through = "control"

    def parameters(self, model, i):
        return (Parameter("gain", "1", 1.0, 0.01, 100.0, 0.01),)

    def edit(self, model, i, values):
        model.actuator_gainprm[i, :3] *= values[0]
        model.actuator_biasprm[i, :3] *= values[0]

    def write(self, spec, model, i, values):
        actuator = self.general(spec, model, i)
        actuator.gainprm[:3] *= values[0]
        actuator.biasprm[:3] *= values[0]
        return "mjcf"


@catalogue
class Bias(ActuatorEffect):
    """Force F + bias, in N·m or N of the actuator. Source: MuJoCo's biasprm[0]."""

    name = "bias"

    def parameters(self, model, i):
        F = self.strength(model, i)
        return (Parameter("bias", self.unit(model, i), 0.0, -HUGE * F, HUGE * F, 0.01 * F),)

    def edit(self, model, i, values):
        model.actuator_biasprm[i, 0] += values[0]

    def write(self, spec, model, i, values):
        self.general(spec, model, i).biasprm[0] += values[0]
        return "mjcf"


@catalogue
class BackEmf(ActuatorEffect):
    """A force −d·v, v of the actuator, d in N·m·s/rad or N·s/m: back-EMF, or a servo's velocity
    gain.

    In a drive on one joint it is `viscous_damping`, but for a limited force. Source: biasprm[2].
    """

    name = "back_emf"
    acts_through = "velocity"

    def parameters(self, model, i):
        nominal, step = -model.actuator_biasprm[i, 2], 0.01 * self.strength(model, i)
        if self.on_joint(model, i) and model.actuator_gear[i, 0]:
            step = (
                0.02
                * model.dof_M0[model.jnt_dofadr[model.actuator_trnid[i, 0]]]
                / model.actuator_gear[i, 0] ** 2
            )
        unit = {"N·m": "N·m·s/rad", "N": "N·s/m"}[self.unit(model, i)]
        return (Parameter("damping", unit, nominal, 0.0, HUGE * step, max(step, 0.01 * nominal)),)

    def edit(self, model, i, values):
        model.actuator_biasprm[i, 2] = -values[0]

    def write(self, spec, model, i, values):
        self.general(spec, model, i).biasprm[2] = -values[0]
        return "mjcf"


@catalogue
class Saturation(ActuatorEffect):
    """|F| ≤ forcerange (of a range that is not symmetric: its larger end), N·m or N.

    Source: MuJoCo's forcerange; the limit of a motor's current.
    """

    name = "saturation"
    bounds = True
    acts_through = "control"

    def parameters(self, model, i):
        F = self.strength(model, i)
        nominal = F if model.actuator_forcelimited[i] else np.inf
        return (
            Parameter("forcerange", self.unit(model, i), nominal, 1e-4 * F, HUGE * F, 0.02 * F),
        )

    def probes(self, model, i, recordings):
        used = self.forces(model, i, recordings).max()
        (limit,) = (p.nominal for p in self.parameters(model, i))
        # a little above as well: what else the model lacks changes what it uses
        below = used * np.array([1.2, 0.9, 0.7, 0.5, 0.3, 0.1, 0.03]) if used > 0 else np.zeros(0)
        above = [1.4 * limit, 2 * limit] if np.isfinite(limit) else []
        return np.array([*below[below < limit], *above])[:, None]

    @staticmethod
    def limits(model, i, value):
        """The range: where there is one already, that in proportion."""
        nominal = (
            model.actuator_forcerange[i]
            if model.actuator_forcelimited[i]
            else np.array([-1.0, 1.0])
        )
        return nominal * value / abs(nominal).max()

    def edit(self, model, i, values):
        model.actuator_forcerange[i] = self.limits(model, i, values[0])
        model.actuator_forcelimited[i] = True

    def write(self, spec, model, i, values):
        actuator = spec.actuator(model.actuator(i).name)
        actuator.forcelimited, actuator.forcerange = (
            mujoco.mjtLimited.mjLIMITED_TRUE,
            self.limits(model, i, values[0]),
        )
        return "mjcf"


@catalogue
class Lag(ActuatorEffect):
    """The command passes a first-order filter: seconds · ẏ = u − y. Source: MuJoCo's
    filterexact."""

    name = "lag"
    acts_through = "control"

    def fits(self, model, i):
        return super().fits(model, i) and model.actuator_dyntype[i] == int(mujoco.mjtDyn.mjDYN_NONE)

    def parameters(self, model, i):
        return (
            Parameter("seconds", "s", 0.0, 0.0, 5.0, max(0.001, model.opt.timestep)),
        )  # less is lost within a step

    def command(self, signal, model, i, values):
        return replace(signal, lag=values[0])

    def write(self, spec, model, i, values):
        seconds, step = values[0], spec.option.timestep
        if runge_kutta(model) and seconds < step:  # explodes on a filter faster than a step
            return "python" if seconds else "mjcf"
        if not runge_kutta(model):
            seconds = end_of_step(seconds, step)
        set_lag(self.general(spec, model, i), seconds, model)
        return "mjcf"

    def part(self, model, i, values):
        return Part("lag", model.actuator(i).name, {"seconds": float(values[0])})


@catalogue
class Delay(ActuatorEffect):
    """The command acts later: u(t − seconds), by any fraction of a time step. Source: MuJoCo's
    delay."""

    name, simplicity, delays = "delay", 0, True
    acts_through = "control"

    def parameters(self, model, i):
        return (Parameter("seconds", "s", nominal_delay(model, i), 0.0, 1.0, 0.001),)

    def command(self, signal, model, i, values):
        return replace(signal, delay=values[0])

    def write(self, spec, model, i, values):
        """MuJoCo reads its history as of each force evaluation, but only what was there before the
        step: a delay of less than a step is left to corrected.py."""
        seconds, actuator, step = (
            values[0],
            spec.actuator(model.actuator(i).name),
            spec.option.timestep,
        )
        actuator.delay, actuator.nsample = 0.0, 0
        if seconds < step:
            return "python" if seconds else "mjcf"
        if runge_kutta(model):  # evaluates half a step later on average, a whole one at the last
            refine(spec, seconds / 1.5)
            seconds += spec.option.timestep / 2
        actuator.delay, actuator.interp = seconds, 1
        # for a spec that is compiled before its time step is final
        actuator.nsample = int(np.ceil(seconds / spec.option.timestep)) + 1
        return "mjcf"

    def part(self, model, i, values):
        return Part("delay", model.actuator(i).name, {"seconds": float(values[0])})


def nominal_delay(model, i):
    """Seconds by which the nominal model delays actuator i: MuJoCo takes a part of a step for one,
    and every delay for whole steps where it does not interpolate."""
    delay, step = model.actuator_delay[i], model.opt.timestep
    if delay <= 0:
        return 0.0
    held = model.actuator_history[i, 1] == 0
    return float(step * np.ceil(delay / step - 1e-9)) if held else max(delay, step)
