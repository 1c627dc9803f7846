"""File formats: what each library writes is read back as the same recording."""

import json
import sys

import mujoco
import numpy as np
import pyarrow as pa
import pytest
import torch
from arm import ARM, archive, arm, run, text
from bags import joint_state, write_bag
from pyarrow import parquet

from diagnosis.recordings.column_map import load_layout
from diagnosis.recordings.columns import RecordingError
from diagnosis.recordings.layout import Layout
from diagnosis.recordings.recording import load

SERVOS = ARM.replace(
    '<motor name="shoulder_motor" joint="shoulder"', '<position name="s" kp="20" joint="shoulder"'
).replace('<motor name="elbow_motor" joint="elbow"', '<position name="e" kp="20" joint="elbow"')
JOINTS = ["shoulder", "elbow"]


@pytest.fixture(scope="module")
def model():
    return arm()


@pytest.fixture(scope="module")
def servos():
    return mujoco.MjModel.from_xml_string(
        SERVOS.replace('ctrlrange="-3 3"', "")
        .replace('ctrlrange="-1 1"', "")
        .replace('ctrllimited="true"', "")
    )


@pytest.fixture(scope="module")
def good():
    return run(seconds=1.0)


def same(got, good, rtol=1e-9):
    np.testing.assert_allclose(got.time, good[:, 0], atol=1e-9)
    np.testing.assert_allclose(got.qpos, good[:, 1:3], rtol=rtol)
    np.testing.assert_allclose(got.qvel, good[:, 3:5], rtol=rtol)
    np.testing.assert_allclose(got.ctrl, good[:, 5:7], rtol=rtol)


def states(good, order=(1, 0), stamps=True):
    """JointState messages of a table, joints in another order than the model's."""
    names = [JOINTS[k] for k in order]
    return [
        (
            int(row[0] * 1e9) + 5_000_000,
            joint_state(
                int(round(row[0] * 1e9)) + (10**18 if stamps else 0),
                names,
                *([row[first + k] for k in order] for first in (1, 3, 5)),
            ),
        )
        for row in good
    ]


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_a_ros_2_bag_by_its_folder_or_file(tmp_path, model, good, storage):
    bag = write_bag(tmp_path / "bag", {"/joint_states": states(good)}, storage)
    (file,) = [f for f in bag.iterdir() if f.suffix != ".yaml"]
    for path in (bag, file):
        (got,) = load(path, model)
        same(got, good)
        assert got.name == path.name


def test_a_bag_whose_efforts_pass_a_gear(tmp_path, good):
    geared = mujoco.MjModel.from_xml_string(ARM.replace('joint="elbow"', 'joint="elbow" gear="50"'))
    (got,) = load(write_bag(tmp_path / "bag", {"/joint_states": states(good)}), geared)
    np.testing.assert_allclose(got.ctrl, good[:, 5:7] / [1, 50])


def test_targets_of_a_bag_act_from_when_they_were_told(tmp_path, servos, good):
    told = [
        (
            int(row[0] * 1e9),
            joint_state(10**18 + int(round((row[0] + 0.004) * 1e9)), JOINTS, row[5:7], [], []),
        )
        for row in good[::5]
    ]
    bag = write_bag(tmp_path / "bag", {"/joint_states": states(good), "/goal": told})
    (tmp_path / "map.toml").write_text('[ros]\ntargets = "/goal"\n')
    (got,) = load(bag, servos, load_layout(str(tmp_path / "map.toml")))
    # 4 ms late: it holds from the row after, and in the first row nothing is told yet
    rows = np.arange(len(good) - 1) // 5 * 5
    np.testing.assert_allclose(got.ctrl, good[rows, 5:7])
    np.testing.assert_allclose(got.qpos, good[1:, 1:3])
    np.testing.assert_allclose(got.time, good[1:, 0] - good[1, 0], atol=1e-9)
    assert got.notes == ("rows before the first target are left out: 1",)


def goal_map(folder):
    """The layout of targets on /goal, the elbow's first where messages name no joints."""
    path = folder / "map.toml"
    path.write_text('[ros]\ntargets = "/goal"\njoints = ["elbow", "shoulder"]\n')
    return load_layout(str(path))


