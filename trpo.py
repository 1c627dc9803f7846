"""Trust region policy optimisation (Schulman et al. 2015) with GAE(lambda), in batches.

    learner = TRPO(policy, value, TRPOConfig())
    learner.learn(env, steps=1_000_000, seed=0, on_update=print)

The environment is a gymnasium VectorEnv in SAME_STEP autoreset mode. Each update solves

    max_theta  E[pi_theta/pi_old * A] + entropy * H(pi_theta)
    s.t.       E[KL(pi_old || pi_theta)] <= max_kl

to first order: conjugate gradient on the Fisher matrix gives the direction, the constraint the
length, and a line search the largest step that really keeps both promises.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from models import (
    adam,
    as_vector,
    gaussian_entropy,
    gaussian_kl,
    gaussian_log_prob,
    least_squares_step,
    tie,
    torch_threads,
)


@dataclass(frozen=True)
class TRPOConfig:
    """One learner's settings; the target policy and the action transformer are two instances."""

    batch_size: int = 4096  # transitions per update, over all environments
    gamma: float = 0.99  # discount
    lam: float = 0.95  # lambda of GAE
    max_kl: float = 0.01  # trust region, nats
    entropy: float = 0.0  # weight of the entropy inside the surrogate
    cg_steps: int = 15  # conjugate gradient iterations
    cg_damping: float = 0.1  # added to the Fisher matrix's diagonal
    fisher_every: int = 5  # the Fisher product uses every k-th transition
    backtrack: float = 0.8  # the line search shortens the step by this factor,
    backtracks: int = 15  # at most so many times
    value_epochs: int = 5  # passes of Adam over the batch for the value function
    value_lr: float = 1e-3
    value_batch: int = 512  # its minibatch
    normalize_obs: bool = False  # running mean and std of the observations, until frozen


PRESETS = {
    "InvertedPendulum": TRPOConfig(value_epochs=10),
    "Hopper": TRPOConfig(gamma=0.995, lam=0.97),  # at 0.99 and 0.95 some seeds never stop falling
    "HalfCheetah": TRPOConfig(
        normalize_obs=True, max_kl=0.02
    ),  # at 0.01 two of three seeds stay near 1600 for 1 M steps
}


# both learners where the paper's own settings are asked for: stable-baselines 2's defaults
STABLE_BASELINES = TRPOConfig(
    batch_size=1024,
    lam=0.98,
    cg_steps=10,
    cg_damping=0.01,
    backtrack=0.5,
    backtracks=10,
    value_epochs=3,
    value_lr=3e-4,
    value_batch=128,
)


# --- the pieces -----------------------------------------------------------------------------------


def gae(reward, value, next_value, terminated, done, gamma, lam):
    """Generalised advantage estimates (Schulman et al. 2016, eq. 16), (T, N) like every argument.

    next_value is V of the true successor, so an episode cut by its time limit (done, not
    terminated) is bootstrapped and one that terminated is not.
    """
    delta = reward + gamma * next_value * ~terminated - value
    advantage = np.zeros_like(delta)
    running = np.zeros(delta.shape[1])
    for t in range(len(delta) - 1, -1, -1):
        running = delta[t] + gamma * lam * ~done[t] * running
        advantage[t] = running
    return advantage


def conjugate_gradient(product, b, steps, tolerance=1e-10):
    """Solve A x = b for a symmetric positive definite A given as product(v) = A v. b, x: (n,)."""
    x = torch.zeros_like(b)
    r, p = b.clone(), b.clone()
    rr = r @ r
    for _ in range(steps):
        if rr <= tolerance * (b @ b):
            break
        Ap = product(p)
        pAp = p @ Ap
        if (
            not pAp > 0
        ):  # rounding has eaten the curvature (or NaN): what we have is as good as it gets
            break
        alpha = rr / pAp
        x = x + alpha * p
        r = r - alpha * Ap
        rr_new = r @ r
        p = r + (rr_new / rr) * p
        rr = rr_new
    return x


