"""Multiple shooting: many hypotheses fitted to many windows at once, each window with a start state of its own.

    fit = fit_starts(problem, Hypothesis())                       # start states alone, of a misfit.Problem
    fits = solve(problem, [Hypothesis().plus(coulomb, (0.1,)), ...], warm=fit)
    scan = project(problem, fit, *columns(problem, [fit], [[{coulomb: (0.1,)}, ...]]))  # one column per setting

Start states are eliminated window by window (variable projection), so that what is left of a residual, and of a column,
is what no choice of start states can produce.
"""

from dataclasses import dataclass

import numpy as np

from misfit import Fit
from observer import observed

UNSEEN = 1e-6  # squared change of all predictions, in noises, under which a parameter counts as without effect
GOOD = 0.5  # share of the fall of the squared residual that a Jacobian promised, from which on it is kept
STUCK = 0.02  # share of the squared residual that start states found anew have to spare
POOR = 4.0  # standard deviations of noise's square by which a window leaves more than the best quarter, that make it poor
FIRST = 8, 3  # rows that a start is led from; where they are far apart
LED, LEADS = 4, 2  # iterations each time; steps of the parameters at which it is done
DRAWS, DRAWN = 24, 4  # start states drawn for a poor window; of these, at most, from which it is fitted
SHORT = 0.1  # of a parameter's step, below which it turns round
KEPT = 8  # fits of start states that are remembered


def _eliminate(jacobian, damping):
    """Inverse normal matrices of the start states, (W, 2 nv, 2 nv), damped per window."""
    normal = np.swapaxes(jacobian, 1, 2) @ jacobian
    diagonal = np.einsum("wii->wi", normal)
    diagonal += damping[:, None] * diagonal + 1e-9
    return np.linalg.inv(normal)


def fit_starts(problem, hypothesis, iterations=12, sharp=True):
    """Start states of all windows under one hypothesis, by Levenberg-Marquardt, damped window by window.

    sharp: with a start Jacobian of the states found, for whoever looks at columns next. The latest fits are remembered.
    """
    kept, key = problem.world.fits, (problem.key, hypothesis, iterations, sharp)
    if key in kept:
        return kept[key]
    every, settings = np.arange(len(problem.windows)), [hypothesis.settings] * len(problem.windows)
    jacobian = lambda *fit: Fit(hypothesis, *fit, problem.start_jacobians(settings, every, *fit))
    if sharp:
        fit = fit_starts(problem, hypothesis, iterations, sharp=False)
        begun = jacobian(fit.qpos, fit.qvel, fit.residual)
    else:
        starts = [(problem.guess_qpos, problem.guess_qvel)]
        if problem.far_apart:
            starts.append(observed(problem.world, problem.windows, settings))
        tried = [(*start, problem.residuals(settings, every, *start)) for start in starts]
        best = np.argmin([(residual**2).sum(1) for *_, residual in tried], axis=0)
        begun = jacobian(*(np.stack(parts)[best, every] for parts in zip(*tried)))
    [fit] = _fit_starts(problem, [begun], 2 if sharp else iterations, fresh=True)
    if not sharp:
        [fit] = led(problem, [fit])
        fit = scattered(problem, fit)
    if problem.key:
        kept[key] = fit
        if len(kept) > KEPT:
            del kept[next(iter(kept))]
    return fit


def renewed(problem, fit, most=3):
    """The fit with start states found anew where that leaves less, for they may have stuck on the way; solved again then."""
    for _ in range(most):
        begun = fit.better(fit_starts(problem, fit.hypothesis))
        if begun.chi2.sum() > (1 - STUCK) * fit.chi2.sum():
            break
        [fit] = solve(problem, [fit.hypothesis], begun, iterations=4)
    return fit


def follow(problem, begun, iterations):
    """Fits whose parameters stand as begun (a list of Fit), with start states adapted to them."""
    return _fit_starts(problem, begun, iterations, fresh=False) if begun else []


