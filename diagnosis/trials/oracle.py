"""What the training recordings can show at all, found out with the true machine at hand.

    seen = visibility(trial, index)       # Visibility(alone=812.0, apart=96.1)

The true machine is compared with the best one without the effect, on windows of one second. `alone`
is the noncentrality (squared distance over the noise) that is left when only the windows' start
states may move; `apart` what is left when the usual parameters of the joints nearby may move as
well. Below ENOUGH an ideal test at a level of 1e-4 would miss the effect more than once in a
hundred: it counts as not shown, and no tool is asked for it.
"""

from dataclasses import dataclass, replace

import mujoco
import numpy as np
from scipy.optimize import lsq_linear

from diagnosis.trials.mjcf import to_mjcf
from diagnosis.trials.prediction import model_residuals, system_residuals, windows
from diagnosis.trials.truth import TrueSystem

ENOUGH = 45.0  # noncentral chi² of 3 degrees passes the 1e-4 quantile in 99 % of draws
AMPLE = 50 * ENOUGH  # left of it after the linear fit: no shorter step will take that away
HORIZON = 1.0  # s
COLOURED = 19.0  # (1 + 0.9) / (1 - 0.9), of coloured noise: what is seen slowly counts so much less
REFITS = 3


@dataclass(frozen=True)
class Visibility:
    """Noncentralities; see the module's text."""

    alone: float
    apart: float

    @property
    def visible(self):
        """Could an ideal test tell the machine from the nominal one?"""
        return self.alone >= ENOUGH

    @property
    def distinct(self):
        """Could it tell the effect from the usual parameters, moved?"""
        return self.apart >= ENOUGH


def visibility(trial, index, rows=700):
    """Visibility of item `index` of a Trial, from at most about `rows` training rows, scaled up."""
    total = sum(len(run.time) for run in trial.train)
    runs, used = [], 0
    one = trial.answer.get("gate") == "one recording"
    for run in trial.train:
        if one or used < rows:
            runs.append(run)
            used += len(run.time)
    scale = total / used / (COLOURED if trial.answer["plan"]["noise_kind"] == "coloured" else 1.0)
    system, kept = trial.without(index)
    residual = lambda robot: system_residuals(
        TrueSystem(robot, system.laws), runs, trial.noise, True, kept, HORIZON
    )
    start = residual(system.robot)
    cuts = _cuts(runs)
    bases = _start_bases(system.robot, runs, trial.noise, cuts)
    alone = apart = float(np.sum(_project(start, bases, cuts) ** 2))
    item = trial.items[index]
    if scale * alone >= ENOUGH:
        apart = _refit(system.robot, item, trial.noise, runs, residual, start, bases, cuts)
    return Visibility(round(scale * alone, 2), round(scale * min(apart, alone), 2))


def _cuts(runs):
    """[(first, last)] of each window's rows in the residuals."""
    cuts, begin = [], 0
    for run in runs:
        for first, last in windows(run.time, HORIZON):
            cuts.append((begin, begin + last - first))
            begin += last - first
    return cuts


def _exact(runs):
    """Runs as noiseless sensors would have recorded them, for the stock simulator."""
    return [replace(r, qpos=r.true_qpos, qvel=r.true_qvel, time=r.stamps) for r in runs]


def _stock(robot, runs, noise, shift=None):
    model = mujoco.MjModel.from_xml_string(to_mjcf(robot))
    return model_residuals(model, model, _exact(runs), noise, HORIZON, shift=shift)


def _start_bases(robot, runs, noise, cuts):
    """Orthonormal columns per window that a change of its start state can make."""
    base = _stock(robot, runs, noise)
    nv = base.shape[1]
    columns = []
    for k in range(2 * nv):
        shift = np.zeros((2, nv))
        shift.flat[k] = 1e-4 if k < nv else 1e-3
        columns.append((_stock(robot, runs, noise, shift) - base) / shift.flat[k])
    return [
        np.linalg.qr(np.stack([c[a:b].ravel() for c in columns], 1))[0] if b > a else None
        for a, b in cuts
    ]


def _project(values, bases, cuts):
    """Values (rows, nv) without what start states explain, flat."""
    out = []
    for basis, (a, b) in zip(bases, cuts):
        flat = np.nan_to_num(values[a:b].ravel(), posinf=1e6, neginf=-1e6)
        out.append(flat - basis @ (basis.T @ flat))
    return np.concatenate(out) if out else np.zeros(0)


