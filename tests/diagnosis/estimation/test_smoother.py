"""The located force against hidden ones that were put into stock MuJoCo, and against none."""

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from plants import DRIVEN_PENDULUM, on_spring, recorded

from diagnosis.estimation import windowing
from diagnosis.estimation.smoother import BLOCK, LOUDER, Smoother
from diagnosis.recordings.recording import Recording
from diagnosis.selection.plausibility import Usual, plausible
from diagnosis.simulation.rows import RowMap
from diagnosis.simulation.simulator import World

ARM = """<mujoco><option timestep="0.005"/><default><geom contype="0" conaffinity="0"/></default>
  <worldbody><body name="a" pos="0 0 1"><joint name="j" axis="0 1 0" damping="0.05"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="1"/>
  <body name="b" pos="0 0 -.3"><joint name="k" axis="0 1 0" damping="0.05"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="1"/></body></body></worldbody>
  <actuator><motor name="m" joint="j"/><motor name="n" joint="k"/></actuator></mujoco>"""
PENDULUM = """<mujoco><option timestep="0.005"/><worldbody><body name="a">
  <joint name="j" axis="0 1 0" damping="0.05"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".02" mass="0.5"/></body></worldbody>
  <actuator><motor name="m" joint="j"/></actuator></mujoco>"""
NOISE = 3e-4


def moved(xml, seed, push=None, rows=400):
    """A Recording in stock MuJoCo, and the mean of push(time, qpos, qvel) over each row (rows,
    nv)."""
    rng, model = np.random.default_rng(seed), mujoco.MjModel.from_xml_string(xml)
    data, time = mujoco.MjData(model), 0.01 * np.arange(rows)
    period, phase = rng.uniform(0.6, 1.5, (2, 3, model.nu))
    angle = 2 * np.pi * time[:, None, None] / period + 4 * phase
    ctrl = (0.5 * np.sin(angle)).sum(1)
    qpos, hidden = np.empty((rows, model.nq)), np.zeros((rows, model.nv))
    for t in range(rows):
        qpos[t], data.ctrl[:] = data.qpos, ctrl[t]
        for _ in range(2):
            if push:
                data.qfrc_applied[:] = push(data.time, data.qpos, data.qvel)
            hidden[t] += data.qfrc_applied / 2
            mujoco.mj_step(model, data)
    noisy = qpos + NOISE * rng.normal(size=qpos.shape)
    return Recording(f"{seed}.csv", time, noisy, np.full(qpos.shape, np.nan), ctrl), hidden


PUSHES = {
    "a spring": (PENDULUM, lambda time, q, v: -0.8 * q**3),
    "a wave": (PENDULUM, lambda time, q, v: [0.1 * np.sin(5 * time)]),
    "drag at a joint": (ARM, lambda time, q, v: [0.0, -0.1 * v[1] * abs(v[1])]),
    "both joints": (ARM, lambda time, q, v: [0.5 * np.sin(2 * q[0]), -0.3 * np.tanh(v[1] / 0.3)]),
}


@pytest.mark.parametrize("name", PUSHES)
def test_the_located_force_is_the_hidden_one_within_its_band(name):
    xml, push = PUSHES[name]
    (run, hidden), (more, again) = moved(xml, 0, push), moved(xml, 1, push)
    smoother = Smoother(World(mujoco.MjSpec.from_string(xml)), [run, more])
    found = smoother.locate({})
    rows = np.r_[5:395, 405:795]
    hidden = np.concatenate([hidden, again])[rows]
    error = found.force[rows] - hidden
    acts = np.sqrt(np.mean(hidden**2, 0))
    for dof in np.flatnonzero(acts):
        assert np.sqrt(np.mean(error[:, dof] ** 2)) < 0.25 * acts[dof]
    for dof in np.flatnonzero(acts == 0):
        assert np.sqrt(np.mean(error[:, dof] ** 2)) < 0.1 * acts.max()
    # forces that are smoother than a random walk lie within its band more often than it says
    inside = abs(error) < 1.96 * found.force_sd[rows]
    assert inside[:, acts > 0].mean() > 0.88
    assert smoother.position_noise == pytest.approx(NOISE, rel=0.2)


