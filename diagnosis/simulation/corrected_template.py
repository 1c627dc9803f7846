"""The model in corrected.xml with the physics that no field of MJCF holds. numpy and mujoco alone.

    python -i corrected.py

    model, data = load()
    data.ctrl[:] = 0.3
    step(model, data, 100)                    # instead of mujoco.mj_step(model, data, 100)
    rollout(model, qpos, qvel, ctrl, time)    # many runs
    install(model)                            # or: in every mj_step, a viewer's too

What is added stands in PARTS, in SI units; the laws are the functions below. A curve is linear
between its knots and keeps its outermost value beyond them, so nothing grows outside what was
recorded.
"""

from pathlib import Path

import mujoco
import numpy as np

XML = Path(__file__).with_name("corrected.xml")
# The joints of the recordings, in their columns' order.
JOINTS = []
# What is added: the law, the joint or actuator, the law's numbers.
PARTS = []


class Look:
    """What the laws see of one simulation, after the stages of position, velocity and actuation."""

    def __init__(self, model, data, ahead=0.0):
        self.model, self.data = model, data
        self.time, self.step = data.time + ahead, model.opt.timestep

    def position(self, joint):
        """rad or m."""
        return self.data.qpos[self.model.jnt_qposadr[joint_id(self.model, joint)]]

    def velocity(self, joint):
        """rad/s or m/s."""
        return self.data.qvel[self.model.jnt_dofadr[joint_id(self.model, joint)]]

    def bias(self, joint):
        """Coriolis forces minus gravity in the joint: minus the load from outside, but for
        contacts."""
        return self.data.qfrc_bias[self.model.jnt_dofadr[joint_id(self.model, joint)]]

    def force(self, actuator):
        """Of the actuator, within its range."""
        return self.data.actuator_force[actuator_id(self.model, actuator)]

    def control(self, actuator):
        """As it acts now: within its range, delayed, filtered."""
        model, data, a = self.model, self.data, actuator_id(self.model, actuator)
        if model.actuator_actadr[a] < 0 or model.actuator_dyntype[a] not in FILTERS:
            return self.command(actuator)
        i = model.actuator_actadr[a]
        lag, passed = model.actuator_dynprm[a, 0], self.step
        if not model.actuator_actearly[a]:
            return data.act[i]
        if model.actuator_dyntype[a] == int(mujoco.mjtDyn.mjDYN_FILTEREXACT):
            passed = lag * -np.expm1(-self.step / lag)
        return data.act[i] + passed * data.act_dot[i]

    def command(self, actuator):
        """The control as it reaches the actuator: within its range, delayed, not filtered."""
        model, data, a = self.model, self.data, actuator_id(self.model, actuator)
        u = model.actuator_ctrladr[a]
        value = data.ctrl[u]
        if model.actuator_delay[a] > 0:
            seen = np.zeros((1, 1))
            interp = int(model.actuator_history[a, 1])
            found = mujoco.mj_readCtrl(model, data, a, data.time, seen, interp)
            value = np.ravel(seen if found is None else found)[0]
        return (
            np.clip(value, *model.actuator_ctrlrange[u]) if model.actuator_ctrllimited[u] else value
        )


FILTERS = int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT)
BAD = [getattr(mujoco.mjtWarning, f"mjWARN_BAD{of}") for of in ("QPOS", "QVEL", "QACC")]


def joint_id(model, name):
    """Id of the joint of that name."""
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)


def actuator_id(model, name):
    """Id of the actuator of that name."""
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, name)


def drives(model, joint):
    """[(name, gear)] of the actuators with a control that act on the joint itself."""
    own = (model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)) & (model.actuator_ctrlnum > 0)
    own &= model.actuator_trnid[:, 0] == joint_id(model, joint)
    return [(model.actuator(a).name, model.actuator_gear[a, 0]) for a in np.flatnonzero(own)]


