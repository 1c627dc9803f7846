"""The paper's claims, and what the rows that were measured say of each.

Each claim is a number per seed, positive where the claim is so. Its test is a permutation test over
seeds: under no effect each seed's number is as likely with the other sign. p is one-sided and
corrected over all claims that have seeds enough to be tested (Holm). Rows of different versions are
never put together: of each experiment the version with the most runs counts.
"""

from dataclasses import dataclass
from typing import Callable

import numpy as np
from scipy import stats

from training.experiments import WIDTHS, setting
from training.measured import by_experiment

COLUMNS = (
    "claim figure statistic rounds value low high seeds p p_corrected verdict choice version commit"
).split()
FEWEST = 5  # seeds of a claim that is tested: fewer cannot bring p below 0.05
POOLED = "rgat", "gat", "sim", "solved"  # methods that share one learner
REACHED = 0.9  # of the line of a policy trained on real: what counts as reaching it


# --- the claims -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Claim:
    """values(data) -> (seeds,), positive where the claim is so, and after how many rounds;
    choice: what the verdict hangs on."""

    experiment: str
    text: str
    figure: str
    statistic: str
    values: Callable
    choice: str = ""


def reaches(arm, at=-1, share=REACHED):
    """How far the return after a round is above a share of the line of a policy trained on real."""

    def values(data):
        returns, line = data.with_lines(arm)
        last = returns.shape[1] - 1
        at_round = min(at, last) if at > 0 else last
        return (returns[:, at_round] - share * line) / np.abs(line), at_round

    return values


def minus(reached):
    """How far it stays below what `reaches` asks for."""

    def values(data):
        above, rounds = reached(data)
        return -above, rounds

    return values


def falls_short(arm):
    """As `minus` of `reaches`."""
    return minus(reaches(arm))


def above(arm, other):
    """Mean return over the rounds after the first, against another arm, of the seeds in which
    both begin with the same policy: the returns before grounding are equal."""

    def values(data):
        (ours, theirs), _ = data.paired(arm, other)
        same = ours[:, 0] == theirs[:, 0] if len(ours) else slice(0)
        difference = ours[same, 1:] - theirs[same, 1:]
        return difference.mean(1) if len(difference) else np.empty(0), ours.shape[1] - 1

    return values


def best_width(data):
    """The width of the action noise envelope with the best mean return in the
    last round, as the paper reports it."""
    arms = [f"ane {w:g}" for w in WIDTHS if data.returns[f"ane {w:g}"]]
    last = lambda arm: np.mean([returns[-1] for returns in data.returns[arm].values()])
    return max(arms, key=last) if arms else "ane"


def best_width_reaches(data):
    """As `reaches`, of the best width of the action noise envelope."""
    return reaches(best_width(data))(data)


def more_precise(data):
    """How much larger the one-step error is under GAT than under RGAT, mean over rounds."""
    [returns, _], seeds = data.paired("rgat", "gat")
    mean = lambda arm: np.array([np.nanmean(data.errors[arm][seed]) for seed in seeds])
    return mean("gat") - mean("rgat"), returns.shape[1] - 1


def precision_explains(data):
    """Rank correlation, in each seed over methods and rounds, of a small
    one-step error with a high return.

    Pooled are the methods of POOLED that in each seed begin with RGAT's policy and go as many
    rounds: another policy, or more rounds, would move both numbers. The error of an action noise
    envelope is its own noise, so it is none of them."""
    rgat = data.returns["rgat"]
    begins = lambda returns: {seed: (mine[0], len(mine)) for seed, mine in returns.items()}
    arms = [arm for arm in POOLED if begins(data.returns[arm]) == begins(rgat)]
    [returns, *_], seeds = data.paired(*arms)
    rounds = returns.shape[1] - 1
    after = lambda of_arm, seed: np.concatenate([of_arm[arm][seed][1 : rounds + 1] for arm in arms])
    correlation = lambda x, y: stats.spearmanr(x, y).statistic
    both = [(after(data.errors, seed), after(data.returns, seed)) for seed in seeds]
    return np.array([-correlation(*pair) for pair in both]), rounds


