"""Effects: what a batch simulates is what stock MuJoCo makes of corrected.xml, and nothing at zero size."""

from pathlib import Path
from types import SimpleNamespace

import gymnasium
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from physics import EFFECTS
from signals import Signal
from world import Window, World

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
          <joint name="elbow" type="hinge" axis="0 1 0" damping="0.03 0.01" armature="0.005" stiffness="0.4" springref="{springref}"/>
          <geom name="tip" type="capsule" fromto="0 0 0 .25 0 0" size=".025" mass="0.4" contype="1" conaffinity="1" friction="0.7"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>{actuators}</actuator>
  <sensor><jointpos name="angle" joint="elbow"/><gyro name="spin" site="s"/></sensor>
</mujoco>""".replace('<geom name="tip"', '<site name="s" pos=".1 0 0"/><geom name="tip"')
MOTORS = '<motor name="push" joint="lift" gear="20"/><motor joint="swing" gear="2"/><motor name="bend" joint="elbow" gear="0.5" forcerange="-4 4"/>'
SERVOS = ('<velocity name="push" joint="lift" kv="60"/><position joint="swing" kp="30" kv="1.5"/>'
          '<position name="bend" joint="elbow" kp="12" kv="0.4" forcerange="-3 3"/>')
MODELS = {'motors': (MOTORS, 'implicitfast', 'radian'), 'servos': (SERVOS, 'implicitfast', 'degree'),
          'euler': (MOTORS, 'Euler', 'degree'), 'rk4': (MOTORS, 'RK4', 'radian')}
# a size at which each effect matters, as a function of its nominal values and steps
SIZES = {'mass': (0.9,), 'center_of_mass': (0.12, 0.02, -0.03), 'inertia': (0.004, 0.005, 0.006), 'link_length': (0.36,), 'armature': (0.02,),
         'viscous_damping': (0.3,), 'quadratic_damping': (0.15,), 'coulomb_friction': (0.2,), 'stribeck_friction': (0.1, 0.2, 0.3), 'stiffness': (1.5,),
         'nonlinear_stiffness': (2.0,), 'spring_offset': (0.4,), 'cogging': (0.3, 7.0, 0.5), 'joint_stop': (-0.3, 0.25), 'backlash': (0.05,), 'gain': (1.3,),
         'bias': (0.3,), 'back_emf': (0.6,), 'saturation': (1.0,), 'delay': (0.0053,), 'lag': (0.011,), 'dead_zone': (0.4,), 'gravity': (0.7, 0.0, -9.0),
         'wind': (6.0, 1.0, -2.0), 'air_drag': (30.0,), 'time_step': (0.001,), 'contact_friction': (0.2,), 'contact_stiffness': (9000.0,),
         'contact_damping': (40.0,), 'ground_height': (0.01,), 'sensor_bias': (0.05,), 'sensor_scale': (1.05,), 'sensor_delay': (0.0047,),
         'external_force': (1.0, -0.5, 2.0), 'payload_change': (0.9,)}
T, DT = 60, 0.01


def arm(kind):
    """World and MJCF of an arm with a lift that reaches the floor; one actuator is unnamed."""
    actuators, integrator, angle = MODELS[kind]
    degree = angle == 'degree'
    xml = ARM.format(actuators=actuators, integrator=integrator, angle=angle, ref=20 if degree else 0.35, springref=-10 if degree else -0.2)
    return World(mujoco.MjSpec.from_string(xml)), xml


def record(world, seed=0, rows=T, dt=DT):
    """A made-up recording: random held controls, made strong enough to move and touch the floor."""
    rng = np.random.default_rng(seed)
    ctrl = np.repeat(rng.uniform(-1, 1, (rows // 4 + 1, world.model.nu)), 4, axis=0)[:rows] * [1.0, 2.0, 3.0][:world.model.nu]
    return SimpleNamespace(name='made-up', time=np.arange(rows) * dt, ctrl=ctrl)


def stock(xml, world, recording, qpos, qvel, rows=T):
    """The loop anybody would write: load the file, set the start by name, step, read by name."""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    joints = [world.model.joint(j).name for j in range(world.model.njnt)]
    for name, q, v in zip(joints, qpos, qvel):
        data.joint(name).qpos, data.joint(name).qvel = q, v
    for a in range(world.model.nactuator):  # at rest in the first control
        first = np.clip(recording.ctrl[0, a], *model.actuator_ctrlrange[a]) if model.actuator_ctrllimited[a] else recording.ctrl[0, a]
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


@pytest.fixture(scope='module', params=MODELS)
def case(request):
    world, xml = arm(request.param)
    return world, xml, record(world)


def simulate(world, settings, recording, rows=T, **options):
    n = len(settings)
    return world.simulate(settings, *(np.tile(x, (n, 1)) for x in START), [Window(recording, 0, rows - 1)] * n, **options)[0]


def test_the_contracts_effects_are_all_there():
    assert {effect.name for effect in EFFECTS} == set(SIZES)


def test_nothing_is_exactly_nominal(case):
    world, xml, recording = case
    expected = stock(xml, world, recording, *START)
    assert np.ptp(expected, axis=0).min() > 0.02
    for qpos in simulate(world, [{}] + [{c: c.nominal} for c in world.candidates], recording):
        np.testing.assert_allclose(qpos, expected, rtol=0, atol=1e-12)


def test_zero_size_is_the_limit_of_small_sizes(case):
    """What is left out at its nominal value is also what a vanishing effect tends to: no jump there."""
    world, xml, recording = case
    expected = stock(xml, world, recording, *START)[:20]
    for candidate in world.candidates:
        if candidate.effect.name in ('backlash', 'time_step') or not np.isfinite(candidate.nominal).all():
            continue  # the motor's inertia, the number of steps, limits that begin at infinity
        values = tuple(p.nominal + 1e-6 * p.step for p in candidate.parameters)
        qpos, = simulate(world, [{candidate: values}], recording, 20)
        assert abs(qpos - expected).max() < 2e-6, candidate


def test_every_effect_is_the_same_in_mjcf(case):
    world, xml, recording = case
    predicted = simulate(world, [{}] + [{c: SIZES[c.effect.name]} for c in world.candidates], recording)
    felt = set()
    for candidate, qpos in zip(world.candidates, predicted[1:]):
        corrected, written = world.corrected_xml({candidate: SIZES[candidate.effect.name]})
        assert np.isfinite(qpos).all(), candidate
        if candidate.place.kind != 'sensor' and abs(qpos - predicted[0]).max() > 1e-3:
            felt.add(candidate.effect.name)
        if candidate.effect.name == 'dead_zone' and written[candidate] == 'mjcf':  # a little late
            late, size = abs(stock(corrected, world, recording, *START) - qpos)[:20], abs(predicted[0] - qpos)[:20]
            assert late.max() < 0.5 * size.max() and late.mean() < 0.5 * size.mean()
        elif written[candidate] == 'mjcf' and candidate.effect.name != 'stribeck_friction':
            # Runge-Kutta reads delays and lags at its stages, here they are averaged over the step
            close = 3e-4 if candidate.effect.name in ('delay', 'lag') else 1e-9
            np.testing.assert_allclose(stock(corrected, world, recording, *START), qpos, rtol=0, atol=close, err_msg=repr(candidate))
    contact = {'contact_friction', 'contact_stiffness', 'contact_damping', 'ground_height'}  # the servos hold the arm off the floor
    assert felt | contact == set(SIZES)


def test_all_effects_together_are_the_same_in_mjcf(case):
    """One setting of many effects: each is written beside the others."""
    world, xml, recording = case
    places = {'elbow', 'bend', 'fore', 'world', 'tip'}
    leave = {'stribeck_friction', 'dead_zone', 'sensor_scale', 'sensor_delay', 'payload_change', 'time_step', 'backlash', 'delay', 'lag', 'joint_stop'}
    setting = {c: SIZES[c.effect.name] for c in world.candidates if c.place.name in places and c.effect.name not in leave}
    assert len(setting) > 20
    corrected, written = world.corrected_xml(setting)
    assert set(written.values()) == {'mjcf'}
    qpos, = simulate(world, [setting], recording, 20)
    np.testing.assert_allclose(stock(corrected, world, recording, *START, 20), qpos, rtol=0, atol=1e-9)


PENDULUM = """
<mujoco><option timestep="0.001" integrator="{}"/><worldbody><body><joint name="j" axis="0 1 0"/>
<inertial pos="0 0 -.1" mass=".5" diaginertia=".02 .02 .02"/></body></worldbody><actuator><motor name="m" joint="j"/></actuator></mujoco>"""


def pendulum(integrator='implicitfast'):
    return World(mujoco.MjSpec.from_string(PENDULUM.format(integrator)))


def test_stribeck_friction_in_mjcf_and_by_hand():
    """Bristles, frictionloss with a force, and the law itself at a fine step agree through reversals and sticking."""
    world, (coulomb, static, velocity) = pendulum(), (0.1, 0.2, 0.3)
    time = np.arange(100) * 0.01
    recording = SimpleNamespace(name='', time=time, ctrl=(0.5 * np.sin(6 * time) + 0.3 * np.sin(14 * time + 1))[:, None])
    setting = {world.candidate('stribeck_friction', 'j'): (coulomb, static, velocity)}
    qpos, _ = world.simulate([setting, {}], [[0.0]] * 2, [[1.0]] * 2, [Window(recording, 0, 99)] * 2)
    corrected, _ = world.corrected_xml(setting)
    by_hand, q, v, h = [0.0], 0.0, 1.0, 1e-5
    for t in range(99):
        for _ in range(1000):
            free = v + h / 0.025 * (recording.ctrl[t, 0] - 0.5 * 9.81 * 0.1 * np.sin(q))
            stop = h / 0.025 * (coulomb + (static - coulomb) * np.exp(-(v / velocity)**2))
            v = np.sign(free) * max(abs(free) - stop, 0.0)
            q += h * v
        by_hand.append(q)
    assert abs(qpos[1, :, 0] - by_hand).max() > 0.2
    assert abs(qpos[0, :, 0] - by_hand).max() < 3e-3
    assert abs(stock(corrected, world, recording, [0.0], [1.0], 100)[:, 0] - by_hand).max() < 0.02


def test_coulomb_friction_holds():
    """Below its limit the joint stands still: no creep, unlike MuJoCo's default friction."""
    world = pendulum()
    recording = SimpleNamespace(name='', time=np.array([0.0, 1.0]), ctrl=np.full((2, 1), 0.09))
    setting = {world.candidate('coulomb_friction', 'j'): (0.12,)}
    qpos, _ = world.simulate([setting], [[0.0]], [[0.0]], [Window(recording, 0, 1)])
    assert abs(qpos[0, 1, 0]) < 2e-4


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), delay=st.floats(0, 0.05), lag=st.one_of(st.just(0.0), st.floats(1e-4, 0.1)))
def test_signal_against_a_plain_loop(seed, delay, lag):
    """A held, delayed, filtered control, sampled in steps, against 1 µs steps of the differential equation."""
    rng = np.random.default_rng(seed)
    time, value = np.cumsum(rng.uniform(0.001, 0.02, 12)), rng.uniform(-1, 1, 12)
    start, step, count, fine = time[4], 0.002, 10, 1e-5
    t = np.arange(time[0] - fine, start + step * count, fine) + fine / 2
    u = value[np.maximum(np.searchsorted(time, t - delay, side='right') - 1, 0)]
    act = np.empty_like(u)
    level = value[0]
    for k in range(len(u)):
        level = act[k] = u[k] + (level - u[k]) * np.exp(-fine / lag) if lag else u[k]
    inside = [(t >= start + step * k) & (t < start + step * (k + 1)) for k in range(count)]
    signal = Signal(time, value, delay, lag)
    np.testing.assert_allclose(signal.sample(start, step, count, True), [act[i].mean() for i in inside], atol=0.03)
    if lag:
        np.testing.assert_allclose(signal.sample(start, step, count, False), [act[i][-1] for i in inside], atol=0.03)


