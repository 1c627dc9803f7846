"""The statistical method against closed forms, plain loops and stock MuJoCo; then whole diagnoses of a small pendulum."""

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plants import DRIVEN_PENDULUM, DROP, NOISE, commanded, dropped, recorded

from diagnosis import findings
from diagnosis.effects.base import Candidate, Parameter
from diagnosis.estimation import (
    cluster_scores,
    initial_states,
    multiple_shooting,
    prediction_error,
    residuals,
)
from diagnosis.estimation import windows as cut
from diagnosis.estimator import identify, named_instead
from diagnosis.recordings.recording import Recording
from diagnosis.selection import earning, rivals, transients, unmodelled_force
from diagnosis.selection import search as selection
from diagnosis.simulation.simulator import World

FREE = """<mujoco><worldbody><body><freejoint name="f"/><geom size=".1"/>
  <body><joint name="b" type="ball"/><geom size=".1"/><body pos="0 0 1"><joint name="h"/><geom size=".1"/></body></body></body></worldbody></mujoco>"""


def diagnosed(**hidden):
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    runs = [recorded(f"run{i}.csv", i, **hidden) for i in range(3)]
    return identify(world, runs[:2], runs[2:])


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


# ---- coordinates, windows, error ---------------------------------------------------------------


@given(st.integers(0, 10**6))
@settings(max_examples=50, deadline=None)
def test_tangent_space_is_mujocos(seed):
    rng, model = np.random.default_rng(seed), mujoco.MjModel.from_xml_string(FREE)
    start, step = np.zeros(model.nq), rng.normal(size=model.nv)
    mujoco.mj_integratePos(model, (start := model.qpos0.copy()), rng.normal(size=model.nv), 1.0)
    end, back = start.copy(), np.empty(model.nv)
    mujoco.mj_integratePos(model, end, step, 1.0)
    np.testing.assert_allclose(cut.integrate(model, start, step), end, atol=1e-12)
    mujoco.mj_differentiatePos(model, back, 1.0, start, end)
    np.testing.assert_allclose(cut.difference(model, start, end), back, atol=1e-9)


@given(st.integers(2, 200), st.floats(0.003, 0.2), st.floats(0.0, 0.4), st.integers(0, 99))
@settings(max_examples=60, deadline=None)
def test_windows_tile_the_recording(rows, sample, jitter, seed):
    time = sample * (np.arange(rows) + jitter * np.random.default_rng(seed).uniform(-1, 1, rows))
    found = cut.consecutive(SimpleNamespace(time=time))
    assert found[0].first == 0 and found[-1].last <= rows - 1
    assert all(a.last == b.first for a, b in zip(found, found[1:]))
    assert all(w.first < w.last for w in found)
    if time[-1] - time[0] > 2 * cut.HORIZON:
        assert all(
            time[w.last] - time[w.first]
            <= cut.HORIZON + 0.011 * np.median(np.diff(time)) + sample * (w.last == w.first + 1)
            for w in found
        )


def test_error_is_that_of_stock_mujoco():
    run = recorded("run.csv", 5, mass=0.7)
    xml = DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)
    world = World(mujoco.MjSpec.from_string(xml))
    error, channels = prediction_error.prediction_error(world, {}, [run], np.array([NOISE]))
    assert error == pytest.approx(stock_error(xml, run, NOISE), rel=1e-6)
    assert channels["qpos:pivot"] == pytest.approx(error * NOISE, rel=1e-9)


def test_windows_that_blow_up_are_counted_beside_the_curve():
    run = recorded("run.csv", 5)
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    true, noise = world.simulate, np.array([NOISE])

    def bursts(
        settings, qpos, qvel, windows, *more, **options
    ):  # under the correction, in every other window from 0.4 s on
        out = true(settings, qpos, qvel, windows, *more, **options)
        out[0][[i for i, w in enumerate(windows) if settings[i] and w.first // 90 % 2], 41:] = (
            np.nan
        )
        return out

    world.simulate = bursts
    mass = {world.candidate("mass", "arm"): (0.5001,)}
    rows = prediction_error.curve(world, mass, [run], noise, np.array([np.inf]))
    assert [row["seconds"] > 0.405 for row in rows] == ["blown_up" in row for row in rows]
    assert rows[-1]["blown_up"] == {"before": 0, "after": 2, "of": 4}
    assert all(row["after"] == pytest.approx(row["before"], rel=0.5) for row in rows)


def test_the_curve_goes_by_time_whatever_the_sampling():
    """Of recordings of different rates, against a plain loop over windows and their nearest rows."""
    world, noise = (
        World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.5, mass=0.5))),
        np.array([NOISE]),
    )
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
    entries = prediction_error.curve(world, {}, [fast, *slower], noise, np.array([np.inf]))
    windows = prediction_error.consecutive([fast, *slower], 0.9)
    qpos = prediction_error.predict(world, {}, windows)[0]
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
    floor, channels, scatter = prediction_error.floor_error(
        world, {}, runs, np.array([NOISE]), np.array([np.inf])
    )
    each = [stock_error(xml, run, NOISE) ** 2 for run in runs]
    assert floor == pytest.approx(np.sqrt(np.mean(each)), rel=0.08)
    assert np.std(each, ddof=1) / np.sqrt(len(each)) == pytest.approx(
        scatter, rel=0.7
    )  # known from six runs to 30 % itself
    assert channels["qpos:pivot"] == pytest.approx(floor * NOISE)


def test_noise_of_differences():
    rng, time = np.random.default_rng(0), 0.01 * np.arange(2000)
    x = np.sin(3 * time) + 1e-3 * rng.normal(size=2000)
    assert cut.difference_noise(x) == pytest.approx(1e-3, rel=0.1)


