"""Reads a trajectory that was simulated in equal time steps at any times."""

import mujoco
import numpy as np

from diagnosis.simulation.control_signal import SLACK

FREE, BALL = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)


def read(model, q, v, time, step, delay):
    """qpos (n, rows, nq), qvel (n, rows, nv) at times (n, rows) after the first state; NaN where
    time is.

    q (n, 1 + count, nq), v: the trajectory at every step. Between steps, positions follow the
    cubic through positions and velocities, velocities the line, quaternions the normalized line.
    delay (n, hinges and slides): these are read that much earlier, but not before the first state.
    """
    missing = np.isnan(time)
    x = time / step
    s, k, after, f = locate(x, q.shape[1])
    qpos, qvel = q[s, k], v[s, k]
    if f.any():
        g = f[..., None]
        qpos, qvel = (1 - g) * qpos + g * q[s, after], (1 - g) * qvel + g * v[s, after]
        for j in range(model.njnt):
            a, d = model.jnt_qposadr[j], model.jnt_dofadr[j]
            if model.jnt_type[j] == FREE:
                for i in range(3):
                    qpos[..., a + i] = _cubic(q[..., a + i], v[..., d + i], s, k, after, f, step)
                a += 3
            if model.jnt_type[j] in (FREE, BALL):
                qpos[..., a : a + 4] /= np.linalg.norm(qpos[..., a : a + 4], axis=-1, keepdims=True)
    hinges_and_slides = np.flatnonzero(~np.isin(model.jnt_type, (FREE, BALL)))
    for c, j in enumerate(hinges_and_slides):
        a, d = model.jnt_qposadr[j], model.jnt_dofadr[j]
        if f.any() or delay[:, c].any():
            s, k, after, part = locate(np.maximum(x - delay[:, c, None] / step, 0.0), q.shape[1])
            qpos[..., a] = _cubic(q[..., a], v[..., d], s, k, after, part, step)
            qvel[..., d] = (1 - part) * v[s, k, d] + part * v[s, after, d]
    qpos[missing] = qvel[missing] = np.nan
    return qpos, qvel


def locate(x, length):
    """Simulation, step, the step after it and the fraction between them, in x's shape, of times x
    (n, ...) in steps. Within SLACK of a step that alone is read: the fraction is 0, and the step
    after it is itself."""
    x = np.nan_to_num(x)
    k = np.clip(np.floor(x + SLACK).astype(int), 0, length - 1)
    fraction = np.where(abs(x - k) <= 1.5 * SLACK, 0.0, x - k)
    s = np.arange(len(x)).reshape(-1, *[1] * (x.ndim - 1))
    after = np.minimum(k + (fraction > 0), length - 1)
    return np.broadcast_to(s, x.shape), k, after, fraction


def _cubic(q, v, s, k, after, f, step):
    """Cubic Hermite of positions q and velocities v (n, 1 + count) at fraction f between steps k
    and after."""
    q0, q1, v0, v1 = q[s, k], q[s, after], v[s, k] * step, v[s, after] * step
    return q0 + f * v0 + f**2 * (3 * (q1 - q0) - 2 * v0 - v1) + f**3 * (2 * (q0 - q1) + v0 + v1)
