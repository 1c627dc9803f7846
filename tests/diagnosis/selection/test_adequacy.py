"""What a set errs, beside what it would err in recordings of its own."""

import mujoco
import numpy as np
import pytest
from plants import DRIVEN_PENDULUM, NOISE, recorded

from diagnosis.estimation.ahead import Ahead, cut_ahead
from diagnosis.estimation.smoother import Smoother
from diagnosis.selection.identification import Identification
from diagnosis.selection.judge import Judge, lacking, share_left
from diagnosis.selection.plausibility import Usual
from diagnosis.simulation.simulator import World


def judged(seed, told=None, **hidden):
    """The nominal pendulum, or one with what is told {(effect, place): values}, Fitted on two runs
    that hide something."""
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    runs = [recorded(f"run{i}.csv", 2 * seed + i, **hidden) for i in range(2)]
    smoother = Smoother(world, runs)
    ahead = Ahead(world, cut_ahead(runs), smoother.position_noise)
    ahead.start(smoother.locate({}))
    judge = Judge(ahead, Usual(world, runs, smoother.scale))
    nothing = judge.fit({})
    setting = {world.candidate(*key): values for key, values in (told or {}).items()}
    return judge.fit(setting, steps=0) if told else nothing


def test_a_true_model_lacks_nothing():
    lacks = [lacking(judged(seed))[0] for seed in range(6)]
    assert np.mean([lack.gain for lack in lacks]) < 0.1
    assert min(lack.p_value for lack in lacks) > 0.05 / 6


def test_a_missing_force_is_lacking():
    [lack] = lacking(judged(0, damping=0.1))
    assert lack.gain > 0.2 and lack.p_value < 1e-3


def test_a_search_goes_on_while_something_is_left():
    """A damping that is twice its model's, then told, then told by a spring."""
    something = lambda told: Identification.something(judged(0, told, damping=0.1))
    assert something(None) and not something({("viscous_damping", "pivot"): (0.1,)})
    assert something({("stiffness", "pivot"): (0.01,)})
    assert sum(Identification.something(judged(seed)) for seed in range(6)) <= 2


def test_a_name_leaves_what_it_does_not_explain():
    """The error of a damping that is twice its model's, as a name for it explains all, half, or
    next to none."""
    damping, spring = ("viscous_damping", "pivot"), ("stiffness", "pivot")
    shares = [
        float(share_left(judged(0, told, damping=0.1))[0])
        for told in (None, {spring: (1e-4,)}, {damping: (0.075,)}, {damping: (0.1,)})
    ]
    assert shares[0] == 1.0 and shares[1] == pytest.approx(1.0, abs=0.05)
    assert shares[2] == pytest.approx(0.5, abs=0.1) and shares[3] < 0.1


def test_what_is_within_the_noise_leaves_no_share():
    assert np.isnan(share_left(judged(0))).all()


def test_drawn_residuals_are_noise_and_what_start_states_bring():
    ahead = judged(0).columns.ahead
    start = ahead.residual([{}])[0]
    ahead.spread = np.zeros_like(ahead.spread)
    drawn = ahead.drawn({}, start, np.ones(1), np.random.default_rng(1))
    assert np.std(drawn[ahead.known]) == pytest.approx(ahead.noise[0], rel=0.05)
    assert ahead.noise[0] == pytest.approx(NOISE, rel=0.15) and not drawn[~ahead.known].any()
    ahead.spread[:, 1], later = 0.1, ahead.band == ahead.band.max()  # of the velocity
    drawn = ahead.drawn({}, start, np.ones(1), np.random.default_rng(1))
    assert np.std(drawn[later]) > 5 * NOISE
