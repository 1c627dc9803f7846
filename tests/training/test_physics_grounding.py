"""Grounding by diagnosis: what becomes a recording, and that the missing
physics ends up in the simulator."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch

from diagnosis.simulation.corrected_py import (
    corrected_py,
    module_of,
    parts_in,
    python_parts,
)
from diagnosis.simulation.simulator import World
from envs import BatchEnv, EnvError, model_path, parse_perturbation
from models import GaussianPolicy
from rgat import RGAT, CorrectedEnv, GroundingSettings, Solved, identity, one_step_error
from training.physics_grounding import Physics, PhysicsThen, recordings_of
from trpo import Transitions, TRPOConfig, rollouts

torch.set_num_threads(1)


def transitions(env, episodes, seed=0):
    torch.manual_seed(seed)
    policy = GaussianPolicy(env.single_observation_space.shape[0], env.single_action_space.shape[0])
    return rollouts(policy, env, episodes, seed)[1]


def test_episodes_become_recordings_without_what_the_observation_hides():
    env = BatchEnv("Hopper-v4", 3, nthread=1)
    tau = transitions(env, 3)
    recordings = recordings_of(env, tau)
    assert len(recordings) == 3 and sum(len(r.time) - 1 for r in recordings) == len(tau)
    at = 0
    for r in recordings:
        n = len(r.time) - 1
        assert np.allclose(np.diff(r.time), env.dt)
        assert np.isnan(r.qpos[:, 0]).all()  # the root's x is not observed
        np.testing.assert_array_equal(r.qpos[:-1, 1:], tau.s[at : at + n, :5].astype(float))
        np.testing.assert_array_equal(r.qpos[-1, 1:], tau.s_next[at + n - 1, :5].astype(float))
        np.testing.assert_array_equal(r.ctrl[:-1], tau.a[at : at + n].astype(float))
        at += n


def test_a_clipped_velocity_counts_as_not_measured():
    env = BatchEnv("Hopper-v4", 1, nthread=1)
    s = np.zeros((3, 11), np.float32)
    s[1, -1], s[2, -1] = 10.0, -10.0
    [recording] = recordings_of(env, Transitions(s[:2], np.zeros((2, 3), np.float32), s[1:]))
    assert np.isnan(recording.qvel[1:, -1]).all() and np.isfinite(recording.qvel[0]).all()
    assert np.isfinite(recording.qvel[:, :-1]).all()


def test_the_heavy_pole_is_found_and_put_into_the_simulator():
    sim = BatchEnv("InvertedPendulum-v4", 4, nthread=1)
    real = BatchEnv("InvertedPendulum-v4", 4, parse_perturbation("pole:mass=100"), nthread=1)
    tau, held_out = transitions(real, 12), transitions(real, 4, seed=1)
    grounding = Physics(sim)
    grounding.fit(tau, 0)
    grounding.update(None, 1, 0)
    model = mujoco.MjModel.from_xml_string(grounding.xml)
    assert abs(model.body("pole").mass[0] - 100) < 2
    assert (
        one_step_error(grounding.sim, identity, held_out)[0]
        < 0.02 * one_step_error(sim, identity, held_out)[0]
    )

    again = Physics(sim)  # what a checkpoint holds rebuilds the same simulator
    again.load(grounding.state())
    assert one_step_error(again.sim, identity, held_out) == one_step_error(
        grounding.sim, identity, held_out
    )


def test_a_diagnosis_that_predicts_worse_than_the_last_is_not_taken(monkeypatch):
    sim = BatchEnv("InvertedPendulum-v4", 4, nthread=1)
    real = BatchEnv("InvertedPendulum-v4", 4, parse_perturbation("pole:mass=20"), nthread=1)
    tau, grounding = transitions(real, 4), Physics(sim)
    for mass, joints, kept in ((12, 0, 12), (100, 0, 12), (20, 1, 12), (20, 0, 20)):
        monkeypatch.setattr(
            "training.physics_grounding.diagnose",
            lambda path, recordings: SimpleNamespace(
                corrected_xml=with_pole(mass, joints), corrected_py=""
            ),
        )
        grounding.fit(tau, 0)
        assert mujoco.MjModel.from_xml_string(grounding.xml).body("pole").mass[0] == pytest.approx(
            kept
        )


def scripted(**effects):
    """(xml, script) of the pendulum with effects of its drive, as a diagnosis hands them over."""
    world = World.load(model_path("InvertedPendulum-v4"))
    setting = {world.candidate(name, "slide"): values for name, values in effects.items()}
    xml, written = world.corrected_xml(setting)
    parts = python_parts(world.model, setting, written)
    return xml, corrected_py(parts, ["slider", "hinge"])


SLOW = {"rate_limit": (30.0,), "torque_speed": (2.0, 250.0)}  # a memory, and a force


def begun(env, i):
    """MjData where the i-th of the environments is."""
    data = mujoco.MjData(env.model)
    data.qpos[:], data.qvel[:] = env.qpos[i], env.qvel[i]
    return data


def test_the_world_of_a_script_moves_as_the_script_does():
    xml, script = scripted(**SLOW)
    env = CorrectedEnv("InvertedPendulum-v4", 3, xml, script, nthread=1)
    plain = CorrectedEnv("InvertedPendulum-v4", 3, xml, nthread=1)
    step = module_of(parts_in(script)).step
    rng, apart, ended = np.random.default_rng(0), 0.0, 0
    env.reset(seed=0)
    plain.reset(seed=0)
    alone = [begun(env, i) for i in range(3)]
    for _ in range(12):
        a = rng.uniform(-3, 3, (3, 1)).astype(np.float32)
        seen = env.peek(a)
        np.testing.assert_array_equal(seen, env.peek(a))  # nothing moves
        _, _, fell, _, info = env.step(a)
        np.testing.assert_allclose(seen, info["next_obs"], atol=1e-12)
        for data, u in zip(alone, a):
            data.ctrl[:] = u
            step(env.model, data, env.frame_skip)
        expected = [np.concatenate([data.qpos, data.qvel]) for data in alone]
        np.testing.assert_allclose(info["next_obs"], expected, atol=1e-9)
        # one that fell begins anew, with nothing in memory
        alone = [begun(env, i) if fell[i] else data for i, data in enumerate(alone)]
        ended += fell.sum()
        apart = max(apart, abs(plain.step(a)[-1]["next_obs"] - info["next_obs"]).max())
    assert ended
    assert apart > 1e-3


def test_the_script_of_a_diagnosis_is_in_the_simulator(monkeypatch):
    """Real is a drive that no MJCF holds: with the script nothing is missing, without it much."""
    force = {"torque_speed": SLOW["torque_speed"]}  # one step tells nothing of a memory
    files = scripted(**force)
    monkeypatch.setattr(
        "training.physics_grounding.diagnose",
        lambda path, recordings: SimpleNamespace(corrected_xml=files[0], corrected_py=files[1]),
    )
    sim = BatchEnv("InvertedPendulum-v4", 4, nthread=1)
    tau = transitions(CorrectedEnv("InvertedPendulum-v4", 4, *files, nthread=1), 4)
    grounding = Physics(sim)
    grounding.fit(tau, 0)
    grounding.update(None, 0, 0)
    assert (grounding.xml, grounding.script) == files
    assert one_step_error(grounding.sim, identity, tau)[0] < 1e-5
    assert one_step_error(sim, identity, tau)[0] > 1e-3
    again = Physics(sim)
    again.load(grounding.state())
    assert again.sim.parts == grounding.sim.parts != []


def test_a_solver_probes_the_world_of_the_script():
    env = CorrectedEnv("InvertedPendulum-v4", 3, *scripted(**SLOW), nthread=1)
    solver, rng = Solved(env), np.random.default_rng(1)
    solver.scale = np.ones(4)
    env.reset(seed=0)
    for k in range(4):
        a = rng.uniform(-2, 2, (3, 1)).astype(np.float32)
        tried = np.stack([a, -a] if k % 2 else [-a, a], 1)
        probed = solver._after(solver.trial, tried)[:, (k + 1) % 2]
        np.testing.assert_allclose(probed, env.step(a)[-1]["next_obs"], atol=1e-12)


def with_pole(mass, joints):
    """MJCF of the pendulum with a pole of that mass, and as many joints
    more, as backlash has one."""
    spec = mujoco.MjSpec.from_file(str(model_path("InvertedPendulum-v4")))
    [geom] = spec.body("pole").geoms
    geom.mass = mass
    for _ in range(joints):
        spec.body("pole").add_joint(
            name="play", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0], limited=False
        )
    return spec.to_xml()


def test_too_little_to_diagnose_is_said_in_a_line():
    sim = BatchEnv("InvertedPendulum-v4", 1, nthread=1)
    tau = transitions(sim, 1)[:3]
    with pytest.raises(EnvError, match="no diagnosis from 3 real transitions"):
        Physics(sim).fit(tau, 0)


@pytest.mark.parametrize("rest", [RGAT, Solved])
def test_a_transformer_takes_what_the_diagnosis_leaves(rest, monkeypatch):
    """The diagnosis finds a part of the mass; the rest has the corrected simulator to work on."""
    sim = BatchEnv("InvertedPendulum-v4", 4, nthread=1)
    real = BatchEnv("InvertedPendulum-v4", 4, parse_perturbation("pole:mass=20"), nthread=1)
    tau, held_out = transitions(real, 8), transitions(real, 4, seed=1)
    settings = GroundingSettings(at=TRPOConfig(batch_size=64, gamma=0.0), at_std=0.05)
    grounding, policy = PhysicsThen(rest, sim, settings), GaussianPolicy(4, 1)
    for mass in (12, 13):
        monkeypatch.setattr(
            "training.physics_grounding.diagnose",
            lambda path, recordings: SimpleNamespace(
                corrected_xml=with_pole(mass, 0), corrected_py=""
            ),
        )
        before = getattr(grounding.rest, "learner", None)
        before = before and [p.detach().clone() for p in before.policy.net.parameters()]
        grounding.fit(tau, 0)
        if before and mass == 13:  # g_phi goes on in the new simulator
            now = grounding.rest.learner.policy.net.parameters()
            assert all(torch.equal(a, b) for a, b in zip(before, now))
        grounding.update(policy, 1000, 0)
        assert grounding.sim is grounding.rest.sim
        assert grounding.sim.model.body("pole").mass[0] == pytest.approx(mass)
    corrected = one_step_error(grounding.sim, identity, held_out)[0]
    assert corrected < one_step_error(sim, identity, held_out)[0]
    if rest is Solved:
        assert one_step_error(grounding.sim, grounding.transformer, held_out)[0] < 0.5 * corrected
    again = PhysicsThen(rest, sim, settings)
    again.load(grounding.state())
    ours, theirs = (one_step_error(g.sim, g.transformer, held_out) for g in (grounding, again))
    assert ours == theirs
