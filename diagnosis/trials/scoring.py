"""The rules of the benchmark: findings against the hidden truth, one to one.

    score = score_findings(answer, findings)
    score.strict                # first name or declared class, nothing false, values within 5 %

A finding is an entry of diagnosis.json's "findings"; an answer is `drawing.Trial.answer`.
"""

import math
import re
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import linear_sum_assignment

TOLERANCE = 0.05  # of a true value, or, where that is zero, of its change from the nominal one
LONGEST_CLASS = 3  # names that a finding may give besides its own
MOST_VARIABLES = 3  # that an `unknown` may claim to depend on


@dataclass(frozen=True)
class Match:
    """One hidden item and what was said of it.

    finding: its index or None; first: its own name is right; listed: a name in also_possible is;
    class_size: names given besides the first; values: ValueScore of each parameter compared.
    """

    item: int
    finding: int | None
    first: bool = False
    listed: bool = False
    class_size: int = 0
    values: tuple = ()


@dataclass(frozen=True)
class ValueScore:
    """A parameter of a matched finding: truth, reported value, its nominal and its interval."""

    name: str
    truth: float
    value: float | None
    nominal: float | None
    low: float | None
    high: float | None

    @property
    def near(self):
        """Within 5 % of the truth; of what a truth of zero lacks, within 5 % of that."""
        if self.value is None or not math.isfinite(self.value):
            return False
        size = abs(self.truth) or abs(self.nominal or 0.0)
        return abs(self.value - self.truth) <= TOLERANCE * size

    @property
    def held(self):
        """Is the truth inside the interval? None where none was given."""
        if self.low is None or self.high is None:
            return None
        return self.low <= self.truth <= self.high


@dataclass(frozen=True)
class Score:
    """matches: one per hidden item; false: indices of findings that claim what is not there.

    neutral: findings that are neither: a finer time_step, one claim where the data tell nothing.
    """

    matches: tuple
    false: tuple
    neutral: tuple
    needed: tuple = field(default=())  # items that must be found

    @property
    def found(self):
        """Needed items that are named or in a declared class."""
        return sum(self.matches[k].finding is not None for k in self.needed)

    @property
    def first(self):
        """Needed items that are named by a finding's own name."""
        return sum(self.matches[k].first for k in self.needed)

    @property
    def valued(self):
        """Needed items whose every compared value is within 5 %."""
        return sum(
            self.matches[k].finding is not None and all(v.near for v in self.matches[k].values)
            for k in self.needed
        )

    @property
    def strict(self):
        """All that is needed found, with right values, and no false claim."""
        return not self.false and self.found == self.valued == len(self.needed)


def score_findings(answer, findings, seen=None):
    """Score findings against an answer; seen: per item, whether the training data can show it.

    Without `seen` the oracle's word in the answer counts ("distinct"). Items that are not needed
    may be found all the same; where they are not, one claim at their place is neutral, for the
    data could not tell it from the truth.
    """
    hidden = answer["hidden"]
    if seen is None:
        seen = answer["distinct"]
    seen = [*seen, *[False] * (len(hidden) - len(seen))]
    pairing = assign(hidden, findings)
    matches, taken = [], set()
    for index, item in enumerate(hidden):
        finding = pairing.get(index)
        if finding is None:
            matches.append(Match(index, None))
            continue
        taken.add(finding)
        matches.append(_match(index, item, finding, findings[finding]))
    rest = [k for k in range(len(findings)) if k not in taken]
    step = lambda finding: finding["effect"] == "time_step" and (taken or _finer(finding))
    neutral = [k for k in rest if step(findings[k])]
    for index, item in enumerate(hidden):
        if not seen[index] and item["required"] and matches[index].finding is None:
            here = (k for k in rest if k not in neutral and beside(findings[k]["place"], item))
            neutral += list(here)[:1]
    false = [k for k in rest if k not in neutral]
    needed = tuple(k for k, item in enumerate(hidden) if seen[k] and item["required"])
    return Score(tuple(matches), tuple(false), tuple(neutral), needed)


def assign(hidden, findings):
    """{hidden index: finding index}: one to one, as many first names as possible, then listed
    ones, then values that were fitted wrong and are put right."""
    if not hidden or not findings:
        return {}
    worth = np.zeros((len(hidden), len(findings)))
    for i, item in enumerate(hidden):
        for k, finding in enumerate(findings):
            first, among = names(finding, item), listed(finding, item)
            if not item["required"]:
                worth[i, k] = (first or among) and _puts_right(item, finding) and 1 - 0.01 * k
            elif first or among:
                worth[i, k] = (1000.0 if first else 100.0) - 0.01 * k
    rows, columns = linear_sum_assignment(-worth)
    return {int(i): int(k) for i, k in zip(rows, columns) if worth[i, k] > 0}


