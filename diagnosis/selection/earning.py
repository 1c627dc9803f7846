"""Does every effect earn its keep? The reported error with it, its value as other recordings say, and without it, refitted.

    fit = earned(search, fit, windows, position_noise)      # without the effects that do not

The search judges by windows whose start states are fitted, where a small effect shows best. Where that model reaches the
noise it is to be trusted, unless prediction speaks against it; where it does not, an effect may only bend towards another that
is missing, and has to show in the reported error too: by more than that scatters between recordings or stretches of them, or clearly in all.
"""

import numpy as np

from diagnosis.estimation import cluster_scores, multiple_shooting, prediction_error
from diagnosis.estimation import windows as cut

WORSE, SLIGHT = (
    0.02,
    0.01,
)  # of the reported error: more is no accident; less is not worth an effect
LEVEL = 0.95  # of Student's t, one-sided, beyond which a difference is more than scatter
PLAIN = 0.5  # relative rise of the squared residual without an effect, from which on only clear harm speaks against it
CAP = 10.0  # times the largest finite error of a window, that one which blows up counts for


def earned(search, fit, windows, position_noise):
    """The fit without the effects that are not worth having for predicting, dropped one at a time, the others refitted."""
    noise = prediction_error.reporting_noise(position_noise)
    error = lambda settings: gaps(search.world, settings, windows, noise)
    while fit.hypothesis.effects:
        candidates = fit.hypothesis.candidates
        before, after = (error(s) for s in ([{}] * len(windows), elsewhere(search, fit, windows)))
        far = is_far(search, fit)
        rise, bound, _ = scatter(windows, before, after)
        harm = overall(after) > (1 + WORSE) * overall(before) and (far or rise >= bound)
        if harm:  # what only stands in for something else goes first
            weak = [
                max(
                    candidates,
                    key=lambda c: (c.effect.name == "unknown", search.significance(fit, c)[0]),
                )
            ]
        else:
            without = absent(search, fit, windows, noise, far) if len(candidates) > 1 else [before]
            doubts = {
                c: doubt(search, fit, windows, c, after, less)
                for c, less in zip(candidates, without)
            }
            weak = sorted((c for c, d in doubts.items() if d is not None), key=doubts.get)
        for candidate in weak:
            less = search.without(
                fit, candidate
            )  # the others refitted with more care: is the doubt still there?
            if (
                harm
                or doubt(
                    search,
                    fit,
                    windows,
                    candidate,
                    after,
                    error([less.hypothesis.settings] * len(windows)),
                )
                is not None
            ):
                break
        else:
            break
        fit = less
    return fit


def doubt(search, fit, windows, candidate, after, less):
    """What an effect gains over its scatter, where prediction speaks against it, else None. after, less: gaps with it and without."""
    gain, bound, whole = scatter(windows, after, less)
    if not gain:  # what no measured position sees, velocities may: it is not judged here
        kept = True
    elif is_far(search, fit):
        kept = gain > max(bound, SLIGHT * whole) or overall(less) > (1 + SLIGHT) * overall(after)
    else:
        kept = (
            gain > 0
            or there(windows, after, less)
            or gain > -bound
            and search.significance(fit, candidate)[1] > PLAIN
        )
    return None if kept else gain / max(bound, 1e-9)


def is_far(search, fit):
    """Whether a fit is so far from the noise that its effects may only stand in for others; not where it is jumps that keep it there."""
    return search.leaves_much(fit) and not search.coarse


def scatter(windows, one, other):
    """(by how much the sum of windows' errors rises from one (gap, known) to the other, by how much that may be scatter between
    clusters of them, the sum of one)."""
    errors = np.sqrt(
        [(gap**2).sum((1, 2)) / np.maximum(known.sum((1, 2)), 1) for gap, known in (one, other)]
    )  # (2, W)
    finite = errors[np.isfinite(errors)]
    errors = np.minimum(errors, CAP * finite.max() if len(finite) else 1.0)
    rise = cluster_scores.summed(cluster_scores.clusters(windows), errors[1] - errors[0])
    if len(rise) < 2:
        return rise.sum(), 0.0, errors[0].sum()
    return (
        rise.sum(),
        cluster_scores.t_quantile(len(rise) - 1, LEVEL) * np.sqrt(len(rise)) * rise.std(ddof=1),
        errors[0].sum(),
    )


