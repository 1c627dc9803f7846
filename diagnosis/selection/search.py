"""Which effects? Scan all candidates, refit the best few (alone and in pairs), keep, drop, swap, until nothing earns its keep.

    search = Search(world, problem, recordings)
    fit = search.run(fit)  # misfit.Fit of the chosen hypothesis

An effect is added when its gain is significant after correction for the number of candidates (clusters of windows,
scores.wald), when clusters that its value was not fitted to gain too, and when the residual falls noticeably.
"""

import numpy as np

from diagnosis.estimation import initial_states, multiple_shooting
from diagnosis.selection.candidates import WORTH, Scan, Trial, at_noise

ALPHA = 0.005  # false-alarm rate of one search, shared between all candidates
PRICE = 2.0  # of a parameter, in squared residual
FAR = 2.0  # squared residual over the noise's
LEAST_GROWTH, NUDGE = 1.05, 1.3  # of a value that is moved on; to begin with, in a plain search
VALLEY = 2.0  # times the squared residual, above which both ways lead up
RENEWED, RIVAL = (
    3,
    1.5,
)  # of the refits, the best, whose start states are found anew; times the best's squared residual, of a rival
DOUBTFUL = 3  # candidates that are refitted for their gain alone, where much is left
HOPE = 0.05  # p-value, in the linear look, of a start for a candidate of which another start is significant


