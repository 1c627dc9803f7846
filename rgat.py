"""Grounding: ways to make a simulator's transitions look like the real ones by changing the action.

    sim = BatchEnv("Hopper-v4", 32)
    grounding = RGAT(sim, settings)
    grounding.fit(tau_real, seed)                          # f_psi: Algorithm 1, line 3
    grounding.update(policy, at_steps, seed)               # g_phi: Algorithm 1, line 4
    grounded = GroundedEnv(sim, grounding.transformer)     # what the policy trains in: line 5

An action transformer is any function (s, a) -> a_hat on arrays (N, nobs), (N, nact). Every method
of the paper is one class with the same two steps.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import mujoco
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space
from mujoco.batch import Batch

from diagnosis.simulation.corrected_py import CorrectedBatch, parts_in
from envs import BatchEnv, EnvError, load_task
from models import (
    ForwardModel,
    GaussianPolicy,
    InverseModel,
    Regressor,
    Value,
    load_checkpoint,
)
from trpo import TRPO, TRPOConfig, rollouts

# g_phi's own trust region, entropy and discount; section IV-D has 1e-4, 1e-5 and 0.99
AT_CONFIG = TRPOConfig(batch_size=1024, max_kl=1e-2, entropy=1e-5, gamma=0.0)


def identity(obs, action):
    """The transformer that changes nothing: the grounded simulator is then the raw one."""
    return action


class GroundedEnv(VectorWrapper):
    """The grounded simulator (paper, Fig. 1 and 2a): the sim does a_hat, the reward sees a."""

    def __init__(self, env, transformer=identity):
        super().__init__(env)
        self.transformer = transformer

    def reset(self, *, seed=None, options=None):
        self.obs, info = self.env.reset(seed=seed, options=options)
        return self.obs.copy(), info

    def step(self, actions, applied=None):
        """As BatchEnv.step; applied: what a transformer before this one made of the actions."""
        a_hat = self.transformer(self.obs, actions if applied is None else applied)
        self.obs, *rest = self.env.step(actions, applied=a_hat)
        return self.obs.copy(), *rest


class RealModel:
    """f_psi as both methods use it: the network, and the guess of s' that it starts from.

    residual: guess where the sim goes; else that the state stays: the paper's f_psi(s, a).
    """

    def __init__(self, sim, residual):
        self.sim, self.residual = sim, residual
        self.net = ForwardModel(
            sim.single_observation_space.shape[0], sim.single_action_space.shape[0]
        )

    def fit(self, tau_real, seed):
        """Fit to real Transitions, the sim started in each of their states.

        Returns the held-out RMS error by dimension."""
        torch.manual_seed(seed)
        self.net = ForwardModel(
            *(
                space.shape[0]
                for space in (self.sim.single_observation_space, self.sim.single_action_space)
            )
        )
        seen = tau_real if not self.residual else tau_real[measured(self.sim, tau_real.s)]
        if len(seen) < 2:
            raise EnvError(
                f"{len(seen)} usable real transitions are too few to fit a model on: "
                "raise --real-trajectories"
            )
        guess = predict_all(self.sim, seen) if self.residual else seen.s
        s, a, s_next = seen.tensors()
        return self.net.fit(
            s, a, s_next, torch.from_numpy(guess), torch.Generator().manual_seed(seed)
        )

    @torch.no_grad()
    def __call__(self, s, a):
        """f_psi(s, a) and the guess of it, both (N, nobs) float32, s what the sim now observes."""
        s, a = np.asarray(s, np.float32), np.asarray(a, np.float32)
        guess = self.sim.peek(a).astype(np.float32) if self.residual else s
        predicted = self.net(*(torch.from_numpy(x) for x in (s, a, guess))).numpy()
        # the sim's word stands for states that the observation hides in part: none was fitted
        return (
            np.where(measured(self.sim, s)[:, None], predicted, guess)
            if self.residual
            else predicted
        ), guess


def measured(sim, s):
    """Which observations (N, nobs) show all of qvel: (N,) bool. Hopper's are clipped to +-10."""
    return (np.abs(s[:, -sim.model.nv :]) < sim.task.clip_velocity).all(axis=1)