def test_targets_without_stamps_go_by_the_clock_of_states_that_have_some(tmp_path, servos, good):
    """States are stamped by another clock and received 5 ms late; targets, sorted or not, 4 ms
    after a row's: they hold from the next row on."""
    told = [(int(row[0] * 1e9) + 9_000_000, list(row[[6, 5]])) for row in good]
    bag = write_bag(tmp_path / "bag", {"/joint_states": states(good), "/goal": told[::-1]})
    (got,) = load(bag, servos, goal_map(tmp_path))
    np.testing.assert_allclose(got.ctrl, good[:-1, 5:7])
    np.testing.assert_allclose(got.qpos, good[1:, 1:3])


def test_stamped_targets_out_of_order(tmp_path, servos, good):
    """The order of recording is the reverse of that of the stamps, which counts."""
    told = [
        (10**9 - k, joint_state(10**18 + int(round(row[0] * 1e9)), JOINTS, row[5:7], [], []))
        for k, row in enumerate(good)
    ]
    bag = write_bag(tmp_path / "bag", {"/joint_states": states(good), "/goal": told})
    (got,) = load(bag, servos, goal_map(tmp_path))
    np.testing.assert_allclose(got.ctrl, good[:, 5:7])


def test_targets_of_another_time_are_refused(tmp_path, servos, good):
    told = [(int(row[0] * 1e9), joint_state(10**9, JOINTS, row[5:7], [], [])) for row in good]
    bag = write_bag(tmp_path / "bag", {"/joint_states": states(good), "/goal": told})
    with pytest.raises(RecordingError, match="targets are of 1.00 .*never at the same time"):
        load(bag, servos, goal_map(tmp_path))


def test_a_bag_begins_where_every_joint_has_been_told_a_target(tmp_path, servos, good):
    """The elbow is told from row 30 on; a gripper, which the model lacks, later still."""
    told = []
    for k, row in enumerate(good[10:], start=10):
        names = JOINTS[: 1 + (k >= 30)] + ["gripper"] * (k >= 60)
        stamp = 10**18 + int(round(row[0] * 1e9))
        told.append((k, joint_state(stamp, names, [*row[5:7], 0.0][: len(names)], [], [])))
    bag = write_bag(tmp_path / "bag", {"/joint_states": states(good), "/goal": told})
    (got,) = load(bag, servos, goal_map(tmp_path))
    np.testing.assert_allclose(got.qpos, good[30:, 1:3])
    np.testing.assert_allclose(got.ctrl, good[30:, 5:7])
    assert got.notes == ("rows before the first target are left out: 30",)


def test_targets_without_names_take_their_order_from_the_map(tmp_path, servos, good):
    told = [(int(row[0] * 1e9), list(row[[6, 5]])) for row in good]
    bag = write_bag(tmp_path / "bag", {"/joint_states": states(good, stamps=False), "/goal": told})
    (tmp_path / "map.toml").write_text('[ros]\ntargets = "/goal"\njoints = ["elbow", "shoulder"]\n')
    (got,) = load(bag, servos, load_layout(str(tmp_path / "map.toml")))
    np.testing.assert_allclose(got.ctrl[1:], good[1:, 5:7])
    (tmp_path / "map.toml").write_text('[ros]\ntargets = "/goal"\n')
    with pytest.raises(RecordingError, match="no names of joints.*joints ="):
        load(bag, servos, load_layout(str(tmp_path / "map.toml")))


def test_two_publishers_on_one_topic(tmp_path, model, good):
    halves = [
        (
            0,
            joint_state(
                10**18 + int(round(row[0] * 1e9)), [JOINTS[k]], *([row[f + k]] for f in (1, 3, 5))
            ),
        )
        for row in good
        for k in (0, 1)
    ]
    (got,) = load(write_bag(tmp_path / "bag", {"/joint_states": halves}), model)
    same(got, good)


