"""The command: what it refuses and how, how it splits, what it says, and that a diagnosis comes
out."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

ROOT = str(Path(__file__).resolve().parents[2])
from arm import ARM, run, text
from contract import contract
from malformed import cases
from plants import reported_error

from diagnosis import command as diagnose
from diagnosis import preparation
from diagnosis.estimation import windowing
from diagnosis.recordings.recording import Recording, RecordingError, accepted
from diagnosis.report import text as wording
from diagnosis.simulation.simulator import World

CASES = cases()


def refused(code, out, err, folder, before, says):
    """Exit status 2, one line on stderr with the right hint, nothing on stdout, nothing left
    behind."""
    assert code == 2
    assert out == ""
    lines = err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("diagnose.py: ") and "Traceback" not in err, err
    assert says in lines[0], err
    assert sorted(os.listdir(folder)) == before


def test_the_corpus_is_large():
    assert len(CASES) >= 60


@pytest.mark.parametrize("name", CASES)
def test_malformed_input(name, tmp_path, capfd, monkeypatch):
    argv = CASES[name].write(tmp_path)
    before = sorted(os.listdir(tmp_path))
    monkeypatch.chdir(tmp_path)
    code = diagnose.main(argv)
    captured = capfd.readouterr()
    refused(code, captured.out, captured.err, tmp_path, before, CASES[name].says)


@pytest.mark.parametrize(
    "name", ["binary rubbish", "NPZ with a pickle", "model that blows up", "no such environment"]
)
def test_malformed_input_as_a_process(name, tmp_path):
    argv = CASES[name].write(tmp_path)
    before = sorted(os.listdir(tmp_path))
    done = subprocess.run(
        [sys.executable, os.path.join(ROOT, "diagnose.py"), *argv],
        capture_output=True,
        text=True,
        cwd=tmp_path,
    )
    refused(done.returncode, done.stdout, done.stderr, tmp_path, before, CASES[name].says)


def recording(rows, name):
    t = np.arange(rows) * 0.01
    return Recording(name, t, np.sin(t)[:, None], np.full((rows, 1), np.nan), np.zeros((rows, 0)))


def test_split_keeps_back_every_third_or_the_last_part():
    many, world = [recording(50, f"{k}") for k in range(7)], World(mujoco.MjSpec.from_string(MASS))
    train, held = preparation.split(world, many)
    assert [r.name for r in train] == ["0", "1", "3", "4", "6"] and [r.name for r in held] == [
        "2",
        "5",
    ]
    train, held = preparation.split(world, many[:1])
    assert (
        len(train[0].time) + len(held[0].seen().time) == 50 and 14 <= len(held[0].seen().time) <= 16
    )
    assert held[0].seen().time[0] > train[0].time[-1]
    np.testing.assert_array_equal(held[0].time, many[0].time)  # what led there stays
    train, held = preparation.split(world, many[:2])
    assert [r.name for r in train] == ["0", "1"] == [r.name for r in held]
    [early], [late] = preparation.split(
        world, [dataclasses.replace(many[0], start=40)]
    )  # one that was held out before
    assert len(early.seen().time) == 35 and len(late.seen().time) == 10


def test_what_the_model_misses_most_is_fitted_to():
    """A mass that moves on, at rest in the model: a recording in which it does not is another."""
    many, world = [recording(50, f"{k}") for k in range(6)], World(mujoco.MjSpec.from_string(MASS))
    for odd, kept in ((5, ["2", "4"]), (2, ["1", "5"]), (3, ["2", "5"])):
        jerky = dataclasses.replace(many[odd], qpos=np.abs(5 * many[odd].qpos - 0.5))
        train, held = preparation.split(world, many[:odd] + [jerky] + many[odd + 1 :])
        assert [r.name for r in held] == kept and str(odd) in [r.name for r in train]


def test_what_a_recording_made_in_python_need_not_have():
    made = dataclasses.replace(recording(50, Path("run 1")), qvel=None, sensors=None)
    got = accepted(
        made,
        mujoco.MjModel.from_xml_string(
            INTEGRATOR.replace("<actuator>", "<!--").replace("</actuator>", "-->")
        ),
    )
    assert got.name == "run 1" and np.isnan(got.qvel).all() and got.sensors == {}


def test_a_folder_that_is_named_like_an_environment(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("InvertedPendulum-v4").mkdir()
    with pytest.raises(
        RecordingError, match="nowhere.csv"
    ):  # the model is found, so that this is what is missing
        diagnose.diagnose("InvertedPendulum-v4", ["nowhere.csv"])


MASS = """<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="j" type="slide"/>
<geom size="0.1"/></body></worldbody></mujoco>"""
INTEGRATOR = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body><joint
name="j" axis="0 1 0" damping="0.3"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="1" contype="0"
  conaffinity="0"/></body></worldbody>
  <actuator><intvelocity name="drive" joint="j" kp="20" actrange="-2 2"/></actuator></mujoco>"""


