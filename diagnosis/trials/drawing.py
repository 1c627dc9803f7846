"""A trial: robots, what is hidden between them, the experiment, the folder that a tool gets.

    trial = draw_trial(key=(1, 7), settings=DEVELOPMENT)
    write_folder(trial, Path("bench"))       # sim.xml, train_0.csv, train_1.csv, …

Everything follows from the key and the settings, so that anyone can draw the same trial again.
"""

from dataclasses import asdict, dataclass, field, replace

import mujoco
import numpy as np

from diagnosis.trials import groups, hiding
from diagnosis.trials.disguise import disguise
from diagnosis.trials.experiment import Plan, channel_noise, record
from diagnosis.trials.gates import gate, gate_name
from diagnosis.trials.hiding import Usage
from diagnosis.trials.laws import Gate
from diagnosis.trials.mjcf import to_mjcf
from diagnosis.trials.oracle import visibility
from diagnosis.trials.prediction import model_error, system_error
from diagnosis.trials.robots import TOUCHES, Robot, draw_robot, loguniform
from diagnosis.trials.truth import TrueSystem

KINDS = ("null", "single", "unknown", "pair", "many")
SHARES = (0.25, 0.33, 0.2, 0.14, 0.08)
ATTEMPTS = 100
MOST_NOISE = 4e-3  # rad
TOUCHED = 0.02  # share of the time that a contact or a stop has to act, where one can
FINEST = 5e-4  # s, of a nominal step
AGREEMENT = 0.5  # noise: most that the nominal integrator may be away from the true one


@dataclass(frozen=True)
class Trial:
    """answer: JSON-able dict of everything hidden and its conditions; the rest is for scoring.

    nominal, true: Robots; laws: of the true one; items: hiding.Item each; owners: for each law the
    index of its item; train, held_out: Runs; noise (nv,): true standard deviation per dof.
    """

    answer: dict
    nominal: Robot
    true: Robot
    laws: list = field(repr=False)
    items: list
    owners: list
    changes: list = field(repr=False)
    train: list = field(repr=False)
    held_out: list = field(repr=False)
    noise: np.ndarray

    def system(self):
        """The true machine, new."""
        return TrueSystem(self.true, self.laws)

    def without(self, index):
        """(TrueSystem, kept laws' indices): the true machine with item `index` as in the
        nominal."""
        kept = [k for k, owner in enumerate(self.owners) if owner != index]
        true = self.nominal
        # values fitted wrong were right before anything was hidden
        order = sorted(range(len(self.changes)), key=lambda k: self.items[k].required)
        for k in order:
            if k != index:
                true = self.changes[k](true)
        return TrueSystem(true, [self.laws[k] for k in kept]), kept


class Unfit(Exception):
    """A draw that no experiment can be made with; the next attempt is drawn."""


def draw_trial(key, settings):
    """The Trial of a key, a tuple of integers. Raises RuntimeError after too many unfit draws."""
    rng = np.random.default_rng([*key, 0])
    kind = str(rng.choice(KINDS, p=SHARES))
    touch = str(rng.choice(TOUCHES, p=settings.touches))
    touch = touch if rng.random() < settings.touching else None
    for attempt in range(ATTEMPTS):
        rng = np.random.default_rng([*key, 1, attempt])
        try:
            return _attempt(rng, kind, touch, settings, attempt)
        except Unfit:
            continue
    raise RuntimeError(f"trial {key}: no sane experiment in {ATTEMPTS} attempts")


