"""Every effect as columns: how the open-loop predictions change with its values.

starts = Starts(world, setting, usual).of(candidates)      # [Start]
columns = Columns(ahead, setting, starts)
columns.options[3].candidate; columns.options[3].values(amounts)

Effects are begun at a small step where they act in proportion, at whole values where they do not (a
dead zone, a delay of many rows). An option is a Start with its columns: one for each parameter, or
one for a whole start.
"""

from copy import copy
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from diagnosis.estimation import windowing
from diagnosis.selection.criterion import Evidence
from diagnosis.selection.plausibility import plausible

TOGETHER = 40  # settings that are simulated in one call
SECANTS = 24  # candidates that are simulated once more at the values that suit them best
FULL = 0.3, 3.0  # amounts of a whole start of values, within which a column stands for it
PROBES = 12  # starts of one candidate that are looked at, but for those that come in groups
LADDER = 0.1, 0.4  # shares of a prior's scale
BEGUN = 0.1  # share of an amplitude's scale, at which effects of several values are begun
WAYS = -1, 1  # in which a usual size is tried where something touches
STATES = 300  # of the motion, at which forces are compared
NEARER = 0.5, 0.25  # of the way to the next group of starts, by which the best is moved
STEP = 0.03  # share of a value's prior scale, or its way from nominal, that a step is at least


@dataclass(frozen=True, eq=False)
class Start:
    """A candidate begun at some values.

    base (k,): its values in the setting; directions (p, k): change of the values per unit of each
    of its p amounts; low, high (p,): bounds of the amounts; prior: a Prior; merges: whether its
    amounts are worked out together, by the effect.
    """

    candidate: object
    base: np.ndarray
    directions: np.ndarray
    low: np.ndarray
    high: np.ndarray
    prior: object
    merges: bool = False

    @property
    def whole(self):
        """Whether these are whole values, of which no small share says anything."""
        return bool((self.low > 0).any())

    def reach(self):
        """Bounds (low, high) (p,) of the amounts within which the values are plausible; its own
        where no share of it means anything."""
        if self.merges or (self.low >= self.high).any():
            return self.low, self.high
        return _reach(self.base, self.directions, self.prior)

    def settings(self, setting):
        """A setting with each of the directions."""
        return [{**setting, self.candidate: tuple(self.base + row)} for row in self.directions]


class Starts:
    """Where effects are begun beside a setting."""

    def __init__(self, world, setting, usual, seen=None, trajectory=None, touches=False):
        """usual: a Usual; seen: {candidate: which of its parameters show}; trajectory: along which
        starts that come in groups are compared with the located force, and few of them kept;
        touches: whether the motion mostly touches something."""
        self.world, self.setting, self.usual = world, setting, usual
        self.seen, self.trajectory, self.touches = seen or {}, trajectory, touches

    def of(self, candidates):
        """[Start] of all the candidates."""
        return [start for candidate in candidates for start in self._each(candidate)]

    def _each(self, candidate):
        world, recordings = self.world, self.usual.recordings
        prior = plausible(candidate, self.usual)
        inside = candidate in self.setting
        base = np.array(self.setting.get(candidate, candidate.nominal), float)
        if inside or not candidate.effect.overrides("probes"):
            one = _proportional(candidate, base, prior, self.seen.get(candidate, True))
            out = [one] if one else []
            if inside:
                return out
            whole = list(world.far(candidate, recordings)) + _ladder(base, prior)
            whole += _both_ways(base, prior) if self.touches else []
        else:
            out, whole = [], _begun(candidate, world.probes(candidate, recordings), prior)
        together = candidate.effect.together
        if together == 1:
            whole = [whole[i] for i in windowing.evenly(len(whole), PROBES)]
        groups = [np.array(whole[k : k + together]) for k in range(0, len(whole), together)]
        fits = lambda rows: all(map(prior.inside, rows))
        groups = [*filter(fits, groups)]
        if together > 1 and len(groups) > 1 and self.trajectory is not None:
            groups = self._promising(candidate, groups, fits)
        return out + [_full(candidate, base, rows, prior) for rows in groups]

    def curve(self, candidate, values):
        """The Start of a force without a name at the values that were located."""
        prior = plausible(candidate, self.usual)
        return _full(candidate, np.zeros(len(values)), np.array([values]), prior)

    def _promising(self, candidate, groups, fits):
        """Of evenly spaced groups of starts the one whose force is most like the located one, moved
        to where it is even more so, among those inside what is plausible."""
        t, d = self.trajectory, self.usual.dof(candidate.place)
        rows = np.flatnonzero(~t.free)
        rows = rows[windowing.evenly(len(rows), STATES)]
        if not len(rows):
            return groups
        zero = self._applied(candidate, [0.0, *groups[0][0, 1:]], rows)[:, d]

        def left(group):
            forces = [self._applied(candidate, tuple(values), rows)[:, d] for values in group]
            basis = np.stack(forces, 1) - zero[:, None]
            fit = np.linalg.lstsq(basis, t.force[rows, d], rcond=None)[0]
            return np.sum((t.force[rows, d] - basis @ fit) ** 2)

        best, step = min(groups, key=left), groups[1] - groups[0]
        for share in NEARER:
            moved = filter(fits, (best, best - share * step, best + share * step))
            best = min(moved, key=left)
        return [best]

    def _applied(self, candidate, values, rows):
        """Generalized forces (n, nv) of actuators and joints with a candidate, dry friction
        included, in rows (n,) of the trajectory, but for what is the same at all values."""
        world, t, effect = self.world, self.trajectory, candidate.effect
        if effect.overrides("limit"):
            i = effect.id(world.model, candidate.place.name)
            most = effect.limit([world.model], i, np.array([values], float))
            return -t.direction()[rows] * most(t.qpos[rows], t.qvel[rows], None, None, None)
        structure = [candidate] if effect.overrides("build") else []
        working = world.engine(frozenset(structure)).working
        model = working.edited([(candidate, tuple(values))], world.model.opt.timestep)
        data, out = mujoco.MjData(model), np.empty((len(rows), world.model.nv))
        for row, q, v in zip(out, t.qpos[rows], t.qvel[rows]):
            data.qpos[working.q], data.qvel[working.v] = q, v  # in the nominal coordinates
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_fwdVelocity(model, data)
            mujoco.mj_fwdActuation(model, data)
            row[:] = (data.qfrc_actuator + data.qfrc_passive)[working.v]
        return out


