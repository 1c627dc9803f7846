"""Which effects? Scan all candidates, refit the best few (alone and in pairs), keep, drop, swap, until nothing earns its keep.

    search = Search(world, problem, recordings)
    fit = search.run(fit)               # misfit.Fit of the chosen hypothesis
    fit, possible = search.settle(fit)  # the simplest of equals; what else could stand in each effect's place

An effect is added when its gain is significant after correction for the number of candidates (clusters of windows,
scores.wald), when clusters that its value was not fitted to gain too, and when the residual falls noticeably.
"""

import numpy as np

import scores
import shooting
from scan import WORTH, Scan, Trial, at_noise

ALPHA = 0.005  # false-alarm rate of one search, shared between all candidates
# in squared residual: of a parameter; of an effect one level less simple; up to which few windows do not decide between two
PRICE, ODDS, DOUBT = 2.0, 2.0, 8.0
FAR = 2.0  # squared residual over the noise's
SHARE = 0.05  # of what several effects explain together, that one in their place may leave
LESS = 0.03  # share of an effect, from whose absence that of the whole is extrapolated
LEAST_GROWTH, VALLEY = 1.05, 2.0  # of a value that is moved on; times the squared residual, above which both ways lead up
RENEWED, RIVAL = 3, 1.5  # of the refits, the best, whose start states are found anew; times the best's squared residual, of a rival
DOUBTFUL = 3  # candidates that are refitted for their gain alone, where much is left
HOPE = 0.05  # p-value, in the linear look, of a start for a candidate of which another start is significant


