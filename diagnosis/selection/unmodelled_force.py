"""A force that no name holds: what the located force depends on, and curves for the simulator to
judge.

for found in dependences(world, trajectory, recordings): found.joint, found.variables,
found.candidate
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from diagnosis.effects.base import HINGE, SLIDE
from diagnosis.estimation import windows as cut

KNOTS = 9
BLOCKS = 16  # stretches of time that are left out in turn
# share of the located force's variance, predicted on stretches left out, that a curve must explain
LEAST = 0.03
CLIP = 5.0  # of the usual size, beyond which a located force counts no more


@dataclass(frozen=True)
class Dependence:
    """share: of the located force's variance at the joint that the curve predicts; size: RMS of the
    curve's force; candidate, values: the curve and the forces at its knots."""

    joint: str
    variables: tuple
    share: float
    size: float
    candidate: object
    values: tuple


def dependences(world, trajectory, recordings, most=4):
    """The Dependences of the located force of every hinge and slide, the largest force first."""
    model, found = world.model, []
    ctrl = np.concatenate([r.ctrl for r in recordings])
    time = np.concatenate([r.time for r in recordings])
    keep = ~trajectory.free & np.isfinite(trajectory.force).all(1)
    block = np.arange(keep.sum()) * BLOCKS // max(keep.sum(), 1)
    axes = _axes(model, trajectory, ctrl, time)
    for j in range(model.njnt):
        if model.jnt_type[j] not in (HINGE, SLIDE) or keep.sum() < 10 * KNOTS:
            continue
        name, d = cut.joint_name(model, j), model.jnt_dofadr[j]
        force = trajectory.force[keep, d]
        size = 1.4826 * np.median(abs(force)) + 1e-300
        force = np.clip(force, -CLIP * size, CLIP * size)
        sign = np.tanh(trajectory.qvel[keep, d] / np.maximum(trajectory.qvel_sd[keep, d], 1e-9))
        tried = []
        for variable, x in axes.items():
            tried.append((variable, None, x[keep], np.ones_like(force)))
            if variable == f"position:{name}":
                tried.append((variable, f"velocity:{name}", x[keep], sign))
        for variable, factor, x, times in tried:
            share, rms, knots, values = _explained(force, x, times, block, variable)
            if share > LEAST:
                candidate = world.curve(name, variable, knots, factor)
                found.append(
                    Dependence(
                        name,
                        (variable,) + ((factor,) if factor else ()),
                        share,
                        rms,
                        candidate,
                        tuple(float(v) for v in values),
                    )
                )
    return sorted(found, key=lambda f: -f.share)[:most]


def _axes(model, trajectory, ctrl, time):
    """{variable: (rows,)} of everything at hand that moves."""
    axes = {"time": time}
    for j in range(model.njnt):
        if model.jnt_type[j] in (HINGE, SLIDE):
            name = cut.joint_name(model, j)
            axes[f"position:{name}"] = trajectory.qpos[:, model.jnt_qposadr[j]]
            axes[f"velocity:{name}"] = trajectory.qvel[:, model.jnt_dofadr[j]]
    for a in range(model.nactuator):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, a)
        if name and model.actuator_ctrlnum[a] == 1:
            axes[f"control:{name}"] = ctrl[:, model.actuator_ctrladr[a]]
    return {name: x for name, x in axes.items() if np.ptp(x) > 1e-9}


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


def _explained(force, x, times, block, variable):
    """(share predicted on blocks left out, RMS of the curve's force, knots, values)."""
    knots = knots_of(x, variable)
    if len(knots) < 3:
        return 0.0, 0.0, knots, np.zeros(len(knots))
    basis = np.stack([np.interp(x, knots, e) for e in np.eye(len(knots))], 1) * times[:, None]
    ridge = 1e-4 * len(x) / len(knots) * np.eye(len(knots))
    number = block.max() + 1
    gram = np.array([basis[block == b].T @ basis[block == b] for b in range(number)])
    score = np.array([basis[block == b].T @ force[block == b] for b in range(number)])
    left = 0.0
    for b in range(number):
        values = np.linalg.solve(gram.sum(0) - gram[b] + ridge, score.sum(0) - score[b])
        left += np.sum((force[block == b] - basis[block == b] @ values) ** 2)
    values = np.linalg.solve(gram.sum(0) + ridge, score.sum(0))
    total = np.sum(force**2) + 1e-300
    return 1 - left / total, float(np.sqrt(np.mean((basis @ values) ** 2))), knots, values
