"""Models and recordings as others write them: frames, tendons, passive actuators, sensors that stand still, loggers' habits."""
import os
import sys

import mujoco
import numpy as np
import pytest

sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
import diagnose
import recordings
import windows as cut
from leftover import _variable
from unknown import drives
from windows import difference_noise
from world import World

FRAMES = """<mujoco><worldbody>
  <frame pos="0 0 .1" euler="0 90 0"><geom name="bar" type="box" size=".5 .5 .5" pos=".6 0 0"/></frame>
  <geom name="rail" type="capsule" fromto="0 -1 -2 0 1 -2" size=".1"/>
  <frame pos="0 0 1" euler="0 30 0"><body name="a"><joint name="ja" axis="0 1 0"/><geom size=".03" mass="1"/>
    <frame pos="0 0 -.3" euler="20 0 0"><body name="b" pos="0 .05 -.02"><frame euler="0 0 40"><joint name="jb" axis="0 1 0"/></frame>
      <geom type="capsule" size=".02 .1" pos="0 0 -.1"/></body></frame></body></frame>
</worldbody><actuator><motor name="mb" joint="jb"/></actuator></mujoco>"""


def corrected(world, effect, place, *values):
    xml, written = world.corrected_xml({world.candidate(effect, place): values})
    return mujoco.MjModel.from_xml_string(xml), *written.values()


def test_what_stands_in_frames_is_written_where_it_is_simulated():
    world = World(mujoco.MjSpec.from_string(FRAMES))
    nominal = world.model
    for geom in ("bar", "rail"):
        position = nominal.geom(geom).pos
        model, _ = corrected(world, "ground_height", geom, position[2] + 0.02)
        np.testing.assert_allclose(model.geom(geom).pos, position + [0, 0, 0.02], atol=1e-6)
    length = np.linalg.norm(nominal.body("b").pos)
    model, _ = corrected(world, "link_length", "b", 1.1 * length)
    np.testing.assert_allclose(model.body("b").pos, 1.1 * nominal.body("b").pos, atol=1e-6)
    model, _ = corrected(world, "backlash", "jb", 0.02)
    np.testing.assert_allclose(model.joint("backlash:jb").axis, nominal.joint("jb").axis, atol=1e-6)


@pytest.mark.parametrize("units", ["degree", "radian"])
@pytest.mark.parametrize("own", ["degree", "radian"])
def test_an_attached_robot_keeps_its_own_units(units, own, tmp_path):
    """Of files in degrees and in radians, one in the other."""
    turn = {"degree": 90, "radian": np.pi / 2}[own]
    (tmp_path / "robot.xml").write_text(f"""<mujoco><compiler angle="{own}"/><worldbody><body name="link"><joint name="j" axis="0 1 0"
        range="{-turn} {turn}" stiffness="1"/><geom size=".1" mass="1"/></body></worldbody></mujoco>""")
    (tmp_path / "scene.xml").write_text(f"""<mujoco><compiler angle="{units}"/><asset><model name="robot" file="robot.xml"/></asset>
        <worldbody><attach model="robot" body="link" prefix="x_"/></worldbody></mujoco>""")
    world = World.load(tmp_path / "scene.xml")
    np.testing.assert_allclose(corrected(world, "joint_stop", "x_j", -0.3, 0.4)[0].joint("x_j").range, (-0.3, 0.4), atol=1e-6)
    np.testing.assert_allclose(corrected(world, "spring_offset", "x_j", 0.1)[0].qpos_spring, 0.1, atol=1e-6)
    np.testing.assert_allclose(corrected(world, "sensor_bias", "x_j", 0.05)[0].qpos0, 0.05, atol=1e-6)


def test_a_biased_sensor_whose_joint_a_tendon_reads_is_not_written():
    tendon = FRAMES.replace("<actuator>", '<tendon><fixed name="t"><joint joint="jb" coef="1"/></fixed></tendon><actuator>')
    assert corrected(World(mujoco.MjSpec.from_string(FRAMES)), "sensor_bias", "jb", 0.05)[1] == "mjcf"
    assert corrected(World(mujoco.MjSpec.from_string(tendon)), "sensor_bias", "jb", 0.05)[1] == "measurement"


