"""The catalogue: every effect a simulator may lack, one small class each.

    for effect in EFFECTS.values():
        for name in effect.places(model):
            effect.parameters(model, id)              # unit, nominal, bounds, step
            effect.edit(model, id, values)            # changes a compiled mujoco.MjModel
            effect.write(spec, model, id, values)     # changes the MjSpec of corrected.xml

An effect acts in one or more ways, each a method that does nothing unless a
class overrides it: `edit` (fields of the compiled model), `command` (the control
signal on its way to the actuator), `push` (a constant force), `force` (a force
that depends on the state), `measure` (the sensor), `build` (parts that the
compiled model must have before `edit` can size them). Values are absolute, in SI
units, with the sign of the MJCF field. A value equal to the nominal one leaves
the simulation as it is.

A new effect is one class with the decorator @catalogue and no other line.
"""

from dataclasses import dataclass, replace

import mujoco
import numpy as np

HINGE, SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
LIMITED = mujoco.mjtLimited.mjLIMITED_TRUE
HUGE = 1e6  # an upper bound where physics gives none, in units of the effect's own scale
# frictionloss as a nearly rigid constraint: with MuJoCo's default a stuck joint creeps
SOLREF_FRICTION = (0.004, 1.0)
SOLIMP_FRICTION = (0.999, 0.9999, 0.001, 0.5, 2.0)
EFFECTS = {}  # name: the one instance of its class


@dataclass(frozen=True)
class Place:
    """Where an effect sits: kind is joint, actuator, body, geom, sensor or world."""
    kind: str
    name: str


@dataclass(frozen=True)
class Parameter:
    """One number of an effect, absolute and in SI units.

    `step` is a small typical change, for sensitivities; values outside
    [low, high] are not physical.
    """
    name: str
    unit: str
    nominal: float
    low: float
    high: float
    step: float


@dataclass(frozen=True)
class Candidate:
    """An effect at a place, with its parameters. Hashable; equal if effect and place are."""
    effect: 'Effect'
    place: Place
    parameters: tuple

    def __eq__(self, other):
        return isinstance(other, Candidate) and (self.effect, self.place) == (other.effect, other.place)

    def __hash__(self):
        return hash((self.effect.name, self.place))

    def __repr__(self):
        return f'{self.effect.name}({self.place.name})'

    @property
    def nominal(self):
        return tuple(p.nominal for p in self.parameters)


@dataclass(frozen=True)
class Signal:
    """A recorded control of one actuator on its way there: held, delayed, filtered.

    value[i] (T,) is held from time[i] to time[i+1]; the actuator sees it `delay`
    seconds later, through a first-order lag of time constant `lag`. Before the
    recording began the control was zero, as after mj_resetData.
    """
    time: np.ndarray
    value: np.ndarray
    delay: float = 0.0
    lag: float = 0.0

    def sample(self, start, step, count, average):
        """What the actuator sees in `count` steps of `step` seconds from `start`, (count,).

        A hold that ends inside a step counts by its share of the step, so the
        result changes smoothly with the delay. With a lag: the filter's value at
        the end of the step (MuJoCo's actearly), or its mean over the step if
        `average` (a Runge-Kutta step sees the filter move).
        """
        edges = start - self.delay + step * np.arange(count + 1)
        before, after = self._row(edges[:-1] + 1e-3 * step), self._row(edges[1:] - 1e-3 * step)
        held = np.concatenate([[0.0], self.value])  # row -1: before the recording
        seen = held[before + 1]
        split = before != after
        if split.any() or self.lag:
            area = np.concatenate([[0.0], np.cumsum(self.value[:-1] * np.diff(self.time))])

            def integral(t):
                i = self._row(t)
                return np.where(i < 0, 0.0, area[i] + self.value[i] * (t - self.time[i]))

            mean = np.diff(integral(edges)) / step
            seen = np.where(split, mean, seen)
        if not self.lag:
            return seen
        act = self._filtered(edges)
        return mean - self.lag / step * np.diff(act) if average else act[1:]

    def _row(self, t):
        return np.searchsorted(self.time, t, side='right') - 1

    def _filtered(self, t):
        """The lag's output at times t: exact, from rest at the recording's first row."""
        # a[i+1] = decay[i] a[i] + gain[i], as a scan that doubles its reach
        decay = np.exp(-np.diff(self.time) / self.lag)
        scale, act = decay.copy(), self.value[:-1] * (1 - decay)
        reach = 1
        while reach < len(act) and scale.max(initial=0.0) > 1e-18:
            act[reach:] += scale[reach:] * act[:-reach]
            scale[reach:] = scale[reach:] * scale[:-reach]
            reach *= 2
        act = np.concatenate([[0.0], act])
        i = self._row(t)
        return np.where(i < 0, 0.0, self.value[i] + (act[i] - self.value[i]) * np.exp(-np.maximum(t - self.time[i], 0) / self.lag))


