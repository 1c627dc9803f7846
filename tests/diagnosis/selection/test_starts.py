"""Where effects are begun: how large steps are, and which waves the located force chooses."""

import copy
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from plants import DRIVEN_PENDULUM, DROP, commanded, driven_by, dropped, recorded

from diagnosis.effects.friction import TURNS
from diagnosis.effects.joints import JointStop
from diagnosis.estimation.smoother import Trajectory
from diagnosis.selection.plausibility import Usual, plausible
from diagnosis.selection.starts import STEP, Starts
from diagnosis.simulation.simulator import World


@pytest.fixture(scope="module")
def machine():
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    runs = [recorded("run.csv", 3)]
    return world, Usual(world, runs, np.ones(1))


@pytest.mark.parametrize("effect", ["quadratic_damping", "mass"])
def test_steps_from_a_far_value_are_a_share_of_its_way(machine, effect):
    world, usual = machine
    candidate = next(c for c in world.candidates if c.effect.name == effect)
    prior = plausible(candidate, usual)
    way = (prior.high[0] - candidate.nominal[0]) / 2
    far = candidate.nominal[0] + way
    [start] = Starts(world, {candidate: (far,)}, usual).of([candidate])
    assert abs(start.directions[0, 0]) == pytest.approx(STEP * way)
    near = Starts(world, {candidate: candidate.nominal}, usual).of([candidate])[0]
    least = max(abs(candidate.parameters[0].step), STEP * prior.scale[0])
    assert abs(near.directions[0, 0]) == pytest.approx(least)


def test_a_stop_on_one_side_has_a_step_for_that_side_alone(machine):
    world, usual = machine
    stop = world.candidate("joint_stop", "pivot")
    with np.errstate(all="raise"):
        [start] = Starts(world, {stop: (-0.5, np.inf)}, usual).of([stop])
    assert (start.directions != 0).tolist() == [[True, False]]


def test_a_stop_is_begun_on_either_side_alone(machine):
    """The other side is where the joint goes farthest, from where it may move."""
    world, usual = machine
    stop = world.candidate("joint_stop", "pivot")
    position = usual.recordings[0].qpos[:, 0]
    starts = Starts(world, {}, usual).of([stop])
    ends = [tuple(s.base + row) for s in starts for row in s.directions]
    met = {(bool(low > position.min()), bool(high < position.max())) for low, high in ends}
    assert met == {(True, False), (False, True), (True, True)}
    low, high = next(end for end in ends if end[1] >= position.max())
    assert high == position.max() and position.min() < low < position.max()
    model, motion = world.model, copy.deepcopy(world.model)
    stop.effect.edit(motion, 0, (low, np.inf))
    assert motion.jnt_limited[0] and motion.jnt_range[0].tolist() == [low, JointStop.NEVER]
    assert not model.jnt_limited[0]


@pytest.mark.parametrize("effect, begun", [("mass", 3), ("center_of_mass", 7), ("gain", 3)])
def test_where_something_touches_usual_sizes_are_tried_both_ways(machine, effect, begun):
    """A small step tells of what it makes and breaks."""
    world, usual = machine
    candidate = next(c for c in world.candidates if c.effect.name == effect)
    far = len(world.far(candidate, usual.recordings))
    free = Starts(world, {}, usual).of([candidate])
    starts = Starts(world, {}, usual, touches=True).of([candidate])
    assert len(free) == 1 + far and len(starts) == begun + far
    scale, base = plausible(candidate, usual).scale, np.array(candidate.nominal)
    values = {tuple(np.round(s.base + row, 9)) for s in starts for row in s.directions}
    for row in np.diag(scale):
        assert {tuple(np.round(base + way * row, 9)) for way in (-1, 1)} <= values
    inside = Starts(world, {candidate: candidate.nominal}, usual, touches=True).of([candidate])
    assert len(inside) == 1


