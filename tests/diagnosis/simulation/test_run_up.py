"""Windows begun in the middle of runs whose springs and bristles no recording shows, against stock
MuJoCo."""

import mujoco
import numpy as np
import pytest

from diagnosis.recordings.recording import Recording
from diagnosis.simulation import batch
from diagnosis.simulation.run_up import run_up
from diagnosis.simulation.simulator import Window, World

ARM = """
<mujoco>
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody><body><joint name="elbow" axis="0 1 0" armature="0.02" damping="0.02"
      stiffness="2"/>
    <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="0.4"/></body></worldbody>
  <actuator><motor name="drive" joint="elbow"/></actuator>
</mujoco>"""
SAMPLE, AHEAD = 0.02, 15  # seconds between rows, and rows that a window predicts
VALUES = {"joint_elasticity": (8.0, 0.02), "presliding": (0.3, 6.0), "backlash": (0.1,)}


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "arm.xml"
    path.write_text(ARM)
    return World.load(str(path))


def run(world, effect, noise=0.0, deflected=0.0):
    """(setting, Recording of three seconds, velocities (rows, 1)) of the corrected model in stock
    MuJoCo; what it appends to the coordinates begins at `deflected`."""
    setting = {world.candidate(effect, "elbow"): VALUES[effect]}
    model = mujoco.MjModel.from_xml_string(world.corrected_xml(setting)[0])
    data, rows = mujoco.MjData(model), []
    time = np.arange(150) * SAMPLE
    ctrl = 0.8 * np.sin(7 * time) + 0.5 * np.sin(2.3 * time)
    data.qpos[1:] = deflected
    for u in ctrl:
        rows.append((data.qpos[0], data.qvel[0]))
        data.ctrl[0] = u
        mujoco.mj_step(model, data, round(SAMPLE / model.opt.timestep))
    qpos, qvel = np.array(rows).T[:, :, None]
    noisy = qpos + noise * np.random.default_rng(0).standard_normal(qpos.shape)
    return setting, Recording("run", time, noisy, np.full_like(qpos, np.nan), ctrl[:, None]), qvel


def missed(world, setting, recording, qvel, rows):
    """RMS by which windows from rows on, begun at their velocities, miss the recording."""
    windows = [Window(recording, r, r + AHEAD) for r in rows]
    starts = recording.qpos[list(rows)], qvel[list(rows)]
    predicted = world.simulate([setting] * len(rows), *starts, windows)[0]
    measured = np.array([recording.qpos[r : r + AHEAD + 1] for r in rows])
    return float(np.sqrt(np.mean((predicted - measured) ** 2)))


@pytest.mark.parametrize("effect", VALUES)
def test_what_is_hidden_runs_on_between_returns_to_the_record(world, effect):
    given = run(world, effect)
    rows = 40, 77, 120
    assert missed(world, *given, rows) < 0.05 * missed(world, {}, *given[1:], rows)


@pytest.mark.parametrize("noise, most", [(0.0, 0.005), (1e-3, 0.006)])
def test_a_recording_may_begin_with_a_spring_bent(world, noise, most):
    given = run(world, "joint_elasticity", noise, deflected=0.3)
    rows = 60, 80, 110
    assert missed(world, *given, rows) < most < missed(world, {}, *given[1:], rows) / 4


def test_rows_that_were_not_measured_are_no_returns(world):
    setting, recording, qvel = run(world, "joint_elasticity")
    recording.qpos[30:50] = np.nan
    assert missed(world, setting, recording, qvel, (70, 110)) < 1e-3


def test_the_same_window_begins_alike_beside_others(world):
    setting, recording, qvel = run(world, "joint_elasticity", deflected=0.3)
    rows = [60, 110]
    windows = [Window(recording, r, r + AHEAD) for r in rows]
    starts = recording.qpos[rows], qvel[rows]
    both = world.simulate([setting] * 2, *starts, windows)[0]
    alone = world.simulate([setting], *(x[:1] for x in starts), windows[:1])[0]
    np.testing.assert_allclose(both[0], alone[0], atol=1e-12)


