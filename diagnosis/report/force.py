"""Where the force is missing: what was located before any name was looked for, made ready to draw.

    for joint in joints(diagnosis):
        joint.pictures()

A course is what one joint lacked in one recording: force and its standard deviation over time,
with the joint's position and velocity beside them.
"""

from dataclasses import dataclass

import numpy as np

from diagnosis.report import Diagnosis, text
from diagnosis.report.charts import Series, chart

BINS = 24  # of a variable, over which the force is averaged
SURE = 1.96  # standard deviations of a 95 % band
MISSING = 0.1  # share of the moments: where less is certain, chance would show as much
WORTH_SAYING = 0.1  # share of the variance that goes with a variable
ALIKE = 0.02  # of the variance: variables that explain as much are told by their order
REACH = 1.4  # times the 98 % quantile of the force: what is drawn; impacts would flatten the rest


@dataclass(frozen=True)
class Course:
    """What one joint lacked in one recording; arrays (n,), NaN where it is not known."""

    joint: str
    recording: str
    unit: str
    time: np.ndarray
    force: np.ndarray
    sd: np.ndarray
    position: np.ndarray
    velocity: np.ndarray


@dataclass(frozen=True)
class Joint:
    """All courses of one joint, and what its force may depend on: {"velocity:elbow": (n,), ...},
    of all courses in a row, with their units. depends_on: what the diagnosis says of that; None
    where it says nothing."""

    name: str
    courses: tuple
    variables: dict
    units: dict
    depends_on: tuple | None = None

    @property
    def force(self) -> np.ndarray:
        """(n,) of all courses in a row."""
        return np.concatenate([c.force for c in self.courses])

    @property
    def rms(self) -> float:
        """Root mean square of the force."""
        return float(np.sqrt(np.nanmean(self.force**2)))

    @property
    def certain(self) -> float:
        """Share of the moments in which the force is more than its own uncertainty."""
        sd = np.concatenate([c.sd for c in self.courses])
        known = np.isfinite(self.force) & np.isfinite(sd)
        return float(np.mean(np.abs(self.force[known]) > SURE * sd[known])) if known.any() else 0.0

    @property
    def missing(self) -> bool:
        """Whether there is more than chance would show (5 % of noise lies outside its 95 %), and
        it goes with something, where the diagnosis has looked for that."""
        return self.certain > MISSING and self.depends_on != ()

    def best(self) -> tuple[str, float]:
        """(variable, share of the variance that goes with it): of those that the diagnosis names,
        or else of all, the one that explains most."""
        named = [name for name in self.depends_on or () if name in self.variables]
        shares = {
            name: explained(x, self.force)
            for name, x in self.variables.items()
            if name in named or not named
        }
        most = max(shares.values())
        return next((name, share) for name, share in shares.items() if share >= most - ALIKE)

    def words(self) -> str:
        """What the pictures say, in a sentence."""
        unit, (variable, share) = self.courses[0].unit, self.best()
        parts = [f"RMS {text.number(self.rms, 2)} {unit}"]
        parts.append(f"more than its uncertainty in {100 * self.certain:.0f} % of the moments")
        if share > WORTH_SAYING and self.missing:
            on = text.depends_words([variable])
            parts.append(f"{100 * share:.0f} % of its variance goes with {on}")
        return "; ".join(parts) + "."

    def pictures(self) -> tuple[str, str, str]:
        """(the recording drawn over time, chart over time, chart over the best variable)."""
        loudest = max(self.courses, key=lambda c: np.nanmean(c.force**2))
        label = f"force missing ({loudest.unit})"
        most = REACH * np.nanquantile(np.abs(self.force), 0.98) or 1.0
        cut = lambda y: np.clip(y, -most, most)
        edges = loudest.force[:, None] + SURE * loudest.sd[:, None] * [-1, 1]
        over_time = [
            Series(loudest.time, cut(edges), "missing", "band"),
            Series(loudest.time, cut(loudest.force), "missing"),
        ]
        variable, _ = self.best()
        x = self.variables[variable]
        on = text.axis_words(variable, self.units.get(variable))
        centre, mean, error = averaged(x, self.force)
        shape = [
            Series(x, np.where(np.abs(self.force) < most, self.force, np.nan), "missing", "dots"),
            Series(centre, cut(mean[:, None] + SURE * error[:, None] * [-1, 1]), "missing", "band"),
            Series(centre, cut(mean), "missing"),
        ]
        over_best = chart(shape, on, label, zero=True, label=f"force missing against {on}")
        drawn = chart(over_time, "time (s)", label, zero=True, label="force missing over time")
        return loudest.recording, drawn, over_best


