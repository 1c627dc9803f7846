"""Start states: where every window of a problem begins under a hypothesis, sought by Levenberg-Marquardt from window to window.

    found = starts.fit(problem, Hypothesis())            # a misfit.Fit: start states alone
    begun = starts.evaluate(problem, hypotheses, found)  # other hypotheses from the same starts, as they stand
    found = starts.follow(problem, begun, iterations=2)  # adapted to them

What was recorded is the beginning. Where feet meet the ground or friction sticks that ends in local minima: poor windows are
led from their first rows on (led), and others are drawn about them (scattered).
"""

import numpy as np

from diagnosis.estimation.observer import observed
from diagnosis.estimation.residuals import Fit

GOOD = 0.5  # share of the fall of the squared residual that a Jacobian promised, from which on it is kept
POOR = 4.0  # standard deviations of noise's square by which a window leaves more than the best quarter, that make it poor
FIRST = 8, 3  # rows that a start is led from; where they are far apart
LED = 4  # iterations each time
DRAWS, DRAWN = (
    24,
    4,
)  # start states drawn for a poor window; of these, at most, from which it is fitted
KEPT = 8  # fits of start states that are remembered


def eliminate(jacobian, damping):
    """Inverse normal matrices of the start states, (W, 2 nv, 2 nv), damped per window."""
    normal = np.swapaxes(jacobian, 1, 2) @ jacobian
    diagonal = np.einsum("wii->wi", normal)
    diagonal += damping[:, None] * diagonal + 1e-9
    return np.linalg.inv(normal)


def fit(problem, hypothesis, iterations=12, sharp=True):
    """Start states of all windows under one hypothesis, by Levenberg-Marquardt, damped window by window.

    sharp: with a start Jacobian of the states found, for whoever looks at columns next. The latest fits are remembered.
    """
    kept, key = problem.world.fits, (problem.key, hypothesis, iterations, sharp)
    if key in kept:
        return kept[key]
    every, settings = np.arange(len(problem.windows)), [hypothesis.settings] * len(problem.windows)
    jacobian = lambda *parts: Fit(
        hypothesis, *parts, problem.start_jacobians(settings, every, *parts)
    )
    if sharp:
        rough = fit(problem, hypothesis, iterations, sharp=False)
        begun = jacobian(rough.qpos, rough.qvel, rough.residual)
    else:
        begun_at = [(problem.guess_qpos, problem.guess_qvel)]
        if problem.far_apart:
            begun_at.append(observed(problem.world, problem.windows, settings))
        tried = [(*start, problem.residuals(settings, every, *start)) for start in begun_at]
        best = np.argmin([(residual**2).sum(1) for *_, residual in tried], axis=0)
        begun = jacobian(*(np.stack(parts)[best, every] for parts in zip(*tried)))
    [found] = _fitted(problem, [begun], 2 if sharp else iterations, fresh=True)
    if not sharp:
        [found] = led(problem, [found])
        found = scattered(problem, found)
    if problem.key:
        kept[key] = found
        if len(kept) > KEPT:
            del kept[next(iter(kept))]
    return found


def follow(problem, begun, iterations):
    """Fits whose parameters stand as begun (a list of Fit), with start states adapted to them."""
    return _fitted(problem, begun, iterations, fresh=False) if begun else []


def _fitted(problem, begun, iterations, fresh):
    """The start states of several Fits at once. A window's Jacobian follows its steps by Broyden's update; it is computed
    anew only where a step brings little of what it promised, unless it was fresh (of this very state and hypothesis)."""
    number = len(problem.windows)
    which = np.tile(np.arange(number), len(begun))
    settings = [s for f in begun for s in [f.hypothesis.settings] * number]
    states = (
        np.concatenate([getattr(f, x) for f in begun])
        for x in ("qpos", "qvel", "residual", "start_jacobian")
    )
    parts = (
        np.split(x, len(begun))
        for x in _descended(problem, settings, which, *states, iterations, fresh)
    )
    return [Fit(f.hypothesis, *x) for f, *x in zip(begun, *parts)]