@pytest.mark.parametrize('effect, values', [('delay', (0.0137,)), ('lag', (0.02,)), ('gain', (1.0,))])
def test_a_window_goes_on_where_the_run_was(case, effect, values):
    """Histories: starting in the middle of a run, from its state there, is going on with it."""
    world, _, recording = case
    setting = {world.candidate(effect, 'bend'): values}
    qpos, qvel = world.simulate([setting], *(x[None] for x in START), [Window(recording, 0, T - 1)])
    later = world.simulate([setting], qpos[:, 7], qvel[:, 7], [Window(recording, 7, 22)])[0]
    np.testing.assert_allclose(later[0], qpos[0, 7:23], rtol=0, atol=1e-8)


def test_filtered_and_integrating_actuators_go_on_too():
    actuators = '<general name="push" joint="lift" dyntype="filter" dynprm="0.03" gainprm="20"/><intvelocity name="swing" joint="swing" kp="3"/>'
    xml = ARM.format(actuators=actuators, integrator='Euler', angle='radian', ref=0.35, springref=-0.2)
    world = World(mujoco.MjSpec.from_string(xml))
    recording = record(world)
    model, data = world.model, mujoco.MjData(world.model)
    data.qpos[:], data.qvel[:] = START
    data.act[0] = recording.ctrl[0, 0]
    q, v = [], []
    for t in range(T):
        q.append(data.qpos.copy())
        v.append(data.qvel.copy())
        data.ctrl[:] = recording.ctrl[t]
        mujoco.mj_step(model, data, 5)
    windows = [Window(recording, k, k + 12) for k in (0, 9, 30)]
    qpos, _ = world.simulate([{}] * 3, [q[w.first] for w in windows], [v[w.first] for w in windows], windows)
    for row, w in zip(qpos, windows):
        np.testing.assert_allclose(row, q[w.first:w.last + 1], atol=2e-3)  # MuJoCo's `filter` is an Euler step, not exact


