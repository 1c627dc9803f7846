"""The report: JSON against the contract's schema, whole files or none, and the page in a real browser."""

import errno
import itertools
import json
import os
import re
import shutil
import stat
import subprocess
from dataclasses import replace
from html.parser import HTMLParser

import mujoco
import numpy as np
import pytest
from contract import SCHEMA, conforms, contract
from malformed import ARM, arm
from report_example import example, finding, recordings

from diagnosis import findings
from diagnosis.effects import EFFECTS, unmodelled
from diagnosis.recordings import inverse_dynamics
from diagnosis.recordings.recording import Recording
from diagnosis.report import charts, experiments, mechanism, outlines, overlay, sections, writer
from diagnosis.report import text as wording
from diagnosis.simulation.simulator import World

EPOCH = 1.7e9  # s, of a clock that counts from 1970
BROWSER = next(
    (
        path
        for path in map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))
        if path
    ),
    None,
)


@pytest.fixture
def diagnosis():
    """A diagnosis as the estimator makes them, numbers made up."""
    return example()


@pytest.fixture
def matched(diagnosis):
    diagnosis.summary = {**diagnosis.summary, "verdict": "match", "findings": [], "warnings": []}
    diagnosis.settings = {}
    return diagnosis


# --- diagnosis.json ---


def strict(path):
    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    return json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)


def test_json_keeps_the_contract(diagnosis, tmp_path):
    writer.write(diagnosis, tmp_path / "report")
    contract(strict(tmp_path / "report/diagnosis.json"))


def test_json_is_strict():
    odd = {
        "a": np.float32(1.5),
        "b": np.nan,
        "c": np.int64(3),
        "d": (np.array([1.0, np.inf]), True),
        5: np.bool_(False),
    }
    assert json.loads(json.dumps(writer.plain(odd), allow_nan=False)) == {
        "a": 1.5,
        "b": None,
        "c": 3,
        "d": [[1.0, None], True],
        "5": False,
    }


# --- whole files or none ---


def test_three_files_and_the_unknown_curve(diagnosis, tmp_path):
    out = tmp_path / "a/b/report"
    assert writer.write(diagnosis, out) == [
        "report.html",
        "diagnosis.json",
        "corrected.xml",
        "unknown_1.csv",
    ]
    assert sorted(os.listdir(out)) == [
        "corrected.xml",
        "diagnosis.json",
        "report.html",
        "unknown_1.csv",
    ]
    assert (out / "corrected.xml").read_text() == diagnosis.corrected_xml
    mask = os.umask(0)
    os.umask(mask)
    assert stat.S_IMODE(os.stat(out / "report.html").st_mode) == 0o666 & ~mask
    writer.write(diagnosis, out)  # again, over the old ones
    assert len(os.listdir(out)) == 4


def test_only_own_curves_are_removed(diagnosis, tmp_path):
    """A user's recordings may have any name; what an earlier diagnosis here saved goes with it."""
    for name in ("unknown_1.csv", "unknown_load.csv", "unknown_7.csv"):
        (tmp_path / name).write_text("recorded")
    writer.write(diagnosis, tmp_path)
    assert strict(tmp_path / "diagnosis.json")["findings"][3]["saved_as"] == "unknown_2.csv"
    writer.write(diagnosis, tmp_path)
    assert "unknown_3.csv" not in os.listdir(tmp_path)
    diagnosis.summary["findings"].pop()
    writer.write(diagnosis, tmp_path)
    assert {name for name in os.listdir(tmp_path) if name.startswith("unknown")} == {
        "unknown_1.csv",
        "unknown_load.csv",
        "unknown_7.csv",
    }
    assert all(
        (tmp_path / name).read_text() == "recorded"
        for name in ("unknown_1.csv", "unknown_load.csv", "unknown_7.csv")
    )
    for rubbish in (
        "[]",
        "not JSON",
        '{"findings": [{"saved_as": "../run.csv"}, {"saved_as": "unknown_load.csv"}, 3]}',
    ):
        (tmp_path / "diagnosis.json").write_text(rubbish)
        writer.write(diagnosis, tmp_path)
    assert (tmp_path / "unknown_load.csv").exists()


