"""States that no recording shows, of bristles, plays and springs: found by following what was
recorded.

qpos, qvel, act = run_up(engine, cases, windows, begin, measures, step)

Each case runs once through each stretch of a recording and is brought back to it every RETURN
seconds, where it was measured about then, while what is hidden runs on. That begins at rest, or
where the returns of the first SETTLE seconds speak for it: as with any observer, what is hidden
shows in how far they miss.
"""

from dataclasses import replace

import mujoco
import numpy as np

from diagnosis.common.coordinates import difference, states
from diagnosis.common.distributions import f_sf

RETURN = 0.1  # seconds between returns to the record
SETTLE = 0.5  # seconds whose returns tell how what is hidden began
EARLIER = 2.0  # seconds before a window, from which on what is hidden is followed
LEVEL = 0.01  # of chance, below which it is taken to have begun elsewhere than at rest
SMALL = 0.1, 1e-6  # step of differences: share of what a hidden state moves, and at least


def run_up(engine, cases, windows, begin, measures, step):
    """[qpos, qvel, act] (n, ·) of an Engine's working model at times `begin` (n,) of windows, from
    what was recorded before. measures: as Engine has them."""
    own, some = _stretches(cases, windows, begin)
    chosen, recordings = [cases[s] for s in some], [windows[s].recording for s in some]
    spans = [(begin[own == k].min(), begin[own == k].max()) for k in range(len(some))]
    rows = _together([_returns(r, *span) for r, span in zip(recordings, spans)])
    follower = _Follower(engine, chosen, recordings, rows, measures[:, some], step)
    k = (follower.time[own] <= begin[:, None] + 1e-9).sum(1) - 1
    states = [x[own, k] for x in follower.path()]
    recordings = [w.recording for w in windows]
    _onward(engine, cases, recordings, follower.time[own, k], begin, states, step)
    return states


class _Follower:
    """Follows recordings at their rows (n, K), each under its own case."""

    def __init__(self, engine, cases, recordings, rows, measures, step):
        self.engine, self.cases, self.recordings, self.step = engine, cases, recordings, step
        self.time = np.array([r.time[row] for r, row in zip(recordings, rows)])
        self.settled = max(int((self.time - self.time[:, :1] <= SETTLE).sum(1).max()) - 1, 0)
        filled = {r: _filled(engine.nominal, r) for r in dict.fromkeys(recordings)}
        first = [
            _recorded(engine.nominal, filled[r][0], row[0]) for r, row in zip(recordings, rows)
        ]
        self.first = engine.true(*map(np.array, zip(*first)), measures)  # (n, nq), (n, nv)
        shown = np.array([filled[r][1][row] for r, row in zip(recordings, rows)])
        still = np.zeros((len(shown), engine.nominal.nv))
        self.qpos = [engine.true(q, still, measures)[0] for q in np.swapaxes(shown, 0, 1)]

    def path(self):
        """[qpos, qvel, act] (n, K, ·) of the working model at the rows."""
        first, last = self.settled, self.time.shape[1] - 1
        begun = self._begun(first)
        rest, _ = self._followed([x[:, -1] for x in begun], first, last)
        return [np.concatenate([a, b[:, 1:]], 1) for a, b in zip(begun, rest)]

    def _begun(self, last):
        """The path up to a return, with what is hidden begun at rest, or where the returns are
        missed so much less that it is no chance. The first one tells how far the velocity was."""
        n, own, rest = len(self.cases), _hidden(self.engine), self._at_rest()
        path, missed = self._followed(rest, 0, last)
        size = [SMALL[0] * np.sqrt(np.mean(path[i][..., k] ** 2, 1)) + SMALL[1] for i, k in own]
        begun = [np.tile(x, (len(own), 1)) for x in rest]
        for j, (i, k) in enumerate(own):
            begun[i][j * n : (j + 1) * n, k] += size[j]
        other = self._followed(begun, 0, last)[1].reshape(len(own), *missed.shape)
        count = max(missed.shape[1] - 2, 1)
        scale = np.sqrt((missed[:, 2:] ** 2).sum(1, keepdims=True) / count) + 1e-12
        off = lambda missed: (missed[..., 2:, :] / scale).reshape(*missed.shape[:-2], -1)
        slopes, off_rest = np.moveaxis(off(other - missed), 0, -1), off(missed)
        gram = np.swapaxes(slopes, 1, 2) @ slopes
        ridge = 1e-6 * np.trace(gram, axis1=1, axis2=2)[:, None, None] + 1e-12
        amounts = np.swapaxes(slopes, 1, 2) @ off_rest[..., None]
        amounts = -np.linalg.solve(gram + ridge * np.eye(len(own)), amounts)[..., 0]
        begun = [x.copy() for x in rest]
        for j, (i, k) in enumerate(own):
            begun[i][:, k] += amounts[:, j] * size[j]
        moved, missed = self._followed(begun, 0, last)
        nearer = _no_chance(off_rest, off(missed), len(own))
        return [np.where(nearer[:, None, None], a, b) for a, b in zip(moved, path)]

    def _at_rest(self):
        """States at the first rows: what is hidden is at rest in the middle."""
        n, model = len(self.cases), self.engine.model
        qpos, qvel = np.tile(model.qpos0, (n, 1)), np.zeros((n, model.nv))
        self._return(qpos, qvel, *self.first)
        return [qpos, qvel, np.zeros((n, model.na))]

    def _followed(self, states, first, last):
        """([qpos, qvel, act] (m, K, ·) from return `first` to `last`, how far each return missed
        (m, K, nv)), from states (m, ·), m some times n. What a position is off tells how far the
        velocity was."""
        engine, times = self.engine, len(states[0]) // len(self.cases)
        cases, recordings = self.cases * times, self.recordings * times
        states, time = [x.copy() for x in states], np.tile(self.time, (times, 1))
        path = [np.repeat(x[:, None], last - first + 1, 1) for x in states]
        missed = np.zeros((len(cases), last - first + 1, engine.nominal.nv))
        for k in range(first + 1, last + 1):
            now, then = time[:, k - 1], time[:, k]
            _onward(engine, cases, recordings, now, then, states, self.step)
            qpos = np.tile(self.qpos[k], (times, 1))
            gap = difference(engine.nominal, states[0][:, engine.q], qpos)
            seconds = np.maximum(then - now, self.step)[:, None]
            on = (then > now)[:, None]
            qvel = states[1][:, engine.v] + np.where(on, gap / seconds, 0.0)
            missed[:, k - first] = np.where(on & np.isfinite(gap), gap, 0.0)
            self._return(*states[:2], qpos, qvel)
            for whole, state in zip(path, states):
                whole[:, k - first] = state
        return path, missed

    def _return(self, qpos, qvel, shown_qpos, shown_qvel):
        """Bring states back to what is shown, where it is known."""
        for state, index, shown in (
            (qpos, self.engine.q, shown_qpos),
            (qvel, self.engine.v, shown_qvel),
        ):
            state[:, index] = np.where(np.isfinite(shown), shown, state[:, index])