def _descended(problem, settings, which, qpos, qvel, residual, jacobian, iterations, fresh):
    """Start states of simulations, the i-th in window which[i] under settings[i], fitted: (qpos, qvel, residual, jacobian)."""
    pick = lambda rows: ([settings[i] for i in rows], which[rows])
    active = np.arange(len(which))
    damping, fresh = np.full(len(which), 1e-3), np.full(len(which), fresh)
    for i in range(iterations):
        slope = jacobian[active]
        step = np.einsum(
            "wij,wmj,wm->wi", eliminate(slope, damping[active]), slope, residual[active]
        )
        new_qpos, new_qvel = problem.moved(qpos[active], qvel[active], step)
        new = problem.residuals(*pick(active), new_qpos, new_qvel)
        old_cost, new_cost = (residual[active] ** 2).sum(1), (new**2).sum(1)
        better = new_cost < old_cost
        gained = better & (old_cost - new_cost > 1e-3 * old_cost)
        good = active[better]
        foreseen = np.einsum("wmj,wj->wm", slope, step)  # change of the prediction
        promised = old_cost - ((residual[active] - foreseen) ** 2).sum(1)
        stale = (
            ~fresh[active] & (old_cost - new_cost < GOOD * promised) & (promised > 1e-3 * old_cost)
        )
        missed = residual[good] - new[better] - foreseen[better]
        along = step[better] * np.einsum(
            "wmj,wmj->wj", slope[better], slope[better]
        )  # in noises, not in m and rad/s
        jacobian[good] += (
            missed[..., None]
            * (along / (along * step[better]).sum(1, keepdims=True).clip(1e-300))[:, None]
        )
        qpos[good], qvel[good], residual[good] = new_qpos[better], new_qvel[better], new[better]
        damping[active] *= np.where(better, 0.1, np.where(stale, 1.0, 10.0))
        fresh[good] = False
        again = active[stale]
        if len(again) and i < iterations - 1:
            jacobian[again] = problem.start_jacobians(
                *pick(again), qpos[again], qvel[again], residual[again]
            )
            fresh[again] = True
        active = active[gained | stale | (~better & (damping[active] < 1e3))]
        if not len(active):
            break
    return qpos, qvel, residual, jacobian