def predict_all(sim, transitions):
    """Where the sim goes from every (s, a) of the Transitions: (N, nobs) float32."""
    n, width = len(transitions), sim.num_envs
    after = []
    for first in range(0, n, width):
        fill = np.arange(first, first + width) % n
        after.append(sim.predict(transitions.s[fill].astype(float), transitions.a[fill]))
    return np.concatenate(after)[:n].astype(np.float32)


class ActionTransformer:
    """g_phi as the policy meets it: a_hat = a + delta_a, delta_a the mean of a Gaussian policy.

    Its output is in units of the action range, so that 1 reaches from one bound to the other.
    """

    def __init__(self, policy, low, high):
        self.policy, self.low, self.high = policy, low, high

    @torch.no_grad()
    def __call__(self, obs, action):
        sa = torch.from_numpy(np.concatenate((obs, action), axis=1).astype(np.float32))
        return self.apply(action, self.policy.mean(sa).numpy())

    def apply(self, action, output):
        """a_hat for the Gaussian policy's output."""
        return np.clip(action + (self.high - self.low) * output, self.low, self.high)


class ActionTransformerEnv(VectorEnv):
    """The grounding step as a reinforcement learning problem (paper, section III and Fig. 2b).

    The agent is g_phi: it observes (s, a), a ~ pi_theta(s), chooses delta_a, and is paid

        R_AT = -||f_psi(s, a) - s'||^2,

    each dimension in units of `scale`: how much it changes in a real step. In raw units the fast
    joints are all that counts, and what makes a robot fall, its slow root, is given up for them.
    The target policy and the sim are g_phi's environment. R_AT is never positive, so an agent that
    could end episodes would learn to: the task's falls are handed out as truncations, which TRPO
    bootstraps like time limits.

    baseline: count the reward from what a itself would have got in the sim,
    -||f_psi(s, a) - guess||^2. For gamma 0 g_phi does not influence that. With a longer sight it
    does, for g_phi decides where the path leads, and being where the sim is wrong would pay; then a
    baseline is left to V.
    seed: of pi's noise; g_phi's own must come from another.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, sim, transformer, policy, real_model, scale, seed, baseline=False):
        self.sim, self.transformer, self.policy = sim, transformer, policy
        self.real_model, self.scale, self.baseline = real_model, scale, baseline
        self.num_envs = sim.num_envs
        nobs, nact = sim.single_observation_space.shape[0], sim.single_action_space.shape[0]
        self.single_observation_space = Box(-np.inf, np.inf, (nobs + nact,), np.float32)
        self.single_action_space = Box(-1.0, 1.0, (nact,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.generator = torch.Generator().manual_seed(seed)

    def _with_action(self, s):
        s = s.astype(np.float32)
        a = self.policy.act(torch.from_numpy(s), self.generator).numpy()
        box = self.sim.single_action_space
        return np.concatenate((s, np.clip(a, box.low, box.high)), axis=1)

    def reset(self, *, seed=None, options=None):
        self.sa = self._with_action(self.sim.reset(seed=seed)[0])
        return self.sa.copy(), {}

    def step(self, output):
        s, a = np.split(self.sa, [self.sim.single_observation_space.shape[0]], axis=1)
        predicted, guess = self.real_model(s, a)
        distance = lambda s_next: (((predicted - s_next) / self.scale) ** 2).sum(axis=1)
        obs, _, terminated, truncated, info = self.sim.step(
            a, applied=self.transformer.apply(a, output)
        )
        reward = -distance(info["next_obs"]) + (distance(guess) if self.baseline else 0.0)
        next_sa = self._with_action(info["next_obs"])
        done = terminated | truncated
        self.sa = next_sa.copy()
        if done.any():
            self.sa[done] = self._with_action(obs)[done]
        return self.sa.copy(), reward, np.zeros_like(done), done, {"next_obs": next_sa}


# --- the methods ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class GroundingSettings:
    """What the grounding methods can be told.

    docs/paper.md says where defaults differ from the paper's, and why."""

    at: TRPOConfig = AT_CONFIG  # rgat: TRPO for the action transformer
    at_std: float = 0.01  # rgat: its initial standard deviation, in units of the action range
    residual: bool = True  # rgat and gat: f_psi corrects the sim's own prediction
    # rgat, oracle: R_AT in units of each dimension's change in a real step, not as it stands
    per_step: bool = True
    smoothing: float = 0.95  # gat: a_hat = smoothing * g(s, a) + (1 - smoothing) * a
    # ane: standard deviation of the action noise, in units of half the action range
    ane_width: float = 0.2


