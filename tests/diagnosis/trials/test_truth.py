"""The true system against equations of motion solved by scipy, against stock MuJoCo, and itself."""

import copy
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from diagnosis.trials import laws as L
from diagnosis.trials.experiment import Plan, record
from diagnosis.trials.mjcf import to_mjcf
from diagnosis.trials.prediction import model_error, system_error, windows
from diagnosis.trials.robots import DEVELOPMENT, FINAL, Actuator, Link, Robot, draw_robot
from diagnosis.trials.truth import TrueSystem, dry_friction

MASS, LEVER, ABOUT = 0.8, 0.3, 0.02  # kg, m, kg·m²
ROTOR = 0.05


def pendulum(**values):
    """A link that hangs upwards from a hinge about y, with a motor."""
    link = Link(
        *("link0", -1, "hinge", (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0), 0.6, 0.03),
        *(MASS, (0.0, 0.0, LEVER), (ABOUT, ABOUT, 0.005)),
        armature=ROTOR,
        damping=0.05,
    )
    motor = Actuator("drive0", 0, "motor", 1.0, 1.0, 50.0)
    return Robot((replace(link, **values),), (motor,), 0.002, 2e-4, "Euler")


def block(**values):
    """A mass on a level slide with a motor."""
    link = replace(
        pendulum().links[0], joint="slide", axis=(1.0, 0.0, 0.0), damping=0.0, armature=0.0
    )
    return replace(pendulum(), links=(replace(link, **values),))


def readings(system, ctrl, start, rows=100, row=0.01):
    """What a recording of a joint begun at rest reads, (rows, 2, 1): qpos and qvel."""
    system.reset(np.array([start]), np.zeros(1))
    out = []
    for k in range(rows):
        system.advance(np.array([ctrl(k * row)]), row)
        out.append(system.reading())
    return np.array(out)


def simulate(robot, laws, ctrl, start, rows=100, row=0.01):
    return readings(TrueSystem(robot, laws), ctrl, start, rows, row)[:, 0, 0]


def solve(force, ctrl, start, rows=100, row=0.01, extra=()):
    """The pendulum's own equation with force(t, q, v, u, memory) -> (force, memory's slope)."""
    inertia = ABOUT + MASS * LEVER**2 + ROTOR
    state, out = np.array([start, 0.0, *extra]), []
    for k in range(rows):
        u = ctrl(k * row)

        def slope(t, y):
            push, change = force(t, y[0], y[1], u, y[2:])
            weight = MASS * 9.81 * LEVER * np.sin(y[0])
            return [y[1], (weight - 0.05 * y[1] + u + push) / inertia, *change]

        span = (k * row, (k + 1) * row)
        state = solve_ivp(slope, span, state, rtol=1e-9, atol=1e-11).y[:, -1]
        out.append(state[0])
    return np.array(out)


LAWS = [
    (
        L.Cogging(0, amplitude=0.4, poles=5.0, phase=0.3),
        lambda t, q, v, u, m: (0.4 * np.sin(5 * q + 0.3), ()),
    ),
    (L.QuadraticDamping(0, damping2=0.1), lambda t, q, v, u, m: (-0.1 * v * abs(v), ())),
    (L.CubicSpring(0, stiffness3=2.0), lambda t, q, v, u, m: (-2.0 * q**3, ())),
    (
        L.Shaking(0, amplitude=0.5, hertz=2.0, phase=1.0),
        lambda t, q, v, u, m: (0.5 * np.sin(4 * np.pi * t + 1.0), ()),
    ),
    (L.OneWayBearing(0, damping=0.3), lambda t, q, v, u, m: (-0.3 * max(v, 0.0), ())),
    (
        L.UnevenMotor(0, share=0.3, waves=2.0, phase=0.0),
        lambda t, q, v, u, m: (0.3 * np.cos(2 * q) * u, ()),
    ),
    (L.GainFade(0, rate=0.4), lambda t, q, v, u, m: (u * (np.exp(-0.4 * t) - 1), ())),
    (
        L.FluidMemory(0, damping=0.3, seconds=0.2),
        lambda t, q, v, u, m: (-0.3 * m[0], ((v - m[0]) / 0.2,)),
    ),
    (L.Lag(0, actuator=0, seconds=0.05), lambda t, q, v, u, m: (m[0] - u, ((u - m[0]) / 0.05,))),
]