def test_the_held_out_tail_starts_with_the_actuators_where_they_were():
    """A servo that integrates its control: stock MuJoCo's record of the nominal model itself,
    without noise. Its target at the cut is that of the rows before, so the nominal model predicts
    the tail; from a target of 0 it misses by far."""
    model = mujoco.MjModel.from_xml_string(INTEGRATOR)
    data, rows = mujoco.MjData(model), []
    for _ in range(300):
        rows.append([data.time, data.qpos[0], data.qvel[0], 0.8 + np.sin(3 * data.time)])
        data.ctrl[0] = rows[-1][3]
        mujoco.mj_step(model, data, nstep=5)
    rows = np.array(rows)
    whole = Recording("run.csv", rows[:, 0], rows[:, 1:2], rows[:, 2:3], rows[:, 3:])
    world = World(mujoco.MjSpec.from_string(INTEGRATOR))
    [early], [tail] = preparation.split(world, [whole])
    error, _ = reported_error(world, {}, [tail], np.ones(1))
    assert error < 1e-6 and len(windowing.cut([tail], 0.3)) == 2
    assert reported_error(world, {}, [tail.seen()], np.ones(1))[0] > 0.1
    (trace,) = windowing.traces(world, {}, [tail])
    assert trace["time"][0] == tail.time[tail.start] > early.time[-1]


@pytest.mark.parametrize(
    "change, says",
    [
        (
            {"ctrl": np.full((400, 2), np.nan)},
            "made.py: row 0, column 'ctrl:shoulder_motor': nan; every row needs its control",
        ),
        (
            {"time": 1 - 0.01 * np.arange(400)},
            "made.py: row 1, column 'time': 0.99 runs backward from 1;",
        ),
        (
            {"qpos": np.zeros((400, 3))},
            "made.py: array 'qpos' has shape (400, 3) instead of (400, 2); this model has 2 of "
            "them",
        ),
        (
            {"qvel": np.full((400, 2), None)},
            "made.py: array 'qvel' holds object instead of real numbers",
        ),
        ({"start": 399}, "made.py: start is row 399 of 400"),
    ],
)
def test_recordings_made_in_python_are_checked_too(change, says):
    rows = run()
    sound = Recording("made.py", rows[:, 0], rows[:, 1:3], rows[:, 3:5], rows[:, 5:7])
    with pytest.raises(RecordingError) as error:
        diagnose.diagnose(mujoco.MjSpec.from_string(ARM), [dataclasses.replace(sound, **change)])
    assert says in str(error.value) and "\n" not in str(error.value)


def test_paths_and_recordings_together(tmp_path):
    (tmp_path / "run.csv").write_bytes(text(run(seed=1)))
    rows, model = run(), mujoco.MjModel.from_xml_string(ARM)
    made = Recording(
        "run.csv", rows[:, 0], rows[:, 1:3], rows[:, 3:5], rows[:, 5:7], {"encoder": rows[:, 1]}
    )
    [other], [same] = preparation._recordings([tmp_path / "run.csv"], made, model)
    np.testing.assert_allclose(other.qpos, run(seed=1)[:, 1:3], atol=1e-8)
    np.testing.assert_array_equal(same.qpos, made.qpos)
    assert same.name == "held out run.csv" and same.sensors["encoder"].shape == (400, 1)
    both, none = preparation._recordings([made, tmp_path / "run.csv"], None, model)
    assert [(r.name, len(r.time)) for r in both] == [
        ("run.csv", 400),
        ("run.csv (2)", 400),
    ] and none == []


