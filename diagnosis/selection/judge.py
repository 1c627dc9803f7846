"""The simulator as judge: sets of effects refitted in it, compared by the one criterion.

judge = Judge(ahead, usual)
fitted = judge.fit({friction: (0.1,)})
fitted.setting, fitted.loss
share_left(fitted), lacking(fitted)      # of each channel, beside what a perfect simulator errs
"""

from dataclasses import dataclass, field, replace

import numpy as np

from diagnosis.estimation.intervals import weighted
from diagnosis.selection.columns import Columns
from diagnosis.selection.criterion import BEYOND, PRICE, Evidence, Score, complexity, paired
from diagnosis.selection.plausibility import at_limit, cost, plausible
from diagnosis.selection.starts import Starts

STEPS = 6  # Gauss-Newton steps of a refit, at most
DONE = 2e-3  # loss that another step would still remove, from which on a refit is done
TRUE = 0.5  # of what columns tell of a step, by which it may differ and they are carried along
FARTHER = 0.25  # scales of priors, by which values are moved to look for another minimum
THIRDS = 3  # shares of a step that are tried


@dataclass(frozen=True, eq=False)
class Fitted:
    """A set of effects refitted. setting: {Candidate: values}; score: of the groups left out,
    priors included; columns, evidence: at these values."""

    setting: dict
    score: Score
    columns: Columns = field(repr=False)
    evidence: Evidence = field(repr=False)

    @property
    def loss(self):
        """With the price of the set's complexity."""
        return self.score.loss + PRICE * complexity(self.setting)

    @property
    def settled(self):
        """Whether no value lies at a bound of what is plausible."""
        return len(self.inside) == len(self.setting)

    @property
    def inside(self):
        """The setting without the effects that have a value at a bound."""
        prior = {o.candidate: o.prior for o in self.columns.options}
        lies = lambda c, v: c in prior and at_limit(c, v, prior[c])
        return {c: v for c, v in self.setting.items() if not lies(c, v)}


class Judge:
    """Refits settings in the simulator on the windows of an Ahead; reference: errors of the cells
    to compare with, those of the first set that is fitted if none are given."""

    def __init__(self, ahead, usual, reference=None, seen=None):
        """seen: {candidate: which of its parameters show}, shared with other looks."""
        self.ahead, self.usual, self.reference = ahead, usual, reference
        self.seen = {} if seen is None else seen

    def fit(self, setting, steps=STEPS, near=None):
        """The Fitted values of a set of effects, begun at the values given. Columns are carried
        along with steps that do what they told, and simulated again after others and at the end.
        near: a Fitted set whose columns stand for those of shared effects, also at the end."""
        inside = {}
        for c, v in setting.items():
            prior = plausible(c, self.usual)
            inside[c] = tuple(np.clip(v, prior.low, prior.high).tolist())
        columns, carried = self._columns(inside, near=near), near is not None
        while True:
            evidence = columns.evidence(self.reference)
            index, *rest = problem(columns, range(len(columns.options)))
            score, better, as_told = evidence.score(index, *rest), None, True
            if steps:
                better, as_told = self._better(columns, evidence, index, score.amounts)
            if not better and (not carried or (near and as_told)):
                break
            moved = better or (columns.setting, columns.residual)
            carried, steps = bool(better) and as_told, steps - bool(better)
            columns = columns.about(*moved) if carried else self._columns(*moved)
        self.reference = evidence.reference
        score = score.plus(self.cost(columns.setting), evidence.number)
        return Fitted(columns.setting, score, columns, evidence)

    def _columns(self, setting, residual=None, near=None):
        """Those of a setting's effects, about it; near: a Fitted set that has some of them."""
        known = near.columns if near else None
        starts = Starts(self.ahead.world, setting, self.usual, self.seen).of(setting)
        columns = Columns(self.ahead, setting, starts, residual, self.seen, known)
        columns.straighten()
        return columns

    def _better(self, columns, evidence, index, amounts):
        """((setting, residual) after a step that lowers the loss by more than DONE, or None;
        whether by about as much as columns told): the whole step, or of it and thirds of it the
        first that is better than the next. amounts (p,): of columns index."""
        now, each = evidence.plain(), evidence.cells * len(evidence.count)
        told = now - evidence.plain(index, amounts)
        if told <= DONE:
            return None, True
        now += self.cost(columns.setting) / each
        best, most, as_told = None, DONE, False
        for third in range(THIRDS):
            moved = moved_setting(columns, amounts / 3**third)
            if np.isfinite(self.cost(moved)):
                residual = self.ahead.residual([moved])[0]
                bare = Evidence(self.ahead, residual).plain()
                gained = now - bare - self.cost(moved) / each
                if gained > most:
                    best, most = (moved, residual), gained
                    as_told = abs(gained - told) < TRUE * told
                elif best:
                    break
            if as_told:
                break
        return best, as_told

    def elsewhere(self, fitted):
        """A Fitted set, or a better one that is begun farther along what its columns tell least of:
        where effects make up for each other, or something touches, a loss has several minima."""
        columns = fitted.columns
        step = _least_told(fitted)
        begun = [moved_setting(columns, way * step) for way in (-1, 1)] if step.any() else []
        tries = [self.fit(some, steps=3) for some in begun if np.isfinite(self.cost(some))]
        best = min([fitted, *tries], key=lambda f: f.loss if f.settled else np.inf)
        return best if best is fitted else self.fit(best.setting)

    def cost(self, setting):
        """Minus the log prior density of a setting's values, nats; infinite where they are not
        possible."""
        return sum(cost(c, v, plausible(c, self.usual)) for c, v in setting.items())


