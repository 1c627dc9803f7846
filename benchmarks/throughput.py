"""Environment steps per second: (a) bare physics, (b) TRPO end to end, (c) sb3-contrib's TRPO; all
in one run.

    python benchmarks/throughput.py

(a) steps a mujoco.batch.Batch under random actions and puts fallen robots back on their feet, no
more. (b) is train.py's learner: acting, stepping, advantages, and the update of policy and value.
(c) is sb3-contrib's TRPO with the same settings and batch size: in one environment of gymnasium's,
as it comes,
    and in our batched environment through benchmarks/sb3_adapter.py.
The four alternate for several rounds; medians of the rates and of each round's ratios are printed
and written to results/throughput.csv. Each task and number of environments has a process of its
own, whose peak after (a) and (b), less what importing torch took, is the memory.
"""

import argparse
import csv
import itertools
import multiprocessing
import os
import resource
import sys
import time
from pathlib import Path

import torch

torch.ones(64, 64) @ torch.ones(64, 64)  # torch's own start-up, before memory is looked at
TORCH_MIB = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import gymnasium  # noqa: E402
import numpy as np  # noqa: E402

from envs import BatchEnv  # noqa: E402
from train import Settings, new_learner  # noqa: E402
from trpo import PRESETS  # noqa: E402


def physics(env_id, num_envs, threads, steps, clock):
    """(a): seconds for `steps` environment steps of bare physics."""
    env = BatchEnv(env_id, num_envs, nthread=threads)
    env.reset(seed=0)
    start = env.batch.state.copy()
    box, rng = env.single_action_space, np.random.default_rng(0)
    actions = rng.uniform(box.low, box.high, (64, num_envs, len(box.low)))
    began = clock()
    for t in range(steps // num_envs):
        env.batch.ctrl = actions[t % 64]
        env.batch.step(nstep=env.task.frame_skip)
        fallen = env.task.unhealthy(env.qpos, env.qvel)
        if fallen.any():
            env.batch.state[fallen] = start[fallen]
    return clock() - began


class Ours:
    """(b): one learner that goes on from round to round."""

    def __init__(self, env_id, num_envs, threads):
        self.env = BatchEnv(env_id, num_envs, nthread=threads)
        self.learner = new_learner(Settings(env=env_id, num_envs=num_envs).completed())

    def __call__(self, steps, clock):
        began = clock()
        self.learner.learn(self.env, steps, seed=0, freeze_normalizer=False)
        return clock() - began


class SB3:
    """(c): sb3-contrib's TRPO, on one environment of gymnasium's or on num_envs of ours."""

    def __init__(self, env_id, num_envs, threads, stock):
        from sb3_adapter import trpo_model
        from stable_baselines3.common.monitor import Monitor
        from stable_baselines3.common.vec_env import DummyVecEnv

        env = (
            DummyVecEnv([lambda: Monitor(gymnasium.make(env_id))])
            if stock
            else BatchEnv(env_id, num_envs, nthread=threads)
        )
        self.model = trpo_model(env, PRESETS[env_id.split("-")[0]], seed=0)

    def __call__(self, steps, clock):
        began = clock()
        self.model.learn(steps, reset_num_timesteps=False)
        return clock() - began


def measure(env_id, num_envs, args):
    """Rates (rounds, 4) in steps/s of physics, ours, sb3 as it comes, sb3 on our environment; and
    MiB beyond torch."""
    if args.threads:
        torch.set_num_threads(args.threads)
    batch = PRESETS[env_id.split("-")[0]].batch_size
    ours = Ours(env_id, num_envs, args.threads)
    clock = {"wall": time.perf_counter, "cpu": time.process_time}[args.clock]
    ours(batch, clock)
    physics(env_id, num_envs, args.threads, batch, clock)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024 - TORCH_MIB
    others = [SB3(env_id, num_envs, args.threads, stock) for stock in (True, False)]
    rates = []
    for round in range(args.rounds):
        runs = [
            (lambda n, clock: physics(env_id, num_envs, args.threads, n, clock), args.batches),
            (ours, args.batches),
            *((sb3, 1) for sb3 in others),
        ]
        rates.append([batch * count / run(batch * count, clock) for run, count in runs])
        print(
            f"{env_id}, round {round + 1}: "
            + ", ".join(f"{r:.0f}" for r in rates[-1])
            + " steps/s",
            flush=True,
        )
    return np.array(rates), memory


def arguments(argv):
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--envs", nargs="+", default=["Hopper-v4", "HalfCheetah-v4"])
    parser.add_argument(
        "--num-envs", type=int, nargs="+", default=[Settings.num_envs, 4 * Settings.num_envs]
    )
    parser.add_argument("--threads", type=int, default=0, help="cores to take (default: all)")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument(
        "--batches",
        type=int,
        default=4,
        help="batches per round of (a) and (b); (c) gets one, being slow",
    )
    parser.add_argument(
        "--clock",
        choices=["wall", "cpu"],
        default="wall",
        help="cpu counts this process's own time: for a busy machine, with --threads 1",
    )
    parser.add_argument("--results", type=Path, default=ROOT / "results" / "throughput.csv")
    return parser.parse_args(argv)


def main(argv=None):
    args, rows = arguments(argv), []
    for env_id, num_envs in itertools.product(sorted(args.envs, reverse=True), args.num_envs):
        load = os.getloadavg()[0]
        with multiprocessing.get_context("spawn").Pool(1) as own:
            rates, memory = own.apply(measure, (env_id, num_envs, args))
        rows.append(
            {
                "env": env_id,
                "num_envs": num_envs,
                "threads": args.threads or os.cpu_count(),
                "rounds": args.rounds,
                "clock": args.clock,
                "load_before": round(load, 1),
                **compared(rates),
                "peak_mib_beyond_torch": round(memory),
            }
        )
        told = ", ".join(f"{k} {v}" for k, v in rows[-1].items() if k not in ("env", "num_envs"))
        print(f"{env_id}, {num_envs} environments: {told}", flush=True)
    args.results.parent.mkdir(parents=True, exist_ok=True)
    with args.results.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def compared(rates):
    """Medians over rounds of the rates (rounds, 4) and of their quotients."""
    a, b, stock, batched = np.median(rates, axis=0)
    ratio = lambda i, j: round(float(np.median(rates[:, i] / rates[:, j])), 3)
    return {
        "physics_steps_per_s": round(a),
        "trpo_steps_per_s": round(b),
        "sb3_one_env_steps_per_s": round(stock),
        "sb3_batched_steps_per_s": round(batched),
        "trpo_to_physics": ratio(1, 0),
        "trpo_to_sb3_one_env": ratio(1, 2),
        "trpo_to_sb3_batched": ratio(1, 3),
    }


if __name__ == "__main__":
    main()
