"""A first look at every effect: how much of what is missing it explains, in a part of the
motion.

starts = likely(chain, setting, starts)     # those that are worth a column in every window

It takes a tenth of the time of such columns.
"""

import numpy as np

from diagnosis.estimation import windowing
from diagnosis.selection.beam import Beam
from diagnosis.selection.columns import Columns

ROWS = 300  # that are looked at, evenly chosen
GLANCES = 8, 0.3  # beginnings of windows that are, s, for effects of which no single row tells
ODD = 5.0  # of its usual size, beyond which what is missing in a row counts no more
LEAST = 0.05  # of its RMS, that its usual size is taken to be
ROUNDS, EACH = 3, 12  # looks, beside the best of those before, and candidates that each keeps


def likely(chain, setting, starts):
    """Of Starts, the best ones of those candidates that explain most alone, or beside the best:
    friction shows in a model with a wrong damping only beside that.

    What acts within a row is asked a row ahead. Effects with states of their own or of the sensors
    are asked in short windows, as is what changes nothing in the rows, and everything where the
    motion mostly touches something. Kept are the effects of the setting as well.
    """
    free = chain.begin[~chain.trajectory.free[chain.begin]]
    touches = 2 * len(free) < len(chain.begin)
    kept = [start for start in starts if start.candidate in setting]
    new = [start for start in starts if start.candidate not in setting]
    in_rows, in_windows, some = [], [], []
    for start in new:
        (in_windows if touches or chain.apart(start.candidate) else in_rows).append(start)
    if in_rows:
        target, bases = _bases(chain, setting, in_rows, free[windowing.evenly(len(free), ROWS)])
        in_windows += [start for start in in_rows if start not in bases]
        some = _by_rows(target, bases)
    if in_windows:
        some += _by_windows(chain.beginnings(*GLANCES), setting, kept, in_windows)
    return kept + some


def _best(gains):
    """Of {Start: gain}, [[Start, ...]] of the candidates that are kept, best first: of each the
    best in proportion and the best of its whole values."""
    best = {}
    for start in sorted(gains, key=lambda start: -gains[start]):
        best.setdefault(start.candidate, {}).setdefault(start.whole, start)
    return [list(each.values()) for each in best.values()][:EACH]


def _by_rows(target, bases):
    """The Starts whose bases explain most of a target (n,)."""
    kept, beside = {}, np.zeros((len(target), 0))
    for _ in range(ROUNDS if bases else 0):
        both = {start: np.concatenate([beside, basis], 1) for start, basis in bases.items()}
        best = _best({start: explained(basis, target) for start, basis in both.items()})
        kept |= dict.fromkeys(sum(best, []))
        beside = both[best[0][0]]
    return list(kept)


def _by_windows(short, setting, inside, starts):
    """The Starts that gain most in the windows of a short Chain, beside those inside a setting."""
    columns = Columns(short, setting, inside + starts)
    beam = Beam(columns, columns.evidence())
    node, kept = beam.node(beam.kept), {}
    for _ in range(ROUNDS if beam.free else 0):
        gains = beam.gains(node)
        best = _best({columns.begun[k]: gains[k] for k in beam.free})
        kept |= dict.fromkeys(sum(best, []))
        node = beam.node((*node.options, columns.begun.index(best[0][0])))
    return list(kept)


def _bases(chain, setting, starts, rows):
    """(target (n,), {Start: basis (n, k)}): what is missing in some rows of all dofs, and how
    starts change it."""
    dofs, bases = chain.model.nv + np.flatnonzero(np.isfinite(chain.noise)), {}
    plain = chain.plain(setting)
    gap = chain.missing(plain, rows)[:, dofs]
    usable = np.isfinite(gap).all(1)
    rows, gap = rows[usable], gap[usable]
    size = 1.4826 * np.median(abs(gap), 0) + LEAST * np.sqrt(np.mean(gap**2, 0)) + 1e-12
    weight = 1 / np.maximum(size, abs(gap) / ODD)
    for start in starts:
        changes = [gap - chain.missing(s, rows)[:, dofs] for s in start.settings(plain)]
        moved = [(change * weight).ravel() for change in changes]
        basis = [m / abs(m).max() for m in moved if m.any()]
        if basis and np.isfinite(basis).all():
            bases[start] = np.stack(basis, 1)
    return (gap * weight).ravel(), bases


def explained(basis, target):
    """Share of the squares of a target (n,) that columns (n, k) explain."""
    left = target - basis @ np.linalg.lstsq(basis, target, rcond=None)[0]
    return 1 - left @ left / (target @ target + 1e-300)
