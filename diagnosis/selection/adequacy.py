"""Does a set leave more than a perfect simulator would?

shares = share_left(fitted)        # of what the nominal model errs beyond that, in each channel
for each in lacking(fitted): each.gain, each.p_value      # one Comparison for each channel

What it errs in the recordings is compared with what it errs in windows drawn as if it were true:
begun at states as far off as the smoother leaves them, and read with noise.
"""

import numpy as np

from diagnosis.selection.criterion import BEYOND, Evidence, paired


def share_left(fitted):
    """Share (channels,) of the nominal model's error that a Fitted set leaves, both beyond what a
    perfect simulator errs; NaN where the nominal model hardly errs by more than that."""
    evidence, seen = fitted.evidence, fitted.evidence.count > 0
    floor = np.maximum(_perfect(fitted).square, evidence.noise**2)
    each = lambda x: np.where(seen, x, 0.0).reshape(len(x), evidence.channels, -1).sum((0, 2))
    excess = lambda x: each(np.maximum(x - floor, 0.0))
    before, after = excess(evidence.reference), excess(evidence.square)
    told = each(evidence.reference) > BEYOND**2 * each(floor)
    return np.sqrt(after / np.where(told, before, np.nan))


def channel(fitted, dof):
    """Index of the channel that a degree of freedom belongs to."""
    return [dof in dofs for dofs in fitted.columns.ahead.channels].index(True)


def lacking(fitted):
    """[Comparison] of each channel: what a perfect simulator would remove of the error of a Fitted
    set, start states free."""
    evidence = fitted.evidence
    scores = map(evidence.each_channel, (evidence.square, _perfect(fitted).square))
    return [paired(before, after) for before, after in zip(*scores)]


def _perfect(fitted, seed=0):
    """The Evidence of windows drawn as a perfect simulator would predict them."""
    ahead, evidence = fitted.columns.ahead, fitted.evidence
    louder = np.ones(ahead.model.nv)
    for dofs, times in zip(ahead.channels, _louder(evidence)):
        louder[dofs] = times
    rng = np.random.default_rng(seed)
    drawn = ahead.drawn(fitted.setting, fitted.columns.residual, louder, rng)
    return Evidence(ahead, drawn, np.zeros((*drawn.shape, 0)), evidence.reference)


def _louder(evidence):
    """Times the noise (channels,), at least one, that the shortest predictions err: a force that is
    missing hardly shows in them, but noise that is not white does."""
    count, square = (
        x.reshape(len(x), evidence.channels, -1)[:, :, 0] for x in (evidence.count, evidence.square)
    )
    noise = evidence.noise.reshape(evidence.channels, -1)[:, 0]
    mean = (count * square).sum(0) / np.maximum(count.sum(0), 1)
    return np.sqrt(np.maximum(mean / np.maximum(noise**2, 1e-300), 1.0))