def test_hidden_states_may_be_those_of_another_setting(world, monkeypatch):
    """Which is followed once for all of these; an effect with states of its own follows them."""
    setting, recording, qvel = run(world, "joint_elasticity")
    (spring,) = setting
    heavier = {world.candidate("armature", "elbow"): (0.03,)}
    bristle = {world.candidate("presliding", "elbow"): VALUES["presliding"]}
    windows, followed = [Window(recording, 70, 70 + AHEAD)], []
    starts = recording.qpos[[70]], qvel[[70]]
    monkeypatch.setattr(
        batch,
        "run_up",
        lambda engine, cases, *more: followed.append(cases) or run_up(engine, cases, *more),
    )
    several = [{**setting, c: v} for c, v in heavier.items()] + [{spring: (8.1, 0.02)}, bristle]
    apart = [world.simulate([s], *starts, windows)[0][0] for s in (setting, *several)]
    followed.clear()
    given = [np.repeat(x, 4, 0) for x in starts]
    together = world.simulate([setting, *several], *given, windows * 4, begun=setting)[0]
    own = [[c for c, _ in case.on] for cases in followed for case in cases]
    assert own == [[spring]] * 3 + [[*bristle]]
    assert len({id(case) for case in followed[0]}) == 1
    for k in (0, 3):  # its own, and the bristle's
        np.testing.assert_allclose(together[k], apart[k], atol=1e-12)
    assert abs(together[1] - apart[1]).max() > 1e-6 < abs(together[1] - together[0]).max()


def test_a_gap_in_the_recording_is_run_through(world):
    setting, recording, qvel = run(world, "joint_elasticity")
    kept = np.r_[0:30, 140:150]
    some = Recording(
        "run", *(x[kept] for x in (recording.time, recording.qpos, recording.qvel, recording.ctrl))
    )
    windows, starts = [Window(some, 30, 39)], (some.qpos[30:31], qvel[kept][30:31])
    predicted = world.simulate([setting], *starts, windows)[0]
    assert np.isfinite(predicted).all()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("rows", [2, 4, 12])
def test_a_short_recording_says_nothing_of_how_it_began(world, rows):
    setting, run_, qvel = run(world, "joint_elasticity", deflected=0.3)
    some = Recording("run", *(x[:rows] for x in (run_.time, run_.qpos, run_.qvel, run_.ctrl)))
    starts = some.qpos[:1], qvel[:1]
    predicted = world.simulate([setting], *starts, [Window(some, 0, rows - 1)])[0]
    assert np.isfinite(predicted).all()


def beside(world):
    """World of the arm beside a second one, on a motor of its own."""
    other = "<body><joint name='k' axis='0 1 0' damping='.02'/><geom size='.1'/></body></worldbody>"
    xml = ARM.replace("</worldbody>", other)
    xml = xml.replace("</actuator>", "<motor name='other' joint='k'/></actuator>")
    return World(mujoco.MjSpec.from_string(xml))


@pytest.mark.parametrize("measured", ["in turns", "one never"])
def test_a_joint_is_brought_back_where_another_was_not_measured(world, measured):
    _, one, qvel = run(world, "joint_elasticity")
    one, qvel, two = one.part(25, None), qvel[25:], beside(world)
    still = np.zeros_like(one.qpos)
    qpos, ctrl = np.hstack([one.qpos, still]), np.hstack([one.ctrl, still])
    qpos[1::2, 0] = qpos[::2, 1] = np.nan
    if measured == "one never":
        qpos[:, 0], qpos[:, 1] = one.qpos[:, 0], np.nan
    both = Recording("run", one.time, qpos, np.full_like(qpos, np.nan), ctrl)
    setting = {two.candidate("joint_elasticity", "elbow"): VALUES["joint_elasticity"]}
    rows = [77, 104]
    windows = [Window(both, r, r + AHEAD) for r in rows]
    starts = np.hstack([one.qpos, still])[rows], np.hstack([qvel, still])[rows]
    predicted = two.simulate([setting] * 2, *starts, windows)[0][..., 0]
    measured = np.array([one.qpos[r : r + AHEAD + 1, 0] for r in rows])
    assert np.sqrt(np.mean((predicted - measured) ** 2)) < 8e-3
