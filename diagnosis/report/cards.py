"""What the page tells of each finding: its evidence, values, pictures, and what speaks against it.

for card in cards(diagnosis): ...        # written by templates/findings.html
curves = unknown_curves(diagnosis)       # those of findings without a name
"""

import math

import numpy as np

from diagnosis.recordings import inverse_dynamics
from diagnosis.report import Diagnosis, text
from diagnosis.report.charts import Series, binned, chart, whisker

PER_PERIOD, PER_CURVE = 40, 201  # rows of a saved sine per period, and of another saved curve
REMOVES = {
    "held_out_error_removed": "the held-out error",
    "error_removed_there": "the error around it",
    "sensor_error_removed": "the sensor's own error",
}
WRITTEN = {
    "mjcf": "held in corrected.xml",
    "python": "has no plain MJCF form, but stands in corrected.py",
    "none": "has no plain MJCF form, so not in corrected.xml",
    "measurement": "a property of the measurement, so not in corrected.xml",
}
NOTHING = "nothing was fitted, so nothing is written"  # of a force without a name or a curve


def cards(diagnosis: Diagnosis) -> list[dict]:
    """A dict for each finding: finding, facts, doubts, estimates, plots, each, constancy."""
    left, curves = inverse_dynamics.residuals(diagnosis), unknown_curves(diagnosis)
    made = []
    for i, finding in enumerate(diagnosis.summary["findings"]):
        curve = next((c for c in curves if c["finding"] == i), None)
        plots = [_residual(r) for r in left if r["finding"] == i]
        plots += [_curve(curve, finding["parameters"])] if curve else []
        made.append(
            {
                "finding": finding,
                "facts": "; ".join(_facts(finding)),
                "doubts": text.doubts(finding),
                "estimates": [] if curve else [_parameter(p) for p in finding["parameters"]],
                "plots": [plot for plot in plots if plot["svg"]],
                "each": _each(finding),
                "constancy": _constancy(finding),
            }
        )
    return made


def _facts(finding):
    """The evidence for a finding, in words."""
    facts = []
    fitted = finding["effect"] != "unknown" or finding["parameters"] or finding.get("also_possible")
    for key, value in (finding.get("evidence") or {}).items():
        if key in REMOVES and not fitted:
            continue  # 0 %, for nothing was tried
        if isinstance(value, bool) or not isinstance(value, int | float):
            continue
        if not math.isfinite(value):
            continue
        if key in REMOVES:
            facts.append(f"removes {100 * value:.0f} % of {REMOVES[key]}")
        elif key == "p_value":
            facts.append(f"p {text.p_value(value)}")
        elif key == "error_left":
            facts.append(f"{100 * value:.0f} % of the error there is left")
        else:
            facts.append(f"{key.replace('_', ' ')} {text.number(value)}")
    return [*facts, WRITTEN[finding["written_as"]] if fitted else NOTHING]


def _parameter(p):
    """The row of a parameter; one that moves nothing in the recordings stays where it was."""
    stop = text.no_stop(p["name"], p["value"])
    seen = p["value"] is not None and p["value"] != p["nominal"]
    return [
        p["name"],
        (stop or text.estimate(p)) if seen else text.UNSEEN,
        "none" if text.no_stop(p["name"], p["nominal"]) else text.number(p["nominal"]),
        whisker(p) if seen and not stop else "",
    ]


def _each(finding):
    """Rows of the values that the recordings ask for one by one, against the finding's own."""
    rows, entries = [], finding.get("per_recording") or []
    parameters = {p["name"]: p for p in finding["parameters"]}
    of = lambda entry: parameters.get(entry.get("parameter")) or finding["parameters"][0]
    for entry in entries:
        own = of(entry)
        low, high = entry["interval"] or (None, None)
        p = {"value": entry["value"], "low": low, "high": high, "unit": own["unit"]}
        name = entry["recording"] + (f", {own['name']}" if len(parameters) > 1 else "")
        alike = [v for e in entries if of(e) is own for v in (e["value"], *(e["interval"] or ()))]
        span = [v for v in alike if v is not None and math.isfinite(v)]
        svg = whisker({**p, "nominal": own["value"]}, span, width=160)
        rows.append([name, text.estimate(p), svg])
    return rows


def _constancy(finding):
    """Whether the recordings agree on one value, in a sentence; "" where that was not asked."""
    p = finding.get("constancy")
    if p is None:
        return ""
    agree = "do not agree" if p < text.UNSTEADY else "agree"
    return f"The recordings {agree} on one value (p {text.p_value(p)}); marked: the value of all."


