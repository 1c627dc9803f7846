"""Physics of drives against a pendulum integrated here, by its own equations, at a hundredth of
the step."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from plants import (
    PENDULUM,
    SIZES,
    START,
    WEAKER,
    arm,
    commanded,
    driven_by,
    pendulum,
    record,
    simulate,
    stepped,
    stock,
    tight,
)

from diagnosis.effects.actuators import ActuatorEffect
from diagnosis.effects.friction import FrictionCurve, friction_curve
from diagnosis.simulation.control_signal import Signal
from diagnosis.simulation.rows import RowMap
from diagnosis.simulation.simulator import Window, World

ROWS, DT = 100, 0.01
INERTIA, WEIGHT = (
    0.025,
    0.5 * 9.81 * 0.1,
)  # of plants.PENDULUM about its hinge; torque on it lying flat
SERVO = """<mujoco><option timestep="0.001" integrator="implicitfast"/>
<worldbody><body><joint name="j" axis="0 1 0"/>
<inertial pos="0 0 -.1" mass=".5" diaginertia=".02 .02 .02"/></body></worldbody>
<actuator><position name="m" joint="j" kp="3" kv="0.05" forcerange="-1 1"/></actuator></mujoco>"""


def waves(amplitude=0.5):
    time = np.arange(ROWS) * DT
    return commanded(time, amplitude * (np.sin(6 * time) + 0.6 * np.sin(14 * time + 1))[:, None])


def by_hand(control, torque, level, q=0.0, v=1.0, h=1e-5):
    """Positions (ROWS,) of the pendulum: torque(q, v, u, t) in it, dry friction up to level(q, v,
    drive, load).

    Moreau's time stepping: friction stops the motion, or opposes it with all it has.
    """
    out, steps = [q], round(DT / h)
    for row in range(ROWS - 1):
        for k in range(steps):
            drive, load = torque(q, v, control[row], row * DT + k * h), -WEIGHT * np.sin(q)
            free = v + h / INERTIA * (drive + load)
            v = np.sign(free) * max(abs(free) - h / INERTIA * level(q, v, drive, load), 0.0)
            q += h * v
        out.append(q)
    return np.array(out)


def run(world, setting, recording, q=0.0, v=1.0):
    windows = [Window(recording, 0, ROWS - 1)]
    return world.simulate([setting], [[q]], [[v]], windows)[0][0, :, 0]


def hold(q, v, u, t):
    return u


def servo(q, v, u, t):
    return np.clip(3 * (u - q) - 0.05 * v, -1, 1)


SHARES = 0.4, 0.2, 0.7


def loaded(q, v, drive, load):
    driving, driven, external = SHARES
    return (driving if drive * v >= 0 else driven) * abs(drive - external * load)


def mapped(q, v, drive, load):
    return 0.1 * (1 + 0.8 * np.sin(5 * q + 0.4))


KNOTS, LEVELS = (-0.4, 0.0, 0.3), (0.2, 0.0, 0.15)


def bent(q, v, drive, load):
    return np.interp(q, KNOTS, LEVELS)


@pytest.mark.parametrize(
    "xml, torque, level, effect, values",
    [
        (None, hold, loaded, "load_friction", SHARES),
        (SERVO, servo, loaded, "load_friction", SHARES),
        (None, hold, mapped, "friction_map", (0.1, 0.8, 5.0, 0.4)),
        (None, hold, bent, FrictionCurve(KNOTS), LEVELS),
    ],
)
def test_friction_that_depends_on_the_state(xml, torque, level, effect, values):
    world = World(mujoco.MjSpec.from_string(xml)) if xml else pendulum()
    named = isinstance(effect, str)
    candidate = world.candidate(effect, "j") if named else friction_curve(world.model, "j", KNOTS)
    recording = waves()
    expected = by_hand(recording.ctrl[:, 0], torque, level)
    assert abs(run(world, {candidate: values}, recording) - expected).max() < 4e-3
    assert abs(run(world, {}, recording) - expected).max() > 0.1


def test_friction_of_the_load_holds_and_slips():
    """Below its limit a loaded joint stands; beyond it, it moves: at 0.3 of drive and load
    together."""
    world, flat = pendulum(), np.pi / 2
    candidate = world.candidate("load_friction", "j")
    for torque, moves in ((0.9 * WEIGHT, False), (0.2 * WEIGHT, True), (2.5 * WEIGHT, True)):
        # |τ − W| against 0.3 (τ + W): 0.1 < 0.57, 0.8 > 0.36, 1.5 > 1.05 (times W)
        recording = commanded(np.arange(ROWS) * DT, np.full((ROWS, 1), torque))
        travelled = np.ptp(run(world, {candidate: (0.3, 0.3, 1.0)}, recording, flat, 0.0)[:20])
        assert (travelled > 1e-2) == moves
        assert moves or travelled < 2e-4


def test_friction_of_several_joints_and_conditions_at_once():
    """Each simulation of a batch has its own levels, also where one acts only for some of the
    time."""
    world, recording = pendulum(), waves()
    loaded_, mapped_ = (world.candidate(n, "j") for n in ("load_friction", "friction_map"))
    when = {"recording": recording.name, "time": [0.3, 0.6]}
    later = world.localised(mapped_, when)
    settings = [{loaded_: SHARES}, {mapped_: SIZES["friction_map"]}, {}]
    settings += [{later: SIZES["friction_map"], loaded_: SHARES}, {loaded_: SHARES}]
    windows = [Window(recording, 0, ROWS - 1)] * len(settings)
    start = np.zeros((len(settings), 1)), np.ones((len(settings), 1))
    together = world.simulate(settings, *start, windows)[0]
    for setting, qpos in zip(settings, together):
        np.testing.assert_array_equal(run(world, setting, recording), qpos[:, 0])
    np.testing.assert_array_equal(together[3, :31], together[0, :31])
    assert abs(together[3] - together[0]).max() > 1e-2


def test_a_row_ahead_knows_friction_that_slides_and_that_holds():
    """One recorded row from any state, against a simulation that works it out before each step."""
    world, recording = pendulum(), waves()
    for name, values in (("load_friction", SHARES), ("friction_map", SIZES["friction_map"])):
        setting = {world.candidate(name, "j"): values}
        rows, n = RowMap(world, [recording], setting), ROWS - 1
        qpos = np.linspace(-1, 1, n)[:, None]
        for speed in (np.full((n, 1), 0.7), np.full((n, 1), -0.7), np.zeros((n, 1))):
            windows = [Window(recording, k, k + 1) for k in range(n)]
            expected = world.simulate([setting] * n, qpos, speed, windows)[1][:, 1]
            got = rows.ahead(rows.begin, qpos, speed, np.zeros((n, 1)))[1]
            free = RowMap(world, [recording], {}).ahead(rows.begin, qpos, speed, 0 * qpos)[1]
            assert np.sqrt(np.mean((got - expected) ** 2)) < 0.06 * abs(free - expected).max()


def test_stiffness_and_damping_of_a_servo():
    """kp and kv apart, against the same law by hand; together in one ratio they are a gain."""
    world, recording = World(mujoco.MjSpec.from_string(SERVO)), waves()
    stiff, slow, gain = (
        world.candidate(n, "m") for n in ("servo_stiffness", "servo_damping", "gain")
    )
    assert (stiff.nominal, slow.nominal) == ((3.0,), (0.05,))
    law = lambda q, v, u, t: np.clip(4 * (u - q) - 0.15 * v, -1, 1)
    expected = by_hand(recording.ctrl[:, 0], law, lambda *_: 0.0)
    qpos = run(world, {stiff: (4.0,), slow: (0.15,)}, recording)
    assert abs(qpos - expected).max() < 5e-3  # Euler at 1 ms
    assert abs(run(world, {}, recording) - expected).max() > 0.05
    both = run(world, {stiff: (3.6,), slow: (0.06,)}, recording)
    np.testing.assert_allclose(run(world, {gain: (1.2,)}, recording), both, rtol=0, atol=1e-12)


def test_only_servos_have_gains_of_their_own():
    kinds = {"motors": (0, 0), "servos": (2, 3)}  # one of which follows a speed
    for kind, counts in kinds.items():
        names = [c.effect.name for c in arm(kind)[0].candidates]
        assert (names.count("servo_stiffness"), names.count("servo_damping")) == counts


def test_the_only_gain_of_a_servo_that_follows_a_speed_is_its_gain():
    xml = SERVO.replace(
        'position name="m" joint="j" kp="3" kv="0.05"', 'velocity name="m" joint="j" kv="0.4"'
    )
    world, recording = World(mujoco.MjSpec.from_string(xml)), waves()
    gain, slow = (world.candidate(n, "m") for n in ("gain", "servo_damping"))
    assert slow.nominal == (0.4,)
    qpos = run(world, {slow: (0.6,)}, recording)
    np.testing.assert_allclose(run(world, {gain: (1.5,)}, recording), qpos, rtol=0, atol=1e-12)
    assert abs(run(world, {}, recording) - qpos).max() > 0.01
    written = mujoco.MjModel.from_xml_string(world.corrected_xml({slow: (0.6,)})[0])
    assert (written.actuator_gainprm[0, 0], written.actuator_biasprm[0, 2]) == (0.6, -0.6)


def test_bristles_bend_before_they_slip():
    """Dahl's model by hand, exact in the bristle over each small step; and as written into MJCF."""
    level, stiffness, h = 0.12, 1.5, 1e-5
    recording = waves()
    world, expected, q, v, z = pendulum(), [0.0], 0.0, 0.0, 0.0
    for row in range(ROWS - 1):
        for _ in range(round(DT / h)):
            goal = level / stiffness * np.sign(v)
            z = goal + (z - goal) * np.exp(-abs(v) * h * stiffness / level)
            v += h / INERTIA * (recording.ctrl[row, 0] - WEIGHT * np.sin(q) - stiffness * z)
            q += h * v
        expected.append(q)
    candidate = world.candidate("presliding", "j")
    setting = {candidate: (level, stiffness)}
    qpos = run(world, setting, recording, 0.0, 0.0)
    assert abs(qpos - expected).max() < 6e-3
    assert abs(run(world, {}, recording, 0.0, 0.0) - expected).max() > 0.1
    xml, written = world.corrected_xml(setting)
    assert written == {candidate: "mjcf"}
    there = stock(xml, world, recording, [0.0], [0.0], ROWS)[:, 0]
    np.testing.assert_allclose(there, qpos, rtol=0, atol=1e-9)


