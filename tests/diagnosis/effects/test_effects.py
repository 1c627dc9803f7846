"""Effects: what a batch simulates is what stock MuJoCo makes of corrected.xml, and nothing at
zero size."""

import itertools
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from plants import MODELS, SIZES, START, arm, commanded, pendulum, record, simulate, stock

from diagnosis.effects import EFFECTS
from diagnosis.effects.unmodelled import asked, holds
from diagnosis.simulation.corrected_py import module_of, python_parts
from diagnosis.simulation.simulator import Case, Window, World


@pytest.fixture(scope="module", params=MODELS)
def case(request):
    world, xml = arm(request.param)
    return world, xml, record(world)


def test_the_contracts_effects_are_all_there():
    assert {effect.name for effect in EFFECTS} == set(SIZES)
    here = {c.effect.name for kind in MODELS for c in arm(kind)[0].candidates}
    assert here == set(SIZES)


def test_nothing_is_exactly_nominal(case):
    world, xml, recording = case
    expected = stock(xml, world, recording, *START)
    assert np.ptp(expected, axis=0).min() > 0.02
    for qpos in simulate(world, [{}] + [{c: c.nominal} for c in world.candidates], recording):
        np.testing.assert_allclose(qpos, expected, rtol=0, atol=1e-12)


def test_zero_size_is_the_limit_of_small_sizes(case):
    """What is left out at its nominal value is also what a vanishing effect tends to: no jump
    there."""
    world, xml, recording = case
    expected = stock(xml, world, recording, *START)[:20]
    for candidate in world.candidates:
        if (
            candidate.effect.name in ("backlash", "time_step")
            or not np.isfinite(candidate.nominal).all()
        ):
            continue  # the motor's inertia, the number of steps, limits that begin at infinity
        values = tuple(p.nominal + 1e-6 * p.step for p in candidate.parameters)
        (qpos,) = simulate(world, [{candidate: values}], recording, 20)
        assert abs(qpos - expected).max() < 2e-6, candidate


def test_every_effect_is_the_same_in_mjcf(case):
    world, xml, recording = case
    predicted = simulate(
        world, [{}] + [{c: SIZES[c.effect.name]} for c in world.candidates], recording
    )
    felt = set()
    for candidate, qpos in zip(world.candidates, predicted[1:]):
        corrected, written = world.corrected_xml({candidate: SIZES[candidate.effect.name]})
        assert np.isfinite(qpos).all(), candidate
        if candidate.place.kind != "sensor" and abs(qpos - predicted[0]).max() > 1e-3:
            felt.add(candidate.effect.name)
        if written[candidate] == "mjcf":
            # Runge-Kutta reads delays and lags at its stages, here they are averaged over the step
            close = 3e-4 if candidate.effect.name in ("delay", "lag") else 1e-9
            np.testing.assert_allclose(
                stock(corrected, world, recording, *START),
                qpos,
                rtol=0,
                atol=close,
                err_msg=repr(candidate),
            )
    contact = {
        "contact_friction",
        "contact_stiffness",
        "contact_damping",
        "ground_height",
    }  # the servos hold the arm off the floor
    assert felt | contact == {c.effect.name for c in world.candidates} | contact


def test_all_effects_together_are_the_same_in_mjcf(case):
    """One setting of many effects: each is written beside the others."""
    world, xml, recording = case
    places = {"elbow", "bend", "fore", "world", "tip"}
    leave = {
        "stribeck_friction",
        "dead_zone",
        "sensor_scale",
        "sensor_delay",
        "payload_change",
        "time_step",
        "backlash",
        "delay",
        "lag",
        "joint_stop",
        "load_friction",
        "friction_map",
        "rate_limit",
        "torque_speed",
        "gain_fade",
    }
    setting = {
        c: SIZES[c.effect.name]
        for c in world.candidates
        if c.place.name in places and c.effect.name not in leave
    }
    assert len(setting) > 20
    corrected, written = world.corrected_xml(setting)
    assert set(written.values()) == {"mjcf"}
    (qpos,) = simulate(world, [setting], recording, 20)
    np.testing.assert_allclose(
        stock(corrected, world, recording, *START, 20), qpos, rtol=0, atol=1e-9
    )


