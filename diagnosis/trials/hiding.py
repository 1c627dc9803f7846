"""What a trial hides: effects and laws, sized by what each joint of the robot usually does.

    hidden = hide("cogging", place, size, robots, usage, rng)

Each function takes the two robots (nominal, true) and returns them changed, with the laws and the
true values. `size` is relative: about the share of the joint's usual force that is hidden.
"""

from dataclasses import asdict, dataclass, replace

import numpy as np

from diagnosis.trials import laws as L


@dataclass(frozen=True)
class Item:
    """One hidden thing, as the answer holds it.

    effect: the catalogue's name, or "unknown" with `law` the class that made it.
    place: {"kind", "name"}; parameters: true values, absolute, in the contract's signs.
    needs: for "unknown", the variables ("velocity:joint1", "time") that an answer has to give.
    removed: the nominal model has too much of it. required: False for values that the nominal
    model has wrong because it was fitted without the rest.
    """

    effect: str
    place: dict
    parameters: dict
    law: str = ""
    needs: tuple = ()
    removed: bool = False
    required: bool = True

    def to_json(self):
        """A dict that json writes."""
        return asdict(self) | {"needs": list(self.needs)}


@dataclass(frozen=True)
class Usage:
    """What the nominal robot does in the experiment, per link (NaN for a free base).

    spread: standard deviation of position; speed, load: RMS of speed and of the drive's or
    gravity's force; inertia: effective; quantiles: (links, 101) of position; torque_quantiles:
    (links, 101) of the drive's force, absolute; control: RMS of control per actuator.
    """

    spread: np.ndarray
    speed: np.ndarray
    load: np.ndarray
    inertia: np.ndarray
    quantiles: np.ndarray
    torque_quantiles: np.ndarray
    control: np.ndarray


@dataclass(frozen=True)
class Spot:
    """Where something is hidden: a link, its actuator (-1: none), another link (-1), a sign."""

    link: int
    actuator: int = -1
    other: int = -1
    sign: float = 1.0


# Names grouped by what they need; every group's builder is below.
FIELDS = (
    "mass",
    "inertia",
    "center_of_mass",
    "armature",
    "viscous_damping",
    "coulomb_friction",
    "stiffness",
    "gain",
    "bias",
    "servo_stiffness",
    "servo_damping",
    "saturation",
    "gravity",
    "link_length",
    "joint_stop",
    "contact_friction",
    "contact_stiffness",
    "contact_damping",
    "ground_height",
)
REMOVABLE = tuple(name for name in FIELDS if name not in ("saturation", "joint_stop"))
LAWS = (
    "quadratic_damping",
    "stribeck_friction",
    "nonlinear_stiffness",
    "spring_offset",
    "cogging",
    "backlash",
    "delay",
    "lag",
    "dead_zone",
    "back_emf",
    "air_drag",
    "wind",
    "external_force",
    "payload_change",
    "sensor_bias",
    "sensor_scale",
    "sensor_delay",
    "load_friction",
    "friction_map",
    "joint_elasticity",
    "presliding",
    "rate_limit",
    "torque_speed",
    "gain_fade",
    "coupled_friction",
    "coupled_inertia",
)
OF_DRIVES = (
    "gain",
    "bias",
    "servo_stiffness",
    "servo_damping",
    "saturation",
    "delay",
    "lag",
    "dead_zone",
    "back_emf",
    "load_friction",
    "rate_limit",
    "torque_speed",
    "gain_fade",
    "joint_elasticity",
    "backlash",
    "UnevenMotor",
    "SagGain",
    "BrakeDrag",
    "cogging",
)
OF_PAIRS = ("coupled_friction", "coupled_inertia", "NeighbourSpring")
OF_BODIES = (
    "mass",
    "inertia",
    "center_of_mass",
    "external_force",
    "payload_change",
    "link_length",
)
OF_GROUND = {
    "contact_friction": ("sliding", "sliding"),
    "contact_stiffness": ("contact_stiffness", "stiffness"),
    "contact_damping": ("contact_damping", "damping"),
    "ground_height": ("ground_height", "z"),
}
MIMICS = (
    ("coulomb_friction", "viscous_damping"),
    ("viscous_damping", "quadratic_damping"),
    ("delay", "lag"),
    ("joint_elasticity", "delay"),
    ("stiffness", "nonlinear_stiffness"),
    ("spring_offset", "coulomb_friction"),
    ("gain", "servo_damping"),
    ("mass", "armature"),
    ("backlash", "dead_zone"),
    ("saturation", "gain"),
    ("torque_speed", "back_emf"),
    ("sensor_delay", "delay"),
    ("load_friction", "gain"),
    ("sensor_bias", "stiffness"),
)
AIR = 1.2  # kg/m^3
FAMILIES = (  # of which a robot hides one: two would be one law with other values
    ("backlash", "joint_elasticity"),
    ("coulomb_friction", "stribeck_friction", "presliding", "friction_map"),
    ("mass", "inertia"),
    ("wind", "air_drag"),
)
OF_WORLD = ("gravity", "wind", "air_drag")
WRONG_AXIS = "wrong_axis"
UNNAMED = (*(law.__name__ for law in L.UNNAMED), WRONG_AXIS)


