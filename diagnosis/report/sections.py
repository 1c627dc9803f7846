"""The page that shows a diagnosis: its sections, from the verdict down to what it was made with.

    html = html_page(diagnosis)

One file: drawings are inline SVG, nothing is fetched, and it reads on a phone, in light and in dark.
"""

import html
import math
import re

import numpy as np

from diagnosis.recordings import inverse_dynamics
from diagnosis.report import experiments, mechanism, overlay
from diagnosis.report import text as wording
from diagnosis.report.charts import Series, binned, chart, whisker
from diagnosis.report.page import SCRIPT, STYLE

E = html.escape
PER_PERIOD, PER_CURVE = 40, 201  # rows of a saved sine per period, and of another saved curve
MOST = 15  # candidates that are shown, besides those in the diagnosis


def html_page(diagnosis):
    """The whole page as a string."""
    summary, model = diagnosis.summary, diagnosis.world.model
    title = f"Diagnosis: {wording.model_title(model)}"
    sections = (
        _mechanism,
        _findings,
        _prediction,
        _traces,
        _unexplained,
        _ranking,
        _advice,
        _about,
    )
    body = _head(summary, title) + "".join(section(diagnosis) for section in sections)
    return (
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1"><meta name="color-scheme" content="light dark">'
        f'<link rel="icon" href="data:,"><title>{E(title)}</title>'
        f"<style>{STYLE}</style></head><body><main>{body}</main><script>{SCRIPT}</script></body></html>\n"
    )


def _section(title, *parts, note=""):
    body = "".join(parts)
    return (
        f"<section><h2>{E(title)}</h2>{f'<p class=note>{E(note)}</p>' if note else ''}{body}</section>"
        if body
        else ""
    )


def _box(svg, wide=False):
    return f'<div class="{"scroll wide" if wide else "scroll"}">{svg}</div>' if svg else ""


def _legend(*looks):
    items = "".join(f'<span><i class="{look}"></i>{E(words)}</span>' for look, words in looks)
    return f'<p class="legend">{items}</p>'


def _pair(*parts):
    """Side by side where there is room."""
    inside = "".join(f"<div>{part}</div>" for part in parts if part)
    return f'<div class="pair">{inside}</div>' if inside else ""


def _table(heads, rows, look=""):
    """heads: texts; rows: lists of cells in HTML, a first cell that starts with "*" marks the row. "" without rows."""
    if not rows:
        return ""
    body = ""
    for row in rows:
        chosen = ' class="chosen"' if row[0].startswith("*") else ""
        body += (
            f"<tr{chosen}>"
            + "".join(f"<td>{cell}</td>" for cell in [row[0].lstrip("*"), *row[1:]])
            + "</tr>"
        )
    head = "".join(f"<th>{E(text)}</th>" for text in heads)
    return f'<div class="scroll"><table class="{look}"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _head(summary, title):
    findings = "".join(
        f"<li>{E(wording.finding_words(finding))}</li>" for finding in summary["findings"]
    )
    *values, unit, place = wording.errors(summary)
    before, after, floor = (wording.number(value, 2) for value in values)
    steps = "".join(
        f'<div class="{look}"><b>{E(value)} <small>{E(unit)}</small></b><span>{words}</span></div>'
        for value, look, words in (
            (before, "nominal", "nominal model"),
            (after, "corrected", "corrected model"),
            (floor, "noise", "perfect simulator"),
        )
    )
    left = wording.unexplained_words(summary)
    sentences = " ".join(
        map(wording.sentence, [wording.error_words(summary), *([left] if left else [])])
    )
    horizon = summary["fit"]["held_out"].get("horizon_s", 0.3)
    return (
        f'<header><p class="kicker">{E(title)}</p>'
        f'<h1 class="{summary["verdict"]}">{E(wording.verdict_words(summary))}</h1>'
        f'{f"<ol class=verdict>{findings}</ol>" if findings else ""}<p>{E(sentences)}</p><div class="steps">{steps}</div>'
        f'<p class="note">Error{E(place)} on recordings held out, {horizon:g} s ahead.</p></header>'
    )


def _mechanism(diagnosis):
    summary, model = diagnosis.summary, diagnosis.world.model
    places = [finding["place"] for finding in summary["findings"]]
    labels = [
        wording.effect_words(finding["effect"])
        + ("" if place["kind"] == "world" else f" ({place['name']})")
        for finding, place in zip(summary["findings"], places)
    ]
    picture = mechanism.mechanism(model, overlay.poses(model, diagnosis.held_out), places, labels)
    moving = overlay.overlay(diagnosis)
    film = ""
    if moving:
        recording, start, seconds, motions = moving
        note = (
            f"{recording} from {wording.number(start)} s: from the recorded state, driven by the recorded control for "
            f"{wording.number(seconds, 2)} s. Of the held-out stretches, the one where the nominal "
            "model errs most."
        )
        film = (
            mechanism.animation(model, motions, seconds)
            + f'<p class="note">{E(note)}</p>'
            + _legend(*((look, "recorded" if look == "measured" else look) for look in motions))
        )
    return _section("The mechanism", _pair(_box(picture), film))


