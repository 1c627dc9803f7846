"""What to record next: in simulation, the class of explanations shrinks to the truth."""

import csv
import json
import re

import mujoco
import numpy as np
import pytest
from scipy.optimize import least_squares

from diagnosis import command
from diagnosis.design import signals
from diagnosis.design.explanations import DesignError, Open, limits_of, reached_by
from diagnosis.design.optimal import Trial, design
from diagnosis.design.output import table
from diagnosis.recordings.recording import Recording

MODEL = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body>
  <joint name="pivot" axis="0 1 0" damping="0.01" limited="true" range="-80 80"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="1" contype="0" conaffinity="0"/>
  </body></worldbody>
  <actuator><motor name="drive" joint="pivot" ctrllimited="true" ctrlrange="-2 2"/></actuator>
  </mujoco>"""
NOISE, DT = 0.004, 0.01
STIFF = 'solreffriction="0.004 1" solimpfriction="0.999 0.9999 0.001"'
SECONDS = 5.0


def simulated(ctrl, friction=0.0, damping=0.01):
    """(T,) positions of the pendulum in stock MuJoCo, from rest."""
    joint = f'damping="{damping}" frictionloss="{friction}" {STIFF}'
    model = mujoco.MjModel.from_xml_string(MODEL.replace('damping="0.01"', joint))
    data, out = mujoco.MjData(model), np.empty(len(ctrl))
    for row, value in enumerate(ctrl):
        out[row], data.ctrl[0] = data.qpos[0], value
        mujoco.mj_step(model, data, nstep=5)
    return out


def finding(effect, name, value, **more):
    parameter = {"name": name, "nominal": 0.0, "value": value, "unit": "N·m"}
    place = {"kind": "joint", "name": "pivot"}
    return {"effect": effect, "place": place, "parameters": [parameter], **more}


def report(folder, old, rivals):
    """A folder as a diagnosis of one old recording leaves it: viscous damping, or `rivals`."""
    folder.mkdir()
    (folder / "nominal.xml").write_text(MODEL)
    found = finding("viscous_damping", "damping", 0.032, also_possible=rivals)
    content = {"findings": [found], "noise": {"qpos:pivot": NOISE}}
    (folder / "diagnosis.json").write_text(json.dumps(content))
    qpos = simulated(old, friction=0.03)[:, None]
    time = DT * np.arange(len(old))
    run = Recording("old", time, qpos, np.full(qpos.shape, np.nan), old[:, None])
    reached = reached_by([run], mujoco.MjModel.from_xml_string(MODEL))
    reached["speeds"]["pivot"] = 2.0  # as if it had been moved by hand, too
    (folder / "recorded.json").write_text(json.dumps(reached))
    return str(folder)


@pytest.fixture(scope="module")
def old():
    """A recording that cannot tell friction from damping: one frequency, one amplitude."""
    t = DT * np.arange(int(SECONDS / DT))
    return 0.08 * np.sin(2 * np.pi * 2.5 * t) * np.minimum(1, t)


def excess(ctrl, seed=1):
    """By how much the wrong explanation, refitted, errs more than the right one (both refitted)."""
    seen = (
        simulated(ctrl, friction=0.03) + np.random.default_rng(seed).normal(size=len(ctrl)) * NOISE
    )
    errors = []
    for guess in (
        lambda x: simulated(ctrl, friction=abs(x[0])),
        lambda x: simulated(ctrl, damping=abs(x[0])),
    ):
        fit = least_squares(lambda x: guess(x) - seen, [0.03], diff_step=1e-3, xtol=1e-6)
        errors.append(np.sqrt(2 * fit.cost / len(ctrl)))
    return errors[1] / errors[0] - 1


def test_after_the_next_recording_only_the_truth_is_left(tmp_path, old, capsys):
    folder = report(tmp_path / "report", old, [finding("coulomb_friction", "frictionloss", 0.03)])
    assert command.main(["--next", folder, "--seconds", str(SECONDS)]) == 0
    said = capsys.readouterr().out
    assert "coulomb_friction at pivot instead of viscous_damping at pivot" in said
    assert re.search(r"ratio of evidence.*: over a billion to one", said), said
    with open(tmp_path / "report" / "next.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert list(rows[0]) == ["time", "ctrl:drive"] and len(rows) == SECONDS / DT
    ctrl = np.array([float(row["ctrl:drive"]) for row in rows])
    assert (tmp_path / "report" / "next.png").read_bytes().startswith(b"\x89PNG")
    before, after = excess(old), excess(ctrl)
    assert before < 0.1 and after > 0.5, (before, after)
    moved, limits = simulated(ctrl, friction=0.03), Open.read(folder).limits
    assert np.abs(ctrl).max() <= 2
    assert (moved >= limits.low[0]).all() and (moved <= limits.high[0]).all()
    assert np.abs(np.diff(moved)).max() / DT <= 1.05 * limits.speed[0]


def test_what_no_recording_can_separate_is_said_so(tmp_path, old):
    folder = report(tmp_path / "report", old, [finding("back_emf", "damping", 0.022)])
    content = json.loads((tmp_path / "report" / "diagnosis.json").read_text())
    content["findings"][0]["also_possible"][0]["place"] = {"kind": "actuator", "name": "drive"}
    (tmp_path / "report" / "diagnosis.json").write_text(json.dumps(content))
    left = Open.read(folder)
    assert len(left.settings) == 2
    assert Trial(left).told_apart(DT * np.arange(len(old)), old[:, None]) < 1


def test_without_rivals_the_parameters_are_to_be_known_best(tmp_path, old):
    left = Open.read(report(tmp_path / "report", old, []))
    best = design(left, seconds=3.0)
    [(value, error, _)] = best.errors.values()
    rows = slice(0, len(best.time))
    [(_, other, _)] = Trial(left).described(best.time, old[rows, None]).errors.values()
    assert best.nats is None and value == 0.032 and error < other


def test_a_joint_that_never_moved_is_moved(tmp_path, old):
    folder = report(tmp_path / "report", old, [])
    content = {"findings": [], "noise": {"qpos:pivot": NOISE}}
    (tmp_path / "report" / "diagnosis.json").write_text(json.dumps(content))
    reached = {"columns": {"ctrl:drive": [-1, 1]}, "speeds": {}, "period": DT}
    (tmp_path / "report" / "recorded.json").write_text(json.dumps(reached))
    left = Open.read(folder)
    assert {c.effect.name for c in left.free} == {"coulomb_friction", "viscous_damping", "armature"}


def test_motors_may_be_given_position_controllers_meanwhile(tmp_path, old):
    folder = report(tmp_path / "report", old, [finding("coulomb_friction", "frictionloss", 0.03)])
    left = Open.read(folder, kp=5.0, kd=0.2)
    best = design(left, seconds=2.0)
    assert table(best, left.world.model, left.followed).startswith("time,target:pivot\n")
    assert left.limits.low[0] <= best.ctrl.min() and best.ctrl.max() <= left.limits.high[0]
    assert best.ctrl[0] == best.start_qpos[0] == 0.0
    assert np.abs(best.motions[0, :, 0] - best.ctrl[:, 0]).max() < 1.0  # it follows its targets


def test_it_starts_where_the_first_recording_did():
    reached = {"columns": {"qpos:pivot": [-0.1, 0.1]}, "speeds": {"pivot": 2.0}, "period": DT}
    reached["start"] = {"qpos:pivot": 0.7, "ctrl:drive": 0.9}
    limits = limits_of(mujoco.MjModel.from_xml_string(MODEL), reached)
    assert (limits.start_qpos[0], limits.start_ctrl[0]) == (0.7, 0.9) and limits.high[0] >= 0.7


def test_limits():
    xml = MODEL.replace("-80 80", "-90 60")
    model = mujoco.MjModel.from_xml_string(xml)
    reached = {"columns": {"qpos:pivot": [-0.1, 0.1]}, "speeds": {"pivot": 2.0}, "period": DT}
    limits = limits_of(model, reached)
    assert -np.pi / 2 < limits.low[0] < -1.5 and 0.9 < limits.high[0] < np.pi / 3
    np.testing.assert_allclose([limits.control_low[0], limits.control_high[0]], [-2, 2])
    free = MODEL.replace('limited="true" range="-80 80"', "")
    free = limits_of(mujoco.MjModel.from_xml_string(free), reached)
    assert -0.2 < free.low[0] < -0.1 and 2.0 <= free.speed[0] < 3.0


def test_a_speed_is_not_the_noise_of_an_encoder():
    """A sine of known speed, read at 1 kHz in steps of 2 mrad: 2 rad/s between single rows."""
    time = 1e-3 * np.arange(4000)
    qpos = 2e-3 * np.round(0.1 * np.sin(2 * np.pi * 0.5 * time) / 2e-3)[:, None]
    run = Recording("encoder", time, qpos, np.full(qpos.shape, np.nan), np.zeros(qpos.shape))
    speed = reached_by([run], mujoco.MjModel.from_xml_string(MODEL))["speeds"]["pivot"]
    true = 0.1 * 2 * np.pi * 0.5
    assert true < speed < true + 2e-3 / 0.02


def test_a_report_with_nothing_open_says_so(tmp_path, old):
    folder = report(tmp_path / "report", old, [])
    content = {"findings": [], "noise": {"qpos:pivot": NOISE}}
    (tmp_path / "report" / "diagnosis.json").write_text(json.dumps(content))
    with pytest.raises(DesignError, match="leaves nothing open that a recording could tell"):
        design(Open.read(folder), seconds=1.0)


def test_the_nearest_names_of_an_unknown_force_are_in_the_model(tmp_path, old):
    """Those have intervals; a rival of the one name is an explanation beside it."""
    folder = report(tmp_path / "report", old, [])
    damping = finding("viscous_damping", "damping", 0.032)
    damping["parameters"][0] |= {"low": 0.03, "high": None}
    rival = finding("coulomb_friction", "frictionloss", 0.03)
    unknown = {**finding("unknown", "", 0.0), "parameters": [], "written_as": "mjcf"}
    unknown["also_possible"] = [damping, rival]
    content = {"findings": [unknown], "noise": {"qpos:pivot": NOISE}}
    (tmp_path / "report" / "diagnosis.json").write_text(json.dumps(content))
    values = [
        {c.effect.name: v for c, v in setting.items()} for setting in Open.read(folder).settings
    ]
    assert values == [{"viscous_damping": (0.032,)}, {"coulomb_friction": (0.03,)}]
    unknown["also_possible"].append({**damping, "effect": "armature"})
    unknown["also_possible"][-1]["parameters"] = [{**damping["parameters"][0], "name": "armature"}]
    (tmp_path / "report" / "diagnosis.json").write_text(json.dumps(content))
    [setting] = Open.read(folder).settings
    assert {c.effect.name for c in setting} == {"viscous_damping", "armature"}


def test_signals_stay_inside_and_begin_and_end_at_the_middle():
    rng, time = np.random.default_rng(0), DT * np.arange(500)
    low, high, middle = np.array([-1.0, 0.0]), np.array([2.0, 0.5]), np.array([0.0, 0.1])
    for _ in range(50):
        one, other = (signals.drawn(rng, time, low, high, middle) for _ in range(2))
        mixed = signals.changed(rng, one, other, other, low, high)
        for ctrl in (one, mixed):
            assert (ctrl >= low - 1e-12).all() and (ctrl <= high + 1e-12).all()
            np.testing.assert_allclose(ctrl[[0, -1]], [middle, middle], atol=1e-12)
            assert np.ptp(ctrl, axis=0).min() > 0


@pytest.mark.parametrize("name", ["diagnosis.json", "nominal.xml", "recorded.json"])
def test_a_folder_that_is_no_report(tmp_path, old, name, capsys):
    folder = report(tmp_path / "report", old, [])
    (tmp_path / "report" / name).unlink()
    with pytest.raises(DesignError, match=name):
        Open.read(folder)
    assert command.main(["--next", folder]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert not (tmp_path / "report" / "next.csv").exists()


def test_next_takes_nothing_else(tmp_path, old, capsys):
    folder = report(tmp_path / "report", old, [])
    assert command.main(["--next", folder, "--seconds", "1e9"]) == 2
    assert command.main(["--next", folder, "--out", str(tmp_path)]) == 2
    assert "--seconds" in capsys.readouterr().err
