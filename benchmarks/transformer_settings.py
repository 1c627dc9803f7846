"""What decides whether g_phi learns: one grounding step from the same data under different settings.

    python benchmarks/transformer_settings.py --env Hopper-v4 --seeds 0

Appends to results/transformer_settings.csv: the one-step error on held-out real transitions that a transformer
leaves, beside the untransformed simulator's (identity) and the oracle's. Rows that exist are skipped.
"""

import argparse
import dataclasses
import sys
import time
from pathlib import Path

import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import train  # noqa: E402
from benchmarks.grounding import append, done  # noqa: E402
from envs import BatchEnv, parse_perturbation  # noqa: E402
from rgat import AT_CONFIG, METHODS, GroundingSettings, identity, one_step_error  # noqa: E402
from trpo import rollouts  # noqa: E402

CSV = ROOT / "results" / "transformer_settings.csv"
WIDE, NARROW = 0.14, None  # None: the task's default
VARIANTS = [  # at_gamma, at_max_kl, at_std, forward_model
    (0.0, 1e-2, NARROW, "residual"),
    (0.0, 1e-3, NARROW, "residual"),
    (0.0, 1e-4, NARROW, "residual"),
    (0.9, 1e-2, NARROW, "residual"),
    (0.99, 1e-2, NARROW, "residual"),
    (0.99, 1e-4, NARROW, "residual"),
    (0.0, 1e-2, WIDE, "residual"),
    (0.99, 1e-4, WIDE, "residual"),
    (0.0, 1e-2, NARROW, "plain"),
    (0.99, 1e-4, WIDE, "plain"),
]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", required=True)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    args = parser.parse_args()
    torch.set_num_threads(1)
    for seed in args.seeds:
        s = train.Settings(env=args.env, seed=seed, threads=1, pretrained=str(ROOT / "runs" / "pretrained")).completed()
        todo = [dict(zip(("at_gamma", "at_max_kl", "at_std", "forward_model"), v)) for v in VARIANTS]
        todo = [{**v, "at_std": v["at_std"] or s.at_std} for v in todo]
        todo = [v for v in todo if not done(CSV, {"env": s.env, "seed": seed, **v})]
        if not todo:
            continue
        sim, real = BatchEnv(s.env, s.num_envs, nthread=1), BatchEnv(s.env, s.num_envs, parse_perturbation(s.real), nthread=1)
        learner = train.new_learner(s)
        learner.load(train.pretrained(s, "sim", sim, Quiet()))
        tau_real = rollouts(learner.policy, real, 50, seed + 1)[1]
        held_out = rollouts(learner.policy, real, 20, seed + 1000)[1]
        ends = {"identity_error": one_step_error(sim, identity, held_out)[0]}
        ends["oracle_error"] = one_step_error(sim, METHODS["oracle"](sim, real_model=real.model).transformer, held_out)[0]
        for v in todo:
            began = time.monotonic()
            at = dataclasses.replace(AT_CONFIG, max_kl=v["at_max_kl"], gamma=v["at_gamma"])
            grounding = METHODS["rgat"](sim, GroundingSettings(at=at, at_std=v["at_std"], residual=v["forward_model"] == "residual"))
            fit = grounding.fit(tau_real, learner.policy, seed)
            grounding.update(learner.policy, s.at_steps, seed)
            error, change = one_step_error(sim, grounding.transformer, held_out)
            row = {"env": s.env, "seed": seed, **v, "at_steps": s.at_steps, **fit, "at_error": error, **ends, "delta_action_rms": change}
            append(CSV, [{**row, "seconds": round(time.monotonic() - began, 1)}])


class Quiet:
    """The part of train.Bar that train.pretrained needs, silent."""

    def phase(self, step, name):
        return None

    def skip(self, steps):
        pass


if __name__ == "__main__":
    main()