def _attempt(rng, kind, touch, settings, attempt):
    robot = draw_robot(rng, settings, touch)
    plan = draw_plan(rng, settings)
    usage = observe(robot, plan, rng)
    robot, plan = _agree(robot, plan, channel_noise(robot, plan.noise), rng)
    mimic = kind == "pair" and rng.random() < 0.4
    chosen = choose(rng, kind, robot, mimic)
    target = loguniform(rng, *settings.size_over_noise)
    trial = _hide_all(rng, kind, settings, robot, plan, usage, chosen, target)
    train, held_out = [], []
    system = trial.system()
    for number in range(settings.train_runs + settings.held_out_runs):
        run = record(system, plan, rng, number)
        if run is None:
            raise Unfit
        (train if number < settings.train_runs else held_out).append(run)
    trial = replace(trial, train=train, held_out=held_out)
    fitted = kind != "null" and trial.answer["gate"] is None and rng.random() < 0.2
    if fitted:
        trial = _disguised(trial)
    answer = _answer(trial, kind, plan, settings) | {
        "target": round(target, 4),
        "attempt": attempt,
        "mimic": bool(mimic),
        "fitted_without": any(not item.required for item in trial.items),
        "motorless": _motorless(chosen),
    }
    trial = replace(trial, answer=answer)
    shown = [visibility(trial, k) for k, item in enumerate(trial.items) if item.required]
    more = {
        "alone": [s.alone for s in shown],
        "apart": [s.apart for s in shown],
        "visible": [s.visible for s in shown],
        "distinct": [s.distinct for s in shown],
    }
    return replace(trial, answer=answer | more)


def _hide_all(rng, kind, settings, robot, plan, usage, chosen, target):
    """The Trial before anything is recorded; its answer holds the gate and the plan only."""
    noise = channel_noise(robot, plan.noise)
    nominal, true, laws, items, owners, setters = robot, robot, [], [], [], []
    for effect, spot in chosen:
        seed = int(rng.integers(2**31))
        removed = effect in groups.REMOVABLE and rng.random() < 0.55
        size = _fit_size(effect, spot, removed, robot, usage, plan, noise, seed, target)
        fresh = np.random.default_rng(seed)
        nominal, true, more, item = hiding.hide(
            effect, spot, size, removed, nominal, true, usage, fresh
        )
        setters.append(_setter(effect, spot, item.parameters))
        owners += [len(items)] * len(more)
        alone = kind in ("single", "unknown")
        more = gate(rng, more, plan, settings, usage) if alone else more
        if any(isinstance(law, Gate) and law.within for law in more):
            position = f"position:{robot.links[spot.link].joint_name}"
            item = replace(item, needs=tuple(dict.fromkeys((*item.needs, position))))
        laws += more
        items.append(item)
    answer = {"gate": gate_name(laws), "plan": asdict(plan)}
    return Trial(answer, nominal, true, laws, items, owners, setters, [], [], noise)


def _disguised(trial):
    """The Trial with nominal values fitted by someone who did not know of what is hidden."""
    nominal, wrong = disguise(trial.nominal, trial.true, trial.items, trial.train, trial.noise)
    index = {k.name: i for i, k in enumerate(nominal.links)}
    index |= {k.joint_name: i for i, k in enumerate(nominal.links)}
    right = [
        _setter(item.effect, hiding.Spot(index[item.place["name"]]), item.parameters)
        for item in wrong
    ]
    return replace(trial, nominal=nominal, items=trial.items + wrong, changes=trial.changes + right)


def _motorless(chosen):
    """Is something hidden in a joint without a drive?"""
    bare = {*groups.OF_BODIES, *groups.OF_WORLD, *groups.OF_GROUND}
    return any(spot.actuator < 0 and effect not in bare for effect, spot in chosen)


def draw_plan(rng, settings):
    """The conditions of the recordings."""
    return Plan(
        row=float(rng.choice(settings.row_seconds)),
        level=str(rng.choice(("gentle", "brisk", "violent"), p=(0.25, 0.5, 0.25))),
        feedback=str(rng.choice(("closed", "open"), p=(0.75, 0.25))),
        noise=loguniform(rng, *settings.noise),
        noise_kind=str(rng.choice(("white", "coloured", "quantised"), p=(0.6, 0.2, 0.2))),
        velocities=str(rng.choice(("none", "noisy", "filtered"), p=(0.6, 0.25, 0.15))),
        stamps=str(rng.choice(("regular", "irregular", "jitter"), p=(0.8, 0.1, 0.1))),
        missing=float(rng.choice((0.0, 0.03), p=(0.9, 0.1))),
        seconds=settings.run_seconds,
    )


