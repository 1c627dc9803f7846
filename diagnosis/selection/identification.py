"""Rounds of locating, naming and judging, until no further effect earns its place.

found = Identification(world, train).run()
found.fitted.setting; found.trajectory
"""

from copy import copy
from dataclasses import dataclass
from math import factorial

import numpy as np

from diagnosis.effects.base import condition_of
from diagnosis.effects.unmodelled import Unknown
from diagnosis.estimation.ahead import Ahead, cut_ahead
from diagnosis.estimation.chain import Chain
from diagnosis.estimation.smoother import Smoother
from diagnosis.selection import moments
from diagnosis.selection.beam import LEAST, Beam, likely
from diagnosis.selection.columns import Columns
from diagnosis.selection.criterion import Evidence, complexity, paired
from diagnosis.selection.judge import Fitted, Judge, perfect, without
from diagnosis.selection.missing_force import MissingForce
from diagnosis.selection.plausibility import Usual
from diagnosis.selection.rivals import TIED, as_good, carried
from diagnosis.selection.starts import Starts

ROUNDS = 4
LEVEL = 0.05  # of false additions in all that is looked at
LEFT = 0.05  # p-value of what a perfect simulator is better by, from which on nothing is left
CURVES = 4  # that compete in a round, of those that a located force follows best
FINALISTS = 4  # sets that the simulator judges in a round
ALONE = 4  # single effects that it judges beside them
TRIED = 2  # effects of a set that may be missed least, tried without


@dataclass(frozen=True)
class Found:
    """What the search ended with: fitted, the Fitted set; trajectory and first, smoothed under it
    and under the nominal model; judge, on the windows begun at that trajectory; missing, the
    MissingForce of the last round; ranking: [(candidate, loss removed alone, p-value)], most
    first; sets: Fitted sets of other effects that predict as well."""

    fitted: Fitted
    trajectory: object
    first: object
    smoother: Smoother
    usual: Usual
    judge: Judge
    missing: MissingForce
    ranking: list
    sets: list


