"""The contract's Error, by stock MuJoCo and by the true system, without any code of the diagnosis.

before = model_error(nominal, nominal, runs, noise)     # of a model's file
floor = system_error(system, runs, noise)               # of the truth, from the same noisy starts
moved = system_error(without, runs, noise, perfect=True)  # how far a hidden item moves the motion
"""

import mujoco
import numpy as np

HORIZON = 0.3  # s
FILTERS = int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT)


def windows(time, horizon=HORIZON):
    """[(first row, last row)] of consecutive windows; one ends where the next begins; a stump is
    dropped."""
    found, first = [], 0
    while True:
        last = int(np.searchsorted(time, time[first] + horizon * (1 + 1e-9), side="right")) - 1
        if last <= first or last == len(time) - 1 and time[last] < time[first] + 0.9 * horizon:
            return found
        found.append((first, last))
        first = last


def start_velocity(model, run, row):
    """qvel (nv,) at a row: as measured, else the central difference of the measured positions."""
    if np.isfinite(run.qvel[row]).all():
        return run.qvel[row]
    before, after = max(row - 1, 0), min(row + 1, len(run.time) - 1)
    return difference(model, run.qpos[before], run.qpos[after]) / (
        run.time[after] - run.time[before]
    )


def difference(model, qpos, other):
    """other − qpos in the tangent space (nv,): rad and m."""
    out = np.empty(model.nv)
    mujoco.mj_differentiatePos(model, out, 1.0, qpos, other)
    return out


def rms(values):
    """Root mean square; inf where a simulation blew up."""
    with np.errstate(over="ignore", invalid="ignore"):
        value = float(np.sqrt(np.mean(np.square(values))))
    return value if np.isfinite(value) else float("inf")


def recorded_addresses(nominal, model):
    """(qpos, dof) addresses in `model` of the nominal model's joints, found by name."""
    qpos, dof = [], []
    for index in range(nominal.njnt):
        own = nominal.joint(index)
        joint = model.joint(own.name)
        wide = {int(mujoco.mjtJoint.mjJNT_FREE): (7, 6), int(mujoco.mjtJoint.mjJNT_BALL): (4, 3)}
        q, v = wide.get(int(nominal.jnt_type[index]), (1, 1))
        qpos += range(joint.qposadr[0], joint.qposadr[0] + q)
        dof += range(joint.dofadr[0], joint.dofadr[0] + v)
    return np.array(qpos), np.array(dof)


def model_error(nominal, model, runs, noise, step=None):
    """The Error of a stock MuJoCo `model` over Runs, in units of `noise`, one or per dof (nv,).

    Joints and actuators go by the names of `nominal`; what `model` appends runs on by itself.
    step(model, data): does one step instead of mj_step, for forces that MJCF cannot hold.
    """
    return rms(model_residuals(nominal, model, runs, noise, step=step))


def model_residuals(nominal, model, runs, noise, horizon=HORIZON, step=None, shift=None):
    """Predicted minus recorded positions over the noise, (rows, nv), rows of all Runs in turn.

    shift: (dq, dv), (nv,) each, added to every window's start.
    """
    q, v = recorded_addresses(nominal, model)
    drives = [model.actuator(nominal.actuator(k).name).id for k in range(nominal.nu)]
    out, length = [], model.opt.timestep
    for run in runs:
        data = mujoco.MjData(model)
        _hold(model, data, drives, run.ctrl[0])
        spans = windows(run.time, horizon)
        starts = {first for first, _ in spans}
        end = max((last for _, last in spans), default=0)
        for row in range(end + 1):
            if row:
                out.append(difference(nominal, run.qpos[row], data.qpos[q]) / noise)
            if row in starts:
                qpos, qvel = run.qpos[row].copy(), start_velocity(nominal, run, row)
                if shift is not None:
                    mujoco.mj_integratePos(nominal, qpos, shift[0], 1.0)
                    qvel = qvel + shift[1]
                data.qpos[q], data.qvel[v] = qpos, qvel
            if row < end:
                data.ctrl[drives] = run.ctrl[row]
                gap = run.time[row + 1] - run.time[row]
                steps = max(1, round(gap / length))
                model.opt.timestep = gap / steps
                if step is None:
                    mujoco.mj_step(model, data, steps)
                else:
                    for _ in range(steps):
                        step(model, data)
    model.opt.timestep = length
    return np.array(out).reshape(-1, nominal.nv)


def _hold(model, data, drives, ctrl):
    """What waits and what filters begins as after the first control (nu,) that was recorded, held
    for long: a recording does not tell what was before."""
    for drive, value in zip(drives, ctrl):
        u = model.actuator_ctrladr[drive]
        if model.actuator_ctrllimited[u]:
            value = np.clip(value, *model.actuator_ctrlrange[u])
        if model.actuator_delay[drive] > 0:
            count = model.actuator_history[drive, 0]
            past = -model.opt.timestep * np.arange(count, 0, -1)
            mujoco.mj_initCtrlHistory(model, data, drive, past, np.full(count, value))
        if model.actuator_dyntype[drive] in FILTERS:
            data.act[model.actuator_actadr[drive]] = value


def system_error(system, runs, noise, perfect=False, kept=None):
    """Error of a TrueSystem over Runs of a machine with the same laws, in units of `noise`.

    perfect: started from what noiseless sensors read, compared with what they read later: what
    this system's physics alone does not explain. Otherwise from the noisy start that the contract
    prescribes, with the true memory: the floor of the Error.
    kept: for a system that lacks some laws, the indices of those it has.
    """
    return rms(system_residuals(system, runs, noise, perfect, kept))


def system_residuals(system, runs, noise, perfect=False, kept=None, horizon=HORIZON):
    """Predicted minus recorded (perfect: minus true) positions over the noise, (rows, nv)."""
    out = []
    model = system.model
    for run in runs:
        system.run = run.number
        for first, last in windows(run.time, horizon):
            qpos, qvel, time, memory = run.states[first]
            if kept is not None:
                memory = [memory[k] for k in kept]
            system.restore((qpos, qvel, time, memory))
            wanted = run.true_qpos[first], run.true_qvel[first]
            if not perfect:
                wanted = run.qpos[first], start_velocity(model, run, first)
            move_reading(system, *wanted)
            for row in range(first, last):
                # a file knows neither of rows that are missing nor of when a row really was
                told = [(run.ctrl[row], run.time[row + 1] - run.time[row])]
                for ctrl, seconds in run.sent[row] if perfect else told:
                    system.advance(ctrl, seconds)
                goal = run.true_qpos if perfect else run.qpos
                out.append(difference(model, goal[row + 1], system.reading()[0]) / noise)
    return np.array(out).reshape(-1, model.nv)


def move_reading(system, qpos, qvel):
    """Shift a system's state by what its sensors' reading lacks of qpos (nq,), qvel (nv,)."""
    read_q, read_v = system.reading()
    system._look()
    inner_q, inner_v = system.data.qpos.copy(), system.data.qvel.copy()
    jointed = system.jointed
    inner_q[system.address[jointed]] = system.q[jointed]
    inner_v[system.dof[jointed]] = system.v[jointed]
    shift = difference(system.model, read_q, qpos)
    mujoco.mj_integratePos(system.model, inner_q, shift, 1.0)
    system.place(inner_q, inner_v + qvel - read_v)
