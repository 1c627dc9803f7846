"""Development trials: drawn once, then any tool is scored on the same recordings.

    python benchmarks/development.py draw --cache devset --trials 40
    python benchmarks/development.py score --cache devset --out results/development.csv
    python benchmarks/development.py score --cache devset --only 3,8-12 --against old.csv
    python benchmarks/development.py score --cache devset --kinds null,single --free --out new.csv
    python benchmarks/development.py score --cache devset --version ../other --out other.csv
    python benchmarks/development.py score --cache devset --tool "mytool {model} {recordings} {out}"

Trials follow the DEVELOPMENT settings, in half of which something touches the ground or a stop.
Nothing is sealed here. The CSV is written after each trial; trials that it holds are not run again.
"""

import argparse
import csv
import os
import shutil
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import mujoco  # noqa: E402
import numpy as np  # noqa: E402

from diagnosis.common.atomic_files import write_table  # noqa: E402
from diagnosis.trials.drawing import draw_trial  # noqa: E402
from diagnosis.trials.kept import BENCH, HELD_OUT, is_kept, keep, read_answer  # noqa: E402
from diagnosis.trials.prediction import model_error  # noqa: E402
from diagnosis.trials.replay import load_runs, replay  # noqa: E402
from diagnosis.trials.robots import DEVELOPMENT  # noqa: E402
from diagnosis.trials.scoring import beside, score_findings  # noqa: E402
from diagnosis.trials.sealing import checked_out  # noqa: E402
from diagnosis.trials.tools import run_tool  # noqa: E402

COLUMNS = (
    "trial kind joints touches level hidden over_noise verdict said exit needed found first strict "
    "false unknown_placed prediction error_before error_after error_floor seconds steps version "
    "note"
).split()
KINDS = ("null", "single", "unknown", "pair", "many")
DIAGNOSE = (
    "{{python}} {folder}/diagnose.py --model {{model}} --recordings {{recordings}} --out {{out}}"
)


@dataclass(frozen=True)
class Job:
    """A drawn trial and the tool to run. limit: processor seconds; keep: folder for reports."""

    number: int
    folder: Path
    tool: str
    limit: int
    keep: Path | None
    version: str


def draw(seed, number, cache):
    """Draw a trial into cache/SEED_NUMBER, unless it is there; returns that folder."""
    folder = Path(cache) / f"{seed}_{number}"
    return folder if is_kept(folder) else keep(draw_trial((seed, number), DEVELOPMENT), folder)


def place(item):
    """What was hidden or said, and where, in a word."""
    law = f"={item['law']}" if item.get("law") else ""
    minus = "-" if item.get("removed") else ""
    return f"{minus}{item['effect']}{law}@{item['place']['name']}"


def said(finding):
    """A finding in a few words: name, place, value, and the class declared."""
    values = ",".join(
        f"{p['value']:.3g}" for p in finding.get("parameters", [])[:3] if p.get("value") is not None
    )
    others = "|".join(place(o) for o in finding.get("also_possible") or [])
    needs = "+".join(finding.get("depends_on") or []) if finding["effect"] == "unknown" else ""
    return f"{place(finding)}({values or needs})" + (f" or {others}" if others else "")


