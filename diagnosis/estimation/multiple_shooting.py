"""Multiple shooting: many hypotheses fitted to many windows at once, each window with a start state of its own.

    fit = starts.fit(problem, Hypothesis())                       # start states alone, of a misfit.Problem
    fits = solve(problem, [Hypothesis().plus(coulomb, (0.1,)), ...], warm=fit)
    scan = project(problem, fit, *columns(problem, [fit], [[{coulomb: (0.1,)}, ...]]))  # one column per setting

Start states are eliminated window by window (variable projection), so that what is left of a residual, and of a column,
is what no choice of start states can produce.
"""

from dataclasses import dataclass

import numpy as np

from diagnosis.estimation import initial_states
from diagnosis.estimation.residuals import Fit

UNSEEN = 1e-6  # squared change of all predictions, in noises, under which a parameter counts as without effect
STUCK = 0.02  # share of the squared residual that start states found anew have to spare
LEADS = 2  # steps of the parameters at which start states are led, where rows are far apart
SHORT = 0.1  # of a parameter's step, below which it turns round


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
    moved = problem.residuals(
        flat, np.concatenate(which), np.concatenate(qpos), np.concatenate(qvel)
    )
    moved = moved.reshape(-1, len(every), problem.size)
    out, at = [], 0
    for fit, listed in zip(fits, settings):
        block = moved[at : at + len(listed)]
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
    current = initial_states.evaluate(problem, hypotheses, warm)
    # a hypothesis so far away that it fits worse at first: its start states have to follow before its slopes mean anything
    far = [h for h in range(len(hypotheses)) if current[h].chi2.sum() > 1.01 * warm[h].chi2.sum()]
    for h, fit in zip(far, initial_states.follow(problem, [current[h] for h in far], iterations=3)):
        current[h] = fit
    leads = (
        LEADS if problem.far_apart else 0
    )  # of rows close together start states follow by themselves, or are renewed later
    current = initial_states.led(problem, current) if leads else current
    damping = np.full(len(hypotheses), 1e-3)
    moving = [h for h in range(len(hypotheses))]
    for iteration in range(iterations):
        if not moving:
            break
        perturbations = [perturbed(current[h].hypothesis) for h in moving]
        slopes = columns(problem, [current[h] for h in moving], [p for p, _ in perturbations])
        proposals = []  # two each where rows are far apart: windows far off may be stuck, or be the only ones that tell
        for h, (_, moves), slope in zip(moving, perturbations, slopes):
            for robust in (False, True)[: 1 + problem.far_apart]:
                proposals.append((h, *_propose(current[h], slope, moves, damping[h], robust)))
        # new parameters, once with moved and once with kept start states: a window takes the better
        trial = []
        for h, vector, step in proposals:
            fit, moved = current[h], current[h].hypothesis.moved(vector)
            trial += [
                (moved, *problem.moved(fit.qpos, fit.qvel, step)),
                (moved, fit.qpos, fit.qvel),
            ]
        residual = problem.residuals(
            [s for t in trial for s in [t[0].settings] * number],
            np.tile(every, len(trial)),
            np.concatenate([t[1] for t in trial]),
            np.concatenate([t[2] for t in trial]),
        )
        residual = residual.reshape(len(trial), number, -1)
        still, polish, tried = [], [], {}
        for i, (h, _, _) in enumerate(proposals):
            moved, kept = (
                Fit(*trial[k], residual[k], current[h].start_jacobian) for k in (2 * i, 2 * i + 1)
            )
            tried.setdefault(h, []).append(moved.better(kept))
        best = [min(tried[h], key=lambda fit: cost(problem, fit)) for h in moving]
        for h, fit in zip(moving, initial_states.led(problem, best) if iteration < leads else best):
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
                [s for h in refresh for s in [current[h].hypothesis.settings] * number],
                np.tile(every, len(refresh)),
                np.concatenate([current[h].qpos for h in refresh]),
                np.concatenate([current[h].qvel for h in refresh]),
                np.concatenate([current[h].residual for h in refresh]),
            )
            for h, j in zip(refresh, np.split(jacobians, len(refresh))):
                current[h].start_jacobian = j
        moving = still
    return current


