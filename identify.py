"""The statistical method: which physics a simulator lacks, where, how large, and how sure.

    diagnosis = identify(world, train, held_out)     # physics.World, lists of recordings.Recording
    diagnosis.summary["findings"]; diagnosis.corrected_xml

1. Noise from differences of the recordings and from short windows that the nominal model can follow.
2. The longest windows that the nominal model still follows; start states by Levenberg-Marquardt.
3. Search over all candidates (selection.Search), again with the longer windows that the better model then follows.
4. Final refit on more windows: intervals from the sandwich covariance between clusters of windows.
5. What could stand in each finding's place; what is left unexplained.
Held-out recordings enter only after everything is chosen and fitted.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

import events
import evidence
import scores
import selection
import shooting
import unknown
import windows as cut
from recordings import RecordingError

SEARCH_STEPS = 10000  # simulated steps of one pass over the windows: in the search, and in the final fit
FINAL_STEPS = 30000
LEAST_ROWS, LEAST_WINDOWS, FEW_ROWS = 8, 20, 100
LEFTOVER_SPANS, LEFTOVER_WORTH = (0.2, 0.1), 0.05  # s; share of the nominal's squared residual that a leftover must explain
SAME = 0.05  # effects whose refits differ by less than this in the reported error cannot be told apart
ROUNDS = 3  # of search, each with longer windows
LONGEST = 1.3  # s, of a window
FOLLOWS, FOLLOWS_SHARE = 8.0, 0.03  # residual, in noises and as a share of the motion, above which windows are too long


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


def identify(world, train, held_out, progress=None):
    """Diagnose a simulator from recordings.

    world: physics.World; train, held_out: lists of Recording (held_out is used for nothing but the final figures).
    progress(done, message): called with the share done, 0..1. Raises RecordingError where the data say too little.
    """
    say = progress or (lambda done, message: None)
    say(0.0, "estimating noise")
    position_noise, velocity_noise = noise_of(world, train)
    event, hypothesis = None, shooting.Hypothesis()
    for attempt in range(2):  # what came and went for a while would be mistaken for something that always acts
        data = world, train, position_noise, velocity_noise, event
        problem = problem_of(*data, LEFTOVER_SPANS[0], FINAL_STEPS)
        found = None if event else events.find(world, problem, shooting.fit_starts(problem, hypothesis))
        event = event or found
        if attempt and not found:
            break
        data = world, train, position_noise, velocity_noise, event
        search, fit, ranking, span = searched(data, say)
        hypothesis = fit.hypothesis
        if event:
            break
    say(0.6, "alternatives")
    fit, possible = search.settle(fit)
    hypothesis = fit.hypothesis
    say(0.75, "testing for anything left")
    hypothesis, left = anything_left(data, search, hypothesis)
    say(0.8, "intervals")
    final = selection.Search(world, problem_of(*data, span, FINAL_STEPS), train)
    fit = shooting.fit_starts(final.problem, hypothesis)
    if hypothesis.effects:
        [fit] = shooting.solve(final.problem, [hypothesis], fit)
        fit = final.drop(fit, ())
        hypothesis = fit.hypothesis
    if left and left.simulable and not any(c.effect.name == "unknown" for c in hypothesis.candidates):
        left = None
    say(0.9, "held-out error")
    position_noise, velocity_noise = lowered_noise(world, train, position_noise, velocity_noise, hypothesis)
    return assemble(world, train, held_out, fit, final, possible, left, event, ranking,
                    position_noise, velocity_noise)


def searched(data, say):
    """Rounds of search with longer and longer windows: (Search, Fit, first ranking, last span)."""
    world, train = data[:2]
    hypothesis, ranking, span = shooting.Hypothesis(), [], 0.0
    for i in range(ROUNDS):
        say(0.05 + 0.15 * i, "choosing windows")
        longer = span_for(*data, hypothesis, at_least=span)
        if i and longer < 1.5 * span:
            break
        span = longer
        problem = problem_of(*data, span, SEARCH_STEPS)
        say(0.1 + 0.15 * i, f"searching {len(world.candidates)} candidates in {span:.2g} s windows")
        search = selection.Search(world, problem, train)
        fit = shooting.fit_starts(problem, hypothesis)
        if hypothesis.effects:
            [fit] = shooting.solve(problem, [hypothesis], fit)
            fit = search.drop(fit, ())
        fit = search.run(fit)
        hypothesis = fit.hypothesis
        ranking = ranking or search.ranking
    return search, fit, ranking, span


# ---- data --------------------------------------------------------------------------------------


def noise_of(world, train):
    """Position and velocity noise per dof, (nv,), (nv,): by differences, or what the nominal model leaves of short windows.

    Both are upper bounds: differences where the control jumps at every row, the model where it is wrong.
    """
    position, velocity = cut.measurement_noise(world.model, train)
    if not np.isfinite(position).any() and not np.isfinite(velocity).any():
        raise RecordingError("not enough data: recordings need at least ten measured rows in some qpos column")
    for _ in range(2):
        position, velocity = lowered_noise(world, train, position, velocity, shooting.Hypothesis())
    return position, velocity


def lowered_noise(world, train, position, velocity, hypothesis):
    """Noise (nv,), (nv,) as given, or less where a model leaves less of short windows."""
    model = world.model
    sample = np.median([np.median(np.diff(r.time)) for r in train])
    problem = problem_of(world, train, position, velocity, None, LEAST_ROWS * sample, SEARCH_STEPS)
    fit, weight = shooting.fit_starts(problem, hypothesis), problem.weight
    gap = fit.residual[:, :weight[0].size].reshape(weight.shape) / np.where(weight > 0, weight, 1)
    square, rows = np.where(weight > 0, gap**2, 0).sum(1), (weight > 0).sum(1)  # (W, 2 nv)
    left = np.array([np.sqrt(np.median(s[r > 3] / (r[r > 3] - 2))) if (r > 3).any() else np.inf for s, r in zip(square.T, rows.T)])
    left = np.maximum(left, 1e-9)
    for dofs in cut.channels(model).values():
        left[dofs] = np.sqrt(np.mean(left[dofs] ** 2))
    return np.minimum(position, left[:model.nv]), np.minimum(velocity, left[model.nv:])


def windows_for(world, recordings, span, steps, event=None):
    """Windows of span seconds spread evenly over the recordings, at most `steps` simulated steps in all."""
    every = []
    for r in recordings:
        sample = np.median(np.diff(r.time))
        for first, end in events.quiet(r, event):
            every += cut.consecutive(r, max(span, LEAST_ROWS * sample), first, end)
    duration = np.median([w.recording.time[w.last] - w.recording.time[w.first] for w in every])
    number = max(LEAST_WINDOWS, int(steps / dear(world.model) * world.model.opt.timestep / duration))
    return [every[i] for i in np.unique(np.linspace(0, len(every) - 1, min(number, len(every))).round().astype(int))]


def dear(model):
    """What one step of a model costs, about, with a two-joint arm's as 1."""
    runge_kutta = model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    return (6 + model.nv) / 8 * (3.0 if runge_kutta else 1.0)