def score(job):
    """One row of the table: the tool runs in a folder of its own, so that several may at once."""
    answer, floor = read_answer(job.folder)
    held_out = job.folder / HELD_OUT
    with tempfile.TemporaryDirectory() as parent:
        bench = shutil.copytree(
            job.folder / BENCH, Path(parent) / "run", ignore=shutil.ignore_patterns("report")
        )
        names = sorted(path.name for path in bench.glob("train_*.csv"))
        done = run_tool(job.tool, bench, names, job.limit)
        summary = done.summary() if done.exit == 0 else None
        written = done.exit == 0 and (done.report / "corrected.xml").exists()
        after = replay(bench / "sim.xml", done.report, held_out) if written else None
        nominal = mujoco.MjModel.from_xml_path(str(bench / "sim.xml"))
        before = model_error(nominal, nominal, *load_runs(held_out))
        if job.keep and done.report.exists():
            shutil.copytree(done.report, job.keep / str(job.number), dirs_exist_ok=True)
    return verdict(job.number, answer, summary) | {
        "exit": done.exit,
        "prediction": "" if after is None else f"{after / before:.4g}",
        "error_before": f"{before:.4g}",
        "error_after": "" if after is None else f"{after:.4g}",
        "error_floor": f"{floor:.4g}",
        "seconds": f"{done.cpu_seconds:.1f}",
        "steps": ((summary or {}).get("cost") or {}).get("steps", ""),
        "version": job.version,
        "note": done.note,
    }


def verdict(number, answer, summary):
    """The columns that a diagnosis.json decides; summary: None where there is none."""
    findings = summary["findings"] if summary else []
    result = score_findings(answer, findings)
    unknown = [f["place"] for f in findings if f["effect"] == "unknown"]
    placed = sum(any(beside(p, item) for p in unknown) for item in answer["hidden"])
    touches = "stops" if answer["stops"] else "free base" if answer["free_base"] else "ground"
    return {
        "trial": number,
        "kind": answer["kind"],
        "joints": answer["joints"],
        "touches": touches if answer["touched"] else "",
        "level": answer["plan"]["level"],
        "hidden": "; ".join(map(place, answer["hidden"])) or "nothing",
        "over_noise": " ".join(f"{v:.1f}" for v in answer["over_noise"]),
        "verdict": summary.get("verdict", "") if summary else "",
        "said": "; ".join(map(said, findings)) or ("nothing" if summary else "-"),
        "needed": len(result.needed),
        "found": result.found,
        "first": result.first,
        "strict": int(result.strict and summary is not None),
        "false": len(result.false),
        "unknown_placed": placed if answer["hidden"] else "",
    }


def line(row):
    """One trial for the terminal."""
    right = "MISS"
    if int(row["strict"]):
        right = "right"
    elif row["found"] == row["needed"]:
        right = "named"
    right = f"{right}+{row['false']} FALSE" if int(row["false"]) else right
    right = right if int(row["exit"]) == 0 else f"exit {row['exit']}"
    return (
        f"{row['trial']:>3} {row['kind']:7s} {row['joints']}j {row['touches'] or 'free':9s}"
        f" {right:14s} {row['seconds']:>6s}s {row['error_before']:>6s}>{row['error_after']:>6s}"
        f" floor {row['error_floor']:>6s} hid {row['hidden']} ({row['over_noise']}x)"
        f" | said {row['said']} {row['note'][:80]}"
    )


def totals(rows):
    """Rates over the rows, as one text."""
    count = lambda chosen, test: f"{sum(map(test, chosen))}/{len(chosen)}"
    whole = lambda name: lambda row: int(row[name])
    named = lambda row: int(row["found"]) == int(row["needed"]) and int(row["exit"]) == 0
    out = []
    for kind in (*KINDS, "all"):
        chosen = [r for r in rows if kind in (r["kind"], "all")]
        if chosen:
            out.append(
                f"{kind:7s} strict {count(chosen, whole('strict'))}, named {count(chosen, named)},"
                f" false claim {count(chosen, lambda r: int(r['false']) > 0)}"
            )
    worse = count(rows, lambda r: float(r["prediction"] or 1) > 1.01)
    near = lambda r: float(r["error_after"] or "inf") <= 1.1 * float(r["error_floor"])
    seconds = [float(r["seconds"]) for r in rows]
    return "\n".join(
        [
            *out,
            f"predicts worse than nominal {worse}, within 1.1 of the truth {count(rows, near)};"
            f" processor seconds: mean {np.mean(seconds):.1f}, median {np.median(seconds):.1f}",
        ]
    )


