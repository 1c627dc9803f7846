import glob
import io
import os
import sys
import time
import types
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from arm import ARM, HEADER, archive, arm, run, text, whole
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from diagnosis.recordings import unit_check
from diagnosis.recordings.columns import columns_of
from diagnosis.recordings.plausibility import check
from diagnosis.recordings.recording import Recording, RecordingError, accepted, load

REAL = str(Path(__file__).resolve().parents[4] / "shared" / "recordings")
FREE = """
<mujoco><worldbody>
  <geom type="plane" size="1 1 1"/>
  <body><freejoint name="cube"/><geom type="box" size=".1 .1 .1"/></body>
  <body><joint type="ball"/><geom size=".1" pos="0 0 1"/></body>
  <body><joint type="slide" axis="0 0 1"/><geom size=".1" pos="0 0 2"/></body>
</worldbody><actuator><motor joint="a:b"/></actuator></mujoco>
""".replace('<joint type="slide"', '<joint name="a:b" type="slide"')


@pytest.fixture(scope="module")
def model():
    return arm()


@pytest.fixture(scope="module")
def good():
    return run()


def put(folder, data, name="run.csv"):
    (folder / name).write_bytes(data)
    return folder / name


def recording(table, name="run.csv"):
    return Recording(name, table[:, 0], table[:, 1:3], table[:, 3:5], table[:, 5:7])


def test_csv_and_npz_hold_the_same(tmp_path, model, good):
    (a,) = load(put(tmp_path, text(good)), model)
    (b,) = load(str(put(tmp_path, archive(**whole(good)), "run.npz")), model)
    assert (a.name, b.name) == ("run.csv", "run.npz")
    for field in ("time", "qpos", "qvel", "ctrl"):
        np.testing.assert_allclose(getattr(a, field), getattr(b, field), rtol=1e-8, atol=1e-12)
    np.testing.assert_array_equal(b.qpos, good[:, 1:3])


def test_time_counts_from_the_first_row_and_its_stamp_is_kept(tmp_path, model, good):
    """Clocks of loggers count from 1970."""
    late = good.copy()
    late[:, 0] += 1.75e9
    (there,) = load(put(tmp_path, archive(**whole(late)), "run.npz"), model)
    np.testing.assert_allclose(there.time, good[:, 0] - good[0, 0], atol=1e-6)
    assert there.origin == late[0, 0] and there.part(5, None).origin == there.origin


def test_columns_in_any_order_by_name_or_index(tmp_path, model, good):
    order = [5, 2, 0, 6, 1]
    names = {"qpos:elbow": "qpos:1", "ctrl:shoulder_motor": "ctrl:0"}
    data = text(good[:, order], [names.get(HEADER[k], " " + HEADER[k]) for k in order])
    (got,) = load(
        put(tmp_path, b"\xef\xbb\xbf" + data.replace(b"\n", b"\r\n")), model
    )  # and as Excel would write it
    np.testing.assert_allclose(got.qpos, good[:, 1:3], rtol=1e-8)
    np.testing.assert_allclose(got.ctrl, good[:, 5:7], rtol=1e-8)
    assert np.isnan(got.qvel).all()


def test_empty_cells_and_nan_are_not_measured(tmp_path, model, good):
    lines = text(good).decode().split("\n")
    cells = lines[4].split(",")
    lines[4] = ",".join([cells[0], "", "NaN", *cells[3:]])
    (got,) = load(put(tmp_path, "\n".join(lines).encode()), model)
    assert np.isnan(got.qpos[3]).all() and np.isfinite(np.delete(got.qpos, 3, 0)).all()
    np.testing.assert_allclose(got.ctrl, good[:, 5:7], rtol=1e-8)


