"""Development trials on a given version of the diagnosis: one line per trial, paired by seed.

    python benchmarks/development.py --trials 60 --seed 1 --cache /tmp/trials
    python benchmarks/development.py --trials 60 --cache /tmp/trials --version ../old --out old.csv
    python benchmarks/development.py --trials 60 --cache /tmp/trials --only 3,17 --kinds null,single

Trials are drawn with the DEVELOPMENT settings and kept under --cache, so that a second version
meets the same recordings without drawing them again. Nothing is sealed here.
"""

import argparse
import csv
import json
import shutil
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import mujoco  # noqa: E402
import numpy as np  # noqa: E402

from diagnosis.trials.drawing import draw_trial, write_folder  # noqa: E402
from diagnosis.trials.prediction import model_error, system_error  # noqa: E402
from diagnosis.trials.replay import load_runs, replay, save_runs  # noqa: E402
from diagnosis.trials.robots import DEVELOPMENT  # noqa: E402
from diagnosis.trials.scoring import score_findings  # noqa: E402
from diagnosis.trials.tools import run_tool  # noqa: E402

COLUMNS = (
    "trial kind joints level hidden over_noise verdict said exit first found needed false strict "
    "error_before error_after error_floor cpu_seconds steps note"
).split()


def cached(seed, number, cache):
    """(its folder, with bench/ for the tool; the answer) of a trial, drawn at first use."""
    folder = Path(cache) / f"{seed}_{number}"
    if not (folder / "answer.json").exists():
        folder.mkdir(parents=True, exist_ok=True)
        trial = draw_trial((seed, number), DEVELOPMENT)
        (folder / "bench").mkdir(exist_ok=True)
        write_folder(trial, folder / "bench")
        save_runs(folder / "held_out.npz", trial.held_out, trial.noise)
        floor = system_error(trial.system(), trial.held_out, trial.noise)
        answer = trial.answer | {"error_floor": floor, "noise": trial.noise.tolist()}
        (folder / "answer.json").write_text(json.dumps(answer))
    return folder, json.loads((folder / "answer.json").read_text())


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


def run_trial(template, seed, number, cache, limit):
    """One row of the table."""
    folder, answer = cached(seed, number, cache)
    bench = folder / "bench"
    shutil.rmtree(bench / "report", ignore_errors=True)
    names = sorted(path.name for path in bench.glob("train_*.csv"))
    done = run_tool(template, bench, names, limit)
    summary = done.summary() if done.exit == 0 else None
    findings = summary["findings"] if summary else []
    score = score_findings(answer, findings)
    nominal = mujoco.MjModel.from_xml_path(str(bench / "sim.xml"))
    held_out, noise = load_runs(folder / "held_out.npz")
    after = replay(bench / "sim.xml", done.report, folder / "held_out.npz")
    return {
        "trial": number,
        "kind": answer["kind"],
        "joints": answer["joints"],
        "level": answer["plan"]["level"],
        "hidden": "; ".join(map(place, answer["hidden"])) or "nothing",
        "over_noise": " ".join(f"{v:.1f}" for v in answer["over_noise"]),
        "verdict": summary.get("verdict", "") if summary else "",
        "said": "; ".join(map(said, findings)) or ("nothing" if summary else "-"),
        "exit": done.exit,
        "first": score.first,
        "found": score.found,
        "needed": len(score.needed),
        "false": len(score.false),
        "strict": int(score.strict and summary is not None),
        "error_before": f"{model_error(nominal, nominal, held_out, noise):.4g}",
        "error_after": f"{after:.4g}",
        "error_floor": f"{answer['error_floor']:.4g}",
        "cpu_seconds": f"{done.cpu_seconds:.1f}",
        "steps": ((summary or {}).get("cost") or {}).get("steps", ""),
        "note": done.note,
    }


def line(row):
    """One trial for the terminal."""
    right = "right" if row["strict"] else "named" if row["found"] == row["needed"] else "MISS"
    right = f"{right}+{row['false']} FALSE" if row["false"] else right
    right = right if row["exit"] == 0 else f"exit {row['exit']}"
    return (
        f"{row['trial']:3d} {row['kind']:7s} {row['joints']}j {row['level']:7s} {right:14s}"
        f" {row['cpu_seconds']:>6s}s {row['steps'] or '':>9} {row['error_before']:>6s}>"
        f"{row['error_after']:>6s} floor {row['error_floor']:>6s}"
        f" hid {row['hidden']} ({row['over_noise']}x) | said {row['said']} {row['note'][:80]}"
    )


def totals(rows):
    """Rates over the rows, as one text."""
    count = lambda chosen, test: f"{sum(map(test, chosen))}/{len(chosen)}"
    out = []
    for kind in ("null", "single", "unknown", "pair", "many"):
        chosen = [r for r in rows if r["kind"] == kind]
        if chosen:
            out.append(
                f"{kind}: strict {count(chosen, lambda r: r['strict'])},"
                f" named {count(chosen, lambda r: r['found'] == r['needed'] and r['exit'] == 0)},"
                f" false claim {count(chosen, lambda r: r['false'] > 0)}"
            )
    worse = count(rows, lambda r: float(r["error_after"]) > 1.02 * float(r["error_before"]))
    cpu = np.mean([float(r["cpu_seconds"]) for r in rows])
    return "\n".join([*out, f"predicts worse: {worse}; mean cpu {cpu:.1f} s"])


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--trials", type=int, default=60)
    parser.add_argument("--only", help="numbers of trials, by commas")
    parser.add_argument("--kinds", help="null,single,unknown,pair,many")
    parser.add_argument("--version", type=Path, default=ROOT, help="folder with a diagnose.py")
    parser.add_argument("--cache", type=Path, required=True, help="where drawn trials are kept")
    parser.add_argument("--limit", type=int, default=300, help="processor seconds for a diagnosis")
    parser.add_argument("--out", type=Path, help="CSV of all rows")
    parser.add_argument("--draw", action="store_true", help="only fill the cache")
    options = parser.parse_args()
    numbers = map(int, options.only.split(",")) if options.only else range(options.trials)
    script = options.version.resolve() / "diagnose.py"
    template = f"{{python}} {script} --model {{model}} --recordings {{recordings}} --out {{out}}"
    rows = []
    for number in numbers:
        _, answer = cached(options.seed, number, options.cache)
        if options.draw or options.kinds and answer["kind"] not in options.kinds.split(","):
            continue
        rows.append(run_trial(template, options.seed, number, options.cache, options.limit))
        print(line(rows[-1]), flush=True)
        if options.out:
            with open(options.out, "w", newline="") as file:
                writer = csv.DictWriter(file, COLUMNS)
                writer.writeheader()
                writer.writerows(rows)
    if rows:
        print(totals(rows))


if __name__ == "__main__":
    main()
