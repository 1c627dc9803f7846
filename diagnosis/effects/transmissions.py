"""What lies between a drive and its link: bristles that bend before they slip, springs, shared
rotors and belts.

All have an MJCF form, with parts that the nominal model lacks (see Effect.build).
"""

import mujoco
import numpy as np

from diagnosis.effects.base import (
    HINGE,
    HUGE,
    JOINT_TRANSMISSION,
    SLIDE,
    Parameter,
    angle,
    catalogue,
    joints_of,
    passive,
    runge_kutta,
)
from diagnosis.effects.joints import (
    SOLIMP_FRICTION,
    SOLREF_FRICTION,
    JointEffect,
)

LUGRE_STIFFNESS, LUGRE_LEVELS = 5, slice(3, 6)  # in a dcmotor's dynprm, and in its biasprm
BRISTLE = 400.0  # 1/s², stiffness over inertia: a bristle to begin with
STIFFEST = 1.0  # of inertia over a time step squared: stiffer bristles than the step carries
RELAXES = 2.5  # Runge-Kutta's limit of a decay per step
FASTEST = 10.0  # rad/s or m/s, at which it has to hold
BENDS = 0.02, 0.07  # share of the travel in which a bristle yields, to try first
TONES = 2.0, 2.8, 4.0, 5.7, 8.0, 11.3, 16.0  # Hz of an elastic joint, to try first
DAMPED = 0.1  # its damping ratio


@catalogue
class Presliding(JointEffect):
    """Dry friction whose contacts bend like bristles before they slip: F = −σ z, ż = v − σ |v| z /
    F_c.

    σ `stiffness` in N·m/rad (N/m), F_c `frictionloss` in N·m (N), in addition to the joint's own.
    This is Dahl's model, and LuGre's without micro damping and Stribeck's fall; with σ → ∞ it is
    `coulomb_friction`, for motions below F_c/σ it is `stiffness`. Sources: Dahl, A Solid Friction
    Model (1968); Canudas de Wit, Olsson, Åström, Lischinsky (1995). A window begins with the
    bristle as it is after the motion recorded before.
    """

    name, simplicity, amplitudes = "presliding", 3, 2
    acts_through = "position"

    def _stiffest(self, model, i):
        return STIFFEST / model.dof_invweight0[model.jnt_dofadr[i]] / model.opt.timestep**2

    def parameters(self, model, i):
        M, force = self.scale(model, i), self.unit(model, i, "N·m", "N")
        stiffness = min(BRISTLE * M, self._stiffest(model, i))
        unit = self.unit(model, i, "N·m/rad", "N/m")
        return (
            Parameter("frictionloss", force, 0.0, 0.0, HUGE * M, 0.05 * M),
            Parameter(
                "stiffness", unit, stiffness, 1e-4 * stiffness, self._stiffest(model, i), 0.1 * M
            ),
        )

    def probes(self, model, i, recordings):
        position, _ = self.travel(model, i, recordings)
        spread = np.ptp(np.quantile(position, [0.05, 0.95])) + 1e-6
        farthest, fastest = self.reach(model, i, recordings)
        level = max(0.05, 0.1 * fastest**2 / farthest) * self.scale(model, i)
        stiff = (min(level / (bend * spread), self._stiffest(model, i)) for bend in BENDS)
        return np.array([(level, k) for k in stiff])

    def possible(self, values, nominal):
        return values[0] > 0

    def _motor(self, model, i):
        return f"presliding:{model.joint(i).name}"

    def build(self, spec, model, i):
        self.write(spec, model, i, (1.0, 1.0))

    @staticmethod
    def _carried(model, values):
        """The values with the stiffness that the integrator carries: Runge-Kutta explodes on what
        yields within a step."""
        level, stiffness = values
        if runge_kutta(model):
            stiffness = min(stiffness, RELAXES * level / (model.opt.timestep * FASTEST))
        return level, stiffness

    def edit(self, model, i, values):
        a, (level, stiffness) = (
            model.actuator(self._motor(model, i)).id,
            self._carried(model, values),
        )
        model.actuator_dynprm[a, LUGRE_STIFFNESS] = stiffness
        model.actuator_biasprm[a, LUGRE_LEVELS] = level, level, 1.0

    def write(self, spec, model, i, values):
        level, stiffness = self._carried(model, values)
        lugre = [stiffness, 0.0, level, level, 1.0]
        joint = model.joint(i).name
        passive(spec, self._motor(model, i), JOINT_TRANSMISSION, joint, lugre=lugre)
        return "mjcf"