def test_free_ball_and_sensor_columns(tmp_path):
    model = mujoco.MjModel.from_xml_string(FREE)
    names = list(columns_of(model))
    assert names == [
        *(f"qpos:cube:{k}" for k in range(7)),
        *(f"qvel:cube:{k}" for k in range(6)),
        *(f"qpos:1:{k}" for k in range(4)),
        *(f"qvel:1:{k}" for k in range(3)),
        "qpos:a:b",
        "qvel:a:b",
        "ctrl:0",
    ]
    rng = np.random.default_rng(0)
    rows, qpos = 30, rng.normal(size=(30, model.nq))
    for start in (3, 7):
        qpos[:, start : start + 4] /= np.linalg.norm(
            qpos[:, start : start + 4], axis=1, keepdims=True
        )
    table = np.column_stack([np.arange(rows) * 0.01, qpos, rng.normal(size=(rows, 1))])
    header = ["time", *(n for n in names if n.startswith(("qpos", "ctrl")))]
    (got,) = load(put(tmp_path, text(table, header)), model)
    np.testing.assert_allclose(got.qpos, qpos, rtol=1e-7)
    table[4, 5] += 3
    with pytest.raises(RecordingError, match="row 6.*quaternion"):
        load(put(tmp_path, text(table, header)), model)
    table[4, 5] = np.nan
    with pytest.raises(RecordingError, match="row 6.*partly nan"):
        load(put(tmp_path, text(table, header)), model)
    with pytest.raises(RecordingError, match="7 components"):
        load(put(tmp_path, text(table, ["time", "qpos:cube", *header[2:]])), model)


