"""TRPO's pieces against closed forms, plain loops and torch.distributions; the learner on
environments with known answers."""

import copy
import io
from concurrent.futures import Future
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from gymnasium.vector import VectorEnv
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import trpo
from envs import BatchEnv
from models import GaussianPolicy, Regressor, Value
from trpo import (
    PRESETS,
    TRPO,
    EpisodeReturns,
    Transitions,
    TRPOConfig,
    conjugate_gradient,
    explained_variance,
    fisher_product,
    gae,
    policy_update,
    rollouts,
)

pytestmark = pytest.mark.filterwarnings("ignore")
seeds = st.integers(0, 2**31 - 1)


# --- GAE ------------------------------------------------------------------------------------------


def plain_gae(reward, value, next_value, terminated, done, gamma, lam):
    """The sum of (gamma lam)^l delta_{t+l} to the episode's end,
    written out for one environment."""
    T = len(reward)
    advantage = np.zeros(T)
    for t in range(T):
        weight = 1.0
        for k in range(t, T):
            bootstrap = 0.0 if terminated[k] else gamma * next_value[k]
            advantage[t] += weight * (reward[k] + bootstrap - value[k])
            weight *= gamma * lam
            if done[k]:
                break
    return advantage


@given(seeds, st.integers(1, 25), st.floats(0, 1), st.floats(0, 1))
@settings(max_examples=60, deadline=None)
def test_gae_equals_a_plain_loop(seed, T, gamma, lam):
    rng = np.random.default_rng(seed)
    reward, value, next_value = rng.normal(size=(3, T, 4))
    terminated = rng.random((T, 4)) < 0.2
    done = terminated | (rng.random((T, 4)) < 0.2)
    ours = gae(reward, value, next_value, terminated, done, gamma, lam)
    for i in range(4):
        column = [x[:, i] for x in (reward, value, next_value, terminated, done)]
        np.testing.assert_allclose(
            ours[:, i], plain_gae(*column, gamma, lam), rtol=1e-10, atol=1e-12
        )


def test_gae_bootstraps_a_time_limit_and_not_a_fall():
    one, no = np.array([[1.0]]), np.array([[False]])
    common = dict(reward=one, value=0 * one, next_value=10 * one, gamma=0.9, lam=0.95)
    assert gae(**common, terminated=no, done=~no) == pytest.approx(10.0)  # 1 + 0.9 * 10
    assert gae(**common, terminated=~no, done=~no) == pytest.approx(1.0)


def test_an_episodes_end_keeps_the_next_episode_out():
    reward = np.array([[0.0], [0.0], [100.0]])
    zero, no = np.zeros((3, 1)), np.zeros((3, 1), bool)
    done = np.array([[False], [True], [False]])
    np.testing.assert_array_equal(gae(reward, zero, zero, no, done, 0.99, 0.95)[:2], 0)


# --- conjugate gradient and Fisher product --------------------------------------------------------


@given(seeds, st.integers(1, 12))
@settings(max_examples=60, deadline=None)
def test_conjugate_gradient_equals_a_direct_solve(seed, n):
    g = torch.Generator().manual_seed(seed)
    M = torch.randn(n, n, generator=g, dtype=torch.float64)
    A, b = M @ M.T + 0.5 * torch.eye(n), torch.randn(n, generator=g, dtype=torch.float64)
    x = conjugate_gradient(lambda v: A @ v, b, steps=20 * n, tolerance=1e-20)
    torch.testing.assert_close(x, torch.linalg.solve(A, b), rtol=1e-6, atol=1e-8)


def test_conjugate_gradient_on_no_right_hand_side_and_on_lost_curvature():
    assert not conjugate_gradient(lambda v: v, torch.zeros(4), 10).any()
    indefinite = torch.diag(torch.tensor([1.0, -1.0, 2.0]))
    assert torch.isfinite(conjugate_gradient(lambda v: indefinite @ v, torch.ones(3), 10)).all()
    assert torch.isfinite(conjugate_gradient(lambda v: v * torch.nan, torch.ones(3), 10)).all()


def flat(module):
    return torch.cat([p.detach().reshape(-1) for p in module.parameters()])


