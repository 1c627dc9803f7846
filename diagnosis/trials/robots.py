"""Robots that are drawn, not listed: kinematic trees of hinges, slides and free bases.

    robot = draw_robot(np.random.default_rng(7), DEVELOPMENT)
    mujoco.MjModel.from_xml_string(to_mjcf(robot))

A `Robot` holds every number of one machine. A trial has two of them: the nominal one, written as
MJCF for the tool that is tested, and the true one, simulated by `truth.py`.
"""

from dataclasses import dataclass, replace

import mujoco
import numpy as np

from diagnosis.trials.mjcf import to_mjcf

TOUCHES = ("ground", "free base", "stops")
TOUCHING_STEP = 0.002  # s, at most, where contacts are to be resolved
REFINEMENT = 10  # substeps of the truth in one nominal step


@dataclass(frozen=True)
class Link:
    """One body and the joint that carries it. Lengths m, angles rad, masses kg, SI throughout.

    joint: "hinge", "slide", or "free" (then axis and the joint's own values mean nothing).
    position, quaternion: of the body in its parent's frame. The link runs `length` along local z.
    inertia: diagonal, about the centre of mass, axes of the body frame.
    """

    name: str
    parent: int  # index of the parent link, -1 for the world
    joint: str
    axis: tuple
    position: tuple
    quaternion: tuple
    length: float
    radius: float
    mass: float
    center_of_mass: tuple
    inertia: tuple
    armature: float = 0.0
    damping: float = 0.0
    frictionloss: float = 0.0
    stiffness: float = 0.0
    rest: float = 0.0  # springref
    range: tuple | None = None
    foot: bool = False  # a sphere at its tip that meets the ground

    @property
    def joint_name(self):
        return self.name.replace("link", "joint")


@dataclass(frozen=True)
class Actuator:
    """A drive on the joint of link `link`.

    kind: "motor": force = gain·u + bias; "position": gain·(kp·(u − q) − kv·v) + bias;
    "velocity": gain·kv·(u − v) + bias. limit: largest force, N·m or N.
    """

    name: str
    link: int
    kind: str
    kp: float
    kv: float
    limit: float
    gain: float = 1.0
    bias: float = 0.0


@dataclass(frozen=True)
class Robot:
    """The tree (parents before children), its drives, and the world around it."""

    links: tuple
    actuators: tuple
    step: float  # s, of the nominal simulator
    substep: float  # s, of the true system
    integrator: str  # of the nominal simulator
    gravity: tuple = (0.0, 0.0, -9.81)
    ground: bool = False
    sliding: float = 0.8  # friction coefficient of the ground
    density: float = 0.0  # kg/m^3, of the air
    wind: tuple = (0.0, 0.0, 0.0)
    contact_stiffness: float = 2.0e4  # 1/s^2, MuJoCo's solref convention
    contact_damping: float = 250.0  # 1/s
    ground_height: float = 0.0

    def with_link(self, index, **values):
        """A copy with some values of one link replaced."""
        links = list(self.links)
        links[index] = replace(links[index], **values)
        return replace(self, links=tuple(links))

    def with_actuator(self, index, **values):
        """A copy with some values of one actuator replaced."""
        actuators = list(self.actuators)
        actuators[index] = replace(actuators[index], **values)
        return replace(self, actuators=tuple(actuators))


@dataclass(frozen=True)
class Settings:
    """Ranges that robots and trials are drawn from; "loguniform" where a range spans decades.

    Probabilities are in [0, 1]. Times s, lengths m, densities kg/m^3, frequencies rad/s.
    """

    name: str
    joints: tuple = (1, 4)
    slides: float = 0.2
    touching: float = 0.5  # share of trials in which a contact or a stop acts
    touches: tuple = (0.4, 0.3, 0.3)  # of these: feet of a fixed base, of a free one, joint ranges
    branching: float = 0.2  # chance that a link hangs at an earlier one than the last
    length: tuple = (0.10, 0.45)
    density: tuple = (400.0, 3000.0)
    rotor: tuple = (0.05, 0.8)  # armature over the joint's own inertia
    settling: tuple = (0.4, 4.0)  # inertia over damping
    passive: float = 0.15  # joints without a drive
    drives: tuple = (0.5, 0.3, 0.2)  # motors, position servos, velocity servos
    low_gain: tuple = (4.0, 10.0)  # bandwidth of servos and controllers
    high_gain: tuple = (12.0, 35.0)
    high_gains: float = 0.4
    tilted: float = 0.3  # chance that a frame is turned by an odd angle
    steps: tuple = (0.002, 0.004)
    train_runs: int = 4
    held_out_runs: int = 2
    run_seconds: float = 3.0
    row_seconds: tuple = (0.004, 0.008, 0.01)
    noise: tuple = (2e-4, 1e-3)  # rad, or a third of it in m
    size_over_noise: tuple = (2.0, 60.0)


