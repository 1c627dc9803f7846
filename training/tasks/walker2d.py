"""gymnasium's Walker2d-v4: python train.py --task training/tasks/walker2d.py"""

from pathlib import Path

import gymnasium

from envs import Task
from trpo import TRPOConfig


class Walker2d(Task):
    """The walker: an episode ends where it falls, or bends over."""

    def unhealthy(self, qpos, qvel):
        """Fallen, or bent over."""
        height, angle = qpos[:, 1], qpos[:, 2]
        return ~((0.8 < height) & (height < 2.0) & (-1.0 < angle) & (angle < 1.0))


TASK = Walker2d(
    xml=str(Path(gymnasium.__file__).parent / "envs/mujoco/assets/walker2d.xml"),
    frame_skip=4,
    reset_noise=5e-3,
    real="torso:mass*1.27",
    clip_velocity=10.0,
    ctrl_weight=1e-3,
    healthy_reward=1.0,
    pays_on_end=True,
)
LEARNER = TRPOConfig(gamma=0.995, lam=0.97)
DEFAULTS = {"pretrain_steps": 2_000_000, "reference_steps": 2_000_000}
