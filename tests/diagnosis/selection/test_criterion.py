"""The criterion: false alarms on pure noise, known improvements, ties, bounds."""

import mujoco
import numpy as np
import pytest
from plants import DRIVEN_PENDULUM
from scipy.stats import ttest_rel
from synthetic import clustered, evidence_of, free, scene

from diagnosis.selection.criterion import (
    INDEPENDENT,
    ITERATIONS,
    Score,
    complexity,
    paired,
)
from diagnosis.simulation.simulator import World


def scored(groups, cells=0):
    """A Score of groups (G,) of so many cells."""
    return Score(groups.mean(), groups, groups * cells, ())


def test_p_values_of_pure_noise_are_even():
    rng, p = np.random.default_rng(0), []
    for _ in range(1000):
        p.append(paired(*map(scored, rng.normal(size=(2, 16)))).p_value)
    for level in (0.01, 0.05, 0.5):
        spread = np.sqrt(level * (1 - level) / 1000)
        assert np.mean(np.array(p) < level) == pytest.approx(level, abs=3 * spread)


def test_paired_is_students_on_differences():
    before, after = np.array([3.0, 4.0, 5.0, 7.0]), np.array([2.0, 3.5, 4.0, 5.0])
    found = paired(scored(before), scored(after))
    assert found.gain == pytest.approx((before - after).mean())
    assert found.p_value == pytest.approx(ttest_rel(before, after, alternative="greater").pvalue)
    assert paired(scored(before), scored(before)).p_value == 1.0


def test_a_few_groups_decide_together_but_none_alone():
    before, cells = np.zeros(15), 3
    few, one = np.zeros(15), np.zeros(15)
    few[[0, 5, 10]], one[5] = -1.5, -4.5
    likely = np.exp(-INDEPENDENT * 9)
    assert paired(scored(before, cells), scored(few, cells)).p_value == pytest.approx(likely)
    assert paired(scored(before, cells), scored(one, cells)).p_value > 0.1


@pytest.mark.filterwarnings("error")
def test_values_that_are_impossible_are_no_improvement():
    assert paired(scored(np.ones(4), 3), scored(np.full(4, np.inf), 3)).p_value == 1.0


def alone(rng, ahead, amount):
    """Comparison of none with one column that is in the residual by an amount, in noises."""
    column, residual = clustered(rng, ahead, (1,)), clustered(rng, ahead)
    evidence = evidence_of(ahead, residual + amount * column[..., 0], column)
    return paired(free(evidence, ()), free(evidence, (0,))), free(evidence, (0,)).amounts[0]


def test_columns_of_noise_are_no_improvement():
    rng, ahead = np.random.default_rng(1), scene(bands=2)
    found = [alone(rng, ahead, 0.0)[0] for _ in range(300)]
    # what is predicted with the other groups' amounts gets worse by a column that says nothing
    assert np.mean([f.gain for f in found]) < 0
    assert np.mean([f.p_value < 0.05 for f in found]) < 0.05 + 2 * np.sqrt(0.05 * 0.95 / 300)


def shaped(rng, rank, ahead):
    """Errors (W, rows, channels) of few shapes that all windows share, of very different sizes."""
    shapes = rng.normal(size=(rank, *ahead.known.shape[1:])).cumsum(1).cumsum(1)
    shapes /= np.sqrt((shapes**2).mean(1, keepdims=True))
    size = np.exp(0.7 * rng.normal(size=(len(ahead.group), 1)))
    return np.einsum("wk,ktc->wtc", size * rng.normal(size=(len(size), rank)), shapes)


@pytest.mark.parametrize("rank, windows", [(1, 1), (4, 1), (30, 1), (1, 2)])
def test_errors_of_many_joints_that_one_thing_pushes_are_few(rank, windows):
    """Ten joints in three bands err alike: a column that happens to fit meets one error, not 30."""
    rng, p = np.random.default_rng(5), []
    ahead = scene(windows=windows, channels=10, bands=3)
    for _ in range(200):
        residual, column = shaped(rng, rank, ahead), shaped(rng, rank, ahead)
        evidence = evidence_of(ahead, residual, column[..., None])
        p.append(paired(free(evidence, ()), free(evidence, (0,))).p_value)
    assert np.mean(np.array(p) < 0.01) < 0.06 and np.mean(np.array(p) < 1e-3) < 0.02


