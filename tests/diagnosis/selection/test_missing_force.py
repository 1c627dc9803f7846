"""The force that is missing against the hidden one, and what effects hold of it."""

from dataclasses import replace

import mujoco
import numpy as np
from plants import DRIVEN_PENDULUM, NOISE, commanded, recorded
from scipy.ndimage import gaussian_filter1d

from diagnosis.estimation.ahead import Ahead, cut_ahead
from diagnosis.estimation.chain import Chain
from diagnosis.estimation.smoother import Smoother
from diagnosis.selection.criterion import Evidence
from diagnosis.selection.missing_force import MissingForce
from diagnosis.selection.plausibility import Usual
from diagnosis.selection.starts import Starts
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


def test_the_missing_force_is_the_hidden_one_and_what_the_right_name_holds():
    world, chain, usual = located(0.0)
    missing = MissingForce(chain, {})
    hidden = -FRICTION * np.tanh(chain.trajectory.qvel[missing.rows, 0] / 0.01)
    force = (missing.force / missing.weight)[:, 0]
    assert np.median(abs(force - hidden)) < 0.1 * FRICTION
    friction = world.candidate("coulomb_friction", "pivot")
    start = Starts(world, {}, usual).of([friction])[0]
    held = missing.basis(start)[..., 0] / start.directions[0, 0] * FRICTION
    assert np.median(abs(missing.force - held)) < 0.1 * np.median(abs(missing.force))


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


def test_without_rows_nothing_is_told():
    world, chain, usual = located(0.0)
    chain.start(replace(chain.trajectory, free=np.ones(len(chain.trajectory.free), bool)))
    missing = MissingForce(chain, {})
    start = Starts(world, {}, usual).of([world.candidate("mass", "arm")])[0]
    assert not len(missing.rows) and missing.basis(start) is None


def test_rows_in_which_a_joint_sticks_tell_of_no_force():
    """It hardly moves there, whatever pushes it: what would have moved it may be anything."""
    world, chain, usual = located(0.0)
    start = Starts(world, {}, usual).of([world.candidate("coulomb_friction", "pivot")])[0]
    before = MissingForce(chain, {}).basis(start)
    rows = MissingForce(chain, {}).rows[[20, 90]]
    driven = chain.trajectory.driven.copy()
    driven[rows] *= 1e-3
    chain.start(replace(chain.trajectory, driven=driven))
    after = MissingForce(chain, {}).basis(start)
    assert not after[[20, 90]].any()
    np.testing.assert_allclose(np.delete(after, [20, 90], 0), np.delete(before, [20, 90], 0))


def test_what_an_effect_holds_is_worked_out_once_unless_a_setting_has_it(monkeypatch):
    world, chain, usual = located(0.0)
    friction, mass = world.candidate("coulomb_friction", "pivot"), world.candidate("mass", "arm")
    setting = {friction: (FRICTION,)}
    of_both = Starts(world, setting, usual).of([friction, mass])
    before = MissingForce(chain, {})
    for start in Starts(world, {}, usual).of([friction, mass]):
        before.basis(start)
    anew, asked = MissingForce(chain, setting), []
    carried = MissingForce(chain, setting, before)
    pushed = lambda plain: asked.append(plain) or anew._pushed(plain)
    monkeypatch.setattr(carried, "_pushed", pushed)
    for start in of_both:
        x, y = carried.basis(start), anew.basis(start)
        assert np.median(abs(x - y)) < 0.02 * np.median(abs(y))  # but where friction sticks
    values = {plain[mass] for plain in asked if mass in plain}
    assert asked and not values


TWO = """<mujoco><option timestep="0.002"/><worldbody><body><joint name="lift" type="slide"
  axis="0 0 1" stiffness="300"/><geom size=".05" mass="1"/><body name="rod"><joint name="swing"
  axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".02"/></body></body></worldbody>
  </mujoco>"""


def swung(seed, rows=300, dt=0.02):
    """A run of it in stock MuJoCo, let go of somewhere."""
    model, rng = mujoco.MjModel.from_xml_string(TWO), np.random.default_rng(seed)
    data, qpos = mujoco.MjData(model), np.empty((rows, 2))
    data.qpos[:] = rng.uniform(-1, 1, 2) * [0.05, 1.0]
    for row in qpos:
        row[:] = data.qpos
        mujoco.mj_step(model, data, round(dt / model.opt.timestep))
    noisy = qpos + NOISE * rng.normal(size=qpos.shape)
    return replace(commanded(dt * np.arange(rows), joints=2), qpos=noisy)


def test_what_acts_at_a_joint_is_no_force_in_another():
    """Though a row of several steps leaves a little there, and little may be usual there."""
    world, runs = World(mujoco.MjSpec.from_string(TWO)), [swung(0), swung(1)]
    smoother = Smoother(world, runs)
    chain = Chain(world, cut_ahead(runs), np.full(2, NOISE))
    chain.start(smoother.locate({}))
    missing, starts = MissingForce(chain, {}), Starts(world, {}, Usual(world, runs, smoother.scale))
    held = lambda *what: missing.basis(starts.of([world.candidate(*what)])[0])
    damping = held("viscous_damping", "swing")
    assert damping[:, 1].any() and not damping[:, 0].any()
    assert held("mass", "rod")[:, 0].any()