def difference(rows, others):
    """Trials of both tables in which right, wrong or predicted differ, as one text."""
    before = {int(row["trial"]): row for row in others}
    out = []
    for row in rows:
        old = before.get(int(row["trial"]))
        if old is None:
            continue
        ratio = float(row["prediction"] or 1) / max(float(old["prediction"] or 1), 1e-12)
        moved = any(int(row[c]) != int(old[c]) for c in ("strict", "found", "false"))
        if moved or not 0.9 < ratio < 1.1:
            out += [f"before {line(old)}", f"now    {line(row)}"]
    return "\n".join(out or ["no trial differs"])


def read(path):
    """Rows of a CSV, none where there is no file."""
    if not path or not Path(path).exists():
        return []
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def numbers(text):
    """The set {3, 8, 9, 10} of a text "3,8-10"."""
    spans = (part.partition("-") for part in text.split(","))
    return {n for low, _, high in spans for n in range(int(low), int(high or low) + 1)}


def where(parser):
    """Add the options of where drawn trials are."""
    parser.add_argument("--cache", type=Path, required=True, help="where drawn trials are")
    parser.add_argument("--seed", type=int, default=1)


def choice(parser):
    """Add the options of chosen()."""
    where(parser)
    parser.add_argument("--only", help="numbers of trials: 3,8-12")
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--free", action="store_true", help="only trials that touch nothing")


def chosen(options):
    """Numbers and folders of the drawn trials that are to be scored."""
    folders = {int(f.name.split("_")[1]): f for f in options.cache.glob(f"{options.seed}_*")}
    out = []
    for number, folder in sorted(folders.items()):
        if not is_kept(folder):
            continue
        answer, _ = read_answer(folder)
        if options.only and number not in numbers(options.only):
            continue
        if answer["kind"] in options.kinds.split(",") and not (options.free and answer["touched"]):
            out.append((number, folder))
    return out


def score_all(options):
    """Score what the CSV does not hold yet, in `--jobs` processes; returns all rows."""
    rows = read(options.out)
    done = {int(row["trial"]) for row in rows}
    template = options.tool or DIAGNOSE.format(folder=options.version.resolve())
    version = checked_out(options.version)[:12]
    todo = [
        Job(number, folder, template, options.limit, options.keep, version)
        for number, folder in chosen(options)
        if number not in done
    ]
    with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
        for row in pool.map(score, todo):
            rows.append({k: str(v) for k, v in row.items()})
            print(line(rows[-1]), flush=True)
            if options.out:
                options.out.parent.mkdir(parents=True, exist_ok=True)
                rows.sort(key=lambda r: int(r["trial"]))
                write_table(options.out, COLUMNS, rows)
    return rows


def parse():
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    command = commands.add_parser("draw")
    where(command)
    command.add_argument("--trials", type=int, default=40)
    command = commands.add_parser("score")
    choice(command)
    command.add_argument("--version", type=Path, default=ROOT, help="folder with a diagnose.py")
    command.add_argument("--tool", help="another command line, see prove.py")
    command.add_argument("--limit", type=int, default=300, help="processor seconds for a diagnosis")
    command.add_argument("--jobs", type=int, default=1, help="trials at once")
    command.add_argument("--keep", type=Path, help="folder that gets the reports, by number")
    command.add_argument("--out", type=Path, help="CSV; trials in it are not run again")
    command.add_argument("--against", type=Path, help="CSV of another version, to see differences")
    return parser.parse_args()


def main():
    """Draw, or score."""
    options = parse()
    os.environ["OMP_NUM_THREADS"] = "1"
    if options.command == "draw":
        for number in range(options.trials):
            print(draw(options.seed, number, options.cache), flush=True)
        return
    rows = score_all(options)
    if rows:
        print(totals(rows))
    if options.against:
        print(difference(rows, read(options.against)))


if __name__ == "__main__":
    main()