def test_an_actuator_without_input_has_no_control():
    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><body><joint name="j"/><geom
    size=".1"/></body></worldbody><actuator>
        <dcmotor name="drag" joint="j" input="none" motorconst=".1 .1" resistance="1"/><motor
        name="m" joint="j"/></actuator></mujoco>""")
    assert list(columns_of(model)) == ["qpos:j", "qvel:j", "ctrl:m"]


def test_sensors(tmp_path, model, good):
    (got,) = load(
        put(tmp_path, text(np.column_stack([good, good[:, 1]]), [*HEADER, "sensor:encoder"])), model
    )
    np.testing.assert_allclose(got.sensors["encoder"], good[:, 1:2], rtol=1e-8)
    (got,) = load(
        put(tmp_path, archive(**whole(good), **{"sensor:encoder": good[:, 1]}), "run.npz"), model
    )
    np.testing.assert_array_equal(got.sensors["encoder"], good[:, 1:2])


class Minari(types.ModuleType):
    """As much of the optional package as the reader uses, holding two episodes of a Hopper-like
    observation."""

    def __init__(self, infos):
        super().__init__("minari")
        seen = np.arange(33, dtype=float).reshape(11, 3)  # qpos without its first, then qvel
        seen[5, 2] = 10.0  # clipped
        actions = np.arange(20, dtype=float).reshape(10, 2)
        self.episodes = [
            types.SimpleNamespace(id=k, observations=seen, actions=actions, infos=infos)
            for k in range(2)
        ]

    def load_dataset(self, name):
        if name != "arm/random-v0":
            raise ValueError(f"no local dataset {name}")
        env = types.SimpleNamespace(unwrapped=types.SimpleNamespace(dt=0.05), close=lambda: None)
        return types.SimpleNamespace(
            recover_environment=lambda: env, iterate_episodes=lambda: iter(self.episodes)
        )


def test_minari_episodes(model, monkeypatch):
    monkeypatch.setitem(sys.modules, "minari", Minari(None))
    first, second = load("arm/random-v0", model)
    assert (first.name, second.name) == ("random-v0:0", "random-v0:1")
    np.testing.assert_allclose(first.time, 0.05 * np.arange(11))
    assert np.isnan(first.qpos[:, 0]).all() and first.qpos[3, 1] == 9.0
    assert (
        first.qvel[4].tolist() == [13.0, 14.0]
        and np.isnan(first.qvel[5, 1])
        and np.isnan(first.qvel[3, 0])
    )
    assert first.ctrl[-1].tolist() == first.ctrl[-2].tolist() == [18.0, 19.0]
    infos = {"qpos": np.ones((11, 2)), "qvel": np.zeros((11, 2))}
    monkeypatch.setitem(sys.modules, "minari", Minari(infos))
    assert (load("arm/random-v0", model)[1].qpos == 1).all()
    with pytest.raises(RecordingError, match="arm/expert-v0.*not a readable Minari dataset"):
        load("arm/expert-v0", model)
    dataset = Minari(None)
    dataset.episodes[1].actions = {"arm": np.zeros((10, 2))}
    monkeypatch.setitem(sys.modules, "minari", dataset)
    with pytest.raises(RecordingError, match="arm/random-v0: not a readable Minari dataset"):
        load("arm/random-v0", model)
    dataset.episodes.clear()
    with pytest.raises(RecordingError, match="arm/random-v0: the dataset holds no episodes"):
        load("arm/random-v0", model)


def test_a_recording_made_in_python_keeps_gains_and_notes(model, good):
    more = {"gains": {"elbow": {"kp": 20.0, "kd": 0.5}}, "notes": ("in degrees, perhaps",)}
    got = accepted(replace(recording(good), **more), model)
    assert (got.gains, got.notes) == (more["gains"], more["notes"])


def test_files_of_one_name_are_told_apart(tmp_path, model, good):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        put(tmp_path / folder, text(good))
    assert [r.name for r in load([tmp_path / "a/run.csv", tmp_path / "b/run.csv"], model)] == [
        "a/run.csv",
        "b/run.csv",
    ]


def test_as_many_folders_as_it_takes_tell_files_apart(tmp_path, model, good):
    paths = [tmp_path / day / "run" / "data.csv" for day in ("day1", "day2")]
    for path in paths:
        path.parent.mkdir(parents=True)
        path.write_bytes(text(good))
    link = tmp_path / "run3.csv"
    link.symlink_to(put(tmp_path, text(good), "stored.csv"))
    assert [r.name for r in load([*paths, link], model)] == [
        "day1/run/data.csv",
        "day2/run/data.csv",
        "run3.csv",
    ]


@pytest.mark.parametrize("hertz, rate", [(7, 50), (13, 100), (2.5, 20)])
def test_fast_motion_in_few_rows_is_motion(hertz, rate):
    slow = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="j"/><geom size=".1"/></body></worldbody></mujoco>'
    )
    time, noise = (
        np.arange(10 * rate) / rate,
        1e-4 * np.random.default_rng(0).normal(size=(10 * rate, 1)),
    )
    still = Recording(
        "run.csv", time, noise, np.full((len(time), 1), np.nan), np.zeros((len(time), 0))
    )
    with pytest.raises(RecordingError, match="nothing moves beyond the sensors' noise"):
        check([still], slow)
    assert (
        check([replace(still, qpos=noise + 0.3 * np.sin(2 * np.pi * hertz * time)[:, None])], slow)
        == []
    )


def test_who_turns_on_while_not_measured_is_not_wrapped():
    wheel = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="j"/><geom size=".1"/></body></worldbody></mujoco>'
    )
    time = 0.01 * np.arange(500)
    qpos = (10 * time + 0.3 * np.sin(3 * time))[:, None]
    qpos[200:262] = np.nan
    turning = Recording("run.csv", time, qpos, np.full((500, 1), np.nan), np.zeros((500, 0)))
    [note] = check([turning], wheel)
    assert "nan in 12 % of its rows" in note
    wrapped = (qpos + np.pi) % (2 * np.pi) - np.pi
    with pytest.raises(RecordingError, match="a wrapped angle"):
        check([replace(turning, qpos=wrapped)], wheel)


def test_a_name_of_any_bytes(tmp_path, model, good):
    path = os.path.join(os.fsencode(tmp_path), b"run\xff.csv")
    with open(path, "wb") as stream:
        stream.write(text(good))
    load(os.fsdecode(path), model)[0].name.encode("utf-8")  # a report can be written


def test_two_hundred_thousand_rows_in_seconds(tmp_path, model):
    rows = 200_000
    table = np.column_stack(
        [np.arange(rows) * 0.001, np.random.default_rng(0).normal(size=(rows, 6))]
    )
    stream = io.BytesIO()
    np.savetxt(stream, table, delimiter=",", header=",".join(HEADER), comments="", fmt="%.7g")
    path = put(tmp_path, stream.getvalue())
    start = time.perf_counter()
    assert load(path, model)[0].qpos.shape == (rows, 2)
    assert time.perf_counter() - start < 6


def test_a_sound_recording_raises_no_doubt(model, good):
    assert check([recording(good)], model) == []
    assert check([recording(run(seed=s), f"run{s}.csv") for s in range(1, 4)], model) == []


def test_irregular_sampling_is_sound(model, good):
    keep = np.sort(np.random.default_rng(0).choice(len(good), 250, replace=False))
    assert not [w for w in check([recording(good[keep])], model) if "gap" not in w]


@pytest.mark.parametrize("rig", ["arm_pendulum_single", "cube_toss", "double_pendulum", "emps"])
def test_real_recordings_are_not_refused(rig):
    folder = os.path.join(REAL, rig)
    if not os.path.isdir(folder):
        pytest.skip("recordings are not here")
    for path in glob.glob(os.path.join(folder, "model*.xml")):
        model = mujoco.MjModel.from_xml_path(path)
        check(load(sorted(glob.glob(os.path.join(folder, "*.csv"))), model), model)


def test_warnings(model, good):
    def said(table):
        return " | ".join(check([recording(table)], model))

    saturated = good.copy()
    saturated[:, 6] = np.clip(5 * good[:, 6], -1, 1)
    assert "ctrl:elbow_motor stays at its extreme" in said(saturated) and "ctrlrange" in said(
        saturated
    )
    outside = good.copy()
    outside[:, 6] *= 8
    assert "leaves the model's ctrlrange" in said(outside)
    constant = good.copy()
    constant[:, 6] = 0.2
    assert "ctrl:elbow_motor is constant at 0.2" in said(constant)
    clipped = good.copy()
    clipped[:, 1] = np.minimum(good[:, 1], 0.7 * good[:, 1].max())
    clipped[:, 3] = np.nan
    assert "qpos:shoulder stays at its extreme" in said(clipped)
    holes = good.copy()
    holes[50:150, 2] = np.nan
    assert "qpos:elbow has nan in 25 % of its rows" in said(holes)
    unmeasured = good.copy()
    unmeasured[:, 2] = unmeasured[:, 4] = np.nan
    assert "qpos:elbow is not measured" in said(unmeasured)
    assert "gap of" in said(np.delete(good, slice(100, 107), 0))
    still = good[:60].copy()
    still[:, 1:] = 0
    assert "nothing moves" in " | ".join(
        check([recording(good), recording(still, "still.csv")], model)
    )


def test_positions_that_the_model_cannot_have(model, good):
    far = good.copy()
    far[:, 2] += 5
    assert (
        "qpos:elbow is far outside the joint's range in the model, -2.9 to 2.9, in"
        in " | ".join(check([recording(far[:, :7])], model))
    )
    cube = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><geom name="floor" type="plane"
    size="1 1 1"/><body pos="0 0 .1">
        <freejoint name="cube"/><geom name="box" type="box" size=".1 .1
        .1"/></body></worldbody></mujoco>""")
    t = 0.01 * np.arange(100)
    qpos = np.stack([t, 0 * t, 0.1 + 0 * t, 1 + 0 * t, 0 * t, 0 * t, 0 * t], axis=1)
    slides = Recording("slide.csv", t, qpos, np.full((100, 6), np.nan), np.zeros((100, 0)))
    assert "overlap" not in " | ".join(check([slides], cube))
    qpos[:, 2] -= 0.1  # measured from the corner instead of the centre
    assert "floor and box overlap by 0.1 m and more in 100 % of the rows" in " | ".join(
        check([slides], cube)
    )