def _findings(diagnosis):
    left, curves = inverse_dynamics.residuals(diagnosis), unknown_curves(diagnosis)
    cards = []
    for i, finding in enumerate(diagnosis.summary["findings"]):
        curve = next((c for c in curves if c["finding"] == i), None)
        estimates = [] if curve else [_parameter(p) for p in finding["parameters"]]
        table = _table(["parameter", "value, 95 %", "nominal", ""], estimates, "estimates")
        plots = [_residual(r) for r in left if r["finding"] == i]
        plots += [_curve(curve, finding["parameters"])] if curve else []
        others = "".join(
            f"<li>{E(wording.finding_words(other))}</li>"
            for other in finding.get("also_possible") or []
        )
        others = (
            f'<p class="or">These recordings cannot tell it from:</p><ul>{others}</ul>'
            if others
            else ""
        )
        cards.append(
            f'<article class="card"><h3>{i + 1}. {E(wording.finding_words(finding))}</h3>'
            f'<p class="facts">{E("; ".join(_facts(finding)))}</p>{table}{_pair(*plots)}{others}</article>'
        )
    return _section("What is wrong, in order of importance", *cards)


def _parameter(p):
    """The row of a parameter; one that moves nothing in the recordings stays where it was."""
    stop = wording.no_stop(p["name"], p["value"])
    seen = p["value"] != p["nominal"]
    return [
        E(p["name"]),
        E(stop or wording.estimate(p)) if seen else "not seen in these recordings",
        E("none" if wording.no_stop(p["name"], p["nominal"]) else wording.number(p["nominal"])),
        whisker(p) if seen and not stop else "",
    ]


def _facts(finding):
    """The evidence for a finding, in words."""
    facts = []
    for key, value in (finding.get("evidence") or {}).items():
        if isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value):
            facts.append(
                f"removes {100 * value:.0f} % of the held-out error"
                if key == "held_out_error_removed"
                else f"removes {100 * value:.0f} % of the error around it"
                if key == "error_removed_there"
                else f"removes {100 * value:.0f} % of the sensor's own error"
                if key == "sensor_error_removed"
                else f"p {wording.p_value(value)}"
                if key == "p_value"
                else f"{key.replace('_', ' ')} {wording.number(value)}"
            )
    return facts + [
        {
            "mjcf": "held in corrected.xml",
            "none": "has no plain MJCF form, so not in corrected.xml",
            "measurement": "a property of the measurement, so not in corrected.xml",
        }[finding["written_as"]]
    ]


def unknown_curves(diagnosis):
    """The fitted curves of findings that the catalogue cannot name, one dict each: finding (index), variable, factor, period
    (s, of a sine, or None), x, force (n,), unit. Force between neighbouring x is linear; a sine spans all recordings."""
    curves = []
    for index, finding in enumerate(diagnosis.summary["findings"]):
        for candidate, values in diagnosis.settings.items():
            if (
                finding["effect"] == "unknown" == candidate.effect.name
                and candidate.place.name == finding["place"]["name"]
            ):
                effect, period = candidate.effect, None
                if effect.wave:
                    period = 4 * (effect.knots[1] - effect.knots[0])
                    times = np.concatenate(
                        [r.time for r in [*diagnosis.train, *diagnosis.held_out]]
                    )
                    x = np.arange(
                        times.min(), times.max() + period / PER_PERIOD, period / PER_PERIOD
                    )
                else:
                    x = np.union1d(
                        effect.knots, np.linspace(effect.knots[0], effect.knots[-1], PER_CURVE)
                    )
                force = effect.at(x, np.tile(values, (len(x), 1)))
                curves.append(
                    {
                        "finding": index,
                        "variable": effect.variable,
                        "factor": effect.factor,
                        "period": period,
                        "x": x,
                        "force": force,
                        "unit": candidate.parameters[0].unit,
                    }
                )
    return curves


