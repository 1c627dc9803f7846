"""The page of the sealed trials: rates with Wilson intervals, and figures, from the table of prove.py.

python prove.py page results/proof.csv --out results/proof.html
"""

import base64
import html
import io
import json
from collections import Counter

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from diagnosis.common.atomic_files import write_whole
from diagnosis.trials.conceal import NAMED, seal
from diagnosis.trials.mechanisms import UNKNOWNS

EDGES = (0, 1, 3, 10, 30, 100, np.inf)  # of the effect's size over the noise
FORMLESS = (
    "joint_stop",
    "backlash",
    "payload_change",
    "stribeck_friction",
)  # truth built otherwise than MJCF can


def wilson(hits, trials, z=1.96):
    """95 % Wilson interval of a rate, (low, high); (0, 1) without trials."""
    if trials == 0:
        return 0.0, 1.0
    rate, square = hits / trials, z * z / trials
    centre = (rate + square / 2) / (1 + square)
    half = z * np.sqrt(rate * (1 - rate) / trials + square / (4 * trials)) / (1 + square)
    return float(max(0.0, centre - half)), float(min(1.0, centre + half))


def parse(row, seals):
    """A row of the table with its JSON and numbers read; trials without a diagnosis found nothing. seals: as prove.published gives."""
    number = lambda key: float(row[key]) if row[key] else float("nan")
    answer = json.loads(row["answer"])
    return {
        **row,
        "answer": answer,
        "hidden": answer["hidden"],
        "moved": json.loads(row["over_noise"]),
        "findings": json.loads(row["findings"] or "[]"),
        "parameters": json.loads(row["parameters"] or "[]"),
        "found": int(row["found"] or 0),
        "first": int(row["first"] or 0),
        "extras": int(row["extras"] or 0),
        "finer": int(row["finer"]),
        "sealed": seal(row["answer"], row["salt"]) == row["commitment"]
        and row["commitment"] in seals.get((row["seed"], row["trial"]), ()),
        **{
            key: number(key)
            for key in (
                "seconds",
                "cpu_seconds",
                "error_before",
                "error_after",
                "error_floor",
                "reported_before",
                "reported_after",
                "remeasured_after",
            )
        },
    }


