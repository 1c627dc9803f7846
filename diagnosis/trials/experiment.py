"""The experiment on the true machine: references, controllers, sensors, and what gets recorded.

run = record(system, plan, seed)          # a Run: rows as a user has them, the truth beneath
"""

from dataclasses import dataclass, field

import mujoco
import numpy as np

SUNK = 2e-3  # m that a pose may start beneath the ground
LEVELS = {"gentle": 0.2, "brisk": 0.6, "violent": 1.3}  # rad; slides move 0.15 m per rad


@dataclass(frozen=True)
class Plan:
    """Conditions of all recordings of a trial; each is a column of the table.

    row: seconds between rows; level: see LEVELS; feedback: "closed" (motors follow a reference by
    measured position) or "open"; noise: standard deviation, rad (slides: a third of it in m).
    noise_kind: "white", "coloured", "quantised"; velocities: "none", "noisy", "filtered".
    stamps: "regular", "irregular" (true, but uneven), "jitter" (wrong by up to a fifth of a row).
    missing: share of rows that are not in the file.
    """

    row: float
    level: str
    feedback: str
    noise: float
    noise_kind: str
    velocities: str
    stamps: str
    missing: float
    seconds: float


@dataclass
class Run:
    """One recording. time (T,), ctrl (T, nu), qpos (T, nq), qvel (T, nv; NaN where not measured).

    true_qpos, true_qvel: what noiseless sensors of the same machine read; states: snapshots of the
    system per row; stamps: when the rows truly were; touched: share of the time with a contact;
    sent: per row but the last, [(control (nu,), seconds)] until the next, rows left out and all.
    """

    time: np.ndarray
    ctrl: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    true_qpos: np.ndarray
    true_qvel: np.ndarray
    stamps: np.ndarray
    states: list = field(repr=False)
    number: int = 0
    touched: float = 0.0
    sent: list = field(default_factory=list, repr=False)


def channel_noise(robot, noise):
    """Standard deviation per dof (nv,): rad for hinges and rotations, a third of it in m."""
    out = []
    for link in robot.links:
        slide = noise / 3
        out += [slide] * 3 + [noise] * 3 if link.joint == "free" else []
        out += [] if link.joint == "free" else [noise if link.joint == "hinge" else slide]
    return np.array(out)


class Reference:
    """Smooth or stepping motion of one joint: value and slope at a time."""

    def __init__(self, rng, amplitude):
        self.kind = str(rng.choice(("sines", "steps", "slow"), p=(0.6, 0.2, 0.2)))
        count = 4
        self.pace = 2 * np.pi * np.exp(rng.uniform(np.log(0.15), np.log(1.6), count))
        self.phase = rng.uniform(0, 2 * np.pi, count)
        self.height = amplitude * rng.dirichlet(np.ones(count)) * 1.6
        self.levels = amplitude * rng.uniform(-1, 1, 64)
        self.hold = rng.uniform(0.4, 1.0)
        self.amplitude = amplitude
        self.shift = rng.uniform(0, 1)

    def at(self, time):
        """(value, slope)."""
        if self.kind == "steps":
            return self.levels[int(time / self.hold) % 64], 0.0
        if self.kind == "slow":  # a triangle: slow reversals at constant speed
            phase = (time / 3.0 + self.shift) % 1.0
            rising = phase < 0.5
            value = 4 * phase - 1 if rising else 3 - 4 * phase
            return self.amplitude * value, self.amplitude * (4 / 3.0 if rising else -4 / 3.0)
        angle = self.pace * time + self.phase
        return float(self.height @ np.sin(angle)), float(self.height * self.pace @ np.cos(angle))


def amplitudes(robot, level):
    """Amplitude of the reference per actuator."""
    turn = [1.0 if robot.links[a.link].joint == "hinge" else 0.15 for a in robot.actuators]
    return LEVELS[level] * np.array(turn)


def record(system, plan, rng, number=0, states=True):
    """Drive the system through one recording; returns a Run, or None where it flies apart."""
    robot = system.robot
    references = [Reference(rng, a * rng.uniform(0.7, 1.3)) for a in amplitudes(robot, plan.level)]
    qpos, qvel = _start(system, references, rng, plan)
    system.run = number
    system.reset(qpos, qvel)
    stamps = _stamps(plan, rng)
    sensor = Sensor(robot, system.model, plan, rng, system)
    driven = _drive(system, references, sensor, plan, stamps, states)
    if driven is None:
        return None
    ctrl, measured, speeds, truth, snaps = driven
    time, keep = _written(plan, stamps, rng)
    pick = lambda values: np.array(values)[keep]
    rows, gaps = np.flatnonzero(keep), np.diff(stamps)
    return Run(
        time=time[keep],
        ctrl=pick(ctrl).reshape(keep.sum(), len(robot.actuators)),
        qpos=pick(measured),
        qvel=pick(speeds),
        true_qpos=pick([t[0] for t in truth]),
        true_qvel=pick([t[1] for t in truth]),
        stamps=stamps[keep],
        states=[s for s, k in zip(snaps, keep) if k],
        number=number,
        touched=system.touched / max(system.steps, 1),
        sent=[[(ctrl[k], gaps[k]) for k in range(a, b)] for a, b in zip(rows, rows[1:])],
    )


