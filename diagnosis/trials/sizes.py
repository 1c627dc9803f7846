"""How large a hidden effect is, in units of what each joint of the robot usually does."""

import numpy as np

from diagnosis.trials import laws as L
from diagnosis.trials.groups import OF_BODIES, OF_DRIVES, OF_GROUND


def field_values(effect, spot, size, robot, usage, rng):
    """(values of the robot without it, values with it, place) of a field."""
    if effect in OF_BODIES:
        return _body_values(effect, spot, size, robot, rng)
    if effect == "gravity" or effect in OF_GROUND:
        return _world_values(effect, spot, size, robot, rng)
    i, link = spot.link, robot.links[spot.link]
    joint = {"kind": "joint", "name": link.joint_name}
    load, speed, inertia = usage.load[i], usage.speed[i], usage.inertia[i]
    if effect == "joint_stop":
        side = max(0.01, 0.4 * min(size, 1))
        low, high = np.quantile(usage.quantiles[i], (side, 1 - side))
        return {"low": None, "high": None}, {"low": float(low), "high": float(high)}, joint
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
    return _drive_values(effect, spot, size, robot, usage)


def _drive_values(effect, spot, size, robot, usage):
    i, load = spot.link, usage.load[spot.link]
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


def _body_values(effect, spot, size, robot, rng):
    link = robot.links[spot.link]
    body = {"kind": "body", "name": link.name}
    if effect == "mass":
        return {"mass": link.mass}, {"mass": link.mass * (1 + 1.5 * size)}, body
    if effect == "inertia":
        names = ("ixx", "iyy", "izz")
        wider = np.array(link.inertia) * (1 + 3 * size)
        return _vector(names, link.inertia), _vector(names, wider), body
    if effect == "center_of_mass":
        turn = rng.normal(size=3)
        shift = size * link.length * turn / np.linalg.norm(turn)
        center = np.array(link.center_of_mass)
        return _vector("xyz", center), _vector("xyz", center + shift), body
    length = float(np.linalg.norm(link.position))
    return {"length": length}, {"length": length * (1 + spot.sign * 0.5 * size)}, body


def _world_values(effect, spot, size, robot, rng):
    world = {"kind": "world", "name": "world"}
    if effect == "gravity":
        turn = rng.uniform(0, 2 * np.pi)
        tilt = min(0.5 * size, 0.4)
        down = 9.81 * np.array(
            [np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)]
        )
        return _vector("xyz", robot.gravity), _vector("xyz", down), world
    field, name = OF_GROUND[effect]
    base = getattr(robot, field)
    lower = {"contact_friction": 1 / (1 + 2 * size)}.get(effect, 1 + 2 * spot.sign * min(size, 0.4))
    value = base + 0.03 * spot.sign * size if effect == "ground_height" else base * lower
    return {name: base}, {name: float(value)}, {"kind": "geom", "name": "ground"}


def _vector(names, values):
    """{name: float} of a vector."""
    return dict(zip(names, (float(v) for v in values)))


def named_law(effect, spot, size, robot, usage, rng):
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
        return _coupled_law(effect, spot, amount, 2 * size * inertia, 0.01 * speed, robot)
    if spot.actuator >= 0 and effect in OF_DRIVES and effect != "cogging":
        return _drive_law(effect, spot, size, robot, usage, unit)
    if effect == "stribeck_friction":
        law = L.Stribeck(
            i, coulomb=amount, static=amount * unit(1.5, 2.5), velocity=speed * unit(0.1, 0.3)
        )
        # findings tell the joint's whole friction, of which the law is a part
        whole = {k: link.frictionloss + getattr(law, k) for k in ("coulomb", "static")}
        return law, joint, {**law.parameters, **whole}
    if effect == "quadratic_damping":
        law = L.QuadraticDamping(i, damping2=2 * amount / speed**2)
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


def _coupled_law(effect, spot, level, inertia, creep, robot):
    """Laws in the sum of two joints."""
    names = (robot.links[i].joint_name for i in (spot.other, spot.link))
    pair = {"kind": "joint", "name": "+".join(names)}
    if effect == "coupled_friction":
        law = L.CoupledFriction(spot.link, other=spot.other, level=level, creep=creep)
        return law, pair, {"level": level}
    law = L.CoupledInertia(spot.link, other=spot.other, inertia=inertia)
    return law, pair, {"inertia": inertia}


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
        return law, drive, {"half_width": law.width}
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
    return _transmission(effect, spot, size, robot, usage, unit)


def _transmission(effect, spot, size, robot, usage, unit):
    """An elastic joint or one with play, its rotor's resonance well above the motion."""
    i, link = spot.link, robot.links[spot.link]
    joint = {"kind": "joint", "name": link.joint_name}
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


def unnamed_law(name, spot, size, robot, usage, rng):
    """(law, needs) of a law that the catalogue lacks; needs as the contract writes variables."""
    i = spot.link
    load, speed = float(usage.load[i]), float(usage.speed[i])
    spread, amount = float(usage.spread[i]), size * float(usage.load[i])
    unit = lambda low, high: float(rng.uniform(low, high))
    spot_at = lambda low, high: float(np.quantile(usage.quantiles[i], unit(low, high)))
    patch = lambda low, high, thin, wide: {
        "at": spot_at(low, high),
        "width": spread * unit(thin, wide),
    }
    waves = float(max(1, round(unit(2, 5) / spread)))
    parameters = {
        "Hysteresis": lambda: {"stiffness": amount / (0.4 * spread), "reach": 0.4 * spread},
        "WarmingGrease": lambda: {
            "damping": 2 * amount / speed,
            "heat": amount * speed * unit(0.8, 2.0),
        },
        "Detent": lambda: {"amplitude": amount, **patch(0.3, 0.7, 0.2, 0.4)},
        "CableDrag": lambda: {"amplitude": amount, **patch(0.4, 0.7, 0.4, 0.8)},
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
        "PatchDamping": lambda: {"damping": 3 * amount / speed, **patch(0.25, 0.75, 0.2, 0.5)},
        "SagGain": lambda: {
            "share": min(size, 0.7),
            "full": float(np.quantile(usage.torque_quantiles[i], 0.95)),
        },
        "BrakeDrag": lambda: {"level": amount, "full": load, "creep": 0.05 * speed},
    }[name]()
    law = getattr(L, name)(i, **parameters)
    return law, [_variable(need, i, robot) for need in law.needs]


def _variable(need, link, robot):
    """A law's need as the contract's text: "velocity:joint1", "control:drive1", "time"; where
    either of two will do, with a bar between them."""
    if "|" in need:
        return "|".join(_variable(each, link, robot) for each in need.split("|"))
    kind, place = need if isinstance(need, tuple) else (need, link)
    if kind == "time":
        return kind
    if kind == "control":
        return f"control:{next(a.name for a in robot.actuators if a.link == place)}"
    return f"{kind}:{robot.links[place].joint_name}"
