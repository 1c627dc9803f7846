"""What was done to recordings before they were handed over: facts for the estimator, and for the
user to read.

    quality = assess(recording, model)
    quality.quantum["qpos:elbow"]         # the encoder's step, rad
    for line in told(recordings, model): print(line)

Found are encoders' steps, velocities that are filtered differences of the positions beside them,
time stamps that jitter (and whether the rows themselves were taken evenly), rows left out, and rows
interpolated from a slower rate.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import mujoco
import numpy as np

from diagnosis.recordings.columns import WIDTHS
from diagnosis.recordings.plausibility import grouped

LATTICE = 0.95  # share of steps between values that are whole numbers of one quantum
FLOOR = 0.6  # of an encoder's step: noise below this is the step's own, 0.29 of it by itself
ORDER = 3  # of differences that leave noise of a smooth motion
WHITE = 0.5  # ratio of noises by differences of one order more: below, motion is left in them
EXPLAINED = 0.9  # share of the velocity's noise that the positions' noise makes up
LAGS = range(-3, 9)  # rows; a filter that looks ahead was applied afterwards
UNEVEN = 0.02  # of the usual time between rows
SMOOTHER = 1.5  # times as smooth on an even grid: then the stamps are late, not the rows
STRAIGHT = 0.3  # share of rows on the straight line between their neighbours


class Differenced(NamedTuple):
    """A velocity formed from positions. delay: s by which it lags; explained: share of its
    noise."""

    delay: float
    explained: float


@dataclass(frozen=True)
class Quality:
    """What was done to one recording.

    quantum: {column: step, its unit}, of positions whose readings are whole numbers of it;
    differenced: {joint: Differenced}; period: s between rows, usually; jitter: s, standard
    deviation of the stamps about an even grid; even: the rows were taken evenly although their
    stamps jitter; skipped: share of rows left out; rows_from: s between the rows from which these
    were interpolated, None where they are as they were taken.
    """

    quantum: Mapping[str, float] = field(default_factory=dict)
    differenced: Mapping[str, Differenced] = field(default_factory=dict)
    period: float = 0.0
    jitter: float = 0.0
    even: bool = True
    skipped: float = 0.0
    rows_from: float | None = None

    @property
    def jitters(self):
        """Whether the stamps are away from an even grid."""
        return self.jitter > UNEVEN * self.period


def assess(recording, model: mujoco.MjModel) -> Quality:
    """The Quality of one recording."""
    quantum, differenced, sources = {}, {}, []
    for name, q, v in _coordinates(recording, model):
        step = encoder_quantum(q)
        if step:
            quantum[f"qpos:{name}"] = step
        if found := differenced_velocity(recording.time, q, v):
            differenced[name] = found
        sources.append(interpolated_from(recording.time, q))
    period, jitter, skipped = stamps(recording.time)
    positions = [q for _, q, _ in _coordinates(recording, model)]
    even = jitter <= UNEVEN * period or taken_evenly(recording.time, positions)
    sources = [s for s in sources if s]
    rows_from = float(np.median(sources)) if 2 * len(sources) > len(positions) else None
    return Quality(quantum, differenced, period, jitter, even, skipped, rows_from)


def evenly_stamped(recording):
    """A recording of known Quality, at stamps of an even grid where its rows were taken evenly."""
    if not (recording.quality.jitters and recording.quality.even):
        return recording
    time, rows = recording.time, _rows(recording.time)
    return replace(recording, time=time[0] + rows * (time[-1] - time[0]) / rows[-1])


def _rows(time):
    """(T,) number of each row of an even grid, those that were left out counted."""
    steps = np.diff(time)
    return np.append(0, np.cumsum(np.maximum(np.rint(steps / np.median(steps)), 1)))


def told(recordings, model: mujoco.MjModel) -> list[str]:
    """What is worth knowing of the recordings' quality, one line for each kind of thing."""
    found = {}
    for recording in recordings:
        for line in _lines(recording, recording.quality or assess(recording, model), model):
            found.setdefault(line, []).append((recording.name, None))
    return grouped(found)


