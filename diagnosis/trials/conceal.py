"""Concealing a trial: what is hidden, the experiment, the folder that the diagnosis gets, the seal.

    trial = conceal(seed=1, number=7, folder=Path("empty"))
    trial.commitment                                 # SHA-256 of trial.answer + trial.salt

Everything is drawn from (seed, number), so that anyone can draw the same answer again; only the
salt is random. The answer stays in this process.
"""

import hashlib
import json
import secrets
from dataclasses import dataclass, field

import mujoco
import numpy as np

from diagnosis.trials.mechanisms import MECHANISMS, UNKNOWNS
from diagnosis.trials.true_system import Real

FINAL_SEED = 314159  # of the published table: run once, while the method stood still
SIZES = (0.03, 0.1, 0.3)
NOISES = (0.0003, 0.001)  # rad or m per reading
BLOCK = ("null",) * 13 + ("single",) * 24 + ("pair",) * 8 + ("unknown",) * 5
NAMED = {
    "hopper_torso": ("hopper", "torso", 1.27),
    "cheetah_torso": ("half_cheetah", "torso", 1.15),
    "heavy_pole": ("inverted_pendulum_firm", "pole", 100 / 5.0185916),
}
PAIRABLE = (
    "mass",
    "armature",
    "viscous_damping",
    "quadratic_damping",
    "coulomb_friction",
    "stiffness",
    "spring_offset",
    "gain",
    "bias",
    "delay",
    "lag",
    "saturation",
    "gravity",
    "sensor_bias",
    "link_length",
    "contact_friction",
    "external_force",
)
DEPENDS_ON = {
    "friction_patch": ("position", "velocity"),
    "periodic_torque": ("time",),
    "detent": ("position",),
    "one_way_drag": ("velocity",),
    "fading_gain": ("time", "control"),
}


@dataclass
class Trial:
    """answer: JSON text; salt, commitment: hex; command: arguments of diagnose.py inside the folder.

    runs: {file name: Run}, the recordings with what was true beneath them, for scoring.
    """

    answer: str
    salt: str
    commitment: str
    command: list
    runs: dict


@dataclass
class Run:
    """One recording, measured and true. Rows: time (T,), ctrl (T, nu), measured and true qpos, qvel."""

    time: np.ndarray
    ctrl: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray  # NaN where not measured
    true_qpos: np.ndarray  # as an ideal sensor of the same faults reads
    true_qvel: np.ndarray
    states: list = field(repr=False)  # of the Real, per row
    event: np.ndarray = None  # (T,) whether an effect that comes and goes acts


def seal(answer, salt):
    """SHA-256, hex, of the answer and the salt."""
    return hashlib.sha256(f"{answer}{salt}".encode()).hexdigest()


def conceal(seed, number, folder):
    """Draw trial `number` of `seed`, record it into the empty `folder`, return the Trial.

    A draw whose machine flies apart is drawn again with the next attempt.
    """
    for attempt in range(20):
        rng = np.random.default_rng((seed, number, attempt))
        answer = draw(seed, number, rng)
        runs = record(answer, rng)
        if runs is not None:
            break
    else:
        raise RuntimeError(f"trial {number} of seed {seed}: no sane experiment in 20 attempts")
    mechanism = MECHANISMS[answer["mechanism"]]
    for name, run in runs.items():
        if mechanism.env:
            _write_npz(folder / name, run)
        else:
            _write_csv(folder / name, run, mechanism.spec().compile())
    command = [
        "--recordings",
        *sorted(n for n in runs if n.startswith("train")),
        "--held-out",
        *sorted(n for n in runs if n.startswith("held_out")),
    ]
    if mechanism.env:
        command = ["--env", mechanism.env[0], *command]
    else:
        (folder / "sim.xml").write_text(mechanism.xml)
        command = ["--model", "sim.xml", *command]
    text, salt = json.dumps(answer, sort_keys=True), secrets.token_hex(16)
    return Trial(text, salt, seal(text, salt), command, runs)