def rates(rows):
    """[(what, hits, trials)] of everything that is asked of the method; rows as `parse` gives them."""
    diagnosed = [r for r in rows if r["exit"] == "0"]
    single = [r for r in rows if r["kind"] == "single"]
    strong = [r for r in single if min(r["moved"]) > 1]
    literal = [r for r in single if r["error_before"] - r["error_floor"] > 1]
    null = [r for r in rows if r["kind"] == "null"]
    pairs = [r for r in rows if r["kind"] == "pair"]
    strong_pairs = [r for r in pairs if min(r["moved"]) > 1]
    unknown = [r for r in rows if r["kind"] == "unknown" and min(r["moved"]) > 1]
    intervals = [
        (r, p)
        for r in rows
        for p in r["parameters"]
        if p["low"] is not None and p["high"] is not None
    ]
    held = lambda chosen: (sum(p["low"] <= p["truth"] <= p["high"] for _, p in chosen), len(chosen))
    formed = [(r, p) for r, p in intervals if p["effect"] not in FORMLESS]
    estimates = [p for r in strong for p in r["parameters"]]
    changes = [
        p for p in estimates if p["nominal"] not in (None, p["truth"])
    ]  # None: a limit that the model does not have
    named = [r for r in single if r["answer"]["sizes"] == [0.0]]
    count = lambda chosen, test: (sum(map(test, chosen)), len(chosen))
    return [
        ("a diagnosis was made (exit status 0)", len(diagnosed), len(rows)),
        ("the seal holds", *count(rows, lambda r: r["sealed"])),
        (
            "one effect that moves prediction by > 1 x noise: named or among the possible",
            *count(strong, lambda r: r["found"] == 1),
        ),
        ("… by its first name", *count(strong, lambda r: r["first"] == 1)),
        (
            "… and nothing else claimed",
            *count(strong, lambda r: r["found"] == 1 and r["extras"] == 0),
        ),
        (
            "… where it moves the contract's Error (noisy starts) by > 1 x noise: named or among the possible",
            *count(literal, lambda r: r["found"] == 1),
        ),
        (
            "one effect that moves prediction by less: a wrong name",
            *count([r for r in single if min(r["moved"]) <= 1], lambda r: r["extras"] > 0),
        ),
        (
            "nothing hidden: a false alarm, or no diagnosis",
            *count(null, lambda r: r["extras"] > 0 or r["exit"] != "0"),
        ),
        (
            "two effects, each > 1 x noise: both named or among the possible",
            *count(strong_pairs, lambda r: r["found"] == 2),
        ),
        ("… both by first name", *count(strong_pairs, lambda r: r["first"] == 2)),
        ("… at least one of them", *count(strong_pairs, lambda r: r["found"] >= 1)),
        (
            "an effect without a name (> 1 x noise): called unknown, right place, right variable",
            *count(unknown, lambda r: r["found"] == 1),
        ),
        (
            "… called by a catalogue name instead, unknown not among the possible",
            *count(unknown, confidently_wrong),
        ),
        (
            "parameters within 5 % (first name right, effect > 1 x noise)",
            *count(estimates, lambda p: deviation(p) <= 0.05),
        ),
        (
            "… within 5 % of their change from a finite nominal value",
            *count(
                changes,
                lambda p: abs(p["value"] - p["truth"]) <= 0.05 * abs(p["truth"] - p["nominal"]),
            ),
        ),
        ("95 % intervals hold the truth: all", *held(intervals)),
        ("… where the truth has the model's form", *held(formed)),
        ("… and its time step", *held([(r, p) for r, p in formed if r["finer"] == 1])),
        ("… and a finer one", *held([(r, p) for r, p in formed if r["finer"] > 1])),
        (
            "Hopper torso +27 %, HalfCheetah torso +15 %, pendulum pole 100: named",
            *count(named, lambda r: r["found"] == 1),
        ),
        (
            "error of corrected.xml in stock MuJoCo within 2 % of the reported one (all findings in MJCF)",
            *count(
                [
                    r
                    for r in diagnosed
                    if r["findings"]
                    and all(f.get("written_as", "mjcf") == "mjcf" for f in r["findings"])
                ],
                agrees,
            ),
        ),
    ]


def deviation(p):
    """Relative to the true value, to the change from the nominal or, of a vector, to its size, where that is larger."""
    return abs(p["value"] - p["truth"]) / max(
        abs(p["truth"]), abs(p["truth"] - (p["nominal"] or 0.0)), p.get("size", 0.0), 1e-12
    )


def confidently_wrong(row):
    """Names from the catalogue, and no `unknown` anywhere."""
    claims = [f for f in row["findings"] if f["effect"] != "time_step"]
    return bool(claims) and not any(
        f["effect"] == "unknown"
        or any(a["effect"] == "unknown" for a in f.get("also_possible", []))
        for f in claims
    )


def agrees(row):
    """The held-out error that the report gives is that of corrected.xml in stock MuJoCo, in the report's own noise."""
    return abs(row["remeasured_after"] - row["reported_after"]) <= 0.02 * row["reported_after"]


def confusion(rows):
    """(truths, names, counts) of trials with at most one thing hidden: its name where a finding has it, else the first."""
    pairs = []
    for row in rows:
        if row["kind"] not in ("single", "null", "unknown"):
            continue
        truth = row["hidden"][0]["effect"] if row["hidden"] else "(nothing)"
        claims = [
            f["effect"]
            for f in row["findings"]
            if f["effect"] != "time_step" or truth == "time_step"
        ]
        if row["first"]:
            name = "unknown" if truth in UNKNOWNS else truth
        else:
            name = claims[0] if claims else "(nothing)" if row["exit"] == "0" else "(no diagnosis)"
        pairs.append((truth, name))
    truths = sorted({t for t, _ in pairs})
    names = sorted({n for _, n in pairs} | set(truths) - set(UNKNOWNS))
    counts = np.zeros((len(truths), len(names)), int)
    for truth, name in pairs:
        counts[truths.index(truth), names.index(name)] += 1
    return truths, names, counts


