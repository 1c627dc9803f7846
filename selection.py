"""Which effects? Scan all candidates, refit the best few (alone and in pairs), keep, drop, swap, until nothing earns its keep.

    search = Search(world, problem, recordings)
    fit, steps = search.run()           # shooting.Fit of the chosen hypothesis, one Step per addition
    fit, possible = search.settle(fit)  # the simplest of equals; what else could stand in each effect's place

An effect is added when its gain is significant after correction for the number of candidates (clusters of windows,
scores.wald), when clusters that its value was not fitted to gain too, and when the residual falls noticeably.
"""

from dataclasses import dataclass, field, replace

import numpy as np

import scores
import shooting

ALPHA = 0.005  # false-alarm rate of one search, shared between all candidates
WORTH, WORTH_MISFIT = 0.03, 0.1  # least fall of the squared residual that an effect must bring; where it is far above the noise
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


@dataclass
class Step:
    """One accepted addition: which effects came, and the ranking that led there."""

    added: tuple
    p_value: float
    chi2: float
    ranking: list = field(default_factory=list)


def unseen(world, place, recordings):
    """Whether a place is a joint whose position was never measured: nothing tells where its probes should lie."""
    if place.kind != "joint":
        return False
    q = world.model.jnt_qposadr[world.model.joint(place.name).id]
    return not any(np.isfinite(r.qpos[:, q]).any() for r in recordings)


def options_of(world, recordings):
    """Every way to try every candidate. Effects with probes of their own have no gradient at their nominal value."""
    out = []
    for candidate in world.candidates:
        if candidate.effect.timed or candidate.effect.overrides("probes") and unseen(world, candidate.place, recordings):
            continue
        if candidate.effect.name == "cogging":
            candidate = rippling(world, candidate, recordings)
        if candidate.effect.overrides("probes"):
            out += [Option(candidate, (tuple(float(v) for v in row),), False) for row in world.probes(candidate, recordings)]
        else:
            moved = shooting.perturbed(shooting.Hypothesis(((candidate, candidate.nominal),)))[0]
            out.append(Option(candidate, tuple(m[candidate] for m in moved), True))
            # far from its nominal a mass does not act in proportion; friction that sticks has no gradient at all
            factors = {"mass": (4.0, 20.0), "contact_friction": (0.5, 0.2)}.get(candidate.effect.name, ())
            out += [Option(candidate, ((factor * candidate.nominal[0],),), False) for factor in factors]
    return out


def rippling(world, candidate, recordings):
    """Cogging with at least one whole wave within the recorded travel: less is only a bent spring."""
    address = world.model.joint(candidate.place.name).qposadr[0]
    travel = max(np.nanmax(r.qpos[:, address]) - np.nanmin(r.qpos[:, address]) for r in recordings)
    least = 2 * np.pi / max(travel, 1e-9)
    return replace(candidate, parameters=tuple(replace(p, low=max(p.low, least)) if p.name == "poles" else p for p in candidate.parameters))


