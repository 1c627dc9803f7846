"""Friction, damping, springs and transmissions that the catalogue names."""

import numpy as np

from diagnosis.trials.laws.base import Law


class QuadraticDamping(Law):
    """τ = −d₂ v |v|."""

    effect = "quadratic_damping"

    def force(self, s):
        v = s.v[self.link]
        s.force[self.link] -= self.damping2 * v * abs(v)


class Coulomb(Law):
    """Dry friction of one level, |τ| ≤ F, stick included."""

    effect = "coulomb_friction"

    def friction(self, s):
        s.limit[self.link] += self.frictionloss


class Stribeck(Law):
    """|τ| ≤ F_c + (F_s − F_c) exp(−(v/v_s)²)."""

    effect = "stribeck_friction"

    def friction(self, s):
        bend = np.exp(-((s.v[self.link] / self.velocity) ** 2))
        s.limit[self.link] += self.coulomb + (self.static - self.coulomb) * bend


class LoadFriction(Law):
    """|τ| ≤ share · |transmitted torque|: gear teeth pressed together by what they carry."""

    effect = "load_friction"

    def friction(self, s):
        carried = s.tau[self.link]
        driving = carried * s.v[self.link] >= 0
        s.limit[self.link] += (self.driving if driving else self.driven) * abs(carried)


class FrictionMap(Law):
    """|τ| ≤ F (1 + c sin(n q + φ)): a bearing that runs out of true."""

    effect = "friction_map"

    def friction(self, s):
        wave = np.sin(self.waves * s.q[self.link] + self.phase)
        s.limit[self.link] += self.level * (1 + self.contrast * wave)


class Presliding(Law):
    """Dahl: dz/dt = v (1 − σ z/F · sign v), τ = −σ z: a bristle that bends before it slips."""

    effect = "presliding"

    def reset(self, s):
        self.state = 0.0

    def force(self, s):
        v = s.v[self.link]
        limit = self.frictionloss / self.stiffness
        # exact over the substep for constant v, which keeps a stiff bristle stable
        goal = limit * np.sign(v)
        self.state = goal + (self.state - goal) * np.exp(-abs(v) * s.dt / limit)
        s.force[self.link] -= self.stiffness * self.state


class CoupledFriction(Law):
    """One tendon over two joints: −F tanh((v_a + v_b)/v_ε) on both."""

    effect = "coupled_friction"

    def force(self, s):
        v = s.v[self.link] + s.v[self.other]
        push = -self.level * np.tanh(v / self.creep)
        s.force[self.link] += push
        s.force[self.other] += push


class CoupledInertia(Law):
    """A rotor J driven by both joints: kinetic energy J (v_a + v_b)²/2.

    It is part of the mass matrix, so that dry friction and contacts move it as well.
    """

    effect = "coupled_inertia"

    def couple(self, joints):
        both = "".join(f'<joint joint="{joints[i]}" coef="1"/>' for i in (self.other, self.link))
        return f'<tendon><fixed armature="{self.inertia:.12g}">{both}</fixed></tendon>'


class CubicSpring(Law):
    """τ = −k₃ (q − rest)³."""

    effect = "nonlinear_stiffness"

    def force(self, s):
        s.force[self.link] -= self.stiffness3 * (s.q[self.link] - s.rest[self.link]) ** 3


class ConstantTorque(Law):
    """τ = constant: a spring wound up, a tool's weight on a slide."""

    effect = "spring_offset"

    def force(self, s):
        s.force[self.link] += self.torque


class Cogging(Law):
    """τ = A sin(n q + φ)."""

    effect = "cogging"

    def force(self, s):
        s.force[self.link] += self.amplitude * np.sin(self.poles * s.q[self.link] + self.phase)


class Transmission(Law):
    """A rotor before the joint, in series with a spring, a damper and a gap of given width.

    J θ̈ = τ_motor − τ_t,  M q̈ = … + τ_t,  τ_t = k·dead(θ − q, gap) + c (θ̇ − q̇) when touching.
    The encoder, the drive, the joint's damping and friction are on the rotor's side.
    """

    gap = 0.0

    def reset(self, s):
        self.state = (s.q[self.link], s.v[self.link])

    def twist(self, q, v):
        """Force handed on to the link, from the link's own q and v."""
        stretch, rate = self.state[0] - q, self.state[1] - v
        over = np.sign(stretch) * max(abs(stretch) - self.gap / 2, 0.0)
        push = self.stiffness * over + (self.damping * rate if over or not self.gap else 0.0)
        return push if not self.gap or push * over > 0 else 0.0


class JointElasticity(Transmission):
    """A transmission without a gap: a harmonic drive, a belt, a long shaft."""

    effect = "joint_elasticity"


class Backlash(Transmission):
    """A stiff transmission with a gap."""

    effect = "backlash"
