"""The force that the simulator lacks along the measured motion, what of it effects hold, and what
it depends on where no name holds it.

missing = MissingForce(chain, setting)
missing.basis(start)                    # (rows, dofs, p): what a Start holds of it
for found in dependences(world, trajectory, recordings): found.joint, found.candidate
"""

from dataclasses import dataclass

import numpy as np

from diagnosis.effects.base import HINGE, SLIDE
from diagnosis.effects.drives import drives_of
from diagnosis.effects.unmodelled import asked, reader
from diagnosis.estimation import windowing

ROWS = 300  # in which forces are looked at, at most
STICKS = 0.1  # of the usual effect of a force on a joint, below which it sticks in a row
ODD = 5.0  # of its usual size, beyond which what is missing in a row counts no more
SMALLEST = 0.05  # of its RMS, that its usual size is taken to be
FINE, KNOTS = 33, 9  # places over the range where a curve may bend, and values that it has at most
BLOCKS = 16  # stretches of time that are left out in turn
# share of the located force's variance, predicted on stretches left out, that a curve must explain
LEAST = 0.03
# periods over the travel, or a recording, from, to and by, of forces that come and go
WAVES = 1.0, 30.0, 0.1
# radians of such a wave for each of the variable's own unit, at least: gravity has one a radian
SLOWEST = 2.0
SAMPLED = 2000  # rows in which these are looked for
CLIP = 5.0  # of the usual size, beyond which a located force counts no more


class MissingForce:
    """In rows of a Chain where nothing touches, under a setting. force (n, nv), in units of what is
    usual in each dof; rows (n,): those of the Chain that are looked at."""

    def __init__(self, chain, setting, before=None):
        """before: a MissingForce in the same rows, from which what effects do there that neither
        setting has is taken over: a motion that is located anew hardly moves."""
        self.chain, self.setting, self.plain = chain, setting, chain.plain(setting)
        self.rows = chain.used[windowing.evenly(len(chain.used), ROWS)]
        self.done, t = {}, chain.trajectory
        if before and np.array_equal(before.rows, self.rows):
            known, inside = before.done.items(), {*setting, *before.setting}
            self.done = {key: done for key, done in known if key[0] not in inside}
        if len(self.rows):
            driven = t.driven[self.rows, chain.model.nv :]
            moves = np.linalg.norm(driven, axis=1)
            sticks = moves < STICKS * rms(moves)  # a joint that sticks obeys no force
            self.obeyed = np.where(sticks[..., None], 0.0, np.linalg.pinv(driven))
            self.whole = self._pushed(self.plain)
            # it was located under the chain's own setting
            force = t.force[self.rows] + self.whole - self._pushed(chain.base)
            size = 1.4826 * np.median(abs(force), 0) + SMALLEST * rms(force) + 1e-12
            seen = np.isfinite(chain.noise)
            self.weight = np.where(seen, 1 / np.maximum(size, abs(force) / ODD), 0.0)
            self.force = force * self.weight

    def _pushed(self, plain):
        """Generalized force (n, nv) that a plain setting lacks in each row, as it is."""
        lacks = self.chain.missing(plain, self.rows)[:, self.chain.model.nv :]
        return (self.obeyed @ lacks[..., None])[..., 0]

    def basis(self, start):
        """(n, nv, p): what a Start holds of the force, each row as it is; None where no row
        tells. What acts at a joint or a drive is no force elsewhere: what a row with several
        steps leaves there is small, but so may be what is usual there."""
        if self.chain.apart(start.candidate) or not len(self.rows):
            return None
        every = start.settings(self.plain)
        keys = [(start.candidate, setting[start.candidate]) for setting in every]
        for key, setting in zip(keys, every):  # what it does is worked out once for its values
            if key not in self.done:
                self.done[key] = self.whole - self._pushed(setting)
        every = [self.done[key] for key in keys]
        moved = any(done.any() for done in every) and np.isfinite(every).all()
        weight = (self.weight * self._own(start.candidate.place))[..., None]
        return np.stack(every, -1) * weight if moved else None

    def _own(self, place):
        """(nv,): in which dofs what acts at a place may be a force."""
        model, joints = self.chain.model, self.chain.world.joints(place)
        if place.kind not in ("joint", "actuator") or joints is None:
            return np.ones(model.nv, bool)
        return np.isin(model.dof_jntid, list(joints))


def rms(x):
    """Of (n,), or of each column."""
    return np.sqrt(np.mean(x**2, 0))


@dataclass(frozen=True)
class Dependence:
    """share: of the located force's variance at the joint that the curve predicts in stretches left
    out; candidate, values: the curve and the forces at its knots; above: RMS of so much of it over
    the standard deviation of the located force."""

    joint: str
    variables: tuple
    share: float
    candidate: object
    values: tuple
    above: float = 0.0


