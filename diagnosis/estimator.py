"""The statistical method: which physics a simulator lacks, where, how large, and how sure.

    diagnosis = identify(world, train, held_out)     # world.World, lists of recordings.Recording
    diagnosis.summary["findings"]; diagnosis.corrected_xml

1. Noise from differences of the recordings and from short windows that the nominal model can follow.
2. The longest windows that the nominal model still follows; start states by Levenberg-Marquardt.
3. Search over all candidates (selection.Search), where that leaves much once more from nothing with larger steps; again
   with the longer windows that the better model then follows.
4. Final refit on more windows: intervals from the sandwich covariance between clusters of windows.
5. What could stand in each finding's place (rivals); what is left unexplained.
Held-out recordings enter only after everything is chosen and fitted.
"""

from dataclasses import replace

import numpy as np

from diagnosis import findings
from diagnosis.estimation import initial_states, multiple_shooting, observer, residuals
from diagnosis.estimation import windows as cut
from diagnosis.estimation.horizons import (
    FEW_ROWS,
    FINAL_STEPS,
    LEAST_ROWS,
    MORE,
    SEARCH_STEPS,
    problem_of,
    shortest_rows,
    span_for,
    windows_for,
)
from diagnosis.recordings.recording import RecordingError
from diagnosis.selection import candidates, clock, rivals, transients, unmodelled_force
from diagnosis.selection import search as selection
from diagnosis.selection.earning import earned

LEFTOVER_SPANS = 0.2, 0.1  # s
MOST = 0.7  # share of the squared residual, that a leftover explains, above which no shorter windows are asked
STAND_IN = 0.1  # share of what named effects and a leftover curve explain, up to which the curve does without them
GROSS = 5.0  # residual of a window over the usual one, that it may count for
MUCH, UNFOUND = (
    4.0,
    0.05,
)  # squared residual, over the noise's and the nominal model's, above which shorter windows are tried
UNLIKELY = 3.0  # standard deviations of the squared residual, that an event must spare
MANY, SOME = (
    3,
    60,
)  # effects, of which a few may be one in disguise; windows in which another search will do
ROUNDS = 3  # of search, each with longer windows


def identify(world, train, held_out, progress=None):
    """Diagnose a simulator from recordings.

    world: world.World; train, held_out: lists of Recording (held_out is used for nothing but the final figures).
    progress(done, message): called with the share done, 0..1. Raises RecordingError where the data say too little.
    """
    say = progress or (lambda done, message: None)
    say(0.0, "estimating noise")
    position_noise, velocity_noise = noise_of(world, train)
    data = world, train, position_noise, velocity_noise, None
    search, fit, ranking, span = searched(data, say)
    event = happened(data, search, fit.hypothesis)
    if event:  # what lasts is searched again where it was not disturbed
        data = world, train, position_noise, velocity_noise, event
        search, fit, ranking, span = searched(data, say)
    say(0.6, "alternatives")
    fit, possible = rivals.settle(search, fit)
    hypothesis = fit.hypothesis
    say(0.75, "testing for anything left")
    hypothesis, left, hint, possible = anything_left(data, search, hypothesis, possible)
    hypothesis = residuals.Hypothesis(
        tuple((c, c.effect.canonical(values)) for c, values in hypothesis.effects)
    )
    say(0.8, "intervals")
    problem, fit = bounded(problem_of(*data, span, FINAL_STEPS), hypothesis)
    final = selection.Search(world, problem, train, search.coarse)
    if hypothesis.effects:
        [fit] = multiple_shooting.solve(final.problem, [hypothesis], fit)
        fit = final.drop(multiple_shooting.renewed(final.problem, fit), ())
        fit = earned(
            final, fit, windows_for(world, train, cut.HORIZON, FINAL_STEPS, event), position_noise
        )
        hypothesis = fit.hypothesis
    if left and left.candidate not in hypothesis.candidates:
        left, hint = None, left
    largest = max(hypothesis.candidates, key=lambda c: final.significance(fit, c)[1], default=None)
    note = clock.suspect(final.small, fit.subset(final.few), largest)
    say(0.9, "held-out error")
    position_noise, velocity_noise = lowered_noise(
        world, train, position_noise, velocity_noise, hypothesis
    )
    found = findings.assemble(
        world,
        train,
        held_out,
        fit,
        final,
        possible,
        left,
        hint,
        event,
        ranking,
        position_noise,
        velocity_noise,
    )
    return replace(found, summary={**found.summary, "warnings": [note] if note else []})