def led(problem, fits):
    """Fits with the start states of their poor windows sought again: for the first rows alone, then for more and more.

    Where feet meet the ground or friction sticks, a state that leads through some rows nearly leads through the next, and
    any other start ends in a local minimum. Windows are poor beside the best quarter of their fit. Where rows are far apart
    it begins with the observer's state and three rows, else with the recorded one and eight.
    """
    owner, which = np.nonzero(is_poor(problem, np.array([f.chi2 for f in fits])))
    if not len(which):
        return fits
    settings = [fits[h].hypothesis.settings for h in owner]
    if problem.far_apart:
        qpos, qvel = observed(problem.world, [problem.windows[w] for w in which], settings)
    else:
        qpos, qvel = problem.guess_qpos[which], problem.guess_qvel[which]
    rows, longest = FIRST[int(problem.far_apart)], problem.weight.shape[1]
    while True:
        part = problem.first_rows(rows) if rows < longest else problem
        residual = part.residuals(settings, which, qpos, qvel)
        jacobian = part.start_jacobians(settings, which, qpos, qvel, residual)
        qpos, qvel, residual, jacobian = _descended(
            part, settings, which, qpos, qvel, residual, jacobian, LED, True
        )
        if part is problem:
            break
        rows += max(1, rows // 2)
    parts = qpos, qvel, residual, jacobian
    return [
        replaced(f, which[owner == h], *(x[owner == h] for x in parts)) for h, f in enumerate(fits)
    ]


def scattered(problem, fit, rounds=2):
    """The fit with the start states of its poor windows sought among others drawn about them, as far as noise leaves them open
    and farther: where something is met in one step of time or in the next, no slope leads from one to the other."""
    rng, size, settings = np.random.default_rng(0), 2 * problem.model.nv, fit.hypothesis.settings
    for _ in range(rounds):
        poor = np.flatnonzero(is_poor(problem, fit.chi2))
        if not len(poor):
            break
        spread = np.linalg.cholesky(eliminate(fit.start_jacobian[poor], np.zeros(len(poor))))
        drawn = rng.normal(size=(len(poor), DRAWS, size)) * 2.0 ** (np.arange(DRAWS) % 4)[:, None]
        which = np.repeat(poor, DRAWS)
        qpos, qvel = problem.moved(
            fit.qpos[which],
            fit.qvel[which],
            np.einsum("wij,wdj->wdi", spread, drawn).reshape(-1, size),
        )
        residual = problem.residuals([settings] * len(which), which, qpos, qvel)
        cost = (residual**2).sum(1).reshape(-1, DRAWS)
        order = np.argsort(cost, axis=1)[:, :DRAWN] + DRAWS * np.arange(len(poor))[:, None]
        kept = order[
            cost.ravel()[order] < fit.chi2[poor, None]
        ]  # about a lowest point all are higher: these are of another
        if not len(kept):
            break
        which, qpos, qvel, residual = (x[kept] for x in (which, qpos, qvel, residual))
        several = [settings] * len(kept)
        jacobian = problem.start_jacobians(several, which, qpos, qvel, residual)
        found = _descended(problem, several, which, qpos, qvel, residual, jacobian, LED, True)
        fit = replaced(fit, which, *found)
    return fit


def replaced(fit, which, qpos, qvel, residual, jacobian):
    """The fit with every window's best of other start states, the i-th of window which[i], where that leaves less."""
    out = Fit(
        fit.hypothesis,
        *(getattr(fit, x).copy() for x in ("qpos", "qvel", "residual", "start_jacobian")),
    )
    cost, chi2 = (residual**2).sum(1), fit.chi2
    for i in np.argsort(-cost):  # the best last
        if cost[i] < chi2[which[i]]:
            w = which[i]
            out.qpos[w], out.qvel[w], out.residual[w], out.start_jacobian[w] = (
                qpos[i],
                qvel[i],
                residual[i],
                jacobian[i],
            )
    return out


def is_poor(problem, chi2):
    """Which windows (..., W) leave much more of the squared residual (..., W) than the best quarter does."""
    each = chi2 / problem.free
    return each > (1 + POOR * np.sqrt(2 / problem.free)) * np.quantile(
        each, 0.25, axis=-1, keepdims=True
    )


def evaluate(problem, hypotheses, warm):
    """Fits at hypotheses as they stand: each window from its start state in warm (a Fit, or one for each), or, where it
    leaves more than in warm, from the recorded one if that does better (impacts can push start states far off)."""
    warm = warm if isinstance(warm, list) else [warm] * len(hypotheses)
    if not hypotheses:
        return []
    which = np.tile(np.arange(len(problem.windows)), len(hypotheses))
    settings = [s for h in hypotheses for s in [h.settings] * len(problem.windows)]
    qpos, qvel = (np.concatenate([getattr(f, x) for f in warm]) for x in ("qpos", "qvel"))
    residual = problem.residuals(settings, which, qpos, qvel)
    cost = (residual**2).sum(1)
    worse = np.flatnonzero(cost > np.concatenate([f.chi2 for f in warm]))
    if len(worse):
        recorded = problem.guess_qpos[which[worse]], problem.guess_qvel[which[worse]]
        other = problem.residuals([settings[i] for i in worse], which[worse], *recorded)
        better = (other**2).sum(1) < cost[worse]
        for x, y in zip((qpos, qvel, residual), (*recorded, other)):
            x[worse[better]] = y[better]
    parts = (np.split(x, len(hypotheses)) for x in (qpos, qvel, residual))
    return [Fit(h, q, v, r, f.start_jacobian) for h, f, q, v, r in zip(hypotheses, warm, *parts)]
