"""Effects on bodies and on sensors."""

from types import SimpleNamespace

import mujoco
import numpy as np

from diagnosis.effects.base import (
    HINGE,
    HUGE,
    JOINT_TRANSMISSION,
    JOINT_TRANSMISSIONS,
    SLIDE,
    Effect,
    Parameter,
    authored,
    catalogue,
    constant_force,
    displace,
    explicit_inertia,
    turns,
)
from diagnosis.effects.joints import JointEffect

REST, RESTING = (
    0.02,
    0.05,
    # share of a joint's travel about its end, and of all rows found there, where it seems to lie
    # at its
    # stop
)


class InertialEffect(Effect):
    """An effect on mass, centre of mass or inertia of a moving body."""

    kinds = ("body",)
    constants = True

    def fits(self, model, i):
        return model.body_weldid[i] != 0 and model.body_mass[i] > 0

    def write(self, spec, model, i, values):
        explicit_inertia(spec, model)
        body = spec.body(model.body(i).name)
        alone = SimpleNamespace(
            **{f"body_{f}": np.array([getattr(body, f)]) for f in ("mass", "ipos", "inertia")}
        )
        self.edit(alone, 0, values)
        body.mass, body.ipos, body.inertia = (
            alone.body_mass[0],
            alone.body_ipos[0],
            alone.body_inertia[0],
        )
        return "mjcf"


@catalogue
class Mass(InertialEffect):
    """Another mass, kg; the inertia scales along. Source: MuJoCo's inertial."""

    name, simplicity = "mass", 0

    def parameters(self, model, i):
        m = model.body_mass[i]
        return (Parameter("mass", "kg", m, 0.02 * m, 50 * m, 0.01 * m),)

    def far(self, model, i, recordings):
        return [(factor * model.body_mass[i],) for factor in (4.0, 20.0)]

    def edit(self, model, i, values):
        model.body_inertia[i] *= values[0] / model.body_mass[i]
        model.body_mass[i] = values[0]


def turning(model, i):
    """Whether body i can rotate."""
    while i:
        first = model.body_jntadr[i]
        if (model.jnt_type[first : first + model.body_jntnum[i]] != SLIDE).any():
            return True
        i = model.body_parentid[i]
    return False


def size_of(model, i):
    """Length scale of a body: its radius of gyration, or its centre's distance from the joint."""
    return max(
        np.sqrt(model.body_inertia[i].max() / model.body_mass[i]),
        0.3 * np.linalg.norm(model.body_ipos[i]),
    )


@catalogue
class CenterOfMass(InertialEffect):
    """The centre of mass lies elsewhere in the body's frame: x, y, z, m. Source: MuJoCo's
    inertial."""

    name = "center_of_mass"

    def fits(self, model, i):
        return super().fits(model, i) and turning(model, i)

    def parameters(self, model, i):
        s = size_of(model, i)
        return tuple(
            Parameter(n, "m", p, p - 10 * s, p + 10 * s, 0.02 * s)
            for n, p in zip("xyz", model.body_ipos[i])
        )

    def edit(self, model, i, values):
        model.body_ipos[i] = values


@catalogue
class Inertia(InertialEffect):
    """Other principal moments of inertia about the centre of mass, kg·m², in the body's inertial
    axes.

    Of a rigid body none is larger than the sum of the others. Source: MuJoCo's inertial.
    """

    name = "inertia"

    def fits(self, model, i):
        return super().fits(model, i) and turning(model, i)

    def parameters(self, model, i):
        moments = zip(("ixx", "iyy", "izz"), model.body_inertia[i])
        return tuple(Parameter(n, "kg·m²", I, 0.02 * I, 100 * I, 0.02 * I) for n, I in moments)

    def possible(self, values, nominal):
        """No principal moment of a rigid body is larger than the sum of the others; one at its
        nominal value did not show, and may be any."""
        return rigid(values) or any(v == n for v, n in zip(values, nominal))

    @staticmethod
    def _rigid(values, back):
        """The moments (3,), those with a number in `back` moved to it as far as the triangle
        inequality allows."""
        moments = [float(v if np.isnan(b) else b) for v, b in zip(values, back)]
        for k in sorted(np.flatnonzero(np.isfinite(back)), key=lambda k: -moments[k]):
            one, other = moments[:k] + moments[k + 1 :]
            moments[k] = min(max(moments[k], ROUNDED * abs(one - other)), (one + other) / ROUNDED)
        return tuple(moments)

    def edit(self, model, i, values):
        model.body_inertia[i] = values

    def write(self, spec, model, i, values):
        """As fitted: what is at its nominal value did not show and moves along as far as a rigid
        body needs, for no other compiles.

        Where all three were fitted and no rigid body has them nothing is written: each is as
        likely to be wrong.
        """
        nominal = model.body_inertia[i]
        moments = self._rigid(values, np.where(np.equal(values, nominal), nominal, np.nan))
        return super().write(spec, model, i, moments) if rigid(moments) else "none"