def searched(data, say):
    """Rounds of search with longer and longer windows: (Search, Fit, first ranking, last span).

    Where the first leaves much, windows were too long for that: motion far off is soon not linear, and start states stick. If
    what shorter ones say reaches the noise there and not in longer ones, the shorter ones have the last word.
    """
    world, train = data[:2]
    hypothesis, ranking, span, kept = residuals.Hypothesis(), [], 0.0, None
    for i in range(ROUNDS):
        say(0.05 + 0.15 * i, "choosing windows")
        longer = span_for(*data, hypothesis, at_least=span)
        if i and longer < MORE * span:
            break
        say(
            0.1 + 0.15 * i,
            f"searching {len(world.candidates)} candidates in {longer:.2g} s windows",
        )
        search, fit, before = sought(
            world, train, problem_of(*data, longer, SEARCH_STEPS), hypothesis
        )
        span = longer
        # in few rows even a small part of what an unstable mechanism first missed is much
        share = UNFOUND if sum(len(r.time) for r in train) > FEW_ROWS else 0.0
        much = fit.chi2.sum() > max(MUCH * search.problem.rows, share * before)
        if much and kept:  # too long again
            search, fit, span = kept
            break
        if (much or search.gives_up(fit)) and not i:
            found = shorter(data, search, fit, span, say)
            # of what reaches the noise in short windows and not in long ones, the start states are wrong there
            kept = (
                found
                if found[2] < span and found[1].chi2.sum() < selection.FAR * found[0].problem.rows
                else None
            )
            search, fit, span = found
        if not (i or fit.hypothesis.effects) and observer.far_apart(train):
            search, fit, span = further(data, search, fit, span, say)
        hypothesis = fit.hypothesis
        ranking = ranking or search.ranking
    return search, fit, ranking, span


def shorter(data, search, fit, span, say):
    """(Search, Fit, span) of shorter windows in which something is found, or as given.

    What longer windows said, wrong as its value may be for start states that stuck there, is a beginning in these.
    """
    world, train = data[:2]
    less_span, shortest = span, shortest_rows(train) * cut.sampling(train)
    while less_span > MORE * shortest:
        less_span = max(less_span / 3, shortest)
        say(0.15, f"searching {len(world.candidates)} candidates in {less_span:.2g} s windows")
        other, less, _ = sought(
            world, train, problem_of(*data, less_span, SEARCH_STEPS), residuals.Hypothesis()
        )
        if fit.hypothesis.effects:
            [again] = multiple_shooting.solve(other.problem, [fit.hypothesis], less)
            if again.chi2.sum() < (1 + selection.WORTH) * less.chi2.sum():
                less = other.run(other.drop(again, ()))
        if less.hypothesis.effects:
            return other, less, less_span
    return search, fit, span


def further(data, search, fit, span, say):
    """(Search, Fit, span) of longer windows in which something is found and then nothing left, or as given.

    For rows far apart: there windows are kept as short as start states need them, and in those a small fault is not seen.
    """
    world, train = data[:2]
    more_span, most = span, span_for(*data, fit.hypothesis, at_least=span, scatter=np.inf)
    while more_span < most:
        more_span = min(2 * more_span, most)
        say(0.15, f"searching {len(world.candidates)} candidates in {more_span:.2g} s windows")
        other, more, _ = sought(
            world, train, problem_of(*data, more_span, SEARCH_STEPS), residuals.Hypothesis()
        )
        if more.hypothesis.effects and more.chi2.sum() < selection.FAR * other.problem.rows:
            return other, more, more_span
    return search, fit, span


def sought(world, train, problem, hypothesis):
    """(Search, Fit, squared residual at the beginning) of what a problem's windows say, begun at a hypothesis.

    Where nothing was known and that leaves much, or takes many effects, it is done again: with nothing held back, and with larger
    steps. Where something is met in one step of time or in the next predictions jump, and small steps see the jumps alone.
    """
    problem, fit = bounded(problem, hypothesis)
    before = fit.chi2.sum()
    search = selection.Search(world, problem, train)
    if hypothesis.effects:
        [fit] = multiple_shooting.solve(problem, [hypothesis], fit)
        fit = search.drop(fit, ())
    fit = search.run(fit)
    several = [c for c in fit.hypothesis.candidates if c.effect.name != "time_step"]
    if not hypothesis.effects and (
        search.gives_up(fit) or search.leaves_much(fit) or len(several) >= MANY
    ):
        search, fit = again(search, fit)
    return search, fit, before