@pytest.mark.parametrize(
    "variable, factor, wave, knots, header",
    [
        ("position:elbow", None, False, (-1.0, -0.2, 0.9), "position:elbow,force"),
        (
            "position:elbow",
            "velocity:shoulder",
            False,
            (-1.0, -0.2, 0.9),
            "position:elbow,sign(velocity:shoulder),force",
        ),
        ("time", "control:elbow_motor", False, (0.0, 1.0, 3.0), "time,control:elbow_motor,force"),
        (
            "time",
            "control:elbow_motor",
            False,
            (EPOCH, EPOCH + 1.0, EPOCH + 3.0),
            "time,control:elbow_motor,force",
        ),
        ("time", None, True, (0.0, 0.2), "time,force"),
    ],
)
def test_a_saved_curve_is_the_force_that_is_simulated(
    diagnosis, tmp_path, variable, factor, wave, knots, header
):
    """The force that the engine applies in the shoulder, at random states, from the rows of the file alone."""
    model, rng = arm(), np.random.default_rng(0)
    candidate = unmodelled.curve(model, "shoulder", variable, knots, factor, wave)
    values = rng.normal(size=len(knots))
    diagnosis.settings = {candidate: values}
    writer.write(diagnosis, tmp_path)
    assert (tmp_path / "unknown_1.csv").read_text().splitlines()[0] == header
    rows = np.loadtxt(tmp_path / "unknown_1.csv", delimiter=",", skiprows=1)
    force = candidate.effect.force([model], 0, values[None])
    for _ in range(50):
        (q, v, u), t = rng.uniform(-0.9, 0.9, (3, 1, 2)), max(knots[0], 0.0) + rng.uniform(0, 2.9)
        x, times = (
            (t if variable == "time" else q[0, 1]),
            {"": 1.0, "v": np.sign(v[0, 0]), "c": u[0, 1]}[(factor or "")[:1]],
        )
        some = rows[rows[:, 1] == 1] if factor else rows
        expected = force(q, v, u, np.array([t]))[0, 0]
        np.testing.assert_allclose(
            times * np.interp(x, some[:, 0], some[:, -1]), expected, atol=0.01 if wave else 1e-7
        )
        if factor:
            np.testing.assert_allclose(rows[rows[:, 1] == -1, -1], -some[:, -1])
    page = sections.html_page(diagnosis)
    assert ("Acts times the" in page) == bool(factor) and ("A sine of 0.800 s" in page) == wave


@pytest.mark.parametrize("fails", ["fsync", "replace"])
def test_a_full_disk_leaves_nothing(diagnosis, tmp_path, monkeypatch, fails):
    def full(*args):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, fails, full)
    with pytest.raises(writer.ReportError, match="No space left") as error:
        writer.write(diagnosis, tmp_path / "report")
    assert "\n" not in str(error.value) and not (tmp_path / "report").exists()
    (tmp_path / "kept").mkdir()
    (tmp_path / "kept/diagnosis.json").write_text("old")
    with pytest.raises(writer.ReportError):
        writer.write(diagnosis, tmp_path / "kept")
    assert (
        os.listdir(tmp_path / "kept") == ["diagnosis.json"]
        and (tmp_path / "kept/diagnosis.json").read_text() == "old"
    )


def test_a_really_full_disk(diagnosis):
    """The kernel's own ENOSPC, where this test may mount one megabyte."""
    if os.geteuid() != 0:
        pytest.skip("needs to mount")
    folder = "/tmp/full_disk_of_the_report_test"
    os.makedirs(folder, exist_ok=True)
    if subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", folder], capture_output=True
    ).returncode:
        os.rmdir(folder)
        pytest.skip("cannot mount")
    try:
        with pytest.raises(writer.ReportError, match="space"):
            writer.write(diagnosis, os.path.join(folder, "report"))
        assert os.listdir(folder) == []
        subprocess.run(["mount", "-o", "remount,ro", folder], check=True)
        with pytest.raises(writer.ReportError, match="cannot be written"):
            writer.check_folder(os.path.join(folder, "report"))
    finally:
        subprocess.run(["umount", folder], check=True)
        os.rmdir(folder)


def test_folder_is_checked_before_the_work(tmp_path):
    writer.check_folder(tmp_path / "new/deep")
    (tmp_path / "file").write_text("")
    for bad in ("file", "file/below"):
        with pytest.raises(writer.ReportError, match="not a folder"):
            writer.check_folder(tmp_path / bad)
    assert os.listdir(tmp_path) == ["file"]