def _least_told(fitted):
    """Amounts (p,) of a Fitted set's columns that move its values, in scales of their priors,
    where these are told least, by FARTHER; none of what has no scale."""
    options = fitted.columns.options
    index = np.array([i for o in options for i in o.columns], int)
    each = [abs(row / o.prior.scale).max() for o in options for row in o.directions]
    plain = [not (o.merges or o.candidate.effect.numerical) for o in options for _ in o.directions]
    size = np.array(each) * plain
    moves, out = np.flatnonzero(size > 0), np.zeros(len(index))
    if len(moves):
        products, weight = weighted(fitted.evidence, index[moves])
        told = products.weighed(weight).sum(0)[1:, 1:] / np.outer(size[moves], size[moves])
        least = np.linalg.eigh(told)[1][:, 0]
        out[moves] = FARTHER * least / abs(least).max() / size[moves]
    return out


def nominal(option):
    """Amounts (p,) of an option without its effect; infinite of a limit: slopes where it is met say
    nothing of where it is not."""
    if option.candidate.effect.bounds:
        return np.full(len(option.columns), np.inf)
    away = np.array(option.candidate.nominal) - option.base
    return np.array([away[row != 0][0] / row[row != 0][0] for row in option.directions])


def problem(columns, chosen, gone=()):
    """(indices, low, high, precision, pull) of options, for Evidence.score: of some that are chosen
    and of effects that are nominal then."""
    options = [columns.options[k] for k in (*chosen, *gone)]
    if not options:
        return (), *[np.zeros(0)] * 4
    parts = zip(*((o.low, o.high, *o.quadratic()) for o in options))
    index, (low, high, *prior) = [i for o in options for i in o.columns], map(np.concatenate, parts)
    for k in gone:
        inside = np.isin(index, columns.options[k].columns)
        low[inside] = high[inside] = nominal(columns.options[k])
    return index, low, high, *prior