PENDULUM = """<mujoco><worldbody><body><joint name="j" axis="0 1 0" damping=".05"/><geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02"/></body>
  <body pos="1 0 0"><joint name="k" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02"/></body></worldbody>
  <tendon><fixed name="t"><joint joint="k" coef="1"/></fixed></tendon>
  <actuator><motor name="pull" tendon="t"/></actuator></mujoco>"""


def test_a_corrected_model_can_be_diagnosed_again(tmp_path):
    """Its Stribeck friction is an actuator with a state and without a control, and is not looked for a second time."""
    world = World(mujoco.MjSpec.from_string(PENDULUM))
    xml, _ = world.corrected_xml({world.candidate("stribeck_friction", "j"): (0.05, 0.1, 0.2)})
    (tmp_path / "again.xml").write_text(xml)
    again = World.load(tmp_path / "again.xml")
    assert ("stribeck_friction", "j") not in {(c.effect.name, c.place.name) for c in again.candidates}
    time = np.arange(300) * 0.01
    run = recordings.Recording("run", time, np.stack([np.cos(3 * time), 0.5 * np.cos(3 * time)], 1), np.full((300, 2), np.nan), np.zeros((300, 1)))
    some = cut.consecutive(run, 0.3)
    qpos, _ = again.simulate([{}] * len(some), *cut.recorded_starts(again.model, some), some)
    assert np.isfinite(qpos[:, :10]).all()


def test_drives_are_the_actuators_of_a_joint():
    """A tendon's number is not a joint's."""
    model = mujoco.MjModel.from_xml_string(PENDULUM.replace("<actuator>", '<actuator><position name="servo" joint="k"/>'))
    assert drives(model, 0) == [] and drives(model, 1) == [0]


def test_controls_of_actuators_after_a_passive_one():
    passive = PENDULUM.replace("<actuator>", '<actuator><dcmotor name="brake" joint="j" motorconst="0.05" resistance="2" input="none"/>')
    model, ctrl = mujoco.MjModel.from_xml_string(passive), np.arange(3.0)[:, None]
    assert model.nactuator == 2 and model.nu == 1
    values, *_ = _variable(model, "control:pull", None, None, None, None, ctrl)
    assert (values == ctrl[:, 0]).all()


def test_noise_of_a_reading_that_stands_still():
    assert np.isinf(difference_noise(np.full(500, 0.3)))
    steps = np.repeat(np.arange(20), 50) * 0.01  # an encoder at slow speed
    assert difference_noise(steps) == pytest.approx(0.01 / np.sqrt(12))


def csv(path, rows):
    lines = ["time,qpos:j,qpos:k,ctrl:pull"] + [f"{t},{a},{b},{u}" for t, a, b, u in rows]
    path.write_text("\n".join(lines) + "\n")
    return str(path)


def test_the_last_row_needs_no_control(tmp_path):
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    time = np.arange(100) * 0.01
    rows = [(t, np.sin(t), np.sin(2 * t), "" if i == 99 else np.cos(t)) for i, t in enumerate(time)]
    [run] = recordings.load([csv(tmp_path / "run.csv", rows)], model)
    assert run.ctrl[99, 0] == run.ctrl[98, 0]
    rows[50] = (*rows[50][:3], "")
    with pytest.raises(recordings.RecordingError, match="row 52"):
        recordings.load([csv(tmp_path / "run.csv", rows)], model)


def test_recordings_to_fit_that_stand_still(tmp_path, capfd):
    (tmp_path / "model.xml").write_text(PENDULUM)
    time = np.arange(300) * 0.01
    still = csv(tmp_path / "still.csv", [(t, 0.3, 0.3, 0) for t in time])
    moves = csv(tmp_path / "moves.csv", [(t, np.sin(3 * t), np.sin(2 * t), 0) for t in time])
    status = diagnose.main(["--model", str(tmp_path / "model.xml"), "--recordings", still, "--held-out", moves, "--out", str(tmp_path / "out")])
    assert status == 2 and "nothing moves" in capfd.readouterr().err
