"""Excitations to choose from: shapes (T,) within -1..1 of several families, and mixtures of
them."""

import numpy as np

FREQUENCIES = 0.1, 3.0  # Hz
RAMP = 0.4  # s in which an excitation comes and goes
AMPLITUDES = 0.1, 1.0  # of what the limits allow


def drawn(rng: np.random.Generator, time: np.ndarray, low, high, middle) -> np.ndarray:
    """(T, nu) controls between low and high (nu,), starting and ending at `middle` (nu,)."""
    ramp = np.clip(np.minimum(time - time[0], time[-1] - time) / RAMP, 0, 1)
    shapes = np.column_stack([_shape(rng, time) for _ in middle])
    size = np.exp(rng.uniform(*np.log(AMPLITUDES), len(middle)))
    room = np.where(shapes > 0, high - middle, middle - low)
    return middle + ramp[:, None] * shapes * size * room


def changed(rng: np.random.Generator, one, other, fresh, low, high) -> np.ndarray:
    """(T, nu) controls made of two good ones and a fresh one."""
    share = rng.uniform(0, 1, 2)
    share[1] *= 0.5
    mixed = share[0] * one + (1 - share[0]) * other
    mixed = (1 - share[1]) * mixed + share[1] * fresh
    middle = one[0]
    return np.clip(middle + rng.uniform(0.8, 1.4) * (mixed - middle), low, high)


def _shape(rng, time):
    """One shape of a family drawn at random, or two of them."""
    shapes = [rng.choice([_sines, _sweep, _triangle, _steps])(rng, time) for _ in range(2)]
    return shapes[0] if rng.uniform() < 0.5 else 0.5 * (shapes[0] + shapes[1])


def _sines(rng, time):
    frequencies = np.exp(rng.uniform(*np.log(FREQUENCIES), 4))
    phases = rng.uniform(0, 2 * np.pi, 4)
    waves = np.sin(2 * np.pi * time[:, None] * frequencies + phases).sum(axis=1)
    return waves / np.abs(waves).max()


def _sweep(rng, time):
    begin, end = np.exp(rng.uniform(*np.log(FREQUENCIES), 2))
    share = (time - time[0]) / (time[-1] - time[0])
    turns = (time[-1] - time[0]) * begin * _grown(share, np.log(end / begin))
    return np.sin(2 * np.pi * turns)


def _grown(share, rate):
    """The integral of exp(rate · share)."""
    return share if abs(rate) < 1e-6 else np.expm1(rate * share) / rate


def _triangle(rng, time):
    """Slow reversals: of equal speed one way and the other."""
    period = rng.uniform(1.5, 8.0)
    phase = (time / period + rng.uniform()) % 1
    return 4 * np.abs(phase - 0.5) - 1


def _steps(rng, time):
    hold = rng.uniform(0.3, 1.5)
    levels = rng.uniform(-1, 1, int((time[-1] - time[0]) / hold) + 2)
    return levels[((time - time[0]) / hold).astype(int)]