def test_rows_between_time_steps():
    """Irregular rows that no time step meets, against the closed form of an oscillator pushed at those rows."""
    xml = """<mujoco><option timestep="0.003" gravity="0 0 0" integrator="RK4"/><worldbody><body><joint name="x" type="slide" axis="1 0 0" stiffness="50"/>
             <geom size=".1" mass="2"/></body></worldbody><actuator><motor name="m" joint="x"/></actuator></mujoco>"""
    world, rng = World(mujoco.MjSpec.from_string(xml)), np.random.default_rng(0)
    time = np.cumsum(rng.uniform(0.002, 0.02, 60))
    force, q, v, w = rng.uniform(-5, 5, 60), 0.1, -0.3, 5.0
    exact = [(q, v)]
    for f, dt in zip(force, np.diff(time)):  # x'' = f / 2 - 25 x
        c, s, rest = np.cos(w * dt), np.sin(w * dt), f / 50
        q, v = rest + (q - rest) * c + v / w * s, -(q - rest) * w * s + v * c
        exact.append((q, v))
    recording = SimpleNamespace(name='', time=time, ctrl=force[:, None])
    qpos, qvel = world.simulate([{}] * 2, [[0.1]] * 2, [[-0.3]] * 2, [Window(recording, 0, 59), Window(recording, 0, 20)])
    np.testing.assert_allclose(qpos[0, :, 0], np.array(exact)[:, 0], atol=2e-5)
    np.testing.assert_allclose(qvel[0, :, 0], np.array(exact)[:, 1], atol=4e-3)
    assert np.isnan(qpos[1, 21:]).all() and np.isfinite(qpos[1, :21]).all()


