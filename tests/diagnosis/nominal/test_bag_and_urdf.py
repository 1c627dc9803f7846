"""What a newcomer has: ROS 2 bags and a URDF. One command makes the report, in their formats."""

import json

import mujoco
import numpy as np
from bags import joint_state, write_bag

from diagnosis import command
from diagnosis.nominal.urdf import urdf_spec

PENDULUM = """<robot name="pendulum"><link name="stand"/><link name="rod"><inertial>
  <origin xyz="0 0 -.2"/><mass value="0.5"/>
  <inertia ixx=".004" iyy=".004" izz=".0004" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="pivot" type="revolute"><parent link="stand"/><child link="rod"/><axis xyz="0 1 0"/>
  <limit lower="-3" upper="3" effort="2" velocity="20"/><dynamics damping="0.01"/></joint>
  </robot>"""
HIDDEN = 0.08  # N·m of Coulomb friction
FINE = 'frictionloss="0.08" solreffriction="0.004 1" solimpfriction="0.999 0.9999 0.001"'


def swings(path, seed, kp=None, kd=0.0):
    """A bag of a pendulum that has friction, with the torque on it as effort, or targets it
    follows."""
    xml = urdf_spec(path).to_xml().replace("<joint ", f"<joint {FINE} ", 1)
    model = mujoco.MjModel.from_xml_string(xml)
    data, rng, states, goals = mujoco.MjData(model), np.random.default_rng(seed), [], []
    phase = rng.uniform(0, 2 * np.pi, 3)
    for row in range(400):
        wave = np.sin(2 * np.pi * 0.01 * row * np.array([0.4, 0.9, 1.7]) + phase) @ [0.5, 0.4, 0.3]
        shown = data.qpos + rng.normal(size=1) * 2e-4
        stamp = 10**18 + row * 10**7
        effort = [] if kp else [wave]
        states.append((row * 10**7, joint_state(stamp, ["pivot"], shown, [], effort)))
        goals.append((row * 10**7, joint_state(stamp, ["pivot"], [wave], [], [])))
        for _ in range(5):
            data.ctrl[0] = kp * (wave - data.qpos[0]) - kd * data.qvel[0] if kp else wave
            mujoco.mj_step(model, data)
    topics = {"/joint_states": states, **({"/goal": goals} if kp else {})}
    return topics


def made(tmp_path, *more, **gains):
    """diagnosis.json of a URDF and two bags, and the folder of the report."""
    path = str(tmp_path / "pendulum.urdf")
    (tmp_path / "pendulum.urdf").write_text(PENDULUM)
    bags = [
        str(write_bag(tmp_path / f"bag{seed}", swings(path, seed, **gains), storage))
        for seed, storage in ((0, "mcap"), (1, "sqlite3"))
    ]
    out = tmp_path / "report"
    argv = ["--model", path, "--recordings", *bags, "--out", str(out), *more]
    assert command.main(argv) == 0
    return json.loads((out / "diagnosis.json").read_text()), out


def friction(summary):
    [finding] = summary["findings"]
    assert (finding["effect"], finding["place"]["name"]) == ("coulomb_friction", "pivot")
    return finding["parameters"][0]["value"]


def test_bags_of_torques(tmp_path, capsys):
    summary, out = made(tmp_path, "--write-urdf")
    assert abs(friction(summary) - HIDDEN) < 0.1 * HIDDEN
    (tmp_path / "again").mkdir()
    text = (out / "corrected.urdf").read_text()
    (tmp_path / "again" / "pendulum.urdf").write_text(text)
    model = urdf_spec(str(tmp_path / "again" / "pendulum.urdf")).compile()
    np.testing.assert_allclose(model.dof_frictionloss[0], friction(summary), rtol=1e-6)
    assert "corrected.urdf" in capsys.readouterr().out


def test_bags_of_targets(tmp_path):
    (tmp_path / "map.toml").write_text('[ros]\ntargets = "/goal"\n')
    argv = ("--map", str(tmp_path / "map.toml"), "--kp", "4", "--kd", "0.1")
    summary, _ = made(tmp_path, *argv, kp=4.0, kd=0.1)
    assert abs(friction(summary) - HIDDEN) < 0.1 * HIDDEN