def test_errors_of_every_shape_are_as_many_as_cells_hold():
    ahead = scene(windows=1, channels=10, bands=3)
    residual = np.random.default_rng(6).normal(size=ahead.known.shape)
    evidence = evidence_of(ahead, residual, np.zeros((*residual.shape, 0)))
    assert free(evidence, ()).independent == INDEPENDENT
    evidence = evidence_of(ahead, 1e-3 * residual, np.zeros((*residual.shape, 0)))
    assert free(evidence, ()).independent == INDEPENDENT  # within the noise


def test_columns_that_say_the_same_are_one():
    rng, ahead = np.random.default_rng(7), scene(windows=1, rows=60)
    column, other = rng.normal(size=(2, *ahead.known.shape))
    different = lambda *each: evidence_of(ahead, column, np.stack(each, -1)).different()
    assert different(column) == pytest.approx(1.0)
    assert different(column, -3 * column, column, 0 * column) == pytest.approx(1.0, abs=1e-3)
    assert different(column, other) == pytest.approx(2.0, abs=0.1)
    assert 1.1 < different(column, column + 0.5 * other) < 1.9


def test_a_known_improvement_is_found_at_its_size():
    rng, ahead = np.random.default_rng(2), scene(channels=2, bands=2)
    for _ in range(20):
        comparison, amount = alone(rng, ahead, 1.0)
        assert comparison.p_value < 1e-3 and comparison.gain > 0.3
        assert amount == pytest.approx(1.0, abs=0.5)


def test_the_loss_is_the_mean_log_error_of_groups_left_out():
    """Against a plain loop, above the error of the reference."""
    rng, ahead = np.random.default_rng(3), scene(groups=5, windows=1, noise=1e-9)
    column, residual = rng.normal(size=(*ahead.known.shape, 1)), rng.normal(size=ahead.known.shape)
    residual = residual + 2.0 * column[..., 0]
    score = free(evidence_of(ahead, residual, column), (0,))
    for g in range(5):
        weight = np.array(
            [1 / np.mean((residual[k] - 2.0 * column[k, ..., 0]) ** 2) for k in range(5)]
        )
        rest = [k for k in range(5) if k != g]
        top = sum(weight[k] * (column[k, ..., 0] * residual[k]).sum() for k in rest)
        value = top / sum(weight[k] * (column[k] ** 2).sum() for k in rest)
        square = np.mean((residual[g] - value * column[g, ..., 0]) ** 2)
        before = np.mean(residual[g] ** 2)
        assert score.groups[g] == pytest.approx(0.5 * np.log(square / before), abs=0.005)
    assert score.loss == pytest.approx(score.groups.mean())


def test_what_is_within_the_noise_decides_nothing():
    rng, ahead = np.random.default_rng(6), scene(noise=1.0)
    column = rng.normal(size=(*ahead.known.shape, 1))
    evidence = evidence_of(ahead, 0.9 * column[..., 0], column)
    assert evidence.squares((0,), np.ones(1)).max() < 0.02
    assert abs(free(evidence, (0,)).loss) < 1e-9


def test_what_shows_in_few_groups_is_worth_as_much_and_breaking_others_costs():
    """Of sixteen groups four err, by ten noises; a column mends them, or mends them and shakes the
    others."""
    rng, ahead = np.random.default_rng(7), scene(noise=1.0)
    noise = rng.normal(size=ahead.known.shape)
    column = rng.normal(size=(*ahead.known.shape, 1))
    few = np.isin(ahead.group, (1, 3, 8, 11))[:, None, None]
    mends, shakes = column * few[..., None], column
    evidence = evidence_of(ahead, noise + 10 * mends[..., 0], mends)
    good = free(evidence, (0,))
    assert -good.loss == pytest.approx(np.log(10), abs=0.2)
    assert paired(free(evidence, ()), good).p_value < 1e-3
    both = evidence_of(ahead, noise + 10 * mends[..., 0], shakes)
    assert both.at((0,), np.array([10.0])).loss > 1.0


