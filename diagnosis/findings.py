"""What a fit says, in the words of the contract: findings with intervals and evidence, errors before, after and at the floor.

diagnosis = assemble(world, train, held_out, fit, search, possible, left, hint, event, ranking, position_noise, velocity_noise)
diagnosis.summary                    # diagnosis.json
"""

from dataclasses import dataclass

import numpy as np

from diagnosis.effects.base import JOINT_TRANSMISSIONS
from diagnosis.estimation import (
    cluster_scores,
    initial_states,
    multiple_shooting,
    prediction_error,
    residuals,
)
from diagnosis.estimation import windows as cut
from diagnosis.selection import search as selection
from diagnosis.selection import sensor_faults

SAME = (
    0.05  # effects whose refits differ by less than this in the reported error cannot be told apart
)
SCATTER = (
    2.0  # standard deviations of a perfect simulator's squared error, that are nothing unexplained
)
NEAR = 0.3  # so near they have to come before they are refitted
WIDER = 1.3  # for what clusters do not show: without it 88 % of the intervals of 400 trials (seed 161803) held the truth, with it 93 %
# of an unknown force's largest: up to which it counts as none, up to which its interval must lie outside its region;
# of the recorded range: a region that covers more is no part of it
FAINT, SMALL, PART = 0.25, 0.4, 0.75


@dataclass(frozen=True)
class Diagnosis:
    summary: dict  # diagnosis.json
    corrected_xml: str
    world: object
    settings: dict  # {Candidate: values}
    ranking: list
    traces: list
    train: list  # Recordings
    held_out: list


def intervals(search, fit):
    """{candidate: [(low, high), ...]}: 95 %, from the spread between clusters of windows, and the time step's error."""
    if not fit.hypothesis.effects:
        return {}
    slope, moves = search.slopes(fit)
    halved = (
        fit.residual - search.problem.refined(fit).residual
    )  # change of the prediction with half the time step
    scan = multiple_shooting.project(
        search.problem, fit, np.concatenate([slope, halved[..., None]], -1), search.pieces
    )
    gram, score = (
        cluster_scores.summed(search.labels, scan.gram),
        cluster_scores.summed(search.labels, scan.score),
    )
    seen = np.flatnonzero(np.diag(gram.sum(0))[:-1] > multiple_shooting.UNSEEN)
    half, shift = np.full(len(moves), np.inf), np.zeros(len(moves))
    half[seen] = (
        WIDER * np.abs(moves[seen]) * spread(gram, score, seen, np.zeros(len(seen)))
    )  # at the optimum scores are leftovers
    # as far as ever smaller steps would move the values, which is twice as far as half a step, if so much of it is in the data
    every = np.append(seen, -1)
    amounts = cluster_scores.solve_small(gram.sum(0)[np.ix_(every, every)], score.sum(0)[every])
    most = amounts[-1] + spread(gram, score, every, amounts)[-1]
    shift[seen] = -moves[seen] * cluster_scores.solve_small(
        gram.sum(0)[np.ix_(seen, seen)], gram.sum(0)[seen, -1]
    )
    shift *= np.clip(most, 0.0, 2.0)
    below, above = half - np.minimum(shift, 0), half + np.maximum(shift, 0)
    out, at = {}, 0
    for c, values in fit.hypothesis.effects:
        out[c] = [
            (max(v - a, p.low), min(v + b, p.high))
            for v, a, b, p in zip(values, below[at:], above[at:], c.parameters)
        ]
        at += len(values)
    return out


def spread(gram, score, columns, values):
    """(k,) half widths of the 95 % intervals of some columns' values, from cluster sums of all columns."""
    covariance = cluster_scores.sandwich(gram[:, columns][:, :, columns], score[:, columns], values)
    return cluster_scores.t_quantile(max(len(gram) - len(columns), 1)) * np.sqrt(
        np.diag(covariance)
    )


def place_of(candidate):
    return {"kind": candidate.place.kind, "name": candidate.place.name}


def parameters_of(candidate, values, bounds=None):
    out = []
    for i, (p, v) in enumerate(zip(candidate.parameters, values)):
        entry = {
            "name": p.name,
            "nominal": float(p.nominal),
            "value": float(np.clip(v, p.low, p.high)),
            "unit": p.unit,
        }
        if candidate.effect.name == "unknown":
            entry["at"] = candidate.effect.knots[i]
        if bounds:
            entry["low"], entry["high"] = (float(b) for b in bounds[i])
        out.append(entry)
    return out


def removed(without, after, before):
    """Share of the nominal model's error that a finding removes; a prediction that blows up errs by infinity."""
    if np.isinf(without) or np.isinf(after):
        return float(np.isinf(without)) - float(np.isinf(after))
    return (without - after) / max(before, 1e-12)


def unexplained(before, after, floor, scatter):
    """Share of the nominal model's squared error that is left above a perfect simulator's, and above what that scatters by."""
    return (
        1.0
        if np.isinf(after)
        else float(np.clip((after**2 - floor**2 - SCATTER * scatter) / max(before**2, 1e-24), 0, 1))
    )