def test_a_window_begins_with_the_bristle_as_it_was():
    """What a window in the middle of a run does not show, the bend of the bristles, follows from
    what was recorded before."""
    world, recording = pendulum(), waves()
    setting = {world.candidate("presliding", "j"): (0.12, 1.5)}
    windows = [Window(recording, 0, ROWS - 1)]
    q, v = (x[0] for x in world.simulate([setting], [[0.0]], [[0.0]], windows))
    recording = replace(recording, qpos=q, qvel=v)
    middle = [Window(recording, 60, ROWS - 1)]
    (again,) = world.simulate([setting], q[60:61], v[60:61], middle)[0]
    assert abs(again - q[60:]).max() < 2e-4


def test_an_elastic_joint_is_two_inertias_on_a_spring():
    """Motor and link by hand; the sensor sees the motor."""
    xml = SERVO.replace('axis="0 1 0"/>', 'axis="0 1 0" armature="0.01"/>')
    world, recording = World(mujoco.MjSpec.from_string(xml)), waves()
    k, c, h = 6.0, 0.02, 1e-5
    expected, motor, link = [0.0], np.zeros(2), np.zeros(2)
    for row in range(ROWS - 1):
        for _ in range(round(DT / h)):
            passed = k * (motor[0] - link[0]) + c * (motor[1] - link[1])
            drive = servo(*motor, recording.ctrl[row, 0], 0.0)
            motor[1] += h / 0.01 * (drive - passed)
            link[1] += h / INERTIA * (passed - WEIGHT * np.sin(link[0]))
            motor[0], link[0] = motor[0] + h * motor[1], link[0] + h * link[1]
        expected.append(motor[0])
    candidate = world.candidate("joint_elasticity", "j")
    setting = {candidate: (k, c)}
    qpos = run(world, setting, recording, 0.0, 0.0)
    assert abs(qpos - expected).max() < 6e-3
    assert abs(run(world, {}, recording, 0.0, 0.0) - expected).max() > 0.05
    xml, written = world.corrected_xml(setting)
    assert written == {candidate: "mjcf"}
    there = stock(xml, world, recording, [0.0], [0.0], ROWS)[:, 0]
    np.testing.assert_allclose(there, qpos, rtol=0, atol=1e-9)


