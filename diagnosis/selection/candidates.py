"""Which effects could explain what a fit leaves? One linear look at every option: gain, significance, where a refit may start.

    scan = Scan(world, problem, recordings)
    trials, gram, score, chi2 = scan.trials(fit)        # best first
    p_value, cost = scan.significance(fit, candidate)   # of an effect that a fit holds

Columns are differences of simulations, with start states and the fit's own parameters projected out (shooting.project);
what is significant is measured between clusters of windows (scores).
"""

from dataclasses import dataclass, replace

import numpy as np

from diagnosis.estimation import cluster_scores, multiple_shooting, residuals
from diagnosis.estimation import windows as cut

WORTH, WORTH_MISFIT = (
    0.03,
    0.1,
)  # least fall of the squared residual that an effect must bring; where it is far above the noise
FLEXIBLE = "inertia", "nonlinear_stiffness"  # with many ways to bend, they too come late
PROMISING = 12  # options, at least, that are looked at anew after every addition
COARSE = 10.0  # times the usual steps of parameters, where small ones see jumps alone
NEARER, LEAST = (
    0.3,
    0.01,
)  # share of a far value, up to which a refit starts between it and the nominal one; below which not at all
NEARLY = 1.1  # squared residual over the noise's, up to which nothing need be left
FEW = 16  # windows, at least, of a refit that only has to tell hypotheses apart


@dataclass(frozen=True)
class Option:
    """A way to try a candidate: columns along `directions` (values at which to simulate), refitted from `start`."""

    candidate: object
    directions: tuple
    linear: bool  # the linear estimate is a good start; else the direction itself is


@dataclass
class Trial:
    """An option's score: gain in chi2, p-value, gain in unseen clusters, where to start a refit."""

    option: Option
    gain: float
    p_value: float
    held: float
    start: tuple  # None where the estimate points out of the bounds
    columns: list  # of the scan, the first of the option at `where`
    where: range
    value: np.ndarray
    chi2: float  # before


def freedom(problem):
    """Measured rows that start states do not take up."""
    return max(problem.rows - problem.taken.sum(), 1)


def at_noise(problem, fit):
    """Whether a fit leaves hardly more than the noise does."""
    return fit.chi2.sum() <= NEARLY * freedom(problem)


def unseen(world, place, recordings):
    """Whether a place is a joint whose motion was never measured: nothing tells where its probes should lie."""
    if place.kind != "joint":
        return False
    q = world.model.jnt_qposadr[world.model.joint(place.name).id]
    return not any(np.isfinite(r.qpos[:, q]).sum() > 1 for r in recordings)


def options_of(world, recordings, coarse=1.0):
    """Every way to try every candidate, with `coarse` times the usual steps. Effects with probes have no gradient at their nominal value."""
    out = []
    for candidate in world.candidates:
        if (
            candidate.effect.timed or candidate.place.kind == "sensor"
        ):  # no residual holds sensors other than the joints'
            continue
        if candidate.effect.overrides("probes") and unseen(world, candidate.place, recordings):
            continue
        candidate = world.suited(candidate, recordings)
        if coarse != 1:
            candidate = replace(
                candidate,
                parameters=tuple(replace(p, step=coarse * p.step) for p in candidate.parameters),
            )
        if candidate.effect.overrides("probes"):
            rows, n = (
                [tuple(float(v) for v in row) for row in world.probes(candidate, recordings)],
                candidate.effect.together,
            )
            out += [
                Option(candidate, tuple(rows[k : k + n]), False) for k in range(0, len(rows), n)
            ]
        else:
            moved = multiple_shooting.perturbed(
                residuals.Hypothesis(((candidate, candidate.nominal),))
            )[0]
            out.append(Option(candidate, tuple(m[candidate] for m in moved), True))
            out += [
                Option(candidate, (values,), False) for values in world.far(candidate, recordings)
            ]
    return out