def noise_by_channel(model, position_noise):
    return {
        name: float(np.sqrt(np.mean(position_noise[dofs] ** 2)))
        for name, dofs in cut.channels(model).items()
        if np.isfinite(position_noise[dofs]).all()
    }


def assemble(
    world,
    train,
    held_out,
    fit,
    search,
    possible,
    left,
    hint,
    event,
    ranking,
    position_noise,
    velocity_noise,
):
    settings, model = fit.hypothesis.settings, world.model
    noise = prediction_error.reporting_noise(position_noise)
    bounds = intervals(search, fit)
    held = held_out or train
    figures = {"train": figure(world, settings, train, position_noise, velocity_noise)[0]}
    figures["held_out"], scatter = figure(world, settings, held, position_noise, velocity_noise)
    figures["held_out"]["horizon_s"] = cut.HORIZON
    figures["held_out"]["curve"] = prediction_error.curve(
        world, settings, held, position_noise, velocity_noise
    )
    if others := sensor_faults.errors(world, settings, held):
        figures["held_out"]["sensors"] = others
    before, after, floor = (figures["held_out"][k] for k in ("before", "after", "floor"))
    findings = []
    xml, written = world.corrected_xml(settings)
    p_values = {c: search.significance(fit, c)[0] for c in fit.hypothesis.candidates}
    for candidate, values in fit.hypothesis.effects:
        without = prediction_error.prediction_error(
            world, fit.hypothesis.minus(candidate).settings, held, noise
        )[0]
        curve = candidate.effect.name == "unknown"
        form = (
            {key: getattr(candidate.effect, key) for key in ("variable", "factor", "wave")}
            if curve
            else None
        )
        findings.append(
            {
                "effect": candidate.effect.name,
                "place": place_of(candidate),
                "parameters": parameters_of(candidate, values, bounds[candidate]),
                "evidence": {
                    "held_out_error_removed": removed(without, after, before),
                    "p_value": p_values[candidate],
                },
                "depends_on": list(left.variables) if curve else depends_on(model, candidate),
                "when": region(
                    candidate.effect, values, bounds[candidate], travel(model, train, candidate)
                )
                if curve
                else None,
                "written_as": written[candidate],
                "also_possible": also_possible(
                    search, fit, train, noise, candidate, possible.get(candidate, [])
                ),
                **({"curve": form} if curve else {}),
            }
        )
    if event:
        findings.append(event_finding(event, train))
    findings += sensor_faults.faults(world, settings, train, position_noise, velocity_noise, event)
    findings.sort(key=lambda f: -f["evidence"]["held_out_error_removed"])
    summary = {
        "format": 1,
        "verdict": "mismatch" if findings else "match",
        "noise": noise_by_channel(model, position_noise),
        "findings": findings,
        "fit": figures,
        "unexplained": {
            "fraction": unexplained(before, after, floor, scatter),
            "place": {"kind": "joint", "name": hint.joint} if hint else None,
            "depends_on": list(hint.variables) if hint else [],
        },
    }
    return Diagnosis(
        summary,
        xml,
        world,
        settings,
        ranking_rows(ranking, fit, search, p_values),
        prediction_error.traces(world, settings, held),
        train,
        held,
    )


def region(effect, values, bounds, travelled):
    """Where an unknown force acts, as {"qpos:<joint>" or "qvel:<joint>": [from, to]}; None where it acts everywhere, or where
    that cannot be said. travelled: (least, most) recorded of what it depends on.

    It acts between the knots at which its 95 % interval leaves out zero, and, since it is linear in between, on to the next
    knots; beyond the last it goes on as there. At the others it must be known to be small, or nothing is said.
    """
    kind, _, name = effect.variable.partition(":")
    if effect.wave or kind not in ("position", "velocity"):
        return None
    knots, size, (low, high) = np.array(effect.knots), np.abs(values), np.array(bounds, float).T
    acts = np.flatnonzero(((low > 0) | (high < 0)) & (size > FAINT * size.max()))
    if not len(acts):
        return None
    outside = np.r_[: acts[0], acts[-1] + 1 : len(knots)]
    begin = knots[acts[0] - 1] if acts[0] else travelled[0]
    end = knots[acts[-1] + 1] if acts[-1] + 1 < len(knots) else travelled[1]
    known = (np.maximum(-low, high)[outside] < SMALL * size.max()).all()
    if not known or end - begin > PART * (travelled[1] - travelled[0]):
        return None
    return {f"{'qpos' if kind == 'position' else 'qvel'}:{name}": [float(begin), float(end)]}


def travel(model, train, curve):
    """(least, most) recorded of the position or velocity that a curve depends on, but for a few odd rows; None of others."""
    kind, _, name = curve.effect.variable.partition(":")
    if kind not in ("position", "velocity"):
        return None
    joint, which = model.joint(name), kind == "velocity"
    column = (joint.qposadr, joint.dofadr)[which][0]
    return np.quantile(
        np.concatenate([cut.states(model, r)[which][:, column] for r in train]), (0.001, 0.999)
    )


