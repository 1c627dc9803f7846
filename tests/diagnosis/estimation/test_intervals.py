"""Coverage of intervals under noise that is common to groups, for many parameters and for one."""

import mujoco
import numpy as np
import pytest
from interval_coverage import trial
from plants import DRIVEN_PENDULUM, recorded
from synthetic import clustered, evidence_of, free, scene

from diagnosis.estimation.ahead import Ahead, cut_ahead
from diagnosis.estimation.intervals import half_widths, intervals, one_number
from diagnosis.estimation.smoother import Smoother
from diagnosis.selection.judge import Judge
from diagnosis.selection.plausibility import Usual
from diagnosis.simulation.simulator import World


def fitted(ahead, residual, columns):
    """(values, half widths): columns' amounts refitted until nothing moves, as a judge does."""
    every = np.arange(columns.shape[-1])
    values = np.zeros(len(every))
    for _ in range(4):
        evidence = evidence_of(ahead, residual - columns @ values, columns)
        values = values + free(evidence, every).amounts
    half, moves = half_widths(evidence_of(ahead, residual - columns @ values, columns), every)
    return values + moves, half


@pytest.mark.parametrize("number, bands", [(6, 1), (16, 3)])
@pytest.mark.parametrize("kind", ["common", "walk"])
def test_half_widths_cover_whatever_groups_have_in_common(number, bands, kind):
    """Noise that windows of a group share, and noise that is summed up along windows."""
    rng, inside = np.random.default_rng(0), []
    for _ in range(60):
        ahead = scene(groups=number, windows=3, rows=12, bands=bands)
        if kind == "common":
            columns, noise = clustered(rng, ahead, (3,), share=0.3), clustered(rng, ahead)
        else:
            columns = np.cumsum(rng.normal(size=(*ahead.known.shape, 3)), 1)
            noise = np.cumsum(np.cumsum(rng.normal(size=ahead.known.shape), 1), 1)
        truth = rng.normal(size=3)
        values, half = fitted(ahead, columns @ truth + noise, columns)
        inside.append(abs(values - truth) < half)
    assert 0.90 <= np.mean(inside) <= 0.99


def test_noise_without_groups_gives_the_textbooks_interval():
    rng, ahead = np.random.default_rng(1), scene(groups=40, windows=2, rows=30)
    columns = rng.normal(size=(*ahead.known.shape, 2))
    residual = rng.normal(size=ahead.known.shape)
    _, half = fitted(ahead, residual, columns)
    assert half == pytest.approx(1.96 / np.sqrt(residual.size), rel=0.3)


def test_intervals_hold_the_truth_of_a_world_with_finer_steps():
    """Where they missed it while the step was taken for the world's: of 95 % one in ten may."""
    rows = [row for seed in (13, 19, 34, 35, 36) for row in trial(seed, 4)]
    assert sum(row["inside"] for row in rows) >= len(rows) - 1 and len(rows) >= 9
    width = [(float(r["high"]) - float(r["low"])) / float(r["truth"]) for r in rows]
    assert np.median(width) < 0.05


def test_intervals_are_those_of_their_own_effects_in_whatever_order_a_set_was_found():
    """Columns of a finer step come last, wherever a set has it."""
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.4)))
    run = recorded("run.csv", 0, push=lambda t, q, v: -0.05 * np.tanh(v / 0.01))
    smoother = Smoother(world, [run])
    ahead = Ahead(world, cut_ahead([run]), smoother.position_noise)
    ahead.start(smoother.locate({}))
    begun = {"time_step": "world", "mass": "arm", "coulomb_friction": "pivot"}
    values = dict(zip(begun, ((0.00125,), (0.5,), (0.05,))))
    found = []
    for order in (begun, reversed(begun)):
        setting = {world.candidate(name, begun[name]): values[name] for name in order}
        fitted = Judge(ahead, Usual(world, [run], smoother.scale)).fit(setting, steps=0)
        found.append({c.effect.name: bounds[0] for c, bounds in intervals(fitted).items()})
    assert found[0].keys() == found[1].keys()
    for name, bounds in found[0].items():
        assert bounds == pytest.approx(found[1][name], rel=1e-6), name


def test_what_others_do_as_well_has_no_interval():
    rng, ahead = np.random.default_rng(2), scene()
    column = clustered(rng, ahead, (1,))
    three = np.concatenate([column, 2 * column, clustered(rng, ahead, (1,))], -1)
    half, _ = half_widths(evidence_of(ahead, clustered(rng, ahead), three), np.arange(3))
    assert np.isinf(half[:2]).all() and np.isfinite(half[2])


@pytest.mark.parametrize("number", [5, 16])
def test_one_number_covers_and_its_p_values_are_even(number):
    rng, inside, low = np.random.default_rng(3), [], []
    label = np.repeat(np.arange(number), 30)
    for _ in range(400):
        x = rng.normal(size=len(label)) + rng.normal(size=number)[label]
        noise = rng.normal(size=len(label)) + rng.normal(size=number)[label]
        total = lambda z: np.bincount(label, z)
        value, half, _ = one_number(total(x**2), total(x * (0.7 * x + noise)))
        inside.append(abs(value - 0.7) < half)
        low.append(one_number(total(x**2), total(x * noise))[2] < 0.05)
    assert 0.92 < np.mean(inside) < 0.985 and 0.015 < np.mean(low) < 0.08
    assert one_number(np.ones(2), np.ones(2))[2] == 1.0
