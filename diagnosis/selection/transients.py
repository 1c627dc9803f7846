"""Effects that act only for a while: a load picked up, a push. Where in time does the residual concentrate?

    event = find(world, problem, fit)            # None, or an Event
    event.when, event.candidate                  # {"recording": name, "time": [a, b]}, a localised Candidate

Windows follow each other through every recording. The gain of an effect that acts in windows a..b only is the gain of
the sums of its scores and Gram matrices over them, so every interval is tested from one simulation per effect.
"""

from dataclasses import dataclass, field

import numpy as np

from diagnosis.estimation import cluster_scores, multiple_shooting, residuals
from diagnosis.estimation import windows as cut

LEVEL = 1e-3  # false-alarm rate, shared between all intervals and effects
CONCENTRATED = (
    0.8  # of what lies above the usual residual, the share that the interval must explain
)
QUIET = 3.0  # squared residual over the noise's, of the windows without an event, above which something else is wrong
ALONE = 0.9  # of an event's gain, the share of one window, above which that window is odd rather than an event
LONGEST = 0.6  # of a recording: what lasts longer is no event
USUAL = {1: 0.148, 2: 0.713, 3: 1.424}  # quantile 0.3 of chi-square


@dataclass
class Event:
    candidate: object  # localised
    values: tuple
    recording: object
    time: tuple  # (from, to), s
    p_value: float
    fit: object = None  # misfit.Fit on the windows around it
    problem: object = None
    left: float = 0.0  # squared residual of all windows with it
    others: list = field(default_factory=list)  # [(candidate, values)] that explain it as well

    @property
    def when(self):
        return {"recording": self.recording.name, "time": [float(t) for t in self.time]}


def tried(world):
    """(the effect that acts always, the one to report) for every effect that may come and go."""
    by = {(c.effect.name, c.place): c for c in world.candidates}
    out = [(c, c) for c in world.candidates if c.effect.name == "external_force"]
    return out + [
        (by["mass", c.place], c)
        for c in world.candidates
        if c.effect.timed and ("mass", c.place) in by
    ]


