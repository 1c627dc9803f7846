"""Measurement noise from the recordings alone: a floor for what a smoother may call noise.

position, velocity = measurement_noise(model, recordings)       # (nv,), (nv,); inf where never
measured
"""

import mujoco
import numpy as np

from diagnosis.estimation.windowing import difference, joint_slices, pooled
from diagnosis.recordings.quality import encoder_quantum

# of differences: what a smooth motion leaves falls with the order, noise does not
ORDERS = range(2, 9)


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