ROUNDED = 1 + 1e-6  # a margin for what rounding does to the triangle inequality


def rigid(moments):
    """Whether a rigid body has these principal moments (3,)."""
    return bool(2 * max(moments) <= sum(moments) * ROUNDED)


@catalogue
class LinkLength(Effect):
    """The body hangs farther from, or nearer to, its parent than the model says: metres to its
    frame."""

    name, kinds, constants = "link_length", ("body",), True

    def fits(self, model, i):
        return (
            model.body_weldid[i] != 0
            and model.body_parentid[i] != 0
            and np.linalg.norm(model.body_pos[i]) > 0
        )

    def parameters(self, model, i):
        length = np.linalg.norm(model.body_pos[i])
        return (Parameter("length", "m", length, 0.1 * length, 10 * length, 0.01 * length),)

    def edit(self, model, i, values):
        model.body_pos[i] *= values[0] / np.linalg.norm(model.body_pos[i])

    def write(self, spec, model, i, values):
        displace(
            spec,
            "body",
            model.body(i).name,
            (values[0] / np.linalg.norm(model.body_pos[i]) - 1) * model.body_pos[i],
        )
        return "mjcf"


# ---------------------------------------------------------------- loads that may come and go


@catalogue
class ExternalForce(Effect):
    """A constant force on a body's centre of mass, in world axes: x, y, z, N."""

    name, kinds, simplicity = "external_force", ("body",), 2

    def fits(self, model, i):
        return model.body_weldid[i] == i != 0 and model.body_mass[i] > 0

    def parameters(self, model, i):
        F = 10 * model.body_subtreemass[i]
        return tuple(Parameter(n, "N", 0.0, -HUGE * F, HUGE * F, 0.005 * F) for n in "xyz")

    def push(self, qfrc, xfrc, model, i, values):
        xfrc[i, :3] += values

    def write(self, spec, model, i, values):
        body = spec.body(model.body(i).name)
        name, origin = f"external_force:{body.name}", f"external_force:{body.name}:world"
        explicit = (
            body.explicitinertial
            and spec.compiler.inertiafromgeom != mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
        )
        body.add_site(name=name, pos=body.ipos if explicit else model.body_ipos[i])
        spec.worldbody.add_site(name=origin)
        motor = constant_force(spec, name, 1.0, mujoco.mjtTrn.mjTRN_SITE, name)
        motor.refsite, motor.gear = origin, [*values, 0.0, 0.0, 0.0]
        return "mjcf"


@catalogue
class PayloadChange(Mass):
    """Another mass of a body for part of the time, kg. What is picked up is small beside the body,
    so the inertia about the centre of mass stays as it is."""

    name, timed, simplicity = "payload_change", True, 3

    def edit(self, model, i, values):
        model.body_mass[i] = values[0]


class SensorEffect(Effect):
    """An effect on the measurement of a hinge or slide, or of a sensor of the model."""

    kinds = ("joint", "sensor")

    def fits(self, model, i):
        return self.kind == "sensor" or model.jnt_type[i] in (HINGE, SLIDE)

    def stops(self, model, i, recordings):
        """[(reading, end of the range)] where the joint seems to lie at its stop: there a sensor's
        fault shows at once."""
        limited = self.kind == "joint" and model.jnt_limited[i]
        position = JointEffect.travel(model, i, recordings)[0] if limited else ()
        if not len(position):
            return []
        ends = np.quantile(
            position, (RESTING / 2, 1 - RESTING / 2)
        )  # beyond it lie a few rows of impacts
        near = [position[abs(position - end) < REST * np.ptp(position)] for end in ends]
        return [
            (float(np.median(x)), float(stop))
            for x, stop in zip(near, model.jnt_range[i])
            if len(x) > RESTING * len(position)
        ]

    def write(self, spec, model, i, values):
        return "measurement"