class Search(Scan):
    def run(self, fit, most=6, late=False):
        """Additions, drops and swaps from a fit: a Fit. late: nothing is held back until what is simple is exhausted."""
        always, refused, pairs = late, set(), []
        for _ in range(most):
            trials, gram, score, chi2 = self.trials(fit, late)
            self.ranking = self.ranking or trials
            ways = [(fit.hypothesis, p) for p in self.proposals(fit, trials, gram, score, chi2) + pairs] + self.swaps(fit)
            ways = [(rest, p) for rest, p in ways if frozenset(c for c, _ in p) not in refused]
            hypotheses, proposals = [rest for rest, _ in ways], [p for _, p in ways]
            for i, proposal in enumerate(proposals):
                for candidate, start in proposal:
                    hypotheses[i] = hypotheses[i].plus(candidate, start)
            fits = shooting.solve(self.small, hypotheses, fit.subset(self.few), iterations=4)
            fits = self.renewed(fits, self.small)
            chosen = self.choose(fit, fits, proposals) if proposals else None
            if chosen is None and late:
                break
            if chosen is None:
                late, refused = True, {frozenset(c for c, _ in p) for p in proposals}
            elif len(chosen[1]) > 1 and not late:  # one of the flexible may do alone what this pair does
                late, pairs = True, [[(c, chosen[0].hypothesis.settings[c]) for c in chosen[1]]]
            else:
                late, refused, pairs = always, set(), []
                fit, added = chosen
                fit = shooting.renewed(self.problem, fit)
                fit = self.drop(self.stretched(fit, added) if self.coarse else fit, added)
        return fit

    def proposals(self, fit, trials, gram, score, chi2, looks=12, singles=5, doubles=2):
        """What to refit: [[(candidate, start)], ..., [(candidate, start), (candidate, start)], ...].

        Single effects by what they leave at full size, where what is alike in a small step may differ, and by the linear
        estimate in turn, no two of them alike; pairs by the linear estimate, where it promises much more than any single effect.
        """
        level, worth = ALPHA / self.places, self.worth(fit)
        fair = [t for t in trials if t.start and t.p_value < HOPE and t.held > 0 and t.gain > 0.3 * worth * chi2]
        promising = {t.option.candidate for t in fair if t.p_value < 10 * level}
        if self.leaves_much(fit):  # a few windows whose start states stuck may scatter more than the others gain
            promising |= set(list(dict.fromkeys(t.option.candidate for t in fair))[:DOUBTFUL])
        hopeful = [t for t in fair if t.option.candidate in promising][:looks] + self.leaps(fit)
        left = self.left(fit, [fit.hypothesis.plus(t.option.candidate, t.start) for t in hopeful])
        chosen, by_size = [], sorted(range(len(left)), key=left.__getitem__)
        for i in (i for both in zip(by_size, range(len(left))) for i in both):  # the linear estimate moves the others along
            rivals = [j for j in chosen if self.alike(hopeful[i], hopeful[j], gram) and left[i] > 0.9 * left[j]]
            if len(chosen) < singles and i not in chosen and not rivals:
                chosen.append(i)
        same = lambda i: [j for j in by_size if self.alike(hopeful[i], hopeful[j], gram) and left[j] < (1 + WORTH) * left[i]]
        chosen = [min(same(i), key=lambda j: simplicity(hopeful[j].option.candidate)) for i in chosen]
        chosen += [i for i in by_size if not hopeful[i].columns and i not in chosen][:1]  # start states soon stick at such a place
        out = [[(hopeful[i].option.candidate, hopeful[i].start)] for i in chosen]
        best = max((t.gain for t in trials if t.start), default=0.0)
        return out + [list(pair) for gain, *pair in self.pairs(trials, gram, score, doubles)
                      if gain > best + max(2 * worth * chi2, 0.1 * best)]

    def renewed(self, fits, problem):
        """Fits of a problem, the best of them with start states found anew where none reaches the noise: they may have stuck on
        the way, as feet and balls bounce, and decide between rivals."""
        order = sorted(range(len(fits)), key=lambda i: fits[i].chi2.sum())[:RENEWED]
        if not self.coarse:
            order = [i for i in order if fits[i].chi2.sum() < RIVAL * fits[order[0]].chi2.sum()]
        if order and not at_noise(problem, fits[order[0]]) and (self.coarse or len(order) > 1):
            for i in order:
                fits[i] = shooting.renewed(problem, fits[i], most=1)
        return fits

    def stretched(self, fit, added, most=12):
        """A fit with the values of added effects moved on together, or back, while that leaves less with start states found anew:
        where predictions jump, a step of all at once ends at the next jump."""
        growth = 2.0
        for _ in range(most):
            if growth < LEAST_GROWTH or at_noise(self.problem, fit):
                break
            tried = [stretch(fit.hypothesis, added, factor) for factor in (growth, 1 / growth)]
            led = shooting.follow(self.problem, shooting.evaluate(self.problem, tried, fit), iterations=2)
            best = min((f.better(shooting.fit_starts(self.problem, f.hypothesis, sharp=False)) for f in led), key=lambda f: f.chi2.sum())
            if best.chi2.sum() < (1 - shooting.STUCK) * fit.chi2.sum():
                fit = best
            else:
                growth **= 0.5 if best.chi2.sum() < VALLEY * fit.chi2.sum() else 0.25
        return fit

    def swaps(self, fit):
        """Effects without gradient for which a simpler one may stand: [(the hypothesis without that, [(the other, its best start)]), ...]."""
        if fit.chi2.sum() < (1 + WORTH) * self.freedom:  # nothing is left for them to explain
            return []
        tried = []
        for candidate in fit.hypothesis.candidates:
            akin, rest = set(self.world.related(candidate)) - set(fit.hypothesis.candidates), fit.hypothesis.minus(candidate)
            for o in (o for o in self.options if o.candidate in akin and o.candidate.effect.overrides("probes")):
                n = o.candidate.effect.amplitudes if same_unit(candidate, o.candidate) else 0
                for probe in o.directions:  # as large as what it replaces
                    start = [fit.hypothesis.settings[candidate][0] / probe[0] * x for x in probe[:n]] + list(probe[n:])
                    tried.append((rest, o.candidate, tuple(start)))
        best = {}
        for i in np.argsort(self.left(fit, [rest.plus(*other) for rest, *other in tried])):
            rest, candidate, start = tried[i]
            best.setdefault((rest, candidate), (rest, [(candidate, start)]))
        return list(best.values())

    def left(self, fit, hypotheses):
        """What hypotheses leave of the scouts as they stand, start states following: [squared residual]."""
        begun = shooting.evaluate(self.scouting, hypotheses, fit.subset(self.scouts))
        return [f.chi2.sum() for f in shooting.follow(self.scouting, begun, iterations=2)]

    def leaps(self, fit, most=3):
        """Far values that leave less than a fit at once, as Trials; sought where it leaves much, for no small step leads there."""
        if not self.leaves_much(fit):
            return []
        far = [o for o in self.options if not (o.linear or o.candidate.effect.overrides("probes"))
               and o.candidate not in fit.hypothesis.candidates]
        warm = fit.subset(self.scouts)
        tried = [fit.hypothesis.plus(o.candidate, o.directions[0]) for o in far]
        gain = [warm.chi2.sum() - f.chi2.sum() for f in shooting.evaluate(self.scouting, tried, warm)]
        best = [i for i in np.argsort(gain)[::-1][:most] if gain[i] > self.worth(fit) * warm.chi2.sum()]
        return [Trial(far[i], gain[i], 0.0, gain[i], far[i].directions[0], [], range(0), np.zeros(0), warm.chi2.sum()) for i in best]

    def leaves_much(self, fit):
        """Whether a fit stays far above the noise."""
        return fit.chi2.sum() > FAR * self.freedom

    def choose(self, fit, fits, proposals):
        """The hypothesis that wins, refitted to all windows, as (Fit, added candidates); None when none earns its keep."""
        level, before, worth = ALPHA / self.places, fit.chi2[self.few].sum(), self.worth(fit)
        left, size = np.array([f.chi2.sum() for f in fits]), [sum(len(c.parameters) for c, _ in p) for p in proposals]
        price = PRICE * left.min() * len(self.problem.windows) / len(self.few) / self.freedom
        order = sorted(range(len(fits)), key=lambda i: left[i] + price * size[i])
        # a pair wins only over what the best single leaves for a second step, unless that has as many parameters
        single = next((i for i in order if len(proposals[i]) == 1), None)
        if single is not None and len(proposals[order[0]]) == 2:
            if size[single] < size[order[0]] and fits[order[0]].chi2.sum() > 0.7 * fits[single].chi2.sum():
                order.remove(single)
                order.insert(0, single)
        for i in order[:3]:
            added = tuple(candidate for candidate, _ in proposals[i])
            if 1 - fits[i].chi2.sum() / before < 0.5 * worth * len(added):
                continue
            [new] = self.renewed(shooting.solve(self.problem, [fits[i].hypothesis], fit, iterations=4), self.problem)
            needed = worth * sum(len(c.parameters) if c.effect.simplicity > 2 else 1 for c in added)
            if not new.hypothesis.possible or 1 - new.chi2.sum() / fit.chi2.sum() < needed or not self.shared(fit, new, worth):
                continue
            if max(self.significance(new, c)[0] for c in added) < level:
                return new, added
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
        """Leave out earlier effects that no longer earn their keep, now that the others may take their part."""
        while True:
            earlier = {c: self.significance(fit, c) for c in fit.hypothesis.candidates if c not in added}
            worth, level = self.worth(fit), ALPHA / self.places
            weak = [c for c, (p, cost) in earlier.items() if cost < 3 * worth or p > level]
            weak += self.replaced(fit, [c for c in earlier if c not in weak], added)
            for candidate in sorted(weak, key=lambda c: earlier[c][1]):
                less = self.without(fit, candidate)
                if less.chi2.sum() < (1 + worth * (1 if earlier[candidate][0] < level else 3)) * fit.chi2.sum():
                    fit = less
                    break
            else:
                return fit

    def replaced(self, fit, earlier, added):
        """Which earlier effects the added ones can do without, by refits on few windows: far from here no small step tells."""
        if not added:
            return []
        small = fit.subset(self.few)
        fits = shooting.solve(self.small, [fit.hypothesis.minus(c) for c in earlier], small, iterations=4)
        return [c for c, f in zip(earlier, fits) if f.chi2.sum() < (1 + self.worth(fit)) * small.chi2.sum()]

    def without(self, fit, candidate):
        """A fit with a candidate left out; what then has to go far away may begin there."""
        less = fit.hypothesis.minus(candidate)
        both = {o.candidate for o in self.options if o.linear} & set(less.candidates)
        far = [less.plus(o.candidate, o.directions[0]) for o in self.options if not o.linear and o.candidate in both]
        few = shooting.solve(self.small, [less] + far, fit.subset(self.few), iterations=4)
        best = min(few, key=lambda f: f.chi2.sum())
        return shooting.solve(self.problem, [best.hypothesis], fit, iterations=4)[0]

    def settle(self, fit, but=()):
        """Name every effect by the best that can stand in its place, the simplest where several do as well.

        Returns (fit, {candidate: [(error ratio, candidate, values), ...]}): what else is possible, best first.
        """
        fit, possible = fit if but else self.united(fit), {}
        for candidate in fit.hypothesis.candidates:
            if candidate in but:
                continue
            small = fit.subset(self.few)
            others, pair = self.alternatives(fit, small, candidate)
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
            first = min(simplicity(c)[:2] for _, c in equals)
            best, name = self.likeliest(fit, [e for e in equals if simplicity(e[1])[:2] == first])
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

    def united(self, fit, most=3):
        """The fit, or one with a single effect where several at one joint, its body or motor together only looked like it, and what
        else then is needed."""
        for joint in range(self.model.njnt):
            near = lambda candidate: joint in (self.world.joints(candidate.place) or ())
            several = [c for c in fit.hypothesis.candidates if near(c)]
            if len(several) < 2:
                continue
            rest, small = fit.hypothesis.minus(*several), fit.subset(self.few)
            fewer = lambda candidate: len(candidate.parameters) < sum(len(c.parameters) for c in several)
            tried = [rest.plus(o.candidate, o.directions[0]) for o in self.options
                     if near(o.candidate) and o.candidate not in several and fewer(o.candidate)]
            start = {}
            for i in np.argsort(self.left(fit, tried)):
                start.setdefault(tried[i].candidates[-1], tried[i])
            best = sorted(shooting.solve(self.scouting, list(start.values()), fit.subset(self.scouts), iterations=3), key=lambda f: f.chi2.sum())
            bare, *fits = shooting.solve(self.small, [rest] + [f.hypothesis for f in best[:most]], small, iterations=4)
            one = min((f for f in fits if f.hypothesis.possible), key=lambda f: f.chi2.sum(), default=bare)
            if one.chi2.sum() < small.chi2.sum() + SHARE * (bare.chi2.sum() - small.chi2.sum()):
                [new] = shooting.solve(self.problem, [one.hypothesis], fit, iterations=4)
                new = self.run(new)
                if new.chi2.sum() < (1 + WORTH) * fit.chi2.sum():
                    fit = new
        return fit

    def likeliest(self, fit, rivals, most=3):
        """The likeliest of rivals [(Fit on few windows, candidate)] of equally many parameters, refitted to all windows."""
        scale = fit.chi2.sum() / self.freedom  # what a squared residual is worth, whatever the noise was thought to be
        odds = lambda fits, among: [f.chi2.sum() / scale + ODDS * c.effect.simplicity + self.wide(c) for f, (_, c) in zip(fits, among)]
        few = odds([f for f, _ in rivals], rivals)
        rivals = [rivals[i] for i in np.argsort(few, kind="stable")[:most] if few[i] < min(few) + DOUBT]
        if len(rivals) == 1:
            return rivals[0]
        fits = shooting.solve(self.problem, [f.hypothesis for f, _ in rivals], fit, iterations=3)
        return rivals[int(np.argmin(np.round(odds(fits, rivals), 1)))]

    def wide(self, candidate):
        """1 at a geom of the world, which many others may touch, else 0: the same at what touches it says less."""
        return int(candidate.place.kind == "geom" and self.model.geom_bodyid[self.model.geom(candidate.place.name).id] == 0)

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

    def alternatives(self, fit, small, candidate, most=6):
        """What can stand in a candidate's place, on few windows: [(Fit, other candidate)], and a promising pair or None.

        small: the fit's part on few windows.

        To first order: the residual that the effect's absence would leave, explained by the columns of others.
        """
        values = small.hypothesis.settings[candidate]
        without = small.hypothesis.minus(candidate)
        own = [{**s, candidate: values} for s in shooting.perturbed(without)[0]]
        akin = set(self.world.related(candidate))
        options = [o for o in self.options if o.candidate not in small.hypothesis.candidates
                   and (o.linear or o in self.kept or o.candidate in akin)]
        # absence is extrapolated from a little less, unless the effect is a limit: unstable motion is soon not linear
        nominal, less = np.array(candidate.nominal), without.settings
        finite = np.isfinite(nominal).all()
        if finite:
            less = without.plus(candidate, nominal + (1 - LESS) * (np.array(values) - nominal)).settings
        known = {o: columns[self.few] for o, (at, columns) in self.looked.items() if at is fit}
        slope = self.stacked(self.small, small, own + [less], options, known)
        slope[..., len(own)] *= 1 / LESS if finite else 1.0
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
        hypotheses, same, seen = [], [], set()
        for chi2, option, _, start in singles:
            stands = len(seen) < 2 * most and alone - chi2 > 0.5 * (alone - now)
            if option.candidate not in seen and (stands or option.candidate in akin):
                hypotheses.append(without.plus(option.candidate, start))
                same.append(chi2 < now + max(LESS * (alone - now), WORTH * now))
                seen.add(option.candidate)
        for option in options:  # of a contact's two geoms, or a joint's two frictions, one hides the other's part: columns say nothing
            other, n = option.candidate, len(option.candidate.parameters)
            twin = other.effect is candidate.effect and candidate.place.kind == "geom"
            if option.linear and (twin or n == 1 and other in akin and same_unit(candidate, other)):
                start = np.clip(values[:n], [p.low for p in other.parameters], [p.high for p in other.parameters])
                hypotheses.append(without.plus(other, start))
                same.append(False)
        # a first look at full size, where what is alike in a small step may differ, and the other way round
        looks = [shooting.project(self.small, f, np.zeros(f.residual.shape + (0,))).chi2.sum()
                 for f in shooting.evaluate(self.small, hypotheses, small)]
        order = sorted(range(len(looks)), key=looks.__getitem__)[:most]
        order = [i for i in order if same[i] or looks[i] < now + 0.5 * (alone - now)]
        if self.leaves_much(fit):  # where no model reaches the noise, related ones may predict as well
            order += [i for i in range(len(looks)) if i not in order and hypotheses[i].candidates[-1] in akin]
        hypotheses = [hypotheses[i] for i in order]
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
        best = {}
        for f in sorted((f for f in fits if f.hypothesis.possible), key=lambda f: f.chi2.sum()):
            best.setdefault(f.hypothesis.candidates[-1], f)
        return [(f, c) for c, f in best.items()], pair


def stretch(hypothesis, candidates, factor):
    """A hypothesis with the distances of some candidates' values from the nominal ones times a factor, inside their bounds."""
    for c in candidates:
        values, nominal = np.array(hypothesis.settings[c]), np.array(c.nominal)
        n = c.effect.amplitudes or len(values)  # the others of an effect without gradient say where it acts, not how much
        origin = np.where(np.isfinite(nominal), nominal, 0.0)
        moved = np.where(np.arange(len(values)) < n, origin + factor * (values - origin), values)
        hypothesis = hypothesis.plus(c, np.clip(moved, [p.low for p in c.parameters], [p.high for p in c.parameters]))
    return hypothesis


def same_unit(one, other):
    """Whether two candidates' first parameters have the same unit, so that the one's value is a start for the other's."""
    return one.parameters[0].unit == other.parameters[0].unit


def simplicity(candidate):
    """What to prefer among effects that the data cannot tell apart: the simulator's own step, then few parameters."""
    return candidate.effect.name != "time_step", len(candidate.parameters), candidate.effect.simplicity
