"""The page that shows a diagnosis: its sections, from the verdict down to what it was made with.

    html = html_page(diagnosis)

One file: drawings are inline SVG, nothing is fetched, and it reads on a phone, in light and in
dark. A section is computed here, and written in a template of the same name.
"""

import math
import re
from dataclasses import dataclass

import numpy as np

from diagnosis.report import Diagnosis, experiments, force, mechanism, overlay, text
from diagnosis.report.cards import cards, unknown_curves
from diagnosis.report.charts import Series, chart
from diagnosis.report.page import render

MOST = 15  # candidates that are shown, besides those in the diagnosis
FORCES = 6  # joints whose missing force is shown; others, and those that lack none, are folded away
TRACES = 8  # channels that are drawn, and as many more are folded away


@dataclass(frozen=True)
class Section:
    """A heading, Markup, and a line between the two."""

    title: str
    body: str
    note: str = ""


def html_page(diagnosis: Diagnosis) -> str:
    """The whole page as a string."""
    title = f"Diagnosis: {text.model_title(diagnosis.world.model)}"
    made = (
        _missing_force(diagnosis),
        _mechanism(diagnosis),
        _findings(diagnosis),
        _prediction(diagnosis),
        _traces(diagnosis),
        _unexplained(diagnosis),
        _ranking(diagnosis),
        _advice(diagnosis),
        _about(diagnosis),
    )
    sections = [section for section in made if section and section.body.strip()]
    head = _head(diagnosis.summary, title)
    return str(render("page.html", title=title, head=head, sections=sections)) + "\n"


def _head(summary, title):
    *values, unit, where = text.errors(summary)
    looks = ("nominal", "nominal model"), ("corrected", "corrected model")
    looks += (("noise", "perfect simulator"),)
    said = [text.error_words(summary), text.unexplained_words(summary)]
    return render(
        "head.html",
        title=title,
        summary=summary,
        verdict=text.verdict_words(summary),
        sentences=" ".join(text.sentence(words) for words in said if words),
        steps=[(look, text.number(v, 2), words) for v, (look, words) in zip(values, looks)],
        unit=unit,
        where=where,
        horizon=summary["fit"]["held_out"].get("horizon_s", 0.3),
    )


def _missing_force(diagnosis):
    """The force that the nominal model lacks, joint by joint; None where nothing tells it."""
    shown, more = [], []
    for joint in force.joints(diagnosis):
        recording, over_time, over_best = joint.pictures()
        drawn = shown if joint.missing and len(shown) < FORCES else more
        drawn.append(
            {
                "name": joint.name,
                "words": joint.words(),
                "recording": recording,
                "over_time": over_time,
                "over_best": over_best,
            }
        )
    summary, rows = diagnosis.summary.get("missing_force"), []
    if isinstance(summary, dict):
        for name, joint in summary.items():
            values = (f"{text.number(joint[k], 2)} {joint['unit']}" for k in ("rms", "after"))
            rows.append([name, *values, text.depends_words(joint["depends_on"]) or "–"])
    if not shown and not more and not rows:
        return None
    return Section(
        "Where the force is missing",
        render("force.html", shown=shown, more=more, rows=rows),
        "The force at each joint that the nominal model lacks, estimated from the recordings "
        "before any name is looked for. Shaded: 95 %.",
    )


def _mechanism(diagnosis):
    summary, model = diagnosis.summary, diagnosis.world.model
    places = [finding["place"] for finding in summary["findings"]]
    labels = [
        text.effect_words(finding["effect"])
        + ("" if place["kind"] == "world" else f" ({place['name']})")
        for finding, place in zip(summary["findings"], places)
    ]
    picture = mechanism.mechanism(model, overlay.poses(model, diagnosis.held_out), places, labels)
    film, note, looks = "", "", []
    if moving := overlay.overlay(diagnosis):
        recording, start, seconds, motions = moving
        note = (
            f"{recording} from {start:.2f} s: from the recorded state, driven by the "
            f"recorded control for {text.number(seconds, 2)} s. Of the held-out stretches, the one "
            "where the nominal model errs most."
        )
        film = mechanism.animation(model, motions, seconds)
        looks = [(look, "recorded" if look == "measured" else look) for look in motions]
    body = render("mechanism.html", picture=picture, film=film, film_note=note, looks=looks)
    return Section("The mechanism", body)


def _findings(diagnosis):
    found = cards(diagnosis)
    title = "What is wrong, in order of importance"
    return Section(title, render("findings.html", cards=found)) if found else None


def _prediction(diagnosis):
    fit = diagnosis.summary["fit"]["held_out"]
    picture, looks, blown = _curve(fit.get("curve") or [])
    channels = []
    for name, channel in (fit.get("channels") or {}).items():
        unit, factor = text.SMALL.get(channel["unit"], (channel["unit"], 1))
        values = (channel[key] for key in ("before", "after", "floor"))
        words = [text.number(None if v is None else v * factor, 2) for v in values]
        channels.append([text.channel_words(name), *words, unit])
    sensors = [
        [name, *(text.number(s[key], 2) for key in ("before", "after", "noise")), s["unit"]]
        for name, s in (fit.get("sensors") or {}).items()
    ]
    body = render(
        "prediction.html",
        picture=picture,
        looks=looks,
        blown=blown,
        channels=channels,
        sensors=sensors,
    )
    return Section(
        "How well it predicts recordings it was not fitted to",
        body,
        "A perfect simulator, too, would start from measured positions and velocities: their noise "
        "sets the limit.",
    )


