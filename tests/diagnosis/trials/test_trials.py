"""Sealed trials: the hand-written physics against stock MuJoCo's fields, the seal, the scoring, small whole trials."""

import json
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from diagnosis.trials import command as prove
from diagnosis.trials import conceal, reference_error
from diagnosis.trials import page as proof_page
from diagnosis.trials.mechanisms import MECHANISMS, UNKNOWNS, Mechanism
from diagnosis.trials.true_system import Real

pytestmark = pytest.mark.filterwarnings("ignore:.*settotalmass")
HINGE = """<mujoco><option timestep="0.001" gravity="0 0 0"/><worldbody><body name="wheel">
  <joint name="axle" axis="0 1 0" armature="0.02"/><geom type="box" size="0.1 0.1 0.1" mass="3" contype="0" conaffinity="0"/>
  </body></worldbody><actuator><motor name="drive" joint="axle"/></actuator></mujoco>"""


def wheel():
    return Mechanism("wheel", {}, xml=HINGE)


def hide(effect, kind, name, **parameters):
    return {"effect": effect, "place": {"kind": kind, "name": name}, "parameters": parameters}


# the hand-written forces against MuJoCo's own fields


def rub(spec, joint, size):  # with constraint settings that creep little
    joint = spec.joint(joint)
    joint.frictionloss, joint.solref_friction = size, [0.004, 1]
    joint.solimp_friction = [0.999, 0.9999, 0.001, 0.5, 2]


def servo_gain(spec, ratio):
    actuator = spec.actuators[0]
    actuator.gainprm[0] *= ratio
    actuator.biasprm[:3] *= ratio


def affine(spec, index, term, change):
    spec.actuators[index].biastype = mujoco.mjtBias.mjBIAS_AFFINE
    spec.actuators[index].biasprm[term] += change


def late(spec, seconds):
    spec.actuators[1].delay, spec.actuators[1].nsample = seconds, 40


def lagging(spec, index, seconds):
    actuator = spec.actuators[index]
    actuator.dyntype, actuator.dynprm[0], actuator.actearly = (
        mujoco.mjtDyn.mjDYN_FILTEREXACT,
        seconds,
        1,
    )


def limits(spec, low, high):
    spec.joint("elbow").range, spec.joint("elbow").limited = np.rad2deg([low, high]), 1


def limit_force(spec, force):
    spec.actuators[1].forcerange, spec.actuators[1].forcelimited = [-force, force], 1