# --- drawings ---


@pytest.mark.parametrize("low, high", [(0, 1), (-3.2, 7.9), (1e-6, 3e-6), (-1e5, 2e5)])
def test_ticks_are_round_and_inside(low, high):
    found = charts.ticks(low, high)
    assert 3 <= len(found) <= 11 and all(
        low - 1e-9 * abs(low) <= t <= high + 1e-9 * abs(high) for t in found
    )
    assert len({round(b - a, 12) for a, b in zip(found, found[1:])}) == 1 or low == 1e-6


def test_times_since_1970_can_be_read_from_an_axis():
    time = EPOCH + np.linspace(0.5, 8, 50)
    chart = charts.chart([charts.Series(time, np.sin(time), "measured")], "time (s)", "force")
    assert "time (s), from 1700000000 on" in chart and re.findall(
        r'text-anchor="middle">([\d.]+)<', chart
    ) == ["2", "4", "6", "8"]
    assert "from" not in charts.chart(
        [charts.Series(time - EPOCH, np.sin(time), "measured")], "time (s)", "force"
    )


def test_thinned_curves_keep_extremes_and_gaps():
    x = np.linspace(0, 1, 20000)
    y = np.sin(40 * x)
    y[5000], y[12000:12010] = 9.0, np.nan
    a, b = charts.thin(x, y)
    assert (
        len(a) < 1600
        and np.nanmax(b) == 9.0
        and np.nanmin(b) == np.nanmin(y)
        and np.isnan(b).any()
        and (np.diff(a) > 0).all()
    )


def test_hull_against_area_of_known_shapes():
    rng = np.random.default_rng(0)
    square = np.concatenate([rng.uniform(0, 1, (200, 2)), [[0, 0], [1, 0], [1, 1], [0, 1]]])
    corners = outlines.hull(square)
    assert sorted(map(tuple, corners)) == [(0, 0), (0, 1), (1, 0), (1, 1)]


def test_planar_mechanisms_are_seen_along_their_hinges():
    axes, towards = outlines.view(arm(), np.zeros(2))
    np.testing.assert_allclose(axes, [[1, 0, 0], [0, 0, 1]], atol=1e-12)  # x to the right, z up
    np.testing.assert_allclose(towards, [0, -1, 0], atol=1e-12)


def test_outline_of_a_rod_lies_where_the_kinematics_put_it():
    model = arm()
    axes, towards = outlines.view(model, np.zeros(2))
    angle = 0.7
    shapes = {
        g: outline
        for g, outline, _ in outlines.outlines(model, np.array([angle, 0.0]), axes, towards)
    }
    tip = -0.55 * np.array(
        [np.sin(angle), np.cos(angle)]
    )  # both rods in line: 0.3 + 0.25 m from the shoulder
    far = shapes[1][np.argmax(np.linalg.norm(shapes[1], axis=1))]
    assert abs(np.linalg.norm(far) - 0.565) < 1e-3 and np.linalg.norm(far - tip) < 0.02


def test_motion_starts_as_recorded_and_follows_stock_mujoco():
    model, recording = arm(), recordings(1, 3)[0]
    columns = overlay.columns_in(model, model)
    got = overlay.simulate(model, recording, 20, 60, columns)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = recording.qpos[20], recording.qvel[20]
    for row in range(20, 60):
        np.testing.assert_allclose(got[row - 20], data.qpos, atol=1e-9)
        data.ctrl[:] = recording.ctrl[row]
        mujoco.mj_step(model, data, nstep=5)


