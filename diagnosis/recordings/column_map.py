"""Column maps: a TOML file that says what the columns of recordings are, so that nobody rewrites
files.

[columns]                                   # the tool's name = the file's own
time = {column = "stamp_us", scale = 1e-6}
"qpos:elbow" = "q2"
"ctrl:elbow_motor" = {column = "i2", scale = 0.105, offset = 0.0}
"qpos:finger" = nan                         # a number: the same in every row; nan: not measured

[joints]                                    # the model's joint = its name in the files
shoulder = "joint_1"

[ros]                                       # of ROS 2 bags
topic = "/joint_states"
targets = "/position_controller/commands"
joints = ["joint_1", "joint_2"]             # the order of targets without names
"""

import tomllib

from diagnosis.recordings.columns import RecordingError
from diagnosis.recordings.layout import Layout, Source

TABLES = "columns", "joints", "ros"
ROS = {"topic": str, "targets": str, "joints": list}


def load_layout(path: str | None, degrees: bool = False, gains: frozenset = frozenset()) -> Layout:
    """The Layout of a column map, or without one. Raises RecordingError."""
    if path is None:
        return Layout(degrees=degrees, gains=gains)
    try:
        with open(path, "rb") as stream:
            content = tomllib.load(stream)
    except OSError as error:
        raise RecordingError(
            f"{path}: the column map cannot be read ({error.strerror}); check the path"
        ) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: not TOML ({error})") from None
    other = [key for key in content if key not in TABLES]
    if other:
        raise RecordingError(
            f"{path}: {other[0]!r} is not known; tables are [columns], [joints] and [ros]"
        )
    tables = [content.get(name, {}) for name in TABLES]
    if not all(isinstance(table, dict) for table in tables) or not any(tables):
        raise RecordingError(
            f"{path}: names nothing; write [columns], [joints] or [ros] and what stands for what "
            f"below"
        )
    columns = {name: _source(path, name, value) for name, value in tables[0].items()}
    for joint, name in tables[1].items():
        if not isinstance(name, str):
            raise RecordingError(f"{path}: [joints] {joint!r}: {name!r} is not a name in quotes")
    for key, value in tables[2].items():
        if key not in ROS or not isinstance(value, ROS[key]):
            raise RecordingError(
                f'{path}: [ros] {key!r}: write topic = "...", targets = "...", joints = ["...", '
                f"...]"
            )
    return Layout(path, columns, tables[1], tables[2], degrees, gains)


def _source(path, name, value):
    """The Source that one line of [columns] says. Raises RecordingError."""
    if isinstance(value, bool):
        value = None
    if isinstance(value, str):
        return Source(value)
    if isinstance(value, (int, float)):
        return Source(None, 1.0, float(value))
    if isinstance(value, dict) and isinstance(value.get("column"), str):
        rest = {key: number for key, number in value.items() if key != "column"}
        if all(
            key in ("scale", "offset") and isinstance(number, (int, float)) and number == number
            for key, number in rest.items()
        ):
            return Source(value["column"], rest.get("scale", 1.0), rest.get("offset", 0.0))
    raise RecordingError(
        f'{path}: [columns] {name!r}: write "column", '
        f'{{column = "...", scale = 1.0, offset = 0.0}}, or a number'
    )
