"""Fields of an MJCF model that a fit may move, named as the benchmark names them."""

from collections.abc import Callable
from dataclasses import dataclass

import mujoco

FRICTION = ([0.004, 1], [0.999, 0.9999, 0.001])  # solref and solimp that hold without creep
USUAL = ("mass", "armature", "viscous_damping", "coulomb_friction", "gain")


@dataclass(frozen=True)
class Field:
    """A number of the model. set(spec, value) writes it; low and high bound it."""

    effect: str
    kind: str
    name: str
    parameter: str
    nominal: float
    low: float
    high: float
    set: Callable

    @property
    def key(self):
        """A name that no other field has."""
        return f"{self.effect} {self.name} {self.parameter}"


def fields(spec, usual=False):
    """Every Field of a spec; usual: only those of USUAL."""
    model = spec.compile()
    found = [*of_bodies(model), *of_joints(model), *of_drives(model), *of_world(model)]
    return [f for f in found if f.effect in USUAL] if usual else found


def of_bodies(model):
    """Masses (with inertias along), centres of mass and inertias."""
    for index in range(1, model.nbody):
        name, mass = model.body(index).name, float(model.body_mass[index])
        inertia = model.body_inertia[index].copy()

        def heavier(spec, value, name=name, mass=mass, inertia=inertia):
            spec.body(name).mass = value
            spec.body(name).inertia = inertia * value / mass

        yield Field("mass", "body", name, "mass", mass, 0.3 * mass, 3 * mass, heavier)
        for k, axis in enumerate("xyz"):

            def moved(spec, value, name=name, k=k):
                spec.body(name).ipos[k] = value

            now = float(model.body_ipos[index, k])
            yield Field("center_of_mass", "body", name, axis, now, now - 0.2, now + 0.2, moved)


def of_joints(model):
    """Damping, friction, armature and springs of hinges and slides."""
    for index in range(model.njnt):
        if model.jnt_type[index] == int(mujoco.mjtJoint.mjJNT_FREE):
            continue
        name, dof = model.joint(index).name, model.jnt_dofadr[index]
        inertia = float(model.dof_M0[dof])

        def armature(spec, value, name=name):
            spec.joint(name).armature = value

        def damping(spec, value, name=name):
            spec.joint(name).damping[0] = value

        def friction(spec, value, name=name):
            joint = spec.joint(name)
            joint.frictionloss = value
            joint.solref_friction[:], joint.solimp_friction[:3] = FRICTION

        def stiffness(spec, value, name=name):
            spec.joint(name).stiffness[0] = value

        for effect, parameter, now, most, write in (
            ("armature", "armature", model.dof_armature[dof], 3 * inertia, armature),
            ("viscous_damping", "damping", model.dof_damping[dof], 30 * inertia, damping),
            (
                "coulomb_friction",
                "frictionloss",
                model.dof_frictionloss[dof],
                50 * inertia,
                friction,
            ),
            ("stiffness", "stiffness", model.jnt_stiffness[index], 300 * inertia, stiffness),
        ):
            now = float(now)
            yield Field(effect, "joint", name, parameter, now, 0.0, 3 * now + most, write)


def of_drives(model):
    """Gain (a ratio) and bias of every actuator."""
    for index in range(model.nu):
        name = model.actuator(index).name
        gains, biases = model.actuator_gainprm[index].copy(), model.actuator_biasprm[index].copy()

        def gain(spec, value, name=name, gains=gains, biases=biases):
            spec.actuator(name).gainprm[0] = value * gains[0]
            if biases[1]:
                spec.actuator(name).biasprm[1] = value * biases[1]

        def bias(spec, value, name=name):
            spec.actuator(name).biasprm[0] = value

        most = 0.5 * float(model.actuator_forcerange[index, 1])
        yield Field("gain", "actuator", name, "gain", 1.0, 0.3, 2.5, gain)
        yield Field("bias", "actuator", name, "bias", float(biases[0]), -most, most, bias)


def of_world(model):
    """Gravity, and the ground's sliding friction."""
    for k, axis in enumerate("xyz"):

        def gravity(spec, value, k=k):
            spec.option.gravity[k] = value

        now = float(model.opt.gravity[k])
        yield Field("gravity", "world", "world", axis, now, now - 5, now + 5, gravity)
    for index in range(model.ngeom):
        name = model.geom(index).name
        if model.geom_type[index] == int(mujoco.mjtGeom.mjGEOM_PLANE):

            def sliding(spec, value, name=name):
                spec.geom(name).friction[0] = value

            now = float(model.geom_friction[index, 0])
            yield Field("contact_friction", "geom", name, "sliding", now, 0.0, 3.0, sliding)
