"""Recordings cut into windows: start states, residuals, the error that everybody reports, before,
after and at the floor, its curve, and traces.

    windows = consecutive(recording, horizon=0.3)
    start_qpos, start_qvel = recorded_starts(model, windows)
    qpos, qvel = world.simulate(settings, start_qpos, start_qvel, windows)
    rms, per_channel = error(model, windows, qpos, noise)

A window is (recording, first row, last row), both rows inside. Position differences live in the
tangent space of the joints (nv numbers), so that quaternions need no special case further up.
"""

import numpy as np

from diagnosis.common.coordinates import (
    channels,
    difference,
    integrate,
    joint_name,
    joint_slices,
    states,
)
from diagnosis.simulation.simulator import Window

HORIZON = 0.3  # s, of the error that is reported
ENDLESS = 1e100  # m or rad: whoever is farther off is nowhere
DRAWS = 4  # of noise, for what a perfect simulator would miss


def recordings_of(windows):
    """The recordings that windows were cut from, each once."""
    return list(dict.fromkeys(w.recording for w in windows))


def sampling(recordings):
    """Usual time between the rows of recordings, s."""
    return np.median([np.median(np.diff(r.time)) for r in recordings])


def evenly(number, most):
    """At most so many of 0 .. number - 1, evenly spread: indices, ascending."""
    return np.unique(np.linspace(0, number - 1, min(number, most)).round().astype(int))


def consecutive(recording, horizon=HORIZON, first=0, end=None):
    """Windows of horizon seconds end to end (one's last row is the next one's first) in rows first
    to end, that not included; an incomplete last one is dropped, but if there is no other."""
    time, out = recording.time[:end], []
    sample, start = np.median(np.diff(recording.time)), first
    while first < len(time) - 1:
        last = int(np.searchsorted(time, time[first] + horizon + 0.01 * sample, side="right")) - 1
        last = max(last, first + 1)
        if time[-1] < time[first] + horizon - 0.5 * sample:
            break
        out.append(Window(recording, first, last))
        first = last
    return out or [Window(recording, start, len(time) - 1)]


def beginning(window, seconds):
    """The first seconds of a window, three rows at least where it has as many."""
    time = window.recording.time[window.first : window.last + 1]
    rows = int(np.searchsorted(time, time[0] + seconds * (1 + 1e-9), side="right")) - 1
    return window._replace(last=min(window.last, window.first + max(rows, 3)))


def recorded_starts(model, windows):
    """Start states as the error defines them: qpos (W, nq), qvel (W, nv)."""
    known = {r: states(model, r) for r in recordings_of(windows)}
    pick = [(known[w.recording], w.first) for w in windows]
    return np.array([s[0][i] for s, i in pick]), np.array([s[1][i] for s, i in pick])


def rows_of(when, recordings):
    """Which rows (n,) of recordings, one after the other, a condition holds in."""
    own = lambda r: when["recording"] in (None, r.name)
    inside = lambda r: (when["time"][0] <= r.time) & (r.time <= when["time"][1])
    return np.concatenate([own(r) & inside(r) for r in recordings])


def measured(windows, read=lambda recording: recording.qpos):
    """The recorded rows of every window, (W, T, ...), padded with NaN to the longest."""
    each = [read(w.recording)[w.first : w.last + 1] for w in windows]
    out = np.full((len(each), max(map(len, each)), *each[0].shape[1:]), np.nan)
    for row, rows in zip(out, each):
        row[: len(rows)] = rows
    return out


def known(model, windows):
    """Whether something was measured in the rows of windows, (W, T, nv)."""
    rows = measured(windows)
    return np.isfinite(difference(model, rows, rows))


def gaps(model, windows, qpos):
    """Measured less predicted (W, T - 1, nv) after the starts, 0 where nothing was measured and
    infinite where a prediction blew up, and where something was measured."""
    residual = difference(model, qpos, measured(windows))[:, 1:]
    there = known(model, windows)[:, 1:]
    return np.where(there, np.where(abs(residual) < ENDLESS, residual, np.inf), 0.0), there


def squares(gap, known, noise):
    """Parts (W,) of the squared error over all channels, in noises, by window. gap, known: see
    gaps(); noise (nv,)."""
    return ((gap / noise) ** 2).sum((1, 2)) / max(known.sum(), 1)


