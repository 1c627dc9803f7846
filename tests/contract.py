"""What the contract says of diagnosis.json: the schema that ships, and what a schema cannot say."""

import json
import re
from pathlib import Path

import jsonschema

from diagnosis import report

SCHEMA_FILE = Path(report.__file__).with_name("diagnosis.schema.json")

NUMBER, TEXT = (int, float), str
PLACE = {"kind": TEXT, "name": TEXT}
PARAMETER = {"name": TEXT, "nominal": (int, float, type(None)), "value": NUMBER, "unit": TEXT}
ERROR = {"before": NUMBER, "after": NUMBER, "floor": NUMBER}
SCHEMA = {
    "format": int,
    "verdict": TEXT,
    "noise": dict,
    "findings": [
        {
            "effect": TEXT,
            "place": PLACE,
            "parameters": [{**PARAMETER, "low": NUMBER, "high": NUMBER}],
            "evidence": {"held_out_error_removed": NUMBER, "p_value": NUMBER},
            "depends_on": [TEXT],
            "when": (dict, type(None)),
            "written_as": TEXT,
            "also_possible": [{"effect": TEXT, "place": PLACE, "parameters": [PARAMETER]}],
        }
    ],
    "fit": {"train": ERROR, "held_out": {**ERROR, "horizon_s": NUMBER, "curve": list}},
    "unexplained": {"fraction": NUMBER, "place": (dict, type(None)), "depends_on": [TEXT]},
}


def conforms(value, schema, where="$"):
    """Asserts that value has the schema's shape: dicts with at least these keys, lists of one form,
    types."""
    if isinstance(schema, dict):
        assert isinstance(value, dict), where
        for key, inner in schema.items():
            assert key in value, f"{where}.{key} is missing"
            conforms(value[key], inner, f"{where}.{key}")
    elif isinstance(schema, list):
        assert isinstance(value, list), where
        for k, item in enumerate(value):
            conforms(item, schema[0], f"{where}[{k}]")
    else:
        assert isinstance(value, schema) and not (isinstance(value, bool) and schema is not bool), (
            f"{where} is {value!r}"
        )


def strict(path):
    """What a JSON file holds; NaN and infinity are refused, as other programs do."""

    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    return json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)


def validator():
    """A validator by the schema file of format 2."""
    schema = json.loads(SCHEMA_FILE.read_text(encoding="utf-8"))
    return jsonschema.Draft202012Validator(schema)


def contract(summary):
    """Asserts everything the contract says of diagnosis.json. The shape is the schema file's;
    format 1, from before that file, has one of its own here."""
    if summary["format"] == 1:
        conforms(summary, SCHEMA)
        assert summary["verdict"] in ("match", "mismatch")
        assert (summary["verdict"] == "mismatch") == bool(summary["findings"])
    else:
        validator().validate(summary)
        assert summary["verdict"] != "match" or not summary["findings"]
        assert summary["verdict"] != "mismatch" or summary["findings"]
    assert all(isinstance(v, NUMBER) and v > 0 for v in summary["noise"].values())
    for found in summary["findings"]:
        assert found["place"]["kind"] in ("joint", "actuator", "body", "geom", "sensor", "world")
        assert found["place"]["kind"] != "world" or found["place"]["name"] == "world"
        assert found["written_as"] in ("mjcf", "python", "measurement", "none")
        assert len(found["also_possible"]) <= 3
        for p in found["parameters"]:
            assert None in (p["low"], p["value"], p["high"]) or p["low"] <= p["value"] <= p["high"]
        for name in found["depends_on"]:
            assert name == "time" or re.fullmatch(
                r"(position|velocity|control|contact|load):.+", name
            )
        when = found["when"]
        assert (
            when is None
            or "time" in when
            and len(when["time"]) == 2
            or all(len(limits) == 2 for limits in when.values())
        )
