"""Locate: the states of the recorded motion, and the generalized force that the simulator lacks,
over time.

smoother = Smoother(world, recordings)
trajectory = smoother.locate({})              # under the nominal model; later under a corrected one
trajectory.force, trajectory.force_sd         # (rows, nv)

x' = f(x, u) + B w with w a random walk in every joint, y = x + noise; Gauss-Newton around a Kalman
smoother over blocks of rows. Variances of w and of the noise by maximum likelihood, the noise not
below what differences of the recordings show. Where something touches, no smooth map tells of a
force: there a velocity wanders at random, by as much as it was recorded to change.
"""

from copy import copy
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from diagnosis.effects.base import HINGE, SLIDE, runge_kutta
from diagnosis.effects.environment import collides
from diagnosis.estimation import windowing
from diagnosis.estimation.kalman import smooth
from diagnosis.estimation.readings import behind, later, measurement_noise, shown
from diagnosis.simulation.rows import RowMap, coarse

LONGER = 4  # times the simulator's own step, what one is at most for how small changes go on
BLOCK, LEAD = 200, 40  # rows that are smoothed as one piece, and beside them on either side
PASSES = 3, 2  # of Gauss-Newton, from the recordings, and from another trajectory
UPDATES = 3  # of the variances in each
MOST = 10.0  # factor of a variance in one update
LOUDER = 20.0  # noise is at most so many times what differences of readings show
REACH = 2.0  # deviations of a position, within which something may touch
STILL = 1e-6  # rad or m, and per second: noise of readings that are always the same
WANDERS = 0.3  # share of a joint's usual forces by which w first may wander in 0.1 s


@dataclass(frozen=True)
class Trajectory:
    """Smoothed motion of recordings as their sensors show it, rows of all of them one after the
    other.

    qpos (rows, nq), qvel (rows, nv); force (rows, nv): what the simulator lacks, mean over the row
    that follows; qpos_sd, qvel_sd, force_sd (rows, nv); first: {recording: its first row}; free
    (rows,): where something touches, and no force is told; transition (rows, 2 nv, 2 nv): to the
    next row, of small changes; step: the simulator's, s, 0 if unknown; driven (rows, 2 nv, nv): by
    forces, None if unknown.
    """

    qpos: np.ndarray
    qvel: np.ndarray
    force: np.ndarray
    qpos_sd: np.ndarray
    qvel_sd: np.ndarray
    force_sd: np.ndarray
    first: dict
    free: np.ndarray
    transition: np.ndarray
    step: float = 0.0
    driven: np.ndarray = None

    def at(self, windows):
        """Start states of windows: qpos (W, nq), qvel (W, nv)."""
        rows = self.begin(windows)
        return self.qpos[rows], self.qvel[rows]

    def begin(self, windows):
        """The first row (W,) of each window."""
        return np.array([self.first[w.recording] + w.first for w in windows], int)

    def rows(self, recording):
        """The slice of a recording's rows."""
        return slice(self.first[recording], self.first[recording] + len(recording.time))

    def direction(self):
        """The sign of each velocity (rows, nv), as friction has it, as far as it is known."""
        return np.tanh(self.qvel / np.maximum(self.qvel_sd, 1e-9))

    def located(self):
        """(RMS (nv,) of the force, and of its standard deviation), where nothing touches."""
        rows = ~self.free
        if not rows.any():
            return np.zeros(self.force.shape[1]), np.ones(self.force.shape[1])
        size = lambda force: np.sqrt(np.mean(force[rows] ** 2, 0))
        return size(self.force), size(self.force_sd)