def draw(seed, number, rng):
    """The answer: a JSON-able dict of everything hidden and of the experiment's conditions."""
    block, place = divmod(number, len(BLOCK))
    order = np.random.default_rng((seed, block, 10**6)).permutation(BLOCK)
    kind = str(order[place])
    nth = block * int((order == kind).sum()) + int((order[:place] == kind).sum())
    mechanism, wanted = _choose(seed, kind, nth, rng)
    model = MECHANISMS[mechanism].spec().compile()
    finer = int(rng.choice((1, 4)))
    scale = _scale(MECHANISMS[mechanism], model, rng)
    hidden = [_item(effect, place, size, model, scale, rng) for effect, place, size in wanted]
    if kind == "pair":
        for item in hidden:
            item["parameters"].pop("event", None)
    if any(item["effect"] == "time_step" for item in hidden):
        finer = 4
    if any(item["effect"] == "backlash" for item in hidden):
        finer = 8
    return {
        "kind": kind,
        "mechanism": mechanism,
        "hidden": hidden,
        "finer": finer,
        "sizes": [float(size) for _, _, size in wanted],
        "noise": float(rng.choice(NOISES)),
        "velocities": bool(rng.random() < 0.25),
        "irregular": bool(MECHANISMS[mechanism].env is None and rng.random() < 0.12),
    }