def _lines(recording, quality, model):
    """What is worth knowing of one recording."""
    for name, q, _ in _coordinates(recording, model):
        step = quality.quantum.get(f"qpos:{name}", 0.0)
        if step and _by_differences(q[np.isfinite(q)], ORDER + 2) < FLOOR * step:
            yield (
                f"qpos:{name} is read in steps of {step:.3g}; no motion finer than that is told "
                "from noise"
            )
    for name, how in quality.differenced.items():
        yield (
            f"qvel:{name} is no measurement of its own but a filtered difference of qpos:{name}, "
            f"{1e3 * how.delay:.1f} ms late; it adds nothing to the positions"
        )
    if quality.jitters:
        what = (
            "the rows were taken evenly: an even grid fits the motion better, and takes their place"
            if quality.even
            else "the motion follows them"
        )
        yield f"time stamps jitter by {1e3 * quality.jitter:.2g} ms; {what}"
    if quality.skipped > 0.005:
        yield f"about {100 * quality.skipped:.0f} % of the rows were left out, by their time stamps"
    if quality.rows_from:
        yield (
            "rows seem interpolated on straight lines between rows "
            f"{1e3 * quality.rows_from:.3g} ms apart; what "
            "happens faster than that is not in them"
        )


def _coordinates(recording, model):
    """(name, positions (T,), velocities (T,)) of every hinge and slide."""
    for j in range(model.njnt):
        if model.jnt_type[j] not in WIDTHS:
            name = model.joint(j).name or str(j)
            yield (
                name,
                recording.qpos[:, model.jnt_qposadr[j]],
                recording.qvel[:, model.jnt_dofadr[j]],
            )


def encoder_quantum(values: np.ndarray) -> float:
    """The step of which all differences between values (T,) are whole multiples; 0 where there is
    none."""
    levels = np.unique(values[np.isfinite(values)])
    steps = np.diff(levels)
    steps = steps[steps > 1e-9 * max(1.0, np.abs(levels).max(initial=0))]
    if len(steps) < 3:
        return 0.0
    for parts in (1, 2, 3):  # where it moves fast, hardly two readings are neighbours
        step = steps.min() / parts
        for most in (1.5, 3.5, 8.5, 20.5):  # rounding in the file tells on large multiples
            near = steps[steps < most * parts * step]
            step = near.sum() / np.rint(near / step).sum()
        whole = np.rint(steps / step)
        if np.mean(np.abs(steps / step - whole) < 0.1) > LATTICE:
            return float(steps.sum() / whole.sum())
    return 0.0


def differenced_velocity(time, position, velocity) -> Differenced | None:
    """How a velocity (T,) is a filter of the positions' differences, or None where it is a
    measurement of its own.

    The noise of positions and that of a velocity sensor have nothing to do with each other; the
    noise of a difference is that of the positions. Compared are differences of ORDER, in which
    noise is all that is left of smooth motion; where motion is left there is no telling.
    """
    both = np.isfinite(position) & np.isfinite(velocity)
    if both.mean() < 0.9 or both.sum() < 20 * len(LAGS):
        return None
    dt = float(np.median(np.diff(time)))
    rate = np.append(0.0, np.diff(np.interp(time, time[both], position[both])) / dt)
    speed = np.interp(time, time[both], velocity[both])
    if not _is_noise(rate[1:]):
        return None
    x, y = np.diff(rate, ORDER), np.diff(speed, ORDER)
    rows = np.arange(LAGS[-1] + 1, len(x) + LAGS[0])
    past = [y[rows - 1], y[rows - 2]]
    design = np.column_stack([x[rows - lag] for lag in LAGS] + past)
    # what a velocity's own past says of it is no evidence: only what positions add to that
    fit, alone = (
        np.linalg.lstsq(d, y[rows], rcond=None)[0] for d in (design, np.column_stack(past))
    )
    left = np.var(y[rows] - design @ fit) / np.var(y[rows] - np.column_stack(past) @ alone)
    if not 1 - left > EXPLAINED:
        return None
    ahead, back = fit[: len(LAGS)], fit[len(LAGS) :]
    if not 0.3 < ahead.sum() / (1 - back.sum()) < 3:
        return None
    delay = (ahead @ np.array(LAGS)) / ahead.sum() + (back @ [1, 2]) / (1 - back.sum())
    return Differenced(float(dt * (delay + 0.5)), float(1 - left))


