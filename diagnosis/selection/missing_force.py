"""The other direction: the force that the simulator lacks along the measured motion, and what of
it effects hold.

missing = MissingForce(chain, setting)
missing.basis(start)                    # (rows, dofs, p): what a Start holds of it
missing.evidence(starts).at([0], [0.1]) # the criterion's Score of what is lacking beside them
missing.scores({}, {friction: (0.1,)}) # the Scores of what settings lack

Errors in what a model is given pass for physics in predictions or in this, but not in both.
"""

from types import SimpleNamespace

import numpy as np

from diagnosis.estimation.ahead import GROUPS
from diagnosis.selection.criterion import Evidence

ODD = 5.0  # of its usual size, beyond which what is missing in a row counts no more
LEAST = 0.05  # of its RMS, that its usual size is taken to be


class MissingForce:
    """In rows of a Chain where nothing touches, under a setting. force (n, nv), in units of what is
    usual in each dof; noise (nv,): how well that is known; rows (n,): those of the Chain in which
    forces are compared, as many in each group."""

    def __init__(self, chain, setting, before=None):
        """before: a MissingForce in the same rows, from which what effects do there that neither
        setting has is taken over: a motion that is located anew hardly moves."""
        self.chain, self.setting = chain, setting
        self.rows = chain.telling()[: len(chain.telling()) // GROUPS * GROUPS]
        self.seen, self.plain = np.isfinite(chain.noise), chain.plain(setting)
        self.force, self.noise = self._lacking([setting])[..., 0], np.full(chain.model.nv, np.inf)
        self.done = {}
        if before and np.array_equal(before.rows, self.rows):
            known, inside = before.done.items(), {*setting, *before.setting}
            self.done = {key: done for key, done in known if key[0] not in inside}
        if len(self.rows):
            size = 1.4826 * np.median(abs(self.force), 0) + LEAST * rms(self.force) + 1e-12
            self.weight = np.where(self.seen, 1 / np.maximum(size, abs(self.force) / ODD), 0.0)
            self.force = self.force * self.weight
            sd = rms(chain.trajectory.force_sd[self.rows] * self.weight)
            self.noise = np.where(self.seen, sd, np.inf)
            # a joint that sticks obeys no force
            self.obeyed = np.linalg.pinv(chain.trajectory.driven[self.rows, chain.model.nv :])
            self.whole = self._pushed(self.plain)

    def _lacking(self, settings):
        """Generalized force (n, nv, settings) that settings lack in the rows, as the smoother
        locates it."""
        found = self.chain.lacking([self.chain.plain(setting) for setting in settings])
        return np.stack(found, -1)[: len(self.rows)]

    def _pushed(self, plain):
        """Generalized force (n, nv) that a plain setting lacks in each row, as it is."""
        lacks = self.chain.missing(plain, self.rows)[:, self.chain.model.nv :]
        return (self.obeyed @ lacks[..., None])[..., 0]

    def basis(self, start):
        """(n, nv, p): what a Start holds of the force, each row as it is; None where no row
        tells."""
        if self.chain.apart(start.candidate) or not len(self.rows):
            return None
        every = [self._done(s, start.candidate) for s in start.settings(self.plain)]
        moved = any(done.any() for done in every) and np.isfinite(every).all()
        return np.stack(every, -1) * self.weight[..., None] if moved else None

    def _done(self, plain, candidate):
        """(n, nv): what a candidate of a plain setting does, worked out once for its values."""
        key = candidate, plain[candidate]
        if key not in self.done:
            self.done[key] = self.whole - self._pushed(plain)
        return self.done[key]

    def evidence(self, starts):
        """The Evidence of the force and of what Starts hold of it, all their directions in turn,
        as the smoother would locate that."""
        bases = [self._held(start) for start in starts]
        return self._evidence(np.concatenate([self.force[..., None], *bases], -1))

    def _held(self, start):
        """(n, nv, p): what a Start holds, 0 where no row tells."""
        if self.chain.apart(start.candidate):
            return np.zeros((*self.force.shape, len(start.directions)))
        lacking = self._lacking(start.settings(self.setting)) * self.weight[..., None]
        return self.force[..., None] - lacking

    def _evidence(self, every):
        """Of the force and what is held of it (n, nv, 1 + p)."""
        every = every.reshape(GROUPS, len(every) // GROUPS, *every.shape[1:])
        groups = SimpleNamespace(  # as the windows of an Ahead that knows their states
            known=np.broadcast_to(self.seen, every.shape[:3]),
            band=np.zeros(every.shape[:2], int),
            group=np.arange(GROUPS),
            channels=self.chain.channels,
            noise=self.noise,
            freedom=lambda: np.zeros((*every.shape[:3], 0)),
        )
        return Evidence(groups, every[..., 0], every[..., 1:])

    def scores(self, *settings):
        """[Score] of the force that settings lack, or None where no row tells."""
        if not len(self.rows):
            return None
        lacking = self._lacking(settings) * self.weight[..., None]
        every = np.concatenate([self.force[..., None], self.force[..., None] - lacking], -1)
        evidence = self._evidence(every)
        return [evidence.at([k], np.ones(1)) for k in range(len(settings))]


def rms(x):
    """Of (n,), or of each column."""
    return np.sqrt(np.mean(x**2, 0))
