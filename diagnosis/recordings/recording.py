"""Recordings of the real system: read them, refuse what cannot be used.

    recordings = load(["run1.csv", "run2.npz"], model)     # model: the nominal mujoco.MjModel

A CSV has a header `time`, `qpos:<joint>`, optional `qvel:<joint>`, `ctrl:<actuator>`, optional
`sensor:<name>`; free and ball joints and wide sensors take a component, `qpos:<joint>:0`. An
unnamed joint, actuator or sensor goes by its index. An NPZ has `time (T,)`, `qpos (T, nq)`, `ctrl
(T, nu)` and optionally `qvel (T, nv)` and `sensor:<name> (T, k)`. ROS 2 bags, LeRobot and Minari
datasets and PACE dictionaries are read too (formats/), and columns under other names by a Layout
(columns.py). Units are SI: s, m, rad, N, N·m.

Row t is the state at time[t] and the control held from time[t] to time[t+1]. NaN, or an empty cell,
is "not measured".
"""

import os
from dataclasses import dataclass, field, replace

import numpy as np

from diagnosis.recordings.columns import WIDTHS, RecordingError, by_column, columns_of
from diagnosis.recordings.formats import read
from diagnosis.recordings.layout import Layout

LARGEST = {
    "time": 1e300,
    "qpos": 1e6,
    "qvel": 1e6,
    "ctrl": 1e9,
    "sensor": 1e12,
}  # beyond these no unit explains a value


@dataclass(frozen=True, eq=False)
class Recording:
    """One continuous run, equal to itself alone. NaN: not measured. Columns stand in MuJoCo's
    order.

    name: file name; time (T,) s, increasing; origin: the stamp that it counts from, s; qpos (T,
    nq) m or rad; qvel (T, nv), all NaN when absent; ctrl (T, nu), without NaN; sensors: name ->
    (T, k). start: the row from which on it is predicted where it is held out; those before only
    say what led there, such as controls that are still on their way. gains: {joint: {"kp",
    "kd"}} of the controllers whose targets the controls are, where the file says so. notes:
    what its reader found odd, one line each. quality: what was done to it before
    (quality.Quality), once that was looked at.
    """

    name: str
    time: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    ctrl: np.ndarray
    sensors: dict = field(default_factory=dict)
    start: int = 0
    gains: dict = field(default_factory=dict)
    notes: tuple = ()
    quality: object = None
    origin: float = 0.0

    def seen(self):
        """The rows from `start` on, as a Recording of their own."""
        return self.part(self.start, None)

    def part(self, first, end):
        """Rows first to end, without that, as a Recording of their own."""
        rows = slice(first, end)
        fields = {f: getattr(self, f)[rows] for f in ("time", "qpos", "qvel", "ctrl")}
        sensors = {name: values[rows] for name, values in self.sensors.items()}
        return replace(self, **fields, sensors=sensors, start=0)


def load(paths, model, layout=Layout()):
    """Read files, bags and datasets into a list of Recording, in the order given.

    paths: one path or several. model: mujoco.MjModel whose names they use, or to whose names
    `layout` brings them. Raises RecordingError on the first thing that is wrong.
    """
    paths = [paths] if isinstance(paths, (str, os.PathLike)) else list(paths)
    if not paths:
        raise RecordingError("no recordings given: name at least one CSV or NPZ file")
    paths = [os.fspath(path) for path in paths]
    real = [os.path.realpath(path) for path in paths]
    for path, where in zip(paths, real):
        if real.count(where) > 1:
            raise RecordingError(f"{path}: given twice; name each recording once")
    out = []
    for path, folders in zip(paths, _folders(paths)):
        for raw in read(path, model, layout):
            plan = layout.plan(raw.label, raw.columns, raw.natural, model)
            columns, gains = plan.apply(raw.label, raw.columns, model)
            made = _recording(raw.label, folders + raw.name, columns, model, raw.first_row)
            notes = (*raw.notes, *plan.doubts(columns))
            out.append(replace(made, gains=gains, notes=notes))
    return out


def _folders(paths):
    """What has to stand in front of the last part of each path to tell it from the others': "", or
    "run1/" of run1/data.csv."""
    parts, out = [os.path.abspath(path).split(os.sep) for path in paths], []
    for mine in parts:
        most = next(
            n
            for n in range(1, len(mine) + 1)
            if sum(other[-n:] == mine[-n:] for other in parts) == 1
        )
        out.append("".join(f"{part}/" for part in mine[-most:-1]))
    return out


