"""The batched simulator against closed forms, plain loops and itself, one simulation at a time."""

import mujoco
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from plants import (
    ARM,
    DT,
    FILTER,
    INTEGRATOR,
    MODELS,
    SIZES,
    START,
    T,
    arm,
    commanded,
    driven_by,
    pendulum,
    record,
    simulate,
    stock,
    there_and_back,
)

from diagnosis.effects.base import end_of_step
from diagnosis.simulation.control_signal import Signal
from diagnosis.simulation.simulator import Window, World


@pytest.fixture(scope="module", params=MODELS)
def case(request):
    world, xml = arm(request.param)
    return world, xml, record(world)


@example(seed=2288, delay=0.0001, lag=0.0001)
@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    delay=st.floats(0, 0.05),
    lag=st.one_of(st.just(0.0), st.floats(1e-4, 0.1)),
)
def test_signal_against_a_plain_loop(seed, delay, lag):
    """A held, delayed, filtered control, sampled in steps, against 1 µs steps of the differential
    equation."""
    rng = np.random.default_rng(seed)
    time, value = np.cumsum(rng.uniform(0.001, 0.02, 12)), rng.uniform(-1, 1, 12)
    start, step, count, fine = time[4], 0.002, 10, 1e-6
    t = np.arange(time[0] - fine, start + step * count, fine) + fine / 2
    u = value[np.maximum(np.searchsorted(time, t - delay, side="right") - 1, 0)]

    def filtered(lag):
        act, level, stays = np.empty_like(u), value[0], np.exp(-fine / lag) if lag else 0.0
        for k in range(len(u)):
            level = act[k] = u[k] + (level - u[k]) * stays
        return act

    act = filtered(lag)
    inside = [(t >= start + step * k) & (t < start + step * (k + 1)) for k in range(count)]
    signal = Signal(time, value, delay, lag)
    np.testing.assert_allclose(
        signal.sample(start, step, count, True), [act[i].mean() for i in inside], atol=0.03
    )
    if lag:
        act = filtered(end_of_step(lag, step))
        np.testing.assert_allclose(
            signal.sample(start, step, count, False), [act[i][-1] for i in inside], atol=0.03
        )


@pytest.mark.parametrize("average", [False, True])
@pytest.mark.parametrize("lag", [0.0005, 0.002, 0.03])
def test_a_lag_is_as_late_as_it_says(lag, average):
    """Behind a step of the control by 1 for `lag` seconds in all, whatever the time step."""
    signal = Signal(np.array([0.0, 0.1, 1.0]), np.array([0.0, 1.0, 1.0]), lag=lag)
    for step in (0.0005, 0.002, 0.01):
        seen = signal.sample(0.1, step, round(0.8 / step), average)
        assert (1 - seen).sum() * step == pytest.approx(lag, rel=1e-6)


@pytest.mark.parametrize(
    "effect, values", [("delay", (0.0137,)), ("lag", (0.02,)), ("gain", (1.0,))]
)
def test_a_window_goes_on_where_the_run_was(case, effect, values):
    """Histories: starting in the middle of a run, from its state there, is going on with it."""
    world, _, recording = case
    setting = {world.candidate(effect, "bend"): values}
    qpos, qvel = world.simulate([setting], *(x[None] for x in START), [Window(recording, 0, T - 1)])
    later = world.simulate([setting], qpos[:, 7], qvel[:, 7], [Window(recording, 7, 22)])[0]
    np.testing.assert_allclose(later[0], qpos[0, 7:23], rtol=0, atol=1e-8)


def test_filtered_and_integrating_actuators_go_on_too():
    actuators = """
        <general name="push" joint="lift" dyntype="filter" dynprm="0.03" gainprm="20"/>
        <intvelocity name="swing" joint="swing" kp="3"/>"""
    xml = ARM.format(
        actuators=actuators, integrator="Euler", angle="radian", ref=0.35, springref=-0.2
    )
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
    qpos, _ = world.simulate(
        [{}] * 3, [q[w.first] for w in windows], [v[w.first] for w in windows], windows
    )
    for row, w in zip(qpos, windows):
        np.testing.assert_allclose(
            row, q[w.first : w.last + 1], atol=2e-3
        )  # MuJoCo's `filter` is an Euler step, not exact