class Effect:
    """One kind of physics; ids are those of the model that is passed."""
    name = ''
    kind = ''          # where it sits: joint, actuator, body, geom, sensor or world
    constants = False  # edit() changes something mj_setConst derives constants from
    timed = False      # means something only with a `when`

    def __repr__(self):
        return self.name

    def places(self, model):
        """Names of the objects of model where this effect can sit."""
        if self.kind == 'world':
            return ['world'] if self.fits(model, 0) else []
        count, view = {'body': (model.nbody, model.body), 'joint': (model.njnt, model.joint), 'geom': (model.ngeom, model.geom),
                       'actuator': (model.nactuator, model.actuator), 'sensor': (model.nsensor, model.sensor)}[self.kind]
        return [view(i).name for i in range(count) if self.fits(model, i)]

    def id(self, model, name):
        if self.kind == 'world':
            return 0
        return mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f'mjOBJ_{self.kind.upper()}'), name)

    def fits(self, model, i):
        """Whether the effect can sit at object i."""
        return True

    def parameters(self, model, i):
        """Tuple of Parameter for object i."""
        raise NotImplementedError

    def build(self, spec, name):
        """Add to spec what edit() sizes; return True if anything was added."""
        return False

    def edit(self, model, i, values):
        """Put the effect into a compiled model."""

    def command(self, signal, model, i, values):
        """The Signal that reaches the actuator."""
        return signal

    def push(self, qfrc, xfrc, model, i, values):
        """Add a constant force to qfrc (nv,) or xfrc (nbody, 6)."""

    def force(self, models, i, values):
        """None, or a function (qpos (S,nq), qvel (S,nv), ctrl (S,nu), time (S,)) -> force to add, (S,nv).

        models: S compiled models with every edit made; values (S, parameters).
        """
        return None

    def measure(self, values):
        """(offset, ratio, delay) of the sensor, or None."""
        return None

    def write(self, spec, model, i, values):
        """Put the effect into spec; return 'mjcf', 'measurement' or 'none'."""
        raise NotImplementedError


def catalogue(cls):
    """Class decorator: the effect joins EFFECTS."""
    EFFECTS[cls.name] = cls()
    return cls


def angle(spec, model, j, value):
    """A joint position as the spec writes it."""
    return np.rad2deg(value) if spec.compiler.degree and model.jnt_type[j] == HINGE else value


# ---------------------------------------------------------------- bodies

def explicit_inertia(spec, model):
    """Make every inertia of spec explicit, as compiled: what geoms imply cannot be edited."""
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    spec.compiler.settotalmass, spec.compiler.balanceinertia = -1, False
    for body in spec.bodies[1:]:
        if not body.explicitinertial or np.isfinite(body.fullinertia[0]):
            _write_inertia(body, model)


def _write_inertia(body, model):
    i = model.body(body.name).id
    body.explicitinertial, body.fullinertia = True, np.full(6, np.nan)
    body.mass, body.ipos, body.inertia = model.body_mass[i], model.body_ipos[i], model.body_inertia[i]
    body.ialt.type, body.iquat = mujoco.mjtOrientation.mjORIENTATION_QUAT, model.body_iquat[i]


class _Inertial(Effect):
    """An effect on mass, centre of mass or inertia of a moving body."""
    kind = 'body'
    constants = True

    def fits(self, model, i):
        return model.body_weldid[i] != 0 and model.body_mass[i] > 0

    def write(self, spec, model, i, values):
        explicit_inertia(spec, model)
        body, edited = spec.body(model.body(i).name), _Inertia(body_mass=model.body_mass.copy(), body_ipos=model.body_ipos.copy(), body_inertia=model.body_inertia.copy())
        edited.body_mass[i], edited.body_ipos[i], edited.body_inertia[i] = body.mass, body.ipos, body.inertia
        self.edit(edited, i, values)
        body.mass, body.ipos, body.inertia = edited.body_mass[i], edited.body_ipos[i], edited.body_inertia[i]
        return 'mjcf'


@dataclass
class _Inertia:
    """The part of a model that _Inertial effects edit."""
    body_mass: np.ndarray
    body_ipos: np.ndarray
    body_inertia: np.ndarray


