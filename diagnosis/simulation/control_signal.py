"""A recorded control on its way to the actuator: held between rows, delayed, filtered."""

from dataclasses import dataclass, replace

import numpy as np

from diagnosis.effects.base import end_of_step

SLACK = 1e-3  # of a time step: a row this near to a step's edge is taken to lie on it


@dataclass(frozen=True)
class Signal:
    """value[i] (T,) is held from time[i] to time[i+1] and seen `delay` seconds later, through a
    first-order `lag`.

    Before the recording began its first control was held, and the lag at rest in it.
    """

    time: np.ndarray
    value: np.ndarray
    delay: float = 0.0
    lag: float = 0.0
    rate: float = np.inf
    tires: float = 0.0

    def sample(self, start, step, count, average):
        """What the actuator sees in each of `count` steps of `step` seconds from time `start`,
        (count,).

        As passed(), but for what it tires. start may be an array (n, 1) of times: then (n, count).
        """
        seen = self.passed(start, step, count, average)
        if self.tires:
            begins = start + step * np.arange(count)
            worked = replace(self, value=self.value**2).integral(begins)
            seen = seen * np.exp(-self.tires * np.maximum(worked, 0.0))
        return seen

    def passed(self, start, step, count, average):
        """What the actuator sees in each of `count` steps of `step` seconds from time `start`,
        (count,).

        A row that changes inside a step counts by its share of it, so the result is continuous in
        the delay, and what MuJoCo's linear interpolation gives. With a lag: the value at the end
        of the step (MuJoCo's actearly) of the filter that is as late on average (see end_of_step),
        or the filter's mean over the step if `average` (a Runge-Kutta step sees the filter move).
        """
        if np.isfinite(self.rate) and not self.lag:
            edges = start - self.delay + step * np.arange(count + 1)
            return np.diff(self._ramps(edges)) / step
        if np.isfinite(self.rate):
            each = [self._followed(float(t), step, count, average) for t in np.ravel(start)]
            return np.array(each).reshape(*np.shape(start)[:-1], count)
        edges = start - self.delay + step * np.arange(count + 1)
        first = self._row(edges[..., :-1] + SLACK * step)
        last = self._row(edges[..., 1:] - SLACK * step)
        held = self.value[first]
        if (first != last).any() or self.lag:
            mean = np.diff(self.integral(edges)) / step
            held = np.where(first == last, held, mean)
        if not self.lag:
            return held
        if not average:
            return replace(self, lag=end_of_step(self.lag, step)).filtered(edges)[..., 1:]
        act = self.filtered(edges)
        return held - self.lag / step * np.diff(act)

    def _followed(self, start, step, count, average):
        """As passed(), of a limited rate with a lag: its mean over each step, exactly, then the lag
        of these."""
        # until what was before does not count any more
        lead = max(0, int(np.ceil(min(start - self.delay - self.time[0], 40 * self.lag) / step)))
        edges = start - self.delay + step * np.arange(-lead, count + 1)
        mean = np.diff(self._ramps(edges)) / step
        steady = Signal(edges[:-1], mean, lag=self.lag)
        return steady.sample(edges[lead], step, count, average)

    def _ramps(self, t):
        """Integral from the first row to times t of the undelayed control that follows at
        `rate`."""
        # one number at a time: plain floats are ten times as quick as numpy's
        seconds, value, rate = np.diff(self.time).tolist(), self.value.tolist(), float(self.rate)
        now, total = value[0], 0.0
        level, area = [now], [total]
        for goal, dt in zip(value, seconds):
            gap = goal - now
            size, sign = abs(gap), (gap > 0) - (gap < 0)
            reached = min(size / rate, max(dt, 0.0))
            total += now * dt + sign * (
                rate * (reached * reached) / 2 + size * (max(dt, 0.0) - reached)
            )
            now += sign * rate * reached
            level.append(now)
            area.append(total)
        level, area = np.array(level), np.array(area)
        i = self._row(t)
        return area[i] + _ramp(level[i], self.value[i], t - self.time[i], self.rate)[1]

    def _row(self, t):
        """The row that holds at times t; row 0 also before the recording."""
        return np.maximum(np.searchsorted(self.time, t, side="right") - 1, 0)

    def integral(self, t):
        """Of the undelayed, unfiltered control, from the first row to times t."""
        area = np.concatenate([[0.0], np.cumsum(self.value[:-1] * np.diff(self.time))])
        i = self._row(t)
        return area[i] + self.value[i] * (t - self.time[i])

    def held(self, t, low, high):
        """As integral(), kept between low and high at all times: what an activation adds up to."""
        if np.isinf([low, high]).all():
            return self.integral(t)
        area = [min(max(0.0, low), high)]
        for gained in (self.value[:-1] * np.diff(self.time)).tolist():
            area.append(min(max(area[-1] + gained, low), high))
        i = self._row(t)
        return np.clip(np.array(area)[i] + self.value[i] * (t - self.time[i]), low, high)

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


def _ramp(level, goal, seconds, rate):
    """(level after some seconds, its integral over them) on the way to a goal at a rate; or
    before, at rest."""
    gap = goal - level
    reached = np.clip(abs(gap) / rate, 0.0, np.maximum(seconds, 0.0))
    gained = np.sign(gap) * (rate * reached**2 / 2 + abs(gap) * (np.maximum(seconds, 0) - reached))
    return level + np.sign(gap) * rate * reached, level * seconds + gained
