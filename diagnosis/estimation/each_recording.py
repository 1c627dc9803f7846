"""The value that each recording alone asks for, about the values fitted to all.

asked = each_recording(fitted)      # {candidate: [(recording, parameter, value, half width,
error)]}
"""

from types import SimpleNamespace

import numpy as np
from scipy import stats

from diagnosis.estimation.intervals import half_widths

FEWEST = 4  # windows of a recording, from which on its own value is told


def each_recording(fitted, make_evidence):
    """Values by recording of a Fitted set: one Gauss-Newton step of its windows alone.

    make_evidence(ahead, residual, columns): the criterion's Evidence. Returns {candidate:
    [(recording
    name, parameter index, value, half width of the 95 % interval)]} where two recordings or more
    tell.
    """
    ahead, columns, out = fitted.columns.ahead, fitted.columns, {}
    array = columns.array
    for recording in dict.fromkeys(w.recording for w in ahead.windows):
        mine = np.flatnonzero([w.recording is recording for w in ahead.windows])
        if len(mine) < FEWEST:
            continue
        part = SimpleNamespace(
            group=np.arange(len(mine)),
            band=ahead.band[mine],
            known=ahead.known[mine],
            channels=ahead.channels,
            noise=ahead.noise,
        )
        evidence = make_evidence(part, columns.residual[mine], array[mine])
        _told(fitted, evidence, recording.name, out)
    return {c: rows for c, rows in out.items() if len({name for name, *_ in rows}) > 1}


def _told(fitted, evidence, name, out):
    """Add a recording's values to `out`."""
    options = fitted.columns.options
    if not options:
        return
    index = np.concatenate([[0], *[np.array(o.columns) + 1 for o in options]]).astype(int)
    half, moves = half_widths(evidence, index)
    at = 0
    for option in options:
        for row in option.directions:
            k = int(np.flatnonzero(row)[0])
            value = fitted.setting[option.candidate][k] + moves[at] * row[k]
            width = half[at] * abs(row[k])
            if np.isfinite(width) and width > 0:
                out.setdefault(option.candidate, []).append((name, k, float(value), float(width)))
            at += 1


def p_of_constancy(rows):
    """p of Cochran's Q that the values (value, half width) of one parameter are one."""
    values, halves = (np.array(x) for x in zip(*rows))
    weights = (1.96 / halves) ** 2
    mean = weights @ values / weights.sum()
    return float(stats.chi2.sf(weights @ (values - mean) ** 2, len(values) - 1))
