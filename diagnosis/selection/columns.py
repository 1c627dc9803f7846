"""Every effect as columns: how the open-loop predictions change with its values.

columns = Columns(ahead, setting, starts)
columns.options[3].candidate; columns.options[3].values(amounts)

An option is a Start with its columns: one for each parameter where an effect acts in proportion,
one for a whole start of values where it does not (a dead zone, a delay of many rows).
"""

from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from diagnosis.selection.criterion import Evidence
from diagnosis.selection.starts import Start

TOGETHER = 40  # settings that are simulated in one call
SECANTS = 24  # candidates that are simulated once more at the values that suit them best


@dataclass(frozen=True, eq=False, kw_only=True)
class Option(Start):
    """A Start and its columns: their indices (p,)."""

    columns: tuple

    def values(self, amounts):
        """The candidate's values at amounts (p,)."""
        if self.merges:
            rows, at = self.base + self.directions, list(amounts)
            start, amount = self.candidate.effect.merged(rows, at)
            values = np.array(start, float)
            values[0] = self.base[0] + amount * (start[0] - self.base[0])
        else:
            values = self.base + np.asarray(amounts) @ self.directions
        return tuple(np.clip(values, self.prior.low, self.prior.high))

    def about(self, values):
        """The same with other values (k,) for its base, as if its columns were the same there."""
        moved = np.linalg.lstsq(self.directions.T, np.asarray(values) - self.base, rcond=None)[0]
        low, high = self.low - moved, self.high - moved
        return replace(self, base=np.asarray(values, float), low=low, high=high)

    def quadratic(self):
        """(precision, pull) (p,) of the prior about the base, for the criterion."""
        # where the start is: far out a Student's t bends little
        k = np.array(self.prior.precision(self.base + self.directions.sum(0)))
        moved = self.directions
        if self.merges:  # of what is worked out together, the amounts tell the amplitude alone
            moved = moved * (np.arange(moved.shape[1]) < self.candidate.effect.amplitudes)
        precision = (moved**2 * k).sum(1)
        pull = -(moved * k * (self.base - self.prior.centre)).sum(1)
        return precision, pull


def stepwise(world, candidate):
    """Whether a candidate has to be worked out before each step, which is dear."""
    effect = candidate.effect
    return effect.stepwise(world.model, effect.id(world.model, candidate.place.name))