def places(robot, effect):
    """Every Spot of a robot where this effect or law can be hidden."""
    drives = {a.link: i for i, a in enumerate(robot.actuators)}
    joints = [i for i, k in enumerate(robot.links) if k.joint != "free"]
    if effect in OF_WORLD:
        return [Spot(0)]
    if effect in OF_GROUND:
        return [Spot(0)] if robot.ground else []
    if effect in OF_PAIRS:
        return [
            Spot(i, drives.get(i, -1), robot.links[i].parent)
            for i in joints
            if robot.links[i].parent in joints
        ]
    if effect == "link_length":
        return [Spot(i) for i in joints if robot.links[i].parent >= 0]
    if effect in OF_BODIES:
        return [Spot(i) for i in range(len(robot.links))]
    spots = [Spot(i, drives.get(i, -1)) for i in joints]
    if effect in OF_DRIVES:
        spots = [s for s in spots if s.actuator >= 0]
    kind = lambda s: robot.actuators[s.actuator].kind
    if effect == "servo_stiffness":
        return [s for s in spots if kind(s) == "position"]
    if effect == "servo_damping":
        return [s for s in spots if kind(s) != "motor"]
    if effect in ("back_emf", "torque_speed"):
        return [s for s in spots if kind(s) == "motor"]
    if effect in ("backlash", "joint_elasticity"):
        return [s for s in spots if robot.links[s.link].armature > 0]
    if effect == "presliding":
        return [s for s in spots if robot.links[s.link].frictionloss == 0]
    if effect == "joint_stop":
        return [s for s in spots if robot.links[s.link].range is None]
    return spots


def hide(effect, spot, size, removed, nominal, true, usage, rng):
    """(nominal Robot, true Robot, [laws], Item) with this effect between them.

    size: relative; removed: the nominal has more than the truth, where a field can say so.
    """
    if effect in FIELDS:
        return _hide_field(effect, spot, size, removed, nominal, true, usage, rng)
    if effect == WRONG_AXIS:
        return _hide_axis(spot, size, nominal, true, rng)
    if effect in UNNAMED:
        law, needs = _unnamed(effect, spot, size, true, usage, rng)
        name = true.links[spot.link].joint_name
        item = Item(
            "unknown",
            {"kind": "joint", "name": name},
            {k: v for k, v in law.parameters.items()},
            law=effect,
            needs=tuple(needs),
        )
        return nominal, true, [law], item
    if effect == "wind":  # of air that the nominal model has as well, and holds still
        nominal, true = replace(nominal, density=AIR), replace(true, density=AIR)
    law, place, parameters = _named_law(effect, spot, size, true, usage, rng)
    return nominal, true, [law], Item(effect, place, parameters)


