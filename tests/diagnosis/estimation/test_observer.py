"""Start states against the velocities of stock MuJoCo, on a pendulum and a Hopper that are recorded too seldom."""

import mujoco
import numpy as np
import pytest

from diagnosis.estimation import initial_states, multiple_shooting
from diagnosis.estimation.observer import observed
from diagnosis.estimation.residuals import Hypothesis, Problem
from diagnosis.estimation.windows import consecutive, recorded_starts
from diagnosis.nominal.model import load_world as _world
from diagnosis.recordings.recording import Recording
from diagnosis.simulation.simulator import World
from envs import model_path

PENDULUM = """<mujoco><option timestep="0.002"/><worldbody><body><joint name="hinge" axis="0 1 0" damping="0.01"/>
<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="0.5" contype="0" conaffinity="0"/></body></worldbody>
<actuator><motor joint="hinge" gear="2"/></actuator></mujoco>"""


def recorded(model, ctrl, substeps, noise=0.0, seed=0):
    """A Recording of stock MuJoCo's positions at every `substeps` steps, and its true velocities."""
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    qpos, qvel = [], []
    for u in ctrl:
        qpos.append(data.qpos.copy())
        qvel.append(data.qvel.copy())
        data.ctrl[:] = u
        for _ in range(substeps):
            mujoco.mj_step(model, data)
    qpos, qvel = np.array(qpos), np.array(qvel)
    time = model.opt.timestep * substeps * np.arange(len(ctrl))
    return Recording(
        "run.csv",
        time,
        qpos + noise * rng.normal(size=qpos.shape),
        np.full(qvel.shape, np.nan),
        ctrl,
    ), qvel


def errors(world, recording, qvel, span):
    windows = [w for w in consecutive(recording, span) if w.first]
    first = [w.first for w in windows]
    rms = lambda speed: np.sqrt(np.mean((speed - qvel[first]) ** 2))
    return (
        rms(recorded_starts(world.model, windows)[1]),
        rms(observed(world, windows, [{}] * len(windows))[1]),
        rms(0.0),
    )


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_a_pendulum_seen_every_50_ms(noise):
    world = World(mujoco.MjSpec.from_string(PENDULUM))
    ctrl = np.random.default_rng(1).uniform(-1, 1, (200, 1))
    recording, qvel = recorded(world.model, ctrl, 25, noise)
    by_difference, by_observer, speed = errors(world, recording, qvel, 0.2)
    assert by_observer < 0.02 * speed + 20 * noise < by_difference


def test_a_hopper_through_contacts():
    world = _world(model_path("Hopper-v4"))
    ctrl = np.repeat(np.random.default_rng(2).uniform(-1, 1, (60, 3)), 2, axis=0)
    recording, qvel = recorded(world.model, ctrl, 25)  # every 50 ms
    by_difference, by_observer, speed = errors(world, recording, qvel, 0.2)
    assert by_observer < 0.3 * by_difference


def test_holes_and_measured_velocities():
    world = World(mujoco.MjSpec.from_string(PENDULUM))
    recording, qvel = recorded(world.model, np.random.default_rng(1).uniform(-1, 1, (100, 1)), 25)
    windows = [w for w in consecutive(recording, 0.2) if w.first > 20]
    recording.qpos[::3] = np.nan
    first = [w.first for w in windows]
    assert (
        np.abs(observed(world, windows, [{}] * len(windows))[1] - qvel[first]).max()
        < 0.1 * np.abs(qvel).max()
    )
    recording.qvel[:] = qvel
    np.testing.assert_allclose(observed(world, windows, [{}] * len(windows))[1], qvel[first])


def test_led_starts_and_bounded_steps_find_a_mass_through_contacts():
    """A runner seen every 50 ms: windows end in local minima by the usual way, and hold a parameter where it begins."""
    world = _world(model_path("HalfCheetah-v4"))
    torso = next(c for c in world.candidates if c.effect.name == "mass" and c.place.name == "torso")
    real = _world(model_path("HalfCheetah-v4")).model
    real.body_mass[1] *= 1.15
    real.body_inertia[1] *= 1.15
    mujoco.mj_setConst(real, mujoco.MjData(real))
    recording, _ = recorded(real, np.random.default_rng(3).uniform(-1, 1, (150, 6)), 5, noise=1e-3)
    noise, unmeasured = np.full(9, 1e-3), np.full(9, np.inf)
    problem = Problem(world, consecutive(recording, 0.25), noise, unmeasured)
    freedom = 6 * 9 - 18  # of a window
    truth = Hypothesis().plus(torso, (1.15 * torso.nominal[0],))
    good = lambda fit: np.mean(fit.chi2 < 2 * freedom)
    led = good(initial_states.fit(problem, truth))
    world.fits.clear()
    problem.far_apart = False
    assert led > max(0.8, 0.1 + good(initial_states.fit(problem, truth)))
    world.fits.clear()
    problem.far_apart = True
    begun = Hypothesis().plus(torso, (1.02 * torso.nominal[0],))
    [fit] = multiple_shooting.solve(problem, [begun], initial_states.fit(problem, Hypothesis()))
    assert abs(fit.hypothesis.vector[0] / torso.nominal[0] - 1.15) < 0.02


def test_a_simulation_that_blows_up_on_the_way_begins_again_as_recorded():
    world = World(mujoco.MjSpec.from_string(PENDULUM))
    recording, _ = recorded(world.model, np.zeros((60, 1)), 25)
    windows = consecutive(recording, 0.2)[2:]
    qpos, qvel = observed(
        world,
        windows,
        [{world.candidate("bias", world.model.actuator(0).name): (1e14,)}] * len(windows),
    )
    np.testing.assert_array_equal((qpos, qvel), recorded_starts(world.model, windows))