def drive(look, joint, more=0.0):
    """Force of the joint's drives in its own coordinate and some more of theirs, within the joint's
    range for them."""
    model, j = look.model, joint_id(look.model, joint)
    total = more + sum(gear * look.force(name) for name, gear in drives(model, joint))
    return np.clip(total, *model.jnt_actfrcrange[j]) if model.jnt_actfrclimited[j] else total


# dry friction: the level up to which it holds the joint, on top of the model's frictionloss


def stribeck_rest(look, joint, fall):
    """What friction at rest has more than in motion; stribeck_release gives it back."""
    return fall + 0 * look.velocity(joint)


def load_friction(look, joint, driving, driven, external):
    """share · |τ_drive − external · τ_load|, a share for the drive moving the joint, one for the
    load."""
    torque = drive(look, joint)
    share = np.where(torque * look.velocity(joint) >= 0, driving, driven)
    return share * abs(torque + external * look.bias(joint))


def friction_wave(look, joint, level, contrast, waves, phase):
    """level · (1 + contrast · sin(waves · q + phase))."""
    return level * (1 + contrast * np.sin(waves * look.position(joint) + phase))


def friction_curve(look, joint, knots, levels):
    """A level along the travel."""
    return np.interp(look.position(joint), knots, levels)


# forces


def variable(look, name):
    """The value of 'position:<joint>', 'velocity:…', 'load:…', 'control:<actuator>', 'command:…' or
    'time'."""
    kind, _, place = name.partition(":")
    if kind == "time":
        return look.time
    if kind == "load":
        return drive(look, place)
    return getattr(look, kind)(place)


def asked(look, kind, actuator):
    """Control of an actuator, or its command; of a servo, less where it already is: its force over
    its gain."""
    model, a = look.model, actuator_id(look.model, actuator)
    gain, bias = model.actuator_gainprm[a, 0], model.actuator_biasprm[a]
    u = variable(look, f"{kind}:{actuator}")
    if model.actuator_biastype[a] != int(mujoco.mjtBias.mjBIAS_AFFINE) or not gain:
        return u
    joint, gear = model.joint(model.actuator_trnid[a, 0]).name, model.actuator_gear[a, 0]
    q, v = look.position(joint), look.velocity(joint)
    return u + (bias[0] + gear * (bias[1] * q + bias[2] * v)) / gain


def factor_of(look, factor):
    """What a curve is multiplied by: 1, what an actuator is asked for, a velocity, its size or its
    sign."""
    if factor is None:
        return 1.0
    kind, _, place = factor.partition(":")
    if kind in ("control", "command"):
        return asked(look, kind, place)
    velocity = look.velocity(place)
    return {"velocity": np.sign(velocity), "speed": abs(velocity), "damping": velocity}[kind]


def curve(look, joint, of, knots, forces, factor=None):
    """A force along one variable, flat beyond its knots."""
    return np.interp(variable(look, of), knots, forces) * factor_of(look, factor)


def wave(look, joint, of, knots, forces, factor=None):
    """A sine through two knots, a quarter of its period apart."""
    turn = np.pi / 2 * (variable(look, of) - knots[0]) / (knots[1] - knots[0])
    return (forces[0] * np.cos(turn) + forces[1] * np.sin(turn)) * factor_of(look, factor)


def stribeck_release(look, joint, fall, velocity):
    """What friction at rest has too much for one moving: fall · (1 − exp(−(v/velocity)²)) along
    v."""
    v = look.velocity(joint)
    return -fall * np.expm1(-((v / velocity) ** 2)) * np.sign(v)


# what a drive loses of its force; the place is the actuator


def dead_zone_of_force(look, actuator, half_width):
    """A force below half_width does nothing, of a larger one what is above."""
    return -np.clip(look.force(actuator), -half_width, half_width)


def torque_speed(look, actuator, slope, stall):
    """|force| is at most stall − slope · |speed| where the drive pushes the way it moves."""
    model, a = look.model, actuator_id(look.model, actuator)
    joint, gear = model.joint(model.actuator_trnid[a, 0]).name, model.actuator_gear[a, 0]
    force, speed = look.force(actuator), gear * look.velocity(joint)
    most = np.maximum(stall - slope * abs(speed), 0.0)
    return np.where(force * speed > 0, np.clip(force, -most, most) - force, 0.0)