def _hide_axis(spot, size, nominal, true, rng):
    """A joint whose axis is not where the drawing has it."""
    link = true.links[spot.link]
    axis = np.array(link.axis)
    across = np.cross(axis, rng.normal(size=3))
    across /= np.linalg.norm(across)
    angle = min(0.5 * size, 0.5)
    turned = tuple((np.cos(angle) * axis + np.sin(angle) * across).tolist())
    place = {"kind": "joint", "name": link.joint_name}
    values = {"axis": turned}
    true = set_field(WRONG_AXIS, spot, true, values)
    return nominal, true, [], Item("unknown", place, {**values, "angle": angle}, law=WRONG_AXIS)


def _hide_field(effect, spot, size, removed, nominal, true, usage, rng):
    """A field that differs between the two robots."""
    low, high, place = _field_values(effect, spot, size, true, usage, rng)
    change = lambda robot, values: set_field(effect, spot, robot, values)
    nominal_values, true_values = (high, low) if removed else (low, high)
    nominal, true = change(nominal, nominal_values), change(true, true_values)
    return nominal, true, [], Item(effect, place, true_values, removed=removed)


def set_field(effect, spot, robot, values):
    """The Robot with an effect's field set to these values, named as the contract names them."""
    link = robot.links[spot.link]
    if effect == "mass":
        ratio = values["mass"] / link.mass
        inertia = tuple(ratio * i for i in link.inertia)
        return robot.with_link(spot.link, mass=values["mass"], inertia=inertia)
    if effect == "inertia":
        return robot.with_link(spot.link, inertia=tuple(values[k] for k in ("ixx", "iyy", "izz")))
    if effect == "center_of_mass":
        return robot.with_link(spot.link, center_of_mass=tuple(values[k] for k in "xyz"))
    if effect == "link_length":
        direction = np.array(link.position) / np.linalg.norm(link.position)
        return robot.with_link(spot.link, position=tuple(values["length"] * direction))
    if effect == WRONG_AXIS:
        return robot.with_link(spot.link, axis=values["axis"])
    if effect in OF_GROUND:
        return replace(robot, **{OF_GROUND[effect][0]: next(iter(values.values()))})
    if effect == "gravity":
        return replace(robot, gravity=tuple(values[k] for k in "xyz"))
    if effect == "joint_stop":
        stop = None if values["low"] is None else (values["low"], values["high"])
        return robot.with_link(spot.link, range=stop)
    field = {
        "viscous_damping": "damping",
        "coulomb_friction": "frictionloss",
        "servo_stiffness": "kp",
        "servo_damping": "kv",
        "saturation": "limit",
    }.get(effect, effect)
    value = next(iter(values.values()))
    if spot.actuator >= 0 and effect in OF_DRIVES:
        return robot.with_actuator(spot.actuator, **{field: value})
    return robot.with_link(spot.link, **{field: value})