@pytest.mark.parametrize(
    "kind, effect, place, values",
    [
        ("euler", "delay", "bend", (0.0015,)),
        ("rk4", "delay", "bend", (0.0015,)),
        ("rk4", "lag", "bend", (0.0008,)),
        ("motors", "stribeck_friction", "elbow", (0.1, 0.2, 0.3)),
    ],
)
def test_what_is_written_by_the_time_step_is_by_the_corrected_one(kind, effect, place, values):
    """Beside a finer time step an effect is written as into a model that had it from the
    beginning, and a method that is implicit in the speeds of drives."""
    world, xml = arm(kind)
    finer = xml.replace('timestep="0.002"', 'timestep="0.001"').replace("Euler", "implicitfast")
    fine = World(mujoco.MjSpec.from_string(finer))
    together = {
        world.candidate(effect, place): values,
        world.candidate("time_step", "world"): (0.001,),
    }
    alone = {fine.candidate(effect, place): values}
    assert (
        world.corrected_xml(together)[0]
        == fine.corrected_xml(alone)[0]
        != world.corrected_xml({})[0]
    )


@pytest.mark.parametrize("coulomb, static, velocity", [(0.1, 0.2, 0.3), (0.02, 0.2, 0.05)])
def test_stribeck_friction_by_hand(coulomb, static, velocity):
    """The law at a fine step, through reversals and sticking; in corrected.py it is the same."""
    world = pendulum()
    time = np.arange(100) * 0.01
    recording = commanded(time, (0.5 * np.sin(6 * time) + 0.3 * np.sin(14 * time + 1))[:, None])
    candidate = world.candidate("stribeck_friction", "j")
    setting = {candidate: (coulomb, static, velocity)}
    qpos, _ = world.simulate(
        [setting, {}], [[0.0]] * 2, [[1.0]] * 2, [Window(recording, 0, 99)] * 2
    )
    by_hand, q, v, h = [0.0], 0.0, 1.0, 1e-5
    for t in range(99):
        for _ in range(1000):
            free = v + h / 0.025 * (recording.ctrl[t, 0] - 0.5 * 9.81 * 0.1 * np.sin(q))
            stop = h / 0.025 * (coulomb + (static - coulomb) * np.exp(-((v / velocity) ** 2)))
            v = np.sign(free) * max(abs(free) - stop, 0.0)
            q += h * v
        by_hand.append(q)
    assert abs(qpos[1, :, 0] - by_hand).max() > 0.1
    assert abs(qpos[0, :, 0] - by_hand).max() < 5e-3
    xml, written = world.corrected_xml(setting)
    assert written == {candidate: "python"}
    model, script = (
        mujoco.MjModel.from_xml_string(xml),
        module_of(python_parts(world.model, setting, written)),
    )
    (there,), _ = script.rollout(model, [[0.0]], [[1.0]], recording.ctrl[None], time)
    np.testing.assert_allclose(there, qpos[0], rtol=0, atol=1e-9)


def test_stribeck_friction_that_does_not_fall_is_coulomb_friction():
    world = pendulum()
    stribeck, friction = (
        world.candidate("stribeck_friction", "j"),
        world.candidate("coulomb_friction", "j"),
    )
    for static in (0.1, 0.08):  # below coulomb, as a fit may have it: still a model that runs
        xml, written = world.corrected_xml({stribeck: (0.1, static, 0.3)})
        model = mujoco.MjModel.from_xml_string(xml)
        data = mujoco.MjData(model)
        data.qvel[0] = 1.0
        mujoco.mj_step(model, data, 300)
        assert (
            written == {stribeck: "mjcf"}
            and np.isfinite(data.qpos).all()
            and abs(data.qvel[0]) < 1.0
        )
    xml = [
        world.corrected_xml({c: v})[0] for c, v in ((stribeck, (0.1, 0.1, 0.3)), (friction, (0.1,)))
    ]
    assert xml[0] == xml[1]