@catalogue
class Mass(_Inertial):
    """Another mass; the inertia scales along."""
    name = 'mass'

    def parameters(self, model, i):
        m = model.body_mass[i]
        return Parameter('mass', 'kg', m, 0.02 * m, 50 * m, 0.01 * m),

    def edit(self, model, i, values):
        model.body_inertia[i] *= values[0] / model.body_mass[i]
        model.body_mass[i] = values[0]


def _size(model, i):
    """Length scale of a body: its radius of gyration, or its centre's distance from the joint."""
    return max(np.sqrt(model.body_inertia[i].max() / model.body_mass[i]), 0.3 * np.linalg.norm(model.body_ipos[i]))


@catalogue
class CenterOfMass(_Inertial):
    """The centre of mass lies elsewhere in the body's frame."""
    name = 'center_of_mass'

    def parameters(self, model, i):
        s = _size(model, i)
        return tuple(Parameter(n, 'm', p, p - 10 * s, p + 10 * s, 0.02 * s) for n, p in zip('xyz', model.body_ipos[i]))

    def edit(self, model, i, values):
        model.body_ipos[i] = values


@catalogue
class Inertia(_Inertial):
    """Other principal moments of inertia about the centre of mass."""
    name = 'inertia'

    def parameters(self, model, i):
        return tuple(Parameter(n, 'kg·m²', I, 0.02 * I, 100 * I, 0.02 * I) for n, I in zip(('ixx', 'iyy', 'izz'), model.body_inertia[i]))

    def edit(self, model, i, values):
        model.body_inertia[i] = values


@catalogue
class LinkLength(Effect):
    """The body hangs farther from, or nearer to, its parent than the model says."""
    name, kind, constants = 'link_length', 'body', True

    def fits(self, model, i):
        return model.body_weldid[i] != 0 and model.body_parentid[i] != 0 and np.linalg.norm(model.body_pos[i]) > 0

    def parameters(self, model, i):
        length = np.linalg.norm(model.body_pos[i])
        return Parameter('metres', 'm', length, 0.1 * length, 10 * length, 0.01 * length),

    def edit(self, model, i, values):
        model.body_pos[i] *= values[0] / np.linalg.norm(model.body_pos[i])

    def write(self, spec, model, i, values):
        spec.body(model.body(i).name).pos = model.body_pos[i] * values[0] / np.linalg.norm(model.body_pos[i])
        return 'mjcf'


# ---------------------------------------------------------------- joints

class _Joint(Effect):
    """An effect on a hinge or slide; scales follow the joint's own inertia."""
    kind = 'joint'

    def fits(self, model, i):
        return model.jnt_type[i] in (HINGE, SLIDE)

    @staticmethod
    def unit(model, i, hinge, slide):
        return hinge if model.jnt_type[i] == HINGE else slide

    @staticmethod
    def scale(model, i):
        return model.dof_M0[model.jnt_dofadr[i]]


@catalogue
class Armature(_Joint):
    """Inertia of rotor and gears, in the joint's own coordinate."""
    name, constants = 'armature', True

    def parameters(self, model, i):
        M = self.scale(model, i)
        return Parameter('armature', self.unit(model, i, 'kg·m²', 'kg'), model.dof_armature[model.jnt_dofadr[i]], 0.0, HUGE * M, 0.01 * M),

    def edit(self, model, i, values):
        model.dof_armature[model.jnt_dofadr[i]] = values[0]

    def write(self, spec, model, i, values):
        spec.joint(model.joint(i).name).armature = values[0]
        return 'mjcf'


@catalogue
class ViscousDamping(_Joint):
    """Force −d·v."""
    name = 'viscous_damping'

    def parameters(self, model, i):
        M, nominal = self.scale(model, i), model.dof_damping[model.jnt_dofadr[i]]
        return Parameter('damping', self.unit(model, i, 'N·m·s/rad', 'N·s/m'), nominal, 0.0, HUGE * M, max(0.02 * M, 0.01 * nominal)),

    def edit(self, model, i, values):
        model.dof_damping[model.jnt_dofadr[i]] = values[0]

    def write(self, spec, model, i, values):
        spec.joint(model.joint(i).name).damping[0] = values[0]
        return 'mjcf'