def test_joints_of_other_names_and_one_too_many(tmp_path, model, good):
    theirs = [
        (
            t,
            joint_state(
                t,
                ["joint_1", "joint_2", "gripper"],
                *([*x, 0.0] for x in (m.position, m.velocity, m.effort)),
            ),
        )
        for t, m in states(good, order=(0, 1))
    ]
    bag = write_bag(tmp_path / "bag", {"/joint_states": theirs})
    with pytest.raises(RecordingError, match="'qpos:shoulder' is missing"):
        load(bag, model)
    (tmp_path / "map.toml").write_text('[joints]\nshoulder = "joint_1"\nelbow = "joint_2"\n')
    (got,) = load(bag, model, load_layout(str(tmp_path / "map.toml")))
    np.testing.assert_allclose(got.qpos, good[:, 1:3])


def lerobot(folder, good, episodes=2, names=True, version=3):
    """A dataset as the library lays it out, observation.state of positions, velocities and
    torques, action of targets."""
    parts = [f"{j}.{end}" for end in ("pos", "vel", "torque") for j in JOINTS]
    features = {
        "observation.state": {"names": parts if names else None},
        "action": {"names": [f"{j}.pos" for j in JOINTS] if names else None},
    }
    (folder / "meta").mkdir(parents=True)
    (folder / "data" / "chunk-000").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(
        json.dumps({"codebase_version": "v3.0", "fps": 100, "features": features})
    )
    table = pa.table(
        {
            "observation.state": pa.array(
                list(np.tile(good[:, 1:7], (episodes, 1)).astype(np.float32)),
                pa.list_(pa.float32()),
            ),
            "action": pa.array(
                list(np.tile(good[:, 1:3] + 0.1, (episodes, 1)).astype(np.float32)),
                pa.list_(pa.float32()),
            ),
            "timestamp": np.tile(good[:, 0], episodes).astype(np.float32),
            "episode_index": np.repeat(np.arange(episodes), len(good)),
            "task": ["wave"] * (episodes * len(good)),
        }
    )
    cut = len(good) + 7  # an episode may run on in the next file
    parquet.write_table(table[:cut], folder / "data" / "chunk-000" / "file-000.parquet")
    parquet.write_table(table[cut:], folder / "data" / "chunk-000" / "file-001.parquet")
    return folder


def test_a_lerobot_dataset(tmp_path, model, servos, good):
    folder = lerobot(tmp_path / "arm", good)
    runs = load(folder, model)
    assert [r.name for r in runs] == ["arm:0", "arm:1"]
    for got in runs:
        np.testing.assert_allclose(got.time, good[:, 0], atol=1e-6)
        np.testing.assert_allclose(got.qpos, good[:, 1:3], rtol=1e-6)
        np.testing.assert_allclose(got.qvel, good[:, 3:5], rtol=1e-6)
        np.testing.assert_allclose(got.ctrl, good[:, 5:7], rtol=1e-6)
    np.testing.assert_allclose(load(folder, servos)[1].ctrl, good[:, 1:3] + 0.1, rtol=1e-5)
    (first, part) = load(folder / "data" / "chunk-000" / "file-000.parquet", model)
    assert len(first.time) == len(good) and len(part.time) == 7


def test_a_lerobot_dataset_without_names_needs_a_map(tmp_path, model, good):
    folder = lerobot(tmp_path / "arm", good, names=False)
    with pytest.raises(RecordingError, match="'qpos:shoulder' is missing"):
        load(folder, model)
    state = [
        f'"{kind}" = "observation.state[{k}]"'
        for k, kind in enumerate(
            [
                "qpos:shoulder",
                "qpos:elbow",
                "qvel:shoulder",
                "qvel:elbow",
                "effort:shoulder",
                "effort:elbow",
            ]
        )
    ]
    (tmp_path / "map.toml").write_text("[columns]\n" + "\n".join(state))
    (got, _) = load(folder, model, load_layout(str(tmp_path / "map.toml")))
    np.testing.assert_allclose(got.ctrl, good[:, 5:7], rtol=1e-6)


