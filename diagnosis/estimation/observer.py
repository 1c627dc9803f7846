"""Start states from the rows before: the simulator runs along the recording and is put right at every row.

    if far_apart(recordings):
        qpos, qvel = observed(world, windows, [settings] * len(windows))

Where rows lie far apart joints turn round and feet meet the ground between them, and no difference of positions tells
the speed. A simulator that is nearly right does: what it misses in the position of one row, over the time since the last,
is what it missed in the speed (a Luenberger observer with constant gain). Of rows close together that is mostly noise.
"""

import numpy as np

from diagnosis.estimation import windows as cut

CORRECTIONS, GAIN = 8, 0.6  # rows that put a state right; share of the missed speed that each adds
APART = 0.02  # s between rows, from which on they are far apart


def far_apart(recordings):
    """Whether speeds by differences are no good start: the rows of recordings are APART."""
    return cut.sampling(recordings) > APART * (1 - 1e-6)


def observed(world, windows, settings):
    """States at the first rows of windows, each under its settings: qpos (W, nq), qvel (W, nv). As recorded, at a recording's start."""
    model = world.model
    first = np.array([w.first for w in windows])
    at = np.maximum(first - CORRECTIONS, 0)
    qpos, qvel = cut.recorded_starts(
        model, [w._replace(first=a, last=max(a + 1, w.last)) for w, a in zip(windows, at)]
    )
    while (at < first).any():
        live = np.flatnonzero(at < first)
        steps = [windows[i]._replace(first=at[i], last=at[i] + 1) for i in live]
        predicted, speed = (
            x[:, 1]
            for x in world.simulate([settings[i] for i in live], qpos[live], qvel[live], steps)
        )
        at[live] += 1
        measured, known = (
            np.array([getattr(windows[i].recording, x)[at[i]] for i in live])
            for x in ("qpos", "qvel")
        )
        missed = np.nan_to_num(cut.difference(model, predicted, measured))
        apart = np.array([np.diff(windows[i].recording.time[at[i] - 1 : at[i] + 1]) for i in live])
        qpos[live] = cut.integrate(model, predicted, missed)
        qvel[live] = np.where(np.isfinite(known), known, speed + GAIN * missed / apart)
        lost = live[
            ~(np.isfinite(qpos[live]).all(1) & np.isfinite(qvel[live]).all(1))
        ]  # it blew up: as recorded, and on from there
        if len(lost):
            qpos[lost], qvel[lost] = cut.recorded_starts(
                model, [windows[i]._replace(first=at[i], last=at[i] + 1) for i in lost]
            )
    return qpos, qvel
