"""A recording clock that runs wrong: recordings of stock MuJoCo whose times are multiplied afterwards."""

import re
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from plants import DRIVEN_PENDULUM, NOISE, recorded

from diagnosis.estimation import initial_states, multiple_shooting, residuals
from diagnosis.estimation import windows as cut
from diagnosis.selection import clock
from diagnosis.simulation.simulator import World

DAMPING = 0.15  # N·m·s/rad, of the real pendulum


def fitted(ratio, effects):
    """(problem, fit of these effects): the real pendulum only has more damping, and its recording's time is `ratio` times true."""
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    run = recorded("run.csv", 0, damping=DAMPING)
    problem = residuals.Problem(
        world,
        cut.consecutive(replace(run, time=run.time * ratio), 0.4),
        np.array([NOISE]),
        np.array([np.inf]),
    )
    hypothesis = residuals.Hypothesis()
    for effect, place in effects:
        candidate = world.candidate(effect, place)
        hypothesis = hypothesis.plus(candidate, candidate.nominal)
    [fit] = multiple_shooting.solve(
        problem, [hypothesis], initial_states.fit(problem, residuals.Hypothesis())
    )
    return problem, fit


FOUR = [("viscous_damping", "pivot"), ("inertia", "arm"), ("gain", "drive"), ("bias", "drive")]


@pytest.mark.parametrize("ratio, way", [(1.04, "fast"), (0.97, "slow")])
def test_a_wrong_clock_is_told(ratio, way):
    """Damping's true value and the true clock leave the noise alone; the note gives the clock's error to a per cent."""
    problem, fit = fitted(ratio, FOUR)
    damping = fit.hypothesis.candidates[0]
    truth = residuals.Hypothesis().plus(damping, (DAMPING,))
    assert (
        clock.left(problem, 1 / ratio, truth)
        < 1.3 * problem.rows
        < 0.1 * clock.left(problem, 1.0, truth)
    )
    note = clock.suspect(problem, fit, damping)
    percent, said = re.search(r"seems to run ([\d.]+)% (\w+)", note).groups()
    assert said == way and abs(float(percent) - 100 * abs(ratio - 1)) < 1.0 and "\n" not in note


@pytest.mark.parametrize("ratio, effects", [(1.0, FOUR), (1.04, FOUR[:3])])
def test_a_right_clock_and_few_findings_are_left_alone(ratio, effects):
    problem, fit = fitted(ratio, effects)
    assert clock.suspect(problem, fit, fit.hypothesis.candidates[0]) is None
