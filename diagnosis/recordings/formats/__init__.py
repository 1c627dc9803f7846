"""File formats of recordings, one class each: down to columns by the file's own names.

    for raw in read("run.csv", model, Layout()): ...

CSV, NPZ, ROS 2 bags, LeRobot datasets, PACE dictionaries and Minari datasets. Those that need a
library of their own name it where it is not installed. Nothing is ever unpickled. Every fault
raises RecordingError with one line: file, row, column, and what to do.
"""

import glob
import os
import stat

from diagnosis.recordings.columns import RecordingError
from diagnosis.recordings.formats.csv_file import CsvFile
from diagnosis.recordings.formats.lerobot_dataset import LeRobotDataset
from diagnosis.recordings.formats.minari_dataset import MinariDataset
from diagnosis.recordings.formats.npz_file import NpzFile
from diagnosis.recordings.formats.pace_dictionary import PaceDictionary
from diagnosis.recordings.formats.ros_bag import RosBag
from diagnosis.recordings.layout import Layout, Raw

__all__ = ["read"]

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
    (b"#ROSBAG", "a ROS 1 bag", "convert it to ROS 2 (rosbags-convert)"),
)
BAGS = (b"SQLite format 3\x00", b"\x89MCAP0\r\n")


def read(path: str, model, layout: Layout) -> list[Raw]:
    """The runs of one file or folder, each with columns by the file's own names. Raises
    RecordingError."""
    if os.path.isdir(path) or not os.path.exists(path) and not os.path.splitext(path)[1]:
        return _folder(path, model, layout)
    data = _bytes(path)
    name, suffix = os.path.basename(path), os.path.splitext(path)[1].lower()
    if data.startswith(BAGS) or suffix in (".db3", ".mcap"):
        return RosBag().read(path, model, layout)
    if data[:4] == b"PAR1" or suffix == ".parquet":
        return LeRobotDataset().read(path, model, layout)
    if suffix in (".pt", ".pth"):
        return PaceDictionary().read(path, name, data, model, layout)
    if suffix == ".npz" or data[:4] == b"PK\x03\x04":
        return NpzFile().read(path, name, data, model, layout)
    return CsvFile().read(path, name, data, model, layout)


def _bytes(path):
    """The contents of a file. Raises RecordingError where there are none, or they are packed."""
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
    return data


def _folder(path, model, layout):
    """The runs of a folder that is one recording or one dataset, or of a Minari id."""
    if os.path.isfile(os.path.join(path, "meta", "info.json")):
        return LeRobotDataset().read(path, model, layout)
    bags = [
        f for end in ("db3", "mcap") for f in glob.glob(os.path.join(glob.escape(path), f"*.{end}"))
    ]
    if bags or os.path.isfile(os.path.join(path, "metadata.yaml")):
        return RosBag().read(path, model, layout)
    return MinariDataset().read(path, model, layout)
