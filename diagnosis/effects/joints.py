"""Effects in a joint: a hinge or slide, some in a ball joint too. Their scales follow the joint's
own inertia."""

import mujoco
import numpy as np

from diagnosis.effects.base import (
    BALL,
    HINGE,
    HUGE,
    JOINT_TRANSMISSION,
    SLIDE,
    Effect,
    Parameter,
    authored,
    catalogue,
    constant_force,
    passive,
    turns,
)

# frictionloss as a nearly rigid constraint: with MuJoCo's default a stuck joint creeps
SOLREF_FRICTION = (0.004, 1.0)
SOLIMP_FRICTION = (0.999, 0.9999, 0.001, 0.5, 2.0)
STRENGTHS = (
    1.0,
    10.0,
    100.0,
)  # of a force that grows faster than in proportion, over what turns the fastest motion round


class JointEffect(Effect):
    """An effect on a joint, of the types given."""

    kinds = ("joint",)
    types = HINGE, SLIDE

    def fits(self, model, i):
        return model.jnt_type[i] in self.types

    @staticmethod
    def driven(model, i):
        """Whether an actuator acts on the joint itself."""
        return (
            (model.actuator_trntype == JOINT_TRANSMISSION) & (model.actuator_trnid[:, 0] == i)
        ).any()

    @staticmethod
    def unit(model, i, hinge, slide):
        return slide if model.jnt_type[i] == SLIDE else hinge

    @staticmethod
    def scale(model, i):
        """Inertia the joint moves in the reference pose."""
        return model.dof_M0[model.jnt_dofadr[i]]

    @staticmethod
    def travel(model, i, recordings):
        """All recorded positions and speeds of the joint, speeds by differences."""
        q = model.jnt_qposadr[i]
        known = [
            np.isfinite(r.qpos[:, q]) for r in recordings
        ]  # between measured rows, be they next to each other or not
        speed = [np.diff(r.qpos[k, q]) / np.diff(r.time[k]) for r, k in zip(recordings, known)]
        return np.concatenate([r.qpos[k, q] for r, k in zip(recordings, known)]), abs(
            np.concatenate(speed)
        )

    def reach(self, model, i, recordings):
        """How far from its spring's rest, and how fast, the joint was recorded, but for the odd
        row."""
        position, speed = self.travel(model, i, recordings)
        far = abs(position - model.qpos_spring[model.jnt_qposadr[i]])
        return [
            float(max(np.quantile(x, 0.99, method="lower"), 1e-3)) if len(x) else 1.0
            for x in (far, speed)
        ]


class JointNumber(JointEffect):
    """An effect that is one number of the joint, in the compiled model and in the spec."""

    number = "", "", ""  # name; unit for a hinge, for a slide
    compiled = "", None  # field of the model by dof (or jnt_*, by joint); column, if it has several
    authored = "", None  # attribute of the spec's joint; its component, if it has several
    step, signed = 0.02, False

    def _field(self, model, i):
        name, column = self.compiled
        rows = i if name.startswith("jnt") else self._dofs(model, i)
        return getattr(model, name), rows if column is None else (rows, column)

    @staticmethod
    def _dofs(model, i):
        first = model.jnt_dofadr[i]
        return slice(first, first + (3 if model.jnt_type[i] == BALL else 1))

    def parameters(self, model, i):
        (name, *units), (field, k), M = self.number, self._field(model, i), self.scale(model, i)
        low, nominal = -HUGE * M if self.signed else 0.0, np.ravel(field[k])[0]
        step = max(self.step * M, 0.01 * abs(nominal))
        return (Parameter(name, self.unit(model, i, *units), nominal, low, HUGE * M, step),)

    def edit(self, model, i, values):
        field, k = self._field(model, i)
        field[k] = values[0]

    def write(self, spec, model, i, values):
        joint, (attribute, component) = spec.joint(model.joint(i).name), self.authored
        if component is None:
            setattr(joint, attribute, values[0])
        else:
            getattr(joint, attribute)[component] = values[0]
        return "mjcf"


@catalogue
class Armature(JointNumber):
    """Inertia J of rotor and gears in the joint's own coordinate: force −J q̈. kg·m² or kg.

    Source: MuJoCo's joint armature; a rotor of J_r behind gears of ratio n adds n² J_r.
    """

    name, types, constants = "armature", (HINGE, SLIDE, BALL), True
    number, compiled, authored, step = (
        ("armature", "kg·m²", "kg"),
        ("dof_armature", None),
        ("armature", None),
        0.01,
    )


