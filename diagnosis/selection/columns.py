"""Every effect as columns: how the open-loop predictions change with its values.

columns = Columns(ahead, setting, usual)
columns.options[3].candidate; columns.options[3].values(amounts)

An option is a candidate begun at some values: one column for each parameter where it acts in
proportion, one for a whole start of values where it does not (a dead zone, a delay of many rows).
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from diagnosis.estimation import windowing
from diagnosis.selection.criterion import Evidence
from diagnosis.selection.first_look import likely
from diagnosis.selection.plausibility import plausible

TOGETHER = 40  # settings that are simulated in one call
FULL = 0.3, 3.0  # amounts of a whole start of values, within which a column stands for it
PROBES = 12  # starts of one candidate that are looked at, but for those that come in groups
LADDER = 0.1, 0.4  # shares of a prior's scale
BEGUN = 0.1  # share of an amplitude's scale, at which effects of several values are begun
STATES = 300  # of the motion, at which forces are compared
PROMISING = 3  # groups of starts that are simulated
SECANTS = 24  # candidates that are simulated once more at the values that suit them best


@dataclass(frozen=True)
class Option:
    """A candidate at a start.

    base (k,): its values in the setting; directions (p, k): change of the values per unit of each
    of its p columns; columns (p,): their indices; low, high (p,): bounds of the amounts; prior: a
    Prior.
    """

    candidate: object
    base: np.ndarray
    directions: np.ndarray
    columns: tuple
    low: np.ndarray
    high: np.ndarray
    prior: object
    merges: bool = False

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

    def quadratic(self):
        """(precision, pull) (p,) of the prior about the base, for the criterion."""
        # where the start is: far out a Student's t bends little
        k = np.array(self.prior.precision(self.base + self.directions.sum(0)))
        precision = (self.directions**2 * k).sum(1)
        pull = -(self.directions * k * (self.base - self.prior.centre)).sum(1)
        return precision, pull


def stepwise(world, candidate):
    """Whether a candidate has to be worked out before each step, which is dear."""
    effect = candidate.effect
    return effect.stepwise(world.model, effect.id(world.model, candidate.place.name))


def applied(model, qpos, qvel, working):
    """Generalized forces of actuators and joints (n, nv) at states (n, nq), (n, nv) of the nominal
    coordinates."""
    data, out = mujoco.MjData(model), np.empty((len(qpos), qvel.shape[1]))
    for row, q, v in zip(out, qpos, qvel):
        data.qpos[working.q], data.qvel[working.v] = q, v
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_fwdActuation(model, data)
        row[:] = (data.qfrc_actuator + data.qfrc_passive)[working.v]
    return out


def _begun(candidate, probes, prior):
    """Starts of an effect, their amplitudes as large as the machine's forces let expect."""
    n, rows = candidate.effect.amplitudes, np.array(probes, float)
    if n and len(rows) and np.isfinite(prior.scale[0]) and len(set(rows[:, 0])) == 1:
        rows[:, :n] *= BEGUN * prior.scale[0] / rows[0, 0]
        rows = np.clip(rows, prior.low, prior.high)
    return list(rows)


