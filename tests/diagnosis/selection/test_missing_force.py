"""The force that is located against the hidden one, and what effects do along the motion."""

from dataclasses import replace

import mujoco
import numpy as np
from plants import DRIVEN_PENDULUM, NOISE, recorded
from scipy.ndimage import gaussian_filter1d

from diagnosis.estimation.ahead import Ahead, cut_ahead
from diagnosis.estimation.chain import Chain
from diagnosis.estimation.smoother import Smoother
from diagnosis.selection.criterion import Evidence
from diagnosis.selection.plausibility import Usual
from diagnosis.simulation.simulator import World

FRICTION = 0.1


def located(torque_noise, rows=5.0):
    """(World, Chain, Usual) of a pendulum with dry friction that its model lacks, whose
    torque is measured with noise that lasts for some rows."""
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    rng, dry = np.random.default_rng(5), lambda t, q, v: -FRICTION * np.tanh(v / 0.01)
    runs = [recorded(f"{k}.csv", k, push=dry, seconds=8.0) for k in (0, 1)]
    for k, run in enumerate(runs):
        noise = gaussian_filter1d(rng.normal(size=run.ctrl.shape), rows, axis=0)
        runs[k] = replace(run, ctrl=run.ctrl + torque_noise * noise / noise.std())
    smoother = Smoother(world, runs)
    chain = Chain(world, cut_ahead(runs), np.array([NOISE]))
    chain.start(smoother.locate({}))
    return world, chain, Usual(world, runs, smoother.scale)


def test_the_located_force_is_the_hidden_one_and_what_the_right_name_does():
    world, chain, _ = located(0.0)
    t, rows = chain.trajectory, chain.used[::5]
    hidden = -FRICTION * np.tanh(t.qvel[rows, 0] / 0.01)
    assert np.median(abs(t.force[rows, 0] - hidden)) < 0.1 * FRICTION
    friction = {world.candidate("coulomb_friction", "pivot"): (FRICTION,)}
    gone, left = (np.median(abs(chain.missing(s, rows)[:, 1])) for s in ({}, friction))
    assert left < 0.2 * gone


def test_noisy_torques_speak_for_a_heavier_joint_in_the_simulator_and_not_along_the_motion():
    """It obeys them less, and so is predicted better; but it needs more force than there was."""
    world, chain, _ = located(0.3)
    ahead = Ahead(world, chain.windows, chain.noise)
    ahead.start(chain.trajectory)
    heavier = {world.candidate("armature", "pivot"): (0.01,)}
    right = {world.candidate("coulomb_friction", "pivot"): (FRICTION,)}
    for along, wrong in ((ahead, "better"), (chain, "worse")):
        nominal, *others = along.residual([{}, heavier, right])
        empty = np.zeros((*nominal.shape, 0))
        reference = Evidence(along, nominal, empty).reference
        heavy, dry = (Evidence(along, x, empty, reference).plain() for x in others)
        start = Evidence(along, nominal, empty, reference).plain()
        assert dry < start - 0.1
        assert heavy < start - 0.02 if wrong == "better" else heavy > start + 0.1
