"""Where effects are begun: how large steps are, and which waves the located force chooses."""

import copy

import mujoco
import numpy as np
import pytest
from plants import DRIVEN_PENDULUM, recorded

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
    world, usual = machine
    stop = world.candidate("joint_stop", "pivot")
    starts = Starts(world, {}, usual).of([stop])
    met = [abs(s.base + row) < JointStop.NEVER for s in starts for row in s.directions]
    assert {(True, False), (False, True), (True, True)} == {tuple(row) for row in met}
    position = usual.recordings[0].qpos[:, 0]
    model, motion = world.model, copy.deepcopy(world.model)
    low, high = next(v for s in starts for v in [s.base + s.directions[0]] if v[1] > 1e5)
    stop.effect.edit(motion, 0, (low, high))
    assert motion.jnt_limited[0] and position.min() < motion.jnt_range[0, 0] < position.max()
    assert motion.jnt_range[0, 1] == JointStop.NEVER and not model.jnt_limited[0]


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


def test_a_friction_map_begins_at_the_wave_of_the_located_force(machine):
    world, usual = machine
    friction = world.candidate("friction_map", "pivot")
    angle = np.linspace(0, 40, 600)
    q, v = 0.8 * np.sin(angle)[:, None], 0.8 * np.cos(angle)[:, None]
    waves = 9.0
    travel = np.ptp(np.quantile(usual.recordings[0].qpos, [0.02, 0.98]))
    force = -np.sign(v) * (0.2 + 0.15 * np.sin(waves * q + 1.0))
    free = np.zeros(len(q), bool)
    sd, run = np.full(q.shape, 1e-3), usual.recordings[0]
    transition = np.tile(np.eye(2), (len(q), 1, 1))
    trajectory = Trajectory(q, v, force, sd, sd, sd, {run: 0}, free, transition)
    starts = Starts(world, {}, usual, trajectory=trajectory).of([friction])
    begun = {start.base[2] + start.directions[0, 2] for start in starts}
    step = (TURNS[1] - TURNS[0]) / travel
    assert min(abs(n - waves) for n in begun) < 0.15 * step and len(begun) == 1
    assert all(start.merges and len(start.directions) == 3 for start in starts)
    reach = [start.high[0] * start.directions[0, 0] for start in starts]  # all that is plausible
    assert reach == pytest.approx([plausible(friction, usual).high[0]] * len(starts))


def test_a_drives_bias_is_as_plausible_as_the_springs_offset_that_it_equals(machine):
    world, usual = machine
    bias, offset = (
        plausible(world.candidate(*c), usual)
        for c in (("bias", "drive"), ("spring_offset", "pivot"))
    )
    for field in ("scale", "low", "high"):
        np.testing.assert_allclose(getattr(bias, field), getattr(offset, field))
