"""Spikes, dropouts and repeated values are found in motion of all kinds, and nothing else is."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from arm import arm, run

from diagnosis.recordings.cleaning import without_defects
from diagnosis.recordings.recording import Recording


def recorded(noise=2e-4, name="run.csv"):
    table = run(noise=noise)
    return Recording(name, table[:, 0], table[:, 1:3], table[:, 3:5], table[:, 5:7])


def missing(recording, model=None):
    """Rows (T, nq) that became nan, and what was said."""
    [out], notes = without_defects([recording], model or arm())
    assert np.array_equal(out.qpos[np.isfinite(out.qpos)], recording.qpos[np.isfinite(out.qpos)])
    return np.isnan(out.qpos), notes


@pytest.mark.parametrize("noise", [0.0, 2e-4])
@pytest.mark.parametrize("counts", [None, 2e-5, 1e-3, 2e-2])
def test_sound_recordings_stay(noise, counts):
    """Exact, noisy, and read by encoders from fine to coarse."""
    sound = recorded(noise)
    if counts:
        sound = replace(sound, qpos=np.round(sound.qpos / counts) * counts)
    rows, notes = missing(sound)
    assert not rows.any() and notes == []


def test_readings_that_are_alike_by_chance_stay():
    """Among 16000 noisy readings of seven digits two or so are as the row before, and the next is
    far from them."""
    time = np.arange(8000) * 0.002
    motion = 0.4 * np.sin(np.outer(time, [1.0, 1.7]))
    for seed in range(20):
        noisy = motion + np.random.default_rng(seed).normal(0, 1e-4, motion.shape)
        digits = np.vectorize(lambda x: float(f"{x:.7g}"))(noisy)
        rows, notes = missing(
            Recording("run.csv", time, digits, np.full_like(digits, np.nan), np.zeros_like(digits))
        )
        assert not rows.any() and notes == []


def test_coarse_readings_that_were_interpolated_stay():
    """A swing that rests in between, read by an encoder at 60 Hz and written at 100 Hz."""
    slow = recorded(0.0)
    read, count = np.arange(0, 4.1, 1 / 60), 2 * np.pi / 4096
    swing = np.round(0.01 * np.sin(4 * read) ** 3 / count) * count + 0.03
    qpos = np.stack([np.interp(slow.time, read, swing)] * 2, 1)
    rows, notes = missing(replace(slow, qpos=qpos, qvel=np.full((400, 2), np.nan)))
    assert not rows.any() and notes == []


def test_rest_and_starting_from_it_stay():
    sound = recorded(0.0)
    rest = np.repeat(sound.qpos[:1], 100, axis=0)
    rows, notes = missing(
        replace(
            sound, qpos=np.concatenate([rest, sound.qpos[:-100]]), qvel=np.full((400, 2), np.nan)
        )
    )
    assert not rows.any() and notes == []


def test_a_bouncing_ball_stays():
    model = mujoco.MjModel.from_xml_string("""<mujoco><option timestep="0.002"/><worldbody><geom
    type="plane" size="1 1 1" solref="-20000 -5"/>
        <body pos="0 0 .6"><freejoint name="ball"/><geom size=".1" solref="-20000 -5"
        priority="1"/></body></worldbody></mujoco>""")
    data, rows = mujoco.MjData(model), []
    data.qvel[:] = 0.3, 0, 0, 0, 5, 0
    for _ in range(400):
        rows.append(data.qpos.copy())
        mujoco.mj_step(model, data, nstep=5)
    qpos = np.array(rows)
    assert np.count_nonzero(np.diff(np.sign(np.diff(qpos[:, 2]))) > 0) > 2  # it bounces
    ball = Recording(
        "ball.csv", 0.01 * np.arange(400), qpos, np.full((400, 6), np.nan), np.zeros((400, 0))
    )
    lost, notes = missing(ball, model)
    assert not lost.any() and notes == []
    qpos = qpos.copy()
    qpos[100:102] = 0, 0, 0, 1, 0, 0, 0  # the tracker lost it
    lost, notes = missing(replace(ball, qpos=qpos), model)
    assert (
        np.flatnonzero(lost.any(axis=1)).tolist() == [100, 101]
        and lost[100].all()
        and "qpos:ball jumps away" in notes[0]
    )


@pytest.mark.parametrize("length", [1, 2, 3])
def test_spikes_and_dropouts(length):
    broken = recorded()
    qpos = broken.qpos.copy()
    for at in (50, 200, 333):
        qpos[at : at + length, 1] += 0.9
    rows, notes = missing(replace(broken, qpos=qpos))
    assert (
        np.flatnonzero(rows[:, 1]).tolist()
        == [at + k for at in (50, 200, 333) for k in range(length)]
        and not rows[:, 0].any()
    )
    share = "less than 1 %" if length == 1 else f"{100 * 3 * length / 400:.0f} %"
    assert notes == [
        f"run.csv: qpos:elbow jumps away and back in {share} of its rows, which count as not "
        f"measured"
    ]


def test_a_dropout_to_zero_amid_fast_motion():
    """The zeros are too near the line between the values before and after to be a spike."""
    time = 0.01 * np.arange(400)
    qpos = np.stack([6 * np.sin(4 * time), np.cos(time)], axis=1) + 2e-4 * np.random.default_rng(
        0
    ).normal(size=(400, 2))
    at = 75
    assert 1.0 < qpos[at - 1, 0] < 1.2 and 0 < qpos[at + 3, 0] < 0.2  # going on by 0.24 in a row
    qpos[at : at + 3, 0] = 0
    rows, _ = missing(replace(recorded(), qpos=qpos, qvel=np.full((400, 2), np.nan)))
    assert np.flatnonzero(rows[:, 0]).tolist() == [at, at + 1, at + 2] and not rows[:, 1].any()


def test_a_wrapped_angle_is_no_spike():
    wrapped = recorded()
    qpos = wrapped.qpos.copy()
    qpos[100:102, 0] += 2 * np.pi
    assert not missing(replace(wrapped, qpos=qpos))[0].any()


@pytest.mark.parametrize("noise", [0.0, 2e-4])
def test_a_slower_sensor_that_is_held(noise):
    held = recorded(noise)
    own = np.arange(400) // 4 * 4
    rows, notes = missing(replace(held, qpos=held.qpos[own]))
    fresh = np.arange(400) % 4 == 0
    assert (
        not rows[fresh].any() and rows[~fresh].mean() > 0.9
    )  # at turning points two readings can be alike
    assert (
        len(notes) == 2
        and "qpos:shoulder repeats its last value and then catches up in 7" in notes[0]
    )


def test_many_recordings_are_one_line():
    frozen = []
    for k in range(3):
        sound = recorded(name=f"run{k}.csv")
        qpos = sound.qpos.copy()
        qpos[100 : 110 + 2 * k, 0] = qpos[100, 0]
        frozen.append(replace(sound, qpos=qpos))
    _, notes = without_defects(frozen, arm())
    assert notes == [
        "run0.csv and 2 more: qpos:shoulder repeats its last value and then catches up in up to 3 "
        "% of its rows, "
        "which count as not measured"
    ]
