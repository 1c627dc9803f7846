"""What a corrected simulator predicts: the reported error before, after and at the floor, its
curve, and traces.

    windows = consecutive(recordings, windowing.HORIZON)
    before, channels = windowing.error(model, windows, predict(world, {}, windows)[0], noise)
"""

import numpy as np

from diagnosis.estimation import windowing

DRAWS = 4  # of noise, for what a perfect simulator would miss


def predict(world, settings, windows, begun=None):
    """qpos (W, T, nq) and qvel (W, T, nv) of every window from its recorded start, or from the
    given ones."""
    qpos, qvel = windowing.recorded_starts(world.model, windows) if begun is None else begun
    return world.simulate([settings] * len(windows), qpos, qvel, windows)


def consecutive(recordings, horizon):
    return [w for r in recordings for w in windowing.consecutive(r, horizon, r.start)]


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
    per_channel = windowing.by_channel(world.model, square, known)
    return float(np.sqrt(total.sum() / count)), per_channel, scatter


def floor_gaps(world, settings, smoother, trajectory, horizon=windowing.HORIZON):
    """What a perfect simulator would miss in the windows, or some of many: (DRAWS W, T, nv), NaN
    where nothing was measured. The corrected model from smoothed states, from one row before each
    window on, stands for the truth; it is measured anew and predicted from starts as the error
    defines them, DRAWS times."""
    rng, model = np.random.default_rng(0), world.model
    windows = sparse(consecutive(smoother.recordings, horizon))
    early = [w._replace(first=max(w.first - 1, 0)) for w in windows]
    truth, speed = predict(world, settings, early, trajectory.at(early))
    finite = np.where(np.isfinite(smoother.position_noise), smoother.position_noise, 0.0)
    every = np.arange(len(windows))
    at = np.array([w.first - e.first for w, e in zip(windows, early)])
    seconds = np.array(
        [[np.ptp(e.recording.time[[e.first, e.first + k + 1]])] for k, e in zip(at, early)]
    )
    known = windowing.known(model, windows)
    measured = np.array([np.isfinite(w.recording.qvel[w.first]) for w in windows])
    spread, out = _velocity_spread(smoother, trajectory), []
    for _ in range(DRAWS):
        noise = finite * rng.normal(size=(*truth.shape[:2], model.nv))
        noisy = windowing.integrate(model, truth, noise)
        start = windowing.difference(model, noisy[every, 0], noisy[every, at + 1]) / seconds
        start = np.where(measured, speed[every, at] + spread * rng.normal(size=start.shape), start)
        predicted = predict(world, settings, windows, (noisy[every, at], start))[0]
        rows = np.minimum(np.arange(predicted.shape[1]) + at[:, None], noisy.shape[1] - 1)
        gap = windowing.difference(model, predicted, noisy[every[:, None], rows])
        out.append(np.where(known, gap, np.nan))
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


def curve(world, settings, smoother, trajectory, noise, longest=3 * windowing.HORIZON, points=15):
    """[{"seconds": t, "before":, "after":, "floor": error at t after the start}, ...], in noises, t
    up to `longest`. Windows in which a prediction blew up by then are left out, and counted with
    all that were measured then: "blown_up": {"before":, "after":, "of":}."""
    windows = consecutive(smoother.recordings, longest)
    seconds = [w.recording.time[w.first : w.last + 1] - w.recording.time[w.first] for w in windows]
    sample = np.median([s[-1] / (len(s) - 1) for s in seconds])
    most = max(1, round(max(s[-1] for s in seconds) / sample))
    known = windowing.known(world.model, windows)
    miss = lambda qpos: windowing.difference(world.model, qpos, windowing.measured(windows))
    both = {"before": {}, "after": settings}
    gaps = {name: miss(predict(world, s, windows)[0]) for name, s in both.items()}
    gaps["floor"] = floor_gaps(world, settings, smoother, trajectory, longest)
    out = []
    for time in sample * np.unique(np.linspace(1, most, min(points, most)).round()):
        rows = np.array([_row_at(s, time) for s in seconds])  # recordings may differ in their rates
        there, then = _at(known, rows), {name: _at(gaps[name], rows) for name in both}
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
        windows = consecutive([recording], windowing.HORIZON)
        nominal, corrected = (
            _stitched(predict(world, s, windows)[0], windows) for s in ({}, settings)
        )
        rows = np.concatenate([np.arange(w.first, w.last + 1) for w in windows])
        for j, _, q, _ in windowing.joint_slices(model):
            for i in range(q.start, q.stop):
                if np.isfinite(recording.qpos[:, i]).any():
                    part = f":{i - q.start}" if q.stop - q.start > 1 else ""
                    line = {
                        "recording": recording.name,
                        "channel": f"qpos:{windowing.joint_name(model, j)}{part}",
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
