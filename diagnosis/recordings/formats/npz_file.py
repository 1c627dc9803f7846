"""NPZ: the arrays time (T,), qpos (T, nq), ctrl (T, nu), optional qvel (T, nv) and sensor:<name>
(T, k), in MuJoCo's order.

With a column map, arrays of any other names too: `name` is one of (T,), `name[k]` column k of one
of (T, n).
"""

import difflib
import io
import zipfile
import zlib

import numpy as np

from diagnosis.recordings.columns import RecordingError, by_column
from diagnosis.recordings.layout import Layout, Raw

LARGEST_NPZ = 4 << 30  # bytes unpacked: a small archive can claim to hold terabytes
OURS = "time", "qpos", "qvel", "ctrl"
DAMAGED = (  # what numpy raises on archives that are not what they claim
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
)


class NpzFile:
    """Reads NumPy's archives of arrays, without ever unpickling."""

    def read(self, path, name, data, model, layout: Layout) -> list[Raw]:
        """The one run of an archive whose bytes are `data`. Raises RecordingError."""
        arrays = _arrays(path, data, anything=layout.mapped)
        if not layout.mapped:
            columns = by_column(path, arrays, model)
            return [Raw(path, name, columns, {column: column for column in columns})]
        columns = apart(arrays)
        if len({len(values) for values in columns.values()}) > 1:
            lengths = ", ".join(f"{key} {len(array)}" for key, array in arrays.items())
            raise RecordingError(
                f"{path}: arrays of different lengths ({lengths}); every one needs T rows"
            )
        return [Raw(path, name, columns, {column: column for column in columns})]


def apart(arrays):
    """{"name": (T,), "name[k]": (T,)} of the numbers among arrays (T,) and (T, n)."""
    columns = {}
    for key, array in arrays.items():
        if array.dtype.kind in "fiub" and array.ndim == 1:
            columns[key] = array.astype(float)
        elif array.dtype.kind in "fiub" and array.ndim == 2:
            columns |= {f"{key}[{k}]": array[:, k].astype(float) for k in range(array.shape[1])}
    return columns


def _arrays(path, data, anything):
    """{name: array} of an archive: what a recording has, or anything."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            if sum(member.file_size for member in archive.infolist()) > LARGEST_NPZ:
                raise RecordingError(
                    f"{path}: unpacks to more than {LARGEST_NPZ >> 30} GiB; split the recording"
                )
            if "[Content_Types].xml" in archive.namelist():
                raise RecordingError(f"{path}: an Excel workbook; save the sheet as CSV")
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            known = [key for key in archive.files if _known(path, key, anything)]
            return {key: _array(path, archive, key) for key in known}
    except RecordingError:
        raise
    except DAMAGED as error:
        raise RecordingError(
            f"{path}: not a readable NPZ file ({type(error).__name__}); save it again with "
            "numpy.savez"
        ) from None


def _known(path, key, anything):
    """Whether an array is read. Raises RecordingError where its name seems misspelt."""
    if anything or key in OURS or key.startswith("sensor:"):
        return True
    close = difflib.get_close_matches(key.lower(), OURS, n=1, cutoff=0.7)
    if close:
        raise RecordingError(f"{path}: array {key!r} is not known; did you mean {close[0]!r}?")
    return False


def _array(path, archive, key):
    """One array. Raises RecordingError where it would have to be unpickled."""
    try:
        return archive[key]
    except ValueError as error:
        if "pickle" in str(error).lower():
            raise RecordingError(
                f"{path}: array {key!r} holds pickled objects, which are never loaded; save a "
                "plain array of floats"
            ) from None
        raise