@catalogue
class QuadraticDamping(_Joint):
    """Force −d·v·|v|."""
    name = 'quadratic_damping'

    def parameters(self, model, i):
        M, nominal = self.scale(model, i), model.dof_dampingpoly[model.jnt_dofadr[i], 0]
        return Parameter('damping2', self.unit(model, i, 'N·m·s²/rad²', 'N·s²/m²'), nominal, 0.0, HUGE * M, max(0.02 * M, 0.01 * nominal)),

    def edit(self, model, i, values):
        model.dof_dampingpoly[model.jnt_dofadr[i], 0] = values[0]

    def write(self, spec, model, i, values):
        spec.joint(model.joint(i).name).damping[1] = values[0]
        return 'mjcf'


@catalogue
class CoulombFriction(_Joint):
    """Dry friction, which holds the joint below its limit."""
    name = 'coulomb_friction'

    def parameters(self, model, i):
        M, nominal = self.scale(model, i), model.dof_frictionloss[model.jnt_dofadr[i]]
        return Parameter('frictionloss', self.unit(model, i, 'N·m', 'N'), nominal, 0.0, HUGE * M, max(0.05 * M, 0.01 * nominal)),

    def edit(self, model, i, values):
        d = model.jnt_dofadr[i]
        if not model.dof_frictionloss[d]:  # else the nominal's own stiffness counts
            model.dof_solref[d], model.dof_solimp[d] = SOLREF_FRICTION, SOLIMP_FRICTION
        model.dof_frictionloss[d] = values[0]

    def write(self, spec, model, i, values):
        joint = spec.joint(model.joint(i).name)
        if not joint.frictionloss:
            joint.solref_friction, joint.solimp_friction = SOLREF_FRICTION, SOLIMP_FRICTION
        joint.frictionloss = values[0]
        return 'mjcf'


@catalogue
class Stiffness(_Joint):
    """Force −k·(q − springref)."""
    name = 'stiffness'

    def parameters(self, model, i):
        M, nominal = self.scale(model, i), model.jnt_stiffness[i]
        return Parameter('stiffness', self.unit(model, i, 'N·m/rad', 'N/m'), nominal, 0.0, HUGE * M, max(0.1 * M, 0.01 * nominal)),

    def edit(self, model, i, values):
        model.jnt_stiffness[i] = values[0]

    def write(self, spec, model, i, values):
        spec.joint(model.joint(i).name).stiffness[0] = values[0]
        return 'mjcf'


@catalogue
class NonlinearStiffness(_Joint):
    """Force −k·(q − springref)³."""
    name = 'nonlinear_stiffness'

    def parameters(self, model, i):
        M, nominal = self.scale(model, i), model.jnt_stiffnesspoly[i, 1]
        return Parameter('stiffness3', self.unit(model, i, 'N·m/rad³', 'N/m³'), nominal, -HUGE * M, HUGE * M, max(0.1 * M, 0.01 * abs(nominal))),

    def edit(self, model, i, values):
        model.jnt_stiffnesspoly[i, 1] = values[0]

    def write(self, spec, model, i, values):
        spec.joint(model.joint(i).name).stiffness[2] = values[0]
        return 'mjcf'


@catalogue
class SpringOffset(_Joint):
    """A constant force in the joint: a spring at rest elsewhere, a tilt, a cable."""
    name = 'spring_offset'

    def parameters(self, model, i):
        M = self.scale(model, i)
        return Parameter('torque', self.unit(model, i, 'N·m', 'N'), 0.0, -HUGE * M, HUGE * M, 0.05 * M),

    def push(self, qfrc, xfrc, model, i, values):
        qfrc[model.jnt_dofadr[i]] += values[0]

    def write(self, spec, model, i, values):
        joint = spec.joint(model.joint(i).name)
        k = joint.stiffness
        if k[0] > 0 and not k[1] and not k[2]:
            joint.springref = joint.springref + angle(spec, model, i, values[0] / k[0])
        else:
            constant_force(spec, f'spring_offset:{joint.name}', values[0], mujoco.mjtTrn.mjTRN_JOINT, joint.name)
        return 'mjcf'


def passive(spec, name, trntype, target):
    """A dcmotor without inputs or electrics: carries cogging and LuGre friction, adds no control."""
    motor = spec.add_actuator(name=name, trntype=trntype, target=target)
    motor.set_to_dcmotor(motorconst=[0.0, 0.0], resistance=1.0, input='none')
    return motor


def constant_force(spec, name, value, trntype, target):
    """A constant actuator force with no control: cogging with no poles."""
    motor = passive(spec, name, trntype, target)
    motor.biasprm[:3] = value, 0.0, np.pi / 2
    return motor


