"""The paper's claims against the rows that were measured: results/claims.csv,
the figures, and docs/results.md's tables.

Each claim is a number per seed, positive where the claim is so. Its test is a permutation test over
seeds: under no effect each seed's number is as likely with the other sign. p is one-sided and
corrected over all claims that have seeds enough to be tested (Holm). Rows of different versions are
never put together: of each experiment the version with the most runs counts.
"""

import re
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Callable

import numpy as np
from matplotlib.figure import Figure
from scipy import stats

from diagnosis.common.atomic_files import write_table, write_whole
from training.experiments import WIDTHS
from training.results import SAME, read

COLUMNS = "claim figure statistic value low high seeds p p_corrected verdict choice version commit".split()
COLORS = {"rgat": "#1f5fa8", "gat": "#d98b1f", "sim": "#c0392b", "real": "#2e8b57", "oracle": "#555555", "solved": "#0f8b8d", "rgat as printed": "#111111", "rgat, rolled back": "#7fb0e0"}  # fmt: skip
DOCS = Path(__file__).resolve().parents[1] / "docs" / "results.md"
FEWEST = 5  # seeds of a claim that is tested: fewer cannot bring p below 0.05
REACHED = 0.9  # of the line of a policy trained on real: what counts as reaching it


# --- the rows of an experiment --------------------------------------------------------------------


class Data:
    """The rows of one experiment and one version: returns (rounds,) by arm and
    seed, and reference lines by seed."""

    def __init__(self, rounds, judged):
        self.returns, self.errors = defaultdict(dict), defaultdict(dict)
        self.lines = defaultdict(dict)  # by arm too: a policy of other settings has its own line
        for row in sorted(rounds, key=lambda r: int(r["grounding_step"])):
            arm, seed = row["arm"], int(row["seed"])
            value = float(row["real_return_deterministic"])
            self.returns[arm].setdefault(seed, []).append(value)
            error = float(row["at_one_step_error"] or "nan")
            self.errors[arm].setdefault(seed, []).append(error)
        for row in judged:
            self.lines[row["arm"]][int(row["seed"])] = float(row["trained_on_real"])
        self.version = rounds[0]["version"] if rounds else ""
        self.commits = sorted({row["commit"] for row in rounds})

    def paired(self, *arms):
        """Seeds that all arms have, over as many rounds as all of them have:
        [arrays (seeds, rounds)], seeds."""
        seeds = sorted(set.intersection(*(set(self.returns[arm]) for arm in arms)))
        if not seeds:
            return [np.empty((0, 1)) for _ in arms], []
        length = min(len(self.returns[arm][seed]) for arm in arms for seed in seeds)
        return [np.array([self.returns[arm][seed][:length] for seed in seeds]) for arm in arms], seeds  # fmt: skip

    def line(self):
        """The line of the figure and the table: that of the first arm that has one, (seeds,)."""
        arms = ["rgat", *self.lines]
        return np.array(next((list(self.lines[a].values()) for a in arms if self.lines[a]), []))

    def with_lines(self, arm):
        """Returns (seeds, rounds) of an arm and the reference lines (seeds,)
        of the seeds that have one."""
        [returns], seeds = self.paired(arm)
        lines = self.lines[arm]
        keep = [k for k, seed in enumerate(seeds) if seed in lines]
        return returns[keep], np.array([lines[seeds[k]] for k in keep])


def by_experiment(rounds, judged):
    """{experiment: Data} of the runs that have ended, of each the version with the most runs."""
    found = {}
    run = lambda row: tuple(str(row[k]) for k in SAME)
    ended = {run(row) for row in judged}
    rounds = [row for row in rounds if run(row) in ended]
    for name in sorted({row["experiment"] for row in rounds}):
        mine = [row for row in rounds if row["experiment"] == name]
        runs = defaultdict(set)
        for row in mine:
            runs[row["version"]].add((row["arm"], row["seed"]))
        version = max(runs, key=lambda v: (len(runs[v]), v))
        of = lambda rows: [r for r in rows if (r["experiment"], r["version"]) == (name, version)]
        found[name] = Data(of(mine), of(judged))
    return found


# --- the claims -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Claim:
    """values(data) -> (seeds,), positive where the claim is so; choice:
    what the verdict hangs on."""

    experiment: str
    text: str
    figure: str
    statistic: str
    values: Callable
    choice: str = ""


def reaches(arm, at=-1):
    """How far the return after a round is above REACHED of the line of a policy trained on real."""

    def values(data):
        returns, line = data.with_lines(arm)
        after = returns[:, min(at, returns.shape[1] - 1)] if at > 0 else returns[:, -1]
        return (after - REACHED * line) / np.abs(line)

    return values


def falls_short(arm):
    return lambda data: -reaches(arm)(data)


