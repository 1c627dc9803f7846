"""Residuals and columns without a simulator behind them: what tests of the criterion share."""

from types import SimpleNamespace

import numpy as np

from diagnosis.selection.criterion import Evidence


def scene(groups=16, windows=3, rows=20, channels=1, bands=1, noise=1e-3, begun=None):
    """As much of an Ahead as an Evidence reads: groups of windows, all rows measured. begun (W,
    rows, channels, m): what start states change, nothing by default."""
    W = groups * windows
    return SimpleNamespace(
        group=np.repeat(np.arange(groups), windows),
        band=np.tile(np.arange(rows) * bands // rows, (W, 1)),
        known=np.ones((W, rows, channels), bool),
        channels=[np.array([c]) for c in range(channels)],
        noise=np.full(channels, noise),
        freedom=lambda: np.zeros((W, rows, channels, 0)) if begun is None else begun,
    )


def clustered(rng, ahead, extra=(), share=0.5):
    """Unit noise (W, rows, channels, *extra) of which a share is common to a group."""
    shape = (*ahead.known.shape, *extra)
    common = rng.normal(size=(ahead.group.max() + 1, 1, *shape[2:]))[ahead.group]
    return np.sqrt(share) * common + np.sqrt(1 - share) * rng.normal(size=shape)


def free(evidence, columns):
    """Score of columns without bounds and priors."""
    wide = np.full(len(columns), np.inf)
    return evidence.score(columns, -wide, wide, 0 * np.ones(len(wide)), 0 * np.ones(len(wide)))


def evidence_of(ahead, residual, columns):
    return Evidence(ahead, residual, columns)
