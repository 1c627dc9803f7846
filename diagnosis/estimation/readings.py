"""What sensors that are off show of a motion, the motion behind what they show, and the noise of
recordings alone: a floor for what a smoother may call noise.

qpos, qvel = shown(model, setting, recordings, qpos, qvel)
qpos, qvel = behind(model, setting, recordings, qpos, qvel)
recording = undone(model, setting, recording)
position, velocity = measurement_noise(model, recordings)   # (nv,), (nv,); inf where never measured
"""

from dataclasses import replace

import mujoco
import numpy as np
from scipy.interpolate import CubicHermiteSpline

from diagnosis.estimation.windowing import difference, joint_slices, pooled
from diagnosis.estimation.windowing import states as filled
from diagnosis.recordings.quality import encoder_quantum

# of differences: what a smooth motion leaves falls with the order, noise does not
ORDERS = range(2, 9)


def shown(model, setting, recordings, qpos, qvel):
    """Positions (rows, nq) and velocities (rows, nv) over all recordings as the sensors of hinges
    and slides show them under a setting {Candidate: values}: shifted, scaled and late."""
    show = lambda value, offset, ratio: ratio * value + offset
    return _each(model, setting, recordings, qpos, qvel, -1.0, show)


def behind(model, setting, recordings, qpos, qvel):
    """The motion that is shown as qpos, qvel: shown() turned back, steady beyond the last row."""
    true = lambda value, offset, ratio: (value - offset) / ratio
    return _each(model, setting, recordings, qpos, qvel, 1.0, true)


def later(model, setting, recordings, known):
    """known (rows, nv), NaN where nothing was measured, of the motion behind: NaN too where the
    recording ends before a late sensor shows it."""
    known = known.copy()
    for joint, (_, ratio, delay) in _measures(model, setting):
        d = joint.dofadr[0]
        for time, rows in _pieces(recordings):
            if delay:
                known[rows, d] = np.interp(time + delay, time, known[rows, d], right=np.nan)
            known[rows, d] /= ratio
    return known


def undone(model, setting, recording):
    """A Recording as it would be if the sensors of hinges and slides were not off, as far as that
    was measured."""
    off = _measures(model, setting)
    if not off:
        return recording
    own, given = (np.array(recording.qpos), np.array(recording.qvel)), (model, setting, [recording])
    states = behind(*given, *filled(model, recording))
    known = difference(model, own[0], own[0]), own[1]
    for read, state, here, at in zip(own, states, known, ("qposadr", "dofadr")):
        there = np.isfinite(later(*given, here))
        for joint, _ in off:
            k, d = getattr(joint, at)[0], joint.dofadr[0]
            read[:, k] = np.where(there[:, d], state[:, k], np.nan)
    return replace(recording, qpos=own[0], qvel=own[1])


def _each(model, setting, recordings, qpos, qvel, sign, change):
    """(qpos, qvel) at other times, by a delay before or after, and with other values."""
    qpos, qvel = qpos.copy(), qvel.copy()
    for joint, (offset, ratio, delay) in _measures(model, setting):
        q, d = joint.qposadr[0], joint.dofadr[0]
        for time, rows in _pieces(recordings):
            position, speed = qpos[rows, q], qvel[rows, d]
            if delay and len(time) > 1:
                position, speed = _at(time, position, speed, time + sign * delay)
            qpos[rows, q] = change(position, offset, ratio)
            qvel[rows, d] = change(speed, 0.0, ratio)
    return qpos, qvel


def _measures(model, setting):
    """[(joint, (offset, ratio, delay))] of the effects that move what a joint's sensor shows."""
    off = [c for c in setting if c.effect.overrides("measure") and c.place.kind == "joint"]
    return [(model.joint(c.place.name), c.effect.measure(setting[c])) for c in off]


def _pieces(recordings):
    """[(time, slice of rows)] of recordings one after the other."""
    ends = np.cumsum([0] + [len(r.time) for r in recordings])
    return [(r.time, slice(a, b)) for r, a, b in zip(recordings, ends[:-1], ends[1:])]


def _at(time, position, speed, then):
    """Positions and speeds (rows,) at other times: at rest before the first row, steady after the
    last one."""
    inside = np.clip(then, time[0], time[-1])
    path = CubicHermiteSpline(time, position, speed)(inside)
    return path + np.maximum(then - time[-1], 0.0) * speed[-1], np.interp(then, time, speed)


def difference_noise(time, column):
    """Standard deviation of white noise in one column (T,), by divided differences on its time
    stamps (T,), which annihilate a polynomial; their quantile keeps impacts and standstill out. inf
    where nothing moves."""
    known = np.isfinite(column)
    time, column = time[known], column[known]
    if not len(column) or np.ptp(column) == 0:
        return np.inf
    each = [_divided(time, column, order) for order in ORDERS]
    estimates = [np.quantile(np.abs(d), 0.8) / 1.2816 for d in each if len(d) >= 5]
    best = min(estimates, default=np.inf)
    if len(estimates) > 2:  # what still falls with the order is motion, and falls on
        best *= min(1.0, estimates[-1] / estimates[-3]) ** 2
    step = encoder_quantum(column)
    return max(best, step / np.sqrt(12)) if best or step else np.inf


def _divided(time, column, order):
    """Divided differences of an order, their weights scaled to unit norm: (T - order,)."""
    n = len(time) - order
    if n < 1:
        return np.zeros(0)
    near = np.arange(n)[:, None] + np.arange(order + 1)
    t = time[near]
    gap = (t[:, :, None] - t[:, None]) / np.median(np.diff(time)) + np.eye(order + 1)
    weight = 1 / gap.prod(2)
    weight /= np.linalg.norm(weight, axis=1, keepdims=True)
    return (weight * column[near]).sum(1)


def measurement_noise(model, recordings):
    """Noise of each dof's position and velocity, (nv,), (nv,); inf where nothing was measured."""
    noise = np.full((2, model.nv), np.inf)
    for dof in range(model.nv):
        columns = [(_tangent_column(model, r, dof), (r.time, r.qvel[:, dof])) for r in recordings]
        for kind, own in enumerate(zip(*columns)):
            each = np.array([difference_noise(*column) for column in own])
            if np.isfinite(each).any():
                noise[kind, dof] = np.median(each[np.isfinite(each)])
    return pooled(model, noise[0]), pooled(model, noise[1])  # components of one channel share it


def _tangent_column(model, recording, dof):
    """Time and position (n,) of one dof; of a rotation its sum of small turns."""
    for _, kind, q, v in joint_slices(model):
        if v.start <= dof < v.stop:
            if kind in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
                return recording.time, recording.qpos[:, q.start]
            if kind == mujoco.mjtJoint.mjJNT_FREE and dof < v.start + 3:
                return recording.time, recording.qpos[:, q.start + dof - v.start]
            known = np.isfinite(recording.qpos[:, q.stop - 4 : q.stop]).all(1)
            qpos, time = recording.qpos[known], recording.time[known]
            turned = np.cumsum(difference(model, qpos[:-1], qpos[1:])[:, dof])
            return time[1:], turned
    raise IndexError(dof)