def above(arm, other):
    """Mean return over the rounds after the first, against another arm from the same policies."""

    def values(data):
        (ours, theirs), _ = data.paired(arm, other)
        return ours[:, 1:].mean(1) - theirs[:, 1:].mean(1)

    return values


def best_width(data):
    """The width of the action noise envelope with the best mean return in the
    last round, as the paper reports it."""
    arms = [f"ane {w:g}" for w in WIDTHS if data.returns[f"ane {w:g}"]]
    last = lambda arm: np.mean([returns[-1] for returns in data.returns[arm].values()])
    return max(arms, key=last) if arms else "ane"


def more_precise(data):
    """How much larger the one-step error is under GAT than under RGAT, mean over rounds."""
    _, seeds = data.paired("rgat", "gat")
    mean = lambda arm: np.array([np.nanmean(data.errors[arm][seed]) for seed in seeds])
    return mean("gat") - mean("rgat")


def precision_explains(data):
    """Rank correlation, in each seed over methods and rounds, of a small
    one-step error with a high return."""
    arms = [arm for arm in data.returns if arm not in ("real", "rgat, rolled back")]
    seeds = set.intersection(*(set(data.returns[arm]) for arm in arms)) if arms else ()
    pairs = lambda k: np.array([p for arm in arms for p in zip(data.errors[arm][k][1:], data.returns[arm][k][1:])])  # fmt: skip
    return np.array([-stats.spearmanr(*pairs(k).T).statistic for k in sorted(seeds)])


def shallow_fails(data):
    """How far a shallow policy trained on real stays below half of what
    a deep one returns there."""
    out = []
    for env in ("Hopper-v4", "HalfCheetah-v4"):
        (shallow, deep), _ = data.paired(f"{env}, shallow", f"{env}, deep")
        out.append((0.5 * deep[:, -1] - shallow[:, -1]) / np.abs(deep[:, -1]))
    return np.concatenate(out)


def sim_costs(data):
    """The part of the reference line that the sim's policy lacks on real
    before any grounding, less 30 %."""
    returns, line = data.with_lines("sim")
    return (line - returns[:, 0]) / np.abs(line) - 0.3


END = "return after the last round, less 90 % of the real line, in units of that line"
MEAN = "difference of the mean return over the rounds"
CLAIMS = [
    Claim("pendulum, shallow", "RGAT does well with a shallow policy", "5a", END, reaches("rgat")),
    Claim("pendulum, shallow", "GAT does well with a shallow policy", "5a", END, reaches("gat")),
    Claim("pendulum, deep", "RGAT transfers a deep policy", "5b", END, reaches("rgat")),
    Claim("pendulum, deep", "GAT fails with a deep policy", "5b", f"minus {END}", falls_short("gat"), "no gap is left to a policy that only trains on (arm sim)"),
    Claim("pendulum, deep", "RGAT above GAT with a deep policy", "5b", MEAN, above("rgat", "gat")),
    Claim("pendulum, deep", "RGAT above training on in the raw sim", "5b", MEAN, above("rgat", "sim")),
    Claim("pendulum, deep", "ANE does well on the pendulum (best of four widths)", "text", END, lambda d: reaches(best_width(d))(d)),
    Claim("pendulum, deep", "RGAT with the printed settings transfers a deep policy", "5b", END, reaches("rgat as printed"), "f_psi, units of R_AT, max KL, gamma and width of exploration, all as printed"),
    Claim("pendulum, deep", "solving for delta_a is at least RGAT", "-", MEAN, above("solved", "rgat")),
    Claim("hopper", "RGAT reaches the green line within three rounds", "7", END.replace("the last", "three"), reaches("rgat", 3)),
    Claim("hopper", "GAT barely improves: it stays below the green line", "7", f"minus {END}", falls_short("gat")),
    Claim("hopper", "RGAT above GAT", "7", MEAN, above("rgat", "gat")),
    Claim("hopper", "RGAT above training on in the raw sim", "7", MEAN, above("rgat", "sim")),
    Claim("hopper", "RGAT with the printed settings reaches the green line", "7", END, reaches("rgat as printed"), "f_psi, units of R_AT, max KL, gamma and width of exploration, all as printed"),
    Claim("hopper", "ANE does not transfer (best of four widths)", "text", f"minus {END}", lambda d: falls_short(best_width(d))(d)),
    Claim("hopper", "RGAT is more precise than GAT", "text", "difference of the one-step errors", more_precise),
    Claim("hopper", "precision explains transfer", "text", "rank correlation of small error and return within a seed", precision_explains),
    Claim("hopper", "solving for delta_a is above RGAT", "-", MEAN, above("solved", "rgat")),
    Claim("hopper", "going back to the best policy is above going on", "-", MEAN, above("rgat, rolled back", "rgat")),
    Claim("cheetah", "there is a gap to close at +15 %", "6", "part of the real line that the sim's policy lacks, less 30 %", sim_costs),
    Claim("cheetah", "RGAT above GAT", "6", MEAN, above("rgat", "gat")),
    Claim("cheetah with a gap", "there is a gap to close with weak thighs", "-", "part of the real line that the sim's policy lacks, less 30 %", sim_costs),
    Claim("cheetah with a gap", "RGAT above GAT where there is a gap", "-", MEAN, above("rgat", "gat")),
    Claim("capacity", "shallow policies cannot do Hopper and HalfCheetah", "text", "half the deep policy's return less the shallow one's, in units of the deep one's", shallow_fails),
]  # fmt: skip