@pytest.mark.parametrize(
    "memory", ["dyntype='filter' dynprm='.2'", "dyntype='none' delay='.1' nsample='60'"]
)
def test_motion_runs_on_from_the_control_before_it(memory):
    """One that starts in the middle of a run of the model itself follows that run."""
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><option timestep=".002"/><worldbody><body><joint name="j" type="slide" axis="1 0 0" damping="1"/>
        <geom size=".1" mass="1"/></body></worldbody><actuator><general joint="j" gainprm="20" {memory}/></actuator></mujoco>""")
    data, rows = mujoco.MjData(model), 200
    ctrl = np.repeat(np.random.default_rng(0).uniform(-1, 1, rows // 20), 20)[:, None]
    ctrl[:20] = 0.0
    qpos, qvel = np.empty((2, rows, 1))
    for row in range(rows):
        qpos[row], qvel[row], data.ctrl[:] = data.qpos, data.qvel, ctrl[row]
        mujoco.mj_step(model, data, nstep=5)
    recording = Recording("r", 0.01 * np.arange(rows), qpos, qvel, ctrl)
    columns = overlay.columns_in(model, model)
    for first in (0, 95):
        np.testing.assert_allclose(
            overlay.simulate(model, recording, first, 199, columns), qpos[first:], atol=0.01
        )
    assert abs(qpos).max() > 0.1


def test_sides_of_a_cube_are_files_too(tmp_path):
    xml = f'<mujoco><compiler texturedir="{tmp_path}/t"/><asset><texture name="c" type="cube" fileright="a.png"/></asset></mujoco>'
    assert 'texturedir="t"' in writer.portable(xml, tmp_path)


@pytest.mark.parametrize("used", [True, False])
def test_corrected_file_finds_meshes_from_the_report_wherever_both_go(tmp_path, used):
    parts, out = tmp_path / "here/model/parts & more", tmp_path / "here/report"
    parts.mkdir(parents=True)
    out.mkdir()
    (parts / "tetra.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    mesh, geom = (
        ('<asset><mesh name="t" file="tetra.obj"/></asset>', 'type="mesh" mesh="t"')
        if used
        else ("", 'size=".1"')
    )
    (
        parts.parent / "sim.xml"
    ).write_text(f"""<mujoco><compiler meshdir="parts &amp; more"/>{mesh}<worldbody><body><joint/><geom {geom}/></body>
        </worldbody></mujoco>""")
    world = World.load(parts.parent / "sim.xml")
    text = writer.portable(
        world.corrected_xml({world.candidate("coulomb_friction", "0"): (0.5,)})[0], out
    )
    (out / "corrected.xml").write_text(text)
    assert str(tmp_path) not in text and ("meshdir" in text) == used
    (tmp_path / "here").rename(tmp_path / "there")
    assert (
        mujoco.MjModel.from_xml_path(str(tmp_path / "there/report/corrected.xml")).dof_frictionloss[
            0
        ]
        == 0.5
    )


def test_overlay_finds_recorded_joints_in_a_model_with_more(diagnosis):
    spec = mujoco.MjSpec.from_string(diagnosis.corrected_xml)
    spec.body("upper").add_joint(name="backlash", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 1, 0])
    qpos, dof = overlay.columns_in(spec.compile(), arm())
    assert qpos.tolist() == [0, 2] == dof.tolist()


def test_marks_of_actuators_that_drive_no_joint():
    """A thruster is marked at its site, a tendon at its end, and one that drives a body nowhere."""
    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><site name="wall" pos="1 0 0"/><body name="b" pos="0 0 .5"><joint name="j"/>
        <geom size=".1"/><site name="rotor" pos=".3 0 0"/></body></worldbody><tendon><spatial name="t"><site site="wall"/><site site="rotor"/>
        </spatial><fixed name="f"><joint joint="j" coef="1"/></fixed></tendon><actuator><motor name="thrust" site="rotor"/><motor name="rope"
        tendon="t"/><motor name="belt" tendon="f"/><adhesion name="glue" body="b" ctrlrange="0 1"/></actuator></mujoco>""")
    data = outlines.posed(model, model.qpos0)
    points = {}
    for name in ("thrust", "rope", "belt", "glue"):
        _, point = mechanism.marked(model, {"kind": "actuator", "name": name})
        points[name] = None if point is None else point(data).tolist()
    assert points == {
        "thrust": [0.3, 0, 0.5],
        "rope": [0.3, 0, 0.5],
        "belt": [0, 0, 0.5],
        "glue": None,
    }


