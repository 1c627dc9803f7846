"""Every rule of the benchmark, each on a case made for it."""

import pytest

from diagnosis.trials.scoring import assign, score_findings


def hidden(
    effect="coulomb_friction", name="joint0", kind="joint", required=True, needs=(), **values
):
    return {
        "effect": effect,
        "place": {"kind": kind, "name": name},
        "parameters": values or {"frictionloss": 1.0},
        "needs": list(needs),
        "required": required,
    }


def finding(
    effect="coulomb_friction", name="joint0", kind="joint", others=(), depends=(), **values
):
    values = values or {"frictionloss": (1.0, 0.9, 1.1)}
    named = lambda k, v: {"name": k, "nominal": 0.0, "value": v[0], "low": v[1], "high": v[2]}
    return {
        "effect": effect,
        "place": {"kind": kind, "name": name},
        "parameters": [named(k, v) for k, v in values.items()],
        "depends_on": list(depends),
        "also_possible": list(others),
    }


def score(items, findings, distinct=None):
    distinct = distinct or [item["required"] for item in items]
    return score_findings({"hidden": items, "distinct": distinct}, findings)


def test_right_name_and_value_is_a_strict_success():
    got = score([hidden()], [finding()])
    assert got.strict and got.first == got.found == got.valued == 1 and not got.false
    assert got.matches[0].values[0].held


def test_nothing_hidden_and_nothing_said_is_a_strict_success():
    assert score([], []).strict


@pytest.mark.parametrize("said", [{"effect": "viscous_damping"}, {"name": "joint1"}])
def test_wrong_effect_or_place_is_a_miss_and_a_false_claim(said):
    got = score([hidden()], [finding(**said)])
    assert not got.strict and got.found == 0 and got.false == (0,)


def test_any_claim_about_a_null_is_false():
    got = score([], [finding(), finding("time_step", "world", "world")])
    assert got.false == (0, 1) and not got.strict


def test_time_step_beside_a_right_finding_is_neutral():
    got = score([hidden()], [finding("time_step", "world", "world"), finding()])
    assert got.strict and got.neutral == (0,)


def test_a_finer_time_step_is_true_of_every_trial():
    finer = finding("time_step", "world", "world", timestep=(-0.1, -0.2, 0.0))  # below nominal
    assert score([], [finer]).strict
    got = score([hidden()], [finer, finding(name="joint3")])
    assert got.neutral == (0,) and got.false == (1,)


def test_time_step_beside_a_wrong_finding_is_false():
    got = score([hidden()], [finding("time_step", "world", "world"), finding(name="joint3")])
    assert got.false == (0, 1)


def test_a_declared_class_counts_but_not_as_first_name():
    said = finding("viscous_damping", damping=(2.0, 1.0, 3.0), others=[finding()])
    got = score([hidden()], [said])
    assert got.strict and got.found == 1 and got.first == 0
    assert got.matches[0].listed and got.matches[0].class_size == 1
    assert got.matches[0].values[0].value == 1.0  # the listed effect's own


def test_a_class_longer_than_three_is_cut():
    others = [finding("mass", "link0", "body"), finding("gain"), finding("bias"), finding()]
    assert score([hidden()], [finding("viscous_damping", others=others)]).found == 0


def test_one_finding_matches_one_truth():
    pair = [hidden(), hidden("viscous_damping", damping=2.0)]
    both = finding(others=[finding("viscous_damping", damping=(2.0, 1.9, 2.1))])
    got = score(pair, [both])
    assert got.found == 1 and got.first == 1 and not got.strict


def test_matching_finds_all_that_can_be_matched():
    pair = [hidden(), hidden("viscous_damping", damping=2.0)]
    both = finding(others=[finding("viscous_damping", damping=(2.0, 1.9, 2.1))])
    first_only = finding()
    assert assign(pair, [both, first_only]) == {1: 0, 0: 1}


def test_the_same_thing_said_twice_is_false_once():
    got = score([hidden()], [finding(), finding()])
    assert got.found == 1 and len(got.false) == 1


