"""Start states from the rows before: the simulator runs along the recording and is put right at every row.

    qpos, qvel = observed(world, windows, settings)

Where rows lie far apart joints turn round and feet meet the ground between them, and no difference of positions tells
the speed. A simulator that is nearly right does: what it misses in the position of one row, over the time since the last,
is what it missed in the speed (a Luenberger observer with constant gain).
"""

import numpy as np

import windows as cut

CORRECTIONS, GAIN = 8, 0.6  # rows that put a state right; share of the missed speed that each adds
APART = 0.03  # s between them, at least: closer rows tell more of noise than of speed


def observed(world, windows, settings):
    """States at the first rows of windows under settings: qpos (W, nq), qvel (W, nv). As recorded, at a recording's start."""
    model = world.model
    strides = np.array([max(1, round(APART / np.median(np.diff(w.recording.time)))) for w in windows])
    first = np.array([w.first for w in windows])
    at = first - strides * np.minimum(CORRECTIONS, first // strides)
    qpos, qvel = cut.recorded_starts(model, [w._replace(first=a, last=max(a + 1, w.last)) for w, a in zip(windows, at)])
    while (at < first).any():
        live = np.flatnonzero(at < first)
        steps = [windows[i]._replace(first=at[i], last=at[i] + strides[i]) for i in live]
        there = world.simulate([settings] * len(live), qpos[live], qvel[live], steps)
        at[live] += strides[live]
        rows = np.arange(len(live)), strides[live]
        predicted, speed = there[0][rows], there[1][rows]
        measured, known = (np.array([getattr(windows[i].recording, x)[at[i]] for i in live]) for x in ("qpos", "qvel"))
        missed = np.nan_to_num(cut.difference(model, predicted, measured))
        apart = np.array([np.ptp(windows[i].recording.time[[at[i] - strides[i], at[i]]]) for i in live])
        qpos[live] = cut.integrate(model, predicted, missed)
        qvel[live] = np.where(np.isfinite(known), known, speed + GAIN * missed / apart[:, None])
    return qpos, qvel
