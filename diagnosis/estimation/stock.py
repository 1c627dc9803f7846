"""Predictions by stock MuJoCo of a model's file, with nothing of ours in the loop: what a report
may promise.

qpos = predicted(model, nominal, windows)        # (W, T, nq) in the nominal model's coordinates
"""

import mujoco
import numpy as np

from diagnosis.estimation import windowing
from diagnosis.simulation.editable_model import FILTERS


def compiled(xml):
    """The MjModel of an MJCF string."""
    return mujoco.MjSpec.from_string(xml).compile()


def predicted(model, nominal, windows, step=None):
    """qpos (W, T, nq) of windows that follow each other, each begun as recorded; NaN where there is
    none.

    Joints and actuators go by the nominal model's names; what the model appends, its actuators'
    states and delayed controls run on through each recording. step(model, data): instead of
    mj_step.
    """
    q, v = addresses(nominal, model)
    drives = np.array(
        [
            model.actuator_ctrladr[model.actuator(nominal.actuator(a).name).id]
            for a in range(nominal.nactuator)
        ],
        int,
    )
    inputs = nominal.actuator_ctrladr[: nominal.nactuator]
    measured = windowing.measured(windows)
    out = np.full(measured.shape, np.nan)
    begun = windowing.recorded_starts(nominal, windows)
    step = step or (lambda model, data: mujoco.mj_step(model, data))
    length = model.opt.timestep
    for recording in windowing.recordings_of(windows):
        mine = {w.first: k for k, w in enumerate(windows) if w.recording is recording}
        last = max(windows[k].last for k in mine.values())
        data, now, start = mujoco.MjData(model), None, 0
        _hold(model, data, drives, np.nan_to_num(recording.ctrl[0, inputs]))
        for row in range(last + 1):
            if now is not None and row <= windows[now].last:
                out[now, row - start] = data.qpos[q]
            if row in mine:
                now, start = mine[row], row
                data.qpos[q], data.qvel[v] = begun[0][now], begun[1][now]
                out[now, 0] = begun[0][now]
            if row < last:
                data.ctrl[drives] = np.nan_to_num(recording.ctrl[row, inputs])
                gap = recording.time[row + 1] - recording.time[row]
                count = max(1, round(gap / length))
                model.opt.timestep = gap / count
                for _ in range(count):
                    step(model, data)
    model.opt.timestep = length
    return out


def _hold(model, data, drives, control):
    """What waits and what filters begin as after its first control held for long."""
    data.ctrl[drives] = control
    for a in range(model.nactuator):
        if not model.actuator_ctrlnum[a]:
            continue
        u = model.actuator_ctrladr[a]
        value = data.ctrl[u]
        if model.actuator_ctrllimited[u]:
            value = np.clip(value, *model.actuator_ctrlrange[u])
        if model.actuator_delay[a] > 0:
            past = -model.opt.timestep * np.arange(model.actuator_history[a, 0], 0, -1)
            mujoco.mj_initCtrlHistory(model, data, a, past, np.full(len(past), value))
        if model.actuator_actadr[a] >= 0 and model.actuator_dyntype[a] in FILTERS:
            data.act[model.actuator_actadr[a]] = value


def addresses(nominal, model):
    """(qpos, dof) addresses in `model` of the nominal model's joints, by name."""
    qpos, dof = [], []
    for j, _, q, v in windowing.joint_slices(nominal):
        joint = model.joint(nominal.joint(j).name)
        qpos += range(joint.qposadr[0], joint.qposadr[0] + q.stop - q.start)
        dof += range(joint.dofadr[0], joint.dofadr[0] + v.stop - v.start)
    return np.array(qpos, int), np.array(dof, int)
