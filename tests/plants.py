"""Mechanisms, recordings and the plain loop that the tests of effects and simulator share."""

from dataclasses import replace

import mujoco
import numpy as np

from diagnosis.estimation import windowing
from diagnosis.recordings.recording import Recording
from diagnosis.simulation.simulator import Window, World

ARM = """
<mujoco model="arm">
  <compiler angle="{angle}" autolimits="true"/>
  <option timestep="0.002" integrator="{integrator}" density="1.2" wind="0.5 0 0"/>
  <default><geom contype="0" conaffinity="0"/><motor ctrlrange="-9 9"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="2 2 .1" contype="1" conaffinity="1"/>
    <body name="base" pos="0 0 .45">
      <joint name="lift" type="slide" axis="0 0 1" damping="3" stiffness="400"/>
      <geom type="box" size=".05 .05 .05" mass="1.3"/>
      <body name="upper" pos="0.1 0 0.02">
        <joint name="swing" type="hinge" axis="0 1 0" damping="0.05" armature="0.01" ref="{ref}"/>
        <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="0.7123456789"/>
        <body name="fore" pos=".3 0 .01">
          <joint name="elbow" type="hinge" axis="0 1 0" damping="0.03 0.01" armature="0.005"
          stiffness="0.4" springref="{springref}"/>
          <geom name="tip" type="capsule" fromto="0 0 0 .25 0 0" size=".025" mass="0.4" contype="1"
          conaffinity="1" friction="0.7"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>{actuators}</actuator>
  <sensor><jointpos name="angle" joint="elbow"/><gyro name="spin" site="s"/></sensor>
</mujoco>""".replace('<geom name="tip"', '<site name="s" pos=".1 0 0"/><geom name="tip"')
MOTORS = """<motor name="push" joint="lift" gear="20"/><motor joint="swing" gear="2"/>
<motor name="bend" joint="elbow" gear="0.5" forcerange="-4 4"/>"""
SERVOS = (
    '<velocity name="push" joint="lift" kv="60"/><position joint="swing" kp="30" kv="1.5"/>'
    '<position name="bend" joint="elbow" kp="12" kv="0.4" forcerange="-3 3"/>'
)
MODELS = {
    "motors": (MOTORS, "implicitfast", "radian"),
    "servos": (SERVOS, "implicitfast", "degree"),
    "euler": (MOTORS, "Euler", "degree"),
    "rk4": (MOTORS, "RK4", "radian"),
}
# a size at which each effect matters, as a function of its nominal values and steps
SIZES = {
    "mass": (0.9,),
    "center_of_mass": (0.12, 0.02, -0.03),
    "inertia": (0.004, 0.005, 0.006),
    "link_length": (0.36,),
    "armature": (0.02,),
    "viscous_damping": (0.3,),
    "quadratic_damping": (0.15,),
    "coulomb_friction": (0.2,),
    "stribeck_friction": (0.1, 0.2, 0.3),
    "stiffness": (1.5,),
    "nonlinear_stiffness": (2.0,),
    "spring_offset": (0.4,),
    "cogging": (0.3, 7.0, 0.5),
    "joint_stop": (-0.3, 0.25),
    "backlash": (0.05,),
    "gain": (1.3,),
    "bias": (0.3,),
    "back_emf": (0.6,),
    "saturation": (1.0,),
    "delay": (0.0053,),
    "lag": (0.011,),
    "dead_zone": (0.4,),
    "servo_stiffness": (9.0,),
    "servo_damping": (0.8,),
    "load_friction": (0.3, 0.5, 0.7),
    "friction_map": (0.15, 0.8, 5.0, 0.4),
    "rate_limit": (4.0,),
    "torque_speed": (0.5, 2.0),
    "gain_fade": (0.8,),
    "presliding": (0.15, 3.0),
    "joint_elasticity": (8.0, 0.02),
    "coupled_friction": (0.2,),
    "coupled_inertia": (0.02,),
    "gravity": (0.7, 0.0, -9.0),
    "wind": (6.0, 1.0, -2.0),
    "air_drag": (30.0,),
    "time_step": (0.001,),
    "contact_friction": (0.2,),
    "contact_stiffness": (9000.0,),
    "contact_damping": (40.0,),
    "ground_height": (0.01,),
    "sensor_bias": (0.05,),
    "sensor_scale": (1.05,),
    "sensor_delay": (0.0047,),
    "external_force": (1.0, -0.5, 2.0),
    "payload_change": (0.9,),
}
T, DT = 60, 0.01