def _is_noise(values):
    """Whether high differences of (T,) leave noise and no motion: then one order more finds as
    much."""
    sizes = [_by_differences(values, order) for order in (ORDER, ORDER + 2)]
    return sizes[0] > 0 and sizes[1] > WHITE * sizes[0]


def _by_differences(values, order):
    """The size of what differences of an order leave, as of white noise."""
    binomials = np.poly(np.ones(order))
    return float(np.sqrt(np.mean(np.diff(values, order) ** 2)) / np.linalg.norm(binomials))


def stamps(time: np.ndarray) -> tuple[float, float, float]:
    """(usual time between rows, standard deviation of stamps about an even grid, share of rows left
    out)."""
    steps = np.diff(time)
    period = float(np.median(steps))
    rows = np.cumsum(np.maximum(np.rint(steps / period), 1))
    if rows[-1] > len(steps):  # the median is that of a jittering clock
        period = float((time[-1] - time[0]) / rows[-1])
    jitter = float(np.std(steps - period * np.maximum(np.rint(steps / period), 1)) / np.sqrt(2))
    return period, jitter, float(1 - len(steps) / rows[-1])


def taken_evenly(time: np.ndarray, positions: list[np.ndarray]) -> bool:
    """Whether the motion is smoother with rows an even time apart than at their stamps: of all
    joints together, for where one is slow its noise is the same with either."""
    rows, ratios = _rows(time), []
    for q in positions:
        known = np.isfinite(q)
        if known.sum() > 20 and np.ptp(q[known]) > 0:
            stamped, even = (_roughness(t[known], q[known]) for t in (time, rows))
            ratios.append(stamped / even if even else 1.0)
    return bool(ratios) and float(np.prod(ratios)) > SMOOTHER


def _roughness(time, values):
    """RMS distance of values (T,) from the cubic through two neighbours on either side, where they
    move."""
    t = [time[k : len(time) - 4 + k] for k in range(5)]
    x = [values[k : len(values) - 4 + k] for k in range(5)]
    near = (0, 1, 3, 4)
    guess = sum(
        x[i] * np.prod([(t[2] - t[j]) / (t[i] - t[j]) for j in near if j != i], axis=0)
        for i in near
    )
    return float(np.sqrt(np.mean((guess - x[2]) ** 2)))


def interpolated_from(time: np.ndarray, values: np.ndarray) -> float | None:
    """s between the rows from which (T,) values were interpolated on straight lines, or None.

    On such a line three rows in one have no second difference; in measured rows noise and motion
    leave one.
    """
    known = np.isfinite(values)
    time, values = time[known], values[known]
    if len(values) < 50 or encoder_quantum(values):  # between an encoder's steps lies nothing
        return None
    slope = np.diff(values) / np.diff(time)
    bend, moving = np.abs(np.diff(slope)), np.abs(slope[1:]) > 0
    size = np.quantile(bend[moving], 0.9) if moving.any() else 0.0
    if size == 0 or moving.mean() < 0.5:
        return None
    straight = (bend < 1e-3 * size) & moving
    if straight.sum() < STRAIGHT * moving.sum():
        return None
    # between bends of one line lie as many rows as the slower clock has time between its own
    knots = np.flatnonzero(~straight & moving)
    apart = np.diff(time[1:-1][knots])
    step = np.median(np.diff(time))
    return float(np.sum(apart) / max(1, np.sum(apart > 1.5 * step))) if len(apart) > 10 else None
