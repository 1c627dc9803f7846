"""A diagnosis in words: places, times, stops, models that blow up, experiments for rivals."""

import itertools

import numpy as np
from contract import strict, validator
from report_example import finding

from diagnosis.effects import EFFECTS
from diagnosis.report import experiments, writer
from diagnosis.report import text as wording


def test_where_and_when_in_words():
    assert (
        wording.when_words({"qpos:elbow": [0.4, 0.8]})
        == ", where the position of elbow is between 0.400 and 0.800"
    )
    assert (
        wording.when_words({"qvel:elbow": [0, 2]})
        == ", where the velocity of elbow is between 0 and 2.00"
    )
    assert (
        wording.when_words({"recording": "run3.csv", "time": [2.0, 7.5]})
        == ", in run3.csv from 2.00 to 7.50 s"
    )
    assert wording.when_words(None) == ""


def test_a_stop_on_one_side_and_a_model_that_blows_up(diagnosis, tmp_path):
    """JSON keeps numbers where the contract has them; page and terminal say it in words."""
    stop = finding(
        "joint_stop",
        "joint",
        "elbow",
        0.0,
        0.0,
        0.0,
        "rad",
        parameters=[
            {
                "name": "low",
                "nominal": -np.inf,
                "value": -1e6,
                "low": -1e6,
                "high": -1e6,
                "unit": "rad",
            },
            {
                "name": "high",
                "nominal": np.inf,
                "value": 0.5,
                "low": 0.49,
                "high": 0.51,
                "unit": "rad",
            },
        ],
    )
    held = diagnosis.summary["fit"]["held_out"]
    diagnosis.summary["findings"] = [stop]
    held["before"], held["channels"]["qpos:elbow"]["before"] = np.inf, np.inf
    writer.write(diagnosis, tmp_path)
    written = strict(tmp_path / "diagnosis.json")
    assert (
        written["findings"][0]["parameters"][0]["value"] == -1e6
        and written["fit"]["held_out"]["before"] is None
    )
    validator().validate(written)
    page = (tmp_path / "report.html").read_text()
    assert (
        "joint stop high 0.500 ± 0.010 rad was left out (no stop below)" in page
        and "<td>no stop below</td>" in page
    )
    assert (
        "is 2.0 mrad at elbow, where the nominal model blows up" in page
        and "1000000" not in page
        and "nan %" not in page
    )
    assert "the nominal model blows up" in wording.terminal(written, "out", ["report.html"])


def test_the_verdict_counts_the_simulators_faults_apart_from_the_sensors():
    one, sensor = {"effect": "mass", "written_as": "mjcf"}, {"effect": "sensor_bias"}
    sensor["written_as"] = "measurement"
    said = lambda *findings: wording.verdict_words({"verdict": "mismatch", "findings": findings})
    assert said(one) == "One thing is wrong with the simulator."
    assert said(one, one) == "2 things are wrong with the simulator."
    words = "The simulator shows no fault, but one thing is wrong with the sensors."
    assert said(sensor) == words
    words = "2 things are wrong with the simulator, and one thing is wrong with the sensors."
    assert said(one, sensor, one) == words


def test_the_experiment_for_two_rivals():
    rival = {"effect": "lag", "place": {"kind": "actuator", "name": "drive"}}
    (line,) = experiments.advice(
        [
            {
                "effect": "delay",
                "place": {"kind": "actuator", "name": "drive"},
                "also_possible": [rival],
            },
            {"effect": "mass", "place": {"kind": "body", "name": "torso"}, "also_possible": []},
        ]
    )
    assert line.startswith("Delay of actuator drive or lag of actuator drive: drive with a sine")


def test_every_listed_pair_of_rivals_has_an_experiment_of_its_own():
    """Whichever of the two is the finding; and every effect of the table is one of the
    catalogue."""
    known = {effect.name for effect in EFFECTS}
    for effects, way in experiments.SEPARATING:
        assert effects <= known, effects - known
        for one, other in itertools.permutations(effects, 2):
            lines = [
                experiments.advice(
                    [
                        {
                            "effect": a,
                            "place": {"kind": "body", "name": "x"},
                            "also_possible": [
                                {"effect": b, "place": {"kind": "body", "name": "x"}}
                            ],
                        }
                    ]
                )[0]
                for a, b in ((one, other), (other, one))
            ]
            assert (
                lines[0].split(": ", 1)[1] == lines[1].split(": ", 1)[1]
                and experiments.OTHERWISE not in lines[0]
            )


def test_places_in_words():
    places = [("joint", "elbow"), ("joint", "hip+knee"), ("body", "a+b"), ("world", "world")]
    words = [wording.place_words({"kind": kind, "name": name}) for kind, name in places]
    assert words == ["joint elbow", "joints hip and knee", "body a+b", "the world"]
