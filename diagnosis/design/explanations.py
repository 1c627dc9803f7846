"""What a finished report left open, as settings of its nominal model that can be simulated.

left = Open.read("report/")
left.settings[0]        # all findings; the others: with one finding exchanged for a rival
"""

import json
import os
from dataclasses import dataclass

import mujoco
import numpy as np

from diagnosis.nominal.model import ModelError, gains_of, load_world, with_gains
from diagnosis.recordings.columns import WIDTHS, columns_of
from diagnosis.recordings.layout import is_servo, joint_of
from diagnosis.simulation.simulator import World

STILL = 5.0  # noises: a joint that moved less never moved
SLOPE = 0.03  # s over which a speed is taken: over single rows it would be the encoder's noise
BEYOND = 0.25  # of the recorded range, by which a joint without limits may leave it
SLACK = 0.02  # of a range, kept free at its ends
DEFAULT_NOISE = 1e-3  # rad or m, where the report has none
RUBBING = "coulomb_friction", "viscous_damping", "armature"  # asked of a joint that never moved


class DesignError(ValueError):
    """No excitation can be designed. One line: why, and what to do."""


@dataclass(frozen=True)
class Limits:
    """What an excitation may do.

    low, high, speed (n,): of hinges and slides; control_low, control_high (nu,): of the controls;
    period: s between rows; start_qpos (nq,), start_ctrl (nu,): where it begins and ends, at rest.
    """

    low: np.ndarray
    high: np.ndarray
    speed: np.ndarray
    control_low: np.ndarray
    control_high: np.ndarray
    period: float
    start_qpos: np.ndarray
    start_ctrl: np.ndarray


@dataclass(frozen=True)
class Open:
    """What a report left open.

    world: the nominal model. names, settings: explanations, the first being the report's own.
    free: [Candidate] that only motion not recorded yet would show, at their nominal values.
    noise (n,): of hinges and slides. limits: what was reached, and what the model allows.
    followed: joints whose motors were given position controllers meanwhile.
    """

    world: World
    names: tuple
    settings: tuple
    free: tuple
    noise: np.ndarray
    limits: Limits
    followed: tuple = ()

    @classmethod
    def read(cls, folder: str, kp=None, kd=None) -> "Open":
        """From a report's folder. kp, kd: gains of position controllers that the motors are given
        meanwhile, one number or {joint: number}. Raises DesignError."""
        summary = _json(os.path.join(folder, "diagnosis.json"), "findings")
        reached = _json(os.path.join(folder, "recorded.json"), "columns")
        path = os.path.join(folder, "nominal.xml")
        if not os.path.isfile(path):
            raise DesignError(
                f"{path}: no such file; diagnose again, it is written beside the report"
            )
        try:
            world = load_world(path)
            gains = gains_of({"kp": kp, "kd": kd}, world.model)
            world = with_gains(world, gains)
        except ModelError as error:
            raise DesignError(error) from None
        names, settings = _explanations(world, summary)
        joints = single(world.model)
        known = summary.get("noise") or {}
        noise = np.array([known.get(f"qpos:{j}") or DEFAULT_NOISE for j in joints])
        still = [j for j, n in zip(joints, noise) if _range(reached, f"qpos:{j}") < STILL * n]
        free = tuple(
            c for c in world.candidates if c.effect.name in RUBBING and c.place.name in still
        )
        return cls(
            world,
            names,
            settings,
            free,
            noise,
            limits_of(world.model, reached, gains),
            tuple(gains),
        )


def single(model: mujoco.MjModel) -> list[str]:
    """Names of the hinges and slides, in MuJoCo's order."""
    return [model.joint(j).name for j in range(model.njnt) if model.jnt_type[j] not in WIDTHS]


def reached_by(recordings, model: mujoco.MjModel) -> dict:
    """What recordings reached, for recorded.json: {"columns": {name: [low, high]}, "speeds":
    {joint: largest}, "period": s, "start": {name: value in the first row}}."""
    columns, speeds, start = {}, {}, {}
    for column, (kind, k) in columns_of(model).items():
        if kind in ("qpos", "ctrl"):
            values = np.concatenate([getattr(r, kind)[:, k] for r in recordings])
            if np.isfinite(values).any():
                columns[column] = [float(np.nanmin(values)), float(np.nanmax(values))]
                first = getattr(recordings[0], kind)[0, k]
                start[column] = float(first) if np.isfinite(first) else None
    for joint in single(model):
        q = model.jnt_qposadr[model.joint(joint).id]
        rates = []
        for r in recordings:
            known = np.isfinite(r.qpos[:, q])
            rates.append(_speeds(r.time[known], r.qpos[known, q]))
        rates = np.concatenate(rates)
        if len(rates):
            speeds[joint] = float(np.quantile(rates, 0.995))
    period = float(np.median(np.concatenate([np.diff(r.time) for r in recordings])))
    return {"columns": columns, "speeds": speeds, "period": period, "start": start}


def _speeds(time, position):
    """Absolute speeds (rad/s or m/s) over SLOPE seconds from every row; none of fewer rows."""
    if len(time) < 2:
        return np.zeros(0)
    rows = max(1, int(round(SLOPE / np.median(np.diff(time)))))
    return np.abs((position[rows:] - position[:-rows]) / (time[rows:] - time[:-rows]))


