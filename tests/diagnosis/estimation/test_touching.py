"""Rows in which something may touch, against the contacts of the motion behind noisy readings."""

import mujoco
import numpy as np
import pytest

from diagnosis.estimation.smoother import Smoother, touching
from diagnosis.recordings.recording import Recording
from diagnosis.simulation.simulator import World

BALL = """<mujoco><option timestep="0.002"/><worldbody><geom type="plane" size="5 5 .1"/>
  <body name="ball" pos="0 0 .3"><joint name="z" type="slide" axis="0 0 1"/>
  <geom size=".05" mass="1" solref="0.01 1"/></body></worldbody></mujoco>"""
ROD = """<mujoco><worldbody><geom type="plane" size="5 5 .1" margin="{margin}"/>
  <body name="rod" pos="0 0 .3"><joint name="pitch" axis="0 1 0" limited="true" range="-90 90"/>
  <geom type="capsule" fromto="0 0 0 1 0 0" size=".02" mass="1"/></body></worldbody></mujoco>"""
NOISE = 3e-3


def fallen():
    """(Recording of a ball that falls, bounces and rests; rows (T,) in which it touches)."""
    model = mujoco.MjModel.from_xml_string(BALL)
    data, qpos, touch = mujoco.MjData(model), np.empty((300, 1)), np.zeros(300, bool)
    for t in range(300):
        mujoco.mj_forward(model, data)
        qpos[t], touch[t] = data.qpos, data.ncon > 0
        for _ in range(2):
            mujoco.mj_step(model, data)
    noisy = qpos + NOISE * np.random.default_rng(0).normal(size=qpos.shape)
    none = np.full(qpos.shape, np.nan)
    return Recording("0.csv", 0.004 * np.arange(300), noisy, none, np.zeros((300, 0))), touch


def test_a_robot_that_rests_touches_whatever_noisy_readings_say():
    run, touch = fallen()
    world = World(mujoco.MjSpec.from_string(BALL))
    bare = touching(world.model, run.qpos, np.zeros(1))
    assert bare[touch].mean() < 0.9  # a reading above the ground, and the next one too
    located = Smoother(world, [run]).locate({})
    assert located.free[touch].mean() > 0.99
    high = run.qpos[:, 0] > -0.25 + 10 * NOISE  # of the ball's lowest point
    assert high.sum() > 40 and located.free[high].mean() < 0.1


@pytest.mark.parametrize("margin", [0.0, 0.01])
def test_what_may_touch_is_told_by_how_far_the_distance_may_be_off(margin):
    """The rod's end lies 0.3 - 0.02 - sin(pitch) over the ground, and moves by cos(pitch) a rad."""
    model = mujoco.MjModel.from_xml_string(ROD.format(margin=margin))
    off, height = 0.01, 0.28 - margin
    for side in (-1, 1):
        pitch = np.arcsin(height)
        for _ in range(20):  # where the distance is what it may be off by
            pitch = np.arcsin(height - off * np.cos(pitch))
        touch = touching(model, np.array([[pitch - side * 1e-4], [0.0]]), np.array([off]))
        assert touch.tolist() == [side < 0, False]


PAIRED = """<mujoco><default><geom contype="0" conaffinity="0"/></default><worldbody>
  <geom name="floor" type="plane" size="5 5 .1"/><body pos="0 0 .05">
  <joint type="slide" axis="0 0 1"/><geom name="ball" size=".05" mass="1"/></body></worldbody>
  <contact><pair geom1="floor" geom2="ball" margin="0.02"/></contact></mujoco>"""


def test_of_a_pair_its_own_margin_counts():
    """Its geoms collide with nothing else, and have no margin of their own."""
    model = mujoco.MjModel.from_xml_string(PAIRED)
    for off in (0.0, 0.004):
        at = 0.02 + off
        qpos = np.array([[at - 1e-4], [1.0], [at + 1e-4]])
        assert touching(model, qpos, np.array([off])).tolist() == [True, False, False]


def test_a_joint_at_the_end_of_its_travel_as_far_as_it_is_known():
    model = mujoco.MjModel.from_xml_string(ROD.format(margin=0.0))
    end = -np.pi / 2
    qpos = np.array([[-1.0], [end + 0.02], [-1.0], [-1.0], [end + 0.001]])
    assert touching(model, qpos, np.zeros(1)).tolist() == [False] * 5
    # the row before is not free either: it leads to one that touches
    assert touching(model, qpos, np.array([0.01])).tolist() == [False, False, False, True, True]
    each = np.array([[0.0], [0.03], [0.0], [0.0], [0.0]])
    assert touching(model, qpos, each).tolist() == [True, True, False, False, False]
