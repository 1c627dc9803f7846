"""What decides whether g_phi learns: one grounding step from the same data under different
settings.

    python benchmarks/transformer_settings.py --env Hopper-v4 --seeds 0

Appends to results/transformer_settings.csv: the one-step error on held-out real transitions that a
transformer leaves, and the return that the same frozen policy gets in the grounded simulator: it
should be the real one. Variants "sim", "real" and "oracle" are the raw worlds and the perfect
transformer, "raw" is R_AT with its dimensions in SI units, not in those of a real step. Rows that
exist are skipped.
"""

import argparse
import dataclasses
import sys
import time
import types
from pathlib import Path

import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import train  # noqa: E402
from benchmarks.rows import append, finished  # noqa: E402
from envs import BatchEnv, parse_perturbation  # noqa: E402
from rgat import AT_CONFIG, METHODS, GroundedEnv, GroundingSettings, one_step_error  # noqa: E402
from trpo import rollouts  # noqa: E402

CSV = ROOT / "results" / "transformer_settings.csv"
WIDE, NARROW = 0.14, None  # None: the task's default
VARIANTS = [  # method, norm, at_gamma, at_max_kl, at_std, forward_model
    ("sim", "", "", "", "", ""),
    ("real", "", "", "", "", ""),
    ("oracle", "step", "", "", "", ""),
    ("oracle", "raw", "", "", "", ""),
    ("rgat", "step", 0.0, 1e-2, NARROW, "residual"),
    ("rgat", "raw", 0.0, 1e-2, NARROW, "residual"),
    ("rgat", "step", 0.0, 1e-3, NARROW, "residual"),
    ("rgat", "step", 0.0, 1e-4, NARROW, "residual"),
    ("rgat", "step", 0.9, 1e-2, NARROW, "residual"),
    ("rgat", "step", 0.99, 1e-2, NARROW, "residual"),
    ("rgat", "step", 0.99, 1e-4, NARROW, "residual"),
    ("rgat", "step", 0.0, 1e-2, WIDE, "residual"),
    ("rgat", "step", 0.0, 1e-2, NARROW, "plain"),
    ("rgat", "raw", 0.99, 1e-4, WIDE, "plain"),
]
COLUMNS = ("method", "norm", "at_gamma", "at_max_kl", "at_std", "forward_model")


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--env", required=True)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    args = parser.parse_args()
    torch.set_num_threads(1)
    kept = str(ROOT / "runs" / "pretrained")
    for seed in args.seeds:
        s = train.Settings(env=args.env, seed=seed, threads=1, pretrained=kept).completed()
        variants = [dict(zip(COLUMNS, values)) for values in VARIANTS]
        for variant in variants:
            if variant["method"] == "rgat":
                variant["at_std"] = variant["at_std"] or s.at_std
        new = lambda v: not finished(CSV, {"env": s.env, "seed": seed, **v})
        measure(s, list(filter(new, variants)))


def measure(s, variants):
    """Append a row for each variant, all from the same policy and the same real data."""
    if not variants:
        return
    sim = BatchEnv(s.env, s.num_envs, nthread=1)
    real = BatchEnv(s.env, s.num_envs, parse_perturbation(s.real), nthread=1)
    learner = train.new_learner(s)
    learner.load(train.pretrained(s, "sim", sim, s.pretrain_steps, Quiet()))
    policy = learner.policy
    tau_real = rollouts(policy, real, s.real_trajectories, s.seed + 1)[1]
    held_out = rollouts(policy, real, s.eval_episodes, s.seed + 1000)[1]
    for v in variants:
        began = time.monotonic()
        grounding, world, fit = ground(s, v, sim, real, policy, tau_real, s.seed)
        error, change = one_step_error(world, grounding.transformer, held_out)
        grounded = GroundedEnv(world, grounding.transformer)
        returned = lambda deterministic: rollouts(policy, grounded, 64, s.seed, deterministic)[0]
        row = {
            "env": s.env,
            "seed": s.seed,
            **v,
            "at_steps": s.at_steps,
            "forward_model_error": "",
            **fit,
            "one_step_error": error,
            "delta_action_rms": change,
            "return_deterministic": returned(True).mean(),
            "return_stochastic": returned(False).mean(),
        }
        append(CSV, [{**row, "seconds": round(time.monotonic() - began, 1)}])


def ground(s, v, sim, real, policy, tau_real, seed):
    """The grounding of one variant, the world that it acts in, and the statistics of its fit."""
    method, world = METHODS[v["method"]], real if v["method"] == "real" else sim
    settings = GroundingSettings(per_step=v["norm"] != "raw")
    if v["method"] == "rgat":
        at = dataclasses.replace(AT_CONFIG, max_kl=v["at_max_kl"], gamma=v["at_gamma"])
        settings = dataclasses.replace(
            settings, at=at, at_std=v["at_std"], residual=v["forward_model"] == "residual"
        )
    told = (real.model,) if v["method"] == "oracle" else ()
    grounding = method(world, settings, *told)
    fit = grounding.fit(tau_real, seed)
    grounding.update(policy, s.at_steps, seed)
    return grounding, world, fit


class Quiet:
    """The part of train.Bar that train.pretrained needs, silent."""

    world, run = "sim", types.SimpleNamespace(train=[], flush=lambda: None)

    def phase(self, step, name):
        return None

    def skip(self, steps, counts=True):
        pass


if __name__ == "__main__":
    main()