class Grounding:
    """No grounding: the policy goes on learning in its world (the `sim` and `real` lines)."""

    learns_from_real = False
    least_transitions = 0  # real ones per grounding step, whatever the number of episodes

    def __init__(self, sim, settings=GroundingSettings()):
        self.sim, self.settings = sim, settings
        self.low, self.high = sim.single_action_space.low, sim.single_action_space.high
        self.nobs, self.nact = (
            sim.single_observation_space.shape[0],
            sim.single_action_space.shape[0],
        )
        self.transformer = identity
        self.scale = np.ones(self.nobs, np.float32)

    def fit(self, tau_real, seed):
        """Line 3: learn a model of the real dynamics. Returns statistics for progress.csv."""
        return {}

    def _measure_scale(self, tau_real):
        """The unit of each dimension of R_AT, from the first real data: later, a robot that stands
        still would make it vanishingly small."""
        if self.settings.per_step and (self.scale == 1).all():
            self.scale = step_size(tau_real)

    def update(self, policy, steps, seed, on_update=None):
        """Line 4: renew self.transformer with up to `steps` transitions in the sim.

        Returns statistics."""
        return {}

    def state(self):
        """Tensors that a checkpoint needs to rebuild the transformer."""
        return {}

    def load(self, state):
        """Take over what state() returned."""


class RGAT(Grounding):
    """The paper's method: g_phi learnt end to end by TRPO on R_AT;
    f_psi enters the reward alone."""

    learns_from_real = True

    def __init__(self, sim, settings=GroundingSettings()):
        super().__init__(sim, settings)
        self.real_model = RealModel(sim, settings.residual)
        self._new_transformer()

    def fit(self, tau_real, seed):
        self.seen = tau_real
        self._measure_scale(tau_real)
        return {"forward_model_error": relative(self.real_model.fit(tau_real, seed), tau_real)}

    def update(self, policy, steps, seed, on_update=None):
        """g_phi goes on from the last grounding step, as Algorithm 1 has it."""
        if not self.learner.value.normalizer.count:
            torch.manual_seed(seed)
            self._new_transformer()
            sa = torch.from_numpy(np.concatenate((self.seen.s, self.seen.a), axis=1))
            for network in (self.learner.policy, self.learner.value):
                network.normalizer.update(sa)
        # exploration is renewed: with what TRPO leaves of it, g_phi would stay where it is
        with torch.no_grad():
            self.learner.policy.log_std.fill_(np.log(self.settings.at_std))
        baseline = self.real_model.residual and self.settings.at.gamma == 0
        env = ActionTransformerEnv(
            self.sim, self.transformer, policy, self.real_model, self.scale, seed + 1, baseline
        )
        kls = []
        self.learner.learn(
            env,
            steps,
            seed,
            on_update=lambda stats: (kls.append(stats["kl"]), on_update and on_update(stats)),
        )
        std = self.learner.policy.log_std.detach().exp().numpy() * (self.high - self.low)
        return {"at_std": float(std.mean()), "kl": float(np.mean(kls))}

    def _new_transformer(self):
        policy = GaussianPolicy(
            self.nobs + self.nact, self.nact, log_std=np.log(self.settings.at_std)
        )
        self.learner = TRPO(policy, Value(self.nobs + self.nact), self.settings.at)
        self.transformer = ActionTransformer(policy, self.low, self.high)

    def state(self):
        scale = torch.from_numpy(self.scale)
        return {
            "at": self.learner.state(),
            "forward_model": self.real_model.net.state_dict(),
            "scale": scale,
        }

    def load(self, state):
        self.learner.load(state["at"])
        self.scale = state["scale"].numpy()
        self.real_model.net.load_state_dict(state["forward_model"])