WORLD = ("world", "world")
FIELDS = [
    (
        "arm2",
        hide("viscous_damping", "joint", "elbow", damping=0.3),
        lambda s: setattr(s.joint("elbow"), "damping", [0.3, 0, 0]),
    ),
    (
        "arm2",
        hide("quadratic_damping", "joint", "elbow", damping2=0.1),
        lambda s: setattr(s.joint("elbow"), "damping", [0.05, 0.1, 0]),
    ),
    (
        "arm2",
        hide("coulomb_friction", "joint", "shoulder", frictionloss=0.5),
        lambda s: rub(s, "shoulder", 0.5),
    ),
    (
        "cart_pole",
        hide("coulomb_friction", "joint", "rail", frictionloss=1.5),
        lambda s: rub(s, "rail", 1.5),
    ),
    (
        "servo_arm",
        hide("coulomb_friction", "joint", "pitch", frictionloss=0.5),
        lambda s: rub(s, "pitch", 0.5),
    ),
    (
        "hopper",
        hide("coulomb_friction", "joint", "leg_joint", frictionloss=3.0),
        lambda s: rub(s, "leg_joint", 3.0),
    ),
    (
        "hopper",
        hide("viscous_damping", "joint", "leg_joint", damping=2.0),
        lambda s: setattr(s.joint("leg_joint"), "damping", [2, 0, 0]),
    ),
    (
        "inverted_pendulum",
        hide("viscous_damping", "joint", "slider", damping=10.0),
        lambda s: setattr(s.joint("slider"), "damping", [10, 0, 0]),
    ),
    (
        "pendulum",
        hide("stiffness", "joint", "pivot", stiffness=0.5),
        lambda s: setattr(s.joint("pivot"), "stiffness", [0.5, 0, 0]),
    ),
    (
        "half_cheetah",
        hide("stiffness", "joint", "bthigh", stiffness=300.0),
        lambda s: setattr(s.joint("bthigh"), "stiffness", [300, 0, 0]),
    ),
    (
        "arm2",
        hide("nonlinear_stiffness", "joint", "elbow", stiffness3=1.0),
        lambda s: setattr(s.joint("elbow"), "stiffness", [0, 0, 1]),
    ),
    (
        "arm2",
        hide("joint_stop", "joint", "elbow", low=-0.4, high=0.4, spring=60.0, damper=2.0),
        lambda s: limits(s, -0.4, 0.4),
    ),
    (
        "furuta",
        hide("gravity", *WORLD, x=0.5, y=0.3, z=-9.6),
        lambda s: setattr(s.option, "gravity", [0.5, 0.3, -9.6]),
    ),
    (
        "sail",
        hide("wind", *WORLD, x=2.0, y=0.3, z=0.0),
        lambda s: setattr(s.option, "wind", [2, 0.3, 0]),
    ),
    ("sail", hide("air_drag", *WORLD, density=4.0), lambda s: setattr(s.option, "density", 4.0)),
    ("ball", hide("air_drag", *WORLD, density=4.0), lambda s: setattr(s.option, "density", 4.0)),
    (
        "slider",
        hide("contact_friction", "geom", "block", sliding=0.3),
        lambda s: [setattr(geom, "friction", [0.3, 0.005, 0.0001]) for geom in s.geoms],
    ),
    ("servo_arm", hide("gain", "actuator", "yaw_servo", gain=0.8), lambda s: servo_gain(s, 0.8)),
    (
        "servo_arm",
        hide("saturation", "actuator", "pitch_servo", forcerange=2.0),
        lambda s: limit_force(s, 2.0),
    ),
    (
        "cart_pole",
        hide("back_emf", "actuator", "drive", damping=0.02),
        lambda s: affine(s, 0, 2, -0.02),
    ),
    (
        "gantry",
        hide("back_emf", "actuator", "trolley_servo", damping=10.0),
        lambda s: affine(s, 0, 2, -10.0),
    ),
    ("gantry", hide("bias", "actuator", "trolley_servo", bias=3.0), lambda s: affine(s, 0, 0, 3.0)),
    ("arm2", hide("delay", "actuator", "elbow_motor", seconds=0.02), lambda s: late(s, 0.02)),
    ("arm2", hide("lag", "actuator", "elbow_motor", seconds=0.03), lambda s: lagging(s, 1, 0.03)),
    (
        "servo_arm",
        hide("lag", "actuator", "yaw_servo", seconds=0.03),
        lambda s: lagging(s, 0, 0.03),
    ),
    (
        "arm2",
        hide("mass", "body", "fore", mass=0.8),
        lambda s: setattr(s.geom("fore"), "mass", 0.8),
    ),
    (
        "arm2",
        hide("link_length", "body", "fore", length=0.4),
        lambda s: setattr(s.body("fore"), "pos", [0, 0, -0.4]),
    ),
]


