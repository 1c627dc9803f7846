"""The README's figures and tables of the grounding runs, drawn from the committed CSVs.

python benchmarks/figures.py  # results/grounding.png, transitions.png, and Markdown tables
"""

import csv
from collections import defaultdict
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

RESULTS = Path(__file__).resolve().parent.parent / "results"
COLORS = {
    "rgat": "#1f5fa8",
    "gat": "#d98b1f",
    "ane": "#7b5aa6",
    "sim": "#c0392b",
    "real": "#2e8b57",
    "oracle": "#555555",
    "physics": "#0f8b8d",
}
RETURN = "return on real, deterministic"


def read(name):
    """The rows of a table in results/, [] where there is none."""
    path = RESULTS / name
    return list(csv.DictReader(path.open(newline=""))) if path.exists() else []


def curves(rows):
    """{(env, policy, tag): {algo: {seed: returns by grounding step}}}"""
    table = defaultdict(lambda: defaultdict(lambda: defaultdict(list)))
    for row in rows:
        table[row["env"], row["policy"], row["tag"]][row["algo"]][int(row["seed"])].append(
            float(row["real_return_deterministic"])
        )
    return table


def panels(count):
    """A figure and its axes, one for each of `count` panels."""
    across = 2 if count == 4 else 3
    rows = -(-count // across)
    figure = Figure(figsize=(4.6 * min(count, across), 3.7 * rows), layout="constrained")
    axes = list(figure.subplots(rows, min(count, across), squeeze=False).flat)
    for unused in axes[count:]:
        unused.set_axis_off()
    return figure, axes


def draw_grounding(rows, best):
    """One panel per task, those where grounding shows first."""
    told = [(key, algos) for key, algos in curves(rows).items() if key[2] == "default"]
    table = dict(sorted(told, key=lambda item: "Hopper" not in item[0][0]))
    figure, all_axes = panels(len(table))
    for axes, ((env, policy, _), algos) in zip(all_axes, table.items()):
        for algo, seeds in algos.items():
            draw_seeds(axes, list(seeds.values()), algo)
        key = env, policy, "default", "rgat"
        lines = [r for r in best if (r["env"], r["policy"], r["tag"], r["algo"]) == key]
        for column, color in (
            ("trained_on_real", COLORS["real"]),
            ("before_grounding", COLORS["sim"]),
        ):
            by_seed = {row["seed"]: float(row[column]) for row in lines if row[column]}
            if by_seed:
                name = f"{column.replace('_', ' ')}, mean of {len(by_seed)}"
                level(axes, list(by_seed.values()), color, name)
        axes.set(title=f"{env}, {policy} policy", xlabel="grounding step", ylabel=RETURN)
        axes.set(ylim=(0, None))
        axes.xaxis.get_major_locator().set_params(integer=True)
        axes.legend(fontsize=7, ncols=2, loc="lower right")
    figure.savefig(RESULTS / "grounding.png", dpi=110)


def draw_seeds(axes, runs, algo):
    """Every seed thin, the mean thick with its standard error. runs: [returns by grounding step]"""
    for returns in runs:
        axes.plot(returns, color=COLORS[algo], lw=0.6, alpha=0.3)
    length = min(map(len, runs))
    values = np.array([returns[:length] for returns in runs])
    mean, se = values.mean(0), np.zeros(length)
    if len(values) > 1:
        se = values.std(0, ddof=1) / np.sqrt(len(values))
    label = f"{algo}, {seeds_of(values)}"
    axes.plot(mean, color=COLORS[algo], lw=2, marker="o", ms=3, label=label)
    axes.fill_between(range(length), mean - se, mean + se, color=COLORS[algo], alpha=0.2, lw=0)


def level(axes, values, color, label):
    """A reference line at the mean of values."""
    axes.axhline(np.mean(values), color=color, lw=1.2, ls="--", label=label)


def seeds_of(values):
    """How many seeds, in words."""
    return f"{len(values)} seed{'s' * (len(values) > 1)}"


def draw_transitions(rows, best):
    """Return on real against the real transitions that it took: diagnosis beside RGAT, every seed a
    line."""
    deep = [r for r in rows if (r["tag"], r["policy"]) == ("default", "deep")]
    mine = [r for r in deep if r["algo"] in ("physics", "rgat") and int(r["grounding_step"])]
    tasks = sorted({r["env"] for r in mine if r["algo"] == "physics"})
    if not tasks:
        return
    figure, all_axes = panels(len(tasks))
    for axes, env in zip(all_axes, tasks):
        for algo in ("rgat", "physics"):
            draw_runs(axes, [r for r in mine if (r["env"], r["algo"]) == (env, algo)], algo)
        key = env, "deep", "rgat"
        told = [r for r in best if (r["env"], r["policy"], r["algo"]) == key]
        lines = {r["seed"]: float(r["trained_on_real"]) for r in told}
        level(axes, list(lines.values()), COLORS["real"], "trained on real, mean")
        axes.set(title=env, xlabel="real transitions used", ylabel=RETURN, ylim=(0, None))
        axes.legend(fontsize=7)
    figure.savefig(RESULTS / "transitions.png", dpi=110)


def draw_runs(axes, rows, algo):
    """Every seed's return against its real transitions."""
    seeds = sorted({r["seed"] for r in rows})
    look = {"color": COLORS[algo], "lw": 1, "marker": "o", "ms": 4, "alpha": 0.7}
    for i, seed in enumerate(seeds):
        run = [r for r in rows if r["seed"] == seed]
        x = [float(r["real_transitions"]) for r in run]
        y = [float(r["real_return_deterministic"]) for r in run]
        axes.semilogx(x, y, label=None if i else f"{algo}, {seeds_of(seeds)}", **look)


def table(rows, best):
    """Markdown: the last step's mean, and the best step re-evaluated on fresh episodes, per task
    and method."""
    titles = [
        "task",
        "policy",
        "method",
        "seeds",
        "before, median",
        "last step, mean (each)",
        "best step on fresh episodes, median (each)",
        "`real` line, median",
    ]
    print("\n| " + " | ".join(titles) + " |\n" + "|---" * len(titles) + "|")
    each = lambda values: f"({', '.join(f'{v:.0f}' for v in values)})"
    for (env, policy, tag), algos in sorted(curves(rows).items()):
        for algo, seeds in algos.items():
            last = [returns[-1] for returns in seeds.values()]
            mine = [
                row
                for row in best
                if (row["env"], row["policy"], row["tag"], row["algo"]) == (env, policy, tag, algo)
            ]
            fresh, real, before = (
                [float(r[k]) for r in mine]
                for k in ("real_return_deterministic", "trained_on_real", "before_grounding")
            )
            cells = [
                env,
                policy,
                algo if tag == "default" else f"{algo} ({tag})",
                len(last),
                f"{np.median(before):.0f}",
            ]
            cells += [
                f"{np.mean(last):.0f} {each(last)}",
                f"{np.median(fresh):.0f} {each(fresh)}",
                f"{np.median(real):.0f}",
            ]
            print("| " + " | ".join(map(str, cells)) + " |")


def walking(rows, enough=3000):
    """After how many of all rounds, over all seeds, Hopper's policy walks on real, per method."""
    print()
    for algo, seeds in curves(rows)["Hopper-v4", "deep", "default"].items():
        rounds = [value for returns in seeds.values() for value in returns[1:]]
        print(
            f"Hopper-v4 {algo}: above {enough} after {sum(value > enough for value in rounds)} of "
            f"{len(rounds)} rounds"
        )


def trpo_table(rows):
    """Markdown: TRPO here and sb3-contrib's, median over seeds of the deterministic return."""
    groups = defaultdict(list)
    for row in rows:
        groups[row["env"], row["implementation"]].append(row)
    print(
        "\n| environment | implementation | steps | deterministic, median (each) | stochastic, "
        "median | CPU seconds |\n|---|---|---|---|---|---|"
    )
    for (env, implementation), mine in sorted(groups.items()):
        returns, noisy, seconds = (
            [float(r[k]) for r in mine]
            for k in ("return_deterministic", "return_stochastic", "seconds")
        )
        every = ", ".join(f"{v:.0f}" for v in returns)
        print(
            f"| {env} | {implementation} | {int(mine[0]['steps']):,} | {np.median(returns):.0f} "
            f"({every}) | {np.median(noisy):.0f} | {np.median(seconds):.0f} |"
        )


def settings_table(rows):
    """Markdown: what a frozen policy returns in the grounded simulator under each variant, and the
    one-step error; seed by seed."""
    print(
        "\n| method | units of R_AT | f_ψ | γ_AT | max KL | std | error of f_ψ | one-step error | "
        "return, stochastic | deterministic |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    variants = defaultdict(list)
    for row in rows:
        variants[
            tuple(
                row[k]
                for k in ("method", "norm", "forward_model", "at_gamma", "at_max_kl", "at_std")
            )
        ].append(row)
    for told, of_seeds in variants.items():
        shown = [
            ("forward_model_error", ".4f"),
            ("one_step_error", ".4f"),
            ("return_stochastic", ".0f"),
            ("return_deterministic", ".0f"),
        ]
        cells = [
            ", ".join(f"{float(row[k]):{digits}}" for row in of_seeds if row[k])
            for k, digits in shown
        ]
        print("| " + " | ".join([*told, *cells]) + " |")


if __name__ == "__main__":
    settings_table(read("transformer_settings.csv"))
    trpo_table(read("trpo.csv"))
    rows, best = read("grounding.csv"), read("best.csv")
    if rows:
        draw_grounding(rows, best)
        draw_transitions(rows, best)
        table(rows, best)
        walking(rows)
