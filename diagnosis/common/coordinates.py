"""Joint coordinates: quaternions, the tangent space, names of joints and channels.

Positions qpos (nq) and differences of them (nv) as MuJoCo has them; everything works on arrays of
any leading shape.
"""

import mujoco
import numpy as np


def _quat_multiply(a, b):
    w, x, y, z = np.moveaxis(a, -1, 0)
    p, q, r, s = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            w * p - x * q - y * r - z * s,
            w * q + x * p + y * s - z * r,
            w * r - x * s + y * p + z * q,
            w * s + x * r - y * q + z * p,
        ],
        -1,
    )


def _rotation_vector(quat):
    """(..., 4) unit quaternions -> (..., 3) rotation vectors of at most half a turn."""
    quat = np.where(quat[..., :1] < 0, -quat, quat)
    sine = np.linalg.norm(quat[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, quat[..., :1])
    return quat[..., 1:] * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)


def _quat_of(vector):
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.concatenate([np.cos(angle / 2), vector * 0.5 * np.sinc(angle / (2 * np.pi))], -1)


def joint_slices(model):
    """(joint id, type, qpos slice, dof slice) for every joint."""
    sizes = {mujoco.mjtJoint.mjJNT_FREE: (7, 6), mujoco.mjtJoint.mjJNT_BALL: (4, 3)}
    for j in range(model.njnt):
        kind = mujoco.mjtJoint(model.jnt_type[j])
        nq, nv = sizes.get(kind, (1, 1))
        q, v = model.jnt_qposadr[j], model.jnt_dofadr[j]
        yield j, kind, slice(q, q + nq), slice(v, v + nv)


def difference(model, start, end):
    """end - start in the tangent space: (..., nq), (..., nq) -> (..., nv), as mj_differentiatePos
    with dt = 1."""
    out = np.empty(np.broadcast_shapes(start.shape, end.shape)[:-1] + (model.nv,))
    for _, kind, q, v in joint_slices(model):
        a, b = start[..., q], end[..., q]
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            out[..., v.start : v.start + 3] = b[..., :3] - a[..., :3]
            a, b, v = a[..., 3:], b[..., 3:], slice(v.start + 3, v.stop)
        elif kind != mujoco.mjtJoint.mjJNT_BALL:
            out[..., v] = b - a
            continue
        out[..., v] = _rotation_vector(_quat_multiply(a * np.array([1.0, -1, -1, -1]), b))
    return out


def integrate(model, qpos, step):
    """qpos + step, step in the tangent space: (..., nq), (..., nv) -> (..., nq)."""
    out = np.empty(np.broadcast_shapes(qpos.shape[:-1], step.shape[:-1]) + (model.nq,))
    for _, kind, q, v in joint_slices(model):
        a, d = qpos[..., q], step[..., v]
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            out[..., q.start : q.start + 3] = a[..., :3] + d[..., :3]
            a, d, q = a[..., 3:], d[..., 3:], slice(q.start + 3, q.stop)
        elif kind != mujoco.mjtJoint.mjJNT_BALL:
            out[..., q] = a + d
            continue
        quat = _quat_multiply(a, _quat_of(d))
        out[..., q] = quat / np.linalg.norm(quat, axis=-1, keepdims=True)
    return out


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
            turned = np.cumsum((quat[known[1:]] * quat[known[:-1]]).sum(1) < 0) % 2
            quat[known[1:]] *= np.where(turned, -1.0, 1.0)[:, None]
        for i in range(q.start, q.stop):
            if np.isfinite(qpos[:, i]).any() or rotation:
                qpos[:, i] = _filled(time, qpos[:, i], model.qpos0[i])
            else:
                speed = _filled(time, qvel[:, v.start], 0.0)
                gone = np.cumsum(speed[:-1] * np.diff(time))
                qpos[:, i] = model.qpos0[i] + np.concatenate([[0], gone])
        if rotation:
            quat /= np.maximum(np.linalg.norm(quat, axis=1, keepdims=True), 1e-9)
    before = np.maximum(np.arange(len(time)) - 1, 0)
    after = np.minimum(np.arange(len(time)) + 1, len(time) - 1)
    central = difference(model, qpos[before], qpos[after]) / (time[after] - time[before])[:, None]
    return qpos, np.where(np.isfinite(qvel), qvel, central)


def joint_name(model, joint):
    """What columns call a joint: its name, or its index where it has none."""
    return model.joint(joint).name or str(joint)


def channels(model):
    """{channel name: dofs}: one per hinge and slide, ":pos" and ":rot" for a free joint."""
    out = {}
    for j, kind, _, v in joint_slices(model):
        name = "qpos:" + joint_name(model, j)
        dofs = np.arange(v.start, v.stop)
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            out[name + ":pos"], out[name + ":rot"] = dofs[:3], dofs[3:]
        else:
            out[name] = dofs
    return out