@catalogue
class Backlash(JointEffect):
    """Play of width `gap` between motor and load; the sensor sits at the motor.

    The recorded joint becomes the motor's; a second one in the same body, limited to ± gap/2 and
    in the middle at the start of a run, carries the load. The motor side needs inertia of its own:
    without armature it gets one per cent of the joint's.
    """

    name, simplicity, amplitudes = "backlash", 3, 1
    acts_through = "position"

    def fits(self, model, i):
        body = model.jnt_bodyid[i]
        last = model.body_jntadr[body] + model.body_jntnum[body] - 1 == i
        return super().fits(model, i) and last and self.driven(model, i)

    def parameters(self, model, i):
        return (Parameter("gap", self.unit(model, i, "rad", "m"), 0.0, 0.0, 1.0, 0.005),)

    def probes(self, model, i, recordings):
        position, _ = self.travel(model, i, recordings)
        return np.ptp(position) * np.array([[0.01], [0.04]])

    def _load(self, model, i):
        """Name of the joint that carries the load."""
        return f"{self.name}:{model.joint(i).name}"

    def build(self, spec, model, i):
        motor = spec.joint(model.joint(i).name)
        if motor.armature == model.dof_armature[model.jnt_dofadr[i]]:  # else another one was found
            motor.armature = max(motor.armature, 0.01 * self.scale(model, i))
        load = motor.parent.add_joint(
            name=self._load(model, i),
            type=motor.type,
            pos=model.jnt_pos[i],
            axis=model.jnt_axis[i],
        )
        load.armature = load.frictionloss = load.ref = load.springref = load.margin = 0.0
        load.damping, load.stiffness = [0.0] * 3, [0.0] * 3
        load.limited, load.range = (
            mujoco.mjtLimited.mjLIMITED_TRUE,
            [angle(spec, model, i, x) for x in (-0.5, 0.5)],
        )
        load.solref_limit, load.solimp_limit = [0.004, 1.0], [0.95, 0.99, 0.001, 0.5, 2.0]
        return load

    def edit(self, model, i, values):
        model.jnt_range[model.joint(self._load(model, i)).id] = -values[0] / 2, values[0] / 2

    def write(self, spec, model, i, values):
        self.build(spec, model, i).range = [
            angle(spec, model, i, x) for x in (-values[0] / 2, values[0] / 2)
        ]
        return "mjcf"


@catalogue
class JointElasticity(Backlash):
    """A spring and a damper between drive and link: J θ̈ = τ − F, F = k (θ − q) + c (θ̇ − q̇)
    moves the link.

    k `stiffness` in N·m/rad (N/m), c `damping` in N·m·s/rad (N·s/m). The sensor sits at the motor,
    as do the joint's friction and armature J; without armature the motor gets one per cent of the
    joint's inertia. At the tone's frequency √(k/J') it is no `delay`: that turns no phase back.
    Source: Spong, Modeling and Control of Elastic Joint Robots (1987).
    """

    name, simplicity, amplitudes = "joint_elasticity", 3, 0

    def _reduced(self, model, i):
        """Inertia of motor and link swinging against each other."""
        whole = self.scale(model, i)
        motor = max(model.dof_armature[model.jnt_dofadr[i]], 0.01 * whole)
        link = max(whole - motor, 0.01 * whole)
        return motor * link / (motor + link)

    def parameters(self, model, i):
        reduced = self._reduced(model, i)
        stiffest = reduced / model.opt.timestep**2
        units = [self.unit(model, i, *u) for u in (("N·m/rad", "N/m"), ("N·m·s/rad", "N·s/m"))]
        soft, slow = reduced * (2 * np.pi) ** 2, 2 * np.pi * reduced
        return (
            Parameter("stiffness", units[0], np.inf, min(0.01 * soft, stiffest), stiffest, soft),
            Parameter("damping", units[1], 0.0, 0.0, 1e3 * slow, 0.1 * slow),
        )

    def probes(self, model, i, recordings):
        reduced = self._reduced(model, i)
        stiffest = self.parameters(model, i)[0].high
        tones = 2 * np.pi * np.array(TONES)
        return np.array([(min(reduced * w**2, stiffest), 2 * DAMPED * reduced * w) for w in tones])

    def possible(self, values, nominal):
        return np.isfinite(values[0])

    def build(self, spec, model, i):
        load = super().build(spec, model, i)
        load.limited = mujoco.mjtLimited.mjLIMITED_FALSE
        return load

    def edit(self, model, i, values):
        joint = model.joint(self._load(model, i)).id
        model.jnt_stiffness[joint] = values[0]
        model.dof_damping[model.jnt_dofadr[joint]] = values[1]

    def write(self, spec, model, i, values):
        load = self.build(spec, model, i)
        load.stiffness, load.damping = [values[0], 0.0, 0.0], [values[1], 0.0, 0.0]
        return "mjcf"