def gain_fade(look, actuator, rate):
    """The force falls as exp(−rate · time)."""
    return look.force(actuator) * np.expm1(-rate * look.time)


# what reaches a drive of its control; memory is kept from step to step


def dead_zone(look, wanted, memory, half_width):
    """A control below half_width does nothing, of a larger one what is above."""
    return np.sign(wanted) * np.maximum(abs(wanted) - half_width, 0.0)


def rate_limit(look, wanted, memory, rate):
    """The control follows at `rate` per second at most; its mean over the step to come."""
    goal, value, since = memory.get("rate_limit", (wanted, wanted, look.time))
    value = value + np.clip(goal - value, -rate * (look.time - since), rate * (look.time - since))
    begins = look.time < since  # another run
    value = np.where(begins, wanted, value)
    memory["rate_limit"] = np.copy(wanted), value, np.copy(look.time)
    gap, h = wanted - value, look.step
    reached = np.minimum(abs(gap) / rate, h)
    return value + np.sign(gap) * (rate * reached**2 / 2 + abs(gap) * (h - reached)) / h


def lag(look, wanted, memory, seconds):
    """The control passes a first-order filter: its mean over the step to come."""
    goal, value, since = memory.get("lag", (wanted, wanted, look.time))
    value = goal + (value - goal) * np.exp(-np.maximum(look.time - since, 0.0) / seconds)
    value = np.where(look.time < since, wanted, value)  # another run
    memory["lag"] = np.copy(wanted), value, np.copy(look.time)
    gone = -np.expm1(-look.step / seconds)
    return wanted + seconds / look.step * gone * (value - wanted)


def delay(look, wanted, memory, seconds):
    """The control comes later by less than a step: its mean over the step to come."""
    before, since = memory.get("delay", (wanted, look.time))
    before = np.where(look.time < since, wanted, before)
    memory["delay"] = np.copy(wanted), np.copy(look.time)
    late = min(seconds / look.step, 1.0)
    return late * before + (1 - late) * wanted


def effort_fade(look, wanted, memory, tires):
    """The control loses exp(−tires · E), E the integral of its square since the run began."""
    before, effort, since = memory.get("effort", (wanted, 0.0, look.time))
    effort = np.where(look.time < since, 0.0, effort + before**2 * (look.time - since))
    memory["effort"] = np.copy(wanted), effort, np.copy(look.time)
    return wanted * np.exp(-tires * effort)


FRICTION = {f.__name__: f for f in (stribeck_rest, load_friction, friction_wave, friction_curve)}
FORCE = {f.__name__: f for f in (curve, wave, stribeck_release)}
DRIVE = {f.__name__: f for f in (dead_zone_of_force, torque_speed, gain_fade)}
CONTROL = {f.__name__: f for f in (dead_zone, rate_limit, effort_fade, delay, lag)}


# running


def load(xml=XML):
    """(model, data) of corrected.xml."""
    model = mujoco.MjModel.from_xml_path(str(xml))
    return model, mujoco.MjData(model)


def controls(model, look, wanted, memory):
    """What reaches the actuators of the controls wanted (nu,)."""
    out = np.array(wanted, dtype=float)
    for number, (law, place, numbers) in enumerate(PARTS):
        if law in CONTROL:
            u = model.actuator_ctrladr[actuator_id(model, place)]
            value = out[..., u]
            if model.actuator_ctrllimited[u]:
                value = np.clip(value, *model.actuator_ctrlrange[u])
            own = memory.setdefault(number, {})
            out[..., u] = CONTROL[law](look, value, own, **numbers)
    return out


