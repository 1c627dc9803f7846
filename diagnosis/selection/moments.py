"""Effects that act under a condition only: in one recording of several, or from a moment on in all.

when, starts = proposed(columns, evidence, timed)     # of candidates that act under one condition

Every column is looked at with windows that count and windows that do not, beside what lasts and in
its place: what acts at times leaves little that stands out once a lasting effect is fitted to it.
"""

from dataclasses import dataclass, replace

import numpy as np

from diagnosis.effects.base import condition_of
from diagnosis.estimation import windowing
from diagnosis.selection.beam import Beam
from diagnosis.selection.columns import Columns
from diagnosis.selection.criterion import PRICE, Evidence, complexity
from diagnosis.selection.judge import problem
from diagnosis.selection.missing_force import dependences
from diagnosis.selection.transients import STEADY

CLEARLY = 2.0  # times what any name that lasts promises, that one at times must promise
TOLD = 6  # effects that are tried under the condition
STARTS = 2  # of each of them
CLOSER = 0.25, 0.05  # of a window, by which a moment is moved
REACH = 4  # such moves, either way


@dataclass(frozen=True)
class Condition:
    """recording: None for every one; time: (from, to), s; inside (W,): in which windows it
    holds."""

    recording: object
    time: tuple
    inside: np.ndarray

    @property
    def when(self):
        """As a Candidate has it."""
        name = self.recording and self.recording.name
        return {"recording": name, "time": [float(t) for t in self.time]}


def conditions(windows):
    """[Condition] of every recording of several, and every moment at which a window begins."""
    recordings = windowing.recordings_of(windows)
    owner, end = [w.recording for w in windows], max(r.time[-1] for r in recordings)
    begin = np.array([w.recording.time[w.first] for w in windows])
    some = recordings if len(recordings) > 1 else []
    each = [Condition(r, (r.time[0], r.time[-1]), np.array([o is r for o in owner])) for r in some]
    return each + [Condition(None, (t, end), begin >= t) for t in np.unique(begin)[1:]]


def rows_of(when, recordings):
    """Which rows (n,) of recordings, one after the other, a condition holds in."""
    own = lambda r: when["recording"] in (None, r.name)
    inside = lambda r: (when["time"][0] <= r.time) & (r.time <= when["time"][1])
    return np.concatenate([own(r) & inside(r) for r in recordings])


def followed(world, trajectory, recordings, when=None):
    """The Dependences of the force that is located while a condition holds, on curves that act
    under it; without one, all of the time."""
    if not when:
        return dependences(world, trajectory, recordings)
    found = dependences(world, trajectory, recordings, rows_of(when, recordings))
    return [replace(d, candidate=world.localised(d.candidate, when)) for d in found]


def placed(world, candidate, when):
    """A candidate that acts under a condition; None of what another effect is then, as a mass that
    comes is a load."""
    loads = [c for c in world.candidates if c.effect.timed and c.place == candidate.place]
    if any(STEADY[load.effect.name] == candidate.effect.name for load in loads):
        return None
    return world.localised(candidate, when)


def proposed(columns, evidence, timed):
    """(condition, [Start]) of the effects that promise most under the condition under which one
    promises most, beside the setting of some Columns; (None, []) where no one promises
    clearly more than any name that lasts. timed: Starts of effects that never last."""
    if condition_of(columns.setting):  # no two at once
        return None, []
    columns, reference = columns.more(timed), evidence.reference
    chain, evidence = columns.ahead, columns.evidence(reference)
    each, free = conditions(chain.windows), _free(columns)
    if not each or not free:
        return None, []
    inside = np.array([np.ones(len(chain.windows)), *(c.inside for c in each)])
    promise = _promise(columns, evidence, inside)
    at = lambda o: placed(chain.world, o.candidate, each[0].when)
    lasts = [promise(o)[0] for o in free if not (o.candidate.effect.timed or o.unnamed)]
    some = [o for o in free if at(o)]
    gains = np.array([promise(o)[1:] for o in some]).T
    comes = gains - PRICE * np.array([complexity([at(o)]) for o in some])
    best, first = np.unravel_index(np.argmax(comes), comes.shape)
    if not _clear(gains[best], lasts):
        return None, []
    when, told = each[best].when, {}
    if each[best].recording is None:
        when = _closer(columns, reference, some[first], when)
    for k in np.argsort(-comes[best]):
        told.setdefault(some[k].candidate, []).append(_under(chain.world, some[k].start, when))
    return when, [start for starts in list(told.values())[:TOLD] for start in starts[:STARTS]]