class CoupledEffect(JointEffect):
    """An effect in the sum of the positions of a joint and the one that carries it, named "a+b": a
    fixed tendon."""

    unit_names = "", ""
    number, field = "", ""
    simplicity = 3

    def places(self, model):
        return [f"{model.joint(a).name}+{model.joint(b).name}" for a, b in pairs(model)]

    def id(self, model, name):
        """The two joints' ids."""
        return joints_of(model, name)

    def parameters(self, model, i):
        M = max(self.scale(model, j) for j in i)
        unit = self.unit(model, i[0], *self.unit_names)
        return (Parameter(self.number, unit, 0.0, 0.0, HUGE * M, 0.05 * M),)

    def _name(self, model, i):
        return f"{self.name}:" + "+".join(model.joint(j).name for j in i)

    def build(self, spec, model, i):
        name = self._name(model, i)
        tendon = spec.add_tendon(name=name, limited=mujoco.mjtLimited.mjLIMITED_FALSE)
        tendon.frictionloss = tendon.armature = 0.0  # whatever the defaults say
        tendon.stiffness, tendon.damping = [0.0] * 3, [0.0] * 3
        tendon.solref_friction, tendon.solimp_friction = SOLREF_FRICTION, SOLIMP_FRICTION
        for j in i:
            tendon.wrap_joint(model.joint(j).name, 1.0)
        return tendon

    def edit(self, model, i, values):
        getattr(model, f"tendon_{self.field}")[model.tendon(self._name(model, i)).id] = values[0]

    def write(self, spec, model, i, values):
        setattr(self.build(spec, model, i), self.field, values[0])
        return "mjcf"


@catalogue
class CoupledFriction(CoupledEffect):
    """Dry friction in what two joints turn together: the same |F| ≤ level in both, against q̇_a +
    q̇_b. N·m or N.

    As in differential wrists, linkages and belts that run through a joint. Beside
    `coulomb_friction` of each joint, which opposes its own speed. Source: MuJoCo's tendon
    frictionloss.
    """

    name, number, field, acts_through = "coupled_friction", "level", "frictionloss", "velocity"
    unit_names = "N·m", "N"


@catalogue
class CoupledInertia(CoupledEffect):
    """A rotor that two joints turn together: kinetic energy J (q̇_a + q̇_b)² / 2. kg·m² or kg.

    The off-diagonal part is what `armature` of both joints lacks. Source: as CoupledFriction;
    MuJoCo's tendon armature.
    """

    name, number, field, constants = "coupled_inertia", "inertia", "armature", True
    unit_names = "kg·m²", "kg"


def pairs(model):
    """[(a, b)] joints of one type, a hinge or slide each, the only one of its body, b's body
    hanging on a's."""
    single = {
        model.jnt_bodyid[j]: j
        for j in range(model.njnt)
        if model.jnt_type[j] in (HINGE, SLIDE) and model.body_jntnum[model.jnt_bodyid[j]] == 1
    }
    out = []
    for body, b in single.items():
        parent = model.body_parentid[body]
        while parent and not model.body_jntnum[parent]:  # welded in between
            parent = model.body_parentid[parent]
        a = single.get(parent)
        if a is not None and model.jnt_type[a] == model.jnt_type[b]:
            out.append((a, b))
    return out