# ---------------------------------------------------------------- actuators

class _Actuator(Effect):
    """An effect on an actuator with one control and an affine force: motors and servos."""
    kind = 'actuator'

    def fits(self, model, i):
        affine = model.actuator_gaintype[i] in (0, 1) and model.actuator_biastype[i] in (0, 1)
        return affine and model.actuator_ctrlnum[i] == 1 and model.actuator_outnum[i] == 1

    @staticmethod
    def strength(model, i):
        """A typical force of the actuator."""
        if model.actuator_forcelimited[i]:
            return abs(model.actuator_forcerange[i]).max()
        if model.actuator_ctrllimited[i]:
            return abs(model.actuator_gainprm[i, 0]) * abs(model.actuator_ctrlrange[i]).max()
        return abs(model.actuator_gainprm[i, 0])

    @staticmethod
    def general(spec, model, i):
        """The spec's actuator, in a notation that can hold any gain and bias."""
        actuator = spec.actuator(model.actuator(i).name)
        actuator.type = mujoco.mjtActuator.mjACTUATOR_GENERAL
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        return actuator


@catalogue
class Gain(_Actuator):
    """The actuator is stronger or weaker by a ratio, feedback of a servo included."""
    name = 'gain'

    def parameters(self, model, i):
        return Parameter('gain', '1', 1.0, 0.01, 100.0, 0.01),

    def edit(self, model, i, values):
        model.actuator_gainprm[i, :3] *= values[0]
        model.actuator_biasprm[i, :3] *= values[0]

    def write(self, spec, model, i, values):
        actuator = self.general(spec, model, i)
        actuator.gainprm[:3] *= values[0]
        actuator.biasprm[:3] *= values[0]
        return 'mjcf'


@catalogue
class Bias(_Actuator):
    """A constant actuator force on top."""
    name = 'bias'

    def parameters(self, model, i):
        F = self.strength(model, i)
        return Parameter('bias', 'N·m' if _turns(model, i) else 'N', 0.0, -HUGE * F, HUGE * F, 0.01 * F),

    def edit(self, model, i, values):
        model.actuator_biasprm[i, 0] += values[0]

    def write(self, spec, model, i, values):
        self.general(spec, model, i).biasprm[0] += values[0]
        return 'mjcf'


def _turns(model, i):
    joint = model.actuator_trnid[i, 0]
    return model.actuator_trntype[i] == int(mujoco.mjtTrn.mjTRN_JOINT) and model.jnt_type[joint] == HINGE


@catalogue
class BackEmf(_Actuator):
    """A force −d·(actuator velocity): back-EMF, or the velocity gain of a servo."""
    name = 'back_emf'

    def parameters(self, model, i):
        nominal, step = -model.actuator_biasprm[i, 2], 0.01 * self.strength(model, i)
        if model.actuator_trntype[i] == int(mujoco.mjtTrn.mjTRN_JOINT):
            step = 0.02 * model.dof_M0[model.jnt_dofadr[model.actuator_trnid[i, 0]]] / model.actuator_gear[i, 0]**2
        return Parameter('damping', 'N·m·s/rad' if _turns(model, i) else 'N·s/m', nominal, 0.0, HUGE * step, max(step, 0.01 * nominal)),

    def edit(self, model, i, values):
        model.actuator_biasprm[i, 2] = -values[0]

    def write(self, spec, model, i, values):
        self.general(spec, model, i).biasprm[2] = -values[0]
        return 'mjcf'


@catalogue
class Saturation(_Actuator):
    """The force is cut off at ± forcerange."""
    name = 'saturation'

    def parameters(self, model, i):
        F = self.strength(model, i)
        return Parameter('forcerange', 'N·m' if _turns(model, i) else 'N', F if model.actuator_forcelimited[i] else np.inf, 1e-4 * F, HUGE * F, 0.02 * F),

    def edit(self, model, i, values):
        model.actuator_forcelimited[i] = True
        model.actuator_forcerange[i] = -values[0], values[0]

    def write(self, spec, model, i, values):
        actuator = spec.actuator(model.actuator(i).name)
        actuator.forcelimited, actuator.forcerange = LIMITED, [-values[0], values[0]]
        return 'mjcf'