def by_channel(model, square, known):
    """{channel: RMS, SI} of squared errors (..., nv), of what is known (..., nv)."""
    rms = lambda dofs: float(np.sqrt(square[..., dofs].sum() / known[..., dofs].sum()))
    return {name: rms(dofs) for name, dofs in channels(model).items() if known[..., dofs].any()}


def error(model, windows, qpos, noise):
    """The reported error of predictions qpos (W, T, nq): over all channels, in noises (nv,), and
    {channel: SI}."""
    gap, known = gaps(model, windows, qpos)
    return float(np.sqrt(squares(gap, known, noise).sum())), by_channel(model, gap**2, known)


def pooled(model, noise):
    """noise (nv,) with that of each channel from its components that moved; inf where none did."""
    out = np.full_like(noise, np.inf)
    for dofs in channels(model).values():
        finite = noise[dofs][np.isfinite(noise[dofs])]
        out[dofs] = np.sqrt(np.mean(finite**2)) if len(finite) else np.inf
    return out


def predict(world, settings, windows, begun=None):
    """qpos (W, T, nq) and qvel (W, T, nv) of every window from its recorded start, or from the
    given ones."""
    qpos, qvel = recorded_starts(world.model, windows) if begun is None else begun
    return world.simulate([settings] * len(windows), qpos, qvel, windows)


def cut(recordings, horizon):
    """All consecutive windows of recordings."""
    return [w for r in recordings for w in consecutive(r, horizon, r.start)]


def floor_error(world, settings, smoother, trajectory, noise):
    """The error that a perfect simulator would have, as (all channels in noises, {channel: SI}),
    and how far the square of the former scatters between recordings of the same motion, noise being
    what it is (a standard deviation)."""
    gap = floor_gaps(world, settings, smoother, trajectory)[:, 1:]
    known = np.isfinite(gap)
    square = np.where(known, gap**2, 0.0)
    total, count = (square / noise**2).sum((1, 2)).reshape(DRAWS, -1), max(known.sum(), 1)
    # windows are independent of each other
    scatter = float(np.sqrt(total.var(axis=0, ddof=1).sum()) * DRAWS / count)
    per_channel = by_channel(world.model, square, known)
    return float(np.sqrt(total.sum() / count)), per_channel, scatter


def floor_gaps(world, settings, smoother, trajectory, horizon=HORIZON):
    """What a perfect simulator would miss in the windows, or some of many: (DRAWS W, T, nv), NaN
    where nothing was measured. The corrected model from smoothed states, from one row before each
    window on, stands for the truth; it is measured anew and predicted from starts as the error
    defines them, DRAWS times."""
    rng, model = np.random.default_rng(0), world.model
    windows = sparse(cut(smoother.recordings, horizon))
    early = [w._replace(first=max(w.first - 1, 0)) for w in windows]
    truth, speed = predict(world, settings, early, trajectory.at(early))
    finite = np.where(np.isfinite(smoother.position_noise), smoother.position_noise, 0.0)
    every = np.arange(len(windows))
    at = np.array([w.first - e.first for w, e in zip(windows, early)])
    ends = [e.recording.time[[e.first, e.first + k + 1]] for k, e in zip(at, early)]
    seconds, there = np.ptp(ends, axis=1, keepdims=True), known(model, windows)
    told = np.array([np.isfinite(w.recording.qvel[w.first]) for w in windows])
    spread, out = _velocity_spread(smoother, trajectory), []
    for _ in range(DRAWS):
        noise = finite * rng.normal(size=(*truth.shape[:2], model.nv))
        noisy = integrate(model, truth, noise)
        start = difference(model, noisy[every, 0], noisy[every, at + 1]) / seconds
        start = np.where(told, speed[every, at] + spread * rng.normal(size=start.shape), start)
        predicted = predict(world, settings, windows, (noisy[every, at], start))[0]
        rows = np.minimum(np.arange(predicted.shape[1]) + at[:, None], noisy.shape[1] - 1)
        gap = difference(model, predicted, noisy[every[:, None], rows])
        out.append(np.where(there, gap, np.nan))
    return np.concatenate(out)


def _velocity_spread(smoother, trajectory):
    """Standard deviation (nv,) of velocities as recorded. Filtered differences of positions have no
    noise of their own: theirs is how far they are from the smoothed motion."""
    noise = smoother.velocity_noise
    gaps = [r.qvel - trajectory.qvel[trajectory.rows(r)] for r in smoother.recordings]
    square = np.concatenate(gaps) ** 2
    known = np.isfinite(square)
    apart = np.sqrt(np.where(known, square, 0.0).sum(0) / np.maximum(known.sum(0), 1))
    return np.where(np.isfinite(noise), noise, apart)