def _choose(seed, kind, nth, rng):
    """Mechanism and [(effect, place, size)]: every effect at every size in turn."""
    offers = {}
    for mechanism in MECHANISMS.values():
        for effect in mechanism.places:
            offers.setdefault(effect, []).append(mechanism.name)
    deal = lambda cards: cards[
        int(
            np.random.default_rng((seed, nth // len(cards), len(cards))).permutation(len(cards))[
                nth % len(cards)
            ]
        )
    ]
    if kind == "null":
        return deal([name for name, mechanism in MECHANISMS.items() if mechanism.places]), []
    if kind == "unknown":
        effect, size = deal([(effect, size) for effect in UNKNOWNS for size in SIZES])
        mechanism = str(rng.choice(offers[effect]))
        return mechanism, [
            (effect, str(rng.choice(MECHANISMS[mechanism].places[effect])), 2 * size)
        ]
    if kind == "single":
        cards = [
            (effect, size) for effect in sorted(offers) if effect not in UNKNOWNS for size in SIZES
        ]
        effect, size = deal(cards + [(name, 0.0) for name in NAMED])
        if effect in NAMED:
            mechanism, body, _ = NAMED[effect]
            return mechanism, [(effect, body, 0.0)]
        mechanism = str(rng.choice(offers[effect]))
        return mechanism, [
            (
                effect,
                str(rng.choice(MECHANISMS[mechanism].places[effect])),
                size * rng.uniform(0.8, 1.25),
            )
        ]
    mechanism = str(rng.choice([name for name in MECHANISMS if "gain" in MECHANISMS[name].places]))
    places = MECHANISMS[mechanism].places
    effects = rng.choice([e for e in PAIRABLE if e in places], 2, replace=False)
    return mechanism, [
        (
            str(e),
            str(rng.choice(places[str(e)])),
            float(rng.choice(SIZES[1:])) * rng.uniform(0.8, 1.25),
        )
        for e in effects
    ]


def _scale(mechanism, model, rng):
    """Typical positions, speeds, torques and inertias of a nominal run, per dof, to size effects by."""
    runs = _simulate(mechanism, Real(mechanism, []), rng, 1, 0.0, False, None)
    run = next(iter(runs.values()))
    data = mujoco.MjData(model)
    torque, mobility = [], []
    for row in range(0, len(run.time), 5):
        data.qpos[:], data.qvel[:], data.ctrl[:] = (
            run.true_qpos[row],
            run.true_qvel[row],
            run.ctrl[row],
        )
        mujoco.mj_forward(model, data)
        torque.append(np.maximum(np.abs(data.qfrc_actuator), np.abs(data.qfrc_bias)))
        inverse = np.zeros((model.nv, model.nv))
        mujoco.mj_solveM(model, data, inverse, np.eye(model.nv))
        mobility.append(np.diag(inverse))
    return {
        "qpos": run.true_qpos,
        "speed": np.sqrt((run.true_qvel**2).mean(0)) + 1e-3,
        "torque": np.sqrt((np.array(torque) ** 2).mean(0)),
        "ctrl": run.ctrl,
        "inertia": 1 / np.mean(mobility, 0),
        "qvel": run.true_qvel,
    }


def _item(effect, name, size, model, scale, rng):
    """{"effect", "place", "parameters"} with a size relative to what the mechanism usually does."""
    sign = float(rng.choice((-1, 1)))
    if effect in NAMED:
        return _place("mass", "body", name, mass=float(model.body(name).mass[0] * NAMED[effect][2]))
    if effect in ("gravity", "wind", "air_drag", "time_step"):
        return _world(effect, size, model, rng)
    if effect.startswith(("contact", "ground")):
        geom = model.geom(name).id
        stiffness, damping = -model.geom_solref[geom]
        value = {
            "contact_friction": ("sliding", model.geom_friction[geom, 0] * (1 - 2 * size)),
            "contact_stiffness": ("stiffness", stiffness * (1 + sign * 2 * size)),
            "contact_damping": ("damping", damping * (1 + sign * 2 * size)),
            "ground_height": ("z", model.geom_pos[geom, 2] + sign * size * 0.1),
        }[effect]
        return _place(effect, "geom", name, **{value[0]: float(value[1])})
    if effect in (
        "mass",
        "center_of_mass",
        "inertia",
        "external_force",
        "payload_change",
        "link_length",
    ):
        return _body(effect, name, size, sign, model, rng)
    if effect in ("gain", "bias", "delay", "lag", "saturation", "back_emf", "dead_zone"):
        return _actuator(effect, name, size, sign, model, scale)
    joint = model.joint(name)
    dof = joint.dofadr[0]
    q = scale["qpos"][:, joint.qposadr[0]]
    speed, torque, inertia = scale["speed"][dof], scale["torque"][dof], scale["inertia"][dof]
    spread = q.std() + 1e-3
    reach = np.sqrt(((q - model.qpos_spring[joint.qposadr[0]]) ** 2).mean()) + 1e-3
    damping, stiffness = (float(np.ravel(v)[0]) for v in (joint.damping, joint.stiffness))
    unit = lambda low, high: float(rng.uniform(low, high))
    if effect == "armature":
        p = {"armature": float(model.dof_armature[dof] + 2 * size * inertia)}
    elif effect == "viscous_damping":
        p = {"damping": damping + 2 * size * torque / speed}
    elif effect == "quadratic_damping":
        p = {"damping2": 2 * size * torque / speed**2}
    elif effect == "coulomb_friction":
        p = {"frictionloss": size * torque}
    elif effect == "stribeck_friction":
        p = {
            "coulomb": size * torque,
            "static": size * torque * unit(1.5, 2.5),
            "velocity": speed * unit(0.1, 0.3),
        }
    elif effect == "stiffness":
        p = {"stiffness": stiffness + 2 * size * torque / reach}
    elif effect == "nonlinear_stiffness":
        p = {"stiffness3": 2 * size * torque / reach**3}
    elif effect == "spring_offset":
        p = {"torque": sign * size * torque}
    elif effect == "cogging":
        p = {
            "amplitude": size * torque,
            "poles": float(round(unit(4, 10) / spread)),
            "phase": unit(0, 6.28),
        }
    elif effect == "joint_stop":  # a stiff spring on one side only, well damped
        p = {
            "low": float(np.quantile(q, size)),
            "high": float(np.quantile(q, 1 - size)),
            "spring": inertia * 60.0**2,
            "damper": inertia * 2 * 0.9 * 60.0,
        }
    elif effect == "backlash":
        motor = model.dof_armature[dof]
        reduced = motor * max(inertia - motor, 1e-6) / inertia
        spring = reduced * 700.0**2
        p = {
            "gap": 0.3 * size * spread,
            "spring": spring,
            "damper": 0.6 * np.sqrt(spring * reduced),
        }
    elif effect == "sensor_bias":
        p = {"offset": sign * 0.3 * size * spread}
    elif effect == "sensor_scale":
        p = {"ratio": 1 + sign * 0.5 * size}
    elif effect == "sensor_delay":
        p = {"seconds": 0.1 * size}
    elif effect == "friction_patch":
        low = unit(0.2, 0.5)
        p = {
            "friction": 1.5 * size * torque,
            "low": float(np.quantile(q, low)),
            "high": float(np.quantile(q, low + 0.3)),
        }
    elif effect == "periodic_torque":
        p = {"amplitude": size * torque, "hertz": unit(0.7, 4.0), "phase": unit(0, 6.28)}
    elif effect == "detent":
        p = {
            "amplitude": size * torque,
            "at": float(np.quantile(q, unit(0.3, 0.7))),
            "width": spread * unit(0.15, 0.3),
        }
    elif effect == "one_way_drag":
        p = {"drag": 2 * size * torque / speed**3}
    else:  # fading_gain
        actuator = int(np.flatnonzero(model.actuator_trnid[:, 0] == joint.id)[0])
        return _place(effect, "joint", name, loss=size, seconds=unit(1.0, 3.0), actuator=actuator)
    return _place(effect, "joint", name, **{key: float(value) for key, value in p.items()})


def _place(effect, kind, name, **parameters):
    return {"effect": effect, "place": {"kind": kind, "name": name}, "parameters": parameters}


def _world(effect, size, model, rng):
    flat = (
        not any(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
        and not np.abs(
            model.jnt_axis[model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE][:, [0, 2]]
        ).any()
    )
    turn = (
        np.pi * rng.integers(2) if flat else rng.uniform(0, 2 * np.pi)
    )  # flat: moves in x and z only
    if effect == "gravity":  # tilted by up to 9 degrees
        tilt = 0.5 * size
        g = 9.81 * np.array(
            [np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)]
        )
        return _place(effect, "world", "world", **dict(zip("xyz", g.tolist())))
    if effect == "wind":
        return _place(
            effect,
            "world",
            "world",
            x=10 * size * float(np.cos(turn)),
            y=10 * size * float(np.sin(turn)),
            z=0.0,
        )
    if effect == "air_drag":
        return _place(effect, "world", "world", density=float(model.opt.density * (1 + 8 * size)))
    return _place(effect, "world", "world", seconds=float(model.opt.timestep / 4))


def _body(effect, name, size, sign, model, rng):
    body = model.body(name)
    mass, inertia = float(body.mass[0]), np.array(body.inertia)
    length = float(np.linalg.norm(body.ipos)) or float(
        max(model.geom_rbound[body.geomadr[0]], 0.05)
    )
    if effect == "mass":
        return _place(
            effect, "body", name, mass=mass * (1 + (sign if size < 0.2 else 1.0) * 1.5 * size)
        )
    if effect == "inertia":
        return _place(
            effect,
            "body",
            name,
            **dict(zip(("ixx", "iyy", "izz"), (inertia * (1 + 3 * size)).tolist())),
        )
    if effect == "center_of_mass":
        ipos = np.array(body.ipos)
        angle = rng.uniform(0, 2 * np.pi)
        ipos[[0, 2]] += size * length * np.array([np.cos(angle), np.sin(angle)])
        return _place(effect, "body", name, **dict(zip("xyz", ipos.tolist())))
    if effect == "link_length":
        return _place(
            effect, "body", name, length=float(np.linalg.norm(body.pos)) * (1 + sign * 0.5 * size)
        )
    if effect == "payload_change":
        return _place(effect, "body", name, mass=(1 + 2 * size) * mass, event=True)
    angle, weight = rng.uniform(0, 2 * np.pi), 9.81 * mass * 2 * size
    return _place(
        effect,
        "body",
        name,
        x=float(weight * np.cos(angle)),
        y=0.0,
        z=float(weight * np.sin(angle)),
        event=bool(rng.random() < 0.5),
    )


def _actuator(effect, name, size, sign, model, scale):
    index = int(name) if name.isdigit() else model.actuator(name).id
    joint, gear = model.actuator_trnid[index, 0], abs(model.actuator_gear[index, 0])
    dof, q = model.jnt_dofadr[joint], scale["qpos"][:, model.jnt_qposadr[joint]]
    u, v = scale["ctrl"][:, index], scale["qvel"][:, dof]
    bias = model.actuator_biasprm[index]
    force = model.actuator_gainprm[index, 0] * u + gear * (bias[1] * q + bias[2] * v)
    typical = np.sqrt((force**2).mean())
    value = {
        "gain": ("gain", 1 + sign * size),
        "bias": ("bias", sign * size * typical),
        "delay": ("seconds", max(0.1 * size, 2 * model.opt.timestep * size * 10)),
        "lag": ("seconds", max(0.1 * size, 2 * model.opt.timestep * size * 10)),
        "saturation": ("forcerange", np.quantile(np.abs(force), 1 - 1.5 * size)),
        "back_emf": ("damping", 2 * size * typical / (gear * scale["speed"][dof])),
        "dead_zone": ("half_width", size * (typical if bias.any() else np.sqrt((u**2).mean()))),
    }[effect]
    return _place(effect, "actuator", name, **{value[0]: float(value[1])})


def record(answer, rng):
    """{file name: Run} of the experiment in `answer`, or None where the machine flew apart."""
    mechanism = MECHANISMS[answer["mechanism"]]
    real = Real(mechanism, answer["hidden"], answer["finer"])
    event = any(item["parameters"].get("event") for item in answer["hidden"])
    runs = _simulate(
        mechanism,
        real,
        rng,
        mechanism.train + mechanism.held_out,
        answer["noise"],
        answer["irregular"],
        event,
    )
    sane = all(
        np.isfinite(run.qpos).all() and np.abs(run.true_qvel).max() < 200 for run in runs.values()
    )
    if not sane or any(warning.number for warning in real.data.warning):
        return None
    for run in runs.values():
        if not answer["velocities"]:
            run.qvel[:] = np.nan
    return runs


def _simulate(mechanism, real, rng, count, noise, irregular, event):
    """`count` recordings; the first mechanism.train are for fitting, an event happens in the middle one."""
    runs, model = {}, mechanism.spec().compile()
    for number in range(count):
        held_out = number - mechanism.train
        name = f"train_{number + 1}" if held_out < 0 else f"held_out_{held_out + 1}"
        interval = np.full(round(mechanism.seconds / mechanism.interval), mechanism.interval)
        if irregular:
            steps = max(1, round(mechanism.interval / model.opt.timestep))
            interval = model.opt.timestep * rng.integers(
                max(1, steps - 2), steps + 3, len(interval)
            )
        time = np.concatenate(([0.0], np.cumsum(interval)[:-1]))
        acts = (
            (time > 0.3 * time[-1])
            & (time < 0.8 * time[-1])
            & (number == (mechanism.train - 1) // 2)
        )
        acts = acts if event else np.zeros(len(time), bool)
        control = mechanism.controller(rng, model)
        real.reset(*mechanism.start(rng, model))
        rows = {key: [] for key in ("ctrl", "qpos", "qvel", "true_qpos", "true_qvel", "states")}
        for t, dt, act in zip(time, interval, acts):
            rows["states"].append(real.state())
            true_qpos, true_qvel = real.reading()
            qpos = true_qpos.copy()
            mujoco.mj_integratePos(model, qpos, noise * rng.standard_normal(model.nv), 1.0)
            rows["true_qpos"].append(true_qpos)
            rows["true_qvel"].append(true_qvel)
            rows["qpos"].append(qpos)
            rows["qvel"].append(true_qvel + 10 * noise * rng.standard_normal(model.nv))
            rows["ctrl"].append(control(t, qpos) if model.nu else np.zeros(0))
            if not np.isfinite(true_qpos).all():
                break
            real.advance(rows["ctrl"][-1], dt, bool(act))
        arrays = {key: np.array(value) for key, value in rows.items() if key != "states"}
        runs[name + (".npz" if mechanism.env else ".csv")] = Run(
            time[: len(rows["qpos"])], states=rows["states"], event=acts, **arrays
        )
    return runs


def _write_csv(path, run, model):
    header, columns = ["time"], [run.time]
    for joint in range(model.njnt):
        name, first = model.joint(joint).name, model.jnt_qposadr[joint]
        width = {0: 7, 1: 4}.get(int(model.jnt_type[joint]), 1)
        header += [f"qpos:{name}" + (f":{k}" if width > 1 else "") for k in range(width)]
        columns += list(run.qpos[:, first : first + width].T)
    if np.isfinite(run.qvel).any():
        for joint in range(model.njnt):
            name, first = model.joint(joint).name, model.jnt_dofadr[joint]
            width = {0: 6, 1: 3}.get(int(model.jnt_type[joint]), 1)
            header += [f"qvel:{name}" + (f":{k}" if width > 1 else "") for k in range(width)]
            columns += list(run.qvel[:, first : first + width].T)
    header += [f"ctrl:{model.actuator(k).name}" for k in range(model.nu)]
    columns += list(run.ctrl.T)
    rows = [",".join(f"{value:.9g}" for value in row) for row in zip(*columns)]
    path.write_text("\n".join([",".join(header), *rows]) + "\n")


def _write_npz(path, run):
    arrays = {"time": run.time, "qpos": run.qpos, "ctrl": run.ctrl}
    if np.isfinite(run.qvel).any():
        arrays["qvel"] = run.qvel
    np.savez_compressed(path, **arrays)