def test_what_goes_one_way_is_not_tried_the_other(machine):
    world, usual = machine
    friction = world.candidate("coulomb_friction", "pivot")
    count = lambda touches: len(Starts(world, {}, usual, touches=touches).of([friction]))
    assert count(True) == count(False)


def test_of_a_usual_size_all_is_taken_away_where_there_is_less(machine):
    """Where something touches: a joint of which the model has too much damping may have none."""
    world, usual = machine
    damping = world.candidate("viscous_damping", "pivot")
    (nominal,), (scale,) = damping.nominal, plausible(damping, usual).scale
    assert 0 < nominal < scale
    starts = Starts(world, {}, usual, touches=True).of([damping])
    values = [float((s.base + s.directions[0])[0]) for s in starts if s.whole]
    assert sorted(values) == pytest.approx([0.0, nominal + scale])


def rubbing(run, waves):
    """The Trajectory of a joint whose friction has so many waves per radian."""
    angle = np.linspace(0, 40, len(run.time))
    q, v = 0.8 * np.sin(angle)[:, None], 0.8 * np.cos(angle)[:, None]
    force = -np.sign(v) * (0.2 + 0.15 * np.sin(waves * q + 1.0))
    free, sd = np.zeros(len(q), bool), np.full(q.shape, 1e-3)
    transition = np.tile(np.eye(2), (len(q), 1, 1))
    return Trajectory(q, v, force, sd, sd, sd, {run: 0}, free, transition)


def test_a_friction_map_begins_at_the_wave_of_the_located_force(machine):
    world, usual = machine
    friction, waves = world.candidate("friction_map", "pivot"), 9.0
    travel = np.ptp(np.quantile(usual.recordings[0].qpos, [0.02, 0.98]))
    trajectory = rubbing(usual.recordings[0], waves)
    starts = Starts(world, {}, usual, trajectory=trajectory).of([friction])
    begun = {start.base[2] + start.directions[0, 2] for start in starts}
    step = (TURNS[1] - TURNS[0]) / travel
    assert min(abs(n - waves) for n in begun) < 0.15 * step and len(begun) == 1
    assert all(start.merges and len(start.directions) == 3 for start in starts)
    reach = [start.high[0] * start.directions[0, 0] for start in starts]  # all that is plausible
    assert reach == pytest.approx([plausible(friction, usual).high[0]] * len(starts))


def test_a_wave_that_passes_begins_at_the_force_that_is_located_meanwhile(machine):
    world, usual = machine
    friction, [run] = world.candidate("friction_map", "pivot"), usual.recordings
    one, other = (rubbing(run, waves) for waves in (6.0, 12.0))
    half, begun = len(run.time) // 2, {}
    both = replace(one, force=np.concatenate([one.force[:half], other.force[half:]]))
    for name, (a, b) in {"first": (0, half - 1), "last": (half, -1)}.items():
        when = {"recording": run.name, "time": [run.time[a], run.time[b]]}
        own = Starts(world, {}, usual, trajectory=both).of([world.localised(friction, when)])
        begun[name] = own[0].base[2] + own[0].directions[0, 2]
    assert begun["first"] == pytest.approx(6.0, rel=0.1)
    assert begun["last"] == pytest.approx(12.0, rel=0.1)


def test_a_wave_longer_than_the_travel_is_begun_at_one_that_is_plausible(machine):
    world, usual = machine
    friction = world.candidate("friction_map", "pivot")
    least = plausible(friction, usual).low[2]
    trajectory = rubbing(usual.recordings[0], 0.7 * least)
    [start] = Starts(world, {}, usual, trajectory=trajectory).of([friction])
    assert least <= start.base[2] + start.directions[0, 2] < 1.5 * least


def test_a_drives_bias_is_as_plausible_as_the_springs_offset_that_it_equals(machine):
    world, usual = machine
    bias, offset = (
        plausible(world.candidate(*c), usual)
        for c in (("bias", "drive"), ("spring_offset", "pivot"))
    )
    for field in ("scale", "low", "high"):
        np.testing.assert_allclose(getattr(bias, field), getattr(offset, field))


