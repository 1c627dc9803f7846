"""Which law of drag do the dropped balls themselves say? Plain least squares, without the
diagnosis: results/drag_laws.csv.

    python benchmarks/drag_laws.py [--recordings ../shared/recordings]

For every drop and law, a force k|v|^p with p = 0 (constant), 1 (viscous), 2 (quadratic), height and
speed at the start and k are fitted to the whole drop, from 0.3 s on (until then some balls were not
released). RMS in metres.
"""

import argparse
import sys
from pathlib import Path

import mujoco
import numpy as np
from mujoco import minimize

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from benchmarks.real import BALLS  # noqa: E402
from diagnosis.common.atomic_files import write_table  # noqa: E402

LAWS = {"constant": 0, "viscous": 1, "quadratic": 2}
BEGIN, SUBSTEPS = 0.3, 4  # s; Runge-Kutta steps between two rows


def fallen(x, power, time, mass):
    """Heights (T, n) of a ball that falls with start height, start speed and drag x (3, n)."""
    height, speed = x[0].copy(), x[1].copy()
    out, rate = [height], lambda v: -9.81 - np.sign(v) * x[2] / mass * np.abs(v) ** power
    for h in np.repeat(np.diff(time) / SUBSTEPS, SUBSTEPS):
        a = rate(speed)
        b = rate(speed + h / 2 * a)
        c = rate(speed + h / 2 * b)
        d = rate(speed + h * c)
        height = height + h * (speed + h / 6 * (a + b + c))
        speed = speed + h / 6 * (a + 2 * b + 2 * c + d)
        out.append(height)
    return np.array(out)[::SUBSTEPS]


def fitted(time, height, mass, power):
    """(RMS in m, k) of one law."""
    usual = mass * 9.81 / 20.0**power
    begin = np.array([height[0], np.polyfit(time[:8] - time[0], height[:8], 1)[0], 0.3])
    scaled = lambda x: np.stack([x[0], x[1], x[2] * usual])
    x, _ = minimize.least_squares(
        begin,
        lambda x: fallen(scaled(x), power, time, mass) - height[:, None],
        bounds=[np.array([0, -40.0, -3.0]), np.array([200.0, 5.0, 3.0])],
        verbose=0,
    )
    residual = fallen(scaled(x.reshape(3, 1)), power, time, mass)[:, 0] - height
    return float(np.sqrt(np.mean(residual**2))), float(np.ravel(x)[2] * usual)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--recordings",
        type=Path,
        default=ROOT / ".." / "shared" / "recordings",
        help="folder of the rigs",
    )
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "drag_laws.csv")
    options = parser.parse_args()
    folder, rows = options.recordings / "ball_drop", []
    for ball in BALLS:
        if not (folder / f"model_{ball}.xml").exists():
            print(f"{ball}: not here, skipped")
            continue
        mass = mujoco.MjModel.from_xml_path(str(folder / f"model_{ball}.xml")).body_mass[1]
        for drop in ("train", "heldout"):
            time, height = np.loadtxt(folder / f"{drop}_{ball}.csv", delimiter=",", skiprows=1).T
            time, height = time[time >= BEGIN], height[time >= BEGIN]
            for law, power in LAWS.items():
                rms, k = fitted(time, height, mass, power)
                rows.append(
                    {"ball": ball, "drop": drop, "law": law, "rms": f"{rms:.4f}", "k": f"{k:.5g}"}
                )
                print(*rows[-1].values())
    if rows:
        write_table(options.out, ("ball", "drop", "law", "rms", "k"), rows)


if __name__ == "__main__":
    main()