class Columns:
    """Simulates the columns of starts about a setting. residual (W, T, nv); array (W, T, nv, K);
    options."""

    def __init__(self, ahead, setting, starts, residual=None, seen=None, known=None):
        """residual: of the setting, if it is known; seen: {candidate: which of its parameters
        show}, kept up to date; known: other Columns, whose effects' are taken as if they were the
        same here."""
        self.ahead, self.setting, self.world = ahead, setting, ahead.world
        self.options, self.simulated = [], int(residual is None)
        self.seen = {} if seen is None else seen
        self.residual = ahead.residual([setting])[0] if residual is None else residual
        self.lost = abs(self.residual) >= ahead.travel  # rows of which no slope tells anything
        self.parts, self.begun = [], []  # the Start of every option
        if known:
            self._take(known)
        mine = {option.candidate for option in self.options}
        self._simulate([start for start in starts if start.candidate not in mine])

    def _take(self, known):
        """The columns that others have of the setting's effects."""
        for option, begun in zip(known.options, known.begun):
            if option.candidate in self.setting:
                first, old = len(self.parts), option.columns
                self.parts += [known.parts[i] for i in old]
                option = option.about(self.setting[option.candidate])
                self.options.append(replace(option, columns=(*range(first, first + len(old)),)))
                self.begun.append(begun)

    def about(self, setting, residual):
        """These Columns about other values of the setting's effects, whose residual is known."""
        other = copy(self)
        other.setting, other.residual = setting, residual
        other.options = [option.about(setting[option.candidate]) for option in self.options]
        return other

    def evidence(self, reference=None):
        """The Evidence of the residual and all columns."""
        return Evidence(self.ahead, self.residual, self.array, reference)

    @property
    def array(self):
        """(W, T, nv, K)."""
        return np.stack(self.parts, -1) if self.parts else np.zeros((*self.residual.shape, 0))

    def _simulate(self, starts):
        """Simulate starts; those that change nothing are left out."""
        numerical = lambda start: start.candidate.effect.numerical
        physics = [start for start in starts if not numerical(start)]
        physics = sorted(physics, key=lambda start: stepwise(self.world, start.candidate))
        steps, ahead = [*filter(numerical, starts)], self.ahead
        rough = self.residual
        if physics and not ahead.same(self.setting):
            rough = ahead.rough([self.setting])[0]
        changes = self._changes(ahead.rough, rough, physics)
        changes = iter(changes + self._changes(ahead.residual, self.residual, steps))
        for start in physics + steps:
            own = [next(changes) for _ in start.directions]
            seen = np.array([self._shows(c) for c in own])
            self._remember(start, seen)
            if not seen.any() or (start.merges and not seen.all()):
                continue
            columns = tuple(range(len(self.parts), len(self.parts) + seen.sum()))
            self.parts += [c for c, yes in zip(own, seen) if yes]
            shown = {f: getattr(start, f)[seen] for f in ("directions", "low", "high")}
            self.options.append(Option(**vars(start) | shown, columns=columns))
            self.begun.append(start)

    def _changes(self, residual, base, starts):
        """[(W, T, nv)] of all directions of starts: base, less the residual with them."""
        settings = [setting for start in starts for setting in start.settings(self.setting)]
        changes = []
        for k in range(0, len(settings), TOGETHER):
            for gap in residual(settings[k : k + TOGETHER]):
                with np.errstate(over="ignore"):
                    change = (base - gap).astype(np.float32)
                gone = self.lost | (abs(gap) >= self.ahead.travel) | ~np.isfinite(change)
                changes.append(np.where(gone, np.float32(0.0), change))
        self.simulated += len(settings)
        return changes

    def _remember(self, start, shows):
        """Keep which parameters of a candidate show: later columns leave out the others."""
        single = (start.directions != 0).sum(1) == 1
        # of what is begun at whole values, others may show what these do not
        new = start.candidate not in self.seen and not start.candidate.effect.overrides("probes")
        if single.all() and new and len(single) > 1 and shows.any():
            self.seen[start.candidate] = (start.directions[shows] != 0).any(0)

    def _shows(self, change):
        """Whether a column says anything: more than rounding, beside the noise."""
        noise = np.where(np.isfinite(self.ahead.noise), self.ahead.noise, np.inf)
        return bool((np.sqrt(np.mean(change**2, axis=(0, 1))) > 1e-6 * noise).any())

    def secants(self, evidence):
        """Options of single parameters again, with a column at the value that suits each best
        alone: a small step of what sticks or saturates says little of a large one."""
        moves = lambda o: not o.merges and (o.low < o.high).all()
        single = lambda o: len(o.columns) == 1 and moves(o) and o.candidate not in self.setting
        some = [o for o in self.options if single(o)]
        found = evidence.scores([(o.columns, o.low, o.high, *o.quadratic()) for o in some])
        moved = [(score, o) for score, o in zip(found, some) if abs(score.amounts[0]) > 1e-9]
        starts = []
        for score, o in sorted(moved, key=lambda pair: pair[0].loss)[:SECANTS]:
            row = np.array(o.values(score.amounts)) - o.base
            if not row.any():
                continue
            with np.errstate(divide="ignore", invalid="ignore"):
                ends = np.stack([o.prior.low - o.base, o.prior.high - o.base]) / row
            ends = ends[:, np.isfinite(ends).all(0) & (row != 0)]
            low, high = max(ends.min(0).max(initial=-9), -0.5), min(ends.max(0).min(initial=9), 4.0)
            bounds = np.array([low]), np.array([high])
            starts.append(Start(o.candidate, o.base, row[None], *bounds, o.prior))
        self._simulate(starts)