def renewed(problem, fit, most=3):
    """The fit with start states found anew where that leaves less, for they may have stuck on the way; solved again then."""
    for _ in range(most):
        begun = fit.better(initial_states.fit(problem, fit.hypothesis))
        if begun.chi2.sum() > (1 - STUCK) * fit.chi2.sum():
            break
        [fit] = solve(problem, [fit.hypothesis], begun, iterations=4)
    return fit


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
        inverse = initial_states.eliminate(fit.start_jacobian, np.full(len(every), 1e-3))
        step = np.einsum("wij,wmj,wm->wi", inverse, fit.start_jacobian, fit.residual)
        moved.append(problem.moved(fit.qpos, fit.qvel, step))
    residual = problem.residuals(
        [s for h in which for s in [current[h].hypothesis.settings] * len(every)],
        np.tile(every, len(which)),
        np.concatenate([m[0] for m in moved]),
        np.concatenate([m[1] for m in moved]),
    )
    for h, (qpos, qvel), r in zip(which, moved, np.split(residual, len(which))):
        fit = current[h]
        current[h] = fit.better(Fit(fit.hypothesis, qpos, qvel, r, fit.start_jacobian))


def _propose(fit, slope, moves, damping, robust):
    """Gauss-Newton step of parameters and start states together, start states eliminated: vector (k,), step (W, 2 nv).

    slope (W, m, k): change of the prediction as each parameter moves by moves (k,).
    """
    jacobian, residual = fit.start_jacobian, fit.residual
    inverse = initial_states.eliminate(jacobian, np.full(len(jacobian), damping))
    cross = np.einsum("wmi,wmk->wik", jacobian, slope)
    pull = np.einsum("wmi,wm->wi", jacobian, residual)
    normal = np.einsum("wmk,wml->wkl", slope, slope) - np.einsum(
        "wik,wij,wjl->wkl", cross, inverse, cross
    )
    push = np.einsum("wmk,wm->wk", slope, residual) - np.einsum(
        "wik,wij,wj->wk", cross, inverse, pull
    )
    if robust:
        each = np.concatenate([np.einsum("wkk->wk", normal), (residual**2).sum(1)[:, None]], 1)
        usual = np.median(each, 0)
        weight = np.where(each > usual, usual / np.maximum(each, 1e-300), 1.0)[
            :, usual > UNSEEN
        ].min(1, initial=1.0)
        normal, push = normal * weight[:, None, None], push * weight[:, None]
    normal, push = normal.sum(0), push.sum(0)
    vector = fit.hypothesis.vector
    low = np.array([p.low for p in fit.hypothesis.parameters])
    high = np.array([p.high for p in fit.hypothesis.parameters])
    free, move = np.diag(normal) > UNSEEN, np.zeros(len(vector))
    for _ in range(
        len(vector) + 1
    ):  # parameters that would leave their bounds stop there, the rest follow
        if not free.any():
            break
        size = np.sqrt(np.diag(normal)[free])  # parameters differ by many powers of ten
        block = normal[np.ix_(free, free)] / size / size[:, None] + (damping + 1e-9) * np.eye(
            free.sum()
        )
        move[free] = (
            np.linalg.solve(block, (push[free] - normal[np.ix_(free, ~free)] @ move[~free]) / size)
            / size
        )
        target = vector + moves * move
        outside = free & ((target < low) | (target > high))
        if not outside.any():
            break
        move[outside] = (np.clip(target, low, high)[outside] - vector[outside]) / moves[outside]
        free &= ~outside
    step = np.einsum("wij,wj->wi", inverse, pull - cross @ move)
    return np.clip(vector + moves * move, low, high), step


@dataclass
class Normal:
    """Projected normal equations of many columns, one row per piece of a window (P = W x pieces)."""

    chi2: np.ndarray  # (P,) what is left of the residual
    score: np.ndarray  # (P, K)
    gram: np.ndarray  # (P, K, K)


def project(problem, fit, slope, pieces=1):
    """Normal equations of columns slope (W, m, K) against a fit's residual, start states projected out.

    pieces: a window's rows are summed in this many consecutive pieces (more than one where windows are few).
    """
    number, rows, width = problem.weight.shape
    owner = np.concatenate(
        [np.repeat(np.arange(rows) * pieces // rows, width), np.zeros(2 * problem.model.nv, int)]
    )
    chi2, score, gram = (np.empty((number, pieces) + (slope.shape[-1],) * k) for k in range(3))
    for w in range(number):  # one after the other: columns are many, and large
        q, _ = np.linalg.qr(fit.start_jacobian[w])
        residual, columns = (x - q @ (q.T @ x) for x in (fit.residual[w], slope[w]))
        for piece in range(pieces):
            c, r = columns[owner == piece], residual[owner == piece]
            chi2[w, piece], score[w, piece], gram[w, piece] = r @ r, r @ c, c.T @ c
    flat = lambda x: x.reshape((number * pieces,) + x.shape[2:])
    return Normal(flat(chi2), flat(score), flat(gram))