def test_refining_converges(case):
    world, _, recording = case
    coarse, fine, finest = (simulate(world, [{}], recording, 8, refine=n)[0] for n in (1, 8, 32))
    assert abs(fine - finest).max() < max(0.5 * abs(coarse - finest).max(), 1e-6)
    step = world.candidate('time_step', 'world')
    np.testing.assert_array_equal(simulate(world, [{step: (world.model.opt.timestep / 8,)}], recording, 8)[0], fine)


def test_sensors_of_the_joints(case):
    """scale · q(t − delay) + offset, of the run from the true start."""
    world, _, recording = case
    setting = {world.candidate('sensor_bias', 'elbow'): (0.1,), world.candidate('sensor_scale', 'elbow'): (1.2,)}
    time = np.arange(601) * 0.001
    dense = SimpleNamespace(name='', time=time, ctrl=recording.ctrl[np.minimum((time + 1e-9) // DT, T - 1).astype(int)])
    true = [x.copy() for x in START]
    true[0][2], true[1][2] = (START[0][2] - 0.1) / 1.2, START[1][2] / 1.2
    run = world.simulate([{}], *(x[None] for x in true), [Window(dense, 0, 590)])[0][0]
    seen = simulate(world, [setting], recording)[0]
    np.testing.assert_allclose(seen[:, 2], 1.2 * run[::10, 2] + 0.1, atol=1e-12)
    np.testing.assert_allclose(seen[:, :2], run[::10, :2], atol=1e-12)

    late = {world.candidate('sensor_delay', 'elbow'): (0.0065,)}
    true = [x.copy() for x in START]
    true[0][2] += 0.0065 * START[1][2]  # the start as its sensor shows it
    run = world.simulate([{}], *(x[None] for x in true), [Window(dense, 0, 590)])[0][0]
    seen = simulate(world, [late], recording)[0]
    np.testing.assert_allclose(seen[1:, 2], np.interp(np.arange(1, T) * DT - 0.0065, dense.time[:591], run[:, 2]), atol=2e-4)
    np.testing.assert_allclose(seen[0], START[0])


def test_sensors_of_the_model(case):
    world, xml, recording = case
    setting = {world.candidate('sensor_bias', 'spin'): (0.3,), world.candidate('sensor_scale', 'angle'): (2.0,)}
    qpos, _, data = world.simulate([setting], *(x[None] for x in START), [Window(recording, 0, T - 1)], sensors=True)
    stepped = mujoco.MjData(world.model)
    stepped.qpos[:], stepped.qvel[:] = START
    mujoco.mj_forward(world.model, stepped)
    np.testing.assert_allclose(data[0, :, 0], 2 * qpos[0, :, 2], atol=1e-12)
    np.testing.assert_allclose(data[0, 0, 1:], stepped.sensordata[1:] + 0.3, atol=1e-12)


def test_effects_under_a_condition():
    """A load in the middle of the run, friction in part of the range: against a loop that switches them."""
    world = pendulum()
    time = np.arange(80) * 0.01
    recording = SimpleNamespace(name='run', time=time, ctrl=0.3 * np.sin(9 * time)[:, None])
    window, model = Window(recording, 5, 75), world.model
    body = model.body(1).name

    def loop(act):
        data, out = mujoco.MjData(model), []
        data.qpos[0], data.qvel[0] = 0.3, 0.5
        model.dof_solref[0], model.dof_solimp[0] = (0.004, 1), (0.999, 0.9999, 0.001, 0.5, 2)
        for row in range(5, 76):
            out.append(data.qpos[0])
            data.ctrl[0] = recording.ctrl[row, 0]
            for k in range(10):
                act(model, data, time[row] + k * 0.001)
                mujoco.mj_step(model, data)
        model.dof_frictionloss[0] = model.dof_damping[0] = 0
        return np.array(out)

    def push(m, d, t):
        d.xfrc_applied[1, 0] = 3.0 if 0.2 - 1e-9 <= t < 0.5 - 1e-9 else 0.0

    def rub(m, d, t):
        m.dof_frictionloss[0] = 0.4 * (-0.1 <= d.qpos[0] < 0.2)

    def brake(m, d, t):
        m.dof_damping[0] = 0.2 * (d.qvel[0] >= 0)
    when = {'recording': 'run', 'time': [0.2 - 1e-9, 0.5 - 1e-9]}
    force = world.localised(world.candidate('external_force', body), when)
    patch = world.localised(world.candidate('coulomb_friction', 'j'), {'qpos:j': [-0.1, 0.2]})
    brakes = world.localised(world.candidate('viscous_damping', 'j'), {'qvel:j': [0.0, np.inf]})
    elsewhere = world.localised(world.candidate('external_force', body), when | {'recording': 'another'})
    load = world.localised(world.candidate('payload_change', body), when)
    settings_ = [{force: (3.0, 0.0, 0.0)}, {patch: (0.4,)}, {brakes: (0.2,)}, {elsewhere: (3.0, 0.0, 0.0)}, {load: (0.9,)}, {}]
    qpos, _ = world.simulate(settings_, [[0.3]] * 6, [[0.5]] * 6, [window] * 6)
    for row, act in zip(qpos, (push, rub, brake)):
        np.testing.assert_allclose(row[:, 0], loop(act), rtol=0, atol=1e-9)
    np.testing.assert_array_equal(qpos[3], qpos[5])
    assert abs(qpos[0] - qpos[5]).max() > 0.01 and abs(qpos[4] - qpos[5]).max() > 0.01
    assert force != world.candidate('external_force', body) and force == world.localised(force, dict(when))
    assert world.corrected_xml({force: (3.0, 0.0, 0.0)})[1] == {force: 'none'}
    with pytest.raises(ValueError, match='different conditions'):
        world.simulate([{force: (3.0, 0.0, 0.0), patch: (0.4,)}], [[0.3]], [[0.5]], [window])


def test_unknown_curves():
    """A curve through damping's values is damping, in simulation and in MJCF; a wiggle has no MJCF form."""
    world = pendulum()
    time = np.arange(60) * 0.01
    recording = SimpleNamespace(name='', time=time, ctrl=0.5 * np.sin(9 * time)[:, None])
    knots = np.linspace(-6, 6, 25)
    curve, damping = world.curve('j', 'velocity:j', knots), world.candidate('viscous_damping', 'j')
    spring = world.curve('j', 'position:j', np.linspace(-1, 2, 61))
    follow = world.curve('j', 'control:m', (-1.0, 1.0))
    drift = world.curve('j', 'time', (0.0, 1.0))
    bent = tuple(0.3 - 0.5 * (x - 0.1 * x**2 + 0.2 * x**3) for x in np.linspace(-1, 2, 61))
    settings_ = [{curve: tuple(-0.1 * knots)}, {damping: (0.1,)}, {follow: (-0.3, 0.3)}, {world.candidate('gain', 'm'): (1.3,)}, {drift: (0.2, 0.2)},
                 {world.candidate('spring_offset', 'j'): (0.2,)}, {spring: bent}]
    qpos, _ = world.simulate(settings_, [[0.3]] * 7, [[0.5]] * 7, [Window(recording, 0, 59)] * 7)
    np.testing.assert_allclose(qpos[0], qpos[1], atol=2e-3)  # the curve is explicit, damping implicit
    np.testing.assert_allclose(qpos[2], qpos[3], atol=1e-12)
    np.testing.assert_allclose(qpos[4], qpos[5], atol=1e-12)
    for k, candidate in ((0, curve), (6, spring)):
        xml, written = world.corrected_xml(settings_[k])
        assert written == {candidate: 'mjcf'}
        np.testing.assert_allclose(stock(xml, world, recording, [0.3], [0.5], 60), qpos[k], atol=2e-3)
    assert world.corrected_xml({curve: tuple(np.sin(3 * knots))})[1] == {curve: 'none'}
    assert curve == world.curve('j', 'velocity:j', list(knots)) != world.curve('j', 'velocity:j', knots + 1)


def test_unstable_simulations_are_nan_and_silent(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    world, recording = pendulum('Euler'), SimpleNamespace(name='', time=np.arange(50) * 0.01, ctrl=np.ones((50, 1)))
    wild = {world.candidate('nonlinear_stiffness', 'j'): (-1e9,)}
    no_inertia = {world.candidate('inertia', '1'): (1e-20, 1e-20, 1e-20), world.candidate('mass', '1'): (1e-20,)}
    settings_ = [{}, wild, {}, no_inertia, {world.curve('j', 'position:j', (-1.0, 1.0)): (-1e12, 1e12)}]
    qpos, qvel = world.simulate(settings_, [[0.3]] * 5, [[0.5]] * 5, [Window(recording, 0, 49)] * 5)
    assert np.isfinite(qpos[[0, 2]]).all() and np.array_equal(qpos[0], qpos[2])
    assert np.isnan(qpos[1, 1:]).all() and np.isnan(qvel[1, 1:]).all() and np.isnan(qpos[4, 1:]).all()
    assert qpos[1, 0, 0] == 0.3
    assert not list(tmp_path.iterdir()) and capfd.readouterr() == ('', '')
    np.testing.assert_array_equal(world.simulate([{}], [[0.3]], [[0.5]], [Window(recording, 0, 49)])[0][0], qpos[0])


def test_a_batch_is_its_members(case):
    """Mixed windows and settings in one call, each as if simulated alone."""
    world, _, recording = case
    rng = np.random.default_rng(1)
    windows = [Window(recording, k, k + 5 + k % 3) for k in rng.integers(0, 40, 24)]
    settings_ = [{c: SIZES[c.effect.name]} for c in rng.permutation(np.array(world.candidates, dtype=object))[:24]]
    start_q, start_v = START[0] + rng.normal(0, 0.1, (24, 3)), rng.normal(0, 1, (24, 3))
    together = world.simulate(settings_, start_q, start_v, windows)
    for k, (setting, window) in enumerate(zip(settings_, windows)):
        alone = world.simulate([setting], start_q[k:k + 1], start_v[k:k + 1], [window])
        for a, b in zip(alone, together):
            np.testing.assert_array_equal(a[0], b[k, :window.last - window.first + 1])


def test_probes_show_something(case):
    """Values to try first lie within the bounds and change the motion."""
    world, _, recording = case
    recording.qpos = simulate(world, [{}], recording)[0]
    for candidate in world.candidates:
        rows = world.probes(candidate, [recording])
        low, high = (np.array([getattr(p, bound) for p in candidate.parameters]) for bound in ('low', 'high'))
        assert rows.ndim == 2 and rows.shape[1] == len(low) and len(rows), candidate
        assert (((rows >= low) & (rows <= high)) | np.isinf(rows)).all(), candidate
        assert not (rows == candidate.nominal).all(axis=1).any()


def test_related_sit_at_the_same_joint(case):
    world, _, _ = case
    related = world.related(world.candidate('coulomb_friction', 'elbow'))
    assert {('viscous_damping', 'elbow'), ('back_emf', 'bend')} <= {(c.effect.name, c.place.name) for c in related}
    assert not [c for c in related if c.place.name in ('lift', 'swing', 'push')]


CUBE = """
<mujoco><option timestep="0.001"/><worldbody><geom name="floor" type="plane" size="3 3 .1"/><body name="cube" pos="0 0 .3">
<freejoint name="free"/><geom name="box" type="box" size=".05 .05 .05" mass=".4"/></body></worldbody></mujoco>"""


def test_a_tossed_cube(case):
    """Free joints and contacts: the same in MJCF; friction follows the larger of the two geoms' nominally."""
    world = World(mujoco.MjSpec.from_string(CUBE))
    recording = SimpleNamespace(name='', time=np.arange(60) / 148, ctrl=np.zeros((60, 0)))
    q, v = np.array([0, 0, 0.12, 1, 0, 0, 0.0]), np.array([1.0, 0.3, -1, 2, 1, 0])
    settings_ = [{}] + [{world.candidate(e, g): x} for g in ('floor', 'box') for e, x in (('contact_friction', (0.18,)), ('contact_stiffness', (9000.0,)))]
    qpos, _ = world.simulate(settings_, np.tile(q, (5, 1)), np.tile(v, (5, 1)), [Window(recording, 0, 59)] * 5)
    np.testing.assert_allclose(qpos[1], qpos[3], atol=1e-12)
    assert abs(qpos[1, -1, :2] - qpos[0, -1, :2]).max() > 0.02
    np.testing.assert_allclose(np.linalg.norm(qpos[..., 3:], axis=2), 1, atol=1e-9)
    for setting, predicted in zip(settings_, qpos):
        model = mujoco.MjModel.from_xml_string(world.corrected_xml(setting)[0])
        data, run = mujoco.MjData(model), []
        data.qpos[:], data.qvel[:] = q, v
        for _ in range(420):
            run.append(data.qpos.copy())
            mujoco.mj_step(model, data)
        k = recording.time * 1000  # rows fall between steps: on the line through them, but at impacts
        line = np.array([np.interp(k, np.arange(420), column) for column in np.array(run).T]).T
        assert np.quantile(abs(line[:, :3] - predicted[:, :3]), 0.95) < 1e-4


def gym_model(name):
    return Path(gymnasium.__file__).parent / 'envs' / 'mujoco' / 'assets' / f'{name}.xml'


@pytest.mark.parametrize('name, body', [('hopper', 'torso'), ('half_cheetah', 'torso'), ('inverted_pendulum', 'pole'), ('walker2d', 'foot'), ('ant', 'torso'),
                                        ('humanoid', 'pelvis'), ('swimmer', 'mid'), ('reacher', 'body1')])
def test_gymnasium_models_with_another_mass(tmp_path, name, body):
    """The traps of these files: inertiafromgeom, settotalmass, angles in degrees, six digits."""
    world = World.load(gym_model(name))
    nominal = mujoco.MjModel.from_xml_path(str(gym_model(name)))
    b, mass = nominal.body(body).id, nominal.body(body).mass[0] * 1.2345678901234
    (tmp_path / 'corrected.xml').write_text(world.corrected_xml({world.candidate('mass', body): (mass,)})[0])
    corrected = mujoco.MjModel.from_xml_path(str(tmp_path / 'corrected.xml'))
    assert corrected.body(body).mass[0] == mass
    nominal.body_inertia[b] *= mass / nominal.body_mass[b]
    nominal.body_mass[b] = mass
    mujoco.mj_setConst(nominal, mujoco.MjData(nominal))
    data = [mujoco.MjData(m) for m in (nominal, corrected)]
    for model, d in zip((nominal, corrected), data):
        d.ctrl[:] = 0.3
        mujoco.mj_step(model, d, 40)
    np.testing.assert_allclose(data[0].qpos, data[1].qpos, rtol=0, atol=1e-9)
    for kind, count in (('joint', nominal.njnt), ('actuator', nominal.nu)):
        for i in range(count):
            before = getattr(nominal, kind)(i).name
            assert getattr(corrected, kind)(i).name == before or not before


def test_meshes_are_found_from_the_report(tmp_path):
    (tmp_path / 'model' / 'parts').mkdir(parents=True)
    (tmp_path / 'report').mkdir()
    (tmp_path / 'model' / 'parts' / 'tetra.obj').write_text('v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n')
    (tmp_path / 'model' / 'rest.xml').write_text('<mujoco><worldbody><body name="b"><joint/><geom type="mesh" mesh="tetra"/></body></worldbody></mujoco>')
    (tmp_path / 'model' / 'sim.xml').write_text('<mujoco><compiler meshdir="parts"/><asset><mesh file="tetra.obj"/></asset><include file="rest.xml"/></mujoco>')
    world = World.load(tmp_path / 'model' / 'sim.xml')
    (tmp_path / 'report' / 'corrected.xml').write_text(world.corrected_xml({world.candidate('coulomb_friction', '0'): (0.5,)})[0])
    assert mujoco.MjModel.from_xml_path(str(tmp_path / 'report' / 'corrected.xml')).dof_frictionloss[0] == 0.5


def test_bad_models_say_so_in_one_line(tmp_path):
    (tmp_path / 'bad.xml').write_text('<mujoco><worldbody><body><joint/></body></worldbody></mujoco>')
    (tmp_path / 'worse.xml').write_text('<mujoco')
    for path in (tmp_path / 'bad.xml', tmp_path / 'worse.xml', tmp_path / 'absent.xml'):
        with pytest.raises((ValueError, OSError)) as error:
            World.load(path)
        assert len(str(error.value).splitlines()) == 1
    for env_id in ('NoSuchEnvironment-v9', 'CartPole-v1'):
        with pytest.raises(ValueError) as error:
            World.from_env(env_id)
        assert len(str(error.value).splitlines()) == 1
    assert World.from_env('Hopper-v5').title == 'Hopper-v5'
