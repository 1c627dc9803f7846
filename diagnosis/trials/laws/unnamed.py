"""Laws that the catalogue lacks, from textbooks on friction, drives and wear."""

import numpy as np

from diagnosis.trials.laws.base import Law


class Hysteresis(Law):
    """Bouc–Wen: ż = v − |v| z/z₀ (β + γ sign(v z)), τ = −k z: a rubber coupling, a bent wire."""

    needs = ("position", "velocity")

    def reset(self, s):
        self.state = 0.0

    def force(self, s):
        v, z = s.v[self.link], self.state
        shape = 0.5 + 0.5 * np.sign(v * z)
        self.state = z + s.dt * (v - abs(v) * z * abs(z) / self.reach**2 * shape)
        s.force[self.link] -= self.stiffness * self.state


class WarmingGrease(Law):
    """τ = −d v exp(−W/W₀), W the energy rubbed away so far: grease that thins as it warms."""

    needs = ("velocity", "time")

    def reset(self, s):
        self.state = 0.0

    def force(self, s):
        v = s.v[self.link]
        push = -self.damping * np.exp(-self.state / self.heat) * v
        self.state -= push * v * s.dt
        s.force[self.link] += push


class Detent(Law):
    """τ = −A x exp((1 − x²)/2), x = (q − q₀)/w: a ball that falls into a notch."""

    needs = ("position",)

    def force(self, s):
        x = (s.q[self.link] - self.at) / self.width
        s.force[self.link] -= self.amplitude * x * np.exp(0.5 - 0.5 * x * x)


class CableDrag(Law):
    """τ = −A (exp(x) − 1) for x = (q − q₀)/w > 0: a cable that pulls taut beyond an angle."""

    needs = ("position",)

    def force(self, s):
        x = (s.q[self.link] - self.at) / self.width
        if x > 0:
            s.force[self.link] -= self.amplitude * np.expm1(min(x, 4.0))


class SpeedRipple(Law):
    """τ = A (v/v₀)² sin(n q): a current loop that lags its commutation."""

    needs = ("position", "velocity")

    def force(self, s):
        growth = min((s.v[self.link] / self.speed) ** 2, 9.0)
        wave = np.sin(self.waves * s.q[self.link])
        s.force[self.link] += self.amplitude * growth * wave


class NeighbourSpring(Law):
    """τ_a = −k sin(q_b): a hose laid over the next joint."""

    @property
    def needs(self):
        return (("position", self.other),)

    def force(self, s):
        s.force[self.link] -= self.amplitude * np.sin(s.q[self.other] / self.reach)


class FluidMemory(Law):
    """T ẏ = v − y, τ = −d y: fluid dragged along, which keeps moving when the joint stops. Of slow
    motion it is a damper, of fast motion a spring."""

    needs = ("velocity|position",)

    def reset(self, s):
        self.state = 0.0

    def force(self, s):
        self.state += (1 - np.exp(-s.dt / self.seconds)) * (s.v[self.link] - self.state)
        s.force[self.link] -= self.damping * self.state


class Wear(Law):
    """|τ| ≤ F (1 − exp(−travel/L)): friction that grows with the way gone."""

    needs = ("velocity", "time")

    def reset(self, s):
        self.state = 0.0

    def friction(self, s):
        self.state += abs(s.v[self.link]) * s.dt
        s.limit[self.link] += self.level * -np.expm1(-self.state / self.travel)


class OneWayBearing(Law):
    """τ = −d v for v > 0 only."""

    needs = ("velocity",)

    def force(self, s):
        s.force[self.link] -= self.damping * max(s.v[self.link], 0.0)


class OneWayDrag(Law):
    """τ = −c v³ for v > 0 only: a flap."""

    needs = ("velocity",)

    def force(self, s):
        s.force[self.link] -= self.drag * max(s.v[self.link], 0.0) ** 3


class Shaking(Law):
    """τ = A sin(2π f t + φ): an engine running beside the machine."""

    needs = ("time",)

    def force(self, s):
        phase = 2 * np.pi * self.hertz * s.time + self.phase
        s.force[self.link] += self.amplitude * np.sin(phase)


class UnevenMotor(Law):
    """τ ← τ (1 + a cos(n q)): a motor whose constant depends on where it stands."""

    needs = ("control", "position")

    def drive(self, s, tau):
        tau[self.link] *= 1 + self.share * np.cos(self.waves * s.q[self.link] + self.phase)


class PatchDamping(Law):
    """τ = −d v exp(−x²/2), x = (q − q₀)/w: dirt in part of the travel."""

    needs = ("position", "velocity")

    def force(self, s):
        x = (s.q[self.link] - self.at) / self.width
        s.force[self.link] -= self.damping * s.v[self.link] * np.exp(-0.5 * x * x)


class SagGain(Law):
    """τ ← τ (1 − s |τ|/τ₀): a supply whose voltage sags under load."""

    needs = ("control",)

    def drive(self, s, tau):
        x = tau[self.link]
        tau[self.link] = x * (1 - self.share * min(abs(x) / self.full, 1.0))


class BrakeDrag(Law):
    """−F tanh(v/v_ε) / (1 + |τ|/τ₀): a brake that the motor's current opens."""

    needs = ("control", "velocity")

    def force(self, s):
        hold = self.level / (1 + abs(s.tau[self.link]) / self.full)
        s.force[self.link] -= hold * np.tanh(s.v[self.link] / self.creep)


UNNAMED = (
    Hysteresis,
    WarmingGrease,
    Detent,
    CableDrag,
    SpeedRipple,
    NeighbourSpring,
    FluidMemory,
    Wear,
    OneWayBearing,
    OneWayDrag,
    Shaking,
    UnevenMotor,
    PatchDamping,
    SagGain,
    BrakeDrag,
)