def kl_hessian(policy, obs):
    """The Hessian of the mean KL to the policy as it is, over all parameters, by
    torch.distributions and double backward."""
    names = [n for n, _ in policy.named_parameters()]
    shapes = [p.shape for p in policy.parameters()]

    def dist(theta):
        parts = dict(
            zip(
                names,
                (x.reshape(s) for x, s in zip(theta.split([s.numel() for s in shapes]), shapes)),
            )
        )
        mean, log_std = torch.func.functional_call(policy, parts, (obs,))
        return torch.distributions.Normal(mean, log_std.exp().expand_as(mean))

    theta = flat(policy)
    now = dist(theta)
    kl = lambda t: torch.distributions.kl_divergence(now, dist(t)).sum(1).mean()
    return torch.autograd.functional.hessian(kl, theta)


@pytest.mark.parametrize("seed", range(3))
def test_fisher_product_equals_the_explicit_hessian(seed):
    torch.manual_seed(seed)
    policy = GaussianPolicy(3, 2, (5,), log_std=-0.7).double()
    policy.net[-1].weight.data.normal_()
    obs = torch.randn(20, 3, dtype=torch.float64)
    H = kl_hessian(policy, obs)
    product = fisher_product(policy, obs, damping=0.1)
    for _ in range(4):
        v = torch.randn(len(H), dtype=torch.float64)
        torch.testing.assert_close(product(v), H @ v + 0.1 * v, rtol=1e-8, atol=1e-10)
    assert torch.linalg.eigvalsh(H).min() > -1e-10


# --- one update of the policy ---------------------------------------------------------------------


def mean_kl_and_log_prob(policy, old_mean, old_log_std, obs, action):
    """KL to the old policy and the new log-probabilities, by
    torch.distributions in double precision."""
    with torch.no_grad():
        mean, log_std = (x.double() for x in policy(obs))
    old = torch.distributions.Normal(
        old_mean.double(), old_log_std.double().exp().expand_as(old_mean)
    )
    new = torch.distributions.Normal(mean, log_std.exp().expand_as(mean))
    return (
        torch.distributions.kl_divergence(old, new).sum(1).mean(),
        new.log_prob(action.double()).sum(1),
        new.entropy()[0].sum(),
    )


def advantages(kind, obs, action, g):
    noise = torch.randn(len(obs), generator=g, dtype=torch.float64)
    return {
        "random": noise,
        "zero": 0 * noise,
        "equal": 0 * noise + 7.3,
        "nearly equal": 1e6 + 1e-9 * noise,
        "huge": 1e30 * noise,
        "overflowing": 1e300 * noise,
        "tiny": 1e-30 * noise,
        "one": torch.nn.functional.one_hot(torch.tensor(0), len(obs)).double(),
        "correlated": action[:, 0].double() * 100 + obs[:, 0].double(),
        "anticorrelated": -(action.double().norm(dim=1) ** 4),
        "infinite": noise / (noise.abs() > noise.abs().median()),
        "nan": noise * torch.nan,
    }[kind]


KINDS = (
    "random,zero,equal,nearly equal,huge,overflowing,tiny,one,correlated,anticorrelated,"
    "infinite,nan"
).split(",")
RESTORED = ("no gradient", "no curvature", "exhausted")