def test_files_may_be_given_in_several_parts(tmp_path, capfd):
    (tmp_path / "arm.xml").write_text(ARM)
    (tmp_path / "run.csv").write_bytes(text(run()))
    good, out = (
        str(tmp_path / "run.csv"),
        ["--model", str(tmp_path / "arm.xml"), "--out", str(tmp_path / "report")],
    )
    assert diagnose.main(["--recordings", "first.csv", "--recordings", good, *out]) == 2
    assert "first.csv: no such file" in capfd.readouterr().err
    assert (
        diagnose.main(
            ["--recordings", good, "--held-out", "first.csv", "--held-out", "second.csv", *out]
        )
        == 2
    )
    assert "first.csv: no such file" in capfd.readouterr().err


def test_one_file_for_two_purposes_is_refused(tmp_path):
    (tmp_path / "arm.xml").write_text(ARM)
    (tmp_path / "run.csv").write_bytes(text(run()))
    with pytest.raises(RecordingError, match="held out"):
        diagnose.diagnose(
            tmp_path / "arm.xml", tmp_path / "run.csv", held_out=[tmp_path / "run.csv"]
        )
    with pytest.raises(diagnose.ModelError, match="no such"):
        diagnose.diagnose(tmp_path / "leg.xml", tmp_path / "run.csv")


def pendulum(frictionloss):
    return f"""<mujoco model="pendulum"><option timestep="0.002"
    integrator="implicitfast"/><worldbody><body name="rod">
      <joint name="pivot" axis="0 1 0" damping="0.02" frictionloss="{frictionloss}"
      solreffriction="0.004 1" solimpfriction="0.999 0.9999 0.001"/>
      <geom name="stick" type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="1" contype="0"
      conaffinity="0"/></body></worldbody>
      <actuator><motor name="motor" joint="pivot"/></actuator></mujoco>"""


def swing(frictionloss, seed, seconds=6.0, noise=5e-4):
    """CSV of a driven pendulum, positions only."""
    rng = np.random.default_rng(seed)
    model = mujoco.MjModel.from_xml_string(pendulum(frictionloss))
    data, rows = mujoco.MjData(model), []
    tones, phases = rng.uniform(0.5, 2.0, 3), rng.uniform(0, 6, 3)
    for _ in range(int(seconds / 0.01)):
        torque = 1.2 * np.sin(2 * np.pi * tones * data.time + phases).sum()
        rows.append([data.time, data.qpos[0] + noise * rng.normal(), torque])
        data.ctrl[0] = torque
        mujoco.mj_step(model, data, nstep=5)
    return text(rows, ["time", "qpos:pivot", "ctrl:motor"])


@pytest.fixture(scope="module")
def command(tmp_path_factory):
    """(folder, finished process) of one real run of the command: a pendulum whose Coulomb friction
    was left out."""
    folder = tmp_path_factory.mktemp("command")
    (folder / "sim.xml").write_text(pendulum(0))
    for k in range(3):
        (folder / f"run{k}.csv").write_bytes(swing(0.15, k))
    done = subprocess.run(
        [
            sys.executable,
            os.path.join(ROOT, "diagnose.py"),
            "--model",
            "sim.xml",
            "--recordings",
            "run0.csv",
            "run1.csv",
            "run2.csv",
            "--out",
            "report/",
        ],
        capture_output=True,
        text=True,
        cwd=folder,
    )
    return folder, done


