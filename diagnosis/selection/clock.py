"""Does a recording clock that runs fast or slow explain what several findings only stand in for?

    note = clock.suspect(problem, fit, largest)          # None, or one line

A wrong clock rescales every speed and acceleration at once, so that inertias, gains and dampings all seem off.
"""

from dataclasses import replace

import numpy as np

from diagnosis.estimation import initial_states, residuals
from diagnosis.estimation import windows as cut

WIDEST, STEPS = (
    0.06,
    6,
)  # of the clock's error; steps of the search, each of which halves what is left
MANY = 4  # findings that are needed to stand in for a clock
ENOUGH = (
    0.9  # of what they explain, the share that the clock and the largest of them have to explain
)


def suspect(problem, fit, largest):
    """One line that says how wrong the clock seems, where another clock and the largest finding explain what all do."""
    if sum(c.effect.name != "time_step" for c in fit.hypothesis.candidates) < MANY:
        return None
    alone = residuals.Hypothesis(((largest, fit.hypothesis.settings[largest]),))
    bare = before = left(problem, 1.0, alone)
    ratio, reach = 1.0, WIDEST / 2
    for _ in range(STEPS):
        before, ratio = min(
            [(before, ratio)]
            + [(left(problem, r, alone), r) for r in (ratio - reach, ratio + reach)]
        )
        reach /= 2
    if before == bare or bare - before < ENOUGH * (bare - fit.chi2.sum()):
        return None
    return (
        f"the recordings' clock seems to run {abs(1 / ratio - 1):.1%} {'fast' if ratio < 1 else 'slow'}: with their time "
        f"counted {ratio:.3f} times, the largest finding alone explains what all do; check the sampling rate first"
    )


def left(problem, ratio, hypothesis):
    """Squared residual of a hypothesis with the recordings' time multiplied by ratio."""
    scaled = {r: replace(r, time=r.time * ratio) for r in cut.recordings_of(problem.windows)}
    other = problem.subset(np.arange(len(problem.windows)))
    other.windows = [w._replace(recording=scaled[w.recording]) for w in problem.windows]
    other.guess_qvel = problem.guess_qvel / ratio
    return initial_states.fit(other, hypothesis).chi2.sum()
