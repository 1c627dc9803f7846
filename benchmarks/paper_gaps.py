"""Are the paper's three gaps named from one episode? results/paper_gaps.csv.

    python benchmarks/paper_gaps.py [--envs Hopper-v4] [--seeds 0 1 2]

The policy that was trained in the sim acts at random as it learnt on "real" for one episode. What
is recorded are the positions at every action, with Gaussian noise of 1 mm and 1 mrad, and the
actions. diagnose() is given that. One row per finding; finished ones are skipped.
"""

import argparse
import itertools
import sys
import time
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import train  # noqa: E402
from benchmarks.rows import append, finished  # noqa: E402
from benchmarks.transformer_settings import Quiet  # noqa: E402
from diagnosis.command import diagnose  # noqa: E402
from diagnosis.recordings.recording import Recording  # noqa: E402
from envs import TASKS, BatchEnv, model_path, parse_perturbation  # noqa: E402

NOISE = 1e-3  # m and rad
CSV = ROOT / "results" / "paper_gaps.csv"


def episode(s, seed):
    """One episode of the sim's policy on "real" as a Recording of noisy positions."""
    sim, real = BatchEnv(s.env, s.num_envs), BatchEnv(s.env, 1, parse_perturbation(s.real))
    learner = train.new_learner(s)
    learner.load(train.pretrained(s, "sim", sim, s.pretrain_steps, Quiet()))
    generator, rng = torch.Generator().manual_seed(seed), np.random.default_rng(seed)
    obs, _ = real.reset(seed=seed)
    qpos, ctrl, ended, box = [], [], False, real.single_action_space
    while not ended:  # the last state is not recorded: the environment has begun anew by then
        action = learner.policy.act(torch.from_numpy(obs.astype(np.float32)), generator).numpy()
        action = np.clip(action, box.low, box.high)
        qpos.append(real.qpos[0] + NOISE * rng.normal(size=real.model.nq))
        ctrl.append(action[0])
        obs, _, terminated, truncated, _ = real.step(action)
        ended = bool(terminated[0] | truncated[0])
    unmeasured = np.full((len(qpos), real.model.nv), np.nan)
    return Recording(
        "episode", real.dt * np.arange(len(qpos)), np.array(qpos), unmeasured, np.array(ctrl, float)
    )


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--envs", nargs="+", default=[f"{name}-v4" for name in TASKS])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3, 4])
    args = parser.parse_args()
    torch.set_num_threads(1)
    for env_id, seed in itertools.product(args.envs, args.seeds):
        if finished(CSV, {"env": env_id, "seed": seed}):
            continue
        began = time.process_time()
        rows = measure(env_id, seed)
        seconds = {"cpu_seconds": round(time.process_time() - began, 1)}
        append(CSV, [{**row, **seconds} for row in rows])
        for row in rows:
            print(", ".join(f"{k} {v}" for k, v in row.items()), flush=True)


def measure(env_id, seed):
    """A row per finding, and one without where there is none."""
    kept = str(ROOT / "runs" / "pretrained")
    s = train.Settings(env=env_id, seed=seed, pretrained=kept).completed()
    recording = episode(s, seed)
    summary = diagnose(model_path(env_id), [recording]).summary
    common = {
        "env": env_id,
        "real": s.real,
        "seed": seed,
        "rows": len(recording.time),
        "verdict": summary["verdict"],
    }
    fit = summary["fit"]["held_out"]
    errors = {f"held_out_{k}": round(fit[k], 4) for k in ("before", "after", "floor")}
    nothing = dict.fromkeys(("effect", "place", "value", "low", "high", "also_possible"), "")
    told = [described(finding) for finding in summary["findings"]] or [nothing]
    return [{**common, **each, **errors} for each in told]


def described(finding):
    """A finding's name, first parameter and rivals."""
    first = (finding["parameters"] or [{}])[0]
    also = "; ".join(f"{a['effect']} {a['place']['name']}" for a in finding["also_possible"])
    return {
        "effect": finding["effect"],
        "place": finding["place"]["name"],
        **{k: first.get(k, "") for k in ("value", "low", "high")},
        "also_possible": also,
    }


if __name__ == "__main__":
    main()
