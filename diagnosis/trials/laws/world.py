"""Loads, air, and what sensors do, that the catalogue names."""

from collections import deque

import mujoco
import numpy as np

from diagnosis.trials.laws.base import Law


class ExternalForce(Law):
    """A constant force at a body's centre of mass, world frame."""

    effect = "external_force"

    def bodies(self, s):
        s.data.xfrc_applied[s.body[self.link], :3] += (self.x, self.y, self.z)


class Payload(Law):
    """A point mass hung at a body's centre of mass, from `start` on or in some recordings."""

    effect = "payload_change"

    def bodies(self, s):
        there = s.time >= self.start and (self.runs is None or s.run in self.runs)
        body, own = s.body[self.link], s.robot.links[self.link].mass
        wanted = own + self.added if there else own
        if s.model.body_mass[body] != wanted:
            s.model.body_mass[body] = wanted
            mujoco.mj_setConst(s.model, mujoco.MjData(s.model))


class Air(Law):
    """Drag of air on the box of equal inertia of every body, beyond what the nominal model has."""

    effect = "air_drag"

    def bodies(self, s):
        wind = np.array([self.x, self.y, self.z])
        s.data.xfrc_applied[:] += drag(s.model, s.data, self.density, wind)


class SensorBias(Law):
    """The encoder reads q + offset."""

    effect = "sensor_bias"

    def measure(self, s, q, v):
        q[self.link] += self.offset


class SensorScale(Law):
    """The encoder reads ratio · q."""

    effect = "sensor_scale"

    def measure(self, s, q, v):
        q[self.link] *= self.ratio
        v[self.link] *= self.ratio


class SensorDelay(Law):
    """The encoder reads q(t − T), between substeps on a straight line."""

    effect = "sensor_delay"

    def reset(self, s):
        self.state = deque()

    def force(self, s):  # asked at every substep: the place to remember
        self.state.append((s.time, s.q[self.link], s.v[self.link]))
        while len(self.state) > 2 and self.state[1][0] <= s.time - self.seconds - s.dt:
            self.state.popleft()

    def measure(self, s, q, v):
        times, qs, vs = np.array([*self.state, (s.time, q[self.link], v[self.link])]).T
        q[self.link] = np.interp(s.time - self.seconds, times, qs)
        v[self.link] = np.interp(s.time - self.seconds, times, vs)


def drag(model, data, density, wind):
    """Air drag on every body's box of equal inertia, as force and torque at its centre (nbody, 6).

    Each face pair of area A meets the air at speed w: force -density A w |w| / 2 along its normal.
    Spin: the same pressure over faces turning in the air, as in MuJoCo's inertia-box model.
    """
    out = np.zeros((model.nbody, 6))
    velocity = np.empty(6)
    for body in range(1, model.nbody):
        mass, inertia = model.body_mass[body], model.body_inertia[body]
        if mass <= 0:
            continue
        total = inertia.sum()
        box = np.sqrt(np.maximum(6 * (total - 2 * inertia) / mass, 0.0))  # full edge lengths
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, velocity, 0)
        frame = data.ximat[body].reshape(3, 3)
        spin = frame.T @ velocity[:3]
        flow = frame.T @ (velocity[3:] - wind)
        area = np.array([box[1] * box[2], box[0] * box[2], box[0] * box[1]])
        force = -0.5 * density * area * np.abs(flow) * flow
        lever = np.array(
            [
                box[0] * (box[1] ** 4 + box[2] ** 4),
                box[1] * (box[0] ** 4 + box[2] ** 4),
                box[2] * (box[0] ** 4 + box[1] ** 4),
            ]
        )
        torque = -density * lever * np.abs(spin) * spin / 64
        out[body, :3], out[body, 3:] = frame @ force, frame @ torque
    return out
