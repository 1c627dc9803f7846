"""Where predictions jump, rows lie far apart, or a first look misleads: what start states, steps and windows are then tried."""

import mujoco
import numpy as np
import pytest

import earning
import identify
import misfit
import selection
import shooting
import windows as cut
from recordings import Recording
from world import World

NOISE = 1e-3
DROP = """<mujoco><option timestep="0.002"/><worldbody><geom name="floor" type="plane" size="5 5 .1" solref="-4000 {damping}"/>
  <body name="block" pos="0 0 .05"><joint name="z" type="slide" axis="0 0 1" damping="0.3"/>
  <geom name="block" type="box" size=".08 .08 .05" mass="1" solref="-4000 {damping}"/></body></worldbody></mujoco>"""
POLE = """<mujoco><option timestep="0.01"/><worldbody><body><joint name="x" type="slide" axis="1 0 0" damping=".1"/>
  <geom type="box" size=".1 .1 .1" mass="1" contype="0" conaffinity="0"/>
  <body><joint name="hinge" axis="0 1 0" damping=".05"/><geom type="capsule" fromto="0 0 0 0 0 .6" size=".02" mass=".5" contype="0" conaffinity="0"/>
  </body></body></worldbody><actuator><motor name="push" joint="x" gear="10"/></actuator></mujoco>"""


def run(xml, seed, interval, rows, start, force=lambda q, v: 0.0, feedback=None, noise=NOISE):
    """A run in stock MuJoCo, positions recorded with noise. force(qpos, qvel): what the model of the mechanism lacks."""
    rng, model = np.random.default_rng(seed), mujoco.MjModel.from_xml_string(xml)
    data, qpos, ctrl = mujoco.MjData(model), np.empty((rows, model.nq)), np.zeros((rows, model.nu))
    data.qpos[:] = start(rng)
    for t in range(rows):
        qpos[t] = data.qpos
        if feedback:
            ctrl[t] = data.ctrl[:] = feedback(data.qpos, data.qvel, rng)
        for _ in range(round(interval / model.opt.timestep)):
            data.qfrc_applied[:] = force(data.qpos, data.qvel)
            mujoco.mj_step(model, data)
    noisy = qpos + noise * rng.normal(size=qpos.shape)
    return Recording(f"run{seed}.csv", interval * np.arange(rows), noisy, np.full(qpos.shape, np.nan), ctrl, {})


def dropped(seed, damping=-90):
    return run(DROP.format(damping=damping), seed, 0.01, 150, lambda rng: rng.uniform(0.1, 0.3))


def balanced(seed, force=lambda q, v: 0.0):
    """25 rows a second of a pole that falls ten times as far in one, held upright."""
    hold = lambda q, v, rng: 0.1 * (q[0] + 2 * v[0] + 30 * q[1] + 8 * v[1]) + 0.1 * rng.normal()
    return run(POLE, seed, 0.04, 150, lambda rng: rng.uniform(-0.05, 0.05, 2), force, hold)


def test_start_states_behind_a_bounce_are_drawn():
    """Starts from which the block meets the floor some steps too soon: every small step from them makes it worse."""
    world, runs = World(mujoco.MjSpec.from_string(DROP.format(damping=-30))), [dropped(seed, -30) for seed in range(3)]
    problem = misfit.Problem(world, [w for r in runs for w in cut.consecutive(r, 0.2)], np.array([NOISE]), np.array([np.inf]))
    good, nominal = shooting.fit_starts(problem, misfit.Hypothesis()), misfit.Hypothesis()
    every = np.arange(len(problem.windows))
    settings = [nominal.settings] * len(every)
    rng = np.random.default_rng(0)
    qpos, qvel = good.qpos, good.qvel + 0.3 * rng.normal(size=good.qvel.shape)
    residual = problem.residuals(settings, every, qpos, qvel)
    jacobian = problem.start_jacobians(settings, every, qpos, qvel, residual)
    [stuck] = shooting._fit_starts(problem, [misfit.Fit(nominal, qpos, qvel, residual, jacobian)], 12, fresh=True)
    drawn = shooting.scattered(problem, stuck)
    assert stuck.chi2.sum() > 3 * good.chi2.sum()
    assert drawn.chi2.sum() < 1.3 * good.chi2.sum()
    assert (drawn.chi2 <= stuck.chi2).all()
    again = problem.residuals(settings, every, drawn.qpos, drawn.qvel)
    np.testing.assert_allclose(again, drawn.residual)


