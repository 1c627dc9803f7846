"""Effects that act only for a while, a load picked up, a push: where in time is the error?

event = find(world, recordings, setting, trajectory, noise)   # None, or an Event
event.candidate, event.values                                 # a localised Candidate
event.when                                                    # {"recording": name, "time": [a, b]}

The gain of an effect that acts in short windows a..b only is that of the sums of its scores and
Gram matrices over them, so every interval is tested from one simulation per effect.
"""

from dataclasses import replace

import numpy as np

from diagnosis.common.distributions import chi2_ppf, f_sf
from diagnosis.estimation import windowing
from diagnosis.estimation.prediction_error import consecutive, reporting_noise
from diagnosis.selection.criterion import PRICE, complexity
from diagnosis.selection.event import SPAN, Local, Look, Windows, solved
from diagnosis.selection.unmodelled_force import dependences

LEVEL = 1e-3  # false-alarm rate, shared between all intervals and effects
MOST = 400  # windows that are looked at, those about the largest located force
CONCENTRATED = 0.8  # of what lies above the usual residual, the share that the event must explain
ALONE = 0.9  # of an event's gain, the share of one window, above which that window is odd
LONGEST = 0.6  # of all recordings: what lasts longer is no event
SHORTEST = 8  # rows, of which a stretch needs more
TRIES = 50  # intervals that are looked at closer
STEADY = {"external_force": "external_force", "payload_change": "mass"}  # what comes, what lasts
UNSEEN = 1e-8  # squared size, in noises, of a step that shows nowhere


def happened(world, recordings, found):
    """The Event that leaves least, beside what an identification.Found holds or in its place, or
    None."""
    noise, setting = found.smoother.position_noise, found.fitted.setting
    events = [find(world, recordings, setting, found.trajectory, noise)]
    if setting:
        events.append(find(world, recordings, {}, found.first, noise, setting))
    return min((e for e in events if e), key=lambda e: e.left, default=None)


