"""95 % intervals that allow for dependence within groups, for few groups, and for the time step.

bounds = intervals(fitted)          # {candidate: [(low, high) or None, ...]}
value, half, p = one_number(gram, score)      # of one parameter, in closed form

The sandwich between groups with Bell and McCaffrey's correction (CR2) and Satterthwaite's degrees
of freedom; Bell and McCaffrey, Survey Methodology 28 (2002); Pustejovsky and Tipton, Journal of
Business and Economic Statistics 36 (2018).
"""

import numpy as np

from diagnosis.common.distributions import t_ppf, t_sf

SHARED = 0.01  # of a direction that is not seen, the part beyond which a value is not told
FLAT = 0.2  # of the squares' curvature, the least that the loss's is taken for
ENDLESS = 2.0  # times what half the step changes: steps that are ever smaller
UNSEEN = 1e-8  # share of a column's information that the others leave, below which it is not seen
FEWEST = 4  # groups, below which their spread says nothing


def intervals(fitted):
    """{candidate: [(low, high), ...]} of a Fitted set; None for a parameter that the recordings do
    not show."""
    out = {c: [None] * len(values) for c, values in fitted.setting.items()}
    rows = [(o, row) for o in fitted.columns.options for row in o.directions]
    index = [i for o in fitted.columns.options for i in o.columns]
    for (option, row), at, wide in zip(rows, *without_step(fitted, index)):
        k = int(np.flatnonzero(row)[0])
        value, prior = fitted.setting[option.candidate][k], option.prior
        ends = value + row[k] * np.array([at - wide, at + wide, 0])
        if np.isfinite(ends).all():
            bounds = float(max(min(ends), prior.low[k])), float(min(max(ends), prior.high[k]))
            out[option.candidate][k] = bounds
    return out


def without_step(fitted, index):
    """Middles and half widths (p,) of the amounts of columns index (p,), the time step being free.

    What half the step changes is one more column, of which a world without steps holds twice the
    amount; where the recordings do not tell it from the others, it may be anything up to that.
    """
    columns, p = fitted.columns, len(index)
    if not p:
        return np.zeros(0), np.zeros(0)
    half, moves = half_widths(fitted.evidence, index)
    change = columns.residual - columns.ahead.residual([fitted.setting], refine=2)[0]
    change = np.where(columns.lost, 0.0, change)
    stack = np.concatenate([columns.array[..., index], change[..., None]], -1)
    kind = type(fitted.evidence)  # of a layer above this one
    evidence = kind(columns.ahead, columns.residual, stack)
    every = np.arange(p + 1)
    wide, amounts = half_widths(evidence, every)
    products, weight = weighted(evidence, every)
    whole = products.weighed(weight).sum(0)[1:, 1:]
    scale = np.sqrt(np.maximum(np.diag(whole), 1e-300))
    even = whole / np.outer(scale, scale)
    inside = even[:p, :p] + UNSEEN * np.eye(p)
    each = -np.linalg.solve(inside, even[:p, p]) * scale[p] / scale[:p]
    most = half + ENDLESS / 2 * abs(each)  # the step can do no more than that, told or not
    told = np.isfinite(wide[:p]) & (wide[:p] <= most)
    amount = np.clip(amounts[p], 0.0, ENDLESS) if np.isfinite(wide[p]) else 0.0
    return moves + np.where(told, amount, ENDLESS / 2) * each, np.where(told, wide[:p], most)


def half_widths(evidence, index):
    """Half widths and remaining Gauss-Newton moves (p,) of columns index (p,), amounts zero."""
    products, weight = weighted(evidence, index)
    each = products.weighed(weight)
    scale = np.sqrt(np.maximum(np.diag(each.sum(0))[1:], 1e-300))
    gram, score = each[:, 1:, 1:] / np.outer(scale, scale), each[:, 1:, 0] / scale
    whole = gram.sum(0)
    values, vectors = np.linalg.eigh(whole)
    values, vectors = values[values > UNSEEN], vectors[:, values > UNSEEN]
    inverse, root, back, within = ((vectors * values**a) @ vectors.T for a in (-1, -0.5, 0.5, 0))
    unseen = 1 - np.diag(within) > SHARED
    moves = inverse @ score.sum(0)
    left = score - gram @ moves
    e, u = np.linalg.eigh(root @ gram @ root)
    factor = (u / np.sqrt(np.clip(1 - e, 0.05, 1.0))[:, None]) @ np.swapaxes(u, 1, 2)
    corrected = (back @ factor @ root @ left[..., None])[..., 0]
    meat = corrected.T @ corrected
    shares = np.einsum("ij,gjk,ki->gi", inverse, gram, inverse)
    shares /= np.maximum(np.diag(inverse), 1e-300)
    curvature = _curvature(products.slopes(), weight, root / scale[:, None])
    bread = root @ np.linalg.inv(curvature) @ root.T
    covariance = bread @ meat @ bread
    freedom = np.maximum(1 / np.maximum((shares**2).sum(0), 1e-9) - 1, 1.0)
    half = t_ppf(0.975, freedom) * np.sqrt(np.maximum(np.diag(covariance), 0.0))
    half[unseen] = np.inf
    return half / scale, moves / scale


def weighted(evidence, index):
    """(Products of an Evidence's residual and columns index (p,), start states free; weights (G,
    cells) at which least squares lowers the loss), amounts zero."""
    none = np.zeros(len(index))
    products = evidence.freed(index, none)
    return products, evidence.weighed(evidence.square_of(products, none))


def _curvature(slopes, weight, root):
    """The loss's curvature (p, p) over that of weighted least squares, in whitened columns, of
    products (G, cells, p) of the residual with columns.

    The log of a cell's square bends less than the square itself, for a cell that errs much counts
    less: 1/2 log s has the second derivative X'X / ns - 2 X'r r'X / (ns)^2.
    """
    score = slopes @ root
    less = np.einsum("gc,gci,gcj->ij", 2 * weight**2, score, score)
    values, vectors = np.linalg.eigh(np.eye(len(root)) - less)
    return (vectors * np.clip(values, FLAT, None)) @ vectors.T


def one_number(gram, score):
    """(value that removes most, half width of its 95 % interval, p-value that it is 0) of groups'
    sums of slope² gram (G,) and slope · residual score (G,); endless, 1 where too few see any."""
    gram, score = gram[gram > 0], score[gram > 0]
    if len(gram) < FEWEST:
        return 0.0, np.inf, 1.0
    total = gram.sum()
    share, value = gram / total, score.sum() / total
    left = (score - gram * value) / np.sqrt(np.clip(1 - share, 0.05, 1.0))
    error = np.sqrt((left**2).sum()) / total
    freedom = max(1 / (share**2).sum() - 1, 1.0)
    chance = 2 * t_sf(abs(value) / max(error, 1e-300), freedom)
    return float(value), float(t_ppf(0.975, freedom) * error), float(chance)