def _drive(system, references, sensor, plan, stamps, states):
    """Step the system through all stamps; None where it flies apart.

    Returns lists with an element a stamp: controls, measured positions and velocities, exact
    (positions, velocities), and the system's state (None without `states`)."""
    count = len(system.robot.actuators)
    ctrl, measured, speeds, truth, snaps = [], [], [], [], []
    trackers = [None] * count
    for row, now in enumerate(stamps):
        qpos, qvel = system.reading()
        apart = np.abs(qvel).max() > 80 or np.abs(qpos).max() > 15
        if apart or not np.isfinite(qpos).all():
            return None
        seen = sensor.position(qpos)
        snaps.append(system.snapshot() if states else None)
        controls = [
            _control(system, k, references[k].at(now), seen, trackers, plan) for k in range(count)
        ]
        truth.append((qpos, qvel))
        measured.append(seen)
        speeds.append(sensor.speed(qvel, seen))
        ctrl.append(np.array(controls))
        if row + 1 < len(stamps):
            system.advance(ctrl[-1], stamps[row + 1] - now)
    return ctrl, measured, speeds, truth, snaps


def _written(plan, stamps, rng):
    """(T,) time as the recording tells it, and (T,) bool: which rows it holds."""
    time = stamps.copy()
    if plan.stamps == "jitter":
        time = stamps + plan.row * np.clip(0.1 * rng.normal(size=len(stamps)), -0.2, 0.2)
        time -= time[0]
    keep = np.ones(len(time), bool)
    if plan.missing:
        keep[1:-1] = rng.random(len(time) - 2) >= plan.missing
    return time, keep


def _stamps(plan, rng):
    count = int(round(plan.seconds / plan.row)) + 1
    if plan.stamps != "irregular":
        return np.arange(count) * plan.row
    gaps = plan.row * rng.uniform(0.6, 1.4, count - 1)
    return np.concatenate([[0.0], np.cumsum(gaps)])


def _start(system, references, rng, plan):
    robot, model = system.robot, system.model
    qpos, qvel = model.qpos0.copy(), np.zeros(model.nv)
    for k, actuator in enumerate(robot.actuators):
        qpos[system.address[actuator.link]] = 0.9 * references[k].at(0.0)[0]
    for index, link in enumerate(robot.links):
        if link.joint == "free":
            continue
        if index not in system.driven:
            wide = LEVELS[plan.level] * (1.0 if link.joint == "hinge" else 0.1)
            qpos[system.address[index]] = wide * rng.uniform(-1, 1)
        if link.range:
            adr = system.address[index]
            low, high = link.range
            qpos[adr] = np.clip(qpos[adr], low + 0.05 * (high - low), high - 0.05 * (high - low))
    return _above_ground(system, qpos), qvel


def _above_ground(system, qpos):
    """qpos (nq,), or a pose on the way from it to the upright one that sinks into no ground."""
    if not system.robot.ground:
        return qpos
    for share in (1.0, 0.7, 0.4, 0.2, 0.0):
        pose = system.model.qpos0 + share * (qpos - system.model.qpos0)
        system.data.qpos[:] = pose
        mujoco.mj_forward(system.model, system.data)
        if not system.data.ncon or system.data.contact.dist.min() > -SUNK:
            break
    return pose


def _control(system, k, goal, seen, trackers, plan):
    """Control of actuator k: what a user's controller sends, from what its sensors say."""
    actuator = system.robot.actuators[k]
    value, slope = goal
    if actuator.kind == "position":
        return value
    q = seen[system.address[actuator.link]]
    if actuator.kind == "velocity":
        return slope + (2.0 * (value - q) if plan.feedback == "closed" else 0.0)
    if plan.feedback == "open":
        pace = 2 * np.pi * 0.7
        return value * 0.3 * actuator.limit / max(LEVELS[plan.level], 1e-9) + 0.0 * pace
    before = trackers[k]
    speed = 0.0 if before is None else (q - before[0]) / plan.row
    smooth = speed if before is None else before[1] + 0.4 * (speed - before[1])
    trackers[k] = (q, smooth)
    push = actuator.kp * (value - q) + actuator.kv * (slope - smooth)
    return float(np.clip(push, -actuator.limit, actuator.limit))


class Sensor:
    """Encoders with noise; speeds as the plan has them."""

    def __init__(self, robot, model, plan, rng, system):
        self.plan, self.rng, self.system = plan, rng, system
        self.sigma = channel_noise(robot, plan.noise)
        self.drift = self.sigma * rng.normal(size=model.nv)
        self.last, self.filtered = None, np.zeros(model.nv)

    def position(self, qpos):
        """qpos (nq,) as read."""
        if self.plan.noise_kind == "coloured":  # AR(1) with a memory of ten rows
            fresh = self.rng.normal(size=len(self.sigma))
            self.drift = 0.9 * self.drift + np.sqrt(1 - 0.81) * self.sigma * fresh
            error = self.drift
        else:
            error = self.sigma * self.rng.normal(size=len(self.sigma))
        if self.plan.noise_kind == "quantised" and len(qpos) == len(self.sigma):
            count = self.sigma * np.sqrt(12)
            return np.round(qpos / count) * count
        seen = qpos.copy()
        mujoco.mj_integratePos(self.system.model, seen, error, 1.0)
        return seen

    def speed(self, qvel, seen):
        """qvel (nv,) as recorded: NaN, truth with noise, or differences of positions filtered."""
        if self.plan.velocities == "none":
            return np.full(len(qvel), np.nan)
        if self.plan.velocities == "noisy":
            return qvel + 10 * self.sigma * self.rng.normal(size=len(qvel))
        if self.last is None:
            self.filtered = qvel.copy()
        else:
            rate = np.zeros(len(qvel))
            mujoco.mj_differentiatePos(self.system.model, rate, self.plan.row, self.last, seen)
            self.filtered = self.filtered + 0.5 * (rate - self.filtered)
        self.last = seen
        return self.filtered.copy()
