"""Position targets for a model that has motors: kp and kd against the torque they stand for."""

import mujoco
import numpy as np
import pytest
from arm import ARM, arm

from diagnosis.command import gain_words
from diagnosis.nominal.model import ModelError, gains_of, load_world, together, with_gains
from diagnosis.recordings.recording import Recording

GEARED = ARM.replace('joint="elbow"', 'joint="elbow" gear="6"')
SERVO = ARM.replace("<motor", '<position kp="20"')


@pytest.mark.parametrize("xml", [ARM, GEARED])
def test_the_torque_is_that_of_a_pd_controller(xml):
    world = with_gains(
        load_world(mujoco.MjSpec.from_string(xml)), {"shoulder": (20, 0.5), "elbow": (4, 0.1)}
    )
    data = mujoco.MjData(world.model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = (0.1, -0.2), (0.3, 0.4), (0.15, -0.1)
    mujoco.mj_forward(world.model, data)
    kp, kd = np.array([20, 4]), np.array([0.5, 0.1])
    np.testing.assert_allclose(data.qfrc_actuator, kp * (data.ctrl - data.qpos) - kd * data.qvel)
    data.ctrl[:] = 50, 50
    mujoco.mj_forward(world.model, data)
    gear = world.model.actuator_gear[:, 0]
    np.testing.assert_allclose(data.qfrc_actuator, gear * [3, 1])  # what the motors can


def test_gains_are_one_number_or_one_for_each_joint():
    model = arm()
    assert gain_words("--kp", None) is None
    assert gain_words("--kp", ["20"]) == 20
    assert gain_words("--kp", ["shoulder=20", "elbow=5"]) == {"shoulder": 20, "elbow": 5}
    assert gains_of({"kp": 20, "kd": None}, model) == {"shoulder": (20, 0), "elbow": (20, 0)}
    assert gains_of({"kp": {"elbow": 5}, "kd": 0.1}, model) == {"elbow": (5, 0.1)}
    assert gains_of({}, model) == {}
    for words in (["20", "30"], ["elbow=5", "30"], ["elbow=x"], ["inf"]):
        with pytest.raises(ModelError, match="--kp.*one number, or joint=number"):
            gain_words("--kp", words)
    for given, says in (
        ({"kd": 1}, "--kd without --kp"),
        ({"kp": {"wrist": 1}}, "'wrist' has no motor"),
        ({"kp": -1}, "negative"),
        ({"kp": {"elbow": 1}, "kd": {"shoulder": 1}}, "'shoulder' has no --kp"),
    ):
        with pytest.raises(ModelError, match=says):
            gains_of(given, model)
    with pytest.raises(ModelError, match="position servos, with gains of their own"):
        gains_of({"kp": 20}, mujoco.MjModel.from_xml_string(SERVO))


def test_gains_in_files_must_agree():
    def recorded(name, kp):
        return Recording(name, None, None, None, None, gains={"elbow": {"kp": kp}})

    one, other = recorded("a.csv", 5.0), recorded("b.csv", 6.0)
    assert together({}, [one, one]) == {"elbow": (5, 0)}
    with pytest.raises(ModelError, match="b.csv: kp 6.*a.csv says 5.*one gain at a time"):
        together({}, [one, other])
    with pytest.raises(ModelError, match="a.csv: kp 5.*--kp and --kd say 4"):
        together({"elbow": (4.0, 0.0)}, [one])
