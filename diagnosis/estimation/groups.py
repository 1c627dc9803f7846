"""One number fitted to groups of neighbouring windows or rows: its value, interval and p-value.

line = fitted(gram, score)          # sums of slope² and slope · residual over each group
line.value, line.half, line.p_value

The sandwich between groups with Bell and McCaffrey's correction (CR2) and Satterthwaite's degrees
of freedom, as in intervals.py, for one parameter in closed form.
"""

from typing import NamedTuple

import numpy as np

from diagnosis.common.distributions import t_ppf, t_sf
from diagnosis.estimation.ahead import GROUPS

FEWEST = 4  # groups, below which their spread says nothing


class Line(NamedTuple):
    """value that removes most; half: half width of its 95 % interval; p_value: that it is 0."""

    value: float
    half: float
    p_value: float


def neighbours(number):
    """Group (number,) of each of so many windows or rows in their order."""
    return np.arange(number) * min(GROUPS, number) // max(number, 1)


def summed(group, x):
    """Sums over each group: (n, ...) -> (G, ...)."""
    out = np.zeros((group.max() + 1, *x.shape[1:]))
    np.add.at(out, group, x)
    return out


def fitted(gram, score):
    """The Line through groups' sums gram (G,), score (G,).

    p_value 1 and no width where too few groups see anything.
    """
    seen = gram > 0
    gram, score = gram[seen], score[seen]
    if len(gram) < FEWEST:
        return Line(0.0, np.inf, 1.0)
    total = gram.sum()
    share, value = gram / total, score.sum() / total
    left = (score - gram * value) / np.sqrt(np.clip(1 - share, 0.05, 1.0))
    error = np.sqrt((left**2).sum()) / total
    freedom = max(1 / (share**2).sum() - 1, 1.0)
    chance = 2 * t_sf(abs(value) / max(error, 1e-300), freedom)
    return Line(float(value), float(t_ppf(0.975, freedom) * error), float(chance))