def _no_chance(before, after, number):
    """Whether misses (n, k) fall by more than chance makes them with so many values fitted: an
    F-test."""
    left = np.maximum((before != 0).sum(1) - number, 1)
    removed = (before**2).sum(1) - (after**2).sum(1)
    ratio = np.nan_to_num(removed / number * left / np.maximum((after**2).sum(1), 1e-300))
    return f_sf(np.maximum(ratio, 0.0), number, left) < LEVEL


def _hidden(engine):
    """[(0, 1 or 2: qpos, qvel or act; index)] of an Engine's states that a recording does not
    show."""
    shown = engine.q, engine.v, np.flatnonzero(~engine.hidden)
    sizes = engine.model.nq, engine.model.nv, engine.model.na
    return [(i, k) for i in range(3) for k in np.setdiff1d(np.arange(sizes[i]), shown[i])]


def _onward(engine, cases, recordings, now, then, states, step):
    """Run states [qpos, qvel, act] (n, ·) on in place, from times now to then (n,); as they are
    where a simulation fails."""
    steps = np.rint((then - now) / step).astype(int)
    on = np.flatnonzero(steps)
    if not len(on):
        return
    qpos, qvel, act = (state[on] for state in states)
    cases, recordings = [cases[i] for i in on], [recordings[i] for i in on]
    q, v, _, a = engine.trajectory(
        cases, recordings, now[on], qpos, qvel, step, int(steps.max()), act=act
    )
    for state, run in zip(states, (q, v, a)):
        run = run[np.arange(len(on)), steps[on]]
        state[on] = np.where(np.isfinite(run).all(axis=1, keepdims=True), run, state[on])


def _filled(model, recording):
    """(a Recording without holes, its qpos (T, nq) with NaN in those longer than RETURN)."""
    if np.isfinite(recording.qpos).all():
        return recording, recording.qpos
    qpos, qvel = states(model, recording)
    time, shown = recording.time, qpos.copy()
    for known, column in zip(np.isfinite(recording.qpos).T, shown.T):
        ends = np.concatenate([[-np.inf], time[known], [np.inf]])
        after = np.searchsorted(ends, time)
        column[~known & (ends[after] - ends[after - 1] > RETURN)] = np.nan
    return replace(recording, qpos=qpos, qvel=qvel), shown


def _recorded(model, recording, row):
    """qpos (nq,) and qvel (nv,) at a row: velocities as measured, else over the rows around it."""
    a, b, qvel = max(row - 1, 0), min(row + 1, len(recording.time) - 1), np.full(model.nv, np.nan)
    if b > a:
        seconds = recording.time[b] - recording.time[a]
        mujoco.mj_differentiatePos(model, qvel, seconds, recording.qpos[a], recording.qpos[b])
    measured = recording.qvel[row]
    return recording.qpos[row], np.where(np.isfinite(measured), measured, qvel)


def _stretches(cases, windows, begin):
    """(which stretch each window (n,) belongs to, a window of each): windows of a case in a
    recording that begin no farther apart than EARLIER."""
    alike = {}
    for s in np.argsort(begin, kind="stable"):
        alike.setdefault((id(cases[s]), id(windows[s].recording)), []).append(s)
    own, some = np.empty(len(begin), int), []
    for each in alike.values():
        number = np.cumsum(np.diff(begin[each], prepend=begin[each[0]]) > EARLIER)
        own[each] = len(some) + number
        some += [each[int(np.searchsorted(number, k))] for k in range(number[-1] + 1)]
    return own, some


def _returns(recording, first, last):
    """Rows (k,) of a recording, RETURN seconds apart or farther, from EARLIER before a time up to
    another, or as long as it takes to settle."""
    time = recording.time
    since = max(first - EARLIER, time[0])
    until = min(max(last, since + SETTLE), time[-1])
    marks = np.arange(since, until + 1e-9, RETURN)
    return np.unique(np.searchsorted(time, marks + 1e-9, side="right") - 1)


def _together(rows):
    """[(k,)] as one array (n, K): what is shorter stays at its last."""
    most = max(map(len, rows))
    return np.array([np.pad(r, (0, most - len(r)), mode="edge") for r in rows])