def _field_values(effect, spot, size, robot, usage, rng):
    """(values of the robot without it, values with it, place) of a field."""
    i, link = spot.link, robot.links[spot.link]
    joint = {"kind": "joint", "name": link.joint_name}
    body = {"kind": "body", "name": link.name}
    world = {"kind": "world", "name": "world"}
    load, speed, inertia = usage.load[i], usage.speed[i], usage.inertia[i]
    vector = lambda names, values: dict(zip(names, (float(v) for v in values)))
    if effect == "mass":
        return {"mass": link.mass}, {"mass": link.mass * (1 + 1.5 * size)}, body
    if effect == "inertia":
        names = ("ixx", "iyy", "izz")
        wider = np.array(link.inertia) * (1 + 3 * size)
        return vector(names, link.inertia), vector(names, wider), body
    if effect == "center_of_mass":
        turn = rng.normal(size=3)
        shift = size * link.length * turn / np.linalg.norm(turn)
        center = np.array(link.center_of_mass)
        return vector("xyz", center), vector("xyz", center + shift), body
    if effect == "link_length":
        length = float(np.linalg.norm(link.position))
        return {"length": length}, {"length": length * (1 + spot.sign * 0.5 * size)}, body
    if effect == "gravity":
        turn = rng.uniform(0, 2 * np.pi)
        tilt = min(0.5 * size, 0.4)
        down = 9.81 * np.array(
            [np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)]
        )
        return vector("xyz", robot.gravity), vector("xyz", down), world
    if effect == "joint_stop":
        side = max(0.01, 0.4 * min(size, 1))
        low, high = np.quantile(usage.quantiles[i], (side, 1 - side))
        return {"low": None, "high": None}, {"low": float(low), "high": float(high)}, joint
    if effect in OF_GROUND:
        field, name = OF_GROUND[effect]
        base = getattr(robot, field)
        lower = {"contact_friction": 1 / (1 + 2 * size)}.get(
            effect, 1 + 2 * spot.sign * min(size, 0.4)
        )
        value = base + 0.03 * spot.sign * size if effect == "ground_height" else base * lower
        return {name: base}, {name: float(value)}, {"kind": "geom", "name": "ground"}
    if effect == "armature":
        return {effect: link.armature}, {effect: link.armature + 2 * size * inertia}, joint
    if effect == "viscous_damping":
        return {"damping": link.damping}, {"damping": link.damping + 2 * size * load / speed}, joint
    if effect == "coulomb_friction":
        base = link.frictionloss
        return {"frictionloss": base}, {"frictionloss": base + size * load}, joint
    if effect == "stiffness":
        more = 2 * size * load / usage.spread[i]
        return {effect: link.stiffness}, {effect: link.stiffness + more}, joint
    actuator = robot.actuators[spot.actuator]
    drive = {"kind": "actuator", "name": actuator.name}
    bounded = np.clip(spot.sign * size, -0.6, 1.5)
    if effect == "gain":
        return {"gain": 1.0}, {"gain": float(1 + bounded)}, drive
    if effect == "bias":
        return {"bias": 0.0}, {"bias": float(spot.sign * size * load)}, drive
    if effect == "servo_stiffness":
        return {"kp": actuator.kp}, {"kp": float(actuator.kp * (1 + bounded))}, drive
    if effect == "servo_damping":
        return {"kv": actuator.kv}, {"kv": float(actuator.kv * (1 + bounded))}, drive
    most = np.quantile(usage.torque_quantiles[i], max(0.3, 1 - 0.7 * size))
    return {"forcerange": actuator.limit}, {"forcerange": float(most)}, drive


def _named_law(effect, spot, size, robot, usage, rng):
    """(law, place, parameters as the contract names them)."""
    i, link = spot.link, robot.links[spot.link]
    joint = {"kind": "joint", "name": link.joint_name}
    load, speed, inertia = float(usage.load[i]), float(usage.speed[i]), float(usage.inertia[i])
    spread = float(usage.spread[i])
    amount, unit = size * load, lambda low, high: float(rng.uniform(low, high))
    if effect in ("air_drag", "wind", "external_force", "payload_change"):
        return _surrounding(effect, spot, size, robot, usage, rng)
    if effect.startswith("sensor"):
        law = {
            "sensor_bias": lambda: L.SensorBias(i, offset=spot.sign * 0.3 * size * spread),
            "sensor_scale": lambda: L.SensorScale(i, ratio=1 + spot.sign * min(0.5 * size, 0.4)),
            "sensor_delay": lambda: L.SensorDelay(i, seconds=min(0.1 * size, 0.08)),
        }[effect]()
        return law, joint, law.parameters
    if effect in ("coupled_friction", "coupled_inertia"):
        pair = {
            "kind": "joint",
            "name": f"{robot.links[spot.other].joint_name}+{link.joint_name}",
        }
        if effect == "coupled_friction":
            law = L.CoupledFriction(i, other=spot.other, level=amount, creep=0.01 * speed)
            return law, pair, {"level": amount}
        law = L.CoupledInertia(i, other=spot.other, inertia=2 * size * inertia)
        return law, pair, {"inertia": 2 * size * inertia}
    if spot.actuator >= 0 and effect in OF_DRIVES and effect != "cogging":
        return _drive_law(effect, spot, size, robot, usage, unit)
    if effect == "quadratic_damping":
        law = L.QuadraticDamping(i, damping2=2 * amount / speed**2)
    elif effect == "stribeck_friction":
        law = L.Stribeck(
            i, coulomb=amount, static=amount * unit(1.5, 2.5), velocity=speed * unit(0.1, 0.3)
        )
    elif effect == "nonlinear_stiffness":
        law = L.CubicSpring(i, stiffness3=2 * amount / spread**3)
    elif effect == "spring_offset":
        law = L.ConstantTorque(i, torque=spot.sign * amount)
    elif effect == "cogging":
        poles = float(max(1, round(unit(4, 10) / spread)))
        law = L.Cogging(i, amplitude=amount, poles=poles, phase=unit(0, 6.28))
    elif effect == "friction_map":
        waves = max(1.0, round(unit(2, 6) / spread))
        law = L.FrictionMap(
            i, level=amount, contrast=unit(0.6, 1.0), waves=waves, phase=unit(0, 6.28)
        )
    else:
        law = L.Presliding(i, frictionloss=amount, stiffness=amount / (spread * unit(0.02, 0.1)))
    return law, joint, law.parameters