TWO = """<mujoco><option timestep="0.001" gravity="0 0 0" integrator="implicitfast"/>
<worldbody><body><joint name="a" axis="0 0 1"/>
<inertial pos="0 0 0" mass="1" diaginertia=".02 .02 .02"/>
<body name="wrist"><joint name="b" axis="0 0 1"/>
<inertial pos="0 0 0" mass=".5" diaginertia=".01 .01 .01"/></body></body></worldbody>
<actuator><motor name="ma" joint="a"/><motor name="mb" joint="b"/></actuator></mujoco>"""


@pytest.mark.parametrize("effect, value", [("coupled_friction", 0.06), ("coupled_inertia", 0.015)])
def test_what_two_joints_turn_together(effect, value):
    """Two discs on one axle: M = [[.03, .01], [.01, .01]], and a rotor or dry friction in the sum
    of the joints."""
    world, h, time = World(mujoco.MjSpec.from_string(TWO)), 1e-4, np.arange(ROWS) * DT
    ctrl = 0.1 * np.stack([np.sin(9 * time), np.cos(13 * time)], axis=1)
    recording = commanded(time, ctrl, 2)
    inertia, both = np.array([[0.03, 0.01], [0.01, 0.01]]), np.ones(2)
    if effect == "coupled_inertia":
        inertia = inertia + value
    mobility = np.linalg.inv(inertia)
    expected, q, v = [np.zeros(2)], np.zeros(2), np.zeros(2)
    for row in range(ROWS - 1):
        for _ in range(round(DT / h)):
            v = v + h * mobility @ ctrl[row]
            if (
                effect == "coupled_friction"
            ):  # stops the sum of the speeds, or opposes it with all it has
                most = h * value
                push = np.clip(-v.sum() / (both @ mobility @ both), -most, most)
                v = v + push * mobility @ both
            q = q + h * v
        expected.append(q)
    candidate, window = world.candidate(effect, "a+b"), [Window(recording, 0, ROWS - 1)]
    start = np.zeros((1, 2)), np.zeros((1, 2))
    qpos = world.simulate([{candidate: (value,)}], *start, window)[0][0]
    assert abs(qpos - expected).max() < 6e-3
    assert abs(world.simulate([{}], *start, window)[0][0] - expected).max() > 0.05
    xml, written = world.corrected_xml({candidate: (value,)})
    assert written == {candidate: "mjcf"}
    there = stock(xml, world, recording, np.zeros(2), np.zeros(2), ROWS)
    np.testing.assert_allclose(there, qpos, rtol=0, atol=1e-9)
    again = World(mujoco.MjSpec.from_string(xml))  # which has it already
    assert candidate not in again.candidates and world.joints(candidate.place) == {0, 1}


