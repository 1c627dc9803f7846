"""Grounding methods: rewards and transformers by hand, the oracle against brute force, strangers
training in the grounded sim."""

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode

ROOT = str(Path(__file__).resolve().parents[1])
import rgat
from envs import BatchEnv, parse_perturbation, task_of
from models import GaussianPolicy
from rgat import (
    ANE,
    AT_CONFIG,
    GAT,
    RGAT,
    ActionTransformer,
    ActionTransformerEnv,
    GroundedEnv,
    Grounding,
    GroundingSettings,
    Oracle,
    RealModel,
    Solved,
    identity,
    measured,
    one_step_error,
    predict_all,
)
from trpo import TRPO, Transitions, TRPOConfig, rollouts

pytestmark = pytest.mark.filterwarnings("ignore")
SMALL = GroundingSettings(at=replace(AT_CONFIG, batch_size=64))


def world(env_id, n=4, real=False):
    return BatchEnv(env_id, n, parse_perturbation(task_of(env_id).real) if real else (), nthread=1)


def policy_for(env, seed=0, std=0.3):
    torch.manual_seed(seed)
    policy = GaussianPolicy(
        env.single_observation_space.shape[0], env.single_action_space.shape[0], log_std=np.log(std)
    )
    policy.net[-1].weight.data.normal_(std=0.2)
    return policy


def real_data(env_id, episodes=8):
    real = world(env_id, real=True)
    return rollouts(policy_for(real), real, episodes, seed=1)[1]


class Prophet:
    """Stands for f_psi: says where it is told to."""

    def __init__(self, predicted, guess, residual):
        self.predicted, self.guess, self.residual = predicted, guess, residual

    def __call__(self, s, a):
        return self.predicted, self.guess


@pytest.mark.parametrize("baseline", [False, True])
def test_the_transformers_reward_by_hand(baseline):
    sim, twin = world("Hopper-v4"), world("Hopper-v4")
    rng = np.random.default_rng(0)
    predicted, guess = rng.normal(size=(2, 4, 11)).astype(np.float32)
    low, high = sim.single_action_space.low, sim.single_action_space.high
    transformer = ActionTransformer(GaussianPolicy(14, 3), low, high)
    scale = rng.uniform(0.1, 2, 11)
    env = ActionTransformerEnv(
        sim,
        transformer,
        policy_for(sim),
        Prophet(predicted, guess, True),
        scale,
        seed=3,
        baseline=baseline,
    )
    assert env.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    sa, _ = env.reset(seed=5)
    s, _ = twin.reset(seed=5)
    cut = 0
    for _ in range(60):
        np.testing.assert_array_equal(sa[:, :11], s.astype(np.float32))
        a, output = sa[:, 11:], rng.uniform(-0.3, 0.3, (4, 3))
        s, _, fell, timeout, info = twin.step(
            a, applied=np.clip(a + 2 * output, -1, 1)
        )  # the range of an action is 2
        sa, reward, terminated, truncated, at_info = env.step(output)
        expected = np.zeros(4)
        for i in range(4):
            for k in range(11):
                expected[i] -= ((float(predicted[i, k]) - info["next_obs"][i, k]) / scale[k]) ** 2
                expected[i] += (
                    baseline * ((float(predicted[i, k]) - float(guess[i, k])) / scale[k]) ** 2
                )
        np.testing.assert_allclose(reward, expected, rtol=1e-5, atol=1e-5)
        assert not terminated.any()  # ending an episode must never pay
        np.testing.assert_array_equal(truncated, fell | timeout)
        np.testing.assert_array_equal(
            at_info["next_obs"][:, :11], info["next_obs"].astype(np.float32)
        )
        cut += truncated.sum()
    assert cut > 0


def test_the_transformer_sees_the_target_policys_actions():
    sim = world("HalfCheetah-v4", n=2000)
    policy = policy_for(sim)
    env = ActionTransformerEnv(sim, None, policy, None, 1.0, seed=0)
    sa, _ = env.reset(seed=0)
    with torch.no_grad():
        z = (sa[:, 17:] - policy.mean(torch.from_numpy(sa[:, :17])).numpy()) / 0.3
    inside = np.abs(sa[:, 17:]).max(1) < 1
    assert abs(z[inside].std() - 1) < 0.1 and np.abs(sa[:, 17:]).max() <= 1
    assert env.single_observation_space.shape == (23,)


