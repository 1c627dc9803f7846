"""How often does the criterion accept an effect of what size, or of none? results/power.csv.

    python benchmarks/power.py [--trials 200]

Residuals that windows of a group have in common (half of their square) and columns of the same
kind; an effect of `size` noises is in the residual. accepted: the paired comparison's p-value is
below the level; looked_at: of so many columns, all but one of them empty, the best is taken and its
p-value is multiplied by their number. At size 0 this is the rate of false alarms.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from synthetic import clustered, free, scene  # noqa: E402

from diagnosis.common.atomic_files import write_table  # noqa: E402
from diagnosis.selection.criterion import Evidence, paired  # noqa: E402

CSV = ROOT / "results" / "power.csv"
COLUMNS = "groups", "looked_at", "size", "level", "trials", "accepted", "mean_gain"
SIZES = 0.0, 0.1, 0.2, 0.3, 0.5, 1.0
LEVEL = 0.05


def compared(rng, ahead, size, number):
    """(gain, p-value) of the best of so many columns, of which the first is in the residual."""
    columns, noise = clustered(rng, ahead, (number,)), clustered(rng, ahead)
    evidence = Evidence(ahead, noise + size * columns[..., 0], columns)
    none = free(evidence, ())
    scores = [free(evidence, (k,)) for k in range(number)]
    step = paired(none, min(scores, key=lambda s: s.loss))
    return step.gain, min(number * step.p_value, 1.0)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=200)
    options = parser.parse_args()
    rows = []
    for groups in (8, 16):
        ahead = scene(groups=groups, bands=3, rows=30)
        for number in (1, 20):
            for size in SIZES:
                rng = np.random.default_rng(0)
                found = [compared(rng, ahead, size, number) for _ in range(options.trials)]
                gains, p = np.array(found).T
                accepted = f"{np.mean(p < LEVEL):.3f}"
                row = groups, number, size, LEVEL, options.trials, accepted, f"{gains.mean():.4f}"
                rows.append(dict(zip(COLUMNS, row)))
                print(*row)
    write_table(CSV, COLUMNS, rows)


if __name__ == "__main__":
    main()
