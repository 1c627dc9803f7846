"""The "real" system of the sealed trials: MuJoCo's rigid bodies, everything hidden written by hand.

    real = Real(mechanism, [{"effect": "coulomb_friction", "place": {...}, "parameters": {...}}], finer=4)
    real.reset(qpos, qvel)
    real.advance(ctrl, 0.01)                         # seconds; real.reading() is what the sensors say

An implementation independent of the catalogue that is to find these effects. Friction is Coulomb's
law solved for the velocity at the end of a step (true sticking); delays and lags act on the
continuous control, averaged over a step; drag is summed over faces. Inertial parameters, lengths
and contact constants have no force of their own and are set in the model.
"""

from collections import deque

import mujoco
import numpy as np

from diagnosis.trials import hidden_forces

FULL = mujoco.mjtState.mjSTATE_INTEGRATION
SIMPLE = 0  # body/simple="false": centres of mass may move


class Real:
    """A mechanism with hidden effects, stepped by hand. `finer`: time steps per nominal step."""

    def __init__(self, mechanism, hidden, finer=1):
        self.hidden, self.finer = hidden, finer
        spec = mechanism.spec()
        self.backlash = None
        for item in hidden:
            _build(spec, item)
        self.model = model = spec.compile()
        model.opt.timestep /= finer
        data = mujoco.MjData(model)
        for item in hidden:
            self._edit(item)
        mujoco.mj_setConst(model, data)
        self.data = mujoco.MjData(model)
        self.dt = model.opt.timestep
        self.stage = 0.5 if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4 else 1.0
        self.rubs = [
            item
            for item in hidden
            if item["effect"] in RUBS
            and (item["effect"] != "contact_friction" or self._slides(item))
        ]
        self.rubbing = [self._dof(item) for item in self.rubs]
        self.actuated = [item for item in hidden if item["effect"] in ACTUATORS]
        self.reset(model.qpos0, np.zeros(model.nv))

    # places

    def _joint(self, item):
        return self.model.joint(item["place"]["name"])

    def _dof(self, item):
        if item["effect"] == "contact_friction":
            return self.model.joint("x").dofadr[0]
        return self._joint(item).dofadr[0]

    def _actuator(self, item):
        if item["effect"] == "fading_gain":
            return item["parameters"]["actuator"]
        name = item["place"]["name"]
        return int(name) if name.isdigit() else self.model.actuator(name).id

    def _edit(self, item):
        """Parameters that are numbers of the rigid bodies, contacts or integrator, in the model."""
        model, effect, p = self.model, item["effect"], item["parameters"]
        name = item["place"]["name"]
        if effect in ("mass", "inertia", "center_of_mass"):
            body = model.body(name).id
            if effect == "mass":
                model.body_inertia[body] *= p["mass"] / model.body_mass[body]
                model.body_mass[body] = p["mass"]
            elif effect == "inertia":
                model.body_inertia[body] = [p[k] for k in ("ixx", "iyy", "izz")]
            else:
                model.body_ipos[body] = [p[k] for k in "xyz"]
        elif effect == "armature":
            model.dof_armature[self._dof(item)] = p["armature"]
        elif effect == "contact_friction" and not self._slides(item):
            geom = model.geom(name).id
            model.geom_friction[geom, 0] = p["sliding"]
            model.geom_priority[geom], model.geom_condim[geom] = (
                1,
                model.geom_condim.max(),
            )  # else its own condim would count alone
        elif effect == "contact_friction":  # the slider: smooth contacts, friction by hand
            model.geom_condim[:] = 1
        elif effect in ("contact_stiffness", "contact_damping"):
            geom = model.geom(name).id
            model.geom_solref[geom, 0 if effect == "contact_stiffness" else 1] = -p[effect[8:]]
            model.geom_priority[geom] = 1
        elif effect == "ground_height":
            model.geom_pos[model.geom(name).id, 2] = p["z"]
        elif effect == "backlash":
            self.backlash = item
            dof = self._dof(item)
            self.motor_inertia = model.dof_armature[dof]
            self.motor_damping = model.dof_damping[dof]
            model.dof_armature[dof] = 0.0
            model.dof_damping[dof] = 0.0
            self.motor_actuator = int(
                np.flatnonzero(model.actuator_trnid[:, 0] == self._joint(item).id)[0]
            )
            actuator = self.motor_actuator
            self.motor_law = (
                model.actuator_gainprm[actuator, 0],
                *model.actuator_biasprm[actuator, :3],
            )
            model.actuator_gainprm[actuator, 0] = 0.0
            model.actuator_biasprm[actuator, :3] = 0.0

    def _slides(self, item):
        return item["effect"] == "contact_friction" and "x" in [
            self.model.joint(i).name for i in range(self.model.njnt)
        ]

    # state

    def reset(self, qpos, qvel):
        """Start anew at rest in everything hidden: bristles, delay lines, gaps."""
        mujoco.mj_resetData(self.model, self.data)
        late = [
            item["parameters"]["seconds"]
            for item in self.hidden
            if item["effect"] == "sensor_delay"
        ]
        self.memory = {
            "lines": {},
            "lags": {},
            "rub": np.zeros(len(self.rubs)),
            "acceleration": np.zeros(self.model.nv),
            "past": deque(maxlen=2 + int(max(late, default=0) / self.dt)),
        }
        self.put(qpos, qvel)
        mujoco.mj_forward(self.model, self.data)

    def put(self, qpos, qvel):
        """Set the mechanical state; delay lines and the like run on."""
        self.data.qpos[:], self.data.qvel[:] = qpos, qvel
        if self.backlash is not None:  # the motor is what is seen; the load goes along
            joint = self._joint(self.backlash)
            gap = self.memory.get("motor", (None, None, 0.0))[2]
            self.memory["motor"] = (
                float(qpos[joint.qposadr[0]]),
                float(qvel[joint.dofadr[0]]),
                gap,
            )
            self.data.qpos[joint.qposadr[0]] -= gap

    def state(self):
        """All of it, for `restore`."""
        state = np.empty(mujoco.mj_stateSize(self.model, FULL))
        mujoco.mj_getState(self.model, self.data, state, FULL)
        return state, _copy(self.memory)

    def restore(self, state):
        mujoco.mj_setState(self.model, self.data, state[0], FULL)
        self.memory = _copy(state[1])

    def seen(self):
        """qpos (nq,) and qvel (nv,) at the sensors' place, without sensor faults or noise."""
        qpos, qvel = self.data.qpos.copy(), self.data.qvel.copy()
        if self.backlash is not None:
            joint = self._joint(self.backlash)
            qpos[joint.qposadr[0]], qvel[joint.dofadr[0]] = self.memory["motor"][:2]
        return qpos, qvel

    def reading(self):
        """qpos (nq,) and qvel (nv,) as the sensors report them: bias, scale and delay, no noise."""
        qpos, qvel = self.seen()
        for item in self.hidden:
            effect, p = item["effect"], item["parameters"]
            if not effect.startswith("sensor_"):
                continue
            k, dof = self._joint(item).qposadr[0], self._dof(item)
            if effect == "sensor_bias":
                qpos[k] += p["offset"]
            elif effect == "sensor_scale":
                qpos[k] *= p["ratio"]
                qvel[dof] *= p["ratio"]
            else:
                past = np.array(
                    [(t, q[k], v[dof]) for t, q, v in self.memory["past"]]
                    + [(self.data.time, qpos[k], qvel[dof])]
                )
                then = self.data.time - p["seconds"]
                qpos[k] = np.interp(then, past[:, 0], past[:, 1])
                qvel[dof] = np.interp(then, past[:, 0], past[:, 2])
        return qpos, qvel

    def behind(self, qpos, qvel):
        """The state that its sensors would report as this, but for their delay."""
        qpos, qvel = np.array(qpos), np.array(qvel)
        for item in self.hidden[::-1]:
            if item["effect"] == "sensor_bias":
                qpos[self._joint(item).qposadr[0]] -= item["parameters"]["offset"]
            elif item["effect"] == "sensor_scale":
                qpos[self._joint(item).qposadr[0]] /= item["parameters"]["ratio"]
                qvel[self._dof(item)] /= item["parameters"]["ratio"]
        return qpos, qvel

    # motion

    def advance(self, ctrl, seconds, event=False):
        """Hold `ctrl` (nu,) for `seconds`. event: effects that come and go are there."""
        self.event = event
        for _ in range(max(1, round(seconds / self.dt))):
            if any(item["effect"] == "sensor_delay" for item in self.hidden):
                self.memory["past"].append(
                    (self.data.time, self.data.qpos.copy(), self.data.qvel.copy())
                )
            self._step(np.asarray(ctrl, dtype=float))

    def _step(self, ctrl):
        model, data, memory, dt = self.model, self.data, self.memory, self.dt
        drive = ctrl.copy()
        for item in self.actuated:
            if item["effect"] in ("delay", "lag", "dead_zone"):
                drive[self._actuator(item)] = self._drive(item, drive[self._actuator(item)])
        data.ctrl[:] = drive
        # velocities where the integrator evaluates forces: the step's end (Euler) or middle (RK4)
        qvel = data.qvel + self.stage * dt * memory["acceleration"]
        force = np.zeros(model.nv)
        data.xfrc_applied[:] = 0.0
        for item in self.hidden:
            if item["effect"] in hidden_forces.JOINT:
                joint = self._joint(item)
                dof, q = joint.dofadr[0], joint.qposadr[0]
                angle = (
                    data.qpos[q] + (1 - self.stage) * dt * data.qvel[dof]
                )  # RK4's middle, Euler's start
                force[dof] += hidden_forces.joint_force(
                    item, angle - model.qpos_spring[q], angle, qvel[dof], data.time, joint
                )
            elif item["effect"] in hidden_forces.BODY:
                hidden_forces.body_force(item, model, data, memory["acceleration"], self.event)
        self._motor_faults(drive, qvel, force)
        before = data.qvel.copy()
        if self.backlash is not None:
            self._couple(drive, force)
        self._step_with_friction(force)
        memory["acceleration"] = (data.qvel - before) / dt

    def _step_with_friction(self, force):
        """One step in which each rubbing joint stops or slides: |friction| <= limit, against the slip."""
        model, data, dt = self.model, self.data, self.dt
        if not self.rubs:
            data.qfrc_applied[:] = force
            mujoco.mj_step(model, data)
            return
        dofs, friction = self.rubbing, self.memory["rub"]
        unit, inverse = np.zeros((1, model.nv)), np.zeros((1, model.nv))
        mobility = []
        for dof in dofs:
            unit[:] = 0.0
            unit[0, dof] = 1.0
            mujoco.mj_solveM(model, data, inverse, unit)
            mobility.append(inverse[0, dof])
        limit = np.array([self._rub_limit(item) for item in self.rubs])
        start = np.empty(mujoco.mj_stateSize(model, FULL))
        mujoco.mj_getState(model, data, start, FULL)
        slope, last = dt * np.array(mobility), None
        for _ in range(25):
            data.qfrc_applied[:] = force
            data.qfrc_applied[dofs] += friction
            mujoco.mj_step(model, data)
            slip = data.qvel[dofs].copy()
            if len(dofs) == 1 and last is not None and abs(friction[0] - last[1][0]) > 1e-12:
                secant = (slip - last[0]) / (friction - last[1])  # contacts and servos stiffen it
                slope = np.clip(secant, 0.02 * slope, slope) if secant[0] > 0 else slope
            if any(item["effect"] == "contact_friction" for item in self.rubs):
                limit = np.array([self._rub_limit(item) for item in self.rubs])
            better = np.clip(friction - slip / slope, -limit, limit)
            if np.all(np.abs(better - friction) <= 1e-4 * limit + 1e-12):
                break
            last, friction = (slip, friction), better
            mujoco.mj_setState(model, data, start, FULL)
        else:
            data.qfrc_applied[:] = force
            data.qfrc_applied[dofs] += friction
            mujoco.mj_step(model, data)
        self.memory["rub"] = friction

    def _rub_limit(self, item):
        """Largest friction force now: N.m or N."""
        effect, p = item["effect"], item["parameters"]
        joint = None if effect == "contact_friction" else self._joint(item)
        if effect == "coulomb_friction":
            return p["frictionloss"]
        if effect == "stribeck_friction":
            v = self.data.qvel[joint.dofadr[0]]
            return p["coulomb"] + (p["static"] - p["coulomb"]) * np.exp(-((v / p["velocity"]) ** 2))
        if effect == "friction_patch":
            q = self.data.qpos[joint.qposadr[0]]
            return p["friction"] if p["low"] < q < p["high"] else 0.0
        normal, out = 0.0, np.empty(6)
        for contact in range(self.data.ncon):
            mujoco.mj_contactForce(self.model, self.data, contact, out)
            normal += out[0]
        return p["sliding"] * normal

    def _drive(self, item, u):
        """What an actuator gets for the control u: late, smoothed, or nothing near zero."""
        effect, p, index = item["effect"], item["parameters"], self._actuator(item)
        now, dt = self.data.time, self.dt
        if effect == "delay":
            line = self.memory["lines"].setdefault(index, [(-np.inf, u)])  # (since, value)
            if line[-1][1] != u:
                line.append((now, u))
            while len(line) > 1 and line[1][0] <= now - p["seconds"]:
                line.pop(0)
            begin, end = now - p["seconds"], now - p["seconds"] + dt
            ends = [since for since, _ in line[1:]] + [np.inf]
            return (
                sum(
                    value * max(0.0, min(until, end) - max(since, begin))
                    for (since, value), until in zip(line, ends)
                )
                / dt
            )
        if effect == "lag":
            old, decay = self.memory["lags"].get(index, u), np.exp(-dt / p["seconds"])
            self.memory["lags"][index] = u + (old - u) * decay
            if self.finer == 1 and self.stage == 1:  # as a simulator of this step would have it
                return self.memory["lags"][index]
            return u + (old - u) * (1 - decay) * p["seconds"] / dt  # mean over the step
        if self.model.actuator_biasprm[index].any():
            return u  # servo: in its force
        return np.sign(u) * max(abs(u) - p["half_width"], 0.0)

    def _law(self, index, drive, qvel):
        """Force, length and velocity of an actuator on a joint, by its gain and bias."""
        model = self.model
        joint, gear = model.actuator_trnid[index, 0], model.actuator_gear[index, 0]
        length = gear * self.data.qpos[model.jnt_qposadr[joint]]
        velocity = gear * qvel[model.jnt_dofadr[joint]]
        bias = model.actuator_biasprm[index]
        force = (
            model.actuator_gainprm[index, 0] * drive[index]
            + bias[0]
            + bias[1] * length
            + bias[2] * velocity
        )
        return force, velocity, gear, model.jnt_dofadr[joint]

    def _motor_faults(self, drive, qvel, out):
        """Adds the difference between the faulty actuators' forces and the nominal ones'."""
        if self.model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER:  # damps joints only
            qvel = self.data.qvel
        for index in {self._actuator(item) for item in self.actuated}:
            nominal, velocity, gear, dof = self._law(index, drive, qvel)
            faults = {
                item["effect"]: item["parameters"]
                for item in self.actuated
                if self._actuator(item) == index
            }
            force = nominal  # from the amplifier's input to its output
            if "dead_zone" in faults and self.model.actuator_biasprm[index].any():
                half = faults["dead_zone"]["half_width"]
                force -= np.clip(force, -half, half)
            if "gain" in faults:
                force *= faults["gain"]["gain"]
            if "fading_gain" in faults:
                fading = faults["fading_gain"]
                force *= 1 - fading["loss"] * (1 - np.exp(-self.data.time / fading["seconds"]))
            if "bias" in faults:
                force += faults["bias"]["bias"]
            if "back_emf" in faults:
                force -= faults["back_emf"]["damping"] * velocity
            if "saturation" in faults:
                force = np.clip(
                    force, -faults["saturation"]["forcerange"], faults["saturation"]["forcerange"]
                )
            out[dof] += gear * (force - nominal)

    def _couple(self, drive, out):
        """Motor and load with a gap between: the motor's own motion, by hand; teeth are stiff springs."""
        joint, p = self._joint(self.backlash), self.backlash["parameters"]
        dof, index = joint.dofadr[0], self.motor_actuator
        angle, speed, _ = self.memory["motor"]
        gain, *bias = self.motor_law
        load, load_speed = self.data.qpos[joint.qposadr[0]], self.data.qvel[dof]
        apart = angle - load
        over = max(apart - p["gap"] / 2, 0.0) + min(apart + p["gap"] / 2, 0.0)
        tooth = 0.0
        if over:
            tooth = p["spring"] * over + p["damper"] * (speed - load_speed)
            tooth = tooth if tooth * over > 0 else 0.0
        out[dof] += tooth
        torque = gain * drive[index] + bias[0] + bias[1] * angle - tooth
        damping = self.motor_damping - bias[2]
        speed = (speed + self.dt * torque / self.motor_inertia) / (
            1 + self.dt * damping / self.motor_inertia
        )
        angle += self.dt * speed
        self.memory["motor"] = (angle, speed, angle - (load + self.dt * load_speed))


RUBS = ("coulomb_friction", "stribeck_friction", "contact_friction", "friction_patch")
ACTUATORS = ("gain", "bias", "delay", "lag", "saturation", "back_emf", "dead_zone", "fading_gain")


def _copy(memory):
    """A copy two levels deep, which is as deep as anything in it changes."""
    return {
        key: value.copy() if hasattr(value, "copy") else value
        for key, value in (
            memory | {"lines": {k: list(v) for k, v in memory["lines"].items()}}
        ).items()
    }


def _build(spec, item):
    """Changes that only a fresh model can take: link lengths, movable centres of mass."""
    name = item["place"]["name"]
    if item["effect"] in ("center_of_mass", "inertia"):
        spec.body(name).simple = SIMPLE
    elif item["effect"] == "link_length":
        body = spec.body(name)
        body.pos = np.asarray(body.pos) * item["parameters"]["length"] / np.linalg.norm(body.pos)