@catalogue
class Delay(_Actuator):
    """The command acts later, by any fraction of a time step."""
    name = 'delay'

    def parameters(self, model, i):
        return Parameter('seconds', 's', _nominal_delay(model, i), 0.0, 1.0, 0.001),

    def command(self, signal, model, i, values):
        return replace(signal, delay=values[0])

    def write(self, spec, model, i, values):
        step, actuator = spec.option.timestep, spec.actuator(model.actuator(i).name)
        if values[0] < step:  # MuJoCo rounds a shorter delay up to one step
            spec.option.timestep = step = step / np.ceil(step / values[0])
        actuator.delay, actuator.interp, actuator.nsample = values[0], 1, int(np.ceil(values[0] / step - 1e-9)) + 1
        return 'mjcf'


def _nominal_delay(model, i):
    return max(model.actuator_delay[i], model.opt.timestep) if model.actuator_delay[i] > 0 else 0.0


@catalogue
class Lag(_Actuator):
    """The command passes a first-order filter."""
    name = 'lag'

    def fits(self, model, i):
        return super().fits(model, i) and model.actuator_dyntype[i] == int(mujoco.mjtDyn.mjDYN_NONE)

    def parameters(self, model, i):
        return Parameter('seconds', 's', 0.0, 0.0, 5.0, 0.001),

    def command(self, signal, model, i, values):
        return replace(signal, lag=values[0])

    def write(self, spec, model, i, values):
        actuator = self.general(spec, model, i)
        actuator.dyntype, actuator.actdim = mujoco.mjtDyn.mjDYN_FILTEREXACT, 1
        actuator.dynprm[0] = values[0]
        actuator.actearly = model.opt.integrator != int(mujoco.mjtIntegrator.mjINT_RK4)
        if not actuator.actearly and values[0] < spec.option.timestep:  # Runge-Kutta explodes on a faster filter
            spec.option.timestep /= np.ceil(spec.option.timestep / values[0])
        return 'mjcf'


@catalogue
class DeadZone(_Actuator):
    """Nothing happens below a threshold: of the control (motor) or of the force (servo)."""
    name = 'dead_zone'

    def fits(self, model, i):
        return super().fits(model, i) and (not self._servo(model, i) or model.actuator_trntype[i] == int(mujoco.mjtTrn.mjTRN_JOINT))

    @staticmethod
    def _servo(model, i):
        return model.actuator_biasprm[i, 1:3].any()

    def parameters(self, model, i):
        F = self.strength(model, i)
        if self._servo(model, i):
            return Parameter('half_width', 'N·m' if _turns(model, i) else 'N', 0.0, 0.0, HUGE * F, 0.005 * F),
        u = F / abs(model.actuator_gainprm[i, 0])
        return Parameter('half_width', 'control', 0.0, 0.0, HUGE * u, 0.01 * u),

    def command(self, signal, model, i, values):
        if self._servo(model, i):
            return signal
        return replace(signal, value=np.sign(signal.value) * np.maximum(abs(signal.value) - values[0], 0.0))

    def force(self, models, i, values):
        model = models[0]
        if not self._servo(model, i):
            return None
        gain, bias = (np.array([getattr(m, f'actuator_{prm}')[i, :3] for m in models]) for prm in ('gainprm', 'biasprm'))
        limit = np.array([m.actuator_forcerange[i] if m.actuator_forcelimited[i] else (-np.inf, np.inf) for m in models])
        joint, u, gear = model.actuator_trnid[i, 0], model.actuator_ctrladr[i], model.actuator_gear[i, 0]
        q, d = model.jnt_qposadr[joint], model.jnt_dofadr[joint]

        def absorbed(qpos, qvel, ctrl, time):
            length, velocity = gear * qpos[:, q], gear * qvel[:, d]
            F = gain[:, 0] * ctrl[:, u] + bias[:, 0] + bias[:, 1] * length + bias[:, 2] * velocity
            out = np.zeros_like(qvel)
            out[:, d] = -gear * np.clip(np.clip(F, limit[:, 0], limit[:, 1]), -values[:, 0], values[:, 0])
            return out
        return absorbed

    def write(self, spec, model, i, values):
        return 'none'


# ---------------------------------------------------------------- world

@catalogue
class Gravity(Effect):
    """Another gravity vector: a tilted base, another strength."""
    name, kind = 'gravity', 'world'

    def parameters(self, model, i):
        return tuple(Parameter(n, 'm/s²', g, -30.0, 30.0, 0.05) for n, g in zip('xyz', model.opt.gravity))

    def edit(self, model, i, values):
        model.opt.gravity = values

    def write(self, spec, model, i, values):
        spec.option.gravity = values
        return 'mjcf'