def _puts_right(item, finding):
    """Is what is said of a value that was fitted wrong right, or nearer to that?"""
    told = [v for v in _match(0, item, 0, finding).values if not v.near]
    moved = all(None not in (v.value, v.nominal) for v in told)
    return moved and all(abs(v.value - v.truth) < abs(v.nominal - v.truth) for v in told)


def names(finding, item):
    """Is this finding's own name, place and (for unknown) variables that of the hidden item?"""
    if finding["effect"] != item["effect"] or not same_place(finding["place"], item["place"]):
        return False
    if item["effect"] != "unknown":
        return True
    told = {_plain(t) for t in finding.get("depends_on") or []}
    met = lambda need: any(_says(told, each) for each in need.split("|"))
    return len(told) <= MOST_VARIABLES and all(map(met, item["needs"]))


def _says(told, variable):
    """Whether variables told hold one: what a drive gives is its control's or its joint's load."""
    kind, _, name = variable.partition(":")
    drive = {"place": {"name": name}}
    loads = [{"name": t} for t in told if t.startswith("load:")] if kind == "control" else []
    return variable in told or any(beside(load, drive) for load in loads)


def listed(finding, item):
    """Is the hidden item among the at most three that the finding also holds possible?"""
    others = finding.get("also_possible") or []
    return any(names({**finding, **other}, item) for other in others[:LONGEST_CLASS])


def same_place(place, other):
    """Do two places agree? Two joints "a+b" may stand in either order."""
    parts = lambda p: sorted(str(p["name"]).split("+"))
    kinds = {place["kind"], other["kind"]}
    alike = len(kinds) == 1 or ("+" in str(other["name"]) and kinds <= {"joint", "joints"})
    return alike and parts(place) == parts(other)


def _finer(finding):
    """Does a time_step say that the simulator's is too coarse? In every trial it is, a little."""
    steps = finding.get("parameters") or [{}]
    value, nominal = steps[0].get("value"), steps[0].get("nominal")
    return value is not None and nominal is not None and value < nominal


def beside(place, item):
    """Is a finding's place the item's own joint, link or drive (one number), or one of them the
    world?"""
    numbers = lambda p: set(re.findall(r"\d+", str(p["name"])))
    here, there = numbers(place), numbers(item["place"])
    return not here or not there or bool(here & there)


def _plain(variable):
    """A variable without the component that a surface over two of them may add."""
    return str(variable).split("[")[0]


def _match(index, item, finding_index, finding):
    first = names(finding, item)
    others = (finding.get("also_possible") or [])[:LONGEST_CLASS]
    source = finding
    if not first:
        source = next(other for other in others if names({**finding, **other}, item))
    values = () if item["effect"] == "unknown" else compare_values(item, source)
    return Match(index, finding_index, first, not first, len(others), values)


def compare_values(item, finding):
    """ValueScores of the parameters that a hidden item and a finding share by name.

    Vectors are compared whole, by the component farthest off relative to the vector's length; where
    truth and report have one number each, these are compared whatever their names.
    """
    told = {p["name"]: p for p in finding.get("parameters") or []}
    truth = {k: v for k, v in item["parameters"].items() if isinstance(v, int | float)}
    if len(told) == 1 and len(truth) == 1:
        told = {next(iter(truth)): next(iter(told.values()))}
    if set(truth) in ({"x", "y", "z"}, {"ixx", "iyy", "izz"}, {"low", "high"}):
        return tuple(_vector_scores(truth, told))
    return tuple(
        _value_score(name, float(value), told.get(name, {}))
        for name, value in truth.items()
        if name in told or len(truth) == 1
    )


def _value_score(name, truth, told):
    """ValueScore of one parameter as reported; a phase is compared around the circle."""
    score, value = ValueScore, told.get("value")
    if name == "phase":
        score = _Angle
        truth += 0.0 if value is None else 2 * math.pi * round((value - truth) / (2 * math.pi))
    return score(name, truth, value, told.get("nominal"), told.get("low"), told.get("high"))


class _Angle(ValueScore):
    """An angle in rad, judged by half a turn."""

    @property
    def near(self):
        """Within 5 % of half a turn."""
        if self.value is None or not math.isfinite(self.value):
            return False
        return abs(self.value - self.truth) <= TOLERANCE * math.pi


class _Component(ValueScore):
    """A component of a vector, judged by the vector's length, or an end of a range, by that."""

    scale = 0.0

    @property
    def near(self):
        if self.value is None or not math.isfinite(self.value):
            return self.scale > 0  # one that the recordings do not show may be left out, not all
        return abs(self.value - self.truth) <= TOLERANCE * self.scale


def _vector_scores(truth, told):
    size = truth["high"] - truth["low"] if "high" in truth else math.hypot(*truth.values())
    scale = size if told else 0.0
    for name, true in truth.items():
        p = told.get(name, {})
        low, value, nominal = p.get("low"), p.get("value"), p.get("nominal")
        shown = None if low is None and value == nominal else value
        score = _Component(name, float(true), shown, nominal, low, p.get("high"))
        object.__setattr__(score, "scale", scale)
        yield score
