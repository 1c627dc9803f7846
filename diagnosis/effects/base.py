"""What an effect is: a place, parameters, and the ways it can change a simulation.

An effect acts in one or more ways, each a method of Effect that does nothing unless a class
overrides it:

    edit      fields of the compiled model         build    parts edit() sizes
    command   the control on its way               push     a constant force
    force     a force that depends on the state    measure  the sensor
    limit     dry friction that depends on it      probes   values worth a try
    write     the same in MJCF                     far      values to try at full size

Values are absolute, in SI units, with the sign of the MJCF field. A new effect is one class with
the decorator @catalogue, and no other line.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import mujoco
import numpy as np

HINGE, SLIDE, BALL = (
    int(kind)
    for kind in (
        mujoco.mjtJoint.mjJNT_HINGE,
        mujoco.mjtJoint.mjJNT_SLIDE,
        mujoco.mjtJoint.mjJNT_BALL,
    )
)
JOINT_TRANSMISSION = int(mujoco.mjtTrn.mjTRN_JOINT)
JOINT_TRANSMISSIONS = JOINT_TRANSMISSION, int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)
HUGE = 1e12  # upper bound where physics gives none, in units of the effect's own scale
EFFECTS = []  # the catalogue, one instance of each class; effects are applied in this order


@dataclass(frozen=True)
class Place:
    """Where an effect sits: kind is joint, actuator, body, geom, sensor or world."""

    kind: str
    name: str


@dataclass(frozen=True)
class Parameter:
    """One number of an effect.

    `step` is a small typical change, for sensitivities; values outside [low, high] are not
    physical. nominal is infinite for a limit that the nominal model does not have.
    """

    name: str
    unit: str
    nominal: float
    low: float
    high: float
    step: float


@dataclass(frozen=True, eq=False)
class Candidate:
    """An effect at a place, perhaps only under a condition. Hashable; equal if these are.

    when: None, or {'recording': name, 'time': [from, to]}, in that recording's time; name None: in
    that of each.
    """

    effect: "Effect"
    place: Place
    parameters: tuple
    when: dict = None

    def _key(self):
        return self.effect, self.place, repr(self.when)

    def __eq__(self, other):
        return isinstance(other, Candidate) and self._key() == other._key()

    def __hash__(self):
        return hash((self.effect.name, self.place))

    def __repr__(self):
        return f"{self.effect.name}({self.place.name})" + (
            f" when {self.when}" if self.when else ""
        )

    @property
    def nominal(self):
        return tuple(p.nominal for p in self.parameters)

    @property
    def lasting(self):
        """The same candidate without a condition."""
        return replace(self, when=None) if self.when else self


def condition_of(candidates):
    """The condition under which some of a set act (see Candidate.when), None without: a set has
    one at most."""
    return next((c.when for c in candidates if c.when), None)


class Part(NamedTuple):
    """What corrected.py adds: a law of diagnosis/simulation/corrected_template.py, where, its
    numbers."""

    law: str
    place: str  # the joint's or actuator's name
    numbers: dict  # of the law's arguments: floats, lists of them, names


class Effect:
    """One kind of physics; an id is always that of the model it is passed with."""

    name = ""
    kinds = ()  # kinds of place; one instance for each, with the attribute `kind`
    constants = False  # edit() changes something that mj_setConst derives constants from
    acts_through = ""  # what its force varies with: velocity, position, control or contact
    loaded = True  # limit() reads qfrc_bias
    numerical = False  # the simulator's own method, no physics
    delays = False  # its one value is the time by which something is late
    bounds = False  # its values are limits: on the way to one, nothing changes until it is met
    timed = False  # differs from a simpler effect only under a condition
    amplitudes = (
        0  # of an effect with probes: how many of its first parameters it acts in proportion to
    )
    together = 1  # of an effect with probes: how many in a row are tried as one
    simplicity = 1  # 0 for the first things to think of, up to 3; -1 for what is numerical

    def __repr__(self):
        return self.name

    def places(self, model):
        """Names of the objects of model where this effect can sit."""
        if self.kind == "world":
            return ["world"] if self.fits(model, 0) else []
        count = {
            "body": model.nbody,
            "joint": model.njnt,
            "geom": model.ngeom,
            "actuator": model.nactuator,
            "sensor": model.nsensor,
        }[self.kind]
        return [getattr(model, self.kind)(i).name for i in range(count) if self.fits(model, i)]

    def id(self, model, name):
        """Id of the object of that name in model."""
        if self.kind == "world":
            return 0
        return mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{self.kind.upper()}"), name)

    def fits(self, model, i):
        """Whether the effect can sit at object i."""
        return True

    def parameters(self, model, i):
        """Tuple of Parameter for object i."""
        raise NotImplementedError

    def probes(self, model, i, recordings):
        """Values (P, parameters) to try first: by default each parameter a step up, and down where
        it may."""
        parameters = self.parameters(model, i)
        nominal = [p.nominal for p in parameters]
        rows = [
            nominal[:k] + [p.nominal + d] + nominal[k + 1 :]
            for k, p in enumerate(parameters)
            for d in (p.step, -p.step)
            if p.low <= p.nominal + d <= p.high
        ]
        return np.array(rows)

    def merged(self, rows, amounts):
        """(values, amount): the one probe, and how much of it, that does what these probes in
        these amounts do."""
        return rows[0], amounts[0]

    def far(self, model, i, recordings):
        """Values (P, parameters) to try besides a small step: so far off an effect no longer acts
        in proportion."""
        return ()

    def possible(self, values, nominal):
        """Whether a real machine can have these values, and not another effect by this name."""
        return True

    def twin(self, model, i):
        """Name of another place where the effect has the same numbers, or None."""
        return None

    def build(self, spec, model, i):
        """Add to spec (of the nominal model) what edit() sizes."""

    def edit(self, model, i, values):
        """Put the effect into a compiled model."""

    def command(self, signal, model, i, values):
        """The Signal that reaches the actuator."""
        return signal

    def push(self, qfrc, xfrc, model, i, values):
        """Add a constant force to qfrc (nv,) or xfrc (nbody, 6)."""

    def force(self, models, i, values):
        """None, or a function (qpos (S,nq), qvel (S,nv), ctrl (S,nu), time (S,)) -> force to add,
        (S,nv).

        models: S compiled models with every edit made; values (S, parameters).
        """
        return None

    def limit(self, models, i, values):
        """None, or a function (qpos (S,nq), qvel (S,nv), ctrl (S,nu), time (S,), qfrc_bias (S,nv))
        -> (S,nv), at least 0.

        By so much the dry friction that a joint can hold, its frictionloss, is larger. The
        arguments are those of force(); qfrc_bias is MuJoCo's: Coriolis forces minus gravity, so
        that -qfrc_bias is the load from outside, but for contacts.
        """
        return None

    def stepwise(self, model, i):
        """Whether it has to be worked out before each step of a simulation."""
        return self.overrides("force") or self.overrides("limit")

    def measure(self, values):
        """(offset, ratio, delay) of the sensor."""
        return 0.0, 1.0, 0.0

    def write(self, spec, model, i, values):
        """Put the effect into spec, of the nominal model; return 'mjcf', 'python', 'measurement'
        or 'none'.

        'python': spec holds it only in part or not at all, corrected.py does (see part()).
        """
        raise NotImplementedError

    def part(self, model, i, values):
        """The Part of corrected.py that holds what write() left to it, in full, or several; None
        for
        what never does."""
        return None

    def overrides(self, method):
        """Whether the effect acts by this method."""
        return getattr(type(self), method) is not getattr(Effect, method)


def catalogue(cls):
    """Class decorator: the effect joins EFFECTS, once for each kind of place."""
    for kind in cls.kinds:
        instance = cls()
        instance.kind = kind
        EFFECTS.append(instance)
    return cls


def joints_of(model, name):
    """Ids of the joint of that name, or of the two that "a+b" names."""
    find = lambda one: mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, one)
    if find(name) >= 0:
        return (find(name),)
    parts = name.split("+")
    pairs = (("+".join(parts[:k]), "+".join(parts[k:])) for k in range(1, len(parts)))
    for pair in pairs:
        ids = tuple(map(find, pair))
        if min(ids) >= 0:
            return ids
    raise KeyError(f"no joint {name}")


def end_of_step(lag, step):
    """Time constant of the filter that is `lag` seconds late on average, read at the end of each
    step.

    Its values follow a held control by the factor a = exp(−step/T) a step, in all step · a/(1 − a)
    short of it; a filter with T = lag would be half a step early there. All in seconds.
    """
    return step / np.log1p(step / lag)


def turns(model, j):
    """Whether joint j is a hinge."""
    return model.jnt_type[j] == HINGE


def is_numerical(name):
    """Whether an effect, by its name, is the simulator's own method and no physics."""
    return any(effect.numerical for effect in EFFECTS if effect.name == name)


