"""A force that no name holds: what the located force depends on, and curves for the simulator to
judge.

for found in dependences(world, trajectory, recordings): found.joint, found.variables,
found.candidate
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from diagnosis.effects.base import HINGE, SLIDE
from diagnosis.effects.drives import drives_of
from diagnosis.effects.unmodelled import asked
from diagnosis.estimation import windowing

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


@dataclass(frozen=True)
class Dependence:
    """share: of the located force's variance at the joint that the curve predicts in stretches left
    out; size: RMS of what it predicts; candidate, values: the curve and the forces at its knots."""

    joint: str
    variables: tuple
    share: float
    size: float
    candidate: object
    values: tuple


@dataclass(frozen=True)
class Curve:
    """share: of the force's variance, predicted on blocks left out; rms: of what is predicted."""

    share: float
    rms: float
    knots: np.ndarray
    values: np.ndarray


def dependences(world, trajectory, recordings, most=4):
    """The Dependences of the located force of every hinge and slide, first those that stand out
    most of how far it scatters: where little is known of a force, what is located is smooth, and
    any curve over time follows it."""
    model, found = world.model, []
    ctrl = np.concatenate([r.ctrl for r in recordings])
    time = np.concatenate([r.time for r in recordings])
    keep = ~trajectory.free & np.isfinite(trajectory.force).all(1)
    block = np.arange(keep.sum()) * BLOCKS // max(keep.sum(), 1)
    axes, scatter = _axes(model, trajectory, ctrl, time), trajectory.located()[1]
    for j in range(model.njnt):
        if model.jnt_type[j] not in (HINGE, SLIDE) or keep.sum() < 10 * KNOTS:
            continue
        name, d = windowing.joint_name(model, j), model.jnt_dofadr[j]
        force = trajectory.force[keep, d]
        size = 1.4826 * np.median(abs(force)) + 1e-300
        force = np.clip(force, -CLIP * size, CLIP * size)
        for variable, x in axes.items():
            for factor, times in _factors(model, trajectory, ctrl, j, variable).items():
                returns = variable in (f"position:{name}", "time")
                for wave in (False, True) if returns else (False,):
                    curve = _explained(force, x[keep], times[keep], block, variable, wave)
                    if curve.share > LEAST:
                        candidate = world.curve(name, variable, curve.knots, factor, wave)
                        told = (variable,) + ((factor,) if factor else ())
                        values = tuple(map(float, curve.values))
                        each = Dependence(name, told, curve.share, curve.rms, candidate, values)
                        found.append((curve.rms / scatter[d], each))
    return [each for _, each in sorted(found, key=lambda pair: -pair[0])][:most]


def _axes(model, trajectory, ctrl, time):
    """{variable: (rows,)} of everything at hand that moves."""
    axes = {"time": time}
    for j in range(model.njnt):
        if model.jnt_type[j] in (HINGE, SLIDE):
            name = windowing.joint_name(model, j)
            axes[f"position:{name}"] = trajectory.qpos[:, model.jnt_qposadr[j]]
            axes[f"velocity:{name}"] = trajectory.qvel[:, model.jnt_dofadr[j]]
    for a in range(model.nactuator):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, a)
        if name and model.actuator_ctrlnum[a] == 1:
            axes[f"control:{name}"] = ctrl[:, model.actuator_ctrladr[a]]
    return {name: x for name, x in axes.items() if np.ptp(x) > 1e-9}


def _factors(model, trajectory, ctrl, j, variable):
    """{factor: (rows,)} of what a curve over a variable may be multiplied by: of the joint's own
    and of time, the sign of its speed, as friction has, and what its drives are asked for."""
    name, out = windowing.joint_name(model, j), {None: np.ones(len(ctrl))}
    d = model.jnt_dofadr[j]
    if variable in ("time", f"position:{name}"):
        speed, sd = trajectory.qvel[:, d], np.maximum(trajectory.qvel_sd[:, d], 1e-9)
        out[f"velocity:{name}"] = np.tanh(speed / sd)
    if variable in ("time", f"position:{name}", f"velocity:{name}"):
        for a in drives_of(model, j):
            times = asked(model, a, trajectory.qpos, trajectory.qvel, ctrl)
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