@catalogue
class ViscousDamping(JointNumber):
    """Force −d·v, d in N·m·s/rad or N·s/m. Source: MuJoCo's joint damping; Newtonian grease."""

    name, types, simplicity = "viscous_damping", (HINGE, SLIDE, BALL), 0
    acts_through = "velocity"
    number, compiled, authored = (
        ("damping", "N·m·s/rad", "N·s/m"),
        ("dof_damping", None),
        ("damping", 0),
    )


@catalogue
class QuadraticDamping(JointNumber):
    """Force −d·v·|v|, d in N·m·s²/rad² or N·s²/m². Source: MuJoCo's damping polynomial; a fan."""

    name = "quadratic_damping"
    acts_through = "velocity"
    number, compiled, authored = (
        ("damping2", "N·m·s²/rad²", "N·s²/m²"),
        ("dof_dampingpoly", 0),
        ("damping", 1),
    )

    def far(self, model, i, recordings):
        farthest, _ = self.reach(model, i, recordings)
        return [(strength * self.scale(model, i) / farthest,) for strength in STRENGTHS]


@catalogue
class CoulombFriction(JointNumber):
    """Dry friction: |F| ≤ frictionloss, against the motion or holding the joint. N·m or N.

    Of a level that differs by direction it is this and a `spring_offset`: half their sum, and half
    their difference. Source: MuJoCo's frictionloss, as stiff as a stuck joint needs.
    """

    name, types, simplicity = "coulomb_friction", (HINGE, SLIDE, BALL), 0
    acts_through = "velocity"
    number, compiled, authored = (
        ("frictionloss", "N·m", "N"),
        ("dof_frictionloss", None),
        ("frictionloss", None),
    )
    step = 0.05

    def edit(self, model, i, values):
        dofs = self._dofs(model, i)
        if not model.dof_frictionloss[dofs].any():  # else the nominal model's own softness counts
            model.dof_solref[dofs], model.dof_solimp[dofs] = SOLREF_FRICTION, SOLIMP_FRICTION
        super().edit(model, i, values)

    def write(self, spec, model, i, values):
        joint = spec.joint(model.joint(i).name)
        if not joint.frictionloss:
            joint.solref_friction, joint.solimp_friction = SOLREF_FRICTION, SOLIMP_FRICTION
        return super().write(spec, model, i, values)


@catalogue
class Stiffness(JointNumber):
    """Force −k·(q − springref), k in N·m/rad or N/m. Source: MuJoCo's joint stiffness."""

    name = "stiffness"
    acts_through = "position"
    number, compiled, authored, step = (
        ("stiffness", "N·m/rad", "N/m"),
        ("jnt_stiffness", None),
        ("stiffness", 0),
        0.1,
    )


@catalogue
class NonlinearStiffness(JointNumber):
    """Force −k·(q − springref)³, k in N·m/rad³ or N/m³. Source: MuJoCo's stiffness polynomial."""

    name, simplicity = "nonlinear_stiffness", 2
    acts_through = "position"
    number, compiled, authored = (
        ("stiffness3", "N·m/rad³", "N/m³"),
        ("jnt_stiffnesspoly", 1),
        ("stiffness", 2),
    )
    step, signed = 0.1, True

    def far(self, model, i, recordings):
        farthest, fastest = self.reach(model, i, recordings)
        return [
            (strength * self.scale(model, i) * fastest**2 / farthest**4,) for strength in STRENGTHS
        ]


@catalogue
class SpringOffset(JointEffect):
    """A constant force in the joint, N·m or N: a spring at rest elsewhere, a tilt, a cable.

    With `coulomb_friction` beside it, friction that differs by direction.
    """

    name = "spring_offset"

    def parameters(self, model, i):
        M = self.scale(model, i)
        return (
            Parameter(
                "torque", self.unit(model, i, "N·m", "N"), 0.0, -HUGE * M, HUGE * M, 0.05 * M
            ),
        )

    def push(self, qfrc, xfrc, model, i, values):
        qfrc[model.jnt_dofadr[i]] += values[0]

    def write(self, spec, model, i, values):
        joint = spec.joint(model.joint(i).name)
        k = joint.stiffness
        if k[0] > 0 and not k[1] and not k[2]:
            joint.springref = joint.springref + authored(spec, model, i, values[0] / k[0])
        else:
            constant_force(
                spec, f"spring_offset:{joint.name}", values[0], JOINT_TRANSMISSION, joint.name
            )
        return "mjcf"


