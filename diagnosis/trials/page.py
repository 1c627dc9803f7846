"""The page of a benchmark: who names, who predicts, who knows that it does not know, at what cost.

    write({"ours": read_rows("results/proof_final.csv")}, "results/proof_final.html")

Every rate stands with its hits, its trials and its 95 % Wilson interval.
"""

import json
import math
from dataclasses import dataclass

import numpy as np
from scipy.stats import binomtest

from diagnosis.common.atomic_files import write_whole
from diagnosis.common.pages import environment, inlined

WORSE = 1.01  # times the nominal error: predicts worse
CLOSE = 1.1  # times the true model's error: as good as it
STRONG = 3.0  # times the noise
FEW = 30  # failures that are not folded away
SIZES = (0.0, 3.0, 10.0, 30.0, 100.0, math.inf)
GOALS = {
    "strict success, something hidden": "≥ 85 %",
    "one effect > 3 × noise: named, or in a class of ≤ 3": "≥ 95 %",
    "two effects: both": "≥ 90 %",
    "three or four effects: all": "≥ 75 %",
    "95 % intervals that hold the truth": "93–97 %",
    "nothing hidden: a false claim": "≤ 2 %",
    "any trial: a false claim": "≤ 3 %",
    "a law without a name: unknown, place, variable": "≥ 85 %",
    "… a confident wrong name": "≤ 3 %",
    "held-out error above the nominal model's": "none",
    "within 1.1 of the true model's, something hidden": "≥ 90 %",
    "processor seconds, mean": "≤ 15",
}
ROBOTS = ((1, 1), (2, 3), (4, 6), (7, 12))


@dataclass(frozen=True)
class Rate:
    """Hits among trials; both 0 where nothing was asked."""

    hits: int
    trials: int

    @property
    def interval(self):
        """95 % Wilson interval, (0, 1) without trials."""
        if not self.trials:
            return 0.0, 1.0
        found = binomtest(self.hits, self.trials).proportion_ci(0.95, "wilson")
        return found.low, found.high

    def __str__(self):
        if not self.trials:
            return "–"
        low, high = self.interval
        share = 100 * self.hits / self.trials
        return f"{share:.0f} % ({self.hits}/{self.trials}, {100 * low:.0f}–{100 * high:.0f})"


@dataclass(frozen=True)
class Result:
    """A row of a table, read."""

    number: int
    answer: dict
    findings: list | None  # None: no diagnosis.json
    exit: int
    needed: int
    found: int
    first: int
    valued: int
    false: int
    strict: bool
    values: list
    before: float
    after: float  # NaN: no corrected.xml
    floor: float
    cpu_seconds: float
    note: str

    @property
    def kind(self):
        """null, single, unknown, pair or many."""
        return self.answer["kind"]

    @property
    def shown(self):
        """Does the training data show all that is hidden, as the oracle has it?"""
        return all(self.answer["distinct"])

    @property
    def size(self):
        """Smallest of the required items, over the noise; infinite for a null."""
        required = zip(self.answer["hidden"], self.answer["over_noise"])
        return min((s for item, s in required if item["required"]), default=math.inf)

    @property
    def complete(self):
        """Everything needed named, first or in a declared class."""
        return self.found == self.needed

    @property
    def unsure(self):
        """Says `unknown` somewhere, or nothing."""
        claims = self.findings or []
        return not claims or any(f["effect"] == "unknown" for f in claims)


def parse(row):
    """A Result of a row of text."""
    number = lambda name: float(row[name]) if row.get(name) not in (None, "") else math.nan
    count = lambda name: int(row[name] or 0)
    return Result(
        int(row["number"]),
        json.loads(row["answer"]),
        json.loads(row["findings"]) if row["findings"] else None,
        int(row["exit"]),
        *(count(name) for name in ("needed", "found", "first", "valued", "false")),
        row["strict"] == "1",
        json.loads(row["values"] or "[]"),
        *(number(name) for name in ("error_before", "error_after", "error_floor", "cpu_seconds")),
        row["note"],
    )


def rate(results, test):
    """Rate of a test over results."""
    return Rate(sum(bool(test(r)) for r in results), len(results))


