"""Minari datasets of gymnasium's MuJoCo tasks, by id or folder: one run for each episode."""

import glob
import os

import numpy as np

from diagnosis.recordings.columns import RecordingError, by_column
from diagnosis.recordings.layout import Layout, Raw


class MinariDataset:
    """Reads what Minari stores, through Minari itself (pip install 'minari[hdf5]')."""

    def read(self, path, model, layout: Layout) -> list[Raw]:
        """One run for each episode of a dataset, given by id or by folder. Raises
        RecordingError."""
        name, out = os.path.basename(os.path.normpath(path)), []
        for number, arrays in _episodes(path, model):
            columns = by_column(path, arrays, model)
            label = f"{path} episode {number}"
            out.append(Raw(label, f"{name}:{number}", columns, {c: c for c in columns}))
        return out


def _episodes(path, model):
    """[(number, arrays)] of a dataset. Raises RecordingError."""
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
            f"{path}: {what}; give CSV or NPZ files (a Minari dataset needs the extra [minari]: "
            "pip install 'minari[hdf5]')"
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
    return episodes


def _episode(path, episode, model, dt):
    """Arrays of one Minari episode. qpos and qvel come from its infos where stored, else from the
    observation, which in gymnasium's MuJoCo tasks is (qpos, qvel), often without the root's leading
    positions: those are NaN."""
    actions = np.asarray(episode.actions, dtype=float).reshape(len(episode.actions), -1)
    ctrl = np.vstack([actions, actions[-1:]])  # the last state has no action of its own
    infos = episode.infos or {}
    if "qpos" in infos and "qvel" in infos:
        qpos, qvel = np.asarray(infos["qpos"], dtype=float), np.asarray(infos["qvel"], dtype=float)
    else:
        if isinstance(episode.observations, dict):
            raise RecordingError(
                f"{path}: observations are a dictionary without qpos and qvel infos; convert it "
                f"to NPZ"
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