def _fit_starts(problem, begun, iterations, fresh):
    """The start states of several Fits at once. A window's Jacobian follows its steps by Broyden's update; it is computed
    anew only where a step brings little of what it promised, unless it was fresh (of this very state and hypothesis)."""
    number = len(problem.windows)
    which = np.tile(np.arange(number), len(begun))
    settings = [s for f in begun for s in [f.hypothesis.settings] * number]
    states = (np.concatenate([getattr(f, x) for f in begun]) for x in ("qpos", "qvel", "residual", "start_jacobian"))
    parts = (np.split(x, len(begun)) for x in _descended(problem, settings, which, *states, iterations, fresh))
    return [Fit(f.hypothesis, *x) for f, *x in zip(begun, *parts)]


def _descended(problem, settings, which, qpos, qvel, residual, jacobian, iterations, fresh):
    """Start states of simulations, the i-th in window which[i] under settings[i], fitted: (qpos, qvel, residual, jacobian)."""
    pick = lambda rows: ([settings[i] for i in rows], which[rows])
    active = np.arange(len(which))
    damping, fresh = np.full(len(which), 1e-3), np.full(len(which), fresh)
    for i in range(iterations):
        slope = jacobian[active]
        step = np.einsum("wij,wmj,wm->wi", _eliminate(slope, damping[active]), slope, residual[active])
        new_qpos, new_qvel = problem.moved(qpos[active], qvel[active], step)
        new = problem.residuals(*pick(active), new_qpos, new_qvel)
        old_cost, new_cost = (residual[active] ** 2).sum(1), (new**2).sum(1)
        better = new_cost < old_cost
        gained = better & (old_cost - new_cost > 1e-3 * old_cost)
        good = active[better]
        foreseen = np.einsum("wmj,wj->wm", slope, step)  # change of the prediction
        promised = old_cost - ((residual[active] - foreseen) ** 2).sum(1)
        stale = ~fresh[active] & (old_cost - new_cost < GOOD * promised) & (promised > 1e-3 * old_cost)
        missed = residual[good] - new[better] - foreseen[better]
        along = step[better] * np.einsum("wmj,wmj->wj", slope[better], slope[better])  # in noises, not in m and rad/s
        jacobian[good] += missed[..., None] * (along / (along * step[better]).sum(1, keepdims=True).clip(1e-300))[:, None]
        qpos[good], qvel[good], residual[good] = new_qpos[better], new_qvel[better], new[better]
        damping[active] *= np.where(better, 0.1, np.where(stale, 1.0, 10.0))
        fresh[good] = False
        again = active[stale]
        if len(again) and i < iterations - 1:
            jacobian[again] = problem.start_jacobians(*pick(again), qpos[again], qvel[again], residual[again])
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
        qpos, qvel, residual, jacobian = _descended(part, settings, which, qpos, qvel, residual, jacobian, LED, True)
        if part is problem:
            break
        rows += max(1, rows // 2)
    parts = qpos, qvel, residual, jacobian
    return [replaced(f, which[owner == h], *(x[owner == h] for x in parts)) for h, f in enumerate(fits)]


def scattered(problem, fit, rounds=2):
    """The fit with the start states of its poor windows sought among others drawn about them, as far as noise leaves them open
    and farther: where something is met in one step of time or in the next, no slope leads from one to the other."""
    rng, size, settings = np.random.default_rng(0), 2 * problem.model.nv, fit.hypothesis.settings
    for _ in range(rounds):
        poor = np.flatnonzero(is_poor(problem, fit.chi2))
        if not len(poor):
            break
        spread = np.linalg.cholesky(_eliminate(fit.start_jacobian[poor], np.zeros(len(poor))))
        drawn = rng.normal(size=(len(poor), DRAWS, size)) * 2.0 ** (np.arange(DRAWS) % 4)[:, None]
        which = np.repeat(poor, DRAWS)
        qpos, qvel = problem.moved(fit.qpos[which], fit.qvel[which], np.einsum("wij,wdj->wdi", spread, drawn).reshape(-1, size))
        residual = problem.residuals([settings] * len(which), which, qpos, qvel)
        cost = (residual**2).sum(1).reshape(-1, DRAWS)
        order = np.argsort(cost, axis=1)[:, :DRAWN] + DRAWS * np.arange(len(poor))[:, None]
        kept = order[cost.ravel()[order] < fit.chi2[poor, None]]  # about a lowest point all are higher: these are of another
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
    out = Fit(fit.hypothesis, *(getattr(fit, x).copy() for x in ("qpos", "qvel", "residual", "start_jacobian")))
    cost, chi2 = (residual**2).sum(1), fit.chi2
    for i in np.argsort(-cost):  # the best last
        if cost[i] < chi2[which[i]]:
            w = which[i]
            out.qpos[w], out.qvel[w], out.residual[w], out.start_jacobian[w] = qpos[i], qvel[i], residual[i], jacobian[i]
    return out


def is_poor(problem, chi2):
    """Which windows (..., W) leave much more of the squared residual (..., W) than the best quarter does."""
    each = chi2 / problem.free
    return each > (1 + POOR * np.sqrt(2 / problem.free)) * np.quantile(each, 0.25, axis=-1, keepdims=True)


# ---- hypotheses with parameters ----------------------------------------------------------------


def perturbed(hypothesis):
    """One setting per parameter with that parameter moved by its step, as far as its bounds let it, or away; and the moves (k,)."""
    vector, out, moves = hypothesis.vector, [], []
    for i, p in enumerate(hypothesis.parameters):
        move = p.step
        if not p.low <= vector[i] + move <= p.high:
            room = (p.high if p.step > 0 else p.low) - vector[i]
            move = room if SHORT < abs(room / p.step) < 1 else -p.step
        moved = vector.copy()
        moved[i] += move
        out.append(hypothesis.moved(moved).settings)
        moves.append(move)
    return out, np.array(moves)


def columns(problem, fits, settings):
    """Change of the prediction with each of settings[h] (lists), from the starts of fits[h]: list of (W, m, len)."""
    which, flat, qpos, qvel = [], [], [], []
    every = np.arange(len(problem.windows))
    for fit, listed in zip(fits, settings):
        for s in listed:
            flat += [s] * len(every)
            which.append(every)
            qpos.append(fit.qpos)
            qvel.append(fit.qvel)
    if not flat:
        return [np.zeros((len(every), problem.size, 0)) for _ in fits]
    moved = problem.residuals(flat, np.concatenate(which), np.concatenate(qpos), np.concatenate(qvel))
    moved = moved.reshape(-1, len(every), problem.size)
    out, at = [], 0
    for fit, listed in zip(fits, settings):
        block = moved[at:at + len(listed)]
        out.append(np.moveaxis(np.subtract(fit.residual, block, out=block), 0, -1))
        at += len(listed)
    return out


def solve(problem, hypotheses, warm, iterations=6, tolerance=1e-3):
    """Fit hypotheses side by side, every one with start states of its own: list of Fit.

    warm: a Fit whose start states and start Jacobian begin every hypothesis, or a list of them. Parameters stay
    inside their bounds; a step is damped until the cost falls (the squared residual; where rows are far apart see cost).
    """
    if not hypotheses:
        return []
    warm = warm if isinstance(warm, list) else [warm] * len(hypotheses)
    every = np.arange(len(problem.windows))
    number = len(every)
    current = evaluate(problem, hypotheses, warm)
    # a hypothesis so far away that it fits worse at first: its start states have to follow before its slopes mean anything
    far = [h for h in range(len(hypotheses)) if current[h].chi2.sum() > 1.01 * warm[h].chi2.sum()]
    for h, fit in zip(far, follow(problem, [current[h] for h in far], iterations=3)):
        current[h] = fit
    leads = LEADS if problem.far_apart else 0  # of rows close together start states follow by themselves, or are renewed later
    current = led(problem, current) if leads else current
    damping = np.full(len(hypotheses), 1e-3)
    moving = [h for h in range(len(hypotheses))]
    for iteration in range(iterations):
        if not moving:
            break
        perturbations = [perturbed(current[h].hypothesis) for h in moving]
        slopes = columns(problem, [current[h] for h in moving], [p for p, _ in perturbations])
        proposals = []  # two each where rows are far apart: windows far off may be stuck, or be the only ones that tell
        for h, (_, moves), slope in zip(moving, perturbations, slopes):
            for robust in (False, True)[:1 + problem.far_apart]:
                proposals.append((h, *_propose(current[h], slope, moves, damping[h], robust)))
        # new parameters, once with moved and once with kept start states: a window takes the better
        trial = []
        for h, vector, step in proposals:
            fit, moved = current[h], current[h].hypothesis.moved(vector)
            trial += [(moved, *problem.moved(fit.qpos, fit.qvel, step)), (moved, fit.qpos, fit.qvel)]
        residual = problem.residuals([s for t in trial for s in [t[0].settings] * number], np.tile(every, len(trial)),
                                     np.concatenate([t[1] for t in trial]), np.concatenate([t[2] for t in trial]))
        residual = residual.reshape(len(trial), number, -1)
        still, polish, tried = [], [], {}
        for i, (h, _, _) in enumerate(proposals):
            moved, kept = (Fit(*trial[k], residual[k], current[h].start_jacobian) for k in (2 * i, 2 * i + 1))
            tried.setdefault(h, []).append(moved.better(kept))
        best = [min(tried[h], key=lambda fit: cost(problem, fit)) for h in moving]
        for h, fit in zip(moving, led(problem, best) if iteration < leads else best):
            old, new = cost(problem, current[h]), cost(problem, fit)
            if new < old:
                current[h] = fit
                damping[h] = max(damping[h] / 10, 1e-6)
                polish.append(h)
            else:
                damping[h] *= 10
            if (new < old and old - new > tolerance * old) or (new >= old and damping[h] < 1e2):
                still.append(h)
        _polish(problem, current, polish)
        refresh = [h for h in still if iteration % 2 == 0]
        if refresh:
            jacobians = problem.start_jacobians(
                [s for h in refresh for s in [current[h].hypothesis.settings] * number], np.tile(every, len(refresh)),
                np.concatenate([current[h].qpos for h in refresh]), np.concatenate([current[h].qvel for h in refresh]),
                np.concatenate([current[h].residual for h in refresh]))
            for h, j in zip(refresh, np.split(jacobians, len(refresh))):
                current[h].start_jacobian = j
        moving = still
    return current


def cost(problem, fit):
    """What solve lowers: the squared residual; where rows are far apart the residuals' sizes, lest windows stuck far off decide."""
    return (np.sqrt(fit.chi2) if problem.far_apart else fit.chi2).sum()


def _polish(problem, current, which):
    """One more step of the start states alone, with the Jacobian at hand; kept where it helps."""
    if not which:
        return
    every, moved = np.arange(len(problem.windows)), []
    for h in which:
        fit = current[h]
        inverse = _eliminate(fit.start_jacobian, np.full(len(every), 1e-3))
        step = np.einsum("wij,wmj,wm->wi", inverse, fit.start_jacobian, fit.residual)
        moved.append(problem.moved(fit.qpos, fit.qvel, step))
    residual = problem.residuals([s for h in which for s in [current[h].hypothesis.settings] * len(every)],
                                 np.tile(every, len(which)), np.concatenate([m[0] for m in moved]),
                                 np.concatenate([m[1] for m in moved]))
    for h, (qpos, qvel), r in zip(which, moved, np.split(residual, len(which))):
        fit = current[h]
        current[h] = fit.better(Fit(fit.hypothesis, qpos, qvel, r, fit.start_jacobian))


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


def _propose(fit, slope, moves, damping, robust):
    """Gauss-Newton step of parameters and start states together, start states eliminated: vector (k,), step (W, 2 nv).

    slope (W, m, k): change of the prediction as each parameter moves by moves (k,).
    """
    jacobian, residual = fit.start_jacobian, fit.residual
    inverse = _eliminate(jacobian, np.full(len(jacobian), damping))
    cross = np.einsum("wmi,wmk->wik", jacobian, slope)
    pull = np.einsum("wmi,wm->wi", jacobian, residual)
    normal = np.einsum("wmk,wml->wkl", slope, slope) - np.einsum("wik,wij,wjl->wkl", cross, inverse, cross)
    push = np.einsum("wmk,wm->wk", slope, residual) - np.einsum("wik,wij,wj->wk", cross, inverse, pull)
    if robust:
        each = np.concatenate([np.einsum("wkk->wk", normal), (residual**2).sum(1)[:, None]], 1)
        usual = np.median(each, 0)
        weight = np.where(each > usual, usual / np.maximum(each, 1e-300), 1.0)[:, usual > UNSEEN].min(1, initial=1.0)
        normal, push = normal * weight[:, None, None], push * weight[:, None]
    normal, push = normal.sum(0), push.sum(0)
    vector = fit.hypothesis.vector
    low = np.array([p.low for p in fit.hypothesis.parameters])
    high = np.array([p.high for p in fit.hypothesis.parameters])
    free, move = np.diag(normal) > UNSEEN, np.zeros(len(vector))
    for _ in range(len(vector) + 1):  # parameters that would leave their bounds stop there, the rest follow
        if not free.any():
            break
        size = np.sqrt(np.diag(normal)[free])  # parameters differ by many powers of ten
        block = normal[np.ix_(free, free)] / size / size[:, None] + (damping + 1e-9) * np.eye(free.sum())
        move[free] = np.linalg.solve(block, (push[free] - normal[np.ix_(free, ~free)] @ move[~free]) / size) / size
        target = vector + moves * move
        outside = free & ((target < low) | (target > high))
        if not outside.any():
            break
        move[outside] = (np.clip(target, low, high)[outside] - vector[outside]) / moves[outside]
        free &= ~outside
    step = np.einsum("wij,wj->wi", inverse, pull - cross @ move)
    return np.clip(vector + moves * move, low, high), step


@dataclass
class Scan:
    """Projected normal equations of many columns, one row per piece of a window (P = W x pieces)."""

    chi2: np.ndarray  # (P,) what is left of the residual
    score: np.ndarray  # (P, K)
    gram: np.ndarray  # (P, K, K)


def project(problem, fit, slope, pieces=1):
    """Scan of columns slope (W, m, K) against a fit's residual, start states projected out.

    pieces: a window's rows are summed in this many consecutive pieces (more than one where windows are few).
    """
    number, rows, width = problem.weight.shape
    owner = np.concatenate([np.repeat(np.arange(rows) * pieces // rows, width), np.zeros(2 * problem.model.nv, int)])
    chi2, score, gram = (np.empty((number, pieces) + (slope.shape[-1],) * k) for k in range(3))
    for w in range(number):  # one after the other: columns are many, and large
        q, _ = np.linalg.qr(fit.start_jacobian[w])
        residual, columns = (x - q @ (q.T @ x) for x in (fit.residual[w], slope[w]))
        for piece in range(pieces):
            c, r = columns[owner == piece], residual[owner == piece]
            chi2[w, piece], score[w, piece], gram[w, piece] = r @ r, r @ c, c.T @ c
    flat = lambda x: x.reshape((number * pieces,) + x.shape[2:])
    return Scan(flat(chi2), flat(score), flat(gram))
