"""Whole diagnoses of a small pendulum that lacks something known, or nothing."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from plants import DRIVEN_PENDULUM, NOISE, recorded

from diagnosis import estimator
from diagnosis.estimator import identify
from diagnosis.recordings.recording import RecordingError
from diagnosis.selection.criterion import PRICE, Score, complexity
from diagnosis.simulation.simulator import World


def diagnosed(**hidden):
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    runs = [recorded(f"run{i}.csv", i, **hidden) for i in range(3)]
    return identify(world, runs[:2], runs[2:])


def named(diagnosis):
    return [(f["effect"], f["place"]["name"]) for f in diagnosis.summary["findings"]]


def stock_error(xml, recording, noise):
    """The reported error by a plain loop in stock MuJoCo."""
    model = mujoco.MjModel.from_xml_string(xml)
    data, square = mujoco.MjData(model), []
    q, time = recording.qpos[:, 0], recording.time
    for first in range(0, len(time) - 30, 30):
        mujoco.mj_resetData(model, data)
        a, b = max(first - 1, 0), first + 1
        data.qpos[:], data.qvel[:] = q[first], (q[b] - q[a]) / (time[b] - time[a])
        for row in range(first, first + 30):
            data.ctrl[:] = recording.ctrl[row]
            mujoco.mj_step(model, data, 2)
            square.append((data.qpos[0] - q[row + 1]) ** 2)
    return np.sqrt(np.mean(square)) / noise


def test_nothing_missing_is_a_match():
    summary = diagnosed().summary
    assert summary["verdict"] == "match" and not summary["findings"]
    assert summary["fit"]["held_out"]["before"] == summary["fit"]["held_out"]["after"]
    assert summary["unexplained"]["fraction"] == 0.0
    assert summary["noise"]["qpos:pivot"] == pytest.approx(NOISE, rel=0.15)
    assert summary["missing_force"]["pivot"]["rms"] < 1e-3


def test_a_dry_friction_is_named_first_within_its_interval():
    diagnosis = diagnosed(push=lambda time, q, v: -0.05 * np.tanh(v / 0.002))
    summary = diagnosis.summary
    assert summary["verdict"] == "mismatch" and named(diagnosis)[0] == ("coulomb_friction", "pivot")
    [value] = summary["findings"][0]["parameters"]
    assert value["value"] == pytest.approx(0.05, rel=0.02)
    assert value["low"] < 0.0505 and 0.0495 < value["high"]
    force = summary["missing_force"]["pivot"]
    assert force["rms"] == pytest.approx(0.05, rel=0.2) and force["after"] < 0.2 * force["rms"]
    assert force["depends_on"] == ["velocity:pivot"]


def test_damping_is_named_and_the_corrected_file_reproduces_the_error():
    diagnosis = diagnosed(damping=0.1)
    assert named(diagnosis) == [("viscous_damping", "pivot")]
    [value] = diagnosis.summary["findings"][0]["parameters"]
    assert value["low"] < 0.1 < value["high"] and value["value"] == pytest.approx(0.1, rel=0.02)
    fit = diagnosis.summary["fit"]["held_out"]
    assert fit["after"] < 0.3 * fit["before"]
    noise = diagnosis.summary["noise"]["qpos:pivot"]
    assert stock_error(diagnosis.corrected_xml, diagnosis.held_out[0], noise) == pytest.approx(
        fit["after"], rel=1e-3
    )


def test_two_effects_are_both_found():
    diagnosis = diagnosed(damping=0.1, push=lambda time, q, v: 0.15)
    found = [
        {(f["effect"], f["place"]["name"])}
        | {(a["effect"], a["place"]["name"]) for a in f["also_possible"]}
        for f in diagnosis.summary["findings"]
    ]
    assert len(found) == 2
    assert any(("viscous_damping", "pivot") in f for f in found)
    assert any(("spring_offset", "pivot") in f for f in found)


def test_what_no_catalogue_knows_is_called_unknown():
    diagnosis = diagnosed(push=lambda time, q, v: -0.4 * np.sin(5 * q) * (q > 0))
    first = diagnosis.summary["findings"][0]
    assert (first["effect"], first["place"]["name"]) == ("unknown", "pivot")
    assert "position:pivot" in first["depends_on"]
    assert diagnosis.summary["verdict"] == "unresolved"


def test_a_damping_in_one_direction_is_no_viscous_damping():
    """The nearest name removes half of the error: a curve takes its place, and predicts."""
    summary = diagnosed(push=lambda time, q, v: -0.3 * max(v, 0.0)).summary
    [finding] = summary["findings"]
    assert (finding["effect"], finding["place"]["name"]) == ("unknown", "pivot")
    assert finding["depends_on"] == ["velocity:pivot"]
    figures = summary["fit"]["held_out"]
    assert figures["after"] < 0.2 * figures["before"]


def test_a_push_for_a_while_is_placed_in_time():
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    runs = [
        recorded("calm.csv", 0),
        recorded("pushed.csv", 1, push=lambda time, q, v: 0.5 * (1.5 < time < 2.5)),
        recorded("held.csv", 2),
    ]
    [finding] = identify(world, runs[:2], runs[2:]).summary["findings"]
    assert finding["when"]["recording"] == "pushed.csv"
    assert finding["when"]["time"] == pytest.approx([1.5, 2.5], abs=0.1)


class Set(SimpleNamespace):
    """A Fitted set: its setting and loss."""


class Search:
    """A search that ends with a friction of 0.2; judge: the loss of each friction on all windows,
    beside an event whose price is not counted."""

    def __init__(self, world, train, say=None, log=None):
        self.world, self.train, self.say, self.log = world, train, say, log or (lambda line: None)
        self.smoother = SimpleNamespace(locate=lambda setting, near: (dict(setting), near))

    def run(self, setting):
        self.begun_with = setting
        ended = Set(setting={"friction": 0.2}, loss=0.0)
        return estimator.Found(ended, *[None] * 4, SimpleNamespace(fit=self.refitted), *[None] * 3)

    def refitted(self, setting):
        return Set(setting=setting, loss=0.0)

    def begun(self, judge, setting):
        priced = judge[setting["friction"]] + PRICE * complexity([PUSH.candidate])
        return SimpleNamespace(fit=lambda setting, steps: Set(loss=priced))


class Push:
    effect = SimpleNamespace(simplicity=1, timed=True)
    when = {"recording": "run.csv", "time": [1.0, 2.0]}
    parameters = range(3)


PUSH = SimpleNamespace(candidate=Push(), values=(1.0, 0.0, 0.0))


@pytest.mark.parametrize(
    "beside, event, friction",
    [
        ({0.1: -2.0, 0.2: -3.0}, PUSH, 0.2),  # what the search in calm recordings ended with
        ({0.1: -3.0, 0.2: -2.0}, PUSH, 0.1),  # that predicts worse than what was found before
        ({0.1: -0.5, 0.2: -0.9}, None, 0.1),  # and neither is better for the event
    ],
)
def test_what_lasts_is_searched_again_where_an_event_is_not(monkeypatch, beside, event, friction):
    monkeypatch.setattr(estimator, "Identification", Search)
    monkeypatch.setattr(estimator.transients, "calm", lambda train, event: "calm")
    monkeypatch.setattr(estimator, "_earned", lambda search, judge, fitted: fitted)
    monkeypatch.setattr(estimator, "condition_of", lambda setting: None)
    before = Set(setting={"friction": 0.1}, loss=-1.0)
    found = estimator.Found(before, *[None] * 4, beside, *[None] * 3)
    whole = Search("world", "all of it")
    search, ended, told = estimator._undisturbed(whole, found, PUSH)
    assert told is event and ended.fitted.setting == {"friction": friction}
    if event:
        assert (search.world, search.train) == ("world", "calm")
        assert ended.trajectory == (ended.fitted.setting, None)  # under what it ended with
        assert search.begun_with == {"friction": 0.1}  # begun at nothing it may end anywhere
    else:
        assert search is whole and ended is found


def test_there_is_no_event_where_without_its_time_something_else_acts_at_times(monkeypatch):
    monkeypatch.setattr(estimator, "Identification", Search)
    monkeypatch.setattr(estimator.transients, "calm", lambda train, event: "calm")
    monkeypatch.setattr(estimator, "condition_of", lambda setting: "run.csv")
    before = Set(setting={"friction": 0.1}, loss=-1.0)
    found = estimator.Found(before, *[None] * 4, {0.1: -2.0, 0.2: -3.0}, *[None] * 3)
    whole = Search("world", "all of it")
    assert estimator._undisturbed(whole, found, PUSH) == (whole, found, None)


@pytest.mark.parametrize("worth", [True, False])
def test_what_is_kept_is_earned_over_nothing(worth):
    judge = SimpleNamespace(fit=lambda setting: "nothing")
    search = SimpleNamespace(
        pruned=lambda judge, fitted, now: f"{fitted}, pruned", earned=lambda before, after: worth
    )
    kept = estimator._earned(search, judge, "friction")
    assert kept == ("friction, pruned" if worth else "nothing")


def test_recordings_without_positions_are_refused():
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    run = recorded("run.csv", 0)
    run.qpos[:] = np.nan
    with pytest.raises(RecordingError, match="not enough data"):
        identify(world, [run], [])


def test_what_is_left_is_looked_at_while_the_effects_of_a_set_act(monkeypatch):
    monkeypatch.setattr(estimator.moments, "followed", lambda *given: given[-1])
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    search = SimpleNamespace(world=world, train=[])
    when = {"recording": "1.csv", "time": [0.0, 4.0]}
    friction = world.candidate("coulomb_friction", "pivot")
    for candidate, asked in ((friction, None), (world.localised(friction, when), when)):
        fitted = SimpleNamespace(setting={candidate: (0.1,)})
        assert estimator._left(search, fitted, "motion") == asked


@pytest.mark.parametrize("better", [False, True])
def test_what_is_left_without_a_name_is_looked_at_in_finer_steps(monkeypatch, better):
    monkeypatch.setattr(estimator, "lacking", lambda fitted: fitted.setting)
    told = lambda world, trajectory, train, when: trajectory
    monkeypatch.setattr(estimator.moments, "followed", told)
    monkeypatch.setattr(estimator, "condition_of", lambda setting: None)
    locate = lambda setting, near: f"{near} in {setting}"
    found = SimpleNamespace(judge=None, smoother=SimpleNamespace(locate=locate))
    fitted = SimpleNamespace(setting="usual steps")
    finer = SimpleNamespace(setting="finer steps") if better else fitted
    search = SimpleNamespace(world=None, train=[], finer=lambda judge, given: finer)
    outcome = SimpleNamespace(found=found, fitted=fitted, trajectory="motion", left="as it was")
    estimator._nameless(search, outcome)
    assert outcome.lacks == finer.setting
    assert outcome.left == ("motion in finer steps" if better else "as it was")


@pytest.mark.parametrize(
    "joint, own, earned, chosen",
    [
        (0, 0.0, ["own"], "other"),
        (0, -2.0, ["other"], "own"),
        (0, -2.0, ["own"], "both"),  # chance decides nothing for one that is worse
        (0, 0.0, ["other"], "both"),
        (1, 0.0, [], "both"),
    ],
)
def test_a_name_beside_a_curve_of_its_joint_has_to_be_earned_over_the_better_curve(
    monkeypatch, joint, own, earned, chosen
):
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    curve, name = world.curve("pivot", "time", (0.0, 1.0)), world.candidate("back_emf", "drive")
    both = SimpleNamespace(setting={curve: (0.1, 0.1), name: (0.1,)})
    sets = {
        "both": both,
        "other": SimpleNamespace(setting={curve: (0.2, 0.1)}, loss=-1.0),
        "own": SimpleNamespace(setting={curve: (0.1, 0.1)}, loss=own),
    }
    monkeypatch.setattr(world, "joints", lambda place: (joint if place.name == "drive" else 0,))
    asked = lambda search, found, fitted, names, joint: {*names} == {curve, name} and sets["other"]
    monkeypatch.setattr(estimator, "_instead", asked)
    judge = SimpleNamespace(
        fit=lambda setting, steps: setting == sets["own"].setting and sets["own"]
    )
    search = SimpleNamespace(
        world=world, earned=lambda before, after: any(before is sets[name] for name in earned)
    )
    told = estimator._one_curve(search, SimpleNamespace(judge=judge), both, lambda what: None)
    assert told is sets[chosen]


@pytest.mark.parametrize(
    "worse, kept",
    [
        ({"friction": -5.0, "lag": -6.0}, {"gain", "lag"}),
        ({"friction": -5.0, "lag": 2.0}, {"gain", "friction"}),  # as a class would have it
        ({"friction": 2.0, "lag": 2.0}, {"gain"}),
    ],
)
def test_what_made_up_for_a_finding_that_goes_may_be_another_by_the_same_recordings(
    monkeypatch, worse, kept
):
    fit = lambda setting, steps=0: Set(setting=dict(setting))
    asked = []
    again = lambda setting, trajectory: Set(setting={**setting, "friction": 0.1})
    search = SimpleNamespace(candidates=["gain", "friction", "delay"], again=again, world=None)
    found = SimpleNamespace(judge=SimpleNamespace(fit=fit))
    others = {"gain": [("delay", 0.02)]}
    outcome = SimpleNamespace(found=found, trajectory=None, others=others)
    named = lambda setting: next(iter(setting.keys() - {"gain"}))
    decides = SimpleNamespace(worse=lambda new, old: worse[named(new)], scattered=lambda: 1.0)

    def classes(search, found, fitted, log, candidates, near):
        asked.extend(near)
        setting = {"lag" if c == "friction" else c: v for c, v in fitted.setting.items()}
        return Set(setting=setting), {c: [] for c in near}

    monkeypatch.setattr(estimator, "_classes", classes)
    monkeypatch.setattr(estimator, "_earned", lambda search, judge, fitted: fitted)
    monkeypatch.setattr(estimator.rivals, "meet", lambda world, c, out: False)
    setting = estimator._refitted(search, outcome, decides, None, {"gain": 0.8}, "delay")
    assert set(setting) == kept and asked == (["friction"] if len(kept) > 1 else [])
    assert "delay" not in search.candidates  # no more, nor as what a finding may be
    assert outcome.others["gain"] == []


def test_a_finer_time_step_alone_is_nothing_earned():
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    step, damping = (
        world.candidate("time_step", "world"),
        world.candidate("viscous_damping", "pivot"),
    )
    found = lambda *some, event=None: estimator._earns_something(
        SimpleNamespace(fitted=SimpleNamespace(setting=dict.fromkeys(some)), event=event)
    )
    assert not found() and not found(step)
    assert found(step, damping) and found(damping) and found(event="a push")


@pytest.mark.parametrize("both_show", [False, True])
def test_a_component_that_no_recording_shows_stays_as_it_was(monkeypatch, both_show):
    """Beside one that shows; unless without it the set is worse."""
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    of = lambda effect, place="pivot": world.candidate(effect, place)
    push, damping, gravity = (
        of("external_force", "arm"),
        of("viscous_damping"),
        of("gravity", "world"),
    )
    bounds = {push: [(0.9, 1.1), None, None], damping: [(0.1, 0.3)], gravity: [None] * 3}
    setting = {push: (1.0, 0.4, 0.0), damping: (0.2,), gravity: (0.1, 0.0, -9.7)}
    monkeypatch.setattr(estimator, "intervals", lambda fitted: bounds)
    search = SimpleNamespace(seen={}, earned=lambda before, after: both_show)
    judge = SimpleNamespace(fit=lambda setting, steps: Set(setting=setting))
    found = estimator._as_it_was(search, judge, Set(setting=setting)).setting
    assert found == {**setting, push: (1.0, 0.4 if both_show else 0.0, 0.0)}
    assert search.seen[push].tolist() == [True, both_show, both_show]  # no later fit moves them


def test_what_may_be_nothing_is_the_name_missed_least_whose_intervals_hold_the_nominal_value(
    monkeypatch,
):
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    of = lambda effect, place="pivot": world.candidate(effect, place)
    damping, friction, spring = map(of, ("viscous_damping", "coulomb_friction", "stiffness"))
    step, mass, load = of("time_step", "world"), of("mass", "arm"), of("load_friction")
    bounds = {damping: [(0.04, 0.07)], friction: [(0.0, 0.1)], spring: [(0.1, 0.3)]}
    bounds |= {step: [(0.0, 0.01)], mass: [None]}  # no name, and nothing known
    bounds[load] = [(0.0, 0.4), (0.0, 0.5), None]  # one of the two is there
    loss = {damping: 0.1, friction: 0.5}
    monkeypatch.setattr(estimator, "intervals", lambda fitted: bounds)
    monkeypatch.setattr(estimator, "without", lambda fitted, c: Set(loss=loss[c]))
    judge = SimpleNamespace(fit=lambda setting, steps: None)
    assert estimator._doubtful(judge, dict.fromkeys(bounds)) is damping
    assert estimator._doubtful(judge, dict.fromkeys([spring, step, mass, load])) is None


@pytest.mark.parametrize(
    "better, gain, chosen",
    [
        ((2.0, 9.0), 0.5, "first"),
        ((0.5, 9.0), 0.5, "second"),
        ((0.5, 0.5), 0.5, None),
        ((2.0, 9.0), 0.1, None),  # it is not worth its price to the recordings it was fitted to
    ],
)
def test_a_curve_is_handed_over_where_it_predicts_better_by_more_than_noise(better, gain, chosen):
    names = "first", "second"
    left = [SimpleNamespace(joint=n, candidate=n, values=(1.0,)) for n in names]
    groups = lambda loss: Score(
        loss, loss + np.linspace(-1e-3, 1e-3, 16), 4 * np.full(16, loss), ()
    )
    fit = lambda setting, steps=0: Set(setting=setting, score=groups(-gain if setting else 0.0))
    gains = dict(zip(names, better))
    handed = {"gain": (0.9,)}
    asked = lambda before, uncounted: before is handed and uncounted == 1
    worse = lambda before, setting, uncounted: (
        gains[min(setting)] if asked(before, uncounted) else np.nan
    )
    decides = SimpleNamespace(worse=worse, scattered=lambda: 1.0)
    outcome = SimpleNamespace(handed=SimpleNamespace(setting=handed))
    curve = estimator._best_curve(SimpleNamespace(fit=fit), outcome, decides, left)
    assert curve == ({chosen: (1.0,)} if chosen else None)


@pytest.mark.parametrize(
    "names, left, curve, takes, handed",
    [
        ({}, 0.0, True, True, True),
        ({"gain": 0.9}, 0.5, True, True, True),
        ({"gain": 0.9}, 0.1, True, True, False),  # the name is earned
        ({"gain": 0.9}, np.nan, True, True, False),  # hardly anything is missing there
        ({"gain": 0.9}, 0.5, False, True, False),  # no curve predicts better
        ({"gain": 0.9}, 0.5, True, False, False),  # kept-back recordings speak against it
    ],
)
def test_a_curve_takes_the_place_of_names_that_leave_much(
    monkeypatch, names, left, curve, takes, handed
):
    tried = []
    best = lambda judge, outcome, decides, curves: (
        tried.extend(c.joint for c in curves) or {"curve": 1.0} if curve and curves else None
    )
    monkeypatch.setattr(estimator, "physics", lambda setting: set(setting))
    monkeypatch.setattr(estimator, "share_left", lambda fitted: np.array([np.nan, left, 0.1]))
    monkeypatch.setattr(estimator, "channel", lambda fitted, dof: dof)
    monkeypatch.setattr(estimator, "_best_curve", best)
    monkeypatch.setattr(estimator.missing_force, "each_joint", lambda curves: curves)
    handing = lambda setting, gone: estimator.Handed(setting, None, None, {}, gone)
    accepted = lambda setting: handing(setting if takes else {}, [])
    curves = [SimpleNamespace(joint=joint) for joint in (2, 1, 0)]
    fitted, before = SimpleNamespace(setting=names), handing(names, ["delay"])
    outcome = SimpleNamespace(fitted=fitted, handed=before, dependences=curves)
    model = SimpleNamespace(joint=lambda joint: SimpleNamespace(dofadr=[joint]))
    fit = lambda setting, steps: SimpleNamespace(setting=setting)
    judge = SimpleNamespace(fit=fit, ahead=SimpleNamespace(model=model))
    estimator._curve_instead(judge, outcome, None, accepted)
    if tried:  # at the joint of which names leave much; of none, at the first two
        assert tried == ([1] if names else [2, 1])
    assert outcome.handed.gone == ["delay"]
    assert outcome.fitted.setting == outcome.handed.setting == ({"curve": 1.0} if handed else names)
