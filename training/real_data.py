"""Recordings of the actual robot in the place of a real world that can be rolled out in.

    real = RealData("recordings", sim)        # every file that the diagnosis reads
    tau_real = real.collect()                 # the rows of files not seen before, without ...
    real.held_out()                           # ... the last fifth of each, never fitted

A robot is recorded under the policy that a run has left in policy.pt; its files are added to the
folder, and the run is resumed with one grounding step more.
"""

from pathlib import Path

import mujoco
import numpy as np

from diagnosis.recordings.columns import columns_of
from diagnosis.recordings.recording import RecordingError, load
from training.run_folder import RunError
from trpo import Transitions

TOLERANCE = 0.01  # of a control period: how far a recording's clock may be from a multiple of it


class RealData:
    """The recordings of a folder as real transitions of a task.

    Args: folder: of recordings, in the diagnosis' formats, of the sim's joints and actuators.
    sim: the BatchEnv whose observations they become. seen: names that earlier grounding steps used.
    Raises RunError: no recordings, those of another robot, or of another control period, or too few
    rows that hold all that the task observes.
    """

    def __init__(self, folder, sim, seen=()):
        self.folder, self.sim, self.seen = Path(folder), sim, list(seen)
        try:
            paths = sorted(p for p in self.folder.iterdir() if not p.name.startswith("."))
            recordings = load(paths, sim.model)
        except OSError as error:
            raise RunError(f"--real-data {folder}: {error.strerror}") from None
        except RecordingError as error:
            raise RunError(f"--real-data {folder}: {error}") from None
        self.parts = {r.name: self._split(self._transitions(r)) for r in recordings}
        if not len(self.held_out()):
            raise RunError(f"--real-data {folder}: {self._lacking(recordings)}")

    def _split(self, transitions):
        cut = len(transitions) - len(transitions) // 5
        return transitions[:cut], transitions[cut:]

    def _lacking(self, recordings):
        """Why there are no rows to judge by, in words."""
        rows = sum(len(learnt) for learnt, _ in self.parts.values())
        if rows:
            return (
                f"{rows} usable rows, and none to judge by, the last fifth of a recording: record "
                "at least 6 rows at a time"
            )
        never = [
            name
            for name, (kind, k) in columns_of(self.sim.model).items()
            if kind == "qpos" and all(np.isnan(r.qpos[:, k]).all() for r in recordings)
        ]
        if never:
            return f"never measured: {', '.join(never)}; a task needs every joint"
        return "no two rows in succession hold every joint: fill the gaps"

    def _transitions(self, recording):
        """One recording at the task's control period, without rows that lack something."""
        step = self.sim.dt / np.median(np.diff(recording.time))
        every = max(1, round(step))
        if abs(step - every) > TOLERANCE * every:
            raise RunError(
                f"--real-data: {recording.name} has a row every {self.sim.dt / step:.4g} s, the "
                f"task acts every {self.sim.dt:.4g} s: record at that period, or a whole part of it"
            )
        at = np.arange(0, len(recording.time), every)
        qvel = np.where(np.isnan(recording.qvel), self._differences(recording), recording.qvel)
        obs = self.sim.task.observe(recording.qpos[at], qvel[at]).astype(np.float32)
        held = recording.ctrl[: len(recording.ctrl) // every * every]
        ctrl = held.reshape(-1, every, held.shape[1]).mean(axis=1).astype(np.float32)
        n = min(len(obs) - 1, len(ctrl))
        s, a, s_next = obs[:n], ctrl[:n], obs[1 : n + 1]
        whole = np.isfinite(np.concatenate((s, a, s_next), axis=1)).all(axis=1)
        return Transitions(s[whole], a[whole], s_next[whole])

    def _differences(self, recording):
        """Velocities (T, nv) by central differences of the positions, where none were recorded."""
        out = np.full(recording.qvel.shape, np.nan)
        for t in range(1, len(out) - 1):
            seconds = recording.time[t + 1] - recording.time[t - 1]
            ends = recording.qpos[t - 1], recording.qpos[t + 1]
            mujoco.mj_differentiatePos(self.sim.model, out[t], seconds, *ends)
        return out

    def collect(self):
        """The rows to learn from of every recording not seen before: Transitions, maybe none."""
        new = [name for name in self.parts if name not in self.seen]
        self.seen += new
        return self._joined(new, 0)

    def held_out(self):
        """The rows that nothing is fitted on, of all recordings."""
        return self._joined(self.parts, 1)

    def _joined(self, names, part):
        box, actions = self.sim.single_observation_space, self.sim.single_action_space
        none = np.empty((0, box.shape[0]), np.float32)
        tau = Transitions(none, np.empty((0, actions.shape[0]), np.float32), none)
        for name in names:
            tau += self.parts[name][part]
        return tau