@pytest.mark.parametrize("xml", [PENDULUM, ARM])
def test_of_forces_that_wander_the_band_holds_what_it_says(xml):
    inside = []
    for seed in range(2):
        walk = 0.02 * np.cumsum(np.random.default_rng(seed).normal(size=(400, 2)), 0)
        push = lambda time, q, v: walk[int(time / 0.01 + 1e-6), : len(q)]
        run, hidden = moved(xml, seed, push)
        found = Smoother(World(mujoco.MjSpec.from_string(xml)), [run]).locate({})
        inside.append(abs(found.force - hidden)[5:-5] < 1.96 * found.force_sd[5:-5])
    assert 0.88 < np.mean(inside) < 0.99


@pytest.mark.parametrize("xml", [PENDULUM, ARM])
def test_where_nothing_is_missing_no_force_is_located(xml):
    run, _ = moved(xml, 2)
    smoother = Smoother(World(mujoco.MjSpec.from_string(xml)), [run])
    found = smoother.locate({})
    usual = np.sqrt(np.mean(found.force**2, 0)) / smoother.scale
    assert (usual < 0.01).all()
    assert (abs(found.force) < 3 * found.force_sd).mean() > 0.95


def test_states_are_better_than_measured_and_their_bands_hold():
    run, _ = moved(PENDULUM, 3, lambda time, q, v: -0.05 * np.sign(v))
    rng = np.random.default_rng(9)
    noise = NOISE * rng.normal(size=run.qpos.shape)
    clean = replayed(PENDULUM, 3)
    run = Recording("run", run.time, clean[0] + noise, run.qvel, run.ctrl)
    smoother = Smoother(World(mujoco.MjSpec.from_string(PENDULUM)), [run])
    found = smoother.locate({})
    error, speed = found.qpos - clean[0], found.qvel - clean[1]
    assert np.sqrt(np.mean(error**2)) < 0.8 * NOISE
    assert 0.88 < (abs(error) < 1.96 * found.qpos_sd).mean() < 0.995
    assert 0.88 < (abs(speed) < 1.96 * found.qvel_sd).mean() <= 1.0
    windows = windowing.consecutive(run)
    qpos, qvel = found.at(windows)
    np.testing.assert_array_equal(qpos[3], found.qpos[windows[3].first])
    np.testing.assert_array_equal(qvel[3], found.qvel[windows[3].first])


def replayed(xml, seed, rows=400):
    """qpos, qvel (rows, 1) of moved(..., Coulomb friction), without noise."""
    run, _ = moved(xml, seed, lambda time, q, v: -0.05 * np.sign(v), rows)
    model = mujoco.MjModel.from_xml_string(xml)
    data, qpos, qvel = mujoco.MjData(model), np.empty((rows, 1)), np.empty((rows, 1))
    for t in range(rows):
        qpos[t], qvel[t], data.ctrl[:] = data.qpos, data.qvel, run.ctrl[t]
        for _ in range(2):
            data.qfrc_applied[:] = -0.05 * np.sign(data.qvel)
            mujoco.mj_step(model, data)
    return qpos, qvel


def test_under_the_right_correction_the_force_is_gone():
    run, _ = moved(PENDULUM, 4, lambda time, q, v: -0.1 * v)
    world = World(mujoco.MjSpec.from_string(PENDULUM))
    smoother = Smoother(world, [run])
    before = smoother.locate({})
    after = smoother.locate({world.candidate("viscous_damping", "j"): (0.15,)}, before)
    rms = lambda t: np.sqrt(np.mean(t.force[5:-5] ** 2))
    assert rms(after) < 0.1 * rms(before)


def test_transitions_of_a_few_steps_lead_to_the_same_motion():
    xml = DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)
    world = World(mujoco.MjSpec.from_string(xml.replace('timestep="0.005"', 'timestep="0.001"')))
    runs = [recorded("0.csv", 0, damping=0.2)]
    few, every = Smoother(world, runs), Smoother(world, runs)
    (seconds,) = few.few.values()
    assert seconds[0] > 3 * world.model.opt.timestep
    every.few = {}
    found, exact = few.locate({}), every.locate({})
    scale = abs(exact.force).max()
    assert scale > 1e-3
    np.testing.assert_allclose(found.force, exact.force, atol=0.05 * scale)
    np.testing.assert_allclose(found.qpos, exact.qpos, atol=1e-5)


