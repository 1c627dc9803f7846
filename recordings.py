"""Recordings of the real system: read them, refuse what cannot be used, warn about what looks wrong.

    recordings = load(["run1.csv", "run2.npz"], model)     # model: the nominal mujoco.MjModel
    for warning in check(recordings, model):
        print(warning)

A CSV has a header `time`, `qpos:<joint>`, optional `qvel:<joint>`, `ctrl:<actuator>`, optional `sensor:<name>`; free
and ball joints and wide sensors take a component, `qpos:<joint>:0`. An unnamed joint, actuator or sensor goes by its
index. An NPZ has `time (T,)`, `qpos (T, nq)`, `ctrl (T, nu)` and optionally `qvel (T, nv)` and `sensor:<name> (T, k)`.
A Minari dataset (id or folder) gives one recording per episode. Units are SI: s, m, rad, N, N·m.

Row t is the state at time[t] and the control held from time[t] to time[t+1]. NaN, or an empty cell, is "not measured".
"""
import os
from dataclasses import dataclass, field

import numpy as np

from readers import WIDTHS, RecordingError, columns_of, read

LARGEST = {"time": 1e300, "qpos": 1e6, "qvel": 1e6, "ctrl": 1e9, "sensor": 1e12}  # beyond these no unit explains a value


@dataclass(frozen=True)
class Recording:
    """One continuous run. NaN: not measured. Columns stand in MuJoCo's order.

    name: file name; time (T,) s, increasing; qpos (T, nq) m or rad; qvel (T, nv), all NaN when absent;
    ctrl (T, nu), without NaN; sensors: name -> (T, k).
    """
    name: str
    time: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    ctrl: np.ndarray
    sensors: dict = field(default_factory=dict)


def load(paths, model):
    """Read files or Minari datasets into a list of Recording, in the order given.

    paths: one path or several (.csv, .npz, Minari id or folder). model: mujoco.MjModel whose names they use.
    Raises RecordingError on the first thing that is wrong.
    """
    paths = [paths] if isinstance(paths, (str, os.PathLike)) else list(paths)
    if not paths:
        raise RecordingError("no recordings given: name at least one CSV or NPZ file")
    paths = [os.fspath(path) for path in paths]
    real = [os.path.realpath(path) for path in paths]
    for path, where in zip(paths, real):
        if real.count(where) > 1:
            raise RecordingError(f"{path}: given twice; name each recording once, and none both for fitting and as held out")
    short = [os.path.basename(where) for where in real]
    recordings = []
    for path, where in zip(paths, real):
        for label, name, columns, first_row in read(path, model):
            if short.count(os.path.basename(where)) > 1:  # run1/data.csv, run2/data.csv: findings need to tell them apart
                name = os.path.join(os.path.basename(os.path.dirname(where)), name)
            recordings.append(_recording(label, name, columns, model, first_row))
    return recordings


def _recording(path, name, columns, model, first_row):
    """Columns to a Recording. Raises RecordingError on time that does not increase, NaN controls, impossible values."""
    time = columns["time"]
    for column, values in columns.items():
        kind = column.split(":")[0]
        bad = np.isinf(values) | (np.abs(values) > LARGEST[kind])
        if kind in ("time", "ctrl"):
            bad |= np.isnan(values)
        if bad.any():
            row = int(np.argmax(bad))
            do = {"time": "every row needs a time in seconds", "ctrl": "every row needs its control"}.get(
                kind, "write nan where nothing was measured, and SI units elsewhere")
            raise RecordingError(f"{path}: row {row + first_row}, column {column!r}: {values[row]:g}; {do}")
    if len(time) < 2:
        raise RecordingError(f"{path}: {len(time)} row{'s' * (len(time) != 1)}: not enough data; a run needs at least two "
                             "rows, and some seconds of motion to say anything")
    back = np.diff(time) <= 0
    if back.any():
        row = int(np.argmax(back)) + 1
        word = "repeats" if time[row] == time[row - 1] else "runs backward from"
        raise RecordingError(f"{path}: row {row + first_row}, column 'time': {time[row]:.9g} {word} {time[row - 1]:.9g}; "
                             "remove repeated rows, sort them, and put separate runs into separate files")
    arrays = {"qpos": np.full((len(time), model.nq), np.nan), "qvel": np.full((len(time), model.nv), np.nan),
              "ctrl": np.zeros((len(time), model.nu))}
    sensors = {}
    known = columns_of(model)
    for column, values in columns.items():
        if column == "time":
            continue
        kind, k = known[column]
        if kind.startswith("sensor:"):
            width = sum(place == kind for place, _ in known.values())
            sensors.setdefault(kind[len("sensor:"):], np.full((len(time), width), np.nan))[:, k] = values
        else:
            arrays[kind][:, k] = values
    if model.nq and np.isnan(arrays["qpos"]).all():
        raise RecordingError(f"{path}: no position is measured, every qpos is nan; at least one joint is needed")
    _quaternions(path, arrays["qpos"], model, first_row)
    return Recording(name, time, sensors=sensors, **arrays)


def _quaternions(path, qpos, model, first_row):
    """Raises RecordingError where a free or ball joint's quaternion is not one."""
    for j in range(model.njnt):
        if model.jnt_type[j] not in WIDTHS:
            continue
        end = model.jnt_qposadr[j] + WIDTHS[model.jnt_type[j]][0]
        norm = np.linalg.norm(qpos[:, end - 4:end], axis=1)  # w x y z
        partly = np.isnan(norm) & ~np.isnan(qpos[:, end - 4:end]).all(axis=1)
        bad = partly | (np.abs(norm - 1) > 0.02)
        if bad.any():
            row = int(np.argmax(bad))
            what = "is partly nan" if partly[row] else f"has length {norm[row]:.4g} instead of 1"
            raise RecordingError(f"{path}: row {row + first_row}, columns 'qpos:{model.joint(j).name or j}:{end - 4 - model.jnt_qposadr[j]}' "
                                 f"and the next three: the quaternion {what}; order is w x y z")
