"""A Kalman smoother over many blocks of rows at once, with the scores of its variances.

Per block: x' = A x + c + noise of variance Q, y = x[:m] + noise of variance R; see Durbin and
Koopman, Time Series Analysis by State Space Methods, sections 4.4 and 7.3 (disturbance smoother).
"""

from dataclasses import dataclass

import numpy as np

ROUNDING = 1e-12  # share added to variances: noise far smaller than these would be rounded away


@dataclass(frozen=True)
class Smoothed:
    """state (T, blocks, n), variance (T, blocks, n) of each component; for the variances' updates
    process (of what shares no noise with others), measurement: pairs (sum of squares, what that
    would be at the likelihood's optimum), (n,) or (m,).
    """

    state: np.ndarray
    variance: np.ndarray
    process: tuple
    measurement: tuple


def smooth(A, c, Q, y, R, start, spread):
    """Smooth all blocks.

    A (T, b, n, n), c (T, b, n): from row t to t + 1; Q (T, b, n, n): covariance of its noise. y (T,
    b, m): the first m components as measured, NaN where not; R (m,). start (b, n), spread (b, n):
    mean and variances before the first row. The last row's A, c and Q are not used.
    """
    m = y.shape[-1]
    known = np.isfinite(y)
    filtered = _forward(A, c, Q, np.where(known, y, 0.0), known, R, start, spread)
    predicted, P, K, Finv, error = filtered
    keep = np.broadcast_to(np.eye(c.shape[-1]), P.shape).copy()
    keep[..., :m] -= K
    pushed = _times(Finv, error)
    r, behind, N, within, D = _backward(A, keep, pushed, P, K, Finv)
    state = predicted + _times(P, r)
    variance = np.einsum("tbii->tbi", P) - within
    own = np.einsum("tbii->tbi", Q[:-1])
    process = (own * r[1:] ** 2).sum((0, 1)), (own * N[1:]).sum((0, 1))
    u = pushed - _times(np.swapaxes(K, -1, -2), behind)
    measurement = (u**2 * known).sum((0, 1)), (D * known).sum((0, 1))
    return Smoothed(state, np.maximum(variance, 0.0), process, measurement)


def _backward(A, keep, pushed, P, K, Finv):
    """Of every row, with its own measurement and without: r (T, b, n), A' r of the row behind; and
    the diagonals (T, b, n) of N and P N P, and (T, b, m) of F^-1 + K' A' N A K."""
    T, b, n = keep.shape[:-1]
    m = pushed.shape[-1]
    r, behind, diagonal, within = (np.zeros((T, b, n)) for _ in range(4))
    D = np.einsum("tbii->tbi", Finv).copy()
    r[..., :m], N = pushed, np.zeros((b, n, n))
    for t in range(T - 1, -1, -1):
        if t < T - 1:
            At, kept, Kt = (x[t].transpose(0, 2, 1) for x in (A, keep, K))
            behind[t] = _times(At, r[t + 1])
            N = At @ N @ A[t]
            r[t] += _times(kept, behind[t])
            D[t] += (Kt @ N * Kt).sum(-1)
            N = kept @ N @ keep[t]
        N[:, :m, :m] += Finv[t]
        diagonal[t] = np.einsum("bii->bi", N)
        within[t] = (P[t] @ N * P[t]).sum(-1)
    return r, behind, diagonal, within, D


def _times(matrices, vectors):
    return (matrices @ vectors[..., None])[..., 0]


def _forward(A, c, Q, y, known, R, start, spread):
    """Predicted states and covariances, gains (T, b, n, m), F^-1 (T, b, m, m) with 0 for what is
    not measured, and errors."""
    T, b, n = c.shape
    m = y.shape[-1]
    x, P = start, np.einsum("bi,ij->bij", spread, np.eye(n))
    xs, Ps, gains = np.empty((T, b, n)), np.empty((T, b, n, n)), np.empty((T, b, n, m))
    errors, inverses = np.empty((T, b, m)), np.empty((T, b, m, m))
    pair, noise = known[..., None] & known[..., None, :], np.diag(R)
    for t in range(T):
        xs[t], Ps[t] = x, P
        F = np.where(pair[t], P[:, :m, :m] + noise, np.eye(m))
        F[:, range(m), range(m)] *= 1 + ROUNDING
        inverses[t] = np.linalg.inv(F)
        errors[t] = (y[t] - x[:, :m]) * known[t]
        gains[t] = P[:, :, :m] @ (inverses[t] * pair[t])
        x = _times(A[t], x + _times(gains[t], errors[t])) + c[t]
        P = A[t] @ (P - gains[t] @ P[:, :m]) @ A[t].transpose(0, 2, 1) + Q[t]
        P = (P + np.swapaxes(P, -1, -2)) / 2
    return xs, Ps, gains, inverses * pair, errors
