"""Does the recording that `diagnose.py --next` designs leave only the truth?

Sealed trials in simulation.

    python benchmarks/next_recording.py --trials 12 --seed 1          # writes results/next.csv

Each trial draws a pendulum and hides one of EFFECTS in it. A first recording is a sine of one
frequency. Every effect is refitted to it in stock MuJoCo; those that err no more than 5 % above the
best are the class that it leaves open. A report that holds this class, and nothing of the truth,
goes to the design. The truth then records what was designed and, for comparison, the first
excitation once more, as long as that. The class is counted again on old and new recordings
together.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import mujoco
import numpy as np
from scipy.optimize import least_squares

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from diagnosis.common.atomic_files import write_table  # noqa: E402
from diagnosis.design.explanations import Open, reached_by  # noqa: E402
from diagnosis.design.optimal import design  # noqa: E402
from diagnosis.recordings.recording import Recording  # noqa: E402

PERIOD, SECONDS, WITHIN = 0.01, 5.0, 1.05
STIFF = 'solreffriction="0.004 1" solimpfriction="0.999 0.9999 0.001"'
# name: (kind of place, parameter, nominal value, unit, scale of what is drawn)
EFFECTS = {
    "viscous_damping": ("joint", "damping", 0.01, "N·m·s/rad", 0.03),
    "coulomb_friction": ("joint", "frictionloss", 0.0, "N·m", 0.05),
    "quadratic_damping": ("joint", "damping2", 0.0, "N·m·s²/rad²", 0.01),
    "armature": ("joint", "armature", 0.0, "kg·m²", 0.02),
    "stiffness": ("joint", "stiffness", 0.0, "N·m/rad", 0.5),
    "gain": ("actuator", "gain", 1.0, "1", -0.25),
}
COLUMNS = [
    "seed",
    "trial",
    "truth",
    "before",
    "after",
    "same_again",
    "truth_left",
    "nats",
    "commit",
]


def xml(mass: float, length: float, **values: float) -> str:
    """MJCF of a pendulum with the effects' values."""
    v = {name: nominal for name, (_, _, nominal, _, _) in EFFECTS.items()} | values
    damping = f"{v['viscous_damping']} {v['quadratic_damping']}"
    return f"""<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body>
      <joint name="pivot" axis="0 1 0" damping="{damping}" frictionloss="{v["coulomb_friction"]}"
        armature="{v["armature"]}" stiffness="{v["stiffness"]}" limited="true" range="-120 120"
        {STIFF}/>
      <geom type="capsule" fromto="0 0 0 0 0 -{length}" size="0.02" mass="{mass}" contype="0"
        conaffinity="0"/></body></worldbody><actuator><general name="drive" joint="pivot"
        gainprm="{v["gain"]}" ctrllimited="true" ctrlrange="-3 3"/></actuator></mujoco>"""


def moved(text: str, ctrl: np.ndarray) -> np.ndarray:
    """(T,) positions in stock MuJoCo under controls (T,), from rest."""
    model = mujoco.MjModel.from_xml_string(text)
    data, out = mujoco.MjData(model), np.empty(len(ctrl))
    for row, value in enumerate(ctrl):
        out[row], data.ctrl[0] = data.qpos[0], value
        mujoco.mj_step(model, data, nstep=5)
    return out


def refitted(body: dict, effect: str, runs: list) -> tuple[float, float]:
    """(value, RMS error) of one effect that explains [(ctrl, positions)] as well as it can."""
    _, _, nominal, _, scale = EFFECTS[effect]

    def residual(x):
        value = nominal + scale * x[0]
        value = value if effect == "gain" else max(value, 0.0)
        return np.concatenate([moved(xml(**body, **{effect: value}), u) - q for u, q in runs])

    best = min(
        (least_squares(residual, [s], diff_step=1e-3, xtol=1e-5, max_nfev=15) for s in (0.4, 1.2)),
        key=lambda fit: fit.cost,
    )
    value = nominal + scale * best.x[0]
    return value if effect == "gain" else max(value, 0.0), float(np.sqrt(np.mean(best.fun**2)))


