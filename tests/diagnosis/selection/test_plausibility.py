"""Priors in units of the machine: centred on the model, bounded by physics, dear where far off."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plants import (
    DRIVEN_PENDULUM,
    arm,
    commanded,
    driven_by,
    on_spring,
    record,
    recorded,
    stepped,
)
from scipy import stats

from diagnosis.selection.plausibility import TAIL, Prior, Usual, at_limit, plausible, possible
from diagnosis.simulation.simulator import World


@pytest.fixture(scope="module", params=["motors", "servos"])
def machine(request):
    world, _ = arm(request.param)
    return world, Usual(world, [record(world)], np.ones(world.model.nv))


def test_every_effect_of_the_catalogue_has_a_prior_about_its_nominal_values(machine):
    world, usual = machine
    for c in world.candidates:
        if c.place.kind == "sensor":
            continue
        prior, nominal = plausible(c, usual), np.array(c.nominal, float)
        finite = np.isfinite(nominal)
        assert (prior.centre[finite] == nominal[finite]).all(), c
        assert (prior.low <= prior.high).all() and (prior.scale > 0).all(), c
        shape = np.arange(len(nominal)) >= (c.effect.amplitudes or len(nominal))
        # of a shape nothing is nominal
        inside = np.where(finite & ~shape, nominal, prior.high)
        assert prior.inside(inside), c
        physical = [(p.low, p.high) for p in c.parameters]
        for (low, high), own_low, own_high, n in zip(physical, prior.low, prior.high, nominal):
            assert own_low >= min(low, n) and own_high <= max(high, n), c


def test_a_dead_zone_may_take_all_that_is_asked_for():
    world, _ = driven_by('<motor name="m" joint="j"/>')
    usual = Usual(world, [commanded(0.01 * np.arange(400), np.full((400, 1), 2.0))], np.ones(1))
    prior = plausible(world.candidate("dead_zone", "m"), usual)
    assert prior.inside([1.98]) and not prior.inside([2.02])


@given(st.lists(st.floats(-6, 6), min_size=2, max_size=2))
@settings(max_examples=50, deadline=None)
def test_costs_are_students_and_their_precision_leads_to_the_same_place(z):
    scale, centre = np.array([0.5, 20.0]), np.array([1.0, -3.0])
    prior = Prior(centre, scale, np.full(2, -np.inf), np.full(2, np.inf))
    values, t = centre + scale * z, stats.t(TAIL)
    assert prior.cost(values) == pytest.approx((t.logpdf(0) - t.logpdf(z)).sum(), abs=1e-9)
    small = 1e-5 * scale
    for k, unit in enumerate(np.eye(2)):
        slope = (prior.cost(values + small * unit) - prior.cost(values - small * unit)) / (
            2 * small[k]
        )
        pulled = prior.precision(values)[k] * (values - centre)[k]
        assert pulled == pytest.approx(slope, abs=1e-4 / scale[k])


def test_what_no_machine_has_is_not_possible():
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    usual = Usual(world, [recorded("run.csv", 0)], np.array([0.5]))

    def allowed(effect, place, *values):
        candidate = world.candidate(effect, place)
        return possible(candidate, np.array(values), plausible(candidate, usual))

    assert allowed("mass", "arm", 0.9) and not allowed("mass", "arm", 875.0)
    assert allowed("gain", "drive", 0.8) and not allowed("gain", "drive", 0.01)
    inertia = world.model.dof_M0[0]
    assert allowed("armature", "pivot", 0.5 * inertia)
    assert not allowed("armature", "pivot", 89 * inertia)
    assert allowed("gravity", "world", 1.0, 0.0, -9.76)  # tilted
    assert not allowed("gravity", "world", 0.0, 0.0, -7.0)
    assert not allowed("viscous_damping", "pivot", -0.1)


def test_units_are_those_of_the_machine():
    """Twice the force, twice what is usual of friction."""
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    friction = world.candidate("coulomb_friction", "pivot")
    one, two = (
        plausible(friction, Usual(world, [recorded("run.csv", 0)], np.array([f])))
        for f in (0.5, 1.0)
    )
    assert two.scale == pytest.approx(2 * one.scale) and two.high == pytest.approx(2 * one.high)


def test_only_a_bound_of_what_is_plausible_is_a_limit_beyond_which_the_truth_may_lie(machine):
    world, usual = machine
    damping = world.candidate("viscous_damping", world.model.joint(0).name)
    prior = Prior(*(np.array([x]) for x in (3.0, 1.0, 0.0, 8.0)))
    assert not at_limit(damping, (0.0,), prior)  # none at all: nothing lies beyond
    assert at_limit(damping, (8.0,), prior) and not at_limit(damping, (4.0,), prior)
    gain = world.candidate("gain", world.model.actuator(0).name)
    ends = plausible(gain, usual)
    assert at_limit(gain, ends.low, ends) and at_limit(gain, ends.high, ends)
    assert not at_limit(gain, ends.centre, ends)


def test_a_bristle_that_bends_much_farther_than_the_joint_travels_is_a_spring():
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    usual = Usual(world, [recorded("run.csv", 0)], np.array([0.5]))
    bristle = world.candidate("presliding", "pivot")
    prior = plausible(bristle, usual)
    spring = 0.5 / np.ptp(recorded("run.csv", 0).qpos)
    assert not at_limit(bristle, (0.1, spring), prior)
    assert at_limit(bristle, (0.1, 0.001 * spring), prior)
    assert not possible(bristle, np.array([0.1, 0.001 * spring]), prior)


def test_a_force_without_a_name_is_about_as_large_as_what_is_missing():
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    run = recorded("run.csv", 0)
    usual = Usual(world, [run], np.array([0.5]), missing=np.array([0.02]))
    curve = world.curve("pivot", "position:pivot", (0.0, 1.0))
    times = world.curve("pivot", "position:pivot", (0.0, 1.0), "control:drive")
    assert plausible(curve, usual).scale == pytest.approx([0.06, 0.06])
    asked = np.sqrt(np.mean(run.ctrl[:, 0] ** 2))
    assert plausible(times, usual).scale == pytest.approx([0.06 / asked] * 2)
    grows = world.curve("pivot", "position:pivot", (0.0, 1.0), "speed:pivot")
    usual.speed = np.array([0.25])
    assert plausible(grows, usual).scale == pytest.approx([0.06 / 0.25] * 2)
    assert np.isinf(plausible(curve, Usual(world, [run], np.array([0.5]))).scale).all()


def test_what_is_usual_is_told_by_the_smoothed_motion():
    """A velocity of noise alone is no speed."""
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    run = recorded("run.csv", 0)
    smooth = np.zeros_like(run.qpos), np.full_like(run.qvel, 0.25)
    usual = Usual(world, [run], np.array([0.5]), motion=smooth)
    assert usual.speed == pytest.approx([0.25]) and usual.range == pytest.approx([0.0], abs=1e-8)
    damping = world.candidate("viscous_damping", "pivot")
    assert plausible(damping, usual).high == pytest.approx([5 * 0.5 / 0.25])


@pytest.mark.parametrize("servo", [False, True])
def test_a_servo_saturates_beside_what_it_gave_and_a_motor_beside_what_it_was_asked_for(servo):
    """Of a servo that gives a tenth of what its law asks for, the rest is missing."""
    spec = mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5))
    if servo:
        spec.actuator("drive").set_to_position(kp=50.0, kv=2.0)
    world, run = World(spec), recorded("run.csv", 0)
    qpos, qvel = np.random.default_rng(0).normal(size=(2, *run.ctrl.shape))
    law = 50 * (run.ctrl - qpos) - 2 * qvel if servo else run.ctrl
    usual = Usual(world, [run], np.ones(1), motion=(qpos, qvel), lacking=-0.9 * law)
    low = plausible(world.candidate("saturation", "drive"), usual).low[0]
    most = np.quantile(abs(law), 0.995)
    assert low == pytest.approx(0.05 * most * (0.1 if servo else 1.0))


@pytest.mark.parametrize("located", [False, True])
def test_a_force_that_its_limit_cuts_says_nothing_of_how_much_was_asked_for(located):
    """A servo that asks for 1500 N·m and may give 50 may well give less."""
    world, run = stepped()
    lacking = np.zeros_like(run.qpos) if located else None
    usual = Usual(world, [run], np.ones(1), lacking=lacking)
    prior = plausible(world.candidate("saturation", "m"), usual)
    assert prior.low == pytest.approx([0.05 * 50]) and prior.high[0] > 75


def test_a_spring_is_as_stiff_as_its_force_over_how_far_it_is_bent():
    """Far from zero, near to where it is at rest."""
    world, run = on_spring(rest=np.pi / 3)
    usual = Usual(world, [run], np.array([3.0]))
    assert usual.travel == pytest.approx([0.05], rel=0.02)
    spring, bent = (world.candidate(name, "j") for name in ("stiffness", "nonlinear_stiffness"))
    prior = plausible(spring, usual)
    assert prior.inside([130.0]) and prior.inside([0.0]) and not prior.inside([1000.0])
    assert plausible(bent, usual).high == pytest.approx([5 * 3.0 / usual.travel[0] ** 3])


@pytest.mark.parametrize("effect, at", [("friction_map", 2), ("cogging", 1)])
def test_a_wave_turns_once_within_the_recorded_travel_at_least(effect, at):
    """Less may be of any shape."""
    world, _ = driven_by('<motor name="m" joint="j"/>')
    time = 0.01 * np.arange(400)
    run = commanded(time, np.zeros((400, 1)))
    run = replace(run, qpos=np.linspace(-1, 1, 400)[:, None])
    usual, wave = Usual(world, [run], np.ones(1)), world.candidate(effect, "j")
    prior, values = plausible(wave, usual), np.array(wave.nominal)
    assert prior.low[at] == pytest.approx(np.pi, rel=0.03)  # but for rare ends
    values[0] = 0.5
    for number, allowed in ((0.8 * np.pi, False), (1.2 * np.pi, True), (40.0, True)):
        values[at] = number
        assert possible(wave, values, prior) == allowed


def test_what_passes_may_be_stronger_but_turns_no_more_often():
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    usual, lasts = (
        Usual(world, [recorded("a.csv", 0)], np.ones(1)),
        world.candidate("cogging", "pivot"),
    )
    passes = world.localised(lasts, {"recording": "a.csv", "time": [0.0, 1.0]})
    always, once = plausible(lasts, usual), plausible(passes, usual)
    assert once.high[0] == pytest.approx(20 * always.high[0])
    assert (once.low[1:] == always.low[1:]).all() and (once.high[1:] == always.high[1:]).all()


def test_friction_has_fallen_at_the_speed_that_is_usual():
    """What still falls beyond is another law of friction."""
    world, _ = driven_by('<motor name="m" joint="j"/>')
    angle = 5 * 0.01 * np.arange(400)
    run = replace(commanded(angle / 5, np.zeros((400, 1))), qpos=np.sin(angle)[:, None])
    usual, stribeck = Usual(world, [run], np.ones(1)), world.candidate("stribeck_friction", "j")
    prior = plausible(stribeck, usual)
    assert prior.high[2] == pytest.approx(5 / np.sqrt(2), rel=0.02)
    for speed, allowed in ((0.05, True), (3.0, True), (4.0, False)):
        assert possible(stribeck, np.array([0.1, 0.2, speed]), prior) == allowed
