"""Least squares between bounds, many at once.

x = bounded(matrices, vectors, low, high)
"""

import numpy as np


def bounded(matrices, vectors, low, high):
    """The minima (..., p) of x' matrix x / 2 - vector x between bounds (..., p), of matrices
    (..., p, p) and vectors (..., p), by active sets of the bounds that are met."""
    scale = np.sqrt(np.maximum(np.einsum("...ii->...i", matrices), 1e-300))
    eye, goal, (low, high) = np.eye(low.shape[-1]), vectors / scale, (low * scale, high * scale)
    even = matrices / (scale[..., None] * scale[..., None, :]) + 1e-9 * eye
    x, fixed = np.clip(np.zeros_like(goal), low, high), np.zeros(goal.shape, bool)
    for _ in range(4 * len(eye) + 1):
        free = ~fixed
        inside = np.where(free[..., None] & free[..., None, :], even, eye)
        push = np.where(free, goal - (even @ (x * fixed)[..., None])[..., 0], x)
        step = np.linalg.solve(inside, push[..., None])[..., 0] - x
        room = np.where(step > 0, high, low) - x
        room = np.divide(room, step, out=np.full_like(x, np.inf), where=step != 0)
        share = np.minimum(room.min(-1, initial=np.inf), 1.0)[..., None]
        x = np.clip(x + share * step, low, high)
        met = free & (share < 1) & (room <= share)
        # where nothing is met, the bound that holds back most is left
        slope = (even @ x[..., None])[..., 0] - goal
        inward = np.where(x - low < high - x, -slope, slope) * (fixed & (low < high) & (share == 1))
        most = inward.max(-1, initial=0.0, keepdims=True)
        size = abs(goal).max(-1, initial=0.0, keepdims=True)
        left = (inward == most) & (most > 1e-9 * size)
        fixed = (fixed | met) & ~left
        if not (met | left).any():
            break
    return x / scale
