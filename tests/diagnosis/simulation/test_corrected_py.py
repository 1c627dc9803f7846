"""corrected.py: what the script makes of corrected.xml is what the simulator predicts, in a
process of its own."""

import ast
import subprocess
import sys
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mujoco.batch import Batch
from plants import (
    DT,
    FILTER,
    INTEGRATOR,
    SIZES,
    START,
    WEAKER,
    T,
    arm,
    commanded,
    driven_by,
    pendulum,
    record,
    simulate,
    tight,
)

from diagnosis.effects.base import Part
from diagnosis.effects.friction import friction_curve
from diagnosis.simulation.corrected_py import (
    CorrectedBatch,
    ScriptError,
    corrected_py,
    module_of,
    parts_in,
    predictions,
    python_parts,
)
from diagnosis.simulation.simulator import Window

AXES = "position:elbow", "velocity:swing"
ROWS = 45  # of the recording, in the script
CURVE = (0.3, 0.1, -0.2)  # forces at three knots
JOINTS = ["lift", "swing", "elbow"]
OF_DRIVES = {
    "load_friction",
    "friction_map",
    "dead_zone",
    "rate_limit",
    "torque_speed",
    "gain_fade",
}


def curves(world):
    """Settings of forces and friction without a name, with knots well inside the travel and its
    speeds."""
    make = world.curve
    return [
        {make("elbow", "position:elbow", (-0.4, -0.3, 0.1)): (0.3, -0.3, 0.2)},
        {make("elbow", "velocity:swing", (-0.5, 0.0, 0.3)): (0.3, 0.0, -0.2)},
        {make("elbow", "control:bend", (-1.0, 0.0, 0.5)): (0.1, 0.0, -0.3)},
        {make("elbow", "load:swing", (-1.0, 0.0, 0.5)): (0.1, 0.0, -0.3)},
        {make("swing", "time", (0.1, 0.3, 0.4)): (0.1, 0.5, -0.3)},
        {make("elbow", "time", (0.1, 0.3), "control:bend"): (0.1, -0.2)},
        {make("elbow", "position:elbow", (-0.4, 0.1), "velocity:elbow"): (-0.1, -0.2)},
        {make("elbow", "position:elbow", (0.0, 0.1), "speed:swing", wave=True): (0.3, 0.2)},
        {make("elbow", "time", (0.0, 0.05), wave=True): (0.3, 0.2)},
        {friction_curve(world.model, "elbow", (-0.4, -0.3, 0.1)): (0.3, 0.0, 0.2)},
    ]


def script_of(folder, world, setting):
    xml, written = world.corrected_xml(setting)
    parts = python_parts(world.model, setting, written)
    (folder / "corrected.xml").write_text(xml)
    joints = [world.model.joint(j).name for j in range(world.model.njnt)]
    (folder / "corrected.py").write_text(corrected_py(parts, joints), encoding="utf-8")
    return parts, written


def in_script(folder, parts, recording, rows=ROWS):
    """Positions by the script's rollout, from its own file."""
    module = module_of(parts, JOINTS)
    model, _ = module.load(folder / "corrected.xml")
    start = START if model.nq == 3 else ([START[0][0]], [START[1][0]])
    ctrl, time = recording.ctrl[:rows], recording.time[:rows]
    return module.rollout(model, *(np.array([x]) for x in start), ctrl[None], time)[0][0]


@pytest.mark.parametrize("kind", ["motors", "servos", "rk4"])
def test_the_script_is_the_simulator(tmp_path, kind):
    """Every law, inside and beyond its knots, to the rounding of the solver."""
    world, _ = arm(kind)
    recording, named = record(world), []
    for candidate in world.candidates:
        if candidate.effect.name in OF_DRIVES:
            named.append({candidate: SIZES[candidate.effect.name]})
    named.append({world.candidate("delay", "bend"): (0.0007,)})  # less than a step
    if kind == "rk4":
        named.append({world.candidate("lag", "bend"): (0.0012,)})
    settings = named + (curves(world) if kind != "rk4" else [])
    nominal = simulate(world, [{}], recording, ROWS)[0]
    for setting, expected in zip(settings, simulate(world, settings, recording, ROWS)):
        parts, written = script_of(tmp_path, world, setting)
        assert set(written.values()) == {"python"} and parts
        qpos = in_script(tmp_path, parts, recording)
        np.testing.assert_allclose(qpos, expected, rtol=0, atol=1e-9, err_msg=str(parts))
        assert abs(expected - nominal).max() > 1e-5, parts