def again(search, fit):
    """(Search, Fit) of a search from nothing with larger steps and nothing held back, in some of the windows where these are
    many; as given, where it finds nothing better."""
    number = len(search.problem.windows)
    some = cut.evenly(number, SOME)
    part, size = search.problem.subset(some), lambda f: len(f.hypothesis.parameters)
    better = lambda new, old: (
        new.chi2.sum()
        < (1 + candidates.WORTH if size(new) < size(old) else 1 - search.worth(fit))
        * old.chi2.sum()
    )
    new = selection.Search(search.world, part, search.recordings, coarse=True)
    found = new.run(initial_states.fit(part, residuals.Hypothesis()), late=True)
    if (
        not found.hypothesis.effects
        or not found.hypothesis.possible
        or not better(found, fit.subset(some))
    ):
        return search, fit
    if len(some) < number:
        new = selection.Search(search.world, search.problem, search.recordings, coarse=True)
        begun = initial_states.fit(search.problem, found.hypothesis)
        [found] = multiple_shooting.solve(search.problem, [found.hypothesis], begun)
    return (new, found) if better(found, fit) else (search, fit)


def bounded(problem, hypothesis):
    """The problem with less weight on windows whose residual is GROSS beside the others', lest a few decide alone; a Fit."""
    fit = initial_states.fit(problem, hypothesis)
    each = fit.chi2 / np.maximum((problem.weight > 0).sum((1, 2)), 1)
    factor = np.sqrt(
        np.minimum(GROSS**2 * max(np.median(each), 1.0) / np.maximum(each, 1e-300), 1.0)
    )
    return (problem, fit) if factor.min() == 1 else problem.weighted(fit, factor)


# ---- data --------------------------------------------------------------------------------------


def noise_of(world, train):
    """Position and velocity noise per dof, (nv,), (nv,): by differences, or what the nominal model leaves of short windows.

    Both are upper bounds: differences where the control jumps at every row, the model where it is wrong.
    """
    position, velocity = cut.measurement_noise(world.model, train)
    if not np.isfinite(position).any() and not np.isfinite(velocity).any():
        raise RecordingError(
            "not enough data: recordings need at least ten measured rows in some qpos column"
        )
    for _ in range(2):
        position, velocity = lowered_noise(world, train, position, velocity, residuals.Hypothesis())
    return position, velocity


def lowered_noise(world, train, position, velocity, hypothesis):
    """Noise (nv,), (nv,) as given, or less where a model leaves less of short windows."""
    model = world.model
    sample = cut.sampling(train)
    problem = problem_of(world, train, position, velocity, None, LEAST_ROWS * sample, SEARCH_STEPS)
    fit, weight = initial_states.fit(problem, hypothesis, sharp=False), problem.weight
    gap = fit.residual[:, : weight[0].size].reshape(weight.shape) / np.where(weight > 0, weight, 1)
    square, rows = np.where(weight > 0, gap**2, 0).sum(1), (weight > 0).sum(1)  # (W, 2 nv)
    left = np.array(
        [
            np.sqrt(np.median(s[r > 3] / (r[r > 3] - 2))) if (r > 3).any() else np.inf
            for s, r in zip(square.T, rows.T)
        ]
    )
    left = np.maximum(left, 1e-9)
    for dofs in cut.channels(model).values():
        left[dofs] = cut.pooled(left[dofs])
    return np.minimum(position, left[: model.nv]), np.minimum(velocity, left[model.nv :]) if len(
        left
    ) > model.nv else velocity


def happened(data, search, hypothesis):
    """What came and went for a while, beside what lasts or instead of it: an Event, if it leaves less than what lasts can; else None."""
    problem = problem_of(*data, LEFTOVER_SPANS[0], FINAL_STEPS)
    lasting, found = initial_states.fit(problem, hypothesis), []
    noise = candidates.freedom(problem)
    total = lasting.chi2.sum()
    notable = max(
        STAND_IN * (total - noise), UNLIKELY * np.sqrt(2 * noise)
    )  # of white noise's scatter
    instead = [
        hypothesis.minus(c) for c in hypothesis.candidates
    ]  # what an event made look like something lasting
    for h in dict.fromkeys((hypothesis, *instead, residuals.Hypothesis())):
        event = transients.find(
            data[0], problem, lasting if h == hypothesis else initial_states.fit(problem, h)
        )
        if event and event.left < total - notable:
            found.append(event)
    event = min(found, key=lambda e: e.left) if found else None
    return None if event and lasts(search, problem, lasting, event) else event