def pace(path, good, **more):
    content = {
        "time": good[:, 0],
        "dof_pos": good[:, 1:3],
        "des_dof_pos": good[:, 1:3] + 0.1,
        **more,
    }
    torch.save(
        {k: torch.as_tensor(v) if isinstance(v, np.ndarray) else v for k, v in content.items()},
        path,
    )
    return path


def test_a_pace_dictionary(tmp_path, model, servos, good):
    (got,) = load(pace(tmp_path / "chirp.pt", good), servos)
    np.testing.assert_allclose(got.qpos, good[:, 1:3])
    np.testing.assert_allclose(got.ctrl, good[:, 1:3] + 0.1)
    assert np.isnan(got.qvel).all() and not got.gains
    gains = {"kp": np.array([20.0, 40.0]), "kd": np.array([0.5, 1.0])}
    (got,) = load(pace(tmp_path / "gains.pt", good, dof_vel=good[:, 3:5], **gains), model)
    assert got.gains == {"shoulder": {"kp": 20, "kd": 0.5}, "elbow": {"kp": 40, "kd": 1}}
    np.testing.assert_allclose(got.ctrl, good[:, 1:3] + 0.1)
    np.testing.assert_allclose(got.qvel, good[:, 3:5])


def test_targets_for_motors_need_gains(tmp_path, model, good):
    path = pace(tmp_path / "chirp.pt", good)
    with pytest.raises(RecordingError, match="'target:shoulder' is a position.*--kp"):
        load(path, model)
    (got,) = load(path, model, Layout(gains=frozenset(JOINTS)))
    np.testing.assert_allclose(got.ctrl, good[:, 1:3] + 0.1)


def test_an_effort_is_no_target(tmp_path, model, good):
    """With gains a motor's control is a position: a torque must not stand in for it."""
    names = ["time", *(f"{kind}:{j}" for kind in ("qpos", "qvel", "effort") for j in JOINTS)]
    (tmp_path / "run.csv").write_bytes(text(good[:, :7], names))
    (got,) = load(tmp_path / "run.csv", model)
    np.testing.assert_allclose(got.ctrl, good[:, 5:7])
    with pytest.raises(RecordingError, match="is a target, and nothing in the file is one"):
        load(tmp_path / "run.csv", model, Layout(gains=frozenset(JOINTS)))
    gains = np.full((len(good), 2), 20.0)
    names += [f"kp:{j}" for j in JOINTS]
    (tmp_path / "kp.csv").write_bytes(text(np.column_stack([good[:, :7], gains]), names))
    with pytest.raises(RecordingError, match="is a target, and nothing in the file is one"):
        load(tmp_path / "kp.csv", model)


def test_words_in_columns_that_nobody_names(tmp_path, model, good):
    """A column map passes over them; in a column that is read they are an error still."""
    names = ["time", *(f"{kind}:{j}" for kind in ("qpos", "qvel", "effort") for j in JOINTS)]
    head, *rows = text(good[:, :7], names).decode().splitlines()
    lines = [f"mode,{head}", *(f"swing {k},{row}" for k, row in enumerate(rows))]
    (tmp_path / "run.csv").write_text("\n".join(lines))
    (tmp_path / "map.toml").write_text('[columns]\n"qpos:elbow" = "qpos:elbow"\n')
    (got,) = load(tmp_path / "run.csv", model, load_layout(str(tmp_path / "map.toml")))
    np.testing.assert_allclose(got.ctrl, good[:, 5:7])
    (tmp_path / "map.toml").write_text('[columns]\n"qpos:elbow" = "mode"\n')
    with pytest.raises(RecordingError, match="row 2, column 'mode': 'swing 0' is not a number"):
        load(tmp_path / "run.csv", model, load_layout(str(tmp_path / "map.toml")))


def test_the_error_names_the_extra(tmp_path, model, good, monkeypatch):
    bag = write_bag(tmp_path / "bag", {"/joint_states": states(good)})
    folder, path = lerobot(tmp_path / "arm", good), pace(tmp_path / "chirp.pt", good)
    for module in ("rosbags", "rosbags.highlevel", "pyarrow", "pyarrow.parquet", "torch"):
        monkeypatch.setitem(sys.modules, module, None)
    for where, extra in ((bag, "ros"), (folder, "lerobot"), (path, "pace")):
        with pytest.raises(RecordingError, match=rf"extra \[{extra}\]"):
            load(where, model)


