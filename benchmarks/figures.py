"""The README's figures and tables of the grounding runs, drawn from the committed CSVs.

    python benchmarks/figures.py        # results/grounding.png, and the tables on the terminal as Markdown
"""

import csv
from collections import defaultdict
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

RESULTS = Path(__file__).resolve().parent.parent / "results"
COLORS = {"rgat": "#1f5fa8", "gat": "#d98b1f", "ane": "#7b5aa6", "sim": "#c0392b", "real": "#2e8b57", "oracle": "#555555", "physics": "#0f8b8d"}


def read(name):
    path = RESULTS / name
    return list(csv.DictReader(path.open(newline=""))) if path.exists() else []


def curves(rows):
    """{(env, policy, tag): {algo: {seed: returns by grounding step}}}"""
    table = defaultdict(lambda: defaultdict(lambda: defaultdict(list)))
    for row in rows:
        table[row["env"], row["policy"], row["tag"]][row["algo"]][int(row["seed"])].append(float(row["real_return_deterministic"]))
    return table


def draw_grounding(rows, best):
    """One panel per task: every seed thin, the mean thick with its standard error, both reference lines."""
    table = {key: algos for key, algos in curves(rows).items() if key[2] == "default"}
    figure = Figure(figsize=(5.2 * max(1, len(table)), 4), layout="constrained")
    for axes, ((env, policy, _), algos) in zip(np.atleast_1d(figure.subplots(1, max(1, len(table)))), sorted(table.items())):
        for algo, seeds in algos.items():
            color = COLORS[algo]
            for returns in seeds.values():
                axes.plot(returns, color=color, lw=0.6, alpha=0.35)
            length = min(map(len, seeds.values()))
            values = np.array([returns[:length] for returns in seeds.values()])
            mean, se = values.mean(0), values.std(0, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else np.zeros(length)
            axes.plot(mean, color=color, lw=2, marker="o", ms=4, label=f"{algo}, {len(values)} seed{'s' * (len(values) > 1)}")
            axes.fill_between(range(length), mean - se, mean + se, color=color, alpha=0.2, lw=0)
        lines = [row for row in best if row["env"] == env and row["policy"] == policy and row["tag"] == "default"]
        for column, color in (("trained_on_real", COLORS["real"]), ("before_grounding", COLORS["sim"])):
            values = [float(v) for v in {row["seed"]: row[column] for row in lines if row[column]}.values()]
            if values:
                axes.axhline(np.mean(values), color=color, lw=1.2, ls="--", label=f"{column.replace('_', ' ')}, mean of {len(values)}")
        axes.set(title=f"{env}, {policy} policy", xlabel="grounding step", ylabel="return on real, deterministic", ylim=(0, None))
        axes.xaxis.get_major_locator().set_params(integer=True)
        axes.legend(fontsize=7)
    figure.savefig(RESULTS / "grounding.png", dpi=110)


def table(rows, best):
    """Markdown: the last step's mean, and the best step re-evaluated on fresh episodes, per task and method."""
    print("| task | policy | method | settings | seeds | last step, mean (each) | best step on fresh episodes, median (each) | `real` line, mean |\n|---|---|---|---|---|---|---|---|")
    for (env, policy, tag), algos in sorted(curves(rows).items()):
        for algo, seeds in algos.items():
            last = [returns[-1] for returns in seeds.values()]
            mine = [row for row in best if (row["env"], row["policy"], row["tag"], row["algo"]) == (env, policy, tag, algo)]
            fresh = [float(row["real_return_deterministic"]) for row in mine]
            real = np.mean([float(row["trained_on_real"]) for row in mine])
            each = lambda values: ", ".join(f"{v:.0f}" for v in values)
            print(f"| {env} | {policy} | {algo} | {tag} | {len(last)} | {np.mean(last):.0f} ({each(last)}) | {np.median(fresh):.0f} ({each(fresh)}) | {real:.0f} |")


def settings_table(rows):
    """Markdown: what a frozen policy returns in the grounded simulator under each variant, and the one-step error."""
    print("\n| method | units of R_AT | f_ψ | γ_AT | max KL | std | error of f_ψ | one-step error | return, stochastic | deterministic |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for row in rows:
        f_error = f"{float(row['forward_model_error']):.4f}" if row["forward_model_error"] else ""
        told = [row[k] for k in ("method", "norm", "forward_model", "at_gamma", "at_max_kl", "at_std")]
        returns = [f"{float(row[f'return_{k}']):.0f}" for k in ("stochastic", "deterministic")]
        print("| " + " | ".join([*told, f_error, f"{float(row['one_step_error']):.4f}", *returns]) + " |")


if __name__ == "__main__":
    settings_table(read("transformer_settings.csv"))
    rows, best = read("grounding.csv"), read("best.csv")
    if rows:
        draw_grounding(rows, best)
        table(rows, best)