def shallow_fails(env):
    """How far a shallow policy trained on a task's real stays below half of what
    a deep one returns there."""

    def values(data):
        (shallow, deep), _ = data.paired(f"{env}, shallow", f"{env}, deep")
        short = (0.5 * deep[:, -1] - shallow[:, -1]) / np.abs(deep[:, -1])
        return short, deep.shape[1] - 1

    return values


def sim_costs(data):
    """The part of the reference line that the sim's policy lacks on real
    before any grounding, less 30 %."""
    returns, line = data.with_lines("sim")
    return (line - returns[:, 0]) / np.abs(line) - 0.3, 0


END = "return after the last round, less 90 % of the real line, in units of that line"
MEAN = "difference of the mean return over the rounds, in seeds that begin with the same policy"
LACK = "part of the real line that the sim's policy lacks, less 30 %"
HALF = "half the deep policy's return less the shallow one's, in units of the deep one's"
SMALL_ERROR = "rank correlation of small error and return within a seed"
NO_GAP = "no gap is left to a policy that only trains on (arm sim)"
AS_PRINTED = (
    "f_psi, units of R_AT, max KL, gamma and width of exploration, all as printed, and the target "
    "policy's TRPO as stable-baselines' defaults, but for batches of 32 environments x 32 steps "
    "and KL accepted up to max KL (there 1 x 1024 and 1.5 x max KL)"
)
FROM_THE_SAME = "which methods are pooled: those of RGAT's learner, policies and number of rounds"
BY_EXPERIMENT = {
    "pendulum, shallow": [
        ("RGAT does well with a shallow policy", "5a", END, reaches("rgat")),
        ("GAT does well with a shallow policy", "5a", END, reaches("gat")),
    ],
    "pendulum, deep": [
        ("RGAT transfers a deep policy", "5b", END, reaches("rgat")),
        ("GAT fails with a deep policy", "5b", f"minus {END}", falls_short("gat"), NO_GAP),
        ("RGAT above GAT with a deep policy", "5b", MEAN, above("rgat", "gat")),
        ("RGAT above training on in the raw sim", "5b", MEAN, above("rgat", "sim")),
        (
            "ANE does well on the pendulum (best of four widths)",
            "text",
            END,
            best_width_reaches,
        ),
        (
            "RGAT with the printed settings transfers a deep policy",
            "5b",
            END,
            reaches("rgat as printed"),
            AS_PRINTED,
        ),
        ("solving for delta_a is at least RGAT", "-", MEAN, above("solved", "rgat")),
    ],
    "hopper": [
        (
            "RGAT is at the green line after three rounds",
            "7",
            END.replace("last", "third"),
            reaches("rgat", 3),
        ),
        (
            "GAT barely improves: it stays below the green line",
            "7",
            f"minus {END}",
            falls_short("gat"),
        ),
        ("RGAT above GAT", "7", MEAN, above("rgat", "gat")),
        ("RGAT above training on in the raw sim", "7", MEAN, above("rgat", "sim")),
        (
            "RGAT with the printed settings reaches the green line",
            "7",
            END,
            reaches("rgat as printed"),
            AS_PRINTED,
        ),
        (
            "ANE does not transfer (best of four widths)",
            "text",
            f"minus {END}",
            minus(best_width_reaches),
        ),
        (
            "RGAT is more precise than GAT",
            "text",
            "difference of the one-step errors",
            more_precise,
        ),
        (
            "precision explains transfer",
            "text",
            SMALL_ERROR,
            precision_explains,
            FROM_THE_SAME,
        ),
        ("solving for delta_a is above RGAT", "-", MEAN, above("solved", "rgat")),
        (
            "going back to the best policy is above going on",
            "-",
            MEAN,
            above("rgat, rolled back", "rgat"),
        ),
    ],
    "cheetah": [
        ("there is a gap to close at +15 %", "6", LACK, sim_costs),
        ("RGAT above GAT", "6", MEAN, above("rgat", "gat")),
    ],
    "cheetah with a gap": [
        ("there is a gap to close with weak thighs", "-", LACK, sim_costs),
        ("RGAT above GAT where there is a gap", "-", MEAN, above("rgat", "gat")),
    ],
    "data": [
        (
            "solving for delta_a from one real episode comes within 5 % of the green line",
            "-",
            END.replace("90", "95"),
            reaches("solved, 1", share=0.95),
        ),
    ],
    "critical": [
        ("max KL 1e-2 fails where 1e-4 learns", "text", MEAN, above(setting(kl=1e-4), setting())),
        ("without entropy it fails", "text", MEAN, above(setting(), setting(entropy=0.0))),
        ("gamma_AT 0.99 above 0", "text", MEAN, above(setting(gamma=0.99), setting())),
    ],
    "capacity": [
        ("shallow policies cannot do Hopper", "text", HALF, shallow_fails("Hopper-v4")),
        ("shallow policies cannot do HalfCheetah", "text", HALF, shallow_fails("HalfCheetah-v4")),
    ],
}
CLAIMS = [Claim(name, *claim) for name, claims in BY_EXPERIMENT.items() for claim in claims]