@given(
    seed=seeds,
    kind=st.sampled_from(KINDS),
    n=st.sampled_from([2, 3, 5, 16, 200]),
    log_std=st.sampled_from([-6.0, -2.0, 0.0, 2.0]),
    max_kl=st.sampled_from([1e-4, 1e-2, 0.5]),
    entropy=st.sampled_from([0.0, 1e-5, 0.1]),
    damping=st.sampled_from([0.0, 1e-8, 0.1]),
    scale=st.sampled_from([0.1, 1.0, 1e4]),
    backtracks=st.sampled_from([1, 15]),
    hidden=st.sampled_from([(4,), (16, 16)]),
)
@settings(max_examples=250, deadline=None, suppress_health_check=list(HealthCheck))
def test_an_update_keeps_its_promises(
    seed, kind, n, log_std, max_kl, entropy, damping, scale, backtracks, hidden
):
    torch.manual_seed(seed)
    g = torch.Generator().manual_seed(seed)
    policy = GaussianPolicy(4, 2, hidden, log_std)
    policy.net[-1].weight.data.normal_(generator=g)
    obs = scale * torch.randn(n, 4, generator=g)
    with torch.no_grad():
        old_mean, old_log_std = (x.clone() for x in policy(obs))
        action = policy.act(obs, g)
    before = flat(policy).clone()
    advantage = advantages(kind, obs, action, g)
    config = TRPOConfig(max_kl=max_kl, entropy=entropy, cg_damping=damping, backtracks=backtracks)

    stats = policy_update(policy, obs, action, advantage, config)

    after = flat(policy)
    assert torch.isfinite(after).all()
    assert all(np.isfinite(v) for k, v in stats.items() if k != "line_search")
    kl, log_prob, new_entropy = mean_kl_and_log_prob(policy, old_mean, old_log_std, obs, action)
    if stats["line_search"] in RESTORED:
        assert torch.equal(before, after)
        assert stats["step_size"] == stats["kl"] == stats["surrogate_gain"] == 0
        return
    assert stats["line_search"] == "accepted"
    rounding = 2e-6 + 1e-5 * float((action - old_mean).div(old_log_std.exp()).abs().max())
    assert kl <= max_kl + rounding and stats["kl"] <= max_kl
    assert stats["kl"] == pytest.approx(float(kl), abs=rounding)
    # the surrogate once more, in double precision
    spread = advantage.std()
    informative = torch.isfinite(spread) and spread > 1e-9 * advantage.abs().max()
    A = (
        (advantage - advantage.mean()) / spread
        if informative
        else torch.zeros(n, dtype=torch.float64)
    )
    _, old_log_prob, old_entropy = mean_kl_and_log_prob(
        _at(policy, before), old_mean, old_log_std, obs, action
    )
    gain = ((log_prob - old_log_prob).exp() * A - A).mean() + entropy * (new_entropy - old_entropy)
    assert gain > -rounding * max(1.0, float(A.abs().max()))
    assert stats["surrogate_gain"] > 0


def _at(policy, theta):
    """The same policy with other parameters."""
    torch.nn.utils.vector_to_parameters(theta, policy.parameters())
    return policy


def one_update(advantage_of, config=TRPOConfig(), n=400, seed=0):
    torch.manual_seed(seed)
    policy, obs = GaussianPolicy(3, 1, (16,)), torch.randn(n, 3)
    action = policy.act(obs)
    return policy, obs, policy_update(policy, obs, action, advantage_of(obs, action), config)


def test_an_update_moves_towards_what_was_rewarded():
    policy, obs, stats = one_update(lambda obs, action: action[:, 0])
    assert stats["line_search"] == "accepted"
    assert policy.mean(obs).mean() > 0.02
    assert 0.5 * 0.01 < stats["kl"] <= 0.01  # the trust region is used, not hidden in


def test_the_update_is_the_natural_gradient_step():
    """Against F^-1 g by a dense solve, in double precision, for the full step."""
    torch.manual_seed(1)
    policy = GaussianPolicy(3, 2, (4,)).double()
    policy.net[-1].weight.data.normal_()
    obs = torch.randn(60, 3, dtype=torch.float64)
    action = policy.mean(obs).detach() + torch.randn(60, 2, dtype=torch.float64)
    advantage = action[:, 0] - action[:, 1] * obs[:, 0]
    A = (advantage - advantage.mean()) / advantage.std()
    mean, log_std = policy(obs)
    log_prob = (
        torch.distributions.Normal(mean, log_std.exp().expand_as(mean)).log_prob(action).sum(1)
    )
    g = torch.cat(
        [
            x.reshape(-1)
            for x in torch.autograd.grad((log_prob * A).mean(), list(policy.parameters()))
        ]
    )
    F = kl_hessian(policy, obs) + 0.1 * torch.eye(len(g))
    x = torch.linalg.solve(F, g)
    before = flat(policy)
    config = TRPOConfig(max_kl=1e-4, fisher_every=1, cg_steps=500, cg_damping=0.1)
    stats = policy_update(policy, obs, action, advantage, config)
    expected = stats["step_size"] * torch.sqrt(2 * 1e-4 / (x @ F @ x)) * x
    torch.testing.assert_close(flat(policy) - before, expected, rtol=1e-3, atol=1e-7)


def test_entropy_alone_widens_the_policy():
    policy, _, stats = one_update(
        lambda obs, action: torch.zeros(len(obs)), TRPOConfig(entropy=0.1)
    )
    assert stats["line_search"] == "accepted" and float(policy.log_std.detach()[0]) > 0
    policy, _, stats = one_update(lambda obs, action: torch.zeros(len(obs)))
    assert stats["line_search"] == "no gradient" and float(policy.log_std.detach()[0]) == 0


