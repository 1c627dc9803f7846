"""A Kalman smoother over many blocks of rows at once, with the scores of its variances.

Per block: x' = A x + c + noise of variance Q, y = x[:m] + noise of variance R; see Durbin and
Koopman,
Time Series Analysis by State Space Methods, sections 4.4 and 7.3 (disturbance smoother).
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Smoothed:
    """state (T, blocks, n), variance (T, blocks, n) of each component, and for the variances'
    updates:

    process, measurement: pairs (sum of squares, what that would be at the likelihood's optimum),
    (n,) or (m,). likelihood: log-likelihood summed over blocks.
    """

    state: np.ndarray
    variance: np.ndarray
    process: tuple
    measurement: tuple
    likelihood: float


def smooth(A, c, Q, y, R, start, spread, counts=None):
    """Smooth all blocks.

    A (T, b, n, n), c (T, b, n): from row t to t + 1; Q (T, b, n): variances of its noise. y (T, b,
    m): the first m components as measured, NaN where not; R (m,). start (b, n), spread (b, n): mean
    and variances before the first row. The last row's A, c and Q are not used. counts (T, b): the
    rows that tell R's scores, by default all.
    """
    T, b, n = c.shape
    m = y.shape[-1]
    known = np.isfinite(y)
    filtered = _forward(A, c, Q, np.where(known, y, 0.0), known, R, start, spread)
    predicted, covariance, gain, inverse, error, likelihood = filtered
    r, N = np.zeros((b, n)), np.zeros((b, n, n))
    state, variance = np.empty((T, b, n)), np.empty((T, b, n))
    process, measurement = np.zeros((2, n)), np.zeros((2, m))
    for t in range(T - 1, -1, -1):
        if t < T - 1:
            process[0] += (Q[t] * r**2).sum(0)
            process[1] += (Q[t] * np.einsum("bii->bi", N)).sum(0)
            At = A[t].transpose(0, 2, 1)
            r = (At @ r[..., None])[..., 0]
            N = At @ N @ A[t]
        K, Finv, k = gain[t], inverse[t], known[t]
        Kt = K.transpose(0, 2, 1)
        u = ((Finv @ error[t][..., None]) - Kt @ r[..., None])[..., 0]
        D = np.einsum("bii->bi", Finv) + (Kt @ N * Kt).sum(-1)
        told = k if counts is None else k & counts[t][:, None]
        measurement[0] += (u**2 * told).sum(0)
        measurement[1] += (D * told).sum(0)
        # r before the measurement: H' F^-1 v + (I - K H)' r
        keep = np.tile(np.eye(n), (b, 1, 1))
        keep[:, :, :m] -= K
        r = (keep.transpose(0, 2, 1) @ r[..., None])[..., 0]
        r[:, :m] += (Finv @ error[t][..., None])[..., 0]
        N = keep.transpose(0, 2, 1) @ N @ keep
        N[:, :m, :m] += Finv
        P = covariance[t]
        state[t] = predicted[t] + (P @ r[..., None])[..., 0]
        variance[t] = np.einsum("bii->bi", P) - (P @ N * P).sum(-1)
    return Smoothed(
        state, np.maximum(variance, 0.0), tuple(process), tuple(measurement), float(likelihood)
    )


def _forward(A, c, Q, y, known, R, start, spread):
    """Predicted states and covariances, gains (T, b, n, m), F^-1 (T, b, m, m) with 0 for what is
    not measured, errors."""
    T, b, n = c.shape
    m = y.shape[-1]
    x, P = start.copy(), np.einsum("bi,ij->bij", spread, np.eye(n))
    xs, Ps = np.empty((T, b, n)), np.empty((T, b, n, n))
    gains, inverses, errors = np.zeros((T, b, n, m)), np.empty((T, b, m, m)), np.empty((T, b, m))
    likelihood, eye = 0.0, np.eye(m)
    for t in range(T):
        xs[t], Ps[t], k = x, P, known[t]
        pair = k[:, :, None] & k[:, None]
        F = np.where(pair, P[:, :m, :m] + R * eye, eye)
        inverse = np.linalg.inv(F)
        error = np.where(k, y[t] - x[:, :m], 0.0)
        squares = error * (inverse @ error[..., None])[..., 0]
        likelihood -= 0.5 * (np.linalg.slogdet(F)[1].sum() + squares.sum())
        inverse = inverse * pair
        K = P[:, :, :m] @ inverse
        gains[t], inverses[t], errors[t] = K, inverse, error
        x = x + (K @ error[..., None])[..., 0]
        P = P - K @ P[:, :m]
        if t < T - 1:
            x = (A[t] @ x[..., None])[..., 0] + c[t]
            P = A[t] @ P @ A[t].transpose(0, 2, 1)
            P[:, range(n), range(n)] += Q[t]
            P = (P + P.transpose(0, 2, 1)) / 2
    return xs, Ps, gains, inverses, errors, likelihood