class Smoother:
    """Smooths recordings under any setting. position_noise, velocity_noise (nv,): standard
    deviations, once located."""

    def __init__(self, world, recordings):
        self.world, self.model, self.recordings = world, world.model, list(recordings)
        model = self.model
        lengths = [len(r.time) for r in recordings]
        starts = np.cumsum([0] + lengths)
        self.first = dict(zip(self.recordings, (int(a) for a in starts[:-1])))
        velocities = [_measured_velocity(model, r) for r in recordings]
        told = [replace(r, qvel=qvel) for r, qvel in zip(recordings, velocities)]
        states = [windowing.states(model, r) for r in told]
        self.qpos, self.qvel = (np.concatenate(x) for x in zip(*states))
        read = np.isfinite(np.concatenate([r.qpos for r in recordings]))
        self.position = windowing.difference(model, self.qpos, np.where(read, self.qpos, np.nan))
        self.velocity = np.concatenate(velocities)
        self._blocks(starts)
        self.jumps = self._jumps()
        self.floor = self._floors(recordings)
        self.R = self.floor.copy()
        self.scale = self._scale()
        ((step, (seconds,)),) = coarse(world, recordings).items()
        self.few = {step: (min(seconds, LONGER * model.opt.timestep),)}
        self.walk = (WANDERS * self.scale) ** 2 / 0.1
        self.position_noise, self.velocity_noise = self._noise()

    def _blocks(self, starts):
        """Cut all rows into blocks that overlap: index (rows of a block, blocks), live where a row
        is no padding, own where it is taken from this block. What a block knows of its ends without
        its neighbour would be a jump between the two."""
        blocks = []
        for a, b in zip(starts[:-1], starts[1:]):
            edges = np.linspace(a, b, max(1, round((b - a) / BLOCK)) + 1).astype(int)
            first, end = edges[:-1], edges[1:]
            blocks.append([first, end, np.maximum(first - LEAD, a), np.minimum(end + LEAD, b)])
        first, end, begin, over = np.concatenate(blocks, 1)
        rows = begin + np.arange((over - begin).max())[:, None]
        self.index, self.live = np.minimum(rows, over - 1), rows < over
        self.own = (rows >= first) & (rows < end)
        self.last = np.zeros(starts[-1], bool)
        self.last[starts[1:] - 1] = True  # of a recording: nothing follows
        self.before = np.cumsum(~self.last) - 1  # place among the rows that have a next one

    def _jumps(self):
        """By how much, squared, each velocity (rows, nv) changes as recorded, on the way to the
        next row and those about it: in differences of positions a blow is spread over as many."""
        squares = np.zeros_like(self.qvel)
        squares[:-1] = np.diff(self.qvel, axis=0) ** 2
        squares[self.last] = 0.0
        around = np.concatenate([squares[:1], squares, squares[-1:]])
        return (around[:-2] + around[1:-1] + around[2:]) / 3

    def _floors(self, recordings):
        position, velocity = measurement_noise(self.model, recordings)
        floor = np.concatenate([position, velocity])
        known = np.isfinite(np.concatenate([self.position, self.velocity], 1)).any(0)
        told, still = np.isfinite(floor), np.where(known, STILL, 1.0)
        self.told = told & known  # channels of which there is enough to tell their noise
        return np.where(told, np.maximum(floor, 1e-12), still) ** 2

    def _noise(self):
        out = np.where(self.told, np.sqrt(self.R), np.inf)
        return [windowing.pooled(self.model, x) for x in np.split(out, 2)]

    def _scale(self):
        """Usual generalized force in each dof (nv,): what holds it and what turns it round in 0.2
        s."""
        model, data = self.model, mujoco.MjData(self.model)
        some, held = windowing.evenly(len(self.qpos), 200), []
        for row in some:
            data.qpos[:], data.qvel[:] = self.qpos[row], self.qvel[row]
            mujoco.mj_forward(model, data)
            held.append(abs(data.qfrc_bias) + abs(data.qfrc_actuator) + abs(data.qfrc_passive))
        speed = np.quantile(abs(self.qvel), 0.7, axis=0)
        scale = np.mean(held, axis=0) + model.dof_M0 * (speed + 1e-3) / 0.2
        return np.maximum(scale, 1e-3 * scale.max())

    def locate(self, setting, trajectory=None, passes=None):
        """The Trajectory under a setting {Candidate: values}, begun at another one if given."""
        rows = RowMap(self.world, self.recordings, setting)
        few = RowMap(self.world, self.recordings, {**self.few, **setting})
        if trajectory is None:
            qpos, qvel, force = self.qpos, self.qvel, np.zeros_like(self.qvel)
        else:
            qpos, qvel, force = trajectory.qpos, trajectory.qvel, trajectory.force
        off = self.model, setting, self.recordings
        qpos, qvel = behind(*off, qpos, qvel)
        # of the motion behind what the recordings show, and as far as that was measured
        told = (later(*off, x) for x in (self.position, self.velocity))
        seen = *behind(*off, self.qpos, self.qvel), *told
        qpos_sd = np.sqrt(self.R[: self.model.nv]) if trajectory is None else trajectory.qpos_sd
        for _ in range(passes or PASSES[trajectory is not None]):
            free = touching(self.model, qpos, REACH * qpos_sd)
            step = self._linear((rows, few), qpos, qvel, force, free)
            for _ in range(UPDATES):
                found = self._smooth(step, qpos, qvel, seen)
                self._update(found)
            found = self._smooth(step, qpos, qvel, seen)
            nv, own = self.model.nv, self.own
            state, deviation = (np.empty((len(qpos), 3 * nv)) for _ in range(2))
            state[self.index[own]] = found.state[own]
            deviation[self.index[own]] = np.sqrt(found.variance[own])
            qpos_sd = deviation[:, :nv]
            qpos = windowing.integrate(self.model, qpos, state[:, :nv])
            qvel, force = qvel + state[:, nv : 2 * nv], state[:, 2 * nv :]
        qpos, qvel = shown(*off, qpos, qvel)
        self.position_noise, self.velocity_noise = self._noise()
        sd = np.split(deviation, 3, axis=1)
        transition = np.tile(np.eye(2 * nv, 3 * nv), (len(qpos), 1, 1))
        transition[~self.last] = step[0][:, : 2 * nv]
        split = np.split(transition, [2 * nv], axis=2)
        args = qpos, qvel, force, *sd, self.first, free, split[0], rows.case.step, split[1]
        return Trajectory(*args)

    def _linear(self, maps, qpos, qvel, force, free):
        """(A, c, jumps, seconds) of every row that has a next one: transitions of (q, v, w) about a
        trajectory; the variance (n, nv) by which a velocity changes on its way, where nothing is
        known of that; its length, s. maps: RowMaps in the simulator's steps, which tell where the
        motion goes, and in few of them, for how small changes go on."""
        model, nv, (rows, few) = self.model, self.model.nv, maps
        now = ~self.last
        q, v = rows.ahead(np.arange(now.sum()), qpos[now], qvel[now], force[now])
        A, B = few.linearised(qpos[now], qvel[now], force[now], self.scale, free[now])
        if not runge_kutta(model):
            A, B = _in_own_steps(A, B, (few.case.step - rows.case.step) / 2 / rows.seconds)
        begin = np.flatnonzero(now)
        n, after = len(begin), begin + 1
        with np.errstate(invalid="ignore", over="ignore"):
            moved = windowing.difference(model, qpos[after], q), v - qvel[after]
            drift = np.concatenate(moved, 1) - np.einsum("nij,nj->ni", B, force[now])
        bad = free[now] | ~np.isfinite(drift).all(1) | ~np.isfinite(A).all((1, 2))
        seconds = rows.seconds[bad]
        A[bad], B[bad] = np.eye(2 * nv), 0.0
        A[bad, :nv, nv:] = np.eye(nv) * seconds[:, None, None]
        glide = windowing.integrate(model, qpos[now][bad], qvel[now][bad] * seconds[:, None])
        drift[bad, :nv] = windowing.difference(model, qpos[after][bad], glide)
        drift[bad, nv:] = qvel[now][bad] - qvel[after][bad]
        jumps = np.where(bad[:, None], self.jumps[begin], 0.0)
        whole = np.zeros((n, 3 * nv, 3 * nv))
        whole[:, : 2 * nv, : 2 * nv], whole[:, : 2 * nv, 2 * nv :] = A, B
        whole[:, 2 * nv :, 2 * nv :] = np.eye(nv)
        return whole, np.concatenate([drift, np.zeros((n, nv))], 1), jumps, rows.seconds

    def _smooth(self, step, qpos, qvel, seen):
        A, c, jumps, seconds = step
        nv, (T, b) = self.model.nv, self.index.shape
        follows = self.live & ~self.last[self.index]
        follows[:-1] &= self.live[1:]
        follows[-1] = False
        at = np.where(follows, self.before[self.index], 0)
        transition = np.where(follows[..., None, None], A[at], np.eye(3 * nv))
        drift = np.where(follows[..., None], c[at], 0.0)
        noise, each = np.zeros((T, b, 3 * nv, 3 * nv)), np.arange(nv)
        jumps, seconds = jumps[at], seconds[at][..., None]
        # a velocity that wanders at random on its way takes the position along
        noise[..., each, each] = seconds**2 / 3 * jumps
        noise[..., each, nv + each] = noise[..., nv + each, each] = seconds / 2 * jumps
        noise[..., nv + each, nv + each] = jumps
        noise[..., 2 * nv + each, 2 * nv + each] = self.walk * seconds
        noise[~follows] = 0.0
        seen_qpos, seen_qvel, position, velocity = seen
        gap = windowing.difference(self.model, qpos, seen_qpos)
        offset = np.concatenate([gap, seen_qvel - qvel], 1)
        y = np.concatenate([gap + position, velocity - qvel], 1)
        y = np.where(self.live[..., None], y[self.index], np.nan)
        first = self.index[0]
        start = np.concatenate([offset[first], np.zeros((b, nv))], 1)
        away = (0.05 * np.std(self.qpos, axis=0).max() + 10 * np.sqrt(self.R[:nv])) ** 2
        spread = np.concatenate([away, np.var(self.qvel, axis=0) + 1e-6, self.scale**2])
        spread = np.tile(spread, (b, 1))
        return smooth(transition, drift, noise, y, self.R, start, spread)

    def _update(self, found):
        """Move every variance to where its score is nearer to zero."""
        nv = self.model.nv
        ratio = lambda pair: np.clip(pair[0] / np.maximum(pair[1], 1e-300), 1 / MOST, MOST)
        self.walk = np.maximum(self.walk * ratio(found.process)[2 * nv :], 1e-12 * self.scale**2)
        known = found.measurement[1] > 0
        moved = self.R * ratio(found.measurement)
        moved = np.clip(moved, self.floor, LOUDER**2 * self.floor)
        self.R = np.where(known, moved, self.R)