class GAT(Grounding):
    """Hanna and Stone 2017 (paper, section II-C): both functions of g(s, a) are fitted.

    g(s, a) = f_sim^-1(s, f_real(s, a))"""

    learns_from_real = True

    def __init__(self, sim, settings=GroundingSettings()):
        super().__init__(sim, settings)
        self.real_model = RealModel(sim, settings.residual)
        self.inverse_model = InverseModel(self.nobs, self.nact)

    def fit(self, tau_real, seed):
        self.seen = tau_real
        return {"forward_model_error": relative(self.real_model.fit(tau_real, seed), tau_real)}

    def update(self, policy, steps, seed, on_update=None):
        """f_sim^-1 from whole episodes in the sim, as many transitions as real ones or `steps`."""
        episodes, tau_sim = 0, None
        while tau_sim is None or len(tau_sim) < min(steps, len(self.seen)):
            more = rollouts(policy, self.sim, self.sim.num_envs, seed + episodes)[1]
            tau_sim, episodes = (
                more if tau_sim is None else tau_sim + more,
                episodes + self.sim.num_envs,
            )
        s, a, s_next = tau_sim.tensors()
        torch.manual_seed(seed)
        self.inverse_model = InverseModel(self.nobs, self.nact)
        self.inverse_model.fit(s, s_next, a, torch.Generator().manual_seed(seed))
        self.transformer = self._transform
        return {"sim_transitions": len(tau_sim)}

    @torch.no_grad()
    def _transform(self, obs, action):
        s_next = torch.from_numpy(self.real_model(obs, action)[0])
        a_hat = self.inverse_model(torch.from_numpy(obs.astype(np.float32)), s_next).numpy()
        smoothing = self.settings.smoothing
        return np.clip(smoothing * a_hat + (1 - smoothing) * action, self.low, self.high)

    def state(self):
        return {
            "inverse_model": self.inverse_model.state_dict(),
            "forward_model": self.real_model.net.state_dict(),
        }

    def load(self, state):
        self.inverse_model.load_state_dict(state["inverse_model"])
        self.real_model.net.load_state_dict(state["forward_model"])
        self.transformer = self._transform


class ANE(Grounding):
    """Action noise envelope (Jakobi 1995): no grounding, but a policy
    robust to noise on actions."""

    def update(self, policy, steps, seed, on_update=None):
        rng = np.random.default_rng(seed)
        std = self.settings.ane_width * (self.high - self.low) / 2

        def noisy(obs, action):
            return np.clip(action + std * rng.standard_normal(action.shape), self.low, self.high)

        self.transformer = noisy
        return {}

    def load(self, state):
        self.update(None, 0, seed=0)


class Solver(Grounding):
    """The delta_a that best takes the sim to a target, solved for step by step instead of learnt.

    A Gauss-Newton step on ||s'_sim(a_hat) - target||^2, in the units of R_AT, whole, halved or not
    at all, whichever lands nearest; derivatives by finite differences in a batch, from the sim's
    full state.
    """

    epsilon = 0.05  # finite difference, in units of the action range

    def __init__(self, sim, settings=GroundingSettings()):
        super().__init__(sim, settings)
        self.probe = batch_of(sim, sim.num_envs * (1 + self.nact))
        self.trial = batch_of(sim, sim.num_envs * 2)

    def _target(self, action):
        """Where one step under action (n, nact) should end: (n, 1, nobs), in units of scale."""
        raise NotImplementedError

    def _after(self, batch, actions):
        """One step from the sim's present states under actions (n, k, nact).

        Returns observations (n, k, nobs), in units of scale."""
        n, k, _ = actions.shape
        batch.state[:] = np.repeat(self.sim.batch.state, k, axis=0)
        if isinstance(batch, CorrectedBatch):
            batch.recall(self.sim.batch, k)
        batch.ctrl = actions.reshape(n * k, -1)
        batch.step(nstep=self.sim.task.frame_skip)
        return self.sim.task.observe(batch.qpos, batch.qvel).reshape(n, k, -1) / self.scale

    def solve(self, obs, action):
        """a_hat (n, nact): the transformer."""
        span = self.high - self.low
        action = np.clip(action, self.low, self.high).astype(float)
        target = self._target(action)
        # probe towards the middle, so that no probe leaves the actuator's range
        reach = self.epsilon * span * np.where(action > (self.high + self.low) / 2, -1.0, 1.0)
        probes = np.concatenate(
            (action[:, None], action[:, None] + reach[:, None] * np.eye(self.nact)), axis=1
        )
        after = self._after(self.probe, probes)
        residual = target - after[:, :1]
        jacobian = (after[:, 1:] - after[:, :1]) / reach[..., None]
        normal = np.einsum("naj,nbj->nab", jacobian, jacobian) + 1e-9 * np.eye(self.nact)
        step = np.linalg.solve(
            normal, np.einsum("naj,nj->na", jacobian, residual[:, 0])[..., None]
        )[..., 0]
        trials = np.clip(action[:, None] + np.stack((step, step / 2), axis=1), self.low, self.high)
        self.sim.counterfactual_steps += len(action) * (probes.shape[1] + trials.shape[1])
        errors = np.concatenate((residual, target - self._after(self.trial, trials)), axis=1)
        choices = np.concatenate((action[:, None], trials), axis=1)
        return choices[np.arange(len(action)), (errors**2).sum(axis=2).argmin(axis=1)]