def _full(candidate, base, rows, prior):
    """The Start of a group of whole values (p, k)."""
    finite, together, (low, high) = np.isfinite(base).all(), len(rows), FULL
    start = base if finite else np.zeros_like(base)
    if together > 1:  # waves act in proportion, as far as is plausible
        high = prior.high[0] / rows[0, 0]
        low = -high
    if not finite:
        low, high = 1.0, 1.0  # a limit that there was not: no share of it means anything
    bounds = np.full(together, low), np.full(together, high)
    return Start(candidate, start, rows - start, *bounds, prior, together > 1)


def _begun(candidate, probes, prior):
    """Starts of an effect, their amplitudes as large as the machine's forces let expect."""
    n, rows = candidate.effect.amplitudes, np.array(probes, float)
    if n and len(rows) and np.isfinite(prior.scale[0]) and len(set(rows[:, 0])) == 1:
        more = rows[:, :n] - prior.centre[:n]
        rows[:, :n] = prior.centre[:n] + BEGUN * prior.scale[0] / more[0, 0] * more
        rows = np.clip(rows, prior.low, prior.high)
    return list(rows)


def _ladder(base, prior):
    """Full-size values of a parameter that only goes one way: what sticks or waits shows in no
    small step."""
    if len(base) > 1 or base[0] > prior.low[0] or not np.isfinite(prior.scale[0]):
        return []
    return [base + share * prior.scale for share in LADDER]


def _both_ways(base, prior):
    """A usual size of each parameter that may go either way: where something touches, a small step
    tells of what it makes and breaks."""
    usual = np.where(np.isfinite(prior.scale) & (base > prior.low), prior.scale, 0.0)
    rows = np.diag(usual)[usual > 0]
    return [base + way * row for row in rows for way in WAYS]


def _proportional(candidate, base, prior, shown):
    """The Start of small steps of the parameters that show, or None. Where something touches,
    predictions are rough: a tiny step tells of what it makes and breaks, and of no slope."""
    steps = np.array([p.step for p in candidate.parameters])
    finite = np.isfinite(base) & np.isfinite(candidate.nominal)
    way = np.subtract(base, candidate.nominal, out=np.zeros_like(base), where=finite)
    usual = np.where(np.isfinite(prior.scale), prior.scale, 0.0)
    steps = np.sign(steps) * np.maximum(abs(steps), STEP * np.maximum(abs(way), usual))
    steps = np.where((base + steps > prior.high) | ~np.isfinite(steps), -abs(steps), steps)
    steps = np.where(base + steps < prior.low, abs(steps), steps)
    fits = (base + steps <= prior.high) & (base + steps >= prior.low) & np.isfinite(base) & shown
    if not fits.any():
        return None
    directions = np.diag(steps)[fits]
    return Start(candidate, base, directions, *_reach(base, directions, prior), prior)


def _reach(base, directions, prior):
    """Bounds (low, high) (p,) of amounts of directions (p, k) from a base (k,), between which the
    values lie within a Prior."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([prior.low - base, prior.high - base])[:, None] / directions
    ends = np.where(directions == 0, [[[-np.inf]], [[np.inf]]], ends)
    return ends.min(0).max(1), ends.max(0).min(1)


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
            self.options.append(Option(**vars(start) | shown, columns=columns, start=start))

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

    def nearer(self, reference, starts):
        """Whole values of which no share means anything again, between the best of those tried and
        its neighbours among starts, as waves are moved: the criterion cannot move these, and a tone
        between two that are tried is out of step within a second."""
        of = lambda start: start.base + start.directions[0]
        fixed = lambda s: (s.low >= s.high).all() and (of(s) > 0).all() and np.isfinite(of(s)).all()
        some = [o.candidate for o in self.options if fixed(o) and o.candidate not in self.setting]
        for candidate in dict.fromkeys(some):
            line, ways = [s for s in starts if s.candidate is candidate and fixed(s)], []
            for share in NEARER:
                mine = [o for o in self.options if o.candidate is candidate and fixed(o)]
                best = self._best_of(mine, reference)
                ways = ways or _ways(of(best), [of(start) for start in line])
                rows = [of(best) * np.exp(share * way) for way in ways]
                rows = [row - best.base for row in rows if best.prior.inside(row)]
                self._simulate([replace(line[0], directions=row[None]) for row in rows])

    def _best_of(self, options, reference):
        """The one of options with one column that leaves least."""
        columns = np.stack([self.parts[o.columns[0]] for o in options], -1)
        given = [((k,), o.low, o.high, *o.quadratic()) for k, o in enumerate(options)]
        scores = Evidence(self.ahead, self.residual, columns, reference).scores(given)
        return options[int(np.argmin([score.loss for score in scores]))]


def _ways(values, line):
    """Logs of the ratios (k,) of the neighbours of values (k,) in a line of such values to those
    in the line that are the nearest."""
    at = int(np.argmin([abs(np.log(each / values)).sum() for each in line]))
    return [np.log(line[i] / line[at]) for i in (at - 1, at + 1) if 0 <= i < len(line)]
