"""A nominal simulator made ready for every effect of the catalogue, many runs at once.

world = World.load('sim.xml')                       # or World.from_env('Hopper-v5')
friction = world.candidate('coulomb_friction', 'elbow')
windows = [Window(recording, 0, 30), Window(recording, 30, 60)]
qpos, qvel = world.simulate([{}, {friction: (0.1,)}], start_qpos, start_qvel, windows)
xml, written = world.corrected_xml({friction: (0.1,)})
"""

from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from diagnosis.common.mujoco_warnings import quiet
from diagnosis.effects import EFFECTS, unmodelled
from diagnosis.effects.base import HINGE, SLIDE, Candidate, Place, joints_of, runge_kutta
from diagnosis.simulation.batch import Engine
from diagnosis.simulation.control_signal import SLACK

CHUNK_BYTES = 64e6  # of trajectory in memory at a time


class Window(NamedTuple):
    """Rows first..last, both included, of a Recording (recordings.py)."""

    recording: object
    first: int
    last: int


class World:
    """`model` is the nominal MjModel, `candidates` the whole catalogue on it.

    A joint, actuator, body, geom or sensor without a name is named by its index.
    """

    def __init__(self, spec):
        self.spec = spec.copy()
        with quiet():
            self.spec.compile()
            _name_all(self.spec)
            self.model = self.spec.compile()
        _keep_compiled(self.spec, self.model)
        # a model that is a corrected one has some of the effects already
        s, taken = self.spec, set()
        for elements in (s.actuators, s.joints, s.tendons):
            taken |= {element.name for element in elements}
        self.candidates = [
            Candidate(effect, Place(effect.kind, name), self._parameters(effect, name))
            for effect in EFFECTS
            for name in effect.places(self.model)
            if f"{effect.name}:{name}" not in taken
        ]
        self._engines = {}

    def _parameters(self, effect, name):
        return tuple(effect.parameters(self.model, effect.id(self.model, name)))

    @classmethod
    def load(cls, path):
        """The World of an MJCF file. ValueError, of one line, if it does not compile."""
        try:
            with quiet():
                world = cls(mujoco.MjSpec.from_file(str(path)))
                mujoco.MjSpec.from_string(
                    world.corrected_xml({})[0]
                ).compile()  # before the work: can it be written as one file?
            return world
        except ValueError as error:
            raise ValueError(" ".join(str(error).split())) from None

    @classmethod
    def from_env(cls, env_id):
        """The World of a gymnasium MuJoCo environment's model file. ValueError if it has none."""
        import gymnasium  # only here: a user with an MJCF file does not need it

        try:
            with quiet():  # an old version of an environment is what was asked for
                env = gymnasium.make(env_id)
        except gymnasium.error.Error as error:
            raise ValueError(" ".join(str(error).split())) from None
        try:
            path = getattr(env.unwrapped, "fullpath", None)
        finally:
            env.close()
        if path is None:
            raise ValueError(f"{env_id} is not a MuJoCo environment")
        return cls.load(path)

    @cached_property
    def quick(self):
        """The same World with one evaluation of forces in a time step, for what is a difference of
        two simulations: Runge-Kutta's method takes four."""
        if not runge_kutta(self.model):
            return self
        spec = self.spec.copy()
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        return World(spec)

    def candidate(self, effect, place):
        """The Candidate of an effect and a place, by their names; KeyError if it cannot sit
        there."""
        for candidate in self.candidates:
            if (candidate.effect.name, candidate.place.name) == (effect, place):
                return candidate
        raise KeyError(f"{effect} cannot sit at {place}")

    def curve(self, joint, variable, knots, factor=None, wave=False):
        """Candidate `unknown`: a force in a joint as a curve of 'position:<joint>',
        'velocity:<joint>', 'control:<actuator>' or 'time', linear between knots; its parameters are
        the forces at the knots. See curves.Unknown."""
        return unmodelled.curve(self.model, joint, variable, knots, factor, wave)

    def localised(self, candidate, when):
        """The same candidate acting only under a condition (see Candidate.when)."""
        return replace(candidate, when=when)

    def probes(self, candidate, recordings):
        """Values (P, parameters) worth a first try, for effects whose nominal value has no gradient
        too."""
        return candidate.effect.probes(
            self.model, candidate.effect.id(self.model, candidate.place.name), recordings
        )

    def far(self, candidate, recordings):
        """Values (P, parameters) to try besides a small step."""
        return candidate.effect.far(
            self.model, candidate.effect.id(self.model, candidate.place.name), recordings
        )

    def joints(self, place):
        """Ids of the joints a place belongs to, or None for all."""
        m = self.model
        if place.kind == "joint":  # or two of them, "a+b"
            return set(joints_of(m, place.name))
        if place.kind == "body":
            moved = m.body_weldid[m.jnt_bodyid] == m.body_weldid[m.body(place.name).id]
            return set(np.flatnonzero(moved).tolist())
        if place.kind == "actuator" and m.actuator_trntype[m.actuator(place.name).id] == int(
            mujoco.mjtTrn.mjTRN_JOINT
        ):
            return {m.actuator_trnid[m.actuator(place.name).id, 0]}
        return None

    def moved_by(self, place):
        """Ids of the joints at which what acts at a place is a force, or None for all: a body's
        weight and inertia are that at all joints that carry it."""
        if place.kind != "body":
            return self.joints(place)
        m, out = self.model, set()
        body = m.body(place.name).id
        while body:
            out |= {*range(m.body_jntadr[body], m.body_jntadr[body] + m.body_jntnum[body])}
            body = m.body_parentid[body]
        return out

    def adds_states(self, candidate):
        """Whether an effect brings coordinates (backlash) or states (bristles) of its own."""
        if not candidate.effect.overrides("build"):
            return False
        engine = self.engine(frozenset([candidate]))
        return engine.model.nv > self.model.nv or bool(engine.hidden.any())

    def simulate(
        self, settings, start_qpos, start_qvel, windows, refine=1, sensors=False, begun=None
    ):
        """Predict what the sensors show in S windows, each under its own setting.

        settings: S dicts {Candidate: values}, values being the candidate's parameters in
            order, absolute. An empty dict is the nominal model. Simulations that share
            one dict object share the work of preparing it.
        start_qpos (S, nq), start_qvel (S, nv): the state at each window's first row as
            the joints' sensors show it (under sensor_bias and the like of the setting).
        windows: S Windows. Each runs on its recording's control, held between rows;
            delays, lags and filters run on from the control recorded before the window (before
            the first row: its control, for ever).
        refine: divide the simulator's time step by this integer.
        sensors: also predict the model's sensors.
        begun: a setting under which what recordings do not show (bristles, plays, springs) is
            followed up to each window's first row, for simulations whose hidden states are its own
            too; else each simulation's own setting.

        Returns qpos (S, T, nq), qvel (S, T, nv), and with `sensors` sensordata (S, T,
        nsensordata), at the rows of each window, T the most rows of any; row 0 of qpos and
        qvel is the start. NaN where a window has fewer rows, and in all later rows of a
        simulation that became unstable or whose setting MuJoCo refuses. Rows that fall
        between time steps are interpolated. The same input gives the same output.
        """
        rows = max(w.last - w.first + 1 for w in windows)
        out = [
            np.full((len(windows), rows, n), np.nan)
            for n in (self.model.nq, self.model.nv, self.model.nsensordata)
        ]
        cases, groups, first = {}, {}, begun and Case(self.model, begun, refine)
        for s, setting in enumerate(settings):
            if id(setting) not in cases:
                cases[id(setting)] = case = Case(self.model, setting, refine)
                if first and (first.structure, first.step) == (case.structure, case.step):
                    case.followed = first
            case = cases[id(setting)]
            groups.setdefault((case.structure, case.step, case.stepwise, case.late), []).append(
                (s, case)
            )
        starts = np.asarray(start_qpos, float), np.asarray(start_qvel, float)
        with quiet():
            for members in groups.values():
                self._run(members, starts, windows, sensors, out)
        return tuple(out) if sensors else tuple(out[:2])

    def _run(self, members, starts, windows, sensors, out):
        """Fill out for members [(simulation, Case)] alike in structure, step and way of
        stepping."""
        _, first = members[0]
        engine, step = self.engine(first.structure), first.step
        duration = max(
            r.time[last] - r.time[begin] for r, begin, last in (windows[s] for s, _ in members)
        )
        count = max(1, int(np.ceil(duration / step - SLACK)))
        width = self.model.nu + engine.model.nq + engine.model.nv + sensors * self.model.nsensordata
        chunk = int(np.clip(CHUNK_BYTES / (8 * count * width), 1, 1024))
        for k in range(0, len(members), chunk):
            ids, chosen = zip(*members[k : k + chunk])
            ids = list(ids)
            run = engine.run(
                chosen,
                *(start[ids] for start in starts),
                [windows[s] for s in ids],
                out[0].shape[1],
                step,
                count,
                sensors,
            )
            for whole, part in zip(out, run):
                whole[ids] = part

    def engine(self, structure):
        """The Engine for a frozenset of the candidates that need parts of their own, made once."""
        if structure not in self._engines:
            self._engines[structure] = Engine(self.spec, self.model, structure)
        return self._engines[structure]

    def corrected_xml(self, setting):
        """The model with the effects of a setting, as MJCF for stock MuJoCo.

        Returns (xml, {Candidate: 'mjcf' | 'measurement' | 'none'}): where each effect is
        held. Values keep all their digits; paths of meshes and other files become absolute.
        """
        spec, written = self.spec.copy(), {candidate: "mjcf" for candidate in setting}
        for candidate, values in sorted(Case(self.model, setting, 1).on, key=_when_written):
            i = candidate.effect.id(self.model, candidate.place.name)
            held = "none" if candidate.when else candidate.effect.write(spec, self.model, i, values)
            written[candidate] = held
        for actuator in spec.actuators:  # its history must reach back far enough
            if actuator.delay > 0:
                late = int(np.ceil(actuator.delay / spec.option.timestep - 1e-9))
                actuator.nsample = max(actuator.nsample, late + 1)
        folder = Path(self.spec.modelfiledir).absolute()
        spec.meshdir, spec.texturedir = (
            str(folder / part) for part in (self.spec.meshdir, self.spec.texturedir)
        )
        spec.compiler.savecompiled = spec.compiler.savecanonical = False
        with quiet():
            if spec.keys:
                self._move_keys(spec)
            spec.compile()
            return spec.to_xml(), written

    def _move_keys(self, spec):
        """Fit the keyframes of a corrected spec to its joints: some may have been added between
        the others, and zeros moved."""
        model = spec.compile()
        for key, old in zip(spec.keys, self.model.key_qpos):
            place = model.qpos0.copy()
            for mine in map(self.model.joint, range(self.model.njnt)):
                its, width = model.joint(mine.name), len(mine.qpos0)
                moved = its.qpos0 - mine.qpos0 if mine.type[0] in (HINGE, SLIDE) else 0.0
                at, of = its.qposadr[0], mine.qposadr[0]
                place[at : at + width] = old[of : of + width] + moved
            key.qpos = place