def find(world, problem, fit):
    """The one interval and effect that explain most of a residual which is concentrated there, or None."""
    pairs = tried(world)
    if not pairs or len(problem.windows) < 12:
        return None
    settings, where, moves, bases = [], [], [], []
    for steady, timed in pairs:
        base = np.array(
            fit.hypothesis.settings.get(steady, steady.nominal)
        )  # what a fit holds of it already
        moved, step = multiple_shooting.perturbed(residuals.Hypothesis(((steady, base),)))
        bases.append(
            np.array(timed.nominal) if steady is timed else base
        )  # a push adds to one that lasts, a load takes the mass's place
        where.append(range(len(settings), len(settings) + len(step)))
        settings += [{**fit.hypothesis.settings, steady: m[steady]} for m in moved]
        moves.append(step)
    scan = multiple_shooting.project(
        problem, fit, multiple_shooting.columns(problem, [fit], [settings])[0]
    )
    rows = problem.free
    if np.quantile(scan.chi2 / rows, 0.3) > QUIET:
        return None
    usual = np.quantile(scan.chi2 / rows, 0.3) * (
        rows + 2 * np.sqrt(2 * rows)
    )  # with the scatter of white noise
    excess = (scan.chi2 - usual).clip(0).sum()
    best, everything = None, []
    for (_, timed), columns, step, base in zip(pairs, where, moves, bases):
        keep = [c for c in columns if scan.gram[:, c, c].sum() > multiple_shooting.UNSEEN]
        if not keep:
            continue
        score, gram = scan.score[:, keep], scan.gram[:, keep][:, :, keep]
        alone = np.array([s @ cluster_scores.solve_small(g, s) for s, g in zip(score, gram)])
        spread = max(
            np.quantile(alone, 0.3) / USUAL[len(keep)], 1.0
        )  # what windows without an event show
        for r in cut.recordings_of(problem.windows):
            mine = np.array([i for i, w in enumerate(problem.windows) if w.recording is r])
            for a in range(len(mine)):
                for b in range(a, min(len(mine), a + max(1, int(LONGEST * len(mine))))):
                    s, g = score[mine[a : b + 1]].sum(0), gram[mine[a : b + 1]].sum(0)
                    value = cluster_scores.solve_small(g, s)
                    gain = float(s @ value)
                    share = (
                        2 * score[mine[a : b + 1]] @ value
                        - np.einsum("i,wij,j->w", value, gram[mine[a : b + 1]], value)
                    ).max()
                    if share < ALONE * gain and (best is None or gain > best[0]):
                        full = np.zeros(len(columns))
                        full[[c - columns[0] for c in keep]] = value
                        best = (
                            gain,
                            timed,
                            base + full * step,
                            r,
                            mine[a],
                            mine[b],
                            len(keep),
                            spread,
                        )
        everything.append((timed, columns, keep, step, base, score, gram))
    if best is None:
        return None
    gain, timed, values, r, a, b, k, spread = best
    count = len(problem.windows)
    p = cluster_scores.f_survival(gain / k / spread, k, max(count - k, 1)) * count**2 * len(pairs)
    if p > LEVEL or gain < CONCENTRATED * excess:
        return None
    low, high = (np.array([getattr(q, f) for q in timed.parameters]) for f in ("low", "high"))
    time = r.time[problem.windows[a].first], r.time[problem.windows[b].last]
    event = refined(
        world,
        problem,
        fit,
        Event(None, tuple(np.clip(values, low, high)), r, time, float(min(p, 1))),
        timed,
    )
    inside, others = [i for i in range(a, b + 1) if problem.windows[i].recording is r], []
    for other, columns, keep, step, base, score, gram in everything:
        if other != timed:
            s, g = score[inside].sum(0), gram[inside].sum(0)
            value = cluster_scores.solve_small(g, s)
            if s @ value > 0.8 * gain:
                full = base.copy()
                full[[c - columns[0] for c in keep]] += value * step[[c - columns[0] for c in keep]]
                others.append((world.localised(other, event.when), full))
    rest = fit.hypothesis
    fits = multiple_shooting.solve(
        event.problem, [rest.plus(c, v) for c, v in others], event.fit, iterations=4
    )
    now = event.fit.chi2.sum()
    close = sorted((f.chi2.sum(), i) for i, f in enumerate(fits) if f.chi2.sum() < 1.1 * now)
    event.others = [
        (fits[i].hypothesis.candidates[-1], fits[i].hypothesis.effects[-1][1]) for _, i in close[:3]
    ]
    return event


def refined(world, problem, fit, event, timed):
    """The event with its ends moved, and its values fitted, on the windows around it."""
    span = np.median(
        [w.recording.time[w.last] - w.recording.time[w.first] for w in problem.windows]
    )
    near = [
        i
        for i, w in enumerate(problem.windows)
        if w.recording is event.recording
        and w.recording.time[w.last] > event.time[0] - 2.5 * span
        and w.recording.time[w.first] < event.time[1] + 2.5 * span
    ]
    local, start = problem.subset(near), fit.subset(near)
    bounds, values = list(event.time), event.values
    sample = float(np.median(np.diff(event.recording.time)))
    for reach in (span, span / 3, sample):
        for end in (0, 1):
            trials = []
            for shift in np.linspace(-reach, reach, 7):
                time = bounds.copy()
                time[end] += shift
                if time[1] - time[0] > sample:
                    trials.append(time)
            hypotheses = [
                fit.hypothesis.plus(
                    world.localised(timed, {"recording": event.recording.name, "time": t}), values
                )
                for t in trials
            ]
            fits = multiple_shooting.solve(local, hypotheses, start, iterations=3)
            best = int(np.argmin([f.chi2.sum() for f in fits]))
            bounds, values = trials[best], fits[best].hypothesis.effects[-1][1]
            start = fits[best]
    event.candidate, event.values, event.time = (
        start.hypothesis.candidates[-1],
        values,
        tuple(bounds),
    )
    event.fit, event.problem, event.left = (
        start,
        local,
        float(np.delete(fit.chi2, near).sum() + start.chi2.sum()),
    )
    return event


def quiet(recording, event):
    """[(first row, end row)] of the stretches of a recording that an event does not touch."""
    rows = len(recording.time)
    if event is None or recording is not event.recording:
        return [(0, rows)]
    start, stop = np.searchsorted(recording.time, event.time)
    return [(a, b) for a, b in ((0, int(start)), (int(stop) + 1, rows)) if b - a > 8]
