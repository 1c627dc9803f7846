"""What sensors that are off show of a motion: how far it lies from the motion itself.

q, v = beside(model, setting, recordings, qpos, qvel)     # shown less true, (rows, nv) each
shown = slopes(model, setting) @ true                     # of small changes (q, v)
"""

import numpy as np
from scipy.interpolate import CubicHermiteSpline


def beside(model, setting, recordings, qpos, qvel):
    """Shown less true positions and velocities, (rows, nv) in the tangent space, of a motion qpos
    (rows, nq), qvel (rows, nv) over all recordings: 0 but in hinges and slides whose sensors a
    setting {Candidate: values} moves, scales or delays."""
    q, v = np.zeros_like(qvel), np.zeros_like(qvel)
    ends = np.cumsum([0] + [len(r.time) for r in recordings])
    for joint, (offset, ratio, delay) in _measures(model, setting):
        d, true = joint.dofadr[0], qpos[:, joint.qposadr[0]]
        for recording, a, b in zip(recordings, ends[:-1], ends[1:]):
            late, speed = _earlier(recording.time, true[a:b], qvel[a:b, d], delay)
            q[a:b, d] += ratio * late + offset - true[a:b]
            v[a:b, d] += ratio * speed - qvel[a:b, d]
    return q, v


def slopes(model, setting):
    """(2 nv, 2 nv): how shown positions and velocities change with the true ones."""
    out, nv = np.eye(2 * model.nv), model.nv
    for joint, (_, ratio, delay) in _measures(model, setting):
        d = joint.dofadr[0]
        out[d] *= ratio
        out[d, nv + d] -= ratio * delay
        out[nv + d] *= ratio
    return out


def _measures(model, setting):
    """[(joint, (offset, ratio, delay))] of the effects that move what a joint's sensor shows."""
    shown = [c for c in setting if c.effect.overrides("measure") and c.place.kind == "joint"]
    return [(model.joint(c.place.name), c.effect.measure(setting[c])) for c in shown]


def _earlier(time, position, speed, seconds):
    """Positions and speeds (rows,) as they were so many seconds before; at rest before the first
    row."""
    if not seconds or len(time) < 2:
        return position, speed
    then = np.maximum(time - seconds, time[0])
    return CubicHermiteSpline(time, position, speed)(then), np.interp(then, time, speed)