def test_the_command_names_the_friction(command):
    folder, done = command
    assert done.returncode == 0 and done.stderr == "", done.stderr  # no terminal, no progress
    assert "joint pivot: Coulomb friction 0.15" in done.stdout and "was left out" in done.stdout
    assert "Held-out error 0.3 s ahead falls from" in done.stdout
    files = "report/report.html, diagnosis.json, corrected.xml, force_pivot.csv"
    assert done.stdout.endswith(f"Written: {files}\n")
    assert sorted(os.listdir(folder)) == ["report", "run0.csv", "run1.csv", "run2.csv", "sim.xml"]
    assert {"corrected.xml", "diagnosis.json", "report.html"} <= set(os.listdir(folder / "report"))


def test_the_files_of_the_command(command):
    folder, _ = command
    summary = json.loads((folder / "report/diagnosis.json").read_text(), parse_constant=pytest.fail)
    contract(summary)
    first = summary["findings"][0]
    assert (first["effect"], first["place"]) == (
        "coulomb_friction",
        {"kind": "joint", "name": "pivot"},
    )
    assert abs(first["parameters"][0]["value"] - 0.15) < 0.15 * 0.05
    corrected = mujoco.MjModel.from_xml_path(str(folder / "report/corrected.xml"))
    assert abs(corrected.joint("pivot").frictionloss[0] - 0.15) < 0.15 * 0.05


def test_the_function_reads_as_the_command_does(command):
    folder, _ = command
    calls = []
    diagnosis = diagnose.diagnose(
        folder / "sim.xml",
        [folder / f"run{k}.csv" for k in range(3)],
        progress=lambda *args: calls.append(args),
    )
    summary = json.loads((folder / "report/diagnosis.json").read_text())
    assert diagnosis.summary["findings"][0]["effect"] == summary["findings"][0]["effect"]
    assert (
        diagnosis.summary["findings"][0]["parameters"][0]["value"]
        == summary["findings"][0]["parameters"][0]["value"]
    )  # same numbers
    assert calls and all(0 <= share <= 1 and isinstance(what, str) for share, what in calls)


@pytest.mark.parametrize("terminal", [True, False])
def test_progress_is_for_terminals(terminal, tmp_path, capsys, monkeypatch):
    def stop(model, recordings, held_out, progress, **reading):
        assert (progress is not None) == terminal
        if progress:
            progress(0.25, "estimating noise")
            progress(0.5, "searching")
        raise RecordingError("enough")

    monkeypatch.setattr(diagnose, "diagnose", stop)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal, raising=False)
    argv = CASES["empty file"].write(tmp_path)
    assert diagnose.main(argv) == 2
    err = capsys.readouterr().err
    assert (
        err.endswith("diagnose.py: enough\n") and ("searching" in err and "50%" in err) == terminal
    )


def test_a_fault_of_the_program_is_one_line_too(tmp_path, capsys, monkeypatch):
    def break_down(*args, **reading):
        raise np.linalg.LinAlgError("Singular\nmatrix")

    monkeypatch.setattr(diagnose, "diagnose", break_down)
    assert diagnose.main(CASES["empty file"].write(tmp_path)) == 1
    err = capsys.readouterr().err
    assert err.startswith(
        "diagnose.py: a fault of this program, not of its input: LinAlgError in test_command.py, "
        "line "
    )
    assert err.count("\n") == 1 and "(Singular matrix)" in err


def test_patterns_that_the_shell_left_are_expanded(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("run2.csv", "run1.csv", "[odd].csv"):
        (tmp_path / name).write_text("")
    assert diagnose._expanded(["run*.csv", "[odd].csv", "none*.csv"]) == [
        "run1.csv",
        "run2.csv",
        "[odd].csv",
        "none*.csv",
    ]
    assert diagnose._expanded(None) == []


def test_a_terminal_that_cannot_show_a_sign(command):
    folder, _ = command
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            "import sys; sys.path.insert(0, sys.argv[1]); from diagnosis import command; import "
            "types, json; "
            "s = json.load(open('report/diagnosis.json')); command.writer.write = lambda *a: "
            "['unknown_1.csv']; "
            "command._for_next = lambda *a: {}; "
            "command.diagnose = lambda *a, **k: types.SimpleNamespace(summary=s); "
            "sys.exit(command.main(['--model', 'sim.xml', '--recordings', 'run0.csv', '--out', "
            "'x']))",
            ROOT,
        ],
        capture_output=True,
        cwd=folder,
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
    )
    assert (
        done.returncode == 0 and b"Coulomb friction 0.15" in done.stdout and done.stderr == b""
    ), done.stderr
    assert done.stdout.endswith(b"Written: x/unknown_1.csv\n")


