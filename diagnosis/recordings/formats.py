"""File formats of recordings: CSV, NPZ and Minari, down to named columns {"qpos:elbow": (T,), ...}.

What a column may be called is the model's business (`columns_of`); what its numbers mean is that of recordings.py.
Nothing is ever unpickled. Every fault raises RecordingError with one line: file, row, column, and what to do.
"""

import csv
import difflib
import glob
import io
import os
import stat
import zipfile
import zlib

import mujoco
import numpy as np

LARGEST_NPZ = 4 << 30  # bytes unpacked: a small archive can claim to hold terabytes
WIDTHS = {
    int(mujoco.mjtJoint.mjJNT_FREE): (7, 6),
    int(mujoco.mjtJoint.mjJNT_BALL): (4, 3),
}  # (qpos, qvel); others (1, 1)

PACKED = (  # first bytes of a file, what it is, what to do
    (b"\x1f\x8b", "compressed with gzip", "unpack it first (gunzip)"),
    (b"BZh", "compressed with bzip2", "unpack it first (bunzip2)"),
    (b"\xfd7zXZ", "compressed with xz", "unpack it first (unxz)"),
    (b"7z\xbc\xaf", "a 7z archive", "unpack it first"),
    (
        b"\x89HDF",
        "an HDF5 file",
        "convert it to CSV or NPZ, or name the folder if it is a Minari dataset",
    ),
    (b"MATLAB 5", "a MATLAB file", "export the variables as CSV"),
    (b"\x93NUMPY", "a single NumPy array", "save time, qpos and ctrl together with numpy.savez"),
    (b"PAR1", "a Parquet file", "export it as CSV"),
    (b"SQLite", "a database", "export the topics as CSV"),
    (b"#ROSBAG", "a ROS bag", "export the topics as CSV"),
)


class RecordingError(ValueError):
    """A recording cannot be used. One line: the file, the column, the row, and what to do."""

    def __init__(self, message):
        super().__init__(" ".join(str(message).split()))


def read(path, model):
    """[(label, name, columns, first row)] of one file, or of every episode of a Minari dataset.

    columns: {column name: (T,) float64}; first row: what the file's own reader calls the row of columns[...][0].
    """
    if (
        os.path.isdir(path)
        or not os.path.exists(path)
        and not path.lower().endswith((".csv", ".npz"))
    ):
        return _minari(path, model)
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):
            raise RecordingError(f"{path}: not a regular file; give a CSV or NPZ file")
        with open(path, "rb") as stream:
            data = stream.read()
    except FileNotFoundError:
        raise RecordingError(f"{path}: no such file; check the path") from None
    except OSError as error:
        raise RecordingError(
            f"{path}: cannot be read ({error.strerror}); check its permissions"
        ) from None
    if not data.strip():
        raise RecordingError(f"{path}: the file is empty; record again or leave it out")
    for start, what, do in PACKED:
        if data.startswith(start):
            raise RecordingError(f"{path}: {what}; {do}")
    if path.lower().endswith(".npz") or data[:4] == b"PK\x03\x04":
        return [(path, os.path.basename(path), _npz(path, data, model), 0)]
    first_row, columns = _csv(path, data, model)
    return [(path, os.path.basename(path), columns, first_row)]


# --- columns: what the model calls them -----------------------------------------------------------------------------