class Identification:
    """The search. say(done, message): progress; log(message): what was decided."""

    def __init__(self, world, train, say=None, log=None):
        self.world, self.train = world, train
        self.say, self.log = say or (lambda done, what: None), log or (lambda what: None)
        self.seen, self.missing, self.sets, self.ranking = {}, None, [], []
        self.looked = 1.0  # how many different columns a round looks at
        apart = lambda c: c.place.kind == "sensor" or c.effect.timed or c.effect.numerical
        self.candidates = [c for c in world.candidates if not apart(c)]

    def run(self, setting=None):
        """The Found of all rounds, begun with the nominal model, or with a setting."""
        setting = setting or {}
        trajectory, first = self.locate(setting)
        for i in range(ROUNDS + 1):
            judge = self.begin(setting, trajectory)
            now = judge.fit(setting)
            if i == ROUNDS or (i and not self.something(now)):
                self.missing = MissingForce(self.screen, setting, self.missing)
                fitted, self.sets = now, carried(judge, self.sets, now, now)
                break
            self.say(0.1 + 0.15 * i, f"searching {len(self.candidates)} candidates")
            fitted = self._round(judge, now, self._curves(setting))
            if fitted.setting.keys() == setting.keys():
                break
            setting = fitted.setting
            trajectory = self.smoother.locate(setting, trajectory)
        known = trajectory, first, self.smoother, self.usual, judge
        return Found(fitted, *known, self.missing, self.ranking, self.sets)

    def again(self, setting, trajectory):
        """The Fitted set of one more round, without curves, from a setting and a trajectory of one
        like it."""
        trajectory, self.sets = self.smoother.locate(setting, trajectory), []
        judge = self.begin(setting, trajectory)
        return self._round(judge, judge.fit(setting), [])

    @staticmethod
    def something(fitted):
        """Whether a perfect simulator would still be better than a Fitted set by no chance: if not,
        nothing that is looked for can be."""
        each = fitted.evidence, perfect(fitted, quiet=True)
        left, drawn = (evidence.at((), np.zeros(0)) for evidence in each)
        return paired(left, drawn).p_value < LEFT

    def locate(self, setting):
        """(trajectory under a setting, trajectory under the nominal model), by which the windows
        of the search are cut and what is plausible is known."""
        self.say(0.0, "locating the missing force")
        self.smoother = smoother = Smoother(self.world, self.train)
        first = trajectory = smoother.locate({})
        if setting:
            trajectory = smoother.locate(setting, first)
        known = first.located()[0], (first.qpos, first.qvel), first.force
        self.usual = Usual(self.world, self.train, smoother.scale, *known)
        ahead = Ahead(self.world, cut_ahead(self.train), smoother.position_noise)
        self.windows = ahead, Chain(self.world, ahead.windows, smoother.position_noise)
        return trajectory, first

    def begin(self, setting, trajectory):
        """The Judge of windows that begin at a trajectory located under a setting. It compares with
        the nominal model: an effect has to remove something of what that misses."""
        self.ahead, self.screen = (copy(windows) for windows in self.windows)
        self.ahead.start(trajectory, setting)
        self.screen.start(trajectory, setting)
        self.trajectory = trajectory
        return Judge(self.ahead, self.usual, squares(self.ahead), self.seen)

    def begun(self, judge, setting):
        """A Judge like another one, of windows that begin at the motion located under a setting."""
        ahead = copy(self.ahead)
        ahead.start(copy(self.smoother).locate(setting, self.trajectory), setting)
        return Judge(ahead, self.usual, judge.reference, self.seen)

    def _round(self, judge, now, curves):
        """The Fitted set that a round ends with, begun with the Fitted one that there is; curves:
        [(candidate, values)] that compete."""
        setting = now.setting
        inside = {c.lasting for c in setting}
        others = [c for c in self.candidates if c not in inside]
        known = self.usual, self.seen, self.trajectory, self.screen.touches
        starts = Starts(self.world, setting, *known)
        self.missing = missing = MissingForce(self.screen, setting, self.missing)
        tried = starts.of([*setting, *others])
        some = likely(missing, tried)
        some += [starts.curve(*curve) for curve in curves]
        columns = Columns(self.screen, setting, some, seen=self.seen)
        nominal = squares(self.screen, columns.residual if not setting else None)
        columns.secants(columns.evidence(nominal))
        columns.nearer(nominal, tried)
        evidence = columns.evidence(nominal)
        timed = starts.of([c for c in self.world.candidates if c.effect.timed])
        when, timed = moments.proposed(columns, evidence, timed, starts)
        if when:
            self.log(f"  at times {when}: {len({start.candidate for start in timed})} effects")
            new = self._curves(setting, when) + self._curves(setting, own=True)
            known = {candidate for candidate, _ in curves}
            some = [starts.curve(c, values) for c, values in new if c not in known]
            columns = columns.more(timed + some)
            evidence = columns.evidence(nominal)
        self.looked = max(evidence.different(), 1.0)
        beam = Beam(columns, evidence)
        self.log(f"{len(columns.parts)} columns, {columns.simulated} simulated; {now.loss:.3f}")
        self.ranking = self.ranking or beam.ranking()  # of the first look of all
        judged = self._judged(judge, beam, now)
        best = self._ended(judge, self._choose(judged, now), now)
        return self._beside(judge, judged, now, best)

    def _judged(self, judge, beam, now):
        """[Fitted] of what there was and of the sets that a beam finds. What ends at a bound of the
        plausible has no value, and may hide what has one: then sets are judged without what there
        was of it, and looked for without what is new."""
        fits, inside = {}, []
        while True:
            sets, alone = self._finalists(beam, *beam.nodes())
            for node in sets + alone:
                new = node.options not in fits
                if new:
                    fitted = judge.fit(beam.setting(node), steps=3, near=now)
                    p, fits[node.options] = paired(now.score, fitted.score).p_value, fitted
                    losses = f"linear {node.loss:.3f} judged {fitted.loss:.3f} p {p:.2g}"
                    limit = "" if fitted.settled else "(limit) "
                    self.log(f"  {losses} {limit}{said(fitted.setting)}")
                fitted = fits[node.options]
                limited = fitted.setting.keys() - fitted.inside.keys()
                if new and limited & now.setting.keys():
                    inside.append(judge.fit(fitted.inside, steps=3, near=fitted))
                if node in sets and limited - now.setting.keys():
                    break
            else:
                return [now, *fits.values(), *inside]
            beam.leave(limited)

    def _beside(self, judge, judged, now, best):
        """The best set, or the one of an earlier round that is better with what is new; sets that
        are as good are carried on."""
        earlier = carried(judge, self.sets, now, best)
        better = [f for f in earlier if f.settled and f.loss < best.loss - TIED]
        if better:  # it was judged in its round, and no more
            best = self.pruned(judge, min(better, key=lambda f: f.loss), judge.fit({}))
        self.sets = as_good(judged + earlier, best)
        return best

    def _curves(self, setting, when=None, own=False):
        """[(candidate, values)] of forces without a name, in joints that no effect of a setting has
        for its place: beside one, every curve is significant, and its size decides in the end. What
        depends on the joint's own speed alone is friction of some kind: names are tried first.
        when: the condition under which they act; own: own speeds too, as under a condition."""
        found = moments.followed(self.world, self.trajectory, self.train, when)
        joints = [self.world.joints(c.place) or () for c in setting]
        taken = {self.world.model.joint(j).name for some in joints for j in some}
        lasts = lambda d: not (when or own) and d.variables == (f"velocity:{d.joint}",)
        found = [d for d in found if d.joint not in taken and not lasts(d)]
        return [(d.candidate, d.values) for d in found[:CURVES]]

    def _finalists(self, beam, start, nodes):
        """Two lists of Nodes for the simulator, best first. Sets of other effects, not a better one
        and more, and not one that predicts the same: classes are told later. A column begun far
        from the truth may not be worth its price yet, but no chance. And the best single effects
        beside them: where something touches, columns tell little of whole values."""
        chosen, seen, options = [], [], beam.columns.options
        for node in nodes:
            if len(chosen) == FINALISTS:
                break
            added = set(node.options) - set(start.options)
            chance = not self.no_chance(paired(start.score, node.score), len(added))
            if not added or (node.loss >= start.loss and chance):
                continue
            names = {one(options[k].candidate) for k in set(node.options) ^ set(start.options)}
            same = [abs(node.score.groups - n.score.groups).max() < LEAST for n in [start, *chosen]]
            if not any(same) and not any(names >= better for better in seen):
                seen.append(names)
                chosen.append(node)
        alone = {}
        for node in nodes:
            if len(node.options) == len(start.options) + 1 and node.options[:-1] == start.options:
                alone.setdefault(one(options[node.options[-1]].candidate), node)
        return chosen, [n for n in list(alone.values())[:ALONE] if n not in chosen]

    def _choose(self, judged, now):
        """The simplest set that is earned over what there was and over which the best set is not
        earned, or, of other effects, is worth little more. Where the best is not earned over what
        there was, that stays."""
        best = min((f for f in judged if f is now or f.settled), key=lambda f: f.loss)
        if best is now or not self.earned(now, best):
            return now
        good = [f for f in judged if f.settled and f is not now and self.earned(now, f)]
        tied = lambda f: f.loss < best.loss + TIED and f.setting.keys() - best.setting.keys()
        good = [f for f in good if f is best or tied(f) or not self.earned(f, best)]
        return min(good, key=lambda f: (complexity(f.setting), f.loss))

    @staticmethod
    def further(judge, fitted):
        """Fitted with more steps, or elsewhere, if that predicts better what is left out too: what
        steps lower is the error of what they are fitted to."""
        more = judge.fit(fitted.setting)
        return judge.elsewhere(more if more.settled and more.loss < fitted.loss else fitted)

    def finer(self, judge, fitted):
        """Fitted beside a finer time step, if that is better: what made up for the simulator's own
        goes when the set is pruned."""
        step = self.world.candidate("time_step", "world")
        if step in fitted.setting:
            return fitted
        least = tuple(p.low for p in step.parameters)
        more = judge.fit({**fitted.setting, step: least}, steps=3, near=fitted)
        return more if more.loss < fitted.loss else fitted

    def _ended(self, judge, best, now):
        """What a round ends with: the best set without what it does not need, or what there was, or
        that in finer steps: what these alone explain as well is no physics."""
        fine = self.finer(judge, now)
        fine = fine if self.earned(now, fine) else now
        if best is not now:
            best = moments.sharpened(judge, self.finer(judge, self.further(judge, best)))
            best = self.pruned(judge, best, now)
        if best is now or not self.earned(fine, best):
            best = fine
        self.log(f" chosen {best.loss:.3f} {said(best.setting)}")
        return best

    def earned(self, before, after):
        """Whether a set is worth its complexity, and better by no chance among those looked at: an
        effect of it is one of many too."""
        step = paired(before.score, after.score)
        added = physics(after.setting.keys() - before.setting.keys())
        at_times = len(moments.conditions(self.screen.windows)) if condition_of(added) else 1
        return after.loss < before.loss and self.no_chance(step, len(added), at_times)

    def no_chance(self, step, added=1, at_times=1):
        """Whether a Comparison is significant among all sets of so many different columns, under so
        many conditions, with two tests each."""
        sets = self.looked**added / factorial(added) * at_times
        return step.p_value < LEVEL / max(sets, self.looked) / 2

    def pruned(self, judge, fitted, now):
        """Without the effects that do not earn their place beside the others, as long as what stays
        is earned over what there was: together effects may be earned of which none is. Those that
        small changes show to be needed are not tried without, but for the one missed least."""
        whole = fitted
        while len(fitted.setting) > 1:
            rest = lambda out: {c: v for c, v in fitted.setting.items() if c is not out}
            tries = [rest(out) for out in self._missed_least(fitted)]
            tries = [judge.fit(setting, steps=3, near=fitted) for setting in tries]
            tries = [f for f in tries if self.earned(now, f)]
            less = min(tries, key=lambda f: f.loss, default=None)
            if less:
                step = paired(less.score, fitted.score)
                self.log(f"  without: {less.loss:.3f} {said(less.setting)}; p {step.p_value:.2g}")
            if less is None or self.earned(less, fitted):
                break
            fitted = judge.fit(less.setting, near=less)
        return fitted if fitted is whole else judge.fit(fitted.setting)

    def _missed_least(self, fitted):
        """Effects of a set that may not earn their place: up to TRIED, and limits, of which small
        changes tell nothing. The one that is missed least in any case: near the noise columns are
        too rough to show that two which share one thing need each other."""
        left = {c: without(fitted, c) for c in fitted.setting}
        order = sorted(left, key=lambda c: left[c].loss)
        some = [c for c in order if not self.earned(left[c], fitted)] or order[:1]
        limits = sum(np.isinf(left[c].loss) for c in some)
        return some[: limits + TRIED]


def one(candidate):
    """What a candidate counts as among others: curves of one joint's force are one."""
    return candidate.place if isinstance(candidate.effect, Unknown) else candidate


def physics(candidates):
    """The set of candidates without a finer time step."""
    return {c for c in candidates if not c.effect.numerical}


def squares(ahead, residual=None):
    """Mean squared errors (groups, cells) of an Ahead's residual (W, T, nv), by default that of the
    nominal model."""
    residual = ahead.residual([{}])[0] if residual is None else residual
    return Evidence(ahead, residual).reference


def said(setting):
    """A set in one line."""
    numbers = lambda values: " ".join(f"{x:.4g}" for x in values)
    return ", ".join(f"{c.effect.name} {c.place.name} {numbers(v)}" for c, v in setting.items())