def test_effects_that_do_the_same_tie():
    rng, ahead = np.random.default_rng(4), scene()
    column, noise = clustered(rng, ahead, (1,)), clustered(rng, ahead)
    twins = np.concatenate([column, -3.0 * column], -1)
    evidence = evidence_of(ahead, noise + column[..., 0], twins)
    one, other, both = (free(evidence, c) for c in ((0,), (1,), (0, 1)))
    assert one.loss == pytest.approx(other.loss, abs=1e-6)
    assert other.amounts[0] == pytest.approx(-one.amounts[0] / 3, rel=1e-5)
    assert both.loss == pytest.approx(one.loss, abs=1e-3)
    assert paired(one, both).p_value > 0.01


def begun(rng, windows=48, rows=20):
    """Of two components of a start state: where it is, and where it goes to, (W, rows, 1, 2)."""
    one = np.stack([np.ones(rows), np.arange(rows) / 10], -1)[None, :, None]
    return one * rng.uniform(0.5, 2.0, (windows, 1, 1, 2))


def without_starts(ahead, error, given):
    """(residual, columns) less what start states follow of them, by penalised least squares of
    each window alone, its rows weighted as INDEPENDENT errors of mean squares error (G, 1)."""
    residual, columns = given
    out = [np.array(residual), np.array(columns)]
    for w, S in enumerate(ahead.freedom()):
        m, root = S.shape[-1], np.sqrt(INDEPENDENT / len(S) / error[ahead.group[w]])
        design = np.concatenate([root * S[:, 0], np.eye(m)])
        for each in out:
            flat = each[w].reshape(len(S), -1)
            target = np.concatenate([root * flat, np.zeros((m, flat.shape[1]))])
            moved = np.linalg.lstsq(design, target, rcond=None)[0]
            each[w] -= (S[:, 0] @ moved).reshape(each[w].shape)
    return out


def test_start_states_are_free_within_what_is_known_of_them():
    """Windows begin beside the motion by up to three deviations; a column explains the rest."""
    rng = np.random.default_rng(8)
    S = 0.3 * begun(rng)  # five noises
    ahead = scene(noise=0.1, begun=S)
    moved = rng.normal(size=(48, 1, 1, 2))
    column = rng.normal(size=(*ahead.known.shape, 1))
    noise = 0.1 * rng.normal(size=ahead.known.shape)
    residual = noise + (S * moved).sum(-1) + column[..., 0]
    score = free(evidence_of(ahead, residual, column), (0,))
    assert score.amounts[0] == pytest.approx(1.0, abs=0.02)
    evidence = evidence_of(ahead, residual, column)
    assert np.sqrt(evidence.squares((0,), np.ones(1)).mean()) == pytest.approx(0.1, abs=0.02)
    left = given = noise + (S * moved).sum(-1)
    for _ in range(ITERATIONS):  # rows count by the error that the pass before left
        own = np.array([[np.mean(left[ahead.group == g] ** 2)] for g in range(16)])
        left, _ = without_starts(ahead, own + evidence.floor, (given, column))
    own = np.array([np.mean(left[ahead.group == g] ** 2) for g in range(16)])
    np.testing.assert_allclose(evidence.squares((0,), np.ones(1))[:, 0], own, rtol=1e-6)
    certain = evidence_of(scene(noise=0.1), residual, column).squares((0,), np.ones(1))
    assert np.sqrt(certain.mean()) > 0.3  # where starts are certain, their error stays


