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

KNOTS = 9
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


def knots_of(x, variable):
    """Knots (KNOTS,) over what was recorded; of velocities closer about zero."""
    low, high = np.quantile(x, [0.005, 0.995])
    if not high > low:
        high = low + 1e-9
    if variable.startswith("velocity") and low < 0 < high:
        end = max(-low, high)
        shape = np.array([-1, -0.5, -0.2, -0.03, 0.0, 0.03, 0.2, 0.5, 1.0])
        return np.unique(np.clip(end * shape, low, high))
    return np.linspace(low, high, KNOTS)


def _explained(force, x, times, block, variable, wave=False):
    """The Curve of a force over x, times a factor: linear between knots, or a wave."""
    knots = _quarter(force, x, times) if wave else knots_of(x, variable)
    if len(knots) < 2 + (not wave):
        return Curve(0.0, 0.0, knots, np.zeros(len(knots)))
    if wave:
        turn = np.pi / 2 * (x - knots[0]) / (knots[1] - knots[0])
        basis = np.stack([np.cos(turn), np.sin(turn)], 1) * times[:, None]
    else:
        basis = np.stack([np.interp(x, knots, e) for e in np.eye(len(knots))], 1) * times[:, None]
    number = block.max() + 1
    gram = np.array([basis[block == b].T @ basis[block == b] for b in range(number)])
    score = np.array([basis[block == b].T @ force[block == b] for b in range(number)])
    ridge = 1e-4 * np.trace(gram.sum(0)) / len(knots) * np.eye(len(knots))
    left = 0.0
    for b in range(number):
        values = np.linalg.solve(gram.sum(0) - gram[b] + ridge, score.sum(0) - score[b])
        left += np.sum((force[block == b] - basis[block == b] @ values) ** 2)
    values = np.linalg.solve(gram.sum(0) + ridge, score.sum(0))
    share = 1 - left / (np.sum(force**2) + 1e-300)
    return Curve(share, float(np.sqrt(max(share, 0.0) * np.mean(force**2))), knots, values)


def _quarter(force, x, times):
    """(zero, a quarter of the period) of the wave over x that is most like a force."""
    some = windowing.evenly(len(x), SAMPLED)
    low, high = np.quantile(x, [0.005, 0.995])
    number = np.arange(*WAVES) * 2 * np.pi / max(high - low, 1e-9)
    number = number[number >= min(SLOWEST, number[-1])]
    turned = np.exp(1j * np.outer(number, x[some])) * times[some]
    like = abs(turned @ force[some]) / np.sqrt((abs(turned) ** 2).sum(1) + 1e-300)
    return np.array([0.0, np.pi / 2 / number[np.argmax(like)]])
