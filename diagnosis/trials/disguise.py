"""Wrong nominal values: mass and damping fitted to the recordings by someone who missed the effect.

nominal, items = disguise(nominal, true, hidden, runs, noise)
"""

import mujoco
import numpy as np
from scipy.optimize import least_squares

from diagnosis.trials.hiding import Item
from diagnosis.trials.mjcf import to_mjcf
from diagnosis.trials.prediction import model_residuals

REACH = 2.0  # a fitted value stays within this factor of the one it replaces


def disguise(nominal, true, items, runs, noise):
    """(nominal Robot, [Item, …]): the values fitted to two recordings, and what they should be.

    The mass of the link and the damping of the joint at each item's place are fitted, but for what
    is hidden itself. The Items are not required: a tool may put these values right.
    """
    fields = _fields(nominal, items)
    if not fields:
        return nominal, []
    runs = runs[:2]

    def robot_at(logs):
        robot = nominal
        for (index, field), value in zip(fields, logs):
            robot = _scaled(robot, index, field, float(np.exp(value)))
        return robot

    def residuals(logs):
        model = mujoco.MjModel.from_xml_string(to_mjcf(robot_at(logs)))
        flat = model_residuals(model, model, runs, noise).ravel()
        return np.clip(np.nan_to_num(flat, posinf=1e3, neginf=-1e3), -1e3, 1e3)

    bounds = np.log(REACH)
    found = least_squares(
        residuals,
        np.zeros(len(fields)),
        bounds=(-bounds, bounds),
        diff_step=1e-3,
        loss="soft_l1",
        max_nfev=12,
    )
    return robot_at(found.x), [_right(true.links[index], field) for index, field in fields]


def _right(link, field):
    """The Item of a value that was fitted: what it should be."""
    if field == "mass":
        place = {"kind": "body", "name": link.name}
        return Item("mass", place, {"mass": link.mass}, required=False)
    place = {"kind": "joint", "name": link.joint_name}
    return Item("viscous_damping", place, {"damping": link.damping}, required=False)


def _fields(robot, items):
    """[(link index, "mass" or "damping")] to fit: at the items' places, not the items
    themselves."""
    hidden = {(item.effect, item.place["name"]) for item in items}
    fields = []
    for index, link in enumerate(robot.links):
        drives = {a.name for a in robot.actuators if a.link == index}
        here = {link.name, link.joint_name} | drives
        if link.joint == "free" or not any(item.place["name"] in here for item in items):
            continue
        if ("mass", link.name) not in hidden:
            fields.append((index, "mass"))
        if ("viscous_damping", link.joint_name) not in hidden and link.damping > 0:
            fields.append((index, "damping"))
    return fields


def _scaled(robot, index, field, ratio):
    link = robot.links[index]
    if field == "mass":
        inertia = tuple(ratio * v for v in link.inertia)
        return robot.with_link(index, mass=ratio * link.mass, inertia=inertia)
    return robot.with_link(index, damping=ratio * link.damping)
