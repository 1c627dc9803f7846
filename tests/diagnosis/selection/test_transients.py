"""Events: a load and a push that were put in for a while; none where the motion explains it all."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from plants import DRIVEN_PENDULUM, loaded, recorded

from diagnosis import findings
from diagnosis.estimation.smoother import Smoother
from diagnosis.recordings.recording import Recording
from diagnosis.selection import transients
from diagnosis.simulation.simulator import World


def found(runs, setting=None):
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    setting = {world.candidate(*c): v for c, v in (setting or {}).items()}
    smoother = Smoother(world, runs)
    trajectory = smoother.locate(setting)
    return transients.find(world, runs, setting, trajectory, smoother.position_noise)


def test_a_load_on_top_of_a_lasting_one_is_placed_in_time_and_weighed():
    event = found([loaded(2, 3.0, 4.0, (1.6, 2.4))], {("mass", "arm"): (1.5,)})
    told = findings.of_event(event)
    [p] = told["parameters"]
    assert told["effect"] == "payload_change" and told["written_as"] == "none"
    assert told["when"]["time"] == pytest.approx([1.6, 2.4], abs=0.03)
    assert p["low"] < 2.0 < p["high"] and p["high"] - p["low"] < 0.1
    assert told["evidence"]["p_value"] < 1e-3 and told["evidence"]["error_removed_there"] > 0.8


def test_a_push_is_placed_in_time_and_what_is_calm_is_cut_out():
    runs = [
        recorded("calm.csv", 0),
        recorded("pushed.csv", 1, push=lambda time, q, v: 0.3 * (1.5 < time < 2.5)),
    ]
    event = found(runs)
    assert event.recording is runs[1] and event.time == pytest.approx((1.5, 2.5), abs=0.1)
    parts = transients.calm(runs, event)
    assert parts[0] is runs[0] and [r.name for r in parts] == ["calm.csv"] + ["pushed.csv"] * 2
    assert parts[1].time[-1] < event.time[0] and parts[2].time[0] > event.time[1]
    np.testing.assert_array_equal(parts[2].qpos, runs[1].qpos[-len(parts[2].time) :])


def test_a_push_may_be_there_when_the_only_recording_begins():
    event = found([recorded("run.csv", 1, push=lambda time, q, v: 0.3 * (time < 0.9))])
    assert event.time == pytest.approx((0.0, 0.9), abs=0.1)


def test_a_push_that_is_certain_but_changes_little_is_no_event(monkeypatch):
    pushed = lambda time, q, v: 0.004 * (1.0 < time < 3.0)
    runs = [recorded(f"{k}.csv", k, push=pushed if k == 1 else None) for k in range(3)]
    assert found(runs) is None
    monkeypatch.setattr(transients, "PRICE", 0.0)
    event = found(runs)
    assert event.recording is runs[1] and event.p_value < 1e-3


@pytest.mark.parametrize(
    "push",
    [
        None,
        lambda time, q, v: -0.1 * np.tanh(v / 0.01),
        lambda time, q, v: -0.2 * max(v - 3.5, 0.0),  # few windows are so fast
    ],
)
def test_what_lasts_is_no_event(push):
    assert found([recorded(f"run{i}.csv", i, push=push) for i in range(2)]) is None


TWO = """<mujoco><worldbody>
  <body><joint name="a" axis="0 1 0" damping=".05"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".5" contype="0"/></body>
  <body pos="1 0 0"><joint name="b" axis="0 1 0" damping=".05"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".5" contype="0"/></body>
  </worldbody></mujoco>"""


def test_a_lasting_force_at_another_joint_hides_no_event():
    world, time = World(mujoco.MjSpec.from_string(TWO)), 0.01 * np.arange(500)
    data, rng, qpos = mujoco.MjData(world.model), np.random.default_rng(0), np.empty((500, 2))
    data.qpos[:] = 1.2, -0.9
    for t in range(500):
        qpos[t] = data.qpos
        push = 0.5 * (2.0 < time[t] < 2.6), -0.02 * np.tanh(data.qvel[1] / 0.01)
        for _ in range(5):
            data.qfrc_applied[:] = push
            mujoco.mj_step(world.model, data)
    noisy = qpos + 1e-4 * rng.normal(size=qpos.shape)
    run = Recording("run.csv", time, noisy, np.full((500, 2), np.nan), np.zeros((500, 0)), {})
    smoother = Smoother(world, [run])
    event = transients.find(world, [run], {}, smoother.locate({}), smoother.position_noise)
    assert event is not None and event.time == pytest.approx((2.0, 2.6), abs=0.15)


def carried_through_one_of_three():
    always, never = (0.0, 9.0), (8.0, 9.0)
    runs = [loaded(seed, 1.0, 2.0, always if seed == 1 else never) for seed in range(3)]
    return [replace(run, name=f"run{i}.csv") for i, run in enumerate(runs)]


def test_a_load_may_be_carried_through_one_recording_of_three():
    runs = carried_through_one_of_three()
    event = found(runs)
    assert event.candidate.effect.name == "payload_change" and event.recording is runs[1]
    assert event.values[0] == pytest.approx(1.0, rel=0.03)
    assert event.time == pytest.approx((0.0, 3.99), abs=0.2)  # what is left of whole windows


def test_what_explains_as_much_and_lasts_speaks_against_an_event():
    runs = carried_through_one_of_three()
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    smoother = Smoother(world, runs)
    given = world, runs, {}, smoother.locate({}), smoother.position_noise
    heavy, loaded_one = (
        {world.localised(world.candidate("mass", "arm"), when): (1.0,)}
        for when in (None, {"recording": "run1.csv", "time": [0.0, 9.0]})
    )
    assert transients.find(*given, lasting=heavy) is not None  # wrong in two of three
    assert transients.find(*given, lasting=loaded_one) is None