def _in_own_steps(A, B, share):
    """Transitions in few steps as they are in the simulator's own. Where positions move by a step's
    new velocity, a velocity is that of half a step before its time. share (n,): by how much more of
    the row that is in few steps."""
    nv = B.shape[2]
    same, ends = np.eye(3 * nv), np.zeros((len(A), nv, 3 * nv))
    ends[:, :, 2 * nv :] = np.eye(nv)
    whole = np.concatenate([np.concatenate([A, B], 2), ends], 1)
    sooner = np.zeros_like(whole)
    sooner[:, nv : 2 * nv] = share[:, None, None] * (whole - same)[:, nv : 2 * nv]
    return np.split(((same + sooner) @ whole @ (same - sooner))[:, : 2 * nv], [2 * nv], axis=2)


def _measured_velocity(model, recording):
    """qvel (T, nv) of a recording, NaN where it is not measured: of joints whose velocities are
    filtered differences of the positions, which are late and tell nothing more."""
    qvel, quality = np.array(recording.qvel, float), recording.quality
    for j, _, _, v in windowing.joint_slices(model):
        if quality and windowing.joint_name(model, j) in quality.differenced:
            qvel[:, v] = np.nan
    return qvel


def touching(model, qpos, reach):
    """Rows (N,) of positions (N, nq) at or after which something touches, or a joint lies at the
    end of its travel. reach (nv,) or (N, nv): how far each coordinate may be off."""
    reach = np.broadcast_to(reach, (len(qpos), model.nv))
    ends = (model.jnt_limited != 0) & np.isin(model.jnt_type, (HINGE, SLIDE))
    at, off = qpos[:, model.jnt_qposadr[ends]], reach[:, model.jnt_dofadr[ends]]
    low, high = model.jnt_range[ends].T
    touch = ((at < low + off) | (at > high - off)).any(1)
    if collides(model):
        touch |= _near(model, qpos, reach)
    return touch | np.append(touch[1:], False)


