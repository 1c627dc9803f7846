"""A force without a name that is missing under a condition only: in one recording of several, or
from some moment on in all of them.

where = concentrated(fitted)                  # None, or a Condition
found = where.dependence(world, trajectory, recordings)
"""

from dataclasses import dataclass, replace

import numpy as np

from diagnosis.common.distributions import f_sf
from diagnosis.estimation import windowing
from diagnosis.selection.criterion import BEYOND
from diagnosis.selection.identification import LEVEL
from diagnosis.selection.missing_force import dependences
from diagnosis.selection.transients import CONCENTRATED, LONGEST, SHORTEST, STEADY


@dataclass(frozen=True)
class Condition:
    """recording: None for every one; time: (from, to), s; inside (W,): in which windows it holds;
    p_value: that these err more than the others by chance, corrected for all that were compared."""

    recording: object
    time: tuple
    inside: np.ndarray
    p_value: float

    @property
    def when(self):
        """As a Candidate has it."""
        name = self.recording and self.recording.name
        return {"recording": name, "time": [float(t) for t in self.time]}

    def rows(self, recordings):
        """Which rows (n,) of recordings, one after the other, it holds in."""
        own = [self.recording in (None, r) for r in recordings]
        inside = lambda t: (self.time[0] <= t) & (t <= self.time[1])
        return np.concatenate([yes & inside(r.time) for yes, r in zip(own, recordings)])

    def parts(self, recordings):
        """The recordings while it holds."""
        within = lambda r: np.searchsorted(r.time, self.time)
        some = [(r, *within(r)) for r in recordings if self.recording in (None, r)]
        return [r.part(a, b + 1) for r, a, b in some if b - a > SHORTEST]

    def placed(self, world, candidate):
        """An effect that acts only while it holds: a mass that comes is a load."""
        name, place = candidate.effect.name, candidate.place
        loads = [c for c in world.candidates if STEADY.get(c.effect.name) == name]
        coming = (c for c in loads if c.place == place)
        return world.localised(next(coming, candidate), self.when)

    def dependence(self, world, trajectory, recordings):
        """The Dependence of the located force there, acting there only; None where it follows
        nothing."""
        rows = self.rows(recordings)
        for found in dependences(world, trajectory, recordings, rows=rows):
            return replace(found, candidate=world.localised(found.candidate, self.when))
        return None

    def removed(self, before, after):
        """Share of the error there that one Fitted set removes of another one's."""
        left = [_squares(fitted)[self.inside].sum() for fitted in (after, before)]
        return float(1 - np.sqrt(left[0] / left[1]))


def _squares(fitted):
    """Mean squared residual of the windows (W,) of a Fitted set, in noises."""
    ahead = fitted.columns.ahead
    known = ahead.known & np.isfinite(ahead.noise)
    noise = np.where(np.isfinite(ahead.noise), ahead.noise, 1.0)
    square = (fitted.columns.residual / noise) ** 2 * known
    return square.sum((1, 2)) / np.maximum(known.sum((1, 2)), 1)


def concentrated(fitted):
    """The Condition under which most is left of what a Fitted set does not explain, for the share
    of the windows that it holds in; None where no such one holds what is left, or where chance may
    have made its windows err so much more than the others: an F-test, each window as one error."""
    squares = _squares(fitted)
    excess = np.maximum(squares - BEYOND**2, 0.0)
    some = [c for c in _conditions(fitted.columns.ahead.windows) if c[-1].mean() <= LONGEST]
    if not some or not excess.any():
        return None
    share = [excess[inside].sum() / excess.sum() for *_, inside in some]
    best = int(np.argmax([s - inside.mean() for s, (*_, inside) in zip(share, some)]))
    inside = some[best][-1]
    ratio = squares[inside].mean() / squares[~inside].mean()
    p = float(f_sf(ratio, inside.sum(), (~inside).sum())) * len(some)
    return Condition(*some[best], p) if share[best] >= CONCENTRATED and p < LEVEL else None


def _conditions(windows):
    """[(recording, (from, to), which windows (W,))] of every recording, and every moment at which a
    window begins."""
    recordings = windowing.recordings_of(windows)
    if len(recordings) < 2:
        return []
    owner, end = [w.recording for w in windows], max(r.time[-1] for r in recordings)
    begin = np.array([w.recording.time[w.first] for w in windows])
    single = [(r, (r.time[0], r.time[-1]), np.array([o is r for o in owner])) for r in recordings]
    moments = [(None, (t, end), begin >= t) for t in np.unique(begin)[1:]]
    return single + moments