def test_values_are_stretched_from_the_nominal_ones():
    world = World(mujoco.MjSpec.from_string(DROP.format(damping=-90)))
    damping, friction = world.candidate("contact_damping", "block"), world.candidate("stribeck_friction", "z")
    begun = misfit.Hypothesis().plus(damping, (80.0,)).plus(friction, (0.1, 0.3, 0.2))
    settings = selection.stretch(begun, [damping, friction], 2.0).settings
    assert settings[damping] == (70.0,) and settings[friction] == (0.2, 0.6, 0.2)
    assert selection.stretch(begun, [damping], 1e9).settings[damping] == (damping.parameters[0].low,)
    assert selection.stretch(begun, [damping], 0.0).settings[damping] == damping.nominal


def test_a_value_that_stopped_at_a_jump_is_moved_on():
    world, runs = World(mujoco.MjSpec.from_string(DROP.format(damping=-90))), [dropped(seed, -40) for seed in range(4)]
    problem = misfit.Problem(world, [w for r in runs for w in cut.consecutive(r, 0.2)], np.array([NOISE]), np.array([np.inf]))
    search, damping = selection.Search(world, problem, runs, coarse=True), world.candidate("contact_damping", "block")
    fit = shooting.fit_starts(problem, misfit.Hypothesis().plus(damping, (85.0,)))
    assert not earning.is_far(search, fit) and earning.is_far(selection.Search(world, problem, runs), fit)  # it is jumps that keep it there
    new = search.stretched(fit, (damping,))
    assert fit.chi2.sum() > 3 * search.freedom and new.chi2.sum() < 1.2 * search.freedom
    assert new.hypothesis.vector[0] < 50


def test_coarse_steps_are_that_many_times_the_usual():
    world, runs = World(mujoco.MjSpec.from_string(POLE)), [balanced(0)]
    problem = misfit.Problem(world, cut.consecutive(runs[0], 0.4), np.full(2, NOISE), np.full(2, np.inf))
    fine, coarse = (selection.Search(world, problem, runs, coarse).options for coarse in (False, True))
    for a, b in zip(fine, coarse):
        assert a.candidate == b.candidate
        assert [10 * p.step for p in a.candidate.parameters] == [p.step for p in b.candidate.parameters]


@pytest.mark.parametrize("force, names", [(lambda q, v: (0.0, 0.15), {"spring_offset", "sensor_bias", "center_of_mass"}),
                                          (lambda q, v: (0.0, 0.0), set())])
def test_what_shows_in_longer_windows_than_start_states_need_is_found(force, names):
    runs = [balanced(seed, force) for seed in range(2)]
    findings = identify.identify(World(mujoco.MjSpec.from_string(POLE)), runs[:1], runs[1:]).summary["findings"]
    assert {f["effect"] for f in findings} <= names and bool(findings) == bool(names)


def test_one_effect_of_many_ways_to_bend_is_not_hidden_by_a_simple_one():
    """A cubic spring so hard that, in a small look, a heavy cart explains as much."""
    runs = [balanced(seed, lambda q, v: (-1500 * q[0]**3, 0.0)) for seed in range(2)]
    findings = identify.identify(World(mujoco.MjSpec.from_string(POLE)), runs[:1], runs[1:]).summary["findings"]
    assert findings[0]["effect"] == "nonlinear_stiffness"
    assert findings[0]["parameters"][0]["value"] == pytest.approx(1500, rel=0.02)