def test_a_line_search_that_finds_nothing_restores_exactly(monkeypatch):
    import trpo

    kl = trpo.gaussian_kl
    monkeypatch.setattr(
        trpo, "gaussian_kl", lambda *a: kl(*a) + (0 if torch.is_grad_enabled() else 1)
    )
    torch.manual_seed(0)
    policy, obs = GaussianPolicy(3, 1, (16,)), torch.randn(50, 3)
    before = flat(policy).clone()
    action = policy.act(obs)
    assert (
        policy_update(policy, obs, action, action[:, 0], TRPOConfig())["line_search"] == "exhausted"
    )
    assert torch.equal(before, flat(policy))


def test_explained_variance():
    target = np.random.default_rng(0).normal(size=1000)
    assert explained_variance(target, target) == 1
    assert explained_variance(np.zeros(1000), target) == pytest.approx(0)
    assert explained_variance(-target, target) == pytest.approx(-3)
    assert explained_variance(target, np.ones(1000)) == 0


# --- the learner ----------------------------------------------------------------------------------


class Corridor(VectorEnv):
    """Moves by its action; falls beyond 3, is cut after 5 steps. Reward: where it stands."""

    def __init__(self, num_envs):
        self.num_envs = num_envs
        self.single_action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        self.rng = np.random.default_rng(seed)
        self.x, self.t = self.rng.normal(size=self.num_envs), np.zeros(self.num_envs, int)
        return self.x[:, None].copy(), {}

    def step(self, actions):
        self.x, self.t = self.x + actions[:, 0], self.t + 1
        next_obs, reward = self.x[:, None].copy(), self.x.copy()
        terminated, truncated = self.x > 3, self.t >= 5
        done = terminated | truncated
        self.x[done], self.t[done] = self.rng.normal(size=done.sum()), 0
        return self.x[:, None].copy(), reward, terminated, truncated, {"next_obs": next_obs}


def test_advantages_use_the_value_of_the_true_successor():
    torch.manual_seed(0)
    learner = TRPO(GaussianPolicy(1, 1), Value(1), TRPOConfig(gamma=0.9, lam=0.8))
    env = Corridor(6)
    batch, _ = learner.collect(env, env.reset(seed=0)[0], 40)
    assert batch["terminated"].any() and (batch["done"] & ~batch["terminated"]).any()
    advantage, value = learner.advantages(batch)
    with torch.no_grad():
        v = lambda x: learner.value(torch.from_numpy(x.reshape(-1, 1))).numpy().reshape(40, 6)
        ours, successor = v(batch["obs"]), v(batch["next_obs"])
    np.testing.assert_allclose(value, ours, atol=1e-6)
    for i in range(6):
        column = [
            x[:, i] for x in (batch["reward"], ours, successor, batch["terminated"], batch["done"])
        ]
        np.testing.assert_allclose(advantage[:, i], plain_gae(*column, 0.9, 0.8), atol=1e-4)


def test_actions_are_clipped_for_the_environment_alone():
    learner = TRPO(GaussianPolicy(1, 1, log_std=1.5), Value(1), TRPOConfig())
    env, given_actions = Corridor(4), []
    step = env.step
    env.step = lambda a: given_actions.append(a.copy()) or step(a)
    batch, _ = learner.collect(env, env.reset(seed=0)[0], 30)
    assert np.abs(batch["action"]).max() > 1.5
    np.testing.assert_array_equal(np.array(given_actions), np.clip(batch["action"], -1, 1))


def test_episode_returns_span_batches():
    returns = EpisodeReturns(2)
    batch = lambda reward, done: {"reward": np.array(reward, float), "done": np.array(done, bool)}
    assert np.isnan(returns.mean(batch([[1, 10]], [[0, 0]])))
    assert returns.mean(batch([[2, 20], [4, 40]], [[1, 0], [0, 1]])) == pytest.approx((3 + 70) / 2)
    assert returns.mean(batch([[5, 0]], [[1, 0]])) == pytest.approx(9)


