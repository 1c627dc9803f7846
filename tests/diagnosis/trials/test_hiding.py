"""Where physics can be hidden: what the catalogue holds can be named there."""

import mujoco
import numpy as np
import pytest

from diagnosis.simulation.simulator import World
from diagnosis.trials.hiding import places
from diagnosis.trials.robots import FINAL, draw_robot, to_mjcf


@pytest.mark.parametrize("effect", ["coupled_friction", "coupled_inertia"])
def test_a_pair_of_joints_that_hides_an_effect_can_be_named(effect):
    rng, hidden = np.random.default_rng(0), 0
    for _ in range(20):
        robot = draw_robot(rng, FINAL)
        world = World(mujoco.MjSpec.from_string(to_mjcf(robot)))
        named = {c.place.name for c in world.candidates if c.effect.name == effect}
        links = robot.links
        for spot in places(robot, effect):
            pair = f"{links[spot.other].joint_name}+{links[spot.link].joint_name}"
            assert pair in named
            hidden += 1
    assert hidden > 5