def corrections(model, look):
    """(force, level) as [(dof, value)]: what is added to the joints' forces, and to their
    frictionloss."""
    force, level = [], []
    for law, place, numbers in PARTS:
        if law in DRIVE:
            a = actuator_id(model, place)
            joint = model.joint(model.actuator_trnid[a, 0])
            lost = model.actuator_gear[a, 0] * DRIVE[law](look, place, **numbers)
            lost = drive(look, joint.name, lost) - drive(look, joint.name)
            force.append((joint.dofadr[0], lost))
        elif law in FORCE:
            dof = model.jnt_dofadr[joint_id(model, place)]
            force.append((dof, FORCE[law](look, place, **numbers)))
        elif law in FRICTION:
            dof = model.jnt_dofadr[joint_id(model, place)]
            level.append((dof, np.maximum(FRICTION[law](look, place, **numbers), 0.0)))
    return force, level


# Of the laws of control, by simulation.
MEMORY = {}


def step(model, data, nstep=1, ahead=0.0):
    """As mujoco.mj_step, with what PARTS adds, worked out at the beginning of each step.

    data.ctrl and data.qfrc_applied are the caller's, and left as they are. ahead: s, by which the
    laws' clock is ahead of data.time.
    """
    memory = MEMORY.setdefault(id(data), {})
    for _ in range(nstep):
        wanted, pushed = data.ctrl.copy(), data.qfrc_applied.copy()
        least = model.dof_frictionloss.copy()
        data.ctrl[:] = controls(model, Look(model, data, ahead), wanted, memory)
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_fwdActuation(model, data)
        force, level = corrections(model, Look(model, data, ahead))
        for dof, value in force:
            data.qfrc_applied[dof] += value
        for dof, value in level:
            model.dof_frictionloss[dof] += value
        mujoco.mj_step(model, data)
        data.ctrl[:], data.qfrc_applied[:], model.dof_frictionloss[:] = wanted, pushed, least


def install(model):
    """The same within every mj_step and mj_forward of this process, by MuJoCo's control callback.

    At each evaluation of the forces, of which Runge-Kutta has four a step. The solver's rows of
    dry friction are changed in place: there has to be one for each joint concerned, whose
    frictionloss becomes at least 1e-9, and the solver must not split them into islands.
    """
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
    for law, place, _ in PARTS:
        if law in FRICTION:
            dof = model.jnt_dofadr[joint_id(model, place)]
            model.dof_frictionloss[dof] = max(model.dof_frictionloss[dof], 1e-9)
    mujoco.set_mjcb_control(callback)


def callback(model, data):
    """To be called between the stages of velocity and actuation:
    mujoco.set_mjcb_control(callback)."""
    memory = MEMORY.setdefault(id(data), {})
    wanted, written = memory.get("controls", (None, None))
    if written is None or not np.array_equal(data.ctrl, written):  # the caller's new controls
        wanted = data.ctrl.copy()
    data.ctrl[:] = controls(model, Look(model, data), wanted, memory)
    memory["controls"] = wanted, data.ctrl.copy()
    mujoco.mj_fwdActuation(model, data)
    force, level = corrections(model, Look(model, data))
    for dof, value in force:
        data.qfrc_passive[dof] += value
    dry = data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF)
    for dof, value in level:
        data.efc_frictionloss[dry & (data.efc_id == dof)] += value


def rollout(model, qpos, qvel, ctrl, time):
    """States (S, T, nq), (S, T, nv) of S runs from qpos (S, nq), qvel (S, nv) at time[0].

    ctrl (S, T, nu) is held from time[k] to time[k + 1]; time (T,) in s. Delays and lags begin at
    rest in the first control.
    """
    data, states = mujoco.MjData(model), []
    for q, v, u in zip(qpos, qvel, ctrl):
        begin(model, data, u[0])
        data.qpos[:], data.qvel[:] = q, v
        states.append(list(run(model, data, u, time)))
    q, v = (np.array([[state[k] for state in one] for one in states]) for k in (0, 1))
    return q, v


