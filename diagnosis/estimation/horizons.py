"""Which windows to look at, and how long: as long as a model follows what was recorded, as many as are worth their time.

span = span_for(world, train, position_noise, velocity_noise, event, hypothesis)
problem = problem_of(world, train, position_noise, velocity_noise, event, span, SEARCH_STEPS)
"""

import warnings

import mujoco
import numpy as np

from diagnosis.estimation import initial_states, observer, residuals
from diagnosis.estimation import windows as cut
from diagnosis.selection import transients

SEARCH_STEPS, FINAL_STEPS = (
    10000,
    30000,
)  # simulated steps of one pass over the windows: in the search, and in the final fit
LEAST_ROWS, LEAST_APART, LEAST_WINDOWS, FEW_ROWS = 8, 3, 20, 100
LONGER = 1.3  # times what the shortest windows leave, up to which rows far apart are followed
LONGEST, MORE = 1.3, 1.5  # s, of a window; times as long as the last, that are worth another look
FOLLOWS, FOLLOWS_SHARE = (
    8.0,
    0.03,
)  # residual, in noises and as a share of the motion, above which windows are too long


def windows_for(world, recordings, span, steps, event=None):
    """Windows of span seconds spread evenly over the recordings, at most `steps` simulated steps in all."""
    every, fewest = [], shortest_rows(recordings)
    for r in recordings:
        sample = np.median(np.diff(r.time))
        for first, end in transients.quiet(r, event):
            every += cut.consecutive(r, max(span, fewest * sample), first, end)
    duration = np.median([w.recording.time[w.last] - w.recording.time[w.first] for w in every])
    number = max(
        LEAST_WINDOWS, int(steps / dear(world.model) * world.model.opt.timestep / duration)
    )
    return [every[i] for i in cut.evenly(len(every), number)]


def shortest_rows(recordings):
    """Intervals between rows in the shortest windows: where rows are far apart much happens between two."""
    return LEAST_APART if observer.far_apart(recordings) else LEAST_ROWS


def dear(model):
    """What one step of a model costs, about, with a two-joint arm's as 1."""
    runge_kutta = model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    return (6 + model.nv) / 8 * (3.0 if runge_kutta else 1.0)


def problem_of(world, recordings, position_noise, velocity_noise, event, span, steps):
    return residuals.Problem(
        world, windows_for(world, recordings, span, steps, event), position_noise, velocity_noise
    )


def missed(problem, fit):
    """Median residual of windows, in noises."""
    return np.sqrt(np.median(fit.chi2 / problem.free))


def follows(problem, fit, share_allowed):
    """Whether a model follows its windows: the median residual is a few noises, or a small part of the motion."""
    weight, size = problem.weight, problem.weight[0].size
    if missed(problem, fit) < FOLLOWS:
        return True
    gap = fit.residual[:, :size].reshape(weight.shape) / np.where(weight > 0, weight, np.inf)
    with warnings.catch_warnings(action="ignore"):  # what was never measured has no spread
        moved = np.nanstd(
            cut.difference(problem.model, problem.measured_qpos[:, :1], problem.measured_qpos),
            axis=1,
        )
    share = np.sqrt((gap[..., : problem.model.nv] ** 2).mean(1)) / np.maximum(moved, 1e-12)
    known = (weight[..., : problem.model.nv] > 0).any(1)
    return bool(np.median(share[known] if known.any() else 0.0) < share_allowed)


def span_for(
    world, train, position_noise, velocity_noise, event, hypothesis, at_least=0.0, scatter=LONGER
):
    """The longest window span that the model with a hypothesis follows, from a few samples up.

    Up to LONGEST (or a few dozen rows) while the residual is a few noises; where recordings are far more precise than
    any model, longer windows only add nonlinearity, and half the reported horizon is enough. Where rows are far apart
    start states soon end in local minima, and longer windows are to leave no more than `scatter` times what the shortest do.
    """
    sample = cut.sampling(train)
    duration = np.median([np.ptp(r.time) for r in train])
    shortest = max(shortest_rows(train) * sample, at_least)
    if sum(len(r.time) for r in train) < FEW_ROWS:  # too little to be cut
        return float(max(np.ptp(r.time) for r in train))
    enough = sum(np.ptp(r.time) for r in train) / 12  # clusters need windows
    longest = max(shortest, min(max(LONGEST, 40 * sample), 0.5 * duration, enough))
    if longest < MORE * at_least:
        return at_least

    def fitted(span):
        problem = problem_of(
            world, train, position_noise, velocity_noise, event, span, SEARCH_STEPS / 4
        )
        return problem, initial_states.fit(problem, hypothesis, sharp=False)

    def followed(span):
        problem, fit = fitted(span)
        return (
            follows(problem, fit, FOLLOWS_SHARE if span < 0.6 * cut.HORIZON else 0.0)
            and missed(problem, fit) < most
        )

    most = scatter * missed(*fitted(shortest)) if observer.far_apart(train) else np.inf
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
