"""Does a set leave more than a perfect simulator would?

for each in lacking(fitted): each.gain, each.p_value      # one Comparison for each channel

A perfect simulator errs too: readings are noisy, so start states are not quite known, and a machine
may carry such errors far. Windows are drawn as they would be were the set true: begun at states as
far off as the smoother leaves them, and read with noise. What the set errs in the recordings is
compared with what it errs in those, by the one criterion.
"""

import numpy as np

from diagnosis.selection.criterion import Evidence, paired


def lacking(fitted, seed=0):
    """[Comparison] of each channel: what a perfect simulator would remove of the error of a Fitted
    set, start states free."""
    ahead, evidence = fitted.columns.ahead, fitted.evidence
    louder = np.ones(ahead.model.nv)
    for dofs, times in zip(ahead.channels, _louder(evidence)):
        louder[dofs] = times
    rng = np.random.default_rng(seed)
    drawn = ahead.drawn(fitted.setting, fitted.columns.residual, louder, rng)
    none = np.zeros((*drawn.shape, 0))
    perfect = Evidence(ahead, drawn, none, evidence.reference)
    scores = map(evidence.each_channel, (evidence.square, perfect.square))
    return [paired(before, after) for before, after in zip(*scores)]


def _louder(evidence):
    """Times the noise (channels,), at least one, that the shortest predictions err: a force that is
    missing hardly shows in them, but noise that is not white does."""
    count, square = (
        x.reshape(len(x), evidence.channels, -1)[:, :, 0] for x in (evidence.count, evidence.square)
    )
    noise = evidence.noise.reshape(evidence.channels, -1)[:, 0]
    mean = (count * square).sum(0) / np.maximum(count.sum(0), 1)
    return np.sqrt(np.maximum(mean / np.maximum(noise**2, 1e-300), 1.0))
