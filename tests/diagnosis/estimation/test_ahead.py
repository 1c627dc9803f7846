"""Windows, bands and residuals of predictions ahead, against loops of mj_step."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from plants import DRIVEN_PENDULUM, NOISE, recorded

from diagnosis.estimation.ahead import Ahead, cut_ahead
from diagnosis.estimation.smoother import Smoother
from diagnosis.simulation.simulator import World

XML = DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)


def world():
    return World(mujoco.MjSpec.from_string(XML))


def test_windows_are_a_second_long_where_there_are_enough_and_never_too_many():
    long = [recorded(f"{k}.csv", k, seconds=10.0) for k in range(2)]
    spans = [w.recording.time[w.last] - w.recording.time[w.first] for w in cut_ahead(long)]
    assert len(spans) >= 16 and spans == pytest.approx([1.0] * len(spans))
    short = cut_ahead([recorded("short.csv", 0, seconds=4.0)])
    assert 14 <= len(short) <= 18
    [few] = [recorded("few.csv", 0, seconds=0.4)]
    assert len(few.time) > 30 and {w.last - w.first for w in cut_ahead([few])[:-1]} == {7}
    assert len(cut_ahead([recorded("hour.csv", 0, seconds=80.0)])) <= 48
    late = cut_ahead([replace(long[0], start=500)])
    assert min(w.first for w in late) == 500


def test_residuals_are_those_of_stock_steps_and_what_is_lost_is_no_farther_than_the_travel():
    here, run = world(), recorded("run.csv", 3, seconds=8.0)
    ahead = Ahead(here, cut_ahead([run]), np.array([NOISE]))
    damping = here.candidate("viscous_damping", "pivot")
    both = ahead.residual([{}, {damping: (0.4,)}])
    for setting, model in enumerate(
        mujoco.MjModel.from_xml_string(DRIVEN_PENDULUM.format(damping=d, mass=0.5))
        for d in (0.05, 0.4)
    ):
        for k in (0, 5):
            w, data = ahead.windows[k], mujoco.MjData(model)
            data.qpos[:], data.qvel[:] = ahead.qpos[k], ahead.qvel[k]
            for row in range(w.first + 1, w.last + 1):
                data.ctrl[:] = run.ctrl[row - 1]
                mujoco.mj_step(model, data, 2)
                gap = run.qpos[row, 0] - data.qpos[0]
                gap = np.clip(gap, -ahead.travel[0], ahead.travel[0])
                assert both[setting, k, row - w.first, 0] == pytest.approx(gap, abs=1e-9)
    true = here.simulate
    here.simulate = lambda *a, **k: [x + 100.0 for x in true(*a, **k)]
    assert (ahead.residual([{}])[0][ahead.known] == -ahead.travel[0]).all()
    here.simulate = lambda *a, **k: [np.full_like(x, np.nan) for x in true(*a, **k)]
    lost = ahead.residual([{}])[0]
    assert (lost[ahead.known] == ahead.travel[0]).all() and (lost[~ahead.known] == 0).all()


def test_columns_of_a_runge_kutta_model_take_one_evaluation_a_step_and_are_the_same():
    plain = world()
    assert plain.quick is plain
    here = World(mujoco.MjSpec.from_string(XML.replace("<option", "<option integrator='RK4'")))
    assert here.quick.model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    ahead = Ahead(here, cut_ahead([recorded("run.csv", 3, seconds=8.0)]), np.array([NOISE]))
    damping = here.candidate("viscous_damping", "pivot")
    exact, quick = (
        np.subtract(*each([{}, {damping: (0.1,)}])) for each in (ahead.residual, ahead.rough)
    )
    assert (exact * quick).sum() / np.linalg.norm(exact) / np.linalg.norm(quick) > 0.999
    assert np.linalg.norm(quick) == pytest.approx(np.linalg.norm(exact), rel=0.05)
    assert not ahead.same({}) and Ahead(plain, ahead.windows, ahead.noise).same({})


def test_bands_are_of_time_ahead_and_unmeasured_rows_count_nowhere():
    run = recorded("run.csv", 3, seconds=20.0)
    run.qpos[40:60] = np.nan
    ahead = Ahead(world(), cut_ahead([run]), np.array([NOISE]))
    assert not ahead.known[0, 40:60].any() and not ahead.known[:, 0].any()
    for low, high, band in ((0.0, 0.1, 0), (0.1, 0.3, 1), (0.3, 1.0, 2)):
        inside = (ahead.seconds > low + 1e-6) & (ahead.seconds <= high + 1e-6)
        assert (ahead.band[inside] == band).all()
    assert (ahead.band[:, 0] == -1).all()
    assert sorted(set(ahead.group)) == list(range(16)) and (np.diff(ahead.group) >= 0).all()


def test_a_shorter_step_begins_with_the_velocity_of_a_later_time():
    """From the same motion located at the model's step, a world with finer steps is predicted."""
    here, run = world(), recorded("fine.csv", 4, seconds=8.0, finer=8, noise=1e-6)
    smoother = Smoother(here, [run])
    ahead = Ahead(here, cut_ahead([run]), np.array([NOISE]))
    ahead.start(smoother.locate({}))
    step = here.candidate("time_step", "world")
    coarse, fine = (np.sqrt(np.mean(r**2)) for r in ahead.residual([{}, {step: (0.00125,)}]))
    assert fine < 0.35 * coarse
    assert np.sqrt(np.mean(ahead.residual([{}], refine=4) ** 2)) == pytest.approx(fine, rel=1e-6)