def test_a_column_map(tmp_path, model, good):
    theirs = np.column_stack(
        [
            good[:, 0] * 1e6,
            np.rad2deg(good[:, 1]),
            good[:, 2],
            good[:, 5] / 0.105,
            good[:, 6],
            good[:, 0],
        ]
    )
    header = ["stamp", "q1", "q2", "i1", "tau2", "voltage"]
    (tmp_path / "run.csv").write_bytes(text(theirs, header))
    np.savez(
        tmp_path / "run.npz",
        stamp=theirs[:, 0],
        q=theirs[:, 1:3],
        i1=theirs[:, 3],
        tau2=theirs[:, 4],
    )
    for name, columns in (("run.csv", ("q1", "q2")), ("run.npz", ("q[0]", "q[1]"))):
        (tmp_path / "map.toml").write_text(f"""
            [columns]
            time = {{column = "stamp", scale = 1e-6}}
            "qpos:shoulder" = {{column = "{columns[0]}", scale = {np.pi / 180!r}}}
            "qpos:elbow" = "{columns[1]}"
            "ctrl:shoulder_motor" = {{column = "i1", scale = 0.105}}
            "ctrl:elbow_motor" = "tau2"
            "qvel:elbow" = nan
        """)
        (got,) = load(tmp_path / name, model, load_layout(str(tmp_path / "map.toml")))
        np.testing.assert_allclose(got.time, good[:, 0], rtol=1e-6)
        np.testing.assert_allclose(got.qpos, good[:, 1:3], rtol=1e-6)
        np.testing.assert_allclose(got.ctrl, good[:, 5:7], rtol=1e-6)
        assert np.isnan(got.qvel).all()


def test_degrees_are_turned_where_they_are_angles(tmp_path, servos, good):
    slide = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="rail" type="slide"/><geom size=".1"/><body><joint '
        'name="pole"/><geom size=".1" '
        'pos="0 0 1"/></body></body></worldbody><actuator><motor name="belt" '
        'joint="rail"/></actuator></mujoco>'
    )
    degrees = good[:50].copy()
    degrees[:, 1:5] = np.rad2deg(degrees[:, 1:5])
    names = ["time", "qpos:rail", "qpos:pole", "qvel:rail", "qvel:pole", "ctrl:belt"]
    (tmp_path / "run.csv").write_bytes(text(degrees[:, :6], names))
    (got,) = load(tmp_path / "run.csv", slide, Layout(degrees=True))
    np.testing.assert_allclose(got.qpos, np.column_stack([degrees[:, 1], good[:50, 2]]), rtol=1e-7)
    np.testing.assert_allclose(got.qvel, np.column_stack([degrees[:, 3], good[:50, 4]]), rtol=1e-7)
    np.testing.assert_allclose(got.ctrl[:, 0], good[:50, 5], rtol=1e-7)
    degrees[:, 5:7] = np.rad2deg(good[:50, 5:7])
    names = [
        "time",
        "qpos:shoulder",
        "qpos:elbow",
        "qvel:shoulder",
        "qvel:elbow",
        "target:shoulder",
        "target:elbow",
    ]
    (tmp_path / "run.csv").write_bytes(text(degrees, names))
    (got,) = load(tmp_path / "run.csv", servos, Layout(degrees=True))
    np.testing.assert_allclose(got.ctrl, good[:50, 5:7], rtol=1e-7)


def test_an_npz_without_a_map_is_what_it_was(tmp_path, model, good):
    (tmp_path / "run.npz").write_bytes(
        archive(time=good[:, 0], qpos=good[:, 1:3], ctrl=good[:, 5:7], extra=np.zeros(3))
    )
    (got,) = load(tmp_path / "run.npz", model)
    np.testing.assert_array_equal(got.qpos, good[:, 1:3])
