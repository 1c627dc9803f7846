"""The model's own sensors: errors against a plain loop in stock MuJoCo, faults that were put in,
and none where none are."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from diagnosis.estimation import windowing
from diagnosis.estimation.smoother import Smoother
from diagnosis.recordings.recording import Recording
from diagnosis.selection import sensor_faults
from diagnosis.simulation.simulator import World

ARM = """<mujoco><option timestep="0.002"/><worldbody><body><joint name="a" axis="0 1 0"
  damping="{damping}"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".02" mass="0.5" contype="0" conaffinity="0"/>
  <site name="tip" pos="0 0 -.4"/></body></worldbody>
  <actuator><motor name="m" joint="a"/></actuator><sensor><jointpos name="angle" joint="a"/>
  <gyro name="spin" site="tip"/>
  <accelerometer name="felt" site="tip"/><framepos name="where" objtype="site" objname="tip"/>
  <actuatorfrc name="force" actuator="m"/></sensor></mujoco>"""
NOISE = {"angle": 0.001, "spin": 0.01, "felt": 0.05, "where": 0.001, "force": 0.002}


def run(seed, damping=0.05, seconds=6.0, fault=None):
    """A run in stock MuJoCo, rows 10 ms apart, position and sensors with noise. fault(name, columns
    (T, k)): what a sensor shows instead."""
    rng, model = (
        np.random.default_rng(seed),
        mujoco.MjModel.from_xml_string(ARM.format(damping=damping)),
    )
    data, rows = mujoco.MjData(model), int(100 * seconds)
    time, phase = 0.01 * np.arange(rows), rng.uniform(0, 6, 3)
    ctrl = (0.3 * np.sin(np.outer(time, [3, 5, 8]) + phase)).sum(1, keepdims=True)
    qpos, shown = np.empty((rows, 1)), np.empty((rows, model.nsensordata))
    for row in range(rows):
        data.ctrl[:] = ctrl[row]
        qpos[row] = data.qpos
        mujoco.mj_forward(model, data)
        shown[row] = data.sensordata
        mujoco.mj_step(model, data, nstep=5)
    out = {}
    for i in range(model.nsensor):
        name, at = model.sensor(i).name, model.sensor_adr[i]
        columns = shown[:, at : at + model.sensor_dim[i]]
        columns = fault(name, columns) if fault else columns
        out[name] = columns + NOISE[name] * rng.normal(size=columns.shape)
    return Recording(
        f"run{seed}.csv",
        time,
        qpos + 5e-4 * rng.normal(size=qpos.shape),
        np.full((rows, 1), np.nan),
        ctrl,
        out,
    )


def world():
    return World(mujoco.MjSpec.from_string(ARM.format(damping=0.05)))


def faults(fault, settings=None, damping=0.05):
    here = world()
    settings = {here.candidate(*c): v for c, v in (settings or {}).items()}
    runs = [run(k, damping, fault=fault) for k in range(2)]
    return sensor_faults.faults(here, settings, runs, Smoother(here, runs).locate(settings))


def test_errors_are_those_of_stock_mujoco():
    here, recording = world(), run(3, damping=0.2)
    found = sensor_faults.errors(
        here, {here.candidate("viscous_damping", "a"): (0.2,)}, [recording]
    )
    qpos, qvel = windowing.states(here.model, recording)
    for look, damping in (("before", 0.05), ("after", 0.2)):
        model, squares = mujoco.MjModel.from_xml_string(ARM.format(damping=damping)), []
        for first in range(0, 570, 30):
            data = mujoco.MjData(model)
            data.qpos[:], data.qvel[:] = qpos[first], qvel[first]
            for row in range(first + 1, first + 30):  # the last row's control is the next window's
                data.ctrl[:] = recording.ctrl[row - 1]
                mujoco.mj_step(model, data, nstep=5)
                data.ctrl[:] = recording.ctrl[row]
                mujoco.mj_forward(model, data)
                squares.append(
                    [np.mean((data.sensor(n).data - recording.sensors[n][row]) ** 2) for n in found]
                )
        for name, expected in zip(found, np.sqrt(np.mean(squares, 0))):
            assert found[name][look] == pytest.approx(expected, rel=0.02), name
    assert (
        found["spin"]["noise"] == pytest.approx(0.01, rel=0.3) and found["spin"]["unit"] == "rad/s"
    )
    assert found["felt"]["after"] < found["felt"]["before"] and found["where"]["unit"] == "m"


def test_a_sound_sensor_and_a_wrong_model_are_no_faults():
    assert faults(None) == []
    assert faults(None, damping=0.2) == []
    assert sensor_faults.faults(world(), {}, [replace(run(0), sensors={})], None) == []
    assert sensor_faults.errors(world(), {}, [replace(run(0), sensors={})]) == {}
    assert (
        faults(lambda name, x: 1.2 * x if name == "force" else x) == []
    )  # the gain may be wrong, too


@pytest.mark.parametrize(
    "effect, name, value, fault",
    [
        ("sensor_bias", "angle", 0.03, lambda x: x + 0.03),
        ("sensor_scale", "spin", 1.1, lambda x: 1.1 * x),
        ("sensor_delay", "angle", 0.03, lambda x: np.concatenate([x[:1]] * 3 + [x[:-3]])),
        ("sensor_scale", "felt", 0.8, lambda x: 0.8 * x),
    ],
)
def test_a_fault_is_named_with_its_size(effect, name, value, fault):
    (found,) = faults(
        lambda n, x: fault(x) if n == name else x, {("viscous_damping", "a"): (0.2,)}, 0.2
    )
    [p] = found["parameters"]
    assert (found["effect"], found["place"]) == (effect, {"kind": "sensor", "name": name})
    assert (
        p["value"] == pytest.approx(value, rel=0.05)
        and p["low"] < p["value"] < p["high"]
        and found["written_as"] == "measurement"
    )


def test_the_two_quaternions_of_a_rotation_are_one():
    xml = """<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody><body>
        <joint name="a" axis="0 1 0"/><geom size=".1" mass="1"/>
      <site name="s"/></body></worldbody><sensor><framequat name="q" objtype="site" objname="s"/>
      </sensor></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    data, qpos, quat = mujoco.MjData(model), np.empty((400, 1)), np.empty((400, 4))
    data.qvel[:] = 6.0
    for t in range(400):
        mujoco.mj_forward(model, data)
        qpos[t], quat[t] = data.qpos, data.sensordata
        mujoco.mj_step(model, data, 5)
    quat *= np.where(quat[:, :1] < 0, -1, 1)  # as many devices give it
    run = Recording(
        "r.csv",
        0.01 * np.arange(400),
        qpos,
        np.full((400, 1), np.nan),
        np.zeros((400, 0)),
        {"q": quat},
    )
    found = sensor_faults.errors(World(mujoco.MjSpec.from_string(xml)), {}, [run])["q"]
    assert found["before"] < 1e-3 and found["after"] < 1e-3
