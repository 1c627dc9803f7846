"""Bags, datasets, URDF, column maps and gains that must be refused."""

import functools
import io
import tempfile
from pathlib import Path

import numpy as np
import pyarrow as pa
import torch
from arm import ARM, HEADER, text
from bags import joint_state, write_bag
from pyarrow import parquet

from malformed.case import Case, Exploit

URDF = """<robot name="arm"><link name="base"/><link name="upper"><inertial><mass value="1"/>
  <inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><geometry><mesh filename="package://arm/gone.stl"/></geometry></collision></link>
  <joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/></joint>
</robot>"""
SERVOS = ARM.replace("<motor", '<position kp="20"')
SERVOS = SERVOS.replace('ctrllimited="true"', 'ctrllimited="false"')
JOINTS = ["shoulder", "elbow"]


def bag(good, storage, topic="/joint_states", effort=True):
    """The one file of a ROS 2 bag, as bytes."""
    with tempfile.TemporaryDirectory() as folder:
        messages = [
            (
                int(row[0] * 1e9),
                joint_state(
                    int(1e18) + int(row[0] * 1e9),
                    JOINTS,
                    row[1:3],
                    row[3:5],
                    row[5:7] if effort else [],
                ),
            )
            for row in good
        ]
        if topic == "/chatter":
            messages = [(time, "hello") for time, _ in messages]
        where = write_bag(Path(folder) / "bag", {topic: messages}, storage)
        [file] = [f for f in where.iterdir() if f.suffix != ".yaml"]
        return file.read_bytes()


def torch_file(**content):
    """A torch file as bytes."""
    stream = io.BytesIO()
    tensors = {
        key: torch.as_tensor(value) if isinstance(value, np.ndarray) else value
        for key, value in content.items()
    }
    torch.save(tensors, stream)
    return stream.getvalue()


def table_file(**columns):
    """A Parquet file as bytes."""
    stream = io.BytesIO()
    parquet.write_table(pa.table(columns), stream)
    return stream.getvalue()


def of_robots(good):
    """{name: Case} of bags, datasets, URDF, column maps and gains."""
    found = {}
    of_files(found, good)
    of_maps(found, good)
    of_gains(found, good)
    return found


def case_of(found, name, says, path, data, *more, model="arm.xml", **files):
    """Add the Case of one recording, and of other files as name_suffix=bytes."""
    given = {path: data, **{key.replace("_", "."): value for key, value in files.items()}}
    argv = ["--model", "{dir}/" + model, "--recordings", "{dir}/" + path, *more]
    found[name] = Case(given, says, [*argv, "--out", "{dir}/report"])


MAP = "--map", "{dir}/map.toml"


def of_files(found, good):
    """Bags, dictionaries and tables."""
    file = functools.partial(case_of, found)
    db3, mcap = bag(good, "sqlite3"), bag(good, "mcap")
    file("bag without joint states", "/chatter (std", "b.db3", bag(good, "sqlite3", "/chatter"))
    file("bag cut off", "not a readable ROS 2 bag", "b.db3", db3[: len(db3) // 2])
    file("MCAP cut off", "not a readable ROS 2 bag", "b.mcap", mcap[: len(mcap) // 2])
    file("MCAP rubbish", "not a readable ROS 2 bag", "b.mcap", b"mcap" * 300)
    silent = bag(good, "mcap", effort=False)
    file("bag without efforts", "'ctrl:shoulder_motor' is missing", "b.mcap", silent)
    topic = b'[ros]\ntopic = "/other"\n'
    file("bag without the topic", "no topic '/other'", "b.mcap", mcap, *MAP, map_toml=topic)

    pace = {"time": good[:, 0], "dof_pos": good[:, 1:3], "des_dof_pos": good[:, 1:3]}
    file("PACE with objects", "never loaded", "run.pt", torch_file(time=Exploit()))
    file("PACE rubbish", "not a readable torch file", "run.pt", b"torch" * 100)
    file(
        "PACE without targets",
        "'des_dof_pos' is missing",
        "run.pt",
        torch_file(time=good[:, 0], dof_pos=good[:, 1:3]),
    )
    more = {**pace, "dof_pos": good[:, 1:4]}
    file("PACE of another robot", "(400, 3)", "run.pt", torch_file(**more))
    file("targets for motors", "--kp", "run.pt", torch_file(**pace))
    file("Parquet rubbish", "not a readable Parquet", "run.parquet", b"PAR1" + bytes(400))
    stateless = table_file(speed=good[:, 3])
    file("Parquet of something else", "'timestamp'", "run.parquet", stateless)


def of_maps(found, good):
    """Column maps."""

    def mapped(name, says, content):
        case_of(found, name, says, "run.csv", text(good), *MAP, map_toml=content)

    mapped("map of nothing", "names nothing", b"# later\n")
    mapped("map that is not TOML", "not TOML", b"qpos:elbow = q2\n")
    mapped("map of an absent column", "'q2', which", b'[columns]\n"qpos:elbow" = "q2"\n')
    mapped("map to an absent joint", "no joint 'wrist'", b'[columns]\n"qpos:wrist" = "time"\n')
    mapped("map with another table", "'colums' is not known", b'[colums]\ntime = "t"\n')
    mapped("map of an absent name", "'joint_2'", b'[joints]\nelbow = "joint_2"\n')
    case_of(found, "no such map", "column map cannot be read", "run.csv", text(good), *MAP)


def of_gains(found, good):
    """Gains, units and URDFs."""
    file = functools.partial(case_of, found)
    file(
        "kp for servos",
        "position servos",
        "run.csv",
        text(good),
        "--kp",
        "20",
        model="servo.xml",
        servo_xml=SERVOS.encode(),
    )
    file("kp of words", "one number", "run.csv", text(good), "--kp", "stiff")
    file("kp of an absent joint", "'wrist'", "run.csv", text(good), "--kp", "wrist=20")
    file("kd without kp", "--kd without --kp", "run.csv", text(good), "--kd", "0.5")
    changing = np.column_stack([good, np.where(good[:, 0] < 2, 20, 30)])
    gains = [*HEADER, "kp:elbow"]
    file("kp that changes", "changes from 20 to 30", "run.csv", text(changing, gains))
    mixed = good.copy()
    mixed[:, 1:3] = np.rad2deg(mixed[:, 1:3])
    file("degrees beside rad/s", "mixed units", "run.csv", text(mixed), "--degrees")
    mixed = good.copy()
    mixed[:, 5:7] = np.rad2deg(mixed[:, 1:3])
    names = [*HEADER[:5], "target:shoulder", "target:elbow"]
    file(
        "targets in degrees",
        "mixed units",
        "run.csv",
        text(mixed, names),
        model="servo.xml",
        servo_xml=SERVOS.encode(),
    )

    single = text(good[:, [0, 1, 5]], ["time", "qpos:shoulder", "ctrl:shoulder"])
    file(
        "URDF without its mesh",
        "gone.stl",
        "run.csv",
        single,
        model="arm.urdf",
        arm_urdf=URDF.encode(),
    )
    file(
        "URDF cut off", "not XML", "run.csv", single, model="arm.urdf", arm_urdf=URDF.encode()[:300]
    )
    file("URDF to write from MJCF", "no URDF", "run.csv", text(good), "--write-urdf")