def shown(offset, ratio, late, rows=300):
    """(Recording, truly shown positions (rows,)) of a pendulum whose encoder is off: late by so
    many steps of 5 ms."""
    rng, model = np.random.default_rng(3), mujoco.MjModel.from_xml_string(PENDULUM)
    data, time = mujoco.MjData(model), 0.01 * np.arange(rows)
    ctrl = 0.5 * np.sin(7 * time)[:, None] + 0.4 * np.cos(11 * time)[:, None]
    path = []
    for t in range(rows):
        data.ctrl[:] = ctrl[t]
        for _ in range(2):
            path.append(data.qpos[0])
            mujoco.mj_step(model, data)
    true = np.array(path)[np.maximum(2 * np.arange(rows) - late, 0)]
    seen = ratio * true + offset
    noisy = (seen + NOISE * rng.normal(size=rows))[:, None]
    return Recording("off.csv", time, noisy, np.full(noisy.shape, np.nan), ctrl), seen


@pytest.mark.parametrize(
    "name, value, off",
    [
        ("sensor_delay", 0.015, (0.0, 1.0, 3)),
        ("sensor_delay", 0.04, (0.0, 1.0, 8)),
        ("sensor_bias", 0.3, (0.3, 1.0, 0)),
        ("sensor_scale", 1.3, (0.0, 1.3, 0)),
    ],
)
def test_a_sensor_that_is_off_is_no_missing_force(name, value, off):
    run, seen = shown(*off)
    world = World(mujoco.MjSpec.from_string(PENDULUM))
    under = Smoother(world, [run]).locate({world.candidate(name, "j"): (value,)})
    plain = Smoother(world, [run]).locate({})
    forces = [np.sqrt(np.mean(t.force[5:-5] ** 2)) for t in (under, plain)]
    assert forces[0] < 0.1 * forces[1]
    smoother, again = Smoother(world, [run]), None
    for _ in range(4):  # turn by turn, from what is shown each time
        again = smoother.locate({world.candidate(name, "j"): (value,)}, again, passes=1)
    assert np.sqrt(np.mean(again.force[5:-5] ** 2)) < 0.15 * forces[1]
    # what is told are states as the sensor shows them
    assert np.sqrt(np.mean((under.qpos[5:-5, 0] - seen[5:-5]) ** 2)) < 0.5 * NOISE


STOPPED = """<mujoco><option timestep="0.001"/><worldbody>{floor}<body name="a" pos="0 0 .35">
  <joint name="j" axis="0 1 0" damping="0.05" {limit}/>
  <geom type="capsule" fromto="0 0 0 0.1 0 -.3" size=".02" mass="0.5"/></body></worldbody>
  <actuator><motor name="m" joint="j"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    "floor, limit",
    [
        ("", 'limited="true" range="-20 20" solreflimit="{} 1"'),
        ('<geom type="box" size=".1 1 .1" pos="0.19 0 0.1" solref="{} 1"/>', ""),
    ],
)
def test_what_a_model_errs_where_something_touches_is_no_noise(floor, limit):
    """Its stop or wall is ten times as stiff as the machine's."""
    soft, stiff = (
        STOPPED.format(floor=floor.format(s), limit=limit.format(s)) for s in (0.05, 0.015)
    )
    runs = [moved(soft, seed)[0] for seed in range(2)]
    smoother = Smoother(World(mujoco.MjSpec.from_string(stiff)), runs)
    assert 0.02 < smoother.locate({}).free.mean() < 0.9
    assert smoother.position_noise == pytest.approx(NOISE, rel=0.15)