def ramped(control, rate, h=1e-5):
    """Control (n,) at every h seconds that follows the recorded one at `rate` per second at
    most."""
    goal, out = np.repeat(control[:-1], round(DT / h)), np.empty((ROWS - 1) * round(DT / h))
    level = control[0]
    for k, u in enumerate(goal):
        level += np.clip(u - level, -rate * h, rate * h)
        out[k] = level
    return out


LIMITED = {
    "rate_limit": ((4.0,), servo),
    "torque_speed": (
        (0.12, 0.6),
        lambda q, v, u, t: (lambda F: np.clip(F, *most(0.6 - 0.12 * abs(v), F * v)))(
            servo(q, v, u, t)
        ),
    ),
    "gain_fade": ((0.9,), lambda q, v, u, t: servo(q, v, u, t) * np.exp(-0.9 * t)),
}


def most(force, power):
    force = max(force, 0.0) if power > 0 else np.inf
    return -force, force


@pytest.mark.parametrize("effect", LIMITED)
def test_what_a_drive_cannot_give(effect):
    """A servo whose goal is ramped, whose force falls with speed, or with time: by hand, and
    stepwise."""
    world, recording = World(mujoco.MjSpec.from_string(SERVO)), waves()
    values, torque = LIMITED[effect]
    h, steps, q, v, expected = 1e-5, round(DT / 1e-5), 0.0, 0.0, [0.0]
    control = np.repeat(recording.ctrl[:-1, 0], steps)
    if effect == "rate_limit":
        control = ramped(recording.ctrl[:, 0], values[0])
    for k, u in enumerate(control):
        v += h / INERTIA * (torque(q, v, u, k * h) - WEIGHT * np.sin(q))
        q += h * v
        if (k + 1) % steps == 0:
            expected.append(q)
    qpos = run(world, {world.candidate(effect, "m"): values}, recording, 0.0, 0.0)
    assert abs(qpos - expected).max() < 6e-3
    assert abs(run(world, {}, recording, 0.0, 0.0) - expected).max() > 0.05


