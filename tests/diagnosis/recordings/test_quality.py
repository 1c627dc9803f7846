"""What was done to recordings before: each fault put in by hand is found, and sound ones have
none."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from arm import arm, run
from plants import DRIVEN_PENDULUM, recorded
from scipy.signal import lfilter

from diagnosis.recordings.quality import (
    assess,
    differenced_velocity,
    encoder_quantum,
    evenly_stamped,
    interpolated_from,
    stamps,
    taken_evenly,
    told,
)
from diagnosis.recordings.recording import Recording

DT = 0.005
T = DT * np.arange(2000)
STEP = 2 * np.pi / 4096


def motion(t):
    return np.sin(2 * np.pi * 0.7 * t) + 0.4 * np.sin(2 * np.pi * 1.9 * t + 1)


def speed(t):
    return 1.4 * np.pi * np.cos(2 * np.pi * 0.7 * t) + 1.52 * np.pi * np.cos(
        2 * np.pi * 1.9 * t + 1
    )


def noise(size, seed=0, rows=len(T)):
    return np.random.default_rng(seed).normal(size=rows) * size


@pytest.fixture(scope="module")
def sound():
    table = run(seconds=6.0)
    return Recording("run.csv", table[:, 0], table[:, 1:3], table[:, 3:5], table[:, 5:7])


def test_a_sound_recording_has_nothing_to_tell(sound):
    quality = assess(sound, arm())
    assert (quality.quantum, quality.differenced, quality.rows_from) == ({}, {}, None)
    assert quality.jitter < 1e-9 and quality.skipped == 0 and quality.even
    assert told([sound], arm()) == []


@pytest.mark.parametrize("digits", [5, 9])
def test_the_step_of_an_encoder(digits):
    read = np.round(0.013 + STEP * np.rint((motion(T) + noise(1e-4)) / STEP), digits)
    assert abs(encoder_quantum(read) - STEP) < 1e-3 * STEP
    assert encoder_quantum(motion(T) + noise(1e-4)) == 0
    assert encoder_quantum(np.zeros(50)) == 0


@pytest.mark.parametrize("speed", [3, 10, 20])
def test_the_step_of_an_encoder_that_is_read_while_it_moves_fast(speed):
    read = np.round(STEP * np.rint(speed * motion(T[:600]) / STEP), 6)
    assert abs(encoder_quantum(read) - STEP) < 1e-3 * STEP  # hardly two values are neighbours


def test_noise_has_no_step():
    for seed in range(200):
        assert encoder_quantum(np.random.default_rng(seed).normal(size=30)) == 0


@pytest.mark.parametrize("pole, lag", [(0.0, 0), (0.0, 2), (0.7, 0)])
def test_a_velocity_that_is_a_filtered_difference(pole, lag):
    q = motion(T) + noise(2e-4)
    v = np.append(0, np.diff(q)) / DT
    v = lfilter([1 - pole], [1, -pole], np.append(np.zeros(lag), v[: len(v) - lag]))
    found = differenced_velocity(T, q, v)
    late = DT * (0.5 + lag + pole / (1 - pole))
    assert found.explained > 0.99 and abs(found.delay - late) < 0.1 * DT
    shift = np.interp(T - late, T, speed(T))  # by its meaning: it shows what was so long ago
    assert np.std((v - shift)[50:]) < np.std((v - speed(T))[50:])


def test_a_velocity_of_its_own_is_none():
    q, v = motion(T) + noise(2e-4), speed(T) + noise(0.02, seed=1)
    assert differenced_velocity(T, q, v) is None
    assert differenced_velocity(T, motion(T), speed(T)) is None  # nothing but motion: no telling
    assert differenced_velocity(T, q, np.full(len(T), np.nan)) is None


def test_stamps():
    jittered = T + np.random.default_rng(0).uniform(-1, 1, len(T)) * 0.2 * DT
    period, jitter, skipped = stamps(jittered)
    np.testing.assert_allclose([period, jitter], [DT, 0.4 * DT / np.sqrt(12)], rtol=0.05)
    assert skipped == 0
    kept = np.random.default_rng(1).uniform(size=len(T)) > 0.1
    period, jitter, skipped = stamps(T[kept])
    assert abs(period - DT) < 1e-9 and jitter < 1e-9 and 0.07 < skipped < 0.13


def test_late_stamps_and_late_rows_are_told_apart():
    jittered = T + np.random.default_rng(0).uniform(-1, 1, len(T)) * 0.2 * DT
    assert taken_evenly(jittered, [motion(T) + noise(1e-5)])
    assert not taken_evenly(jittered, [motion(jittered) + noise(1e-5)])


def test_of_many_joints_the_fast_one_tells_that_rows_were_taken_evenly():
    jittered = T + np.random.default_rng(0).uniform(-1, 1, len(T)) * 0.2 * DT
    slow = [1e-3 * motion(T) + noise(1e-5, seed=k) for k in range(5)]
    assert not taken_evenly(jittered, slow)
    assert taken_evenly(jittered, [*slow, motion(T) + noise(1e-5)])


def test_an_even_grid_stands_in_the_place_of_stamps_that_jitter():
    model = mujoco.MjModel.from_xml_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5))
    run = recorded("run.csv", 0)
    wrong = run.time + np.random.default_rng(0).uniform(-1, 1, len(run.time)) * 0.2 * 0.01
    wrong[[0, -1]] = run.time[[0, -1]]
    late = replace(run, time=wrong)
    late, true = (evenly_stamped(replace(r, quality=assess(r, model))) for r in (late, run))
    np.testing.assert_allclose(late.time, run.time, atol=1e-9)
    assert true.time is run.time


def test_rows_interpolated_from_a_slower_rate():
    for period in (0.02, 0.033):
        slow = np.arange(0, T[-1] + period, period)
        taken = motion(slow) + noise(1e-4, rows=len(slow))
        found = interpolated_from(T, np.interp(T, slow, taken))
        assert abs(found - period) < 0.1 * period
    assert interpolated_from(T, motion(T) + noise(1e-5)) is None
    assert interpolated_from(T, motion(T)) is None
    assert interpolated_from(T, STEP * np.rint(motion(T) / STEP)) is None  # a coarse encoder


def test_what_is_told(sound):
    model = arm()
    rows = len(sound.time)
    qpos = STEP * np.rint(sound.qpos / STEP)
    qvel = np.vstack([np.zeros((1, 2)), np.diff(sound.qpos, axis=0)]) / 0.01
    jitter = np.random.default_rng(0).uniform(-1, 1, rows) * 2e-3
    lines = told([replace(sound, qpos=qpos)], model)
    assert len(lines) == 2 and all("steps of 0.00153" in line for line in lines)
    lines = told([replace(sound, qvel=qvel)], model)
    assert len(lines) == 2 and "filtered difference of qpos:shoulder, 5.0 ms late" in lines[0]
    [line] = told([replace(sound, time=sound.time + jitter)], model)
    assert "jitter by" in line and "taken evenly" in line
    [line] = told([replace(sound, name=name, time=sound.time + jitter) for name in "ab"], model)
    assert line.startswith("a and 1 more: ")