def find(world, recordings, setting, trajectory, noise, lasting=None):
    """The Event that explains most of a residual which is concentrated in its time, or None.

    trajectory: a smoother.Trajectory under the setting {Candidate: values}; noise (nv,): of the
    positions; lasting: a setting that may explain it as well.
    """
    windows = consecutive(recordings, SPAN)
    number = len(windows)
    if number < 12:
        return None
    first = max(0, min(_loudest(trajectory, windows) - MOST // 2, number - MOST))
    scene = Windows(world, setting, windows[first:][:MOST], trajectory, reporting_noise(noise))
    chi2 = (scene.plain**2).sum(1)
    each = chi2 / scene.rows
    usual = np.median(each)
    looks, spans = _looks(scene), _spans(scene.windows)
    found = [f for f in (_interval(look, spans, usual) for look in looks) if f]
    if not found:
        return None
    _, gain, inside, spread, look = max(found, key=lambda f: f[0])
    k = len(look.which)
    p = f_sf(gain / k / spread, k, max(number - k, 1)) * number**2 * len(looks)
    ceiling = usual + 4 * (usual - np.quantile(each, 0.16))  # of windows without an event
    above = (each - ceiling).clip(0) * scene.rows
    excess, there = above.sum(), above[inside].sum()
    if p > LEVEL or there < CONCENTRATED * excess or not _worth(look, scene, chi2, inside, gain):
        return None
    local = Local(scene, trajectory, chi2, inside)
    curves = dependences(world, trajectory, recordings, most=None)
    if local.lasting(gain, curves, lasting):
        return None
    event = local.event(look, min(float(p), 1.0))
    after = scene.left([{**setting, event.candidate: event.values}])[0]
    if chi2.sum() - (after**2).sum() < CONCENTRATED * excess:
        return None
    return replace(event, others=local.others(event, looks, look, gain))


def _worth(look, scene, chi2, inside, gain):
    """Whether an effect takes enough of the error of its recordings for what is asked of any."""
    theirs = {scene.windows[i].recording for i in inside}
    own = [w.recording in theirs for w in scene.windows]
    removed = np.log(chi2[own].sum() / max(chi2[own].sum() - gain, 1e-300)) / 2
    return removed > PRICE * complexity([look.timed])


def _loudest(trajectory, windows):
    """Index of the window with the largest located force, in each joint's usual ones."""
    size = np.median(abs(trajectory.force), axis=0) + 1e-300
    loud = ((trajectory.force / size) ** 2).sum(1)
    ends = [(a, a + w.last - w.first + 1) for a, w in zip(trajectory.begin(windows), windows)]
    return int(np.argmax([loud[a:b].mean() for a, b in ends]))


def _looks(scene):
    """The Looks of every effect that may come and go: pushes, and changes of a mass."""
    world, setting, out = scene.world, scene.setting, []
    by = {(c.effect.name, c.place): c for c in world.candidates}
    for timed in world.candidates:
        name = STEADY.get(timed.effect.name)
        if (name, timed.place) not in by:
            continue
        # a push adds to one that lasts, a load takes the mass's place
        steady = by[name, timed.place]
        base = np.array(setting.get(steady, steady.nominal), float)
        steps = np.array([p.step for p in timed.parameters])
        moved = [{**setting, timed: tuple(row)} for row in base + np.diag(steps)]
        columns = np.moveaxis(scene.changes(moved), 0, -1)
        which = np.flatnonzero((columns**2).sum((0, 1)) > UNSEEN)
        if which.size:
            columns = columns[..., which]
            start = np.array(timed.nominal, float) if steady is timed else base
            score = np.einsum("wrk,wr->wk", columns, scene.plain)
            gram = np.einsum("wrk,wrl->wkl", columns, columns)
            out.append(Look(timed, start, steps[which], which, score, gram))
    return out


def _interval(look, spans, usual):
    """(merit, gain, inside, spread, look) of the windows in which an effect gains most. merit: the
    gain less what so many parameters gain of nothing; spread: gain per parameter elsewhere."""
    k, found = len(look.which), []
    alone = (solved(look.gram, look.score) * look.score).sum(-1)
    spread = max(usual, np.quantile(alone, 0.3) / chi2_ppf(0.3, k))
    for order, first in spans:
        score, gram = look.score[order].cumsum(0), look.gram[order].cumsum(0)
        gain = (solved(gram, score) * score).sum(-1)
        found += [(float(g), order, n) for n, g in enumerate(gain, 1) if n > first]
    for gain, order, n in sorted(found, key=lambda f: -f[0])[:TRIES]:
        inside = np.sort(order[:n])
        score, gram = look.score[inside], look.gram[inside]
        value = solved(gram.sum(0), score.sum(0))
        share = 2 * score @ value - np.einsum("i,wij,j->w", value, gram, value)
        if share.max() < ALONE * gain:
            merit = gain - spread * k * np.log(len(alone))
            return merit, gain, inside, spread, look
    return None


def _spans(windows):
    """[(indices of windows in an order, first)]: an event may be the first n of them, n > first, of
    stretches of one recording, and of what begins in all at the same time and goes on."""
    owner = [w.recording for w in windows]
    most, out = max(1, int(LONGEST * len(windows))), []
    recordings = windowing.recordings_of(windows)
    for r in recordings:
        mine = np.array([i for i, o in enumerate(owner) if o is r])
        out += [(mine[a : a + most], 0) for a in range(len(mine))]
    if len(recordings) > 1:
        begin = np.array([w.recording.time[w.first] for w in windows])
        out.append((np.argsort(-begin, kind="stable")[:most], len(recordings) - 1))
    return out


def quiet(recording, event):
    """[(first row, end row)] of the stretches of a recording that an event does not touch."""
    rows = len(recording.time)
    if event is None or event.recording not in (None, recording):
        return [(recording.start, rows)]
    start, stop = np.searchsorted(recording.time, event.time)
    stretches = (recording.start, int(start)), (int(stop) + 1, rows)
    return [(a, b) for a, b in stretches if b - a > SHORTEST]


def calm(recordings, event):
    """The recordings without the time of an event, each stretch a Recording of its own."""
    return [
        r if (a, b) == (r.start, len(r.time)) else r.part(a, b)
        for r in recordings
        for a, b in quiet(r, event)
    ]
