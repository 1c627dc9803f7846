"""The contract's error once more, by stock MuJoCo and the system written by hand, without any code of the diagnosis.

before = stock_error(nominal, corrected, runs, noise)     # of a model's file
floor = hand_error(real, runs, noise, perfect=False)      # of the true system, from the same noisy starts
"""

import mujoco
import numpy as np

HORIZON = 0.3  # s


def windows(time):
    """[(first row, last row)] of consecutive windows; one ends where the next begins; a stump is dropped."""
    found, first = [], 0
    while True:
        last = int(np.searchsorted(time, time[first] + HORIZON * (1 + 1e-9), side="right")) - 1
        if last <= first or last == len(time) - 1 and time[last] < time[first] + 0.9 * HORIZON:
            return found
        found.append((first, last))
        first = last


def velocity(model, run, row):
    """qvel (nv,) at a row: as measured, else the central difference of the measured positions."""
    if np.isfinite(run.qvel[row]).all():
        return run.qvel[row]
    before, after = max(row - 1, 0), min(row + 1, len(run.time) - 1)
    qvel = np.empty(model.nv)
    mujoco.mj_differentiatePos(
        model, qvel, run.time[after] - run.time[before], run.qpos[before], run.qpos[after]
    )
    return qvel


def apart(model, qpos, other):
    """other - qpos in the tangent space (nv,): rad and m."""
    out = np.empty(model.nv)
    mujoco.mj_differentiatePos(model, out, 1.0, qpos, other)
    return out


def rms(differences):
    """Root mean square; inf where a simulation blew up."""
    with np.errstate(over="ignore", invalid="ignore"):
        value = float(np.sqrt(np.mean(np.square(differences))))
    return value if np.isfinite(value) else float("inf")


def stock_error(nominal, model, runs, noise):
    """The contract's Error of a stock MuJoCo `model` over Runs, in units of `noise`, one or per dof (nv,).

    Joints are found by the names of the `nominal` model; what `model` appends runs on by itself.
    """
    if nominal.nq != model.nq:
        joints = [model.joint(nominal.joint(j).name) for j in range(nominal.njnt)]
        q = np.concatenate(
            [
                np.arange(j.qposadr[0], j.qposadr[0] + len(nominal.joint(j.name).qpos0))
                for j in joints
            ]
        )
        v = np.concatenate(
            [
                np.arange(j.dofadr[0], j.dofadr[0] + len(nominal.joint(j.name).damping))
                for j in joints
            ]
        )
    else:
        q, v = np.arange(model.nq), np.arange(model.nv)
    differences, step = [], model.opt.timestep
    for run in runs:
        data = mujoco.MjData(model)
        starts = {first for first, _ in windows(run.time)}
        end = max((last for _, last in windows(run.time)), default=0)
        for row in range(end + 1):
            if row:
                differences.append(apart(nominal, run.qpos[row], data.qpos[q]) / noise)
            if row in starts:
                data.qpos[q], data.qvel[v] = run.qpos[row], velocity(nominal, run, row)
            if row < end:
                data.ctrl[: nominal.nu] = run.ctrl[row]
                length = run.time[row + 1] - run.time[row]
                steps = max(1, round(length / step))
                model.opt.timestep = length / steps
                mujoco.mj_step(model, data, steps)
    model.opt.timestep = step
    return rms(differences)


def dof_noise(nominal, channels):
    """Noise per dof (nv,) from diagnosis.json's {channel: noise}; a free joint has a channel of 3 and one of 3."""
    noise = np.empty(nominal.nv)
    for index in range(nominal.njnt):
        joint = nominal.joint(index)
        first, channel = joint.dofadr[0], f"qpos:{joint.name or index}"
        if nominal.jnt_type[index] == mujoco.mjtJoint.mjJNT_FREE:
            noise[first : first + 3], noise[first + 3 : first + 6] = (
                channels[channel + ":pos"],
                channels[channel + ":rot"],
            )
        else:
            noise[first] = channels[channel]
    return noise


def hand_error(real, runs, noise, perfect):
    """Error of the hand-written `real` system over Runs, in units of noise.

    perfect: started from what ideal sensors read, against that: what its physics alone leaves.
    Otherwise from the noisy start that the contract prescribes, with the true memory: the floor.
    """
    nominal, differences = real.model, []
    for run in runs:
        if perfect:
            real.reset(*real.behind(run.true_qpos[0], run.true_qvel[0]))
        for first, last in windows(run.time):
            if perfect:
                real.put(*real.behind(run.true_qpos[first], run.true_qvel[first]))
            else:
                real.restore(run.states[first])
                qpos, qvel = real.seen()
                mujoco.mj_integratePos(
                    nominal, qpos, apart(nominal, run.true_qpos[first], run.qpos[first]), 1.0
                )
                real.put(qpos, qvel + velocity(nominal, run, first) - run.true_qvel[first])
            for row in range(first, last):
                real.advance(run.ctrl[row], run.time[row + 1] - run.time[row], bool(run.event[row]))
                goal = run.true_qpos if perfect else run.qpos
                differences.append(apart(nominal, goal[row + 1], real.reading()[0]))
    return rms(differences) / noise
