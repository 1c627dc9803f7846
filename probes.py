"""Values at which to try an effect that shows nothing at its nominal value.

    values_to_try(model, candidate, recordings) -> [(value, ...), ...]

Most effects change the motion from their nominal value on, in proportion; one small step per parameter tells how.
A limit does nothing until it is reached, a ripple has a wavelength, a curve has a bend: such effects are tried at a
few plausible values, taken from the range that the recordings cover. An empty list: a small step is enough.
"""

import mujoco
import numpy as np


def values_to_try(model, candidate, recordings):
    """Plausible values of a candidate's parameters; empty where its nominal value has a gradient."""
    function = PROBES.get(candidate.effect.name)
    return [] if function is None else [tuple(float(v) for v in p) for p in function(model, candidate, recordings)]


def _travel(model, name, recordings, field):
    joint = model.joint(name).id
    column = model.jnt_qposadr[joint] if field == "qpos" else model.jnt_dofadr[joint]
    x = np.concatenate([getattr(r, field)[:, column] for r in recordings])
    return x[np.isfinite(x)]


def _speeds(model, name, recordings):
    joint = model.joint(name).id
    out = []
    for r in recordings:
        q = r.qpos[:, model.jnt_qposadr[joint]]
        stride = max(1, len(q) // 2000)
        out.append(np.diff(q[::stride]) / np.diff(r.time[::stride]))
    x = np.abs(np.concatenate(out))
    return x[np.isfinite(x)]


def _forces(model, name, recordings):
    """|force| that an actuator was asked for: gain * control + bias(position); velocity terms left out."""
    i = model.actuator(name).id
    out = []
    for r in recordings:
        force = model.actuator_gainprm[i, 0] * r.ctrl[:, model.actuator_ctrladr[i]]
        if model.actuator_biastype[i] == int(mujoco.mjtBias.mjBIAS_AFFINE):
            force = force + model.actuator_biasprm[i, 0]
            if model.actuator_trntype[i] == int(mujoco.mjtTrn.mjTRN_JOINT):
                joint = model.actuator_trnid[i, 0]
                length = r.qpos[:, model.jnt_qposadr[joint]] * model.actuator_gear[i, 0]
                force = force + model.actuator_biasprm[i, 1] * np.nan_to_num(length)
        out.append(np.abs(force))
    return np.concatenate(out)


def _saturation(model, candidate, recordings):
    force = _forces(model, candidate.place.name, recordings)
    top = min(force.max(), candidate.parameters[0].nominal)
    return [(share * top,) for share in (0.9, 0.7, 0.5, 0.3)] if top > 0 else []


def _time_step(model, candidate, recordings):
    return [(model.opt.timestep / 4,)]


def _joint_stop(model, candidate, recordings):
    x = _travel(model, candidate.place.name, recordings, "qpos")
    if len(x) == 0 or np.ptp(x) == 0:
        return []
    low, high = np.quantile(x, [0.0, 1.0])
    far = high - low
    return [(low - 10 * far, high - share * far) for share in (0.03, 0.15)] + \
           [(low + share * far, high + 10 * far) for share in (0.03, 0.15)] + \
           [(low + 0.05 * far, high - 0.05 * far)]


def _cogging(model, candidate, recordings):
    names = [p.name for p in candidate.parameters]
    step = candidate.parameters[names.index("amplitude")].step
    travel = np.ptp(_travel(model, candidate.place.name, recordings, "qpos")) if recordings else 0
    out = []
    for poles in (4, 6, 7, 8, 10, 11, 12, 14, 16, 18, 20, 24, 28, 32, 36, 42, 48):
        if poles * travel < np.pi:
            continue
        for phase in (0.0, np.pi / 2):
            values = {"amplitude": step, "poles": poles, "phase": phase}
            out += [tuple(values[n] for n in names), tuple({**values, "phase": phase + np.pi}[n] for n in names)]
    return out


def _stribeck(model, candidate, recordings):
    speed = _speeds(model, candidate.place.name, recordings)
    if len(speed) == 0 or speed.max() == 0:
        return []
    step = candidate.parameters[0].step
    return [(step, 2 * step, v) for v in np.quantile(speed[speed > 0], [0.1, 0.3, 0.6])]


def _backlash(model, candidate, recordings):
    travel = np.ptp(_travel(model, candidate.place.name, recordings, "qpos"))
    return [(share * travel,) for share in (0.005, 0.02, 0.08)]


PROBES = {"saturation": _saturation, "time_step": _time_step, "joint_stop": _joint_stop, "cogging": _cogging,
          "stribeck_friction": _stribeck, "backlash": _backlash}
