"""Grounding runs over many seeds: every row of every run's progress.csv, and the best policy's
fresh evaluation.

    python benchmarks/grounding.py --env Hopper-v4 --algos rgat gat sim --seeds 0 1 2 3 4

Appends to results/grounding.csv (a row per grounding step) and results/best.csv (a row per run).
Runs that are there already are skipped, a run that was cut off goes on where it stopped: call it
again until it is done.
"""

import argparse
import csv
import json
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import train  # noqa: E402
from benchmarks.rows import append, finished  # noqa: E402


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--env", required=True)
    parser.add_argument("--algos", nargs="+", required=True)
    parser.add_argument("--seeds", nargs="+", type=int, required=True)
    parser.add_argument("--policy", default="deep")
    parser.add_argument(
        "--tag",
        default="default",
        help="name of a variant, whose settings follow as further train.py options",
    )
    parser.add_argument("--results", type=Path, default=ROOT / "results")
    parser.add_argument("--runs", type=Path, default=ROOT / "runs")
    args, extra = parser.parse_known_args()
    for seed in args.seeds:
        for algo in args.algos:
            key = {
                "env": args.env,
                "policy": args.policy,
                "algo": algo,
                "tag": args.tag,
                "seed": seed,
            }
            if finished(args.results / "best.csv", key):
                continue
            folder = args.runs / "-".join(str(v) for v in key.values())
            options = [
                "--env",
                args.env,
                "--algo",
                algo,
                "--policy",
                args.policy,
                "--seed",
                str(seed),
                "--threads",
                "1",
            ]
            options += ["--out", str(folder), "--pretrained", str(args.runs / "pretrained"), *extra]
            if (folder / "config.json").exists():
                options = ["--resume", str(folder)]
            if train.main(options):
                sys.exit(f"{folder}: stopped; call again to go on")
            if not finished(args.results / "grounding.csv", key):
                append(
                    args.results / "grounding.csv",
                    [
                        {**key, **row}
                        for row in csv.DictReader((folder / "progress.csv").open(newline=""))
                    ],
                )
            with (folder / "progress.csv").open(newline="") as file:
                before = next(csv.DictReader(file))["real_return_deterministic"]
            best, lines = (
                json.loads((folder / name).read_text()) for name in ("best.json", "lines.json")
            )
            row = {
                **key,
                **best,
                "before_grounding": before,
                "trained_on_real": lines["trained on real"],
            }
            append(args.results / "best.csv", [row])


if __name__ == "__main__":
    main()
