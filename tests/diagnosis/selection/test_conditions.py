"""A drag that is there in one recording of three or from some moment on is told with where it acts,
by its name if it has one; where it acts always, or nothing does, no condition is."""

import mujoco
import numpy as np
import pytest
from plants import DRIVEN_PENDULUM, recorded

from diagnosis.estimator import identify
from diagnosis.selection.conditions import Condition, concentrated
from diagnosis.selection.identification import Identification
from diagnosis.simulation.simulator import World

XML = DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)


def drag(begin=0.0):
    """A torque against fast motion one way, from some moment on."""
    return lambda time, qpos, qvel: -0.01 * max(qvel, 0.0) ** 2 * (time >= begin)


def runs(*pushes):
    return [recorded(f"{k}.csv", k, push=push) for k, push in enumerate(pushes)]


def search(*pushes):
    """(Identification without candidates, its Found: the nominal model)."""
    here = Identification(World(mujoco.MjSpec.from_string(XML)), runs(*pushes))
    here.candidates = []
    return here, here.run()


@pytest.mark.parametrize(
    "pushes, recording, begin",
    [((None, drag(), None), "1.csv", 0.0), ((drag(2.0),) * 3, None, 2.0)],
)
def test_the_condition_is_where_what_is_left_is(pushes, recording, begin):
    here, found = search(*pushes)
    where = concentrated(found.fitted)
    assert where.when["recording"] == recording
    assert where.time[0] == pytest.approx(begin, abs=0.3)
    rest = where.dependence(here.world, found.trajectory, here.train)
    assert rest.variables == ("velocity:pivot",) and rest.candidate.when == where.when
    beside = found.judge.fit({rest.candidate: rest.values}, steps=2)
    assert beside.loss < found.fitted.loss - 0.2
    assert where.removed(found.fitted, beside) > 0.5


def test_where_nothing_is_left_no_condition_is():
    assert concentrated(search(None, None, None)[1].fitted) is None


def test_rows_of_a_condition_are_those_of_its_recordings_in_its_time():
    two = runs(None, None)
    later = Condition(None, (1.0, 4.0), np.ones(1), 1).rows(two)
    assert later.sum() == 2 * 300 and not later[:100].any()
    one = Condition(two[1], (0.0, 4.0), np.ones(1), 1).rows(two)
    assert one[400:].all() and not one[:400].any()


def test_parts_of_a_condition_are_its_recordings_in_its_time():
    two = runs(None, None)
    parts = Condition(None, (1.0, 4.0), np.ones(1), 1).parts(two)
    assert [(r.name, r.time[0], len(r.time)) for r in parts] == [
        ("0.csv", pytest.approx(1.0), 300),
        ("1.csv", pytest.approx(1.0), 300),
    ]
    (one,) = Condition(two[1], (0.0, 4.0), np.ones(1), 1).parts(two)
    assert one.name == "1.csv" and (one.qpos == two[1].qpos).all()


def test_a_mass_that_comes_is_a_load():
    world, where = World(mujoco.MjSpec.from_string(XML)), Condition(None, (1.0, 4.0), np.ones(1), 1)
    placed = lambda effect, place: where.placed(world, world.candidate(effect, place))
    load, drag = placed("mass", "arm"), placed("viscous_damping", "pivot")
    assert load.effect.name == "payload_change" and load.place.name == "arm"
    assert drag.effect.name == "viscous_damping" and load.when == drag.when == where.when


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
    assert finding["when"]["recording"] == "1.csv"
    assert finding["evidence"]["error_removed_there"] > 0.5
    assert finding["evidence"]["p_value"] < 1e-3


def test_a_drag_that_has_a_name_is_told_by_it():
    finding = first([recorded(f"{k}.csv", k, damping=0.1 if k == 1 else 0.05) for k in range(3)])
    assert finding["effect"] == "viscous_damping" and finding["place"]["name"] == "pivot"
    assert finding["when"]["recording"] == "1.csv" and finding["adequate"]
    (value,) = finding["parameters"]
    assert value["value"] == pytest.approx(0.1, rel=0.05) and value["low"] < 0.1 < value["high"]


def test_a_drag_in_all_of_them_has_no_condition():
    assert told(drag(), drag(), drag())["when"] is None
