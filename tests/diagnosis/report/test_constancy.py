"""Constancy of a value between recordings, against frequencies in drawn data and scipy's own."""

import numpy as np
import pytest
from arm import arm, run
from scipy import stats

from diagnosis.recordings.recording import Recording
from diagnosis.report.constancy import (
    between,
    between_runs,
    constancy,
    goes_along,
    pooled,
    table,
    words,
)

ERRORS = np.array([0.01, 0.02, 0.015, 0.01, 0.03, 0.02])


def drawn(scatter=0.0, trials=2000, seed=0):
    """(trials, 6) values around 0.2 with ERRORS and a scatter of their own."""
    rng = np.random.default_rng(seed)
    return 0.2 + rng.normal(size=(trials, 6)) * np.hypot(ERRORS, scatter)


def test_p_is_uniform_for_one_value():
    p = [constancy(values, ERRORS) for values in drawn()]
    assert stats.kstest(p, "uniform").pvalue > 0.01


def test_equal_errors_are_a_variance_test():
    values = drawn()[0]
    q = np.var(values) * len(values) / 0.02**2
    expected = stats.chi2.sf(q, 5)
    np.testing.assert_allclose(constancy(values, np.full(6, 0.02)), expected)


def test_different_values_are_seen_and_their_scatter_is_found():
    values = drawn(scatter=0.06)
    assert np.mean([constancy(x, ERRORS) < 0.05 for x in values]) > 0.95
    squares = np.mean([between(x, ERRORS) ** 2 for x in values])
    assert abs(np.sqrt(squares) - 0.06) < 0.01
    assert between([0.2, 0.2, 0.2], [0.1, 0.1, 0.1]) == 0


def test_the_pooled_interval_covers():
    for scatter in (0.0, 0.06):
        inside = []
        for values in drawn(scatter):
            mean, error = pooled(values, ERRORS)
            inside.append(abs(mean - 0.2) < 1.96 * error)
        assert 0.86 < np.mean(inside) < 0.98


def test_recordings_that_do_not_show_it_are_left_out():
    values, errors = [0.2, np.nan, 0.21, 0.5], [0.01, 0.01, 0.01, np.nan]
    assert constancy(values, errors) == constancy([0.2, 0.21], [0.01, 0.01])
    assert constancy([0.2, np.nan], [0.01, 0.01]) == constancy([], []) == 1
    assert np.isnan(pooled([np.nan], [np.nan])).all()


def test_the_variable_that_it_goes_along_with():
    rng, wrong, found = np.random.default_rng(0), 0, 0
    for _ in range(300):
        variables = {name: rng.normal(size=8) for name in ("order", "speed", "load")}
        errors = np.full(8, 0.01)
        alone = 0.2 + rng.normal(size=8) * 0.01
        wrong += goes_along(alone, errors, variables) is not None
        along = goes_along(alone + 0.1 * variables["load"], errors, variables)
        found += along is not None and along[0] == "load" and abs(along[1] - 0.1) < 0.03
    assert wrong < 0.09 * 300 and found > 0.95 * 300
    assert goes_along([1, 2, 3], [0.1] * 3, {"order": np.arange(3)}) is None  # too few to say


def test_a_table_and_its_words():
    order = {"the order of the recordings": np.arange(6.0)}
    rows = table(
        {
            "coulomb_friction at elbow": (0.2 + np.array([1, -1, 1, -1, 1, -1]) * 0.005, ERRORS),
            "gain at drive": (1 - 0.05 * np.arange(6), np.full(6, 0.01)),
            "armature at elbow": ([np.nan] * 5 + [0.3], ERRORS),
        },
        [f"run{k}.csv" for k in range(6)],
        order,
    )
    assert [row.p > 0.05 for row in rows] == [True, False, True]
    assert words(rows[0]).startswith("coulomb_friction at elbow: 0.2 ± ")
    assert "all 6 recordings" in words(rows[0])
    assert "falls with the order of the recordings" in words(rows[1])
    assert rows[1].along[1] == pytest.approx(-0.05, rel=0.05)
    assert "1 of 6 recordings" in words(rows[2])


def test_what_differs_between_runs():
    tables = [run(seconds=2.0, amplitude=a) for a in (0.5, 1.0)]
    runs = [Recording("r", t[:, 0], t[:, 1:3], t[:, 3:5], t[:, 5:7]) for t in tables]
    variables = between_runs(runs, arm())
    assert {"speed of elbow", "mean position of shoulder", "control of elbow_motor"} < set(
        variables
    )
    control = variables["control of elbow_motor"]
    np.testing.assert_allclose(control[1], 2 * control[0])
    for k, t in enumerate(tables):  # measured velocities: an account of their own
        true = np.sqrt(np.mean(t[:, 3] ** 2))
        assert abs(variables["speed of shoulder"][k] / true - 1) < 0.15