def _curve(curve):
    """(chart of error against horizon, its legend, how many windows blew up) of fit.held_out."""
    if not curve:
        return "", [], ""
    keys = ("seconds", "before", "after", "floor")
    x, before, after, floor = (np.array([p.get(k) for p in curve], dtype=float) for k in keys)
    wide = bool(np.nanmax(before) > 8 * max(np.nanmin(after), 1e-12))
    looks = [("nominal", "nominal"), ("corrected", "corrected")]
    looks += [("noise", "perfect simulator")] if np.isfinite(floor).any() else []
    lines = [Series(x, y, look) for y, (look, _) in zip((before, after, floor), looks)]
    labels = "horizon (s)", "error (× noise)"
    picture = chart(lines, *labels, log_y=wide, zero=not wide, label="error against horizon")
    counts = [point["blown_up"] for point in curve if "blown_up" in point]
    worst = max(counts, key=lambda b: b["before"] + b["after"], default=None)
    return picture, looks, text.blown_words(worst) if worst else ""


def _traces(diagnosis):
    """Held-out traces: every channel once, from the longest recording that has it; then more."""
    traces = diagnosis.traces
    first = {}
    for i in sorted(range(len(traces)), key=lambda i: -len(traces[i]["time"])):
        first.setdefault(traces[i]["channel"], i)
    shown = sorted(first.values())[:TRACES]
    more = [i for i in range(len(traces)) if i not in shown][:TRACES]
    if not shown:
        return None
    channels = diagnosis.summary["fit"]["held_out"].get("channels") or {}
    draw = lambda i: _trace(traces[i], (channels.get(traces[i]["channel"]) or {}).get("unit"))
    return Section(
        "Recorded and predicted, held out",
        render("traces.html", shown=list(map(draw, shown)), more=list(map(draw, more))),
        "Each prediction starts again from the recording after every horizon.",
    )


def _trace(trace, unit):
    """One channel over time: recorded, nominal, corrected."""
    time = np.asarray(trace["time"], float)
    looks = ("measured", "nominal", "corrected")
    values = {look: np.asarray(trace[look], float) for look in looks}
    # no line between two predictions, but the recording runs on
    seen = ~np.isnan(list(values.values())).all(axis=0)
    lines = [Series(time[seen], values["measured"][seen], "measured")]
    lines += [Series(time, values[look], look) for look in looks[1:]]
    name = text.channel_words(trace["channel"])
    y_label = name + (f" ({unit})" if unit else "")
    svg = chart(lines, "time (s)", y_label, 900, 240, label=f"{name} over time")
    return {"name": name, "recording": trace["recording"], "svg": svg}


def _unexplained(diagnosis):
    left = text.unexplained_words(diagnosis.summary)
    lines = [text.sentence(left)] if left else []
    return Section("What is left", render("list.html", lines=lines)) if lines else None


def _ranking(diagnosis):
    """The candidates, and what each removes alone; those of the diagnosis whatever their rank."""
    findings = diagnosis.summary["findings"]
    named = {(f["effect"], f["place"]["kind"], f["place"]["name"]) for f in findings}
    rows = []
    for rank, candidate in enumerate(diagnosis.ranking):
        place, removed = candidate["place"], candidate["error_removed"]
        chosen = (candidate["effect"], place["kind"], place["name"]) in named
        if rank >= MOST and not chosen:
            continue
        share = 0 if removed is None or not math.isfinite(removed) else min(1, max(0, removed))
        rows.append(
            {
                "effect": candidate["effect"],
                "place": place,
                "chosen": chosen,
                "percent": round(100 * share),
                "p": candidate["p_value"],
            }
        )
    if not rows:
        return None
    return Section(
        "Candidates",
        render("ranking.html", rows=rows),
        "The share of the squared error that each effect at each place removes on its own. Marked: "
        "in the diagnosis.",
    )


def _advice(diagnosis):
    lines = experiments.advice(diagnosis.summary["findings"])
    title = "What cannot be told apart, and the experiment that would"
    return Section(title, render("list.html", lines=lines)) if lines else None


def _about(diagnosis):
    summary = diagnosis.summary
    noise = (f"{text.channel_words(n)} {text.number(v, 2)}" for n, v in summary["noise"].items())
    others = []
    if getattr(diagnosis, "corrected_py", ""):
        others.append(("corrected.py", "what MJCF cannot hold, beside a step of corrected.xml"))
    if unknown_curves(diagnosis):
        others.append(("unknown_<n>.csv", "a force without a name, as a curve"))
    if isinstance(summary.get("missing_force"), dict) and force.courses(diagnosis):
        others.append(("force_<joint>.csv", "the missing force"))
    body = render(
        "about.html",
        train=_names(diagnosis.train),
        held=_names(diagnosis.held_out),
        noise=", ".join(noise),
        warnings=summary.get("warnings", []),
        reads=reads_files(diagnosis.corrected_xml),
        others=others,
    )
    return Section("The recordings", body)


def reads_files(xml: str) -> bool:
    """Whether MJCF names files of meshes, textures or height fields."""
    return bool(re.search(r'\sfile\w*="', xml))


def _names(recordings, most=12):
    """The names of recordings in a line; of a held-out tail, from when on."""
    # a fixed format: the clock of a Recording made in Python may count from 1970
    begins = lambda r: f" from {r.time[r.start]:.2f} s on" if r.start else ""
    names = list(dict.fromkeys(r.name + begins(r) for r in recordings))
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
