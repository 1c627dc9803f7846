"""Effects of the world around the bodies: gravity, air, contacts, the simulator's own clock."""

import mujoco
import numpy as np

from diagnosis.effects.base import Effect, Parameter, catalogue, displace, runge_kutta

FACTORS = (
    0.25,
    0.5,
    2.0,
    4.0,
)  # of a contact's stiffness or damping, whose effect soon is not in proportion


@catalogue
class Gravity(Effect):
    """Another gravity vector, m/s²: a tilted base, another strength. Source: MuJoCo's option."""

    name, kinds, simplicity = "gravity", ("world",), 0

    def parameters(self, model, i):
        return tuple(
            Parameter(n, "m/s²", g, -30.0, 30.0, 0.05) for n, g in zip("xyz", model.opt.gravity)
        )

    def edit(self, model, i, values):
        model.opt.gravity = values

    def write(self, spec, model, i, values):
        spec.option.gravity = values
        return "mjcf"


@catalogue
class Wind(Effect):
    """Moving air, m/s; felt only where the model has density or viscosity. Source: MuJoCo's
    option."""

    name, kinds = "wind", ("world",)

    def fits(self, model, i):
        return model.opt.density > 0 or model.opt.viscosity > 0

    def parameters(self, model, i):
        return tuple(
            Parameter(n, "m/s", w, -100.0, 100.0, 0.1) for n, w in zip("xyz", model.opt.wind)
        )

    def far(self, model, i, recordings):
        """Breezes and gusts along every axis: drag grows with the square of the speed, and small
        ones say little."""
        return [
            tuple(model.opt.wind + speed * axis)
            for speed in (3.0, -3.0, 10.0, -10.0)
            for axis in np.eye(3)
        ]

    def edit(self, model, i, values):
        model.opt.wind = values

    def write(self, spec, model, i, values):
        spec.option.wind = values
        return "mjcf"


@catalogue
class AirDrag(Effect):
    """A medium of some density around the bodies, kg/m³.

    Force −ρ A w|w|/2 on each face of the box of a body's inertia. Source: MuJoCo's inertia-box
    drag.
    """

    name, kinds = "air_drag", ("world",)

    def parameters(self, model, i):
        return (
            Parameter(
                "density", "kg/m³", model.opt.density, 0.0, 1e5, max(0.1, 0.01 * model.opt.density)
            ),
        )

    def edit(self, model, i, values):
        model.opt.density = values[0]

    def write(self, spec, model, i, values):
        spec.option.density = values[0]
        return "mjcf"


@catalogue
class TimeStep(Effect):
    """The simulator's own integration step, s: what it leaves out is no physics, and in every
    simulator. With another step Euler's method is implicit in the speeds of drives as it is in
    those of joints: or the same damping would differ by where it is."""

    # no physics that a name could be spent on: it costs nothing, and all else is compared with it
    name, kinds, numerical, simplicity = "time_step", ("world",), True, -1

    def parameters(self, model, i):
        h = model.opt.timestep
        # a quarter leaves a quarter of the error; finer is dear, as Runge-Kutta's method is
        finest = h / 2 if runge_kutta(model) else h / 4
        return (Parameter("seconds", "s", h, finest, h, -h / 4),)

    def probes(self, model, i, recordings):
        return model.opt.timestep / np.array([[2.0]])

    def edit(self, model, i, values):
        self._set(model.opt, values)

    def write(self, spec, model, i, values):
        self._set(spec.option, values)
        return "mjcf"

    @staticmethod
    def _set(option, values):
        option.timestep = values[0]
        if option.integrator == mujoco.mjtIntegrator.mjINT_EULER:
            option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST


# ---------------------------------------------------------------- contacts


def touchable(model, i):
    """Which geoms (ngeom,) geom i can collide with, by MuJoCo's rules."""
    weld, parent = model.body_weldid[model.geom_bodyid], model.body_weldid[model.body_parentid]
    meets = (
        (model.geom_contype[i] & model.geom_conaffinity)
        | (model.geom_contype & model.geom_conaffinity[i])
    ) != 0
    meets &= weld != weld[i]
    if not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT):
        # parent and child pass through each other, unless the parent is the world
        meets &= ~(
            (weld != 0) & (weld[i] != 0) & ((parent[weld] == weld[i]) | (parent[weld[i]] == weld))
        )
    return meets & (not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CONTACT))


def collides(model):
    """Whether anything in a model can touch."""
    geoms = any(touchable(model, i).any() for i in range(model.ngeom))
    return bool(model.npair or model.nflex or geoms)