def test_action_transformer_adds_its_mean_and_stays_in_bounds():
    policy = GaussianPolicy(4 + 1, 1, log_std=0.0)
    for p in policy.net.parameters():
        p.data.zero_()
    policy.net[-1].bias.data.fill_(0.25)
    transform = ActionTransformer(policy, np.array([-3.0]), np.array([3.0]))
    np.testing.assert_allclose(
        transform(np.zeros((3, 4)), np.array([[-3.0], [0.0], [2.9]])),
        [[-1.5], [1.5], [3.0]],
        atol=1e-6,
    )


# --- f_psi ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("residual", [False, True])
def test_the_model_of_the_real_world_comes_nearer_to_it(residual):
    sim, tau = world("InvertedPendulum-v4"), real_data("InvertedPendulum-v4", 30)
    model = RealModel(sim, residual)
    held_out = model.fit(tau, seed=0)
    sim.reset(seed=0)
    miss, miss_without = [], []
    real = world("InvertedPendulum-v4", real=True)
    rng = np.random.default_rng(0)
    real.reset(seed=0)
    for _ in range(4):
        sim.batch.state[:] = real.batch.state
        s, a = sim.observe(), rng.uniform(-1, 1, (4, 1)).astype(np.float32)
        predicted, guess = model(s, a)
        truth = real.step(a)[4]["next_obs"]
        (
            miss.append(((predicted - truth) ** 2).sum(1)),
            miss_without.append(((sim.peek(a) - truth) ** 2).sum(1)),
        )
        np.testing.assert_array_equal(
            guess, sim.peek(a).astype(np.float32) if residual else s.astype(np.float32)
        )
    assert held_out.shape == (4,) and (held_out > 0).all() and (held_out < 0.5).all()
    assert np.mean(miss) < 0.3 * np.mean(miss_without)


def test_a_state_not_seen_in_full_keeps_the_sims_word():
    sim, tau = world("Hopper-v4"), real_data("Hopper-v4")
    model = RealModel(sim, residual=True)
    model.fit(tau, seed=0)
    obs, _ = sim.reset(seed=0)
    sim.qvel[1, 3] = 12.0  # observed as 10
    predicted, guess = model(sim.observe(), np.zeros((4, 3)))
    np.testing.assert_array_equal(predicted[1], guess[1])
    assert not np.array_equal(predicted[0], guess[0])
    np.testing.assert_array_equal(measured(sim, sim.observe()), [True, False, True, True])


def test_predict_all_goes_through_a_ragged_number_of_rows():
    sim, tau = world("InvertedPendulum-v4"), real_data("InvertedPendulum-v4")[:11]
    after = predict_all(sim, tau)
    assert after.shape == tau.s.shape
    one = world("InvertedPendulum-v4", n=1)
    for k in range(11):
        np.testing.assert_allclose(
            after[k], one.predict(tau.s[k : k + 1].astype(float), tau.a[k : k + 1])[0], atol=1e-6
        )


# --- the methods ----------------------------------------------------------------------------------


def test_no_grounding_is_the_raw_sim():
    grounding = Grounding(world("Hopper-v4"))
    assert (
        grounding.transformer is identity
        and grounding.fit(None, 0) == grounding.update(None, 10, 0) == {}
    )


def test_ane_adds_noise_of_the_asked_width_to_actions():
    grounding = ANE(world("InvertedPendulum-v4"), replace(SMALL, ane_width=0.1))
    grounding.update(None, 0, seed=0)
    noise = grounding.transformer(None, np.zeros((20_000, 1)))
    assert abs(noise.std() - 0.1 * 3) < 0.01 and abs(noise.mean()) < 0.01
    assert np.abs(grounding.transformer(None, np.full((1000, 1), 3.0))).max() <= 3


def test_gat_smooths_the_inverse_models_action():
    sim, tau = world("InvertedPendulum-v4"), real_data("InvertedPendulum-v4", 30)
    policy = policy_for(sim)
    grounding = GAT(sim, SMALL)
    assert 0 < grounding.fit(tau, 0)["forward_model_error"] < 1
    assert grounding.update(policy, 400, 0)["sim_transitions"] >= min(400, len(tau))
    obs, _ = sim.reset(seed=1)
    a = np.array([[-1.0], [0.5], [0.0], [2.0]])
    with torch.no_grad():
        s_next = torch.from_numpy(grounding.real_model(obs, a)[0])
        inverse = grounding.inverse_model(torch.from_numpy(obs.astype(np.float32)), s_next).numpy()
    expected = np.clip(0.95 * inverse + 0.05 * a, -3, 3)
    np.testing.assert_allclose(grounding.transformer(obs, a), expected, atol=1e-6)
    other = GAT(world("InvertedPendulum-v4"), SMALL)
    other.load(copy.deepcopy(grounding.state()))
    other.sim.reset(seed=1)
    np.testing.assert_allclose(other.transformer(obs, a), expected, atol=1e-6)


