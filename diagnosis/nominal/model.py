"""The nominal simulator as its owner has it: an MJCF or URDF file, a gymnasium id, or a
mujoco.MjSpec.

    world = load_world("robot.urdf")
    world = with_gains(world, {"elbow": (20.0, 0.5)})  # its motor becomes a position controller
"""

import os
from collections.abc import Mapping

import mujoco

from diagnosis.common.mujoco_warnings import quiet
from diagnosis.nominal.urdf import UrdfError, is_urdf, urdf_spec
from diagnosis.recordings.layout import is_motor, is_servo, joint_of
from diagnosis.simulation.simulator import World


class ModelError(ValueError):
    """The simulator cannot be used. One line: which, why, and what to do."""

    def __init__(self, message):
        super().__init__(" ".join(str(message).split()))


def load_world(model, skip_meshes: bool = False) -> World:
    """The nominal simulator of an MJCF or URDF path, a gymnasium id, or an MjSpec.

    skip_meshes: go on without those meshes of a URDF that are not found. Raises ModelError.
    """
    do = "correct the file"
    if isinstance(model, mujoco.MjSpec):
        what, make = "the given MjSpec", World
    elif os.path.isfile(what := os.fspath(model)) or what.endswith((".xml", ".urdf")):
        if not os.path.isfile(what):
            raise ModelError(f"{what}: no such model file; check the path")
        make = _from_urdf(skip_meshes) if is_urdf(what) else World.load
    else:
        make = World.from_env
        do = "give the id of a gymnasium MuJoCo environment, or --model file.xml"
    try:
        world = make(model if isinstance(model, mujoco.MjSpec) else what)
    except UrdfError as error:
        raise ModelError(error) from None
    except (
        ValueError,
        OSError,
        TypeError,
        AttributeError,
        ImportError,
        mujoco.FatalError,
    ) as error:
        raise ModelError(f"{what}: the model does not load ({error}); {do}") from None
    if world.model.nq == 0:
        raise ModelError(
            f"{what}: the model has no joints, so nothing in it can move; give the model of the "
            f"recorded "
            "mechanism"
        )
    return world


def _from_urdf(skip_meshes):
    """A maker of the World of a URDF file."""

    def make(path):
        with quiet():
            world = World(urdf_spec(path, skip_meshes))
            mujoco.MjSpec.from_string(world.corrected_xml({})[0]).compile()
        return world

    return make


def motor_joints(model: mujoco.MjModel) -> list[str]:
    """The hinges and slides that a motor acts on."""
    joints = (joint_of(model, a) for a in range(model.nactuator) if is_motor(model, a))
    return [joint for joint in joints if joint is not None]


def gains_of(words: Mapping[str, float | Mapping[str, float] | None], model) -> dict:
    """{joint: (kp, kd)} of {"kp": ..., "kd": ...}, each one number for every motor or {joint:
    number}.

    Raises ModelError where there is no such motor, or nothing to be a gain of.
    """
    kp, kd = words.get("kp"), words.get("kd")
    if kp is None and kd is None:
        return {}
    if kp is None:
        raise ModelError("--kd without --kp; give the stiffness of the position controllers too")
    motors = motor_joints(model)
    servos = {joint_of(model, a) for a in range(model.nactuator) if is_servo(model, a)}
    if not motors:
        has = "has position servos, with gains of their own" if servos else "has no motors"
        raise ModelError(f"--kp: the model {has}; leave --kp and --kd out")
    out = {}
    for joint in kp if isinstance(kp, Mapping) else motors:
        values = [_one(name, gain, joint) for name, gain in (("kp", kp), ("kd", kd))]
        if joint not in motors:
            why = "is moved by a position servo already" if joint in servos else "has no motor"
            raise ModelError(f"--kp: joint {joint!r} {why}; motors act on {', '.join(motors)}")
        if min(values) < 0:
            raise ModelError(f"--kp, --kd: joint {joint!r}: a gain cannot be negative")
        out[joint] = tuple(values)
    for joint in kd if isinstance(kd, Mapping) else ():
        if joint not in out:
            raise ModelError(f"--kd: joint {joint!r} has no --kp; give both")
    return out


def _one(name, gain, joint):
    """The gain of one joint; kd is 0 where nothing is said. Raises ModelError."""
    if isinstance(gain, Mapping):
        if joint not in gain and name == "kp":
            raise ModelError(f"--kp: nothing for joint {joint!r}")
        return float(gain.get(joint, 0.0))
    return float(gain or 0.0)


def together(given: Mapping, recordings) -> dict:
    """The gains given with those that recordings carry, {joint: (kp, kd)}. Raises ModelError where
    they disagree."""
    out = {joint: (value, "--kp and --kd say") for joint, value in given.items()}
    for recording in recordings:
        for joint, gains in recording.gains.items():
            if "kp" not in gains:
                raise ModelError(
                    f"{recording.name}: 'kd:{joint}' without 'kp:{joint}'; give both columns"
                )
            value = gains["kp"], gains.get("kd", 0.0)
            before = out.setdefault(joint, (value, f"{recording.name} says"))
            if value != before[0]:
                raise ModelError(
                    f"{recording.name}: kp {value[0]:g}, kd {value[1]:g} at joint {joint!r}, "
                    f"where {before[1]} "
                    f"{before[0][0]:g}, {before[0][1]:g}; diagnose runs of one gain at a time"
                )
    return {joint: value for joint, (value, _) in out.items()}


def with_gains(world: World, gains: Mapping[str, tuple[float, float]]) -> World:
    """The World whose motors on these joints are position controllers: torque = kp (target - q) -
    kd q'.

    What a motor's control was limited to now limits its force; its control is the target, in rad or
    m.
    """
    if not gains:
        return world
    spec, model = world.spec.copy(), world.model
    for a in range(model.nactuator):
        joint = joint_of(model, a)
        if joint not in gains or not is_motor(model, a):
            continue
        motor, (kp, kd) = spec.actuator(model.actuator(a).name), gains[joint]
        gear, gain = float(model.actuator_gear[a, 0]), float(model.actuator_gainprm[a, 0])
        if model.actuator_ctrllimited[a] and not model.actuator_forcelimited[a]:
            motor.forcerange = sorted(gain * model.actuator_ctrlrange[a])
            motor.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        motor.ctrlrange, motor.ctrllimited = [0, 0], mujoco.mjtLimited.mjLIMITED_FALSE
        motor.type = mujoco.mjtActuator.mjACTUATOR_GENERAL
        motor.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        motor.gainprm[0] = kp / gear  # the control is the joint's target, not the motor's
        motor.biasprm[:3] = 0, -kp / gear**2, -kd / gear**2
    return World(spec)