class Oracle(Solver):
    """The ceiling of action transformation: solved towards the true real model.

    It knows that model, which no method may: it tells what a perfect g_phi could do.
    """

    learns_from_real = True  # the units alone

    def __init__(self, sim, settings=GroundingSettings(), real_model=None):
        super().__init__(sim, settings)
        self.real_batch = Batch(real_model, sim.num_envs, sim.batch.nthread)
        self.transformer = self.solve

    def fit(self, tau_real, seed):
        self._measure_scale(tau_real)
        return {}

    def _target(self, action):
        return self._after(self.real_batch, action[:, None])

    def state(self):
        return {"scale": torch.from_numpy(self.scale)}

    def load(self, state):
        self.scale = state["scale"].numpy()


class Solved(Solver):
    """RGAT's g_phi with a label instead of a reward: delta_a solved for, then distilled.

    The solver needs the sim's full state and several of its steps for each one taken; the network
    (s, a) -> delta_a that is fitted to what it said needs neither.
    """

    learns_from_real = True

    def __init__(self, sim, settings=GroundingSettings()):
        super().__init__(sim, settings)
        self.real_model = RealModel(sim, settings.residual)
        self.network = Regressor(self.nobs + self.nact, self.nact)

    def fit(self, tau_real, seed):
        self._measure_scale(tau_real)
        return {"forward_model_error": relative(self.real_model.fit(tau_real, seed), tau_real)}

    def _target(self, action):
        return (self.real_model(self.sim.observe(), action)[0] / self.scale)[:, None]

    def update(self, policy, steps, seed, on_update=None):
        """Label whole episodes of the policy in the grounded sim,
        `steps` of them, and fit g_phi."""
        labels, episodes, count = [], 0, 0

        def told(obs, action):
            a_hat = self.solve(obs, action)
            labels.append((np.concatenate((obs, action), axis=1), a_hat - action))
            return a_hat

        solved = GroundedEnv(self.sim, told)
        while len(labels) * self.sim.num_envs < steps:
            count += len(rollouts(policy, solved, self.sim.num_envs, seed + episodes)[1])
            episodes += self.sim.num_envs
        x, y = (torch.from_numpy(np.concatenate(z).astype(np.float32)) for z in zip(*labels))
        torch.manual_seed(seed)
        self.network = Regressor(self.nobs + self.nact, self.nact)
        self.network.fit(x, y, torch.Generator().manual_seed(seed))
        self.transformer = self._transform
        return {"sim_transitions": count}

    @torch.no_grad()
    def _transform(self, obs, action):
        sa = torch.from_numpy(np.concatenate((obs, action), axis=1).astype(np.float32))
        return np.clip(action + self.network(sa).numpy(), self.low, self.high)

    def state(self):
        return {
            "network": self.network.state_dict(),
            "forward_model": self.real_model.net.state_dict(),
            "scale": torch.from_numpy(self.scale),
        }

    def load(self, state):
        self.network.load_state_dict(state["network"])
        self.real_model.net.load_state_dict(state["forward_model"])
        self.scale, self.transformer = state["scale"].numpy(), self._transform


METHODS = {
    "rgat": RGAT,
    "gat": GAT,
    "ane": ANE,
    "oracle": Oracle,
    "solved": Solved,
    "sim": Grounding,
    "real": Grounding,
}


def batch_of(env, nsim):
    """A Batch of so many simulations of a BatchEnv's world."""
    parts = getattr(env, "parts", ())
    kind = partial(CorrectedBatch, parts=parts) if parts else Batch
    return kind(env.model, nsim, env.batch.nthread)