def without(fitted, candidate):
    """A Fitted set when an effect of it becomes nominal and the others move, as far as its columns
    tell. Of a limit they tell nothing, so it is as if none missed it."""
    options = fitted.columns.options
    rest = {c: v for c, v in fitted.setting.items() if c is not candidate}
    gone = [k for k, o in enumerate(options) if o.candidate is candidate]
    if not all(np.isfinite(nominal(options[k])).all() for k in gone):
        return replace(fitted, setting=rest, score=replace(fitted.score, loss=-np.inf))
    kept = [k for k in range(len(options)) if k not in gone]
    score = fitted.evidence.score(*problem(fitted.columns, kept, gone))
    return replace(fitted, setting=rest, score=score)


def changing(judge, fitted):
    """A Fitted set without the effects whose values became the nominal ones, and without a limit
    on a side where none is met."""
    shown = {o.candidate: (o.directions != 0).any(0) for o in fitted.columns.options}
    rest = {}
    for c, v in fitted.setting.items():
        met = shown.get(c, False) | np.isfinite(c.nominal)
        values = tuple(np.where(met, v, c.nominal).tolist())
        if not np.allclose(values, c.nominal, rtol=1e-6, atol=0):
            rest[c] = values
    return fitted if rest == fitted.setting else judge.fit(rest, steps=0)


def moved_setting(columns, amounts, chosen=None):
    """The setting after the amounts of some options (all of them by default), one option after the
    other."""
    moved, at = dict(columns.setting), 0
    for k in range(len(columns.options)) if chosen is None else chosen:
        option = columns.options[k]
        part = amounts[at : at + len(option.columns)]
        at += len(option.columns)
        moved[option.candidate] = tuple(float(x) for x in option.values(part))
    return moved


def share_left(fitted):
    """Share (channels,) of the nominal model's error that a Fitted set leaves, both beyond what a
    perfect simulator errs; NaN where the nominal model hardly errs by more than that."""
    evidence, seen = fitted.evidence, fitted.evidence.count > 0
    floor = np.maximum(perfect(fitted).square, evidence.noise**2)
    each = lambda x: np.where(seen, x, 0.0).reshape(len(x), evidence.channels, -1).sum((0, 2))
    excess = lambda x: each(np.maximum(x - floor, 0.0))
    before, after = excess(evidence.reference), excess(evidence.square)
    told = each(evidence.reference) > BEYOND**2 * each(floor)
    return np.sqrt(after / np.where(told, before, np.nan))


def channel(fitted, dof):
    """Index of the channel that a degree of freedom belongs to."""
    return [dof in dofs for dofs in fitted.columns.ahead.channels].index(True)


def lacking(fitted):
    """[Comparison] of each channel: what a perfect simulator would remove of the error of a Fitted
    set, start states free."""
    evidence = fitted.evidence
    scores = map(evidence.each_channel, (evidence.square, perfect(fitted).square))
    return [paired(before, after) for before, after in zip(*scores)]


def perfect(fitted, quiet=False):
    """The Evidence of windows drawn as if a set were true: begun at states as far off as the
    smoother leaves them, and read with noise, as much louder, if at all, as the shortest
    predictions err: a force that is missing hardly shows in them, noise that is not white does.
    quiet: no louder than the noise is known to be."""
    ahead, evidence = fitted.columns.ahead, fitted.evidence
    louder, rng = np.ones(ahead.model.nv), np.random.default_rng(0)
    if not quiet:
        for dofs, times in zip(ahead.channels, _shortest(evidence)):
            louder[dofs] = max(times, 1.0)
    drawn = ahead.drawn(fitted.setting, fitted.columns.residual, louder, rng)
    return Evidence(ahead, drawn, reference=evidence.reference)


def _shortest(evidence):
    """RMS errors (channels,) of the shortest predictions, in units of the noise."""
    first = lambda x: x.reshape(len(x), evidence.channels, -1)[:, :, 0]
    count, square, [noise] = map(first, (evidence.count, evidence.square, evidence.noise[None]))
    mean = (count * square).sum(0) / np.maximum(count.sum(0), 1)
    return np.sqrt(mean / np.maximum(noise**2, 1e-300))
