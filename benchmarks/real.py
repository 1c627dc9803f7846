"""Diagnose the recordings of real machines and compare with what was published: results/real.csv.

    python benchmarks/real.py [--recordings ../shared/recordings] [--only emps double_pendulum]

Recordings are not part of this repository; what is absent is skipped, and keeps its rows. One row
per finding; seconds are of the processor.
"""

import argparse
import csv
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from diagnosis.command import diagnose  # noqa: E402
from diagnosis.common.atomic_files import write_table  # noqa: E402

COMMIT = subprocess.run(
    ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True
).stdout.strip()
BALLS = (
    "bowlingball",
    "baseball",
    "golfball",
    "volleyball",
    "tennisball",
    "whiffleball_1",
    "whiffleball_2",
    "whiffleball_orange",
    "whiffleball_yellow",
    "basketball_blue",
    "basketball_green",
)
# rig, model, pattern of the recordings, what was published or is expected
CASES = [
    ("emps", "model.xml", "*", "viscous 203.5 N s/m, Coulomb 20.4 N, offset 3.16 N"),
    ("emps", "model_viscous.xml", "*", "Coulomb 20.4 N, damping back to 203.5, offset 3.16 N"),
    ("ur10e_joint1", "model.xml", "*", "viscous 21.3 N m s/rad, Coulomb 12.5 N m"),
    ("simple_pendulum", "model.xml", "*", "Coulomb 0.15 N m, gain 0.83"),
    ("bam_xl330", "model.xml", "*", "load friction about 0.2, gain about 0.7"),
    ("cart_friction", "model.xml", "*", "Coulomb 3 to 6 N along the rail"),
    ("double_pendulum", "model.xml", "*", "Coulomb 0.146 and 0.123 N m, armature 0.0036 kg m2"),
    ("arm_pendulum_double_val", "model.xml", "*", "next to nothing"),
    ("arm_pendulum_single", "model.xml", "*", "viscous 2.24e-4 N m s/rad, or Coulomb 4.6e-4 N m"),
    ("go2_leg", "model.xml", "*", "Coulomb 0.16, 0.17, 0.64 N m, and a bias"),
    ("panda", "model.xml", "*", "Coulomb 0.27 0.44 0.32 0.64 0.42 0.15 0.28 N m"),
    ("cube_toss", "model.xml", "*", "contact friction 0.18"),
]
CASES += [
    (
        "ball_drop",
        f"model_{b}.xml",
        b,
        "match" if b in BALLS[:3] else "quadratic damping or air drag",
    )
    for b in BALLS
]
COLUMNS = (
    "rig",
    "model",
    "expected",
    "verdict",
    "effect",
    "place",
    "parameter",
    "value",
    "low",
    "high",
    "unit",
    "also_possible",
    "held_out_before",
    "held_out_after",
    "held_out_floor",
    "channel",
    "unit_before",
    "unit_after",
    "seconds",
    "commit",
)


def rows_of(folder, rig, model, pattern, expected):
    train, held = (
        sorted(map(str, (folder / rig).glob(f"{kind}_{pattern}.csv")))
        for kind in ("train", "heldout")
    )
    if not train or not (folder / rig / model).exists():
        print(f"{rig} {model}: not here, skipped")
        return []
    begun = time.process_time()
    summary = diagnose(folder / rig / model, train, held).summary
    fit = summary["fit"]["held_out"]
    channel, figures = next(iter(fit["channels"].items()))
    common = {
        "rig": rig,
        "model": model,
        "expected": expected,
        "verdict": summary["verdict"],
        "held_out_before": fit["before"],
        "held_out_after": fit["after"],
        "held_out_floor": fit["floor"],
        "channel": channel,
        "unit_before": figures["before"],
        "unit_after": figures["after"],
        "seconds": round(time.process_time() - begun, 1),
        "commit": COMMIT,
    }
    out = []
    for finding in summary["findings"]:
        also = "; ".join(f"{a['effect']} {a['place']['name']}" for a in finding["also_possible"])
        for parameter in finding["parameters"] or [{}]:
            out.append(
                {
                    **common,
                    "effect": finding["effect"],
                    "place": finding["place"]["name"],
                    "parameter": parameter.get("name"),
                    **{k: parameter.get(k) for k in ("value", "low", "high", "unit")},
                    "also_possible": also,
                }
            )
    return out or [common]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--recordings",
        type=Path,
        default=ROOT / ".." / "shared" / "recordings",
        help="folder of the rigs",
    )
    parser.add_argument("--only", nargs="*", help="rigs, or ball names, to do again (all)")
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "real.csv")
    options = parser.parse_args()
    kept = list(csv.DictReader(options.out.open())) if options.out.exists() else []
    for case in CASES:
        if options.only and not {case[0], case[2]} & set(options.only):
            continue
        new = rows_of(options.recordings, *case)
        if not new:
            continue
        kept = [r for r in kept if (r["rig"], r["model"]) != case[:2]] + new
        for row in new:
            print(
                *(
                    row.get(k)
                    for k in (
                        "rig",
                        "model",
                        "verdict",
                        "effect",
                        "place",
                        "value",
                        "low",
                        "high",
                        "also_possible",
                        "seconds",
                    )
                ),
                flush=True,
            )
        options.out.parent.mkdir(exist_ok=True)
        write_table(
            options.out,
            COLUMNS,
            ({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in r.items()} for r in kept),
        )


if __name__ == "__main__":
    main()