def limits_of(model: mujoco.MjModel, reached: dict, followed=()) -> Limits:
    """The Limits of a model whose recordings reached {"columns", "speeds", "period", "start"}.

    followed: joints whose motors were given position controllers since.
    """
    low, high, speed = {}, {}, {}
    qpos, ctrl = _start(model, reached, followed)
    usual = max(reached["speeds"].values(), default=1.0)
    for joint in single(model):
        j, at = model.joint(joint).id, qpos[model.joint(joint).qposadr[0]]
        first, last = reached["columns"].get(f"qpos:{joint}", (0.0, 0.0))
        more = BEYOND * (last - first)
        span = model.jnt_range[j] if model.jnt_limited[j] else (first - more, last + more)
        low[joint] = min(at, span[0] + SLACK * (span[1] - span[0]))
        high[joint] = max(at, span[1] - SLACK * (span[1] - span[0]))
        speed[joint] = max(reached["speeds"].get(joint, 0.0), 0.2 * usual) * (1 + BEYOND)
    span = model.actuator_ctrlrange.copy()
    for name, (kind, k) in columns_of(model).items():
        if kind == "ctrl" and not model.actuator_ctrllimited[k]:
            span[k] = reached["columns"].get(name, (0.0, 0.0))
    for a in range(model.nactuator):
        if joint_of(model, a) in followed:
            span[model.actuator_ctrladr[a]] = low[joint_of(model, a)], high[joint_of(model, a)]
    every = (np.array(list(x.values()), dtype=float) for x in (low, high, speed))
    ctrl = np.clip(ctrl, span[:, 0], span[:, 1])
    return Limits(*every, span[:, 0], span[:, 1], reached["period"], qpos, ctrl)


def _start(model, reached, followed):
    """(qpos (nq,), ctrl (nu,)) with which the first recording began, or of the reference pose."""
    start = reached.get("start") or {}
    qpos, ctrl = model.qpos0.copy(), np.zeros(model.nu)
    known = columns_of(model)
    for name, (kind, k) in known.items():
        if kind == "qpos" and start.get(name) is not None:
            qpos[k] = start[name]
    for a in range(model.nactuator):
        joint, name = joint_of(model, a), f"ctrl:{model.actuator(a).name}"
        if joint is not None and is_servo(model, a):
            gear = 1.0 if joint in followed else model.actuator_gear[a, 0]
            ctrl[model.actuator_ctrladr[a]] = gear * qpos[model.joint(joint).qposadr[0]]
        if joint not in followed and start.get(name) is not None and name in known:
            ctrl[known[name][1]] = start[name]
    return qpos, ctrl


def _json(path, key):
    """The content of a report's file. Raises DesignError."""
    try:
        with open(path, encoding="utf-8") as stream:
            content = json.load(stream)
        if key not in content:
            raise ValueError
        return content
    except OSError as error:
        raise DesignError(
            f"{path}: cannot be read ({error.strerror}); give the folder of a finished report"
        ) from None
    except (ValueError, TypeError):
        raise DesignError(f"{path}: is not of a report; diagnose again") from None


def _range(reached, column):
    low, high = reached["columns"].get(column, (0.0, 0.0))
    return high - low


def _explanations(world, summary):
    """(names, settings): all findings that can be simulated, then with one exchanged for each of
    its rivals."""
    written = [f for finding in summary["findings"] for f in _written(finding)]
    found = [(f, _setting(world, f)) for f in written]
    base = {c: values for _, pair in found if pair for c, values in [pair]}
    names, settings = ["as diagnosed"], [base]
    for finding, pair in found:
        for rival in finding.get("also_possible") or []:
            other = _setting(world, rival)
            if pair and other and other[0] not in base:
                settings.append({c: v for c, v in base.items() if c != pair[0]} | dict([other]))
                names.append(f"{_words(rival)} instead of {_words(finding)}")
    return tuple(names), tuple(settings)


def _written(finding):
    """[finding] that the corrected model holds in the place of one: itself, or the nearest names of
    a force without a name and without a curve. Such names have intervals; their rivals have none,
    and can be exchanged only where there is one name."""
    fitted = finding["effect"] != "unknown" or finding["parameters"]
    if fitted or finding.get("written_as") not in ("mjcf", "python"):
        return [finding]
    names, rivals = [], []
    for other in finding.get("also_possible") or []:
        (names if all("low" in p for p in other["parameters"]) else rivals).append(other)
    return [{**name, "also_possible": rivals if len(names) == 1 else []} for name in names]


def _setting(world, finding):
    """(Candidate, values) of a finding or a rival, or None where it cannot be simulated from
    here."""
    if finding.get("when") or finding["effect"] == "unknown":
        return None
    try:
        candidate = world.candidate(finding["effect"], finding["place"]["name"])
    except KeyError:
        return None
    told = {p["name"]: p["value"] for p in finding["parameters"]}
    values = [told.get(p.name) for p in candidate.parameters]
    nominal = [p.nominal for p in candidate.parameters]
    return candidate, tuple(float(n if v is None else v) for v, n in zip(values, nominal))


def _words(finding):
    return f"{finding['effect']} at {finding['place']['name']}"