def fisher_product(policy, obs, damping):
    """v -> (F + damping I) v, F the Fisher matrix of the policy as it is, over obs (N, nobs).

    For a Gaussian, F is the mean over obs of J' diag(1/sigma^2) J, J the Jacobian of the action's
    mean, and 2 for each log sigma: what the Hessian of KL(pi || pi_theta) at theta = pi comes to
    (its gradient is 0 there). F is never formed: J v and J' u are found layer by layer.
    """
    net, log_std = policy.net, policy.log_std.detach()  # in parameters() log_std comes first
    weights = list(net.parameters())
    sizes = [len(log_std), *(w.numel() for w in weights)]
    values = net.values(policy.normalizer(obs))
    metric = torch.exp(-2 * log_std) / len(obs)

    def product(v):
        v_log_std, *v_weights = v.split(sizes)
        Jv = net.tangent(values, [x.view_as(w) for x, w in zip(v_weights, weights)])
        Fv = net.gradient(values, metric * Jv)
        return torch.cat([2 * v_log_std, *(x.reshape(-1) for x in Fv)]) + damping * v

    return product


def policy_update(policy, obs, action, advantage, config):
    """One TRPO step on the policy, in place.

    Tensors: obs (N, nobs), action (N, nact), advantage (N,).

    Returns a dict: kl, surrogate_gain, step_size (the fraction of the full step taken, 0 if none),
    line_search ("accepted", "no gradient", "no curvature", "exhausted"), entropy. Parameters change
    only if the new ones are finite, keep KL <= max_kl and better the surrogate; otherwise they are
    restored exactly.
    """
    advantage = advantage.double()
    spread = advantage.std() if len(advantage) > 1 else torch.zeros(())
    # an advantage that is the same everywhere says nothing; dividing by its rounding error would
    informative = torch.isfinite(spread) and spread > 1e-9 * advantage.abs().max()
    advantage = (
        (advantage - advantage.mean()) / spread if informative else torch.zeros_like(advantage)
    ).to(obs.dtype)

    mean, log_std = policy(obs)
    log_prob = gaussian_log_prob(mean, log_std, action)
    old_mean, old_log_std, old_log_prob = mean.detach(), log_std.detach().clone(), log_prob.detach()

    def surrogate(log_prob, log_std):
        return (
            torch.exp(log_prob - old_log_prob) * advantage
        ).mean() + config.entropy * gaussian_entropy(log_std)

    stats = {"kl": 0.0, "surrogate_gain": 0.0, "step_size": 0.0, "line_search": "accepted"}
    old_surrogate = surrogate(log_prob, log_std)
    gradient = parameters_to_vector(torch.autograd.grad(old_surrogate, list(policy.parameters())))
    old_surrogate = old_surrogate.detach()
    old = parameters_to_vector(policy.parameters()).detach().clone()
    if not torch.isfinite(gradient).all() or not gradient.any():
        return {
            **stats,
            "line_search": "no gradient",
            "entropy": float(gaussian_entropy(old_log_std)),
        }

    product = fisher_product(policy, obs[:: config.fisher_every], config.cg_damping)
    direction = conjugate_gradient(product, gradient, config.cg_steps)
    curvature = direction @ product(direction)
    full_step = torch.sqrt(2 * config.max_kl / curvature) * direction
    stats["line_search"] = "exhausted" if torch.isfinite(full_step).all() else "no curvature"
    if stats["line_search"] == "exhausted":
        with torch.no_grad():
            for k in range(config.backtracks):
                vector_to_parameters(old + config.backtrack**k * full_step, policy.parameters())
                mean, log_std = policy(obs)
                new_surrogate = surrogate(gaussian_log_prob(mean, log_std, action), log_std)
                kl = gaussian_kl(old_mean, old_log_std, mean, log_std)
                if (
                    torch.isfinite(new_surrogate)
                    and kl <= config.max_kl
                    and new_surrogate > old_surrogate
                ):
                    gain = float(new_surrogate - old_surrogate)
                    stats.update(
                        kl=float(kl),
                        surrogate_gain=gain,
                        step_size=config.backtrack**k,
                        line_search="accepted",
                    )
                    break
            else:
                vector_to_parameters(old, policy.parameters())
    stats["entropy"] = float(gaussian_entropy(policy.log_std.detach()))
    return stats


def value_update(value, optimizer, obs, returns, config, generator):
    """A function that fits V to returns (N,) by minibatch Adam, in the value's own scale.

    Everything random or shared is settled before it is handed out: it may run beside the policy's
    update and the next rollout, and the numbers do not depend on when.
    """
    value.returns.update(returns[:, None])
    inputs, target = (
        value.normalizer(obs),
        (returns[:, None] - value.returns.mean) / value.returns.std,
    )
    orders = [torch.randperm(len(obs), generator=generator) for _ in range(config.value_epochs)]

    def fit():
        for order in orders:
            for x, y in zip(
                inputs[order].split(config.value_batch), target[order].split(config.value_batch)
            ):
                least_squares_step(value.net, optimizer, x, y)

    return fit