def test_unmeasured_states_are_filled_from_velocity():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint type="slide"/><geom size=".1"/></body></worldbody></mujoco>'
    )
    time = 0.1 * np.arange(11)
    recording = Recording(
        "r", time, np.full((11, 1), np.nan), np.full((11, 1), 2.0), np.zeros((11, 0)), {}
    )
    qpos, qvel = cut.states(model, recording)
    np.testing.assert_allclose(qpos[:, 0], 2.0 * time, atol=1e-12)
    assert (qvel == 2.0).all()


# ---- statistics --------------------------------------------------------------------------------


@given(st.floats(0.01, 50), st.integers(1, 60))
def test_f_tail_with_two_degrees_is_a_power(f, b):
    assert cluster_scores.f_survival(f, 2, b) == pytest.approx(
        (1 + 2 * f / b) ** (-b / 2), rel=1e-8
    )


def test_t_quantile_of_one_degree_is_cauchys():
    assert cluster_scores.t_quantile(1) == pytest.approx(np.tan(np.pi * 0.475), rel=1e-6)


def test_p_values_hold_under_correlated_residuals():
    rng, low = np.random.default_rng(1), []
    for _ in range(400):
        column = rng.normal(size=(24, 30, 1)) + rng.normal(size=(24, 1, 1))
        residual = rng.normal(size=(24, 30)) + rng.normal(
            size=(24, 1)
        )  # chi-square would reject half of these
        low.append(
            cluster_scores.wald(
                np.einsum("cmk,cml->ckl", column, column), np.einsum("cmk,cm->ck", column, residual)
            )[2]
            < 0.05
        )
    assert 0.02 < np.mean(low) < 0.09


def test_noise_is_that_of_the_recordings_that_measured_it():
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    runs = [recorded(f"run{k}.csv", k) for k in range(3)]
    alone = cut.measurement_noise(world.model, runs[:1])[0]
    for run in runs[1:]:
        run.qpos[:] = np.nan
    np.testing.assert_array_equal(cut.measurement_noise(world.model, runs)[0], alone)


def test_every_other_position_still_has_probes_for_friction():
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    candidate, run = (
        world.candidate("stribeck_friction", "pivot"),
        recorded("run.csv", 1, noise=0.0),
    )
    whole = world.probes(candidate, [run])
    run.qpos[1::2] = np.nan
    np.testing.assert_allclose(world.probes(candidate, [run]), whole, rtol=0.1)


def test_values_for_windows_are_those_that_other_recordings_say():
    runs = [recorded(f"run{k}.csv", k, damping=0.08) for k in range(4)]
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    noise, windows = np.array([NOISE]), [w for r in runs[1:] for w in cut.consecutive(r, 0.3)]
    problem = residuals.Problem(
        world, [w for r in runs[:3] for w in cut.consecutive(r, 0.5)], noise, np.array([np.inf])
    )
    damping = world.candidate("viscous_damping", "pivot")
    [fit] = multiple_shooting.solve(
        problem,
        [residuals.Hypothesis().plus(damping, (0.06,))],
        initial_states.fit(problem, residuals.Hypothesis()),
    )
    settings = earning.elsewhere(selection.Search(world, problem, runs), fit, windows)
    for w, s in zip(windows, settings):
        others = residuals.Problem(
            world,
            [v for r in runs[:3] if r is not w.recording for v in cut.consecutive(r, 0.5)],
            noise,
            np.array([np.inf]),
        )
        [alone] = multiple_shooting.solve(
            others, [fit.hypothesis], initial_states.fit(others, fit.hypothesis)
        )
        assert s[damping][0] == pytest.approx(alone.hypothesis.vector[0], rel=0.01)
    before, after = (
        earning.overall(earning.gaps(world, s, windows, noise))
        for s in ([{}] * len(windows), settings)
    )
    assert after < 0.5 * before
    assert after == pytest.approx(
        prediction_error.prediction_error(world, fit.hypothesis.settings, runs[1:], noise)[0],
        rel=0.02,
    )


def test_intervals_allow_for_a_finer_step_where_the_data_do():
    width = {}
    for finer in (1, 8):
        runs = [recorded(f"run{k}.csv", k, damping=0.06, finer=finer) for k in range(4)]
        world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
        problem = residuals.Problem(
            world,
            [w for r in runs for w in cut.consecutive(r, 0.5)],
            np.array([NOISE]),
            np.array([np.inf]),
        )
        damping = world.candidate("viscous_damping", "pivot")
        [fit] = multiple_shooting.solve(
            problem,
            [residuals.Hypothesis().plus(damping, (0.058,))],
            initial_states.fit(problem, residuals.Hypothesis()),
        )
        [(low, high)] = findings.intervals(selection.Search(world, problem, runs), fit)[damping]
        assert low < 0.06 < high
        width[finer] = high - low
    assert width[1] < width[8] / 5


def test_each_of_a_dozen_recordings_is_a_cluster():
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    for number in (11, 13, 20):
        runs = [recorded(f"run{k}.csv", k, seconds=1.0) for k in range(number)]
        problem = residuals.Problem(
            world,
            [w for r in runs for w in cut.consecutive(r, 0.25)],
            np.array([NOISE]),
            np.array([np.inf]),
        )
        search = selection.Search(world, problem, runs)
        assert search.pieces == 1 and (search.labels.max() + 1 == number) == (number > 11)


