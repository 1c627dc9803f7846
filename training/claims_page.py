"""What a reader sees of the claims: claims.csv, the figure, and the tables of docs/results.md."""

import io
import re
from collections import defaultdict
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from diagnosis.common.atomic_files import write_table, write_whole
from training.claims import COLUMNS, table
from training.measured import by_experiment
from training.results import read

DOCS = Path(__file__).resolve().parents[1] / "docs" / "results.md"
COLORS = {
    "rgat": "#1f5fa8",
    "gat": "#d98b1f",
    "sim": "#c0392b",
    "real": "#2e8b57",
    "oracle": "#555555",
    "solved": "#0f8b8d",
    "rgat as printed": "#111111",
    "rgat, rolled back": "#7fb0e0",
}


def report(results):
    """Write results/claims.csv, results/rounds.png, and the tables of docs/results.md, from the
    CSVs in a folder."""
    names = "rounds", "judged", "transformers"
    rounds, judged, transformers = (read(results / f"{name}.csv") for name in names)
    transformers = [row for row in transformers if "version" in row]
    rows = table(rounds, judged, transformers)
    write_table(results / "claims.csv", COLUMNS, rows)
    if rounds:
        draw(by_experiment(rounds, judged), results / "rounds.png")
    if DOCS.exists() and results.resolve() == DOCS.parents[1] / "results":
        write_whole(DOCS, filled(DOCS.read_text(), rounds, judged, transformers, rows))


def filled(text, rounds, judged, transformers, claims):
    """docs/results.md with what stands between its markers made anew."""
    made = {
        "claims": claims_markdown(claims),
        "rounds": rounds_markdown(rounds, judged),
        "transformers": transformers_markdown(transformers),
    }
    for name, made in made.items():
        pattern = rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)"
        text = re.sub(pattern, lambda m: m[1] + made + m[2], text, flags=re.DOTALL)
    return text


def claims_markdown(claims):
    """The rows of claims.csv as a table."""
    header = "claim|figure|rounds|value|95 % interval|seeds|p, corrected|verdict|version"
    row = (
        "{claim}|{figure}|{rounds}|{value}|{low} to {high}|{seeds}|{p_corrected}|**{verdict}**|"
        "{version}"
    )
    told = lambda cell: (
        "–" if cell in ("nan", "nan to nan") else cell
    )  # of fewer seeds than it asks
    cells = [row.format(**claim).split("|") for claim in claims]
    return markdown(header, [[told(cell) for cell in line] for line in cells])


def markdown(header, rows):
    """A table: the columns' names with | between them, and the cells [[text, ...]]."""
    names = header.split("|")
    lines = [
        "|" + "".join(f" {cell} |" if cell != "" else " |" for cell in cells) + "\n"
        for cells in (names, *rows)
    ]
    return lines[0] + "|" + "---|" * len(names) + "\n" + "".join(lines[1:])


def rounds_markdown(rounds, judged):
    """A table per experiment: mean ± standard error over seeds of the
    return on real, before and after."""
    return "".join(rounds_of(name, data) for name, data in by_experiment(rounds, judged).items())


def rounds_of(name, data):
    """The heading and the table of one experiment."""
    rows = []
    for arm in data.returns:
        [returns], seeds = data.paired(arm)
        means = [pm(returns[:, k]) for k in (0, min(1, returns.shape[1] - 1), -1)]
        rows.append([arm, len(seeds), returns.shape[1] - 1, *means, whole(returns[:, -1])])
    line = data.line()
    if len(line):
        rows.append(["*trained on real*", len(line), "", "", "", pm(line), whole(line)])
    made = f"Version {data.version}, commit {', '.join(data.commits)}."
    header = "arm|seeds|rounds|before|first round|last round|every seed, last round"
    return f"\n### {name.capitalize()}\n\n{made}\n\n{markdown(header, rows)}\n"


def whole(values):
    """Numbers without decimals, side by side."""
    return " ".join(f"{value:.0f}" for value in values)


def transformers_markdown(rows):
    """What one grounding step makes of actions, mean ± standard error over seeds."""
    groups = defaultdict(list)
    for row in rows:
        groups[row["world"], row["forward_model"], row["algo"]].append(row)
    numbers = "rms_from_identity", "slope", "one_step_error"
    cells = lambda mine: [pm(np.array([float(row[k]) for row in mine]), 3) for k in numbers]
    rows = [[*key, len(mine), *cells(mine)] for key, mine in groups.items()]
    header = "real pole|f_ψ|method|seeds|RMS from the identity|slope|one-step error"
    return markdown(header, rows)


def pm(values, digits=0):
    """Mean ± standard error."""
    se = np.std(values, ddof=min(1, len(values) - 1)) / np.sqrt(len(values))
    return f"{np.mean(values):.{digits}f}" + f" ± {se:.{digits}f}" * (len(values) > 1)


def draw(experiments, path):
    """One panel per experiment: mean over seeds and standard error, and the
    line of a policy trained on real."""
    across = min(3, len(experiments))
    down = -(-len(experiments) // across)
    figure = Figure(figsize=(5.2 * across, 3.9 * down), layout="constrained")
    all_axes = list(figure.subplots(down, across, squeeze=False).flat)
    for axes in all_axes[len(experiments) :]:
        axes.set_axis_off()
    for axes, (name, data) in zip(all_axes, experiments.items()):
        for k, arm in enumerate(data.returns):
            [returns], seeds = data.paired(arm)
            mean = returns.mean(0)
            se = returns.std(0, ddof=min(1, len(seeds) - 1)) / np.sqrt(len(seeds))
            color, dash = COLORS.get(arm, f"C{k % 10}"), "-" if arm in COLORS else "--"
            axes.plot(mean, color=color, ls=dash, marker="o", ms=3, label=f"{arm} ({len(seeds)})")
            axes.fill_between(range(len(mean)), mean - se, mean + se, color=color, alpha=0.2, lw=0)
        if len(data.line()):
            axes.axhline(np.mean(data.line()), color="#2e8b57", ls="--", lw=1)
        axes.set(title=f"{name}; version {data.version}")
        axes.set(xlabel="grounding step", ylabel="return on real")
        axes.title.set_fontsize(9)
        axes.xaxis.get_major_locator().set_params(integer=True)
        axes.legend(fontsize=6, ncols=2)
    image = io.BytesIO()
    figure.savefig(image, format="png", dpi=110)
    write_whole(path, image.getvalue())
