"""The paper's look at the action transformers: a_hat against a after one grounding step, GAT beside
RGAT.

    python benchmarks/transformers.py [--seeds 0 1 2]     # results/transformers.csv,
    transformer_points.csv, transformers.png
    python benchmarks/transformers.py --draw              # the picture alone, from the CSVs

InvertedPendulum-v4; the real pole weighs the same as the sim's (sim-to-self), more, or less; f_psi
is the paper's plain network, or corrects the sim. Points are the (s, a) of held-out real episodes
of the stochastic policy; those of seed 0 are kept and drawn. Rows of seeds that are there already
with this version are not made again.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import train  # noqa: E402
from benchmarks.rows import append, finished  # noqa: E402
from envs import BatchEnv, parse_perturbation  # noqa: E402
from models import torch_threads  # noqa: E402
from reproduce import commit  # noqa: E402
from rgat import METHODS, one_step_error  # noqa: E402
from training.experiments import version  # noqa: E402
from training.results import read  # noqa: E402
from trpo import rollouts  # noqa: E402

WORLDS = {"sim-to-self": "", "heavier (pole 20)": "pole:mass=20", "lighter (pole 2)": "pole:mass=2"}
ALGOS = ("gat", "rgat", "solved")
POINTS = 300  # drawn per panel
CSV = ROOT / "results" / "transformers.csv"


@torch_threads(1)
def measure(seed, name):
    """The rows of one seed, and the points of its panels."""
    s = train.Settings(env="InvertedPendulum-v4", seed=seed, pretrain_steps=30_000).completed()
    sim = BatchEnv(s.env, s.num_envs, nthread=1)
    learner = train.new_learner(s)
    learner.learn(sim, s.pretrain_steps, seed, freeze_normalizer=False)
    rows, points = [], []
    for world, change in WORLDS.items():
        real = BatchEnv(s.env, s.num_envs, parse_perturbation(change), nthread=1)
        tau_real = rollouts(learner.policy, real, s.real_trajectories, seed + 1)[1]
        held_out = rollouts(learner.policy, real, s.num_envs, seed + 1000)[1]
        pick = np.linspace(0, len(held_out) - 1, 4 * POINTS).astype(int)
        for model in ("plain", "residual"):
            settings = train.Settings(env=s.env, forward_model=model).completed().grounding
            for algo in ALGOS:
                grounding = METHODS[algo](sim, settings)
                grounding.fit(tau_real, seed)
                grounding.update(learner.policy, s.at_steps, seed)
                a_hat = transformed(sim, grounding.transformer, held_out[pick])
                a, error = held_out.a[pick, 0], one_step_error(sim, grounding.transformer, held_out)
                key = {"seed": seed, "world": world, "forward_model": model, "algo": algo}
                rows.append(
                    {
                        **key,
                        "rms_from_identity": f"{np.sqrt(np.mean((a_hat - a) ** 2)):.5f}",
                        "slope": f"{np.polyfit(a, a_hat, 1)[0]:.5f}",
                        "one_step_error": f"{error[0]:.5f}",
                        "version": version(),
                        "commit": name,
                    }
                )
                print(*rows[-1].values(), flush=True)
                points += [
                    {**key, "a": f"{x:.4f}", "a_hat": f"{y:.4f}"}
                    for x, y in zip(a[::4], a_hat[::4])
                ]
    return rows, points


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
    """transformers.png: a panel per world and method, each f_psi in its colour, with every seed's
    mean RMS."""
    from matplotlib.figure import Figure

    points, rows = read(CSV.with_name("transformer_points.csv")), read(CSV)
    figure = Figure(figsize=(9, 8), layout="constrained")
    panels = [(algo, world) for algo in ALGOS for world in WORLDS]
    for panel, (algo, world) in zip(figure.subplots(3, 3, sharex=True, sharey=True).flat, panels):
        panel.plot([-3, 3], [-3, 3], color="black", lw=1)
        title = []
        for model, color in (("plain", "#d98b1f"), ("residual", "#1f5fa8")):
            mine = lambda table: [
                r
                for r in table
                if (r["algo"], r["world"], r["forward_model"]) == (algo, world, model)
            ]
            xy = np.array([(float(r["a"]), float(r["a_hat"])) for r in mine(points)])
            panel.scatter(*xy.T, s=4, alpha=0.4, color=color, lw=0)
            rms = np.mean([float(r["rms_from_identity"]) for r in mine(rows)])
            title.append(f"{model} {rms:.3f}")
        panel.set_title(f"{algo.upper()}, {world}\nRMS: {', '.join(title)}", fontsize=9)
    figure.supxlabel("action of the policy, a")
    figure.supylabel("transformed action")
    figure.savefig(CSV.with_suffix(".png"), dpi=110)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(10)))
    parser.add_argument("--draw", action="store_true", help="only draw, from the CSVs")
    parser.add_argument("--results", type=Path, default=CSV.parent)
    parser.add_argument("--commit", default=None)
    args = parser.parse_args()
    CSV = args.results / CSV.name
    for seed in () if args.draw else args.seeds:
        if not finished(CSV, {"seed": seed, "version": version()}):
            rows, points = measure(seed, args.commit or commit())
            append(CSV, rows)
            if seed == 0:
                append(CSV.with_name("transformer_points.csv"), points)
    draw()