def columns_of(model):
    """Every column that a recording of this model can have: {"qpos:elbow": ("qpos", 3), ...}, in MuJoCo's order.

    The value is the kind and the index within qpos, qvel or ctrl; for sensors ("sensor:<name>", component).
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


def _by_index(model):
    """The same columns with every place by its index, for those who write qpos:0 although the joint has a name."""
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


def _resolve(path, header, model):
    """Header cells to canonical column names. Raises RecordingError on unknown, repeated or missing ones."""
    known, by_index = columns_of(model), _by_index(model)
    names = []
    for position, cell in enumerate(header, start=1):
        name = cell.strip()
        if name != "time" and name not in known:
            head, _, component = name.rpartition(":")
            if name in by_index and by_index[name] in known:
                name = by_index[name]
            elif f"{by_index.get(head)}:{component}" in known:
                name = f"{by_index[head]}:{component}"
            else:
                raise RecordingError(
                    f"{path}: column {position} ({name!r}): {_unknown(name, known)}"
                )
        if name in names:
            raise RecordingError(
                f"{path}: column {position} ({name!r}): stands twice in the header; remove one"
            )
        names.append(name)
    for name in ["time", *known]:
        if name not in names and name.startswith(("time", "qpos:", "ctrl:")):
            hint = (
                "filled with nan if that joint was not measured"
                if name.startswith("qpos:")
                else "the simulation cannot be driven without it"
                if name.startswith("ctrl:")
                else "seconds, increasing"
            )
            raise RecordingError(
                f"{path}: column {name!r} is missing from the header; add it ({hint})"
            )
    return names


def _unknown(name, known):
    """Why a header cell is not a column of this model, and which one was perhaps meant."""
    if name == "":
        return "has no name; every column needs one"
    wanted = "time", *known
    wide = [column for column in wanted if column.startswith(name + ":")]
    if wide:
        return f"has {len(wide)} components; write {wide[0]!r} to {wide[-1]!r}"
    kind, _, place = name.partition(":")
    lower = {column.lower(): column for column in wanted}
    close = difflib.get_close_matches(name.lower(), lower, n=1, cutoff=0.6)
    meant = f"; did you mean {lower[close[0]]!r}?" if close else ""
    what = {"qpos": "joint", "qvel": "joint", "ctrl": "actuator", "sensor": "sensor"}.get(kind)
    if what and place:
        options = [column.split(":", 1)[1] for column in known if column.startswith(kind + ":")]
        meant = meant or (
            f"; it has {', '.join(options[:6])}{', ...' if len(options) > 6 else ''}"
            if options
            else f"; it has no {what}s: remove the column"
        )
        return f"the model has no {what} {place!r}{meant}"
    return "not a column of a recording" + (
        meant or "; columns are time, qpos:<joint>, qvel:<joint>, ctrl:<actuator>, sensor:<name>"
    )


# --- CSV ------------------------------------------------------------------------------------------------------------


def _csv(path, data, model):
    """(first row, {column name: (T,) float64}) of a CSV file, rows as an editor counts them: the header is row 1."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise RecordingError(f"{path}: written as UTF-16; save it as UTF-8 CSV")
    if b"\x00" in data:
        raise RecordingError(
            f"{path}: binary data, not CSV; give a text file with a header, or an NPZ"
        )
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        row = data.count(b"\n", 0, error.start) + 1
        raise RecordingError(
            f"{path}: row {row}: not UTF-8 text; save the file as UTF-8 CSV"
        ) from None
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    above, first, body = _header_line(text)
    try:
        header = [cell.strip() for cell in next(csv.reader([first], strict=True), [])]
        header = [
            cell[1:-1] if len(cell) > 1 and cell[0] == cell[-1] == '"' else cell for cell in header
        ]  # quoted after a space
    except csv.Error as error:
        raise RecordingError(
            f"{path}: row {above + 1}: the header cannot be read ({error}); write plain column names"
        ) from None
    if "time" not in header:
        for mark, name in ((";", "semicolons"), ("\t", "tabs"), ("|", "bars"), (" ", "spaces")):
            if "time" in [cell.strip(' "') for cell in first.split(mark)]:
                raise RecordingError(
                    f"{path}: row {above + 1}: columns are separated by {name}; separate them by commas"
                )
        if all(_number(cell) is not None for cell in header):
            raise RecordingError(
                f"{path}: row {above + 1}: no header; the first line must name the columns "
                "(time,qpos:<joint>,...)"
            )
    names = _resolve(path, header, model)
    if not body.strip():
        raise RecordingError(f"{path}: a header and no rows; record again or leave it out")
    try:
        if "\n\n" in "\n" + body.rstrip():
            raise ValueError
        table = np.loadtxt(io.StringIO(body), delimiter=",", ndmin=2, comments=None)
        if table.shape[1] != len(names):
            raise ValueError
    except (
        ValueError,
        OverflowError,
    ):  # something is odd: read it slowly, to say where, or to accept empty cells
        table = _slow(path, body, names, above + 2)
    return above + 2, dict(zip(names, table.T))