def dependences(world, trajectory, recordings, rows=True):
    """The Dependences of the located force of every hinge and slide, first those that stand out
    most of how far it scatters: where little is known of a force, what is located is smooth, and
    any curve over time follows it. rows (n,): which ones are looked at."""
    model, found = world.model, []
    ctrl = np.concatenate([r.ctrl for r in recordings])
    time = np.concatenate([r.time for r in recordings])
    keep = ~trajectory.free & np.isfinite(trajectory.force).all(1) & rows
    block = np.arange(keep.sum()) * BLOCKS // max(keep.sum(), 1)
    axes, scatter = _axes(model, trajectory, ctrl, time), trajectory.located()[1]
    for j in range(model.njnt):
        if model.jnt_type[j] not in (HINGE, SLIDE) or keep.sum() < 10 * KNOTS:
            continue
        name, d = windowing.joint_name(model, j), model.jnt_dofadr[j]
        force = trajectory.force[keep, d]
        sizes = 1.4826 * np.median(abs(force)), rms(force)
        usual, force = (np.clip(force, -CLIP * s - 1e-300, CLIP * s + 1e-300) for s in sizes)
        for variable, x in axes.items():
            for factor, times in _factors(model, trajectory, ctrl, j, variable).items():
                returns = variable in (f"position:{name}", "time")
                for wave in (False, True) if returns else (False,):
                    some = x[keep], times[keep], block, variable, wave
                    share, knots, values = _explained(usual, force, *some)
                    if share > LEAST:
                        candidate = world.curve(name, variable, knots, factor, wave)
                        told, values = candidate.effect.depends_on, tuple(map(float, values))
                        above = rms(force) * np.sqrt(share) / scatter[d]
                        found.append(Dependence(name, told, share, candidate, values, above))
    return sorted(found, key=lambda each: -each.above)


def each_joint(found):
    """The first of the Dependences of each joint, in their order."""
    return [d for k, d in enumerate(found) if d.joint not in {e.joint for e in found[:k]}]


def _axes(model, trajectory, ctrl, time):
    """{variable: (rows,)} of everything at hand that moves."""
    joints = np.flatnonzero(np.isin(model.jnt_type, (HINGE, SLIDE)))
    kinds = [(k, model.joint(j).name) for j in joints for k in ("position", "velocity")]
    drives = np.flatnonzero(model.actuator_ctrlnum == 1)
    kinds += [("control", model.actuator(a).name) for a in drives]
    read, state = reader([model]), (trajectory.qpos, trajectory.qvel, ctrl, time)
    axes = {name: read(name, *state) for name in ("time", *map(":".join, kinds))}
    return {name: x for name, x in axes.items() if np.ptp(x) > 1e-9}


def _factors(model, trajectory, ctrl, j, variable):
    """{factor: (rows,)} of what a curve over a variable may be multiplied by: of the joint's own
    and of time, the sign of its velocity, as friction has, its speed, as what has to be moved has,
    both, as damping has, and what its drives are asked for."""
    name, out = windowing.joint_name(model, j), {None: np.ones(len(ctrl))}
    d, drives = model.jnt_dofadr[j], drives_of(model, j)
    asked_for = [f"control:{model.actuator(a).name}" for a in drives]
    if variable in ("time", f"position:{name}", *asked_for):
        out[f"velocity:{name}"] = trajectory.direction()[:, d]
        out[f"speed:{name}"] = abs(trajectory.qvel[:, d])
        out[f"damping:{name}"] = trajectory.qvel[:, d]
    if variable in ("time", f"position:{name}", f"velocity:{name}"):
        for a in drives:
            times = asked([model], a, trajectory.qpos, trajectory.qvel, ctrl)
            out[f"control:{model.actuator(a).name}"] = times
    return out


def places_of(x, variable):
    """Where a curve may bend (up to FINE,), over what was recorded; of velocities closer about
    zero."""
    low, high = np.quantile(x, [0.005, 0.995])
    if not high > low:
        high = low + 1e-9
    even = np.linspace(-1, 1, FINE)
    if variable.startswith("velocity") and low < 0 < high:
        return np.unique(np.clip(max(-low, high) * even**3, low, high))
    return low + (high - low) * (even + 1) / 2


