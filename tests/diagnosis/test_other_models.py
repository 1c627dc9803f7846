"""Models and recordings as others write them: frames, tendons, passive actuators, sensors that
stand still, loggers' habits."""

import mujoco
import numpy as np
import pytest

from diagnosis import command as diagnose
from diagnosis.estimation import windowing
from diagnosis.estimation.ahead import Ahead, cut_ahead
from diagnosis.estimation.readings import difference_noise, measurement_noise
from diagnosis.estimation.smoother import Smoother
from diagnosis.recordings import recording
from diagnosis.recordings.inverse_dynamics import course_of
from diagnosis.simulation.simulator import World

FRAMES = """<mujoco><worldbody>
  <frame pos="0 0 .1" euler="0 90 0"><geom name="bar" type="box" size=".5 .5 .5" pos=".6 0
  0"/></frame>
  <geom name="rail" type="capsule" fromto="0 -1 -2 0 1 -2" size=".1"/>
  <frame pos="0 0 1" euler="0 30 0"><body name="a"><joint name="ja" axis="0 1 0"/><geom size=".03"
  mass="1"/>
    <frame pos="0 0 -.3" euler="20 0 0"><body name="b" pos="0 .05 -.02"><frame euler="0 0 40"><joint
    name="jb" axis="0 1 0"/></frame>
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
    (
        tmp_path / "robot.xml"
    ).write_text(f"""<mujoco><compiler angle="{own}"/><worldbody><body name="link"><joint name="j"
    axis="0 1 0"
        range="{-turn} {turn}" stiffness="1"/><geom size=".1"
        mass="1"/></body></worldbody></mujoco>""")
    (
        tmp_path / "scene.xml"
    ).write_text(f"""<mujoco><compiler angle="{units}"/><asset><model name="robot"
    file="robot.xml"/></asset>
        <worldbody><attach model="robot" body="link" prefix="x_"/></worldbody></mujoco>""")
    world = World.load(tmp_path / "scene.xml")
    np.testing.assert_allclose(
        corrected(world, "joint_stop", "x_j", -0.3, 0.4)[0].joint("x_j").range,
        (-0.3, 0.4),
        atol=1e-6,
    )
    np.testing.assert_allclose(
        corrected(world, "spring_offset", "x_j", 0.1)[0].qpos_spring, 0.1, atol=1e-6
    )
    np.testing.assert_allclose(
        corrected(world, "sensor_bias", "x_j", 0.05)[0].qpos0, 0.05, atol=1e-6
    )


def test_a_biased_sensor_whose_joint_a_tendon_reads_is_not_written():
    tendon = FRAMES.replace(
        "<actuator>",
        '<tendon><fixed name="t"><joint joint="jb" coef="1"/></fixed></tendon><actuator>',
    )
    assert (
        corrected(World(mujoco.MjSpec.from_string(FRAMES)), "sensor_bias", "jb", 0.05)[1] == "mjcf"
    )
    assert (
        corrected(World(mujoco.MjSpec.from_string(tendon)), "sensor_bias", "jb", 0.05)[1]
        == "measurement"
    )


PENDULUM = """<mujoco><worldbody><body><joint name="j" axis="0 1 0" damping=".05"/><geom
type="capsule" fromto="0 0 0 0 0 -.5" size=".02"/></body>
  <body pos="1 0 0"><joint name="k" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.5"
  size=".02"/></body></worldbody>
  <tendon><fixed name="t"><joint joint="k" coef="1"/></fixed></tendon>
  <actuator><motor name="pull" tendon="t"/></actuator></mujoco>"""


def test_a_corrected_model_can_be_diagnosed_again(tmp_path):
    """Its presliding is an actuator with a state and without a control, and is not looked for a
    second time."""
    world = World(mujoco.MjSpec.from_string(PENDULUM))
    xml, _ = world.corrected_xml({world.candidate("presliding", "j"): (0.05, 2.0)})
    (tmp_path / "again.xml").write_text(xml)
    again = World.load(tmp_path / "again.xml")
    assert ("presliding", "j") not in {(c.effect.name, c.place.name) for c in again.candidates}
    time = np.arange(300) * 0.01
    run = recording.Recording(
        "run",
        time,
        np.stack([np.cos(3 * time), 0.5 * np.cos(3 * time)], 1),
        np.full((300, 2), np.nan),
        np.zeros((300, 1)),
    )
    some = windowing.consecutive(run, 0.3)
    qpos, _ = again.simulate([{}] * len(some), *windowing.recorded_starts(again.model, some), some)
    assert np.isfinite(qpos[:, :10]).all()


def test_controls_of_actuators_after_a_passive_one():
    passive = PENDULUM.replace(
        "<actuator>",
        '<actuator><dcmotor name="brake" joint="j" motorconst="0.05" resistance="2" input="none"/>',
    )
    model, ctrl = mujoco.MjModel.from_xml_string(passive), np.arange(3.0)[:, None]
    assert model.nactuator == 2 and model.nu == 1
    values, *_ = course_of(model, "control:pull", None, None, None, ctrl)
    assert (values == ctrl[:, 0]).all()


def test_noise_of_a_reading_that_stands_still():
    assert np.isinf(difference_noise(0.01 * np.arange(500), np.full(500, 0.3)))
    steps = np.repeat(np.arange(20), 50) * 0.01  # an encoder at slow speed
    assert difference_noise(0.01 * np.arange(1000), steps) == pytest.approx(0.01 / np.sqrt(12))


def csv(path, rows):
    lines = ["time,qpos:j,qpos:k,ctrl:pull"] + [f"{t},{a},{b},{u}" for t, a, b, u in rows]
    path.write_text("\n".join(lines) + "\n")
    return str(path)


def test_the_last_row_needs_no_control(tmp_path):
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    time = np.arange(100) * 0.01
    rows = [(t, np.sin(t), np.sin(2 * t), "" if i == 99 else np.cos(t)) for i, t in enumerate(time)]
    [run] = recording.load([csv(tmp_path / "run.csv", rows)], model)
    assert run.ctrl[99, 0] == run.ctrl[98, 0]
    rows[50] = (*rows[50][:3], "")
    with pytest.raises(recording.RecordingError, match="row 52"):
        recording.load([csv(tmp_path / "run.csv", rows)], model)


def test_a_header_quoted_after_spaces(tmp_path):
    path = csv(
        tmp_path / "run.csv", [(t, np.sin(t), np.sin(2 * t), 0.0) for t in np.arange(100) * 0.01]
    )
    text = (
        (tmp_path / "run.csv")
        .read_text()
        .replace("time,qpos:j,qpos:k,ctrl:pull", '"time", "qpos:j", "qpos:k", "ctrl:pull"')
    )
    (tmp_path / "run.csv").write_text(text)
    [run] = recording.load([path], mujoco.MjModel.from_xml_string(PENDULUM))
    assert run.qpos[50, 1] == pytest.approx(np.sin(1.0))


def test_recordings_to_fit_that_stand_still(tmp_path, capfd):
    (tmp_path / "model.xml").write_text(PENDULUM)
    time = np.arange(300) * 0.01
    still = csv(tmp_path / "still.csv", [(t, 0.3, 0.3, 0) for t in time])
    moves = csv(tmp_path / "moves.csv", [(t, np.sin(3 * t), np.sin(2 * t), 0) for t in time])
    status = diagnose.main(
        [
            "--model",
            str(tmp_path / "model.xml"),
            "--recordings",
            still,
            "--held-out",
            moves,
            "--out",
            str(tmp_path / "out"),
        ]
    )
    assert status == 2 and "nothing moves" in capfd.readouterr().err


# ---- what a model's author left to the compiler ------------------------------------------------

TWO = """<mujoco><option timestep="0.002"/><worldbody><geom name="floor" type="plane" size="2 2
.1"/><body name="a" pos="0 0 1"><joint name="j" axis="0 1 0" {joint}/>
  <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="1" contype="0"/><body name="b" pos="0
  0 -.3"><joint name="k" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="1"
  contype="0"/></body></body></worldbody>
  <actuator><{actuator} joint="k"/></actuator><keyframe><key qpos="0.1 0.2"/></keyframe></mujoco>"""
TWO_AXES = 'motor name="m"'
BOX = """<mujoco><option timestep="{}"/><worldbody><geom name="floor" type="plane" size="2 2 .1"
friction="{}"/><body name="box" pos="0 0 .1">
  <freejoint name="f"/><geom name="box" type="box" size=".1 .1 .1" mass="1"
  friction="0.5"/></body></worldbody></mujoco>"""


def same_motion(world, setting, qpos, qvel, seconds=0.4):
    """Largest difference between World's simulation of a setting and its corrected.xml in stock
    MuJoCo."""
    time = np.arange(round(seconds / 0.01)) * 0.01
    held = np.full((len(time), world.model.nu), 0.3)
    run = recording.Recording(
        "run",
        time,
        np.zeros((len(time), world.model.nq)),
        np.zeros((len(time), world.model.nv)),
        held,
    )
    here = world.simulate(
        [setting], np.array([qpos]), np.array([qvel]), [windowing.Window(run, 0, len(time) - 1)]
    )[0][0]
    model = mujoco.MjModel.from_xml_string(world.corrected_xml(setting)[0])
    data, there = mujoco.MjData(model), []
    data.qpos[:], data.qvel[:], data.ctrl[:], data.act[:] = qpos, qvel, 0.3, 0.3
    for a in np.flatnonzero(model.actuator_delay):  # at rest in the first control
        past = -model.opt.timestep * np.arange(model.actuator_history[a, 0], 0, -1)
        mujoco.mj_initCtrlHistory(model, data, a, past, np.full(len(past), 0.3))
    for _ in time:
        there.append(data.qpos.copy())
        mujoco.mj_step(model, data, round(0.01 / model.opt.timestep))
    return np.abs(here - there).max()


@pytest.mark.parametrize(
    "joint, actuator", [("", 'position kp="20" dampratio="1"'), ('springdamper="0.5 1"', TWO_AXES)]
)
def test_gains_that_the_compiler_works_out_stay_as_they_were(joint, actuator):
    world = World(mujoco.MjSpec.from_string(TWO.format(joint=joint, actuator=actuator)))
    servo = world.model.actuator(0).name
    for effect, place, factor in (
        ("mass", "b", 2.0),
        ("gain", servo, 1.5),
        ("armature", "k", None),
        ("viscous_damping", "j", None),
    ):
        candidate = world.candidate(effect, place)
        value = factor * candidate.nominal[0] if factor else 0.1
        assert same_motion(world, {candidate: (value,)}, [0.3, -0.2], [0.5, 0.0]) < 1e-6, effect


@pytest.mark.parametrize("seconds", [0.0, 0.001, 0.01, 0.05])
def test_another_delay_than_the_models_own(seconds):
    world = World(
        mujoco.MjSpec.from_string(
            TWO.format(joint="", actuator='general name="m" delay="0.02" nsample="10"')
        )
    )
    model, form = corrected(world, "delay", "m", seconds)
    if 0 < seconds < model.opt.timestep:  # which MuJoCo would make a whole step
        assert form == "python" and model.actuator_delay[0] == 0
        return
    assert form == "mjcf" and model.actuator_delay[0] == seconds
    assert (
        same_motion(world, {world.candidate("delay", "m"): (seconds,)}, [0.3, -0.2], [0.5, 0.0])
        < 1e-3
    )


def test_keyframes_keep_their_poses():
    world = World(mujoco.MjSpec.from_string(TWO.format(joint="", actuator=TWO_AXES)))
    model, _ = corrected(world, "backlash", "k", 0.02)
    assert [model.key_qpos[0, model.joint(n).qposadr[0]] for n in ("j", "k", "backlash:k")] == [
        0.1,
        0.2,
        0.0,
    ]
    driven = World(
        mujoco.MjSpec.from_string(
            TWO.format(joint="", actuator=TWO_AXES).replace('joint="k"/></act', 'joint="j"/></act')
        )
    )
    model, _ = corrected(driven, "backlash", "j", 0.02)  # its joint comes between the two
    assert [model.key_qpos[0, model.joint(n).qposadr[0]] for n in ("j", "k", "backlash:j")] == [
        0.1,
        0.2,
        0.0,
    ]
    np.testing.assert_allclose(
        corrected(world, "sensor_bias", "k", 0.05)[0].key_qpos[0], [0.1, 0.25]
    )


def test_two_things_wrong_with_a_contact_one_at_each_geom():
    world = World(mujoco.MjSpec.from_string(BOX.format(0.002, 0.5)))
    friction, stiffness = (
        world.candidate("contact_friction", "floor"),
        world.candidate("contact_stiffness", "box"),
    )
    setting = {friction: (0.2,), stiffness: (3 * stiffness.nominal[0],)}
    start = [0, 0, 0.12, 1, 0, 0, 0], [2.0, 0, 0, 0, 0, 0]
    assert same_motion(world, setting, *start) < 1e-6
    slid = lambda s: same_motion(world, s, *start)
    assert slid({friction: (0.2,)}) < 1e-6 and slid({stiffness: setting[stiffness]}) < 1e-6


def test_contacts_stiffer_than_a_step_can_carry():
    coarse = World(
        mujoco.MjSpec.from_string(BOX.format(0.02, 0.5))
    )  # MuJoCo makes the default 0.02 s two steps long
    assert coarse.candidate("contact_stiffness", "box").nominal[0] == pytest.approx(1 / 0.04**2)


def test_friction_where_the_model_has_none():
    world = World(
        mujoco.MjSpec.from_string(BOX.format(0.002, 0).replace('friction="0.5"', 'friction="0"'))
    )
    [sliding] = world.candidate("contact_friction", "box").parameters
    assert sliding.low <= sliding.nominal == 0 < sliding.step
    assert all(value > 0 for (value,) in world.far(world.candidate("contact_friction", "box"), []))


def test_moments_that_did_not_show_move_along_in_the_file():
    world = World(mujoco.MjSpec.from_string(TWO.format(joint="", actuator=TWO_AXES)))
    inertia = world.candidate("inertia", "a")
    x, y, z = inertia.nominal
    assert inertia.effect.possible(
        (x, 1.5 * y, z), inertia.nominal
    ) and not inertia.effect.possible((1.01 * x, 1.5 * y, 1.01 * z), inertia.nominal)
    moments = corrected(world, "inertia", "a", x, 1.5 * y, z)[0].body("a").inertia
    assert moments[1] == 1.5 * y and 2 * moments.max() <= moments.sum()
    assert corrected(world, "inertia", "a", 1.01 * x, 1.5 * y, 1.01 * z)[1] == "none"
    assert same_motion(world, {inertia: (x, 1.5 * y, z)}, [0.3, -0.2], [0.5, 0.0]) < 1e-6


def test_a_dead_zone_beside_a_total_mass():
    world = World(
        mujoco.MjSpec.from_string(
            TWO.format(joint="", actuator=TWO_AXES).replace(
                "<option", '<compiler settotalmass="3"/><option'
            )
        )
    )
    model, form = corrected(world, "dead_zone", "m", 0.1)
    assert form == "python" and model.body("a").mass + model.body("b").mass == pytest.approx(3.0)


def test_a_force_range_that_is_not_symmetric_keeps_its_shape():
    world = World(
        mujoco.MjSpec.from_string(TWO.format(joint="", actuator='motor name="m" forcerange="-1 2"'))
    )
    assert world.candidate("saturation", "m").nominal == (2.0,)
    np.testing.assert_allclose(
        corrected(world, "saturation", "m", 0.5)[0].actuator_forcerange[0], [-0.25, 0.5]
    )
    assert (
        same_motion(world, {world.candidate("saturation", "m"): (0.2,)}, [0.3, -0.2], [0.5, 0.0])
        < 1e-6
    )


def test_effects_where_a_motor_turns_a_free_body():
    thrust = """<actuator><motor name="up" joint="f" gear="0 0 1 0 0 0"/>
        <position name="p" joint="f" gear="0 0 1 0 0 0" kp="3"/></actuator></mujoco>"""
    world = World(mujoco.MjSpec.from_string(BOX.format(0.002, 0.5).replace("</mujoco>", thrust)))
    own = [c for c in world.candidates if c.place.kind == "actuator"]
    assert all(np.isfinite([p.low, p.step]).all() and p.step for c in own for p in c.parameters)
    assert ("dead_zone", "p") not in {(c.effect.name, c.place.name) for c in own}
    assert corrected(world, "dead_zone", "up", 0.1)[1] == "python"


def test_a_muscles_joint_is_not_given_another_zero():
    muscle = 'muscle name="m" lengthrange="-1 1"'
    world = World(mujoco.MjSpec.from_string(TWO.format(joint="", actuator=muscle)))
    assert corrected(world, "sensor_bias", "k", 0.05)[1] == "measurement"
    assert corrected(world, "sensor_bias", "j", 0.05)[1] == "mjcf"


@pytest.mark.parametrize(
    "actuator, field",
    [
        ('position name="m" kp="20" inheritrange="0.9"', "ctrlrange"),
        ('intvelocity name="m" kp="20" inheritrange="0.9"', "actrange"),
    ],
)
def test_a_range_that_was_inherited_stays_as_it_was(actuator, field):
    world = World(
        mujoco.MjSpec.from_string(
            TWO.format(joint="", actuator=actuator).replace('name="k"', 'name="k" range="-60 60"')
        )
    )
    for effect, values in (("joint_stop", (-0.3, 0.5)), ("sensor_bias", (0.1,))):
        model, form = corrected(world, effect, "k", *values)
        nominal = getattr(world.model, f"actuator_{field}")
        assert form == "mjcf" and nominal[0, 1] == pytest.approx(0.9 * np.deg2rad(60))
        np.testing.assert_allclose(getattr(model, f"actuator_{field}"), nominal)


def test_another_zero_of_a_joint_without_limits():
    xml = TWO.format(joint="", actuator=TWO_AXES).replace(
        "<option", '<compiler autolimits="false"/><option'
    )
    world = World(mujoco.MjSpec.from_string(xml))
    assert corrected(world, "sensor_bias", "j", 0.1)[1] == "mjcf"
    both = {
        world.candidate("joint_stop", "j"): (-0.5, 0.5),
        world.candidate("sensor_bias", "j"): (0.1,),
    }
    model = mujoco.MjModel.from_xml_string(world.corrected_xml(both)[0])
    np.testing.assert_allclose(model.joint("j").range, [-0.4, 0.6])


def test_a_corrected_model_may_lack_another_force():
    world, xml = World(mujoco.MjSpec.from_string(TWO.format(joint="", actuator=TWO_AXES))), None
    for names in ({"unknown:j"}, {"unknown:j", "unknown:j:2"}):
        curve = world.curve("j", "velocity:j", np.array([-1.0, 0.0, 1.0]))
        xml, written = world.corrected_xml({curve: (0.3, 0.1, -0.1)})
        world = World(mujoco.MjSpec.from_string(xml))
        assert list(written.values()) == ["mjcf"] and names <= {
            a.name for a in world.spec.actuators
        }


@pytest.mark.parametrize(
    "joint, transmission, unit",
    [
        ("hinge", "joint", "N·m"),
        ("hinge", "jointinparent", "N·m"),
        ("ball", "joint", "N·m"),
        ("slide", "joint", "N"),
    ],
)
def test_the_unit_of_a_motors_force(joint, transmission, unit):
    world = World(
        mujoco.MjSpec.from_string(f'''<mujoco><worldbody><body><joint name="j" type="{joint}"/>
            <geom size=".1"/></body></worldbody>
      <actuator><motor name="m" {transmission}="j" ctrlrange="-1 1"/></actuator></mujoco>''')
    )
    assert world.candidate("saturation", "m").parameters[0].unit == unit


# ---- holes and constants -----------------------------------------------------------------------


def tumbling(rows=300, seed=0):
    """A free body that turns about all axes: model, Recording with noise of 1 mm and 2 mrad."""
    model = mujoco.MjModel.from_xml_string(
        BOX.format(0.002, 0.5).replace('pos="0 0 .1"', 'pos="0 0 9"')
    )
    data, rng, qpos = mujoco.MjData(model), np.random.default_rng(seed), np.empty((rows, 7))
    data.qvel[:] = 0.3, 0.2, 1.0, 2.0, 1.0, -1.5
    for t in range(rows):
        qpos[t] = data.qpos
        mujoco.mj_integratePos(model, qpos[t], rng.normal(size=6) * np.repeat([1e-3, 2e-3], 3), 1.0)
        mujoco.mj_step(model, data, 2)
    return model, recording.Recording(
        "run", 0.004 * np.arange(rows), qpos, np.full((rows, 6), np.nan), np.zeros((rows, 0))
    )


def test_a_lost_rotation_does_not_silence_the_others():
    model, run = tumbling()
    run.qpos[[0, 40], 3:] = np.nan
    noise = measurement_noise(model, [run])[0]
    np.testing.assert_allclose(noise, np.repeat([1e-3, 2e-3], 3), rtol=0.3)


def test_a_component_that_stands_still_does_not_silence_its_channel():
    model, run = tumbling()
    run.qpos[:, 2] = 0.1
    np.testing.assert_allclose(
        measurement_noise(model, [run])[0], np.repeat([1e-3, 2e-3], 3), rtol=0.3
    )


def test_a_hole_across_which_the_quaternion_turns_its_sign():
    model, run = tumbling()
    whole = windowing.states(model, run)
    run.qpos[100:110, 3:] = np.nan
    run.qpos[110:, 3:] *= -1
    qpos, qvel = windowing.states(model, run)
    assert np.abs(windowing.difference(model, whole[0], qpos)).max() < 0.02
    assert np.abs((whole[1] - qvel)[[99, 110], 3:]).max() < 1.0


def test_a_joint_read_once_is_a_joint_that_was_not_measured():
    world = World(mujoco.MjSpec.from_string(TWO.format(joint="", actuator=TWO_AXES)))
    time = np.arange(300) * 0.01
    qpos = np.stack([0.3 * np.sin(2 * time), np.full(300, np.nan)], 1)
    qpos[0, 1] = 0.2
    run = recording.Recording("run", time, qpos, np.full((300, 2), np.nan), np.zeros((300, 1)))
    smoother = Smoother(world, [run])
    smoother.locate({}, passes=1)
    assert np.isfinite(smoother.position_noise[0]) and np.isinf(smoother.position_noise[1])
    ahead = Ahead(world, cut_ahead([run]), smoother.position_noise)
    assert ahead.known[..., 0].any() and not ahead.known[..., 1].any()


def test_an_offset_and_an_unnamed_force_in_a_joint_with_a_spring():
    world = World(
        mujoco.MjSpec.from_string(
            TWO.format(joint='stiffness="2" springref="10"', actuator=TWO_AXES)
        )
    )
    curve = world.curve("j", "position:j", np.linspace(-1, 1, 9))
    setting = {
        world.candidate("spring_offset", "j"): (0.4,),
        curve: tuple(-1.5 * np.linspace(-1, 1, 9)),
    }
    assert set(world.corrected_xml(setting)[1].values()) == {"mjcf"}
    assert same_motion(world, setting, [0.1, 0.2], [0.0, 0.0]) < 1e-3