def problem_of(world, recordings, position_noise, velocity_noise, event, span, steps):
    return shooting.Problem(world, windows_for(world, recordings, span, steps, event), position_noise, velocity_noise)


def follows(problem, fit, share_allowed):
    """Whether a model follows its windows: the median residual is a few noises, or a small part of the motion."""
    weight, size = problem.weight, problem.weight[0].size
    rows = np.maximum((weight > 0).sum((1, 2)) - 2 * problem.model.nv, 1)
    if np.sqrt(np.median(fit.chi2 / rows)) < FOLLOWS:
        return True
    gap = fit.residual[:, :size].reshape(weight.shape) / np.where(weight > 0, weight, np.inf)
    moved = np.nanstd(cut.difference(problem.model, problem.measured_qpos[:, :1], problem.measured_qpos), axis=1)
    share = np.sqrt((gap[..., :problem.model.nv] ** 2).mean(1)) / np.maximum(moved, 1e-12)
    return bool(np.nanmedian(share) < share_allowed)


def span_for(world, train, position_noise, velocity_noise, event, hypothesis, at_least=0.0):
    """The longest window span that the model with a hypothesis follows, from a few samples up.

    Up to LONGEST (or a few dozen rows) while the residual is a few noises; where recordings are far more precise than
    any model, longer windows only add nonlinearity, and half the reported horizon is enough.
    """
    sample = np.median([np.median(np.diff(r.time)) for r in train])
    duration = np.median([np.ptp(r.time) for r in train])
    shortest = max(LEAST_ROWS * sample, at_least)
    if sum(len(r.time) for r in train) < FEW_ROWS:  # too little to be cut
        return float(duration)
    enough = sum(np.ptp(r.time) for r in train) / 12  # clusters need windows
    longest = max(shortest, min(max(LONGEST, 40 * sample), 0.5 * duration, enough))

    def followed(span):
        problem = problem_of(world, train, position_noise, velocity_noise, event, span, SEARCH_STEPS / 4)
        return follows(problem, shooting.fit_starts(problem, hypothesis), FOLLOWS_SHARE if span < 0.6 * cut.HORIZON else 0.0)

    span = float(np.clip(cut.HORIZON / 2, shortest, longest))
    if followed(span):
        while span < longest and followed(min(2 * span, longest)):
            span = min(2 * span, longest)
        return span
    while span / 2 >= shortest:
        span /= 2
        if followed(span):
            break
    return span