def left_open(body: dict, effects, runs: list) -> dict:
    """{effect: value} of those that err at most WITHIN times the best, the best first."""
    fits = {effect: refitted(body, effect, runs) for effect in effects}
    least = min(error for _, error in fits.values())
    order = sorted(fits, key=lambda effect: fits[effect][1])
    return {effect: fits[effect][0] for effect in order if fits[effect][1] <= WITHIN * least}


def finding(effect: str, value: float) -> dict:
    """An entry of diagnosis.json."""
    kind, name, nominal, unit, _ = EFFECTS[effect]
    parameter = {"name": name, "nominal": nominal, "value": value, "unit": unit}
    place = {"kind": kind, "name": "pivot" if kind == "joint" else "drive"}
    return {"effect": effect, "place": place, "parameters": [parameter]}


def report(folder: Path, body: dict, possible: dict, noise: float, run: tuple) -> Open:
    """What a finished report with this class leaves open."""
    first, *others = (finding(effect, value) for effect, value in possible.items())
    content = {"findings": [{**first, "also_possible": others[:3]}], "noise": {"qpos:pivot": noise}}
    (folder / "diagnosis.json").write_text(json.dumps(content))
    (folder / "nominal.xml").write_text(xml(**body))
    ctrl, qpos = run
    time, unseen = PERIOD * np.arange(len(ctrl)), np.full((len(ctrl), 1), np.nan)
    recording = Recording("old", time, qpos[:, None], unseen, ctrl[:, None])
    reached = reached_by([recording], mujoco.MjModel.from_xml_string(xml(**body)))
    (folder / "recorded.json").write_text(json.dumps(reached))
    return Open.read(str(folder))


def trial(seed: int, number: int) -> dict | None:
    """A row of the table, or None where the first recording leaves one effect alone."""
    rng = np.random.default_rng([seed, number])
    body = {"mass": rng.uniform(0.4, 1.2), "length": rng.uniform(0.2, 0.4)}
    truth, noise = str(rng.choice(list(EFFECTS))), 0.004
    nominal, scale = EFFECTS[truth][2], EFFECTS[truth][4]
    real = xml(**body, **{truth: nominal + scale * rng.uniform(0.5, 1.5)})
    t = PERIOD * np.arange(int(SECONDS / PERIOD))
    frequency, size = rng.uniform(0.4, 3.0), rng.uniform(0.05, 0.2)
    old = size * np.sin(2 * np.pi * frequency * t) * np.minimum(1, t)

    def record(ctrl):
        return ctrl, moved(real, ctrl) + rng.normal(size=len(ctrl)) * noise

    runs = [record(old)]
    before = left_open(body, EFFECTS, runs)
    if len(before) < 2:
        return None
    with tempfile.TemporaryDirectory() as folder:
        best = design(report(Path(folder), body, before, noise, runs[0]), SECONDS, seed=number)
    after = left_open(body, before, [*runs, record(best.ctrl[:, 0])])
    again = left_open(body, before, [*runs, record(old)])
    return {
        "seed": seed,
        "trial": number,
        "truth": truth,
        "before": " ".join(before),
        "after": " ".join(after),
        "same_again": " ".join(again),
        "truth_left": list(after) == [truth],
        "nats": f"{best.nats:.4g}",
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=12, help="with more than one effect open")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", default=os.path.join("results", "next.csv"))
    args = parser.parse_args()
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True)
    rows, number = [], 0
    while len(rows) < args.trials:
        row = trial(args.seed, number)
        number += 1
        if row is None:
            print(f"trial {number - 1}: one effect alone after the first recording", flush=True)
            continue
        rows.append({**row, "commit": commit.stdout.strip()})
        print(row, flush=True)
        write_table(args.out, COLUMNS, rows)
    alone = sum(row["truth_left"] for row in rows)
    same = sum(row["same_again"] == row["truth"] for row in rows)
    print(f"truth alone: {alone} of {len(rows)} after the design, {same} after the same again")


if __name__ == "__main__":
    main()