def test_leftover_force_is_the_one_that_was_left_out():
    """Recorded with viscous damping 0.3, nominal without: the residual is -0.3 times the velocity, the corrected one's none."""

    def made(damping):
        return mujoco.MjModel.from_xml_string(ARM.replace('damping="0.05"', f'damping="{damping}"'))

    truth, rows, data = made(0.3), [], None
    data = mujoco.MjData(truth)
    for k in range(3000):
        data.ctrl[:] = np.sin(3 * data.time), 0.3 * np.sin(7 * data.time)
        if k % 5 == 0:
            rows.append([data.time, *data.qpos, *data.qvel, *data.ctrl])
        mujoco.mj_step(truth, data)
    rows = np.array(rows)
    time, qpos, qvel, qacc, ctrl = inverse_dynamics.smooth(
        truth, Recording("r", rows[:, 0], rows[:, 1:3], rows[:, 3:5], rows[:, 5:7]), 300
    )
    np.testing.assert_allclose(qvel, rows[np.searchsorted(rows[:, 0], time - 1e-9), 3:5], atol=0.05)
    missing = inverse_dynamics.forces(made(0.0), qpos, qvel, qacc, ctrl)
    np.testing.assert_allclose(missing, -0.3 * qvel, atol=0.05)
    assert (
        np.abs(inverse_dynamics.forces(truth, qpos, qvel, qacc, ctrl)).max()
        < 0.05
        < 0.3 * np.abs(qvel).max() / 5
    )


def test_recordings_too_short_to_smooth_add_nothing(diagnosis):
    """Beside good ones, one of a few rows and one full of holes: no rows, of the same widths, and the page comes out."""
    [good], model = diagnosis.held_out, arm()
    short = replace(
        good,
        name="short.csv",
        time=good.time[:5],
        qpos=good.qpos[:5],
        qvel=good.qvel[:5],
        ctrl=good.ctrl[:5],
    )
    holed = replace(
        good,
        name="holed.csv",
        qpos=np.where(np.arange(len(good.time))[:, None] % 3, good.qpos, np.nan),
    )
    for poor in (short, holed):
        assert [x.shape for x in inverse_dynamics.smooth(model, poor, 100)] == [
            (0,),
            (0, 2),
            (0, 2),
            (0, 2),
            (0, 2),
        ]
    alone = inverse_dynamics.residuals(diagnosis, 300)
    diagnosis.held_out = [short, good, holed]
    assert [len(r["x"]) for r in inverse_dynamics.residuals(diagnosis, 900 - 3)] == [
        len(r["x"]) for r in alone
    ] and alone
    assert "force left at elbow" in sections.html_page(diagnosis)


def test_rows_before_a_held_out_tail_are_not_drawn(diagnosis):
    [whole] = diagnosis.held_out
    tail = replace(whole, start=150, qpos=np.where(np.arange(300)[:, None] < 150, 99.0, whole.qpos))
    diagnosis.held_out = [tail]
    assert (
        np.abs(overlay.poses(arm(), [tail])).max() < 20
        and min(r["x"].max() for r in inverse_dynamics.residuals(diagnosis)) < 20
    )
    name, begin, _, motions = overlay.overlay(diagnosis)
    assert (
        name == whole.name and begin >= whole.time[150] and np.abs(motions["measured"]).max() < 20
    )
    assert f"Held out: {whole.name} from 1.50 s on." in sections.html_page(diagnosis)


def test_what_the_corrected_file_cannot_hold_is_not_drawn_as_corrected(diagnosis):
    diagnosis.summary["findings"] = [{**diagnosis.summary["findings"][0], "written_as": "none"}]
    assert all(
        np.isnan(r["after"]).all() and np.isfinite(r["before"]).all()
        for r in inverse_dynamics.residuals(diagnosis)
    )
    assert set(overlay.overlay(diagnosis)[3]) == {"measured", "nominal"}
    assert "by the corrected one" not in sections.html_page(diagnosis)


def test_the_experiment_for_two_rivals():
    rival = {"effect": "lag", "place": {"kind": "actuator", "name": "drive"}}
    (line,) = experiments.advice(
        [
            {
                "effect": "delay",
                "place": {"kind": "actuator", "name": "drive"},
                "also_possible": [rival],
            },
            {"effect": "mass", "place": {"kind": "body", "name": "torso"}, "also_possible": []},
        ]
    )
    assert line.startswith("Delay of actuator drive or lag of actuator drive: drive with a sine")


def test_every_listed_pair_of_rivals_has_an_experiment_of_its_own():
    """Whichever of the two is the finding; and every effect of the table is one of the catalogue."""
    known = {effect.name for effect in EFFECTS}
    for effects, way in experiments.SEPARATING:
        assert effects <= known, effects - known
        for one, other in itertools.permutations(effects, 2):
            lines = [
                experiments.advice(
                    [
                        {
                            "effect": a,
                            "place": {"kind": "body", "name": "x"},
                            "also_possible": [
                                {"effect": b, "place": {"kind": "body", "name": "x"}}
                            ],
                        }
                    ]
                )[0]
                for a, b in ((one, other), (other, one))
            ]
            assert (
                lines[0].split(": ", 1)[1] == lines[1].split(": ", 1)[1]
                and experiments.OTHERWISE not in lines[0]
            )