def new_learner(env_id, seed=0, **changes):
    env = BatchEnv(env_id, 8, nthread=1)
    torch.manual_seed(seed)
    nobs, nact = env.single_observation_space.shape[0], env.single_action_space.shape[0]
    config = replace(PRESETS[env_id.split("-")[0]], **changes)
    return env, TRPO(GaussianPolicy(nobs, nact), Value(nobs), config)


def test_learning_repeats_and_leaves_torchs_threads_alone():
    threads, results = torch.get_num_threads(), []
    for _ in range(2):
        env, learner = new_learner("Hopper-v4", batch_size=256)
        rows = []
        learner.learn(env, 600, seed=3, on_update=rows.append)
        results.append((rows, flat(learner.policy), flat(learner.value)))
    assert torch.get_num_threads() == threads
    assert [r["steps"] for r in results[0][0]] == [256, 512, 768]
    np.testing.assert_equal(results[0][0], results[1][0])
    assert torch.equal(results[0][1], results[1][1]) and torch.equal(results[0][2], results[1][2])
    for key in ("kl", "step_size", "line_search", "explained_variance", "return"):
        assert key in rows[0]


def test_a_learner_goes_on_from_its_saved_state():
    env, learner = new_learner("InvertedPendulum-v4", batch_size=256, normalize_obs=True)
    learner.learn(env, 512, seed=0, freeze_normalizer=False)
    _, other = new_learner("InvertedPendulum-v4", seed=1, batch_size=256, normalize_obs=True)
    file = io.BytesIO()  # through a file, as checkpoints go
    torch.save(learner.state(), file)
    file.seek(0)
    other.load(torch.load(file, weights_only=True))
    for one in (learner, other):
        one.learn(env, 512, seed=1)
    assert torch.equal(flat(learner.policy), flat(other.policy)) and torch.equal(
        flat(learner.value), flat(other.value)
    )
    assert all(torch.equal(a, b) for a, b in zip(learner.policy.buffers(), other.policy.buffers()))


@pytest.mark.parametrize("change", ["copied", "converted"])
def test_a_copied_or_converted_learner_keeps_its_critic(change):
    env, learner = new_learner("Hopper-v4", batch_size=256)
    learner.learn(env, 512, seed=0)
    other = copy.deepcopy(learner)
    if change == "converted":
        other.value.double().float(), other.policy.double().float()
    for one in (learner, other):
        before = flat(one.value).clone()
        one.learn(env, 512, seed=1)
        assert not torch.equal(before, flat(one.value))
    for network in ("value", "policy"):
        ours, theirs = flat(getattr(learner, network)), flat(getattr(other, network))
        assert torch.allclose(ours, theirs, atol=1e-4)
        assert change == "converted" or torch.equal(ours, theirs)


def test_learners_and_fits_do_not_depend_on_torchs_threads():
    threads, found = torch.get_num_threads(), []
    try:
        for n in (1, 4):
            torch.set_num_threads(n)
            env, learner = new_learner("Hopper-v4", batch_size=256)
            learner.learn(env, 256, seed=0)
            x = torch.randn(4000, 25, generator=torch.Generator().manual_seed(0))
            model = Regressor(25, 11)
            model.fit(x, x[:, :11].sin(), torch.Generator().manual_seed(0), max_updates=30)
            found.append((flat(learner.policy), flat(learner.value), flat(model)))
            assert torch.get_num_threads() == n
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(a, b) for a, b in zip(*found))


class ChainEnv:
    """Two states in turn, reward 1 in the first and 3 in the second, for
    200 steps that a time limit cuts."""

    num_envs = 4
    single_observation_space = Box(-1, 1, (2,), np.float32)
    single_action_space = Box(-1, 1, (1,), np.float32)

    def reset(self, seed=None):
        self.t = 0
        return self.obs(), {}

    def obs(self):
        return np.tile(np.eye(2)[self.t % 2], (4, 1))

    def step(self, action):
        reward = np.full(4, (1.0, 3.0)[self.t % 2])
        self.t += 1
        after, cut = self.obs(), np.full(4, self.t % 200 == 0)
        return self.obs(), reward, np.zeros(4, bool), cut, {"next_obs": after}


