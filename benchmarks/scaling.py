"""How does the time of a diagnosis grow? results/scaling.csv, docs/scaling.png.

    python benchmarks/scaling.py [--only seconds joints candidates]

Arms of one to six hinges, moved by sums of sines, with viscous damping at the first hinge that the
nominal model lacks. One thing is varied at a time: the recording's length, the number of joints,
and the share of the catalogue that is looked at (every n-th candidate beside the right one and the
time step).
seconds: of the processor, one thread, from recordings in memory to the findings.
"""

import argparse
import csv
import os
import subprocess
import sys
import time
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"

import mujoco
import numpy as np
from matplotlib.figure import Figure

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from diagnosis.common.atomic_files import write_table  # noqa: E402
from diagnosis.estimator import identify  # noqa: E402
from diagnosis.recordings.recording import Recording  # noqa: E402
from diagnosis.simulation.simulator import World  # noqa: E402

CSV = ROOT / "results" / "scaling.csv"
COLUMNS = ("varied", "length", "joints", "candidates", "rows", "found", "seconds", "commit")
DAMPING, NOISE, ROW = 0.4, 3e-4, 0.01  # N·m·s/rad; rad; s between rows
VARIED = {  # what is varied: [(seconds recorded, joints, every n-th candidate)]
    "seconds": [(s, 1, 1) for s in (5, 10, 20, 40, 80, 160)],
    "joints": [(20, n, 1) for n in (1, 2, 3, 4, 6)],
    "candidates": [(20, 2, n) for n in (8, 4, 2, 1)],
}
UNITS = {"seconds": "length", "joints": "joints", "candidates": "candidates"}
LABELS = {
    "seconds": "seconds recorded, one joint",
    "joints": "joints, 20 s recorded",
    "candidates": "candidates, two joints, 20 s",
}


def arm(joints):
    """MJCF of an arm of so many hinges, each with a motor."""
    body, end = "", ""
    for k in range(joints):
        body += (
            f'<body name="link{k}" pos="0 0 {-0.3 if k else 0}">'
            f'<joint name="joint{k}" axis="0 1 0" damping="0.05" armature="0.005"/>'
            f'<geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="{0.8 / (k + 1):.3f}"'
            ' contype="0" conaffinity="0"/>'
        )
        end += "</body>"
    motors = "".join(f'<motor name="motor{k}" joint="joint{k}"/>' for k in range(joints))
    return (
        '<mujoco><option timestep="0.002" integrator="implicitfast"/>'
        f"<worldbody>{body}{end}</worldbody><actuator>{motors}</actuator></mujoco>"
    )


def recorded(xml, seconds, seed):
    """A Recording of the arm with DAMPING more at its first hinge."""
    rng, model = np.random.default_rng(seed), mujoco.MjModel.from_xml_string(xml)
    model.dof_damping[0] += DAMPING
    data, clock = mujoco.MjData(model), np.arange(0, seconds, ROW)
    pace, phase = rng.uniform(0.3, 1.5, (3, model.nu)), rng.uniform(0, 6, (3, model.nu))
    waves = np.sin(2 * np.pi * clock[:, None, None] * pace + phase).sum(1)
    control = 0.8 * waves / (1 + np.arange(model.nu)) ** 1.5
    qpos = np.empty((len(clock), model.nq))
    for row, u in zip(qpos, control):
        row[:] = data.qpos
        data.ctrl[:] = u
        mujoco.mj_step(model, data, nstep=round(ROW / model.opt.timestep))
    noisy = qpos + NOISE * rng.normal(size=qpos.shape)
    return Recording(f"run{seed}", clock, noisy, np.full_like(noisy, np.nan), control)


def measured(seconds, joints, every, commit):
    """A row: the time of one diagnosis."""
    xml = arm(joints)
    world = World(mujoco.MjSpec.from_string(xml))
    right = world.candidate("viscous_damping", "joint0")
    kept = [right, world.candidate("time_step", "world")]  # the second is asked for in any case
    world.candidates = kept + [c for c in world.candidates if c not in kept][::every]
    train, held = recorded(xml, seconds, 0), recorded(xml, max(5, seconds // 4), 1)
    begun = time.process_time()
    found = identify(world, [train], [held]).summary["findings"]
    return {
        "length": seconds,
        "joints": joints,
        "candidates": len(world.candidates),
        "rows": len(train.time),
        "found": "; ".join(f"{f['effect']} {f['place']['name']}" for f in found),
        "seconds": f"{time.process_time() - begun:.1f}",
        "commit": commit,
    }


def draw(rows, path):
    """Time over what was varied."""
    figure = Figure(figsize=(9.6, 3.0), layout="constrained")
    for axes, (varied, name) in zip(figure.subplots(1, 3), UNITS.items()):
        mine = [r for r in rows if r["varied"] == varied]
        x, y = ([float(r[k]) for r in mine] for k in (name, "seconds"))
        axes.plot(x, y, "o-", color="#1f5fa8")
        axes.set_xlabel(LABELS[varied])
        axes.set_ylim(0, None)
        axes.set_xlim(0, None)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    figure.axes[0].set_ylabel("processor seconds")
    figure.savefig(path, dpi=150)


def main():
    """Measure, write, draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", choices=list(VARIED), default=list(VARIED))
    options = parser.parse_args()
    rows = list(csv.DictReader(CSV.open())) if CSV.exists() else []
    git = ["git", "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(git, cwd=ROOT, capture_output=True, text=True).stdout.strip()
    for varied in options.only:
        rows = [r for r in rows if r["varied"] != varied]
        for case in VARIED[varied]:
            rows.append({"varied": varied} | measured(*case, commit))
            print(*rows[-1].values(), flush=True)
        write_table(CSV, COLUMNS, rows)
    draw(rows, ROOT / "docs" / "scaling.png")


if __name__ == "__main__":
    main()