def event_finding(event, train):
    local = selection.Search(event.problem.world, event.problem, train)
    candidate = event.candidate
    [without] = multiple_shooting.solve(
        event.problem, [event.fit.hypothesis.minus(candidate)], event.fit
    )
    there = removed(*(np.sqrt(f.chi2.sum()) for f in (without, event.fit, without)))
    named = lambda c, values, bounds=None: {
        "effect": c.effect.name,
        "place": place_of(c),
        "parameters": parameters_of(c, values, bounds),
    }
    return {
        **named(candidate, event.values, intervals(local, event.fit)[candidate]),
        "evidence": {
            "held_out_error_removed": 0.0,
            "error_removed_there": there,
            "p_value": event.p_value,
        },
        "depends_on": ["time"],
        "when": event.when,
        "written_as": "none",
        "also_possible": [named(c, values) for c, values in event.others],
    }


def figure(world, settings, recordings, position_noise, velocity_noise):
    """Errors of recordings before, after and of a perfect simulator, as diagnosis.json has them; scatter of the last one's square."""
    noise, channels, out = prediction_error.reporting_noise(position_noise), {}, {}
    for name, s in (("before", {}), ("after", settings)):
        out[name], per_channel = prediction_error.prediction_error(world, s, recordings, noise)
        for channel, value in per_channel.items():
            channels.setdefault(channel, {})[name] = value
    out["floor"], per_channel, scatter = prediction_error.floor_error(
        world, settings, recordings, position_noise, velocity_noise
    )
    for channel, value in per_channel.items():
        channels[channel] |= {"floor": value, "unit": unit_of(world.model, channel)}
    out["channels"] = {
        name: values for name, values in channels.items() if "floor" in values
    }  # seldom measured, a channel may have none
    return out, scatter


def unit_of(model, channel):
    for j, kind, _, _ in cut.joint_slices(model):
        name = "qpos:" + cut.joint_name(model, j)
        if channel == name + ":pos" or (channel == name and kind.name == "mjJNT_SLIDE"):
            return "m"
    return "rad"


def depends_on(model, candidate):
    variable, name = candidate.effect.acts_through, candidate.place.name
    if variable == "velocity" and candidate.place.kind == "actuator":
        actuator = model.actuator(name)
        if (
            actuator.trntype[0] not in JOINT_TRANSMISSIONS
        ):  # a site or tendon moves with many joints
            return []
        name = cut.joint_name(model, actuator.trnid[0])
    return [f"{variable}:{name}"] if variable else []


def also_possible(search, fit, train, noise, candidate, others, most=3):
    """The alternatives [(error ratio, candidate, values)] that leave the reported error, on the data they were fitted to,
    within 5 % of the finding's; refitted, the other findings with them, where they come near."""
    windows, world, rest = (
        prediction_error.consecutive(train, cut.HORIZON),
        search.world,
        fit.hypothesis.minus(candidate),
    )
    windows = windows[:: -(-len(windows) // 60)]
    rms = lambda h: cut.error(
        world.model, windows, prediction_error.predict(world, h.settings, windows)[0], noise
    )[0]
    stood = [
        rest.plus(other, values)
        for _, other, values in others
        if other not in fit.hypothesis.candidates
    ]
    best = rms(fit.hypothesis) if stood else 0.0
    near = [h for h in stood if rms(h) < (1 + NEAR) * best][: most + 1]
    out = []
    for f in multiple_shooting.solve(
        search.problem, near, fit, iterations=1
    ):  # few windows have brought them near
        other, values = f.hypothesis.effects[-1]
        if len(out) < most and rms(f.hypothesis) < (1 + SAME) * best:
            out.append(
                {
                    "effect": other.effect.name,
                    "place": place_of(other),
                    "parameters": parameters_of(other, values),
                }
            )
    return out


def ranking_rows(trials, fit, search, p_values):
    """What every candidate removes alone of the squared residual, most first: as the first look has it, or refitted where that
    passed over what a fit holds. p_values: of the latter."""
    best = {}
    for t in trials:
        best.setdefault(t.option.candidate, (t.gain / t.chi2, t.p_value))
    late = [effect for effect in fit.hypothesis.effects if effect[0] not in best]
    if late:
        bare = initial_states.fit(search.small, residuals.Hypothesis())
        alone = multiple_shooting.solve(
            search.small, [residuals.Hypothesis((effect,)) for effect in late], bare, iterations=4
        )
        best |= {
            c: (1 - f.chi2.sum() / bare.chi2.sum(), p_values[c]) for (c, _), f in zip(late, alone)
        }
    return [
        {
            "effect": c.effect.name,
            "place": place_of(c),
            "error_removed": float(best[c][0]),
            "p_value": best[c][1],
        }
        for c in sorted(best, key=lambda c: -best[c][0])
    ]