@pytest.mark.parametrize("law, force", LAWS, ids=lambda x: type(x).__name__)
def test_laws_against_an_equation_solved_by_scipy(law, force):
    ctrl = lambda t: 1.5 * np.cos(7 * t)
    extra = (
        (0.0,) if isinstance(law, L.FluidMemory) else (ctrl(0),) if isinstance(law, L.Lag) else ()
    )
    wanted = solve(force, ctrl, 0.4, extra=extra)
    plain = solve(lambda *_: (0.0, ()), ctrl, 0.4)
    got = simulate(pendulum(), [law], ctrl, 0.4)
    acts = np.abs(wanted - plain).max()
    assert acts > 1e-2
    assert np.abs(got - wanted).max() < 3e-3 * acts + 2e-5


AGAIN = [
    *(law for law, _ in LAWS),
    L.JointElasticity(0, stiffness=60.0, damping=0.2),
    L.Backlash(0, gap=0.1, stiffness=2000.0, damping=1.0),
    L.Presliding(0, frictionloss=0.2, stiffness=20.0),
    L.Hysteresis(0, stiffness=3.0, reach=0.1),
    L.WarmingGrease(0, damping=0.3, heat=0.1),
    L.Delay(0, actuator=0, seconds=0.03),
    L.RateLimit(0, actuator=0, rate=20.0),
]


@pytest.mark.parametrize("law", AGAIN, ids=lambda law: type(law).__name__)
def test_a_recording_does_not_remember_the_one_before(law):
    ctrl = lambda t: 1.5 * np.cos(7 * t)
    system, other = TrueSystem(pendulum(), [law]), TrueSystem(pendulum(), [copy.deepcopy(law)])
    readings(system, ctrl, 1.5, rows=30)
    second, first = (readings(each, ctrl, -0.4, rows=30) for each in (system, other))
    assert np.abs(first - second).max() == 0.0


def test_elastic_joint_against_two_masses_solved_by_scipy():
    stiffness, damping = 60.0, 0.2
    law = L.JointElasticity(0, stiffness=stiffness, damping=damping)
    ctrl = lambda t: 1.5 * np.cos(7 * t)
    state, wanted = np.array([0.4, 0.0, 0.4, 0.0]), []  # rotor, link
    for k in range(100):
        u = ctrl(k * 0.01)

        def slope(t, y):
            twist = stiffness * (y[0] - y[2]) + damping * (y[1] - y[3])
            weight = MASS * 9.81 * LEVER * np.sin(y[2])
            rotor = (u - 0.05 * y[1] - twist) / ROTOR
            return [y[1], rotor, y[3], (weight + twist) / (ABOUT + MASS * LEVER**2)]

        state = solve_ivp(slope, (0, 0.01), state, rtol=1e-9, atol=1e-11).y[:, -1]
        wanted.append(state[0])
    got = simulate(pendulum(), [law], ctrl, 0.4)
    assert np.abs(got - np.array(wanted)).max() < 5e-3


def test_dry_friction_stops_a_block_where_energy_says():
    system = TrueSystem(block(frictionloss=2.0))
    system.reset(np.zeros(1), np.array([1.5]))
    for _ in range(200):
        system.advance(np.zeros(1), 0.01)
    assert system.reading()[0][0] == pytest.approx(MASS * 1.5**2 / (2 * 2.0), rel=1e-3)
    assert system.reading()[1][0] == 0.0


def test_dry_friction_holds_without_creep():
    assert np.abs(simulate(block(frictionloss=2.0), [], lambda t: 1.9, 0.0)).max() < 1e-12
    moved = simulate(block(frictionloss=2.0), [], lambda t: 2.2, 0.0)[-1]
    assert moved == pytest.approx(0.5 * 0.2 / MASS, rel=2e-3)


def test_friction_of_coupled_joints_solves_the_complementarity_problem():
    rng = np.random.default_rng(0)
    for _ in range(50):
        root = rng.normal(size=(3, 3))
        mobility, goal = root @ root.T + 0.3 * np.eye(3), rng.normal(size=3)
        limit = rng.uniform(0.1, 1.0, 3)
        push = dry_friction(mobility, goal, limit, sweeps=2000)
        left = goal + mobility @ push  # of the acceleration to be stopped
        assert (np.abs(push) <= limit + 1e-12).all()
        for f, most, slip in zip(push, limit, left):
            assert abs(slip) < 1e-4 or f == pytest.approx(-most * np.sign(slip))


