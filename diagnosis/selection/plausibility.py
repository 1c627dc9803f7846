"""How plausible values are: weak, proper priors in units of the machine, in one table.

usual = Usual(world, recordings, force)            # what the machine does
prior = plausible(candidate, usual)                # centre, scale, low, high of each parameter
"""

from dataclasses import dataclass

import numpy as np

from diagnosis.effects.actuators import ActuatorEffect
from diagnosis.effects.base import joints_of
from diagnosis.effects.bodies import size_of
from diagnosis.effects.unmodelled import asked
from diagnosis.estimation import windowing

WAVE = ("waves", np.inf, 1.0, np.inf), ("plain", np.inf, -10, 10)  # its number, its phase
TAIL = 4.0  # degrees of freedom of the priors: Student's, for surprises happen

# of each effect: (unit, scale, low, high), one row for all its parameters, or one for each. Units:
#   plain: the parameter's own                  times: the nominal value
#   force: what is usual in the joint           inertia: what the joint moves
#   missing: what the nominal model lacks in the joint, over the size of what a curve is times
#   per speed, per travel: so much force at the joint's usual speed, or travel
#   speed: the joint's usual one                waves: one wave over its recorded range
#   travel: the joint's recorded range          size, weight: the body's
#   used: the largest force that the controls ask for
TABLE = {
    "mass": [("times", 0.4, 0.05, 30.0)],
    "payload_change": [("times", 0.4, 0.3, 3.0)],
    "center_of_mass": [("size", 0.3, -1.5, 1.5)],
    "inertia": [("times", 0.4, 0.25, 4.0)],
    "armature": [("inertia", 0.5, 0.0, 20.0)],
    "viscous_damping": [("per speed", 0.7, 0.0, 5.0)],
    "quadratic_damping": [("per speed²", 0.5, 0.0, 5.0)],
    "back_emf": [("per speed", 0.7, 0.0, 5.0)],
    "coulomb_friction": [("force", 0.7, 0.0, 3.0)],
    "stribeck_friction": [
        ("force", 0.7, 0.0, 3.0),
        ("force", 0.7, 0.0, 3.0),
        ("speed", np.inf, 0.0, 1.0),  # what still falls beyond is another law
    ],
    "stiffness": [("per travel", 0.5, 0.0, 5.0)],
    "nonlinear_stiffness": [("per travel³", 0.5, -5.0, 5.0)],
    "spring_offset": [("force", 0.5, -2.0, 2.0)],
    "cogging": [("force", 0.7, -3.0, 3.0), *WAVE],
    "backlash": [("travel", 0.05, 0.0, 0.3)],
    "gain": [("times", 0.25, 0.2, 5.0)],
    "bias": [("force", 0.5, -2.0, 2.0)],  # in a drive on a joint it is a spring_offset
    "saturation": [("given", np.inf, 0.05, np.inf)],
    "torque_speed": [("plain", np.inf, 0.0, np.inf), ("used", np.inf, 0.05, np.inf)],
    "delay": [("plain", 0.03, 0.0, 0.15)],
    "lag": [("plain", 0.03, 0.0, 0.3)],
    "dead_zone": [("used", 0.15, 0.0, 1.0)],
    "gravity": [("plain", 1.0, -12.0, 12.0)],
    "wind": [("plain", 3.0, -30.0, 30.0)],
    "air_drag": [("plain", np.inf, 0.0, 3000.0)],
    "contact_friction": [("times", 0.5, 0.15, 5.0)],
    "contact_stiffness": [("times", 3.0, 0.02, 50.0)],
    "contact_damping": [("times", 3.0, 0.02, 50.0)],
    "ground_height": [("plain", 0.02, -0.1, 0.1)],
    "sensor_bias": [("plain", 0.05, -0.5, 0.5)],
    "sensor_scale": [("times", 0.05, 0.5, 2.0)],
    "sensor_delay": [("plain", 0.02, 0.0, 0.1)],
    "external_force": [("weight", 0.1, -2.0, 2.0)],
    "link_length": [("times", 0.1, 0.3, 3.0)],
    "load_friction": [("plain", 0.3, 0.0, 0.9), ("plain", 0.3, 0.0, 0.9), ("plain", 0.5, 0.0, 1.0)],
    "friction_map": [("force", 0.7, 0.0, 3.0), ("plain", 0.5, 0.0, 1.0), *WAVE],
    "servo_stiffness": [("times", 0.25, 0.4, 2.5)],
    "servo_damping": [("times", 0.4, 0.2, 5.0)],
    "coupled_friction": [("force", 0.7, 0.0, 3.0)],
    # a softer bristle never yields: it is a spring
    "presliding": [("force", 0.7, 0.0, 3.0), ("per travel", np.inf, 0.1, np.inf)],
    "coupled_inertia": [("inertia", 0.5, 0.0, 20.0)],
    "gain_fade": [("plain", 0.05, 0.0, 0.5)],
    "unknown": [("missing", 3.0, -20.0, 20.0)],
}
AWAY = "gravity ground_height bias spring_offset center_of_mass external_force wind".split()
# where the nominal value is zero and "times" says nothing
NONE = {"servo_damping": "per speed", "contact_friction": "plain"}
PUSH = 20.0  # times what may last: what acts for a while may be larger
STRENGTH = 0.04  # share by which gravity's strength may differ from the model's