@catalogue
class Wind(Effect):
    """Moving air; felt only where the model has density or viscosity."""
    name, kind = 'wind', 'world'

    def fits(self, model, i):
        return model.opt.density > 0 or model.opt.viscosity > 0

    def parameters(self, model, i):
        return tuple(Parameter(n, 'm/s', w, -100.0, 100.0, 0.1) for n, w in zip('xyz', model.opt.wind))

    def edit(self, model, i, values):
        model.opt.wind = values

    def write(self, spec, model, i, values):
        spec.option.wind = values
        return 'mjcf'


@catalogue
class AirDrag(Effect):
    """A medium of some density around the bodies (MuJoCo's inertia-box drag)."""
    name, kind = 'air_drag', 'world'

    def parameters(self, model, i):
        return Parameter('density', 'kg/m³', model.opt.density, 0.0, 1e5, max(0.1, 0.01 * model.opt.density)),

    def edit(self, model, i, values):
        model.opt.density = values[0]

    def write(self, spec, model, i, values):
        spec.option.density = values[0]
        return 'mjcf'


@catalogue
class TimeStep(Effect):
    """The simulator's own integration step: what it leaves out is no physics."""
    name, kind = 'time_step', 'world'

    def parameters(self, model, i):
        h = model.opt.timestep
        return Parameter('seconds', 's', h, h / 16, h, -h / 2),

    def edit(self, model, i, values):
        model.opt.timestep = values[0]

    def write(self, spec, model, i, values):
        spec.option.timestep = values[0]
        return 'mjcf'


# ---------------------------------------------------------------- contacts

class _Contact(Effect):
    """An effect on all contacts of one geom, which gets priority over its partners.

    A pair's friction is the larger of the two and its solref a mixture, so the
    geom first takes over what its pair has nominally.
    """
    kind = 'geom'

    def fits(self, model, i):
        return self.partner(model, i) is not None

    @staticmethod
    def partner(model, i):
        """The geom this one mostly touches: a static one if any, else that with most friction."""
        body, root = model.geom_bodyid, model.body_weldid
        weld, mine = root[body], root[body[i]]
        meets = ((model.geom_contype[i] & model.geom_conaffinity) | (model.geom_contype & model.geom_conaffinity[i])) != 0
        meets &= weld != mine  # neither itself nor welded to it
        parent = root[model.body_parentid[weld]]
        kin = (parent == mine) & (mine != 0) | (weld == root[model.body_parentid[mine]]) & (weld != 0)
        if not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT):
            meets &= ~kin
        if model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CONTACT) or not meets.any():
            return None
        return int(np.argmax(np.where(meets, model.geom_friction[:, 0] + 1e6 * (weld == 0), -1.0)))

    @classmethod
    def pair(cls, model, i):
        """What geom i's contacts have nominally: condim, friction (3,), solref (2,), solimp (5,)."""
        j = cls.partner(model, i)
        if model.geom_priority[i] != model.geom_priority[j]:
            k = max(i, j, key=lambda g: model.geom_priority[g])
            return model.geom_condim[k], model.geom_friction[k].copy(), model.geom_solref[k].copy(), model.geom_solimp[k].copy()
        a, b = model.geom_solmix[i], model.geom_solmix[j]
        w = a / (a + b) if a + b > 1e-10 else 0.5
        solref = [w * model.geom_solref[i] + (1 - w) * model.geom_solref[j], np.minimum(model.geom_solref[i], model.geom_solref[j])]
        return (max(model.geom_condim[i], model.geom_condim[j]), np.maximum(model.geom_friction[i], model.geom_friction[j]),
                solref[not (model.geom_solref[[i, j], 0] > 0).all()], w * model.geom_solimp[i] + (1 - w) * model.geom_solimp[j])

    def edit(self, model, i, values):
        if model.geom_priority[i] <= model.geom_priority.min():
            condim, model.geom_friction[i], model.geom_solref[i], model.geom_solimp[i] = self.pair(model, i)
            model.geom_condim[i] = condim
            model.geom_priority[i] = model.geom_priority.max() + 1
        self.change(model.geom_friction[i], model.geom_solref[i], values)

    def write(self, spec, model, i, values):
        geom = spec.geom(model.geom(i).name)
        if geom.priority <= model.geom_priority.min():
            geom.condim, geom.friction, geom.solref, geom.solimp = self.pair(model, i)
            geom.priority = model.geom_priority.max() + 1
        self.change(geom.friction, geom.solref, values)
        return 'mjcf'


