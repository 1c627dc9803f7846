"""What a trial hides as a setting of the candidates."""

import mujoco
import pytest
from plants import DRIVEN_PENDULUM

from benchmarks.truths import true_setting
from diagnosis.simulation.simulator import World


def hidden(effect, place, **parameters):
    return {"effect": effect, "place": {"name": place}, "parameters": parameters}


@pytest.mark.parametrize(
    "item, values",
    [
        (hidden("dead_zone", "drive", half_width=0.2), (0.2,)),
        (hidden("load_friction", "pivot", driving=0.1, driven=0.3), (0.1, 0.3, 1.0)),
        (hidden("gain", "drive", anything=0.8), (0.8,)),
        (hidden("load_friction", "pivot", driving=0.1, teeth=12), None),
        (hidden("gain", "nowhere", gain=0.8), None),
        (hidden("unknown", "pivot", damping=0.8), None),
    ],
)
def test_true_values_by_name_what_is_not_told_as_in_the_model(item, values):
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    gain = hidden("gain", "drive", gain=0.9)
    found = true_setting(world, {"hidden": [item]})
    assert (found and list(found.values())) == (values and [values])
    assert not true_setting(world, {"hidden": []})
    if values is None:
        assert true_setting(world, {"hidden": [gain, item]}) is None