def test_coulomb_friction_holds():
    """Below its limit the joint stands still: no creep, unlike MuJoCo's default friction."""
    world = pendulum()
    recording = commanded(np.array([0.0, 1.0]), np.full((2, 1), 0.09))
    setting = {world.candidate("coulomb_friction", "j"): (0.12,)}
    qpos, _ = world.simulate([setting], [[0.0]], [[0.0]], [Window(recording, 0, 1)])
    assert abs(qpos[0, 1, 0]) < 2e-4


def test_unknown_curves():
    """A curve through damping's values is damping, in simulation and in MJCF; a wiggle has no
    MJCF form."""
    world = pendulum()
    time = np.arange(60) * 0.01
    recording = commanded(time, 0.5 * np.sin(9 * time)[:, None])
    knots = np.linspace(-6, 6, 25)
    curve, damping = world.curve("j", "velocity:j", knots), world.candidate("viscous_damping", "j")
    spring = world.curve("j", "position:j", np.linspace(-1, 2, 61))
    follow = world.curve("j", "control:m", (-1.0, 1.0))
    drift = world.curve("j", "time", (0.0, 1.0))
    bent = tuple(0.3 - 0.5 * (x - 0.1 * x**2 + 0.2 * x**3) for x in np.linspace(-1, 2, 61))
    settings_ = [
        {curve: tuple(-0.1 * knots)},
        {damping: (0.1,)},
        {follow: (-0.3, 0.3)},
        {world.candidate("gain", "m"): (1.3,)},
        {drift: (0.2, 0.2)},
        {world.candidate("spring_offset", "j"): (0.2,)},
        {spring: bent},
    ]
    qpos, _ = world.simulate(settings_, [[0.3]] * 7, [[0.5]] * 7, [Window(recording, 0, 59)] * 7)
    np.testing.assert_allclose(
        qpos[0], qpos[1], atol=2e-3
    )  # the curve is explicit, damping implicit
    np.testing.assert_allclose(qpos[2], qpos[3], atol=1e-12)
    np.testing.assert_allclose(qpos[4], qpos[5], atol=1e-12)
    for k, candidate in ((0, curve), (6, spring)):
        xml, written = world.corrected_xml(settings_[k])
        assert written == {candidate: "mjcf"}
        np.testing.assert_allclose(
            stock(xml, world, recording, [0.3], [0.5], 60), qpos[k], atol=2e-3
        )
    assert world.corrected_xml({curve: tuple(np.sin(3 * knots))})[1] == {curve: "python"}
    assert (
        curve
        == world.curve("j", "velocity:j", list(knots))
        != world.curve("j", "velocity:j", knots + 1)
    )


@pytest.mark.parametrize(
    "knots, forces",
    [
        ((-1.0, -0.5, 0.0, 0.5, 1.0), (0.5, -0.4, 0.3, -0.4, 0.5)),  # on a quartic: wiggles
        (
            (-1.0, -0.3, 0.2, 0.6, 1.0),
            (-1.0, -0.3, 0.2, 0.6, 1.0),
        ),  # pushes away, the farther the more
        ((-1.0, 0.0, 0.3, 0.35, 1.0), (0.1, 0.1, 0.1, -0.2, -0.2)),  # a step between two knots
        ((-0.32, 0.11, 0.42, 0.54), (0.3, 0.9, 0.4, -0.3)),  # a cubic is right at its knots only
    ],
)
def test_a_polynomial_that_runs_away_is_not_written(knots, forces):
    """At the knots a cubic may be near: what counts is the curve between them, and beyond."""
    world = pendulum()
    for variable in ("position:j", "velocity:j"):
        curve = world.curve("j", variable, knots)
        assert world.corrected_xml({curve: forces})[1] == {curve: "python"}
    (part,) = python_parts(world.model, {curve: forces})
    assert part.numbers["knots"] == list(knots) and part.numbers["forces"] == list(forces)