def test_same_warning_for_many_files_is_one_line(model, good):
    many = []
    for k in range(5):
        table = good[k:].copy()
        table[:, 6] = 0
        table[20 : 40 + 10 * k, 1] = np.nan
        many.append(recording(table, f"run{k}.csv"))
    assert check(many, model) == [
        "run0.csv and 4 more: qpos:shoulder has nan in up to 15 % of its rows",
        "run0.csv and 4 more: ctrl:elbow_motor is constant at 0; nothing can be said about what "
        "only it would show",
    ]


def test_a_recording_is_not_judged_by_its_own_copy(tmp_path, model, good):
    for name in ("run.csv", "copy.csv"):
        put(tmp_path, text(good), name)
    with pytest.raises(
        RecordingError, match="copy.csv: holds the same rows as run.csv; give it once"
    ):
        check(load([tmp_path / "run.csv", tmp_path / "copy.csv"], model), model)


@pytest.mark.parametrize("above", [b"# ", b"# by hand\n# on a Monday, in rain\n", b"# by hand\n#"])
def test_comments_above_the_header(tmp_path, model, good, above):
    (got,) = load(
        put(tmp_path, above + text(good)), model
    )  # numpy.savetxt writes its header behind a "# "
    np.testing.assert_allclose(got.qpos, good[:, 1:3], rtol=1e-8)
    lines = (above + text(good)).split(b"\n")
    row = above.count(b"\n") + 3
    lines[row - 1] = b"x" + lines[row - 1]
    with pytest.raises(RecordingError, match=f"row {row}, column 'time'"):
        load(put(tmp_path, b"\n".join(lines)), model)


