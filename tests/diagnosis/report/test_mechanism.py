"""Pictures of a mechanism: outlines where the kinematics put them, motion as MuJoCo makes it."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from arm import ARM, arm
from report_example import recordings

from diagnosis.recordings import inverse_dynamics
from diagnosis.recordings.recording import Recording
from diagnosis.report import mechanism, outlines, overlay, sections


def test_hull_against_area_of_known_shapes():
    rng = np.random.default_rng(0)
    square = np.concatenate([rng.uniform(0, 1, (200, 2)), [[0, 0], [1, 0], [1, 1], [0, 1]]])
    corners = outlines.hull(square)
    assert sorted(map(tuple, corners)) == [(0, 0), (0, 1), (1, 0), (1, 1)]


def test_planar_mechanisms_are_seen_along_their_hinges():
    axes, towards = outlines.view(arm(), np.zeros(2))
    np.testing.assert_allclose(axes, [[1, 0, 0], [0, 0, 1]], atol=1e-12)  # x to the right, z up
    np.testing.assert_allclose(towards, [0, -1, 0], atol=1e-12)


def test_outline_of_a_rod_lies_where_the_kinematics_put_it():
    model = arm()
    axes, towards = outlines.view(model, np.zeros(2))
    angle = 0.7
    shapes = {
        g: outline
        for g, outline, _ in outlines.outlines(model, np.array([angle, 0.0]), axes, towards)
    }
    tip = -0.55 * np.array(
        [np.sin(angle), np.cos(angle)]
    )  # both rods in line: 0.3 + 0.25 m from the shoulder
    far = shapes[1][np.argmax(np.linalg.norm(shapes[1], axis=1))]
    assert abs(np.linalg.norm(far) - 0.565) < 1e-3 and np.linalg.norm(far - tip) < 0.02


def test_motion_starts_as_recorded_and_follows_stock_mujoco():
    model, recording = arm(), recordings(1, 3)[0]
    columns = overlay.columns_in(model, model)
    got = overlay.simulate(model, recording, 20, 60, columns)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = recording.qpos[20], recording.qvel[20]
    for row in range(20, 60):
        np.testing.assert_allclose(got[row - 20], data.qpos, atol=1e-9)
        data.ctrl[:] = recording.ctrl[row]
        mujoco.mj_step(model, data, nstep=5)


@pytest.mark.parametrize(
    "memory", ["dyntype='filter' dynprm='.2'", "dyntype='none' delay='.1' nsample='60'"]
)
def test_motion_runs_on_from_the_control_before_it(memory):
    """One that starts in the middle of a run of the model itself follows that run."""
    model = mujoco.MjModel.from_xml_string(f"""
        <mujoco>
          <option timestep=".002"/>
          <worldbody>
            <body>
              <joint name="j" type="slide" axis="1 0 0" damping="1"/>
              <geom size=".1" mass="1"/>
            </body>
          </worldbody>
          <actuator><general joint="j" gainprm="20" {memory}/></actuator>
        </mujoco>""")
    data, rows = mujoco.MjData(model), 200
    ctrl = np.repeat(np.random.default_rng(0).uniform(-1, 1, rows // 20), 20)[:, None]
    ctrl[:20] = 0.0
    qpos, qvel = np.empty((2, rows, 1))
    for row in range(rows):
        qpos[row], qvel[row], data.ctrl[:] = data.qpos, data.qvel, ctrl[row]
        mujoco.mj_step(model, data, nstep=5)
    recording = Recording("r", 0.01 * np.arange(rows), qpos, qvel, ctrl)
    columns = overlay.columns_in(model, model)
    for first in (0, 95):
        np.testing.assert_allclose(
            overlay.simulate(model, recording, first, 199, columns), qpos[first:], atol=0.01
        )
    assert abs(qpos).max() > 0.1


def test_overlay_finds_recorded_joints_in_a_model_with_more(diagnosis):
    spec = mujoco.MjSpec.from_string(diagnosis.corrected_xml)
    spec.body("upper").add_joint(name="backlash", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 1, 0])
    qpos, dof = overlay.columns_in(spec.compile(), arm())
    assert qpos.tolist() == [0, 2] == dof.tolist()


def test_marks_of_actuators_that_drive_no_joint():
    """A thruster is marked at its site, a tendon at its end, and one that drives a body nowhere."""
    model = mujoco.MjModel.from_xml_string("""
        <mujoco>
          <worldbody>
            <site name="wall" pos="1 0 0"/>
            <body name="b" pos="0 0 .5">
              <joint name="j"/>
              <geom size=".1"/>
              <site name="rotor" pos=".3 0 0"/>
            </body>
          </worldbody>
          <tendon>
            <spatial name="t"><site site="wall"/><site site="rotor"/></spatial>
            <fixed name="f"><joint joint="j" coef="1"/></fixed>
          </tendon>
          <actuator>
            <motor name="thrust" site="rotor"/>
            <motor name="rope" tendon="t"/>
            <motor name="belt" tendon="f"/>
            <adhesion name="glue" body="b" ctrlrange="0 1"/>
          </actuator>
        </mujoco>""")
    data = outlines.posed(model, model.qpos0)
    points = {}
    for name in ("thrust", "rope", "belt", "glue"):
        _, point = mechanism.marked(model, {"kind": "actuator", "name": name})
        points[name] = None if point is None else point(data).tolist()
    assert points == {
        "thrust": [0.3, 0, 0.5],
        "rope": [0.3, 0, 0.5],
        "belt": [0, 0, 0.5],
        "glue": None,
    }


def test_leftover_force_is_the_one_that_was_left_out():
    """Recorded with viscous damping 0.3, nominal without: the residual is -0.3 times the velocity,
    the corrected one's none."""

    def made(damping):
        return mujoco.MjModel.from_xml_string(ARM.replace('damping="0.05"', f'damping="{damping}"'))

    truth, rows, data = made(0.3), [], None
    data = mujoco.MjData(truth)
    for k in range(3000):
        data.ctrl[:] = np.sin(3 * data.time), 0.3 * np.sin(7 * data.time)
        if k % 5 == 0:
            rows.append([data.time, *data.qpos, *data.qvel, *data.ctrl])
        mujoco.mj_step(truth, data)
    rows = np.array(rows)
    time, qpos, qvel, qacc, ctrl = inverse_dynamics.smooth(
        truth, Recording("r", rows[:, 0], rows[:, 1:3], rows[:, 3:5], rows[:, 5:7]), 300
    )
    np.testing.assert_allclose(qvel, rows[np.searchsorted(rows[:, 0], time - 1e-9), 3:5], atol=0.05)
    missing = inverse_dynamics.forces(made(0.0), qpos, qvel, qacc, ctrl)
    np.testing.assert_allclose(missing, -0.3 * qvel, atol=0.05)
    assert (
        np.abs(inverse_dynamics.forces(truth, qpos, qvel, qacc, ctrl)).max()
        < 0.05
        < 0.3 * np.abs(qvel).max() / 5
    )


