"""Least squares between bounds, against scipy's."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from diagnosis.common.quadratic import bounded


@given(st.integers(0, 10**6), st.integers(1, 5))
@settings(max_examples=100, deadline=None)
def test_bounded_least_squares_are_scipys(seed, size):
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(2, 12, size)), rng.normal(size=(2, 12))
    low = -rng.uniform(0, 0.3, (2, size))
    high = rng.uniform(0, 0.3, (2, size))
    xt = np.swapaxes(x, 1, 2)
    found = bounded(xt @ x, (xt @ y[..., None])[..., 0], low, high)
    for k in range(2):
        expected = lsq_linear(x[k], y[k], (low[k], high[k]), method="bvls", tol=1e-12).x
        np.testing.assert_allclose(found[k], expected, atol=1e-6)
