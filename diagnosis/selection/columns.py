"""Every effect as columns: how the open-loop predictions change with its values.

columns = Columns(ahead, setting, starts)
columns.options[3].candidate; columns.options[3].values(amounts)

An option is a Start with its columns: one for each parameter, or one for a whole start.
"""

from copy import copy
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.linalg import inv

from diagnosis.selection.criterion import Evidence
from diagnosis.selection.starts import NEARER, Start

TOGETHER = 40  # settings that are simulated in one call
MOVED = 4  # candidates of which whole values are moved
SECANTS = 24  # candidates that are simulated once more at the values that suit them best
# share of what the best told direction of an effect changes, below which another one is hardly
# told; a step along the best one is shortened to that at most
SLIGHT = 0.1
PASSES = 3  # simulations of such columns that follow the first, at most


@dataclass(frozen=True, eq=False, kw_only=True)
class Option(Start):
    """What of a Start shows, and its columns: their indices (p,)."""

    columns: tuple
    start: Start = None

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


class Columns:
    """Simulates the columns of starts about a setting. residual (W, T, nv); array (W, T, nv, K);
    options."""

    def __init__(self, ahead, setting, starts, residual=None, seen=None, known=None):
        """residual: of the setting, if it is known; seen: {candidate: which of its parameters
        show}, kept up to date; known: other Columns, whose effects' are taken as if they were the
        same here."""
        self.ahead, self.setting = ahead, setting
        self.options, self.simulated = [], int(residual is None)
        self.seen = {} if seen is None else seen
        self.residual = ahead.residual([setting])[0] if residual is None else residual
        self.lost = abs(self.residual) >= ahead.travel  # rows of which no slope tells anything
        self.parts = []  # [(W, T, nv)]
        if known:
            self._take(known)
        mine = {option.candidate for option in self.options}
        self._simulate([start for start in starts if start.candidate not in mine])

    def _take(self, known):
        """The columns that others have of the setting's effects."""
        for option in known.options:
            if option.candidate in self.setting:
                first, old = len(self.parts), option.columns
                self.parts += [known.parts[i] for i in old]
                option = option.about(self.setting[option.candidate])
                self.options.append(replace(option, columns=(*range(first, first + len(old)),)))

    def straighten(self):
        """Simulate effects of several values again, along what their columns tell apart, where they
        hardly tell some of it: what leaves predictions as they are is lost in the differences of
        large steps."""
        some, rough = [o for o in self.options if len(o.columns) > 1 and not o.merges], None
        for _ in range(PASSES):
            turned = [each for each in map(self._turned, some) if each]
            if not turned:
                break
            rough = self._rough() if rough is None else rough
            changes = self._physics([start for *_, start in turned], rough)
            for option, ways, start in turned:
                own = np.einsum("ij,j...->i...", inv(ways), np.stack(changes[start]))
                for k, part in zip(option.columns, own):
                    self.parts[k] = part
            some = [option for option, *_ in turned]

    def _turned(self, option):
        """(option, amounts (p, p), Start along them) of what columns of an option tell apart; None
        where they tell all of it well."""
        each = [(self.parts[k] / self.ahead.known_noise).ravel() for k in option.columns]
        size, ways = np.linalg.svd(np.stack(each, -1), full_matrices=False)[1:]
        if size[-1] >= SLIGHT * size[0]:  # or none of them shows anything
            return None
        ways = ways * np.maximum(size[-1] / np.maximum(size, 1e-300), SLIGHT)[:, None]
        return option, ways, replace(option.start, directions=ways @ option.directions)

    def _rough(self):
        """The setting's residual as of quick simulations."""
        if self.ahead.same(self.setting):
            return self.residual
        return self.ahead.rough([self.setting])[0]

    def about(self, setting, residual):
        """These Columns about other values of the setting's effects, whose residual is known."""
        other = copy(self)
        other.setting, other.residual = setting, residual
        other.options = [option.about(setting[option.candidate]) for option in self.options]
        return other

    def evidence(self, reference=None):
        """The Evidence of the residual and all columns."""
        ahead, heavier = self.ahead, self.ahead.heavier(self.setting, self.options)
        return Evidence(ahead, self.residual, self.array, reference, heavier)

    @property
    def array(self):
        """(W, T, nv, K)."""
        return np.stack(self.parts, -1) if self.parts else np.zeros((*self.residual.shape, 0))

    def _simulate(self, starts):
        """Simulate starts; those that change nothing are left out."""
        ahead, model = self.ahead, self.ahead.model
        place = lambda c: c.effect.id(model, c.place.name)
        # last what has to be worked out before each step, which is dear
        dear = lambda start: start.candidate.effect.stepwise(model, place(start.candidate))
        physics = sorted((s for s in starts if not s.candidate.effect.numerical), key=dear)
        steps = [start for start in starts if start.candidate.effect.numerical]
        rough = self._rough() if physics else self.residual
        changes = self._physics(physics, rough)
        changes |= self._changes(ahead.residual, self.residual, steps)
        for start, own in changes.items():
            seen = np.array([self._shows(c) for c in own])
            self._remember(start, seen)
            if not seen.any() or (start.merges and not seen.all()):
                continue
            columns = tuple(range(len(self.parts), len(self.parts) + seen.sum()))
            self.parts += [c for c, yes in zip(own, seen) if yes]
            shown = {f: getattr(start, f)[seen] for f in ("directions", "low", "high")}
            self.options.append(Option(**vars(start) | shown, columns=columns, start=start))

    def _physics(self, starts, rough):
        """_changes() in quick simulations. Beside the setting, what recordings do not show begins
        as the setting alone has it."""
        inside = [start for start in starts if start.candidate in self.setting]
        beside = [start for start in starts if start.candidate not in self.setting]
        changes = self._changes(self.ahead.rough, rough, inside)
        residual = partial(self.ahead.rough, begun=self.setting)
        return changes | self._changes(residual, rough, beside)

    def _changes(self, residual, base, starts):
        """{start: [(W, T, nv)] of its directions}: base, less the residual with them."""
        settings = [setting for start in starts for setting in start.settings(self.setting)]
        changes = []
        for k in range(0, len(settings), TOGETHER):
            for gap in residual(settings[k : k + TOGETHER]):
                with np.errstate(over="ignore"):
                    change = (base - gap).astype(np.float32)
                gone = self.lost | (abs(gap) >= self.ahead.travel) | ~np.isfinite(change)
                changes.append(np.where(gone, np.float32(0.0), change))
        self.simulated += len(settings)
        each = iter(changes)
        return {start: [next(each) for _ in start.directions] for start in starts}

    def _remember(self, start, shows):
        """Keep which parameters of a candidate show: later columns leave out the others."""
        single = (start.directions != 0).sum(1) == 1
        # of what is begun at whole values, others may show what these do not
        new = start.candidate not in self.seen and not start.candidate.effect.overrides("probes")
        if single.all() and new and len(single) > 1 and shows.any():
            self.seen[start.candidate] = (start.directions[shows] != 0).any(0)

    def _shows(self, change):
        """Whether a column says anything: more than rounding, beside the noise."""
        return bool(
            (np.sqrt(np.mean(change**2, axis=(0, 1))) > 1e-6 * self.ahead.known_noise).any()
        )

    def more(self, starts):
        """These Columns and those of further starts."""
        other = copy(self)
        other.options, other.parts = list(self.options), list(self.parts)
        other._simulate(starts)
        return other

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

    def nearer(self, reference, starts):
        """Whole values of which no share means anything again, between the best of those tried and
        its neighbours among starts, as waves are moved: the criterion cannot move these, and a tone
        between two that are tried is out of step within a second. Only of the MOVED candidates
        that leave least."""
        of = lambda start: start.base + start.directions[0]
        fixed = lambda s: (s.low >= s.high).all() and (of(s) > 0).all() and np.isfinite(of(s)).all()
        some = [o for o in self.options if fixed(o) and o.candidate not in self.setting]
        order = sorted(some, key=dict(zip(some, self._alone(some, reference))).get)
        for candidate in [*dict.fromkeys(o.candidate for o in order)][:MOVED]:
            line, ways = [s for s in starts if s.candidate is candidate and fixed(s)], []
            for share in NEARER:
                mine = [o for o in self.options if o.candidate is candidate and fixed(o)]
                best = mine[int(np.argmin(self._alone(mine, reference)))]
                ways = ways or _ways(of(best), [of(start) for start in line])
                rows = [of(best) * np.exp(share * way) for way in ways]
                rows = [row - best.base for row in rows if best.prior.inside(row)]
                self._simulate([replace(line[0], directions=row[None]) for row in rows])

    def _alone(self, options, reference):
        """The loss (n,) that each of some options with one column leaves alone."""
        if not options:
            return []
        columns = np.stack([self.parts[o.columns[0]] for o in options], -1)
        given = [((k,), o.low, o.high, *o.quadratic()) for k, o in enumerate(options)]
        scores = Evidence(self.ahead, self.residual, columns, reference).scores(given)
        return [score.loss for score in scores]


def _ways(values, line):
    """Logs of the ratios (k,) of the neighbours of values (k,) in a line of such values to those
    in the line that are the nearest."""
    at = int(np.argmin([abs(np.log(each / values)).sum() for each in line]))
    return [np.log(line[i] / line[at]) for i in (at - 1, at + 1) if 0 <= i < len(line)]