def _picture(figure):
    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "proof"}):  # the same table gives the same page
        figure.savefig(buffer, format="svg", bbox_inches="tight", metadata={"Date": None})
    return f'<img src="data:image/svg+xml;base64,{base64.b64encode(buffer.getvalue()).decode()}" alt="">'


def _confusion_figure(rows):
    truths, names, counts = confusion(rows)
    figure = Figure(figsize=(0.26 * len(names) + 2, 0.24 * len(truths) + 2))
    axis = figure.subplots()
    axis.imshow(counts / np.maximum(counts.sum(1, keepdims=True), 1), cmap="Blues", vmin=0, vmax=1)
    for i, j in zip(*np.nonzero(counts)):
        axis.text(j, i, counts[i, j], ha="center", va="center", fontsize=7)
    axis.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
    axis.set_yticks(range(len(truths)), truths, fontsize=7)
    axis.set_xlabel("first finding")
    axis.set_ylabel("hidden")
    return _picture(figure)


def _detection_figure(rows):
    figure = Figure(figsize=(6, 3.2))
    axis = figure.subplots()
    single = [r for r in rows if r["kind"] == "single"]
    for key, label, shift in (("found", "named or possible", -0.06), ("first", "first name", 0.06)):
        for k, (low, high) in enumerate(zip(EDGES, EDGES[1:])):
            chosen = [r[key] for r in single if low < r["moved"][0] <= high]
            if chosen:
                a, b = wilson(sum(chosen), len(chosen))
                axis.plot([k + shift] * 2, [a, b], color="C0" if shift < 0 else "C1")
                axis.plot(
                    k + shift, np.mean(chosen), "o", color="C0" if shift < 0 else "C1", label=label
                )
                if shift < 0:
                    axis.text(k, 1.04, f"n={len(chosen)}", ha="center", fontsize=8)
    axis.set_xticks(range(len(EDGES) - 1), [f"{a:g}–{b:g}" for a, b in zip(EDGES, EDGES[1:])])
    axis.set(
        xlabel="how far the effect moves the held-out prediction, over the noise",
        ylabel="rate",
        ylim=(-0.02, 1.12),
    )
    handles = dict(zip(*axis.get_legend_handles_labels()[::-1]))  # one of each
    if handles:
        axis.legend(handles.values(), handles.keys(), loc="lower right")
    return _picture(figure)


def _error_figure(rows):
    figure = Figure(figsize=(6, 4))
    axis = figure.subplots()
    hidden = [r for r in rows if r["hidden"] and r["exit"] == "0" and np.isfinite(r["error_after"])]
    hidden.sort(key=lambda r: r["error_before"])
    for key, mark, label in (
        ("error_before", "C3.", "before"),
        ("error_after", "C0.", "after (corrected.xml, stock MuJoCo)"),
        ("error_floor", "k_", "floor (the true system from the same noisy starts)"),
    ):
        axis.semilogy([r[key] for r in hidden], mark, label=label, markersize=4)
    axis.set(
        xlabel="trials with something hidden, by error before", ylabel="held-out error / noise"
    )
    axis.legend()
    return _picture(figure)


def _interval_figure(rows):
    figure = Figure(figsize=(6, 2.8))
    axis = figure.subplots()
    scores = [
        (p["value"] - p["truth"]) / max((p["high"] - p["low"]) / 3.92, 1e-300)
        for r in rows
        for p in r["parameters"]
        if None not in (p["low"], p["high"])
    ]
    if scores:
        axis.hist(np.clip(scores, -6, 6), np.linspace(-6, 6, 49), density=True)
    x = np.linspace(-6, 6, 200)
    axis.plot(x, np.exp(-x * x / 2) / np.sqrt(2 * np.pi), "k", linewidth=1)
    axis.set(xlabel="(value - truth) / (interval / 3.92), beyond 6 drawn at 6", ylabel="density")
    return _picture(figure)


def _table(header, lines):
    cell = lambda tag, values: "".join(f"<{tag}>{html.escape(str(v))}</{tag}>" for v in values)
    body = "".join(f"<tr>{cell('td', line)}</tr>" for line in lines)
    return f"<table><tr>{cell('th', header)}</tr>{body}</table>"