def test_start_states_do_not_follow_what_is_far_beyond_what_is_known_of_them():
    """An error of thirty deviations is no matter of the start."""
    rng = np.random.default_rng(9)
    S = 0.01 * begun(rng)
    ahead = scene(noise=1e-3, begun=S)
    residual = 30 * S.sum(-1)
    square = evidence_of(ahead, residual, np.zeros((*residual.shape, 0))).reference
    assert np.sqrt(square.mean() / np.mean(residual**2)) > 0.3


def nothing_bounds(p):
    """Bounds far away and a prior of no weight, of p columns, as score() takes them."""
    return np.full(p, -99.0), np.full(p, 99.0), np.zeros(p), np.zeros(p)


@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("share", [1.0, 0.8])
def test_a_first_look_is_the_gain_of_least_squares(moves, share):
    """Also where the amounts are not those of least squares."""
    rng = np.random.default_rng(5)
    ahead = scene(channels=1 if moves else 2, begun=begun(rng) if moves else None)
    columns, residual = clustered(rng, ahead, (4,)), clustered(rng, ahead)
    columns[..., 3] = 2 * columns[..., 1] + 1e-7 * columns[..., 0]  # tells nothing more
    evidence = evidence_of(ahead, residual, columns)
    amounts, far = share * free(evidence, (1,)).amounts, np.full(4, 99.0)
    [gains] = evidence.looks(((1,), *nothing_bounds(1)), amounts, -far, far)
    weight = evidence.weighed(evidence.squares((1,), amounts))
    rows = np.sqrt(weight[ahead.group])[:, None, :] * np.ones(ahead.known.shape)
    if moves:
        every = np.array([0.0, amounts[0], 0.0, 0.0])
        error = evidence.squares(range(4), every) + evidence.floor
        residual, columns = without_starts(ahead, error, (residual, columns))
    y, x = (rows * residual).ravel(), (rows[..., None] * columns).reshape(-1, 4)
    left = lambda keep: np.sum(
        (y - x[:, keep] @ np.linalg.lstsq(x[:, keep], y, rcond=None)[0]) ** 2
    )
    for k in (0, 2):
        assert gains[k] == pytest.approx((left([1]) - left([1, k])) / 2, rel=0.05, abs=1e-3)
    assert abs(gains[3]) < 1e-3


def test_a_first_look_leaves_amounts_at_their_bounds_where_they_are():
    rng, ahead = np.random.default_rng(6), scene()
    columns = clustered(rng, ahead, (2,))
    columns[..., 1] += columns[..., 0]
    evidence = evidence_of(ahead, columns @ [1.0, 1.0] + 0.01 * clustered(rng, ahead), columns)
    far, low, high, *prior = np.full(2, 9.0), *nothing_bounds(1)
    look = lambda high: evidence.looks(((0,), low, high, *prior), np.ones(1), -far, far)[0, 1]
    assert look(high) > 0 and look(np.ones(1)) > 0
    assert look(np.ones(1)) != pytest.approx(look(high), rel=0.01)


def test_a_first_look_promises_no_more_than_amounts_within_their_bounds():
    rng, ahead = np.random.default_rng(6), scene()
    columns = clustered(rng, ahead, (2,))
    evidence = evidence_of(ahead, columns @ [1.0, 0.0] + 0.01 * clustered(rng, ahead), columns)
    bounds = lambda low, high: np.array([[low] * 2, [high] * 2])
    look = lambda low, high: evidence.looks(((), *nothing_bounds(0)), [], *bounds(low, high))[0, 0]
    most = look(-9.0, 9.0)
    assert look(0.3, 3.0) == most and look(-9.0, 0.5) == pytest.approx(0.75 * most, rel=0.01)
    assert look(-9.0, 0.0) == 0 > look(3.0, 9.0)