@pytest.mark.parametrize(
    "name,item,edit", FIELDS, ids=[f"{name}-{item['effect']}" for name, item, _ in FIELDS]
)
def test_hand_written_physics_moves_as_mujocos_field_does(name, item, edit):
    mechanism = MECHANISMS[name]
    nominal = mechanism.spec().compile()
    rng = np.random.default_rng(3)
    start, control = mechanism.start(rng, nominal), mechanism.controller(rng, nominal)
    spec = mechanism.spec()
    edit(spec)
    ctrl = []

    def roll(model, record=False):
        data, seen = mujoco.MjData(model), []
        data.qpos[:], data.qvel[:] = start
        for row in range(round(1.5 / mechanism.interval)):
            seen.append(data.qpos.copy())
            if record:
                ctrl.append(
                    control(row * mechanism.interval, data.qpos) if model.nu else np.zeros(0)
                )
            data.ctrl[:] = ctrl[row]
            mujoco.mj_step(model, data, round(mechanism.interval / model.opt.timestep))
        return np.array(seen)

    without, field = roll(nominal, record=True), roll(spec.compile())
    real, hand = Real(mechanism, [item]), []
    real.reset(*start)
    for u in ctrl:
        hand.append(real.seen()[0])
        real.advance(u, mechanism.interval)
    effect, difference = reference_error.rms(field - without), reference_error.rms(field - hand)
    loose = {"contact_friction": 0.05, "joint_stop": 0.02}  # MuJoCo's are soft, ours are not
    assert effect > 1e-3
    assert difference < loose.get(item["effect"], 0.002) * effect


def test_nothing_hidden_is_stock_mujoco():
    for name in ("servo_arm", "hopper", "ball"):
        mechanism = MECHANISMS[name]
        model = mechanism.spec().compile()
        data, real = mujoco.MjData(model), Real(mechanism, [])
        data.qpos[:], data.qvel[:] = mechanism.start(np.random.default_rng(0), model)
        real.reset(data.qpos, data.qvel)
        data.ctrl[:] = 0.3
        mujoco.mj_step(model, data, 300)
        real.advance(np.full(model.nu, 0.3), 300 * model.opt.timestep)
        np.testing.assert_array_equal(real.seen()[0], data.qpos)


@pytest.mark.parametrize(
    "item,limit",
    [
        (hide("coulomb_friction", "joint", "axle", frictionloss=0.5), 0.5),
        (hide("stribeck_friction", "joint", "axle", coulomb=0.3, static=0.8, velocity=0.1), 0.8),
        (hide("friction_patch", "joint", "axle", friction=0.4, low=-1.0, high=1.0), 0.4),
    ],
)
def test_friction_holds_below_its_limit_and_yields_above(item, limit):
    real = Real(wheel(), [item])
    real.advance([0.99 * limit], 1.0)
    assert abs(real.seen()[0][0]) < 1e-9
    real.advance([1.05 * limit], 0.2)
    assert real.seen()[0][0] > 1e-3


def test_sliding_friction_is_stribecks_curve():
    coulomb, static, speed = 0.3, 0.8, 0.5
    real = Real(
        wheel(),
        [
            hide(
                "stribeck_friction", "joint", "axle", coulomb=coulomb, static=static, velocity=speed
            )
        ],
        finer=4,
    )
    for v in (0.1, 0.5, 2.0):
        real.reset(np.zeros(1), np.array([v]))
        real.advance([0.0], 0.004)
        deceleration = (v - real.seen()[1][0]) / 0.004
        assert deceleration / real.model.dof_invweight0[0] == pytest.approx(
            coulomb + (static - coulomb) * np.exp(-((v / speed) ** 2)), rel=0.05
        )


@given(seconds=st.floats(0.0003, 0.03), values=st.lists(st.floats(-1, 1), min_size=8, max_size=8))
@settings(max_examples=30, deadline=None)
def test_delay_is_exact_between_time_steps(seconds, values):
    """The speed of a free wheel is the integral of the control, whenever it comes."""
    real, held = Real(wheel(), [hide("delay", "actuator", "drive", seconds=seconds)]), 0.01
    real.reset(np.zeros(1), np.zeros(1))
    for value in values:
        real.advance([value], held)
    grid = np.linspace(0, len(values) * held, 80001)
    then = np.clip(((grid - seconds) / held).astype(int), 0, None)
    expected = np.trapezoid(np.array(values)[then], grid) * real.model.dof_invweight0[0]
    assert real.seen()[1][0] == pytest.approx(expected, abs=2e-4 * real.model.dof_invweight0[0])


