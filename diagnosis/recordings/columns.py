"""Columns of a recording: what a model calls them.

columns_of(model)                   # {"qpos:elbow": ("qpos", 3), ...}: every column there can be
Names(model).canonical("qpos:1")    # "qpos:elbow"
"""

import difflib
from collections.abc import Mapping

import mujoco
import numpy as np

WIDTHS = {
    int(mujoco.mjtJoint.mjJNT_FREE): (7, 6),
    int(mujoco.mjtJoint.mjJNT_BALL): (4, 3),
}  # (qpos, qvel); others (1, 1)
GAINS = "kp", "kd"
BY_JOINT = "effort", "target", *GAINS


class RecordingError(ValueError):
    """A recording cannot be used. One line: the file, the column, the row, and what to do."""

    def __init__(self, message):
        super().__init__(" ".join(str(message).split()))


# --- what the model calls them


def columns_of(model: mujoco.MjModel) -> dict:
    """Every column that a recording of this model can have: {"qpos:elbow": ("qpos", 3), ...}, in
    MuJoCo's order.

    The value is the kind and the index within qpos, qvel or ctrl; for sensors ("sensor:<name>",
    component).
    """
    table = {}

    def add(kind, place, width, start):
        for k in range(width):
            table[f"{kind}:{place}" + (f":{k}" if width > 1 else "")] = (kind, start + k)

    for j in range(model.njnt):
        widths = WIDTHS.get(model.jnt_type[j], (1, 1))
        add("qpos", model.joint(j).name or str(j), widths[0], model.jnt_qposadr[j])
        add("qvel", model.joint(j).name or str(j), widths[1], model.jnt_dofadr[j])
    for a in range(model.nactuator):  # one without an input has no control, and a few have several
        add(
            "ctrl",
            model.actuator(a).name or str(a),
            model.actuator_ctrlnum[a],
            model.actuator_ctrladr[a],
        )
    for s in range(model.nsensor):
        place = model.sensor(s).name or str(s)
        for k in range(model.sensor_dim[s]):
            wide = model.sensor_dim[s] > 1
            table[f"sensor:{place}" + (f":{k}" if wide else "")] = (f"sensor:{place}", k)
    return table


def single_joints(model: mujoco.MjModel) -> list[str]:
    """Names of the hinges and slides, in MuJoCo's order."""
    return [
        model.joint(j).name or str(j) for j in range(model.njnt) if model.jnt_type[j] not in WIDTHS
    ]


def _by_index(model):
    """The same columns with every place by its index, for those who write qpos:0 although the joint
    has a name."""
    table = {}
    for kind, count, named in (
        ("qpos", model.njnt, model.joint),
        ("qvel", model.njnt, model.joint),
        ("ctrl", model.nactuator, model.actuator),
        ("sensor", model.nsensor, model.sensor),
    ):
        for i in range(count):
            table[f"{kind}:{i}"] = f"{kind}:{named(i).name or i}"
    return table


class Names:
    """The names that columns of one model can have."""

    def __init__(self, model: mujoco.MjModel):
        self.known, self.by_index = columns_of(model), _by_index(model)
        self.by_joint = {f"{kind}:{j}" for j in single_joints(model) for kind in BY_JOINT}

    def canonical(self, name: str) -> str | None:
        """The model's name of a column called `name`, perhaps by an index; None: not one of this
        model's."""
        if name == "time" or name in self.known or name in self.by_joint:
            return name
        head, _, component = name.rpartition(":")
        for other in (self.by_index.get(name), f"{self.by_index.get(head)}:{component}"):
            if other in self.known:
                return other
        return None

    def unknown(self, name: str) -> str:
        """Why `name` is not a column of this model, and which one was perhaps meant."""
        if name == "":
            return "has no name; every column needs one"
        wanted = "time", *self.known
        wide = [column for column in wanted if column.startswith(name + ":")]
        if wide:
            return f"has {len(wide)} components; write {wide[0]!r} to {wide[-1]!r}"
        kind, _, place = name.partition(":")
        lower = {column.lower(): column for column in wanted}
        close = difflib.get_close_matches(name.lower(), lower, n=1, cutoff=0.6)
        meant = f"; did you mean {lower[close[0]]!r}?" if close else ""
        what = {"ctrl": "actuator", "sensor": "sensor"}.get(
            kind, "joint" if kind in ("qpos", "qvel", *BY_JOINT) else None
        )
        if what and place:
            like = "qpos:" if what == "joint" else kind + ":"
            options = [column.split(":", 1)[1] for column in self.known if column.startswith(like)]
            meant = meant or (
                f"; it has {', '.join(options[:6])}{', ...' if len(options) > 6 else ''}"
                if options
                else f"; it has no {what}s: remove the column"
            )
            return f"the model has no {what} {place!r}{meant}"
        return "not a column of a recording" + (
            meant
            or "; columns are time, qpos:<joint>, qvel:<joint>, ctrl:<actuator>, sensor:<name> "
            "(or give --map)"
        )


# --- whole arrays
#
#
#


def by_column(path: str, arrays: Mapping[str, np.ndarray], model: mujoco.MjModel) -> dict:
    """Whole arrays (time, qpos, qvel, ctrl, sensor:<name>) to {column name: (T,)}; raises
    RecordingError on widths."""
    names = Names(model)
    known = names.known
    widths = {"qpos": model.nq, "qvel": model.nv, "ctrl": model.nu}
    for kind, _ in known.values():
        if kind.startswith("sensor:"):
            widths[kind] = widths.get(kind, 0) + 1
    arrays = dict(arrays)
    for key in ("time", "qpos", *(["ctrl"] if model.nu else [])):
        if key not in arrays:
            raise RecordingError(
                f"{path}: array {key!r} is missing; a recording has time (T,), qpos (T, "
                f"{model.nq}), "
                f"ctrl (T, {model.nu})"
            )
    for key, array in arrays.items():
        if array.dtype.kind not in "fiu":
            raise RecordingError(
                f"{path}: array {key!r} holds {array.dtype} instead of real numbers; save it as "
                f"float64"
            )
        if key not in widths and key != "time":
            raise RecordingError(f"{path}: array {key!r}: {names.unknown(key)}")
    time = np.asarray(arrays.pop("time"), dtype=float)
    if time.ndim == 2 and time.shape[1] == 1:
        time = time[:, 0]
    if time.ndim != 1:
        raise RecordingError(f"{path}: array 'time' has shape {time.shape}; it must be (T,)")
    columns = {"time": time}
    inverse = {place: name for name, place in known.items()}
    for key, array in arrays.items():
        array = np.asarray(array, dtype=float)
        if array.ndim == 1 and widths[key] == 1:
            array = array[:, None]
        if array.shape != (len(time), widths[key]):
            raise RecordingError(
                f"{path}: array {key!r} has shape {array.shape} instead of "
                f"({len(time)}, {widths[key]}){_shape_hint(key, array, len(time), widths[key])}"
            )
        for k in range(widths[key]):
            columns[inverse[key, k]] = array[:, k]
    return columns


def _shape_hint(key, array, rows, width):
    """What to do about an array that has another shape than (rows, width)."""
    if key == "ctrl" and array.shape == (rows - 1, width):
        return "; repeat the last row: a control belongs to every time"
    if array.ndim == 2 and array.shape[::-1] == (rows, width):
        return "; transpose it"
    if array.ndim == 2 and array.shape[1] != width:
        return f"; this model has {width} of them"
    return ""
