"""One row ahead against plain loops of mj_step, and its derivatives against central differences."""

import dataclasses

import mujoco
import numpy as np
import pytest
from mujoco import rollout
from plants import FILTER, INTEGRATOR, driven_by, there_and_back

from diagnosis.recordings.recording import Recording
from diagnosis.simulation.rows import RowMap
from diagnosis.simulation.simulator import Window, World

ARM = """<mujoco><option timestep="0.002" density="1.2"/><default>
  <geom contype="0" conaffinity="0"/></default><worldbody>
  <body name="a" pos="0 0 1"><joint name="j" axis="0 1 0" damping="{damping}"/>
  <geom type="capsule" fromto="0 0 0 .1 0 -.3" size=".02" mass="1"/>
  <body name="b" pos="0 0 -.3"><joint name="k" axis="0 1 0" damping="0.02"/>
  <geom type="capsule" fromto="0 0 0 0 .1 -.3" size=".02" mass="0.5"/></body></body></worldbody>
  <actuator><motor name="m" joint="j" gear="2"/><position name="s" joint="k" kp="{kp}" kv="0.2"/>
  </actuator></mujoco>"""
FREE = """<mujoco><option timestep="0.002" gravity="0 0 -1"/><worldbody><body name="a">
  <freejoint/><geom type="box" size=".1 .2 .3" mass="1"/></body></worldbody></mujoco>"""


def world():
    return World(mujoco.MjSpec.from_string(ARM.format(damping=0.05, kp=8)))


def uneven(model, seed=0, rows=12):
    """A Recording whose rows are 6, 10 or 14 ms apart, all of whole steps."""
    rng = np.random.default_rng(seed)
    time = np.concatenate([[0.0], np.cumsum(rng.choice([0.006, 0.01, 0.014], rows - 1))])
    ctrl = rng.uniform(-1, 1, (rows, model.nu))
    return Recording(
        "run", time, np.zeros((rows, model.nq)), np.full((rows, model.nv), np.nan), ctrl
    )