def test_muscles_go_on_too():
    world = World(
        mujoco.MjSpec.from_string("""<mujoco><option timestep="0.002"/><worldbody><body>
            <joint name="j" axis="0 1 0" damping="1"/>
        <geom type="capsule" fromto="0 0 0 .2 0 0" size=".02"/></body></worldbody><actuator>
        <muscle name="m" joint="j" force="50"
        lengthrange="-1 1" ctrlrange="0 1"/></actuator></mujoco>""")
    )
    recording = commanded(0.01 * np.arange(40), np.repeat([[0.1], [1.4], [0.0], [0.6]], 10, axis=0))
    data, states = mujoco.MjData(world.model), []
    data.act[0] = recording.ctrl[0, 0]
    for control in recording.ctrl:
        states.append((data.qpos.copy(), data.qvel.copy()))
        data.ctrl[:] = control
        mujoco.mj_step(world.model, data, nstep=5)
    q, v = map(np.array, zip(*states))
    later = world.simulate([{}], q[12:13], v[12:13], [Window(recording, 12, 39)])[0]
    np.testing.assert_allclose(later[0], q[12:], rtol=0, atol=1e-9)


def test_a_filtered_control_that_comes_late_goes_on_too():
    """From the middle of a run as from its beginning, which is stock MuJoCo's."""
    world, _ = driven_by(FILTER)
    recording, setting = record(world), {world.candidate("delay", "m"): (0.04,)}
    q, v = world.simulate([setting], [[0.3]], [[0.5]], [Window(recording, 0, T - 1)])
    there = stock(world.corrected_xml(setting)[0], world, recording, [0.3], [0.5])
    np.testing.assert_allclose(q[0], there, rtol=0, atol=1e-9)
    later = world.simulate([setting], q[:, 20], v[:, 20], [Window(recording, 20, T - 1)])[0]
    np.testing.assert_allclose(later[0], q[0, 20:], rtol=0, atol=1e-9)


def test_what_an_actuator_adds_up_stays_at_its_end_until_it_is_asked_to_return():
    """A goal that moves to an end of its range and on, then back: from there, in stock MuJoCo."""
    world, _ = driven_by(INTEGRATOR)
    recording, q, v = there_and_back(world)
    later = world.simulate([{}], q[100:101], v[100:101], [Window(recording, 100, 119)])[0]
    np.testing.assert_allclose(later[0], q[100:], rtol=0, atol=1e-9)


@pytest.mark.parametrize("delay, steps", [(0.013, 2), (0.02, 2), (0.004, 1)])
def test_a_delay_of_the_model_lasts_whole_steps(delay, steps):
    motor = f'<motor name="m" joint="j" delay="{delay}" nsample="3"/>'
    _, xml = driven_by(motor)
    xml = xml.replace('timestep="0.001"', 'timestep="0.01"')
    world = World(mujoco.MjSpec.from_string(xml))
    assert world.candidate("delay", "m").nominal == (pytest.approx(0.01 * steps),)
    recording = record(world)
    qpos, _ = world.simulate([{}], [[0.3]], [[0.5]], [Window(recording, 0, T - 1)])
    expected = stock(xml, world, recording, [0.3], [0.5])
    np.testing.assert_allclose(qpos[0], expected, rtol=0, atol=1e-12)