def accepted(recording, model):
    """A Recording that somebody made in Python, as `load` would have made it. Raises RecordingError
    as `load` does; rows are counted from 0."""
    name, arrays = (
        str(recording.name),
        {"time": recording.time, "qpos": recording.qpos, "ctrl": recording.ctrl},
    )
    if recording.qvel is not None:
        arrays["qvel"] = recording.qvel
    arrays |= {f"sensor:{sensor}": values for sensor, values in (recording.sensors or {}).items()}
    columns = by_column(name, {key: np.asarray(values) for key, values in arrays.items()}, model)
    made = _recording(name, name, columns, model, 0)
    if not 0 <= recording.start < len(made.time) - 1:
        raise RecordingError(
            f"{name}: start is row {recording.start} of {len(made.time)}; at least two rows have "
            f"to "
            "follow it"
        )
    return replace(made, start=recording.start, gains=recording.gains, notes=tuple(recording.notes))


def _recording(path, name, columns, model, first_row):
    """Columns to a Recording. Raises RecordingError on time that does not increase, NaN controls
    but in the last row, impossible values."""
    time = columns["time"]
    columns = {c: _possible(path, c, values, first_row) for c, values in columns.items()}
    _increasing(path, time, first_row)
    arrays = {
        "qpos": np.full((len(time), model.nq), np.nan),
        "qvel": np.full((len(time), model.nv), np.nan),
        "ctrl": np.zeros((len(time), model.nu)),
    }
    sensors = {}
    known = columns_of(model)
    for column, values in columns.items():
        if column == "time":
            continue
        kind, k = known[column]
        if kind.startswith("sensor:"):
            width = sum(place == kind for place, _ in known.values())
            empty = np.full((len(time), width), np.nan)
            sensors.setdefault(kind[len("sensor:") :], empty)[:, k] = values
        else:
            arrays[kind][:, k] = values
    if model.nq and np.isnan(arrays["qpos"]).all():
        raise RecordingError(
            f"{path}: no position is measured, every qpos is nan; at least one joint is needed"
        )
    _quaternions(path, arrays["qpos"], model, first_row)
    name = name.encode("utf-8", "replace").decode()  # it can hold any byte
    # curves over time and a fading gain count from where a recording begins
    return Recording(name, time - time[0], sensors=sensors, origin=float(time[0]), **arrays)


def _possible(path, column, values, first_row):
    """The values of a column. Raises RecordingError on one that no unit explains, or that is
    missing where it must not."""
    kind = column.split(":")[0]
    if kind == "ctrl" and len(values) > 1 and np.isnan(values[-1]):
        # it would act after the last row: some loggers leave it out
        values = np.append(values[:-1], values[-2])
    bad = np.isinf(values) | (np.abs(values) > LARGEST[kind])
    if kind in ("time", "ctrl"):
        bad |= np.isnan(values)
    if bad.any():
        row = int(np.argmax(bad))
        do = {
            "time": "every row needs a time in seconds",
            "ctrl": "every row needs its control",
        }.get(kind, "write nan where nothing was measured, and SI units elsewhere")
        raise RecordingError(
            f"{path}: row {row + first_row}, column {column!r}: {values[row]:g}; {do}"
        )
    return values


def _increasing(path, time, first_row):
    """Raises RecordingError where there are no two times, or one is no later than the one
    before."""
    if len(time) < 2:
        raise RecordingError(
            f"{path}: {len(time)} row{'s' * (len(time) != 1)}: not enough data; a run needs at "
            "least two rows, and some seconds of motion to say anything"
        )
    back = np.diff(time) <= 0
    if back.any():
        row = int(np.argmax(back)) + 1
        word = "repeats" if time[row] == time[row - 1] else "runs backward from"
        do = (
            "write time with more digits"
            if word == "repeats" and back.mean() > 0.2 and np.ptp(time) > 0
            else "remove repeated rows, sort them, and put separate runs into separate files"
        )
        raise RecordingError(
            f"{path}: row {row + first_row}, column 'time': {time[row]:.15g} {word} "
            f"{time[row - 1]:.15g}; {do}"
        )


def _quaternions(path, qpos, model, first_row):
    """Raises RecordingError where a free or ball joint's quaternion is not one."""
    for j in range(model.njnt):
        if model.jnt_type[j] not in WIDTHS:
            continue
        end = model.jnt_qposadr[j] + WIDTHS[model.jnt_type[j]][0]
        norm = np.linalg.norm(qpos[:, end - 4 : end], axis=1)  # w x y z
        partly = np.isnan(norm) & ~np.isnan(qpos[:, end - 4 : end]).all(axis=1)
        bad = partly | (np.abs(norm - 1) > 0.02)
        if bad.any():
            row = int(np.argmax(bad))
            what = "is partly nan" if partly[row] else f"has length {norm[row]:.4g} instead of 1"
            first = f"qpos:{model.joint(j).name or j}:{end - 4 - model.jnt_qposadr[j]}"
            raise RecordingError(
                f"{path}: row {row + first_row}, column {first!r} and the next three: the "
                f"quaternion {what}; "
                "order is w x y z"
            )
