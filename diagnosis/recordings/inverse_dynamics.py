"""What force is left over: inverse dynamics of smoothed recordings, under the nominal and under the
corrected model.

    residual = M(q) a + c(q, v) - passive - friction and contact - actuators        (N or N·m per
    joint)

For pictures and for plausibility checks; the diagnosis itself never differentiates recordings
twice.
"""

import mujoco
import numpy as np

from diagnosis.effects.base import HINGE, JOINT_TRANSMISSION, SLIDE

HALF = 0.03  # s: half width of the parabolas that smooth the positions


def smooth(model, recording, most, seconds=HALF):
    """Local parabolas over ± `seconds` at up to `most` rows: time (n,), qpos (n, nq), qvel, qacc
    (n, nv), and the mean control (n, nu) beside them. Rows near unmeasured ones are left out."""
    time, rows = recording.time, len(recording.time)
    half = max(3, int(round(seconds / np.median(np.diff(time)))))
    centres = (
        np.unique(np.linspace(half, rows - half - 1, most).astype(int))
        if rows > 2 * half + 1
        else []
    )
    found = []
    for centre in centres:
        near = slice(centre - half, centre + half + 1)
        if np.isnan(recording.qpos[near]).any():
            continue
        t = time[near] - time[centre]
        away = np.empty(
            (len(t), model.nv)
        )  # from the centre; its derivatives there are velocity and acceleration
        for row, qpos in zip(away, recording.qpos[near]):
            mujoco.mj_differentiatePos(model, row, 1.0, recording.qpos[centre], qpos)
        here, speed, acceleration = np.linalg.lstsq(
            np.stack([np.ones_like(t), t, t * t / 2], axis=1), away, rcond=None
        )[0]
        qpos = recording.qpos[centre].copy()
        mujoco.mj_integratePos(model, qpos, here, 1.0)
        found.append(
            (
                time[centre],
                qpos,
                speed,
                acceleration,
                recording.ctrl[near.start : near.stop - 1].mean(axis=0),
            )
        )
    widths = (), (model.nq,), (model.nv,), (model.nv,), (model.nu,)
    return [
        np.array([row[k] for row in found]).reshape(len(found), *width)
        for k, width in enumerate(widths)
    ]


def forces(model, qpos, qvel, qacc, ctrl):
    """(n, nv) residual force of a model on smoothed states; its own actuator states are not known,
    so it has none."""
    data, out = mujoco.MjData(model), np.empty((len(qpos), model.nv))
    for row, (q, v, a, u) in enumerate(zip(qpos, qvel, qacc, ctrl)):
        data.qpos[:], data.qvel[:], data.ctrl[: len(u)] = q, v, u
        mujoco.mj_forward(model, data)
        actuators = data.qfrc_actuator.copy()
        data.qacc[:] = a
        mujoco.mj_inverse(model, data)
        out[row] = data.qfrc_inverse - actuators
    return out


def residuals(diagnosis, most=1200):
    """One dict per finding that can be drawn: finding (index), variable, x, before, after (n,),
    unit, x_unit, joint (name). after: under corrected.xml; NaN for a finding that it cannot
    hold."""
    nominal = diagnosis.world.model
    corrected = mujoco.MjModel.from_xml_string(diagnosis.corrected_xml)
    measured = [r.seen() for r in diagnosis.held_out if not np.isnan(r.qpos).all(axis=0).any()]
    if nominal.na or not measured:
        return []
    time, *states = (
        np.concatenate(x)
        for x in zip(*(smooth(nominal, r, most // len(measured) + 1) for r in measured))
    )
    if len(time) < 50:
        return []
    before, (qpos, qvel, _, ctrl) = forces(nominal, *states), states
    same = (corrected.nq, corrected.nv, corrected.na) == (
        nominal.nq,
        nominal.nv,
        0,
    )  # else its extra states are not known
    after = forces(corrected, *states) if same else np.full_like(before, np.nan)
    found = []
    for index, finding in enumerate(diagnosis.summary["findings"]):
        held = after if finding["written_as"] == "mjcf" else np.full_like(after, np.nan)
        for variable in finding["depends_on"][:2]:
            x, joint, unit = course_of(nominal, variable, time, qpos, qvel, ctrl)
            joint = _joint_of(nominal, finding["place"], joint)
            if x is None or joint is None:
                continue
            hinge = nominal.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
            dof = nominal.jnt_dofadr[joint]
            found.append(
                {
                    "finding": index,
                    "variable": variable,
                    "x": x,
                    "before": before[:, dof],
                    "after": held[:, dof],
                    "unit": "N·m" if hinge else "N",
                    "x_unit": unit,
                    "joint": nominal.joint(joint).name or str(joint),
                }
            )
    return found


def course_of(model, variable, time, qpos, qvel, ctrl):
    """(values (n,), joint id or None, unit) of "velocity:elbow", "control:motor", "time"; values
    None where unknown."""
    kind, _, name = variable.partition(":")
    if kind == "time":
        return time, None, "s"
    if kind in ("position", "velocity"):
        joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)
        if joint >= 0 and model.jnt_type[joint] in (HINGE, SLIDE):
            length = "rad" if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE else "m"
            q, v = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
            if kind == "position":
                return qpos[:, q], joint, length
            return qvel[:, v], joint, length + "/s"
    if kind == "control":
        actuator = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, name)
        if actuator >= 0 and model.actuator_ctrlnum[actuator]:
            return ctrl[:, model.actuator_ctrladr[actuator]], None, ""
    return None, None, ""


def _joint_of(model, place, joint):
    """The joint whose force shows a finding: its own, its actuator's, or else the one it depends
    on."""
    if place["kind"] == "joint":
        own = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, place["name"])
        return own if own >= 0 else None
    if place["kind"] == "actuator":
        actuator = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, place["name"])
        if actuator >= 0 and model.actuator_trntype[actuator] == JOINT_TRANSMISSION:
            return int(model.actuator_trnid[actuator, 0])
    return joint