@pytest.mark.parametrize(
    "data, says",
    [(b"\x1f\x8b\x08", "gunzip"), (b"\x89HDF\r\n", "HDF5"), (b"\x93NUMPY\x01", "numpy.savez")],
)
def test_other_formats_are_named(tmp_path, model, data, says):
    with pytest.raises(RecordingError, match=says):
        load(put(tmp_path, data + bytes(100)), model)


@pytest.mark.parametrize(
    "spoil, says",
    [
        (lambda t: t * [1, 1, -1, 1, 1, 1, 1], "column 'qpos:elbow' seems to have the wrong sign"),
        (
            lambda t: t * [1, 1, 1, 1, 1, -1, 1],
            "column 'ctrl:shoulder_motor' seems to have the wrong sign",
        ),
        (
            lambda t: t * [1, 1, -1, 1, 1, 1, -1],
            "'qpos:shoulder' and 'ctrl:shoulder_motor' do not fit the signs of the others",
        ),
        (
            lambda t: t + [0, 0, np.pi / 2, 0, 0, 0, 0],
            "'qpos:elbow' seems to count from another zero than the model; add -90 degrees",
        ),
        (
            lambda t: t - [0, np.pi, 0, 0, 0, 0, 0],
            "'qpos:shoulder' seems to count from another zero than the model; add 180 degrees",
        ),
        (
            lambda t: t[:, [0, 1, 2, 3, 4, 6, 5]],
            "'ctrl:shoulder_motor' and 'ctrl:elbow_motor' seem to be exchanged",
        ),
    ],
)
def test_signs_and_columns_that_the_model_cannot_follow(model, spoil, says):
    table = spoil(run(amplitude=2.0))
    table[:, 3:5] = np.nan
    with pytest.raises(RecordingError, match=says):
        check([recording(table)], model)


@pytest.mark.parametrize("wrong, beyond_doubt", [((1, 0, 0), False), ((1, 1, 0), True)])
def test_a_sign_is_beyond_doubt_where_most_recordings_have_it(model, wrong, beyond_doubt):
    sign = np.array([1, 1, -1, 1, 1, 1, 1])
    tables = [run(amplitude=2.0 + 0.1 * k) * sign**turned for k, turned in enumerate(wrong)]
    for table in tables:
        table[:, 3:5] = np.nan
    recordings = [recording(t, f"{k}.csv") for k, t in enumerate(tables)]
    says = "column 'qpos:elbow' seems to have the wrong sign"
    if beyond_doubt:
        with pytest.raises(RecordingError, match=f"0.csv: {says}"):
            check(recordings, model)
    else:
        assert any(line.startswith(f"0.csv: {says}") for line in check(recordings, model))


@pytest.mark.parametrize("short, doubt", [(0.9, "turned"), (0.2, None)])
def test_a_law_that_holds_with_little_smoothing_is_not_doubted_with_much(
    model, good, monkeypatch, short, doubt
):
    """Smoothed over more than a swing, a fast servo seems to move the other way."""
    left = iter([short, 0.9, 0.9, 0.2] if doubt else [short, 0.9, 0.2])
    turned = unit_check.Reading("turned", [1], 3, ("turned",))
    monkeypatch.setattr(unit_check, "_readings", lambda *given: [turned])
    monkeypatch.setattr(unit_check, "_imbalance", lambda *given: np.array([0.1, next(left)]))
    assert unit_check.suspect(recording(good), model) == doubt


@pytest.mark.parametrize(
    "factor, gear, says",
    [
        (1000, 1, "1000 times too large"),
        (100, 1, "percent"),
        (1, 50, "actuator's gear"),
        (1, 1, None),
    ],
)
def test_controls_in_another_unit(good, factor, gear, says):
    model = mujoco.MjModel.from_xml_string(
        ARM.replace('ctrllimited="true"', f'gear="{gear}" ctrllimited="false"')
    )
    table = good * [1, 1, 1, 1, 1, factor, factor]
    if says is None:
        check([recording(table)], model)
    else:
        with pytest.raises(RecordingError, match=says):
            check([recording(table)], model)


