"""A first look at every candidate: how much of what is missing it explains, a row ahead.

kept = likely(chain, setting, starts)     # the candidates that are worth a column in every row

It takes a tenth of the time of such columns.
"""

import numpy as np

from diagnosis.estimation import windowing

ROWS = 300  # that are looked at, evenly chosen
ODD = 5.0  # of its usual size, beyond which what is missing in a row counts no more
LEAST = 0.05  # of its RMS, that its usual size is taken to be
ROUNDS, EACH = 3, 12  # looks, beside the best of those before, and candidates that each keeps


def likely(chain, setting, starts):
    """Of the candidates of starts [(candidate, base, directions, ...)], those that explain most
    alone, or beside the best: friction shows in a model with a wrong damping only beside that.

    Kept is also what no row tells of: effects with states of their own or of the sensors, those
    that change nothing in these rows or end in nothing finite; and everything, of a motion that
    mostly touches something.
    """
    every = {start[0] for start in starts}
    free = chain.begin[~chain.trajectory.free[chain.begin]]
    if 2 * len(free) < len(chain.begin):
        return every
    target, bases = _bases(chain, setting, starts, free[windowing.evenly(len(free), ROWS)])
    kept, beside = every - {candidate for candidate, _ in bases}, np.zeros((len(target), 0))
    for _ in range(ROUNDS):
        best = {}
        for candidate, basis in bases:
            found = explained(np.concatenate([beside, basis], 1), target)
            if found > best.get(candidate, (-1.0,))[0]:
                best[candidate] = found, basis
        ranked = sorted(best, key=lambda c: -best[c][0])
        kept |= set(ranked[:EACH])
        if ranked:
            beside = np.concatenate([beside, best[ranked[0]][1]], 1)
    return kept


def _bases(chain, setting, starts, rows):
    """(target (n,), [(candidate, basis (n, k))]): what is missing in some rows of all dofs, and how
    starts change it."""
    dofs, bases = chain.model.nv + np.flatnonzero(np.isfinite(chain.noise)), []
    plain = chain.plain(setting)
    gap = chain.missing(plain, rows)[:, dofs]
    usable = np.isfinite(gap).all(1)
    rows, gap = rows[usable], gap[usable]
    size = 1.4826 * np.median(abs(gap), 0) + LEAST * np.sqrt(np.mean(gap**2, 0)) + 1e-12
    weight = 1 / np.maximum(size, abs(gap) / ODD)
    for candidate, base, directions, *_ in starts:
        if candidate in setting or chain.apart(candidate):
            continue
        settings = [{**plain, candidate: tuple(base + row)} for row in directions]
        moved = [((gap - chain.missing(s, rows)[:, dofs]) * weight).ravel() for s in settings]
        basis = [m / abs(m).max() for m in moved if m.any()]
        if basis and np.isfinite(basis).all():
            bases.append((candidate, np.stack(basis, 1)))
    return (gap * weight).ravel(), bases


def explained(basis, target):
    """Share of the squares of a target (n,) that columns (n, k) explain."""
    left = target - basis @ np.linalg.lstsq(basis, target, rcond=None)[0]
    return 1 - left @ left / (target @ target + 1e-300)
