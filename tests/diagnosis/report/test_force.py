"""The missing force on the page: which variable it is drawn over, how sure it is, what is said."""

import csv
import json
import types

import numpy as np
import pytest
from report_example import example

from diagnosis.report import force, sections, text, writer


@pytest.fixture
def diagnosis():
    return example()


def courses(function, seed=0, rows=400, sd=0.05):
    """One course each of joints a and b; the force at a is function(own position, own velocity,
    b's velocity, time) with noise of `sd`."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 8, rows)
    states = rng.uniform(-1, 1, (4, rows))
    made = []
    for k, joint in enumerate("ab"):
        position, velocity = states[2 * k : 2 * k + 2]
        value = function(states[0], states[1], states[3], time) if joint == "a" else np.zeros(rows)
        made.append(
            {
                "joint": joint,
                "recording": "run1.csv",
                "unit": "N",
                "time": list(time),
                "force": list(value + sd * rng.normal(size=rows)),
                "sd": [sd] * rows,
                "position": list(position),
                "velocity": list(velocity),
            }
        )
    return types.SimpleNamespace(summary={"missing_force": made})


@pytest.mark.parametrize(
    "function, variable",
    [
        (lambda p, v, w, t: np.sign(v), "velocity:a"),
        (lambda p, v, w, t: p**3, "position:a"),
        (lambda p, v, w, t: np.abs(w), "velocity:b"),
        (lambda p, v, w, t: np.where(t > 5, 1.0, 0.0), "time"),
    ],
)
def test_the_variable_that_carries_the_force_is_drawn(function, variable):
    joint = force.joints(courses(function))[0]
    best, share = joint.best()
    assert (joint.name, best) == ("a", variable) and share > 0.8
    assert text.depends_words([variable]) in joint.words()


def test_noise_is_explained_by_nothing():
    shares, certain = [], []
    for seed in range(20):
        joint = force.joints(courses(lambda p, v, w, t: 0 * t, seed))[0]
        shares.append(np.mean([force.explained(x, joint.force) for x in joint.variables.values()]))
        certain.append(joint.certain)
    assert np.mean(shares) < 0.03 and 0.03 < np.mean(certain) < 0.07


def test_the_share_is_that_of_the_variances():
    """Of a sine over its variable with noise: 0.5 / (0.5 + sd²), by theory."""
    rng = np.random.default_rng(1)
    x = rng.uniform(0, 2 * np.pi, 20000)
    for sd in (0.3, 1.0):
        y = np.sin(x) + sd * rng.normal(size=x.shape)
        assert force.explained(x, y) == pytest.approx(0.5 / (0.5 + sd**2), abs=0.02)


def test_means_come_with_their_standard_errors():
    rng, off = np.random.default_rng(2), []
    for _ in range(60):
        x, y = rng.uniform(-1, 1, 800), rng.normal(size=800)
        _, mean, error = force.averaged(x, y)
        off.append(mean / error)
    assert np.std(off) == pytest.approx(1.0, abs=0.1)


def test_unknown_moments_are_left_out():
    located = courses(lambda p, v, w, t: np.sign(v))
    course = located.summary["missing_force"][0]
    course["force"][50:100] = [None] * 50
    course["velocity"][10:20] = [None] * 10
    joint = force.joints(located)[0]
    assert joint.best()[0] == "velocity:a" and np.isfinite(joint.rms)
    _, over_time, _ = joint.pictures()
    assert over_time.count("M") > 2 and "nan" not in over_time


def test_the_page_begins_with_it(diagnosis):
    page = sections.html_page(diagnosis)
    first = page.partition("<h2>")[2]
    assert first.startswith("Where the force is missing</h2>")
    assert first.index("<h3>elbow</h3>") < first.index("<h3>shoulder</h3>")  # the surer one first
    del diagnosis.summary["missing_force"]
    assert "Where the force is missing" not in sections.html_page(diagnosis)


@pytest.mark.parametrize(
    "named, drawn, missing",
    [
        (["position:a"], "position:a", True),
        (["position:a", "velocity:a"], "velocity:a", True),
        (["control:m"], "velocity:a", True),
        ([], "velocity:a", False),
        (None, "velocity:a", True),
    ],
)
def test_of_what_the_diagnosis_names_the_most_telling_is_drawn(named, drawn, missing):
    """A force of which it was found that it goes with nothing is folded away."""
    located = courses(lambda p, v, w, t: np.sign(v))
    located.located = located.summary["missing_force"]
    entry = {} if named is None else {"depends_on": named}
    located.summary["missing_force"] = {"a": entry, "b": {"depends_on": []}}
    joint = force.joints(located)[0]
    assert joint.best()[0] == drawn and joint.missing == missing


def test_each_joint_has_its_file(diagnosis, tmp_path):
    """With the numbers that are drawn; the next diagnosis takes what it does not write away."""
    diagnosis.located = diagnosis.summary["missing_force"]
    entry = {"rms": 0.1, "unit": "N·m", "after": 0.0, "depends_on": []}
    diagnosis.summary["missing_force"] = {"elbow": dict(entry), "shoulder": dict(entry)}
    diagnosis.corrected_py = "print('here')"
    diagnosis.summary["findings"][2]["written_as"] = "python"
    (tmp_path / "force_elbow.csv").write_text("a user's own")
    names = writer.write(diagnosis, tmp_path)
    assert {"force_elbow_2.csv", "force_shoulder.csv", "corrected.py"} <= set(names)
    summary = json.loads((tmp_path / "diagnosis.json").read_text(encoding="utf-8"))
    assert summary["missing_force"]["elbow"]["curve"] == "force_elbow_2.csv"
    with open(tmp_path / "force_elbow_2.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    own = [c for c in diagnosis.located if c["joint"] == "elbow"]
    expected = np.concatenate([c["force"] for c in own])
    np.testing.assert_allclose([float(row["force"]) for row in rows], expected, rtol=1e-8)
    assert {row["recording"] for row in rows} == {c["recording"] for c in own}
    del diagnosis.summary["missing_force"]
    diagnosis.located, diagnosis.corrected_py = [], ""
    writer.write(diagnosis, tmp_path)
    left = {"force_elbow.csv", "unknown_1.csv", "report.html", "diagnosis.json", "corrected.xml"}
    assert {path.name for path in tmp_path.iterdir()} == left


def test_a_summary_for_each_joint_is_a_table(diagnosis):
    elbow = {"rms": 0.08, "unit": "N·m", "after": None, "depends_on": ["velocity:elbow"]}
    diagnosis.summary["missing_force"] = {"elbow": elbow}
    page = sections.html_page(diagnosis)
    assert "<td>0.080 N·m</td><td>– N·m</td><td>the velocity of elbow</td>" in page


def test_doubts_stand_beside_the_name(diagnosis):
    page = sections.html_page(diagnosis)
    for words in (
        "The nearest name only: its value lies at the edge of what was tried.",
        "Hard to believe: 1.1 times the nominal value.",
        "The recordings do not agree on one value: p 1.0e-5.",
        "0.130 (0.100 to 0.140) N·m",
        "(nearest name only)",
    ):
        assert words in page, words
    said = text.terminal(diagnosis.summary, "out", ["report.html"])
    assert "    (the nearest name only: " in said


@pytest.mark.parametrize("named", [True, False])
def test_unresolved_is_neither_a_match_nor_a_mismatch(diagnosis, named):
    diagnosis.summary["verdict"] = "unresolved"
    if not named:
        diagnosis.summary["findings"], diagnosis.settings = [], {}
    page = sections.html_page(diagnosis)
    assert "Something is missing, and no name explains it well enough" in page
    assert ("the nearest names are these" in page) == named and 'class="unresolved"' in page
    assert "Nothing is missing" not in page


def test_a_value_that_was_not_seen_is_said_so(diagnosis):
    friction = diagnosis.summary["findings"][0]
    friction["parameters"][0] |= {"value": None, "low": None, "high": None}
    assert "not seen in these recordings" in sections.html_page(diagnosis)