def test_the_units_of_the_reward_are_of_a_real_step_unless_told():
    sim, tau = world("InvertedPendulum-v4"), real_data("InvertedPendulum-v4", 30)
    scales = []
    for per_step in (True, False):
        grounding = RGAT(sim, replace(SMALL, per_step=per_step))
        grounding.fit(tau, 0)
        scales.append(grounding.scale)
    np.testing.assert_allclose(
        scales[0], np.sqrt(np.mean((tau.s_next - tau.s) ** 2, axis=0)), rtol=1e-3
    )
    np.testing.assert_array_equal(scales[1], np.ones(4))


def test_rgat_learns_repeats_and_reloads():
    tau, results = real_data("InvertedPendulum-v4", 30), []
    for _ in range(2):
        sim = world("InvertedPendulum-v4")
        grounding, policy = RGAT(sim, SMALL), policy_for(sim)
        fitted, rows = grounding.fit(tau, 0), []
        learnt = grounding.update(policy, 256, 0, rows.append)
        results.append(
            (fitted, learnt, [p.detach().clone() for p in grounding.learner.policy.parameters()])
        )
    assert results[0][:2] == results[1][:2] and len(rows) == 4
    assert all(torch.equal(a, b) for a, b in zip(results[0][2], results[1][2]))
    assert 0 < learnt["kl"] <= SMALL.at.max_kl and 0 < learnt["at_std"]
    obs, _ = sim.reset(seed=1)
    a = np.zeros((4, 1))
    assert np.abs(grounding.transformer(obs, a) - a).max() > 0
    other = RGAT(world("InvertedPendulum-v4"), SMALL)
    other.load(copy.deepcopy(grounding.state()))
    np.testing.assert_array_equal(other.transformer(obs, a), grounding.transformer(obs, a))


def spied_transformer_env(monkeypatch, **at):
    """The ActionTransformerEnv that an update trains in, and the grounding."""
    made, kept = [], rgat.ActionTransformerEnv
    monkeypatch.setattr(
        rgat, "ActionTransformerEnv", lambda *a, **k: made.append(kept(*a, **k)) or made[-1]
    )
    sim = world("HalfCheetah-v4", n=64)
    tau = rollouts(policy_for(sim), sim, 1, 0)[1]
    grounding = RGAT(sim, replace(SMALL, at=replace(SMALL.at, batch_size=1024, **at)))
    grounding.fit(tau[:50], 0)
    return made, grounding


@pytest.mark.parametrize("gamma", [0.0, 0.9])
def test_a_baseline_is_only_taken_where_g_phi_cannot_move_it(gamma, monkeypatch):
    made, grounding = spied_transformer_env(monkeypatch, gamma=gamma)
    grounding.update(policy_for(grounding.sim), 1, seed=5)
    assert made[0].baseline == (gamma == 0)


def test_the_transformers_noise_is_not_the_policys(monkeypatch):
    made, grounding = spied_transformer_env(monkeypatch)
    policy, seen = policy_for(grounding.sim), []
    collect = TRPO.collect
    monkeypatch.setattr(TRPO, "collect", lambda *a: seen.append(collect(*a)) or seen[-1])
    grounding.update(policy, 1, seed=5)
    obs, output = seen[0][0]["obs"].reshape(-1, 23), seen[0][0]["action"].reshape(-1, 6)
    with torch.no_grad():
        noise = obs[:, 17:] - policy.mean(torch.from_numpy(obs[:, :17])).numpy()
    inside = np.abs(obs[:, 17:]).max(1) < 1
    r = np.corrcoef(noise[inside].ravel(), (output - output.mean(0))[inside].ravel())[0, 1]
    assert abs(r) < 0.1