def rates(results):
    """[(group, what is asked, Rate or text)] of one tool's results; GOALS has what is aimed at."""
    kind = lambda *names: [r for r in results if r.kind in names and r.needed == expected(r)]
    nulls = [r for r in results if r.kind == "null"]
    hidden = [r for r in results if r.needed]
    singles, unknown = kind("single"), kind("unknown")
    strong = [r for r in singles if r.size > STRONG]
    values = [v for r in results for v in r.values]
    held = [v for v in values if v["held"] is not None]
    # what acts in one recording is in every kept-out one, and in no file
    lasting = [r for r in hidden if r.answer["gate"] != "one recording"]
    return [
        ("names", "strict success, something hidden", rate(hidden, lambda r: r.strict)),
        ("names", "strict success, one named effect", rate(singles, lambda r: r.strict)),
        ("names", "one effect > 3 × noise: named, or in a class of ≤ 3", rate(strong, complete)),
        ("names", "… by its first name", rate(strong, lambda r: r.first == r.needed)),
        ("names", "two effects: both", rate(kind("pair"), complete)),
        ("names", "three or four effects: all", rate(kind("many"), complete)),
        ("names", "values within 5 %", rate(values, lambda v: v["near"])),
        ("names", "95 % intervals that hold the truth", rate(held, lambda v: v["held"])),
        ("names", "names in a declared class, mean", class_size(results)),
        ("does not invent", "nothing hidden: a false claim", rate(nulls, lambda r: r.false)),
        ("does not invent", "any trial: a false claim", rate(results, lambda r: r.false)),
        ("knows what it lacks", "a law without a name: unknown, place, variable",
         rate(unknown, complete)),
        ("knows what it lacks", "… a confident wrong name",
         rate(unknown, lambda r: r.false and not r.unsure)),
        ("predicts", "held-out error above the nominal model's", rate(results, worse)),
        ("predicts", "… and above that of the true model",
         rate(results, lambda r: worse(r) and r.after > WORSE * r.floor)),
        ("predicts", "within 1.1 of the true model's, something hidden", rate(lasting, close)),
        ("costs", "no answer", rate(results, lambda r: r.exit != 0)),
        ("costs", "processor seconds, mean", f"{np.mean([r.cpu_seconds for r in results]):.1f}"),
        ("apart", "hidden, but not told apart by the training data",
         rate([r for r in results if r.kind != "null"], lambda r: not r.shown)),
    ]  # fmt: skip


def expected(result):
    """Required items of a trial."""
    return sum(item["required"] for item in result.answer["hidden"])


def complete(result):
    """See Result.complete."""
    return result.complete


def worse(result):
    """Predicts held-out recordings worse than the nominal model; no file at all does not."""
    return result.after > WORSE * result.before


def close(result):
    """Predicts nearly as well as the true system from the same noisy starts."""
    return result.after <= CLOSE * result.floor


def class_size(results):
    """Mean number of names that right findings list besides their own, as text."""
    sizes = [len(f.get("also_possible") or []) for r in results for f in r.findings or []]
    return f"{np.mean(sizes):.2f}" if sizes else "–"


def headline(tables):
    """Lines of a Markdown table: every rate, a column for each tool."""
    columns = [rates([parse(row) for row in rows]) for rows in tables.values()]
    line = lambda cells: "| " + " | ".join(map(str, cells)) + " |"
    lines = [line(["", "goal", *tables]), "|---" * (len(tables) + 2) + "|"]
    for cells in zip(*columns):
        asked = cells[0][1]
        lines.append(line([asked, GOALS.get(asked, ""), *(cell[2] for cell in cells)]))
    return lines


# breakdowns


