"""What a set errs, beside what it would err in recordings of its own."""

import mujoco
import numpy as np
import pytest
from plants import DRIVEN_PENDULUM, NOISE, recorded

from diagnosis.estimation.ahead import Ahead, cut_ahead
from diagnosis.estimation.smoother import Smoother
from diagnosis.selection.adequacy import lacking
from diagnosis.selection.judge import Judge
from diagnosis.selection.plausibility import Usual
from diagnosis.simulation.simulator import World


def judged(seed, **hidden):
    """The nominal pendulum, Fitted on two runs that hide something."""
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    runs = [recorded(f"run{i}.csv", 2 * seed + i, **hidden) for i in range(2)]
    smoother = Smoother(world, runs)
    ahead = Ahead(world, cut_ahead(runs), smoother.position_noise)
    ahead.start(smoother.locate({}))
    return Judge(ahead, Usual(world, runs, smoother.scale)).fit({})


def test_a_true_model_lacks_nothing():
    lacks = [lacking(judged(seed))[0] for seed in range(6)]
    assert np.mean([lack.gain for lack in lacks]) < 0.1
    assert min(lack.p_value for lack in lacks) > 0.05 / 6


def test_a_missing_force_is_lacking():
    [lack] = lacking(judged(0, damping=0.1))
    assert lack.gain > 0.2 and lack.p_value < 1e-3


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
