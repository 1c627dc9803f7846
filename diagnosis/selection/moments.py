"""Effects that act under a condition only: in one recording of several, or from a moment on in all.

when, begun = proposed(columns, evidence, timed, starts)   # of effects that act under one condition

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

CLEARLY = 2.0  # times what any name that lasts removes, that one at times must remove
LOOKS = 8  # options that are tried in full under each condition, of those that promise most
STARTS = 2  # of each effect that are tried under the condition in the end
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


def followed(world, trajectory, recordings, when=None):
    """The Dependences of the force that is located while a condition holds, on curves that act
    under it; without one, all of the time."""
    if not when:
        return dependences(world, trajectory, recordings)
    found = dependences(world, trajectory, recordings, windowing.rows_of(when, recordings))
    return [replace(d, candidate=world.localised(d.candidate, when)) for d in found]


def placed(world, candidate, when):
    """A candidate that acts under a condition; None of what another effect is then, as a mass that
    comes is a load."""
    loads = [c for c in world.candidates if c.effect.timed and c.place == candidate.place]
    if any(STEADY[load.effect.name] == candidate.effect.name for load in loads):
        return None
    return world.localised(candidate, when)


def proposed(columns, evidence, timed, starts):
    """(condition, [Start]) of effects that are worth their price under a condition, the one under
    which an effect removes most beside the setting of some Columns; (None, []) where none removes
    clearly more than any name that lasts. timed: Starts of effects that never last; starts: the
    Starts that all come from."""
    if condition_of(columns.setting):  # no two at once
        return None, []
    columns, reference = columns.more(timed), evidence.reference
    chain = columns.ahead
    each, free = conditions(chain.windows), _free(columns)
    if not each or not free:
        return None, []
    kept = [k for k, o in enumerate(columns.options) if o.candidate in columns.setting]
    own = problem(columns, kept)
    lasts, *comes = _removed(columns, reference, own, _looks(columns, reference, own, free, each))
    removed = [max(some.values(), default=0.0) for some in comes]
    best = int(np.argmax(removed))
    if removed[best] <= CLEARLY * max(lasts.values(), default=0.0):
        return None, []
    when, told, best = each[best].when, {}, comes[best]
    if when["recording"] is None:
        when = _closer(columns, reference, max(best, key=best.get), when)
    price = lambda o: PRICE * complexity([placed(chain.world, o.candidate, when)])
    for option in sorted(best, key=best.get, reverse=True):
        if best[option] > price(option):
            told.setdefault(option.candidate, []).append(option.start)
    under = (_begun(starts, one, mine, when) for one, mine in told.items())
    return when, [start for some in under for start in some]


def _begun(starts, candidate, lasting, when):
    """[Start] of a candidate under a condition: where the best of those that last begin, or, of
    waves, where the force is that is located meanwhile."""
    here = placed(starts.world, candidate, when)
    if lasting[0].merges:
        return starts.of([here])
    return [replace(start, candidate=here) for start in lasting[:STARTS]]


def _free(columns):
    """The options with a name of Columns that a row or a few tell all of, but for those of the
    setting."""
    new = lambda c: c not in columns.setting and not columns.ahead.apart(c)
    return [o for o in columns.options if new(o.candidate) and not o.unnamed]


def _looks(columns, reference, own, free, each):
    """[(windows (W,), options)] that promise most in a first look beside the setting, whose problem
    is given: where they last first, then under each Condition."""
    chain, options, evidence = columns.ahead, columns.options, columns.evidence(reference)
    low, high = (np.concatenate([getattr(o, end) for o in options]) for end in ("low", "high"))
    inside = np.array([np.ones(len(chain.windows)), *(c.inside for c in each)])
    gains = evidence.looks(own, evidence.score(*own).amounts, low, high, inside)
    lasts = [o for o in free if not o.candidate.effect.timed]
    comes = [o for o in free if placed(chain.world, o.candidate, each[0].when)]
    most = lambda gain, some: sorted(some, key=lambda o: -gain[list(o.columns)].sum())[:LOOKS]
    some = [lasts, *[comes] * len(each)]
    return [(where, most(gain, which)) for where, gain, which in zip(inside, gains, some)]


def _removed(columns, reference, own, tried):
    """[{option: loss that it removes beside the setting}] of options that act in some windows each,
    [(inside (W,), options)]; own: the problem of the setting."""
    chain, options, parts = columns.ahead, columns.options, columns.parts
    first = np.arange(len(own[0])), *own[1:]
    which, acts, given = [*own[0]], [np.ones(len(chain.windows))] * len(own[0]), []
    for inside, some in tried:
        for option in some:
            index = np.arange(len(which), len(which) + len(option.columns))
            mine = index, option.low, option.high, *option.quadratic()
            given.append([np.concatenate(pair) for pair in zip(first, mine)])
            which += option.columns
            acts += [inside] * len(index)
    array = np.stack([parts[k] * on[:, None, None] for k, on in zip(which, acts)], -1)
    heavier = chain.heavier(columns.setting, options)[which]
    evidence = Evidence(chain, columns.residual, array, reference, heavier)
    left = iter([score.loss for score in evidence.scores(given)])
    before = evidence.score(*first).loss
    return [{option: before - next(left) for option in some} for _, some in tried]


def _closer(columns, reference, option, when):
    """The condition with its moment moved to where an option leaves least."""
    chain = columns.ahead

    def left(told):
        here = lambda when: placed(chain.world, option.candidate, when)
        starts = [replace(option.start, candidate=here(when)) for when in told]
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