def runge_kutta(model):
    """Whether forces are evaluated several times in a step."""
    return model.opt.integrator == int(mujoco.mjtIntegrator.mjINT_RK4)


def displace(spec, kind, name, by):
    """Move a spec's "body" or "geom" by a vector (3,) in the axes of its body, whatever <frame>s
    it stands in."""
    find = lambda within: getattr(within, kind)(name)
    element, turn = find(spec), np.eye(3)
    if element.frame is not None:

        def compiled(move):
            other = spec.copy()
            find(other).pos += move
            return find(other.compile()).pos

        turn = np.stack([compiled(axis) - compiled(0 * axis) for axis in np.eye(3)])
    ends = kind == "geom" and not np.isnan(element.fromto[0])
    if ends:
        element.fromto += np.tile(turn @ by, 2)
    else:
        element.pos += turn @ by


def explicit_inertia(spec, model):
    """Make every inertia of spec explicit, as compiled: what geoms or a total mass imply cannot be
    edited."""
    compiler, on = spec.compiler, mujoco.mjtInertiaFromGeom
    # even over what the file says
    implied = compiler.inertiafromgeom == on.mjINERTIAFROMGEOM_TRUE or compiler.settotalmass > 0
    compiler.inertiafromgeom, compiler.settotalmass, compiler.balanceinertia = (
        on.mjINERTIAFROMGEOM_AUTO,
        -1,
        False,
    )
    for body in spec.bodies[1:]:
        i, explicit = (
            model.body(body.name).id,
            body.explicitinertial and not np.isfinite(body.fullinertia[0]),
        )
        if (implied or not explicit) and model.body_mass[i] > 0:
            body.explicitinertial, body.fullinertia = True, np.full(6, np.nan)
            body.mass, body.ipos, body.inertia = (
                model.body_mass[i],
                model.body_ipos[i],
                model.body_inertia[i],
            )
            body.ialt.type, body.iquat = (
                mujoco.mjtOrientation.mjORIENTATION_QUAT,
                model.body_iquat[i],
            )


