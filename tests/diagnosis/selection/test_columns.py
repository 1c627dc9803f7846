"""Columns against differences of stock simulations, and what is offered at all."""

import copy
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from plants import DRIVEN_PENDULUM, NOISE, recorded

from diagnosis.estimation.ahead import Ahead, cut_ahead
from diagnosis.estimation.smoother import Smoother
from diagnosis.selection.columns import Columns
from diagnosis.selection.criterion import Evidence
from diagnosis.selection.plausibility import Usual, plausible
from diagnosis.selection.starts import Start, Starts
from diagnosis.simulation.simulator import World


@pytest.fixture(scope="module")
def scene():
    """(World, Ahead, Usual) of two runs of the pendulum with a friction that its model lacks."""
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    runs = [recorded(f"{k}.csv", k, push=lambda t, q, v: -0.05 * np.tanh(v / 0.01)) for k in (0, 1)]
    smoother = Smoother(world, runs)
    trajectory = smoother.locate({}, passes=2)
    ahead = Ahead(world, cut_ahead(runs), smoother.position_noise)
    ahead.start(trajectory)
    return world, ahead, Usual(world, runs, smoother.scale)


def columns_of(scene, candidates):
    """The Columns of all starts of candidates."""
    world, ahead, usual = scene
    return Columns(ahead, {}, Starts(world, {}, usual).of(candidates))


def stock(ahead, window, damping=0.05, mass=0.5):
    """qpos (T,) of one window in stock MuJoCo."""
    model = mujoco.MjModel.from_xml_string(DRIVEN_PENDULUM.format(damping=damping, mass=mass))
    data, w = mujoco.MjData(model), ahead.windows[window]
    data.qpos[:], data.qvel[:] = ahead.qpos[window], ahead.qvel[window]
    out = [data.qpos[0]]
    for row in range(w.first, w.last):
        data.ctrl[:] = w.recording.ctrl[row]
        mujoco.mj_step(model, data, 2)
        out.append(data.qpos[0])
    return np.array(out)


def test_a_column_is_what_the_prediction_gains_by_a_step_of_the_value(scene):
    world, ahead, usual = scene
    candidates = [world.candidate("viscous_damping", "pivot"), world.candidate("mass", "arm")]
    columns = columns_of(scene, candidates)
    for name, moved in (("viscous_damping", "damping"), ("mass", "mass")):
        options = [o for o in columns.options if o.candidate.effect.name == name]
        option = min(options, key=lambda o: abs(o.directions).max())
        step = option.directions[0, 0]
        for window in (0, 9):
            ends = [stock(ahead, window, **{moved: option.base[0] + x}) for x in (step, 0.0)]
            own = columns.array[window, : len(ends[0]), 0, option.columns[0]]
            usable = ~columns.lost[window, : len(own), 0]
            expected = (ends[0] - ends[1])[usable]
            np.testing.assert_allclose(own[usable], expected, atol=1e-7)


def test_nothing_outside_its_bounds_is_offered(scene):
    world, ahead, usual = scene
    candidates = [
        c for c in world.candidates if c.place.kind in ("joint", "actuator") and not c.effect.timed
    ]
    columns = columns_of(scene, candidates)
    evidence = Evidence(ahead, columns.residual, columns.array)
    columns.secants(evidence)
    assert len(columns.options) > 15
    for option in columns.options:
        prior, zero = plausible(option.candidate, usual), np.zeros(len(option.columns))
        for amounts in (option.low, option.high, np.clip(zero + 1.0, option.low, option.high)):
            finite = np.where(np.isfinite(amounts), amounts, 1e6 * np.sign(amounts))
            values = np.array(option.values(finite))
            assert (values >= prior.low - 1e-9).all() and (values <= prior.high + 1e-9).all()


def test_effects_that_show_nowhere_are_left_out(scene):
    world, ahead, usual = scene
    candidates = [world.candidate("ground_height", g) for g in ()]
    gravity = world.candidate("gravity", "world")
    columns = columns_of(scene, candidates + [gravity])
    sideways = [o for o in columns.options if (o.directions[:, 1] != 0).any()]
    assert not sideways  # the pendulum turns about y