def test_backlash_lets_the_motor_turn_by_its_gap():
    item = hide("backlash", "joint", "axle", gap=0.04, spring=4000.0, damper=3.0)
    real = Real(wheel(), [item], finer=4)
    slack = []
    for k in range(400):
        real.advance([0.5 * np.sign(np.sin(k / 30))], 0.005)
        slack.append(real.seen()[0][0] - real.data.qpos[0])
    assert max(slack) == pytest.approx(0.02, abs=0.001) and min(slack) == pytest.approx(
        -0.02, abs=0.001
    )


@pytest.mark.parametrize(
    "name,load", [("pendulum", "arm"), ("arm2", "fore"), ("furuta", "pendulum")]
)
def test_payload_is_a_point_mass_at_the_centre_of_mass(name, load):
    mechanism = MECHANISMS[name]
    model = mechanism.spec().compile()
    heavy = float(model.body(load).mass[0]) + 0.05
    real = Real(mechanism, [hide("payload_change", "body", load, mass=heavy, event=True)], finer=8)
    model.opt.timestep /= 8
    model.body_mass[model.body(load).id] = heavy
    mujoco.mj_setConst(model, mujoco.MjData(model))
    data = mujoco.MjData(model)
    data.qpos[:] = 0.8
    without = Real(mechanism, [], finer=8)
    for system in (real, without):
        system.reset(data.qpos, np.zeros(model.nv))
        system.advance(np.full(model.nu, 0.2), 1.0, event=True)
    data.ctrl[:] = 0.2
    mujoco.mj_step(model, data, round(1.0 / model.opt.timestep))
    effect = np.abs(data.qpos - without.seen()[0]).max()
    assert effect > 1e-3 and np.abs(data.qpos - real.seen()[0]).max() < 0.02 * effect


def test_sensor_faults_act_on_readings_only():
    faults = {
        "sensor_bias": {"offset": 0.1},
        "sensor_scale": {"ratio": 1.2},
        "sensor_delay": {"seconds": 0.0137},
    }
    truth = Real(wheel(), [])
    truth.reset(np.array([0.2]), np.array([2.0]))
    times = np.arange(0, 0.5, 0.01)
    path = []
    for _ in times:
        path.append(truth.seen()[0][0])
        truth.advance([0.3], 0.01)
    for effect, parameters in faults.items():
        real = Real(wheel(), [hide(effect, "joint", "axle", **parameters)])
        real.reset(np.array([0.2]), np.array([2.0]))
        for t, q in zip(times, path):
            assert real.seen()[0][0] == q
            expected = {
                "sensor_bias": q + 0.1,
                "sensor_scale": 1.2 * q,
                "sensor_delay": np.interp(t - 0.0137, times, path),
            }[effect]
            assert real.reading()[0][0] == pytest.approx(expected, abs=1e-4)
            real.advance([0.3], 0.01)


# the draw, the seal, the folder


def test_every_effect_is_hidden_and_a_quarter_of_the_trials_hide_nothing():
    rng = np.random.default_rng(0)
    orders = [
        np.random.default_rng((5, block, 10**6)).permutation(conceal.BLOCK) for block in range(8)
    ]
    assert np.mean(np.concatenate(orders) == "null") >= 0.25
    singles = {conceal._choose(5, "single", nth, rng)[1][0][:1] for nth in range(192)}
    contract = """mass center_of_mass inertia armature viscous_damping quadratic_damping coulomb_friction stribeck_friction
        stiffness nonlinear_stiffness spring_offset cogging joint_stop backlash gain bias delay lag saturation back_emf
        dead_zone gravity wind air_drag time_step contact_friction contact_stiffness contact_damping ground_height
        sensor_bias sensor_scale sensor_delay external_force payload_change link_length""".split()
    assert {effect for (effect,) in singles} >= set(contract) | set(conceal.NAMED)
    unknown = {conceal._choose(5, "unknown", nth, rng)[1][0][0] for nth in range(15)}
    assert unknown == set(UNKNOWNS)