def _refit(robot, item, noise, runs, residual, start, bases, cuts):
    """Least squared distance over the usual parameters nearby: Gauss–Newton with shorter steps.

    Where the linear fit leaves AMPLE, that is the answer and nothing is simulated again.
    """
    base = _stock(robot, runs, noise)
    moves = rivals(robot, item)
    left = _project(start, bases, cuts)
    best = float(np.sum(left**2))
    if not moves:
        return best
    columns = [
        _project((_stock(m.apply(robot, m.small), runs, noise) - base) / m.small, bases, cuts)
        for m in moves
    ]
    columns = np.stack(columns, 1)
    size = np.linalg.norm(columns, axis=0) + 1e-12
    for _ in range(REFITS):
        least = np.array([-m.value(robot) for m in moves]) * size
        step = lsq_linear(columns / size, -left, bounds=(least - 1e-9, np.inf)).x / size
        linear = float(np.sum((left + columns @ step) ** 2))
        if linear > AMPLE:
            return linear
        better = None
        for share in (1.0, 0.4, 0.1):
            moved = robot
            for move, amount in zip(moves, share * step):
                moved = move.apply(moved, float(amount))
            there = _project(residual(moved), bases, cuts)
            distance = float(np.sum(there**2))
            if distance < best:
                better = moved, there, distance
                break
        if better is None:
            break
        robot, left, best = better
    return best


@dataclass(frozen=True)
class Move:
    """A usual parameter of a Robot. link or actuator: its index; small: a step for differences."""

    field: str
    small: float
    link: int = -1
    actuator: int = -1

    def value(self, robot):
        """How far it may go down from what it is; infinite for a bias."""
        if self.field == "bias":
            return np.inf
        if self.actuator >= 0:
            return 0.9 * getattr(robot.actuators[self.actuator], self.field)
        share = 0.9 if self.field == "mass" else 1.0
        return share * getattr(robot.links[self.link], self.field)

    def apply(self, robot, amount):
        """The Robot with `amount` more of it; inertia scales along with mass."""
        if self.actuator >= 0:
            now = getattr(robot.actuators[self.actuator], self.field)
            return robot.with_actuator(self.actuator, **{self.field: now + amount})
        link = robot.links[self.link]
        value = max(getattr(link, self.field) + amount, 0.0)
        if self.field != "mass":
            return robot.with_link(self.link, **{self.field: value})
        inertia = tuple(value / link.mass * v for v in link.inertia)
        return robot.with_link(self.link, mass=value, inertia=inertia)


def rivals(robot, item):
    """Moves of the usual parameters at and beside an item's place, its own field left out."""
    moves = []
    for index in _links_near(robot, item.place):
        link = robot.links[index]
        moves.append(("mass", Move("mass", 1e-3 * link.mass, index)))
        if link.joint == "free":
            continue
        size = link.damping if link.damping > 0 else 1e-3
        inertia = link.armature + link.mass * link.length**2 / 10
        moves += [
            ("viscous_damping", Move("damping", 1e-2 * size, index)),
            ("armature", Move("armature", 1e-3 * inertia, index)),
            ("coulomb_friction", Move("frictionloss", 1e-2 * (link.frictionloss + size), index)),
            ("stiffness", Move("stiffness", 1e-2 * (link.stiffness + 10 * size), index)),
        ]
        for k, actuator in enumerate(robot.actuators):
            if actuator.link == index:
                moves.append(("gain", Move("gain", 1e-3, actuator=k)))
                moves.append(("bias", Move("bias", 1e-3 * actuator.limit, actuator=k)))
    own = {item.place["name"]}
    at = lambda m: (
        robot.actuators[m.actuator].name
        if m.actuator >= 0
        else (robot.links[m.link].name if m.field == "mass" else robot.links[m.link].joint_name)
    )
    return [m for effect, m in moves if not (effect == item.effect and at(m) in own)]


def _links_near(robot, place):
    names = str(place["name"]).split("+")
    own = [
        i
        for i, link in enumerate(robot.links)
        if {link.name, link.joint_name} & set(names)
        or any(a.link == i and a.name in names for a in robot.actuators)
    ]
    own = own or list(range(min(len(robot.links), 3)))
    beside = [i for i, link in enumerate(robot.links) if link.parent in own]
    return sorted({*own, *beside, *(robot.links[i].parent for i in own)} - {-1})
