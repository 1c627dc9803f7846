"""The first look: what is missing ranks first, and what no row tells of is not judged."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from plants import DRIVEN_PENDULUM, NOISE, recorded

from diagnosis.estimation.ahead import cut_ahead
from diagnosis.estimation.chain import Chain
from diagnosis.estimation.smoother import Smoother
from diagnosis.recordings.recording import Recording
from diagnosis.selection import beam
from diagnosis.selection.beam import likely
from diagnosis.selection.columns import Columns
from diagnosis.selection.missing_force import MissingForce
from diagnosis.selection.plausibility import Usual, plausible
from diagnosis.selection.starts import Start, Starts
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


def starts(scene, *names):
    """Starts of candidates at a share of their scale."""
    world, _, usual = scene
    bounds = np.full(1, -9.0), np.full(1, 9.0)
    of = lambda c: (c, np.array(c.nominal, float), np.array([[0.05]]), *bounds)
    chosen = [c for c in world.candidates if c.effect.name in names]
    return [Start(*of(c), plausible(c, usual)) for c in chosen]


def kept_of(scene, some, setting={}):
    missing = MissingForce(scene[1], setting)
    return {start.candidate.effect.name for start in likely(missing, some)}


def test_what_is_missing_is_kept_first(scene, monkeypatch):
    monkeypatch.setattr(beam, "EACH", 1)
    monkeypatch.setattr(beam, "MORE", 0)
    some = starts(scene, "coulomb_friction", "armature", "mass")
    assert kept_of(scene, some) == {"coulomb_friction"}
    # another look keeps others
    monkeypatch.setattr(beam, "EACH", 2)
    monkeypatch.setattr(beam, "MORE", 1)
    alike = "coulomb_friction", "viscous_damping", "quadratic_damping", "armature"
    assert kept_of(scene, starts(scene, *alike)) == set(alike)
    # what the model has already stays
    monkeypatch.setattr(beam, "EACH", 1)
    monkeypatch.setattr(beam, "MORE", 0)
    friction = {scene[0].candidate("coulomb_friction", "pivot"): (0.1,)}
    assert len(kept_of(scene, some, friction)) == 2


def test_waves_that_the_located_force_chose_are_kept(scene, monkeypatch):
    """Row by row a fast ripple explains next to nothing of a noisy motion."""
    monkeypatch.setattr(beam, "EACH", 1)
    monkeypatch.setattr(beam, "MORE", 0)
    ripple, friction = starts(scene, "cogging")[:1], starts(scene, "coulomb_friction")
    waves = [replace(start, merges=True) for start in ripple]
    assert kept_of(scene, [*ripple, *friction]) == {"coulomb_friction"}
    assert kept_of(scene, [*waves, *friction]) == {"coulomb_friction", "cogging"}


def test_what_shows_only_beside_the_best_is_kept(monkeypatch):
    other = located(damping=0.09, kept=0.0)  # as a fit without dry friction has it
    monkeypatch.setattr(beam, "EACH", 1)
    some = starts(other, "coulomb_friction", "viscous_damping", "mass", "gain", "armature")
    assert {"coulomb_friction", "viscous_damping"} <= kept_of(other, some)


def looked_at(monkeypatch, chain, some):
    """(names that a look by rows is asked for, those that a look in windows is, what is kept where
    either keeps the first of them)."""
    asked = []

    def look(*given):
        tried = [*given[-2]]  # before the number of rounds
        asked.append({start.candidate.effect.name for start in tried})
        return tried[:1]

    monkeypatch.setattr(beam, "_by_rows", look)
    monkeypatch.setattr(beam, "_by_windows", look)
    return asked, likely(MissingForce(chain, {}), some)


def test_all_are_looked_at_in_windows_and_where_it_tells_row_by_row(scene, monkeypatch):
    chain, forces = scene[1], {"coulomb_friction", "mass"}
    some = starts(scene, "sensor_scale", *forces)
    asked, kept = looked_at(monkeypatch, chain, some)
    assert asked == [forces, {"sensor_scale", *forces}]
    assert {*kept} == {next(s for s in some if s.candidate.effect.name in forces), some[0]}
    # what changes nothing in the rows
    monkeypatch.setattr(chain, "missing", lambda setting, rows: np.ones((len(rows), 2)))
    assert looked_at(monkeypatch, chain, some)[0] == [{"sensor_scale", *forces}]


def test_where_the_motion_mostly_touches_something_no_row_tells(scene, monkeypatch):
    world, chain, _ = scene
    touching = Chain(world, chain.windows, chain.noise)
    free = np.ones(len(chain.trajectory.free), bool)
    touching.start(replace(chain.trajectory, free=free))
    some = starts(scene, "sensor_scale", "coulomb_friction", "mass", "armature")
    monkeypatch.setattr(beam, "EACH", 1)
    monkeypatch.setattr(beam, "MORE", 0)
    assert kept_of((world, touching, None), some) == {"coulomb_friction"}
    asked, _ = looked_at(monkeypatch, touching, some)
    assert asked == [{start.candidate.effect.name for start in some}]


def test_of_a_candidate_the_best_share_and_the_best_whole_value_are_kept(scene):
    friction = starts(scene, "coulomb_friction")[0]
    size = lambda x: replace(friction, directions=np.array([[x]]), low=np.array([0.3]))
    tried = [friction, replace(friction, directions=np.array([[-0.9]])), size(0.1), size(3.0)]
    missing = MissingForce(scene[1], {})
    kept = beam._by_rows(missing.force, {s: missing.basis(s) for s in tried}, 1)
    assert len(kept) == 2 and kept.count(tried[2]) == 1
    assert [start.whole for start in sorted(kept, key=lambda s: s.whole)] == [False, True]


def test_whole_values_are_looked_at_within_their_bounds(monkeypatch):
    """A sensor is late by three rows: thirty times a delay of a tenth of a row would do as well in
    a picture that is linear, but no delay acts in proportion that far."""
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    runs = [recorded(f"{k}.csv", k) for k in (0, 1)]
    late = lambda r: replace(r, qpos=np.concatenate([r.qpos[:1]] * 3 + [r.qpos[:-3]]))
    runs = [late(run) for run in runs]
    smoother, seconds = Smoother(world, runs), float(3 * np.diff(runs[0].time[:2])[0])
    chain = Chain(world, cut_ahead(runs), np.array([NOISE]))
    chain.start(smoother.locate({}))
    candidate = world.candidate("sensor_delay", "pivot")
    prior = plausible(candidate, Usual(world, runs, smoother.scale))
    bounds = np.array([0.3]), np.array([3.0])
    whole = lambda x: Start(candidate, np.zeros(1), np.array([[x]]), *bounds, prior)
    near, tiny = whole(0.8 * seconds), whole(seconds / 30)
    monkeypatch.setattr(beam, "MORE", 0)
    assert likely(MissingForce(chain, {}), [tiny, near]) == [near]


def test_a_look_at_all_starts_keeps_those_of_the_setting(scene, monkeypatch):
    world, chain, usual = scene
    monkeypatch.setattr(beam, "EACH", 1)
    armature = world.candidate("armature", "pivot")
    friction = world.candidate("coulomb_friction", "pivot")
    setting = {armature: armature.nominal}
    every = Starts(world, setting, usual).of([armature, friction, world.candidate("mass", "arm")])
    kept = {start.candidate for start in likely(MissingForce(chain, setting), every)}
    assert {armature, friction} <= kept


def test_beginnings_are_the_first_seconds_of_windows(scene):
    short = scene[1].beginnings(4, 0.3)
    assert len(short.windows) == 4
    for w in short.windows:
        time = w.recording.time
        assert 0.28 < time[w.last] - time[w.first] <= 0.3 + 1e-9
    gap = short.residual([{}])[0]
    whole = scene[1].residual([{}])[0]
    index = [
        scene[1].windows.index(w)
        for w in scene[1].windows
        if w.first in [s.first for s in short.windows if s.recording is w.recording]
    ]
    np.testing.assert_allclose(gap, whole[index][:, : gap.shape[1]], atol=1e-12)


def test_beginnings_simulate_an_effect_once_for_all_starts(scene, monkeypatch):
    world, chain, _ = scene
    late = {world.candidate("sensor_delay", "pivot"): (0.01,)}
    nominal, first = chain.beginnings(4, 0.3).residual([{}, late])
    chain.start(chain.trajectory)
    short, asked = chain.beginnings(4, 0.3), []
    monkeypatch.setattr(short.whole, "residual", asked.append)
    np.testing.assert_array_equal(short.residual([late])[0] - nominal, first - nominal)
    assert not asked


DISC = """
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body>
<joint name="shaft" type="hinge" axis="0 0 1" armature="0.0024" damping="0.003"/>
<inertial pos="0 0 0" mass="1" diaginertia="0.001 0.001 0.0019"/></body></worldbody>
<actuator><motor name="drive" joint="shaft"/></actuator></mujoco>"""


def two_discs(name, seed, stiffness, damping, step=2e-4, every=25):
    """A Recording of a disc that turns another one by a spring, at 200 Hz for 6 s."""
    rng, rows = np.random.default_rng(seed), 1200
    tones, phases = rng.uniform(0.2, 4.0, 9), rng.uniform(0, 2 * np.pi, 9)
    time = np.arange(rows) * step * every
    torque = 0.05 * np.sin(2 * np.pi * tones * time[:, None] + phases).sum(1)
    angle, (q, v, p, w) = np.empty(rows), np.zeros(4)
    for row in range(rows):
        angle[row], torque[row] = q, torque[row] - 0.03 * q
        for _ in range(every):
            spring = stiffness * (q - p) + damping * (v - w)
            v += step * (torque[row] - spring - 0.003 * v) / 0.0024
            w += step * spring / 0.0019
            q, p = q + step * v, p + step * w
    qpos = (angle + 4e-4 * rng.normal(size=rows))[:, None]
    return Recording(name, time, qpos, np.full_like(qpos, np.nan), torque[:, None])


def test_a_tone_between_two_that_are_tried_is_moved_to():
    """The nearest tone tried is 11 % too fast: of no use a second ahead, and an elastic joint alone
    was never judged."""
    stiffness = 0.5424
    world = World(mujoco.MjSpec.from_string(DISC))
    runs = [two_discs(f"{k}.csv", k, stiffness, 0.0014) for k in (0, 1)]
    smoother = Smoother(world, runs)
    chain = Chain(world, cut_ahead(runs), np.array([4e-4]))
    chain.start(smoother.locate({}))
    usual = Usual(world, runs, smoother.scale)
    every = Starts(world, {}, usual).of([world.candidate("joint_elasticity", "shaft")])
    columns = Columns(chain, {}, likely(MissingForce(chain, {}), every))
    off = lambda: min(abs((o.base + o.directions[0])[0] / stiffness - 1) for o in columns.options)
    assert off() > 0.2
    columns.nearer(None, every)
    best = columns.options[int(np.argmin(columns._alone(columns.options, None)))]
    assert abs((best.base + best.directions[0])[0] / stiffness - 1) < 0.1