def test_what_was_not_seen_at_one_fit_is_looked_at_again_at_the_next():
    runs = [recorded(f"run{k}.csv", k, damping=0.08) for k in range(2)]
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    problem = residuals.Problem(
        world,
        [w for r in runs for w in cut.consecutive(r, 0.5)],
        np.array([NOISE]),
        np.array([np.inf]),
    )
    search, bare = (
        selection.Search(world, problem, runs),
        initial_states.fit(problem, residuals.Hypothesis()),
    )
    search.trials(bare)
    damping, mass = world.candidate("viscous_damping", "pivot"), world.candidate("mass", "arm")
    [option] = [o for o in search.options if o.candidate == damping and o.linear]
    search.looked[option] = bare, np.zeros_like(search.looked[option][1])
    [fit] = multiple_shooting.solve(problem, [residuals.Hypothesis().plus(mass, (0.51,))], bare)
    assert option in {t.option for t in search.trials(fit)[0]}


def loaded(seed, lasting, carried, between, seconds=4.0):
    """A run of the pendulum, `lasting` times as heavy as nominal, for a while `carried` times."""
    rng = np.random.default_rng(seed)
    models = [
        mujoco.MjModel.from_xml_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5 * ratio))
        for ratio in (lasting, carried)
    ]
    data, rows = mujoco.MjData(models[0]), round(seconds / 0.01)
    time, period = 0.01 * np.arange(rows), rng.uniform(0.6, 1.2, 3)
    ctrl, qpos = (
        (0.4 * np.sin(2 * np.pi * time[:, None] / period)).sum(1, keepdims=True),
        np.empty((rows, 1)),
    )
    for t in range(rows):
        qpos[t], data.ctrl[:] = data.qpos, ctrl[t]
        mujoco.mj_step(models[int(between[0] <= time[t] < between[1])], data, 2)
    return Recording(
        "run.csv",
        time,
        qpos + NOISE * rng.normal(size=qpos.shape),
        np.full((rows, 1), np.nan),
        ctrl,
        {},
    )


def test_a_load_on_top_of_a_lasting_one_is_placed_in_time():
    world, run = (
        World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5))),
        loaded(2, 3.0, 4.0, (1.6, 2.4)),
    )
    problem = residuals.Problem(
        world, cut.consecutive(run, 0.2), np.array([NOISE]), np.array([np.inf])
    )
    heavy = residuals.Hypothesis().plus(world.candidate("mass", "arm"), (1.5,))
    event = transients.find(world, problem, initial_states.fit(problem, heavy))
    assert event.candidate.effect.name == "payload_change"
    assert event.time == pytest.approx((1.6, 2.4), abs=0.05) and event.values[0] == pytest.approx(
        2.0, rel=0.05
    )


def test_an_effect_that_does_not_predict_other_recordings_better_goes():
    runs = [recorded(f"run{k}.csv", k, damping=0.08) for k in range(4)]
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    noise, windows = np.array([NOISE]), [w for r in runs for w in cut.consecutive(r, 0.3)]
    problem = residuals.Problem(
        world, [w for r in runs for w in cut.consecutive(r, 0.5)], noise, np.array([np.inf])
    )
    damping, air = world.candidate("viscous_damping", "pivot"), world.candidate("air_drag", "world")
    both = residuals.Hypothesis().plus(damping, (0.06,)).plus(air, (50.0,))
    [fit] = multiple_shooting.solve(
        problem, [both], initial_states.fit(problem, residuals.Hypothesis())
    )
    search = selection.Search(world, problem, runs)
    search.freedom = 1  # as where the model is far from the noise
    assert earning.earned(search, fit, windows, noise).hypothesis.candidates == (damping,)


def test_alternatives_are_refitted_and_listed_where_they_predict_as_well():
    runs = [
        recorded(f"run{k}.csv", k, damping=0.08, push=lambda time, qpos, qvel: 0.03)
        for k in range(3)
    ]
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    noise = np.array([NOISE])
    problem = residuals.Problem(
        world, [w for r in runs for w in cut.consecutive(r, 0.5)], noise, np.array([np.inf])
    )
    damping, offset, bias, gain = (
        world.candidate(*c)
        for c in (
            ("viscous_damping", "pivot"),
            ("spring_offset", "pivot"),
            ("bias", "drive"),
            ("gain", "drive"),
        )
    )
    true = residuals.Hypothesis().plus(damping, (0.08,)).plus(offset, (0.03,))
    [fit] = multiple_shooting.solve(
        problem, [true], initial_states.fit(problem, residuals.Hypothesis())
    )
    others = [(1.0, gain, (1.01,)), (1.1, bias, (0.027,))]  # as few windows see them
    (only,) = findings.also_possible(
        selection.Search(world, problem, runs), fit, runs, noise, offset, others
    )
    assert (only["effect"], only["place"]["name"]) == ("bias", "drive")
    assert only["parameters"][0]["value"] == pytest.approx(
        0.03, rel=0.02
    )  # the motor has no gear: the same torque


def test_what_stands_in_a_curves_place_brings_its_equals_along():
    runs = [recorded(f"run{k}.csv", k, damping=0.1) for k in range(2)]
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    problem = residuals.Problem(
        world,
        [w for r in runs for w in cut.consecutive(r, 0.2)],
        np.array([NOISE]),
        np.array([np.inf]),
    )
    curve = world.curve("pivot", "velocity:pivot", (-5.0, 0.0, 5.0))
    [fit] = multiple_shooting.solve(
        problem,
        [residuals.Hypothesis().plus(curve, (0.2, 0.0, -0.2))],
        initial_states.fit(problem, residuals.Hypothesis()),
    )
    hypothesis, possible = named_instead(selection.Search(world, problem, runs), fit, curve)
    [(name, values)] = hypothesis.effects
    [(_, others)] = possible.items()
    straight = {("viscous_damping", "pivot"), ("back_emf", "drive")}  # this curve is a line
    assert (name.effect.name, name.place.name) in straight and list(possible) == [name]
    assert straight <= {(c.effect.name, c.place.name) for _, c, _ in others} | {
        (name.effect.name, name.place.name)
    }
    assert values[0] - name.nominal[0] == pytest.approx(0.05, rel=0.05)


