"""What the files predict in stock MuJoCo against the simulator that fitted them."""

import mujoco
import numpy as np
import pytest

from diagnosis import handover
from diagnosis.estimation import windowing
from diagnosis.recordings.recording import Recording
from diagnosis.simulation.corrected_py import module_of
from diagnosis.simulation.simulator import World

ARM = """<mujoco><option timestep="0.002"/><default><geom contype="0" conaffinity="0"/></default>
  <worldbody><body name="a" pos="0 0 1"><joint name="j" axis="0 1 0" damping="0.05"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="1"/>
  <body name="b" pos="0 0 -.3"><joint name="k" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="1"/></body></body></worldbody>
  <actuator><motor name="m" joint="k"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    "setting",
    [
        {},
        {("viscous_damping", "j"): (0.3,), ("gain", "m"): (0.7,)},
        {("mass", "b"): (1.5,), ("delay", "m"): (0.02,)},
    ],
)
def test_files_predict_what_was_fitted(setting):
    world = World(mujoco.MjSpec.from_string(ARM))
    setting = {world.candidate(*c): v for c, v in setting.items()}
    rng, time = np.random.default_rng(0), 0.01 * np.arange(151)
    qpos = np.stack([np.sin(3 * time), np.cos(4 * time)], 1)
    ctrl = np.repeat(rng.uniform(-1, 1, (31, 1)), 5, 0)[:151]
    runs = [
        Recording(f"{k}.csv", time, qpos + 0.1 * k, np.full((151, 2), np.nan), ctrl)
        for k in range(2)
    ]
    windows = [w for r in runs for w in windowing.consecutive(r)]
    model = handover.compiled(world.corrected_xml(setting)[0])
    found = handover.in_stock_mujoco(model, world.model, windows)
    starts = windowing.recorded_starts(world.model, windows)
    expected = world.simulate([setting] * len(windows), *starts, windows)[0]
    assert found.shape == expected.shape
    np.testing.assert_allclose(found, expected, atol=2e-5)


@pytest.mark.parametrize(
    "step, row", [(0.008, 0.01), (0.01, 0.0149), (0.002, 0.003), (0.005, 0.01)]
)
def test_a_script_that_adds_nothing_predicts_the_same(step, row):
    """Whatever part of a row a time step is."""
    world = World(mujoco.MjSpec.from_string(ARM.replace("0.002", str(step))))
    time = row * np.arange(101)
    qpos = np.stack([np.sin(3 * time), np.cos(4 * time)], 1)
    ctrl = np.random.default_rng(0).uniform(-1, 1, (101, 1))
    recording = Recording("r.csv", time, qpos, np.full((101, 2), np.nan), ctrl)
    windows = windowing.consecutive(recording)
    found = handover.in_stock_mujoco(world.model, world.model, windows)
    rows = [(w.first, w.last) for w in windows]
    states = windowing.states(world.model, recording)
    expected = module_of([], ["j", "k"]).predict(world.model, time, *states, ctrl, rows)
    for one, other in zip(found, expected):
        np.testing.assert_allclose(one[: len(other)], other, rtol=0, atol=1e-9)