def there(windows, one, less):
    """Whether what an effect adds to predictions may be in the measurements in full: their slope on it, from the gaps with it
    (one) and without (less), is not clearly below one. Where noise in the start states grows fast, no error tells more."""
    one, less = one[0], less[0]
    finite = np.isfinite(one).all((1, 2)) & np.isfinite(less).all((1, 2))
    one, less = (np.where(finite[:, None, None], gap, 0.0) for gap in (one, less))
    added, weight = less - one, 1 / np.maximum((one**2 + less**2).sum((1, 2)), 1e-300)
    labels = cluster_scores.clusters(windows)
    own, along = (
        cluster_scores.summed(labels, weight * (x * added).sum((1, 2))) for x in (added, less)
    )
    if len(own) < 2 or not own.sum():
        return False
    slope = along.sum() / own.sum()
    spread = np.sqrt(len(own)) * (along - slope * own).std(ddof=1) / own.sum()
    return slope > 1 - cluster_scores.t_quantile(len(own) - 1, LEVEL) * spread


def absent(search, fit, windows, noise, far):
    """[gaps] of windows without each effect of a fit, the others refitted: with care only where the model is far from the
    noise, for else nothing but harm is looked for."""
    shorter = [fit.hypothesis.minus(c) for c in fit.hypothesis.candidates]
    if far:
        fits = multiple_shooting.solve(search.small, shorter, fit.subset(search.few), iterations=3)
        fits = multiple_shooting.solve(
            search.problem, [f.hypothesis for f in fits], fit, iterations=1
        )
    else:
        fits = multiple_shooting.solve(
            search.scouting, shorter, fit.subset(search.scouts), iterations=2
        )
    return [
        gaps(search.world, [f.hypothesis.settings] * len(windows), windows, noise) for f in fits
    ]


def elsewhere(search, fit, windows):
    """Settings for each of windows: a fit's values as the other recordings say, one step from it.

    Where there is but one recording: as its other thirds say.
    """
    recordings = cut.recordings_of([*search.problem.windows, *windows])

    def block(w):
        if len(recordings) > 1:
            return recordings.index(w.recording)
        return min(3 * w.first // len(w.recording.time), 2)

    slope, moves = search.slopes(fit)
    scan, owner = (
        multiple_shooting.project(search.problem, fit, slope),
        np.array([block(w) for w in search.problem.windows]),
    )
    low, high = (
        np.array([getattr(p, bound) for p in fit.hypothesis.parameters])
        for bound in ("low", "high")
    )
    settings = {}
    for b in {block(w) for w in windows}:
        others = owner != b
        shift = (
            cluster_scores.elsewhere(
                scan.gram.sum(0), scan.gram[~others].sum(0), scan.score[others].sum(0)
            )
            if others.any()
            else 0.0
        )
        settings[b] = fit.hypothesis.moved(
            np.clip(fit.hypothesis.vector + moves * shift, low, high)
        ).settings
    return [settings[block(w)] for w in windows]


def gaps(world, settings, windows, noise):
    """(measured less predicted, in noises, 0 where nothing was measured (W, T - 1, nv), where something was), starts as recorded.

    settings: one for each window.
    """
    predicted = world.simulate(settings, *cut.recorded_starts(world.model, windows), windows)[0]
    gap, known = cut.gaps(world.model, windows, predicted)
    return gap / noise, known


def overall(parts):
    """The error of all windows."""
    gap, known = parts
    return float(np.sqrt((gap**2).sum() / max(known.sum(), 1)))