def test_recordings_too_short_to_smooth_add_nothing(diagnosis):
    """Beside good ones, one of a few rows and one full of holes: no rows, of the same widths, and
    the page comes out."""
    [good], model = diagnosis.held_out, arm()
    short = replace(
        good,
        name="short.csv",
        time=good.time[:5],
        qpos=good.qpos[:5],
        qvel=good.qvel[:5],
        ctrl=good.ctrl[:5],
    )
    holed = replace(
        good,
        name="holed.csv",
        qpos=np.where(np.arange(len(good.time))[:, None] % 3, good.qpos, np.nan),
    )
    for poor in (short, holed):
        assert [x.shape for x in inverse_dynamics.smooth(model, poor, 100)] == [
            (0,),
            (0, 2),
            (0, 2),
            (0, 2),
            (0, 2),
        ]
    alone = inverse_dynamics.residuals(diagnosis, 300)
    diagnosis.held_out = [short, good, holed]
    assert [len(r["x"]) for r in inverse_dynamics.residuals(diagnosis, 900 - 3)] == [
        len(r["x"]) for r in alone
    ] and alone
    assert "force left at elbow" in sections.html_page(diagnosis)


def test_rows_before_a_held_out_tail_are_not_drawn(diagnosis):
    [whole] = diagnosis.held_out
    tail = replace(whole, start=150, qpos=np.where(np.arange(300)[:, None] < 150, 99.0, whole.qpos))
    diagnosis.held_out = [tail]
    assert (
        np.abs(overlay.poses(arm(), [tail])).max() < 20
        and min(r["x"].max() for r in inverse_dynamics.residuals(diagnosis)) < 20
    )
    name, begin, _, motions = overlay.overlay(diagnosis)
    assert (
        name == whole.name and begin >= whole.time[150] and np.abs(motions["measured"]).max() < 20
    )
    assert f"Held out: {whole.name} from 1.50 s on." in sections.html_page(diagnosis)


def test_what_the_corrected_file_cannot_hold_is_not_drawn_as_corrected(diagnosis):
    diagnosis.summary["findings"] = [{**diagnosis.summary["findings"][0], "written_as": "none"}]
    assert all(
        np.isnan(r["after"]).all() and np.isfinite(r["before"]).all()
        for r in inverse_dynamics.residuals(diagnosis)
    )
    assert set(overlay.overlay(diagnosis)[3]) == {"measured", "nominal"}
    assert "by the corrected one" not in sections.html_page(diagnosis)