def unknown_curves(diagnosis: Diagnosis) -> list[dict]:
    """The fitted curves of findings that the catalogue cannot name, one dict each: finding (index),
    variable, factor, period (of a sine, in words, or None), x, force (n,), unit. Force between
    neighbouring x is linear; a sine spans all recordings."""
    curves = []
    for index, finding in enumerate(diagnosis.summary["findings"]):
        for candidate, values in diagnosis.settings.items():
            names = finding["effect"], candidate.effect.name, candidate.place.name
            if names == ("unknown", "unknown", finding["place"]["name"]):
                curves.append({"finding": index, **_sampled(diagnosis, candidate, values)})
    return curves


def _sampled(diagnosis, candidate, values):
    """The curve of one unknown force, at points between which it is linear."""
    effect, period = candidate.effect, None
    if effect.wave:
        period = 4 * (effect.knots[1] - effect.knots[0])
        model, runs = diagnosis.world.model, [*diagnosis.train, *diagnosis.held_out]
        course_of = lambda r: inverse_dynamics.course_of(
            model, effect.variable, r.time, r.qpos, r.qvel, r.ctrl
        )
        courses, _, (unit, *_) = zip(*map(course_of, runs))
        low, high = np.nanmin(np.concatenate(courses)), np.nanmax(np.concatenate(courses))
        x = np.arange(low, high + period / PER_PERIOD, period / PER_PERIOD)
        period = f"{text.number(period)} {unit}"
    else:
        even = np.linspace(effect.knots[0], effect.knots[-1], PER_CURVE)
        x = np.union1d(effect.knots, even)
    return {
        "variable": effect.variable,
        "factor": effect.factor,
        "period": period,
        "x": x,
        "force": effect.at(x, np.tile(values, (len(x), 1))),
        "unit": candidate.parameters[0].unit,
    }


def _curve(curve, parameters):
    """The unknown force against its variable, with the 95 % interval of what is linear between
    knots."""
    x, force, lines, note = curve["x"], curve["force"], [], ""
    if curve["period"]:
        x, force = x[: 3 * PER_PERIOD + 1], force[: 3 * PER_PERIOD + 1]
        note = f"A sine of {curve['period']}."
    elif all(p.get("at") is not None and _bounded(p) for p in parameters):
        at = [p["at"] for p in parameters]
        band = [np.interp(x, at, [p[bound] for p in parameters]) for bound in ("low", "high")]
        lines = [Series(x, np.stack(band, axis=1), "corrected", "band")]
    label = f"force ({curve['unit']})"
    if curve["factor"]:
        label, times = _multiplied(curve)
        note = f"{note} {times}".strip()
    axis = text.axis_words(curve["variable"])
    lines.append(Series(x, force, "corrected"))
    return {"svg": chart(lines, axis, label, label="the unknown force"), "note": note, "looks": []}


def _bounded(parameter):
    low, high = parameter["low"], parameter["high"]
    return low is not None and high is not None and math.isfinite(high - low)


def _multiplied(curve):
    """(axis, note) of a force that is multiplied by a control, a speed, or its sign."""
    kind, _, name = curve["factor"].partition(":")
    if kind == "speed":
        return f"force / speed ({curve['unit']})", f"Acts times the speed of {name}."
    if kind == "velocity":
        note = f"Acts times the sign of the velocity of {name}."
        return f"force × sign ({curve['unit']})", note
    note = f"Acts times the {kind} of {name}"
    if kind == "control":
        note += " (of a servo: less what it has reached, its nominal force over its gain)"
    return f"force ({curve['unit']}) per control", note + "."


def _residual(residual):
    """Force left over against the variable that it depends on, before and after, with the bins'
    medians."""
    x, before, after = (np.asarray(residual[key], float) for key in ("x", "before", "after"))
    reach = 1.5 * np.nanpercentile(np.abs(before), 90)  # impacts would flatten the picture
    before, after = (np.where(np.abs(y) < reach, y, np.nan) for y in (before, after))
    picture = chart(
        [
            Series(x, before, "nominal faint", "dots"),
            Series(x, after, "corrected faint", "dots"),
            Series(*binned(x, before), "nominal"),
            Series(*binned(x, after), "corrected"),
        ],
        text.axis_words(residual["variable"], residual["x_unit"]),
        f"force left at {residual['joint']} ({residual['unit']})",
        label="residual against " + residual["variable"],
    )
    looks = [("nominal", "left over by the nominal model")]
    looks += [("corrected", "by the corrected one")] if np.isfinite(after).any() else []
    return {"svg": picture, "looks": looks, "note": ""}