@dataclass(frozen=True)
class Prior:
    """Of one candidate's parameters (k,): nominal centre and scale of a Student's t; low and high
    bounds."""

    centre: np.ndarray
    scale: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def cost(self, values):
        """Minus the log density, but for a constant: nats."""
        z = (np.asarray(values) - self.centre) / self.scale
        return float(0.5 * (TAIL + 1) * np.log1p(z**2 / TAIL).sum())

    def precision(self, values):
        """Curvature of the cost for iterated least squares, (k,)."""
        z = (np.asarray(values) - self.centre) / self.scale
        return (TAIL + 1) / TAIL / self.scale**2 / (1 + z**2 / TAIL)

    def inside(self, values):
        return bool((values >= self.low).all() and (values <= self.high).all())


class Usual:
    """What a machine usually does: force (nv,), speed (nv,) and travel (nv,) of each dof, forces
    asked of actuators."""

    def __init__(self, world, recordings, force, missing=None, motion=None, lacking=None):
        """missing (nv,): RMS of the force that the nominal model lacks, if it is located. motion:
        (qpos, qvel) of all rows, smoothed; by default as they were measured. lacking (n, nv): that
        force in these rows."""
        model = world.model
        measured = zip(*(windowing.states(model, r) for r in recordings))
        self.motion = motion or [np.concatenate(x) for x in measured]
        qpos, qvel = self.motion
        gone = windowing.difference(model, np.broadcast_to(model.qpos_spring, qpos.shape), qpos)
        self.model, self.force, self.recordings = model, force, recordings
        self.missing, self.lacking = missing, lacking
        self.speed = np.sqrt(np.mean(qvel**2, axis=0)) + 1e-9
        self.travel = np.quantile(abs(gone), 0.95, axis=0) + 1e-9
        self.range = np.ptp(np.quantile(gone, [0.01, 0.99], axis=0), axis=0) + 1e-9

    def dof(self, place):
        """The dof of a joint's place, or of the joint an actuator acts on; None elsewhere."""
        if place.kind == "joint":
            first, *_ = joints_of(self.model, place.name)  # of two that an effect couples
            return self.model.jnt_dofadr[first]
        if place.kind == "actuator":
            i = self.model.actuator(place.name).id
            if ActuatorEffect.on_joint(self.model, i):
                return self.model.jnt_dofadr[self.model.actuator_trnid[i, 0]]
        return None

    def unit(self, kind, candidate):
        """Size of a unit of the table for a candidate."""
        place, model, d = candidate.place, self.model, self.dof(candidate.place)
        if kind == "plain":
            return 1.0
        if kind == "size":
            return size_of(model, model.body(place.name).id)
        if kind == "weight":
            return 10.0 * model.body_subtreemass[model.body(place.name).id]
        if kind == "used" or (kind == "force" and place.kind == "actuator" and d is None):
            i = model.actuator(place.name).id
            used = np.quantile(ActuatorEffect.forces(model, i, self.recordings), 0.995)
            motor = candidate.effect.name == "dead_zone" and not ActuatorEffect.servo(model, i)
            return max(used, 1e-9) / (abs(model.actuator_gainprm[i, 0]) if motor else 1.0)
        if kind == "given":
            return self._given(candidate)
        if d is None:
            return np.inf
        if kind == "missing":
            return np.inf if self.missing is None else self.missing[d] / self._times(candidate)
        gear = 1.0
        if place.kind == "actuator":
            gear = abs(model.actuator_gear[model.actuator(place.name).id, 0]) or 1.0
        return {
            "force": self.force[d] / gear,
            "inertia": model.dof_M0[d],
            "per speed": self.force[d] / self.speed[d] / gear**2,
            "per speed²": self.force[d] / self.speed[d] ** 2,
            "per travel": self.force[d] / self.travel[d],
            "per travel³": self.force[d] / self.travel[d] ** 3,
            "travel": self.range[d],
            "speed": self.speed[d],
            "waves": 2 * np.pi / self.range[d],
        }[kind]

    def _given(self, candidate):
        """What a drive gave at most, as far as the motion tells: what a servo asks for grows with
        its error, so of that what the motion needed; of a motor, what was asked for."""
        model, d = self.model, self.dof(candidate.place)
        i = model.actuator(candidate.place.name).id
        if d is None or self.lacking is None or not ActuatorEffect.servo(model, i):
            return self.unit("used", candidate)
        nominal = model.actuator_gainprm[i, 0] * self._asked(i)
        nominal = ActuatorEffect.limited(model, i, nominal)
        gave = nominal + self.lacking[:, d] / model.actuator_gear[i, 0]
        return max(np.nanquantile(abs(gave), 0.995), 1e-9)

    def _times(self, curve):
        """RMS of what a curve is multiplied by."""
        kind, _, name = (curve.effect.factor or "").partition(":")
        if kind in ("speed", "damping"):
            return self.speed[self.model.joint(name).dofadr[0]]
        if kind != "control":
            return 1.0
        return np.sqrt(np.nanmean(self._asked(self.model.actuator(name).id) ** 2)) + 1e-9

    def _asked(self, i):
        """(n,) what an actuator is asked for along the motion."""
        ctrl = np.concatenate([r.ctrl for r in self.recordings])
        return asked([self.model], i, *self.motion, ctrl)


