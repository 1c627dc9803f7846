"""Sparse regression on what inverse dynamics leaves: sequentially thresholded least squares.

    python benchmarks/entrants/sparse.py {model} {recordings} {out}

Per joint, the force that the nominal model lacks is regressed on friction, damping, springs,
armature, the drive's force and a constant; terms below a share of the force, or below three of
their standard errors, are dropped and the rest is fitted again.
"""

import sys
from pathlib import Path

import mujoco
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))

from command_line import words  # noqa: E402
from common import finding, opened, states, write  # noqa: E402
from fields import fields  # noqa: E402

SHARE = 0.05  # of the joint's force, below which a term is dropped
ERRORS = 3.0  # standard errors that a term must exceed
MEMORY = 10.0  # rows that the smoothing correlates
STILL = 0.02  # rad/s or m/s, over which the sign of the speed is smoothed


def forces(model, recording):
    """(q, v, a, drives, needed): smooth motion, motors' force, what the motion needs, (T, nv)."""
    qpos, qvel, qacc = states(recording, model)
    data, wanted, drives = mujoco.MjData(model), [], []
    for q, v, a, u in zip(qpos, qvel, qacc, recording.ctrl):
        data.qpos[:], data.qvel[:], data.qacc[:], data.ctrl[:] = q, v, a, u
        mujoco.mj_inverse(model, data)
        wanted.append(data.qfrc_inverse.copy())
        mujoco.mj_fwdActuation(model, data)
        drives.append(data.qfrc_actuator.copy())
    return qpos, qvel, qacc, np.array(drives), np.array(wanted)


def terms(model, index, motion):
    """{effect: column (T,)} of one hinge or slide; each the force per unit of its parameter."""
    qpos, qvel, qacc, drives, _ = motion
    q, v = qpos[:, model.jnt_qposadr[index]], qvel[:, dof := model.jnt_dofadr[index]]
    out = {
        "coulomb_friction": -np.tanh(v / STILL),
        "viscous_damping": -v,
        "quadratic_damping": -v * np.abs(v),
        "stiffness": -q,
        "armature": -qacc[:, dof],
        "bias": np.ones_like(v),
    }
    if np.any(drives[:, dof]):
        out["gain"] = drives[:, dof]
    return out


def regress(columns, force, usual):
    """{effect: (value, standard error)} of the terms that stay; usual: RMS force of the joint."""
    names = list(columns)
    while names:
        matrix = np.stack([columns[n] for n in names], 1)
        values, *_ = np.linalg.lstsq(matrix, force)
        left = force - matrix @ values
        spread = MEMORY * left @ left / max(len(force) - len(names), 1)
        errors = np.sqrt(spread * np.diag(np.linalg.pinv(matrix.T @ matrix)))
        size = np.abs(values) * np.sqrt(np.mean(matrix**2, 0)) / usual
        weak = np.minimum(size / SHARE, np.abs(values) / (ERRORS * errors + 1e-12))
        if weak.min() >= 1:
            return dict(zip(names, zip(values.tolist(), errors.tolist())))
        names.pop(int(np.argmin(weak)))
    return {}


def main():
    """Regress joint by joint, name the terms, write those that MJCF holds."""
    spec, recordings, out = opened(words(main.__doc__))
    model, findings = spec.compile(), []
    motions = [forces(model, recording) for recording in recordings]
    known = {(f.effect, f.name): f for f in fields(spec)}
    driver = {model.actuator_trnid[k, 0]: model.actuator(k).name for k in range(model.nu)}
    for index in range(model.njnt):
        if model.jnt_type[index] == int(mujoco.mjtJoint.mjJNT_FREE):
            continue
        each = [terms(model, index, motion) for motion in motions]
        columns = {name: np.concatenate([e[name] for e in each]) for name in each[0]}
        dof = model.jnt_dofadr[index]
        needed = np.concatenate([m[4][:, dof] for m in motions])
        force = needed - np.concatenate([m[3][:, dof] for m in motions])
        usual = np.sqrt(np.mean(needed**2)) + 1e-12
        for effect, (value, error) in regress(columns, force, usual).items():
            at_drive = effect in ("gain", "bias")
            if at_drive and index not in driver:
                continue
            place = driver[index] if at_drive else model.joint(index).name
            field = known.get((effect, place))
            nominal = field.nominal if field else 0.0
            name = field.parameter if field else "damping2"
            told = (
                nominal,
                nominal + value,
                nominal + value - 2 * error,
                nominal + value + 2 * error,
            )
            kind = "actuator" if at_drive else "joint"
            findings.append(finding(effect, kind, place, {name: told}))
            if field:
                field.set(spec, float(np.clip(nominal + value, field.low, field.high)))
            elif value > 0:
                spec.joint(place).damping[1] = value
    write(out, spec, findings)


if __name__ == "__main__":
    main()