def test_a_second_update_goes_on_from_the_first_and_explores_anew():
    sim, tau = world("InvertedPendulum-v4"), real_data("InvertedPendulum-v4", 30)
    grounding, policy = RGAT(sim, replace(SMALL, at_std=0.05)), policy_for(sim)
    grounding.fit(tau, 0)
    first = grounding.update(policy, 2048, 0)
    learnt = [p.detach().clone() for p in grounding.learner.policy.net.parameters()]
    scale = grounding.scale.copy()
    statistics = grounding.learner.policy.normalizer.mean.clone()
    grounding.fit(tau[: len(tau) // 2] + tau[:3], 1)
    np.testing.assert_array_equal(grounding.scale, scale)  # units are of the first real data
    second = grounding.update(policy, 64, 1)
    now = list(grounding.learner.policy.net.parameters())
    moved = sum(float(((a - b) ** 2).sum()) for a, b in zip(learnt, now)) ** 0.5
    whole = sum(float((a**2).sum()) for a in learnt) ** 0.5
    assert 0 < moved < 0.2 * whole
    assert torch.equal(statistics, grounding.learner.policy.normalizer.mean)
    # in units of action: 5 % of the range of 6, and hardly less after a single update
    assert first["at_std"] < 0.93 * 0.3 < second["at_std"] <= 0.31


def test_gats_inverse_is_fitted_on_the_sims_transitions(monkeypatch):
    sim, tau = world("InvertedPendulum-v4"), real_data("InvertedPendulum-v4", 30)
    grounding, seen, fit = GAT(sim, SMALL), [], rgat.InverseModel.fit
    monkeypatch.setattr(
        rgat.InverseModel, "fit", lambda self, *a: seen.append(a) or fit(self, *a, max_updates=1)
    )
    grounding.fit(tau, 0)
    grounding.update(policy_for(sim), 400, 0)
    s, s_next, a = (x.numpy() for x in seen[0][:3])
    after = predict_all(sim, Transitions(s, a, s_next))
    np.testing.assert_allclose(after, s_next, atol=1e-5)


# --- solved ---------------------------------------------------------------------------------------


def test_solved_takes_the_sim_to_what_f_psi_says():
    sim, oracle_sim, real = (world("InvertedPendulum-v4", real=k) for k in (False, False, True))
    grounding, oracle = Solved(sim, SMALL), Oracle(oracle_sim, SMALL, real.model)

    class Truth:
        residual = True

        def __call__(self, s, a):
            real.batch.state[:] = sim.batch.state
            return real.peek(a), None

    tau = real_data("InvertedPendulum-v4", 30)
    grounding.fit(tau, 0), oracle.fit(tau, 0)
    grounding.real_model = Truth()
    obs, _ = sim.reset(seed=0)
    oracle_sim.reset(seed=0)
    sim.counterfactual_steps = 0
    a = np.array([[-2.0], [-0.5], [0.7], [2.0]])
    np.testing.assert_allclose(grounding.solve(obs, a), oracle.transformer(obs, a), atol=1e-9)
    assert sim.counterfactual_steps == 4 * (2 + 2)


def test_what_was_solved_is_distilled():
    sim, tau = world("InvertedPendulum-v4"), real_data("InvertedPendulum-v4", 30)
    policy, grounding = policy_for(sim), Solved(sim, SMALL)
    grounding.fit(tau, 0)
    assert grounding.update(policy, 2000, 0)["sim_transitions"] > 1000
    held_out = real_data("InvertedPendulum-v4", 5)
    raw, solved, distilled = (
        one_step_error(sim, t, held_out)[0]
        for t in (identity, grounding.solve, grounding.transformer)
    )
    assert solved < 0.5 * raw and distilled < 1.3 * solved + 0.05 * raw
    other = Solved(world("InvertedPendulum-v4"), SMALL)
    other.load(copy.deepcopy(grounding.state()))
    obs, a = held_out.s[:4], held_out.a[:4]
    np.testing.assert_array_equal(other.transformer(obs, a), grounding.transformer(obs, a))


@pytest.mark.parametrize("env_id", ["InvertedPendulum-v4", "Hopper-v4", "HalfCheetah-v4"])
def test_the_oracle_is_never_worse_than_the_identity(env_id):
    sim, real = world(env_id), world(env_id, real=True)
    oracle = Oracle(sim, SMALL, real.model)
    obs, _ = sim.reset(seed=2)
    box, rng = sim.single_action_space, np.random.default_rng(0)
    better = []
    for _ in range(25):
        a = rng.uniform(box.low, box.high, sim.action_space.shape)
        state = sim.batch.state.copy()
        a_hat = oracle.transformer(obs, a)
        np.testing.assert_array_equal(sim.batch.state, state)  # it looked, and moved nothing
        assert (a_hat >= box.low).all() and (a_hat <= box.high).all()
        real.batch.state[:] = state
        truth = real.peek(a)
        error = lambda u: ((sim.peek(u) - truth) ** 2).sum(1)
        assert (error(a_hat) <= error(a) * (1 + 1e-9) + 1e-12).all()
        better.append(error(a_hat).mean() / error(a).mean())
        obs = sim.step(a, applied=a_hat)[0]
    assert np.median(better) < 0.9


def test_the_oracle_finds_the_best_action_of_the_pendulum():
    sim, real = world("InvertedPendulum-v4"), world("InvertedPendulum-v4", real=True)
    oracle = Oracle(sim, SMALL, real.model)
    obs, _ = sim.reset(seed=0)
    a = np.array([[-2.0], [-0.5], [0.7], [2.0]])
    found = oracle.transformer(obs, a)
    real.batch.state[:] = sim.batch.state
    truth = real.peek(a)
    error = lambda u: ((sim.peek(np.broadcast_to(u, (4, 1))) - truth) ** 2).sum(1)
    grid = np.min([error(u) for u in np.linspace(-3, 3, 601)], axis=0)
    assert (error(found) < grid + 1e-4).all()


def test_one_step_errors_by_hand():
    env_id = "InvertedPendulum-v4"
    sim, one, tau = world(env_id), world(env_id, n=1), real_data(env_id)[:11]
    halve = lambda obs, a: 0.5 * a
    miss, change = [], []
    for s, a, s_next in zip(tau.s.astype(float), tau.a.astype(float), tau.s_next.astype(float)):
        miss.append((one.predict(s[None], 0.5 * a[None])[0] - s_next) ** 2)
        change.append(((0.5 * a) ** 2).sum())
    # each dimension in units of its own real step, then the RMS over dimensions
    steps = ((tau.s_next.astype(float) - tau.s) ** 2).mean(0)
    expected = np.sqrt((np.mean(miss, axis=0) / steps).mean())
    assert one_step_error(sim, halve, tau) == pytest.approx(
        (expected, np.sqrt(np.mean(change))), rel=1e-3
    )
    assert one_step_error(sim, identity, tau)[1] == 0


def test_one_step_error_is_naught_in_the_same_world():
    sim = world("InvertedPendulum-v4")
    tau = rollouts(policy_for(sim), sim, 4, seed=0)[1]
    assert one_step_error(sim, identity, tau)[0] < 1e-4  # what float32 keeps of the states


# --- strangers ------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", ["InvertedPendulum-v4", "Hopper-v5"])
def test_sb3_trains_in_the_grounded_sim(env_id):
    pytest.importorskip("sb3_contrib")
    from sb3_adapter import ActingPolicy, trpo_model

    grounded = GroundedEnv(world(env_id), lambda obs, a: 0.8 * a)
    model = trpo_model(grounded, TRPOConfig(batch_size=256, value_batch=64), seed=0)
    before = [p.detach().clone() for p in model.policy.parameters()]
    model.learn(600)
    assert model.num_timesteps == 768
    assert any(not torch.equal(a, b) for a, b in zip(before, model.policy.parameters()))
    assert all(torch.isfinite(p).all() for p in model.policy.parameters())
    returns = rollouts(ActingPolicy(model), world(env_id), 3, seed=0, deterministic=True)[0]
    assert np.isfinite(returns).all() and (returns > 0).all()


def test_sb3_is_told_falls_and_time_limits_apart(monkeypatch):
    pytest.importorskip("stable_baselines3")
    from sb3_adapter import SB3Env

    import envs

    monkeypatch.setattr(envs, "TIME_LIMIT", 12)
    env, twin = SB3Env(world("Hopper-v4")), world("Hopper-v4")
    env.seed(0), env.reset(), twin.reset(seed=0)
    rng, kinds = np.random.default_rng(0), set()
    for _ in range(60):
        a = rng.uniform(-1, 1, (4, 3))
        obs, reward, done, infos = env.step(a)
        _, _, terminated, truncated, info = twin.step(a)
        np.testing.assert_array_equal(done, terminated | truncated)
        for i in np.flatnonzero(done):
            np.testing.assert_array_equal(infos[i]["terminal_observation"], info["next_obs"][i])
            assert infos[i]["TimeLimit.truncated"] == (truncated[i] and not terminated[i])
            kinds.add(infos[i]["TimeLimit.truncated"])
    assert kinds == {True, False}
