"""What a located force depends on: right on made-up motions, nothing on noise."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from diagnosis.estimation.smoother import Trajectory
from diagnosis.recordings.recording import Recording
from diagnosis.selection.missing_force import CLIP, LEAST, _explained, dependences, places_of
from diagnosis.simulation.simulator import World

ARM = """<mujoco><default><geom contype="0" conaffinity="0"/></default><worldbody>
  <body><joint name="j" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02"/>
  <body pos="0 0 -.3"><joint name="k" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02"/></body></body></worldbody>
  <actuator><motor name="m" joint="j"/></actuator></mujoco>"""
ROWS = 3000


def made_up(law, noise=0.02, seed=0):
    """(World, Trajectory, [Recording]) of two joints that swing, with a force law (rows, 2)."""
    rng, time = np.random.default_rng(seed), 0.01 * np.arange(ROWS)
    rate, phase = rng.uniform(2, 6, (2, 3, 1, 2)) * [1, 1], rng.uniform(0, 6, (3, 1, 2))
    angle = rate[0] * time[:, None] + phase
    q, v = np.sin(angle).sum(0) / 2, (rate[0] * np.cos(angle)).sum(0) / 2
    u = np.sin(rate[1][0, 0, 0] * 1.3 * time)[:, None]
    force = law(q, v, u, time) + noise * rng.normal(size=(ROWS, 2))
    run = Recording("run.csv", time, q, v, u)
    sd = np.full((ROWS, 2), 1e-3)
    free, carried = np.zeros(ROWS, bool), np.tile(np.eye(4), (ROWS, 1, 1))
    world = World(mujoco.MjSpec.from_string(ARM))
    return world, Trajectory(q, v, force, sd, sd, sd, {run: 0}, free, carried), [run]


def at(joint, force):
    out = np.zeros((ROWS, 2))
    out[:, joint] = force
    return out


@pytest.mark.parametrize(
    "law, joint, variable",
    [
        (lambda q, v, u, t: at(0, 0.3 * np.sin(4 * q[:, 0])), "j", "position:j"),
        (lambda q, v, u, t: at(1, -0.2 * np.tanh(v[:, 1] / 0.1)), "k", "velocity:k"),
        (lambda q, v, u, t: at(1, 0.2 * q[:, 0] ** 2), "k", "position:j"),
        (lambda q, v, u, t: at(0, 0.3 * np.maximum(u[:, 0], 0)), "j", "control:m"),
        (lambda q, v, u, t: at(0, 0.3 * np.tanh((t - 14) / 4)), "j", "time"),
    ],
)
def test_the_variable_of_a_force_is_named_with_its_curve(law, joint, variable):
    world, trajectory, runs = made_up(law)
    found = dependences(world, trajectory, runs)[0]
    assert (found.joint, found.variables[0]) == (joint, variable) and found.share > 0.8
    values = np.array(found.values)
    q, v, u = trajectory.qpos, trajectory.qvel, runs[0].ctrl
    x = {"position:j": q[:, 0], "velocity:k": v[:, 1], "control:m": u[:, 0]}.get(
        variable, runs[0].time
    )
    dof = {"j": 0, "k": 1}[joint]
    if len(found.variables) == 1:
        curve = found.candidate.effect.at(x, np.tile(values, (len(x), 1)))
        true = law(q, v, u, runs[0].time)[:, dof]
        assert np.sqrt(np.mean((curve - true) ** 2)) < 0.35 * np.sqrt(np.mean(true**2))
        size = found.above * trajectory.located()[1][dof]
        assert size == pytest.approx(np.sqrt(np.mean(true**2)), rel=0.2)


def test_a_friction_over_the_travel_depends_on_position_and_on_the_sign_of_velocity():
    law = lambda q, v, u, t: at(0, -0.2 * (1 + q[:, 0]) * np.sign(v[:, 0]))
    found = dependences(*made_up(law))[0]
    assert found.variables == ("position:j", "velocity:j") and found.share > 0.8


def test_a_friction_that_its_drive_lessens_depends_on_control_and_on_the_sign_of_velocity():
    law = lambda q, v, u, t: at(0, -0.2 * np.exp(-abs(u[:, 0])) * np.sign(v[:, 0]))
    found = dependences(*made_up(law))[0]
    assert found.variables == ("control:m", "velocity:j") and found.share > 0.8
    assert found.candidate.effect.factor == "velocity:j"


def test_a_ripple_that_grows_with_speed_depends_on_position_and_velocity():
    law = lambda q, v, u, t: at(0, 0.1 * v[:, 0] ** 2 * np.sin(9 * q[:, 0]))
    world, trajectory, runs = made_up(law)
    found = dependences(world, trajectory, runs)[0]
    assert found.variables == ("position:j", "velocity:j") and found.share > 0.7
    assert found.candidate.effect.factor == "speed:j" and found.candidate.effect.wave
    force, scatter = trajectory.force[~trajectory.free, 0], trajectory.located()[1][0]
    most = CLIP * max(1.4826 * np.median(abs(force)), np.sqrt(np.mean(force**2)))
    size = np.sqrt(found.share * np.mean(np.clip(force, -most, most) ** 2))
    assert found.above == pytest.approx(size / scatter)


def test_ripples_of_what_a_drive_is_asked_for_are_a_wave_times_its_control():
    law = lambda q, v, u, t: at(0, 0.3 * u[:, 0] * np.sin(14 * q[:, 0] + 1))
    found = dependences(*made_up(law))[0]
    assert found.variables == ("position:j", "control:m") and found.share > 0.8
    zero, quarter = found.candidate.effect.knots
    assert found.candidate.effect.wave and np.pi / 2 / (quarter - zero) == pytest.approx(
        14, rel=0.02
    )


def test_what_stands_out_of_what_is_known_comes_first():
    law = lambda q, v, u, t: at(0, 0.3 * np.sin(4 * q[:, 0])) + at(1, np.sin(t / 3))
    world, trajectory, runs = made_up(law)
    assert dependences(world, trajectory, runs)[0].joint == "k"
    trajectory.force_sd[:, 1] = 1.0  # as smooth, and as large as what is not known of it
    assert dependences(world, trajectory, runs)[0].joint == "j"


def test_noise_depends_on_nothing():
    for seed in range(5):
        assert dependences(*made_up(lambda q, v, u, t: np.zeros((ROWS, 2)), seed=seed)) == []


def test_a_drive_that_is_asked_for_nothing_multiplies_no_curve():
    world, trajectory, [run] = made_up(lambda q, v, u, t: at(0, 0.3 * np.sin(4 * q[:, 0])))
    idle = replace(run, ctrl=np.zeros_like(run.ctrl))
    trajectory = replace(trajectory, first={idle: 0})
    found = dependences(world, trajectory, [idle])
    assert found and not any("control:m" in d.variables for d in found)


def test_rows_in_contact_are_left_out():
    world, trajectory, runs = made_up(lambda q, v, u, t: at(0, 0.3 * np.sin(4 * q[:, 0])))
    trajectory.free[:] = True
    assert dependences(world, trajectory, runs) == []


def test_a_curve_bends_where_its_force_does_and_nowhere_else():
    def notch(q, v, u, t):
        x = (q[:, 0] - 0.2) / 0.06  # of a travel of three
        return at(0, -0.3 * x * np.exp(0.5 - 0.5 * x * x))

    found = dependences(*made_up(notch))[0]
    assert found.variables == ("position:j",) and found.share > 0.75
    near = [k for k in found.candidate.effect.knots if abs(k - 0.2) < 0.25]
    assert len(near) > 4
    bent = dependences(*made_up(lambda q, v, u, t: at(0, -0.3 * np.maximum(q[:, 0], 0)), 0.1))[0]
    assert bent.variables == ("position:j",) and len(bent.values) < 7


def test_a_force_that_mostly_is_not_there_is_as_large_as_where_it_is():
    """A stiff stop, met in 28 % of all rows."""
    stop = lambda q: -20 * np.maximum(q[:, 0] - np.quantile(q[:, 0], 0.72), 0.0)
    world, trajectory, runs = made_up(lambda q, v, u, t: at(0, stop(q)))
    found = dependences(world, trajectory, runs)[0]
    assert found.variables == ("position:j",) and found.share > 0.9
    peak = np.quantile(abs(stop(trajectory.qpos)), 0.995)
    assert np.abs(found.values).max() == pytest.approx(peak, rel=0.1)


def test_chosen_knots_predict_no_force_that_wanders_by_itself():
    """Smooth noise beside a smooth motion: knots that are chosen where they are judged predict
    a share of it in a third of the cases."""
    rng, smooth, seen = np.random.default_rng(0), np.ones(25) / 25, []
    block = np.arange(2000) * 16 // 2000
    for _ in range(30):
        x, force = (np.convolve(rng.normal(size=2024), smooth, "valid") for _ in range(2))
        seen.append(_explained(force, force, x, np.ones(2000), block, "position:j")[0] > LEAST)
    assert np.mean(seen) < 0.15


def test_knots_lie_close_about_standstill():
    v = np.random.default_rng(0).normal(size=2000)
    knots = places_of(v, "velocity:j")
    assert 0.0 in knots and min(np.diff(knots)) < 0.1 * max(np.diff(knots))
    assert np.diff(places_of(v, "position:j")) == pytest.approx(np.diff(places_of(v, "time")))
