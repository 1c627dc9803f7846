"""Rows that only look measured: sensors that repeat their last value, drop out or spike. They
become "not measured".

    recordings, notes = without_defects(recordings, model)

A joint has inertia: it does not jump away and come back within three rows, nor stand still and
catch up in one. What a coarse encoder does at slow speed (repeat, then move on by one count), what
a joint at rest does and what an impact does (a new velocity, not a new position) stays. Velocities
may jump, so in them only repeats count.
"""

from dataclasses import replace

import numpy as np

from diagnosis.recordings.columns import WIDTHS
from diagnosis.recordings.plausibility import grouped
from diagnosis.recordings.quality import encoder_quantum

AWAY = 8  # a spike is so many times as far off as rows usually are,
PACE = 3  # and as the motion before and after goes in a row
LONGEST = 3  # rows of a spike; what lasts longer may be real
CATCH_UP = 2  # the change after repeated values, in the one that follows it: above, they were stale
LEAST = 3  # standard deviations of their number, by which repeats must outnumber those of chance
COUNTS = 3  # of the encoder: changes up to these are its resolution


def without_defects(recordings, model):
    """(recordings with nan where a defect was, [one line for each joint and kind of defect])."""
    out, found = [], {}
    for recording in recordings:
        arrays = {"qpos": recording.qpos.copy(), "qvel": recording.qvel.copy()}
        for kind, name, columns in _channels(model):
            for find, what in (
                (_spikes, "jumps away and back"),
                (_repeats, "repeats its last value and then catches up"),
            ):
                rows = (
                    find(arrays[kind][:, columns])
                    if kind == "qpos" or find is _repeats
                    else np.zeros(1, bool)
                )
                if rows.any():
                    arrays[kind][np.ix_(rows, columns)] = np.nan
                    message = (
                        f"{kind}:{name} {what} in {{}} of its rows, which count as not measured"
                    )
                    found.setdefault(message, []).append((recording.name, rows.mean()))
        out.append(replace(recording, **arrays))
    return out, grouped(found)


def _channels(model):
    """(qpos or qvel, joint, its columns) of every joint: what one sensor measures at once."""
    for j in range(model.njnt):
        nq, nv = WIDTHS.get(model.jnt_type[j], (1, 1))
        for kind, first, width in (
            ("qpos", model.jnt_qposadr[j], nq),
            ("qvel", model.jnt_dofadr[j], nv),
        ):
            yield kind, model.joint(j).name or str(j), list(range(first, first + width))


def _spikes(values):
    """(T,) rows, at most LONGEST at a time, in which values (T, k) are far from the line between
    the rows around them."""
    found = np.zeros(len(values), bool)
    rows = np.flatnonzero(np.isfinite(values).all(axis=1))
    if len(rows) < 20:
        return found
    x = values[rows]
    change = np.abs(np.diff(x, axis=0)).max(axis=1)
    usual = np.quantile(_off_line(x, 1), 0.9)
    for n in range(1, LONGEST + 1):
        # off[i]: rows i + 2 to i + 1 + n, with motion change[i] before and change[i + n + 2] after
        off = _off_line(x, n)[1:-1]
        pace = np.max(
            [
                change[: len(off)],
                change[n + 2 :],
                np.abs(x[n + 2 : -1] - x[1 : -n - 2]).max(axis=1) / (n + 1),
            ],
            axis=0,
        )
        jump = change[1 : 1 + len(off)]
        spike = (
            (off > AWAY * usual) & (off > PACE * pace) & (np.abs(jump - 2 * np.pi) > 0.1)
        )  # else an angle wraps
        for k in range(n):
            found[rows[np.flatnonzero(spike) + 2 + k]] = True
    return found


def _off_line(x, n):
    """(T - n - 1,) how far at least n rows of x (T, k) are from the straight line between the row
    before and the one after."""
    first, last = x[: -n - 1], x[n + 1 :]
    inside = [
        np.abs(x[k : k + len(first)] - first - (last - first) * k / (n + 1)).max(axis=1)
        for k in range(1, n + 1)
    ]
    return np.min(inside, axis=0)


def _repeats(values):
    """(T,) rows in which values (T, k) are the row before's to the last digit, though the next new
    one, or the one before, is far from it."""
    found = np.zeros(len(values), bool)
    rows = np.flatnonzero(np.isfinite(values).all(axis=1))
    if len(rows) < 20:
        return found
    change = np.abs(np.diff(values[rows], axis=0)).max(axis=1)
    same = change == 0
    if same.all() or not same.any():
        return found
    # readings that were interpolated rest at an encoder's steps, and move on by parts of one
    rests = values[rows[1:]][same]
    count = max(change[~same].min(), *map(encoder_quantum, rests.T))
    chance = same.sum() <= 3 * (
        np.count_nonzero(change[~same] < 1.5 * count) - 1
    )  # a coarse and noisy sensor repeats, too
    usual = np.median(change[~same])
    alike = (
        np.count_nonzero(change[~same] < 0.1 * usual) * count / (0.2 * usual)
    )  # rows that noise makes so, with this resolution
    chance |= same.sum() <= alike + LEAST * np.sqrt(alike + 1)
    begin = np.flatnonzero(
        same & ~np.append(False, same[:-1])
    )  # change[k] is between rows k and k + 1
    for first in begin:
        last = first
        while last < len(same) and same[last]:
            last += 1
        following = change[last + 1] if last + 1 < len(change) else np.inf
        if (
            last < len(change)
            and not chance
            and change[last] > max(COUNTS * count, CATCH_UP * following)
        ):
            found[rows[first + 1 : last + 1]] = True
        if (
            first > 1
            and last > first + 1
            and change[first - 2]
            and change[first - 1] > PACE * max(change[first - 2], usual)
        ):
            found[rows[first : last + 1]] = True  # it even jumped there, to zero, say
    return found
