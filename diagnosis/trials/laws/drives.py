"""What drives do to a control, and to their force, that the catalogue names."""

from collections import deque

import numpy as np

from diagnosis.trials.laws.base import Law


class Delay(Law):
    """u(t − T), to the substep."""

    effect = "delay"

    def reset(self, s):
        self.state = deque()

    def control(self, s, u):
        self.state.append((s.time, u[self.actuator]))
        while len(self.state) > 1 and self.state[1][0] <= s.time - self.seconds + 1e-9:
            self.state.popleft()
        u = u.copy()
        u[self.actuator] = self.state[0][1]
        return u


class Lag(Law):
    """T ẏ = u − y, solved over the substep; it starts settled."""

    effect = "lag"

    def reset(self, s):
        self.state = None

    def control(self, s, u):
        u = u.copy()
        before = u[self.actuator] if self.state is None else self.state
        blend = 1 - np.exp(-s.dt / self.seconds)
        self.state = before + blend * (u[self.actuator] - before)
        u[self.actuator] = before + 0.5 * (self.state - before)
        return u


class RateLimit(Law):
    """|ẏ| ≤ r per second; it starts at the first control."""

    effect = "rate_limit"

    def reset(self, s):
        self.state = None

    def control(self, s, u):
        u = u.copy()
        before = u[self.actuator] if self.state is None else self.state
        most = self.rate * s.dt
        self.state = before + min(max(u[self.actuator] - before, -most), most)
        u[self.actuator] = self.state
        return u


class DeadZone(Law):
    """Control (of a motor) or force (of a servo) nearer to zero than w does nothing."""

    effect = "dead_zone"

    def control(self, s, u):
        if self.servo:
            return u
        u = u.copy()
        x = u[self.actuator]
        u[self.actuator] = np.sign(x) * max(abs(x) - self.width, 0.0)
        return u

    def drive(self, s, tau):
        if self.servo:
            x = tau[self.link]
            tau[self.link] = np.sign(x) * max(abs(x) - self.width, 0.0)


class BackEmf(Law):
    """τ −= b v while driven."""

    effect = "back_emf"

    def drive(self, s, tau):
        tau[self.link] -= self.damping * s.v[self.link]


class TorqueSpeed(Law):
    """The largest torque falls with speed: |τ| ≤ T₀ − s |v| where τ v > 0."""

    effect = "torque_speed"

    def drive(self, s, tau):
        x, v = tau[self.link], s.v[self.link]
        if x * v > 0:
            most = max(self.stall - self.slope * abs(v), 0.0)
            tau[self.link] = min(max(x, -most), most)


class GainFade(Law):
    """τ ← τ exp(−r t): a battery that runs down."""

    effect = "gain_fade"

    def drive(self, s, tau):
        tau[self.link] *= np.exp(-self.rate * s.time)