@catalogue
class SensorBias(SensorEffect):
    """The sensor's zero is off: it reads value + offset, in rad, m or its own unit."""

    name = "sensor_bias"

    def parameters(self, model, i):
        unit = "sensor" if self.kind == "sensor" else "rad" if turns(model, i) else "m"
        return (Parameter("offset", unit, 0.0, -HUGE, HUGE, 0.002),)

    def far(self, model, i, recordings):
        return [(seen - stop,) for seen, stop in self.stops(model, i, recordings)]

    def measure(self, values):
        return values[0], 1.0, 0.0

    @staticmethod
    def shared(model, i):
        """Whether what reads the joint too would see its zero move: a fixed tendon, an actuator in
        the parent's frame, a muscle."""
        wrapped = (model.wrap_objid == i) & (model.wrap_type == mujoco.mjtWrap.mjWRAP_JOINT)
        gain, bias = mujoco.mjtGain, mujoco.mjtBias
        plain = (
            (model.actuator_trntype == JOINT_TRANSMISSION)
            & np.isin(
                model.actuator_biastype,
                [int(b) for b in (bias.mjBIAS_NONE, bias.mjBIAS_AFFINE, bias.mjBIAS_DCMOTOR)],
            )
            & (
                (model.actuator_gaintype != int(gain.mjGAIN_AFFINE))
                | (model.actuator_gainprm[:, 1] == 0)
            )
        )
        own = np.isin(model.actuator_trntype, JOINT_TRANSMISSIONS) & (
            model.actuator_trnid[:, 0] == i
        )
        return wrapped.any() or (own & ~plain).any()

    def write(self, spec, model, i, values):
        if self.kind == "sensor" or self.shared(model, i):
            return "measurement"
        joint, offset = spec.joint(model.joint(i).name), authored(spec, model, i, values[0])
        joint.ref, joint.springref = joint.ref + offset, joint.springref + offset
        if (
            model.jnt_limited[i] or joint.limited == mujoco.mjtLimited.mjLIMITED_TRUE
        ):  # by a stop that was found
            joint.range = [bound + offset for bound in joint.range]
        for actuator in spec.actuators:  # servos and magnets go on acting on the true position
            if actuator.trntype == mujoco.mjtTrn.mjTRN_JOINT and actuator.target == joint.name:
                shift = actuator.gear[0] * values[0]
                if actuator.biastype == mujoco.mjtBias.mjBIAS_DCMOTOR:
                    actuator.biasprm[2] -= actuator.biasprm[1] * shift
                elif actuator.biastype == mujoco.mjtBias.mjBIAS_AFFINE and actuator.biasprm[1]:
                    actuator.type = mujoco.mjtActuator.mjACTUATOR_GENERAL
                    actuator.biasprm[0] -= actuator.biasprm[1] * shift
        return "mjcf"


@catalogue
class SensorScale(SensorEffect):
    """The sensor reads value · ratio; its speed too."""

    name = "sensor_scale"

    def parameters(self, model, i):
        return (Parameter("ratio", "1", 1.0, 0.1, 10.0, 0.005),)

    def far(self, model, i, recordings):
        return [
            (seen / stop,)
            for seen, stop in self.stops(model, i, recordings)
            if stop and 0.1 < seen / stop < 10
        ]

    def measure(self, values):
        return 0.0, values[0], 0.0


@catalogue
class SensorDelay(SensorEffect):
    """The sensor shows what was true some time ago: value(t − seconds)."""

    name, delays = "sensor_delay", True

    def parameters(self, model, i):
        return (Parameter("seconds", "s", 0.0, 0.0, 1.0, 0.001),)

    def measure(self, values):
        return 0.0, 1.0, values[0]