def _header_line(text):
    """(lines above it, the header, all that follows): comments may stand above, and numpy.savetxt writes "# time,..."."""
    above, rest = 0, text
    while True:
        first, _, rest = rest.partition("\n")
        bare = first.lstrip("# \t")
        if not first.startswith("#") or "time" in [cell.strip() for cell in bare.split(",")]:
            return above, bare if first.startswith("#") else first, rest
        above += 1


def _slow(path, body, names, first_row):
    """(T, columns) of a CSV body cell by cell: empty cells are NaN, anything else odd raises RecordingError."""
    rows = []
    lines = body.rstrip().split("\n")
    for row, line in enumerate(lines, start=first_row):
        if not line.strip():
            raise RecordingError(
                f"{path}: row {row}: an empty line inside the recording; remove it"
            )
        cells = [cell.strip().strip('"') for cell in line.split(",")]
        if len(cells) != len(names):
            why = (
                " (is the file cut off?)"
                if row == len(lines) + first_row - 1
                else " (is a decimal comma used?)"
                if len(cells) > len(names)
                else ""
            )
            raise RecordingError(
                f"{path}: row {row}: {len(cells)} cells where the header has {len(names)}; repair the "
                f"row{why}"
            )
        values = [float("nan") if cell == "" else _number(cell) for cell in cells]
        if None in values:
            k = values.index(None)
            raise RecordingError(
                f"{path}: row {row}, column {names[k]!r}: {cells[k][:40]!r} is not a number; "
                "write nan for what was not measured"
            )
        rows.append(values)
    return np.array(rows, dtype=float)


def _number(cell):
    try:
        return None if "_" in cell else float(cell)  # Python alone reads 1_000 as a number
    except ValueError:
        return None


# --- NPZ ------------------------------------------------------------------------------------------------------------


