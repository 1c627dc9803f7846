"""Grounding by diagnosis: what becomes a recording, and that the missing
physics ends up in the simulator."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch

from envs import BatchEnv, EnvError, model_path, parse_perturbation
from models import GaussianPolicy
from rgat import RGAT, GroundingSettings, Solved, identity, one_step_error
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
            lambda path, recordings: SimpleNamespace(corrected_xml=with_pole(mass, joints)),
        )
        grounding.fit(tau, 0)
        assert mujoco.MjModel.from_xml_string(grounding.xml).body("pole").mass[0] == pytest.approx(
            kept
        )


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
            lambda path, recordings: SimpleNamespace(corrected_xml=with_pole(mass, 0)),
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
