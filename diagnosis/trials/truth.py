"""The true machine: rigid bodies by MuJoCo at a tenth of the step, every other force by hand.

    system = TrueSystem(robot, [Cogging(0, amplitude=0.1, poles=7, phase=0)])
    system.reset(qpos, qvel)
    system.advance(ctrl, 0.01)
    qpos, qvel = system.reading()                      # as ideal sensors read

MuJoCo supplies mass matrix (with rotors that two joints drive), Coriolis forces, gravity, joint
ranges and contacts of a model without springs, dampers, friction or drives; those are this module's
and the laws' own equations. The motion is integrated here, by Adams and Bashforth's two-step
formula. Dry friction is solved as a complementarity problem (Moreau's time stepping), without
MuJoCo's soft constraint.
"""

from dataclasses import replace

import mujoco
import numpy as np

from diagnosis.trials import laws as law_module
from diagnosis.trials.laws import Air, Transmission
from diagnosis.trials.mjcf import to_mjcf


class TrueSystem:
    """A Robot and its laws. q, v, u, tau, force, limit: see laws.py.

    run: the number of the recording, for laws that act in some of them only.
    """

    def __init__(self, robot, laws=(), run=0):
        self.robot, self.laws, self.run = robot, list(laws), run
        still = not any(isinstance(_inner(law), Air) for law in self.laws)
        self._air = Air(0, density=robot.density, x=0.0, y=0.0, z=0.0) if still else None
        bare = replace(
            robot,
            links=tuple(
                replace(k, damping=0.0, frictionloss=0.0, stiffness=0.0) for k in robot.links
            ),
            actuators=(),
            density=0.0,
            wind=(0.0, 0.0, 0.0),
        )
        self.transmission = next((k for k in self.laws if isinstance(k, Transmission)), None)
        if self.transmission is not None:  # the rotor is simulated beside the tree
            bare = bare.with_link(self.transmission.link, armature=0.0)
        joints = [k.joint_name for k in robot.links]
        tendons = "".join(k.couple(joints) for k in self.laws if _has(k, "couple"))
        text = to_mjcf(bare).replace("</mujoco>", tendons + "</mujoco>")
        self.model = mujoco.MjModel.from_xml_string(text)
        self.data = mujoco.MjData(self.model)
        self._index(robot)

    def _index(self, robot):
        model, links = self.model, robot.links
        self.jointed = np.array([i for i, k in enumerate(links) if k.joint != "free"])
        joints = [model.joint(links[i].joint_name) for i in self.jointed]
        self.dof = np.full(len(links), -1)
        self.dof[self.jointed] = [j.dofadr[0] for j in joints]
        self.address = np.full(len(links), -1)
        self.address[self.jointed] = [j.qposadr[0] for j in joints]
        self.body = np.array([model.body(k.name).id for k in links])
        field = lambda name: np.array([getattr(k, name) for k in links])
        self.damping, self.stiffness, self.rest = map(field, ("damping", "stiffness", "rest"))
        self.dry = field("frictionloss")
        actuators = robot.actuators
        term = lambda f: np.array([f(a) for a in actuators])
        self.driven = np.array([a.link for a in actuators], int)
        self.feed = term(lambda a: {"motor": 1.0, "position": a.kp, "velocity": a.kv}[a.kind])
        self.feed = self.feed * term(lambda a: a.gain)
        self.stiff = term(lambda a: a.gain * a.kp if a.kind == "position" else 0.0)
        self.slow = term(lambda a: 0.0 if a.kind == "motor" else a.gain * a.kv)
        self.bias = term(lambda a: a.bias)
        self.most = term(lambda a: a.limit)
        shape = len(links)
        self.q, self.v, self.tau = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        self.force, self.limit = np.zeros(shape), np.zeros(shape)
        self._dofs = self.dof[self.jointed]
        self._smooth_before = None
        self.u = np.zeros(len(actuators))
        self.steps = self.touched = 0  # substeps since `reset`, and those with a contact or a stop
        self.time, self.dt = 0.0, robot.substep
        hooked = lambda name: [k for k in self.laws if _has(k, name)]
        self.hooks = {
            name: hooked(name)
            for name in ("control", "drive", "force", "friction", "bodies", "measure")
        }
        if self._air is not None and robot.density > 0:  # of the nominal model, without a wind
            self.hooks["bodies"].append(self._air)
        self._rubs = bool(self.dry.any() or self.hooks["friction"])

    def reset(self, qpos, qvel):
        """Start a recording at time 0 from positions (nq,) and speeds (nv,), memories empty."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = qpos, qvel
        self.time, self.steps, self.touched = 0.0, 0, 0
        if self.transmission is not None:
            self.transmission.state = None  # the rotor begins where the link does
        self._look()
        for law in self.laws:
            law.reset(self)
        self._look()

    def _look(self):
        """Fill q and v, per link, as the motors see them."""
        self.q[self.jointed] = self.data.qpos[self.address[self.jointed]]
        self.v[self.jointed] = self.data.qvel[self.dof[self.jointed]]
        if self.transmission is not None and self.transmission.state is not None:
            link = self.transmission.link
            self.q[link], self.v[link] = self.transmission.state

    def advance(self, ctrl, duration):
        """Hold the control (nu,) for `duration` seconds."""
        steps = max(1, round(duration / self.robot.substep))
        self.dt = self.model.opt.timestep = duration / steps
        self.u = np.asarray(ctrl, float)
        self._smooth_before = None  # the control has jumped: start the two-step scheme anew
        for _ in range(steps):
            self._substep()

    def _substep(self):
        """v' = v + dt (3 a_n - a_(n-1))/2, q' = q + dt (v + v')/2; friction and contacts by
        Euler."""
        model, data = self.model, self.data
        mujoco.mj_step1(model, data)
        self._look()
        self._add_forces()
        dofs = self._dofs
        data.qfrc_applied[dofs] = self.force[self.jointed]
        mujoco.mj_fwdAcceleration(model, data)
        before = self._smooth_before
        smooth = data.qacc_smooth.copy()
        self._smooth_before = smooth
        rate = smooth if before is None else 1.5 * smooth - 0.5 * before
        if self._rubs:
            rate = self._rub(rate)
        self.steps += 1
        if data.nefc:  # contacts and stops, with the friction in place
            self.touched += 1
            data.qacc_smooth[:] = rate
            mujoco.mj_mulM(model, data, data.qfrc_smooth, rate)  # the solver reads both
            mujoco.mj_fwdConstraint(model, data)
            rate = data.qacc
        after = data.qvel + self.dt * rate
        mujoco.mj_integratePos(model, data.qpos, 0.5 * (data.qvel + after), self.dt)
        data.qvel[:] = after
        self.time += self.dt

    def _add_forces(self):
        """Fill tau, force (springs, dampers, drives, laws) and limit (dry friction)."""
        data, hooks = self.data, self.hooks
        u = self.u
        for law in hooks["control"]:
            u = law.control(self, u)
        q, v, tau = self.q, self.v, self.tau
        tau[:] = 0.0
        if len(u):
            x = self.feed * u - self.stiff * q[self.driven] - self.slow * v[self.driven]
            tau[self.driven] = np.minimum(np.maximum(x + self.bias, -self.most), self.most)
        for law in hooks["drive"]:
            law.drive(self, tau)
        np.subtract(tau, self.damping * v, out=self.force)
        self.force -= self.stiffness * (q - self.rest)
        for law in hooks["force"]:
            law.force(self)
        if hooks["bodies"]:
            data.xfrc_applied[:] = 0.0
            for law in hooks["bodies"]:
                law.bodies(self)
        self.limit[:] = self.dry
        for law in hooks["friction"]:
            law.friction(self)
        if self.transmission is not None:
            self._turn_rotor()

    def _turn_rotor(self):
        """One semi-implicit step of the rotor; leaves the transmitted force on the link."""
        law = self.transmission
        link = law.link
        dof, adr = self.dof[link], self.address[link]
        passed = law.twist(self.data.qpos[adr], self.data.qvel[dof])
        inertia = max(self.robot.links[link].armature, 1e-9)
        angle, speed = law.state
        free = speed + self.dt * (self.force[link] - passed) / inertia
        brake = self.dt * self.limit[link] / inertia
        speed = np.sign(free) * max(abs(free) - brake, 0.0)
        law.state = (angle + self.dt * speed, speed)
        self.force[link], self.limit[link] = passed, 0.0

    def _mobility(self, dofs):
        """Columns (n, nv) of the inverse mass matrix."""
        unit = np.zeros((len(dofs), self.model.nv))
        unit[np.arange(len(dofs)), dofs] = 1.0
        out = np.empty_like(unit)
        mujoco.mj_solveM(self.model, self.data, out, unit)
        return out

    def _rub(self, rate):
        """Accelerations (nv,) with dry friction, contacts and stops pushing as they did last."""
        rubbing = np.flatnonzero(self.limit > 0)
        if not rubbing.size:
            return rate
        dofs = self.dof[rubbing]
        columns = self._mobility(dofs)
        goal = self.data.qvel[dofs] / self.dt + rate[dofs]
        if self.data.nefc:
            goal += columns @ self.data.qfrc_constraint
        push = dry_friction(columns[:, dofs], goal, self.limit[rubbing])
        return rate + push @ columns

    def snapshot(self):
        """All that decides the future; give it to `restore`."""
        memory = law_module.snapshot(self.laws)
        return self.data.qpos.copy(), self.data.qvel.copy(), self.time, memory

    def restore(self, state):
        """Back to a snapshot of this system, or of one with the same laws."""
        self.data.qpos[:], self.data.qvel[:], self.time, memory = state
        law_module.restore(self.laws, memory)
        self._look()

    def place(self, qpos, qvel):
        """Move to positions (nq,) and speeds (nv,) as read on the motors' side; memories stay."""
        if self.transmission is not None:
            link = self.transmission.link
            dof, adr = self.dof[link], self.address[link]
            angle, speed = self.transmission.state
            twist, rate = self.data.qpos[adr] - angle, self.data.qvel[dof] - speed
            self.transmission.state = (float(qpos[adr]), float(qvel[dof]))
            qpos, qvel = np.array(qpos), np.array(qvel)
            qpos[adr] += twist
            qvel[dof] += rate
        self.data.qpos[:], self.data.qvel[:] = qpos, qvel
        self._look()

    def reading(self):
        """(qpos (nq,), qvel (nv,)) as noiseless sensors with the hidden faults read them."""
        self._look()
        q, v = self.q.copy(), self.v.copy()
        for law in self.hooks["measure"]:
            law.measure(self, q, v)
        qpos, qvel = self.data.qpos.copy(), self.data.qvel.copy()
        qpos[self.address[self.jointed]] = q[self.jointed]
        qvel[self.dof[self.jointed]] = v[self.jointed]
        return qpos, qvel


def _inner(law):
    """The law behind a gate, or the law itself."""
    return getattr(law, "law", law)


def _has(law, name):
    """Does a law, or the one behind its gate, define this hook?"""
    return getattr(type(_inner(law)), name) is not getattr(law_module.Law, name)


def dry_friction(mobility, goal, limit, sweeps=20):
    """Friction f (n,), |f| ≤ limit, that stops the motion or opposes it with all it has.

    Solves, per component, f = clip(f − (goal + mobility f)/mobility_ii, ±limit) by Gauss–Seidel;
    goal (n,): acceleration that would carry the speed through the substep without friction, plus
    speed over its length. mobility (n, n): inverse inertia.
    """
    if len(goal) == 1:
        return np.clip(-goal / mobility[0], -limit, limit)
    rows, goal, limit = mobility.tolist(), goal.tolist(), limit.tolist()
    count = range(len(goal))
    push = [min(max(-goal[i] / rows[i][i], -limit[i]), limit[i]) for i in count]
    enough = 1e-6 * max(limit)
    for _ in range(sweeps):
        moved = 0.0
        for i in count:
            row = rows[i]
            left = goal[i] + sum(row[k] * push[k] for k in count)
            value = min(max(push[i] - left / row[i], -limit[i]), limit[i])
            moved = max(moved, abs(value - push[i]))
            push[i] = value
        if moved <= enough:
            break
    return np.array(push)
