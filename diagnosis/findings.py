"""What a search found, in the words of the contract: findings with intervals and evidence, errors
before, after and at the floor.

diagnosis = assemble(world, train, held_out, outcome)
diagnosis.summary                    # diagnosis.json
"""

from dataclasses import dataclass, field

import numpy as np

from diagnosis.effects.base import is_numerical
from diagnosis.estimation import windowing
from diagnosis.estimation.intervals import intervals
from diagnosis.handover import Handed
from diagnosis.selection import sensor_faults
from diagnosis.selection.missing_force import each_joint
from diagnosis.unnamed import depends_on, led

SCATTER = 2.0  # standard deviations of a perfect simulator's squared error, that are nothing
COLOURED = 3.0  # of its error under white noise, what noise of another kind may reach
POINTS = 400  # of a located force that are told


@dataclass(frozen=True)
class Diagnosis:
    """summary: diagnosis.json; corrected_xml, corrected_py ("" where MJCF holds all): files;
    settings {Candidate: values};
    ranking, traces, located: rows for the report; train, held_out: Recordings."""

    summary: dict
    corrected_xml: str
    world: object
    settings: dict
    ranking: list
    traces: list
    train: list
    held_out: list
    located: list = field(default_factory=list)
    corrected_py: str = ""


def assemble(world, train, held_out, outcome):
    """The Diagnosis of an Outcome (estimator.py)."""
    settings, handed = outcome.fitted.setting, outcome.handed
    bounds = intervals(outcome.fitted)
    figures = {"train": _figure(world, handed, outcome.train_check, settings)}
    figures["held_out"] = _figure(world, handed, outcome.held_check, settings)
    figures["held_out"]["horizon_s"] = windowing.HORIZON
    check = outcome.held_check
    figures["held_out"]["curve"] = windowing.curve(
        world, _files(handed), settings, check.smoother, check.trajectory, check.noise
    )
    if others := sensor_faults.errors(world, settings, check.recordings):
        figures["held_out"]["sensors"] = others
    figure = figures["held_out"]
    left = unexplained(figure["before"], figure["after"], figure["floor"], check.scatter)
    if not outcome.earned and figure["after"] < COLOURED * figure["floor"]:
        left = 0.0  # noise that is not white does as much
    findings = _findings(world, outcome, bounds, figure)
    findings = led(world, outcome, findings, left > 0, figure["channels"])
    for finding in findings:
        finding["when"] = stamped(finding["when"], train)
    hint = outcome.left[0] if outcome.left and left > 0 else None
    summary = {
        "format": 2,
        "verdict": verdict(findings, left > 0),
        "noise": noise_by_channel(world.model, outcome.found.smoother.position_noise),
        "findings": findings,
        "fit": figures,
        "missing_force": missing_force(world, outcome),
        "unexplained": {
            "fraction": left,
            "place": {"kind": "joint", "name": hint.joint} if hint else None,
            "depends_on": list(hint.variables) if hint else [],
        },
        "warnings": [],
    }
    return Diagnosis(
        summary,
        handed.files.xml,
        world,
        settings,
        _ranking(outcome),
        windowing.traces(world, settings, check.recordings),
        train,
        held_out,
        located(world, outcome),
        handed.files.python,
    )


def _findings(world, outcome, bounds, figure):
    """All findings, the most important first, as (candidate or None, finding): of the model, of a
    while, of sensors."""
    settings = outcome.fitted.setting
    found = [(c, _finding(world, c, outcome, bounds, figure)) for c in settings]
    if outcome.event:
        found.append((None, of_event(outcome.event)))
    given = world, settings, outcome.found.smoother.recordings, outcome.trajectory, outcome.event
    found += [(None, fault) for fault in sensor_faults.faults(*given)]
    return sorted(found, key=lambda pair: -pair[1]["evidence"]["held_out_error_removed"])


def stamped(when, recordings):
    """A condition by its recording's own time stamps; one of every recording as it is, in s since
    each began."""
    origin = {r.name: r.origin for r in recordings}.get((when or {}).get("recording"))
    return {**when, "time": [t + origin for t in when["time"]]} if origin else when