def angle(spec, model, j, value):
    """A position of a new joint like joint j as the spec writes it."""
    return np.rad2deg(value) if spec.compiler.degree and turns(model, j) else value


def authored(spec, model, j, value):
    """A position of joint j as the spec writes it. What was attached from another file keeps that
    file's units, and stands in a frame."""
    if not (turns(model, j) and spec.frames):
        return angle(spec, model, j, value)
    other, name = spec.copy(), model.joint(j).name
    joint = other.joint(name)
    joint.ref, joint.limited = (
        1.0,
        mujoco.mjtLimited.mjLIMITED_FALSE,
    )  # its range may be half written
    return value / other.compile().joint(name).qpos0[0]


def passive(spec, name, trntype, target, **block):
    """Add a dcmotor with neither inputs nor electrics: a carrier of cogging and friction, without
    a control."""
    motor = spec.add_actuator(name=name, trntype=trntype, target=target)
    motor.forcelimited = motor.ctrllimited = (
        mujoco.mjtLimited.mjLIMITED_FALSE
    )  # whatever the defaults say
    motor.set_to_dcmotor(
        motorconst=[0.0, 0.0],
        resistance=1.0,
        ctrlspec=int(mujoco.mjtCtrlInput.mjINPUT_NONE),
        **block,
    )
    return motor


def constant_force(spec, name, value, trntype, target):
    """Add a constant force along a transmission: cogging with no poles."""
    return passive(spec, name, trntype, target, cogging=[value, 0.0, np.pi / 2])