def test_a_polynomial_may_not_grow_beyond_its_knots():
    """Half the travel further it is at most three times as large, and far away it pushes back."""
    x = np.linspace(-1, 1, 41)
    for force, good in (
        (lambda x: -x, True),
        (lambda x: -(x**3), False),  # 3.4 times at 1.5
        (lambda x: -0.6 * x - 0.4 * x**3, True),
        (lambda x: 0.1 * x, False),
        (lambda x: 0.3 - x**2, False),
        (lambda x: 0.0 * x + 0.2, True),
    ):
        assert holds(force, x, force(x), 0.0) == good
        assert not holds(lambda x: force(x) + 0.2, x, force(x), 0.0)


def test_what_is_written_of_a_curve_stays_near_it():
    """Between the knots and half the travel beyond: in stock MuJoCo, by the joint's own force."""
    world, knots = pendulum(), np.linspace(-0.8, 1.2, 5)
    for variable in ("position", "velocity"):
        values = tuple(0.2 - 0.3 * knots - 0.1 * knots**3)
        curve = world.curve("j", f"{variable}:j", knots)
        xml, written = world.corrected_xml({curve: values})
        assert written == {curve: "mjcf"}
        models = [mujoco.MjModel.from_xml_string(x) for x in (xml, world.corrected_xml({})[0])]
        for x in np.linspace(-1.3, 1.7, 31):
            forces = []
            for model in models:
                data = mujoco.MjData(model)
                data.qpos[0], data.qvel[0] = (x, 0.0) if variable == "position" else (0.0, x)
                mujoco.mj_forward(model, data)
                forces.append(data.qfrc_smooth[0])
            flat = np.interp(x, knots, values)
            inside = knots[0] <= x <= knots[-1]
            assert abs(forces[0] - forces[1] - flat) < (0.06 if inside else 0.6)


def test_inertias_that_were_seen_are_written_as_they_are():
    """The triangle inequality moves what did not show; where all did and none is a body's, nothing
    is written."""
    world = World(mujoco.MjSpec.from_string(BODY))
    candidate = world.candidate("inertia", "b")
    effect, nominal = candidate.effect, candidate.nominal
    for seen, x in itertools.product(range(3), (0.2, 0.7, 1.6, 5.0)):
        values = list(nominal)
        values[seen] *= x
        xml, written = world.corrected_xml({candidate: tuple(values)})
        there = mujoco.MjModel.from_xml_string(xml).body("b").inertia
        assert written == {candidate: "mjcf"} and there[seen] == values[seen]
        assert 2 * there.max() <= there.sum() * (1 + 1e-9)
    both = (0.4 * nominal[0], 3 * nominal[1], nominal[2])  # two seen, the third follows
    there = mujoco.MjModel.from_xml_string(world.corrected_xml({candidate: both})[0]).body("b")
    np.testing.assert_array_equal(there.inertia[:2], both[:2])
    none = (0.9 * nominal[0], 0.9 * nominal[1], 5 * nominal[2])
    xml, written = world.corrected_xml({candidate: none})
    assert written == {candidate: "none"} and not effect.possible(none, nominal)
    np.testing.assert_allclose(mujoco.MjModel.from_xml_string(xml).body("b").inertia, nominal)


BODY = """<mujoco><worldbody><body name="b"><joint name="j" axis="0 1 0"/>
<inertial pos="0 0 -.1" mass=".5" diaginertia=".002 .003 .0035"/></body></worldbody></mujoco>"""


def test_motors_with_dead_zones_run_in_one_go():
    """Only a servo's is a force that depends on the state, to be worked out step by step."""
    for kind, stepwise in (("motors", False), ("servos", True)):
        world, _ = arm(kind)
        setting = {world.candidate("dead_zone", "bend"): (0.4,)}
        assert Case(world.model, setting, 1).stepwise == stepwise