def test_scatter_of_errors_between_recordings_is_students():
    rng, runs = np.random.default_rng(1), [commanded(np.arange(9.0)) for _ in range(14)]
    windows, known = [cut.Window(r, 0, 8) for r in runs], np.full((14, 8, 1), True)
    one, other = rng.normal(0, 2, (2, 14, 8, 1))
    rise, bound, _ = earning.scatter(windows, (one, known), (other, known))
    each = (np.sqrt((x**2).mean((1, 2))) for x in (other, one))
    each = np.subtract(*each)
    assert rise == pytest.approx(each.sum()) and bound == pytest.approx(
        1.7709 * each.std(ddof=1) * np.sqrt(14), rel=1e-3
    )
    other[3] = np.inf  # a window that blows up counts for ten of the worst
    assert earning.scatter(windows, (one, known), (other, known))[0] > rise + 8 * np.sqrt(1)


def test_what_an_effect_adds_is_believed_where_the_measurements_may_hold_all_of_it():
    rng, runs = np.random.default_rng(0), [commanded(np.arange(9.0)) for _ in range(30)]
    windows, known = [cut.Window(r, 0, 8) for r in runs], np.full((30, 8, 1), True)
    believed = {0.0: 0, 1.0: 0}
    for share in believed:
        for _ in range(50):
            added, noise = rng.normal(size=(2, 30, 8, 1))
            less = share * added + 3 * noise  # noise much larger than what is added
            believed[share] += earning.there(windows, (less - added, known), (less, known))
    assert believed[1.0] >= 45 and believed[0.0] <= 5


def test_what_a_motor_at_a_site_depends_on_is_no_joint():
    xml = """<mujoco><worldbody><body name="drone"><freejoint name="root"/><geom size=".1"/><site name="s"/></body></worldbody>
      <actuator><motor name="a" site="s" gear="0 0 1 0 0 0"/><motor name="b" site="s" gear="0 0 1 0 0 .1"/></actuator></mujoco>"""
    world = World(mujoco.MjSpec.from_string(xml))
    for actuator in "ab":
        assert findings.depends_on(world.model, world.candidate("back_emf", actuator)) == []
        assert findings.depends_on(world.model, world.candidate("gain", actuator)) == [
            f"control:{actuator}"
        ]


# ---- shooting ----------------------------------------------------------------------------------


def test_start_states_and_damping_are_recovered_without_noise():
    run = recorded("run.csv", 2, damping=0.08, noise=0.0)
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    problem = residuals.Problem(
        world, cut.consecutive(run, 0.5), np.array([1e-4]), np.array([np.inf])
    )
    nominal = initial_states.fit(problem, residuals.Hypothesis())
    damping = world.candidate("viscous_damping", "pivot")
    [fit] = multiple_shooting.solve(
        problem, [residuals.Hypothesis(((damping, (0.06,)),))], nominal, iterations=8
    )
    assert fit.hypothesis.vector[0] == pytest.approx(0.08, rel=1e-3)
    assert fit.chi2.sum() < 1e-3 * nominal.chi2.sum()
    again = residuals.Problem(world, problem.windows, np.array([1e-4]), np.array([np.inf]))
    assert initial_states.fit(again, residuals.Hypothesis()) is nominal  # remembered
    assert initial_states.fit(problem.subset([0, 1]), residuals.Hypothesis()) is not nominal


def test_updated_start_jacobians_serve_as_well_as_fresh_ones():
    run = recorded("run.csv", 4, damping=0.2)
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    problem = residuals.Problem(
        world, cut.consecutive(run, 0.5), np.array([NOISE]), np.array([np.inf])
    )
    fit, every = (
        initial_states.fit(problem, residuals.Hypothesis()),
        np.arange(len(problem.windows)),
    )
    qpos, qvel, residual = fit.qpos, fit.qvel, fit.residual
    for _ in range(5):  # plain Gauss-Newton
        jacobian = problem.start_jacobians([{}] * len(every), every, qpos, qvel, residual)
        step = np.array([np.linalg.lstsq(j, r, rcond=None)[0] for j, r in zip(jacobian, residual)])
        qpos, qvel = problem.moved(qpos, qvel, step)
        residual = problem.residuals([{}] * len(every), every, qpos, qvel)
    assert fit.chi2.sum() == pytest.approx((residual**2).sum(), rel=2e-3)
    assert np.abs(fit.start_jacobian - jacobian).max() < 0.02 * np.abs(jacobian).max()


@pytest.mark.parametrize("pieces", [1, 3])
def test_projection_is_least_squares_on_the_start_states(pieces):
    rng = np.random.default_rng(0)
    problem = SimpleNamespace(
        weight=np.ones((4, 9, 1)), model=SimpleNamespace(nv=1)
    )  # 9 rows and the prior's two
    fit = SimpleNamespace(
        residual=rng.normal(size=(4, 11)), start_jacobian=rng.normal(size=(4, 11, 2))
    )
    slope = rng.normal(size=(4, 11, 3))
    scan = multiple_shooting.project(problem, fit, slope, pieces)
    for w in range(4):
        rest = lambda x: (
            x - fit.start_jacobian[w] @ np.linalg.lstsq(fit.start_jacobian[w], x, rcond=None)[0]
        )
        mine = slice(w * pieces, (w + 1) * pieces)
        assert scan.chi2[mine].sum() == pytest.approx((rest(fit.residual[w]) ** 2).sum())
        assert np.allclose(scan.score[mine].sum(0), rest(slope[w]).T @ rest(fit.residual[w]))
        assert np.allclose(scan.gram[mine].sum(0), rest(slope[w]).T @ rest(slope[w]))