def test_several_at_once_and_beside_what_mjcf_holds(tmp_path):
    world, _ = arm("motors")
    recording = record(world)
    places = {
        "load_friction": "elbow",
        "friction_map": "swing",
        "dead_zone": "bend",
        "delay": "bend",
        "gain": "bend",
        "mass": "fore",
        "coulomb_friction": "elbow",
    }
    setting = {world.candidate(name, place): SIZES[name] for name, place in places.items()}
    setting |= curves(world)[0]
    setting[world.candidate("delay", "bend")] = (0.006,)  # whole steps: as load friction sees it
    parts, written = script_of(tmp_path, world, setting)
    assert sorted(p.law for p in parts) == ["curve", "dead_zone", "friction_wave", "load_friction"]
    assert {c.effect.name for c, form in written.items() if form == "mjcf"} == {
        "delay",
        "gain",
        "mass",
        "coulomb_friction",
    }
    expected = simulate(world, [setting], recording, ROWS)[0]
    qpos = in_script(tmp_path, parts, recording)
    np.testing.assert_allclose(qpos, expected, rtol=0, atol=1e-9)


def test_a_delay_of_less_than_a_step_beside_a_dead_zone(tmp_path):
    """What comes late is what the dead zone left."""
    world, _ = arm("motors")
    recording = record(world)
    setting = {world.candidate("dead_zone", "bend"): (0.4,)}
    setting[world.candidate("delay", "bend")] = (0.0013,)
    parts, written = script_of(tmp_path, world, setting)
    assert [part.law for part in parts] == ["dead_zone", "delay"]
    expected = simulate(world, [setting], recording, ROWS)[0]
    qpos = in_script(tmp_path, parts, recording)
    np.testing.assert_allclose(qpos, expected, rtol=0, atol=1e-9)
    whole = {world.candidate("delay", "bend"): (0.002,)}
    assert set(world.corrected_xml(whole)[1].values()) == {"mjcf"}