@pytest.mark.parametrize("value, near", [(1.049, True), (1.051, False), (0.949, False)])
def test_values_within_five_percent(value, near):
    got = score([hidden()], [finding(frictionloss=(value, 0.5, 1.5))])
    assert got.found == 1 and (got.valued == 1) is near and got.strict is near


@pytest.mark.parametrize("value, near", [(0.0, True), (0.019, True), (0.021, False)])
def test_a_truth_of_zero_is_told_within_five_percent_of_what_there_was_too_much(value, near):
    said = finding(frictionloss=(value, 0.0, 0.1))
    said["parameters"][0]["nominal"] = 0.4
    assert score([hidden(frictionloss=0.0)], [said]).strict is near


def test_a_value_of_null_is_not_right():
    assert score([hidden()], [finding(frictionloss=(None, None, None))]).valued == 0


def test_interval_that_misses_the_truth():
    value = score([hidden()], [finding(frictionloss=(1.02, 1.01, 1.03))]).matches[0].values[0]
    assert value.near and value.held is False


def test_interval_not_given():
    value = score([hidden()], [finding(frictionloss=(1.02, None, None))]).matches[0].values[0]
    assert value.held is None


def test_a_phase_is_compared_around_the_circle():
    item = hidden("cogging", amplitude=2.0, phase=5.71)
    said = lambda phase: finding("cogging", amplitude=(2.0, 1.9, 2.1), phase=phase)
    assert score([item], [said((-0.573, -0.6, -0.5))]).strict
    assert score([item], [said((-0.573, -0.6, -0.5))]).matches[0].values[1].held
    assert not score([item], [said((0.573, 0.5, 0.6))]).strict


def test_vectors_are_judged_by_their_length():
    item = hidden("gravity", "world", "world", x=0.0, y=0.5, z=-9.8)
    near = finding("gravity", "world", "world", x=(0.3, 0, 1), y=(0.3, 0, 1), z=(-9.8, -10, -9))
    far = finding("gravity", "world", "world", x=(0.8, 0, 1), y=(0.5, 0, 1), z=(-9.8, -10, -9))
    assert score([item], [near]).valued == 1
    assert score([item], [far]).valued == 0


def test_a_single_number_is_compared_whatever_its_name():
    item = hidden("delay", "drive0", "actuator", seconds=0.02)
    said = finding("delay", "drive0", "actuator", delay=(0.0201, 0.019, 0.021))
    assert score([item], [said]).valued == 1


def test_unknown_needs_place_and_variable():
    item = hidden("unknown", needs=["velocity:joint0"], amplitude=1.0)
    right = finding("unknown", depends=["velocity:joint0"])
    assert score([item], [right]).strict
    assert score([item], [finding("unknown", depends=["position:joint0"])]).found == 0
    assert score([item], [finding("unknown", "joint1", depends=["velocity:joint0"])]).found == 0


def test_a_force_that_is_either_of_two_variables_is_told_by_one():
    item = hidden("unknown", needs=["velocity:joint0|position:joint0"], amplitude=1.0)
    for variable, found in (("velocity", 1), ("position", 1), ("control", 0)):
        said = finding("unknown", depends=[f"{variable}:joint0"])
        assert score([item], [said]).found == found


def test_what_a_drive_is_asked_for_may_be_told_as_its_joints_load():
    item = hidden("unknown", needs=["control:drive0"], amplitude=1.0)
    for variable, found in (("load:joint0", 1), ("load:joint1", 0), ("position:joint0", 0)):
        assert score([item], [finding("unknown", depends=[variable])]).found == found


@pytest.mark.parametrize(
    "low, high, strict",
    [
        ((-0.0093, -0.01, -0.009), (None, None, None), True),  # no recording meets the other side
        ((-0.0093, -0.01, -0.009), (1.21, 1.2, 1.22), True),
        ((-0.08, -0.1, -0.07), (1.2, 1.1, 1.3), False),  # 7 % of the range
    ],
)
def test_a_stop_is_right_within_a_twentieth_of_its_range(low, high, strict):
    item = hidden("joint_stop", low=-0.01, high=1.2)
    assert score([item], [finding("joint_stop", low=low, high=high)]).strict == strict


