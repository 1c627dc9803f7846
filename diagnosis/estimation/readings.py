"""What sensors that are off show of a motion, and the motion behind what they show.

qpos, qvel = shown(model, setting, recordings, qpos, qvel)
qpos, qvel = behind(model, setting, recordings, qpos, qvel)
"""

import numpy as np
from scipy.interpolate import CubicHermiteSpline


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
