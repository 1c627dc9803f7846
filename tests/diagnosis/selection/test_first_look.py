"""The first look: what is missing ranks first, and what no row tells of is not judged."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from plants import DRIVEN_PENDULUM, NOISE, recorded

from diagnosis.estimation.ahead import cut_ahead
from diagnosis.estimation.chain import Chain
from diagnosis.estimation.smoother import Smoother
from diagnosis.selection import first_look
from diagnosis.selection.columns import Columns
from diagnosis.selection.first_look import likely
from diagnosis.selection.plausibility import Usual
from diagnosis.simulation.simulator import World


@pytest.fixture(scope="module")
def scene():
    """(World, Chain, Usual) of a pendulum with dry friction that its model lacks."""
    return located(damping=0.05)


def located(damping, kept=0.05):
    """The same of a model with a damping, where the machine has another."""
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=damping, mass=0.5)))
    dry = lambda t, q, v: -0.1 * np.tanh(v / 0.01)
    runs = [recorded(f"{k}.csv", k, damping=kept, push=dry) for k in (0, 1)]
    smoother = Smoother(world, runs)
    chain = Chain(world, cut_ahead(runs), np.array([NOISE]))
    chain.start(smoother.locate({}))
    return world, chain, Usual(world, runs, smoother.scale)


def starts(world, *names):
    """Starts of candidates at a share of their scale."""
    of = lambda c: (c, np.array(c.nominal, float), np.array([[0.05]]))
    return [of(c) for c in world.candidates if c.effect.name in names]


def kept_of(chain, some, setting={}):
    return {c.effect.name for c in likely(chain, setting, some)}


def test_what_is_missing_is_kept_first(scene, monkeypatch):
    world, chain, _ = scene
    monkeypatch.setattr(first_look, "EACH", 1)
    monkeypatch.setattr(first_look, "ROUNDS", 1)
    some = starts(world, "coulomb_friction", "armature", "mass")
    assert kept_of(chain, some) == {"coulomb_friction"}
    # what the model has already is not judged
    friction = {world.candidate("coulomb_friction", "pivot"): (0.1,)}
    assert len(kept_of(chain, some, friction)) == 2


def test_what_shows_only_beside_the_best_is_kept(monkeypatch):
    world, chain, _ = located(damping=0.09, kept=0.0)  # as a fit without dry friction has it
    monkeypatch.setattr(first_look, "EACH", 1)
    some = starts(world, "coulomb_friction", "viscous_damping", "mass", "gain", "armature")
    assert {"coulomb_friction", "viscous_damping"} <= kept_of(chain, some)


def test_sensors_and_motions_that_mostly_touch_are_not_judged(scene, monkeypatch):
    world, chain, _ = scene
    monkeypatch.setattr(first_look, "EACH", 0)
    assert kept_of(chain, starts(world, "sensor_scale", "mass")) == {"sensor_scale"}
    touching = Chain(world, chain.windows, chain.noise)
    touching.start(chain.trajectory)
    free = np.ones(len(chain.trajectory.free), bool)
    touching.trajectory = replace(chain.trajectory, free=free)
    assert kept_of(touching, starts(world, "coulomb_friction")) == {"coulomb_friction"}


def test_few_columns_are_those_of_what_is_kept_and_of_the_setting(scene, monkeypatch):
    world, chain, usual = scene
    monkeypatch.setattr(first_look, "EACH", 1)
    monkeypatch.setattr(first_look, "ROUNDS", 1)
    names = "coulomb_friction", "armature", "mass", "sensor_scale"
    candidates = [c for c in world.candidates if c.effect.name in names]
    few = Columns(chain, {}, usual, candidates, few=True)
    assert {o.candidate.effect.name for o in few.options} == {"coulomb_friction", "sensor_scale"}
    armature = next(c for c in candidates if c.effect.name == "armature")
    some = Columns(chain, {armature: armature.nominal}, usual, candidates, few=True)
    assert armature in {o.candidate for o in some.options}
