"""A recorded control on its way to the actuator: held between rows, delayed, filtered."""

from dataclasses import dataclass

import numpy as np

SLACK = 1e-3  # of a time step: a row this near to a step's edge is taken to lie on it


@dataclass(frozen=True)
class Signal:
    """value[i] (T,) is held from time[i] to time[i+1] and seen `delay` seconds later, through a first-order `lag`.

    Before the recording began its first control was held, and the lag at rest in it.
    """

    time: np.ndarray
    value: np.ndarray
    delay: float = 0.0
    lag: float = 0.0

    def sample(self, start, step, count, average):
        """What the actuator sees in each of `count` steps of `step` seconds from time `start`, (count,).

        A row that changes inside a step counts by its share of it, so the result is
        continuous in the delay, and what MuJoCo's linear interpolation gives. With a
        lag: the filter's value at the end of the step (MuJoCo's actearly), or its mean
        over the step if `average` (a Runge-Kutta step sees the filter move).
        """
        edges = start - self.delay + step * np.arange(count + 1)
        first, last = self._row(edges[:-1] + SLACK * step), self._row(edges[1:] - SLACK * step)
        held = self.value[first]
        if (first != last).any() or self.lag:
            mean = np.diff(self.integral(edges)) / step
            held = np.where(first == last, held, mean)
        if not self.lag:
            return held
        act = self.filtered(edges)
        return held - self.lag / step * np.diff(act) if average else act[1:]

    def _row(self, t):
        """The row that holds at times t; row 0 also before the recording."""
        return np.maximum(np.searchsorted(self.time, t, side="right") - 1, 0)

    def integral(self, t):
        """Of the undelayed, unfiltered control, from the first row to times t."""
        area = np.concatenate([[0.0], np.cumsum(self.value[:-1] * np.diff(self.time))])
        i = self._row(t)
        return area[i] + self.value[i] * (t - self.time[i])

    def filtered(self, t):
        """The lag's output at times t of the undelayed control, exactly."""
        # act[i+1] = decay[i] act[i] + (1 - decay[i]) value[i], as a scan that doubles its reach
        decay = np.concatenate([[0.0], np.exp(-np.diff(self.time) / self.lag)])
        act, reach = np.concatenate([self.value[:1], self.value[:-1] * (1 - decay[1:])]), 1
        while reach < len(act) and decay.max() > 1e-18:
            act[reach:] += decay[reach:] * act[:-reach]
            decay[reach:] = decay[reach:] * decay[:-reach]
            decay[:reach] = 0.0
            reach *= 2
        i = self._row(t)
        return self.value[i] + (act[i] - self.value[i]) * np.exp(
            -np.maximum(t - self.time[i], 0.0) / self.lag
        )