def test_the_same_seed_hides_the_same_and_the_salt_differs(tmp_path):
    trials = []
    for name in "ab":
        (tmp_path / name).mkdir()
        trials.append(conceal.conceal(1, 20, tmp_path / name))
    assert trials[0].answer == trials[1].answer and trials[0].commitment != trials[1].commitment
    for path in (tmp_path / "a").iterdir():
        if path.suffix != ".npz":
            assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()


def test_a_changed_answer_fails_its_commitment(tmp_path):
    trial = conceal.conceal(1, 20, tmp_path)
    assert conceal.seal(trial.answer, trial.salt) == trial.commitment
    trial.answer = trial.answer.replace('"null"', '"single"')
    with pytest.raises(ValueError, match="not the one that was sealed"):
        prove.reveal(trial, tmp_path, 1, 20, {"exit": 0})


def test_the_diagnosing_process_gets_nothing_but_the_folder(tmp_path, monkeypatch):
    """A stand-in for diagnose.py writes down everything that it was given."""
    (tmp_path / "diagnose.py").write_text(
        "import json, os, sys\n"
        "files = {n: open(n, 'rb').read().decode('latin1') for n in os.listdir('.')}\n"
        "json.dump([sys.argv, dict(os.environ), os.getcwd(), os.listdir('..'), files], open('seen.json', 'w'))\n"
    )
    monkeypatch.setattr(prove, "ROOT", tmp_path)
    monkeypatch.setenv("SECRET", "of the parent")
    bench = tmp_path / "parent" / "bench"
    bench.mkdir(parents=True)
    trial = conceal.conceal(971, 35, bench)
    assert prove.diagnose(trial.command, bench)["exit"] == 0
    arguments, environment, folder, beside, files = json.loads((bench / "seen.json").read_text())
    assert Path(folder) == bench and beside == ["bench"]
    assert set(environment) <= {"PATH", "HOME", "OMP_NUM_THREADS", "LC_CTYPE"}
    assert arguments[1:] == [*trial.command, "--out", "report"]
    names = {name for name in files if not name.startswith(("train_", "held_out_"))}
    assert names <= {"sim.xml"}
    item = json.loads(trial.answer)["hidden"][0]
    for secret in (trial.commitment, trial.salt, item["effect"], "971"):
        assert secret not in json.dumps([arguments[1:], environment, sorted(files)])
    for secret in (trial.commitment, trial.salt, item["effect"]):
        assert not any(secret in content for content in files.values())


# scores

ELBOW = hide("coulomb_friction", "joint", "elbow", frictionloss=0.1)
MASS = hide("mass", "body", "fore", mass=1.0)


def finding(item, also=(), **more):
    return {
        "effect": item["effect"],
        "place": item["place"],
        "also_possible": list(also),
        "parameters": [],
        **more,
    }


def answer(*hidden, finer=1):
    return {"hidden": list(hidden), "finer": finer}


