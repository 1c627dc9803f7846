"""Many small systems of equations at once, by Broyden's method (1965, doi:10.2307/2003941).

x = nearest(missed, x, missed(x), slope, size, rounds)
"""

import numpy as np


def nearest(missed, x, off, slope, size, rounds):
    """Of all x (n, k) that are tried, of each of n systems the one at which least is missed.

    missed(x): (n, k), what each system misses; x: where to begin; off: missed(x) there;
    slope (n, k, k): minus its derivative; size (n, k): weights of what is missed; rounds: trials
    beside the first.
    """
    inverse = np.linalg.pinv(slope)
    far = lambda off: np.nan_to_num(np.linalg.norm(off * size, axis=1), nan=np.inf)
    best, least = x, far(off)
    for _ in range(rounds):
        moved = np.nan_to_num((inverse @ off[..., None])[..., 0])
        x, before = x + moved, off
        off = missed(x)
        now = far(off)
        best, least = np.where((now < least)[:, None], x, best), np.minimum(now, least)
        told = (inverse @ (before - off)[..., None])[..., 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            along = (moved[:, None] @ inverse) / (moved * told).sum(1)[:, None, None]
            more = (moved - told)[..., None] * along
        inverse = inverse + np.where(np.isfinite(more), more, 0.0)
    return best