@pytest.mark.parametrize("effect", ["gravity", "joint_stop"])
def test_a_name_without_any_value_is_not_right(effect):
    values = {"x": 0.4, "y": 0.0, "z": -9.8} if effect == "gravity" else {"low": -1.0, "high": 1.0}
    bare = finding(effect) | {"parameters": []}
    got = score([hidden(effect, **values)], [bare])
    assert got.found == 1 and not got.strict


def test_unknown_that_depends_on_everything_says_nothing():
    item = hidden("unknown", needs=["velocity:joint0"], amplitude=1.0)
    everything = ["velocity:joint0", "position:joint0", "control:drive0", "time"]
    assert score([item], [finding("unknown", depends=everything)]).found == 0


def test_what_the_data_cannot_show_is_not_asked_for():
    got = score([hidden()], [], distinct=[False])
    assert got.needed == () and got.strict


def test_one_claim_in_place_of_what_cannot_be_told_apart_is_neutral():
    claims = [finding("viscous_damping"), finding("gain", "drive0", "actuator")]
    got = score([hidden()], claims, distinct=[False])
    assert got.neutral == (0,) and got.false == (1,)
    elsewhere = score([hidden()], [finding("viscous_damping", "joint4")], distinct=[False])
    assert elsewhere.false == (0,)


def test_a_wrong_nominal_value_may_be_put_right_and_need_not_be():
    items = [hidden(), hidden("mass", "link0", "body", required=False, mass=2.0)]
    mass = finding("mass", "link0", "body", mass=(2.3, 2.2, 2.4))
    assert score(items, [finding()]).strict
    got = score(items, [finding(), mass])
    assert got.strict and not got.false


def test_coupled_joints_in_either_order():
    item = hidden("coupled_friction", "joint0+joint1", level=1.0)
    said = finding("coupled_friction", "joint1+joint0", level=(1.0, 0.9, 1.1))
    assert score([item], [said]).strict


def test_a_value_that_was_fitted_wrong_takes_no_finding_from_what_is_asked_for():
    asked = hidden("servo_damping", "drive0", "actuator", kv=2.0)
    fitted = hidden("viscous_damping", required=False, damping=0.1)
    other = {
        "effect": "servo_damping",
        "place": {"kind": "actuator", "name": "drive0"},
        "parameters": [{"name": "kv", "nominal": 1.0, "value": 2.0}],
    }
    said = finding("viscous_damping", damping=(1.1, 1.0, 1.2), others=[other])
    got = score([asked, fitted], [said])
    assert got.strict and not got.matches[1].finding


@pytest.mark.parametrize("value, right", [(1.0, True), (0.7, True), (-0.2, False), (2.5, False)])
def test_a_value_that_was_fitted_wrong_may_be_put_right_and_not_made_worse(value, right):
    said = finding("mass", "link0", "body", mass=(value, value - 0.1, value + 0.1))
    got = score([hidden("mass", "link0", "body", required=False, mass=1.0)], [said])
    assert got.strict == right and got.false == (() if right else (0,))


def test_a_component_that_a_member_of_a_class_leaves_as_it_was_is_not_shown():
    truth = hidden("inertia", "link0", "body", ixx=3.0, iyy=2.0, izz=0.1)
    parts = [("ixx", 1.0, 3.01), ("iyy", 1.0, 1.0), ("izz", 0.1, 0.1)]
    member = {
        "effect": "inertia",
        "place": truth["place"],
        "parameters": [{"name": n, "nominal": a, "value": v} for n, a, v in parts],
    }
    said = finding("armature", armature=(1.0, 0.9, 1.1), others=[member])
    assert score([truth], [said]).strict
