"""Does a diagnosis predict real rigs as well as what was published? results/published.csv.

    python benchmarks/published.py [--recordings ../shared/recordings] [--only emps]

Held-out error (RMS, SI) of the nominal model, with the published effects in it, and with those that
the diagnosis found, in the windows in which the published effects were tried before. A rig whose
recordings are absent is skipped, and keeps its rows.
"""

import argparse
import csv
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from diagnosis.command import diagnose  # noqa: E402
from diagnosis.common.atomic_files import write_table  # noqa: E402
from diagnosis.estimation import windowing  # noqa: E402

CSV = ROOT / "results" / "published.csv"
COLUMNS = ("rig", "model", "window", "channel", "nominal", "published", "diagnosed")
DRIVE = {
    ("viscous_damping", "x"): 203.5034,
    ("coulomb_friction", "x"): 20.3935,
    ("bias", "drive"): 3.1648,
}
ARM = {
    ("coulomb_friction", "shoulder"): 0.146,
    ("coulomb_friction", "elbow"): 0.123,
    ("armature", "shoulder"): 0.0036,
    ("armature", "elbow"): 0.0036,
    ("viscous_damping", "shoulder"): 0.001,
    ("viscous_damping", "elbow"): 0.001,
}
# rig, model, window in s, published effects
CASES = [
    ("emps", "model.xml", 0.5, DRIVE),
    ("emps", "model_viscous.xml", 0.5, DRIVE),
    ("double_pendulum", "model.xml", 0.25, ARM),
    ("cube_toss", "model.xml", 0.25, {("contact_friction", "cube_box"): 0.18}),
]


def rows_of(folder, rig, model, span, published):
    """A row per channel."""
    train, held = (
        sorted(map(str, (folder / rig).glob(f"{kind}_*.csv"))) for kind in ("train", "heldout")
    )
    if not train:
        print(f"{rig}: not here, skipped")
        return []
    found = diagnose(folder / rig / model, train, held)
    world, windows = found.world, windowing.cut(found.held_out, span)
    known = {world.candidate(*key): (value,) for key, value in published.items()}
    errors = [
        windowing.error(
            world.model,
            windows,
            windowing.predict(world, settings, windows)[0],
            np.ones(world.model.nv),
        )[1]
        for settings in ({}, known, found.settings)
    ]
    return [
        dict(
            zip(
                COLUMNS, (rig, model, span, channel, *(f"{error[channel]:.6g}" for error in errors))
            )
        )
        for channel in errors[0]
    ]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--recordings",
        type=Path,
        default=ROOT / ".." / "shared" / "recordings",
        help="folder of the rigs",
    )
    parser.add_argument("--only", nargs="*", help="rigs to do again (all)")
    options = parser.parse_args()
    for case in CASES:
        new = (
            rows_of(options.recordings, *case)
            if not options.only or case[0] in options.only
            else []
        )
        if new:
            kept = list(csv.DictReader(CSV.open())) if CSV.exists() else []
            write_table(CSV, COLUMNS, [r for r in kept if (r["rig"], r["model"]) != case[:2]] + new)
            print(*(" ".join(str(v) for v in row.values()) for row in new), sep="\n", flush=True)


if __name__ == "__main__":
    main()