@pytest.mark.parametrize("effect", WEAKER)
def test_a_drive_that_fades_stays_within_the_joints_range(effect):
    """What its joint passes on is the weaker force, cut; not the force that was cut, weakened."""
    world, (values, weaker) = tight(), WEAKER[effect]
    candidate = world.candidate(effect, "m")
    q, v, t = np.random.default_rng(0).uniform([[-1], [-4], [0]], [[1], [4], [0.5]], (3, 200))
    goal = np.full((200, 1), 0.5)
    given = [world.model] * 200, candidate.effect.id(world.model, "m"), np.tile(values, (200, 1))
    added = candidate.effect.force(*given)(q[:, None], v[:, None], goal, t)[:, 0]
    whole = 50 * (0.5 - q)
    cut = np.clip(weaker(whole, v, t), -1, 1)
    np.testing.assert_allclose(added + np.clip(whole, -1, 1), cut, atol=1e-12)
    assert (abs(cut) < 0.9).any() and (abs(cut) == 1).any()


def test_a_limit_above_the_recorded_pace_is_begun_too():
    """A control is held until the next one: a limit turns its step into a ramp, however slowly the
    controls change from row to row."""
    world, recording = World(mujoco.MjSpec.from_string(SERVO)), waves()
    limit = world.candidate("rate_limit", "m")
    pace = abs(np.diff(recording.ctrl[:, 0]) / np.diff(recording.time))
    fastest = max(world.probes(limit, [recording]))
    assert fastest > pace.max()
    change = run(world, {limit: fastest}, recording, 0.0, 0.0) - run(world, {}, recording, 0.0, 0.0)
    assert abs(change).max() > 1e-3


def test_a_servo_that_is_asked_for_steps_is_begun_at_the_pace_at_which_it_moves():
    """Steps of 1.5 rad from one row to the next have a pace of 150 rad/s."""
    world, recording = stepped()
    probes = world.probes(world.candidate("rate_limit", "m"), [recording])
    assert ((probes > 1.5) & (probes < 3)).any()


def test_a_limit_of_force_is_begun_on_either_side_of_the_models():
    """A servo that asks for 1500 N·m and may give 50."""
    world, recording = stepped()
    limit = world.candidate("saturation", "m")
    assert limit.nominal == (50.0,)
    probes = world.probes(limit, [recording])[:, 0]
    below, above = probes[probes < 50], probes[probes > 50]
    assert len(below) >= 5 and below.min() < 5 and 0 < len(above) and above.max() < 200


def test_a_drive_gave_no_more_than_its_joint_passes_on():
    """50 N·m one way and 30 the other, through a gear that turns it round."""
    world, run = stepped()
    spec = world.spec.copy()
    spec.actuator("m").gear[0] = -2
    spec.joint("j").actfrcrange, spec.joint("j").actfrclimited = (-30, 50), True
    model, asked = spec.compile(), np.array([-100.0, -26.0, -24.0, 14.0, 16.0, 100.0])
    np.testing.assert_array_equal(
        ActuatorEffect.limited(model, 0, asked), [-25.0, -25.0, -24.0, 14.0, 15.0, 15.0]
    )
    assert ActuatorEffect.forces(model, 0, [run]).max() == 15.0  # it is asked upwards alone