# --- the page ---


class Tags(HTMLParser):
    """Checks that tags close in order, and gathers addresses."""

    def __init__(self):
        super().__init__()
        self.open, self.addresses = [], []

    def handle_starttag(self, tag, attrs):
        self.addresses += [
            value for key, value in attrs if key in ("src", "href", "action", "data")
        ]
        if tag not in ("meta", "link", "br", "input"):
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        pass

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


@pytest.mark.parametrize("kind", ["diagnosis", "matched"])
def test_page_is_well_formed_and_self_contained(kind, request):
    page = sections.html_page(request.getfixturevalue(kind))
    tags = Tags()
    tags.feed(page)
    assert tags.open == [] and set(tags.addresses) == {"data:,"}
    assert not re.search(r"https?://|url\(|@import", page)
    assert len(page) < 2_000_000 and "nan" not in re.findall(r'd="([^"]*)"', page)
    assert "<stays>" not in page


def test_page_says_it_all(diagnosis):
    page = sections.html_page(diagnosis)
    for words in (
        "joint elbow: Coulomb friction 0.120 ± 0.004 N·m was left out",
        "dead zone",
        "push the joint by hand with the actuator off",
        "has no plain MJCF form",
        "unexplained",
        "&lt;stays&gt;",
        "run5.csv",
        "error (× noise)",
        "force (N·m)",
        "a force that the catalogue has no name for",
        "force left at elbow (N·m)",
        "badmark",
        "gyro &lt;1&gt;",
        "3 of 40 windows blow up under the nominal model: from then on they are left out of its line.",
    ):
        assert words in page, words


def test_what_was_found_is_among_the_candidates_whatever_its_rank(diagnosis):
    found, other = diagnosis.ranking
    weak = [
        {
            **other,
            "effect": "gain",
            "place": {"kind": "actuator", "name": f"motor{k}"},
            "error_removed": 0.7,
        }
        for k in range(20)
    ]
    diagnosis.ranking = [*weak, found]
    page = sections.html_page(diagnosis).partition("Candidates")[2]
    assert "motor14" in page and "motor15" not in page and "Coulomb friction<small>" in page


def test_where_and_when_in_words():
    assert (
        wording.when_words({"qpos:elbow": [0.4, 0.8]})
        == ", where the position of elbow is between 0.400 and 0.800"
    )
    assert (
        wording.when_words({"qvel:elbow": [0, 2]})
        == ", where the velocity of elbow is between 0 and 2.00"
    )
    assert (
        wording.when_words({"recording": "run3.csv", "time": [2.0, 7.5]})
        == ", in run3.csv from 2.00 to 7.50 s"
    )
    assert wording.when_words(None) == ""


def test_a_stop_on_one_side_and_a_model_that_blows_up(diagnosis, tmp_path):
    """JSON keeps numbers where the contract has them; page and terminal say it in words."""
    stop = finding(
        "joint_stop",
        "joint",
        "elbow",
        0.0,
        0.0,
        0.0,
        "rad",
        parameters=[
            {
                "name": "low",
                "nominal": -np.inf,
                "value": -1e6,
                "low": -1e6,
                "high": -1e6,
                "unit": "rad",
            },
            {
                "name": "high",
                "nominal": np.inf,
                "value": 0.5,
                "low": 0.49,
                "high": 0.51,
                "unit": "rad",
            },
        ],
    )
    held = diagnosis.summary["fit"]["held_out"]
    diagnosis.summary["findings"] = [stop]
    held["before"], held["channels"]["qpos:elbow"]["before"] = np.inf, np.inf
    writer.write(diagnosis, tmp_path)
    written = strict(tmp_path / "diagnosis.json")
    assert (
        written["findings"][0]["parameters"][0]["value"] == -1e6
        and written["fit"]["held_out"]["before"] is None
    )
    conforms(written["findings"], SCHEMA["findings"])
    page = (tmp_path / "report.html").read_text()
    assert (
        "joint stop high 0.500 ± 0.010 rad was left out (no stop below)" in page
        and "<td>no stop below</td>" in page
    )
    assert (
        "is 2.0 mrad at elbow, where the nominal model blows up" in page
        and "1000000" not in page
        and "nan %" not in page
    )
    assert "the nominal model blows up" in wording.terminal(written, "out", ["report.html"])


