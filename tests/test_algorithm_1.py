"""Algorithm 1 itself: which world, seeds and data each of its phases used,
seen by a spy; nothing is learnt here."""

import dataclasses

import numpy as np
import pytest

import train
import trpo
from envs import BatchEnv
from rgat import GroundedEnv, Grounding, identity
from training.run_folder import Run
from training.settings import PURPOSES, Settings
from trpo import Transitions

STEPS, ENVS, PRETRAIN, REFERENCE, POLICY, AT, TRAJECTORIES, EPISODES = 2, 4, 40, 48, 56, 64, 7, 3


def world(env):
    """What an environment is: "sim", "real", or the world below a
    transformer and the transformer."""
    if isinstance(env, GroundedEnv):
        return world(env.env), env.transformer
    return "real" if env.model.body("pole").mass[0] == 100 else "sim"


class Fake(Grounding):
    """A grounding method that keeps what it is given. Its transformer is new in every step."""

    learns_from_real = True

    def fit(self, tau_real, seed):
        self.log.append(("fit", tau_real.s[:, 0].tolist(), seed))
        return {"forward_model_error": 0.25}

    def update(self, policy, steps, seed, on_update=None):
        self.transformer = lambda obs, action: action
        self.log.append(("update", policy, steps, seed, self.transformer))
        return {"kl": 0.5}


@pytest.fixture
def spied(tmp_path, monkeypatch):
    """spied(algo): what happened in a run, in order: [(what, ...)]; and the run."""

    def go(algo="rgat", returns=(5.0,), **changes):
        log, judged = [], iter(np.resize(returns, 100))

        def learn(self, env, steps, seed, freeze_normalizer=True, on_update=None):
            log.append(("learn", world(env), steps, seed, freeze_normalizer, self))
            self.policy.net[-1].bias.data.fill_(
                {"sim": 1.0, "real": 2.0}.get(world(env), 3.0 + len(log))
            )
            on_update({"steps": steps, "return": 1.0})

        def rollouts(policy, env, episodes, seed, deterministic=False):
            rows = np.full((episodes, 4), len(log), np.float32)
            trained_in = {0.0: "nothing", 1.0: "sim", 2.0: "real"}
            told = world(env), episodes, seed, deterministic
            log.append(("rollouts", *told, trained_in.get(policy.net[-1].bias.item(), "grounded")))
            found = next(judged) if deterministic else -1.0
            return np.full(episodes, found), Transitions(rows, rows[:, :1], rows)

        def one_step_error(env, transformer, transitions):
            log.append(("error", world(env), transformer, transitions.s[:, 0].tolist()))
            return (0.1 if transformer is identity else 0.3), 0.7

        fake = type("Spy", (Fake,), {"log": log})
        monkeypatch.setattr(Run, "plot", lambda run: None)
        monkeypatch.setitem(train.GROUNDINGS, "rgat", fake)
        monkeypatch.setattr(trpo.TRPO, "learn", learn)
        monkeypatch.setattr(train, "rollouts", rollouts)
        monkeypatch.setattr(train, "one_step_error", one_step_error)
        s = Settings(
            env="InvertedPendulum-v4",
            algo=algo,
            seed=9,
            pretrain_steps=PRETRAIN,
            reference_steps=REFERENCE,
            grounding_steps=STEPS,
            policy_steps=POLICY,
            at_steps=AT,
            real_trajectories=TRAJECTORIES,
            eval_episodes=EPISODES,
            num_envs=ENVS,
        )
        s = dataclasses.replace(s, **changes).completed()
        run = Run.create(tmp_path / f"run{len(list(tmp_path.iterdir()))}", dataclasses.asdict(s))
        train.algorithm_1(s, run, train.Bar(s, run))
        return log, run, s

    return go


def seed(step, purpose):
    return train.seed_for(9, step, purpose)


def of(log, what):
    return [entry[1:] for entry in log if entry[0] == what]


def test_each_phase_uses_its_own_world_and_seeds(spied):
    log, run, _ = spied()
    transformers = [entry[-1] for entry in of(log, "update")]
    told = [(what, *rest[:-1]) for what, *rest in log if what in ("learn", "rollouts")]
    judge = lambda step, k=EPISODES: [
        ("rollouts", "real", k, seed(step, "evaluate"), deterministic)
        for deterministic in (True, False)
    ]
    expected = [
        ("learn", "sim", PRETRAIN, seed(0, "pretrain"), False),
        ("learn", "real", REFERENCE, seed(0, "pretrain"), False),
        judge(0)[0],  # the line
        *judge(0),
    ]
    for step in (1, 2):
        expected += [
            ("rollouts", "real", TRAJECTORIES, seed(step, "collect"), False),
            ("rollouts", "real", EPISODES, seed(step, "held out"), False),
            ("learn", ("sim", transformers[step - 1]), POLICY, seed(step, "policy"), True),
            *judge(step),
        ]
    assert told == expected
    assert len(set(transformers)) == STEPS