# --- words ---


def parameter(name, nominal, value, half, unit):
    return {
        "name": name,
        "nominal": nominal,
        "value": value,
        "low": value - half,
        "high": value + half,
        "unit": unit,
    }


def finding(effect, kind, name, *parameters, **more):
    return {
        "effect": effect,
        "place": {"kind": kind, "name": name},
        "parameters": list(parameters),
        "when": None,
        "depends_on": [],
        **more,
    }


@pytest.mark.parametrize(
    "given, words",
    [
        (
            finding(
                "coulomb_friction",
                "joint",
                "elbow",
                parameter("frictionloss", 0.0, 0.1214, 0.0042, "N·m"),
            ),
            "joint elbow: Coulomb friction 0.121 ± 0.004 N·m was left out",
        ),
        (
            finding(
                "coulomb_friction",
                "joint",
                "elbow",
                parameter("frictionloss", 0.0, 0.15, 0.000023, "N·m"),
            ),
            "joint elbow: Coulomb friction 0.1500 ± 2e-5 N·m was left out",
        ),
        (
            finding("mass", "body", "torso", parameter("mass", 3.56, 4.52, 0.031, "kg")),
            "body torso: mass 4.52 ± 0.03 kg instead of 3.56 (+27 %)",
        ),
        (
            finding("armature", "joint", "elbow", parameter("armature", 0.01, 3.5, 0.2, "kg·m²")),
            "joint elbow: armature 3.50 ± 0.20 kg·m² instead of 0.0100 (350 times)",
        ),
        (
            finding("center_of_mass", "body", "fore", parameter("z", 0.1, -1e-8, 4e-5, "m")),
            "body fore: centre of mass: z 0.00000 ± 0.00004 m instead of 0.100 (-100 %)",
        ),
        (
            finding("delay", "actuator", "drive", parameter("seconds", 0.0, 0.0123, 0.0012, "s")),
            "actuator drive: delay 0.0123 ± 0.0012 s was left out",
        ),
        (
            finding(
                "external_force",
                "body",
                "cart",
                parameter("x", 0.0, 2.0, 0.1, "N"),
                when={"recording": "run3.csv", "time": [2.0, 7.5]},
            ),
            "body cart: external force 2.00 ± 0.10 N was left out, in run3.csv from 2.00 to 7.50 s",
        ),
        (
            finding("unknown", "joint", "elbow", depends_on=["position:elbow", "contact:floor"]),
            "joint elbow: a force that the catalogue has no name for, depending on the position "
            "of elbow and contact with floor",
        ),
        (
            finding("gravity", "world", "world", parameter("z", -9.81, -9.5, 0.01, "m/s²")),
            "the world: gravity: z -9.500 ± 0.010 m/s² instead of -9.81 (-3 %)",
        ),
    ],
)
def test_findings_in_words(given, words):
    assert wording.finding_words(given) == words


def test_a_wave_in_words():
    parameters = [
        {"name": f"force {k}", "value": v, "unit": "N·m", "at": at}
        for k, (v, at) in enumerate([(0.3, 0.0), (-0.4, 0.125)])
    ]
    wave = {
        **finding("unknown", "joint", "elbow", depends_on=["time"]),
        "parameters": parameters,
        "curve": {"wave": True},
    }
    assert wording.finding_words(wave) == (
        "joint elbow: a force that the catalogue has no name for, "
        "repeating 2.00 times a second with an amplitude of 0.500 N·m"
    )
    wave["depends_on"] = ["position:elbow", "velocity:elbow"]
    assert wording.finding_words(wave) == (
        "joint elbow: a force that the catalogue has no name for, depending on the position of "
        "elbow and the velocity of elbow"
    )