def courses(diagnosis: Diagnosis) -> list[Course]:
    """The courses of a diagnosis, from `located` or from the list in its summary; none where it has
    neither."""
    records = getattr(diagnosis, "located", None) or diagnosis.summary.get("missing_force")
    arrays = ("time", "force", "sd", "position", "velocity")
    return [
        Course(r["joint"], r["recording"], r["unit"], *(np.array(r[k], float) for k in arrays))
        for r in (records if isinstance(records, list) else [])
        if np.isfinite(np.array(r["force"], float)).any()
    ]


def joints(diagnosis: Diagnosis) -> list[Joint]:
    """Joint for each that has a course, first where the missing force is most certain."""
    grouped, units, told = {}, {}, diagnosis.summary.get("missing_force")
    for course in courses(diagnosis):
        grouped.setdefault(course.joint, []).append(course)
    for name, (course, *_) in grouped.items():
        length = "rad" if "m" in course.unit else "m"  # N·m acts on an angle, N on a length
        units |= {f"position:{name}": length, f"velocity:{name}": f"{length}/s"}
    found = []
    for name, some in grouped.items():
        entry = (told.get(name) if isinstance(told, dict) else None) or {}
        depends = tuple(entry["depends_on"]) if "depends_on" in entry else None
        found.append(Joint(name, tuple(some), _variables(some, grouped), units, depends))
    return sorted(found, key=lambda joint: -joint.certain)


def _variables(own, grouped):
    """{variable: (n,)} for a joint's courses: its own state first, then that of the joints that
    were recorded at the same moments, then time."""
    variables = {}
    for name in sorted(grouped, key=lambda name: name != own[0].joint):
        beside = {c.recording: c for c in grouped[name]}
        same = [beside.get(c.recording) for c in own]
        if all(b is not None and np.array_equal(b.time, c.time) for b, c in zip(same, own)):
            for kind in ("velocity", "position"):
                values = np.concatenate([getattr(b, kind) for b in same])
                if np.isfinite(values).any():
                    variables[f"{kind}:{name}"] = values
    return variables | {"time": np.concatenate([c.time for c in own])}


def _groups(x, force):
    """Indices in equally filled bins of x, of what is known; fewer bins of few points."""
    known = np.flatnonzero(np.isfinite(x) & np.isfinite(force))
    count = max(1, min(BINS, len(known) // 8))
    return np.array_split(known[np.argsort(x[known], kind="stable")], count)


def explained(x: np.ndarray, force: np.ndarray) -> float:
    """Share of the force's variance between bins of x, corrected for their number; not below 0."""
    groups = [g for g in _groups(x, force) if len(g)]
    n, k = sum(map(len, groups)), len(groups)
    if n <= k:
        return 0.0
    values = force[np.concatenate(groups)]
    within = sum(((force[g] - force[g].mean()) ** 2).sum() for g in groups) / (n - k)
    return max(0.0, 1.0 - within / max(values.var(ddof=1), 1e-300))


def averaged(x: np.ndarray, force: np.ndarray) -> tuple[np.ndarray, ...]:
    """(centres, means, standard errors of the means) in equally filled bins of x."""
    rows = [
        (np.mean(x[g]), np.mean(force[g]), np.std(force[g], ddof=1) / np.sqrt(len(g)))
        for g in _groups(x, force)
        if len(g) > 1
    ]
    return tuple(np.array(column) for column in zip(*rows)) if rows else (np.zeros(0),) * 3