@catalogue
class Cogging(JointEffect):
    """Force amplitude·sin(poles·q + phase), as of a motor's magnets.

    amplitude in N·m (N), poles per rad (rad/m), phase in rad. Source: the cogging of MuJoCo's
    dcmotor.
    """

    name, simplicity, amplitudes, together = "cogging", 3, 1, 2
    acts_through = "position"

    def fits(self, model, i):
        return super().fits(model, i) and self.driven(model, i)

    def parameters(self, model, i):
        M = self.scale(model, i)
        return (
            Parameter(
                "amplitude", self.unit(model, i, "N·m", "N"), 0.0, -HUGE * M, HUGE * M, 0.05 * M
            ),
            Parameter("poles", self.unit(model, i, "1", "rad/m"), 6.0, 0.1, 1e6, 0.1),
            Parameter("phase", "rad", 0.0, -10.0, 10.0, 0.1),
        )

    def probes(self, model, i, recordings):
        """Ripples close enough to each other for one of them to stay in step over the whole
        travel."""
        position, _ = self.travel(model, i, recordings)
        travel = np.ptp(np.quantile(position, [0.05, 0.95])) + 1e-6
        if turns(model, i) and travel > 5:
            poles = np.arange(1, 25)
        else:
            poles = np.arange(6.5, 80.0, 3.0) / travel
        farthest, fastest = self.reach(model, i, recordings)
        amplitude = max(0.05, 0.1 * fastest**2 / farthest) * self.scale(
            model, i
        )  # too little does not show beside dry friction
        return np.array([(amplitude, n, phase) for n in poles for phase in (0.0, np.pi / 2)])

    def merged(self, rows, amounts):
        wave = sum(amount * row[0] * np.exp(1j * row[2]) for row, amount in zip(rows, amounts))
        return (rows[0][0], rows[0][1], float(np.angle(wave))), abs(wave) / rows[0][0]

    def _motor(self, model, i):
        return f"cogging:{model.joint(i).name}"

    def build(self, spec, model, i):
        self.write(spec, model, i, (0.0, 1.0, 0.0))  # no force while it is off

    def edit(self, model, i, values):
        model.actuator_biasprm[model.actuator(self._motor(model, i)).id, :3] = values

    def write(self, spec, model, i, values):
        passive(
            spec,
            self._motor(model, i),
            JOINT_TRANSMISSION,
            model.joint(i).name,
            cogging=list(values),
        )
        return "mjcf"


@catalogue
class JointStop(JointEffect):
    """The joint is limited to [low, high], in rad or m. Source: MuJoCo's joint range."""

    name, simplicity = "joint_stop", 2
    bounds = True
    acts_through = "position"
    NEVER = 1e5  # a bound that far away is never met

    def parameters(self, model, i):
        low, high = model.jnt_range[i] if model.jnt_limited[i] else (-np.inf, np.inf)
        unit = self.unit(model, i, "rad", "m")
        return (
            Parameter("low", unit, low, -10 * self.NEVER, 10 * self.NEVER, 0.01),
            Parameter("high", unit, high, -10 * self.NEVER, 10 * self.NEVER, -0.01),
        )

    def probes(self, model, i, recordings):
        position, _ = self.travel(model, i, recordings)
        low, high = (p.nominal for p in self.parameters(model, i))
        least, a, b, c, d, most = np.quantile(position, [0, 0.03, 0.15, 0.85, 0.97, 1])
        both = [(x, y) for x, y in ((a, d), (b, c)) if x > low and y < high]
        # a side without a stop begins at the farthest position: from there on it may move
        bottom, top = np.where(np.isfinite([low, high]), [low, high], [least, most])
        starts = [(x, top) for x in (a, b) if x > low] + [(bottom, x) for x in (c, d) if x < high]
        return np.array(starts + both).reshape(-1, 2)

    def edit(self, model, i, values):
        model.jnt_limited[i] = True
        model.jnt_range[i] = self._range(values)

    def _range(self, values):
        low, high = np.clip(values, -self.NEVER, self.NEVER)
        return low, max(high, low + 1e-6)  # MuJoCo compiles no other

    def write(self, spec, model, i, values):
        joint = spec.joint(model.joint(i).name)
        joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
        joint.range = [authored(spec, model, i, x) for x in self._range(values)]
        return "mjcf"