def _explained(usual, force, x, times, block, variable, wave=False):
    """(share of a force's variance that a curve over x, times a factor, predicts on blocks left
    out; its knots, and values there): linear between knots, or a wave.

    Where it bends, and whether, is told by the usual force (n,); how large it is, by force (n,),
    which holds what is not there most of the time as well.
    """
    if wave:
        knots = _quarter(usual, x, times)
        turn = np.pi / 2 * (x - knots[0]) / (knots[1] - knots[0])
        basis = np.stack([np.cos(turn), np.sin(turn)], 1) * times[:, None]
        return Sums(basis, usual, block).predicted(2), knots, amounts(basis, force)
    places = places_of(x, variable)
    low, span = places[0], places[-1] - places[0]
    bends = lambda at: np.maximum((at[:, None] - places[:-1]) / span, 0.0)
    shape = lambda at: np.column_stack([np.ones(len(at)), bends(np.clip(at, low, places[-1]))])
    basis = shape(x) * times[:, None]
    sums = Sums(basis, usual, block)
    size = max(range(2, KNOTS + 1), key=sums.predicted)
    chosen = sums.chosen(size)
    knots = places[[0, *sorted(k - 1 for k in chosen[2:]), -1]]
    curve = shape(knots)[:, chosen] @ amounts(basis[:, chosen], force)
    return sums.predicted(size), knots, curve


def amounts(basis, force):
    """(k,) of a basis (n, k) that fit a force (n,)."""
    return _solved((basis.T @ basis)[None], (basis.T @ force)[None, :, None])[0, :, 0]


class Sums:
    """Gram matrices and scores of a basis (n, k) with a force (n,), by blocks (n,) of rows. Columns
    are taken in turn: the first two, and each next one that which explains most beside those."""

    def __init__(self, basis, force, block):
        parts = [slice(*np.searchsorted(block, [b, b + 1])) for b in range(block.max() + 1)]
        self.gram = np.array([basis[p].T @ basis[p] for p in parts])
        self.score = np.array([basis[p].T @ force[p] for p in parts])
        self.square = np.sum(force**2)
        others = self.gram.sum(0) - self.gram, self.score.sum(0) - self.score
        self.without = self._taken(*others, min(KNOTS, basis.shape[1]))
        self.left = [self._left(*others, some) for some in self.without]

    @staticmethod
    def _taken(gram, score, most):
        """[(b, size)] columns for gram (b, k, k) and score (b, k), of sizes from two on."""
        b = np.arange(len(gram))[:, None]
        own, out = np.einsum("bii->bi", gram), [np.tile([0, 1], (len(gram), 1))]
        while out[-1].shape[1] < most:
            some = out[-1]
            inside, beside = _among(gram, some), gram[b, some]
            share = np.swapaxes(_solved(inside, beside), 1, 2)  # of each column, what those hold
            rest = score - (share @ score[b, some][..., None])[..., 0]
            free = own - (share * np.swapaxes(beside, 1, 2)).sum(2)
            gain = np.where(free > 1e-9 * own, rest**2 / np.maximum(free, 1e-300), 0.0)
            gain[b, some] = 0.0
            out.append(np.concatenate([some, gain.argmax(1)[:, None]], 1))
        return out

    def _left(self, gram, score, some):
        """Squares that columns some (b, size), fitted to all other blocks, leave of the force."""
        b = np.arange(len(gram))[:, None]
        z = _solved(_among(gram, some), score[b, some][..., None])[..., 0]
        cross = np.sum(z * self.score[b, some])
        return self.square - 2 * cross + np.einsum("bi,bij,bj->", z, _among(self.gram, some), z)

    def predicted(self, size):
        """Share of the force's variance that so many columns predict in each block, chosen and
        fitted without it."""
        left = self.left[min(size, len(self.left) + 1) - 2]
        return float(1 - left / self.square) if self.square > 0 else 0.0

    def chosen(self, size):
        """So many columns, or fewer where no more explain anything."""
        gram, score = self.gram.sum(0)[None], self.score.sum(0)[None]
        *_, some = self._taken(gram, score, min(size, gram.shape[-1]))
        return [0, 1, *(int(k) for k in some[0, 2:] if k > 1)]


def _among(gram, some):
    """(b, size, size) of gram (b, k, k): products of columns some (b, size) with each other."""
    b = np.arange(len(gram))[:, None, None]
    return gram[b, some[:, :, None], some[:, None]]


def _solved(gram, right):
    """x (b, k, m) of gram (b, k, k) x = right (b, k, m), with a ridge that keeps it finite."""
    size = gram.shape[-1]
    ridge = 1e-8 * np.trace(gram, axis1=1, axis2=2)[:, None, None] / size + 1e-300
    return np.linalg.solve(gram + ridge * np.eye(size), right)


def _quarter(force, x, times):
    """(zero, a quarter of the period) of the wave over x that is most like a force."""
    some = windowing.evenly(len(x), SAMPLED)
    low, high = np.quantile(x, [0.005, 0.995])
    number = np.arange(*WAVES) * 2 * np.pi / max(high - low, 1e-9)
    number = number[number >= min(SLOWEST, number[-1])]
    turned = np.exp(1j * np.outer(number, x[some])) * times[some]
    like = abs(turned @ force[some]) / np.sqrt((abs(turned) ** 2).sum(1) + 1e-300)
    return np.array([0.0, np.pi / 2 / number[np.argmax(like)]])
