"""The other direction: the force that the simulator lacks along the measured motion, and what of
it effects hold.

missing = MissingForce(chain, setting)
missing.basis(start)                    # (rows, dofs, p): what a Start holds of it
missing.evidence(starts).at([0], [0.1]) # the criterion's Score of what is lacking beside them
missing.scores({}, {friction: (0.1,)}) # the Scores of what settings lack

Predictions run from forces to motion, this from motion to forces. Where the forces that a model is
given are measured, a joint that obeys them less is predicted better, and where a motion is noisy, a
joint that has less inertia lacks less force: errors in what is given pass for physics in one
direction, but not in both.
"""

import mujoco
import numpy as np

from diagnosis.estimation import windowing
from diagnosis.estimation.ahead import GROUPS
from diagnosis.selection.criterion import Evidence

ROWS = 19  # in each group, evenly chosen
ODD = 5.0  # of its usual size, beyond which what is missing in a row counts no more
LEAST = 0.05  # of its RMS, that its usual size is taken to be


class MissingForce:
    """In rows of a Chain where nothing touches, under a setting. lacking (n, nv), N m or N; force
    (n, nv), the same in units of what is usual in each dof; noise (nv,): how well that is known;
    free: all such rows, of which some are looked at."""

    def __init__(self, chain, setting, before=None):
        """before: a MissingForce in the same rows, from which what effects hold that neither
        setting has is taken over: a motion that is located anew hardly moves."""
        self.chain, self.setting = chain, setting
        self.plain, nv = chain.plain(setting), chain.model.nv
        trajectory = chain.trajectory
        self.free = chain.begin[~trajectory.free[chain.begin]]
        self.rows = self.free[windowing.evenly(len(self.free), GROUPS * ROWS)]
        force = self._force(self.plain)
        usable = np.flatnonzero(np.isfinite(force).all(1))
        usable = usable[: len(usable) // GROUPS * GROUPS]
        self.rows, force = self.rows[usable], force[usable]
        self.seen = np.isfinite(chain.noise)
        self.lacking, self.force, self.noise = force, force, np.full(nv, np.inf)
        self.added = {}
        if before and np.array_equal(before.rows, self.rows):
            known, inside = before.added.items(), {*setting, *before.setting}
            self.added = {key: held for key, held in known if key[0] not in inside}
        if len(usable):
            size = 1.4826 * np.median(abs(force), 0) + LEAST * rms(force) + 1e-12
            self.weight = np.where(self.seen, 1 / np.maximum(size, abs(force) / ODD), 0.0)
            self.force = force * self.weight
            sd = rms(trajectory.force_sd[self.rows] * self.weight)
            self.noise = np.where(self.seen, sd, np.inf)

    def _force(self, plain):
        """Generalized force (n, nv) that a plain setting lacks in the rows."""
        chain, nv = self.chain, self.chain.model.nv
        lacks = chain.missing(plain, self.rows)[:, nv:]
        model = chain.map.model  # of the setting just asked
        data, out = mujoco.MjData(model), np.empty_like(lacks)
        for row, qpos, gap in zip(out, chain.trajectory.qpos[self.rows], lacks):
            data.qpos[:] = qpos
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_mulM(model, data, row, gap)
        return out / chain.map.seconds[np.searchsorted(chain.map.begin, self.rows), None]

    def basis(self, start):
        """(n, nv, p): what a Start holds of the force; None where no row tells."""
        if self.chain.apart(start.candidate) or not len(self.rows):
            return None
        added = [self._added(s, start.candidate) for s in start.settings(self.plain)]
        moved = any(a.any() for a in added) and np.isfinite(added).all()
        return np.stack(added, -1) * self.weight[..., None] if moved else None

    def _added(self, plain, candidate):
        """(n, nv): what a candidate of a plain setting holds, worked out once for its values."""
        key = candidate, plain[candidate]
        if key not in self.added:
            self.added[key] = self._held(plain)
        return self.added[key]

    def _held(self, plain):
        """(n, nv): what a plain setting holds beyond that of this force."""
        return self.lacking - self._force(plain)

    def evidence(self, starts):
        """The Evidence of the force and of what Starts hold of it, all their directions in turn."""
        bases = [self.basis(start) for start in starts]
        none = [np.zeros((*self.force.shape, len(start.directions))) for start in starts]
        every = [zero if b is None else b for b, zero in zip(bases, none)]
        return self._evidence(np.concatenate([self.force[..., None], *every], -1))

    def _evidence(self, every):
        """Of the force and what is held of it (n, nv, 1 + p)."""
        every = every.reshape(GROUPS, len(every) // GROUPS, *every.shape[1:])
        return Evidence(Rows(every, self), every[..., 0], every[..., 1:])

    def scores(self, *settings):
        """[Score] of the force that settings lack, or None where no row tells."""
        if not len(self.rows):
            return None
        held = [self._held(self.chain.plain(setting)) * self.weight for setting in settings]
        evidence = self._evidence(np.stack([self.force, *held], -1))
        return [evidence.at([k], np.ones(1)) for k in range(len(held))]


def rms(x):
    """Of each column."""
    return np.sqrt(np.mean(x**2, 0))


class Rows:
    """Groups of rows as the windows of an Ahead that knows their states."""

    def __init__(self, values, missing):
        """values (G, rows, dofs, p)."""
        self.known = np.broadcast_to(missing.seen, values.shape[:3])
        self.band, self.group = np.zeros(values.shape[:2], int), np.arange(len(values))
        self.channels, self.noise = missing.chain.channels, missing.noise

    def freedom(self):
        return np.zeros((*self.known.shape, 0))