@pytest.mark.parametrize("effect", WEAKER)
def test_a_drive_that_fades_stays_within_the_joints_range(tmp_path, effect):
    """Simulated, and by the script: as stock MuJoCo moves by a motor that gives what is left."""
    world, (values, weaker) = tight(), WEAKER[effect]
    recording = commanded(np.arange(ROWS) * DT, np.full((ROWS, 1), 0.5))
    model, expected = pendulum().model, []
    data = mujoco.MjData(model)
    data.qpos[0], data.qvel[0] = START[0][0], START[1][0]
    for _ in range(ROWS):
        expected.append(data.qpos.copy())
        for _ in range(round(DT / model.opt.timestep)):
            left = weaker(50 * (0.5 - data.qpos[0]), data.qvel[0], data.time)
            data.ctrl[0] = np.clip(left, -1, 1)
            mujoco.mj_step(model, data)
    setting, window = {world.candidate(effect, "m"): values}, Window(recording, 0, ROWS - 1)
    parts, _ = script_of(tmp_path, world, setting)
    script = in_script(tmp_path, parts, recording)
    (qpos,) = world.simulate([setting], [START[0][:1]], [START[1][:1]], [window])[0]
    (nominal,) = world.simulate([{}], [START[0][:1]], [START[1][:1]], [window])[0]
    assert abs(nominal - expected).max() > 1e-3
    np.testing.assert_allclose(qpos, expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(script, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("more", [{}, {("delay", "m"): (0.0131,)}])
@pytest.mark.parametrize("factor", [None, "control:m"])
def test_a_force_over_a_late_control_is_late_once(tmp_path, more, factor):
    """By the nominal model's delay, of whole steps, or by one that is written, of parts of one."""
    world, _ = driven_by('<motor name="m" joint="j" delay="0.0095" nsample="12"/>')
    curve = world.curve("j", "position:j" if factor else "control:m", (-1.0, 0.0, 1.0), factor)
    setting = {curve: CURVE} | {world.candidate(*c): v for c, v in more.items()}
    ctrl = np.random.default_rng(0).uniform(-1, 1, (ROWS, 1))
    window = Window(commanded(DT * np.arange(ROWS), ctrl), 0, ROWS - 1)
    (expected,) = world.simulate([setting], [START[0][:1]], [START[1][:1]], [window])[0]
    parts, _ = script_of(tmp_path, world, setting)
    script = in_script(tmp_path, parts, window.recording)
    np.testing.assert_allclose(script, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("actearly", ["false", "true"])
@pytest.mark.parametrize("factor", [None, "control:m"])
def test_a_force_over_a_drive_with_a_filter_of_its_own_is_of_what_is_sent(
    tmp_path, actearly, factor
):
    """What the simulator fitted it over; only `lag` comes before it."""
    world, _ = driven_by(FILTER.replace("/>", f' actearly="{actearly}"/>'))
    curve = world.curve("j", "position:j" if factor else "control:m", (-1.0, 0.0, 1.0), factor)
    ctrl = np.random.default_rng(0).uniform(-1, 1, (ROWS, 1))
    window, setting = Window(commanded(DT * np.arange(ROWS), ctrl), 0, ROWS - 1), {curve: CURVE}
    (expected,) = world.simulate([setting], [START[0][:1]], [START[1][:1]], [window])[0]
    parts, _ = script_of(tmp_path, world, setting)
    script = in_script(tmp_path, parts, window.recording)
    np.testing.assert_allclose(script, expected, rtol=0, atol=1e-9)
    model = world.model
    batch, data = CorrectedBatch(model, 1, 1, parts=parts), mujoco.MjData(model)
    batch.bind("ctrl")[:] = data.ctrl[:] = 1.0
    batch.step(nstep=20)
    module_of(parts, ["j"]).step(model, data, 20)
    np.testing.assert_allclose(batch.bind("qpos")[0], data.qpos, rtol=0, atol=1e-12)


def test_stamps_since_1970_keep_the_clock_and_the_delays(tmp_path):
    """Of a tone of 5 Hz and of controls late by exactly a row, with rows of 10 ms to a µs."""
    world, _ = driven_by('<motor name="m" joint="j" delay="0.01" nsample="12"/>')
    rng, time = np.random.default_rng(0), 0.01 * np.arange(1000)
    plain = commanded(time, 0.2 * rng.choice([-1.0, 1.0], (1000, 1)))
    stamped = replace(plain, time=1.7e9 + time + rng.uniform(-5e-7, 5e-7, 1000))
    setting = {world.curve("j", "time", (0.0, 0.05), wave=True): (1.0, 0.0)}
    parts, _ = script_of(tmp_path, world, setting)
    expected, found = (in_script(tmp_path, parts, r, 1000) for r in (plain, stamped))
    np.testing.assert_allclose(found, expected, rtol=0, atol=5e-4)


@pytest.mark.parametrize("kind", ["motors", "servos"])
def test_what_depends_on_the_true_position_does_so_where_its_sensor_is_off(tmp_path, kind):
    """Of a friction map of ten waves a radian 0.3 rad is half a wave; knots move along too."""
    world, _ = arm(kind)
    recording, make = record(world), world.curve
    some = [
        {world.candidate("friction_map", "elbow"): (0.15, 0.8, 10.0, 0.4)},
        {friction_curve(world.model, "elbow", (-0.4, -0.3, 0.1)): (0.3, 0.0, 0.2)},
        {make("swing", "position:elbow", (-0.4, -0.3, 0.1)): (0.3, -0.3, 0.2)},
        {make("elbow", "position:elbow", (0.0, 0.1), "speed:swing", wave=True): (0.3, 0.2)},
    ]
    bias = world.candidate("sensor_bias", "elbow")
    settings = [{**setting, bias: (0.3,)} for setting in some]
    plain = simulate(world, [{bias: (0.3,)}], recording, ROWS)[0]
    for setting, expected in zip(settings, simulate(world, settings, recording, ROWS)):
        parts, written = script_of(tmp_path, world, setting)
        assert parts and written[bias] == "mjcf"
        qpos = in_script(tmp_path, parts, recording)
        np.testing.assert_allclose(qpos, expected, rtol=0, atol=1e-9, err_msg=str(parts))
        assert abs(expected - plain).max() > 1e-3, parts


def test_a_curve_that_mjcf_holds_is_of_the_true_position_too(tmp_path):
    """k (q - 0.2) in two knots, of a joint that reads 0.3 rad too much."""
    world, _ = arm("motors")
    curve = world.curve("elbow", "position:elbow", (-0.8, 1.2))
    setting = {curve: (0.5, -0.5), world.candidate("sensor_bias", "elbow"): (0.3,)}
    recording = record(world)
    parts, written = script_of(tmp_path, world, setting)
    assert not parts and written[curve] == "mjcf"
    expected = simulate(world, [setting], recording, ROWS)[0]
    qpos = in_script(tmp_path, parts, recording)
    np.testing.assert_allclose(qpos, expected, rtol=0, atol=0.01)  # 0.16 beside it


def test_a_setting_that_mjcf_holds_needs_no_script():
    world, _ = arm("motors")
    setting = {world.candidate("coulomb_friction", "elbow"): (0.1,)}
    written = world.corrected_xml(setting)[1]
    assert "python" not in written.values() and python_parts(world.model, setting, written) == []
    assert python_parts(world.model, setting) == []


def test_predictions_of_windows_in_a_process_of_its_own(tmp_path):
    """Windows inside a run go on where it was: delayed controls, ramps, bristles that nothing
    recorded."""
    world, _ = arm("motors")
    recording = record(world)
    setting = {
        world.candidate("load_friction", "elbow"): SIZES["load_friction"],
        world.candidate("rate_limit", "bend"): (4.0,),
        world.candidate("presliding", "swing"): (0.15, 3.0),
    }
    script_of(tmp_path, world, setting)
    start = [x[None] for x in START]
    q, v = (x[0] for x in world.simulate([setting], *start, [Window(recording, 0, T - 1)]))
    run = replace(recording, qpos=q, qvel=v)
    windows = [Window(run, 0, 12), Window(run, 30, T - 1), Window(run, 20, 25)]
    rows = predictions(tmp_path / "corrected.py", windows, world.model)
    for window, qpos in zip(windows, rows):
        expected = q[window.first : window.last + 1]
        assert qpos.shape == expected.shape
        np.testing.assert_allclose(qpos, expected, rtol=0, atol=2e-5)
    np.testing.assert_allclose(rows[0], q[:13], rtol=0, atol=1e-9)
    unmeasured = replace(run, qvel=np.full_like(v, np.nan))
    (rough,) = predictions(tmp_path / "corrected.py", [Window(unmeasured, 20, 25)], world.model)
    assert 0 < abs(rough - q[20:26]).max() < 0.1


@pytest.mark.parametrize(
    "actuator, effect, values",
    [
        (INTEGRATOR, ("friction_map", "j"), (0.01, 0.8, 5.0, 0.4)),
        ('<motor name="m" joint="j"/>', ("rate_limit", "m"), (0.2,)),
    ],
)
def test_what_drives_remember_a_tail_knows(tmp_path, actuator, effect, values):
    """An integral, and a control that follows for longer than joints are left to themselves."""
    world, _ = driven_by(actuator)
    time = 0.01 * np.arange(150)
    recording = commanded(time, np.where(time < 0.2, 1.0, np.where(time < 1.2, -0.3, 0.1))[:, None])
    setting = {world.candidate(*effect): values}
    script_of(tmp_path, world, setting)
    whole = Window(recording, 0, 149)
    q, v = (x[0] for x in world.simulate([setting], [[0.0]], [[0.0]], [whole]))
    qpos = q.copy()
    qpos[:100:2] = np.nan
    tail = Window(replace(recording, qpos=qpos, qvel=v), 105, 149)
    (found,) = predictions(tmp_path / "corrected.py", [tail], world.model)
    np.testing.assert_allclose(found, q[105:], rtol=0, atol=1e-9)


def test_the_script_stands_alone(tmp_path):
    """It imports numpy and mujoco, runs with neither our package nor its folder on the path, and
    is short."""
    world = pendulum()
    setting = {world.candidate("load_friction", "j"): (0.2, 0.3, 1.0)}
    xml, written = world.corrected_xml(setting)
    text = corrected_py(python_parts(world.model, setting, written), ["j"])
    for absent in ("diagnosis", "gain_fade", "def asked"):
        assert absent not in text
    assert max(map(len, text.splitlines())) <= 100
    (tmp_path / "corrected.xml").write_text(xml)
    (tmp_path / "corrected.py").write_text(text)
    code = """import sys; sys.path.insert(0, '.'); import corrected as c
m, d = c.load(); d.ctrl[:] = 1.0; c.step(m, d, 50); print(float(d.qpos[0]))"""
    done = subprocess.run(
        [sys.executable, "-I", "-c", code], capture_output=True, text=True, cwd=tmp_path, check=True
    )
    time = 0.001 * np.arange(51)
    run = commanded(time, np.ones((51, 1)))
    qpos = world.simulate([setting], [[0.0]], [[0.0]], [Window(run, 0, 50)])[0]
    assert float(done.stdout) == pytest.approx(qpos[0, -1, 0], abs=1e-9)


def test_as_a_callback(tmp_path):
    """In mj_step itself, and with the controls that were asked for left to the caller's next
    ones."""
    world, _ = arm("servos")
    recording = record(world)
    places = {"load_friction": "elbow", "dead_zone": "bend", "friction_map": "swing"}
    setting = {world.candidate(name, place): SIZES[name] for name, place in places.items()}
    parts, _ = script_of(tmp_path, world, setting)
    module = module_of(parts, JOINTS)
    model, data = module.load(tmp_path / "corrected.xml")
    module.install(model)
    try:
        data.qpos[:], data.qvel[:] = START
        out = [data.qpos.copy()]
        for u in recording.ctrl[:-1]:
            data.ctrl[:] = u
            mujoco.mj_step(model, data, round(DT / model.opt.timestep))
            out.append(data.qpos.copy())
    finally:
        mujoco.set_mjcb_control(None)
    expected = simulate(world, [setting], recording)[0]
    np.testing.assert_allclose(out, expected, rtol=0, atol=1e-7)


def test_a_ramp_within_a_callback_begins_anew_with_each_run():
    module = module_of([Part("rate_limit", "m", {"rate": 2.0})], ["j"])
    model = pendulum().model
    data = mujoco.MjData(model)
    for _ in range(2):
        mujoco.mj_resetData(model, data)
        data.ctrl[0] = 0.0
        module.step(model, data)
        data.ctrl[0] = 1.0
        module.step(model, data, 100)
        look = module.Look(model, data)
        seen = module.controls(model, look, data.ctrl, module.MEMORY[id(data)])
        assert seen[0] == pytest.approx(2.0 * 0.1005, abs=1e-9)  # its mean over the next step
        assert data.ctrl[0] == 1.0


@pytest.mark.parametrize("late", [False, True])
def test_many_environments_at_once(late):
    """Each simulation of a batch for training moves as the simulator predicts, with delays too."""
    world, _ = arm("motors")
    recording = record(world)
    places = {"load_friction": "elbow", "dead_zone": "bend", "torque_speed": "push"}
    setting = {world.candidate(name, place): SIZES[name] for name, place in places.items()}
    if late:
        setting[world.candidate("delay", "bend")] = (0.006,)
    xml, written = world.corrected_xml(setting)
    text = corrected_py(python_parts(world.model, setting, written), JOINTS)
    batch = CorrectedBatch(mujoco.MjModel.from_xml_string(xml), 3, 1, parts=parts_in(text))
    qpos, qvel, ctrl = (batch.bind(name) for name in ("qpos", "qvel", "ctrl"))
    expected = simulate(world, [setting], recording)[0]
    model, data = batch.model, mujoco.MjData(batch.model)
    count, step = round(DT / model.opt.timestep), module_of(parts_in(text)).step
    qpos[:], qvel[:] = data.qpos[:], data.qvel[:] = START
    qpos[1] += 0.01
    for row, u in enumerate(recording.ctrl[:-1]):
        ctrl[:] = data.ctrl[:] = u
        batch.step(nstep=count)
        step(model, data, count)
        np.testing.assert_array_equal(ctrl, np.tile(u, (3, 1)))
        # MuJoCo's history begins with zeros, the simulator's at rest in the first control
        there = data.qpos if late else expected[row + 1]
        np.testing.assert_allclose(qpos[[0, 2]], np.tile(there, (2, 1)), rtol=0, atol=1e-8)
    assert abs(qpos[1] - qpos[0]).max() > 1e-4


def test_a_batch_without_parts_is_mujocos():
    world, _ = arm("motors")
    batches = [CorrectedBatch(world.model, 2, 1), Batch(world.model, 2, 1)]
    for batch in batches:
        batch.bind("qvel")[:] = START[1]
        batch.step(nstep=20)
    np.testing.assert_array_equal(*(batch.state for batch in batches))
    assert parts_in("") == []
    with pytest.raises(ScriptError, match="no PARTS"):
        parts_in("import os")


def test_a_force_over_a_control_that_comes_late_is_refused_in_a_batch():
    world, _ = arm("motors")
    curve = world.curve("elbow", "control:bend", (-1.0, 1.0))
    setting = {curve: (0.1, 0.2), world.candidate("delay", "bend"): (0.01,)}
    xml, written = world.corrected_xml(setting)
    parts = python_parts(world.model, setting, written)
    batch = CorrectedBatch(mujoco.MjModel.from_xml_string(xml), 1, 1, parts=parts)
    with pytest.raises(ValueError, match="bend: a batch does not tell its delayed control"):
        batch.step()


@settings(max_examples=30, deadline=None)
@given(st.text(max_size=12), st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=4))
def test_names_and_numbers_come_back_from_the_text_as_they_were(name, forces):
    """Whatever a joint is called: its name is text in the script, never code."""
    knots = [float(k) for k in range(len(forces))]
    numbers = {"of": f"position:{name}", "knots": knots, "forces": forces, "factor": None}
    parts = [Part("curve", name, numbers)]
    text = corrected_py(parts, [name], xml_name=f"{name}.xml")
    assert parts_in(text) == parts
    tree = ast.parse(text)
    assigned = {t.id for n in tree.body if isinstance(n, ast.Assign) for t in n.targets}
    assert "PARTS" in assigned and len(tree.body) == len(ast.parse(PLAIN).body)


PLAIN = corrected_py([Part("curve", "j", {})], ["j"])


def test_a_script_that_does_not_run_is_one_line(tmp_path):
    world = pendulum()
    window = Window(commanded(np.arange(3) * 0.01, np.zeros((3, 1))), 0, 2)
    (tmp_path / "corrected.py").write_text(corrected_py([], ["j"]))  # no corrected.xml beside it
    with pytest.raises(ScriptError, match="does not run") as error:
        predictions(tmp_path / "corrected.py", [window], world.model)
    assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match="no law 'magic'"):
        corrected_py([Part("magic", "j", {})], ["j"])