@pytest.mark.parametrize(
    "truth,findings,found,first,extras",
    [
        (answer(), [], 0, 0, 0),
        (answer(), [finding(MASS)], 0, 0, 1),
        (answer(), [finding(hide("time_step", *WORLD))], 0, 0, 1),
        (answer(finer=4), [finding(hide("time_step", *WORLD))], 0, 0, 0),
        (answer(ELBOW), [finding(ELBOW)], 1, 1, 0),
        (answer(ELBOW), [finding(MASS, also=[finding(ELBOW)])], 1, 0, 0),
        (answer(ELBOW), [finding(ELBOW), finding(hide("time_step", *WORLD))], 1, 1, 0),
        (answer(ELBOW), [finding(ELBOW), finding(MASS)], 1, 1, 1),
        (answer(ELBOW, MASS), [finding(MASS), finding(ELBOW)], 2, 2, 0),
        (answer(ELBOW), [finding(hide("coulomb_friction", "joint", "shoulder"))], 0, 0, 1),
        (
            answer(hide("detent", "joint", "elbow")),
            [finding(hide("unknown", "joint", "elbow"), depends_on=["position:elbow"])],
            1,
            1,
            0,
        ),
        (
            answer(hide("detent", "joint", "elbow")),
            [finding(hide("unknown", "joint", "elbow"), depends_on=["time"])],
            0,
            0,
            1,
        ),
        (
            answer(hide("detent", "joint", "elbow")),
            [finding(hide("unknown", "joint", "elbow"), depends_on=["position:wrist"])],
            0,
            0,
            1,
        ),
        (
            answer(hide("friction_patch", "joint", "elbow")),
            [finding(hide("unknown", "joint", "elbow"), depends_on=["velocity:elbow"])],
            0,
            0,
            1,
        ),
        (
            answer(hide("fading_gain", "joint", "elbow")),
            [finding(hide("unknown", "joint", "elbow"), depends_on=["time", "control:m"])],
            1,
            1,
            0,
        ),
        (
            answer(hide("detent", "joint", "elbow")),
            [finding(hide("cogging", "joint", "elbow"))],
            0,
            0,
            1,
        ),
    ],
)
def test_score(truth, findings, found, first, extras):
    assert prove.score(truth, findings) == {"found": found, "first": first, "extras": extras}


@given(st.lists(st.floats(0.001, 0.2), min_size=2, max_size=200))
def test_windows_tile_the_recording(steps):
    time = np.concatenate(([0.0], np.cumsum(steps)))
    tiles = reference_error.windows(time)
    assert all(a < b for a, b in tiles)
    assert all(b == c for (_, b), (c, _) in zip(tiles, tiles[1:])) and (
        not tiles or tiles[0][0] == 0
    )
    assert all(time[b] - time[a] <= 0.3 * (1 + 1e-6) for a, b in tiles)


def test_error_of_the_true_model_is_the_floor_and_without_noise_zero(tmp_path):
    trial = conceal.conceal(1, 23, tmp_path)  # nothing hidden, the nominal time step
    truth = json.loads(trial.answer)
    assert truth["hidden"] == [] and truth["finer"] == 1
    mechanism, runs = MECHANISMS[truth["mechanism"]], list(trial.runs.values())[:1]
    nominal = mechanism.spec().compile()
    floor = reference_error.hand_error(Real(mechanism, []), runs, truth["noise"], perfect=False)
    assert reference_error.stock_error(nominal, nominal, runs, truth["noise"]) == pytest.approx(
        floor, rel=1e-6
    )
    for run in runs:
        run.qpos, run.qvel = run.true_qpos, run.true_qvel
    assert reference_error.stock_error(nominal, nominal, runs, truth["noise"]) < 1e-6
    assert (
        reference_error.hand_error(Real(mechanism, []), runs, truth["noise"], perfect=True) < 1e-6
    )


def test_hidden_memory_runs_on_through_windows(tmp_path):
    """The hand-written system, restarted in each window from its true state, retraces the recording."""
    mechanism = MECHANISMS["arm2"]
    hidden = [
        hide("coulomb_friction", "joint", "elbow", frictionloss=0.2),
        hide("lag", "actuator", "shoulder_motor", seconds=0.02),
    ]
    truth = {
        "mechanism": "arm2",
        "hidden": hidden,
        "finer": 4,
        "noise": 0.001,
        "velocities": True,
        "irregular": True,
    }
    runs = list(conceal.record(truth, np.random.default_rng(0)).values())[:1]
    for run in runs:
        run.qpos, run.qvel = run.true_qpos, run.true_qvel
    assert reference_error.hand_error(Real(mechanism, hidden, 4), runs, 0.001, perfect=False) < 1e-3
    assert prove.over_noise(truth, runs, {0}) > 1 and prove.over_noise(truth, runs, {1}) > 1


