"""Recordings cut into windows: start states, residuals and the error that everybody reports.

    windows = consecutive(recording, horizon=0.3)
    start_qpos, start_qvel = recorded_starts(model, windows)
    qpos, qvel = world.simulate(settings, start_qpos, start_qvel, windows)
    rms, per_channel = error(model, windows, qpos, noise)

A window is (recording, first row, last row), both rows inside. Position differences live in the
tangent space of the joints (nv numbers), so that quaternions need no special case further up.
"""

import mujoco
import numpy as np

from diagnosis.common.coordinates import channels, difference, integrate, joint_name, joint_slices
from diagnosis.simulation.simulator import Window

__all__ = ["channels", "difference", "integrate", "joint_name", "joint_slices"]

HORIZON = 0.3  # s, of the error that is reported
ENDLESS = 1e100  # m or rad: whoever is farther off is nowhere


def recordings_of(windows):
    """The recordings that windows were cut from, each once."""
    return list(dict.fromkeys(w.recording for w in windows))


def sampling(recordings):
    """Usual time between the rows of recordings, s."""
    return np.median([np.median(np.diff(r.time)) for r in recordings])


def evenly(number, most):
    """At most so many of 0 .. number - 1, evenly spread: indices, ascending."""
    return np.unique(np.linspace(0, number - 1, min(number, most)).round().astype(int))


# ---- states ------------------------------------------------------------------------------------


def _filled(time, column, default):
    good = np.isfinite(column)
    return np.interp(time, time[good], column[good]) if good.any() else np.full(len(time), default)


def states(model, recording):
    """Recorded states without holes: qpos (T, nq); qvel (T, nv) as measured, else by central
    difference. What was never measured is made up: positions by summing measured velocities from
    the model's qpos0, else qpos0 and rest."""
    time = recording.time
    qpos, qvel = np.array(recording.qpos, float), np.array(recording.qvel, float)
    for _, kind, q, v in joint_slices(model):
        rotation = kind in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL)
        quat = qpos[:, q.stop - 4 : q.stop] if rotation else None
        if rotation:  # q and -q are one: between holes too
            known = np.flatnonzero(np.isfinite(quat).all(1))
            quat[known[1:]] *= np.where(
                np.cumsum((quat[known[1:]] * quat[known[:-1]]).sum(1) < 0) % 2, -1.0, 1.0
            )[:, None]
        for i in range(q.start, q.stop):
            if np.isfinite(qpos[:, i]).any() or rotation:
                qpos[:, i] = _filled(time, qpos[:, i], model.qpos0[i])
            else:
                speed = _filled(time, qvel[:, v.start], 0.0)
                qpos[:, i] = model.qpos0[i] + np.concatenate(
                    [[0], np.cumsum(speed[:-1] * np.diff(time))]
                )
        if rotation:
            quat /= np.maximum(np.linalg.norm(quat, axis=1, keepdims=True), 1e-9)
    before = np.maximum(np.arange(len(time)) - 1, 0)
    after = np.minimum(np.arange(len(time)) + 1, len(time) - 1)
    central = difference(model, qpos[before], qpos[after]) / (time[after] - time[before])[:, None]
    return qpos, np.where(np.isfinite(qvel), qvel, central)


def consecutive(recording, horizon=HORIZON, first=0, end=None):
    """Windows of horizon seconds end to end (one's last row is the next one's first) in rows first
    to end, that not included; an incomplete last one is dropped, but if there is no other."""
    time, out = recording.time[:end], []
    sample, start = np.median(np.diff(recording.time)), first
    while first < len(time) - 1:
        last = int(np.searchsorted(time, time[first] + horizon + 0.01 * sample, side="right")) - 1
        last = max(last, first + 1)
        if time[-1] < time[first] + horizon - 0.5 * sample:
            break
        out.append(Window(recording, first, last))
        first = last
    return out or [Window(recording, start, len(time) - 1)]


def beginning(window, seconds):
    """The first seconds of a window, three rows at least where it has as many."""
    time = window.recording.time[window.first : window.last + 1]
    rows = int(np.searchsorted(time, time[0] + seconds * (1 + 1e-9), side="right")) - 1
    return window._replace(last=min(window.last, window.first + max(rows, 3)))


def recorded_starts(model, windows):
    """Start states as the error defines them: qpos (W, nq), qvel (W, nv)."""
    known = {r: states(model, r) for r in recordings_of(windows)}
    pick = [(known[w.recording], w.first) for w in windows]
    return np.array([s[0][i] for s, i in pick]), np.array([s[1][i] for s, i in pick])


def measured(windows, field="qpos"):
    """The recorded rows of every window, (W, T, ...), padded with NaN to the longest."""
    each = [getattr(w.recording, field)[w.first : w.last + 1] for w in windows]
    out = np.full((len(each), max(map(len, each)), *each[0].shape[1:]), np.nan)
    for row, rows in zip(out, each):
        row[: len(rows)] = rows
    return out


def known(model, windows):
    """Whether something was measured in the rows of windows, (W, T, nv)."""
    rows = measured(windows)
    return np.isfinite(difference(model, rows, rows))


def gaps(model, windows, qpos):
    """Measured less predicted (W, T - 1, nv) after the starts, 0 where nothing was measured and
    infinite where a prediction blew up, and where something was measured."""
    residual = difference(model, qpos, measured(windows))[:, 1:]
    there = known(model, windows)[:, 1:]
    return np.where(there, np.where(abs(residual) < ENDLESS, residual, np.inf), 0.0), there


def squares(gap, known, noise):
    """Parts (W,) of the squared error over all channels, in noises, by window. gap, known: see
    gaps(); noise (nv,)."""
    return ((gap / noise) ** 2).sum((1, 2)) / max(known.sum(), 1)


def by_channel(model, square, known):
    """{channel: RMS, SI} of squared errors (..., nv), of what is known (..., nv)."""
    rms = lambda dofs: float(np.sqrt(square[..., dofs].sum() / known[..., dofs].sum()))
    return {name: rms(dofs) for name, dofs in channels(model).items() if known[..., dofs].any()}


def error(model, windows, qpos, noise):
    """The reported error of predictions qpos (W, T, nq): over all channels, in noises (nv,), and
    {channel: SI}."""
    gap, known = gaps(model, windows, qpos)
    return float(np.sqrt(squares(gap, known, noise).sum())), by_channel(model, gap**2, known)


def pooled(model, noise):
    """noise (nv,) with that of each channel from its components that moved; inf where none did."""
    out = np.full_like(noise, np.inf)
    for dofs in channels(model).values():
        finite = noise[dofs][np.isfinite(noise[dofs])]
        out[dofs] = np.sqrt(np.mean(finite**2)) if len(finite) else np.inf
    return out
