"""What the contract says of diagnosis.json."""

import re

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
    """Asserts that value has the schema's shape: dicts with at least these keys, lists of one form, types."""
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


def contract(summary):
    """Asserts everything the contract says of diagnosis.json that a shape cannot."""
    conforms(summary, SCHEMA)
    assert summary["format"] == 1 and summary["verdict"] in ("match", "mismatch")
    assert (summary["verdict"] == "mismatch") == bool(summary["findings"])
    assert all(isinstance(v, NUMBER) and v > 0 for v in summary["noise"].values())
    for found in summary["findings"]:
        assert found["place"]["kind"] in ("joint", "actuator", "body", "geom", "sensor", "world")
        assert found["place"]["kind"] != "world" or found["place"]["name"] == "world"
        assert (
            found["written_as"] in ("mjcf", "measurement", "none")
            and len(found["also_possible"]) <= 3
        )
        for p in found["parameters"]:
            assert p["low"] <= p["value"] <= p["high"]
        for name in found["depends_on"]:
            assert name == "time" or re.fullmatch(r"(position|velocity|control|contact):.+", name)
        when = found["when"]
        assert (
            when is None
            or "time" in when
            and len(when["time"]) == 2
            or all(len(limits) == 2 for limits in when.values())
        )