def anything_left(data, search, hypothesis):
    """(hypothesis, Leftover or None): the residual's dependence on position, velocity, control and time.

    Named effects that only stood in for the leftover curve go.
    """
    for span in LEFTOVER_SPANS:
        problem = problem_of(*data, span, FINAL_STEPS)
        bare = shooting.fit_starts(problem, shooting.Hypothesis()).chi2.sum()

        def look(h):
            fit = shooting.fit_starts(problem, h)
            found = unknown.leftover(search, problem, fit, LEFTOVER_WORTH * bare)
            return found, fit.chi2.sum() * (1 - found.share if found else 1.0)

        found, rest = look(hypothesis)
        if found is None:
            continue
        for candidate in hypothesis.candidates:
            again, alone = look(hypothesis.minus(candidate))
            if again and again.joint == found.joint and alone - rest < 0.1 * (bare - rest):
                hypothesis, found, rest = hypothesis.minus(candidate), again, alone
        curve = found.candidate(data[0])
        return (hypothesis.plus(curve, found.force) if curve else hypothesis), found
    return hypothesis, None


# ---- report ------------------------------------------------------------------------------------


def intervals(search, fit):
    """{candidate: [(low, high), ...]}: 95 %, from the spread between clusters of windows, and the time step's error."""
    if not fit.hypothesis.effects:
        return {}
    slope, moves = search.slopes(fit)
    scan = shooting.project(search.problem, fit, slope, search.pieces)
    gram, score = scores.summed(search.labels, scan.gram), scores.summed(search.labels, scan.score)
    seen = np.diag(gram.sum(0)) > shooting.UNSEEN
    covariance = scores.sandwich(gram[:, seen][:, :, seen], score[:, seen], np.zeros(seen.sum()))
    half = np.full(len(moves), np.inf)
    half[seen] = scores.t_quantile(max(len(gram) - seen.sum(), 1)) * np.sqrt(np.diag(covariance)) * np.abs(moves[seen])
    # the integrator's own error: how far the values would move with half the time step
    finer = search.problem.refined(fit)
    shift = scores.solve_small(gram.sum(0)[np.ix_(seen, seen)], shooting.project(
        search.problem, finer, slope, search.pieces).score.sum(0)[seen] - score.sum(0)[seen])
    half[seen] = np.hypot(half[seen], shift * moves[seen])
    out, at = {}, 0
    for c, values in fit.hypothesis.effects:
        out[c] = [(max(v - h, p.low), min(v + h, p.high)) for v, h, p in zip(values, half[at:], c.parameters)]
        at += len(values)
    return out


def place_of(candidate):
    return {"kind": candidate.place.kind, "name": candidate.place.name}


def parameters_of(candidate, values, bounds=None):
    out = []
    for i, (p, v) in enumerate(zip(candidate.parameters, values)):
        entry = {"name": p.name, "nominal": float(p.nominal), "value": float(v), "unit": p.unit}
        if bounds:
            entry["low"], entry["high"] = (float(b) for b in bounds[i])
        out.append(entry)
    return out


def noise_by_channel(model, position_noise):
    return {name: float(np.sqrt(np.mean(position_noise[dofs] ** 2))) for name, dofs in cut.channels(model).items()
            if np.isfinite(position_noise[dofs]).all()}


def assemble(world, train, held_out, fit, search, possible, left, event, ranking, position_noise, velocity_noise):
    settings, model = fit.hypothesis.settings, world.model
    noise = evidence.reporting_noise(position_noise)
    bounds = intervals(search, fit)
    held = held_out or train
    before, after = (evidence.prediction_error(world, s, held, noise)[0] for s in ({}, settings))
    findings = []
    xml, written = world.corrected_xml(settings)
    for candidate, values in fit.hypothesis.effects:
        without = evidence.prediction_error(world, fit.hypothesis.minus(candidate).settings, held, noise)[0]
        curve = candidate.effect.name == "unknown"
        findings.append({
            "effect": candidate.effect.name, "place": place_of(candidate),
            "parameters": parameters_of(candidate, values, bounds[candidate]),
            "evidence": {"held_out_error_removed": (without - after) / max(before, 1e-12),
                         "p_value": search.significance(fit, candidate)[0]},
            "depends_on": list(left.variables) if curve else depends_on(model, candidate), "when": None, "written_as": written[candidate],
            "also_possible": also_possible(world, train, noise, fit.hypothesis, candidate, possible.get(candidate, []))})
    if left and not left.simulable:  # found, but no curve of one variable: nothing to simulate
        findings.append({"effect": "unknown", "place": {"kind": "joint", "name": left.joint}, "parameters": [],
                         "evidence": {"held_out_error_removed": 0.0, "p_value": left.p_value, "residual_explained": left.share},
                         "depends_on": list(left.variables), "when": None, "written_as": "none", "also_possible": []})
    if event:
        findings.append(event_finding(event, train))
    findings.sort(key=lambda f: -f["evidence"]["held_out_error_removed"])
    figures = {"train": figure(world, settings, train, position_noise, velocity_noise),
               "held_out": figure(world, settings, held, position_noise, velocity_noise)}
    figures["held_out"]["horizon_s"] = cut.HORIZON
    figures["held_out"]["curve"] = evidence.curve(world, {"before": {}, "after": settings}, held, noise)
    floor = figures["held_out"]["floor"]
    summary = {"format": 1, "verdict": "mismatch" if findings else "match",
               "noise": noise_by_channel(model, position_noise), "findings": findings, "fit": figures,
               "unexplained": {"fraction": float(np.clip((after**2 - floor**2) / max(before**2, 1e-24), 0, 1)),
                               "place": None, "depends_on": []}}
    return Diagnosis(summary, xml, world, settings, ranking_rows(ranking, fit), evidence.traces(world, settings, held),
                     train, held)