class CorrectedEnv(BatchEnv):
    """The task in the world that a diagnosis hands over: its corrected.xml, and what its
    corrected.py adds to every step.

    xml, script: the texts; an empty script adds nothing. Raises EnvError for a model with other
    joints than the task's.
    """

    def __init__(self, env_id, num_envs, xml, script="", nthread=0):
        model = mujoco.MjModel.from_xml_string(xml)
        super().__init__(env_id, num_envs, model=model, nthread=nthread)
        self.parts = parts_in(script)
        if self.parts:
            self.batch = batch_of(self, num_envs)
            self.qpos, self.qvel, ctrl = map(self.batch.bind, ("qpos", "qvel", "ctrl"))
            self._ctrl = ctrl[:, : self._ctrl.shape[1]]
            self.task.place(self)

    def peek(self, actions):
        """As BatchEnv.peek, with what has reached the drives so far."""
        if self.parts:
            self._peek = self._peek or batch_of(self, self.num_envs)
            self._peek.recall(self.batch)
        return super().peek(actions)


def grounded_env(run, num_envs=1, step=None):
    """The grounded simulator of a finished run, RGAT's product: a gymnasium vector environment to
    train any policy in.

    run: the run's folder. step: the grounding step that it is of, the last one by default.
    Raises EnvError for a folder without that step, for a run of the oracle, and where the file of
    a user's task is no longer what it was.
    """
    number = lambda path: int(path.stem.removeprefix("step_"))  # as text 100 is before 11
    steps = sorted(Path(run).glob("step_*.pt"), key=number)[1:]
    if not 0 < (len(steps) if step is None else step) <= len(steps):
        raise EnvError(f"{run} has no grounding step {step or 1}: it has done {len(steps)}")
    saved = load_checkpoint(steps[-1 if step is None else step - 1])
    world, state = saved["world"], saved["grounding"]
    if world.get("task"):
        try:
            load_task(world["task"])
        except Exception as error:  # whatever a user's file raises
            raise EnvError(f"{run}: its --task {world['task']} fails: {error!r}") from None
    xml, script = state.get("corrected_xml"), state.get("corrected_py", "")
    if xml:
        sim = CorrectedEnv(world["env"], num_envs, xml, script)
    else:
        sim = BatchEnv(world["env"], num_envs)
    state = state.get("rest", state)
    method = METHODS.get(world["algo"].removeprefix("physics+"), Grounding)
    if method is Oracle:
        raise EnvError(f"{run}: an oracle's simulator cannot be had without the real one")
    grounding = method(sim, GroundingSettings(**world["settings"]))
    grounding.load(state)
    return GroundedEnv(sim, grounding.transformer)


def step_size(transitions):
    """How much each dimension of s changes in a step: its RMS, (nobs,) float32."""
    return np.sqrt(((transitions.s_next - transitions.s) ** 2).mean(axis=0)) + 1e-6


def relative(rms_error, transitions):
    """RMS errors by dimension (nobs,) as one number, in units of its step: 1 is that of s' = s."""
    return float(np.sqrt(((rms_error / step_size(transitions)) ** 2).mean()))


def one_step_error(env, transformer, transitions, limit=4096):
    """How far the sim under a transformer lands from where the real world did.

    Returns (error relative to the real step, RMS of ||a_hat - a||) over up to `limit` real
    transitions. Rows whose velocities the observation clipped are left out: their state is not
    known.
    """
    counted = env.counterfactual_steps  # to measure is not to learn
    rows = np.flatnonzero(measured(env, transitions.s))
    rows = rows[np.linspace(0, len(rows) - 1, min(limit, len(rows))).astype(int)]
    miss, change = [], []
    for part in np.array_split(rows, -(-len(rows) // env.num_envs)):
        fill = np.resize(
            part, env.num_envs
        )  # a batch has one size: repeat rows, then drop the repeats
        s, a, s_next = (
            x[fill].astype(float) for x in (transitions.s, transitions.a, transitions.s_next)
        )
        a_hat = []
        after = env.predict(s, lambda obs: a_hat.append(transformer(obs, a)) or a_hat[0])
        miss.append((after - s_next)[: len(part)] ** 2)
        change.append(((a_hat[0] - a) ** 2).sum(axis=1)[: len(part)])
    env.counterfactual_steps = counted
    return relative(np.sqrt(np.concatenate(miss).mean(axis=0)), transitions[rows]), float(
        np.sqrt(np.concatenate(change).mean())
    )
