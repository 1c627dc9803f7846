"""Do 95 % intervals cover where the structure is right? results/coverage.csv.

    python benchmarks/interval_coverage.py [--trials 100] [--first 0]

Each trial hides two effects in a small pendulum (of damping, dry friction, gain, mass and a spring,
with values, noise and excitation drawn from the seed), records it in stock MuJoCo at the model's
own step or four times finer, refits just these two, and asks which intervals hold the truth. A row
per parameter; rows of seeds that are run again are replaced.
"""

import argparse
import csv
import sys
import time as clock
from pathlib import Path

import mujoco
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from diagnosis.common.atomic_files import write_table  # noqa: E402
from diagnosis.estimation.ahead import Ahead, cut_ahead  # noqa: E402
from diagnosis.estimation.intervals import intervals  # noqa: E402
from diagnosis.estimation.smoother import Smoother  # noqa: E402
from diagnosis.recordings.recording import Recording  # noqa: E402
from diagnosis.selection.judge import Judge  # noqa: E402
from diagnosis.selection.plausibility import Usual  # noqa: E402
from diagnosis.simulation.simulator import World  # noqa: E402

CSV = ROOT / "results" / "coverage.csv"
COLUMNS = (
    *("seed", "finer", "noise", "effect", "parameter"),
    *("truth", "value", "low", "high", "inside", "seconds"),
)
XML = """<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody><body name="arm">
  <joint name="pivot" axis="0 1 0" damping="{damping}" stiffness="{stiffness}"
    frictionloss="{frictionloss}" solreffriction="0.004 1" solimpfriction="0.999 0.9999 0.001"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".02" mass="{mass}" contype="0"/></body>
  </worldbody><actuator><motor name="drive" joint="pivot" gear="{gain}"/></actuator></mujoco>"""
NOMINAL = {"damping": 0.05, "stiffness": 0.0, "frictionloss": 0.0, "mass": 0.5, "gain": 1.0}
# attribute: effect, place, range of the hidden value
HIDDEN = {
    "damping": ("viscous_damping", "pivot", (0.08, 0.2)),
    "frictionloss": ("coulomb_friction", "pivot", (0.02, 0.1)),
    "gain": ("gain", "drive", (0.75, 0.95)),
    "mass": ("mass", "arm", (0.55, 0.75)),
    "stiffness": ("stiffness", "pivot", (0.2, 1.0)),
}


def record(rng, values, noise, finer, name, rows=600):
    """A Recording of 6 s in stock MuJoCo, position every 10 ms."""
    model = mujoco.MjModel.from_xml_string(XML.format(**values))
    step = 0.01 / round(0.01 / (model.opt.timestep / finer))
    model.opt.timestep = step
    data, time = mujoco.MjData(model), 0.01 * np.arange(rows)
    period, phase = rng.uniform(0.6, 1.6, 3), rng.uniform(0, 6, 3)
    ctrl = (0.3 * np.sin(2 * np.pi * time[:, None] / period + phase)).sum(1, keepdims=True)
    qpos = np.empty((rows, 1))
    for t in range(rows):
        qpos[t], data.ctrl[:] = data.qpos, ctrl[t]
        mujoco.mj_step(model, data, round(0.01 / step))
    noisy = qpos + noise * rng.normal(size=qpos.shape)
    return Recording(name, time, noisy, np.full(qpos.shape, np.nan), ctrl)


def trial(seed, finer=None):
    """Rows of one trial; finer: how often the truth's step goes into the model's."""
    rng, begun = np.random.default_rng(seed), clock.process_time()
    hidden = sorted(rng.choice(sorted(HIDDEN), 2, replace=False))
    values = {a: float(rng.uniform(*HIDDEN[a][2])) for a in hidden}
    noise, drawn = float(10 ** rng.uniform(-4, -2.7)), int(rng.choice([1, 4]))
    finer = finer or drawn
    world = World(mujoco.MjSpec.from_string(XML.format(**NOMINAL)))
    runs = [record(rng, {**NOMINAL, **values}, noise, finer, f"{k}.csv") for k in range(2)]
    smoother = Smoother(world, runs)
    trajectory = smoother.locate({})
    setting = {world.candidate(*HIDDEN[a][:2]): (values[a] * 0.9,) for a in hidden}
    for _ in range(2):
        ahead = Ahead(world, cut_ahead(runs), smoother.position_noise)
        ahead.start(trajectory)
        fitted = Judge(ahead, Usual(world, runs, smoother.scale)).fit(setting)
        setting = fitted.setting
        trajectory = smoother.locate(setting, trajectory, passes=1)
    bounds, out = intervals(fitted), []
    for c, (value,) in fitted.setting.items():
        truth = next(values[a] for a in hidden if HIDDEN[a][0] == c.effect.name)
        low, high = bounds[c][0] or (np.nan, np.nan)
        row = seed, finer, f"{noise:.3g}", c.effect.name, c.parameters[0].name
        row += tuple(f"{x:.6g}" for x in (truth, value, low, high))
        seconds = f"{clock.process_time() - begun:.2f}"
        out.append(dict(zip(COLUMNS, (*row, int(low <= truth <= high), seconds))))
    return out


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    options = parser.parse_args()
    rows = []
    if CSV.exists():
        with open(CSV, newline="", encoding="utf-8") as stream:
            rows = list(csv.DictReader(stream))
    for seed in range(options.first, options.first + options.trials):
        rows = [r for r in rows if int(r["seed"]) != seed] + trial(seed)
        rows.sort(key=lambda r: int(r["seed"]))
        write_table(CSV, COLUMNS, rows)
    for finer in (1, 4):
        inside = [int(r["inside"]) for r in rows if int(r["finer"]) == finer]
        print(f"truth {finer} times finer: {np.mean(inside):.3f} of {len(inside)} inside")


if __name__ == "__main__":
    main()