def transformer_values(rows, world, model, what):
    """Per-seed numbers of the transformers' own experiment (results/transformers.csv)."""
    of = lambda algo, column: {int(r["seed"]): float(r[column]) for r in rows if (r["world"], r["forward_model"], r["algo"]) == (world, model, algo)}  # fmt: skip
    rgat, gat = of("rgat", what), of("gat", what)
    seeds = sorted(set(rgat) & set(gat))
    if what == "rms_from_identity":
        return np.array([gat[k] - rgat[k] for k in seeds])
    sign = 1 if world.startswith("heavier") else -1
    return np.array([sign * (1 - rgat[k]) for k in sorted(rgat)])


def transformer_claims(rows):
    """Figures 3 and 4: [(claim, values, rows)]."""
    found = []
    for model in ("plain", "residual"):
        for world, text, figure, what, statistic in (
            ("sim-to-self", "RGAT alters actions less than GAT where sim is real", "3", "rms_from_identity", "GAT's RMS distance from the identity less RGAT's"),
            ("heavier (pole 20)", "RGAT weakens actions for a heavier pole", "4", "slope", "1 less the slope of transformed against original action"),
            ("lighter (pole 2)", "RGAT strengthens actions for a lighter pole", "4", "slope", "that slope less 1"),
        ):  # fmt: skip
            claim = Claim("transformers", f"{text} ({model} f_psi)", figure, statistic, None, "f_psi" if what != "slope" else "")  # fmt: skip
            mine = [row for row in rows if row["forward_model"] == model]
            found.append((claim, transformer_values(mine, world, model, what), mine))
    return found


# --- the verdicts ---------------------------------------------------------------------------------


def permutation_p(values):
    """One-sided p of mean(values) > 0 if each sign is a coin's: exact up to 14
    seeds, 100 000 draws beyond."""
    n = len(values)
    if n == 0:
        return float("nan")
    if n <= 14:
        signs = 1 - 2 * ((np.arange(2**n)[:, None] >> np.arange(n)) & 1)
    else:
        signs = np.random.default_rng(0).choice([-1, 1], (100_000, n))
    means = signs @ values / n
    return float(np.mean(means >= values.mean() - 1e-12 * np.abs(values).max()))


def interval(values):
    """Mean and its 95 % interval (Student's t over seeds)."""
    n, mean = len(values), float(np.mean(values)) if len(values) else float("nan")
    if n < 2:
        return mean, float("nan"), float("nan")
    half = float(stats.t.ppf(0.975, n - 1) * np.std(values, ddof=1) / np.sqrt(n))
    return mean, mean - half, mean + half


def holm(p):
    """Holm's correction of p-values (nan: not tested)."""
    p = np.asarray(p, float)
    out, running, tested = p.copy(), 0.0, np.flatnonzero(~np.isnan(p))
    for rank, i in enumerate(tested[np.argsort(p[tested], kind="stable")]):
        running = max(running, min(1.0, (len(tested) - rank) * p[i]))
        out[i] = running
    return out


def verdict(high, p_corrected, n):
    """holds: shown; does not hold: the interval has no room for it;
    undecided: neither, or too few seeds."""
    if n >= FEWEST and p_corrected < 0.05:
        return "holds"
    return "does not hold" if n >= FEWEST and high <= 0 else "undecided"