def test_a_column_at_full_size_tells_friction_that_a_small_step_does_not(scene):
    world, ahead, usual = scene
    friction = world.candidate("coulomb_friction", "pivot")
    columns = columns_of(scene, [friction])
    losses = {}
    evidence = Evidence(ahead, columns.residual, columns.array)
    for option in columns.options:
        score = evidence.score(option.columns, option.low, option.high, *option.quadratic())
        losses[option.values(score.amounts)[0]] = score.loss
    best = min(losses, key=losses.get)
    assert best == pytest.approx(0.05, rel=0.3)
    assert losses[best] < evidence.score((), *[np.zeros(0)] * 4).loss - 0.5
    assert NOISE > 0


def test_amplitudes_are_begun_at_forces_that_the_machine_has(scene):
    world, ahead, usual = scene
    for name in ("friction_map", "stribeck_friction", "presliding"):
        candidate = world.candidate(name, "pivot")
        prior = plausible(candidate, usual)
        for option in columns_of(scene, [candidate]).options:
            begun = option.base[0] + option.directions[0, 0]
            assert begun == pytest.approx(0.1 * prior.scale[0]), name


@pytest.mark.parametrize("runs_away_to", [np.nan, np.inf, 1e60])
def test_what_runs_away_in_some_windows_leaves_all_columns_finite(scene, monkeypatch, runs_away_to):
    world, ahead, usual = scene
    damping, mass = world.candidate("viscous_damping", "pivot"), world.candidate("mass", "arm")
    predicted = ahead.residual

    def residual(settings):
        out = predicted(settings)
        out[[mass in setting for setting in settings], :3] = runs_away_to
        return out

    monkeypatch.setattr(ahead, "residual", residual)
    monkeypatch.setattr(ahead, "travel", np.full(1, np.inf))  # as of a Chain without contact
    columns = columns_of(scene, [damping, mass])
    assert {o.candidate for o in columns.options} == {damping, mass}
    assert np.isfinite(columns.array).all()


def test_a_step_that_would_leave_its_bounds_goes_the_other_way(scene):
    world, _, usual = scene
    step = world.candidate("time_step", "world")
    for h in (step.nominal[0], 0.3 * step.nominal[0], 0.25 * step.nominal[0]):
        [start] = Starts(world, {step: (h,)}, usual).of([step])
        prior = plausible(step, usual)
        assert prior.inside(start.base + start.directions[0]) and start.directions[0, 0] != 0


def test_a_limit_that_the_model_lacks_is_begun_at_whole_values_alone(scene):
    """No share of the way to it means anything, so no column is asked for anew."""
    world, ahead, usual = scene
    limits = [world.candidate(name, "drive") for name in ("saturation", "rate_limit")]
    gain = world.candidate("gain", "drive")
    columns = columns_of(scene, [*limits, gain])
    begun = columns.simulated
    count = lambda c: sum(o.candidate is c for o in columns.options)
    before = {c: count(c) for c in (*limits, gain)}
    columns.secants(Evidence(ahead, columns.residual, columns.array))
    assert all(before[c] and count(c) == before[c] for c in limits)
    assert count(gain) > before[gain] and columns.simulated - begun == count(gain) - before[gain]


def test_hidden_states_begin_as_the_setting_alone_has_them(scene):
    """For columns beside it; those of its own effects follow each."""
    world, ahead, usual = scene
    friction, damping = (
        world.candidate(e, "pivot") for e in ("coulomb_friction", "viscous_damping")
    )
    asked, other, setting = [], copy.copy(ahead), {friction: (0.05,)}
    other.rough = lambda settings, begun=None: (
        asked.extend((len(s), begun) for s in settings) or ahead.rough(settings, begun)
    )
    Columns(other, setting, Starts(world, setting, usual).of([friction, damping]))
    assert {begun is setting for number, begun in asked if number == 2} == {True}
    assert {begun for number, begun in asked if number == 1} == {None}


def test_what_columns_of_one_effect_tell_apart_is_finite_where_they_tell_nothing():
    start = Start(None, np.zeros(2), np.eye(2), np.zeros(2), np.ones(2), None)
    option = SimpleNamespace(columns=(0, 1), start=start, directions=start.directions)
    rows = np.random.default_rng(0).normal(size=(3, 5, 1))
    turned = lambda *parts: Columns._turned(
        SimpleNamespace(parts=parts, ahead=SimpleNamespace(known_noise=np.ones(1))), option
    )
    assert turned(0 * rows, 0 * rows) is None  # as those of simulations that are all lost
    assert turned(rows, rows[::-1]) is None
    _, ways, along = turned(rows, 0 * rows)
    assert np.isfinite(ways).all() and np.isfinite(along.directions).all()
    assert abs(np.linalg.det(ways)) > 0