def _name_all(spec):
    """Give a name to every joint, actuator, body, geom and sensor of a compiled spec: its index."""
    for elements in (spec.joints, spec.actuators, spec.bodies[1:], spec.geoms, spec.sensors):
        taken = {element.name for element in elements}
        for element in elements:
            if not element.name:
                index = str(element.id)
                element.name = f"index {index}" if index in taken else index


def _keep_compiled(spec, model):
    """Write into spec what the compiler works out of other numbers: of another mass or range it
    would work out something else, and these may be what is wrong."""
    for actuator in spec.actuators:
        compiled = model.actuator(actuator.name)
        if actuator.biasprm[2] > 0:
            actuator.biasprm[2] = compiled.biasprm[2]
        if actuator.inheritrange > 0:
            integrates = actuator.dyntype == mujoco.mjtDyn.mjDYN_INTEGRATOR
            field = "actrange" if integrates else "ctrlrange"
            setattr(actuator, field, getattr(compiled, field).ravel())
            actuator.inheritrange = 0
    for joint in spec.joints:
        if any(joint.springdamper):
            compiled = model.joint(joint.name)
            joint.stiffness = [compiled.stiffness[0], 0, 0]
            joint.damping, joint.springdamper = [compiled.damping[0], 0, 0], [0, 0]