def arm(kind):
    """World and MJCF of an arm with a lift that reaches the floor; one actuator is unnamed."""
    actuators, integrator, angle = MODELS[kind]
    degree = angle == "degree"
    xml = ARM.format(
        actuators=actuators,
        integrator=integrator,
        angle=angle,
        ref=20 if degree else 0.35,
        springref=-10 if degree else -0.2,
    )
    return World(mujoco.MjSpec.from_string(xml)), xml


def commanded(time, ctrl=None, joints=1, name="made-up"):
    """A Recording of controls (T, nu), or of none, without measurements: what a simulation needs of
    one."""
    unread = np.full((len(time), joints), np.nan)
    return Recording(name, time, unread, unread, np.empty((len(time), 0)) if ctrl is None else ctrl)


def record(world, seed=0, rows=T, dt=DT):
    """A made-up recording: random held controls, made strong enough to move and touch the floor."""
    rng = np.random.default_rng(seed)
    ctrl = (
        np.repeat(rng.uniform(-1, 1, (rows // 4 + 1, world.model.nu)), 4, axis=0)[:rows]
        * [1.0, 2.0, 3.0][: world.model.nu]
    )
    return commanded(np.arange(rows) * dt, ctrl, world.model.njnt)


def stock(xml, world, recording, qpos, qvel, rows=T):
    """The loop anybody would write: load the file, set the start by name, step, read by name."""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    joints = [world.model.joint(j).name for j in range(world.model.njnt)]
    for name, q, v in zip(joints, qpos, qvel):
        data.joint(name).qpos, data.joint(name).qvel = q, v
    for a in range(world.model.nactuator):  # at rest in the first control
        first = (
            np.clip(recording.ctrl[0, a], *model.actuator_ctrlrange[a])
            if model.actuator_ctrllimited[a]
            else recording.ctrl[0, a]
        )
        if model.actuator_delay[a] > 0:
            past = -model.opt.timestep * np.arange(model.actuator_history[a, 0], 0, -1)
            mujoco.mj_initCtrlHistory(model, data, a, past, np.full(len(past), first))
        if model.actuator_actadr[a] >= 0:
            data.act[model.actuator_actadr[a]] = first
    out = [np.concatenate([data.joint(n).qpos for n in joints])]
    for t in range(rows - 1):
        for a in range(world.model.nactuator):
            data.ctrl[a] = recording.ctrl[t, a]  # appended actuators come last, without controls
        for _ in range(round((recording.time[t + 1] - recording.time[t]) / model.opt.timestep)):
            mujoco.mj_step(model, data)
        out.append(np.concatenate([data.joint(n).qpos for n in joints]))
    return np.array(out)


START = np.array([0.02, 0.4, -0.3]), np.array([0.1, -0.5, 0.8])


def simulate(world, settings, recording, rows=T, **options):
    n = len(settings)
    return world.simulate(
        settings,
        *(np.tile(x, (n, 1)) for x in START),
        [Window(recording, 0, rows - 1)] * n,
        **options,
    )[0]


PENDULUM = """
<mujoco><option timestep="0.001" integrator="{}"/><worldbody><body><joint name="j" axis="0 1 0"/>
<inertial pos="0 0 -.1" mass=".5" diaginertia=".02 .02 .02"/></body></worldbody><actuator>
<motor name="m" joint="j"/></actuator></mujoco>"""


def pendulum(integrator="implicitfast"):
    return World(mujoco.MjSpec.from_string(PENDULUM.format(integrator)))


def driven_by(actuator):
    """The pendulum with another actuator "m" on its joint "j": World, MJCF."""
    xml = PENDULUM.replace('<motor name="m" joint="j"/>', actuator).format("implicitfast")
    return World(mujoco.MjSpec.from_string(xml)), xml


def tight():
    """World of the pendulum on a stiff position servo, whose joint passes 1 N·m on at most."""
    _, xml = driven_by('<position name="m" joint="j" kp="50"/>')
    limited = xml.replace('axis="0 1 0"', 'axis="0 1 0" actuatorfrcrange="-1 1"')
    return World(mujoco.MjSpec.from_string(limited))


# what is left of a force F of such a servo at a speed v and a time t
WEAKER = {
    "gain_fade": ((9.0,), lambda F, v, t: F * np.exp(-9.0 * t)),
    "torque_speed": (
        (0.5, 1.5),
        lambda F, v, t: np.where(F * v > 0, np.sign(F) * np.clip(1.5 - 0.5 * abs(v), 0, abs(F)), F),
    ),
}


def stepped():
    """World of a servo of 50 N·m at most, and a run in which its goal steps by 1.5 rad, and its
    joint follows at 2 rad/s."""
    world, _ = driven_by('<position name="m" joint="j" kp="1000" forcerange="-50 50"/>')
    time = 0.01 * np.arange(400)
    up, moved = time % 2 >= 1, 2.0 * np.clip(time % 1, 0, 0.75)
    angle = np.where(up, moved, 1.5 - moved)[:, None]
    return world, replace(commanded(time, 1.5 * up[:, None]), qpos=angle)


FILTER = '<general name="m" joint="j" dyntype="filterexact" dynprm="0.05"/>'
INTEGRATOR = '<intvelocity name="m" joint="j" kp="3" actrange="-0.3 0.3"/>'


def there_and_back(world):
    """A run in stock MuJoCo of an actuator asked for 1 per second for 0.8 s, then for -1: its
    Recording, qpos and qvel (120, 1)."""
    ctrl = np.where(np.arange(120) < 80, 1.0, -1.0)[:, None]
    data, states = mujoco.MjData(world.model), []
    for control in ctrl:
        states.append((data.qpos.copy(), data.qvel.copy()))
        data.ctrl[:] = control
        mujoco.mj_step(world.model, data, nstep=10)
    return commanded(0.01 * np.arange(120), ctrl), *map(np.array, zip(*states))


def on_spring(stiff=100.0, rest=0.0):
    """World of an undriven wheel on a spring, and a run at 5 Hz and 0.05 rad about where that is at
    rest, in rad."""
    inertia = stiff / (10 * np.pi) ** 2
    xml = f"""<mujoco><compiler angle="radian"/><option timestep="0.001"/><worldbody><body>
        <joint name="j" axis="0 0 1" stiffness="{stiff}" springref="{rest}"/>
        <inertial pos="0 0 0" mass="1" diaginertia="{inertia} {inertia} {inertia}"/></body>
        </worldbody></mujoco>"""
    time = 0.01 * np.arange(400)
    angle = rest + 0.05 * np.cos(10 * np.pi * time)[:, None]
    return World(mujoco.MjSpec.from_string(xml)), replace(commanded(time), qpos=angle)


DROP = """<mujoco><option timestep="0.002"/><worldbody>
  <geom name="floor" type="plane" size="5 5 .1" solref="-4000 {damping}"/>
  <body name="block" pos="0 0 .05"><joint name="z" type="slide" axis="0 0 1" damping="0.3"/>
  <geom name="block" type="box" size=".08 .08 .05" mass="1" solref="-4000 {damping}"/></body>
  </worldbody></mujoco>"""


def dropped(seed, damping):
    """A block falls from somewhere, bounces and lies still, in stock MuJoCo: few rows hold what its
    contact is like."""
    rng, model = (
        np.random.default_rng(seed),
        mujoco.MjModel.from_xml_string(DROP.format(damping=damping)),
    )
    data, qpos = mujoco.MjData(model), np.empty((150, 1))
    data.qpos[:] = rng.uniform(0.1, 0.3)
    for t in range(len(qpos)):
        qpos[t] = data.qpos
        mujoco.mj_step(model, data, 5)
    noisy = qpos + 1e-3 * rng.normal(size=qpos.shape)
    return Recording(
        f"drop{seed}.csv",
        0.01 * np.arange(len(qpos)),
        noisy,
        np.full(qpos.shape, np.nan),
        np.zeros((len(qpos), 0)),
        {},
    )


DRIVEN_PENDULUM = """<mujoco><option timestep="0.005"/><worldbody><body name="arm">
  <joint name="pivot" axis="0 1 0" damping="{damping}"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".02" mass="{mass}" contype="0" conaffinity="0"/>
  </body></worldbody>
  <actuator><motor name="drive" joint="pivot"/></actuator></mujoco>"""

NOISE = 5e-4


def reported_error(world, setting, recordings, noise):
    """(error in noises, {channel: SI}) of a setting over windows as the contract has them."""
    windows = windowing.cut(recordings, windowing.HORIZON)
    predicted, _ = windowing.predict(world, setting, windows)
    return windowing.error(world.model, windows, predicted, noise)


def recorded(name, seed, damping=0.05, mass=0.5, push=None, seconds=4.0, noise=NOISE, finer=1):
    """A run of the pendulum in stock MuJoCo: sines and steps, position measured every 10 ms with
    noise.

    push(time, qpos, qvel): torque that no catalogue knows of.
    """
    rng = np.random.default_rng(seed)
    model = mujoco.MjModel.from_xml_string(DRIVEN_PENDULUM.format(damping=damping, mass=mass))
    model.opt.timestep /= finer
    data = mujoco.MjData(model)
    rows, period, phase = round(seconds / 0.01), rng.uniform(0.6, 1.2, 3), rng.uniform(0, 6, 3)
    time = 0.01 * np.arange(rows)
    ctrl = (0.2 * np.sin(2 * np.pi * time[:, None] / period + phase)).sum(1, keepdims=True)
    qpos = np.empty((rows, 1))
    data.qpos[:] = rng.uniform(-1, 1)
    for t in range(rows):
        qpos[t] = data.qpos
        data.ctrl[:] = ctrl[t]
        for _ in range(2 * finer):
            data.qfrc_applied[:] = push(data.time, data.qpos[0], data.qvel[0]) if push else 0.0
            mujoco.mj_step(model, data)
    return Recording(
        name, time, qpos + noise * rng.normal(size=qpos.shape), np.full((rows, 1), np.nan), ctrl, {}
    )


def loaded(seed, lasting, carried, between, rows=400):
    """A run of a pendulum, `lasting` times as heavy as nominal, for a while `carried` times: with a
    small load at its centre of mass."""
    rng, time = np.random.default_rng(seed), 0.01 * np.arange(rows)
    models = [
        mujoco.MjModel.from_xml_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5 * ratio))
        for ratio in (lasting, carried)
    ]
    models[1].body_inertia[1] = models[0].body_inertia[1]
    mujoco.mj_setConst(models[1], mujoco.MjData(models[1]))
    data, period = mujoco.MjData(models[0]), rng.uniform(0.6, 1.2, 3)
    ctrl = (0.4 * np.sin(2 * np.pi * time[:, None] / period)).sum(1, keepdims=True)
    qpos = np.empty((rows, 1))
    for t in range(rows):
        qpos[t], data.ctrl[:] = data.qpos, ctrl[t]
        mujoco.mj_step(models[int(between[0] <= time[t] < between[1])], data, 2)
    noisy = qpos + NOISE * rng.normal(size=qpos.shape)
    return Recording("run.csv", time, noisy, np.full((rows, 1), np.nan), ctrl, {})