def table(rounds, judged, transformers):
    """The rows of claims.csv, of every claim that has a seed."""
    experiments, tried = by_experiment(rounds, judged), []
    for claim in CLAIMS:
        data = experiments.get(claim.experiment)
        values = claim.values(data) if data else np.empty(0)
        if len(values):
            tried.append((claim, values, data.version, " ".join(data.commits)))
    for claim, values, rows in transformer_claims(transformers):
        if len(values):
            of = lambda column: " ".join(sorted({row[column] for row in rows}))
            tried.append((claim, values, of("version"), of("commit")))
    tested = [permutation_p(v) if len(v) >= FEWEST else float("nan") for _, v, _, _ in tried]
    out = []
    for (claim, values, version, commit), p, p_corrected in zip(tried, tested, holm(tested)):
        mean, low, high = interval(values)
        numbers = {"value": mean, "low": low, "high": high, "p": p, "p_corrected": p_corrected}  # fmt: skip
        out.append({
            "claim": f"{claim.experiment}: {claim.text}", "figure": claim.figure, "statistic": claim.statistic,
            **{k: f"{v:.4g}" for k, v in numbers.items()}, "seeds": len(values),
            "verdict": verdict(high, p_corrected, len(values)), "choice": claim.choice, "version": version, "commit": commit,
        })  # fmt: skip
    return out


# --- what a reader sees ---------------------------------------------------------------------------


def report(results):
    """Write results/claims.csv, results/rounds.png, and the tables of docs/results.md, from the
    CSVs in a folder."""
    rounds, judged, transformers = (read(results / f"{n}.csv") for n in ("rounds", "judged", "transformers"))  # fmt: skip
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
    for name, made in made.items():  # fmt: skip
        pattern = rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)"
        text = re.sub(pattern, lambda m: m[1] + made + m[2], text, flags=re.DOTALL)
    return text


def claims_markdown(claims):
    lines = ["| claim | figure | value | 95 % interval | seeds | p, corrected | verdict | version |", "|---|---|---|---|---|---|---|---|"]  # fmt: skip
    lines += [
        f"| {c['claim']} | {c['figure']} | {c['value']} | {c['low']} to {c['high']} | {c['seeds']} | {c['p_corrected']} | **{c['verdict']}** | {c['version']} |"
        for c in claims
    ]
    return "\n".join(lines) + "\n"


def rounds_markdown(rounds, judged):
    """A table per experiment: mean ± standard error over seeds of the
    return on real, before and after."""
    out = []
    for name, data in by_experiment(rounds, judged).items():
        out += [f"\n### {name.capitalize()}\n", f"Version {data.version}, commit {', '.join(data.commits)}.", ""]  # fmt: skip
        out += ["| arm | seeds | rounds | before | first round | last round | every seed, last round |", "|---|---|---|---|---|---|---|"]  # fmt: skip
        for arm in data.returns:
            [returns], seeds = data.paired(arm)
            cells = [pm(returns[:, k]) for k in (0, min(1, returns.shape[1] - 1), -1)]
            last = " ".join(f"{v:.0f}" for v in returns[:, -1])
            out.append(f"| {arm} | {len(seeds)} | {returns.shape[1] - 1} | {' | '.join(cells)} | {last} |")  # fmt: skip
        line = data.line()
        if len(line):
            out.append(f"| *trained on real* | {len(line)} | | | | {pm(line)} | {' '.join(f'{v:.0f}' for v in line)} |")  # fmt: skip
    return "\n".join(out) + "\n\n"


def transformers_markdown(rows):
    """What one grounding step makes of actions, mean ± standard error over seeds."""
    groups = defaultdict(list)
    for row in rows:
        groups[row["world"], row["forward_model"], row["algo"]].append(row)
    numbers = "rms_from_identity", "slope", "one_step_error"
    lines = [
        "| real pole | f_ψ | method | seeds | RMS from the identity | slope | one-step error |",
        "|---|---|---|---|---|---|---|",
    ]
    for key, mine in groups.items():
        cells = [pm(np.array([float(row[k]) for row in mine]), 3) for k in numbers]
        lines.append(f"| {' | '.join(key)} | {len(mine)} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def pm(values, digits=0):
    """Mean ± standard error."""
    se = np.std(values, ddof=min(1, len(values) - 1)) / np.sqrt(len(values))
    return f"{np.mean(values):.{digits}f}" + f" ± {se:.{digits}f}" * (len(values) > 1)


def draw(experiments, path):
    """One panel per experiment: mean over seeds and standard error, and the
    line of a policy trained on real."""
    import io

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
            color = COLORS.get(arm, f"C{k % 10}")
            axes.plot(mean, color=color, marker="o", ms=3, label=f"{arm} ({len(seeds)})")
            axes.fill_between(range(len(mean)), mean - se, mean + se, color=color, alpha=0.2, lw=0)
        if len(data.line()):
            axes.axhline(np.mean(data.line()), color="#2e8b57", ls="--", lw=1)
        axes.set(title=f"{name}; version {data.version}", xlabel="grounding step", ylabel="return on real")  # fmt: skip
        axes.title.set_fontsize(9)
        axes.xaxis.get_major_locator().set_params(integer=True)
        axes.legend(fontsize=6, ncols=2)
    image = io.BytesIO()
    figure.savefig(image, format="png", dpi=110)
    write_whole(path, image.getvalue())