def verdict(findings, something):
    """match, mismatch, or unresolved: something is missing and no name explains it well enough. A
    finer time step explains nothing that is missing."""
    physics = [f for f in findings if not is_numerical(f["effect"])]
    if not physics:
        return "unresolved" if something else "mismatch" if findings else "match"
    named = physics[0]["effect"] != "unknown" and any(f["adequate"] for f in physics)
    return "mismatch" if named else "unresolved"


def _finding(world, candidate, outcome, bounds, figure):
    values, handed = outcome.fitted.setting[candidate], outcome.handed
    curve = candidate.effect.name == "unknown"
    before, after = figure["before"], figure["after"]
    return {
        "effect": candidate.effect.name,
        "place": place_of(candidate),
        "parameters": parameters_of(candidate, values, bounds[candidate]),
        "evidence": {
            "held_out_error_removed": removed(handed.without[candidate], after, before),
            "p_value": outcome.p_values[candidate],
            **({"error_removed_there": outcome.there[candidate]} if candidate.when else {}),
        },
        "adequate": not curve and certain(candidate, bounds[candidate]),
        "strains": outcome.strains.get(candidate),
        "depends_on": depends_on(world.model, candidate),
        "when": candidate.when,
        "written_as": handed.files.forms[candidate],
        "also_possible": [
            {"effect": c.effect.name, "place": place_of(c), "parameters": parameters_of(c, v)}
            for c, v in outcome.others.get(candidate, [])
        ],
        **({"curve": form_of(candidate)} if curve else {}),
    }


def of_event(event):
    """The finding of an Event, as diagnosis.json has it."""
    curve = event.candidate.effect.name == "unknown"
    told = lambda candidate, *values: {
        "effect": candidate.effect.name,
        "place": place_of(candidate),
        "parameters": parameters_of(candidate, *values),
    }
    bounds = [(a, b) if b > a else None for a, b in zip(event.low, event.high)]
    return {
        **told(event.candidate, event.values, bounds),
        "evidence": {
            "held_out_error_removed": 0.0,
            "error_removed_there": event.removed,
            "p_value": event.p_value,
        },
        "adequate": not curve,
        "strains": None,
        "depends_on": depends_on(None, event.candidate) if curve else ["time"],
        "when": event.candidate.when,
        "written_as": "none",
        "also_possible": [told(c, values) for c, values in event.others],
        **({"curve": form_of(event.candidate)} if curve else {}),
    }


def form_of(candidate):
    """The variable of a curve, what it is multiplied by, and whether it is a wave."""
    return {key: getattr(candidate.effect, key) for key in ("variable", "factor", "wave")}


def certain(candidate, bounds):
    """Whether the interval of some value leaves out the nominal one; of its amplitudes, where an
    effect has such: the rest means nothing without."""
    return any(not low <= p.nominal <= high for p, (low, high) in _told(candidate, bounds))


def may_be_nothing(candidate, bounds):
    """Whether the one value that is told of an effect has an interval that holds the nominal one.
    Of several that are told together each may be nothing, and all of them may not."""
    return len(_told(candidate, bounds)) == 1 and not certain(candidate, bounds)


def _told(candidate, bounds):
    """[(Parameter, (low, high))] of the amplitudes that are told, or of all values."""
    count = candidate.effect.amplitudes or len(candidate.parameters)
    return [(p, b) for p, b in zip(candidate.parameters[:count], bounds) if b is not None]


def place_of(candidate):
    return {"kind": candidate.place.kind, "name": candidate.place.name}


def parameters_of(candidate, values, bounds=None):
    """[parameter] of a finding; the interval of a value that the recordings do not show is None,
    and so is the value where it stays as it was, or where there was none."""
    out = []
    for i, (p, v) in enumerate(zip(candidate.parameters, values)):
        untold = bounds is not None and bounds[i] is None
        kept = np.isinf(p.nominal) or np.isclose(v, p.nominal, rtol=1e-9, atol=0)
        entry = {
            "name": p.name,
            "nominal": float(p.nominal),
            "value": None if untold and kept else float(np.clip(v, p.low, p.high)),
            "unit": p.unit,
        }
        if candidate.effect.name == "unknown":
            entry["at"] = candidate.effect.knots[i]
        if bounds is not None:
            entry["low"], entry["high"] = (None, None) if untold else bounds[i]
        out.append(entry)
    return out