def stepped(model, recording, row, qpos, qvel, force):
    """The state one row later, by mj_step."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.qfrc_applied[:] = qpos, qvel, force
    data.ctrl[:] = recording.ctrl[row]
    seconds = recording.time[row + 1] - recording.time[row]
    mujoco.mj_step(model, data, round(seconds / model.opt.timestep))
    return data.qpos.copy(), data.qvel.copy()


def some_states(model, count, seed=1):
    rng = np.random.default_rng(seed)
    qpos = np.array([random_pose(model, rng) for _ in range(count)])
    return qpos, rng.normal(size=(count, model.nv)), 0.3 * rng.normal(size=(count, model.nv))


def random_pose(model, rng):
    qpos = model.qpos0.copy()
    mujoco.mj_integratePos(model, qpos, rng.normal(size=model.nv), 1.0)
    return qpos


def test_a_row_ahead_is_what_mujoco_steps_whatever_its_length():
    here = world()
    run = uneven(here.model)
    setting = {
        here.candidate("viscous_damping", "j"): (0.3,),
        here.candidate("gain", "m"): (1.3,),
    }
    model = mujoco.MjModel.from_xml_string(ARM.format(damping=0.3, kp=8))
    model.actuator_gainprm[0, 0] = 1.3
    rows = RowMap(here, [run, run], setting)
    assert rows.begin.tolist() == [*range(11), *range(12, 23)]
    qpos, qvel, force = some_states(model, len(rows.begin))
    q, v = rows.ahead(np.arange(len(rows.begin)), qpos, qvel, force)
    for k, row in enumerate(rows.begin):
        expected = stepped(model, run, row % 12, qpos[k], qvel[k], force[k])
        np.testing.assert_allclose(q[k], expected[0], atol=1e-9)
        np.testing.assert_allclose(v[k], expected[1], atol=1e-9)


@pytest.mark.parametrize("xml", [ARM.format(damping=0.05, kp=8), FREE])
def test_derivatives_are_central_differences_of_stock_steps(xml):
    here = World(mujoco.MjSpec.from_string(xml))
    model, nv, small = here.model, here.model.nv, 1e-5
    run = uneven(model, rows=5)
    rows = RowMap(here, [run], {})
    qpos, qvel, force = some_states(model, 4)
    A, B = rows.linearised(qpos, qvel, force, np.ones(nv), np.zeros(4, bool))

    def moved(k, column, sign):
        state = [qpos[k].copy(), qvel[k].copy(), force[k].copy()]
        if column < nv:
            mujoco.mj_integratePos(model, state[0], sign * small * np.eye(nv)[column], 1.0)
        else:
            state[column // nv][column % nv] += sign * small
        return stepped(model, run, k, *state)

    for k in range(4):
        for column in range(3 * nv):
            up, down = moved(k, column, 1), moved(k, column, -1)
            slope = np.empty(nv)
            mujoco.mj_differentiatePos(model, slope, 2 * small, down[0], up[0])
            slope = np.concatenate([slope, (up[1] - down[1]) / (2 * small)])
            own = np.concatenate([A[k], B[k]], 1)[:, column]
            np.testing.assert_allclose(own, slope, atol=2e-4 * max(1.0, abs(slope).max()))


def test_a_hole_costs_the_other_rows_nothing(monkeypatch):
    here = world()
    run = uneven(here.model)
    time = run.time + np.where(np.arange(12) > 5, 1.0, 0.0)  # a second is missing
    rows = RowMap(here, [dataclasses.replace(run, time=time)], {})
    steps, rolled = [], rollout.rollout

    def counted(model, data, state, control, **more):
        steps.append(len(state) * more["nstep"])
        return rolled(model, data, state, control, **more)

    monkeypatch.setattr(rollout, "rollout", counted)
    state = some_states(here.model, 11)
    together = rows.ahead(np.arange(11), *state)
    least = np.ceil(np.diff(time) / here.model.opt.timestep).sum()
    assert sum(steps) < 2 * least
    for k in range(11):
        alone = rows.ahead(np.array([k]), *(x[k : k + 1] for x in state))
        np.testing.assert_array_equal(together[0][k], alone[0][0])
        np.testing.assert_array_equal(together[1][k], alone[1][0])


def test_rows_that_are_skipped_cost_nothing_and_change_no_other():
    here = World(mujoco.MjSpec.from_string(FREE))
    rows = RowMap(here, [uneven(here.model, rows=5)], {})
    state, skipped = some_states(here.model, 4), np.array([False, True, False, True])
    whole = rows.linearised(*state, np.ones(6), np.zeros(4, bool))
    asked, ahead = [], rows.ahead
    rows.ahead = lambda index, *moved: asked.append(index.tolist()) or ahead(index, *moved)
    for every, some in zip(whole, rows.linearised(*state, np.ones(6), skipped)):
        np.testing.assert_array_equal(some[~skipped], every[~skipped])
        assert np.isnan(some[skipped]).all()
    assert set(map(tuple, asked)) == {(0, 2)}


def test_a_constant_push_on_a_body_turns_with_it_within_a_row():
    """As in plain steps, and as in a simulation of the row."""
    here = world()
    run, push = uneven(here.model), (1.0, 0.0, -2.0)
    setting = {here.candidate("external_force", "b"): push}
    rows = RowMap(here, [run], setting)
    qpos, qvel, force = some_states(here.model, len(rows.begin))
    q, v = rows.ahead(np.arange(len(rows.begin)), qpos, qvel, force)
    for k, row in enumerate(rows.begin):
        data = mujoco.MjData(here.model)
        data.qpos[:], data.qvel[:], data.qfrc_applied[:] = qpos[k], qvel[k], force[k]
        data.ctrl[:], data.xfrc_applied[2, :3] = run.ctrl[row], push
        count = round((run.time[row + 1] - run.time[row]) / 0.002)
        mujoco.mj_step(here.model, data, count)
        np.testing.assert_allclose(q[k], data.qpos, atol=1e-9)
        np.testing.assert_allclose(v[k], data.qvel, atol=1e-9)
    windows = [Window(run, row, row + 1) for row in rows.begin]
    simulated = here.simulate([setting] * len(windows), qpos, qvel, windows)
    for own, other in zip(rows.ahead(np.arange(len(windows)), qpos, qvel, 0 * force), simulated):
        np.testing.assert_allclose(own, other[:, 1], atol=1e-9)


@pytest.mark.parametrize("actuator", [FILTER, INTEGRATOR])
def test_rows_begin_with_what_an_actuator_has_added_up(actuator):
    """A control that comes late through a filter, and one that is summed within a range: row by row
    as in one run."""
    here, _ = driven_by(actuator)
    run, *_ = there_and_back(here)
    setting = {here.candidate("delay", "m"): (0.04,)} if actuator == FILTER else {}
    qpos, qvel = (x[0] for x in here.simulate([setting], [[0.3]], [[0.5]], [Window(run, 0, 119)]))
    rows = RowMap(here, [run], setting)
    q, v = rows.ahead(np.arange(119), qpos[:-1], qvel[:-1], np.zeros((119, 1)))
    np.testing.assert_allclose(q, qpos[1:], atol=1e-9)
    np.testing.assert_allclose(v, qvel[1:], atol=1e-9)


def test_derivatives_by_force_work_out_no_load_again(monkeypatch):
    """It depends on the states alone: once where they are, and once where each is moved."""
    here, asked = world(), []
    run = uneven(here.model)
    rows = RowMap(here, [run], {here.candidate("load_friction", "j"): (0.2, 0.3, 1.0)})
    stage = mujoco.mj_fwdVelocity
    monkeypatch.setattr(mujoco, "mj_fwdVelocity", lambda *given: asked.append(1) or stage(*given))
    count, nv = len(rows.begin), here.model.nv
    rows.linearised(*some_states(here.model, count), np.ones(nv), np.zeros(count, bool))
    assert len(asked) == (1 + 2 * nv) * count


def test_sensors_that_are_late_or_rarely_read_change_no_row():
    """What they remember is part of MuJoCo's state beside positions, velocities and activations."""
    xml = ARM.format(damping=0.05, kp=8)
    late = '<sensor><jointpos joint="j" nsample="5" delay="0.004"/></sensor></mujoco>'
    both = [World(mujoco.MjSpec.from_string(x)) for x in (xml, xml.replace("</mujoco>", late))]
    assert both[1].model.nhistory
    run = uneven(both[0].model)
    state = some_states(both[0].model, 11)
    plain, other = (RowMap(w, [run], {}).ahead(np.arange(11), *state) for w in both)
    np.testing.assert_array_equal(plain, other)
