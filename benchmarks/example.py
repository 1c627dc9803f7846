"""The example of the README: a real two-link arm, diagnosed, as numbers and as a picture.

    python benchmarks/example.py         # diagnose, results/example.csv and docs/diagnosis.png
    python benchmarks/example.py --draw  # only draw what results/example.csv holds

It prints what docs/validation.md quotes.
"""

import argparse
import csv
import glob
import os
import sys

import matplotlib
import numpy as np

ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
sys.path.insert(0, ROOT)
RIG = os.path.join(ROOT, "..", "shared", "recordings", "double_pendulum")
TABLE, PICTURE = (
    os.path.join(ROOT, "results", "example.csv"),
    os.path.join(ROOT, "docs", "diagnosis.png"),
)
COLOURS = {"measured": "#1d2733", "nominal": "#c8500a", "corrected": "#0a66b0"}


def compute():
    """Rows (panel, x, measured, nominal, corrected) of the three panels."""
    from diagnosis.command import diagnose
    from diagnosis.recordings import inverse_dynamics
    from diagnosis.report.text import terminal

    diagnosis = diagnose(
        os.path.join(RIG, "model.xml"),
        sorted(glob.glob(os.path.join(RIG, "train*.csv"))),
        sorted(glob.glob(os.path.join(RIG, "heldout*.csv"))),
    )
    print(terminal(diagnosis.summary, "report", []))
    rows = []
    trace = next(t for t in diagnosis.traces if t["channel"] == "qpos:elbow")
    for k in np.flatnonzero(trace["time"] <= 5)[::2]:
        rows.append(["elbow", trace["time"][k], *(trace[look][k] for look in COLOURS)])
    for point in diagnosis.summary["fit"]["held_out"]["curve"]:
        rows.append(
            [
                "horizon",
                point["seconds"],
                point.get("floor", np.nan),
                point["before"],
                point["after"],
            ]
        )
    left = next(
        r
        for r in inverse_dynamics.residuals(diagnosis, 800)
        if r["joint"] == "elbow" and r["variable"].startswith("velocity")
    )
    rows += [
        ["force", x, np.nan, before, after]
        for x, before, after in zip(left["x"], left["before"], left["after"])
    ]
    return rows


def draw(rows):
    """Three panels: elbow angle over time, error against horizon, force left over against
    velocity."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    look = {"axes.spines.top": False, "axes.spines.right": False, "axes.grid": True}
    plt.rcParams.update({"font.size": 9, "grid.color": "#dde3e8", **look})
    figure, axes = plt.subplots(
        1, 3, figsize=(11, 3.1), width_ratios=(2, 1, 1), layout="constrained"
    )
    for axis, (panel, drawn) in zip(axes, PANELS.items()):
        drawn(axis, *np.array([[float(x) for x in row[1:]] for row in rows if row[0] == panel]).T)
    os.makedirs(os.path.dirname(PICTURE), exist_ok=True)
    figure.savefig(PICTURE, dpi=110)


def draw_elbow(axis, time, measured, nominal, corrected):
    """Angle over time, recorded and predicted; NaN breaks a line."""
    known, broad = np.isfinite(measured), {"linewidth": 4, "alpha": 0.3, "label": "recorded"}
    axis.plot(time[known], measured[known], color=COLOURS["measured"], **broad)
    for look, values in (("nominal", nominal), ("corrected", corrected)):
        axis.plot(time, values, color=COLOURS[look], linewidth=1.3, label=look)
    title = "held-out recording, predicted 0.3 s at a time"
    axis.set(xlabel="time (s)", ylabel="elbow (rad)", title=title)
    axis.legend(frameon=False, ncols=3, loc="lower center", bbox_to_anchor=(0.5, -0.01))
    axis.set_ylim(min(measured[known]) - 0.9, None)


def draw_horizon(axis, seconds, floor, before, after):
    """Error against horizon, in multiples of the noise."""
    axis.semilogy(seconds, before, color=COLOURS["nominal"])
    axis.semilogy(seconds, after, color=COLOURS["corrected"])
    axis.semilogy(seconds, floor, color="#8a949e", linestyle="--")
    axis.set(xlabel="horizon (s)", ylabel="error (× noise)", title="error against horizon")


def draw_force(axis, speed, _, before, after):
    """Force left over against velocity, with the medians of its bins."""
    from diagnosis.report.charts import binned

    for look, force in (("nominal", before), ("corrected", after)):
        axis.plot(speed, force, ".", markersize=2, alpha=0.3, color=COLOURS[look])
        axis.plot(*binned(speed, force, 16), color=COLOURS[look], linewidth=1.8)
    labels = {"xlabel": "elbow velocity (rad/s)", "ylabel": "force left over (N·m)"}
    axis.set(title="force left over", xlim=(-7, 7), ylim=(-0.45, 0.45), **labels)


PANELS = {"elbow": draw_elbow, "horizon": draw_horizon, "force": draw_force}


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draw", action="store_true", help="only draw")
    if not parser.parse_args().draw:
        if not os.path.isdir(RIG):
            sys.exit(f"{RIG} is not here; --draw works without it")
        rows = compute()
        os.makedirs(os.path.dirname(TABLE), exist_ok=True)
        with open(TABLE, "w", newline="") as stream:
            writer = csv.writer(stream)
            writer.writerow(["panel", "x", "measured", "nominal", "corrected"])
            writer.writerows(
                [[panel, *(f"{value:.6g}" for value in values)] for panel, *values in rows]
            )
    with open(TABLE, newline="") as stream:
        draw(list(csv.reader(stream))[1:])


if __name__ == "__main__":
    main()
