"""Names stand first only where the error of their joint goes with them."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from arm import ARM, run

from diagnosis import unnamed
from diagnosis.estimation.smoother import Trajectory
from diagnosis.recordings.recording import Recording
from diagnosis.selection.criterion import PRICE, Comparison
from diagnosis.selection.plausibility import Usual, plausible
from diagnosis.simulation.simulator import World

WORLD = World(mujoco.MjSpec.from_string(ARM))
FRICTION, STIFFNESS, MASS = (
    WORLD.candidate(*c)
    for c in (("coulomb_friction", "elbow"), ("stiffness", "elbow"), ("mass", "lower"))
)

TABLE = run()
RUN = Recording("run.csv", TABLE[:, 0], TABLE[:, 1:3], TABLE[:, 3:5], TABLE[:, 5:])
USUAL = Usual(WORLD, [RUN], np.ones(2))


def smoothed(elbow, shoulder=0.0, scatter=0.1):
    """A trajectory with forces of these RMS values at two joints, each known to the scatter."""
    force = np.array([[shoulder, elbow], [-shoulder, -elbow]])
    free = np.zeros(2, bool)
    none = np.zeros((2, 2))
    sd = np.full((2, 2), scatter)
    return Trajectory(none, none, force, none, none, sd, {}, free, none)


@pytest.fixture(autouse=True)
def shares(monkeypatch):
    monkeypatch.setattr(unnamed, "share_left", lambda fitted: fitted.shares)


def outcome(trajectory, share=1.0, depends=(), friction=0.1, gains=(1, 1), gone=()):
    """share: of the error of the elbow that is left; the shoulder erred by none. gains: nats that a
    perfect simulator would remove in the shoulder and in the elbow. gone: what was not handed
    over."""
    dependences = [SimpleNamespace(joint=j, variables=v, size=1.0, above=2.0) for j, v in depends]
    ahead = SimpleNamespace(channels=[np.array([0]), np.array([1])])
    setting = {FRICTION: (friction,), STIFFNESS: (0.1,), MASS: (0.3,)}
    columns = SimpleNamespace(ahead=ahead)
    left = np.array([np.nan, share])
    fitted = SimpleNamespace(shares=left, columns=columns, setting=setting)
    found = SimpleNamespace(first=trajectory, usual=USUAL, fitted=fitted)
    handed = SimpleNamespace(gone=list(gone))
    return SimpleNamespace(
        found=found,
        fitted=fitted,
        left=dependences,
        handed=handed,
        lacks=[Comparison(gain, 1e-9) for gain in gains],
    )


def led(world, given, findings, something, channels={}):
    return unnamed.led(world, given, findings, something, channels)


def finding(candidate, removed=0.4, p=1e-5, written="mjcf"):
    return candidate, {
        "effect": candidate.effect.name,
        "place": {"kind": "joint", "name": candidate.place.name},
        "parameters": [{"value": 0.1}],
        "evidence": {"held_out_error_removed": removed, "p_value": p},
        "adequate": True,
        "depends_on": [],
        "when": candidate.when,
        "written_as": written,
        "also_possible": [],
    }


DEPENDS = [("elbow", ("position:elbow", "velocity:elbow")), ("shoulder", ("time",))]


@pytest.mark.parametrize(
    "after, effect, adequate",
    [
        (0.1, "coulomb_friction", True),
        (0.2, "coulomb_friction", True),
        (0.4, "unknown", False),  # the nearest name
        (0.7, "unknown", False),
    ],
)
def test_a_name_stands_by_how_much_of_the_error_it_leaves(after, effect, adequate):
    given = outcome(smoothed(1.0), after, DEPENDS)
    told = led(WORLD, given, [finding(FRICTION)], True)
    [only] = told
    assert (only["effect"], only["adequate"]) == (effect, adequate)
    if effect == "unknown":
        assert only["place"]["name"] == "elbow" and only["written_as"] == "mjcf"
        assert only["depends_on"] == ["position:elbow", "velocity:elbow"]
        assert [o["effect"] for o in only["also_possible"]] == ["coulomb_friction"]
        assert only["evidence"]["held_out_error_removed"] == 0.4


@pytest.mark.parametrize(
    "fitted, before, after, floor, effect, share",
    [
        (0.7, 10.0, 2.0, 3.0, "coulomb_friction", 0.0),  # all is explained
        (0.7, 10.0, 5.0, 3.0, "unknown", None),
        (0.2, 10.0, 5.0, 3.0, "coulomb_friction", 0.2),
        (0.2, 10.0, 6.0, 3.0, "unknown", None),  # most is left
        (0.2, 4.0, 3.9, 3.0, "coulomb_friction", 0.2),  # they show little
        (0.7, 4.0, 2.9, 3.0, "coulomb_friction", 0.0),
        (0.7, 3.0, 2.9, 3.1, "unknown", None),  # or nothing
        (0.7, 10.0, np.inf, 3.0, "unknown", None),
    ],
)
def test_held_out_recordings_say_what_a_name_leaves_as_well(
    fitted, before, after, floor, effect, share
):
    errors = {"qpos:elbow": {"before": before, "after": after, "floor": floor}}
    given = outcome(smoothed(1.0), fitted, DEPENDS)
    [only] = led(WORLD, given, [finding(FRICTION)], True, errors)
    assert only["effect"] == effect and only["evidence"].get("error_left") == share


def test_files_tell_nothing_of_a_joint_whose_sensor_is_off():
    scale = WORLD.candidate("sensor_scale", "elbow")
    given = outcome(smoothed(1.0), 0.1, DEPENDS)
    given.fitted.setting[scale] = (0.9,)
    errors = {"qpos:elbow": {"before": 10.0, "after": 8.0, "floor": 3.0}}
    off = finding(scale, written="measurement")
    told = led(WORLD, given, [off, finding(FRICTION)], True, errors)
    assert [f["effect"] for f in told] == ["sensor_scale", "coulomb_friction"]
    off[1]["written_as"] = "mjcf"
    told = led(WORLD, given, [off, finding(FRICTION)], True, errors)
    assert [f["effect"] for f in told] == ["unknown"]


def test_a_finer_step_is_no_name_for_a_force():
    step = WORLD.candidate("time_step", "world")
    given = outcome(smoothed(1.0), 0.7, DEPENDS, gains=(0, 0))
    given.fitted.setting[step] = (1e-4,)
    [only] = led(WORLD, given, [finding(step)], True)
    assert only["effect"] == "time_step" and only["evidence"]["error_left"] is None


def test_what_acts_in_all_joints_is_no_better_than_where_most_is_missing():
    gravity = WORLD.candidate("gravity", "world")
    given = outcome(smoothed(1.0), 0.7, DEPENDS)
    given.fitted.setting[gravity] = (0.3, 0.0, -9.8)
    [only] = led(WORLD, given, [finding(gravity)], True)
    assert (only["effect"], only["place"]["name"]) == ("unknown", "elbow")
    assert [o["effect"] for o in only["also_possible"]] == ["gravity"]


def test_an_unknown_force_varies_with_what_its_nearest_name_does():
    nearest = finding(FRICTION)
    nearest[1]["depends_on"] = ["velocity:elbow"]
    told = led(WORLD, outcome(smoothed(1.0), 0.7, DEPENDS), [nearest], True)
    assert told[0]["depends_on"] == ["velocity:elbow", "position:elbow"]


def test_names_that_share_a_joint_are_one_unknown_force():
    given = [finding(FRICTION), finding(STIFFNESS, removed=0.1, p=1e-9)]
    told = led(WORLD, outcome(smoothed(1.0), 0.9, DEPENDS), given, True)
    [only] = told
    names = [o["effect"] for o in only["also_possible"]]
    assert names == ["coulomb_friction", "stiffness"]
    assert only["evidence"]["held_out_error_removed"] == 0.5
    assert only["evidence"]["p_value"] == 1e-9


def test_members_of_a_names_class_follow_all_names():
    friction, stiffness = finding(FRICTION), finding(STIFFNESS)
    friction[1]["also_possible"] = [{"effect": "dead_zone"}, {"effect": "gain"}]
    given = outcome(smoothed(1.0), 0.9, DEPENDS)
    [only] = led(WORLD, given, [friction, stiffness], True)
    names = [o["effect"] for o in only["also_possible"]]
    assert names == ["coulomb_friction", "stiffness", "dead_zone"]


def test_a_curve_that_was_found_leads_the_names_at_its_joint():
    curve = WORLD.curve("elbow", "position:elbow", (0.0, 0.5, 1.0))
    known = finding(curve, written="python")
    known[1].update(depends_on=["position:elbow"], curve={})
    friction = finding(FRICTION)
    friction[1]["depends_on"] = ["velocity:elbow"]
    given = [friction, known]
    told = led(WORLD, outcome(smoothed(1.0), 0.9, DEPENDS), given, True)
    [only] = told
    assert only["depends_on"] == ["position:elbow", "velocity:elbow"]
    assert only["written_as"] == "python"
    assert [o["effect"] for o in only["also_possible"]] == ["coulomb_friction"]


def test_an_unknown_force_acts_when_its_nearest_name_does():
    when = {"recording": "1.csv", "time": [0.0, 4.0]}
    friction = finding(FRICTION)
    friction[1]["when"] = when
    [only] = led(WORLD, outcome(smoothed(1.0), 0.9, DEPENDS), [friction], True)
    assert only["effect"] == "unknown" and only["when"] == when
    [always] = led(WORLD, outcome(smoothed(1.0), 0.9, DEPENDS), [finding(FRICTION)], True)
    assert always["effect"] == "unknown" and always["when"] is None


def test_of_two_unknown_forces_at_a_joint_the_more_important_one_is_told():
    curve = WORLD.curve("elbow", "position:elbow", (0.0, 0.5, 1.0))
    first, second = (finding(curve, removed)[1] for removed in (0.4, 0.0))
    [only] = led(WORLD, outcome(smoothed(0.1)), [(None, first), (None, second)], True)
    assert only["evidence"]["held_out_error_removed"] == 0.4


def test_where_nothing_has_a_name_the_joint_that_lacks_most_is_told():
    both = outcome(smoothed(0.3), depends=DEPENDS, gains=(1.0, 0.9))
    [only] = led(WORLD, both, [], True)
    assert (only["effect"], only["place"]["name"]) == ("unknown", "shoulder")
    assert only["depends_on"] == ["time"] and only["written_as"] == "none"


def test_a_finer_time_step_is_no_name():
    finer = {
        "effect": "time_step",
        "place": {"kind": "world", "name": "world"},
        "written_as": "mjcf",
    }
    loud = outcome(smoothed(0.3), gains=(1.0, 0.9))
    kept, force = led(WORLD, loud, [(None, finer)], True)
    assert kept == finer and force["place"]["name"] == "shoulder"
    assert led(WORLD, loud, [(None, finer)], False) == [finer]


def places(given, something):
    return [f["place"]["name"] for f in led(WORLD, given, [], something)]


def test_a_force_without_a_name_is_told_only_where_a_perfect_simulator_is_worth_its_price():
    price = PRICE * unnamed.UNNAMED
    told = lambda *gains: places(outcome(smoothed(0.3), gains=gains), True)
    assert told(0.9 * price, 0.9 * price) == []
    assert told(1.2 * price, 1.1 * price) == ["shoulder"]
    assert told(0.9 * price, 1.1 * price) == ["elbow"]
    chance = outcome(smoothed(0.3))
    chance.lacks = [Comparison(1.0, p) for p in (0.03, 0.02)]  # two joints were asked
    assert places(chance, True) == ["elbow"]


def test_what_held_out_recordings_do_not_show_is_no_claim():
    loud = outcome(smoothed(0.3), depends=DEPENDS, gains=(1.0, 0.9), gone=[FRICTION])
    assert places(loud, True) == ["elbow"] and places(loud, False) == []


def test_an_unknown_force_names_the_variables_that_it_follows_best():
    some = [("elbow", ("time",)), ("shoulder", ("position:elbow",)), ("elbow", ("time", "x"))]
    some += [("elbow", ("y", "z"))]
    [only] = led(WORLD, outcome(smoothed(0.3), depends=some, gains=(0, 1)), [], True)
    assert only["depends_on"] == ["time", "x", "y"]


def test_what_kept_back_recordings_spoke_against_is_an_unknown_force_at_its_joint():
    loud = smoothed(0.3, shoulder=0.9)
    elsewhere = [d for d in DEPENDS if d[0] == "shoulder"]
    given = outcome(loud, depends=elsewhere, gone=[FRICTION])
    [only] = led(WORLD, given, [], True)
    assert (only["effect"], only["place"]["name"]) == ("unknown", "elbow")
    assert only["depends_on"] == ["velocity:elbow"] and not only["adequate"]
    [only] = led(WORLD, outcome(loud, depends=DEPENDS, gone=[FRICTION]), [], True)
    assert only["depends_on"] == ["velocity:elbow", "position:elbow"]  # what it leaves as well
    kept = led(WORLD, outcome(loud, 0.1, gone=[FRICTION]), [finding(MASS)], True)
    assert [f["effect"] for f in kept] == ["mass"]
    curve = WORLD.curve("elbow", "position:elbow", (0.0, 0.5, 1.0))  # tried, and never earned
    assert led(WORLD, outcome(loud, gains=(0, 0), gone=[curve]), [], True) == []


def test_what_lies_within_the_noise_says_nothing_against_a_name():
    [only] = led(WORLD, outcome(smoothed(0.1), np.nan), [finding(MASS)], True)
    assert only["effect"] == "mass" and only["adequate"]
    assert only["evidence"]["error_left"] is None


def test_a_value_at_the_edge_of_what_was_tried_is_no_name():
    edge = plausible(FRICTION, USUAL).high[0]
    given = outcome(smoothed(1.0), 0.1, DEPENDS, friction=edge)
    [only] = led(WORLD, given, [finding(FRICTION)], True)
    assert only["effect"] == "unknown"
    assert [o["effect"] for o in only["also_possible"]] == ["coulomb_friction"]
