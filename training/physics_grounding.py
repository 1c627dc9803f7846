"""Grounding by diagnosis: not actions are transformed, but missing physics is put into the sim.

The real trajectories become recordings, diagnose() finds what they show to be missing, and its
corrected model, with the forces of its script, becomes the world in which the policy improves. It
sees what the other methods see: observations and actions.
"""

import numpy as np

from diagnosis.command import ModelError, diagnose
from diagnosis.recordings.recording import Recording, RecordingError
from envs import EnvError, model_path
from rgat import CorrectedEnv, Grounding, GroundingSettings, identity, one_step_error


class Physics(Grounding):
    """Lines 3 and 4 of Algorithm 1 by diagnosis; no action transformer is left to learn."""

    learns_from_real = True
    least_transitions = 200

    def __init__(self, sim, settings=GroundingSettings()):
        super().__init__(sim, settings)
        self.nominal, self.xml, self.script = sim, "", ""

    def fit(self, tau_real, seed):
        """Line 3: the raw simulator with the physics that all recordings so far show to be missing.

        The last one stays where it predicts the recorded transitions better than the new one, or
        where that has joints that the task does not know, as backlash and dead zones are written.
        """
        path = model_path(self.nominal.env_id)
        try:
            diagnosis = diagnose(path, recordings_of(self.nominal, tau_real))
        except (RecordingError, ModelError) as error:
            raise EnvError(f"no diagnosis from {len(tau_real)} real transitions: {error}") from None

        def error(files):
            try:
                return one_step_error(self._simulator(*files), identity, tau_real)[0]
            except ValueError:  # EnvError, or what a batch does not tell a script
                return np.inf

        found = diagnosis.corrected_xml, diagnosis.corrected_py
        self.xml, self.script = min(found, (self.xml, self.script), key=error)
        return {}

    def update(self, policy, steps, seed, on_update=None):
        """Line 4: what was found becomes the simulator."""
        self._rebuild()
        return {}

    def _rebuild(self):
        self.sim, self.transformer = self._simulator(self.xml, self.script), identity

    def _simulator(self, xml, script):
        """The task in the world of an MJCF and a script's forces, or in the raw simulator's if
        there is none yet."""
        raw = self.nominal
        if not xml:
            return raw
        return CorrectedEnv(raw.env_id, raw.num_envs, xml, script, raw.batch.nthread)

    def state(self):
        return {"corrected_xml": self.xml, "corrected_py": self.script}

    def load(self, state):
        self.xml, self.script = state["corrected_xml"], state["corrected_py"]
        self._rebuild()


class PhysicsThen(Physics):
    """The diagnosis corrects the model, and an action transformer takes what has no name in it.

    Args: rest: the Grounding class that works on the corrected simulator, RGAT or Solved.
    """

    def __init__(self, rest, sim, settings=GroundingSettings()):
        super().__init__(sim, settings)
        self.rest = rest(sim, settings)

    def fit(self, tau_real, seed):
        super().fit(tau_real, seed)
        self._rebuild()
        return self.rest.fit(tau_real, seed)

    def update(self, policy, steps, seed, on_update=None):
        stats = self.rest.update(policy, steps, seed, on_update)
        self.transformer = self.rest.transformer
        return stats

    def _rebuild(self):
        """The rest goes on in the new simulator with what it has learnt."""
        super()._rebuild()
        learnt, learning = self.rest.state(), self.rest
        self.rest = type(learning)(self.sim, self.settings)
        self.rest.load(learnt)

    def state(self):
        return {**super().state(), "rest": self.rest.state()}

    def load(self, state):
        super().load(state)
        self.rest.load(state["rest"])
        self.transformer = self.rest.transformer


def recordings_of(env, transitions):
    """Transitions as Recordings, one per episode.

    What the observation leaves out or clips counts as not measured."""
    task, nq, nv = env.task, env.model.nq, env.model.nv
    first = np.flatnonzero(np.r_[True, (transitions.s[1:] != transitions.s_next[:-1]).any(axis=1)])
    recordings = []
    for k, rows in enumerate(np.split(np.arange(len(transitions)), first[1:])):
        obs = np.concatenate((transitions.s[rows], transitions.s_next[rows[-1:]])).astype(float)
        qpos = np.full((len(obs), nq), np.nan)
        qpos[:, task.skip_root_x :] = obs[:, : nq - task.skip_root_x]
        qvel = obs[:, -nv:]
        qvel = np.where(np.abs(qvel) < task.clip_velocity, qvel, np.nan)
        # the last row has no action of its own: nothing is predicted from it
        ctrl = transitions.a[np.r_[rows, rows[-1]]].astype(float)
        recordings.append(Recording(f"episode {k}", env.dt * np.arange(len(obs)), qpos, qvel, ctrl))
    return recordings
