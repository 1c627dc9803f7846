"""The reported error, its curve and its floor against plain loops in stock MuJoCo."""

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from plants import DRIVEN_PENDULUM, NOISE, recorded, reported_error

from diagnosis.estimation import windowing
from diagnosis.estimation.smoother import Smoother
from diagnosis.handover import Files
from diagnosis.simulation.simulator import World


def stock_error(xml, recording, noise):
    """The reported error by a plain loop in stock MuJoCo."""
    model = mujoco.MjModel.from_xml_string(xml)
    data, square, first = mujoco.MjData(model), [], 0
    q, time = recording.qpos[:, 0], recording.time
    while first + 30 < len(time):
        mujoco.mj_resetData(model, data)
        a, b = max(first - 1, 0), first + 1
        data.qpos[:], data.qvel[:] = q[first], (q[b] - q[a]) / (time[b] - time[a])
        for row in range(first, first + 30):
            data.ctrl[:] = recording.ctrl[row]
            mujoco.mj_step(model, data, round(0.01 / model.opt.timestep))
            square.append((data.qpos[0] - q[row + 1]) ** 2)
        first += 30
    return np.sqrt(np.mean(square)) / noise


def test_error_is_that_of_stock_mujoco():
    run = recorded("run.csv", 5, mass=0.7)
    xml = DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)
    world = World(mujoco.MjSpec.from_string(xml))
    error, channels = reported_error(world, {}, [run], np.array([NOISE]))
    assert error == pytest.approx(stock_error(xml, run, NOISE), rel=1e-6)
    assert channels["qpos:pivot"] == pytest.approx(error * NOISE, rel=1e-9)


def test_windows_that_blow_up_are_counted_beside_the_curve():
    run = recorded("run.csv", 5)
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    smoother, files = Smoother(world, [run]), {"before": Files.of(world, {})}
    trajectory = smoother.locate({})

    def bursts(nominal, windows):  # in every other window from 0.4 s on
        out = files["before"].predicted(nominal, windows)
        out[[i for i, w in enumerate(windows) if w.first // 90 % 2], 41:] = np.nan
        return out

    files["after"] = SimpleNamespace(predicted=bursts)
    rows = windowing.curve(world, files, {}, smoother, trajectory, np.array([NOISE]))
    assert [row["seconds"] > 0.405 for row in rows] == ["blown_up" in row for row in rows]
    assert rows[-1]["blown_up"] == {"before": 0, "after": 2, "of": 4}
    assert all(row["after"] == pytest.approx(row["before"], rel=0.5) for row in rows)


def test_the_curve_goes_by_time_whatever_the_sampling():
    """Recordings of different rates, against a plain loop over windows and nearest rows."""
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.5, mass=0.5)))
    fast, uneven = (
        recorded("fast.csv", 5),
        np.sort(np.random.default_rng(0).choice(400, 300, replace=False)),
    )
    slower = [
        replace(r, **{part: getattr(r, part)[rows] for part in ("time", "qpos", "qvel", "ctrl")})
        for r, rows in (
            (recorded("slow.csv", 6), slice(None, None, 4)),
            (recorded("uneven.csv", 7), uneven),
        )
    ]
    smoother = Smoother(world, [fast, *slower])
    noise = np.array([NOISE])
    off = lambda nominal, windows: windowing.measured(windows) + 3 * NOISE
    files = {"before": Files.of(world, {}), "after": SimpleNamespace(predicted=off)}
    entries = windowing.curve(world, files, {}, smoother, smoother.locate({}), noise)
    assert all(entry["after"] == pytest.approx(3) for entry in entries)
    windows = windowing.cut([fast, *slower], 0.9)
    qpos = windowing.predict(world, {}, windows)[0]
    assert entries[-1]["seconds"] == pytest.approx(0.9, abs=0.05)
    for entry in entries:
        square = []
        for w, path in zip(windows, qpos):
            time = w.recording.time[w.first : w.last + 1] - w.recording.time[w.first]
            row = np.argmin(abs(time - entry["seconds"]))
            if row and abs(time[row] - entry["seconds"]) < 0.021:
                square.append((path[row, 0] - w.recording.qpos[w.first + row, 0]) ** 2)
        assert (
            entry["before"] == pytest.approx(np.sqrt(np.mean(square)) / NOISE, rel=0.1)
            and entry["floor"] > 0
        )


def test_floor_is_what_noise_does_to_a_perfect_simulator():
    xml = DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)
    runs, world = (
        [recorded(f"run{k}.csv", 20 + k, seconds=20.0) for k in range(6)],
        World(mujoco.MjSpec.from_string(xml)),
    )
    smoother = Smoother(world, runs)
    floor, channels, scatter = windowing.floor_error(
        world, {}, smoother, smoother.locate({}), np.array([NOISE])
    )
    each = [stock_error(xml, run, NOISE) ** 2 for run in runs]
    assert floor == pytest.approx(np.sqrt(np.mean(each)), rel=0.08)
    assert np.std(each, ddof=1) / np.sqrt(len(each)) == pytest.approx(
        scatter, rel=0.7
    )  # known from six runs to 30 % itself
    assert channels["qpos:pivot"] == pytest.approx(floor * NOISE)


def test_velocities_that_are_late_differences_raise_the_floor_by_their_error():
    run = recorded("run.csv", 5)
    rate = np.gradient(run.qpos[:, 0], run.time)
    late = np.array([rate[max(t - 8, 0) : t + 1].mean() for t in range(len(rate))])[:, None]
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    floors = []
    for quality in (None, SimpleNamespace(differenced=["pivot"])):
        told = replace(run, qvel=late, quality=quality)
        smoother = Smoother(world, [told])
        trajectory = smoother.locate({})
        noise = np.array([NOISE])
        floors.append(windowing.floor_error(world, {}, smoother, trajectory, noise)[0])
        error, _ = reported_error(world, {}, [told], noise)
        taken = (
            rate[:, None] if quality else late
        )  # in the place of such velocities, what is not late
        np.testing.assert_allclose(smoother.qvel[1:-1], taken[1:-1])
    assert floors[1] == pytest.approx(error, rel=0.2) and floors[0] < 0.8 * error
