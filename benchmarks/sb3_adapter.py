"""Lets stable-baselines3 and sb3-contrib train in our batched environments, raw or grounded, with
our settings.

model = trpo_model(BatchEnv("Hopper-v4", 32), TRPOConfig(), seed=0); model.learn(100_000)
returns = rollouts(ActingPolicy(model), env, 20, seed=0, deterministic=True)[0]
"""

import numpy as np
import torch
from stable_baselines3.common.vec_env import VecEnv, VecNormalize


class SB3Env(VecEnv):
    """A BatchEnv, GroundedEnv or any other SAME_STEP VectorEnv with info["next_obs"], as
    stable-baselines3 wants it."""

    def __init__(self, env):
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self.start_seed = None

    def seed(self, seed=None):
        self.start_seed = seed
        return [seed] * self.num_envs

    def reset(self):
        obs, _ = self.env.reset(seed=self.start_seed)
        self.start_seed = None
        return obs

    def step_async(self, actions):
        self.actions = actions

    def step_wait(self):
        obs, reward, terminated, truncated, info = self.env.step(self.actions)
        done = terminated | truncated
        infos = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(done):
            infos[i] = {
                "terminal_observation": info["next_obs"][i],
                "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
            }
        return obs, reward.astype(np.float32), done, infos

    def close(self):
        pass

    def get_attr(self, attr_name, indices=None):
        return [getattr(self.env, attr_name)] * self.num_envs

    def set_attr(self, attr_name, value, indices=None):
        raise NotImplementedError("the copies of a batch share their attributes")

    def env_method(self, method_name, *args, indices=None, **kwargs):
        raise NotImplementedError("the copies of a batch have no methods of their own")

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False] * self.num_envs


def trpo_model(env, config, seed, hidden=(64, 64)):
    """sb3-contrib's TRPO with a TRPOConfig's settings on one of our environments or on an sb3
    VecEnv.

    What it lacks: the entropy bonus (0 in every preset) and the scaling of the value function's
    targets.
    """
    from sb3_contrib import TRPO

    vec = env if isinstance(env, VecEnv) else SB3Env(env)
    if config.normalize_obs:
        vec = VecNormalize(vec, norm_reward=False)
    return TRPO(
        "MlpPolicy",
        vec,
        learning_rate=config.value_lr,
        n_steps=max(1, config.batch_size // vec.num_envs),
        batch_size=config.value_batch,
        gamma=config.gamma,
        gae_lambda=config.lam,
        cg_max_steps=config.cg_steps,
        cg_damping=config.cg_damping,
        line_search_shrinking_factor=config.backtrack,
        line_search_max_iter=config.backtracks,
        n_critic_updates=config.value_epochs,
        target_kl=config.max_kl,
        # it would thin out the gradient and the line search too, not the Fisher product alone
        sub_sampling_factor=1,
        policy_kwargs={
            "net_arch": {"pi": list(hidden), "vf": list(hidden)},
            "activation_fn": torch.nn.Tanh,
        },
        seed=seed,
        device="cpu",
    )


class ActingPolicy:
    """A trained sb3 model with our policies' mean() and act(), so that both are judged by the same
    episodes."""

    def __init__(self, model):
        self.policy, self.normalizer = model.policy, model.get_vec_normalize_env()

    def _distribution(self, obs):
        if self.normalizer is not None:
            obs = torch.from_numpy(self.normalizer.normalize_obs(obs.numpy())).float()
        return self.policy.get_distribution(obs).distribution

    @torch.no_grad()
    def mean(self, obs):
        return self._distribution(obs).mean

    @torch.no_grad()
    def act(self, obs, generator=None):
        d = self._distribution(obs)
        return d.mean + d.stddev * torch.randn(d.mean.shape, generator=generator)