def lasts(search, problem, fit, event):
    """Whether a force that acts whenever the motion is like that, beside what a fit holds, explains as much as an event."""
    found = unmodelled_force.leftover(search, problem, fit, fit.chi2.sum())
    if not found or "time" in found.variables:
        return False
    [new] = multiple_shooting.solve(
        problem, [fit.hypothesis.plus(found.candidate, found.candidate.nominal)], fit
    )
    return new.chi2.sum() < (1 + selection.WORTH) * event.left


def anything_left(data, search, hypothesis, possible):
    """(hypothesis, large Leftover or None, small one or None, what else is possible): what the residual depends on.

    possible: {candidate: [(error ratio, other candidate, values), ...]}, as settle returns it. Named effects that only stood
    in for what is left go, all of them or one after the other: where it explains as much without them, and much more than
    they do without it.
    """
    hint, best = None, None
    shortest = LEAST_ROWS * cut.sampling(data[1])
    spans = sorted({max(span, shortest) for span in LEFTOVER_SPANS}, reverse=True)
    for problem in [search.problem] + [problem_of(*data, span, SEARCH_STEPS) for span in spans]:
        fit = initial_states.fit(problem, hypothesis)
        if unmodelled_force.quiet(problem, fit):
            continue
        bare = initial_states.fit(problem, residuals.Hypothesis()) if hypothesis.effects else fit
        found = unmodelled_force.leftover(search, problem, fit, bare.chi2.sum())
        hint = hint or found
        notable = found and (found.large or len(hypothesis.effects) > 1 and found.share > MOST)
        if notable and (best is None or found.share > best[0].share):
            best = found, problem, fit, bare
        if best and best[0].share > MOST:
            break
    if best is None:
        return hypothesis, None, hint, possible
    found, problem, fit, bare = best
    curve, named = unmodelled_force.tuned(problem, fit, found.candidate), fit.chi2.sum()
    found = replace(found, candidate=curve)
    [fit] = multiple_shooting.solve(problem, [hypothesis.plus(curve, curve.nominal)], fit)
    for gone in [hypothesis.candidates] + [(c,) for c in hypothesis.candidates]:
        shorter = fit.hypothesis.minus(*gone)
        if len(shorter.effects) < len(fit.hypothesis.effects):
            shorter = shorter.plus(curve, curve.nominal)
            [less] = multiple_shooting.solve(
                problem, [shorter], bare if len(shorter.effects) == 1 else fit
            )
            rest = fit.chi2.sum()
            if less.chi2.sum() < rest + min(
                STAND_IN * (bare.chi2.sum() - rest), 0.5 * (named - rest)
            ):
                fit = less
    if not found.large and len(fit.hypothesis.effects) > 1:  # it counts only in the place of all
        return hypothesis, None, hint, possible
    local = selection.Search(search.world, problem, search.recordings)
    local.kept = search.kept
    renamed, others = named_instead(local, fit, curve)
    if renamed:
        return renamed, None, None, {**possible, **others}
    fit, settled = rivals.settle(
        local, fit, but=(curve,)
    )  # beside the curve others may look likelier
    return fit.hypothesis, found, None, {**settled, **others}


def named_instead(search, fit, curve):
    """(the hypothesis with an effect of the catalogue in a curve's place, if one leaves no more than the curve, else None;
    {that effect, or the curve: [(error ratio, other candidate, values), ...]})."""
    small = fit.subset(search.few)
    others = sorted(
        rivals.alternatives(search, fit, small, curve)[0], key=lambda o: o[0].chi2.sum()
    )
    listed = [
        (float(np.sqrt(f.chi2.sum() / small.chi2.sum())), c, f.hypothesis.settings[c])
        for f, c in others
    ]
    if others and others[0][0].chi2.sum() <= (1 + selection.WORTH) * small.chi2.sum():
        [new] = multiple_shooting.solve(search.problem, [others[0][0].hypothesis], fit)
        if new.chi2.sum() < (1 + selection.WORTH) * fit.chi2.sum():
            return new.hypothesis, {others[0][1]: listed[1:]}
    return None, {curve: listed}