def test_what_is_nominally_zero_is_begun_at_a_usual_size():
    """A servo without damping of its own, a floor without friction: of zero no share is a scale."""
    world, _ = driven_by('<position name="m" joint="j" kp="30"/>')
    damping, usual = (
        world.candidate("servo_damping", "m"),
        Usual(world, [moving(world)], np.ones(1)),
    )
    prior = plausible(damping, usual)
    assert damping.nominal == (0.0,) and np.isfinite(prior.scale).all()
    assert prior.high[0] == pytest.approx(5.0 / usual.speed[0])
    starts = Starts(world, {}, usual).of([damping])
    assert starts and all((s.base + s.directions > 0).all() for s in starts)
    spec = mujoco.MjSpec.from_string(DROP.format(damping=-40))
    for geom in spec.geoms:
        geom.friction = np.zeros(3)
    slippery = World(spec)
    grip, usual = slippery.candidate("contact_friction", "block"), [dropped(0, -40)]
    prior = plausible(grip, Usual(slippery, usual, np.ones(1)))
    assert grip.nominal == (0.0,) and np.isfinite(prior.scale).all() and prior.inside([0.5])


def moving(world):
    """A run of one joint that swings by a radian, at up to 5 rad/s."""
    time = 0.01 * np.arange(400)
    run = commanded(time, np.zeros((400, world.model.nu)))
    return replace(run, qpos=np.sin(5 * time)[:, None])


def test_friction_that_falls_is_begun_with_more_than_the_joint_has():
    spec = mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5))
    spec.joint("pivot").frictionloss = 0.3
    world = World(spec)
    usual = Usual(world, [recorded("run.csv", 3)], np.ones(1))
    stribeck = world.candidate("stribeck_friction", "pivot")
    assert stribeck.nominal[:2] == (0.3, 0.3)
    starts = Starts(world, {}, usual).of([stribeck])
    begun = np.array([s.base + s.low * row for s in starts for row in s.directions])
    assert len(begun) and (begun[:, 0] > 0.3).all() and (begun[:, 1] > begun[:, 0]).all()


@pytest.mark.parametrize("effect", ["friction_map", "cogging", "stribeck_friction"])
def test_all_that_is_begun_of_a_shape_is_plausible(effect):
    """Whatever is worth a try lies inside the bounds, and no start is left out for them."""
    world, _ = driven_by('<motor name="m" joint="j"/>')
    usual = Usual(world, [moving(world)], np.ones(1))
    candidate = world.candidate(effect, "j")
    prior, probes = plausible(candidate, usual), world.probes(candidate, usual.recordings)
    assert (probes[:, 2 if effect == "friction_map" else 1] >= 0).all()
    starts = Starts(world, {}, usual).of([candidate])
    assert sum(len(s.directions) for s in starts) == len(probes)
    assert all(prior.inside(s.base + row) for s in starts for row in s.directions)


def test_a_limit_that_is_not_met_is_begun_at_whole_values_as_one_that_there_was_not(machine):
    """On the way from 13 N·m to what the drive asks for nothing changes: no share of it tells."""
    world, usual = machine
    limited = DRIVEN_PENDULUM.replace('joint="pivot"/>', 'joint="pivot" forcerange="-13 13"/>')
    other = World(mujoco.MjSpec.from_string(limited.format(damping=0.05, mass=0.5)))
    begun = []
    for each in (world, other):
        own = Usual(each, usual.recordings, np.ones(1))
        starts = Starts(each, {}, own).of([each.candidate("saturation", "drive")])
        assert starts and all((s.low == 1).all() and (s.high == 1).all() for s in starts)
        begun.append({round(float((s.base + s.directions)[0, 0]), 9) for s in starts})
    assert begun[0] and begun[0] <= begun[1]