def test_one_policy_is_trained_judged_and_grounded_with_and_the_line_has_its_own(spied):
    log, _, _ = spied()
    learners = [entry[-1] for entry in of(log, "learn")]
    assert learners[0] is not learners[1] and learners[2] is learners[3]
    acting = [entry[-1] for entry in of(log, "rollouts")]
    # the line; before grounding, twice; collected and held out in the first step; after it
    assert acting[:5] == ["real", "sim", "sim", "sim", "sim"]
    assert acting[5:] == ["grounded"] * 6
    assert all(entry[0] is learners[2].policy for entry in of(log, "update"))


def test_f_psi_sees_all_that_was_collected_so_far_and_nothing_else(spied):
    log, run, _ = spied()
    rolled = [(k, entry) for k, entry in enumerate(log) if entry[0] == "rollouts"]
    collected = [k for k, entry in rolled if entry[3] in (seed(1, "collect"), seed(2, "collect"))]
    first, second = ([float(k)] * TRAJECTORIES for k in collected)
    assert [entry[0] for entry in of(log, "fit")] == [first, first + second]
    assert [entry[1] for entry in of(log, "fit")] == [seed(1, "model"), seed(2, "model")]
    for step, k in zip((1, 2), collected):
        assert run.real(step)[0][:, 0].tolist() == [float(k)] * TRAJECTORIES


def test_g_phi_gets_its_steps_and_is_judged_on_what_nothing_is_fitted_on(spied):
    log, _, _ = spied()
    assert [(steps, s) for _, steps, s, _ in of(log, "update")] == [
        (AT, seed(1, "transformer")),
        (AT, seed(2, "transformer")),
    ]
    held_out = [
        k
        for k, e in enumerate(log)
        if e[0] == "rollouts" and e[3] in (seed(1, "held out"), seed(2, "held out"))
    ]
    errors = of(log, "error")
    for step, k in enumerate(held_out):
        transformer = of(log, "update")[step][-1]
        rows = [float(k)] * EPISODES
        assert errors[2 * step : 2 * step + 2] == [
            ("sim", transformer, rows),
            ("sim", identity, rows),
        ]


def test_a_shared_first_policy_is_known_by_what_made_it(spied, tmp_path):
    """Two policies a run, sim's and real's; threads count, although they should not matter."""
    shared = tmp_path / "shared"
    names = lambda: {path.name for path in shared.glob("*.pt")}
    spied(pretrained=str(shared), threads=1)
    first = names()
    spied(pretrained=str(shared), threads=1, at_steps=AT + 1, real_trajectories=1)
    assert names() == first and len(first) == 2
    for change in ({"threads": 2}, {"seed": 8}, {"num_envs": 2}, {"preset": "paper"}):
        before = names()
        spied(**{"pretrained": str(shared), "threads": 1, **change})
        assert len(names()) == len(before) + 2


def test_seeds_differ_between_uses_steps_and_runs():
    seeds = {train.seed_for(s, step, p) for s in (0, 1) for step in range(4) for p in PURPOSES}
    assert len(seeds) == 2 * 4 * len(PURPOSES) and max(seeds) < 2**31


def test_what_is_written_down(spied):
    log, run, _ = spied(returns=(4.0, 5.0, 6.0, 7.0))
    assert run.lines == {"trained on real": 4.0}
    assert run.returns() == [5.0, 6.0, 7.0]
    for step, row in enumerate(run.progress):
        assert row["real_return_stochastic"] == -1.0 and row["real_return_deterministic_se"] == 0
        assert row["real_transitions"] == step * TRAJECTORIES
        assert row["real_transitions_judging"] == EPISODES * (2 * (step + 1) + step)
        assert row["sim_steps"] == PRETRAIN + step * POLICY
        if step:
            assert row["at_one_step_error"] == 0.3 and row["identity_one_step_error"] == 0.1
            assert row["delta_action_rms"] == 0.7 and row["forward_model_error"] == 0.25
            assert row["kl"] == 0.5


def test_the_verdict_is_of_the_best_policy_on_fresh_real_episodes(spied):
    log, run, s = spied(returns=(4.0, 5.0, 9.0, 7.0))
    log.clear()
    text = train.verdict(s, run)
    assert of(log, "rollouts") == [("real", 2 * EPISODES, seed(1, "best"), True, "grounded")]
    assert "after grounding step 1" in text and "before grounding 5" in text


