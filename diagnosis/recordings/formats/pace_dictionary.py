"""PACE's dictionaries: torch.save({"time": (T,), "dof_pos": (T, n), "des_dof_pos": (T, n)}).

Also read where they stand beside these: dof_vel (T, n), dof_torque (T, n), kp and kd (n,). The n
joints are the model's hinges and slides in MuJoCo's order; a column map names others, `dof_pos[0]`
being the first. Loaded with weights_only=True, so nothing is unpickled but tensors and numbers.
"""

import io

import numpy as np

from diagnosis.recordings.columns import RecordingError, single_joints
from diagnosis.recordings.formats.npz_file import apart
from diagnosis.recordings.formats.optional import library
from diagnosis.recordings.layout import Layout, Raw

KINDS = {
    "dof_pos": "qpos",
    "dof_vel": "qvel",
    "des_dof_pos": "target",
    "dof_torque": "effort",
    "kp": "kp",
    "kd": "kd",
}


class PaceDictionary:
    """Reads a dictionary of tensors through torch (already needed by train.py)."""

    def read(self, path, name, data, model, layout: Layout) -> list[Raw]:
        """The one run of a file whose bytes are `data`. Raises RecordingError."""
        arrays = _loaded(path, data)
        for key in () if layout.mapped else ("time", "dof_pos", "des_dof_pos"):
            if key not in arrays:
                raise RecordingError(
                    f"{path}: {key!r} is missing; a PACE dictionary has time (T,), dof_pos and "
                    f"des_dof_pos (T, n)"
                )
        rows = max((len(a) for a in arrays.values() if a.ndim), default=0)
        arrays = {
            key: np.tile(a, (rows, 1)) if key in ("kp", "kd") and a.ndim == 1 else a
            for key, a in arrays.items()
        }
        joints = single_joints(model)
        for key, array in arrays.items():
            if len(array) != rows:
                raise RecordingError(
                    f"{path}: {key!r} has {len(array)} rows where others have {rows}; save whole "
                    f"runs"
                )
            if key in KINDS and not layout.columns and array.shape != (rows, len(joints)):
                raise RecordingError(
                    f"{path}: {key!r} has shape {array.shape} instead of ({rows}, {len(joints)}): "
                    f"this model has "
                    f"{len(joints)} hinges and slides; give the model of these joints, or --map"
                )
        columns = apart(arrays)
        natural = {"time": "time"} if "time" in columns else {}
        for key, kind in KINDS.items():
            for k, joint in enumerate(joints):
                if f"{key}[{k}]" in columns:
                    natural[f"{kind}:{joint}"] = f"{key}[{k}]"
        return [Raw(path, name, columns, natural)]


def _loaded(path, data):
    """{name: float64 array} of a torch file. Raises RecordingError."""
    torch = library(path, "torch", "pace", "a torch file")
    try:
        content = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except Exception as error:  # whatever damaged archives make torch raise
        why = (
            "it holds other objects than tensors, which are never loaded; save a plain dictionary "
            "of tensors"
            if "weights_only" in str(error).lower() or "Unsupported" in str(error)
            else f"not a readable torch file ({type(error).__name__}); save it with torch.save"
        )
        raise RecordingError(f"{path}: {why}") from None
    if not isinstance(content, dict):
        raise RecordingError(
            f"{path}: holds a {type(content).__name__} instead of a dictionary of tensors"
        )
    arrays = {}
    for key, value in content.items():
        if isinstance(value, torch.Tensor) and not value.is_complex() and value.ndim in (1, 2):
            value = value.detach().to(torch.float64).numpy()
            arrays[str(key)] = value[:, 0] if key == "time" and value.ndim == 2 else value
    return arrays