@pytest.mark.parametrize("pushed", [0.8, 1.5])
@pytest.mark.parametrize("measured", [False, True])
def test_a_blow_bends_neither_the_motion_before_it_nor_the_rest_after(pushed, measured):
    """A row in which a stop is hit begins with the velocity that it had until then. How it ends
    shows in positions a row or two later."""
    limit = 'limited="true" range="-20 20" solreflimit="0.004 1"'
    xml = STOPPED.format(floor="", limit=limit)
    model, rows = mujoco.MjModel.from_xml_string(xml), 60
    data, qpos, qvel = mujoco.MjData(model), np.empty((rows, 1)), np.empty((rows, 1))
    data.ctrl[:] = pushed
    for t in range(rows):
        qpos[t], qvel[t] = data.qpos, data.qvel
        mujoco.mj_step(model, data, 20)
    rng = np.random.default_rng(0)
    noisy = qpos + NOISE * rng.normal(size=qpos.shape)
    read = qvel + 0.02 * rng.normal(size=qvel.shape) if measured else np.full((rows, 1), np.nan)
    run = Recording("fall.csv", 0.02 * np.arange(rows), noisy, read, np.full((rows, 1), pushed))
    path = Smoother(World(mujoco.MjSpec.from_string(xml)), [run]).locate({})
    until, before = np.arange(rows) <= np.argmax(-np.diff(qvel[:, 0])), ~path.free
    assert until.sum() >= 4 and before.sum() >= 4
    np.testing.assert_allclose(path.qvel[until], qvel[until], atol=0.005 * qvel.max())
    assert abs(path.force[before & until]).max() < 0.05 * pushed
    rest = np.arange(rows) > until.sum() + (1 if measured else 3)
    np.testing.assert_allclose(path.qvel[rest], qvel[rest], atol=0.05)
    np.testing.assert_allclose(path.qpos, qpos, atol=5 * NOISE)


def test_noise_is_between_what_differences_show_and_a_multiple_of_it():
    """Where a model is far off, what is left of the motion is no noise."""
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    smoother = Smoother(world, [recorded("0.csv", 0)])
    shown = smoother.floor.copy()
    for more, times in ((100.0, LOUDER), (0.01, 1.0)):
        found = SimpleNamespace(process=np.ones((2, 3)), measurement=(np.full(2, more), np.ones(2)))
        for _ in range(5):
            smoother._update(found)
        np.testing.assert_allclose(smoother.R[:1], times**2 * shown[:1])


@pytest.mark.parametrize("name", ["drag at a joint", "both joints"])
def test_blocks_that_are_smoothed_apart_join_without_a_jump(name):
    """Where one ends and the next begins, the motion follows from the located force."""
    xml, push = PUSHES[name]
    runs = [moved(xml, seed, push, rows=3 * BLOCK)[0] for seed in (0, 1)]
    world = World(mujoco.MjSpec.from_string(xml))
    found, rows = Smoother(world, runs).locate({}), RowMap(world, runs, {})
    begin = rows.begin
    args = np.arange(len(begin)), found.qpos[begin], found.qvel[begin], found.force[begin]
    jump = found.qvel[begin + 1] - rows.ahead(*args)[1]
    edge = (begin + 1) % BLOCK == 0
    usual = np.sqrt(np.mean(found.qvel_sd**2, 0))
    assert edge.any() and (abs(jump[edge]) < 0.1 * usual).all()


def test_what_springs_hold_counts_among_usual_forces():
    """An undriven wheel at 5 Hz: turning it round in 0.2 s would take a seventh of its spring."""
    world, run = on_spring(stiff=100.0)
    smoother = Smoother(world, [run])
    assert smoother.scale[0] > np.mean(abs(100 * run.qpos))
    spring = world.candidate("stiffness", "j")
    assert plausible(spring, Usual(world, [run], smoother.scale)).inside([110.0])


def test_a_joint_that_a_brake_holds_stays_where_it_is():
    """Its readings never change, and the model has no brake."""
    joint = '<joint name="k" axis="0 1 0" damping="0.05"/>'
    held = ARM.replace(joint, "").replace('pos="0 0 -.3">', 'pos="0 0 -.3" euler="0 28.64789 0">')
    held = held.replace('<motor name="n" joint="k"/>', "")
    run, _ = moved(held, 0)
    other = np.full((len(run.time), 1), 0.5)
    run = replace(
        run,
        qpos=np.hstack([run.qpos, other]),
        qvel=np.full((len(run.time), 2), np.nan),
        ctrl=np.hstack([run.ctrl, 0 * other]),
    )
    found = Smoother(World(mujoco.MjSpec.from_string(ARM)), [run]).locate({})
    assert abs(found.qpos[:, 1] - 0.5).max() < 1e-3
    assert abs(found.force[5:-5, 1]).mean() > 0.1  # what the brake holds
