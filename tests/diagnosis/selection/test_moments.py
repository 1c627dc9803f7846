"""What acts in one recording of three, or from some moment on, is told with where it acts, by its
name if it has one; what acts always has no condition."""

import mujoco
import numpy as np
import pytest
from plants import DRIVEN_PENDULUM, loaded, recorded

from diagnosis.estimation.chain import Chain
from diagnosis.estimator import identify
from diagnosis.report import text
from diagnosis.selection import moments
from diagnosis.selection.identification import Identification
from diagnosis.simulation.rows import holds
from diagnosis.simulation.simulator import World

XML = DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)
LATER = {"recording": None, "time": [2.0, 4.0]}


def drag(begin=0.0):
    """A torque against fast motion one way, from some moment on."""
    return lambda time, qpos, qvel: -0.01 * max(qvel, 0.0) ** 2 * (time >= begin)


def runs(*pushes):
    return [recorded(f"{k}.csv", k, push=push) for k, push in enumerate(pushes)]


def test_a_condition_holds_for_a_share_of_each_row():
    one, other = runs(None, None)
    share = holds({"recording": None, "time": [1.005, 2.0]}, [one, other])
    assert len(share) == 2 * 399 and share[99] == 0.0 and share[101] == 1.0
    assert share[100] == pytest.approx(0.5) and share[200] == 0.0
    (part,) = np.split(holds({"recording": "1.csv", "time": [0.0, 9.0]}, [one, other]), [399])[:1]
    assert not part.any()


def test_rows_of_a_chain_predict_what_comes_and_goes_as_a_simulation_does():
    world = World(mujoco.MjSpec.from_string(XML))
    search = Identification(world, runs(None, None))
    trajectory, _ = search.locate({})
    search.begin({}, trajectory)
    timed = {world.localised(world.candidate("viscous_damping", "pivot"), LATER): (0.06,)}
    assert isinstance(search.screen, Chain) and not search.screen.apart(next(iter(timed)))
    change = lambda ahead: (lambda both: both[1] - both[0])(ahead.residual([{}, timed]))
    chained, simulated = change(search.screen), change(search.ahead)
    before = [w.recording.time[w.last] < 2.0 for w in search.ahead.windows]
    assert any(before) and not chained[before].any()
    cosine = (chained * simulated).sum() / np.sqrt((chained**2).sum() * (simulated**2).sum())
    assert cosine > 0.999


def test_what_comes_and_goes_is_no_force_that_is_missing():
    at = lambda begin: lambda time, qpos, qvel: 0.1 * (time >= begin)
    world = World(mujoco.MjSpec.from_string(XML))
    search = Identification(world, runs(at(2.0), at(2.0)))
    trajectory, first = search.locate({})
    timed = {world.localised(world.candidate("spring_offset", "pivot"), LATER): (0.1,)}
    there = search.smoother.locate(timed, trajectory, passes=2)
    late = np.concatenate([r.time > 2.3 for r in search.train])
    assert np.median(abs(first.force[late])) > 0.08 > 8 * np.median(abs(there.force[late]))


def test_conditions_are_recordings_of_several_and_moments():
    search = Identification(World(mujoco.MjSpec.from_string(XML)), runs(None, None, None))
    search.begin({}, search.locate({})[0])
    each = moments.conditions(search.screen.windows)
    named = [c.recording.name for c in each if c.recording]
    assert named == ["0.csv", "1.csv", "2.csv"]
    later = [c for c in each if not c.recording]
    assert later and all(c.inside.any() and not c.inside.all() for c in later)


def test_a_mass_that_comes_is_a_load():
    world = World(mujoco.MjSpec.from_string(XML))
    placed = lambda effect, place: moments.placed(world, world.candidate(effect, place), LATER)
    assert placed("mass", "arm") is None and placed("payload_change", "arm").when == LATER
    damping = placed("viscous_damping", "pivot")
    assert damping.when == LATER and damping.lasting == world.candidate("viscous_damping", "pivot")


def test_a_moment_is_where_the_simulator_leaves_least():
    world = World(mujoco.MjSpec.from_string(XML))
    push = lambda time, qpos, qvel: 0.1 * (time >= 2.13)
    search = Identification(world, runs(push, push))
    search.candidates = []
    judge = search.run().judge
    timed = world.localised(world.candidate("spring_offset", "pivot"), LATER)
    fitted = moments.sharpened(judge, judge.fit({timed: (0.1,)}))
    [(candidate, values)] = fitted.setting.items()
    assert candidate.when["time"][0] == pytest.approx(2.13, abs=0.03)
    assert values[0] == pytest.approx(0.1, rel=0.02)
    nothing = judge.fit({})
    assert moments.removed(nothing, fitted, candidate.when) > 0.8
    assert moments.sharpened(judge, nothing) is nothing


def first(recordings, **how):
    """The first finding of a diagnosis."""
    world, held = World(mujoco.MjSpec.from_string(XML)), [recorded("held.csv", 9, **how)]
    return identify(world, recordings, held).summary["findings"][0]


def told(*pushes):
    return first(runs(*pushes), push=pushes[0])


def test_a_drag_in_one_recording_is_told_as_unknown_there():
    finding = told(None, drag(), None)
    assert finding["effect"] == "unknown" and finding["place"]["name"] == "pivot"
    assert finding["depends_on"] == ["velocity:pivot"] and not finding["adequate"]
    assert finding["when"]["recording"] == "1.csv" and finding["written_as"] == "none"
    assert finding["evidence"]["error_removed_there"] > 0.5
    assert finding["evidence"]["p_value"] < 1e-3


def test_a_drag_that_has_a_name_is_told_by_it():
    finding = first([recorded(f"{k}.csv", k, damping=0.1 if k == 1 else 0.05) for k in range(3)])
    assert finding["effect"] == "viscous_damping" and finding["place"]["name"] == "pivot"
    assert finding["when"]["recording"] == "1.csv" and finding["adequate"]
    (value,) = finding["parameters"]
    assert value["value"] == pytest.approx(0.1, rel=0.05) and value["low"] < 0.1 < value["high"]


def test_what_a_force_depends_on_is_looked_at_where_it_acts():
    """In two recordings of three nothing is missing: pooled, hardly anything follows the speed."""
    recordings = runs(None, drag(), None)
    world = World(mujoco.MjSpec.from_string(XML))
    search = Identification(world, recordings)
    trajectory, _ = search.locate({})
    when = {"recording": "1.csv", "time": [0.0, 9.0]}
    always, there = (moments.followed(world, trajectory, recordings, w) for w in (None, when))
    share = lambda found: max(d.share for d in found if d.variables == ("velocity:pivot",))
    assert share(there) > 0.8 and share(there) > share(always) + 0.3
    assert all(d.candidate.when == when for d in there)
    assert all(d.candidate.when is None for d in always)


def test_a_drag_in_all_of_them_has_no_condition():
    assert told(drag(), drag(), drag())["when"] is None


def test_a_load_that_every_recording_picks_up_at_the_same_time_stays():
    some = [loaded(k, 1.0, 2.0, (2.2, 9.0)) for k in range(3)]
    for k, run in enumerate(some):
        object.__setattr__(run, "name", f"run{k}.csv")
    finding = first(some)
    assert finding["effect"] == "payload_change"
    assert finding["parameters"][0]["value"] == pytest.approx(1.0, rel=0.02)
    assert finding["when"]["recording"] is None
    assert finding["when"]["time"][0] == pytest.approx(2.2, abs=0.05)
    assert "in every recording from 2.2" in text.finding_words(finding)
