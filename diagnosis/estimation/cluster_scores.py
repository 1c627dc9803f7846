"""Is a gain real? Statistics of projected columns that respect correlated residuals.

Everything works on a shooting.Normal: per window the score s = C'r and Gram matrix G = C'C of the projected columns C.
Residuals inside a window, and in neighbouring windows, are correlated; so windows are gathered into clusters and the
variance of the score is measured between clusters (sandwich), never taken from chi-square.
"""

import math

import numpy as np

from diagnosis.estimation import windows as cut

LITTLE = 0.05  # of a column's size, seen outside a cluster, below which its value there counts as not known

ALONE = 0.3  # of a column's size, in one cluster
MANY = 12  # recordings, from which on each is a cluster


def f_survival(f, a, b):
    """P(F > f) of the F distribution with a and b degrees of freedom."""
    if not f > 0:
        return 1.0
    if not np.isfinite(f):
        return 0.0
    return _beta_tail(b / (b + a * f), b / 2, a / 2)


def _beta_tail(x, a, b):
    """Regularised incomplete beta function I_x(a, b) by its continued fraction (Lentz)."""
    if x <= 0 or x >= 1:
        return float(x >= 1)
    if x > (a + 1) / (a + b + 2):
        return 1 - _beta_tail(1 - x, b, a)
    front = (
        math.exp(
            math.lgamma(a + b)
            - math.lgamma(a)
            - math.lgamma(b)
            + a * math.log(x)
            + b * math.log1p(-x)
        )
        / a
    )
    tiny, c, d, out = 1e-300, 1.0, 0.0, 1.0
    for i in range(400):
        m = i // 2
        if i == 0:
            term = 1.0
        elif i % 2 == 0:
            term = m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m))
        else:
            term = -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1))
        d = 1 / (1 + term * d if abs(1 + term * d) > tiny else tiny)
        c = 1 + term / c if abs(1 + term / c) > tiny else tiny
        out *= c * d
        if abs(c * d - 1) < 1e-12:
            break
    return front * (out - 1)


def t_quantile(degrees, level=0.975):
    """Quantile of Student's t with (possibly few) degrees of freedom, by bisection on the F tail."""
    low, high = 0.0, 1e4
    for _ in range(80):
        middle = (low + high) / 2
        if f_survival(middle**2, 1, degrees) / 2 > 1 - level:
            low = middle
        else:
            high = middle
    return (low + high) / 2


def clusters(windows, most=30):
    """Cluster label of every window: its recording where recordings are many, else a stretch of neighbouring windows."""
    recordings = cut.recordings_of(windows)
    owner = np.array([recordings.index(w.recording) for w in windows])
    if len(recordings) >= MANY:
        return owner
    labels, at = np.zeros(len(windows), int), 0
    for i in range(len(recordings)):
        mine = np.flatnonzero(owner == i)
        mine = mine[np.argsort([windows[j].first for j in mine], kind="stable")]
        pieces = min(len(mine), max(2, round(most * len(mine) / len(windows))))
        labels[mine] = at + np.arange(len(mine)) * pieces // len(mine)
        at = labels.max() + 1
    return labels


def summed(labels, x):
    """Sum over the windows of every cluster: (W, ...) -> (clusters, ...)."""
    out = np.zeros((labels.max() + 1,) + x.shape[1:])
    np.add.at(out, labels, x)
    return out


def solve_small(gram, score):
    """gram^-1 score for small, possibly singular and badly scaled Gram matrices: (..., k, k), (..., k) -> (..., k)."""
    size = np.sqrt(np.maximum(np.einsum("...kk->...k", gram), 1e-300))
    block = gram / size[..., None, :] / size[..., None] + 1e-8 * np.eye(size.shape[-1])
    return np.linalg.solve(block, (score / size)[..., None])[..., 0] / size


def elsewhere(total, gram, score):
    """Values (..., k) that all but a part say: Gram matrix of all (k, k) and of the part (..., k, k), score (..., k) of the
    others. Zero where the others see hardly anything."""
    return solve_small(total - gram + LITTLE * np.diag(np.diag(total)), score)


def sandwich(gram, score, value):
    """Covariance (k, k) of values estimated from clusters: gram (C, k, k), score (C, k), at the values (k,).

    Small-sample factor C / (C - 1) on top of leave-one-out residual scores (CR3), which errs on the safe side.
    """
    total = gram.sum(0)
    rest = score - gram @ value
    # leave-one-out change of the estimate: (total - gram_c)^-1 rest_c
    moves = solve_small(total - gram + 1e-6 * total, rest)
    count = len(gram)
    return (count - 1) / count * moves.T @ moves


def wald(gram, score):
    """Estimate (k,), gain in chi2, p-value of "all zero" and the gain each left-out cluster sees, from cluster sums."""
    value = solve_small(gram.sum(0), score.sum(0))
    gain = float(score.sum(0) @ value)
    k, count = len(value), len(gram)
    if count <= k + 1:
        return value, gain, 1.0, np.zeros(count)
    covariance = sandwich(gram, score, value)
    size = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    whitened = np.linalg.solve(covariance / size / size[:, None] + 1e-6 * np.eye(k), value / size)
    statistic = float(value / size @ whitened) / k * (count - k) / (count - 1)
    unseen = elsewhere(gram.sum(0), gram, score.sum(0) - score)
    held = 2 * (score * unseen).sum(1) - np.einsum("ck,ckl,cl->c", unseen, gram, unseen)
    return value, gain, f_survival(statistic, k, count - k), held


def wald_but_one(gram, score):
    """wald, without the cluster that outweighs all others where that contradicts them: a derivative there is not to be trusted."""
    whole, total = wald(gram, score), np.maximum(np.einsum("ckk->k", gram), 1e-300)
    shares = np.einsum("ckk->ck", gram) / total
    loudest = int(np.argmax(shares.max(1)))
    if (
        len(gram) < 8 or shares[loudest].max() < ALONE or shares[loudest].max() > 1 - 1e-6
    ):  # it alone sees the effect
        return whole
    rest = wald(np.delete(gram, loudest, 0), np.delete(score, loudest, 0))
    return rest if rest[1] > whole[1] else whole
