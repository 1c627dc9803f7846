"""diagnosis.json and the files beside it: strict JSON by the schema, whole files or none."""

import errno
import json
import os
import stat
import subprocess

import mujoco
import numpy as np
import pytest
from arm import arm
from contract import contract, strict

from diagnosis.effects import unmodelled
from diagnosis.report import sections, writer
from diagnosis.simulation.simulator import World

EPOCH = 1.7e9  # s, of a clock that counts from 1970


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
        (
            "position:elbow",
            "speed:shoulder",
            False,
            (-1.0, -0.2, 0.9),
            "position:elbow,abs(velocity:shoulder),force",
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
        (
            "position:elbow",
            "speed:shoulder",
            True,
            (0.0, 0.2),
            "position:elbow,abs(velocity:shoulder),force",
        ),
    ],
)
def test_a_saved_curve_is_the_force_that_is_simulated(
    diagnosis, tmp_path, variable, factor, wave, knots, header
):
    """The force that the engine applies in the shoulder, at random states, from the rows of the
    file alone."""
    model, rng = arm(), np.random.default_rng(0)
    candidate = unmodelled.curve(model, "shoulder", variable, knots, factor, wave)
    values = rng.normal(size=len(knots))
    diagnosis.settings = {candidate: values}
    writer.write(diagnosis, tmp_path)
    assert (tmp_path / "unknown_1.csv").read_text().splitlines()[0] == header
    rows = np.loadtxt(tmp_path / "unknown_1.csv", delimiter=",", skiprows=1)
    force = candidate.effect.force([model], 0, values[None])
    travel = (
        [r.qpos[:, 1] for r in [*diagnosis.train, *diagnosis.held_out]] if wave else [0.9, -0.9]
    )
    low, high = np.min(travel), np.max(travel)  # a wave is told over what was recorded
    for _ in range(50):
        (q, v, u), t = rng.uniform(-0.9, 0.9, (3, 1, 2)), max(knots[0], 0.0) + rng.uniform(0, 2.9)
        q[0, 1] = np.clip(q[0, 1], low, high)
        x, times = (
            (t if variable == "time" else q[0, 1]),
            {"": 1.0, "v": np.sign(v[0, 0]), "s": abs(v[0, 0]), "c": u[0, 1]}[(factor or "")[:1]],
        )
        some = rows[rows[:, 1] == 1] if factor else rows
        expected = force(q, v, u, np.array([t]))[0, 0]
        np.testing.assert_allclose(
            times * np.interp(x, some[:, 0], some[:, -1]), expected, atol=0.01 if wave else 1e-7
        )
        if factor:
            least = 0.0 if factor.startswith("speed") else -1.0
            np.testing.assert_allclose(rows[rows[:, 1] == least, -1], least * some[:, -1])
    page = sections.html_page(diagnosis)
    assert ("Acts times the" in page) == bool(factor) and ("A sine of 0.800 " in page) == wave
    assert ("A sine of 0.800 rad" in page) == (wave and variable != "time")


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


def test_sides_of_a_cube_are_files_too(tmp_path):
    cube = '<asset><texture name="c" type="cube" fileright="a.png"/></asset>'
    xml = f'<mujoco><compiler texturedir="{tmp_path}/t"/>{cube}</mujoco>'
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
    compiler = '<compiler meshdir="parts &amp; more"/>'
    body = f"<worldbody><body><joint/><geom {geom}/></body></worldbody>"
    (parts.parent / "sim.xml").write_text(f"<mujoco>{compiler}{mesh}{body}</mujoco>")
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