def _curve(curve, parameters):
    """The unknown force against its variable, with the 95 % interval of what is linear between knots."""
    x, force, lines, note = curve["x"], curve["force"], [], ""
    if curve["period"]:
        x, force = x[: 3 * PER_PERIOD + 1], force[: 3 * PER_PERIOD + 1]
        note = f"A sine of {wording.number(curve['period'])} s."
    elif all(p.get("at") is not None and math.isfinite(p["high"] - p["low"]) for p in parameters):
        band = [
            np.interp(x, [p["at"] for p in parameters], [p[bound] for p in parameters])
            for bound in ("low", "high")
        ]
        lines = [Series(x, np.stack(band, axis=1), "corrected", "band")]
    label = f"force ({curve['unit']})"
    if curve["factor"]:
        kind, _, name = curve["factor"].partition(":")
        label = (
            f"force × sign ({curve['unit']})"
            if kind == "velocity"
            else f"force ({curve['unit']}) per control"
        )
        note = f"Acts times the {'sign of the ' if kind == 'velocity' else ''}{kind} of {name}"
        note += (
            " (of a servo: less what it has reached, which is its nominal force over its gain)."
            if kind == "control"
            else "."
        )
    return _box(
        chart(
            [*lines, Series(x, force, "corrected")],
            wording.axis_words(curve["variable"]),
            label,
            label="the unknown force",
        )
    ) + (f'<p class="note">{E(note)}</p>' if note else "")


def _residual(residual):
    """Force left over against the variable that it depends on, before and after, with the bins' medians."""
    x, before, after = (np.asarray(residual[key], float) for key in ("x", "before", "after"))
    unit = residual["unit"]
    reach = 1.5 * np.nanpercentile(np.abs(before), 90)  # impacts would flatten the picture
    before, after = (np.where(np.abs(y) < reach, y, np.nan) for y in (before, after))
    picture = chart(
        [
            Series(x, before, "nominal faint", "dots"),
            Series(x, after, "corrected faint", "dots"),
            Series(*binned(x, before), "nominal"),
            Series(*binned(x, after), "corrected"),
        ],
        wording.axis_words(residual["variable"], residual["x_unit"]),
        f"force left at {residual['joint']} ({unit})",
        label="residual against " + residual["variable"],
    )
    corrected = [("corrected", "by the corrected one")] if np.isfinite(after).any() else []
    legend = _legend(("nominal", "left over by the nominal model"), *corrected)
    return picture and legend + _box(picture)


def _prediction(diagnosis):
    fit = diagnosis.summary["fit"]["held_out"]
    curve, picture = fit.get("curve") or [], ""
    if curve:
        x, before, after, floor = (
            np.array(
                [np.nan if point.get(key) is None else point[key] for point in curve], dtype=float
            )
            for key in ("seconds", "before", "after", "floor")
        )
        wide = np.nanmax(before) > 8 * max(np.nanmin(after), 1e-12)
        noise = [("noise", "perfect simulator")] if np.isfinite(floor).any() else []
        lines = [
            Series(x, before, "nominal"),
            Series(x, after, "corrected"),
            Series(x, floor, "noise"),
        ]
        picture = _legend(("nominal", "nominal"), ("corrected", "corrected"), *noise) + _box(
            chart(
                lines,
                "horizon (s)",
                "error (× noise)",
                log_y=bool(wide),
                zero=not wide,
                label="error against horizon",
            )
        )
        worst = max(
            (point["blown_up"] for point in curve if "blown_up" in point),
            key=lambda b: b["before"] + b["after"],
            default=None,
        )
        picture += f'<p class="note">{E(wording.blown_words(worst))}</p>' if worst else ""
    rows = []
    for name, channel in (fit.get("channels") or {}).items():
        unit, factor = wording.SMALL.get(channel["unit"], (channel["unit"], 1))
        values = (
            None if channel[key] is None else channel[key] * factor
            for key in ("before", "after", "floor")
        )
        rows.append(
            [
                E(wording.channel_words(name)),
                *(wording.number(value, 2) for value in values),
                E(unit),
            ]
        )
    table = _table(["", "nominal", "corrected", "perfect", ""], rows)
    rows = [
        [
            E(name),
            *(wording.number(sensor[key], 2) for key in ("before", "after", "noise")),
            E(sensor["unit"]),
        ]
        for name, sensor in (fit.get("sensors") or {}).items()
    ]
    table += _table(["sensor", "nominal", "corrected", "its noise", ""], rows)
    return _section(
        "How well it predicts recordings it was not fitted to",
        _pair(picture, table),
        note="A perfect simulator, too, would start from measured positions and velocities: their noise sets the "
        "limit.",
    )


