"""Nothing is handed over that predicts kept-back recordings worse, or that they do not need."""

from copy import copy
from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from plants import DRIVEN_PENDULUM, NOISE, recorded, reported_error

from diagnosis.estimation import windowing
from diagnosis.estimation.readings import shown, undone
from diagnosis.estimation.smoother import Smoother
from diagnosis.handover import Check, Files, accepted
from diagnosis.simulation.simulator import World


@pytest.fixture(scope="module")
def kept_back():
    """(World, Check) of a run with more damping than its model has."""
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    runs = [recorded("held.csv", 7, damping=0.1, seconds=6.0)]
    smoother = Smoother(world, runs)
    smoother.locate({}, passes=1)
    return world, Check(world, runs, smoother, smoother.position_noise)


def test_a_finding_that_predicts_worse_is_not_handed_over(kept_back):
    world, check = kept_back
    damping, spring = (
        world.candidate(*c) for c in (("viscous_damping", "pivot"), ("stiffness", "pivot"))
    )
    handed = accepted(world, check, {damping: (0.1,), spring: (0.5,)})
    assert set(handed.setting) == {damping} and handed.gone == [spring]
    assert handed.without[damping] == pytest.approx(check.error(Files.of(world, {})))
    assert check.error(handed.files) < handed.without[damping]


def test_a_finding_that_may_be_nothing_is_not_handed_over(kept_back):
    """Though nothing speaks against it, and the rest is fitted again."""
    world, check = kept_back
    damping, delay = (
        world.candidate(*c) for c in (("viscous_damping", "pivot"), ("delay", "drive"))
    )
    refit = lambda some, out: {c: (0.11,) for c in some}
    doubtful = lambda setting: delay if delay in setting else None
    handed = accepted(world, check, {damping: (0.1,), delay: (1e-5,)}, refit, doubtful=doubtful)
    assert handed.setting == {damping: (0.11,)} and handed.gone == [delay]


def test_by_how_much_one_set_predicts_worse_than_another(kept_back):
    world, check = kept_back
    damping = world.candidate("viscous_damping", "pivot")
    near, far = {damping: (0.1,)}, {damping: (0.2,)}
    more = check.error(Files.of(world, far)) ** 2 - check.error(Files.of(world, near)) ** 2
    assert check.worse(far, near) == pytest.approx(more, rel=0.5)
    assert check.worse(far, near) > check.scattered() > 0 > check.worse(near, far)


def test_findings_that_do_harm_together_all_go(kept_back):
    world, check = kept_back
    wrong = {world.candidate("bias", "drive"): (0.3,), world.candidate("gain", "drive"): (1.5,)}
    handed = accepted(world, check, wrong)
    assert handed.setting == {}
    assert check.error(handed.files) == pytest.approx(check.error(handed.nominal))


def test_the_error_of_the_files_is_that_of_the_simulator_that_fitted_them(kept_back):
    world, check = kept_back
    setting = {world.candidate("viscous_damping", "pivot"): (0.1,)}
    for some in ({}, setting):
        own = reported_error(world, some, check.recordings, check.noise)[0]
        assert check.error(Files.of(world, some)) == pytest.approx(own, rel=1e-4)


@pytest.mark.parametrize("form", ["mjcf", "python"])
def test_files_that_blow_up_predict_nothing_until_the_next_window(kept_back, form):
    """MuJoCo begins anew then, and goes on with numbers that mean nothing."""
    world, check = kept_back
    setting = {world.candidate("stiffness", "pivot"): (1e9,)}
    if form == "python":
        setting = {
            world.curve("pivot", "position:pivot", (-1e9, 1e9), "speed:pivot"): (-1e15, 1e15)
        }
    files = Files.of(world, setting)
    assert set(files.forms.values()) == {form}
    qpos = files.predicted(world.model, check.windows)
    assert np.isfinite(qpos[:, 0]).all() and np.isnan(qpos[:, -1]).all()
    assert check.error(files) == np.inf


def test_files_hold_what_mjcf_cannot_in_a_script():
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    run = recorded("run.csv", 1, seconds=2.0)
    zone = world.candidate("dead_zone", "drive")
    smoother = Smoother(world, [run])
    smoother.locate({}, passes=1)
    check = Check(world, [run], smoother, smoother.position_noise)
    files = Files.of(world, {zone: (0.2,)})
    assert files.forms == {zone: "python"} and files.python
    own = reported_error(world, {zone: (0.2,)}, [run], check.noise)[0]
    assert check.error(files) == pytest.approx(own, rel=0.02)
    assert np.isfinite(own) and NOISE > 0


