"""The smoother over blocks against the same problem as one dense Gaussian."""

import numpy as np
import pytest
from scipy.linalg import block_diag

from diagnosis.estimation.kalman import smooth

T, B, N, M = 6, 2, 3, 2


def covariances(rng):
    """(T, B, N, N): two components share noise, the last has its own."""
    factor = 0.3 * rng.normal(size=(T, B, N, N)) + 0.4 * np.eye(N)
    factor[..., -1, :-1] = factor[..., :-1, -1] = 0.0
    return factor @ np.swapaxes(factor, -1, -2)


@pytest.fixture
def problem():
    rng = np.random.default_rng(0)
    y = rng.normal(size=(T, B, M))
    y[1, 0, 0] = y[3, 0] = y[T - 1, 1] = np.nan
    return {
        "A": np.eye(N) + 0.3 * rng.normal(size=(T, B, N, N)),
        "c": rng.normal(size=(T, B, N)),
        "Q": covariances(rng),
        "y": y,
        "R": rng.uniform(0.1, 0.5, M),
        "start": rng.normal(size=(B, N)),
        "spread": rng.uniform(0.5, 2.0, (B, N)),
    }


def dense(A, c, Q, y, R, start, spread, block):
    """Mean (T, N), variance (T, N) and log-likelihood of one block, all rows conditioned at
    once."""
    drive = np.concatenate([start[block], c[:-1, block].ravel()])
    noise = block_diag(np.diag(spread[block]), *Q[:-1, block])
    paths = np.eye(T * N)  # of every disturbance, the states that follow
    for t in range(1, T):
        here, before = slice(t * N, (t + 1) * N), slice((t - 1) * N, t * N)
        paths[here] += A[t - 1, block] @ paths[before]
    mean, covariance = paths @ drive, paths @ noise @ paths.T
    seen = np.flatnonzero(np.isfinite(y[:, block]).ravel())
    pick = np.eye(T * N)[np.array([t * N + i for t in range(T) for i in range(M)])[seen]]
    error = y[:, block].ravel()[seen] - pick @ mean
    F = pick @ covariance @ pick.T + np.diag(np.tile(R, T)[seen])
    gain = covariance @ pick.T @ np.linalg.inv(F)
    likelihood = -0.5 * (np.linalg.slogdet(F)[1] + error @ np.linalg.solve(F, error))
    variance = np.diag(covariance - gain @ pick @ covariance)
    return (mean + gain @ error).reshape(T, N), variance.reshape(T, N), likelihood


def test_it_is_the_conditional_mean_and_variance_of_the_dense_problem(problem):
    found = smooth(**problem)
    for block in range(B):
        mean, variance, _ = dense(**problem, block=block)
        np.testing.assert_allclose(found.state[:, block], mean, atol=1e-9)
        np.testing.assert_allclose(found.variance[:, block], variance, atol=1e-9)


def test_scores_of_the_variances_are_derivatives_of_the_likelihood(problem):
    found, small = smooth(**problem), 1e-5

    def slope(name, i):
        def moved(sign):
            values = problem[name].copy()
            values[(..., i, i) if name == "Q" else (..., i)] *= np.exp(sign * small)
            return sum(dense(**{**problem, name: values}, block=b)[2] for b in range(B))

        return (moved(1) - moved(-1)) / (2 * small)

    own = N - 1  # of the process, the one whose noise is its own
    score = (found.process[0][own] - found.process[1][own]) / 2
    assert score == pytest.approx(slope("Q", own), abs=1e-6)
    for i in range(M):
        # what was measured weighs the squares with R's square, what is expected alike
        score = problem["R"][i] * (found.measurement[0][i] - found.measurement[1][i]) / 2
        assert score == pytest.approx(slope("R", i), abs=1e-6)


def test_what_two_readings_share_may_be_far_larger_than_what_they_do_not():
    """A motion that runs away where nothing is read moves both by as much: their covariance is
    singular but for rounding."""
    A = np.broadcast_to([[1.0, 0.0], [1.0, 0.0]], (2, 1, 2, 2))
    y = np.array([[[np.nan, np.nan]], [[3.0, 3.0]]])
    none, small = np.zeros((2, 1, 2)), np.tile(1e-6 * np.eye(2), (2, 1, 1, 1))
    found = smooth(A, none, small, y, np.full(2, 1e-6), np.zeros((1, 2)), np.full((1, 2), 1e20))
    assert found.state[1, 0] == pytest.approx([3.0, 3.0], abs=1e-3)
    assert np.isfinite(found.variance).all()