def test_an_appended_joint_is_left_alone():
    nominal = mujoco.MjModel.from_xml_string(HINGE)
    longer = mujoco.MjModel.from_xml_string(
        HINGE.replace(
            "</worldbody>", '<body><joint name="more"/><geom size="1"/></body></worldbody>'
        )
    )
    run = conceal.Run(
        np.arange(100) * 0.01,
        np.full((100, 1), 0.1),
        np.zeros((100, 1)),
        np.zeros((100, 1)),
        None,
        None,
        [],
        None,
    )
    assert reference_error.stock_error(nominal, longer, [run], 1.0) == pytest.approx(
        reference_error.stock_error(nominal, nominal, [run], 1.0)
    )


# the table and the page


def test_wilson_interval_solves_its_equation():
    for hits, trials in ((0, 10), (7, 10), (95, 100), (100, 100)):
        for bound in proof_page.wilson(hits, trials):
            spread = 1.96 * np.sqrt(bound * (1 - bound) / trials)
            assert abs(abs(hits / trials - bound) - spread) < 1e-7
    assert proof_page.wilson(0, 0) == (0.0, 1.0)


def test_run_resumes_and_the_page_is_whole(tmp_path, monkeypatch):
    asked = []

    def fake(seed, number, sealed):
        asked.append(number)
        truth = json.dumps(
            {"kind": "null", "hidden": [], "mechanism": "arm2", "sizes": [], "finer": 1}
        )
        row = dict.fromkeys(prove.COLUMNS, "")
        return row | {
            "seed": seed,
            "trial": number,
            "answer": truth,
            "salt": "ab",
            "commitment": conceal.seal(truth, "ab"),
            "kind": "null",
            "mechanism": "arm2",
            "finer": 1,
            "over_noise": "[]",
            "exit": 0,
            "findings": "[]",
            "found": 0,
            "first": 0,
            "extras": 0,
            "seconds": 1.0,
            "cpu_seconds": 1.0,
            "parameters": "[]",
            "error_before": 2.0,
            "error_after": 2.0,
            "error_floor": 2.0,
            "reported_before": 2.0,
            "reported_after": 2.0,
            "remeasured_after": 2.0,
        }

    monkeypatch.setattr(prove, "run_trial", fake)
    monkeypatch.setattr(prove, "ProcessPoolExecutor", ThreadPoolExecutor)
    out = tmp_path / "results" / "proof.csv"
    prove.run(3, range(4), out, 2)
    prove.run(3, range(6), out, 2)
    assert sorted(asked) == [0, 1, 2, 3, 4, 5]
    table = prove.read(out)
    assert [int(row["trial"]) for row in table] == list(range(6))
    (tmp_path / "results" / "proof.csv.sealed").write_text(
        "".join(f"3 {row['trial']} {row['commitment']}\n" for row in table[:5]) + "3 9 ab\n"
    )
    proof_page.write(table, prove.published(out), tmp_path / "proof.html")
    page = (tmp_path / "proof.html").read_text()
    assert (
        "Sealed but not in the table: 1; broken off and sealed again: 0" in page and "5/6" in page
    )  # one row's seal was never published
    assert (
        page.endswith("</html>")
        and "0/6" in page
        and "http" not in page.replace("http://www.w3.org", "")
    )


@pytest.mark.parametrize("command", ["score", "page"])
@pytest.mark.parametrize("there", [None, "", "seed,trial\n"])
def test_a_table_that_is_not_there_or_empty_is_named_and_none_is_made(
    command, there, tmp_path, monkeypatch, capsys
):
    table = tmp_path / "proof.csv"
    if there is not None:
        table.write_text(there)
        (tmp_path / "proof.csv.sealed").write_text("1 0 ab\n")
    monkeypatch.setattr(
        sys,
        "argv",
        [
            "prove.py",
            command,
            str(table),
            *(["--out", str(tmp_path / "page.html")] if command == "page" else []),
        ],
    )
    with pytest.raises(SystemExit) as leave:
        prove.main()
    assert leave.value.code == 2 and str(table) in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["proof.csv", "proof.csv.sealed"] * (
        there is not None
    )