class ContactEffect(Effect):
    """An effect on all contacts of one geom, which gets priority over its partners.

    A pair's friction is the larger of the two and its solref a mixture, so the geom first takes
    over what its pair has nominally.
    """

    kinds, acts_through = ("geom",), "contact"

    def fits(self, model, i):
        return self.partner(model, i) is not None

    @staticmethod
    def partner(model, i):
        """The geom this one mostly touches, or None: a static one if any, else that with most
        friction."""
        meets = touchable(model, i)
        if not meets.any():
            return None
        static = model.body_weldid[model.geom_bodyid] == 0
        return int(np.argmax(np.where(meets, model.geom_friction[:, 0] + 1e6 * static, -1.0)))

    def twin(self, model, i):
        return model.geom(self.partner(model, i)).name

    @classmethod
    def pair(cls, model, i):
        """What geom i's contacts have nominally: condim, friction (3,), solref (2,), solimp
        (5,)."""
        condim, friction, solref, solimp = cls._mixed(model, i)
        if not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_REFSAFE) and solref[0] > 0:
            solref[0] = max(solref[0], 2 * model.opt.timestep)  # as MuJoCo does
        return condim, friction, solref, solimp

    @classmethod
    def _mixed(cls, model, i):
        j = cls.partner(model, i)
        condim, friction, solref, solimp = (
            getattr(model, f"geom_{f}")[[i, j]] for f in ("condim", "friction", "solref", "solimp")
        )
        if model.geom_priority[i] != model.geom_priority[j]:
            k = int(model.geom_priority[j] > model.geom_priority[i])
            return condim[k], friction[k], solref[k], solimp[k]
        mix = model.geom_solmix[[i, j]]
        w = (mix / mix.sum() if mix.sum() > 1e-10 else np.full(2, 0.5))[:, None]
        mixed = (w * solref).sum(axis=0) if (solref[:, 0] > 0).all() else solref.min(axis=0)
        return condim.max(), friction.max(axis=0), mixed, (w * solimp).sum(axis=0)

    def edit(self, model, i, values):
        if model.geom_priority[i] <= model.geom_priority.min():
            condim, model.geom_friction[i], model.geom_solref[i], model.geom_solimp[i] = self.pair(
                model, i
            )
            model.geom_condim[i] = condim
            model.geom_priority[i] = model.geom_priority.max() + 1
        self.change(model.geom_friction[i], model.geom_solref[i], values)

    def write(self, spec, model, i, values):
        geom, so_far = (
            spec.geom(model.geom(i).name),
            spec.copy().compile(),
        )  # with what was written of other contacts
        if geom.priority <= so_far.geom_priority.min():
            geom.condim, geom.friction, geom.solref, geom.solimp = self.pair(
                so_far, so_far.geom(geom.name).id
            )
            geom.priority = so_far.geom_priority.max() + 1
        self.change(geom.friction, geom.solref, values)
        return "mjcf"


def _direct(solref):
    """(stiffness, damping) of a solref, in place if it was (timeconst, dampratio)."""
    if solref[0] > 0:
        solref[:] = -1 / (solref[0] * solref[1]) ** 2, -2 / solref[0]
    return -solref


@catalogue
class ContactFriction(ContactEffect):
    """Sliding friction μ of all contacts of a geom: |F_t| ≤ μ F_n. Source: MuJoCo's geom
    friction."""

    name, simplicity = "contact_friction", 0

    def parameters(self, model, i):
        mu = self.pair(model, i)[1][0]
        return (Parameter("sliding", "1", mu, min(mu, 1e-4), 10.0, 0.02 * mu or 0.02),)

    def far(self, model, i, recordings):
        return [
            (factor * (self.pair(model, i)[1][0] or 1.0),) for factor in (0.5, 0.2)
        ]  # what sticks has no gradient

    @staticmethod
    def change(friction, solref, values):
        friction[0] = values[0]


@catalogue
class ContactStiffness(ContactEffect):
    """Stiffness of all contacts of a geom, as an acceleration per depth, 1/s². Source:
    solref[0]."""

    name = "contact_stiffness"

    def parameters(self, model, i):
        k = _direct(self.pair(model, i)[2])[0]
        return (Parameter("stiffness", "1/s²", k, 1e-3 * k, 1e3 * k, 0.02 * k),)

    def far(self, model, i, recordings):
        return [(factor * _direct(self.pair(model, i)[2])[0],) for factor in FACTORS]

    @staticmethod
    def change(friction, solref, values):
        solref[:] = -values[0], -_direct(solref)[1]


@catalogue
class ContactDamping(ContactEffect):
    """Damping of all contacts of a geom, an acceleration per approach speed, 1/s. Source:
    solref[1]."""

    name = "contact_damping"

    def parameters(self, model, i):
        b = _direct(self.pair(model, i)[2])[1]
        return (Parameter("damping", "1/s", b, 1e-3 * b, 1e3 * b, 0.02 * b),)

    def far(self, model, i, recordings):
        return [(factor * _direct(self.pair(model, i)[2])[1],) for factor in FACTORS]

    @staticmethod
    def change(friction, solref, values):
        solref[:] = -_direct(solref)[0], -values[0]


@catalogue
class GroundHeight(Effect):
    """A fixed geom lies higher or lower: z of its position in its body, m."""

    name, kinds, constants, acts_through = "ground_height", ("geom",), True, "contact"

    def fits(self, model, i):
        return (
            model.body_weldid[model.geom_bodyid[i]] == 0
            and ContactEffect.partner(model, i) is not None
        )

    def parameters(self, model, i):
        z = model.geom_pos[i, 2]
        return (Parameter("z", "m", z, z - 10.0, z + 10.0, 0.0005),)

    def far(self, model, i, recordings):
        small = model.geom_rbound[touchable(model, i) & (model.geom_rbound > 0)].min(initial=1.0)
        return [(model.geom_pos[i, 2] + share * small,) for share in (-0.1, -0.03, 0.03, 0.1)]

    def edit(self, model, i, values):
        model.geom_pos[i, 2] = values[0]

    def write(self, spec, model, i, values):
        displace(
            spec, "geom", model.geom(i).name, np.array([0.0, 0.0, values[0] - model.geom_pos[i, 2]])
        )
        return "mjcf"
