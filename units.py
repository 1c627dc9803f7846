"""Does a recording make sense to the model in another unit, or with two columns exchanged, and only then?

The test is Newton's second law, M(q) a = F(q, v, ctrl), on smoothed positions. A mistake of unit (57 times, 1000 times)
or of column leaves the two sides unrelated, whatever small physics the model lacks; the right reading relates them.
"""
import mujoco
import numpy as np

import leftover

CENTRES = 400  # rows at which the law is tested
UNLIKE = 0.35  # imbalance (0: the law holds, 1: one side dwarfs the other) above which a reading can be wrong;
UNIT_GAIN, SWAP_GAIN = 2, 3  # the right one divides it by so much
# (missing friction alone reaches 0.7, but no wrong reading betters that so)


def suspect(recording, model):
    """One line that says which unit or columns seem wrong, or None. Silent for models with free or ball joints,
    actuator states or joints that were not measured."""
    if model.nq != model.nv or model.na or model.nq == 0 or np.isnan(recording.qpos).all(axis=0).any():
        return None
    states = leftover.smooth(recording, CENTRES)[1:]
    if len(states[0]) < 20:
        return None
    now = _imbalance(model, *states)
    if not (now > UNLIKE).any():
        return None
    readings = []  # (what to tell, joints it concerns, by how much it must be better, reading)
    joints = range(model.nv)
    names = [model.joint(j).name or str(j) for j in joints]
    units = [("degrees; convert to rad", np.pi / 180) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE
             else ("mm; convert to m", 1e-3) for j in joints]
    for j in joints:
        scale = np.ones(model.nv)
        scale[j] = units[j][1]
        readings.append((f"column 'qpos:{names[j]}' seems to be in {units[j][0]}", [j], UNIT_GAIN, _scaled(states, scale, 1)))
    if model.nv > 1:
        readings.append(("the positions seem to be in " + " or ".join(sorted({unit for unit, _ in units})), list(joints), UNIT_GAIN,
                         _scaled(states, np.array([factor for _, factor in units]), 1)))
    readings.append(("column 'time' seems to be in ms; convert to s", list(joints), UNIT_GAIN,
                     _scaled(states, np.ones(model.nv), 1e-3)))
    for i in joints:
        for j in range(i):
            if model.jnt_type[i] == model.jnt_type[j]:
                order = np.arange(model.nv)
                order[[i, j]] = j, i
                readings.append((f"columns 'qpos:{names[j]}' and 'qpos:{names[i]}' seem to be exchanged", [i, j], SWAP_GAIN,
                                 (*(x[:, order] for x in states[:3]), states[3])))
    for i in range(model.nu):
        for j in range(i):
            order = np.arange(model.nu)
            order[[i, j]] = j, i
            driven = [model.actuator_trnid[a, 0] for a in (i, j) if model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT]
            readings.append((f"columns 'ctrl:{model.actuator(j).name or j}' and 'ctrl:{model.actuator(i).name or i}' seem to be "
                             "exchanged", driven, SWAP_GAIN, (*states[:3], states[3][:, order])))
    for message, concerned, gain, reading in readings:
        if concerned and (now[concerned] > UNLIKE).all() and (_imbalance(model, *reading) < now / gain)[concerned].all():
            return message
    return None


def _scaled(states, scale, second):
    """The states with positions times `scale` (nv,), and times that count `second` seconds each."""
    qpos, qvel, qacc, ctrl = states
    return qpos * scale, qvel * scale / second, qacc * scale / second**2, ctrl


def _imbalance(model, qpos, qvel, qacc, ctrl):
    """(nv,) rms(M a - F) / (rms(M a) + rms(F)) over the rows without contact; nan where those are few."""
    data = mujoco.MjData(model)
    inertial, force, product = [], [], np.zeros(model.nv)
    for q, v, a, u in zip(qpos, qvel, qacc, ctrl):
        data.qpos[:], data.qvel[:], data.ctrl[:] = q, v, u
        mujoco.mj_forward(model, data)
        if data.ncon:
            continue
        mujoco.mj_mulM(model, data, product, a)
        inertial.append(product.copy())
        force.append(data.qfrc_actuator + data.qfrc_passive - data.qfrc_bias)
    if len(inertial) < max(20, 0.8 * len(qpos)):  # contacts act: nothing can be said, and every comparison with nan is false
        return np.full(model.nv, np.nan)
    inertial, force = np.array(inertial), np.array(force)

    def rms(x):
        return np.sqrt((x * x).mean(axis=0))

    return rms(inertial - force) / (rms(inertial) + rms(force) + 1e-300)