def explained_variance(prediction, target):
    """1 - Var[target - prediction] / Var[target]; 0 where the target does not vary."""
    var = np.var(target)
    return float(1 - np.var(target - prediction) / var) if var > 0 else 0.0


# --- the learner ----------------------------------------------------------------------------------


class TRPO:
    """A policy, its value function, and how they learn.

    Args: policy: GaussianPolicy; value: Value; config: TRPOConfig.
    """

    def __init__(self, policy, value, config):
        self.policy, self.value, self.config = policy, value, config
        self.optimizer = adam(value.net, config.value_lr)
        self.generator = torch.Generator()

    def state(self):
        """What a checkpoint needs to go on learning."""
        return {
            "policy": self.policy.state_dict(),
            "value": self.value.state_dict(),
            "optimizer": self.optimizer.state_dict(),
        }

    def load(self, state):
        """Take over what state() returned."""
        self.policy.load_state_dict(state["policy"])
        self.value.load_state_dict(state["value"])
        self.optimizer.load_state_dict(state["optimizer"])

    def batch_steps(self, env):
        """Transitions of one update in env: the batch size in whole rows of its environments."""
        return max(1, self.config.batch_size // env.num_envs) * env.num_envs

    def learn(self, env, steps, seed, freeze_normalizer=True, on_update=None, critic_alone=False):
        """Train on env for at least `steps` transitions, in whole batches; seed decides all chance.

        freeze_normalizer: keep the observation statistics as they are. critic_alone: keep the
        policy, which came without a critic: an improvement by one that knows nothing yet would ruin
        it. on_update(stats) is called with a dict after every update of the policy; the value may
        then still be fitting, and stands still once learn returns.
        """
        as_vector(self.policy)
        tie(self.optimizer, self.value.net)
        self.generator.manual_seed(seed)
        obs, _ = env.reset(seed=seed)
        horizon = self.batch_steps(env) // env.num_envs
        adapt = self.config.normalize_obs and not freeze_normalizer
        returns_of = EpisodeReturns(env.num_envs)
        done_steps = 0
        with torch_threads(1), ThreadPoolExecutor(1) as beside:
            value_fit = beside.submit(lambda: None)  # nothing to wait for yet
            while done_steps < steps:
                batch, obs = self.collect(env, obs, horizon)
                done_steps += horizon * env.num_envs
                value_fit.result()
                stats, value_fit = self.update(batch, beside, critic_alone)
                if adapt:
                    for network in (self.policy, self.value):
                        network.normalizer.update(
                            torch.from_numpy(batch["obs"].reshape(-1, batch["obs"].shape[-1]))
                        )
                if on_update:
                    on_update({"steps": done_steps, "return": returns_of.mean(batch), **stats})
            value_fit.result()

    def collect(self, env, obs, horizon):
        """Act for `horizon` steps. Returns arrays (T, N, ...) by name, and the last observation."""
        low, high = env.single_action_space.low, env.single_action_space.high
        act, rows = self.policy.sampler(self.generator), []
        for _ in range(horizon):
            obs32 = np.asarray(obs, np.float32)
            action = act(torch.from_numpy(obs32)).numpy()
            obs, reward, terminated, truncated, info = env.step(np.clip(action, low, high))
            rows.append(
                (
                    obs32,
                    action,
                    reward,
                    terminated,
                    terminated | truncated,
                    successors(obs, info).astype(np.float32),
                )
            )
        names = ("obs", "action", "reward", "terminated", "done", "next_obs")
        return {name: np.stack(column) for name, column in zip(names, zip(*rows))}, obs

    @torch.no_grad()
    def advantages(self, batch):
        """GAE advantages and the values they are measured from, both (T, N)."""
        T, N = batch["reward"].shape
        value = (
            self.value(torch.from_numpy(batch["obs"]).flatten(0, 1))
            .numpy()
            .reshape(T, N)
            .astype(float)
        )
        # the successor's value is the next row's, save where an episode or the batch ends
        next_value = np.concatenate((value[1:], np.zeros((1, N))))
        edge = batch["done"].copy()
        edge[-1] = True
        next_value[edge] = self.value(torch.from_numpy(batch["next_obs"][edge])).numpy()
        config = self.config
        return gae(
            batch["reward"],
            value,
            next_value,
            batch["terminated"],
            batch["done"],
            config.gamma,
            config.lam,
        ), value

    def update(self, batch, beside, critic_alone=False):
        """Update the policy from collect()'s arrays; start to fit the
        value in `beside`, an executor.

        Returns the statistics to log, and the future that ends with the fit.
        """
        advantage, value = self.advantages(batch)
        returns = advantage + value
        obs, action = (torch.from_numpy(batch[k]).flatten(0, 1) for k in ("obs", "action"))
        targets = torch.from_numpy(returns.reshape(-1)).float()
        value_fit = beside.submit(
            value_update(self.value, self.optimizer, obs, targets, self.config, self.generator)
        )
        wanted = torch.from_numpy(advantage.reshape(-1) * (not critic_alone))
        config = replace(self.config, entropy=0.0) if critic_alone else self.config
        stats = policy_update(self.policy, obs, action, wanted, config)
        stats["explained_variance"] = explained_variance(value, returns)
        stats["std"] = float(self.policy.log_std.detach().exp().mean())
        stats["reward"] = float(batch["reward"].mean())
        return stats, value_fit


def successors(obs, info):
    """Every transition's true successor (N, nobs).

    That is info["next_obs"], or what gymnasium's own SAME_STEP environments say."""
    if "next_obs" in info:
        return info["next_obs"]
    after = np.array(obs)
    for i in np.flatnonzero(info.get("_final_obs", ())):
        after[i] = info["final_obs"][i]
    return after


class EpisodeReturns:
    """Mean undiscounted return of the episodes that ended in each batch."""

    def __init__(self, num_envs):
        self.running = np.zeros(num_envs)
        self.last = float("nan")

    def mean(self, batch):
        ended = []
        for reward, done in zip(batch["reward"], batch["done"]):
            self.running += reward
            ended += list(self.running[done])
            self.running[done] = 0
        self.last = float(np.mean(ended)) if ended else self.last
        return self.last


def rollouts(policy, env, episodes, seed, deterministic=False):
    """Run `episodes` whole episodes of a policy.

    Returns their undiscounted returns (episodes,) and Transitions. Each environment plays one
    episode after each reset, so that short episodes are not favoured. The rows of an episode stand
    together, in their order in time.
    """
    generator = torch.Generator().manual_seed(seed)
    low, high = env.single_action_space.low, env.single_action_space.high
    returns, rows = [], []
    with torch_threads(1), torch.no_grad():
        while len(returns) < episodes:
            obs, _ = env.reset(seed=seed + len(returns))
            wanted = np.arange(env.num_envs) < episodes - len(returns)
            total, alive = np.zeros(env.num_envs), wanted.copy()
            while alive.any():
                obs = np.asarray(obs, np.float32)
                before = torch.from_numpy(obs)
                action = policy.mean(before) if deterministic else policy.act(before, generator)
                action, before = np.clip(action.numpy(), low, high), obs
                obs, reward, terminated, truncated, info = env.step(action)
                after = successors(obs, info)[alive].astype(np.float32)
                rows.append(
                    (before[alive], action[alive], after, np.flatnonzero(alive) + len(returns))
                )
                total += reward * alive
                alive &= ~(terminated | truncated)
            returns += list(total[wanted])
    s, a, s_next, episode = (np.concatenate(column) for column in zip(*rows))
    order = np.argsort(episode, kind="stable")
    return np.array(returns), Transitions(s[order], a[order], s_next[order])


@dataclass(frozen=True)
class Transitions:
    """Experience {((s, a), s')}, real or not: float32 arrays (N, nobs), (N, nact), (N, nobs)."""

    s: np.ndarray
    a: np.ndarray
    s_next: np.ndarray

    def __len__(self):
        return len(self.s)

    def __getitem__(self, rows):
        return Transitions(self.s[rows], self.a[rows], self.s_next[rows])

    def __add__(self, other):
        return Transitions(
            *(np.concatenate((getattr(self, k), getattr(other, k))) for k in ("s", "a", "s_next"))
        )

    def tensors(self):
        """The three arrays as torch tensors, sharing memory."""
        return tuple(torch.from_numpy(x) for x in (self.s, self.a, self.s_next))