def test_the_critic_finds_the_values_of_a_chain():
    gamma = 0.5
    torch.manual_seed(0)
    config = TRPOConfig(batch_size=256, gamma=gamma, lam=0.9, value_epochs=20, value_batch=64)
    learner = TRPO(GaussianPolicy(2, 1), Value(2), config)
    learner.learn(ChainEnv(), 256 * 25, seed=0)
    expected = np.linalg.solve([[1, -gamma], [-gamma, 1]], [1, 3])
    with torch.no_grad():
        np.testing.assert_allclose(learner.value(torch.eye(2)).numpy(), expected, rtol=0.03)
    assert learner.value.returns.count == 256 * 25
    assert 1 < float(learner.value.returns.mean) < 6


def test_collect_equals_a_plain_loop_over_gymnasiums_own_environments():
    theirs = gymnasium.vector.SyncVectorEnv(
        [lambda: gymnasium.make("Hopper-v4", max_episode_steps=None) for _ in range(3)],
        autoreset_mode=gymnasium.vector.AutoresetMode.SAME_STEP,
    )
    ours = BatchEnv("Hopper-v4", 3, nthread=1)
    _, learner = new_learner("Hopper-v4")
    horizon, found = 80, []
    for env in (ours, theirs):
        learner.generator.manual_seed(1)
        found.append(learner.collect(env, env.reset(seed=5)[0], horizon))
    (mine, last), (stock, stock_last) = found
    obs, _ = theirs.reset(seed=5)
    generator = torch.Generator().manual_seed(1)
    for t in range(horizon):
        action = learner.policy.act(torch.from_numpy(obs.astype(np.float32)), generator).numpy()
        before = obs
        obs, reward, terminated, truncated, info = theirs.step(np.clip(action, -1, 1))
        for batch in (mine, stock):
            np.testing.assert_allclose(batch["obs"][t], before.astype(np.float32), atol=1e-6)
            np.testing.assert_allclose(batch["action"][t], action, atol=1e-5)
            np.testing.assert_allclose(batch["reward"][t], reward, atol=1e-6)
            np.testing.assert_array_equal(batch["terminated"][t], terminated)
            np.testing.assert_array_equal(batch["done"][t], terminated | truncated)
            for i in range(3):
                after = info["final_obs"][i] if (terminated | truncated)[i] else obs[i]
                np.testing.assert_allclose(batch["next_obs"][t, i], after, atol=1e-5)
    assert mine["done"].sum() > 2
    np.testing.assert_allclose(last, stock_last, atol=1e-6)


def test_a_line_search_takes_no_worse_surrogate(monkeypatch):
    """The trust region is far wider than the surrogate's hill, and stops nothing."""
    monkeypatch.setattr(trpo, "gaussian_kl", lambda *a: torch.zeros(()))
    torch.manual_seed(1)
    policy, obs = GaussianPolicy(3, 1, (16,)), torch.randn(200, 3)
    action = policy.act(obs)
    config = TRPOConfig(max_kl=1e4, backtracks=60, entropy=0.1)
    stats = policy_update(policy, obs, action, action[:, 0], config)
    assert stats["line_search"] == "accepted" and 0 < stats["step_size"] < 1
    assert stats["surrogate_gain"] > 0


def test_the_presets_are_the_documented_ones():
    assert (PRESETS["Hopper"].gamma, PRESETS["Hopper"].lam) == (0.995, 0.97)
    assert PRESETS["HalfCheetah"].normalize_obs and PRESETS["HalfCheetah"].max_kl == 0.02
    sb = trpo.STABLE_BASELINES
    assert (sb.batch_size, sb.gamma, sb.lam, sb.max_kl, sb.cg_steps) == (1024, 0.99, 0.98, 0.01, 10)
    assert (sb.cg_damping, sb.value_epochs, sb.value_lr, sb.value_batch) == (0.01, 3, 3e-4, 128)


def test_observation_statistics_move_only_when_told():
    env, learner = new_learner("InvertedPendulum-v4", batch_size=256, normalize_obs=True)
    learner.learn(env, 256, seed=0)
    assert float(learner.policy.normalizer.count) == 0
    learner.learn(env, 256, seed=0, freeze_normalizer=False)
    assert float(learner.policy.normalizer.count) == float(learner.value.normalizer.count) == 256


class InTurn:
    """An executor that does its work at once, in the caller's own thread."""

    def __init__(self, workers):
        pass

    def __enter__(self):
        return self

    def __exit__(self, *error):
        pass

    def submit(self, work):
        future = Future()
        future.set_result(work())
        return future


