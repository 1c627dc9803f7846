"""LeRobot datasets (Parquet, v2 and v3): one run for each episode of a folder, or of one .parquet
file.

`meta/info.json` names the parts of `observation.state` and `action`. A part called `elbow.pos` is
the position of joint elbow (or where it is told to go, in `action`), `.vel` its velocity, `.torque`
or `.effort` its torque; a name without an ending is a position. In a column map a part is
`observation.state.elbow.pos`, or `observation.state[1]`.
"""

import json
import os
from pathlib import Path

import numpy as np

from diagnosis.recordings.columns import RecordingError
from diagnosis.recordings.formats.optional import library
from diagnosis.recordings.layout import Layout, Raw

ENDINGS = {"pos": "qpos", "vel": "qvel", "torque": "effort", "effort": "effort"}
STATE, ACTION = "observation.state", "action"


class LeRobotDataset:
    """Reads Parquet through pyarrow."""

    def read(self, path, model, layout: Layout) -> list[Raw]:
        """One run for each episode. Raises RecordingError."""
        top = Path(path)
        files = sorted(top.glob("data/**/*.parquet")) if top.is_dir() else [top]
        if not files:
            raise RecordingError(
                f"{path}: a LeRobot dataset without data/*/*.parquet; copy those too"
            )
        info, out = _info(top if top.is_dir() else top.parent), []
        episodes = {}
        for file in files:
            columns, natural = _file(str(file), info)
            number = columns.pop("episode_index", np.zeros(len(columns["time"])))
            for episode in np.unique(number):
                rows = number == episode
                parts = episodes.setdefault(int(episode), [])
                parts.append({name: values[rows] for name, values in columns.items()})
        name = os.path.basename(os.path.normpath(path))
        for episode, parts in sorted(episodes.items()):  # one may run on from file to file
            whole = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
            label = f"{path} episode {episode}" if len(episodes) > 1 else path
            out.append(
                Raw(label, f"{name}:{episode}" if len(episodes) > 1 else name, whole, natural)
            )
        return out


def _info(folder):
    """meta/info.json of the dataset that `folder` is or lies in, or {}."""
    for place in (folder, *list(folder.resolve().parents)[:3]):
        try:
            return json.loads((place / "meta" / "info.json").read_text(encoding="utf-8"))
        except OSError:
            continue
        except ValueError as error:
            raise RecordingError(f"{place / 'meta' / 'info.json'}: not JSON ({error})") from None
    return {}


def _file(path, info):
    """({column: (T,)}, natural) of one Parquet file. Raises RecordingError."""
    parquet = library(path, "pyarrow.parquet", "lerobot", "a Parquet file")
    import pyarrow

    try:
        schema = parquet.read_schema(path)
        numbers = [f.name for f in schema if _is_number(pyarrow.types, f.type)]
        table = parquet.read_table(path, columns=numbers)
        arrays = {n: np.array(table[n].to_pylist(), dtype=float) for n in numbers}
    except (OSError, ValueError, TypeError, pyarrow.ArrowException) as error:
        raise RecordingError(
            f"{path}: not a readable Parquet file ({type(error).__name__}); copy it again"
        ) from None
    columns, natural = {}, {}
    for key, array in arrays.items():
        if array.ndim == 1:
            columns[key] = array
            continue
        for k, part in enumerate(_parts(info, key, array.shape[1])):
            columns[f"{key}[{k}]"] = array[:, k]
            if part is None:
                continue
            columns[f"{key}.{part}"] = array[:, k]
            joint, _, ending = part.rpartition(".")
            kind, joint = (ENDINGS[ending], joint) if ending in ENDINGS else ("qpos", part)
            if key == ACTION:
                kind = "target" if kind == "qpos" else kind
            if key in (STATE, ACTION):
                natural.setdefault(f"{kind}:{joint}", f"{key}.{part}")
    if "timestamp" not in columns:
        raise RecordingError(
            f"{path}: no column 'timestamp'; it has {', '.join(map(repr, numbers[:8]))}; is it a "
            f"LeRobot dataset?"
        )
    columns["time"], natural["time"] = columns["timestamp"], "time"
    return columns, natural


def _is_number(types, kind):
    """Whether a Parquet column holds numbers, or lists of them."""
    if types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind):
        kind = kind.value_type
    return types.is_integer(kind) or types.is_floating(kind)


def _parts(info, key, width):
    """The names of the parts of a list column, None where nobody named them."""
    names = (info.get("features") or {}).get(key, {}).get("names")
    if isinstance(names, dict):  # older datasets: {"motors": [...]}
        names = next(iter(names.values()), None)
    if isinstance(names, list) and len(names) == width:
        return [str(name) for name in names]
    return [None] * width