def test_a_fault_in_one_trial_leaves_the_others_for_later(tmp_path, monkeypatch):
    """What has not begun is neither sealed nor run once one has failed."""

    def trial(seed, number, sealed):
        Path(f"{sealed}.{number}").touch()
        raise RuntimeError("no sane experiment")

    monkeypatch.setattr(prove, "run_trial", trial)
    monkeypatch.setattr(
        prove, "ProcessPoolExecutor", lambda jobs, initializer, initargs: ThreadPoolExecutor(jobs)
    )
    with pytest.raises(RuntimeError, match="no sane"):
        prove.run(1, range(200), tmp_path / "proof.csv", 1)
    assert len(list(tmp_path.iterdir())) < 100


def test_a_report_that_cannot_be_scored_counts_as_no_diagnosis(tmp_path):
    trial = conceal.conceal(1, 59, tmp_path)
    row = prove.reveal(
        trial,
        tmp_path / "nowhere",
        1,
        59,
        {"exit": 0, "seconds": 1.0, "cpu_seconds": 1.0, "note": ""},
    )
    assert (
        row["exit"] == 1
        and "cannot be scored" in row["note"]
        and json.loads(row["over_noise"])[0] > 1
    )


def test_a_row_is_scored_again_and_its_answer_drawn_again(tmp_path):
    trial = conceal.conceal(1, 59, tmp_path)
    [hidden] = json.loads(trial.answer)["hidden"]
    row = {
        "seed": "1",
        "trial": "59",
        "answer": trial.answer,
        "exit": "0",
        "findings": json.dumps([finding(hidden)]),
        "found": 0,
    }
    assert prove.again(row)["found"] == 1
    with pytest.raises(ValueError, match="not the one that was sealed"):
        prove.again(row | {"answer": trial.answer.replace("coulomb", "viscous")})


def test_an_effect_beside_a_biased_sensor_is_as_large_as_alone():
    arm = conceal.MECHANISMS["arm2"]
    bias = hide("sensor_bias", "joint", "elbow", offset=0.05)
    nothing, both = (
        Real(arm, items, finer=1)
        for items in ([bias], [bias, hide("armature", "joint", "shoulder", armature=1e-9)])
    )
    qpos, qvel = np.array([0.3, -0.2]), np.array([0.5, 0.1])
    for real in (nothing, both):
        real.reset(*real.behind(qpos, qvel))
        np.testing.assert_allclose(real.reading(), (qpos, qvel), atol=1e-12)


# whole trials, diagnosed


@pytest.mark.parametrize(
    "number,expected", [(10, None), (20, None), (26, "sensor_scale"), (59, "coulomb_friction")]
)
def test_a_sealed_trial_scores_as_expected(tmp_path, number, expected):
    """Development seed 1: two systems with nothing hidden, a miscalibrated encoder, a cart that rubs."""
    row = prove.run_trial(1, number, tmp_path / "sealed")
    assert row["exit"] == 0, row["note"]
    truth = json.loads(row["answer"])
    assert [item["effect"] for item in truth["hidden"]] == ([expected] if expected else [])
    assert conceal.seal(row["answer"], row["salt"]) == row["commitment"]
    assert expected == "sensor_scale" or float(row["remeasured_after"]) == pytest.approx(
        float(row["reported_after"]), rel=0.02
    )
    assert (tmp_path / "sealed").read_text() == f"1 {number} {row['commitment']}\n"
    assert (row["found"], row["first"], row["extras"]) == ((1, 1, 0) if expected else (0, 0, 0))
    if expected:
        assert float(row["error_after"]) <= float(row["error_before"])
        assert all(
            abs(p["value"] - p["truth"]) <= 0.05 * abs(p["truth"])
            for p in json.loads(row["parameters"])
        )