@pytest.mark.parametrize("friction, stops", [(0.0, None), (0.3, None), (0.0, (0.1, 0.45))])
def test_coupled_inertia_is_mujocos_tendon_armature(friction, stops):
    """To dry friction and to stops as to every other force."""
    robot = draw_robot(
        np.random.default_rng(8), replace(DEVELOPMENT, joints=(2, 2), passive=0, slides=0)
    )
    links = [replace(k, frictionloss=friction, range=None) for k in robot.links]
    robot = replace(robot, links=(links[0], replace(links[1], range=stops)))
    tendon = (
        '<tendon><fixed armature="0.05"><joint joint="joint0" coef="1"/>'
        '<joint joint="joint1" coef="1"/></fixed></tendon></mujoco>'
    )
    text = to_mjcf(replace(robot, step=1e-4, integrator="RK4")).replace("</mujoco>", tendon)
    smooth = not friction and not stops
    law = L.CoupledInertia(1, other=0, inertia=0.05)
    compare(robot, [law], text, 2e-4 if smooth else 1e-3)


def compare(robot, laws, text, tolerance, start=None):
    """The true system against stock MuJoCo's RK4 at fine steps, over half a second."""
    model = mujoco.MjModel.from_xml_string(text)
    data, system = mujoco.MjData(model), TrueSystem(robot, laws)
    start = model.qpos0 + 0.2 * np.arange(1, model.nq + 1) if start is None else np.array([start])
    system.reset(start, np.zeros(model.nv))
    data.qpos[:] = start
    for row in range(50):
        sent = [
            0.2 * np.sin(0.2 * row) * (a.limit if a.kind == "motor" else 1) for a in robot.actuators
        ]
        data.ctrl[:] = sent
        system.advance(np.array(sent), 0.01)
        mujoco.mj_step(model, data, round(0.01 / model.opt.timestep))
    assert np.abs(data.qpos - start).max() > 0.01
    assert np.abs(system.reading()[0] - data.qpos).max() < tolerance


@pytest.mark.parametrize("seed", [0, 3, 5, 11])
def test_drawn_robots_agree_with_stock_mujoco_where_nothing_is_hidden(seed):
    robot = draw_robot(np.random.default_rng(seed), replace(DEVELOPMENT, joints=(1, 5)))
    links = (replace(k, frictionloss=0.0, range=None) for k in robot.links)
    robot = replace(robot, links=tuple(links))
    compare(robot, [], to_mjcf(replace(robot, step=1e-4, integrator="RK4")), 1e-3)


def test_still_air_of_the_nominal_model_is_mujocos():
    robot = draw_robot(np.random.default_rng(3), replace(DEVELOPMENT, joints=(2, 3)))
    links = (replace(k, frictionloss=0.0) for k in robot.links)
    robot = replace(robot, links=tuple(links), density=300.0)
    compare(robot, [], to_mjcf(replace(robot, step=1e-4, integrator="RK4")), 1e-3)


def test_dry_friction_goes_on_where_a_stop_pushes():
    robot = pendulum(frictionloss=0.5, range=(-0.3, 0.3), damping=0.3)
    compare(robot, [], to_mjcf(replace(robot, step=1e-5)), 2e-3, start=0.25)


def test_coupled_joints_with_friction_agree_with_mujoco_on_the_ground():
    drawn = (draw_robot(np.random.default_rng(k), DEVELOPMENT, "ground") for k in range(100))
    robot = next(r for r in drawn if len(r.links) == 2 and r.links[1].frictionloss > 0)
    fine = to_mjcf(replace(robot, step=1e-5, integrator="implicitfast"))
    compare(robot, [], fine, 2e-3)


def test_a_snapshot_brings_back_everything():
    robot = pendulum()
    laws = [L.FluidMemory(0, damping=0.3, seconds=0.2), L.Delay(0, actuator=0, seconds=0.013)]
    system = TrueSystem(robot, laws)
    system.reset(np.array([0.3]), np.zeros(1))
    for k in range(30):
        system.advance(np.array([np.sin(k)]), 0.01)
    kept = system.snapshot()
    first = [system.advance(np.array([k]), 0.01) or system.reading()[0][0] for k in range(20)]
    system.restore(kept)
    again = [system.advance(np.array([k]), 0.01) or system.reading()[0][0] for k in range(20)]
    assert first == again