def test_a_coarser_curve_is_a_sum_of_the_finer():
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    for number in (4, 5, 11):
        finest = world.curve(
            "pivot", "velocity:pivot", np.sort(np.random.default_rng(number).normal(size=number))
        )
        x = np.linspace(-3, 3, 101)
        for curve, weights in unmodelled_force.coarser(world, finest):
            assert np.allclose(
                unmodelled_force.hats(x, finest.effect.knots) @ weights,
                unmodelled_force.hats(x, curve.effect.knots),
            )


# ---- whole diagnoses ---------------------------------------------------------------------------


def names(diagnosis):
    return [(f["effect"], f["place"]["name"]) for f in diagnosis.summary["findings"]]


PAIR = """<mujoco><option timestep="0.005"/><default><geom type="capsule" fromto="0 0 0 0 0 -.4" size=".02" mass=".5" contype="0"
  conaffinity="0"/></default><worldbody><body><joint name="j" axis="0 1 0" damping=".05"/><geom/></body>
  <body pos="0 1 0"><joint name="k" axis="0 1 0" damping="{damping}"/><geom/></body></worldbody>
  <actuator><motor name="m" joint="j"/><motor name="n" joint="k"/></actuator></mujoco>"""


def beside(seed, damping):
    """Two pendulums that share nothing, one with its position measured, one with its velocity."""
    model, rng = (
        mujoco.MjModel.from_xml_string(PAIR.format(damping=damping)),
        np.random.default_rng(seed),
    )
    data, rows = mujoco.MjData(model), 400
    qpos, qvel, ctrl = (
        np.full((rows, 2), np.nan),
        np.full((rows, 2), np.nan),
        np.repeat(rng.uniform(-0.6, 0.6, (rows // 20, 2)), 20, 0),
    )
    for t in range(rows):
        qpos[t, 0], qvel[t, 1] = (
            data.qpos[0] + NOISE * rng.normal(),
            data.qvel[1] + 0.01 * rng.normal(),
        )
        data.ctrl[:] = ctrl[t]
        mujoco.mj_step(model, data, 2)
    return Recording(f"run{seed}.csv", 0.01 * np.arange(rows), qpos, qvel, ctrl, {})


def test_what_only_velocities_show_is_found():
    runs = [beside(seed, 0.12) for seed in range(3)]
    diagnosis = identify(
        World(mujoco.MjSpec.from_string(PAIR.format(damping=0.05))), runs[:2], runs[2:]
    )
    assert names(diagnosis) == [("viscous_damping", "k")]
    assert diagnosis.summary["findings"][0]["parameters"][0]["value"] == pytest.approx(
        0.12, rel=0.02
    )


def test_seldom_and_mostly_unmeasured_rows_can_be_solved():
    run = recorded("seldom.csv", 0, damping=0.1)
    seldom = Recording(
        run.name, run.time[::3], run.qpos[::3].copy(), run.qvel[::3], run.ctrl[::3], {}
    )
    seldom.qpos[:80] = np.nan
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    problem = residuals.Problem(
        world, cut.consecutive(seldom, 0.2), np.array([NOISE]), np.array([np.inf])
    )
    begun = residuals.Hypothesis().plus(world.candidate("viscous_damping", "pivot"), (0.06,))
    [fit] = multiple_shooting.solve(
        problem, [begun], initial_states.fit(problem, residuals.Hypothesis())
    )
    assert fit.hypothesis.vector[0] > 0.06


def test_what_shows_in_a_few_bounces_only_is_found():
    world = World(mujoco.MjSpec.from_string(DROP.format(damping=-90)))
    runs = [dropped(seed, -40) for seed in range(6)]
    diagnosis = identify(world, runs[:4], runs[4:])
    [finding] = diagnosis.summary["findings"]
    assert finding["effect"] == "contact_damping"
    assert finding["parameters"][0]["value"] == pytest.approx(40, rel=0.05)
    fit = diagnosis.summary["fit"]["held_out"]
    assert fit["after"] < fit["before"]


FALL = """<mujoco><compiler angle="radian"/><option timestep="0.005"/><worldbody><body><joint name="x" axis="0 1 0" range="-1.4 1.4" damping=".05"/>
  <geom type="capsule" fromto="0 0 0 0 0 .6" size=".02" mass="1" contype="0" conaffinity="0"/></body></worldbody>
  <actuator><motor name="m" joint="x"/></actuator></mujoco>"""


def fallen(seed, ratio):
    """An upright rod falls onto its stop and lies there, pushed at from time to time."""
    rng, model = np.random.default_rng(seed), mujoco.MjModel.from_xml_string(FALL)
    data, qpos, ctrl = (
        mujoco.MjData(model),
        np.empty((150, 1)),
        np.repeat(rng.uniform(-1, 1, (15, 1)), 10, 0),
    )
    data.qpos[:] = rng.uniform(0.05, 0.2)
    for t in range(len(qpos)):
        qpos[t], data.ctrl[:] = data.qpos, ctrl[t]
        mujoco.mj_step(model, data, 4)
    noisy = ratio * qpos + NOISE * rng.normal(size=qpos.shape)
    return Recording(
        f"fall{seed}.csv", 0.02 * np.arange(len(qpos)), noisy, np.full(qpos.shape, np.nan), ctrl, {}
    )


def test_a_sensor_read_at_a_stop_is_found_though_no_small_step_leads_there():
    runs = [fallen(seed, 0.85) for seed in range(4)]
    [finding] = identify(World(mujoco.MjSpec.from_string(FALL)), runs[:3], runs[3:]).summary[
        "findings"
    ]
    assert finding["effect"] == "sensor_scale"
    assert finding["parameters"][0]["value"] == pytest.approx(0.85, rel=0.01)


def test_far_values_are_looked_at_where_a_fit_leaves_much():
    world, runs = World(mujoco.MjSpec.from_string(FALL)), [fallen(seed, 0.85) for seed in range(3)]
    problem = residuals.Problem(
        world,
        [w for r in runs for w in cut.consecutive(r, 0.2)],
        np.array([NOISE]),
        np.array([np.inf]),
    )
    search = selection.Search(world, problem, runs)
    best, *_ = search.leaps(initial_states.fit(problem, residuals.Hypothesis()))
    assert best.option.candidate.effect.name == "sensor_scale" and best.start[0] == pytest.approx(
        0.85, rel=0.01
    )
    assert not search.leaps(
        initial_states.fit(problem, residuals.Hypothesis().plus(best.option.candidate, (0.85,)))
    )


FINE = DRIVEN_PENDULUM.replace("0.005", "0.00125").format(damping=0.05, mass=0.5)


def rubbed(seed, coulomb, static, velocity, rows=250):
    """A run of the pendulum by a plain loop of its equation of motion, with friction that falls with speed and holds at rest."""
    model, rng, h = mujoco.MjModel.from_xml_string(FINE), np.random.default_rng(seed), 0.00125
    inertia, pull = model.dof_M0[0], 9.81 * model.body_mass[1] * -model.body_ipos[1, 2]
    time, period, phase = 0.01 * np.arange(rows), rng.uniform(0.6, 1.2, 3), rng.uniform(0, 6, 3)
    ctrl = (0.4 * np.sin(2 * np.pi * time[:, None] / period + phase)).sum(1)
    q, v, qpos = rng.uniform(-1, 1), 0.0, np.empty((rows, 1))
    for t in range(rows):
        qpos[t] = q
        for _ in range(8):
            v += h * (ctrl[t] - pull * np.sin(q) - 0.05 * v) / inertia
            hold = h * (coulomb + (static - coulomb) * np.exp(-((v / velocity) ** 2))) / inertia
            v = np.sign(v) * max(abs(v) - hold, 0.0)
            q += h * v
    return Recording(
        f"rub{seed}.csv",
        time,
        qpos + 2e-3 * rng.normal(size=qpos.shape),
        np.full(qpos.shape, np.nan),
        ctrl[:, None],
        {},
    )


@pytest.mark.parametrize(
    "static, effect, values",
    [(0.25, "stribeck_friction", [0.1, 0.25, 0.5]), (0.1, "coulomb_friction", [0.1])],
)
def test_friction_is_named_by_whether_it_falls_with_speed(static, effect, values):
    world, runs = (
        World(mujoco.MjSpec.from_string(FINE)),
        [rubbed(seed, 0.1, static, 0.5) for seed in range(3)],
    )
    finding = identify(world, runs[:2], runs[2:]).summary["findings"][
        0
    ]  # the loop holds harder than MuJoCo's friction: a trace of more
    assert finding["effect"] == effect
    got = [p["value"] for p in finding["parameters"]]
    assert got[:2] == pytest.approx(values[:2], rel=0.05) and got[2:] == pytest.approx(
        values[2:], rel=0.1
    )


VANE = """<mujoco><option timestep="0.004" density="1.2" wind="{wind}"/><worldbody><body><joint name="mast" axis="0 1 0" damping=".001"/>
  <geom type="box" pos="0 0 -.45" size=".002 .15 .15" mass=".05" contype="0" conaffinity="0"/></body></worldbody>
  <actuator><motor name="drive" joint="mast" forcelimited="{limited}" forcerange="-.02 .02"/></actuator></mujoco>"""


def blown(seed, **hidden):
    """A run of a vane, pushed at from time to time, in stock MuJoCo."""
    model = mujoco.MjModel.from_xml_string(
        VANE.format(**{"wind": "0 0 0", "limited": "false", **hidden})
    )
    rng, data, qpos = np.random.default_rng(seed), mujoco.MjData(model), np.empty((500, 1))
    ctrl = np.repeat(rng.uniform(-0.2, 0.2, (20, 1)), 25, 0)
    data.qpos[:] = rng.uniform(-0.3, 0.3)
    for t in range(len(qpos)):
        qpos[t], data.ctrl[:] = data.qpos, ctrl[t]
        mujoco.mj_step(model, data, 3)
    noisy = qpos + NOISE * rng.normal(size=qpos.shape)
    return Recording(
        f"vane{seed}.csv",
        0.012 * np.arange(len(qpos)),
        noisy,
        np.full(qpos.shape, np.nan),
        ctrl,
        {},
    )


@pytest.mark.parametrize(
    "hidden, effect, value",
    [({"wind": "3 0 0"}, "wind", 3.0), ({"limited": "true"}, "saturation", 0.02)],
)
def test_what_does_not_act_in_proportion_is_found_at_its_size(hidden, effect, value):
    world, runs = (
        World(mujoco.MjSpec.from_string(VANE.format(wind="0 0 0", limited="false"))),
        [blown(seed, **hidden) for seed in range(3)],
    )
    [finding] = identify(world, runs[:2], runs[2:]).summary["findings"]
    assert finding["effect"] == effect
    assert finding["parameters"][0]["value"] == pytest.approx(value, rel=0.02)


@given(
    st.lists(st.tuples(st.floats(-1, 1), st.floats(1e-3, 1), st.booleans()), min_size=1, max_size=4)
)
def test_parameters_are_moved_inside_their_bounds_and_never_hardly(cases):
    effect = Candidate(
        SimpleNamespace(name="made up"),
        None,
        tuple(Parameter("p", "1", 0.0, -1.0, 1.0, step if up else -step) for _, step, up in cases),
    )
    vector = np.array([v for v, *_ in cases])
    settings_, moves = multiple_shooting.perturbed(residuals.Hypothesis(((effect, tuple(vector)),)))
    for i, (p, setting) in enumerate(zip(effect.parameters, settings_)):
        assert -1 <= setting[effect][i] <= 1
        assert np.array(setting[effect]) - vector == pytest.approx(
            np.where(np.arange(len(vector)) == i, moves[i], 0)
        )
        assert multiple_shooting.SHORT * abs(p.step) <= abs(moves[i]) <= abs(p.step)


def test_nothing_missing_is_a_match():
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    runs = [
        recorded(f"run{k}.csv", k, seconds=4.0 if k < 2 else 40.0) for k in range(3)
    ]  # an error in noise is itself chance
    diagnosis = identify(world, runs[:2], runs[2:])
    assert diagnosis.summary["verdict"] == "match" and not diagnosis.summary["findings"]
    fit = diagnosis.summary["fit"]["held_out"]
    assert fit["before"] == fit["after"] == pytest.approx(fit["floor"], rel=0.15)
    assert diagnosis.summary["noise"]["qpos:pivot"] == pytest.approx(NOISE, rel=0.15)


def test_damping_is_named_and_the_corrected_file_reproduces_the_error():
    diagnosis = diagnosed(damping=0.1)
    assert names(diagnosis) == [("viscous_damping", "pivot")]
    [value] = diagnosis.summary["findings"][0]["parameters"]
    assert value["low"] < 0.1 < value["high"] and value["value"] == pytest.approx(0.1, rel=0.02)
    fit = diagnosis.summary["fit"]["held_out"]
    assert fit["after"] < fit["before"] and fit["after"] == pytest.approx(fit["floor"], rel=0.3)
    noise = diagnosis.summary["noise"]["qpos:pivot"]
    assert stock_error(diagnosis.corrected_xml, diagnosis.held_out[0], noise) == pytest.approx(
        fit["after"], rel=1e-3
    )


def test_two_effects_are_both_found():
    diagnosis = diagnosed(damping=0.1, push=lambda time, q, v: 0.15)
    found = [
        {(f["effect"], f["place"]["name"])}
        | {(a["effect"], a["place"]["name"]) for a in f["also_possible"]}
        for f in diagnosis.summary["findings"]
    ]
    assert len(found) == 2
    assert any(("viscous_damping", "pivot") in f for f in found) and any(
        ("spring_offset", "pivot") in f for f in found
    )


def test_what_no_catalogue_knows_is_called_unknown():
    diagnosis = diagnosed(push=lambda time, q, v: -0.4 * np.sin(5 * q) * (q > 0))
    found = [f for f in diagnosis.summary["findings"] if f["effect"] == "unknown"]
    assert (
        found
        and found[0]["place"]["name"] == "pivot"
        and "position:pivot" in found[0]["depends_on"]
    )
    [(variable, (begin, end))] = found[0]["when"].items()
    assert variable == "qpos:pivot" and begin == pytest.approx(0, abs=0.1)
    assert end == pytest.approx(max(r.qpos.max() for r in diagnosis.train), abs=0.05)


SERVO = DRIVEN_PENDULUM.format(damping=0.05, mass=0.5).replace(
    '<motor name="drive" joint="pivot"/>', '<position name="drive" joint="pivot" kp="20" kv="0.6"/>'
)


def tired(name, seed, rows=400):
    """A run of the pendulum under a servo that loses half of its force within seconds, in stock MuJoCo; position with noise."""
    model, rng = mujoco.MjModel.from_xml_string(SERVO), np.random.default_rng(seed)
    data, gain, bias = (
        mujoco.MjData(model),
        model.actuator_gainprm.copy(),
        model.actuator_biasprm.copy(),
    )
    time, period, phase = 0.01 * np.arange(rows), rng.uniform(0.6, 1.2, 3), rng.uniform(0, 6, 3)
    ctrl, qpos = (
        (0.3 * np.sin(2 * np.pi * time[:, None] / period + phase)).sum(1, keepdims=True),
        np.empty((rows, 1)),
    )
    for t in range(rows):
        qpos[t], data.ctrl[:] = data.qpos, ctrl[t]
        left = 1 - 0.5 * (1 - np.exp(-time[t]))
        model.actuator_gainprm[:], model.actuator_biasprm[:] = left * gain, left * bias
        mujoco.mj_step(model, data, 2)
    return Recording(
        name,
        time,
        qpos + NOISE * rng.normal(size=qpos.shape),
        np.full(qpos.shape, np.nan),
        ctrl,
        {},
    )


def test_a_servo_that_tires_is_no_weaker_servo():
    world, runs = (
        World(mujoco.MjSpec.from_string(SERVO)),
        [tired(f"run{seed}.csv", seed) for seed in range(3)],
    )
    summary = identify(world, runs[:2], runs[2:]).summary
    [finding] = summary["findings"]
    assert finding["effect"] == "unknown" and finding["place"]["name"] == "pivot"
    assert finding["depends_on"] == ["time", "control:drive"]
    force = [p["value"] for p in finding["parameters"]]
    left = 1 - 0.5 * (1 - np.exp(-np.array([p["at"] for p in finding["parameters"]])))
    assert force == pytest.approx(20 * (left - 1), abs=1.0)
    assert summary["fit"]["held_out"]["after"] < 1.1 * summary["fit"]["held_out"]["floor"]


@pytest.mark.parametrize("speed, drag", [(3.0, 1.5), (3.5, 0.2)])
def test_what_acts_at_high_speed_alone_is_found_and_no_event(speed, drag):
    """Few windows are so fast; and an event in them would explain it too, but the motion does as well."""
    summary = diagnosed(push=lambda time, q, v: -drag * max(v - speed, 0)).summary
    [finding] = summary["findings"]
    assert finding["effect"] == "unknown" and finding["depends_on"] == ["velocity:pivot"]
    assert summary["fit"]["held_out"]["after"] < summary["fit"]["held_out"]["before"]


@pytest.mark.parametrize(
    "push, names",
    [
        (lambda time, q, v: -0.8 * q**3, {"nonlinear_stiffness"}),
        (lambda time, q, v: -0.8 * q + 0.15, {"stiffness", "spring_offset"}),
    ],
)
def test_several_effects_of_a_joint_give_way_to_one_that_does_as_well(push, names):
    world, runs = (
        World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5))),
        [recorded(f"run{i}.csv", i, push=push) for i in range(2)],
    )
    problem = residuals.Problem(
        world,
        [w for r in runs for w in cut.consecutive(r, 0.3)],
        np.array([NOISE]),
        np.array([np.inf]),
    )
    search, hypothesis = selection.Search(world, problem, runs), residuals.Hypothesis()
    for name, values in (("stiffness", (1.0,)), ("spring_offset", (0.1,))):
        hypothesis = hypothesis.plus(world.candidate(name, "pivot"), values)
    [fit] = multiple_shooting.solve(
        problem, [hypothesis], initial_states.fit(problem, residuals.Hypothesis())
    )
    assert {c.effect.name for c in rivals.united(search, fit).hypothesis.candidates} == names