def test_what_actuators_are_asked_is_their_force_over_their_gain():
    for kind in ("motors", "servos"):
        model = arm(kind)[0].model
        data, rng = mujoco.MjData(model), np.random.default_rng(0)
        for _ in range(5):
            data.qpos, data.qvel, data.ctrl = (
                rng.normal(size=model.nq),
                rng.normal(size=model.nv),
                rng.uniform(-0.1, 0.1, model.nu),
            )
            model.actuator_forcelimited[:] = 0
            mujoco.mj_forward(model, data)
            for a in range(model.nu):
                assert asked([model], a, data.qpos, data.qvel, data.ctrl) * model.actuator_gainprm[
                    a, 0
                ] == pytest.approx(data.actuator_force[a])


def test_a_curve_times_what_a_servo_is_asked_for_is_the_same_beside_other_settings():
    """What it is asked for follows from the bias of its own setting."""
    world, _ = arm("servos")
    curve = world.curve("elbow", "time", (0.1, 0.3), "control:bend")
    bias, recording = world.candidate("bias", "bend"), record(world)
    settings = [{curve: (0.1, -0.2), **more} for more in ({}, {bias: (3.0,)}, {bias: (-1.0,)})]
    together = simulate(world, settings, recording)
    for setting, qpos in zip(settings, together):
        np.testing.assert_array_equal(simulate(world, [setting], recording)[0], qpos)
    assert abs(together[1] - together[0]).max() > 0.01


def test_probes_show_something(case):
    """Values to try first lie within the bounds and change the motion."""
    world, _, recording = case
    recording = replace(recording, qpos=simulate(world, [{}], recording)[0])
    for candidate in world.candidates:
        rows = np.array([*world.probes(candidate, [recording]), *world.far(candidate, [recording])])
        bounds = [(p.low, p.high) for p in candidate.parameters]
        low, high = np.array(bounds).T
        assert rows.ndim == 2 and rows.shape[1] == len(low) and len(rows), candidate
        assert (((rows >= low) & (rows <= high)) | np.isinf(rows)).all(), candidate
        assert not (rows == candidate.nominal).all(axis=1).any()


ROD = """<mujoco><compiler angle="radian"/><worldbody><body><joint name="x" axis="0 1 0"
  range="-1.2 1.5"/><geom size=".1" pos="0 0 .3"/></body>
  </worldbody><actuator><motor name="m" joint="x"/></actuator></mujoco>"""


@given(*[st.floats(-5, 5)] * 2, st.floats(1, 20))
def test_two_phases_of_a_ripple_make_one(sine, cosine, poles):
    q, rows = np.linspace(-2, 2, 101), [np.array([0.3, poles, phase]) for phase in (0.0, np.pi / 2)]
    effect = next(e for e in EFFECTS if e.name == "cogging")
    (amplitude, same, phase), amount = effect.merged(rows, (sine, cosine))
    both = 0.3 * (sine * np.sin(poles * q) + cosine * np.cos(poles * q))
    np.testing.assert_allclose(amount * amplitude * np.sin(same * q + phase), both, atol=1e-12)


@given(st.floats(0.1, 3.0), st.floats(0.0, 1.0), st.floats(0.0, 6.2))
def test_levels_of_a_friction_map_merge_into_one_wave(level, contrast, phase):
    effect = next(e for e in EFFECTS if e.name == "friction_map")
    rows = np.array([(0.2, 0.0, 5.0, 0.0), (0.2, 1.0, 5.0, 0.0), (0.2, 1.0, 5.0, np.pi / 2)])
    sine, cosine = (level * contrast * f(phase) for f in (np.cos, np.sin))
    amounts = np.array([level - sine - cosine, sine, cosine]) / 0.2
    (base, told, waves, turned), amount = effect.merged(rows, amounts)
    assert np.allclose((base * amount, told, waves), (level, contrast, 5.0), atol=1e-9)
    assert contrast < 1e-6 or abs(np.exp(1j * turned) - np.exp(1j * phase)) < 1e-6


