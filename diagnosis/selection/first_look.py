"""A first look at every effect: how much of what is missing it explains, in a part of the
motion.

starts = likely(missing, starts)        # those that are worth a column in every window
"""

import numpy as np

from diagnosis.selection.beam import Beam
from diagnosis.selection.columns import Columns

GLANCES = 8, 0.3  # beginnings of windows that are, s, for effects of which no single row tells
MORE, EACH = 2, 10  # looks beside the best of those before, more than joints; new ones in each


def likely(missing, starts):
    """Of Starts, the best ones of those candidates that explain most alone, or beside the best, a
    row ahead, or in short windows where no row tells or the motion mostly touches something. Kept
    are the effects of the setting as well, and waves, which the located force has chosen."""
    chain, setting = missing.chain, missing.setting
    chosen = lambda start: start.candidate in setting or start.merges
    kept = [start for start in starts if chosen(start)]
    new = [start for start in starts if not chosen(start)]
    in_rows, in_windows, some = [], [], []
    rounds = len(chain.channels) + MORE
    for start in new:
        (in_windows if chain.touches or chain.apart(start.candidate) else in_rows).append(start)
    if in_rows:
        bases = {start: missing.basis(start) for start in in_rows}
        in_windows += [start for start in in_rows if bases[start] is None]
        some = _by_rows(missing.force, {s: b for s, b in bases.items() if b is not None}, rounds)
    if in_windows:
        some += _by_windows(chain.beginnings(*GLANCES), setting, kept, in_windows, rounds)
    return [*dict.fromkeys([*kept, *some])]  # a wave may be among the best in windows as well


def _best(gains, kept):
    """(the best of {Start: gain}, further Starts to be kept beside some): of the best candidates
    that are not kept yet the best in proportion and the best of its whole values."""
    order = sorted(gains, key=lambda start: -gains[start])
    best, known = {}, {start.candidate for start in kept}
    for start in order:
        if start.candidate not in known:
            best.setdefault(start.candidate, {}).setdefault(start.whole, start)
    return order[0], [start for each in list(best.values())[:EACH] for start in each.values()]


def _by_rows(target, bases, rounds):
    """The Starts whose bases (n, dofs, p) explain most of a target (n, dofs)."""
    kept, target = {}, target.ravel()
    bases = {start: basis.reshape(len(target), -1) for start, basis in bases.items()}
    for _ in range(rounds if bases else 0):
        gains = {start: explained(basis, target) for start, basis in bases.items()}
        best, further = _best(gains, kept)
        kept |= dict.fromkeys(further)
        beside = np.linalg.qr(bases[best])[0]
        rest = lambda x: x - beside @ (beside.T @ x)
        target, bases = rest(target), {start: rest(basis) for start, basis in bases.items()}
    return list(kept)


def _by_windows(short, setting, inside, starts, rounds):
    """The Starts that gain most in the windows of a short Chain, beside those inside a setting."""
    columns = Columns(short, setting, inside + starts)
    beam = Beam(columns, columns.evidence())
    node, kept = beam.node(beam.kept), {}
    for _ in range(rounds):
        others = beam.others(node)
        # within the bounds of their amounts: a column tells of no values far from its own
        grown = beam.nodes_of([(*node.options, k) for k in others])
        gains = {columns.begun[k]: node.unpriced - new.unpriced for k, new in zip(others, grown)}
        if not gains:
            break
        best, further = _best(gains, kept)
        kept |= dict.fromkeys(further)
        node = beam.node((*node.options, columns.begun.index(best)))
    return list(kept)


def explained(basis, target):
    """Share of the squares of a target (n,) that columns (n, k) explain."""
    left = target - basis @ np.linalg.lstsq(basis, target, rcond=None)[0]
    return 1 - left @ left / (target @ target + 1e-300)