def test_the_true_system_repeats_its_recording_through_rows_left_out_and_wrong_stamps():
    robot = pendulum(frictionloss=0.1, range=(-0.4, 0.4))
    motor = replace(robot.actuators[0], kp=20.0, kv=2.0)
    robot = replace(robot, actuators=(motor,))
    plan = Plan(0.01, "brisk", "closed", 1e-3, "white", "none", "jitter", 0.2, 1.5)
    system = TrueSystem(robot, [L.FluidMemory(0, damping=0.3, seconds=0.2)])
    run = record(system, plan, np.random.default_rng(0))
    assert len(run.time) < 140 and run.touched > 0
    assert system_error(system, [run], np.array([1e-3]), perfect=True) < 1e-9


def test_the_floor_knows_no_more_than_a_file_does():
    """Rows left out and wrong stamps: the machine in stock MuJoCo errs by as much."""
    robot = pendulum()
    motor = replace(robot.actuators[0], kp=20.0, kv=2.0)
    robot = replace(robot, actuators=(motor,), integrator="implicitfast")
    plan = Plan(0.01, "brisk", "closed", 1e-4, "white", "noisy", "jitter", 0.2, 3.0)
    system = TrueSystem(robot, [])
    run, noise = record(system, plan, np.random.default_rng(0)), np.array([1e-4])
    model = mujoco.MjModel.from_xml_string(to_mjcf(replace(robot, step=2e-4)))
    floor, stock = system_error(system, [run], noise), model_error(model, model, [run], noise)
    assert floor == pytest.approx(stock, rel=0.02)


@pytest.mark.parametrize("late", ["lag", "delay"])
def test_a_file_with_the_true_memory_begins_as_the_machine_does(late):
    """A lag and a delay, as MJCF has them: what they hold at first is no error of the file."""
    motor = replace(pendulum().actuators[0], kp=20.0, kv=2.0)
    robot = replace(pendulum(), actuators=(motor,), integrator="implicitfast", step=2e-4)
    plan = Plan(0.01, "brisk", "closed", 1e-4, "white", "none", "regular", 0.0, 0.3)
    law = (L.Lag if late == "lag" else L.Delay)(0, actuator=0, seconds=0.1)
    system = TrueSystem(robot, [law])
    run, noise = record(system, plan, np.random.default_rng(3)), np.array([1e-4])
    spec = mujoco.MjSpec.from_string(to_mjcf(robot))
    (drive,) = spec.actuators
    if late == "lag":
        drive.dyntype, drive.actearly = mujoco.mjtDyn.mjDYN_FILTEREXACT, True
        drive.dynprm[0] = 0.1
    else:
        drive.delay, drive.nsample = 0.1, 501
    file = spec.compile()
    floor, error = system_error(system, [run], noise), model_error(file, file, [run], noise)
    assert abs(run.ctrl[0]) > 0.1 and error < 1.1 * floor


def test_a_joint_begins_within_its_range_also_where_that_holds_no_zero():
    robot = pendulum(range=(-3.6, -1.0))
    plan = Plan(0.01, "brisk", "open", 1e-4, "white", "none", "regular", 0.0, 0.2)
    run = record(TrueSystem(robot, []), plan, np.random.default_rng(0))
    assert -3.6 < run.true_qpos[0, 0] < -1.0


def test_a_delay_is_kept_to_the_substep():
    ctrl = lambda t: 1.0 if t >= 0.5 else 0.0
    late = simulate(block(), [L.Delay(0, actuator=0, seconds=0.0137)], ctrl, 0.0)
    left = 0.99 + 0.01 - 0.5 - 0.0137
    assert late[-1] == pytest.approx(0.5 / MASS * left**2, rel=2e-3)


def test_every_drawn_robot_loads_in_stock_mujoco():
    for seed in range(40):
        robot = draw_robot(np.random.default_rng(seed), (DEVELOPMENT, FINAL)[seed % 2])
        model = mujoco.MjModel.from_xml_string(to_mjcf(robot))
        assert 1 <= len(robot.links) <= 12 and model.nu == len(robot.actuators)
        assert {k.joint for k in robot.links[1:]} <= {"hinge", "slide"}


def test_windows_are_consecutive_and_drop_a_stump():
    spans = windows(np.arange(0, 1.01, 0.01))
    assert spans == [(0, 30), (30, 60), (60, 90)]