def test_a_body_that_is_welded_to_a_link_belongs_to_its_joint():
    world = World(
        mujoco.MjSpec.from_string("""<mujoco><worldbody><body name="base"><geom size=".1"/>
            <body name="link"><joint name="i" axis="0 1 0"/><joint name="j" axis="1 0 0"/>
            <geom size=".1"/><body name="tool"><geom size=".1"/><body name="tip"><geom size=".1"/>
            </body></body><body name="hand"><joint name="k"/><geom size=".1"/></body>
            </body></body></worldbody></mujoco>""")
    )
    own = {c.place.name: world.joints(c.place) for c in world.candidates if c.place.kind == "body"}
    joint = {name: world.model.joint(name).id for name in "ijk"}
    for body in ("link", "tool", "tip"):
        assert own[body] == {joint["i"], joint["j"]}
    assert own["hand"] == {joint["k"]}
    # but its weight is felt by every joint that carries it
    felt = {c.place.name: world.moved_by(c.place) for c in world.candidates}
    assert felt["tool"] == {joint["i"], joint["j"]}
    assert felt["hand"] == set(joint.values())
    assert felt["k"] == {joint["k"]} and felt["world"] is None


BALLS = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body>
  <joint name="neck" type="ball" {}/>
<geom type="capsule" fromto="0 0 0 .1 0 -.4" size=".02" mass="1"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize(
    "effect, value, attribute",
    [
        ("viscous_damping", 0.05, "damping"),
        ("armature", 0.02, "armature"),
        ("coulomb_friction", 0.1, "frictionloss"),
    ],
)
def test_effects_of_a_ball_joint(effect, value, attribute):
    """The same as the attribute in the file, and as the corrected file; the same in all
    directions."""
    world = World(mujoco.MjSpec.from_string(BALLS.format("")))
    recording = commanded(0.01 * np.arange(40))
    start = np.array([[0.9, 0.3, -0.3, np.sqrt(1 - 0.81 - 0.18)]]), np.array([[1.0, -2.0, 3.0]])
    setting = {world.candidate(effect, "neck"): (value,)}
    predicted = world.simulate([setting], *start, [Window(recording, 0, 39)])[0][0]
    stiff = 'solreffriction="0.004 1" solimpfriction="0.999 0.9999 0.001"'
    for xml in (BALLS.format(f'{attribute}="{value}" {stiff}'), world.corrected_xml(setting)[0]):
        model = mujoco.MjModel.from_xml_string(xml)
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = start[0][0], start[1][0]
        mujoco.mj_step(model, data, nstep=39 * 5)
        np.testing.assert_allclose(data.qpos, predicted[-1], rtol=0, atol=1e-6)
    nominal = world.simulate([{}], *start, [Window(recording, 0, 39)])[0][0]
    assert abs(nominal[-1] - predicted[-1]).max() > 0.01


def test_rows_between_time_steps():
    """Irregular rows that no time step meets, against the closed form of an oscillator pushed at
    those rows."""
    xml = """<mujoco><option timestep="0.003" gravity="0 0 0" integrator="RK4"/><worldbody><body>
        <joint name="x" type="slide" axis="1 0 0" stiffness="50"/>
             <geom size=".1" mass="2"/></body></worldbody><actuator><motor name="m" joint="x"/>
             </actuator></mujoco>"""
    world, rng = World(mujoco.MjSpec.from_string(xml)), np.random.default_rng(0)
    time = np.cumsum(rng.uniform(0.002, 0.02, 60))
    force, q, v, w = rng.uniform(-5, 5, 60), 0.1, -0.3, 5.0
    exact = [(q, v)]
    for f, dt in zip(force, np.diff(time)):  # x'' = f / 2 - 25 x
        c, s, rest = np.cos(w * dt), np.sin(w * dt), f / 50
        q, v = rest + (q - rest) * c + v / w * s, -(q - rest) * w * s + v * c
        exact.append((q, v))
    recording = commanded(time, force[:, None])
    qpos, qvel = world.simulate(
        [{}] * 2, [[0.1]] * 2, [[-0.3]] * 2, [Window(recording, 0, 59), Window(recording, 0, 20)]
    )
    np.testing.assert_allclose(qpos[0, :, 0], np.array(exact)[:, 0], atol=2e-5)
    np.testing.assert_allclose(qvel[0, :, 0], np.array(exact)[:, 1], atol=4e-3)
    assert np.isnan(qpos[1, 21:]).all() and np.isfinite(qpos[1, :21]).all()