def test_error_in_words():
    fit = {
        "before": 31,
        "after": 2,
        "floor": 1,
        "horizon_s": 0.3,
        "channels": {
            "qpos:a": {"before": 0.002, "after": 0.002, "floor": 0.001, "unit": "rad"},
            "qpos:elbow": {"before": 0.031, "after": 0.002, "floor": 0.001, "unit": "rad"},
        },
    }
    summary = {"verdict": "mismatch", "findings": [{}], "fit": {"held_out": fit}}
    assert wording.error_words(summary) == (
        "held-out error 0.3 s ahead falls from 31 to 2.0 mrad at elbow; "
        "a perfect simulator would show 1.0, for it too starts from noisy measurements"
    )
    fit["channels"] = {"qpos:1:rot": {**fit["channels"]["qpos:elbow"], "before": float("inf")}}
    assert (
        "ahead is 2.0 mrad at joint 1 (rotation), where the nominal model blows up;"
        in wording.error_words(summary)
    )
    fit["channels"]["qpos:1:rot"]["after"] = None  # as diagnosis.json has it
    assert (
        "has no number, for the corrected model blows up at joint 1 (rotation);"
        in wording.error_words(summary)
    )
    fit["channels"]["qpos:1:rot"]["before"] = 0.031
    assert (
        "is 31 mrad at joint 1 (rotation) with the nominal model, but the corrected one blows up;"
        in wording.error_words(summary)
    )
    assert (
        wording.unexplained_words(
            {"verdict": "mismatch", "unexplained": {"fraction": float("nan")}}
        )
        == ""
    )
    del fit["channels"]
    assert "falls from 31 to 2.0 times the noise" in wording.error_words(summary)


def test_a_stop_on_one_side():
    never, stop = (
        parameter("low", -np.inf, -np.inf, 0.0, "rad"),
        parameter("high", np.inf, 0.5, 0.01, "rad"),
    )
    assert wording.finding_words(finding("joint_stop", "joint", "elbow", never, stop)) == (
        "joint elbow: joint stop high 0.500 ± 0.010 rad was left out (no stop below)"
    )
    gone = parameter("high", 1.2, 1e6, 0.0, "rad")  # the nominal model has one, the real joint none
    kept = parameter("low", -1.2, -1.2, 0.0, "rad")
    assert wording.finding_words(finding("joint_stop", "joint", "elbow", kept, gone)) == (
        "joint elbow: joint stop: no stop above instead of 1.20 rad"
    )


def test_a_stop_at_zero_is_a_stop():
    moved, high = parameter("low", 0.0, 0.3, 0.01, "rad"), parameter("high", 2.5, 2.5, 0.0, "rad")
    words = wording.finding_words(finding("joint_stop", "joint", "knee", moved, high))
    assert words == "joint knee: joint stop: low 0.300 ± 0.010 rad instead of 0"


def test_times_keep_the_digits_that_tell_them_apart():
    assert (
        wording.when_words({"recording": "run.csv", "time": [1.7e9 + 2.25, 1.7e9 + 7.5]})
        == ", in run.csv from 1700000002.25 to 1700000007.50 s"
    )


def test_a_match_far_above_the_noise_says_so():
    summary = {"verdict": "match", "findings": [], "unexplained": {"fraction": 0.05}}
    assert wording.verdict_words(summary).startswith("Nothing is missing")
    summary["unexplained"]["fraction"] = 0.8
    assert wording.verdict_words(summary).startswith(
        "Something is missing, but no effect of the catalogue"
    )


@pytest.mark.parametrize(
    "value, words",
    [
        (0.0005, "0.000500"),
        (411, "411"),
        (1.23e-7, "1.23e-7"),
        (0, "0"),
        (float("nan"), "–"),
        (2.5e9, "2.50e9"),
    ],
)
def test_numbers(value, words):
    assert wording.number(value) == words