def reporting_noise(position_noise):
    """Noise to divide by, (nv,): finite and positive everywhere."""
    return np.where(np.isfinite(position_noise), np.maximum(position_noise, 1e-12), 1.0)


def curve(world, files, settings, smoother, trajectory, noise, longest=3 * HORIZON, points=15):
    """[{"seconds": t, "before":, "after":, "floor": error at t after the start}, ...], in noises, t
    up to `longest`. files {"before":, "after":}: predicted(model, windows) gives their qpos (W, T,
    nq); settings: of the truth that the floor stands for, and of `trajectory`. Windows in which a
    prediction blew up by then are left out, and counted with all that were measured then:
    "blown_up": {"before":, "after":, "of":}."""
    windows = cut(smoother.recordings, longest)
    seconds = [w.recording.time[w.first : w.last + 1] - w.recording.time[w.first] for w in windows]
    sample = np.median([s[-1] / (len(s) - 1) for s in seconds])
    most = max(1, round(max(s[-1] for s in seconds) / sample))
    seen = known(world.model, windows)
    miss = lambda qpos: difference(world.model, qpos, measured(windows))
    gaps = {name: miss(each.predicted(world.model, windows)) for name, each in files.items()}
    gaps["floor"] = floor_gaps(world, settings, smoother, trajectory, longest)
    out = []
    for time in sample * np.unique(np.linspace(1, most, min(points, most)).round()):
        rows = np.array([_row_at(s, time) for s in seconds])  # recordings may differ in their rates
        there, then = _at(seen, rows), {name: _at(gaps[name], rows) for name in files}
        entry = {"seconds": float(time)}
        lost = {k: int((there & ~np.isfinite(gap)).any(1).sum()) for k, gap in then.items()}
        if any(lost.values()):
            entry["blown_up"] = {**lost, "of": int(there.any(1).sum())}
        with np.errstate(invalid="ignore", over="ignore"):
            entry |= {name: _rms(gap / noise) for name, gap in then.items()}
            entry["floor"] = _rms(_at(gaps["floor"], np.tile(sparse(rows), DRAWS)) / noise)
        out.append(entry)
    return out


def _row_at(seconds, time):
    """The row of a window that stands nearest to a time after its start; -1 where the window has
    ended by then."""
    row = int(np.argmin(np.abs(seconds - time)))
    return row if row and np.abs(seconds[row] - time) <= 0.51 * np.diff(seconds).max() else -1


def _at(values, rows):
    """(W, T, nv) at one row of every window, of those that have it: (V, nv)."""
    having = np.flatnonzero((rows >= 0) & (rows < values.shape[1]))
    return values[having, rows[having]]


def sparse(windows, most=300):
    """Every one of a list, or every second, third ... of a long one."""
    return windows[:: -(-len(windows) // most)]


def _rms(x):
    x = x[np.isfinite(x)]
    return float(np.sqrt(np.mean(x**2))) if len(x) else None


def traces(world, settings, recordings):
    """[{recording, channel, time, measured, nominal, corrected}] of some held-out recordings;
    predictions break (NaN) at window starts."""
    out, model = [], world.model
    for recording in recordings[:3]:
        windows = cut([recording], HORIZON)
        paths = (predict(world, s, windows)[0] for s in ({}, settings))
        nominal, corrected = (_stitched(path, windows) for path in paths)
        rows = np.concatenate([np.arange(w.first, w.last + 1) for w in windows])
        for j, _, q, _ in joint_slices(model):
            for i in range(q.start, q.stop):
                if np.isfinite(recording.qpos[:, i]).any():
                    part = f":{i - q.start}" if q.stop - q.start > 1 else ""
                    line = {
                        "recording": recording.name,
                        "channel": f"qpos:{joint_name(model, j)}{part}",
                        "time": recording.time[rows],
                        "measured": recording.qpos[rows, i],
                        "nominal": nominal[:, i],
                        "corrected": corrected[:, i],
                    }
                    out.append(line)
    return out


def _stitched(qpos, windows):
    qpos[:, 0] = np.nan
    return np.concatenate([piece[: w.last - w.first + 1] for piece, w in zip(qpos, windows)])