def transformer_values(rows, world, model, what):
    """Per-seed numbers of the transformers' own experiment (results/transformers.csv)."""

    def of(algo):
        key = world, model, algo
        mine = [r for r in rows if (r["world"], r["forward_model"], r["algo"]) == key]
        return {int(r["seed"]): float(r[what]) for r in mine}

    rgat, gat = of("rgat"), of("gat")
    if what == "rms_from_identity":
        return np.array([gat[k] - rgat[k] for k in sorted(set(rgat) & set(gat))])
    sign = 1 if world.startswith("heavier") else -1
    return np.array([sign * (1 - rgat[k]) for k in sorted(rgat)])


TRANSFORMER_CLAIMS = (  # world, column of transformers.csv, claim, figure, statistic
    (
        *("sim-to-self", "rms_from_identity"),
        "RGAT alters actions less than GAT where sim is real",
        "3",
        "GAT's RMS distance from the identity less RGAT's",
    ),
    (
        *("heavier (pole 20)", "slope"),
        "RGAT weakens actions for a heavier pole",
        "4",
        "1 less the slope of transformed against original action",
    ),
    (
        *("lighter (pole 2)", "slope"),
        "RGAT strengthens actions for a lighter pole",
        "4",
        "that slope less 1",
    ),
)


def transformer_claims(rows):
    """Figures 3 and 4: [(claim, values, rows)]."""
    found = []
    for model in ("plain", "residual"):
        mine = [row for row in rows if row["forward_model"] == model]
        for world, what, text, figure, statistic in TRANSFORMER_CLAIMS:
            choice = "f_psi" if what != "slope" else ""
            told = f"{text} ({model} f_psi)"
            claim = Claim("transformers", told, figure, statistic, None, choice)
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
        values, after = claim.values(data) if data else (np.empty(0), 0)
        if len(values):
            tried.append((claim, values, after, data.version, " ".join(data.commits)))
    for claim, values, rows in transformer_claims(transformers):
        if len(values):
            of = lambda column: " ".join(sorted({row[column] for row in rows}))
            tried.append((claim, values, 1, of("version"), of("commit")))
    tested = [permutation_p(v) if len(v) >= FEWEST else float("nan") for _, v, *_ in tried]
    out = []
    for (claim, values, after, version, commit), p, p_corrected in zip(tried, tested, holm(tested)):
        mean, low, high = interval(values)
        numbers = {"value": mean, "low": low, "high": high, "p": p, "p_corrected": p_corrected}
        row = {
            "claim": f"{claim.experiment}: {claim.text}",
            "figure": claim.figure,
            "statistic": claim.statistic,
            "rounds": after,
            **{k: f"{v:.4g}" for k, v in numbers.items()},
            "seeds": len(values),
            "verdict": verdict(high, p_corrected, len(values)),
            "choice": claim.choice,
            "version": version,
            "commit": commit,
        }
        out.append(row)
    return out
