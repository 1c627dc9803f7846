"""How well TRPO learns, beside sb3-contrib's TRPO with the same settings in the same environments.

    python benchmarks/trpo.py                   # everything, one after the other
    python benchmarks/trpo.py --implementations ours --envs Hopper-v4 --seeds 0 1 2 --threads 1
    python benchmarks/trpo.py --implementations ours --envs HalfCheetah-v4 --max-kl 0.04

Appends a row per finished training to results/trpo.csv and skips what is there, so parts may run
side by side and be stopped at will. An environment is a gymnasium id, perturbed if a change
follows: "Hopper-v4 torso:mass*1.27". Each policy is judged by 20 episodes acting by its mean and 20
acting at random as it learnt; seconds are CPU time.
"""

import argparse
import dataclasses
import sys
import time
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from benchmarks.rows import append, finished  # noqa: E402
from envs import TASKS, BatchEnv, parse_perturbation  # noqa: E402
from train import Settings, new_learner, seed_for  # noqa: E402
from trpo import PRESETS, rollouts  # noqa: E402

STEPS = {"InvertedPendulum": 200_000, "Hopper": 1_000_000, "HalfCheetah": 1_000_000}
ORIGINALS = [f"{name}-v4" for name in TASKS]
PERTURBED = [f"{name}-v4 {task.real}" for name, task in TASKS.items()]
SEEDS = {"ours": 5, "sb3-contrib": 3}


def make_env(name, num_envs, threads):
    """A BatchEnv for "ID" or "ID CHANGES"."""
    env_id, _, changes = name.partition(" ")
    return BatchEnv(env_id, num_envs, parse_perturbation(changes), nthread=threads)


def train_ours(name, config, seed, steps, num_envs, threads):
    """The trained policy, exactly as train.py's pretraining makes it."""
    s = Settings(env=name.partition(" ")[0], seed=seed, num_envs=num_envs).completed()
    learner = new_learner(s)
    learner.config = config
    learner.learn(
        make_env(name, num_envs, threads),
        steps,
        seed_for(seed, 0, "pretrain"),
        freeze_normalizer=False,
    )
    return learner.policy


def train_sb3(name, config, seed, steps, num_envs, threads):
    """sb3-contrib's policy after as many steps with the same settings."""
    from sb3_adapter import ActingPolicy, trpo_model

    model = trpo_model(make_env(name, num_envs, threads), config, seed)
    model.learn(steps)
    return ActingPolicy(model)


IMPLEMENTATIONS = {"ours": train_ours, "sb3-contrib": train_sb3}


def arguments(argv):
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--implementations", nargs="+", choices=list(IMPLEMENTATIONS), default=list(IMPLEMENTATIONS)
    )
    parser.add_argument(
        "--envs",
        nargs="+",
        help=f"default: {', '.join(ORIGINALS)}, and for ours these with the paper's changes",
    )
    parser.add_argument(
        "--seeds", nargs="+", type=int, help="default: 0..4 for ours, 0..2 for sb3-contrib"
    )
    parser.add_argument("--steps", type=int, help="default: 200k for the pendulum, 1M otherwise")
    parser.add_argument(
        "--max-kl",
        type=float,
        help="instead of the preset's; the column `implementation` then tells it too",
    )
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument(
        "--num-envs",
        type=int,
        default=Settings.num_envs,
        help="another number is told by the column `implementation` too",
    )
    parser.add_argument(
        "--threads", type=int, default=0, help="cores for each training (default: all)"
    )
    parser.add_argument("--results", type=Path, default=ROOT / "results" / "trpo.csv")
    return parser.parse_args(argv)


def main(argv=None):
    args = arguments(argv)
    if args.threads:
        torch.set_num_threads(args.threads)
    for implementation in args.implementations:
        for name in args.envs or ORIGINALS + PERTURBED * (implementation == "ours"):
            for seed in args.seeds or range(SEEDS[implementation]):
                measure(implementation, name, seed, args)


def measure(implementation, name, seed, args):
    """Append the row of one training, where there is none yet."""
    task = name.partition("-")[0]
    steps, config, label = args.steps or STEPS[task], PRESETS[task], implementation
    if args.max_kl:
        config = dataclasses.replace(config, max_kl=args.max_kl)
        label += f" max_kl={args.max_kl:g}"
    if args.num_envs != Settings.num_envs:
        label += f" num_envs={args.num_envs}"
    key = {"implementation": label, "env": name, "seed": seed, "steps": steps}
    if finished(args.results, key):
        return
    start = time.process_time()
    learn = IMPLEMENTATIONS[implementation]
    policy = learn(name, config, seed, steps, args.num_envs, args.threads)
    seconds = time.process_time() - start
    env = make_env(name, args.episodes, args.threads)
    judge = lambda deterministic: float(
        np.mean(rollouts(policy, env, args.episodes, 10_000 + seed, deterministic)[0])
    )
    row = {
        **key,
        "return_deterministic": round(judge(True), 1),
        "return_stochastic": round(judge(False), 1),
        "seconds": round(seconds, 1),
    }
    append(args.results, [row])
    print(", ".join(f"{k} {v}" for k, v in row.items()), flush=True)


if __name__ == "__main__":
    main()