def plausible(candidate, usual):
    """The Prior of a candidate on a machine. An effect without a row may have any value its
    parameters allow."""
    parameters = candidate.parameters
    nominal = np.array([p.nominal for p in parameters], float)
    passing = PUSH if candidate.when else 1.0
    rows = TABLE.get(candidate.effect.name, [("plain", np.inf, -np.inf, np.inf)])
    rows = rows if len(rows) == len(parameters) else rows * len(parameters)
    scale, low, high = np.empty(len(rows)), np.empty(len(rows)), np.empty(len(rows))
    for k, (kind, s, a, b) in enumerate(rows):
        kind = NONE.get(candidate.effect.name, kind) if kind == "times" and not nominal[k] else kind
        ratio = kind == "times"
        unit = abs(nominal[k]) if ratio else usual.unit(kind, candidate)
        if kind.startswith("per ") and not candidate.effect.overrides("probes"):
            unit = max(unit, abs(nominal[k]))  # what there is may change by as much
        shift = nominal[k] if candidate.effect.name in AWAY else 0.0
        shape = 0 < candidate.effect.amplitudes <= k
        further = 1.0 if ratio or shape else passing
        ends = np.array([a, b]) * unit * further + shift if np.isfinite(unit) else (-np.inf, np.inf)
        scale[k] = s * unit if np.isfinite(s * unit) and s * unit > 0 else np.inf
        low[k], high[k] = np.clip([min(ends), max(ends)], parameters[k].low, parameters[k].high)
        if np.isfinite(nominal[k]) and not shape:  # of a shape, a nominal value means nothing
            low[k], high[k] = min(low[k], nominal[k]), max(high[k], nominal[k])
    return Prior(np.where(np.isfinite(nominal), nominal, 0.0), scale, low, high)


def at_limit(candidate, values, prior):
    """Whether a value lies at a bound of what is plausible: then the truth may lie anywhere beyond.
    At a bound of what is possible (no spring at all, a share of one) nothing lies beyond."""
    values = np.asarray(values, float)
    ends = np.array([(p.low, p.high) for p in candidate.parameters]).T
    room = 1e-3 * (abs(values) + np.where(np.isfinite(prior.scale), prior.scale, 0.0))
    low = (values <= prior.low + room) & (prior.low > ends[0])
    high = (values >= prior.high - room) & (prior.high < ends[1])
    return bool(((low | high) & (abs(values - prior.centre) > room)).any())


def possible(candidate, values, prior):
    """Whether values are inside the bounds, and physics as a whole: gravity may tilt, but hardly
    change its strength."""
    if not prior.inside(np.asarray(values)):
        return False
    if candidate.effect.name == "gravity" and np.linalg.norm(candidate.nominal) > 0:
        ratio = np.linalg.norm(values) / np.linalg.norm(candidate.nominal)
        return abs(ratio - 1) <= STRENGTH
    return bool(candidate.effect.possible(values, candidate.nominal))


def cost(candidate, values, prior):
    """Minus the log prior density of values, nats; infinite where they are not possible."""
    return prior.cost(values) if possible(candidate, values, prior) else np.inf