def observe(robot, plan, rng):
    """Usage of a robot: one recording without anything hidden. Raises Unfit."""
    system = TrueSystem(robot)
    run = record(system, replace(plan, missing=0.0), rng, states=False)
    if run is None or may_touch(robot) and run.touched < TOUCHED:
        raise Unfit
    data = mujoco.MjData(system.model)
    loads, mobility, torques = [], [], []
    for row in range(0, len(run.time), 5):
        data.qpos[:], data.qvel[:] = run.true_qpos[row], run.true_qvel[row]
        mujoco.mj_forward(system.model, data)
        inverse = np.zeros((system.model.nv,) * 2)
        mujoco.mj_solveM(system.model, data, inverse, np.eye(system.model.nv))
        mobility.append(np.diag(inverse).copy())
        bias = np.zeros(len(robot.links))
        bias[system.jointed] = data.qfrc_bias[system.dof[system.jointed]]
        system.q[system.jointed] = run.true_qpos[row][system.address[system.jointed]]
        system.v[system.jointed] = run.true_qvel[row][system.dof[system.jointed]]
        torque = np.zeros(len(robot.links))
        push = system.feed * run.ctrl[row] + system.bias
        push = push - system.stiff * system.q[system.driven] - system.slow * system.v[system.driven]
        torque[system.driven] = np.clip(push, -system.most, system.most)
        torques.append(np.abs(torque))
        loads.append(np.maximum(np.abs(torque), np.abs(bias)))
    count = len(robot.links)
    inertia, spread, speed = (np.full(count, np.nan) for _ in range(3))
    quantiles = np.full((count, 101), np.nan)
    for i in system.jointed:
        inertia[i] = 1 / np.mean(mobility, 0)[system.dof[i]]
        q = run.true_qpos[:, system.address[i]]
        spread[i], quantiles[i] = q.std() + 1e-4, np.quantile(q, np.linspace(0, 1, 101))
        speed[i] = np.sqrt(np.mean(run.true_qvel[:, system.dof[i]] ** 2)) + 1e-3
    return Usage(
        spread,
        speed,
        np.sqrt(np.mean(np.square(loads), 0)) + 1e-9,
        inertia,
        quantiles,
        np.quantile(torques, np.linspace(0, 1, 101), axis=0).T,
        np.sqrt(np.mean(np.square(run.ctrl), 0)) + 1e-9,
    )


def _agree(robot, plan, noise, rng):
    """(robot, plan) whose nominal integrator follows the true one to within AGREEMENT × the noise.

    The nominal step is halved once, with contacts twice; what is left is met by noisier sensors.
    """
    run = record(TrueSystem(robot), replace(plan, seconds=1.5, missing=0.0), rng)
    if run is None:
        raise Unfit
    for halvings in range(3 if may_touch(robot) else 2):
        if halvings and robot.step > FINEST:
            robot = replace(robot, step=robot.step / 2)
        error = integration_error(robot, run, noise)
        if error <= AGREEMENT:
            return robot, plan
    noisier = plan.noise * error / AGREEMENT
    if noisier > MOST_NOISE:
        raise Unfit
    return robot, replace(plan, noise=noisier)


def may_touch(robot):
    """Has a Robot feet on a ground, or joint ranges?"""
    return robot.ground or any(link.range for link in robot.links)


def integration_error(robot, run, noise):
    """How far the nominal model's integrator alone moves predictions, over the noise."""
    model = mujoco.MjModel.from_xml_string(to_mjcf(robot))
    exact = replace(run, qpos=run.true_qpos, qvel=run.true_qvel, time=run.stamps)
    return model_error(model, model, [exact], noise)


def choose(rng, kind, robot, mimic=False):
    """[(effect, Spot)] to hide; every effect that this robot offers is equally likely.

    mimic: two effects at one place that pass for each other.
    """
    count = {"null": 0, "single": 1, "unknown": 1, "pair": 2, "many": int(rng.integers(3, 5))}[kind]
    names = groups.UNNAMED if kind == "unknown" else (*groups.FIELDS, *groups.LAWS)
    offers = {name: hiding.places(robot, name) for name in names}
    offers = {name: spots for name, spots in offers.items() if spots}
    if mimic:
        return _mimics(rng, offers)
    if len(offers) < count:
        raise Unfit
    effects = [str(e) for e in rng.choice(sorted(offers), count, replace=False)]
    if any(sum(e in family for e in effects) > 1 for family in groups.FAMILIES):
        raise Unfit
    if kind != "single" and "payload_change" in effects:  # it needs its moment
        raise Unfit
    chosen = []
    for effect in effects:
        spot = offers[effect][rng.integers(len(offers[effect]))]
        chosen.append((effect, replace(spot, sign=float(rng.choice((-1, 1))))))
    if any(_one_law(chosen, family) for family in groups.ONE_LAW):
        raise Unfit
    return chosen