def test_refining_converges(case):
    world, _, recording = case
    coarse, quarter, fine, finest = (
        simulate(world, [{}], recording, 8, refine=n)[0] for n in (1, 4, 8, 32)
    )
    assert abs(fine - finest).max() < max(0.5 * abs(coarse - finest).max(), 1e-6)
    step = world.candidate("time_step", "world")
    np.testing.assert_allclose(  # a finer step than Euler's is implicit in the speeds of drives
        simulate(world, [{step: (world.model.opt.timestep / 4,)}], recording, 8)[0],
        quarter,
        rtol=0,
        atol=1e-6 if world.model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER else 0,
    )


def test_sensors_of_the_joints(case):
    """scale · q(t − delay) + offset, of the run from the true start."""
    world, _, recording = case
    setting = {
        world.candidate("sensor_bias", "elbow"): (0.1,),
        world.candidate("sensor_scale", "elbow"): (1.2,),
    }
    time = np.arange(601) * 0.001
    dense = commanded(time, recording.ctrl[np.minimum((time + 1e-9) // DT, T - 1).astype(int)])
    true = [x.copy() for x in START]
    true[0][2], true[1][2] = (START[0][2] - 0.1) / 1.2, START[1][2] / 1.2
    run = world.simulate([{}], *(x[None] for x in true), [Window(dense, 0, 590)])[0][0]
    seen = simulate(world, [setting], recording)[0]
    np.testing.assert_allclose(seen[:, 2], 1.2 * run[::10, 2] + 0.1, atol=1e-12)
    np.testing.assert_allclose(seen[:, :2], run[::10, :2], atol=1e-12)

    # a late sensor, from the middle of the run: what it shows belongs to an earlier moment than the
    # other joints' readings
    late = {
        world.candidate("sensor_delay", "elbow"): (0.0165,),
        world.candidate("sensor_delay", "swing"): (0.004,),
    }
    q, v = (x[0] for x in world.simulate([{}], *(x[None] for x in START), [Window(dense, 0, 599)]))
    t = np.arange(5, 55) * DT
    shown = [
        np.stack(
            [np.interp(t - d, time[:600], x[:, j]) for j, d in enumerate((0.0, 0.004, 0.0165))],
            axis=1,
        )
        for x in (q, v)
    ]
    windows = [Window(recording, k, k + 15) for k in (5, 12, 30)]
    start = [np.array([x[w.first - 5] for w in windows]) for x in shown]
    errors = [
        np.concatenate(
            [
                row - shown[0][w.first - 5 : w.last - 4]
                for row, w in zip(world.simulate([setting] * 3, *start, windows)[0], windows)
            ]
        )
        for setting in (late, {})
    ]
    assert (
        np.median(abs(errors[0])) < 0.2 * np.median(abs(errors[1]))
        and np.median(abs(errors[0])) < 2e-3
    )


def test_sensors_of_the_model(case):
    world, xml, recording = case
    setting = {
        world.candidate("sensor_bias", "spin"): (0.3,),
        world.candidate("sensor_scale", "angle"): (2.0,),
    }
    qpos, _, data = world.simulate(
        [setting], *(x[None] for x in START), [Window(recording, 0, T - 1)], sensors=True
    )
    stepped = mujoco.MjData(world.model)
    stepped.qpos[:], stepped.qvel[:] = START
    mujoco.mj_forward(world.model, stepped)
    np.testing.assert_allclose(data[0, :, 0], 2 * qpos[0, :, 2], atol=1e-12)
    np.testing.assert_allclose(data[0, 0, 1:], stepped.sensordata[1:] + 0.3, atol=1e-12)


BETWEEN = 0.2 - 1e-9, 0.5 - 1e-9  # s, of the recording


def switched(model, recording, act):
    """(71,) angles of rows 5 to 75, by a loop that calls act(data, time) before every step."""
    data, out = mujoco.MjData(model), []
    data.qpos[0], data.qvel[0] = 0.3, 0.5
    model.dof_solref[0], model.dof_solimp[0] = (0.004, 1), (0.999, 0.9999, 0.001, 0.5, 2)
    for row in range(5, 76):
        out.append(data.qpos[0])
        data.ctrl[0] = recording.ctrl[row, 0]
        for k in range(10):
            act(data, recording.time[row] + k * 0.001)
            mujoco.mj_step(model, data)
    model.dof_frictionloss[0] = model.dof_damping[0] = 0
    return np.array(out)


def test_effects_under_a_condition():
    """A load in the middle of the run, friction in part of the range: against a loop that switches
    them."""
    world = pendulum()
    time = np.arange(80) * 0.01
    recording = commanded(time, 0.3 * np.sin(9 * time)[:, None], name="run")
    window, model = Window(recording, 5, 75), world.model
    body = model.body(1).name

    def push(data, t):
        data.xfrc_applied[1, 0] = 3.0 if BETWEEN[0] <= t < BETWEEN[1] else 0.0

    def rub(data, t):
        model.dof_frictionloss[0] = 0.4 * (BETWEEN[0] <= t < BETWEEN[1])

    when = {"recording": "run", "time": list(BETWEEN)}
    pushed = world.candidate("external_force", body)
    force = world.localised(pushed, when)
    friction = world.localised(world.candidate("coulomb_friction", "j"), when)
    elsewhere = world.localised(pushed, when | {"recording": "another"})
    load = world.localised(world.candidate("payload_change", body), when)
    forced = {force: (3.0, 0.0, 0.0)}
    settings = [forced, {friction: (0.4,)}, {elsewhere: (3.0, 0.0, 0.0)}, {load: (0.9,)}, {}]
    qpos, _ = world.simulate(settings, [[0.3]] * 5, [[0.5]] * 5, [window] * 5)
    for row, act in zip(qpos, (push, rub)):
        expected = switched(model, recording, act)
        np.testing.assert_allclose(row[:, 0], expected, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(qpos[2], qpos[4])
    assert abs(qpos[0] - qpos[4]).max() > 0.01 and abs(qpos[3] - qpos[4]).max() > 0.01
    assert force != pushed and force == world.localised(force, dict(when))
    assert world.corrected_xml(forced)[1] == {force: "none"}
    later = world.localised(world.candidate("coulomb_friction", "j"), when | {"time": [0.6, 0.7]})
    with pytest.raises(ValueError, match="different conditions"):
        world.simulate([{**forced, later: (0.4,)}], [[0.3]], [[0.5]], [window])


def test_unstable_simulations_are_nan_and_silent(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    world, recording = pendulum("Euler"), commanded(np.arange(50) * 0.01, np.ones((50, 1)))
    wild = {world.candidate("nonlinear_stiffness", "j"): (-1e9,)}
    no_inertia = {
        world.candidate("inertia", "1"): (1e-20, 1e-20, 1e-20),
        world.candidate("mass", "1"): (1e-20,),
    }
    settings_ = [
        {},
        wild,
        {},
        no_inertia,
        {world.curve("j", "position:j", (-1.0, 1.0)): (-1e12, 1e12)},
    ]
    qpos, qvel = world.simulate(settings_, [[0.3]] * 5, [[0.5]] * 5, [Window(recording, 0, 49)] * 5)
    assert np.isfinite(qpos[[0, 2]]).all() and np.array_equal(qpos[0], qpos[2])
    assert (
        np.isnan(qpos[1, 1:]).all() and np.isnan(qvel[1, 1:]).all() and np.isnan(qpos[4, 1:]).all()
    )
    assert qpos[1, 0, 0] == 0.3
    assert not list(tmp_path.iterdir()) and capfd.readouterr() == ("", "")
    np.testing.assert_array_equal(
        world.simulate([{}], [[0.3]], [[0.5]], [Window(recording, 0, 49)])[0][0], qpos[0]
    )


def test_delays_that_are_written_together_are_of_one_time_step():
    """Half of which each is later in Runge-Kutta's method: of the step that the shortest asks
    for."""
    world, _ = arm("rk4")
    late = {"push": 0.0113, "bend": 0.0023}
    setting = {world.candidate("delay", name): (seconds,) for name, seconds in late.items()}
    model = mujoco.MjModel.from_xml_string(world.corrected_xml(setting)[0])
    assert model.opt.timestep == pytest.approx(world.model.opt.timestep / 2)
    for name, seconds in late.items():
        more = model.actuator_delay[model.actuator(name).id] - seconds
        assert more == pytest.approx(model.opt.timestep / 2)


@pytest.mark.parametrize("effect", [None, "friction_map"])
def test_what_blows_up_after_its_window_is_sound_within(effect):
    """Beside a longer one, each simulation runs on beyond its end. One in one call, one step by
    step."""
    world, _ = driven_by('<general name="m" joint="j" biastype="affine" biasprm="0 0 2"/>')
    setting = {world.candidate(effect, "j"): SIZES[effect]} if effect else {}
    recording = commanded(np.arange(100) * 0.0105, np.zeros((100, 1)))
    windows = [Window(recording, 0, last) for last in (*range(1, 40), 99)]
    n = len(windows)
    start = [np.full((n, 1), 0.3), np.full((n, 1), 0.5)]
    together = world.simulate([setting] * n, *start, windows)
    for k, window in enumerate(windows):
        alone = world.simulate([setting], *(x[:1] for x in start), [window])
        for a, b in zip(alone, together):
            np.testing.assert_array_equal(a[0], b[k, : window.last + 1])
    whole = np.isfinite(together[0][-1, :, 0])
    assert whole[:20].all() and not whole[40:].any()


def test_a_batch_is_its_members(case):
    """Mixed windows and settings in one call, each as if simulated alone."""
    world, _, recording = case
    rng = np.random.default_rng(1)
    windows = [Window(recording, k, k + 5 + k % 3) for k in rng.integers(0, 40, 24)]
    settings_ = [
        {c: SIZES[c.effect.name]}
        for c in rng.permutation(np.array(world.candidates, dtype=object))[:24]
    ]
    start_q, start_v = START[0] + rng.normal(0, 0.1, (24, 3)), rng.normal(0, 1, (24, 3))
    together = world.simulate(settings_, start_q, start_v, windows)
    for k, (setting, window) in enumerate(zip(settings_, windows)):
        alone = world.simulate([setting], start_q[k : k + 1], start_v[k : k + 1], [window])
        for a, b in zip(alone, together):
            np.testing.assert_array_equal(a[0], b[k, : window.last - window.first + 1])


def test_a_block_that_only_slides_and_hops():
    """Such a body is `simple` to MuJoCo, and its contacts would be softer if it were not."""
    xml = """<mujoco><option timestep="0.002" cone="elliptic"/><worldbody>
        <geom type="plane" size="5 5 .1"/><body pos="0 0 .05">
             <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
             <geom type="box" size=".08 .08 .05" mass="1"/>
             </body></worldbody><actuator><motor joint="x"/><motor joint="z"/></actuator>
             </mujoco>"""
    world = World(mujoco.MjSpec.from_string(xml))
    rng = np.random.default_rng(0)
    recording = commanded(np.arange(60) * 0.01, rng.uniform(-20, 10, (60, 2)))
    data, run = mujoco.MjData(world.model), []
    data.qvel[:] = 0.3, 0.8
    for t in range(60):
        run.append(data.qpos.copy())
        data.ctrl[:] = recording.ctrl[t]
        mujoco.mj_step(world.model, data, 5)
    qpos, _ = world.simulate([{}], [[0.0, 0.0]], [[0.3, 0.8]], [Window(recording, 0, 59)])
    np.testing.assert_allclose(qpos[0], run, rtol=0, atol=1e-12)


CUBE = """
<mujoco><option timestep="0.001"/><worldbody><geom name="floor" type="plane" size="3 3 .1"/>
<body name="cube" pos="0 0 .3">
<freejoint name="free"/><geom name="box" type="box" size=".05 .05 .05" mass=".4"/></body>
</worldbody></mujoco>"""


def test_a_tossed_cube(case):
    """Free joints and contacts: the same in MJCF; friction follows the larger of the two geoms'
    nominally."""
    world = World(mujoco.MjSpec.from_string(CUBE))
    recording = commanded(np.arange(60) / 148)
    q, v = np.array([0, 0, 0.12, 1, 0, 0, 0.0]), np.array([1.0, 0.3, -1, 2, 1, 0])
    settings_ = [{}] + [
        {world.candidate(e, g): x}
        for g in ("floor", "box")
        for e, x in (("contact_friction", (0.18,)), ("contact_stiffness", (9000.0,)))
    ]
    qpos, _ = world.simulate(
        settings_, np.tile(q, (5, 1)), np.tile(v, (5, 1)), [Window(recording, 0, 59)] * 5
    )
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
        k = (
            recording.time * 1000
        )  # rows fall between steps: on the line through them, but at impacts
        line = np.array([np.interp(k, np.arange(420), column) for column in np.array(run).T]).T
        assert np.quantile(abs(line[:, :3] - predicted[:, :3]), 0.95) < 1e-4


def test_bad_models_say_so_in_one_line(tmp_path):
    (tmp_path / "bad.xml").write_text(
        "<mujoco><worldbody><body><joint/></body></worldbody></mujoco>"
    )
    (tmp_path / "worse.xml").write_text("<mujoco")
    for path in (tmp_path / "bad.xml", tmp_path / "worse.xml", tmp_path / "absent.xml"):
        with pytest.raises((ValueError, OSError)) as error:
            World.load(path)
        assert len(str(error.value).splitlines()) == 1
    for env_id in ("NoSuchEnvironment-v9", "CartPole-v1"):
        with pytest.raises(ValueError) as error:
            World.from_env(env_id)
        assert len(str(error.value).splitlines()) == 1
    assert World.from_env("Hopper-v5").candidate("mass", "torso").nominal[0] > 3


@pytest.mark.parametrize("kind", ["motors", "servos"])
def test_what_acts_under_a_condition_that_never_holds_changes_nothing(kind):
    """Effects that add a motor or a tendon neither; what adds states cannot come and go."""
    world, _ = arm(kind)
    recording = record(world)
    [plain] = simulate(world, [{}], recording)
    never = {"recording": None, "time": [100.0, 101.0]}
    first = {}
    for candidate in world.candidates:
        first.setdefault(candidate.effect.name, candidate)
    for name, candidate in first.items():
        effect, timed = candidate.effect, world.localised(candidate, never)
        apart = effect.numerical or effect.overrides("measure") or world.adds_states(candidate)
        if name not in SIZES or apart:
            continue
        [moved] = simulate(world, [{timed: SIZES[name]}], recording)
        np.testing.assert_allclose(moved, plain, atol=2e-4, err_msg=name)


def test_a_window_goes_on_where_the_run_was_beside_a_late_sensor():
    """Though the other joint turns round before the late one shows what was."""
    world = World(
        mujoco.MjSpec.from_string("""<mujoco><option timestep="0.001"/><worldbody><body>
      <joint name="late" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02"/>
      <body pos="0 0 -.3"><joint name="stiff" axis="0 1 0" stiffness="8"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02"/></body></body></worldbody>
      </mujoco>""")
    )
    recording = commanded(0.005 * np.arange(200), joints=2)
    setting = {world.candidate("sensor_delay", "late"): (0.06,)}
    whole = Window(recording, 0, 199)
    qpos, qvel = world.simulate([setting], [[0.5, 0.4]], [[0.0, 0.0]], [whole])
    window = Window(recording, 100, 160)
    later = world.simulate([setting], qpos[:, 100], qvel[:, 100], [window])[0]
    assert np.ptp(qpos[0, 88:100, 1]) > 0.2  # rad
    np.testing.assert_allclose(later[0], qpos[0, 100:161], rtol=0, atol=1e-3)
