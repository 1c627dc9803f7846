"""The Error of what a tool wrote, in a process of its own that knows the held-out rows and no
answer.

    python -m diagnosis.trials.replay sim.xml report held_out.npz      # prints {"error": 2.31}

report/corrected.xml runs in stock MuJoCo; where report/corrected.py stands beside it, its
step(model, data) is asked instead of mj_step. held_out.npz: save_runs.
"""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np

from diagnosis.trials.experiment import Run
from diagnosis.trials.prediction import model_error

FIELDS = ("time", "ctrl", "qpos", "qvel")
LIMIT = 600  # s


def save_runs(path, runs, noise):
    """Write what a user would know of held-out Runs, and the noise (nv,) to measure by."""
    arrays = {f"{k}_{f}": getattr(run, f) for k, run in enumerate(runs) for f in FIELDS}
    np.savez(path, count=len(runs), noise=noise, **arrays)


def load_runs(path):
    """(Runs without what is true beneath them, noise (nv,))."""
    blank = np.empty(0)
    with np.load(path, allow_pickle=False) as data:
        runs = [
            Run(
                **{f: data[f"{k}_{f}"] for f in FIELDS},
                true_qpos=blank,
                true_qvel=blank,
                stamps=blank,
                states=[],
                number=k,
            )
            for k in range(int(data["count"]))
        ]
        return runs, data["noise"]


def replay(model, report, held_out):
    """The Error of report/corrected.xml (and .py), measured in a process of its own; inf if it
    fails."""
    command = [sys.executable, "-m", "diagnosis.trials.replay", model, report, held_out]
    try:
        done = subprocess.run(
            list(map(str, command)),
            cwd=Path(__file__).resolve().parents[2],
            capture_output=True,
            text=True,
            timeout=LIMIT,
        )
        value = json.loads(done.stdout)["error"]
    except (subprocess.TimeoutExpired, ValueError, KeyError, TypeError):
        return float("inf")
    return float("inf") if value is None else value


def own_step(path):
    """The function step(model, data) of a corrected.py; None where there is no such file."""
    if not path.exists():
        return None
    spec = importlib.util.spec_from_file_location("corrected", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.step


def main():
    model, report, held_out = sys.argv[1:4]
    nominal = mujoco.MjModel.from_xml_path(model)
    runs, noise = load_runs(held_out)
    corrected = mujoco.MjModel.from_xml_path(str(Path(report) / "corrected.xml"))
    step = own_step(Path(report) / "corrected.py")
    error = model_error(nominal, corrected, runs, noise, step)
    print(json.dumps({"error": error if np.isfinite(error) else None}))


if __name__ == "__main__":
    main()
