"""Where predictions jump, rows lie far apart, or a first look misleads: what start states, steps and windows are then tried."""

import mujoco
import numpy as np
import pytest
from plants import DROP, dropped

from diagnosis.estimation import initial_states, residuals
from diagnosis.estimation import windows as cut
from diagnosis.selection import candidates, earning
from diagnosis.selection import search as selection
from diagnosis.simulation.simulator import World

NOISE = 1e-3


def test_start_states_behind_a_bounce_are_drawn():
    """Starts from which the block meets the floor some steps too soon: every small step from them makes it worse."""
    world, runs = (
        World(mujoco.MjSpec.from_string(DROP.format(damping=-30))),
        [dropped(seed, -30) for seed in range(3)],
    )
    problem = residuals.Problem(
        world,
        [w for r in runs for w in cut.consecutive(r, 0.2)],
        np.array([NOISE]),
        np.array([np.inf]),
    )
    good, nominal = initial_states.fit(problem, residuals.Hypothesis()), residuals.Hypothesis()
    every = np.arange(len(problem.windows))
    settings = [nominal.settings] * len(every)
    rng = np.random.default_rng(0)
    qpos, qvel = good.qpos, good.qvel + 0.3 * rng.normal(size=good.qvel.shape)
    residual = problem.residuals(settings, every, qpos, qvel)
    jacobian = problem.start_jacobians(settings, every, qpos, qvel, residual)
    [stuck] = initial_states._fitted(
        problem, [residuals.Fit(nominal, qpos, qvel, residual, jacobian)], 12, fresh=True
    )
    drawn = initial_states.scattered(problem, stuck)
    assert stuck.chi2.sum() > 3 * good.chi2.sum()
    assert drawn.chi2.sum() < 1.3 * good.chi2.sum()
    assert (drawn.chi2 <= stuck.chi2).all()
    again = problem.residuals(settings, every, drawn.qpos, drawn.qvel)
    np.testing.assert_allclose(again, drawn.residual)


def test_values_are_stretched_from_the_nominal_ones():
    world = World(mujoco.MjSpec.from_string(DROP.format(damping=-90)))
    damping, friction = (
        world.candidate("contact_damping", "block"),
        world.candidate("stribeck_friction", "z"),
    )
    begun = residuals.Hypothesis().plus(damping, (80.0,)).plus(friction, (0.1, 0.3, 0.2))
    settings = selection.stretch(begun, [damping, friction], 2.0).settings
    assert settings[damping] == (70.0,) and settings[friction] == (0.2, 0.6, 0.2)
    assert selection.stretch(begun, [damping], 1e9).settings[damping] == (
        damping.parameters[0].low,
    )
    assert selection.stretch(begun, [damping], 0.0).settings[damping] == damping.nominal


def test_a_value_that_stopped_at_a_jump_is_moved_on():
    world, runs = (
        World(mujoco.MjSpec.from_string(DROP.format(damping=-90))),
        [dropped(seed, -40) for seed in range(4)],
    )
    problem = residuals.Problem(
        world,
        [w for r in runs for w in cut.consecutive(r, 0.2)],
        np.array([NOISE]),
        np.array([np.inf]),
    )
    search, damping = (
        selection.Search(world, problem, runs, coarse=True),
        world.candidate("contact_damping", "block"),
    )
    fit = initial_states.fit(problem, residuals.Hypothesis().plus(damping, (85.0,)))
    assert not earning.is_far(search, fit) and earning.is_far(
        selection.Search(world, problem, runs), fit
    )  # it is jumps that keep it there
    new = search.stretched(fit, (damping,))
    assert fit.chi2.sum() > 3 * search.freedom and new.chi2.sum() < 1.2 * search.freedom
    assert new.hypothesis.vector[0] < 50


def test_what_was_found_is_nudged_until_the_noise_is_reached():
    """In a plain search too, in which a value ends where a small step seems to lead nowhere better."""
    world, runs = (
        World(mujoco.MjSpec.from_string(DROP.format(damping=-90))),
        [dropped(seed, -70) for seed in range(4)],
    )
    problem = residuals.Problem(
        world,
        [w for r in runs for w in cut.consecutive(r, 0.2)],
        np.array([NOISE]),
        np.array([np.inf]),
    )
    search, damping = (
        selection.Search(world, problem, runs),
        world.candidate("contact_damping", "block"),
    )
    fit = initial_states.fit(problem, residuals.Hypothesis().plus(damping, (85.0,)))
    new = search.run(fit)
    assert new.hypothesis.candidates == (damping,) and 70 < new.hypothesis.vector[0] < 85
    assert candidates.at_noise(problem, new) and not candidates.at_noise(problem, fit)


def test_of_a_far_value_that_says_little_only_that_part_is_a_start():
    """Of the change that four times the mass would bring a tenth is there: a refit begins with a tenth of that mass more. Where most
    of it is there it begins at the far value, where hardly any not at all; nor where it has no gradient."""
    world, runs = World(mujoco.MjSpec.from_string(DROP.format(damping=-90))), [dropped(0, -90)]
    problem = residuals.Problem(
        world, cut.consecutive(runs[0], 0.4), np.array([NOISE]), np.array([np.inf])
    )
    search = selection.Search(world, problem, runs)
    start = lambda option, amount: search.start_of(option, [0], range(1), [amount])
    far = next(
        o
        for o in search.options
        if o.candidate == world.candidate("mass", "block") and o.directions == ((4.0,),)
    )
    assert (
        start(far, 0.1) == pytest.approx((1.3,))
        and start(far, 0.6) == (4.0,)
        and start(far, 0.005) is None
        and start(far, -0.2) is None
    )
    probe = next(o for o in search.options if o.candidate == world.candidate("joint_stop", "z"))
    assert start(probe, 0.1) == probe.directions[0]


def test_coarse_steps_are_that_many_times_the_usual():
    world, runs = World(mujoco.MjSpec.from_string(DROP.format(damping=-90))), [dropped(0, -90)]
    problem = residuals.Problem(
        world, cut.consecutive(runs[0], 0.4), np.array([NOISE]), np.array([np.inf])
    )
    fine, coarse = (
        selection.Search(world, problem, runs, coarse).options for coarse in (False, True)
    )
    for a, b in zip(fine, coarse):
        assert a.candidate == b.candidate
        assert [10 * p.step for p in a.candidate.parameters] == [
            p.step for p in b.candidate.parameters
        ]
