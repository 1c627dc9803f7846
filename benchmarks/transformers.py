"""The paper's look at the action transformers: a_hat against a after one grounding step, GAT beside RGAT.

    python benchmarks/transformers.py            # results/transformers.csv and results/transformers.png
    python benchmarks/transformers.py --draw     # the picture alone, from the CSV

InvertedPendulum-v4; the real pole weighs the same as the sim's (sim-to-self), more, or less. Points are the
(s, a) of held-out real episodes of the stochastic policy.
"""

import argparse
import csv
import sys
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import train  # noqa: E402
from envs import BatchEnv, parse_perturbation  # noqa: E402
from rgat import METHODS, GroundingSettings  # noqa: E402
from trpo import rollouts  # noqa: E402

WORLDS = {"sim-to-self": "", "heavier (pole 20)": "pole:mass=20", "lighter (pole 2)": "pole:mass=2"}
POINTS = 300  # kept per panel and seed
CSV = ROOT / "results" / "transformers.csv"


def measure(seeds):
    rows = []
    for seed in seeds:
        s = train.Settings(env="InvertedPendulum-v4", seed=seed, pretrain_steps=30_000).completed()
        sim = BatchEnv(s.env, s.num_envs, nthread=1)
        learner = train.new_learner(s)
        learner.learn(sim, s.pretrain_steps, seed, freeze_normalizer=False)
        for world, change in WORLDS.items():
            real = BatchEnv(s.env, s.num_envs, parse_perturbation(change), nthread=1)
            tau_real = rollouts(learner.policy, real, s.real_trajectories, seed + 1)[1]
            held_out = rollouts(learner.policy, real, s.num_envs, seed + 1000)[1]
            pick = np.linspace(0, len(held_out) - 1, POINTS).astype(int)
            for algo in ("gat", "rgat"):
                grounding = METHODS[algo](sim, GroundingSettings(at_std=s.at_std, residual=True))
                grounding.fit(tau_real, seed)
                grounding.update(learner.policy, s.at_steps, seed)
                a_hat = transformed(sim, grounding.transformer, held_out[pick])
                a = held_out.a[pick, 0]
                rows += [
                    {
                        "seed": seed,
                        "world": world,
                        "algo": algo,
                        "a": f"{x:.5f}",
                        "a_hat": f"{y:.5f}",
                    }
                    for x, y in zip(a, a_hat)
                ]
                distance = np.sqrt(np.mean((a_hat - a) ** 2))
                print(
                    f"seed {seed}, {world}, {algo}: RMS distance from the identity {distance:.4f}",
                    flush=True,
                )
    with CSV.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def transformed(sim, transformer, transitions):
    """a_hat (N,) at the transitions' states, the sim put into each of them."""
    out = []
    for rows in np.array_split(np.arange(len(transitions)), -(-len(transitions) // sim.num_envs)):
        part = transitions[np.resize(rows, sim.num_envs)]
        a_hat = []
        sim.predict(
            part.s.astype(float), lambda obs: a_hat.append(transformer(obs, part.a)) or a_hat[0]
        )
        out.append(a_hat[0][: len(rows), 0])
    return np.concatenate(out)


def draw():
    from matplotlib.figure import Figure

    rows = list(csv.DictReader(CSV.open(newline="")))
    figure = Figure(figsize=(9, 6), layout="constrained")
    panels = [(algo, world) for algo in ("gat", "rgat") for world in WORLDS]
    for panel, (algo, world) in zip(figure.subplots(2, 3, sharex=True, sharey=True).flat, panels):
        a, b = np.array(
            [
                (float(r["a"]), float(r["a_hat"]))
                for r in rows
                if (r["algo"], r["world"]) == (algo, world)
            ]
        ).T
        panel.plot([-3, 3], [-3, 3], color="black", lw=1)
        panel.scatter(a, b, s=4, alpha=0.4, color="#1f5fa8", lw=0)
        panel.set_title(
            f"{algo.upper()}, {world}\nRMS from identity {np.sqrt(np.mean((a - b) ** 2)):.3f}",
            fontsize=9,
        )
    figure.supxlabel("action of the policy, a")
    figure.supylabel("transformed action")
    figure.savefig(CSV.with_suffix(".png"), dpi=110)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--draw", action="store_true", help="only draw results/transformers.csv")
    args = parser.parse_args()
    torch.set_num_threads(1)
    if not args.draw:
        measure(args.seeds)
    draw()