class Scan:
    def __init__(self, world, problem, recordings, coarse=False):
        """coarse: with larger steps, as where predictions jump."""
        self.world, self.model, self.problem, self.recordings, self.coarse = (
            world,
            world.model,
            problem,
            recordings,
            coarse,
        )
        self.options = options_of(world, recordings, COARSE if coarse else 1.0)
        self.freedom = freedom(problem)
        # refits that only have to tell hypotheses apart use some of the windows
        self.few = cut.evenly(len(problem.windows), max(FEW, len(problem.windows) // 4))
        self.small = problem.subset(self.few)
        self.scouts = self.few[::2]
        self.scouting = problem.subset(self.scouts)
        self.places = len({o.candidate for o in self.options})
        labels = cluster_scores.clusters(problem.windows)
        count = labels.max() + 1
        many = (
            len(cut.recordings_of(problem.windows)) >= cluster_scores.MANY
        )  # they are the clusters then, whole
        self.pieces = (
            1 if many or count >= 16 else min(-(-16 // count), max(problem.weight.shape[1] // 4, 1))
        )
        if self.pieces > 1:
            labels = np.arange(len(problem.windows) * self.pieces)
        self.labels = labels
        by_window = labels.reshape(len(problem.windows), self.pieces)
        self.few_labels = np.unique(by_window[self.few].ravel(), return_inverse=True)[1]
        self.scout_labels = np.unique(by_window[self.scouts].ravel(), return_inverse=True)[1]
        self.ranking, self.kept = [], set()
        self.looked = {}  # {option: (fit, its columns there)}
        self.scouted = None, None, {}  # fit, its part on the scouts, {option: its columns there}

    def worth(self, fit):
        """Least fall of the squared residual: more where no hypothesis comes near the noise, and small gains mean little."""
        return WORTH if fit.chi2.sum() < 4 * self.problem.rows else WORTH_MISFIT

    @staticmethod
    def stacked(problem, fit, settings, options, known):
        """Columns of settings, then of options, at a fit: (W, m, K). known {option: columns} spares simulating, and grows."""
        new = [o for o in options if o not in known]
        tried = [fit.hypothesis.plus(o.candidate, d).settings for o in new for d in o.directions]
        slope, at = multiple_shooting.columns(problem, [fit], [settings + tried])[0], len(settings)
        for o in new:
            known[o] = slope[..., at : at + len(o.directions)]
            at += len(o.directions)
        if len(new) == len(options):
            return slope
        return np.concatenate([slope[..., : len(settings)], *(known[o] for o in options)], -1)

    def reduced(self, fit, options, problem):
        """Cluster sums (C, k, k), (C, k) of columns with start states and the fit's own parameters projected out; chi2.

        Columns over all windows are kept: those of the same fit are not simulated again.
        """
        base, whole = multiple_shooting.perturbed(fit.hypothesis)[0], problem is self.problem
        known = (
            {o: columns for o, (_, columns) in self.looked.items()} if whole else self.scouted[2]
        )
        slope = self.stacked(problem, fit, base, options, known)
        if whole:
            self.looked |= {o: (fit, known[o]) for o in options if o not in self.looked}
        scan, labels = (
            multiple_shooting.project(problem, fit, slope, self.pieces),
            self.labels if whole else self.scout_labels,
        )
        gram, score = (
            cluster_scores.summed(labels, scan.gram),
            cluster_scores.summed(labels, scan.score),
        )
        gram, score = self.freed(gram, score, len(base))
        return gram, score, float(scan.chi2.sum())

    @staticmethod
    def freed(gram, score, k):
        """Cluster sums of the columns from k on, with the first k (a fit's own parameters) projected out."""
        if k:
            total, pull = gram.sum(0), score.sum(0)
            size = np.sqrt(np.maximum(np.diag(total)[:k], 1e-300))
            block = total[:k, :k] / size / size[:, None] + 1e-9 * np.eye(k)
            share = np.linalg.solve(block, total[:k, k:] / size[:, None]) / size[:, None]  # (k, K)
            own = np.linalg.solve(block, pull[:k] / size) / size
            # remove what the own parameters take up: residual first, then columns
            score = score - gram[:, :, :k] @ own
            mixed = gram[:, k:, :k]
            score = score[:, k:] - score[:, :k] @ share
            gram = (
                gram[:, k:, k:]
                - mixed @ share
                - np.swapaxes(mixed @ share, 1, 2)
                + share.T @ gram[:, :k, :k] @ share
            )
        return gram, score

    def trials(self, fit, late=True):
        """All options not yet in the hypothesis, best gain first; the cluster sums of their columns; chi2 before.

        Flexible effects that can look like several simple ones (ripples, bends, gaps) come late, when those are exhausted.
        """
        options = [
            o
            for o in self.options
            if o.candidate not in fit.hypothesis.candidates
            and (
                late
                or (o.linear or o.candidate.effect.simplicity < 2)
                and o.candidate.effect.name not in FLEXIBLE
            )
        ]
        options = [o for o in options if o.linear] + self.screened(
            fit, [o for o in options if not o.linear]
        )
        # an option that promises little with the columns it had at an earlier fit is not simulated anew at this one
        older = [o for o in options if o in self.looked and self.looked[o][0] is not fit]
        found = self.scan(fit, older, self.problem)[0] if older else []
        poor = {
            t.option
            for rank, t in enumerate(found)
            if rank >= PROMISING and t.gain <= WORTH / 4 * t.chi2
        }
        self.looked = {
            o: known for o, known in self.looked.items() if o in poor or o not in older
        }  # what was never seen is looked at too
        return self.scan(fit, options, self.problem)

    def screened(self, fit, options, most=16):
        """The most promising of the many probes of effects without gradient, looked at in few windows."""
        if self.scouted[0] is not fit:
            self.scouted = fit, fit.subset(self.scouts), {}
        found, _, _, chi2 = self.scan(self.scouted[1], options, self.scouting)
        out, count = [], {}
        for t in found:
            candidate = t.option.candidate
            if t.gain > WORTH / 3 * chi2 and count.setdefault(candidate, 0) < 4 and len(out) < most:
                count[candidate] += 1
                out.append(t.option)
        self.kept.update(out)
        return out

    def scan(self, fit, options, problem):
        where, at = [], 0
        for option in options:
            where.append(range(at, at + len(option.directions)))
            at += len(option.directions)
        gram, score, chi2 = self.reduced(fit, options, problem)
        own = np.einsum("ckk->k", gram)
        out = []
        for option, mine in zip(options, where):
            columns = [c for c in mine if own[c] > multiple_shooting.UNSEEN]
            if not columns:
                continue
            pick = np.ix_(range(len(gram)), columns, columns)
            value, gain, p, held = cluster_scores.wald_but_one(gram[pick], score[:, columns])
            out.append(
                Trial(
                    option,
                    gain,
                    p,
                    float(held.sum()),
                    self.start_of(option, columns, mine, value),
                    columns,
                    mine,
                    value,
                    chi2,
                )
            )
        out.sort(key=lambda t: -t.gain)
        return out, gram, score, chi2

    def start_of(self, option, columns, where, value):
        """Parameter values of the linear estimate inside the bounds; None where it points out of them."""
        parameters = option.candidate.parameters
        nominal = np.array([p.nominal for p in parameters])
        low, high = np.array([p.low for p in parameters]), np.array([p.high for p in parameters])
        rows = [np.array(option.directions[c - where[0]]) for c in columns]
        if not option.linear:
            (probe, amount), n = (
                option.candidate.effect.merged(rows, value),
                option.candidate.effect.amplitudes,
            )
            if n:  # in proportion to these it is linear; a ripple may be turned round, friction may not
                start = np.r_[np.clip(amount * np.array(probe[:n]), low[:n], high[:n]), probe[n:]]
                return tuple(start) if start[0] else None
            if (
                NEARER < amount
                or not np.isfinite(nominal).all()
                or option.candidate.effect.overrides("probes")
            ):
                return tuple(probe) if amount > 0.05 else None
            return (
                tuple(np.clip(nominal + amount * (np.array(probe) - nominal), low, high))
                if amount > LEAST
                else None
            )
        move = sum(v * (row - nominal) for v, row in zip(value, rows))
        start = np.clip(nominal + move, low, high)
        if np.all(np.abs(start - nominal) < 1e-3 * np.abs(move)):
            return None
        return tuple(start)

    def pairs(self, trials, gram, score, most=2):
        """The best pairs of options, each as [gain, (candidate, start), (candidate, start)]; no two of them alike.

        An option of several columns takes part with their best single combination.
        """
        if not trials:
            return []
        total, pull = gram.sum(0), score.sum(0)
        mix = np.zeros((len(total), len(trials)))
        for i, t in enumerate(trials):
            mix[t.columns, i] = t.value
        size = np.sqrt(np.maximum(np.einsum("ki,kl,li->i", mix, total, mix), 1e-300))
        near, push = mix.T @ total @ mix / size / size[:, None], mix.T @ pull / size
        apart = np.maximum(1 - near**2, 1e-300)
        gains = (push[:, None] ** 2 - 2 * near * np.outer(push, push) + push**2) / apart
        same = np.array(
            [[a.option.candidate == b.option.candidate for b in trials] for a in trials]
        )
        gains[same | (apart < 1e-3)] = -np.inf
        out, used = [], []
        for flat in np.argsort(-gains, axis=None)[: 20 * most]:
            i, j = np.unravel_index(flat, gains.shape)
            if i >= j or not np.isfinite(gains[i, j]):
                continue
            if any(
                {k for k in (i, j)}
                <= {m for m in range(len(trials)) if np.abs(near[m, u]).max() > 0.99}
                for u in used
            ):
                continue
            amounts = (
                np.array([push[i] - near[i, j] * push[j], push[j] - near[i, j] * push[i]])
                / apart[i, j]
                / size[[i, j]]
            )
            pair = []
            for k, amount in zip((i, j), amounts):
                t = trials[k]
                pair.append(
                    (
                        t.option.candidate,
                        self.start_of(t.option, t.columns, t.where, amount * np.asarray(t.value)),
                    )
                )
            if all(start is not None for _, start in pair):
                out.append([float(gains[i, j]), *pair])
                used.append([i, j])
            if len(out) == most:
                break
        return out

    @staticmethod
    def alike(one, other, gram):
        """Whether two trials have the same column, or try the same candidate."""
        if one.option.candidate == other.option.candidate:
            return True
        if not len(one.columns) == len(other.columns) == 1:
            return False
        total, i, j = gram.sum(0), one.columns[0], other.columns[0]
        return abs(total[i, j]) > 0.998 * np.sqrt(total[i, i] * total[j, j])

    def whole(self, fit, candidate):
        """Gram and score sums by cluster of the columns [other parameters..., the whole effect from fitted to absent], those
        left out that show nothing; chi2; and whether the whole effect shows anything.

        The whole effect as one column needs no derivative, which limits and delays lack.
        """
        values = dict(fit.hypothesis.effects)[candidate]
        without = fit.hypothesis.minus(candidate)
        rest = [{**s, candidate: values} for s in multiple_shooting.perturbed(without)[0]]
        slope = multiple_shooting.columns(self.problem, [fit], [rest + [without.settings]])[0]
        scan = multiple_shooting.project(self.problem, fit, slope, self.pieces)
        gram, score = (
            cluster_scores.summed(self.labels, scan.gram),
            cluster_scores.summed(self.labels, scan.score),
        )
        seen = np.diag(gram.sum(0)) > multiple_shooting.UNSEEN
        return gram[:, seen][:, :, seen], score[:, seen], float(scan.chi2.sum()), bool(seen[-1])

    def significance(self, fit, candidate):
        """(p-value of "this effect is absent" at a fit; relative rise of the squared residual without it), others following."""
        gram, score, chi2, seen = self.whole(fit, candidate)
        k, count = len(candidate.parameters), len(gram)
        if not seen or count <= k + 1:
            return 1.0, 0.0
        variance = cluster_scores.sandwich(gram, score, np.zeros(gram.shape[1]))[
            -1, -1
        ]  # at the optimum scores are leftovers
        statistic = 1 / max(variance, 1e-300) / k * (count - k) / (count - 1)
        total = gram.sum(0)
        own = (
            total[-1, -1]
            - total[-1, :-1] @ cluster_scores.solve_small(total[:-1, :-1], total[:-1, -1])
            if len(total) > 1
            else total[0, 0]
        )
        return cluster_scores.f_survival(statistic, k, count - k), float(own / chi2)

    def slopes(self, fit):
        settings, moves = multiple_shooting.perturbed(fit.hypothesis)
        return multiple_shooting.columns(self.problem, [fit], [settings])[0], moves