def test_hypotheses_scored_together_are_those_scored_alone():
    rng, ahead = np.random.default_rng(0), scene()
    columns = rng.normal(size=(*ahead.known.shape, 5))
    residual = columns @ np.array([3.0, 0, -2, 0, 0]) * 1e-2 + rng.normal(size=ahead.known.shape)
    evidence = evidence_of(ahead, residual, columns)
    given = []
    for index in ((0,), (2,), (), (0, 2), (1, 3), (4,), (0, 2, 4)):
        p = len(index)
        low, high = -rng.uniform(0, 0.05, p), rng.uniform(0, 0.05, p)
        given.append((index, low, high, rng.uniform(0, 9, p), rng.normal(size=p)))
    for score, one in zip(evidence.scores(given), given):
        alone = evidence.score(*one)
        assert score.loss == pytest.approx(alone.loss, rel=1e-9)
        np.testing.assert_allclose(score.groups, alone.groups, rtol=1e-9)
        np.testing.assert_allclose(score.amounts, alone.amounts, atol=1e-9)


def test_what_is_farther_from_the_first_things_to_think_of_and_freer_is_more_complex():
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.0, mass=0.5)))
    of = lambda *names: complexity(c for c in world.candidates if c.effect.name in names)
    curve = world.curve("pivot", "position:pivot", np.linspace(-1, 1, 9))
    assert of("coulomb_friction") == of("viscous_damping") == 1
    assert of("coulomb_friction", "viscous_damping") == 2
    assert of("gain") < of("armature") < of("dead_zone") < of("stribeck_friction")
    assert of("stribeck_friction") < complexity([curve])
    assert complexity([curve]) == 9
    wave = world.curve("pivot", "position:pivot", (0.0, 0.1), None, True)
    assert complexity([wave]) > of("cogging")  # which it would be, had it a name
    assert of("time_step") == 0  # no physics


def test_a_fit_is_the_best_of_several_minima():
    """Three groups in which the nominal model happens to be right hold a fit that begins at its
    errors: of the sum of logs that is a minimum, not the least."""
    rng, ahead = np.random.default_rng(0), scene()
    column = clustered(rng, ahead, share=0.0)
    right = (np.arange(16) < 3)[ahead.group][:, None, None]
    left = np.where(right, 0.05, 0.3) * clustered(rng, ahead, share=0.0)
    residual = np.where(right, 0.0, column) + left
    evidence = evidence_of(ahead, residual, column[..., None])
    square = lambda x: ((residual - x * column) ** 2).reshape(16, -1).mean(1)
    tried = np.linspace(-0.5, 1.5, 401)
    least = tried[np.argmin([np.log(square(x)).sum() for x in tried])]
    assert least == pytest.approx(1.0, abs=0.05)
    assert free(evidence, (0,)).amounts == pytest.approx([least], abs=0.01)


def test_each_channel_has_its_part_of_the_loss():
    """Of two channels, one with an error of ten noises, which a column removes."""
    rng, ahead = np.random.default_rng(4), scene(channels=2, bands=2, noise=0.1)
    noise = 0.1 * clustered(rng, ahead, share=0.0)
    column = clustered(rng, ahead, share=0.0) * np.array([1.0, 0.0])
    evidence = evidence_of(ahead, column + noise, column[..., None])
    square = evidence.squares((0,), np.ones(1))
    first, second = evidence.each_channel(square)
    assert first.loss + second.loss == pytest.approx(evidence.at((0,), np.ones(1)).loss)
    assert first.loss < -2 and abs(second.loss) < 1e-9
    assert paired(evidence.each_channel(evidence.square)[0], first).p_value < 1e-3


def test_a_prior_weighs_as_much_beside_joints_that_lack_nothing():
    rng, numbers = np.random.default_rng(0), []
    for channels in (1, 4):
        ahead = scene(channels=channels, noise=1.0)
        residual = rng.normal(size=ahead.known.shape)
        residual[..., 0] *= 20
        evidence = evidence_of(ahead, residual, np.zeros((*residual.shape, 0)))
        prior = evidence.at((), np.zeros(0)).plus(1.0, evidence.number)
        numbers.append(prior.loss)
    assert numbers[1] == pytest.approx(numbers[0], rel=0.01)
    assert numbers[0] == pytest.approx(1 / 16, rel=0.05)  # a cell in each of sixteen groups
