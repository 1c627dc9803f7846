"""Noise told from recordings, against the noise that was put in."""

import math

import mujoco
import numpy as np
import pytest
from plants import DRIVEN_PENDULUM, recorded

from diagnosis.estimation.readings import difference_noise, measurement_noise

RNG = np.random.default_rng


def plain_differences(column, order=3):
    """The same from differences that take rows to be evenly spaced."""
    found = np.diff(column, order) / np.sqrt(math.comb(2 * order, order))
    return np.quantile(np.abs(found), 0.8) / 1.2816


@pytest.mark.parametrize("noise", [1e-5, 1e-3])
def test_noise_of_differences_on_even_stamps(noise):
    time = 0.01 * np.arange(2000)
    column = np.sin(3 * time) + noise * RNG(0).normal(size=2000)
    assert difference_noise(time, column) == pytest.approx(noise, rel=0.1)


def test_stamps_that_jitter_make_no_noise():
    rng = RNG(1)
    time = 0.01 * (np.arange(2000) + rng.uniform(-0.4, 0.4, 2000))
    column = np.sin(3 * time) + 1e-4 * rng.normal(size=2000)
    assert difference_noise(time, column) == pytest.approx(1e-4, rel=0.1)
    assert plain_differences(column) > 1.4e-4


def test_rows_that_were_lost_make_no_noise():
    rng = RNG(2)
    time = 0.01 * np.sort(rng.choice(3000, 1500, replace=False))
    column = np.sin(3 * time) + 1e-4 * rng.normal(size=1500)
    assert difference_noise(time, column) == pytest.approx(1e-4, rel=0.15)
    column[::7] = np.nan
    assert difference_noise(time, column) == pytest.approx(1e-4, rel=0.15)


def test_a_motion_of_few_rows_a_turn_is_no_noise():
    time = 0.02 * np.arange(151)  # every second row of it would look like noise
    column = 0.1 * np.sin(2 * np.pi * 4 * time) + 0.03 * np.sin(2 * np.pi * 6 * time)
    column += 1e-3 * RNG(3).normal(size=151)
    assert difference_noise(time, column) == pytest.approx(1e-3, rel=0.3)


def test_an_encoder_is_no_better_than_its_steps():
    time = 0.01 * np.arange(2000)
    column = 0.002 * np.rint(np.sin(3 * time) / 0.002)
    assert 0.002 / np.sqrt(12) <= difference_noise(time, column) * (1 + 1e-9) < 0.0012
    column[16:] = column[16]  # nor where it mostly rests, and few steps are seen
    assert difference_noise(time, column) * (1 + 1e-9) >= 0.002 / np.sqrt(12)


def test_noise_is_that_of_the_recordings_that_measured_it():
    model = mujoco.MjModel.from_xml_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5))
    runs = [recorded(f"run{k}.csv", k) for k in range(3)]
    alone = measurement_noise(model, runs[:1])[0]
    assert alone == pytest.approx(5e-4, rel=0.15)
    for run in runs[1:]:
        run.qpos[:] = np.nan
    np.testing.assert_array_equal(measurement_noise(model, runs)[0], alone)