def _one_law(chosen, family):
    """Whether two of a family are chosen at one link."""
    links = [spot.link for effect, spot in chosen if effect in family]
    return len(set(links)) < len(links)


def _mimics(rng, offers):
    """Two effects of groups.MIMICS at the same link. Raises Unfit."""
    both = [
        (a, spot, b, other)
        for a, b in groups.MIMICS
        for spot in offers.get(a, ())
        for other in offers.get(b, ())
        if spot.link == other.link
    ]
    if not both:
        raise Unfit
    a, spot, b, other = both[rng.integers(len(both))]
    sign = lambda: float(rng.choice((-1, 1)))
    return [(a, replace(spot, sign=sign())), (b, replace(other, sign=sign()))]


def _fit_size(effect, spot, removed, robot, usage, plan, noise, seed, target):
    """Relative size at which the effect alone moves predictions by about `target` × the noise."""
    size, moved = 0.1, 0.0
    for _ in range(6):
        rng = np.random.default_rng(seed)
        nominal, true, laws, _ = hiding.hide(effect, spot, size, removed, robot, robot, usage, rng)
        brief = replace(plan, seconds=1.3, missing=0.0)
        run = record(TrueSystem(true, laws), brief, np.random.default_rng(seed))
        if run is None:
            size /= 4
            continue
        moved = system_error(TrueSystem(nominal), [run], noise, perfect=True, kept=())
        if 0.6 * target < moved < 1.6 * target:
            break
        size = float(np.clip(size * np.clip(target / max(moved, 1e-9), 0.2, 6.0), 1e-3, 1.0))
    if not 1.0 <= moved <= 4 * target:
        raise Unfit
    return size


def _setter(effect, spot, values):
    """A function that gives a Robot this item's true values; laws change no Robot."""
    if effect not in groups.FIELDS and effect != groups.WRONG_AXIS:
        return lambda robot: robot
    return lambda robot: hiding.set_field(effect, spot, robot, values)


def told_item(item, nominal, true):
    """An Item as findings tell it: a gain as a share of what the nominal model has, which is in the
    feedback of its servos too, and a bias as what is added to that."""
    told, values = item.to_json(), item.parameters
    if item.effect not in ("gain", "bias", "servo_stiffness", "servo_damping"):
        return told
    before, after = (
        next(a for a in robot.actuators if a.name == item.place["name"])
        for robot in (nominal, true)
    )
    if item.effect == "gain":
        values = {"gain": values["gain"] / before.gain}
    elif item.effect == "bias":
        values = {"bias": values["bias"] - before.bias * after.gain / before.gain}
    else:
        values = {name: value * before.gain for name, value in values.items()}
    return told | {"parameters": values}


def _answer(trial, kind, plan, settings):
    """The JSON-able answer of a trial, with the sizes over the noise in both sets of recordings."""
    sizes = {}
    for name in ("train", "held_out"):
        runs, sizes[name] = getattr(trial, name), []
        for index in range(len(trial.items)):
            system, kept = trial.without(index)
            error = system_error(system, runs, trial.noise, True, kept)
            sizes[name].append(round(error, 4))
    links = trial.true.links
    return {
        **trial.answer,
        "kind": kind,
        "hidden": [told_item(item, trial.nominal, trial.true) for item in trial.items],
        "over_noise": sizes["train"],
        "over_noise_held_out": sizes["held_out"],
        "settings": settings.name,
        "joints": len(links),
        "slides": sum(k.joint == "slide" for k in links),
        "free_base": links[0].joint == "free",
        "contact": trial.true.ground,
        "stops": any(k.range for k in links),
        "touched": round(float(np.mean([run.touched for run in trial.train])), 4),
        "passive": len(links) - len(trial.true.actuators) - (links[0].joint == "free"),
        "step": trial.nominal.step,
        "integrator": trial.nominal.integrator,
    }