def begin(model, data, ctrl):
    """At rest in a control: reset, with the delays' and lags' past filled."""
    mujoco.mj_resetData(model, data)
    MEMORY.pop(id(data), None)
    ctrl = controls(model, Look(model, data), ctrl, {})
    for a in np.flatnonzero(model.actuator_ctrlnum == 1):
        u = model.actuator_ctrladr[a]
        limited = model.actuator_ctrllimited[u]
        value = np.clip(ctrl[u], *model.actuator_ctrlrange[u]) if limited else ctrl[u]
        if model.actuator_delay[a] > 0:
            count = model.actuator_history[a, 0]
            past = -model.opt.timestep * np.arange(count, 0, -1)
            mujoco.mj_initCtrlHistory(model, data, a, past, np.full(count, value))
        if model.actuator_actadr[a] >= 0 and model.actuator_dyntype[a] in FILTERS:
            data.act[model.actuator_actadr[a]] = value


def run(model, data, ctrl, time):
    """Yields (qpos, qvel) at each time of time (T,), stepping on from data under ctrl (T, nu).

    data.time goes its own way: seconds since 1970 would round each of its steps, and delays ask
    for equal ones. NaN once it has blown up.
    """
    yield data.qpos.copy(), data.qvel.copy()
    h, sound = model.opt.timestep, True
    for u, now, seconds in zip(ctrl, time, np.diff(time)):
        steps, model.opt.timestep = divided(seconds, h)
        data.ctrl[: len(u)] = u
        step(model, data, steps, now - data.time)
        model.opt.timestep = h
        sound = sound and not blown_up(data)
        yield tuple(np.where(sound, x, np.nan) for x in (data.qpos, data.qvel))


def blown_up(data):
    """Whether MuJoCo met impossible states since this was last asked: it began anew then."""
    met = [data.warning[kind] for kind in BAD]
    found = any(warning.number for warning in met)
    for warning in met:
        warning.number = 0
    return found


def divided(seconds, h):
    """(number, length in s) of the equal time steps in some seconds: of h where these fit, else
    shorter."""
    steps = max(1, int(np.ceil(seconds / h - 1e-3)))
    return steps, h if abs(steps * h - seconds) < 2e-3 * h else seconds / steps


def predict(model, time, qpos, qvel, ctrl, windows, run_up=0.5):
    """[(rows, n)] positions of the recorded joints over windows [(first, last)] of one recording.

    time (T,), qpos (T, n), qvel (T, m), ctrl (T, nu) as recorded, columns of JOINTS and actuators
    in order. A window starts from its first row as recorded; what is not recorded (delays, lags,
    integrals, bristles, added joints) runs on from the window before, or from the first row of all,
    the recorded joints brought back to the record every `run_up` seconds.
    """
    q, v = columns(model)
    whole = np.isfinite(qpos).all(axis=1) & np.isfinite(qvel).all(axis=1)
    data, out, row = mujoco.MjData(model), [None] * len(windows), len(time)
    for k in np.argsort([first for first, _ in windows], kind="stable"):
        first, last = windows[k]
        if row > first:
            row = 0
            begin(model, data, ctrl[row])
        back = -np.inf
        for i in range(row, first):
            if whole[i] and time[i] - back >= run_up:
                data.qpos[q], data.qvel[v], back = qpos[i], qvel[i], time[i]
            for _ in run(model, data, ctrl[i : i + 1], time[i : i + 2]):
                pass
        data.qpos[q], data.qvel[v] = qpos[first], qvel[first]
        states = run(model, data, ctrl[first:last], time[first : last + 1])
        out[k], row = np.array([state[0][q] for state in states]), last
    return out


def columns(model):
    """Addresses in qpos and in qvel of the recorded joints' columns."""
    width = {int(mujoco.mjtJoint.mjJNT_FREE): (7, 6), int(mujoco.mjtJoint.mjJNT_BALL): (4, 3)}
    q, v = [], []
    for j in (joint_id(model, name) for name in JOINTS):
        nq, nv = width.get(int(model.jnt_type[j]), (1, 1))
        q += range(model.jnt_qposadr[j], model.jnt_qposadr[j] + nq)
        v += range(model.jnt_dofadr[j], model.jnt_dofadr[j] + nv)
    return q, v