def _traces(diagnosis):
    """Held-out traces: every channel once, from the longest recording that has it; then more, folded away."""
    order = sorted(range(len(diagnosis.traces)), key=lambda i: -len(diagnosis.traces[i]["time"]))
    first = {}
    for i in order:
        first.setdefault(diagnosis.traces[i]["channel"], i)
    shown = sorted(first.values())[:8]
    more = [i for i in range(len(diagnosis.traces)) if i not in shown][:8]

    units = {
        name: channel["unit"]
        for name, channel in (diagnosis.summary["fit"]["held_out"].get("channels") or {}).items()
    }

    def draw(i):
        trace = diagnosis.traces[i]
        time = np.asarray(trace["time"], float)
        values = {
            look: np.asarray(trace[look], float) for look in ("measured", "nominal", "corrected")
        }
        joint = np.isnan(list(values.values())).all(
            axis=0
        )  # between two predictions; the recording runs on
        lines = [
            Series(time[~joint], values["measured"][~joint], "measured"),
            *(Series(time, values[look], look) for look in ("nominal", "corrected")),
        ]
        name = wording.channel_words(trace["channel"])
        unit = f" ({units[trace['channel']]})" if trace["channel"] in units else ""
        return f'<h3 class="trace">{E(name)} <small>{E(trace["recording"])}</small></h3>' + _box(
            chart(lines, "time (s)", name + unit, 900, 240, label=f"{name} over time"), wide=True
        )

    legend = _legend(("measured", "recorded"), ("nominal", "nominal"), ("corrected", "corrected"))
    folded = (
        f"<details><summary>{len(more)} more</summary>{''.join(map(draw, more))}</details>"
        if more
        else ""
    )
    return _section(
        "Recorded and predicted, held out",
        legend if shown else "",
        *map(draw, shown),
        folded,
        note="Each prediction starts again from the recording after every horizon.",
    )


def _unexplained(diagnosis):
    left = wording.unexplained_words(diagnosis.summary)
    return _section("What is left", f"<p>{E(wording.sentence(left))}</p>") if left else ""


def _ranking(diagnosis):
    rows = []
    chosen = {
        (f["effect"], f["place"]["kind"], f["place"]["name"]) for f in diagnosis.summary["findings"]
    }
    for rank, candidate in enumerate(diagnosis.ranking):
        place, removed = candidate["place"], candidate["error_removed"]
        found = (candidate["effect"], place["kind"], place["name"]) in chosen
        if rank >= MOST and not found:
            continue
        share = 0 if removed is None or not math.isfinite(removed) else min(1, max(0, removed))
        bar = (
            f'<span class="bar"><i style="width:{100 * share:.0f}%"></i></span> {100 * share:.0f} %'
        )
        name = f"{E(wording.effect_words(candidate['effect']))}<small>{E(wording.place_words(place))}</small>"
        rows.append(["*" * found + name, bar, E(wording.p_value(candidate["p_value"]))])
    return _section(
        "Candidates",
        _table(["effect", "removes alone", "p"], rows),
        note="The share of the squared error that each effect at each place removes on its own. Marked: in the "
        "diagnosis.",
    )


def _advice(diagnosis):
    items = "".join(
        f"<li>{E(line)}</li>" for line in experiments.advice(diagnosis.summary["findings"])
    )
    return (
        _section("What cannot be told apart, and the experiment that would", f"<ul>{items}</ul>")
        if items
        else ""
    )


def _about(diagnosis):
    summary = diagnosis.summary
    notes = "".join(f"<li>{E(note)}</li>" for note in summary.get("warnings", []))
    noise = ", ".join(
        f"{wording.channel_words(name)} {wording.number(value, 2)}"
        for name, value in summary["noise"].items()
    )
    train, held = (_names(part) for part in (diagnosis.train, diagnosis.held_out))
    files = (
        "; it reads meshes and textures from where the nominal model has them"
        if reads_files(diagnosis.corrected_xml)
        else ""
    )
    more = (
        ", and unknown_<n>.csv (a force without a name, as a curve)"
        if unknown_curves(diagnosis)
        else ""
    )
    return _section(
        "The recordings",
        f"<p>Fitted: {E(train)}.<br>Held out: {E(held)}.<br>Noise of the sensors (SI): {E(noise)}.</p>",
        f"<ul>{notes}</ul>" if notes else "",
        '<p class="note">Beside this page: diagnosis.json (all numbers) and corrected.xml (the corrected model, for '
        f"stock MuJoCo{files}){E(more)}.</p>",
    )


def reads_files(xml):
    """Whether MJCF names files of meshes, textures or height fields."""
    return bool(re.search(r'\sfile\w*="', xml))


def _names(recordings, most=12):
    names = list(
        dict.fromkeys(
            r.name + (f" from {wording.number(r.time[r.start])} s on" if r.start else "")
            for r in recordings
        )
    )
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