def removed(without, after, before):
    """Share of the nominal model's error that a finding removes; a prediction that blows up errs by
    infinity."""
    if np.isinf(without) or np.isinf(after):
        return float(np.isinf(without)) - float(np.isinf(after))
    return (without - after) / max(before, 1e-12) if np.isfinite(before) else 0.0


def unexplained(before, after, floor, scatter):
    """Share of the nominal model's squared error that is left above a perfect simulator's, and
    above what that scatters by."""
    if np.isinf(after):
        return 1.0
    share = (after**2 - floor**2 - SCATTER * scatter) / max(before**2, 1e-24)
    return float(np.clip(share, 0, 1))


def noise_by_channel(model, position_noise):
    """{channel: noise in SI}."""
    return {
        name: float(np.sqrt(np.mean(position_noise[dofs] ** 2)))
        for name, dofs in windowing.channels(model).items()
        if np.isfinite(position_noise[dofs]).all()
    }


def _files(handed):
    return {"before": handed.nominal, "after": handed.files}


def _figure(world, handed: Handed, check, settings):
    """Errors before, after (of the files handed over, in stock MuJoCo) and of a perfect simulator,
    as diagnosis.json has them."""
    model = world.model
    out, channels = {}, {}
    for name, files in _files(handed).items():
        out[name], per_channel = check.errors(files)
        for channel, value in per_channel.items():
            channels.setdefault(channel, {})[name] = value
    out["floor"], per_channel, check.scatter = windowing.floor_error(
        world, settings, check.smoother, check.trajectory, check.noise
    )
    for channel, value in per_channel.items():
        channels[channel] |= {"floor": value, "unit": unit_of(model, channel)}
    out["channels"] = {name: values for name, values in channels.items() if "floor" in values}
    return out


def unit_of(model, channel):
    """Unit of a position channel."""
    for j, kind, _, _ in windowing.joint_slices(model):
        name = "qpos:" + windowing.joint_name(model, j)
        if channel == name + ":pos" or (channel == name and kind.name == "mjJNT_SLIDE"):
            return "m"
    return "rad"


def missing_force(world, outcome):
    """{joint: rms before and after, unit, what it depends on}: the force that the nominal model
    lacks."""
    out, model = {}, world.model
    first, last = outcome.found.first, outcome.trajectory
    told = each_joint(outcome.dependences)
    for j, kind, _, v in windowing.joint_slices(model):
        name = windowing.joint_name(model, j)
        for i, d in enumerate(range(v.start, v.stop)):
            rms = [
                float(np.sqrt(np.mean(t.force[~t.free, d] ** 2))) if (~t.free).any() else None
                for t in (first, last)
            ]
            linear = kind.name == "mjJNT_SLIDE" or (kind.name == "mjJNT_FREE" and i < 3)
            depends = next((f.variables for f in told if f.joint == name), ())
            out[name if v.stop - v.start == 1 else f"{name}:{i}"] = {
                "rms": rms[0],
                "unit": "N" if linear else "N·m",
                "after": rms[1],
                "depends_on": list(depends),
            }
    return out


def located(world, outcome):
    """[{joint, recording, unit, time, force, sd, position, velocity}] of the nominal model's
    missing force, thinned."""
    out, model, t = [], world.model, outcome.found.first
    for recording in outcome.found.smoother.recordings[:3]:
        rows = np.arange(*t.rows(recording).indices(len(t.qpos))[:2])
        rows = rows[windowing.evenly(len(rows), POINTS)]
        for j, kind, q, v in windowing.joint_slices(model):
            if v.stop - v.start > 1:
                continue
            d = v.start
            out.append(
                {
                    "joint": windowing.joint_name(model, j),
                    "recording": recording.name,
                    "unit": "N" if kind.name == "mjJNT_SLIDE" else "N·m",
                    "time": recording.time[rows - t.first[recording]].tolist(),
                    "force": t.force[rows, d].tolist(),
                    "sd": t.force_sd[rows, d].tolist(),
                    "position": t.qpos[rows, q.start].tolist(),
                    "velocity": t.qvel[rows, d].tolist(),
                }
            )
    return out


def _ranking(outcome):
    """What every candidate removes alone of the log error, most first."""
    return [
        {
            "effect": c.effect.name,
            "place": place_of(c),
            "error_removed": float(1 - np.exp(-max(gain, 0.0))),
            "p_value": p,
        }
        for c, gain, p in outcome.found.ranking
    ]