def axes(result):
    """[(column, value)] of everything that a trial's result is broken down by."""
    a, plan = result.answer, result.answer["plan"]
    joints = next(f"{lo}–{hi}" if lo < hi else f"{lo}" for lo, hi in ROBOTS if a["joints"] <= hi)
    pairs = [
        ("joints", joints),
        ("motion", plan["level"]),
        ("control", "feedback" if plan["feedback"] == "closed" else "open loop"),
        ("noise", plan["noise_kind"]),
        ("speeds", plan["velocities"]),
        ("stamps", plan["stamps"]),
        ("rows", "missing" if plan["missing"] else "complete"),
        ("comes and goes", a["gate"] or "always there"),
    ]
    flags = {
        "mimic": "behind a mimic",
        "fitted_without": "behind fitted nominal values",
        "motorless": "joint without motor",
    }
    pairs += [("hidden", text) for flag, text in flags.items() if a.get(flag)]
    touch = "joint ranges" if a["stops"] else "a free base's feet" if a["free_base"] else "a foot"
    pairs.append(("touches", touch if a["touched"] else "nothing"))
    if any(item["removed"] for item in a["hidden"]):
        pairs.append(("hidden", "nominal has too much"))
    if result.needed:
        size = next(f"{lo:g}–{hi:g}" for lo, hi in zip(SIZES, SIZES[1:]) if result.size <= hi)
        pairs.append(("size over noise", size))
    for item in a["hidden"]:
        if item["required"]:
            pairs.append(("effect", item["law"] or item["effect"]))
    return pairs


def breakdown(results):
    """[(column, value, strict, named, false claim, never worse)] as text, by axes."""
    groups = {}
    for result in results:
        for pair in axes(result):
            groups.setdefault(pair, []).append(result)
    lines = []
    for (column, value), chosen in sorted(groups.items()):
        asked = [r for r in chosen if r.needed]
        cells = (rate(asked, lambda r: r.strict), rate(asked, complete))
        cells += (rate(chosen, lambda r: r.false), rate(chosen, worse))
        lines.append((column, value, *map(str, cells)))
    return lines


def told(item):
    """A hidden item or a finding in a few words."""
    law = f" ({item['law']})" if item.get("law") else ""
    minus = "too much " if item.get("removed") else ""
    values = item.get("parameters") or []
    if isinstance(values, list):
        values = {p["name"]: p["value"] for p in values}
    number = lambda v: f"{v:.4g}" if isinstance(v, int | float) else "?" if v is None else str(v)
    text = ", ".join(f"{k} {number(v)}" for k, v in values.items() if not isinstance(v, list))
    return f"{minus}{item['effect']}{law} at {item['place']['name']} ({text})"


def failures(results):
    """[(number, robot, hidden, said, what is wrong)] of every trial that is no strict success."""
    lines = []
    for r in results:
        faults = [f"exit {r.exit}: {r.note}"] if r.exit else []
        faults += [f"{r.needed - r.found} not found"] if not r.complete else []
        faults += [f"{r.false} false"] if r.false else []
        faults += [f"{r.found - r.valued} with a wrong value"] if r.valued < r.found else []
        faults += ["predicts worse"] if worse(r) else []
        if not faults:
            continue
        a = r.answer
        robot = f"{a['joints']} joints, {a['plan']['level']}"
        sizes = [*a["over_noise"]]
        hidden = "; ".join(
            f"{told(item)} {size:.1f}×" + ("" if item["required"] else " [fitted]")
            for item, size in zip(a["hidden"], sizes)
        )
        said = "; ".join(map(told, r.findings or [])) or "nothing"
        lines.append((r.number, robot, hidden or "nothing", said, "; ".join(faults)))
    return lines


def write(tables, out):
    """Write the page of {tool: rows} to `out`, whole. Raises WriteError."""
    parsed = {name: [parse(row) for row in rows] for name, rows in tables.items()}
    columns = [rates(results) for results in parsed.values()]
    first = next(iter(tables.values()))
    versions = {row["version"][:12] or "development" for rows in tables.values() for row in rows}
    text = (
        environment("diagnosis.trials")
        .get_template("page.html")
        .render(
            style=inlined("diagnosis.trials", "templates/style.css"),
            count=len(first),
            settings=first[0]["settings"],
            versions=", ".join(sorted(versions)),
            names=list(parsed),
            rates=[
                (c[0][0], c[0][1], GOALS.get(c[0][1], ""), *(cell[2] for cell in c))
                for c in zip(*columns)
            ],
            breakdowns={name: breakdown(results) for name, results in parsed.items()},
            failures={name: failures(results) for name, results in parsed.items()},
            few=FEW,
        )
    )
    write_whole(out, text.lstrip() + "\n")