@pytest.mark.parametrize("algo, world_", [("sim", "sim"), ("real", "real")])
def test_the_lines_train_on_in_their_own_world(algo, world_, spied):
    log, run, _ = spied(algo)
    trained = of(log, "learn")
    assert trained[0][0] == world_
    assert [t[:2] for t in trained[-2:]] == [((world_, identity), POLICY)] * 2
    steps = [row["real_transitions" if algo == "real" else "sim_steps"] for row in run.progress]
    assert steps == [PRETRAIN + k * POLICY for k in range(3)]
    assert of(log, "update") == of(log, "fit") == []


def test_short_episodes_are_collected_until_there_are_enough():
    sim = BatchEnv("InvertedPendulum-v4", 4, nthread=1)
    policy = train.new_learner(Settings(env="InvertedPendulum-v4").completed()).policy
    grounding = Grounding(sim)
    s = Settings(env="InvertedPendulum-v4", real_trajectories=1).completed()
    assert len(train.collect(s, grounding, policy, sim, 0)) == 0
    grounding.learns_from_real, grounding.least_transitions = True, 100
    tau = train.collect(s, grounding, policy, sim, 0)
    assert len(tau) >= 100
    starts = tau.s[np.r_[True, (tau.s[1:] != tau.s_next[:-1]).any(1)]]
    assert len(np.unique(starts, axis=0)) == len(starts) > 1  # each episode another


# --- every option reaches its object --------------------------------------------------------------

REACHED = {
    "at_max_kl": (0.5, lambda s: s.grounding.at.max_kl),
    "at_gamma": (0.5, lambda s: s.grounding.at.gamma),
    "at_entropy": (0.5, lambda s: s.grounding.at.entropy),
    "at_std": (0.5, lambda s: s.grounding.at_std),
    "ane_width": (0.5, lambda s: s.grounding.ane_width),
}


@pytest.mark.parametrize("name", REACHED)
def test_numbers_reach_the_grounding(name):
    value, found = REACHED[name]
    plain = Settings(env="Hopper-v4").completed()
    assert found(dataclasses.replace(plain, **{name: value})) == value != found(plain)


def test_words_reach_the_grounding_and_the_networks():
    plain = Settings(env="Hopper-v4").completed()
    assert plain.grounding.residual and plain.grounding.per_step
    told = dataclasses.replace(plain, forward_model="plain", at_norm="raw", policy="shallow")
    assert not told.grounding.residual and not told.grounding.per_step
    assert train.new_learner(plain).policy.sizes == (11, 64, 64, 3)
    assert train.new_learner(told).policy.sizes == (11, 4, 3)
    assert train.new_learner(plain).config == trpo.PRESETS["Hopper"]


def test_the_papers_preset_is_what_the_paper_prints():
    s = Settings(env="Hopper-v4", preset="paper").completed()
    at = s.grounding.at
    assert (at.max_kl, at.gamma, at.entropy) == (1e-4, 0.99, 1e-5)
    assert not s.grounding.residual and not s.grounding.per_step and s.real_trajectories == 50
    assert s.target == trpo.STABLE_BASELINES
    assert dataclasses.replace(s.target, max_kl=1e-4, entropy=1e-5) == at
    assert Settings(env="Hopper-v4", preset="paper", at_gamma=0.5).completed().at_gamma == 0.5
    assert s.grounding.at_std * 2 == 1 and s.grounding_steps == 10
    assert Settings(env="HalfCheetah-v4", preset="paper").completed().grounding_steps == 20


def test_a_roll_back_is_asked_of_the_best_not_of_the_last(spied):
    log, run, _ = spied(returns=(9.0, 10.0, 8.0, 9.5), roll_back=0.9)
    assert [row["rolled_back_to"] for row in run.progress] == ["", 0, ""]
    _, run, _ = spied(returns=(9.0, -10.0, -12.0, -10.5), roll_back=0.9)
    assert [row["rolled_back_to"] for row in run.progress] == ["", 0, ""]
    _, run, _ = spied(returns=(9.0, 5.0, 10.0, 8.0), roll_back=0.9)
    assert [row["rolled_back_to"] for row in run.progress] == ["", "", 1]
    first, best, last = (run.checkpoint(k) for k in range(3))
    bias = lambda saved: saved["learner"]["policy"]["net.4.bias"].item()
    assert bias(last) == bias(best) != bias(first)
    assert last["acting"]["state"]["net.4.bias"].item() not in (bias(best), bias(first))
    _, run, _ = spied(returns=(9.0, 10.0, 1.0, 1.0))
    assert [row["rolled_back_to"] for row in run.progress] == ["", "", ""]
