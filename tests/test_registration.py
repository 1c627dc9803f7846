"""The worlds by gymnasium's names: the same as gymnasium's own, wrapped by its wrappers, trained by
a stranger."""

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics

import envs


@pytest.mark.parametrize("env_id", ["Hopper-v5", "InvertedPendulum-v4"])
def test_a_registered_world_is_gymnasiums_own(env_id):
    """Spaces, observations, rewards and ends over 60 random steps of three environments."""
    ours = gymnasium.make_vec(f"rgat/{env_id}", num_envs=3)
    theirs = gymnasium.make_vec(
        env_id,
        num_envs=3,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP},
    )
    assert ours.metadata["autoreset_mode"] == theirs.metadata["autoreset_mode"]
    assert ours.single_observation_space == theirs.single_observation_space
    assert ours.action_space == theirs.action_space
    ours.action_space.seed(0)
    pairs = [(ours.reset(seed=7)[0], theirs.reset(seed=7)[0])]
    for _ in range(60):
        action = ours.action_space.sample()
        pairs += zip(ours.step(action)[:4], theirs.step(action)[:4])
    for one, other in pairs:
        np.testing.assert_array_equal(one, other)
        assert one.shape == other.shape
    theirs.close()


def test_the_real_world_is_asked_for_by_name():
    env = gymnasium.make_vec("rgat/Hopper-v5", num_envs=2, real="torso:mass*1.27")
    nominal = gymnasium.make_vec("rgat/Hopper-v5", num_envs=2)
    mass = [e.unwrapped.model.body("torso").mass[0] for e in (env, nominal)]
    assert mass[0] == pytest.approx(1.27 * mass[1])
    with pytest.raises(envs.EnvError, match="torse"):
        gymnasium.make_vec("rgat/Hopper-v5", num_envs=2, real="torse:mass*1.27")


def test_gymnasiums_wrappers_count_its_episodes():
    """A random policy drops the pendulum: the wrapper's returns are those that were paid."""
    env = RecordEpisodeStatistics(gymnasium.make_vec("rgat/InvertedPendulum-v5", num_envs=4))
    env.reset(seed=0)
    env.action_space.seed(0)
    paid, counted, lengths = np.zeros(4), 0, np.zeros(4, int)
    for _ in range(120):
        _, reward, terminated, truncated, info = env.step(env.action_space.sample())
        paid, lengths = paid + reward, lengths + 1
        done = terminated | truncated
        if done.any():
            np.testing.assert_allclose(info["episode"]["r"][done], paid[done])
            np.testing.assert_array_equal(info["episode"]["l"][done], lengths[done])
            counted += done.sum()
        paid[done], lengths[done] = 0, 0
    assert counted > 4


def test_a_strangers_trainer_learns_in_it():
    """stable-baselines3's PPO on the pendulum, in a fraction of a minute."""
    sb3 = pytest.importorskip("stable_baselines3")
    from sb3_adapter import SB3Env

    env = SB3Env(gymnasium.make_vec("rgat/InvertedPendulum-v5", num_envs=8))
    model = sb3.PPO("MlpPolicy", env, n_steps=64, seed=0, device="cpu")
    model.learn(1024)
    assert model.num_timesteps >= 1024