def test_a_motor_that_tires_with_its_effort():
    """Its control is less by exp(−rate · ∫ (u/u₀)² dt), by hand; u₀ is the end of its range."""
    xml = PENDULUM.format("implicitfast").replace('name="m"', 'name="m" ctrlrange="-2 2"')
    world, recording = World(mujoco.MjSpec.from_string(xml)), waves(1.2)
    candidate = next(
        c for c in world.candidates if [p.name for p in c.parameters] == ["per_effort"]
    )
    worked, q, v, expected = 0.0, 0.0, 0.0, [0.0]
    for u in recording.ctrl[:-1, 0]:
        for _ in range(round(DT / 1e-5)):
            worked += 1e-5 * (u / 2) ** 2
            v += 1e-5 / INERTIA * (u * np.exp(-3.0 * worked) - WEIGHT * np.sin(q))
            q += 1e-5 * v
        expected.append(q)
    qpos = run(world, {candidate: (3.0,)}, recording, 0.0, 0.0)
    assert abs(run(world, {}, recording, 0.0, 0.0) - expected).max() > 0.3
    assert abs(qpos - expected).max() < 0.03


@pytest.mark.parametrize(
    "kind, together",
    [
        ("motors", {"presliding": "elbow", "joint_elasticity": "elbow"}),
        ("servos", {"armature": "lift", "joint_elasticity": "lift"}),
        ("euler", {"armature": "elbow", "backlash": "elbow", "presliding": "elbow"}),
    ],
)
def test_parts_that_stand_beside_each_other_are_the_same_in_mjcf(kind, together):
    world, _ = arm(kind)
    recording = record(world)
    setting = {world.candidate(name, place): SIZES[name] for name, place in together.items()}
    xml, written = world.corrected_xml(setting)
    assert set(written.values()) == {"mjcf"}
    expected = simulate(world, [setting], recording, 25)[0]
    there = stock(xml, world, recording, *START, 25)
    np.testing.assert_allclose(there, expected, rtol=0, atol=1e-9)


def test_a_limited_rate_passes_delays_and_lags_on():
    """Exact means over the steps, whatever these are; then late, then filtered."""
    time = np.array([0.0, 0.1, 0.25, 0.4])
    signal = Signal(time, np.array([0.0, 1.0, -0.5, -0.5]), rate=8.0)
    fine = np.arange(0, 0.5, 1e-5) + 5e-6
    level, ramp = 0.0, []
    goal = signal.value[np.searchsorted(time, fine, side="right") - 1]
    for u in goal:
        level += np.clip(u - level, -8e-5, 8e-5)
        ramp.append(level)
    mean = np.array(ramp[:48000]).reshape(-1, 300).mean(axis=1)
    seen = signal.sample(0.0, 0.003, len(mean), False)
    np.testing.assert_allclose(seen, mean, atol=1e-4)
    late = replace(signal, delay=0.006)
    np.testing.assert_allclose(late.sample(0.006, 0.003, len(mean), False), mean, atol=1e-4)
    slow = replace(signal, lag=0.02).sample(0.0, 0.003, len(mean), True)
    assert (mean - slow).sum() * 0.003 == pytest.approx(
        0.02 * (mean[-1] - 0.0), abs=1e-3
    )  # not yet quite at rest
    again = replace(signal, lag=0.02).sample(0.3, 0.003, 40, True)
    np.testing.assert_allclose(again, slow[100:140], atol=1e-9)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "passive",
    [
        '<damper name="m" joint="j" kv="0.4" ctrlrange="0 1"/>',
        '<general name="m" joint="j" gainprm="0" biastype="affine" biasprm="0 -3 -0.1"/>',
    ],
)
def test_an_actuator_whose_control_gives_no_force_at_rest_has_no_limits_of_a_drive(passive):
    world, _ = driven_by(passive)
    of_drives = {"dead_zone", "rate_limit", "torque_speed", "gain_fade"}
    assert not of_drives & {c.effect.name for c in world.candidates if c.place.name == "m"}


@pytest.mark.parametrize("beside, there", [("dyntype='filter' dynprm='0.05'", False), ("", True)])
def test_friction_of_the_load_needs_the_force_of_every_drive_of_its_joint(beside, there):
    """That of a filter beside a motor does not follow from control and state alone."""
    world, _ = driven_by(f'<motor name="m" joint="j"/><general name="f" joint="j" {beside}/>')
    assert ("load_friction" in {c.effect.name for c in world.candidates}) == there