def test_a_joint_that_sticks_is_not_in_degrees(model, good):
    """Friction that the nominal model lacks holds the elbow: no acceleration, though gravity
    pulls."""
    stuck = good.copy()
    stuck[:, 2], stuck[:, 3:5] = (
        0.8 + 1e-4 * np.random.default_rng(0).normal(size=len(good)),
        np.nan,
    )
    assert "qpos:elbow does not move beyond the sensor's noise" in " | ".join(
        check([recording(stuck)], model)
    )


BODY = """<mujoco><option timestep="0.002"/><worldbody><body pos="0 0 1"><freejoint
name="root"/><geom type="box" size=".1 .2 .03" mass="1"/>
<site name="a" pos=".1 .1 0"/><site name="b" pos="-.1 0 0"/></body></worldbody><actuator><motor
name="a" site="a" gear="0 0 1 0 0 0.1"/>
<motor name="b" site="b" gear="0 0 1 0 0 -0.1"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    "spoil, says",
    [
        (lambda q, u: (q, u), None),
        (lambda q, u: (q[:, [0, 1, 2, 4, 5, 6, 3]], u), "x y z w"),
        (lambda q, u: (q * [1000, 1000, 1000, 1, 1, 1, 1], u), "in mm"),
        (lambda q, u: (q, u[:, ::-1]), "ctrl:a.*ctrl:b.*exchanged"),
    ],
)
def test_a_free_body_in_another_convention(spoil, says):
    model = mujoco.MjModel.from_xml_string(BODY)
    data, qpos, ctrl = mujoco.MjData(model), [], []
    data.qvel[:] = 0.3, 0.1, 4.0, 1.0, -0.6, 0.4
    for k in range(200):
        data.ctrl[:] = 3 + np.sin(0.1 * k), 3 + np.cos(0.07 * k)
        qpos.append(data.qpos.copy())
        ctrl.append(data.ctrl.copy())
        mujoco.mj_step(model, data, nstep=5)
    qpos, ctrl = spoil(np.array(qpos), np.array(ctrl))
    thrown = Recording("throw.csv", 0.01 * np.arange(200), qpos, np.full((200, 6), np.nan), ctrl)
    if says is None:
        check([thrown], model)
    else:
        with pytest.raises(RecordingError, match=says):
            check([thrown], model)


@pytest.mark.parametrize("unit", ["mm", "m"])
def test_a_slide_in_millimetres(unit):
    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><body><joint name="x" type="slide"
    axis="1 0 0" damping="20"/>
        <geom size=".1" mass="10"/></body></worldbody><actuator><motor name="drive"
        joint="x"/></actuator></mujoco>""")
    data, rows = mujoco.MjData(model), []
    for k in range(800):
        data.ctrl[0] = 40 * np.sin(3 * data.time) + 20 * np.sin(7 * data.time)
        if k % 5 == 0:
            rows.append([data.time, data.qpos[0] * (1000 if unit == "mm" else 1), data.ctrl[0]])
        mujoco.mj_step(model, data)
    rows = np.array(rows)
    one = Recording(
        "run.csv", rows[:, 0], rows[:, 1:2], np.full((len(rows), 1), np.nan), rows[:, 2:]
    )
    if unit == "m":
        assert check([one], model) == []
    else:
        with pytest.raises(RecordingError, match="qpos:x.*mm"):
            check([one], model)