class Search(Scan):
    def run(self, fit, most=6, late=False):
        """Additions, drops and swaps from a fit: a Fit. late: nothing is held back until what is simple is exhausted."""
        always, refused, pairs = late, set(), []
        for _ in range(most):
            trials, gram, score, chi2 = self.trials(fit, late)
            self.ranking = self.ranking or trials
            ways = [
                (fit.hypothesis, p) for p in self.proposals(fit, trials, gram, score, chi2) + pairs
            ] + self.swaps(fit)
            ways = [(rest, p) for rest, p in ways if frozenset(c for c, _ in p) not in refused]
            hypotheses, proposals = [rest for rest, _ in ways], [p for _, p in ways]
            for i, proposal in enumerate(proposals):
                for candidate, start in proposal:
                    hypotheses[i] = hypotheses[i].plus(candidate, start)
            fits = multiple_shooting.solve(
                self.small, hypotheses, fit.subset(self.few), iterations=4
            )
            fits = self.renewed(fits, self.small)
            chosen = self.choose(fit, fits, proposals) if proposals else None
            if chosen is None and late:
                break
            if chosen is None:
                late, refused = True, {frozenset(c for c, _ in p) for p in proposals}
            elif (
                len(chosen[1]) > 1 and not late
            ):  # one of the flexible may do alone what this pair does
                late, pairs = True, [[(c, chosen[0].hypothesis.settings[c]) for c in chosen[1]]]
            else:
                late, refused, pairs = always, set(), []
                fit, added = chosen
                fit = multiple_shooting.renewed(self.problem, fit)
                fit = self.drop(self.stretched(fit, added) if self.coarse else fit, added)
        for candidate in fit.hypothesis.candidates if not self.coarse else ():
            fit = self.stretched(fit, (candidate,), NUDGE)
        return fit

    def proposals(self, fit, trials, gram, score, chi2, looks=12, singles=5, doubles=2):
        """What to refit: [[(candidate, start)], ..., [(candidate, start), (candidate, start)], ...].

        Single effects by what they leave at full size, where what is alike in a small step may differ, and by the linear
        estimate in turn, no two of them alike; pairs by the linear estimate, where it promises much more than any single effect.
        """
        level, worth = ALPHA / self.places, self.worth(fit)
        fair = [
            t
            for t in trials
            if t.start and t.p_value < HOPE and t.held > 0 and t.gain > 0.3 * worth * chi2
        ]
        promising = {t.option.candidate for t in fair if t.p_value < 10 * level}
        if self.leaves_much(
            fit
        ):  # a few windows whose start states stuck may scatter more than the others gain
            promising |= set(list(dict.fromkeys(t.option.candidate for t in fair))[:DOUBTFUL])
        hopeful = [t for t in fair if t.option.candidate in promising][:looks] + self.leaps(fit)
        left = self.left(fit, [fit.hypothesis.plus(t.option.candidate, t.start) for t in hopeful])
        chosen, by_size = [], sorted(range(len(left)), key=left.__getitem__)
        for i in (
            i for both in zip(by_size, range(len(left))) for i in both
        ):  # the linear estimate moves the others along
            rivals = [
                j
                for j in chosen
                if self.alike(hopeful[i], hopeful[j], gram) and left[i] > 0.9 * left[j]
            ]
            if len(chosen) < singles and i not in chosen and not rivals:
                chosen.append(i)
        same = lambda i: [
            j
            for j in by_size
            if self.alike(hopeful[i], hopeful[j], gram) and left[j] < (1 + WORTH) * left[i]
        ]
        chosen = [
            min(same(i), key=lambda j: simplicity(hopeful[j].option.candidate)) for i in chosen
        ]
        chosen += [i for i in by_size if not hopeful[i].columns and i not in chosen][
            :1
        ]  # start states soon stick at such a place
        out = [[(hopeful[i].option.candidate, hopeful[i].start)] for i in chosen]
        best = max((t.gain for t in trials if t.start), default=0.0)
        return out + [
            list(pair)
            for gain, *pair in self.pairs(trials, gram, score, doubles)
            if gain > best + max(2 * worth * chi2, 0.1 * best)
        ]

    def renewed(self, fits, problem):
        """Fits of a problem, the best of them with start states found anew where none reaches the noise: they may have stuck on
        the way, as feet and balls bounce, and decide between rivals."""
        order = sorted(range(len(fits)), key=lambda i: fits[i].chi2.sum())[:RENEWED]
        if not self.coarse:
            order = [i for i in order if fits[i].chi2.sum() < RIVAL * fits[order[0]].chi2.sum()]
        if order and not at_noise(problem, fits[order[0]]) and (self.coarse or len(order) > 1):
            for i in order:
                fits[i] = multiple_shooting.renewed(problem, fits[i], most=1)
        return fits

    def stretched(self, fit, added, growth=2.0, most=12):
        """A fit with the values of added effects moved on together, or back, while that leaves less with start states found anew:
        where predictions jump, a step of all at once ends at the next jump."""
        for _ in range(most):
            if growth < LEAST_GROWTH or at_noise(self.problem, fit):
                break
            tried = [stretch(fit.hypothesis, added, factor) for factor in (growth, 1 / growth)]
            led = initial_states.follow(
                self.problem, initial_states.evaluate(self.problem, tried, fit), iterations=2
            )
            best = min(
                (
                    f.better(initial_states.fit(self.problem, f.hypothesis, sharp=False))
                    for f in led
                ),
                key=lambda f: f.chi2.sum(),
            )
            if best.chi2.sum() < (1 - multiple_shooting.STUCK) * fit.chi2.sum():
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
            akin, rest = (
                set(self.world.related(candidate)) - set(fit.hypothesis.candidates),
                fit.hypothesis.minus(candidate),
            )
            for o in (
                o
                for o in self.options
                if o.candidate in akin and o.candidate.effect.overrides("probes")
            ):
                n = o.candidate.effect.amplitudes if same_unit(candidate, o.candidate) else 0
                for probe in o.directions:  # as large as what it replaces
                    start = [
                        fit.hypothesis.settings[candidate][0] / probe[0] * x for x in probe[:n]
                    ] + list(probe[n:])
                    tried.append((rest, o.candidate, tuple(start)))
        best = {}
        for i in np.argsort(self.left(fit, [rest.plus(*other) for rest, *other in tried])):
            rest, candidate, start = tried[i]
            best.setdefault((rest, candidate), (rest, [(candidate, start)]))
        return list(best.values())

    def left(self, fit, hypotheses):
        """What hypotheses leave of the scouts as they stand, start states following: [squared residual]."""
        begun = initial_states.evaluate(self.scouting, hypotheses, fit.subset(self.scouts))
        return [f.chi2.sum() for f in initial_states.follow(self.scouting, begun, iterations=2)]

    def leaps(self, fit, most=3):
        """Far values that leave less than a fit at once, as Trials; sought where it leaves much, for no small step leads there."""
        if not self.leaves_much(fit):
            return []
        far = [
            o
            for o in self.options
            if not (o.linear or o.candidate.effect.overrides("probes"))
            and o.candidate not in fit.hypothesis.candidates
        ]
        warm = fit.subset(self.scouts)
        tried = [fit.hypothesis.plus(o.candidate, o.directions[0]) for o in far]
        gain = [
            warm.chi2.sum() - f.chi2.sum()
            for f in initial_states.evaluate(self.scouting, tried, warm)
        ]
        best = [
            i for i in np.argsort(gain)[::-1][:most] if gain[i] > self.worth(fit) * warm.chi2.sum()
        ]
        return [
            Trial(
                far[i],
                gain[i],
                0.0,
                gain[i],
                far[i].directions[0],
                [],
                range(0),
                np.zeros(0),
                warm.chi2.sum(),
            )
            for i in best
        ]

    def gives_up(self, fit):
        """Whether a fit holds nothing although there is more than noise."""
        return not fit.hypothesis.effects and not at_noise(self.problem, fit)

    def leaves_much(self, fit):
        """Whether a fit stays far above the noise."""
        return fit.chi2.sum() > FAR * self.freedom

    def choose(self, fit, fits, proposals):
        """The hypothesis that wins, refitted to all windows, as (Fit, added candidates); None when none earns its keep."""
        level, before, worth = ALPHA / self.places, fit.chi2[self.few].sum(), self.worth(fit)
        left, size = (
            np.array([f.chi2.sum() for f in fits]),
            [sum(len(c.parameters) for c, _ in p) for p in proposals],
        )
        price = PRICE * left.min() * len(self.problem.windows) / len(self.few) / self.freedom
        order = sorted(range(len(fits)), key=lambda i: left[i] + price * size[i])
        # a pair wins only over what the best single leaves for a second step, unless that has as many parameters
        single = next((i for i in order if len(proposals[i]) == 1), None)
        if single is not None and len(proposals[order[0]]) == 2:
            if (
                size[single] < size[order[0]]
                and fits[order[0]].chi2.sum() > 0.7 * fits[single].chi2.sum()
            ):
                order.remove(single)
                order.insert(0, single)
        for i in order[:3]:
            added = tuple(candidate for candidate, _ in proposals[i])
            if 1 - fits[i].chi2.sum() / before < 0.5 * worth * len(added):
                continue
            [new] = self.renewed(
                multiple_shooting.solve(self.problem, [fits[i].hypothesis], fit, iterations=4),
                self.problem,
            )
            needed = worth * sum(len(c.parameters) if c.effect.simplicity > 2 else 1 for c in added)
            if (
                not new.hypothesis.possible
                or 1 - new.chi2.sum() / fit.chi2.sum() < needed
                or not self.shared(fit, new, worth)
            ):
                continue
            if max(self.significance(new, c)[0] for c in added) < level:
                return new, added
        return None

    def shared(self, fit, new, worth):
        """Whether more than one recording gains, where there are several: what one run alone shows is no lasting effect."""
        owners = [w.recording for w in self.problem.windows]
        before, after = (
            {o: f.chi2[[i for i, p in enumerate(owners) if p == o]].sum() for o in owners}
            for f in (fit, new)
        )
        if len(before) < 3:
            return True
        best = max(before, key=lambda o: before[o] - after[o])
        return sum(after[o] for o in after if o != best) < (1 - 0.3 * worth) * sum(
            before[o] for o in before if o != best
        )

    def drop(self, fit, added):
        """Leave out earlier effects that no longer earn their keep, now that the others may take their part."""
        while True:
            earlier = {
                c: self.significance(fit, c) for c in fit.hypothesis.candidates if c not in added
            }
            worth, level = self.worth(fit), ALPHA / self.places
            weak = [c for c, (p, cost) in earlier.items() if cost < 3 * worth or p > level]
            weak += self.replaced(fit, [c for c in earlier if c not in weak], added)
            for candidate in sorted(weak, key=lambda c: earlier[c][1]):
                less = self.without(fit, candidate)
                if (
                    less.chi2.sum()
                    < (1 + worth * (1 if earlier[candidate][0] < level else 3)) * fit.chi2.sum()
                ):
                    fit = less
                    break
            else:
                return fit

    def replaced(self, fit, earlier, added):
        """Which earlier effects the added ones can do without, by refits on few windows: far from here no small step tells."""
        if not added:
            return []
        small = fit.subset(self.few)
        fits = multiple_shooting.solve(
            self.small, [fit.hypothesis.minus(c) for c in earlier], small, iterations=4
        )
        return [
            c
            for c, f in zip(earlier, fits)
            if f.chi2.sum() < (1 + self.worth(fit)) * small.chi2.sum()
        ]

    def without(self, fit, candidate):
        """A fit with a candidate left out; what then has to go far away may begin there."""
        less = fit.hypothesis.minus(candidate)
        both = {o.candidate for o in self.options if o.linear} & set(less.candidates)
        far = [
            less.plus(o.candidate, o.directions[0])
            for o in self.options
            if not o.linear and o.candidate in both
        ]
        few = multiple_shooting.solve(self.small, [less] + far, fit.subset(self.few), iterations=4)
        best = min(few, key=lambda f: f.chi2.sum())
        return multiple_shooting.solve(self.problem, [best.hypothesis], fit, iterations=4)[0]


def stretch(hypothesis, candidates, factor):
    """A hypothesis with the distances of some candidates' values from the nominal ones times a factor, inside their bounds."""
    for c in candidates:
        values, nominal = np.array(hypothesis.settings[c]), np.array(c.nominal)
        n = c.effect.amplitudes or len(
            values
        )  # the others of an effect without gradient say where it acts, not how much
        origin = np.where(np.isfinite(nominal), nominal, 0.0)
        moved = np.where(np.arange(len(values)) < n, origin + factor * (values - origin), values)
        hypothesis = hypothesis.plus(
            c, np.clip(moved, [p.low for p in c.parameters], [p.high for p in c.parameters])
        )
    return hypothesis


def same_unit(one, other):
    """Whether two candidates' first parameters have the same unit, so that the one's value is a start for the other's."""
    return one.parameters[0].unit == other.parameters[0].unit


def simplicity(candidate):
    """What to prefer among effects that the data cannot tell apart: the simulator's own step, then few parameters."""
    return (
        candidate.effect.name != "time_step",
        len(candidate.parameters),
        candidate.effect.simplicity,
    )
