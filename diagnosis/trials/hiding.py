"""What a trial hides: effects and laws between two robots.

    hidden = hide("cogging", place, size, robots, usage, rng)

Each function takes the two robots (nominal, true) and returns them changed, with the laws and the
true values. `size` is relative: about the share of the joint's usual force that is hidden.
"""

from dataclasses import asdict, dataclass, replace

import numpy as np

from diagnosis.trials.groups import (
    AIR,
    FIELDS,
    OF_BODIES,
    OF_DRIVES,
    OF_GROUND,
    OF_PAIRS,
    OF_WORLD,
    UNNAMED,
    WRONG_AXIS,
)
from diagnosis.trials.sizes import field_values, named_law, unnamed_law


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


def places(robot, effect):
    """Every Spot of a robot where this effect or law can be hidden."""
    drives = {a.link: i for i, a in enumerate(robot.actuators)}
    joints = [i for i, k in enumerate(robot.links) if k.joint != "free"]
    if effect in OF_WORLD:
        return [Spot(0)]
    if effect in OF_GROUND:
        return [Spot(0)] if robot.ground else []
    if effect in OF_PAIRS:
        parent = lambda i: robot.links[i].parent
        pairs = [i for i in joints if parent(i) in joints]
        if effect.startswith("coupled"):  # what two joints turn together has one unit
            pairs = [i for i in pairs if robot.links[i].joint == robot.links[parent(i)].joint]
        return [Spot(i, drives.get(i, -1), parent(i)) for i in pairs]
    if effect == "link_length":
        return [Spot(i) for i in joints if robot.links[i].parent >= 0]
    if effect in OF_BODIES:
        return [Spot(i) for i in range(len(robot.links))]
    spots = [Spot(i, drives.get(i, -1)) for i in joints]
    if effect in OF_DRIVES:
        spots = [s for s in spots if s.actuator >= 0]
    kind = lambda s: robot.actuators[s.actuator].kind
    if effect == WRONG_AXIS and len(robot.links) == 1:  # as another centre of mass and a rotor
        return []
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
        law, needs = unnamed_law(effect, spot, size, true, usage, rng)
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
    law, place, parameters = named_law(effect, spot, size, true, usage, rng)
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
    low, high, place = field_values(effect, spot, size, true, usage, rng)
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