def event_finding(event, train):
    local = selection.Search(event.problem.world, event.problem, train)
    candidate = event.candidate
    named = lambda c, values, bounds=None: {"effect": c.effect.name, "place": place_of(c), "parameters": parameters_of(c, values, bounds)}
    return {**named(candidate, event.values, intervals(local, event.fit)[candidate]),
            "evidence": {"held_out_error_removed": 0.0, "p_value": event.p_value},
            "depends_on": ["time"], "when": event.when, "written_as": "none",
            "also_possible": [named(c, values) for c, values in event.others]}


def figure(world, settings, recordings, position_noise, velocity_noise):
    noise, channels, out = evidence.reporting_noise(position_noise), {}, {}
    for name, s in (("before", {}), ("after", settings)):
        out[name], per_channel = evidence.prediction_error(world, s, recordings, noise)
        for channel, value in per_channel.items():
            channels.setdefault(channel, {})[name] = value
    out["floor"], per_channel = evidence.floor_error(world, settings, recordings, position_noise, velocity_noise)
    for channel, value in per_channel.items():
        channels[channel]["floor"] = value
        channels[channel]["unit"] = unit_of(world.model, channel)
    out["channels"] = channels
    return out


def unit_of(model, channel):
    for j, kind, _, _ in cut.joint_slices(model):
        name = "qpos:" + cut.joint_name(model, j)
        if channel == name + ":pos" or (channel == name and kind.name == "mjJNT_SLIDE"):
            return "m"
    return "rad"


# What the force of an effect varies with.
VARIABLES = {"velocity": ("viscous_damping", "quadratic_damping", "coulomb_friction", "stribeck_friction", "back_emf"),
             "position": ("stiffness", "nonlinear_stiffness", "joint_stop", "backlash", "cogging"),
             "control": ("gain", "saturation", "dead_zone", "delay", "lag"),
             "contact": ("contact_friction", "contact_stiffness", "contact_damping", "ground_height")}


def depends_on(model, candidate):
    variable = next((v for v, names in VARIABLES.items() if candidate.effect.name in names), None)
    name = candidate.place.name
    if variable == "velocity" and candidate.place.kind == "actuator":
        name = cut.joint_name(model, model.actuator(name).trnid[0])
    return [f"{variable}:{name}"] if variable else []


def also_possible(world, train, noise, hypothesis, candidate, others, most=3):
    """The alternatives that leave the reported error, on the data they were fitted to, within 5 % of the finding's."""
    windows = evidence.consecutive(train, cut.HORIZON)
    windows = windows[:: -(-len(windows) // 60)]
    rms = lambda settings: cut.error(world.model, windows, evidence.predict(world, settings, windows)[0], noise)[0]
    out, best = [], rms(hypothesis.settings) if others else 0.0
    for _, other, values in others:
        if len(out) < most and rms(hypothesis.minus(candidate).plus(other, values).settings) < (1 + SAME) * best:
            out.append({"effect": other.effect.name, "place": place_of(other), "parameters": parameters_of(other, values)})
    return out


def ranking_rows(trials, fit):
    """Best option of every candidate in the first scan: share of the squared residual it removes, and its p-value."""
    rows, seen = [], set()
    for t in trials:
        c = t.option.candidate
        if c in seen:
            continue
        seen.add(c)
        rows.append({"effect": c.effect.name, "place": place_of(c), "error_removed": float(t.gain / t.chi2), "p_value": t.p_value,
                     "chosen": c in fit.hypothesis.candidates})
    return rows[:40]