def test_a_window_that_begins_in_a_hole_of_the_recording_is_predicted_by_the_script_too():
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    run = recorded("run.csv", 1, seconds=2.0)
    smoother = Smoother(world, [run])
    windows = Check(world, [run], smoother, smoother.position_noise).windows
    run.qpos[windows[1].first] = np.nan
    files = Files.of(world, {world.candidate("dead_zone", "drive"): (0.2,)})
    assert np.isfinite(files.predicted(world.model, windows)[1, 1:]).all()


def test_what_kept_back_recordings_do_not_show_stays_and_what_they_speak_against_goes(kept_back):
    world, check = kept_back
    truth = {world.candidate("viscous_damping", "pivot"): (0.1,)}
    stop = world.candidate("bias", "drive")  # of so little that it is lost in the noise
    assert set(accepted(world, check, {**truth, stop: (1e-5,)}).setting) == {*truth, stop}
    some = [{**truth, stop: (x,)} for x in (0.0, 0.02)]
    squares = [check.squares(Files.of(world, s), s) for s in some]
    assert (squares[1].sum(1) > squares[0].sum(1) + check.scattered()).all()
    assert set(accepted(world, check, {**truth, stop: (0.02,)}).setting) == set(truth)


@pytest.mark.parametrize(
    "harm, kept",
    [
        ([9.0, -0.1, -0.1], True),  # one window that goes another way
        ([9.0, 0.1, 0.1], False),
        ([5.0, 5.0, -1.0], False),
        ([9.0], False),  # all that there is
        ([np.inf, -0.1, -0.1], False),
    ],
)
def test_one_window_decides_nothing_about_a_finding(kept_back, harm, kept):
    world = kept_back[0]
    some = [world.candidate(*c) for c in (("viscous_damping", "pivot"), ("bias", "drive"))]
    harm = np.array([harm, harm])
    none = np.zeros(harm.shape)

    def squares(files, setting, near=False):
        """Of the first of two findings the second one makes worse by the harm."""
        return 30.0 - 20 * (some[0] in setting) + (harm if some[1] in setting else none)

    check = SimpleNamespace(squares=squares, scattered=lambda: 0.01, error=lambda files: 1.0)
    handed = accepted(world, check, {some[0]: (0.1,), some[1]: (0.02,)})
    assert set(handed.setting) == set(some if kept else some[:1])


def test_noise_makes_predictions_better_or_worse_by_its_mean_square():
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    run = recorded("run.csv", 1, seconds=6.0)
    check = Check(world, [run], Smoother(world, [run]), np.array([NOISE]))
    rows = sum(w.last - w.first for w in check.windows)
    drawn = np.random.default_rng(0).normal(size=(2000, rows))
    assert check.scattered() == pytest.approx(2 * np.std((drawn**2).mean(1)), rel=0.1)


def test_windows_begin_at_the_motion_of_their_own_setting_whatever_was_asked_before():
    """Of an arm of another mass, not along transitions of the nominal one."""
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    runs = [recorded("held.csv", 7, mass=0.8)]
    smoother = Smoother(world, runs)
    smoother.locate({}, passes=1)
    heavier = {world.candidate("mass", "arm"): (0.8,)}

    def begun(before):
        check = Check(world, runs, copy(smoother), smoother.position_noise)
        if before:
            check.squares(Files.of(world, {}), {})
        return np.hstack(windowing.recorded_starts(world.model, check.smoothed(heavier)))

    # rad and rad/s; along the other transitions it would be ten times as much
    assert abs(begun(True) - begun(False)).max() < 3e-3


@pytest.mark.parametrize("name, value", [("sensor_scale", 0.9), ("sensor_delay", 0.03)])
def test_what_a_sensor_that_is_off_shows_speaks_against_nothing_that_is_true(name, value):
    """Files do not hold it: positions as they are read lie where no force of theirs holds them."""
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    true, model = recorded("held.csv", 7, damping=0.1, seconds=6.0), world.model
    off, damping = world.candidate(name, "pivot"), world.candidate("viscous_damping", "pivot")
    states = windowing.states(model, true)
    qpos, qvel = shown(model, {off: (value,)}, [true], *states)
    run = replace(true, qpos=qpos, qvel=np.full_like(qvel, np.nan))
    back = undone(model, {off: (value,)}, run)
    seen = np.isfinite(back.qpos[:, 0])
    assert seen[:-10].all() and (~seen).any() == (name == "sensor_delay")
    assert abs(back.qpos - true.qpos)[seen][5:].max() < 3 * NOISE
    assert undone(model, {damping: (0.1,)}, run) is run
    check = Check(world, [run], Smoother(world, [run]), np.array([NOISE]))
    both = {off: (value,), damping: (0.1,)}
    squares = lambda setting: check.squares(Files.of(world, setting), setting).sum(1)
    assert (squares(both) < 0.5 * squares({off: (value,)})).all()
    assert set(accepted(world, check, both).setting) == set(both)
