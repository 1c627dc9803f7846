"""The JSON Schema of diagnosis.json: what the contract allows passes, what it forbids does not."""

import copy
import re
from pathlib import Path

import jsonschema
import pytest
from contract import SCHEMA_FILE, validator

from diagnosis.effects import EFFECTS

DOCS = Path(__file__).resolve().parents[3] / "docs/diagnosis-json.md"
ERRORS = {"before": 30.0, "after": 2.0, "floor": None}
FRICTION = {
    "effect": "coulomb_friction",
    "place": {"kind": "joint", "name": "elbow"},
    "parameters": [
        {"name": "frictionloss", "nominal": 0.0, "value": 0.12, "low": 0.117, "high": 0.125}
        | {"unit": "N·m"}
    ],
    "evidence": {"held_out_error_removed": 0.93, "p_value": 1e-40},
    "adequate": True,
    "strains": None,
    "depends_on": ["velocity:elbow"],
    "when": None,
    "written_as": "mjcf",
    "also_possible": [
        {"effect": "dead_zone", "place": {"kind": "actuator", "name": "m"}, "parameters": []}
    ],
    "per_recording": [{"recording": "run1.csv", "value": 0.12, "interval": [0.11, 0.13]}],
    "constancy": 0.4,
}
COURSE = {"joint": "elbow", "recording": "run1.csv", "unit": "N·m"} | {
    key: [0.0, None] for key in ("time", "force", "sd", "position", "velocity")
}
SUMMARY = {
    "format": 2,
    "verdict": "mismatch",
    "noise": {"qpos:elbow": 0.0005, "qpos:cube:pos": 0.001},
    "findings": [FRICTION],
    "fit": {
        "train": ERRORS,
        "held_out": {**ERRORS, "horizon_s": 0.3, "curve": [{**ERRORS, "seconds": 0.1}]},
    },
    "missing_force": [COURSE],
    "unexplained": {"fraction": 0.02, "place": None, "depends_on": ["time"]},
}


def changed(**places):
    """SUMMARY with values put in: 'findings__0__when' is the path of a key."""
    summary = copy.deepcopy(SUMMARY)
    for path, value in places.items():
        *way, last = (int(k) if k.isdigit() else k for k in path.split("__"))
        inner = summary
        for key in way:
            inner = inner[key]
        if value is ...:
            del inner[last]
        else:
            inner[last] = value
    return summary


@pytest.mark.parametrize(
    "places",
    [
        {},
        {"verdict": "unresolved"},
        {"findings": [], "verdict": "match"},
        {"findings__0__when": {"recording": "run3.csv", "time": [2.0, 7.5]}},
        {"findings__0__when": {"qpos:elbow": [0.4, 0.8]}},
        {"findings__0__parameters__0__value": None},
        {"findings__0__place": {"kind": "joint", "name": "shoulder+elbow"}},
        {"findings__0__written_as": "python"},
        {"findings__0__per_recording": ...},
        {"missing_force": {"elbow": {"rms": 0.1, "unit": "N·m", "after": 0.0, "depends_on": []}}},
        {"missing_force": ...},
        {"something_new": 1},
    ],
    ids=str,
)
def test_what_the_contract_allows_passes(places):
    validator().validate(changed(**places))


@pytest.mark.parametrize(
    "places",
    [
        {"format": 1},
        {"verdict": "perhaps"},
        {"noise": {"elbow": 0.1}},
        {"noise": {"qpos:elbow": 0.0}},
        {"findings__0__adequate": ...},
        {"findings__0__adequate": None},
        {"findings__0__effect": "Coulomb friction"},
        {"findings__0__depends_on": ["speed:elbow"]},
        {"findings__0__when": {"time": [0, 1]}},
        {"findings__0__place": {"kind": "world", "name": "arm"}},
        {"findings__0__written_as": "xml"},
        {"findings__0__also_possible": [FRICTION] * 4},
        {"findings__0__parameters__0__low": ...},
        {"findings__0__evidence__p_value": 1.5},
        {"fit__held_out__curve": ...},
        {"unexplained__fraction": 1.2},
        {"missing_force": [{"joint": "elbow"}]},
    ],
    ids=str,
)
def test_what_the_contract_forbids_does_not(places):
    with pytest.raises(jsonschema.ValidationError):
        validator().validate(changed(**places))


def test_the_schema_is_one_itself():
    jsonschema.Draft202012Validator.check_schema(validator().schema)
    assert SCHEMA_FILE.name == "diagnosis.schema.json"


def test_the_documentation_lists_every_effect_and_every_key():
    text = DOCS.read_text(encoding="utf-8")
    effects, schema = text.partition("## The effects")[2], validator().schema
    named = set(re.findall(r"`([a-z_]+)`", effects))
    assert {effect.name for effect in EFFECTS} | {"unknown"} <= named
    keys = {*schema["properties"], *schema["$defs"]["finding"]["properties"]} - {"fit"}
    assert {key for key in keys if f"`{key}" not in text} == set()
