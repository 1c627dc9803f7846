"""gymnasium's Ant-v4: python train.py --task training/tasks/ant.py"""

from pathlib import Path

import gymnasium
import numpy as np

from envs import Task
from trpo import TRPOConfig


class Ant(Task):
    """A robot that moves in the plane: x and y are left out, and the torso's x is paid."""

    def unhealthy(self, qpos, qvel):
        """Thrown over, or thrown up."""
        finite = np.isfinite(qpos).all(1) & np.isfinite(qvel).all(1)
        return ~(finite & (0.2 <= qpos[:, 2]) & (qpos[:, 2] <= 1.0))

    def place(self, env):
        """x of the torso as MuJoCo last worked it out, which is what gymnasium reads."""
        return env.batch.bind("xpos")[:, env.model.body("torso").id, 0].copy()


TASK = Ant(
    xml=str(Path(gymnasium.__file__).parent / "envs/mujoco/assets/ant.xml"),
    frame_skip=5,
    reset_noise=0.1,
    real="torso:mass*1.5",
    skip_root_x=2,
    normal_qvel=True,
    ctrl_weight=0.5,
    healthy_reward=1.0,
    pays_on_end=True,
)
LEARNER = TRPOConfig(normalize_obs=True, max_kl=0.02)