def _clear(gains, lasts):
    """Whether some effect promises clearly more under a condition than any name that lasts: what it
    costs to name it says nothing of whether something comes and goes."""
    return max(gains) >= CLEARLY * max(lasts, default=0.0)


def _free(columns):
    """The options of Columns that a row or a few tell all of, but for those of the setting."""
    new = lambda c: c not in columns.setting and not columns.ahead.apart(c)
    return [o for o in columns.options if new(o.candidate)]


def _promise(columns, evidence, inside):
    """What an option promises, nats (C,) of a look, beside the setting, where it acts in windows
    inside (C, W)."""
    options = columns.options
    kept = [k for k, o in enumerate(options) if o.candidate in columns.setting]
    given = problem(columns, kept)
    low, high = (np.concatenate([getattr(o, end) for o in options]) for end in ("low", "high"))
    gains = evidence.looks(given, evidence.score(*given).amounts, low, high, inside)
    return lambda option: gains[:, list(option.columns)].sum(1) / evidence.number


def _under(world, start, when):
    """A Start that acts under a condition."""
    return replace(start, candidate=placed(world, start.candidate, when))


def _closer(columns, reference, option, when):
    """The condition with its moment moved to where an option leaves least."""
    chain = columns.ahead

    def left(told):
        starts = [_under(chain.world, option.start, when) for when in told]
        given = chain, columns.setting, starts, columns.residual
        fine = Columns(*given, seen=dict(columns.seen), known=columns)
        beam = Beam(fine, fine.evidence(reference))
        at = {fine.options[k].candidate.when["time"][0]: k for k in beam.free}
        each = [at.get(when["time"][0]) for when in told]
        node = lambda k: beam.node(beam.kept if k is None else (*beam.kept, k))
        return [node(k).loss for k in each]

    return _moved(chain, when, left)


def sharpened(judge, fitted):
    """A Fitted set with the moment of what acts from one on moved to where the simulator leaves
    least."""
    when = condition_of(fitted.setting)
    if not when or when["recording"]:
        return fitted
    world, ahead = judge.ahead.world, judge.ahead

    def at(when):
        turn = lambda c: world.localised(c, when) if c.when else c
        return {turn(c): v for c, v in fitted.setting.items()}

    left = lambda told: [Evidence(ahead, r).plain() for r in ahead.residual([*map(at, told)])]
    moved = judge.fit(at(_moved(ahead, when, left)), steps=3)
    return moved if moved.loss < fitted.loss else fitted


def removed(before, after, when):
    """Share of the error of a Fitted set that another one removes while a condition holds."""
    ahead = after.columns.ahead
    acts = lambda w: (
        when["recording"] in (None, w.recording.name)
        and (
            w.recording.time[w.first] < when["time"][1]
            and w.recording.time[w.last] > when["time"][0]
        )
    )
    inside = np.array([acts(w) for w in ahead.windows])
    error = lambda f: np.sqrt(np.mean((f.columns.residual[inside] / ahead.known_noise) ** 2))
    return float(1 - error(after) / error(before))


def _moved(ahead, when, left):
    """A condition with its moment moved to where least is left; left([condition]) -> [how much]."""
    length = np.nanmedian(np.nanmax(ahead.seconds, axis=1))
    for share in CLOSER:
        moment, end = when["time"]
        moments = moment + share * length * np.arange(-REACH, REACH + 1)
        told = [{**when, "time": [float(t), end]} for t in moments if 0 < t < end]
        losses = left(told)
        when = told[int(np.argmin(losses))]
    return when