DEVELOPMENT = Settings(name="development")
FINAL = Settings(
    name="final",
    joints=(1, 12),
    slides=0.25,
    touching=0.34,
    touches=(0.35, 0.35, 0.3),
    branching=0.3,
    length=(0.06, 0.6),
    density=(250.0, 5000.0),
    rotor=(0.02, 1.2),
    settling=(0.25, 6.0),
    passive=0.2,
    drives=(0.45, 0.35, 0.2),
    low_gain=(3.0, 9.0),
    high_gain=(10.0, 45.0),
    high_gains=0.5,
    tilted=0.5,
    steps=(0.001, 0.002, 0.004),
    row_seconds=(0.004, 0.008, 0.012, 0.02),
    noise=(5e-5, 2e-3),
    size_over_noise=(1.5, 100.0),
)


def loguniform(rng, low, high):
    """A number between low and high, uniform in its logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def draw_robot(rng, settings, touch=None):
    """Draw one Robot. The tree first, its inertias and gains from its own mass matrix after.

    touch: one of TOUCHES, what the robot may touch; None for nothing.
    """
    count = int(np.floor(loguniform(rng, settings.joints[0], settings.joints[1] + 0.999)))
    free = touch == "free base"
    ground = touch in ("ground", "free base")
    count = max(count, 2) if free else count
    links = []
    for index in range(count):
        links.append(_draw_link(rng, settings, links, free and index == 0))
    if ground:
        parents = {link.parent for link in links}
        links = [replace(k, foot=i not in parents) for i, k in enumerate(links)]
    step = float(rng.choice(settings.steps))
    step = min(step, TOUCHING_STEP) if touch else step
    integrator = str(rng.choice(("Euler", "implicitfast", "RK4"), p=(0.4, 0.4, 0.2)))
    robot = Robot(tuple(links), (), step, step / REFINEMENT, integrator, ground=ground)
    robot = _lift(robot)
    return _equip(rng, settings, robot, touch == "stops")


def _draw_link(rng, settings, links, free):
    index = len(links)
    parent = index - 1
    if index > 1 and rng.random() < settings.branching:
        parent = int(rng.integers(index))
    length = loguniform(rng, *settings.length)
    radius = length * rng.uniform(0.06, 0.2)
    mass = loguniform(rng, *settings.density) * np.pi * radius**2 * length
    across = mass * (length**2 / 12 + radius**2 / 4)
    shape = rng.uniform(0.8, 1.2, 2)
    inertia = np.array([across * shape[0], across * shape[1], mass * radius**2 / 2])
    inertia[2] = np.clip(inertia[2], 1.05 * abs(inertia[0] - inertia[1]), inertia[:2].sum())
    center = (0.05 * length * rng.normal(), 0.05 * length * rng.normal())
    center = (*center, length * rng.uniform(0.3, 0.7))
    quaternion = _orientation(rng, settings)
    joint, axis = "free", (0.0, 0.0, 1.0)
    if not free:
        joint = "slide" if rng.random() < settings.slides else "hinge"
        weights = (0.4, 0.4, 0.2) if joint == "hinge" else (0.35, 0.35, 0.3)
        axis = tuple(np.eye(3)[rng.choice(3, p=weights)].tolist())
    position = (0.0, 0.0, 0.0) if parent < 0 else (0.0, 0.0, round(links[parent].length, 5))
    rounded = lambda values: tuple(float(f"{v:.5g}") for v in values)
    return Link(
        name=f"link{index}",
        parent=parent,
        joint=joint,
        axis=axis,
        position=position,
        quaternion=rounded(quaternion),
        length=round(length, 5),
        radius=round(radius, 5),
        mass=float(f"{mass:.5g}"),
        center_of_mass=rounded(center),
        inertia=rounded(inertia),
    )


def _orientation(rng, settings):
    """A unit quaternion: a quarter turn about an axis, or in some robots an odd angle."""
    axis = np.eye(3)[rng.integers(3)]
    angle = np.pi / 2 * rng.integers(4)
    if rng.random() < settings.tilted:
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        angle = rng.uniform(0, np.pi)
    return np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * axis])


def _lift(robot):
    """Raise the first link so that a ground, where there is one, is reached but not sunk into."""
    data = mujoco.MjData(model := mujoco.MjModel.from_xml_string(to_mjcf(robot)))
    mujoco.mj_forward(model, data)
    lowest = 0.0
    for index, link in enumerate(robot.links):
        body = model.body(link.name).id
        tip = data.xpos[body] + data.xmat[body].reshape(3, 3) @ [0, 0, link.length]
        reach = link.radius if link.foot else 0.0
        lowest = min(lowest, tip[2] - reach, data.xpos[body][2] - reach)
    free = robot.links[0].joint == "free"
    height = round(float(-lowest + (0.002 if free else 0.01 * robot.links[-1].length)), 5)
    return robot.with_link(0, position=(0.0, 0.0, height))


def joint_scales(robot, rng, draws=24):
    """(inertia, load) per link: mean effective inertia and RMS gravity load at random poses.

    inertia: kg·m² or kg, 1/(M⁻¹)_jj; load: N·m or N. NaN for a free base.
    """
    model = mujoco.MjModel.from_xml_string(to_mjcf(robot))
    data = mujoco.MjData(model)
    mobility, load = [], []
    for _ in range(draws):
        data.qpos[:] = model.qpos0
        for link in robot.links:
            if link.joint != "free":
                joint = model.joint(link.joint_name)
                data.qpos[joint.qposadr[0]] = rng.uniform(-1, 1) * (
                    0.5 * link.length if link.joint == "slide" else 1.0
                )
        mujoco.mj_forward(model, data)
        inverse = np.zeros((model.nv, model.nv))
        mujoco.mj_solveM(model, data, inverse, np.eye(model.nv))
        mobility.append(np.diag(inverse).copy())
        load.append(data.qfrc_bias.copy())
    dofs = [model.joint(k.joint_name).dofadr[0] if k.joint != "free" else None for k in robot.links]
    inertia, load = 1 / np.mean(mobility, 0), np.sqrt(np.mean(np.square(load), 0))
    pick = lambda values: np.array([np.nan if d is None else values[d] for d in dofs])
    return pick(inertia), pick(load)


def _equip(rng, settings, robot, stopped):
    """Rotors, damping, friction, springs, ranges and drives, scaled by what each joint moves."""
    inertia, load = joint_scales(robot, rng)
    digits = lambda value: float(f"{value:.4g}")
    actuators = []
    fast = rng.random() < settings.high_gains
    for index, link in enumerate(robot.links):
        if link.joint == "free":
            continue
        passive = rng.random() < settings.passive and len(robot.links) > 1
        turn = 1.0 if link.joint == "hinge" else 0.15  # typical travel, rad or m
        values = {}
        rotor = 0.0
        if not passive:
            rotor = inertia[index] * loguniform(rng, *settings.rotor)
            rotor = max(rotor, 1e-4 if link.joint == "hinge" else 1e-2)
            values["armature"] = digits(rotor)
        total = inertia[index] + rotor
        values["damping"] = digits(total / loguniform(rng, *settings.settling))
        bandwidth = loguniform(rng, *(settings.high_gain if fast else settings.low_gain))
        if rng.random() < 0.3:
            share = rng.uniform(0.02, 0.1)
            values["frictionloss"] = digits(share * (load[index] + total * 10 * turn))
        sprung = link.joint == "slide" or rng.random() < 0.5 if passive else rng.random() < 0.15
        if sprung:
            values["stiffness"] = digits(total * rng.uniform(3, 12) ** 2)
            if link.joint == "slide":  # the spring carries the load
                values["stiffness"] = digits(
                    max(values["stiffness"], load[index] / (0.3 * link.length))
                )
        if stopped:
            values["range"] = (
                round(-turn * rng.uniform(0.3, 0.9), 4),
                round(turn * rng.uniform(0.3, 0.9), 4),
            )
        robot = robot.with_link(index, **values)
        if passive:
            continue
        kind = str(rng.choice(("motor", "position", "velocity"), p=settings.drives))
        kp = total * bandwidth**2
        kv = 2 * rng.uniform(0.5, 1.1) * total * bandwidth
        limit = 3.0 * load[index] + kp * turn * 1.5
        number = link.name.removeprefix("link")
        actuators.append(
            Actuator(f"drive{number}", index, kind, digits(kp), digits(kv), digits(limit))
        )
    return replace(robot, actuators=tuple(actuators))