def _explained(force, x, times, block, variable, wave=False):
    """The Curve of a force over x, times a factor: linear between knots, or a wave."""
    if wave:
        knots = _quarter(force, x, times)
        turn = np.pi / 2 * (x - knots[0]) / (knots[1] - knots[0])
        sums = Sums(np.stack([np.cos(turn), np.sin(turn)], 1) * times[:, None], force, block)
        return Curve(*sums.predicted([0, 1]), knots, sums.amounts([0, 1]))
    places = places_of(x, variable)
    low, span = places[0], places[-1] - places[0]
    bends = lambda at: np.maximum((at[:, None] - places[:-1]) / span, 0.0)
    shape = lambda at: np.column_stack([np.ones(len(at)), bends(np.clip(at, low, places[-1]))])
    sums = Sums(shape(x) * times[:, None], force, block)
    chosen = sums.chosen()
    knots = places[[0, *sorted(k - 1 for k in chosen[2:]), -1]]
    curve = shape(knots)[:, chosen] @ sums.amounts(chosen)
    return Curve(*sums.predicted(chosen), knots, curve)


class Sums:
    """Of products of a basis (n, k) with itself and with a force (n,), in blocks (n,) of rows."""

    def __init__(self, basis, force, block):
        parts = [slice(*np.searchsorted(block, [b, b + 1])) for b in range(block.max() + 1)]
        self.gram = np.array([basis[p].T @ basis[p] for p in parts])
        self.score = np.array([basis[p].T @ force[p] for p in parts])
        self.square, self.number = np.sum(force**2), len(force)

    @staticmethod
    def _solved(gram, score):
        size = gram.shape[-1]
        ridge = 1e-5 * np.trace(gram, axis1=-2, axis2=-1)[..., None, None] / size + 1e-300
        return np.linalg.solve(gram + ridge * np.eye(size), score[..., None])[..., 0]

    def amounts(self, some):
        """(p,) of columns some (p,) that fit the force."""
        return self._solved(self.gram.sum(0)[np.ix_(some, some)], self.score.sum(0)[some])

    def predicted(self, some):
        """(share of the force's variance that columns some (p,) predict in each block from all the
        others, RMS of that)."""
        gram, score = self.gram[:, some][:, :, some], self.score[:, some]
        z = self._solved(gram.sum(0) - gram, score.sum(0) - score)
        left = self.square - 2 * np.sum(z * score) + np.einsum("bi,bij,bj->", z, gram, z)
        share = float(1 - left / (self.square + 1e-300))
        return share, float(np.sqrt(max(share, 0.0) * self.square / self.number))

    def chosen(self):
        """The columns [0, 1, ...], each next one that which explains most beside those before, as
        many as predict best."""
        gram, score = self.gram.sum(0), self.score.sum(0)
        some = [0, 1]
        best = self.predicted(some)[0], list(some)
        floor = (1e-9 * np.trace(gram) + 1e-300) * np.eye(len(gram))
        while len(some) < min(KNOTS, len(score)):
            inside = gram[np.ix_(some, some)] + floor[: len(some), : len(some)]
            shared = np.linalg.solve(inside, gram[some]).T  # of each column, what those hold
            rest, own = (
                score - shared @ score[some],
                np.diag(gram) - (shared * gram[:, some]).sum(1),
            )
            gain = np.where(own > 1e-9 * np.diag(gram), rest**2 / np.maximum(own, 1e-300), 0.0)
            gain[some] = 0.0
            if not gain.any():
                break
            some = [*some, int(np.argmax(gain))]
            best = max(best, (self.predicted(some)[0], some), key=lambda each: each[0])
        return best[1]


def _quarter(force, x, times):
    """(zero, a quarter of the period) of the wave over x that is most like a force."""
    some = windowing.evenly(len(x), SAMPLED)
    low, high = np.quantile(x, [0.005, 0.995])
    number = np.arange(*WAVES) * 2 * np.pi / max(high - low, 1e-9)
    number = number[number >= min(SLOWEST, number[-1])]
    turned = np.exp(1j * np.outer(number, x[some])) * times[some]
    like = abs(turned @ force[some]) / np.sqrt((abs(turned) ** 2).sum(1) + 1e-300)
    return np.array([0.0, np.pi / 2 / number[np.argmax(like)]])
