"""The first look: what is missing ranks first, and what no row tells of is not judged."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from plants import DRIVEN_PENDULUM, NOISE, recorded

from diagnosis.estimation.ahead import cut_ahead
from diagnosis.estimation.chain import Chain
from diagnosis.estimation.smoother import Smoother
from diagnosis.selection import columns
from diagnosis.selection.columns import Columns
from diagnosis.selection.first_look import first_look
from diagnosis.selection.plausibility import Usual
from diagnosis.simulation.simulator import World


@pytest.fixture(scope="module")
def scene():
    """(World, Chain, Usual) of a pendulum with dry friction that its model lacks."""
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    runs = [recorded(f"{k}.csv", k, push=lambda t, q, v: -0.1 * np.tanh(v / 0.01)) for k in (0, 1)]
    smoother = Smoother(world, runs)
    chain = Chain(world, cut_ahead(runs), np.array([NOISE]))
    chain.start(smoother.locate({}))
    return world, chain, Usual(world, runs, smoother.scale)


def starts(world, *names):
    """Starts of candidates at a share of their scale."""
    of = lambda c: (c, np.array(c.nominal, float), np.array([[0.05]]))
    return [of(c) for c in world.candidates if c.effect.name in names]


def test_what_is_missing_explains_most(scene):
    world, chain, _ = scene
    share = first_look(chain, {}, starts(world, "coulomb_friction", "armature", "mass"))
    ranked = [c.effect.name for c in sorted(share, key=lambda c: -share[c][0])]
    assert ranked[0] == "coulomb_friction" and max(s[0] for s in share.values()) > 0.8
    truth = {world.candidate("coulomb_friction", "pivot"): (0.1,)}
    left = first_look(chain, truth, starts(world, "armature", "mass"))
    assert max(s[0] for s in left.values()) < 0.3


def test_sensors_and_motions_that_mostly_touch_are_not_judged(scene):
    world, chain, _ = scene
    assert not first_look(chain, {}, starts(world, "sensor_scale", "sensor_bias"))
    touching = Chain(world, chain.windows, chain.noise)
    touching.start(chain.trajectory)
    free = np.ones(len(chain.trajectory.free), bool)
    touching.trajectory = replace(chain.trajectory, free=free)
    assert not first_look(touching, {}, starts(world, "coulomb_friction"))


def test_few_columns_are_those_of_the_likely_and_of_what_no_row_tells(scene, monkeypatch):
    world, chain, usual = scene
    monkeypatch.setattr(columns, "LIKELY", 1)
    monkeypatch.setattr(columns, "LOCAL", 1)
    names = "coulomb_friction", "armature", "mass", "sensor_scale"
    candidates = [c for c in world.candidates if c.effect.name in names]
    few = Columns(chain, {}, usual, candidates, few=True)
    assert {o.candidate.effect.name for o in few.options} == {"coulomb_friction", "sensor_scale"}
    armature = next(c for c in candidates if c.effect.name == "armature")
    kept = Columns(chain, {armature: armature.nominal}, usual, candidates, few=True)
    assert armature in {o.candidate for o in kept.options}  # what is in the model stays