def test_a_joint_at_its_stop_shows_its_sensors_fault():
    world = World(mujoco.MjSpec.from_string(ROD))
    fall = np.r_[np.linspace(0, 1.3, 60), 1.35, 1.3, np.full(40, 1.3)]
    recording = SimpleNamespace(qpos=fall[:, None], time=0.01 * np.arange(len(fall)))
    values = {
        name: world.far(world.candidate(name, "x"), [recording])
        for name in ("sensor_scale", "sensor_bias")
    }
    np.testing.assert_allclose(values["sensor_scale"], [(1.3 / 1.5,)], rtol=1e-3)
    np.testing.assert_allclose(values["sensor_bias"], [(1.3 - 1.5,)], rtol=1e-2)
    moving = SimpleNamespace(
        qpos=np.sin(np.arange(100) / 5)[:, None] * np.linspace(1.3, 0.2, 100)[:, None],
        time=recording.time[:100],
    )
    assert not world.far(world.candidate("sensor_bias", "x"), [moving])


def gym_model(name):
    return Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / f"{name}.xml"


@pytest.mark.parametrize(
    "name, body",
    [
        ("hopper", "torso"),
        ("half_cheetah", "torso"),
        ("inverted_pendulum", "pole"),
        ("walker2d", "foot"),
        ("ant", "torso"),
        ("humanoid", "pelvis"),
        ("swimmer", "mid"),
        ("reacher", "body1"),
    ],
)
def test_gymnasium_models_with_another_mass(tmp_path, name, body):
    """The traps of these files: inertiafromgeom, settotalmass, angles in degrees, six digits."""
    world = World.load(gym_model(name))
    nominal = mujoco.MjModel.from_xml_path(str(gym_model(name)))
    b, mass = nominal.body(body).id, nominal.body(body).mass[0] * 1.2345678901234
    (tmp_path / "corrected.xml").write_text(
        world.corrected_xml({world.candidate("mass", body): (mass,)})[0]
    )
    corrected = mujoco.MjModel.from_xml_path(str(tmp_path / "corrected.xml"))
    assert corrected.body(body).mass[0] == mass
    nominal.body_inertia[b] *= mass / nominal.body_mass[b]
    nominal.body_mass[b] = mass
    mujoco.mj_setConst(nominal, mujoco.MjData(nominal))
    data = [mujoco.MjData(m) for m in (nominal, corrected)]
    for model, d in zip((nominal, corrected), data):
        d.ctrl[:] = 0.3
        mujoco.mj_step(model, d, 40)
    np.testing.assert_allclose(data[0].qpos, data[1].qpos, rtol=0, atol=1e-9)
    for kind, count in (("joint", nominal.njnt), ("actuator", nominal.nu)):
        for i in range(count):
            before = getattr(nominal, kind)(i).name
            assert getattr(corrected, kind)(i).name == before or not before


def test_meshes_are_found_from_the_report(tmp_path):
    (tmp_path / "model" / "parts").mkdir(parents=True)
    (tmp_path / "report").mkdir()
    (tmp_path / "model" / "parts" / "tetra.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    (tmp_path / "model" / "rest.xml").write_text(
        '<mujoco><worldbody><body name="b"><joint/>'
        '<geom type="mesh" mesh="tetra"/></body></worldbody></mujoco>'
    )
    (tmp_path / "model" / "sim.xml").write_text(
        '<mujoco><compiler meshdir="parts"/><asset><mesh file="tetra.obj"/></asset>'
        '<include file="rest.xml"/></mujoco>'
    )
    world = World.load(tmp_path / "model" / "sim.xml")
    (tmp_path / "report" / "corrected.xml").write_text(
        world.corrected_xml({world.candidate("coulomb_friction", "0"): (0.5,)})[0]
    )
    assert (
        mujoco.MjModel.from_xml_path(str(tmp_path / "report" / "corrected.xml")).dof_frictionloss[0]
        == 0.5
    )