def test_a_model_in_contact_is_not_accused():
    """Resting on the floor, where the contact force is not known: no verdict on units or
    columns."""
    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><geom type="plane" size="5 5
    1"/><body pos="0 0 .05">
        <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/><geom
        type="box" size=".08 .08 .05" mass="1"/>
        </body></worldbody><actuator><motor name="push" joint="x" gear="10"/><motor name="lift"
        joint="z" gear="10"/></actuator></mujoco>""")
    rng = np.random.default_rng(0)
    data, rows = mujoco.MjData(model), []
    for k in range(2000):
        data.ctrl[:] = 1.5 * np.sin(5 * data.time), 1.3 * np.sin(9 * data.time)
        if k % 5 == 0:
            rows.append([data.time, *(data.qpos + 1e-3 * rng.normal(size=2)), *data.ctrl])
        mujoco.mj_step(model, data)
    rows = np.array(rows)
    check(
        [
            Recording(
                "run.csv", rows[:, 0], rows[:, 1:3], np.full((len(rows), 2), np.nan), rows[:, 3:]
            )
        ],
        model,
    )


# --- fuzzing: whatever stands in a file, it is a sound recording or one line ---


def read_or_refuse(path, model):
    try:
        got = load(path, model)
        check(got, model)
    except RecordingError as error:
        assert "\n" not in str(error) and len(str(error)) > 10
        return
    for r in got:
        assert r.time.dtype == float and np.isfinite(r.time).all() and (np.diff(r.time) > 0).all()
        assert r.qpos.shape == (len(r.time), 2) == r.qvel.shape == r.ctrl.shape
        assert (
            np.isfinite(r.ctrl).all() and not np.isinf(r.qpos).any() and not np.isinf(r.qvel).any()
        )


FUZZ = settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
SMALL = text(run(0.6))
SMALL_NPZ = archive(**whole(run(0.6)))


@FUZZ
@given(st.binary(max_size=300))
def test_fuzz_bytes(tmp_path, model, data):
    read_or_refuse(put(tmp_path, data), model)
    read_or_refuse(put(tmp_path, data, "run.npz"), model)
    read_or_refuse(put(tmp_path, b"PK\x03\x04" + data, "run.npz"), model)


@FUZZ
@given(
    st.lists(
        st.tuples(
            st.floats(0, 1),
            st.sampled_from(
                [b",", b"\n", b"", b"nan", b"1e300", b"-", b"\xff", b"\x00", b'"', b";", b" "]
            ),
            st.integers(0, 30),
        ),
        min_size=1,
        max_size=4,
    )
)
def test_fuzz_damaged_csv(tmp_path, model, edits):
    data = SMALL
    for where, what, cut in edits:
        at = int(where * len(data))
        data = data[:at] + what + data[at + cut :]
    read_or_refuse(put(tmp_path, data), model)


@FUZZ
@given(
    st.lists(
        st.tuples(st.floats(0, 1), st.binary(max_size=6), st.integers(0, 40)),
        min_size=1,
        max_size=4,
    )
)
def test_fuzz_damaged_npz(tmp_path, model, edits):
    data = SMALL_NPZ
    for where, what, cut in edits:
        at = int(where * len(data))
        data = data[:at] + what + data[at + cut :]
    read_or_refuse(put(tmp_path, data, "run.npz"), model)


CELL = st.one_of(
    st.floats().map(repr), st.integers(-(10**20), 10**20).map(str), st.text(max_size=8), st.just("")
)


@FUZZ
@given(
    st.lists(
        st.sampled_from([*HEADER, "qpos:0", "ctrl:7", "time ", "qpos", "sensor:encoder", ""]),
        min_size=1,
        max_size=9,
    ),
    st.lists(st.lists(CELL, min_size=1, max_size=9), max_size=6),
)
def test_fuzz_tables(tmp_path, model, header, rows):
    read_or_refuse(
        put(
            tmp_path,
            "\n".join(",".join(r) for r in [header, *rows]).encode("utf-8", "surrogatepass"),
        ),
        model,
    )


@FUZZ
@given(
    st.lists(
        st.lists(st.floats(width=32) | st.floats(-3, 3), min_size=7, max_size=7),
        min_size=1,
        max_size=40,
    ),
    st.booleans(),
)
def test_fuzz_values(tmp_path, model, rows, clock):
    table = np.array(rows)
    if clock:
        table[:, 0] = 0.02 * np.arange(len(table))
    read_or_refuse(put(tmp_path, text(table)), model)
    read_or_refuse(put(tmp_path, archive(**whole(table)), "run.npz"), model)


@pytest.mark.parametrize("swing, refused", [(0.3, False), (20.0, True)])
def test_positions_far_beyond_their_targets_are_degrees_only_where_they_swing_by_degrees(
    swing, refused
):
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="link")
    body.add_joint(name="j", axis=[0, 1, 0])
    body.add_geom(size=[0.05, 0, 0], pos=[0, 0, -0.3])
    servo = spec.add_actuator(name="s", target="j", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    servo.set_to_position(kp=5.0)
    model, time = spec.compile(), 0.01 * np.arange(400)
    position = swing * np.sin(3 * time)[:, None]
    recording = Recording("run.csv", time, position, np.full((400, 1), np.nan), position / 57.3, {})
    if refused:
        with pytest.raises(RecordingError, match="degrees beside its targets in rad"):
            check([recording], model)
    else:
        check([recording], model)
