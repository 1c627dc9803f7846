"""What development.py says of a trial, from a made-up answer and diagnosis."""

from benchmarks import development

ANSWER = {
    "kind": "pair",
    "joints": 2,
    "stops": True,
    "free_base": False,
    "touched": 0.3,
    "plan": {"level": "brisk"},
    "over_noise": [12.34, 3.0],
    "distinct": [True, True],
    "hidden": [
        {
            "effect": "coulomb_friction",
            "place": {"kind": "joint", "name": "joint1"},
            "parameters": {"frictionloss": 0.2},
            "needs": [],
            "required": True,
            "removed": True,
        },
        {
            "effect": "unknown",
            "law": "Wear",
            "place": {"kind": "joint", "name": "joint0"},
            "parameters": {},
            "needs": ["velocity:joint0", "time"],
            "required": True,
        },
    ],
}
FRICTION = {
    "effect": "coulomb_friction",
    "place": {"kind": "joint", "name": "joint1"},
    "parameters": [{"name": "frictionloss", "nominal": 0.3, "value": 0.201}],
}
UNKNOWN = {
    "effect": "unknown",
    "place": {"kind": "joint", "name": "joint0"},
    "parameters": [],
    "depends_on": ["velocity:joint0"],
}


def row(number, findings, **values):
    summary = {"verdict": "mismatch", "findings": findings}
    measured = {"exit": 0, "prediction": "0.5", "error_before": "4", "error_after": "2"}
    told = development.verdict(number, ANSWER, summary)
    return told | measured | {"error_floor": "1.9", "seconds": "3.0", "note": ""} | values


def test_a_row_says_what_was_hidden_said_and_right():
    got = row(7, [FRICTION, UNKNOWN])
    assert got["hidden"] == "-coulomb_friction@joint1; unknown=Wear@joint0"
    assert got["said"] == "coulomb_friction@joint1(0.201); unknown@joint0(velocity:joint0)"
    assert (got["touches"], got["over_noise"]) == ("stops", "12.3 3.0")
    assert (got["needed"], got["found"], got["false"], got["strict"]) == (2, 1, 1, 0)
    assert got["unknown_placed"] == 1  # at the right joint, though not for all it depends on


def test_a_tool_without_a_diagnosis_names_nothing():
    got = development.verdict(7, ANSWER, None)
    assert (got["said"], got["strict"], got["found"], got["false"]) == ("-", 0, 0, 0)


def test_two_tables_differ_where_a_trial_does():
    before = [row(1, []), row(2, [FRICTION])]
    now = [row(2, [FRICTION]), row(1, [FRICTION]), row(3, [])]
    text = development.difference(now, before)
    assert text.count("before") == text.count("now ") == 1 and "said nothing" in text
    assert "no trial differs" in development.difference(before, before)


def test_totals_count_trials():
    text = development.totals([row(1, [FRICTION], prediction="1.2"), row(2, [FRICTION, UNKNOWN])])
    assert "pair    strict 0/2, named 0/2, false claim 1/2" in text
    assert "predicts worse than nominal 1/2, within 1.1 of the truth 2/2" in text


def test_totals_count_a_trial_without_an_answer():
    stopped = row(1, [], exit=-9, prediction="", error_after="")
    text = development.totals([row(2, [FRICTION]), stopped])
    assert "predicts worse than nominal 0/2, within 1.1 of the truth 1/2" in text


def test_numbers_of_trials():
    assert development.numbers("3,8-10") == {3, 8, 9, 10}