def _npz(path, data, model):
    """{column name: (T,) float64} of an NPZ archive, without ever unpickling."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            if sum(member.file_size for member in archive.infolist()) > LARGEST_NPZ:
                raise RecordingError(
                    f"{path}: unpacks to more than {LARGEST_NPZ >> 30} GiB; split the recording"
                )
            if "[Content_Types].xml" in archive.namelist():
                raise RecordingError(f"{path}: an Excel workbook; save the sheet as CSV")
        arrays = {}
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            for key in archive.files:
                if key in ("time", "qpos", "qvel", "ctrl") or key.startswith("sensor:"):
                    try:
                        arrays[key] = archive[key]
                    except ValueError as error:
                        if "pickle" in str(error).lower():
                            raise RecordingError(
                                f"{path}: array {key!r} holds pickled objects, which are never loaded; "
                                "save a plain array of floats"
                            ) from None
                        raise
                else:
                    close = difflib.get_close_matches(
                        key.lower(), ("time", "qpos", "qvel", "ctrl"), n=1, cutoff=0.7
                    )
                    if close:
                        raise RecordingError(
                            f"{path}: array {key!r} is not known; did you mean {close[0]!r}?"
                        )
    except RecordingError:
        raise
    except (
        ValueError,
        OSError,
        EOFError,
        KeyError,
        MemoryError,
        RuntimeError,
        NotImplementedError,
        OverflowError,
        SyntaxError,
        TypeError,
        AttributeError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        raise RecordingError(
            f"{path}: not a readable NPZ file ({type(error).__name__}); save it again with "
            "numpy.savez"
        ) from None
    return by_column(path, arrays, model)


def by_column(path, arrays, model):
    """Whole arrays (time, qpos, qvel, ctrl, sensor:<name>) to {column name: (T,)}; raises RecordingError on widths."""
    known = columns_of(model)
    widths = {"qpos": model.nq, "qvel": model.nv, "ctrl": model.nu}
    for kind, _ in known.values():
        if kind.startswith("sensor:"):
            widths[kind] = widths.get(kind, 0) + 1
    arrays = dict(arrays)
    for key in ("time", "qpos", *(["ctrl"] if model.nu else [])):
        if key not in arrays:
            raise RecordingError(
                f"{path}: array {key!r} is missing; a recording has time (T,), qpos (T, {model.nq}), "
                f"ctrl (T, {model.nu})"
            )
    for key, array in arrays.items():
        if array.dtype.kind not in "fiu":
            raise RecordingError(
                f"{path}: array {key!r} holds {array.dtype} instead of real numbers; save it as float64"
            )
        if key not in widths and key != "time":
            raise RecordingError(f"{path}: array {key!r}: {_unknown(key, known)}")
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
            hint = ""
            if key == "ctrl" and array.shape == (len(time) - 1, widths[key]):
                hint = "; repeat the last row: a control belongs to every time"
            elif array.ndim == 2 and array.shape[::-1] == (len(time), widths[key]):
                hint = "; transpose it"
            elif array.ndim == 2 and array.shape[1] != widths[key]:
                hint = f"; this model has {widths[key]} of them"
            raise RecordingError(
                f"{path}: array {key!r} has shape {array.shape} instead of "
                f"({len(time)}, {widths[key]}){hint}"
            )
        for k in range(widths[key]):
            columns[inverse[key, k]] = array[:, k]
    return columns


# --- Minari ---------------------------------------------------------------------------------------------------------


def _minari(path, model):
    """What `read` returns, one for each episode of a Minari dataset, given by id or by folder."""
    if not os.path.exists(path) and "/" not in path and "-v" not in path:
        raise RecordingError(f"{path}: no such file; check the path")
    for pattern in ("*.csv", "*.npz"):
        if glob.glob(os.path.join(glob.escape(path), pattern)):
            raise RecordingError(
                f"{path}: a folder; name the files in it, as in {os.path.join(path, pattern)}"
            )
    try:
        import minari
    except ImportError:
        what = "a folder" if os.path.isdir(path) else "neither a file nor a folder"
        raise RecordingError(
            f"{path}: {what}; give CSV or NPZ files (a Minari dataset needs: pip install "
            "'minari[hdf5]')"
        ) from None
    try:
        if os.path.isdir(path):
            data = os.path.join(path, "data")
            dataset = minari.MinariDataset(data if os.path.isdir(data) else path)
        else:
            dataset = minari.load_dataset(path)
        env = dataset.recover_environment()
        dt = float(env.unwrapped.dt)
        env.close()
        episodes = [
            (episode.id, _episode(path, episode, model, dt))
            for episode in dataset.iterate_episodes()
        ]
    except RecordingError:
        raise
    except Exception as error:  # whatever an optional package and a broken folder can raise
        raise RecordingError(
            f"{path}: not a readable Minari dataset ({error}); give its id, its folder, or CSV "
            "files"
        ) from None
    if not episodes:
        raise RecordingError(f"{path}: the dataset holds no episodes; record some or leave it out")
    name = os.path.basename(os.path.normpath(path))
    return [
        (f"{path} episode {number}", f"{name}:{number}", by_column(path, arrays, model), 0)
        for number, arrays in episodes
    ]


def _episode(path, episode, model, dt):
    """Arrays of one Minari episode. qpos and qvel come from its infos where stored, else from the observation, which
    in gymnasium's MuJoCo tasks is (qpos, qvel), often without the root's leading positions: those are NaN."""
    actions = np.asarray(episode.actions, dtype=float).reshape(len(episode.actions), -1)
    ctrl = np.vstack([actions, actions[-1:]])  # the last state has no action of its own
    infos = episode.infos or {}
    if "qpos" in infos and "qvel" in infos:
        qpos, qvel = np.asarray(infos["qpos"], dtype=float), np.asarray(infos["qvel"], dtype=float)
    else:
        if isinstance(episode.observations, dict):
            raise RecordingError(
                f"{path}: observations are a dictionary without qpos and qvel infos; convert it to NPZ"
            )
        seen = np.asarray(episode.observations, dtype=float)
        left_out = model.nq + model.nv - (seen.shape[1] if seen.ndim == 2 else 0)
        if left_out not in (0, 1, 2):
            raise RecordingError(
                f"{path}: observations of shape {seen.shape} are not (qpos, qvel) of this model "
                f"({model.nq} + {model.nv}); convert it to NPZ"
            )
        qpos = np.full((len(seen), model.nq), np.nan)
        qpos[:, left_out:] = seen[:, : model.nq - left_out]
        qvel = seen[:, model.nq - left_out :].copy()
        qvel[np.abs(qvel) == 10] = np.nan  # where Hopper and Walker2d clip the observed velocity
    return {
        "time": dt * np.arange(len(qpos)),
        "qpos": qpos,
        "qvel": qvel,
        "ctrl": ctrl[: len(qpos)],
    }