def _near(model, qpos, reach):
    """Rows (N,) in which a contact may be made, as far as its distance is known."""
    wide = copy(model)  # which finds contacts before they are made
    most = np.linalg.norm(reach, axis=1).max(initial=0.0) * max(model.stat.extent, 1.0)
    wide.geom_margin[:] += most / 2  # those of two that touch are summed
    wide.flex_margin[:] += most / 2
    wide.pair_margin[:] += most
    data, out = mujoco.MjData(wide), np.zeros(len(qpos), bool)
    for row, (q, off) in enumerate(zip(qpos, reach)):
        data.qpos[:] = q
        mujoco.mj_kinematics(wide, data)
        mujoco.mj_comPos(wide, data)
        mujoco.mj_collision(wide, data)
        gaps = ((c, c.dist - c.includemargin + most) for c in data.contact)
        out[row] = any(gap < _off(model, data, c, off) for c, gap in gaps)
    return out


def _off(model, data, contact, reach):
    """How far a contact's distance, m, may be off where coordinates are by reach (nv,),
    independently; 0 of flexible bodies."""
    if min(contact.geom) < 0:
        return 0.0
    slope, jacobian = np.zeros(model.nv), np.empty((3, model.nv))
    for sign, body in zip((-1.0, 1.0), model.geom_bodyid[contact.geom]):
        mujoco.mj_jac(model, data, jacobian, None, contact.pos, body)
        slope += sign * contact.frame[:3] @ jacobian
    return float(np.linalg.norm(slope * reach))