class Columns:
    """Simulates the columns of candidates about a setting. residual (W, T, nv); array (W, T, nv,
    K); options."""

    def __init__(
        self, ahead, setting, usual, candidates, residual=None, seen=None, few=False, curves=()
    ):
        """residual: of the setting, if it is known; seen: {candidate: which of its parameters
        show}, of earlier looks; few: only those of which a first look promises something, ahead
        being a Chain; curves: [(candidate, values)] of forces without a name."""
        self.ahead, self.setting, self.usual, self.world = ahead, setting, usual, ahead.world
        self.options, self.simulated, self.few = [], int(residual is None), few
        self.seen = {} if seen is None else seen
        self.residual = ahead.residual([setting])[0] if residual is None else residual
        self.lost = abs(self.residual) >= ahead.travel  # rows of which no slope tells anything
        self.parts = []
        starts = [start for candidate in candidates for start in self._starts(candidate)]
        if few:
            kept = likely(ahead, setting, starts)
            starts = [start for start in starts if start[0] in kept]
        self._simulate(starts + [self._whole(candidate, values) for candidate, values in curves])

    def evidence(self, reference=None):
        """The Evidence of the residual and all columns."""
        return Evidence(self.ahead, self.residual, self.array, reference)

    @property
    def array(self):
        """(W, T, nv, K)."""
        return np.stack(self.parts, -1) if self.parts else np.zeros((*self.residual.shape, 0))

    def _starts(self, candidate):
        """[(candidate, base, directions, low, high, prior, merges)] of a candidate's options."""
        world, recordings = self.world, self.usual.recordings
        prior = plausible(candidate, self.usual)
        inside = candidate in self.setting
        base = np.array(self.setting.get(candidate, candidate.nominal), float)
        if inside or not candidate.effect.overrides("probes"):
            one = self._proportional(candidate, base, prior, self.seen.get(candidate, True))
            out = [one] if one else []
            if inside:
                return out
            whole = list(world.far(candidate, recordings)) + self._ladder(base, prior)
        else:
            out, whole = [], _begun(candidate, world.probes(candidate, recordings), prior)
        together = candidate.effect.together
        if together == 1 and len(whole) > PROBES:
            some = np.unique(np.linspace(0, len(whole) - 1, PROBES).astype(int))
            whole = [whole[i] for i in some]
        elif together > 1 and self.few:
            whole = self._promising(candidate, whole)
        for k in range(0, len(whole), together):
            rows = np.array(whole[k : k + together], float)
            start = np.where(np.isfinite(base), base, 0.0)
            finite = np.isfinite(base).all()
            directions = rows - start if finite else rows
            amounts = FULL if together == 1 else (-FULL[1], FULL[1])
            if not finite:
                amounts = (1.0, 1.0)  # a limit that there was not: no share of it means anything
                start = np.zeros_like(start)
            low, high = (np.full(len(rows), a) for a in amounts)
            if all(prior.inside(row) for row in rows):
                out.append((candidate, start, directions, low, high, prior, together > 1))
        return out

    def _whole(self, candidate, values):
        """The start of a curve at the forces that were located."""
        prior = plausible(candidate, self.usual)
        low, high = (np.array([amount]) for amount in FULL)
        return candidate, np.zeros(len(values)), np.array([values]), low, high, prior, False

    def _promising(self, candidate, whole):
        """Of starts that come in groups, those of the groups whose force is most like the located
        one."""
        t, world = self.ahead.trajectory, self.world
        rows = np.flatnonzero(~t.free)
        rows = rows[windowing.evenly(len(rows), STATES)]
        if not len(rows):
            return whole
        engine = world.engine(frozenset([candidate])).working
        forces = []
        for values in whole:
            model = engine.edited([(candidate, tuple(values))], world.model.opt.timestep)
            forces.append(applied(model, t.qpos[rows], t.qvel[rows], engine))
        zero = list(whole[0])
        zero[0] = 0.0
        model = engine.edited([(candidate, tuple(zero))], world.model.opt.timestep)
        none = applied(model, t.qpos[rows], t.qvel[rows], engine)
        target, together, left = t.force[rows].ravel(), candidate.effect.together, []
        for k in range(0, len(whole), together):
            basis = np.stack([(f - none).ravel() for f in forces[k : k + together]], 1)
            fit = np.linalg.lstsq(basis, target, rcond=None)[0]
            left.append(np.sum((target - basis @ fit) ** 2))
        best = sorted(np.argsort(left)[:PROMISING])
        return [whole[k * together + i] for k in best for i in range(together)]

    @staticmethod
    def _ladder(base, prior):
        """Full-size values of a parameter that only goes one way: what sticks or waits shows in no
        small step."""
        if len(base) > 1 or base[0] > prior.low[0] or not np.isfinite(prior.scale[0]):
            return []
        return [base + share * prior.scale for share in LADDER]

    @staticmethod
    def _proportional(candidate, base, prior, shown):
        steps = np.array([p.step for p in candidate.parameters])
        steps = np.where((base + steps > prior.high) | ~np.isfinite(steps), -abs(steps), steps)
        fits = (base + steps >= prior.low) & np.isfinite(base) & shown
        if not fits.any():
            return None
        directions = np.diag(steps)[fits]
        ends = np.stack([(prior.low - base) / steps, (prior.high - base) / steps])
        low, high = ends.min(0)[fits], ends.max(0)[fits]
        return candidate, base, directions, low, high, prior, False

    def _simulate(self, starts):
        """Simulate starts; those that change nothing are left out."""
        starts = sorted(starts, key=lambda start: stepwise(self.world, start[0]))
        jobs = [(s, row) for s, start in enumerate(starts) for row in start[2]]
        changes = []
        for k in range(0, len(jobs), TOGETHER):
            some = jobs[k : k + TOGETHER]
            settings = [
                {**self.setting, starts[s][0]: tuple(starts[s][1] + row)} for s, row in some
            ]
            found = self.ahead.residual(settings)
            self.simulated += len(settings)
            for gap in found:
                change = self.residual - gap
                change[self.lost | (abs(gap) >= self.ahead.travel)] = 0.0
                changes.append(change.astype(np.float32))
        at = 0
        for start in starts:
            own = changes[at : at + len(start[2])]
            at += len(own)
            seen = np.array([self._shows(c) for c in own])
            self._remember(start, seen)
            if not seen.any() or (start[6] and not seen.all()):
                continue
            columns = tuple(range(len(self.parts), len(self.parts) + seen.sum()))
            self.parts += [c for c, yes in zip(own, seen) if yes]
            candidate, base, directions, low, high, prior, merges = start
            self.options.append(
                Option(
                    candidate, base, directions[seen], columns, low[seen], high[seen], prior, merges
                )
            )

    def _remember(self, start, shows):
        """Keep which parameters of a candidate show at all, so that later columns leave out the
        others."""
        candidate, base, directions = start[:3]
        single = (directions != 0).sum(1) == 1
        if single.all() and candidate not in self.seen and len(directions) > 1 and shows.any():
            self.seen[candidate] = (directions[shows] != 0).any(0)

    def _shows(self, change):
        """Whether a column says anything: more than rounding, beside the noise."""
        noise = np.where(np.isfinite(self.ahead.noise), self.ahead.noise, np.inf)
        return bool((np.sqrt(np.mean(change**2, axis=(0, 1))) > 1e-6 * noise).any())

    def secants(self, evidence):
        """Options of single parameters again, with a column at the value that suits each best
        alone.

        A small step of what sticks, saturates or is late by less than a row says little of a large
        one.
        """
        ranked = []
        for k, option in enumerate(self.options):
            if len(option.columns) > 1 or option.merges or option.candidate in self.setting:
                continue
            precision, pull = option.quadratic()
            score = evidence.score(option.columns, option.low, option.high, precision, pull)
            if abs(score.amounts[0]) > 1e-9:
                ranked.append((score.loss, k, score.amounts))
        starts = []
        for _, k, amounts in sorted(ranked, key=lambda x: x[:2])[:SECANTS]:
            o = self.options[k]
            row = np.array(o.values(amounts)) - o.base
            if not row.any():
                continue
            with np.errstate(divide="ignore", invalid="ignore"):
                ends = np.stack([o.prior.low - o.base, o.prior.high - o.base]) / row
            ends = ends[:, np.isfinite(ends).all(0) & (row != 0)]
            low, high = max(ends.min(0).max(initial=-9), -0.5), min(ends.max(0).min(initial=9), 4.0)
            starts.append(
                (o.candidate, o.base, row[None], np.array([low]), np.array([high]), o.prior, False)
            )
        self._simulate(starts)