def _direct(solref):
    """(stiffness, damping) of a solref, in place if it was (timeconst, dampratio)."""
    if solref[0] > 0:
        solref[:] = -1 / (solref[0] * solref[1])**2, -2 / solref[0]
    return -solref


@catalogue
class ContactFriction(_Contact):
    """Sliding friction of all contacts of a geom."""
    name = 'contact_friction'

    def parameters(self, model, i):
        mu = self.pair(model, i)[1][0]
        return Parameter('sliding', '1', mu, 1e-4, 10.0, 0.02 * mu),

    @staticmethod
    def change(friction, solref, values):
        friction[0] = values[0]


@catalogue
class ContactStiffness(_Contact):
    """Stiffness of all contacts of a geom, as an acceleration per depth."""
    name = 'contact_stiffness'

    def parameters(self, model, i):
        k = _direct(self.pair(model, i)[2])[0]
        return Parameter('stiffness', '1/s²', k, 1e-3 * k, 1e3 * k, 0.02 * k),

    @staticmethod
    def change(friction, solref, values):
        solref[:] = -values[0], -_direct(solref)[1]


@catalogue
class ContactDamping(_Contact):
    """Damping of all contacts of a geom, as an acceleration per approach speed."""
    name = 'contact_damping'

    def parameters(self, model, i):
        b = _direct(self.pair(model, i)[2])[1]
        return Parameter('damping', '1/s', b, 1e-3 * b, 1e3 * b, 0.02 * b),

    @staticmethod
    def change(friction, solref, values):
        solref[:] = -_direct(solref)[0], -values[0]


@catalogue
class GroundHeight(Effect):
    """A fixed geom lies higher or lower."""
    name, kind, constants = 'ground_height', 'geom', True

    def fits(self, model, i):
        return model.body_weldid[model.geom_bodyid[i]] == 0 and _Contact.partner(model, i) is not None

    def parameters(self, model, i):
        z = model.geom_pos[i, 2]
        return Parameter('z', 'm', z, z - 10.0, z + 10.0, 0.0005),

    def edit(self, model, i, values):
        model.geom_pos[i, 2] = values[0]

    def write(self, spec, model, i, values):
        spec.geom(model.geom(i).name).pos[2] = values[0]
        return 'mjcf'


# ---------------------------------------------------------------- sensors

class _Sensor(_Joint):
    """An effect on the measurement of a hinge or slide."""

    def write(self, spec, model, i, values):
        return 'measurement'


@catalogue
class SensorBias(_Sensor):
    """The sensor's zero is off: it reads position + offset."""
    name = 'sensor_bias'

    def parameters(self, model, i):
        return Parameter('offset', self.unit(model, i, 'rad', 'm'), 0.0, -10.0, 10.0, 0.002),

    def measure(self, values):
        return values[0], 1.0, 0.0

    def write(self, spec, model, i, values):
        joint, offset = spec.joint(model.joint(i).name), angle(spec, model, i, values[0])
        joint.ref, joint.springref = joint.ref + offset, joint.springref + offset
        joint.range = [bound + offset for bound in joint.range]
        return 'mjcf'


@catalogue
class SensorScale(_Sensor):
    """The sensor reads position · ratio."""
    name = 'sensor_scale'

    def parameters(self, model, i):
        return Parameter('ratio', '1', 1.0, 0.1, 10.0, 0.005),

    def measure(self, values):
        return 0.0, values[0], 0.0


@catalogue
class SensorDelay(_Sensor):
    """The sensor shows what was true some time ago."""
    name = 'sensor_delay'

    def parameters(self, model, i):
        return Parameter('seconds', 's', 0.0, 0.0, 1.0, 0.001),

    def measure(self, values):
        return 0.0, 1.0, values[0]


# ---------------------------------------------------------------- forces from outside

@catalogue
class ExternalForce(Effect):
    """A constant force on a body's centre of mass, in world axes."""
    name, kind = 'external_force', 'body'

    def fits(self, model, i):
        return model.body_weldid[i] == i and i != 0

    def parameters(self, model, i):
        F = 10 * model.body_subtreemass[i]
        return tuple(Parameter(n, 'N', 0.0, -HUGE * F, HUGE * F, 0.005 * F) for n in 'xyz')

    def push(self, qfrc, xfrc, model, i, values):
        xfrc[i, :3] += values

    def write(self, spec, model, i, values):
        return 'none'


@catalogue
class PayloadChange(Mass):
    """Another mass of a body for part of the time."""
    name, timed = 'payload_change', True

    def write(self, spec, model, i, values):
        return 'none'