def _when_written(item):
    """Key by which (candidate, values) are written: the time step first, then delays, of which the
    shortest may refine it, then what is written by it."""
    effect, values = item[0].effect, item[1]
    return not effect.numerical, not effect.delays, values[0] if effect.delays else 0.0


def step_of(model, setting):
    """The time step, s, of a setting {Candidate: values}: the model's own without another."""
    return next((float(v[0]) for c, v in setting.items() if c.effect.numerical), model.opt.timestep)


class Case:
    """One setting, resolved: `on` [(candidate, values)] in the order of the catalogue, without
    those at their nominal values; `off` those that act without a condition; `when` the condition of
    the others, if any; `followed` the Case under which hidden states are followed."""

    def __init__(self, model, setting, refine):
        order = {effect: k for k, effect in enumerate(EFFECTS)}
        items = [(c, tuple(float(v) for v in values)) for c, values in setting.items()]
        items = [(c, v) for c, v in items if v != c.nominal]
        self.on = sorted(items, key=lambda item: order.get(item[0].effect, len(order)))
        self.off = [(c, v) for c, v in self.on if not c.when]
        conditions = [c.when for c, _ in self.on if c.when]
        if any(when != conditions[0] for when in conditions):
            raise ValueError("effects under different conditions cannot be simulated together")
        self.when = conditions[0] if conditions else None
        self.step, self.followed = step_of(model, setting) / refine, self
        self.structure = frozenset(c for c, _ in self.on if c.effect.overrides("build"))
        place = lambda c: c.effect.id(model, c.place.name)
        self.stepwise = bool(self.when) or any(
            c.effect.stepwise(model, place(c)) for c, _ in self.on
        )
        self.late = any(
            c.effect.measure(v)[2] for c, v in self.on
        )  # which takes a start of its own