@pytest.mark.parametrize("normalize", [False, True])
def test_the_value_fitted_beside_is_the_value_fitted_in_turn(normalize, monkeypatch):
    learners = []
    for executor in (trpo.ThreadPoolExecutor, InTurn):
        monkeypatch.setattr(trpo, "ThreadPoolExecutor", executor)
        env, learner = new_learner("Hopper-v4", batch_size=256, normalize_obs=normalize)
        learner.learn(env, 1500, seed=2, freeze_normalizer=False)
        learners.append(learner)
    for network in ("policy", "value"):
        one, other = (getattr(learner, network).state_dict() for learner in learners)
        assert all(torch.equal(one[k], other[k]) for k in one)


def test_a_fault_of_the_value_fit_is_not_lost(monkeypatch):
    def fault(*arguments):
        raise ArithmeticError("no fit")

    env, learner = new_learner("InvertedPendulum-v4", batch_size=256)
    monkeypatch.setattr(learner.optimizer, "step", fault)
    with pytest.raises(ArithmeticError, match="no fit"):
        learner.learn(env, 256, seed=0)


def test_no_steps_change_nothing():
    env, learner = new_learner("InvertedPendulum-v4", batch_size=256)
    before = flat(learner.policy).clone(), flat(learner.value).clone()
    learner.learn(env, 0, seed=0)
    assert torch.equal(before[0], flat(learner.policy)) and torch.equal(
        before[1], flat(learner.value)
    )


def test_it_learns_the_pendulum():
    env, learner = new_learner("InvertedPendulum-v4", batch_size=1024)
    before = rollouts(learner.policy, env, 8, seed=7, deterministic=True)[0].mean()
    learner.learn(env, 30_000, seed=0)
    after = rollouts(learner.policy, env, 8, seed=7, deterministic=True)[0].mean()
    assert before < 60 < 150 < after


@pytest.mark.parametrize("episodes", [1, 2, 5])
def test_rollouts_are_gymnasiums_episodes(episodes):
    torch.manual_seed(0)
    policy = GaussianPolicy(11, 3)
    policy.net[-1].weight.data.normal_(std=0.3)
    returns, transitions = rollouts(
        policy, BatchEnv("Hopper-v4", 2, nthread=1), episodes, seed=5, deterministic=True
    )
    assert returns.shape == (episodes,)
    env, expected, count = gymnasium.make("Hopper-v4"), [], 0
    for k in range(episodes):
        obs, done, total = env.reset(seed=5 + k)[0], False, 0.0
        while not done:
            with torch.no_grad():
                a = policy.mean(torch.from_numpy(obs.astype(np.float32))[None]).numpy()[0]
            obs, r, terminated, truncated, _ = env.step(np.clip(a, -1, 1))
            total, done, count = total + r, terminated or truncated, count + 1
        expected.append(total)
    np.testing.assert_allclose(returns, expected, rtol=1e-3)
    assert len(transitions) == count
    env.close()


def test_rollouts_hand_out_true_successors():
    policy = GaussianPolicy(11, 3)
    _, t = rollouts(policy, BatchEnv("Hopper-v4", 3, nthread=1), 5, seed=0)
    # an episode's successor is the next row's state of some environment, or the end of an episode
    known = {row.tobytes() for row in t.s}
    ends = [row for row in t.s_next if row.tobytes() not in known]
    assert len(ends) == 5
    assert all(row[0] < 0.71 or abs(row[1]) > 0.19 for row in ends)


def test_rollouts_hand_out_the_actions_that_the_robot_got():
    env, learner = new_learner("Hopper-v4")
    with torch.no_grad():
        learner.policy.log_std.fill_(2.0)
    tau = rollouts(learner.policy, env, 4, seed=0)[1]
    assert np.abs(tau.a).max() == 1 and (np.abs(tau.a) == 1).mean() > 0.5


def test_transitions_join_and_split():
    make = lambda n, seed: Transitions(
        *np.random.default_rng(seed).normal(size=(3, n, 2)).astype(np.float32)
    )
    joined = make(3, 0) + make(4, 1)
    assert len(joined) == 7
    np.testing.assert_array_equal(joined[3:].s_next, make(4, 1).s_next)
    np.testing.assert_array_equal(joined.tensors()[1].numpy(), joined.a)