def _by(rows, key):
    """Lines (key, trials, found, first, false claims) over singles that move prediction by more than the noise."""
    groups = {}
    for row in rows:
        if row["kind"] == "single" and row["moved"][0] > 1:
            groups.setdefault(key(row), []).append(row)
    return [
        (
            name,
            len(g),
            sum(r["found"] for r in g),
            sum(r["first"] for r in g),
            sum(r["extras"] > 0 for r in g),
        )
        for name, g in sorted(groups.items())
    ]


def lines(rows):
    """[(what, "hits/trials", percent, Wilson interval)] as text, for the page and the terminal."""
    return [
        (
            what,
            f"{hits}/{trials}",
            f"{100 * hits / trials:.1f} %" if trials else "-",
            "{:.1f}–{:.1f} %".format(*(100 * bound for bound in wilson(hits, trials))),
        )
        for what, hits, trials in rates(rows)
    ]


def write(table, seals, out):
    """Write the page of a table (rows as prove.read, seals as prove.published gives them) to `out`, whole."""
    rows = [parse(row, seals) for row in table]
    without = len(set(seals) - {(row["seed"], row["trial"]) for row in rows})
    twice = sum(len(found) > 1 for found in seals.values())
    kinds = Counter(row["kind"] for row in rows)
    seconds = np.array([row["cpu_seconds"] for row in rows])
    worst = [
        (
            r["trial"],
            r["mechanism"],
            "finer" if r["finer"] > 1 else "same",
            "; ".join(
                f"{h['effect']}@{h['place']['name']} ({m:.1f}x)"
                for h, m in zip(r["hidden"], r["moved"])
            ),
            "; ".join(f"{f['effect']}@{f['place']['name']}" for f in r["findings"])
            or ("-" if r["exit"] == "0" else r["note"]),
        )
        for r in rows
        if r["extras"] or r["found"] < sum(m > 1 for m in r["moved"])
    ]
    body = [
        "<h1>Sealed blind trials of the diagnosis</h1>",
        f"<p>{len(rows)} trials, seed {', '.join(sorted({row['seed'] for row in rows}))}: "
        + ", ".join(f"{n} {kind}" for kind, n in kinds.items())
        + f". CPU seconds of a diagnosis: median {np.median(seconds):.1f}, longest {seconds.max():.1f}. "
        f"Sealed but not in the table: {without}; broken off and sealed again: {twice}.</p>",
        _table(("rate", "hits / trials", "", "95 % Wilson interval"), lines(rows)),
        "<h2>Detection against size</h2>",
        _detection_figure(rows),
        "<h2>What was hidden, what was said first</h2>",
        _confusion_figure(rows),
        "<h2>Held-out error</h2>",
        _error_figure(rows),
        "<h2>Intervals</h2>",
        _interval_figure(rows),
        "<h2>By effect</h2>",
        _table(
            ("effect", "trials", "found", "first", "false claims"),
            _by(rows, lambda r: r["hidden"][0]["effect"]),
        ),
        "<h2>By mechanism</h2>",
        _table(
            ("mechanism", "trials", "found", "first", "false claims"),
            _by(rows, lambda r: r["mechanism"]),
        ),
        "<h2>Every miss and every false claim</h2>",
        _table(("trial", "mechanism", "time step", "hidden (over the noise)", "findings"), worst),
        f"<p>Named specially: {html.escape(', '.join(NAMED))}. Truth in another form than the catalogue's, left out "
        f"of one line: "
        f"{html.escape(', '.join(FORMLESS))}.</p>",
    ]
    style = (
        "body{font:16px/1.5 sans-serif;max-width:60em;margin:auto;padding:1em}img{max-width:100%}"
        "table{border-collapse:collapse;font-size:85%;display:block;overflow-x:auto}td,th{padding:.2em .6em;"
        "border-bottom:1px solid #ddd;text-align:left}"
    )
    page = (
        '<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>Sealed blind trials</title><style>{style}</style>{''.join(body)}</html>"
    )
    write_whole(out, page)