@pytest.mark.parametrize("hertz", [1.374, 2.2])
def test_a_periodic_force_is_found_with_its_frequency(hertz):
    """Whatever the windows: in those of 0.3 s, 1.374 Hz looks like 1.96 Hz."""
    diagnosis = diagnosed(push=lambda time, q, v: 0.1 * np.sin(2 * np.pi * hertz * time))
    [finding] = diagnosis.summary["findings"]
    assert (
        finding["effect"] == "unknown"
        and finding["depends_on"] == ["time"]
        and finding["curve"]["wave"]
    )
    begin, quarter = [p["at"] for p in finding["parameters"]]
    assert 0.25 / (quarter - begin) == pytest.approx(hertz, abs=0.02)
    assert np.hypot(*[p["value"] for p in finding["parameters"]]) == pytest.approx(0.1, rel=0.1)
    [alone] = [
        row["error_removed"] for row in diagnosis.ranking if row["effect"] == "unknown"
    ]  # the first look knows no such force
    assert alone == max(row["error_removed"] for row in diagnosis.ranking) and alone > 0.9


@given(st.integers(0, 10**6))
@settings(max_examples=60, deadline=None)
def test_a_region_holds_all_of_the_force_or_is_not_told(seed):
    rng = np.random.default_rng(seed)
    knots = np.sort(rng.uniform(-1, 1, 9))
    first, count = rng.integers(0, 9), rng.integers(1, 9)
    values = np.where(
        (np.arange(9) >= first) & (np.arange(9) < first + count),
        rng.choice([-1, 1]) * rng.uniform(1, 2, 9),
        0,
    )
    bounds = np.stack([values - 0.1, values + 0.1], 1)
    effect = unknown_force(knots)
    told = findings.region(effect, values, bounds, (-1.2, 1.2))
    x = np.linspace(-1.2, 1.2, 2001)
    acts = np.interp(x, knots, values) != 0
    if told:
        [(name, (begin, end))] = told.items()
        assert name == "qpos:pivot" and end - begin < 0.8 * 2.4
        assert begin - 2e-3 <= x[acts].min() and x[acts].max() <= end + 2e-3
        assert begin == pytest.approx(x[acts].min(), abs=3e-3) and end == pytest.approx(
            x[acts].max(), abs=3e-3
        )
    else:
        assert np.ptp(x[acts]) > 0.74 * 2.4
    assert (
        findings.region(effect, values, np.stack([values - 5, values + 5], 1), (-1.2, 1.2)) is None
    )  # it may be nothing
    assert findings.region(unknown_force(knots, "time"), values, bounds, None) is None


def unknown_force(knots, variable="position:pivot"):
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    return world.curve("pivot", variable, knots).effect


def test_a_push_for_a_while_is_placed_in_time():
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    runs = [
        recorded("calm.csv", 0),
        recorded("pushed.csv", 1, push=lambda time, q, v: 0.5 * (1.5 < time < 2.5)),
        recorded("held.csv", 2),
    ]
    [finding] = identify(world, runs[:2], runs[2:]).summary["findings"]
    assert finding["when"]["recording"] == "pushed.csv"
    assert finding["when"]["time"] == pytest.approx([1.5, 2.5], abs=0.1)


def test_the_same_input_gives_the_same_numbers():
    first, second = diagnosed(), diagnosed()
    assert first.summary == second.summary