def _drive_law(effect, spot, size, robot, usage, unit):
    """Laws of one drive; the place is the actuator but for friction and transmissions."""
    i, a, link = spot.link, spot.actuator, robot.links[spot.link]
    actuator = robot.actuators[a]
    load, speed = float(usage.load[i]), float(usage.speed[i])
    joint = {"kind": "joint", "name": link.joint_name}
    drive = {"kind": "actuator", "name": actuator.name}
    servo = actuator.kind != "motor"
    if effect == "delay":
        law = L.Delay(i, actuator=a, seconds=min(0.1 * size, 0.06))
        return law, drive, {"seconds": law.seconds}
    if effect == "lag":
        law = L.Lag(i, actuator=a, seconds=min(0.1 * size, 0.15))
        return law, drive, {"seconds": law.seconds}
    if effect == "rate_limit":
        pace = usage.control[a] * speed / max(float(usage.spread[i]), 1e-6)
        law = L.RateLimit(i, actuator=a, rate=float(pace / (0.3 + 2 * size)))
        return law, drive, {"rate": law.rate}
    if effect == "dead_zone":
        width = size * load if servo else size * float(usage.control[a])
        law = L.DeadZone(i, actuator=a, width=0.5 * width, servo=servo)
        return law, drive, {"half-width": law.width}
    if effect == "back_emf":
        law = L.BackEmf(i, damping=2 * size * load / speed)
        return law, drive, {"damping": law.damping}
    if effect == "torque_speed":
        stall = float(np.quantile(usage.torque_quantiles[i], 0.98))
        law = L.TorqueSpeed(i, stall=stall, slope=min(size, 1.0) * stall / speed)
        return law, drive, {"slope": law.slope, "stall": stall}
    if effect == "gain_fade":
        law = L.GainFade(i, rate=min(0.25 * size, 0.5))
        return law, drive, {"rate": law.rate}
    if effect == "load_friction":
        driving = min(size, 0.6)
        law = L.LoadFriction(i, driving=driving, driven=min(driving * unit(0.5, 1.2), 0.7))
        return law, joint, law.parameters
    rotor = link.armature
    reduced = rotor * usage.inertia[i] / (rotor + usage.inertia[i])
    if effect == "joint_elasticity":
        tone = 2 * np.pi * unit(4.0, 9.0) / np.sqrt(max(size, 0.02) * 10)
        stiffness = float(reduced * tone**2)
        damping = float(2 * unit(0.03, 0.15) * reduced * tone)
        law = L.JointElasticity(i, stiffness=stiffness, damping=damping)
        return law, joint, {"stiffness": stiffness, "damping": damping}
    stiffness = float(reduced * 400.0**2)
    law = L.Backlash(
        i,
        gap=0.4 * size * float(usage.spread[i]),
        stiffness=stiffness,
        damping=float(0.6 * np.sqrt(stiffness * reduced)),
    )
    return law, joint, {"gap": law.gap}


