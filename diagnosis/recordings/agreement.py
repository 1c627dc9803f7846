"""Columns of a recording against each other: a velocity and its position's change, a servo's target
and its joint's position.

check_rates(recording, model, warn); check_targets(recording, model)
"""

import numpy as np

from diagnosis.recordings.columns import RecordingError
from diagnosis.recordings.layout import is_servo, joint_of

LEAST_SWING = 1.0  # degrees: who moves less by its targets did not record degrees by mistake


def check_rates(recording, model, warn):
    """Measured velocities against the change of the positions beside them: units, signs, order."""
    names, gone, travelled = _paths(recording, model)
    for i, name in enumerate(names):
        same = _alike(gone[i], travelled[i])
        if same is None:
            continue
        where = f"{recording.name}: column 'qvel:{name}'"
        if same < 0.5:
            for other, title in enumerate(names):
                if other != i and (_alike(gone[i], travelled[other]) or 0) > max(0.95, same + 0.4):
                    raise RecordingError(
                        f"{where}: does not follow 'qpos:{name}', but 'qvel:{title}' does; the "
                        "columns are swapped"
                    )
        if same < -0.9:
            raise RecordingError(
                f"{where}: has the opposite sign of the change of 'qpos:{name}'; turn one of them "
                "round"
            )
        if same > 0.9:
            _check_scale(where, name, gone[i], travelled[i])
        elif same < 0.5:
            warn(
                recording,
                f"qvel:{name} hardly follows the change of qpos:{name} (correlation {same:.2f})",
            )


def _paths(recording, model):
    """(names, changes of position, integrals of velocity) over some 60 ms from every row.

    Of each coordinate whose velocity is its derivative: a ball joint's is none of its quaternion's.
    """
    time = recording.time
    stride = max(1, int(round(0.03 / np.median(np.diff(time)))))
    names, gone, travelled = [], [], []
    if len(time) < 4 * stride + 8:
        return names, gone, travelled
    for j in range(model.njnt):
        if model.jnt_type[j] == 1:
            continue
        for k in range(3 if model.jnt_type[j] == 0 else 1):
            q = recording.qpos[:, model.jnt_qposadr[j] + k]
            v = recording.qvel[:, model.jnt_dofadr[j] + k]
            step = 0.5 * (v[1:] + v[:-1]) * np.diff(time)
            integral, holes = (
                np.concatenate([[0], np.cumsum(x)]) for x in (np.nan_to_num(step), np.isnan(step))
            )
            whole = holes[2 * stride :] == holes[: -2 * stride]
            gone.append(q[2 * stride :] - q[: -2 * stride])
            way = integral[2 * stride :] - integral[: -2 * stride]
            travelled.append(np.where(whole, way, np.nan))
            part = f":{k}" if model.jnt_type[j] == 0 else ""
            names.append((model.joint(j).name or str(j)) + part)
    return names, gone, travelled


def check_targets(recording, model):
    """Raises RecordingError where a servo's targets follow the positions in another unit."""
    for a in range(model.nactuator):
        joint = joint_of(model, a)
        if joint is None or not is_servo(model, a):
            continue
        target = recording.ctrl[:, model.actuator_ctrladr[a]]
        q = recording.qpos[:, model.jnt_qposadr[model.joint(joint).id]]
        known = np.isfinite(q)
        target, q = target[known] - target[known].mean(), q[known] - q[known].mean()
        if known.sum() < 20 or not target.any() or not q.any():
            continue
        ratio = np.sqrt((target @ target) / (q @ q))
        swing = max(np.std(target), np.std(q))  # of what would be in degrees
        if swing < LEAST_SWING:  # a weak servo in resonance, or one that others move
            continue
        if _alike(target, q) > 0.8 and (0.7 < ratio / 57.3 < 1.4 or 0.7 < ratio * 57.3 < 1.4):
            which = ("target", "position") if ratio > 1 else ("position", "target")
            raise RecordingError(
                f"{recording.name}: the {which[0]}s of joint {joint!r} are in degrees beside its "
                f"{which[1]}s in rad, mixed units; convert one of them (--map with a scale)"
            )


def _alike(a, b):
    """The correlation about 0 of two (N,), where both are known; None: nothing to compare."""
    both = ~np.isnan(a) & ~np.isnan(b)
    if both.sum() < 20:
        return None
    a, b = a[both], b[both]
    size = np.sqrt((a @ a) * (b @ b))
    return (a @ b) / size if size > 1e-12 * both.sum() else None


def _check_scale(where, name, gone, travelled):
    """Raises RecordingError where a velocity is a multiple of its position's change."""
    both = ~np.isnan(gone) & ~np.isnan(travelled)
    ratio = np.sqrt((travelled[both] @ travelled[both]) / (gone[both] @ gone[both]))
    if 0.4 < ratio < 2.5:
        return
    units = (
        (57.3, "qvel is in degrees beside qpos in rad, mixed units"),
        (1 / 57.3, "qpos is in degrees beside qvel in rad/s, mixed units"),
        (1000, "qvel is in mm/s, or time in ms"),
        (1e-3, "qpos is in mm"),
    )
    why = next(
        (text for factor, text in units if 0.7 < ratio / factor < 1.4),
        "one of them is in another unit",
    )
    raise RecordingError(
        f"{where}: is {ratio:.3g} times the change of 'qpos:{name}' per second; it seems {why}: "
        "use SI units"
    )