class Search:
    def __init__(self, world, problem, recordings, progress=None):
        self.world, self.model, self.problem = world, world.model, problem
        self.options = options_of(world, recordings)
        # refits that only have to tell hypotheses apart use some of the windows
        few = max(FEW, len(problem.windows) // 4)
        self.few = np.unique(np.linspace(0, len(problem.windows) - 1, min(few, len(problem.windows))).round().astype(int))
        self.small = problem.subset(self.few)
        self.scouts = self.few[::2]
        self.scouting = problem.subset(self.scouts)
        self.places = len({o.candidate for o in self.options})
        labels = scores.clusters(problem.windows)
        count = labels.max() + 1
        self.pieces = 1 if count >= 16 else min(-(-16 // count), max(problem.weight.shape[1] // 4, 1))
        if self.pieces > 1:
            labels = np.arange(len(problem.windows) * self.pieces)
        self.labels = labels
        by_window = labels.reshape(len(problem.windows), self.pieces)
        self.few_labels = np.unique(by_window[self.few].ravel(), return_inverse=True)[1]
        self.scout_labels = np.unique(by_window[self.scouts].ravel(), return_inverse=True)[1]
        self.progress = progress or (lambda message: None)
        self.ranking, self.kept = [], set()

    def worth(self, fit):
        """Least fall of the squared residual: more where no hypothesis comes near the noise, and small gains mean little."""
        return WORTH if fit.chi2.sum() < 4 * self.problem.rows else WORTH_MISFIT

    # ---- linear scan ---------------------------------------------------------------------------

    def reduced(self, fit, settings, problem):
        """Cluster sums (C, k, k), (C, k) of columns with start states and the fit's own parameters projected out; chi2."""
        base, moves = shooting.perturbed(fit.hypothesis)
        slope = shooting.columns(problem, [fit], [base + settings])[0]
        scan = shooting.project(problem, fit, slope, self.pieces)
        labels = {id(self.problem): self.labels, id(self.small): self.few_labels, id(self.scouting): self.scout_labels}[id(problem)]
        gram, score = scores.summed(labels, scan.gram), scores.summed(labels, scan.score)
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
            gram = (gram[:, k:, k:] - mixed @ share - np.swapaxes(mixed @ share, 1, 2)
                    + share.T @ gram[:, :k, :k] @ share)
        return gram, score

    def trials(self, fit, late=True):
        """All options not yet in the hypothesis, best gain first; the cluster sums of their columns; chi2 before.

        Flexible effects that can look like several simple ones (ripples, bends, gaps) come late, when those are exhausted.
        """
        options = [o for o in self.options if o.candidate not in fit.hypothesis.candidates
                   and (late or (o.linear or o.candidate.effect.simplicity < 2) and o.candidate.effect.name != "inertia")]
        plain = [o for o in options if o.linear]
        return self.scan(fit, plain + self.screened(fit, [o for o in options if not o.linear]), self.problem)

    def screened(self, fit, options, most=12):
        """The most promising of the many probes of effects without gradient, looked at in few windows."""
        found, _, _, chi2 = self.scan(fit.subset(self.scouts), options, self.scouting)
        out, count = [], {}
        for t in found:
            candidate = t.option.candidate
            if t.gain > WORTH / 3 * chi2 and count.setdefault(candidate, 0) < 2 and len(out) < most:
                count[candidate] += 1
                out.append(t.option)
        self.kept.update(out)
        return out

    def scan(self, fit, options, problem):
        settings, where = [], []
        for option in options:
            where.append(range(len(settings), len(settings) + len(option.directions)))
            settings += [fit.hypothesis.plus(option.candidate, d).settings for d in option.directions]
        gram, score, chi2 = self.reduced(fit, settings, problem)
        own = np.einsum("ckk->k", gram)
        out = []
        for option, mine in zip(options, where):
            columns = [c for c in mine if own[c] > shooting.UNSEEN]
            if not columns:
                continue
            pick = np.ix_(range(len(gram)), columns, columns)
            value, gain, p, held = scores.wald(gram[pick], score[:, columns])
            out.append(Trial(option, gain, p, float(held.sum()), self.start_of(option, columns, mine, value), columns, mine, value, chi2))
        out.sort(key=lambda t: -t.gain)
        return out, gram, score, chi2

    def start_of(self, option, columns, where, value):
        """Parameter values of the linear estimate inside the bounds; None where it points out of them."""
        parameters = option.candidate.parameters
        nominal = np.array([p.nominal for p in parameters])
        low, high = np.array([p.low for p in parameters]), np.array([p.high for p in parameters])
        if not option.linear:
            return option.directions[0] if value[0] > 0.05 else None
        move = sum(v * (np.array(option.directions[c - where[0]]) - nominal) for c, v in zip(columns, value))
        start = np.clip(nominal + move, low, high)
        if np.all(np.abs(start - nominal) < 1e-3 * np.abs(move)):
            return None
        return tuple(start)

    def pairs(self, trials, gram, score, most=2):
        """The best pairs of options, each as [gain, (candidate, start), (candidate, start)]; no two of them alike.

        An option of several columns takes part with their best single combination.
        """
        total, pull = gram.sum(0), score.sum(0)
        mix = np.zeros((len(total), len(trials)))
        for i, t in enumerate(trials):
            mix[t.columns, i] = t.value
        size = np.sqrt(np.maximum(np.einsum("ki,kl,li->i", mix, total, mix), 1e-300))
        near, push = mix.T @ total @ mix / size / size[:, None], mix.T @ pull / size
        apart = np.maximum(1 - near**2, 1e-300)
        gains = (push[:, None] ** 2 - 2 * near * np.outer(push, push) + push**2) / apart
        same = np.array([[a.option.candidate == b.option.candidate for b in trials] for a in trials])
        gains[same | (apart < 1e-3)] = -np.inf
        out, used = [], []
        for flat in np.argsort(-gains, axis=None)[: 20 * most]:
            i, j = np.unravel_index(flat, gains.shape)
            if i >= j or not np.isfinite(gains[i, j]):
                continue
            if any({k for k in (i, j)} <= {m for m in range(len(trials)) if np.abs(near[m, u]).max() > 0.99} for u in used):
                continue
            amounts = np.array([push[i] - near[i, j] * push[j], push[j] - near[i, j] * push[i]]) / apart[i, j] / size[[i, j]]
            pair = []
            for k, amount in zip((i, j), amounts):
                t = trials[k]
                pair.append((t.option.candidate, self.start_of(t.option, t.columns, t.where, amount * np.asarray(t.value))))
            if all(start is not None for _, start in pair):
                out.append([float(gains[i, j]), *pair])
                used.append([i, j])
            if len(out) == most:
                break
        return out

    # ---- nonlinear search ----------------------------------------------------------------------

    def run(self, fit, most=6, singles=5, doubles=2):
        """Additions, drops and swaps from the nominal fit: (Fit, [Step])."""
        steps, late = [], False
        for _ in range(most):
            trials, gram, score, chi2 = self.trials(fit, late)
            if not self.ranking:
                self.ranking = trials
            level, worth = ALPHA / self.places, self.worth(fit)
            hopeful = [t for t in trials if t.start and t.p_value < 10 * level and t.held > 0 and t.gain > 0.3 * worth * chi2]
            proposals = [[(t.option.candidate, t.start)] for t in self.spread(hopeful, gram, singles)]
            best = max((t.gain for t in trials if t.start), default=0.0)
            proposals += [list(pair) for gain, *pair in self.pairs(trials, gram, score, doubles)
                          if gain > best + max(2 * worth * chi2, 0.1 * best)]
            if not proposals and late:
                break
            if not proposals:
                late = True
                continue
            hypotheses = [fit.hypothesis for _ in proposals]
            for i, proposal in enumerate(proposals):
                for candidate, start in proposal:
                    hypotheses[i] = hypotheses[i].plus(candidate, start)
            self.progress(f"refitting {len(hypotheses)} hypotheses")
            fits = shooting.solve(self.small, hypotheses, fit.subset(self.few), iterations=4)
            chosen = self.choose(fit, fits, proposals)
            if chosen is None and late:
                break
            if chosen is None:
                late = True
                continue
            new, added, p = chosen
            steps.append(Step(added, p, float(new.chi2.sum()), trials))
            fit = self.drop(new, added)
        return fit, steps

    def spread(self, trials, gram, number):
        """The best few trials, no two of which have the same column."""
        total, out = gram.sum(0), []
        for t in trials:
            for other in out:
                if len(t.columns) == len(other.columns) == 1:
                    i, j = t.columns[0], other.columns[0]
                    if abs(total[i, j]) > 0.998 * np.sqrt(total[i, i] * total[j, j]):
                        break
            else:
                out.append(t)
            if len(out) == number:
                break
        return out

    def whole(self, fit, candidate):
        """Cluster sums of the columns [other parameters..., the whole effect from fitted to absent], and chi2.

        The whole effect as one column needs no derivative, which limits and delays lack.
        """
        values = dict(fit.hypothesis.effects)[candidate]
        without = fit.hypothesis.minus(candidate)
        rest = [{**s, candidate: values} for s in shooting.perturbed(without)[0]]
        slope = shooting.columns(self.problem, [fit], [rest + [without.settings]])[0]
        scan = shooting.project(self.problem, fit, slope, self.pieces)
        gram, score = scores.summed(self.labels, scan.gram), scores.summed(self.labels, scan.score)
        seen = np.diag(gram.sum(0)) > shooting.UNSEEN
        return gram[:, seen][:, :, seen], score[:, seen], float(scan.chi2.sum()), bool(seen[-1])

    def significance(self, fit, candidate):
        """(p-value of "this effect is absent" at a fit; relative rise of the squared residual without it), others following."""
        gram, score, chi2, seen = self.whole(fit, candidate)
        k, count = len(candidate.parameters), len(gram)
        if not seen or count <= k + 1:
            return 1.0, 0.0
        variance = scores.sandwich(gram, score, np.zeros(gram.shape[1]))[-1, -1]  # at the optimum scores are leftovers
        statistic = 1 / max(variance, 1e-300) / k * (count - k) / (count - 1)
        total = gram.sum(0)
        own = total[-1, -1] - total[-1, :-1] @ scores.solve_small(total[:-1, :-1], total[:-1, -1]) if len(total) > 1 else total[0, 0]
        return scores.f_survival(statistic, k, count - k), float(own / chi2)

    def slopes(self, fit):
        settings, moves = shooting.perturbed(fit.hypothesis)
        return shooting.columns(self.problem, [fit], [settings])[0], moves

    def per_cluster(self, fit):
        per_window = np.repeat(fit.chi2 / self.pieces, self.pieces) if self.pieces > 1 else fit.chi2
        return scores.summed(self.labels, per_window)

    def choose(self, fit, fits, proposals):
        """The hypothesis that wins, refitted to all windows, as (Fit, added candidates, p-value); None when none earns its keep."""
        level, before, worth = ALPHA / self.places, fit.chi2[self.few].sum(), self.worth(fit)
        order = sorted(range(len(fits)), key=lambda i: fits[i].chi2.sum())
        # a pair wins only over what the best single leaves for a second step, unless that has as many parameters
        single = next((i for i in order if len(proposals[i]) == 1), None)
        if single is not None and len(proposals[order[0]]) == 2:
            size = [sum(len(c.parameters) for c, _ in proposals[i]) for i in (single, order[0])]
            if size[0] < size[1] and fits[order[0]].chi2.sum() > 0.7 * fits[single].chi2.sum():
                order.remove(single)
                order.insert(0, single)
        for i in order[:3]:
            added = tuple(candidate for candidate, _ in proposals[i])
            if 1 - fits[i].chi2.sum() / before < 0.5 * worth * len(added):
                continue
            [new] = shooting.solve(self.problem, [fits[i].hypothesis], fit, iterations=4)
            needed = worth * sum(len(c.parameters) if c.effect.simplicity > 2 else 1 for c in added)
            if not solid(new.hypothesis) or 1 - new.chi2.sum() / fit.chi2.sum() < needed or not self.shared(fit, new, worth):
                continue
            p = max(self.significance(new, c)[0] for c in added)
            if p < level:
                return new, added, p
        return None

    def shared(self, fit, new, worth):
        """Whether more than one recording gains, where there are several: what one run alone shows is no lasting effect."""
        owners = [id(w.recording) for w in self.problem.windows]
        before, after = ({o: f.chi2[[i for i, p in enumerate(owners) if p == o]].sum() for o in owners} for f in (fit, new))
        if len(before) < 3:
            return True
        best = max(before, key=lambda o: before[o] - after[o])
        return sum(after[o] for o in after if o != best) < (1 - 0.3 * worth) * sum(before[o] for o in before if o != best)

    def drop(self, fit, added):
        """Leave out earlier effects that no longer earn their keep."""
        while True:
            earlier = {c: self.significance(fit, c) for c in fit.hypothesis.candidates if c not in added}
            worth = self.worth(fit)
            weak = [c for c, (p, cost) in earlier.items() if cost < 3 * worth or p > ALPHA / self.places]
            if not weak:
                return fit
            weakest = min(weak, key=lambda c: earlier[c][1])
            [less] = shooting.solve(self.problem, [fit.hypothesis.minus(weakest)], fit, iterations=4)
            if less.chi2.sum() > (1 + worth) * fit.chi2.sum() and earlier[weakest][0] <= ALPHA / self.places:
                return fit
            fit = less

    def settle(self, fit):
        """Name every effect by the best that can stand in its place, the simplest where several do as well.

        Returns (fit, {candidate: [(error ratio, candidate, values), ...]}): what else is possible, best first.
        """
        possible = {}
        for candidate in fit.hypothesis.candidates:
            small = fit.subset(self.few)
            others, pair = self.alternatives(small, candidate)
            if pair is not None:
                [new] = shooting.solve(self.problem, [pair], fit, iterations=5)
                added = [c for c in pair.candidates if c not in fit.hypothesis.candidates]
                if (new.chi2.sum() < (1 - 2 * WORTH) * fit.chi2.sum()
                        and max(self.significance(new, c)[0] for c in added) < ALPHA / self.places):
                    fit = new
                    possible.update({c: [] for c in added})
                    continue
            near = lambda f, c: simplicity(c)[:2] < simplicity(candidate)[:2] and f.chi2.sum() < (1 + WORTH) * small.chi2.sum()
            equals = [(small, candidate)] + [(f, c) for f, c in others if near(f, c) or not self.worse(f, small)]
            best, name = min(equals, key=lambda e: simplicity(e[1]))
            better = [e for e in equals if self.worse(small, e[0]) and e[0].chi2.sum() < (1 - WORTH) * small.chi2.sum()]
            if better:
                best, name = min(better, key=lambda e: e[0].chi2.sum())
            if name != candidate:
                [new] = shooting.solve(self.problem, [best.hypothesis], fit, iterations=5)
                if new.chi2.sum() < (1 + WORTH) * fit.chi2.sum():
                    others = [(small, candidate)] + [o for o in others if o[1] != name]
                    fit, candidate = new, name
                    small = fit.subset(self.few)
            ratio = lambda f: float(np.sqrt(f.chi2.sum() / small.chi2.sum()))
            listed = [(ratio(f), c, f.hypothesis.settings[c]) for f, c in others]
            possible[candidate] = sorted(listed, key=lambda o: (round(o[0], 2), simplicity(o[1])))
        return fit, possible

    def worse(self, one, other):
        """Whether a fit's squared residual (few windows) lies above another's beyond its scatter between clusters."""
        gap = scores.summed(self.few_labels, self.pieced(one) - self.pieced(other))
        scatter = scores.t_quantile(max(len(gap) - 1, 1)) * np.sqrt(len(gap)) * gap.std(ddof=1 if len(gap) > 1 else 0)
        return gap.sum() > max(scatter, 1e-3 * other.chi2.sum())

    def pieced(self, fit):
        """Squared residual of a fit's windows in pieces, (W * pieces,)."""
        rows, width = self.problem.weight.shape[1:]
        square = (fit.residual[:, :rows * width] ** 2).reshape(-1, rows, width).sum(-1)
        owner = np.arange(rows) * self.pieces // rows
        return np.stack([square[:, owner == i].sum(1) for i in range(self.pieces)], 1).ravel()

    def alternatives(self, small, candidate, most=6):
        """What can stand in a candidate's place, on few windows: [(Fit, other candidate)], and a promising pair or None.

        To first order: the residual that the effect's absence would leave, explained by the columns of others.
        """
        values = small.hypothesis.settings[candidate]
        without = small.hypothesis.minus(candidate)
        own = [{**s, candidate: values} for s in shooting.perturbed(without)[0]]
        options = [o for o in self.options if o.candidate not in small.hypothesis.candidates and (o.linear or o in self.kept)]
        tried = [small.hypothesis.plus(o.candidate, d).settings for o in options for d in o.directions]
        # absence is extrapolated from a tenth less, unless the effect is a limit: unstable motion is soon not linear
        nominal, less = np.array(candidate.nominal), without.settings
        tenth = np.isfinite(nominal).all()
        if tenth:
            less = without.plus(candidate, nominal + 0.9 * (np.array(values) - nominal)).settings
        slope = shooting.columns(self.small, [small], [own + [less] + tried])[0]
        slope[..., len(own)] *= 10.0 if tenth else 1.0
        scan = shooting.project(self.small, small, slope)
        gram, k = scan.gram.sum(0), len(own)
        score = scan.score.sum(0) - gram[:, k]  # of the residual without the effect
        bare = scan.chi2.sum() - 2 * scan.score[:, k].sum() + gram[k, k]
        base = list(range(k))

        def left(columns):
            """Squared residual once these columns and the other effects' have explained what they can; their amounts."""
            columns = [c for c in base + columns if gram[c, c] > shooting.UNSEEN]
            amount = scores.solve_small(gram[np.ix_(columns, columns)], score[columns])
            return bare - score[columns] @ amount, dict(zip(columns, amount))

        singles, at, alone = [], k + 1, left([])[0]
        for option in options:
            columns = list(range(at, at + len(option.directions)))
            at += len(columns)
            chi2, amount = left(columns)
            start = self.start_of(option, columns, columns, [amount.get(c, 0.0) for c in columns])
            if start is not None:
                singles.append((chi2, option, columns, start))
        singles.sort(key=lambda s: s[0])
        now = scan.chi2.sum()
        hypotheses, seen = [], set()
        for chi2, option, _, start in singles:
            if option.candidate not in seen and len(seen) < 2 * most and alone - chi2 > 0.5 * (alone - now):
                hypotheses.append(without.plus(option.candidate, start))
                seen.add(option.candidate)
        # a first look at full size, where what is alike in a small step may differ, and the other way round
        looks = [shooting.project(self.small, f, np.zeros(f.residual.shape + (0,))).chi2.sum()
                 for f in shooting.evaluate(self.small, hypotheses, small)]
        order = sorted(range(len(looks)), key=looks.__getitem__)[:most]
        hypotheses = [hypotheses[i] for i in order if looks[i] < now + 0.5 * (alone - now)]
        pair = None
        pairs = [(left(a[2] + b[2])[0], a, b) for i, a in enumerate(singles[:8]) for b in singles[i + 1:8] if a[1].candidate != b[1].candidate]
        if pairs:
            chi2, a, b = min(pairs, key=lambda p: p[0])
            if chi2 < (1 - 2 * WORTH) * now:
                amount = left(a[2] + b[2])[1]
                starts = [self.start_of(o, c, c, [amount.get(i, 0.0) for i in c]) for _, o, c, _ in (a, b)]
                if None not in starts:
                    pair = without.plus(a[1].candidate, starts[0]).plus(b[1].candidate, starts[1])
        fits = shooting.solve(self.small, hypotheses + ([pair] if pair else []), small, iterations=4)
        if pair:
            last = fits.pop()
            pair = last.hypothesis if last.chi2.sum() < (1 - 2 * WORTH) * small.chi2.sum() else None
        return [(f, f.hypothesis.candidates[-1]) for f in fits], pair


def solid(hypothesis):
    """Whether every inertia is one that a rigid body can have: no principal moment above the sum of the others."""
    return all(2 * max(values) <= sum(values) * (1 + 1e-6) for c, values in hypothesis.effects if c.effect.name == "inertia")


def simplicity(candidate):
    """What to prefer among effects that the data cannot tell apart: the simulator's own step, then few parameters."""
    return candidate.effect.name != "time_step", len(candidate.parameters), candidate.effect.simplicity