def _surrounding(effect, spot, size, robot, usage, rng):
    """Wind, air, and a force on a body."""
    i, link = spot.link, robot.links[spot.link]
    world = {"kind": "world", "name": "world"}
    turn = rng.normal(size=3)
    turn /= np.linalg.norm(turn)
    if effect == "external_force":
        push = turn * size * float(np.nanmax(usage.load)) / link.length
        values = dict(zip("xyz", push.tolist()))
        return L.ExternalForce(i, **values), {"kind": "body", "name": link.name}, values
    if effect == "payload_change":
        added = 1.5 * size * link.mass
        law = L.Payload(i, added=added, start=0.0, runs=None)
        return law, {"kind": "body", "name": link.name}, {"mass": link.mass + added}
    if effect == "air_drag":
        density = 30.0 * size
        law = L.Air(0, density=density, x=0.0, y=0.0, z=0.0)
        return law, world, {"density": density}
    wind = dict(zip("xyz", (40.0 * np.sqrt(size) * turn).tolist()))
    return L.Air(0, density=robot.density, **wind), world, wind


def _unnamed(name, spot, size, robot, usage, rng):
    """(law, needs) of a law that the catalogue lacks; needs as the contract writes variables."""
    i = spot.link
    load, speed = float(usage.load[i]), float(usage.speed[i])
    spread, amount = float(usage.spread[i]), size * float(usage.load[i])
    unit = lambda low, high: float(rng.uniform(low, high))
    spot_at = lambda low, high: float(np.quantile(usage.quantiles[i], unit(low, high)))
    waves = float(max(1, round(unit(2, 5) / spread)))
    parameters = {
        "Hysteresis": lambda: {"stiffness": amount / (0.4 * spread), "reach": 0.4 * spread},
        "WarmingGrease": lambda: {
            "damping": 2 * amount / speed,
            "heat": amount * speed * unit(0.8, 2.0),
        },
        "Detent": lambda: {
            "amplitude": amount,
            "at": spot_at(0.3, 0.7),
            "width": spread * unit(0.2, 0.4),
        },
        "CableDrag": lambda: {
            "amplitude": amount,
            "at": spot_at(0.4, 0.7),
            "width": spread * unit(0.4, 0.8),
        },
        "SpeedRipple": lambda: {"amplitude": amount, "speed": speed, "waves": waves},
        "NeighbourSpring": lambda: {
            "amplitude": amount,
            "other": spot.other,
            "reach": float(usage.spread[spot.other]) * unit(0.5, 1.0),
        },
        "FluidMemory": lambda: {"damping": 2 * amount / speed, "seconds": unit(0.15, 0.5)},
        "Wear": lambda: {"level": amount, "travel": speed * unit(1.0, 3.0)},
        "OneWayBearing": lambda: {"damping": 2 * amount / speed},
        "OneWayDrag": lambda: {"drag": 2 * amount / speed**3},
        "Shaking": lambda: {"amplitude": amount, "hertz": unit(0.7, 4.0), "phase": unit(0, 6.28)},
        "UnevenMotor": lambda: {
            "share": min(size, 0.7),
            "waves": waves,
            "phase": unit(0, 6.28),
        },
        "PatchDamping": lambda: {
            "damping": 3 * amount / speed,
            "at": spot_at(0.25, 0.75),
            "width": spread * unit(0.2, 0.5),
        },
        "SagGain": lambda: {
            "share": min(size, 0.7),
            "full": float(np.quantile(usage.torque_quantiles[i], 0.95)),
        },
        "BrakeDrag": lambda: {"level": amount, "full": load, "creep": 0.05 * speed},
    }[name]()
    law = getattr(L, name)(i, **parameters)
    return law, [_variable(need, i, robot) for need in law.needs]


def _variable(need, link, robot):
    """A law's need as the contract's text: "velocity:joint1", "control:drive1", "time"."""
    kind, place = need if isinstance(need, tuple) else (need, link)
    if kind == "time":
        return kind
    if kind == "control":
        return f"control:{next(a.name for a in robot.actuators if a.link == place)}"
    return f"{kind}:{robot.links[place].joint_name}"