def test_findings_tell_where_a_curve_has_its_knots_and_keep_numbers():
    stop, curve = (
        World(mujoco.MjSpec.from_string(ARM)).candidate("joint_stop", "shoulder"),
        unmodelled.curve(arm(), "elbow", "time", (0.0, 2.0, 3.0)),
    )
    assert [p["at"] for p in findings.parameters_of(curve, (1.0, 2.0, 3.0))] == [0.0, 2.0, 3.0]
    assert [p["value"] for p in findings.parameters_of(stop, (-np.inf, 0.5))] == [-1e6, 0.5]
    inf = np.inf
    assert [
        findings.removed(*errors)
        for errors in ((3, 1, 4), (inf, 1, inf), (inf, 1, 4), (3, inf, 4), (inf, inf, inf))
    ] == [0.5, 1, 1, -1, 0]
    assert [
        findings.unexplained(*errors)
        for errors in (
            (10, 1, 1, 0),
            (inf, inf, 1, 1),
            (inf, 2, 1, 1),
            (2, inf, 1, 1),
            (10, 6, 4, 0),
            (10, 6, 4, 5),
        )
    ] == [0, 1, 0, 1, 0.2, 0.1]


def test_page_of_a_match_claims_nothing(matched):
    page = sections.html_page(matched)
    assert (
        "Nothing is missing" in page
        and "What is wrong" not in page
        and 'class="badmark"' not in page
    )


PROBE = """<script>
const problems = [];
addEventListener("error", e => problems.push(String(e.message)), true);
addEventListener("unhandledrejection", e => problems.push(String(e.reason)));
addEventListener("load", () => setTimeout(() => {
  const wide = [...document.querySelectorAll("main *")].filter(e => !e.closest(".scroll") && e.getBoundingClientRect().right > innerWidth + 1);
  const result = {width: innerWidth, page: document.documentElement.scrollWidth, wide: wide.map(e => e.tagName + "." + e.className),
    fetched: performance.getEntriesByType("resource").map(r => r.name).filter(n => !n.startsWith("data:")), problems,
    charts: document.querySelectorAll("svg").length, layers: [...document.querySelectorAll(".layer")].map(e => e.getAttribute("d").length)};
  parent.postMessage("PROBE" + JSON.stringify(result) + "END", "*");
}, 300));
</script>"""
PHONE = """<!DOCTYPE html><body style="margin:0"><p></p><iframe src="page.html" width="390" height="844" style="border:0"></iframe>
<script>addEventListener("message", e => { document.querySelector("p").textContent = e.data; });</script>"""  # no window is as narrow


@pytest.mark.skipif(BROWSER is None, reason="no browser")
@pytest.mark.parametrize("kind", ["diagnosis", "matched"])
def test_page_in_a_browser_on_a_phone(kind, request, tmp_path):
    page = sections.html_page(request.getfixturevalue(kind))
    (tmp_path / "page.html").write_text(
        page.replace("<style>", PROBE + "<style>", 1), encoding="utf-8"
    )
    (tmp_path / "phone.html").write_text(PHONE)
    done = subprocess.run(
        [
            BROWSER,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-background-networking",
            "--enable-logging=stderr",
            f"--user-data-dir={tmp_path / 'profile'}",
            "--window-size=800,900",
            "--virtual-time-budget=3000",
            "--dump-dom",
            f"file://{tmp_path / 'phone.html'}",
        ],
        capture_output=True,
        text=True,
        timeout=60,
    )
    found = re.search(r"PROBE(\{.*\})END", done.stdout)
    assert found, done.stderr[-2000:]
    result = json.loads(
        found.group(1).replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&")
    )
    assert "CONSOLE" not in done.stderr, [
        line for line in done.stderr.splitlines() if "CONSOLE" in line
    ]
    assert result["problems"] == [] and result["fetched"] == []
    assert result["page"] <= result["width"] and result["wide"] == [], result
    assert result["width"] == 390 and result["charts"] > 4 and all(result["layers"]), result
