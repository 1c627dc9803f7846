"""Inputs that must be refused, made by code: one sound set of files, and some eighty ways to spoil
it.

for name, case in cases().items():
    argv = case.write(folder)        # the command line; must give exit status 2 and one line that
    holds case.says
"""

import functools
import gzip
import io
import pickle
import tempfile
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np
import pyarrow as pa
import torch
from bags import joint_state, write_bag
from pyarrow import parquet

ARM = """
<mujoco model="arm">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="0.05"/>
      <geom name="upper_rod" type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="1"
      contype="0" conaffinity="0"/>
      <body name="lower" pos="0 0 -0.3">
        <joint name="elbow" axis="0 1 0" damping="0.05" limited="true" range="-2.9 2.9"/>
        <geom name="lower_rod" type="capsule" fromto="0 0 0 0 0 -0.25" size="0.015" mass="0.5"
        contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="shoulder_motor" joint="shoulder" ctrllimited="true" ctrlrange="-3 3"/>
    <motor name="elbow_motor" joint="elbow" ctrllimited="true" ctrlrange="-1 1"/>
  </actuator>
  <sensor><jointpos name="encoder" joint="shoulder"/></sensor>
</mujoco>
"""
HEADER = [
    "time",
    "qpos:shoulder",
    "qpos:elbow",
    "qvel:shoulder",
    "qvel:elbow",
    "ctrl:shoulder_motor",
    "ctrl:elbow_motor",
]
DT = 0.01


def arm():
    """The model of ARM."""
    return mujoco.MjModel.from_xml_string(ARM)


def run(seconds=4.0, seed=0, noise=2e-4, amplitude=1.0):
    """(T, 7) a sound recording of ARM, columns as in HEADER: random smooth torques, sampled every
    DT."""
    rng = np.random.default_rng(seed)
    model = arm()
    data = mujoco.MjData(model)
    rows = int(round(seconds / DT))
    t = DT * np.arange(rows)
    tones = rng.uniform(0.4, 1.6, (2, 3)), rng.uniform(0, 2 * np.pi, (2, 3))
    ctrl = (
        amplitude
        * np.array([[1.2], [0.4]])
        * np.sin(2 * np.pi * tones[0][:, :, None] * t + tones[1][:, :, None]).mean(axis=1)
    )
    table = np.empty((rows, 7))
    for row in range(rows):
        table[row] = [t[row], *data.qpos, *data.qvel, *ctrl[:, row]]
        data.ctrl[:] = ctrl[:, row]
        mujoco.mj_step(model, data, nstep=5)
    table[:, 1:5] += rng.normal(size=(rows, 4)) * [noise, noise, 10 * noise, 10 * noise]
    return table


def text(table, header=HEADER, separator=","):
    """A CSV as bytes."""
    lines = [separator.join(header)] + [
        separator.join(f"{value:.9g}" for value in row) for row in table
    ]
    return ("\n".join(lines) + "\n").encode()


def archive(**arrays):
    """An NPZ as bytes; object arrays are pickled, as a careless writer would."""
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def whole(table):
    """The arrays of a sound NPZ."""
    return {
        "time": table[:, 0],
        "qpos": table[:, 1:3],
        "qvel": table[:, 3:5],
        "ctrl": table[:, 5:7],
    }


@dataclass
class Case:
    """files: {name: bytes} to write; argv with {dir} for their folder; says: what the line must
    hold."""

    files: dict
    says: str
    argv: list = field(
        default_factory=lambda: [
            "--model",
            "{dir}/arm.xml",
            "--recordings",
            "{dir}/run.csv",
            "--out",
            "{dir}/report",
        ]
    )

    def write(self, folder):
        for name, data in {"arm.xml": ARM.encode(), **self.files}.items():
            (folder / name).write_bytes(data)
        return [word.format(dir=folder) for word in self.argv]


class Exploit:
    """Unpickling it would raise; reading must refuse first."""

    def __reduce__(self):
        return (exec, ("raise SystemExit('unpickled')",))


def cases():
    """{name: Case}."""
    good = run()
    found = {}

    def csv(name, data, says):
        found[name] = Case({"run.csv": data}, says)

    def table(name, says, change, header=HEADER):
        spoiled = good.copy()
        back = change(spoiled)
        csv(name, text(spoiled if back is None else back, header), says)

    def npz(name, says, data=None, **arrays):
        data = (
            archive(**{k: v for k, v in {**whole(good), **arrays}.items() if v is not None})
            if data is None
            else data
        )
        found[name] = Case(
            {"run.npz": data},
            says,
            ["--model", "{dir}/arm.xml", "--recordings", "{dir}/run.npz", "--out", "{dir}/report"],
        )

    def command(name, says, *argv, **files):
        found[name] = Case(
            {
                "run.csv": text(good),
                **{key.replace("_", "."): value for key, value in files.items()},
            },
            says,
            list(argv),
        )

    def cell(row, column, value):
        lines = text(good).decode().split("\n")
        cells = lines[row - 1].split(",")
        cells[column] = value
        lines[row - 1] = ",".join(cells)
        return "\n".join(lines).encode()

    def line(row, value):
        lines = text(good).decode().split("\n")
        lines[row - 1 : row] = value
        return "\n".join(lines).encode()

    def renamed(old, new):
        return [new if name == old else name for name in HEADER]

    # whole files
    csv("empty file", b"", "empty")
    csv("only white space", b" \n\n  \n", "empty")
    csv("header only", (",".join(HEADER) + "\n").encode(), "no rows")
    csv("one row", text(good[:1]), "not enough data")
    csv(
        "binary rubbish",
        np.random.default_rng(0).integers(0, 256, 4000).astype(np.uint8).tobytes(),
        "binary",
    )
    csv(
        "rubbish without zeros",
        np.random.default_rng(1).integers(128, 256, 4000).astype(np.uint8).tobytes(),
        "UTF-8",
    )
    csv("UTF-16", text(good).decode().encode("utf-16"), "UTF-16")
    csv(
        "latin-1 comment",
        text(good).replace(b"qpos:elbow", "qpos:élbow".encode("latin-1"), 1),
        "UTF-8",
    )
    csv("prose", b"Dear colleague,\nthe recordings are attached.\n", "not a column")
    csv("JSON", b'{"time": [0, 1], "qpos": [[0, 1], [2, 3]]}', "not a column")
    csv("no header", text(good).split(b"\n", 1)[1], "header")
    csv("semicolons", text(good, separator=";"), "semicolons")
    csv("tabs", text(good, separator="\t"), "tabs")
    csv("spaces", text(good, separator=" "), "separated by spaces")
    csv("only comments", b"# a recording\n# of nothing\n", "no header")
    csv("gzip", gzip.compress(text(good)), "gunzip")
    csv("decimal commas", text(good).replace(b".", b","), "cells")
    csv("unbalanced quote", b'"time,qpos:shoulder\n0,1\n', "header")
    csv("an NPZ called CSV, cut off", archive(**whole(good))[:300], "NPZ")
    csv("cut off in a row", text(good)[:-20], "cells")
    found["a folder"] = Case(
        {}, "folder", ["--model", "{dir}/arm.xml", "--recordings", "{dir}", "--out", "{dir}/report"]
    )
    found["a folder of recordings"] = Case(
        {"run.csv": text(good)}, "name the files in it", found["a folder"].argv
    )
    found["a copy under another name"] = Case(
        {"run.csv": text(good), "copy.csv": text(good)},
        "same rows",
        [*found["a folder"].argv[:3], "{dir}/run.csv", "{dir}/copy.csv", "--out", "{dir}/report"],
    )
    found["a fitted file held out as a copy"] = Case(
        found["a copy under another name"].files,
        "same rows",
        [
            *found["a folder"].argv[:3],
            "{dir}/run.csv",
            "--held-out",
            "{dir}/copy.csv",
            "--out",
            "{dir}/report",
        ],
    )
    found["no such file"] = Case({}, "no such file")
    found["unmatched pattern"] = Case(
        {},
        "no such file",
        ["--model", "{dir}/arm.xml", "--recordings", "{dir}/*.csv", "--out", "{dir}/report"],
    )
    found["a device"] = Case(
        {},
        "regular file",
        ["--model", "{dir}/arm.xml", "--recordings", "/dev/null", "--out", "{dir}/report"],
    )

    # headers
    csv(
        "misspelt joint",
        text(good, renamed("qpos:elbow", "qpos:elbwo")),
        "did you mean 'qpos:elbow'",
    )
    csv("joint of another model", text(good, renamed("qpos:elbow", "qpos:slider")), "qpos:slider")
    csv(
        "misspelt actuator",
        text(good, renamed("ctrl:elbow_motor", "ctrl:elbow")),
        "did you mean 'ctrl:elbow_motor'",
    )
    csv("unknown sensor", text(good, renamed("qvel:elbow", "sensor:gyro")), "sensor")
    csv("unknown kind", text(good, renamed("qvel:elbow", "torque:elbow")), "torque:elbow")
    csv("component of a hinge", text(good, renamed("qpos:elbow", "qpos:elbow:0")), "qpos:elbow:0")
    csv("column twice", text(good, renamed("qpos:elbow", "qpos:shoulder")), "twice")
    csv("time twice", text(good, renamed("qvel:elbow", "time")), "twice")
    csv("nameless column", text(good, renamed("qvel:elbow", "")), "no name")
    csv("no time", text(good[:, 1:], HEADER[1:]), "'time'")
    csv(
        "no position of the elbow",
        text(np.delete(good, 2, 1), [h for h in HEADER if h != "qpos:elbow"]),
        "'qpos:elbow' is missing",
    )
    csv("no control", text(good[:, :5], HEADER[:5]), "ctrl:shoulder_motor")

    # cells and rows
    csv("a word", cell(17, 2, "abc"), "row 17, column 'qpos:elbow'")
    csv("a unit in a cell", cell(30, 1, "0.5rad"), "row 30")
    csv("a date as time", cell(5, 0, "2024-05-01"), "row 5, column 'time'")
    csv("a hexadecimal number", cell(9, 1, "0x1F"), "row 9")
    csv("an underscore in a number", cell(9, 1, "1_000"), "row 9")
    csv("a row too short", line(40, ["0.38,0.1,0.2"]), "row 40")
    csv("a row too long", line(40, ["0.38,0,0,0,0,0,0,0"]), "row 40")
    csv("all rows too long", text(np.column_stack([good, good[:, 0]]), HEADER), "cells")
    csv("an empty line", line(40, ["", "0.38,0,0,0,0,0,0"]), "row 40")
    csv("a header again", line(100, [",".join(HEADER)]), "row 100")
    csv("time missing", cell(12, 0, ""), "row 12, column 'time'")
    csv("time nan", cell(12, 0, "nan"), "row 12, column 'time'")
    csv("time infinite", cell(12, 0, "inf"), "row 12, column 'time'")
    csv("control nan", cell(20, 5, "nan"), "row 20, column 'ctrl:shoulder_motor'")
    csv("control empty", cell(20, 6, ""), "row 20, column 'ctrl:elbow_motor'")
    csv("control infinite", cell(20, 6, "-inf"), "row 20, column 'ctrl:elbow_motor'")
    csv("position infinite", cell(21, 1, "inf"), "row 21, column 'qpos:shoulder'")
    csv("huge position", cell(22, 1, "1e30"), "row 22, column 'qpos:shoulder'")
    csv("huge velocity", cell(22, 3, "-7e22"), "row 22, column 'qvel:shoulder'")
    csv("huge control", cell(23, 5, "1e200"), "row 23")
    csv("beyond floating point", cell(23, 1, "1e999"), "row 23")

    # time
    table("repeated time", "repeats", lambda x: x.__setitem__((50, 0), x[49, 0]))
    table("almost repeated time", "remove one", lambda x: x.__setitem__((50, 0), x[49, 0] + 1e-8))
    table(
        "time with too few digits",
        "more digits",
        lambda x: x.__setitem__((slice(None), 0), np.round(x[:, 0], 1)),
    )
    table("backward time", "backward", lambda x: x.__setitem__((50, 0), x[48, 0] + 0.001))
    table("two runs in one file", "backward", lambda x: np.vstack([x, x]))
    table("time reversed", "backward", lambda x: x[::-1])
    table("time constant", "repeats", lambda x: x.__setitem__((slice(None), 0), 1.0))
    table("time in ms", "milliseconds", lambda x: x.__setitem__((slice(None), 0), x[:, 0] * 1e3))
    table("time in us", "microseconds", lambda x: x.__setitem__((slice(None), 0), x[:, 0] * 1e6))
    table("time in ns", "nanoseconds", lambda x: x.__setitem__((slice(None), 0), x[:, 0] * 1e9))
    table(
        "time in days", "seconds", lambda x: x.__setitem__((slice(None), 0), x[:, 0] / 86400 / 100)
    )
    table("a gap", "gap", lambda x: np.delete(x, slice(100, 200), 0))

    # units and columns
    no_speed = (slice(None), slice(3, 5))
    table(
        "positions in degrees",
        "degrees",
        lambda x: (
            x.__setitem__((slice(None), slice(1, 3)), np.rad2deg(x[:, 1:3])),
            x.__setitem__(no_speed, np.nan),
        )[0],
    )
    table(
        "one position in degrees",
        "degrees",
        lambda x: (
            x.__setitem__((slice(None), 1), np.rad2deg(x[:, 1])),
            x.__setitem__(no_speed, np.nan),
        )[0],
    )
    table(
        "positions in degrees beside velocities",
        "degrees",
        lambda x: x.__setitem__((slice(None), 1), np.rad2deg(x[:, 1])),
    )
    table(
        "velocities in degrees", "degrees", lambda x: x.__setitem__(no_speed, np.rad2deg(x[:, 3:5]))
    )
    table("velocities exchanged", "swapped", lambda x: x[:, [0, 1, 2, 4, 3, 5, 6]])
    table(
        "velocity turned round",
        "opposite sign",
        lambda x: x.__setitem__((slice(None), 3), -x[:, 3]),
    )
    table("positions exchanged", "exchanged", lambda x: x[:, [0, 2, 1, 4, 3, 5, 6]])
    table(
        "wrapped angle",
        "unwrap",
        lambda x: (
            x.__setitem__((slice(None), 1), (x[:, 1] + 6 * x[:, 0] + np.pi) % (2 * np.pi) - np.pi),
            x.__setitem__(no_speed, np.nan),
        )[0],
    )
    table(
        "control in mN m",
        "range",
        lambda x: x.__setitem__((slice(None), slice(5, 7)), 1000 * x[:, 5:7]),
    )

    # too little
    table(
        "nothing measured",
        "no position",
        lambda x: x.__setitem__((slice(None), slice(1, 3)), np.nan),
    )
    table("too few rows", "not enough data", lambda x: x[:12])
    table("too short to hold back", "not enough data", lambda x: x[:25])
    table("still", "not enough data", lambda x: x.__setitem__((slice(None), slice(1, 7)), 0.0))
    table(
        "only noise",
        "not enough data",
        lambda x: (
            x.__setitem__((slice(None), slice(5, 7)), 0.0),
            x.__setitem__(
                (slice(None), slice(1, 5)), np.random.default_rng(0).normal(size=(len(x), 4)) * 1e-3
            ),
        )[0],
    )

    # NPZ
    npz("NPZ with a pickle", "pickled", qpos=np.array([Exploit(), None], dtype=object))
    npz("NPZ with a ragged list", "pickled", ctrl=np.array([[0.0], [0.0, 1.0]], dtype=object))
    npz("a bare pickle", "NPZ", pickle.dumps(Exploit()))
    npz("NPZ rubbish", "NPZ", b"\x00\x01\x02" * 300)
    npz("NPZ cut off", "NPZ", archive(**whole(good))[:-200])
    npz("NPZ empty", "empty", b"")
    npz("NPZ of nothing", "missing", archive())
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as z:
        z.writestr("time.npy", "not an array")
    npz("NPZ with text", "time", stream.getvalue())
    flipped = bytearray(archive(**whole(good)))
    flipped[400:440] = bytes(40)
    npz("NPZ damaged", "NPZ", bytes(flipped))
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as z:
        z.writestr(
            "time.npy",
            b"\x93NUMPY\x01\x00\x76\x00"
            + b"{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999999,), }".ljust(117)
            + b"\n",
        )
    npz("NPZ that claims terabytes", "NPZ", stream.getvalue())
    npz("NPZ without time", "'time' is missing", time=None)
    npz("NPZ without positions", "'qpos' is missing", qpos=None)
    npz("NPZ without control", "'ctrl' is missing", ctrl=None)
    npz("NPZ misspelt", "did you mean 'qvel'", qvels=good[:, 3:5])
    npz("NPZ positions too wide", "(400, 3)", qpos=good[:, 1:4])
    npz("NPZ velocity too narrow", "qvel", qvel=good[:, 3:4])
    npz("NPZ control one row short", "repeat the last row", ctrl=good[:-1, 5:7])
    npz("NPZ transposed", "transpose", qpos=good[:, 1:3].T)
    npz("NPZ times as a table", "'time'", time=good[:, :2])
    npz("NPZ of words", "real numbers", qpos=good[:, 1:3].astype(str))
    npz("NPZ complex", "real numbers", qpos=good[:, 1:3] + 1j)
    npz(
        "NPZ of dates",
        "real numbers",
        time=np.array(["2024-01-01"] * len(good), dtype="datetime64[s]"),
    )
    npz(
        "NPZ control nan",
        "row 7",
        ctrl=np.where(np.arange(len(good))[:, None] == 7, np.nan, good[:, 5:7]),
    )
    npz("NPZ unknown sensor", "sensor", **{"sensor:gyro": good[:, :3]})

    # models, folders, the command line
    model, recordings, out = (
        ["--model", "{dir}/arm.xml"],
        ["--recordings", "{dir}/run.csv"],
        ["--out", "{dir}/report"],
    )
    command("no such model", "no such model", "--model", "{dir}/absent.xml", *recordings, *out)
    command("model is a folder", "no such model", "--model", "{dir}", *recordings, *out)
    command(
        "model empty", "does not load", "--model", "{dir}/bad.xml", *recordings, *out, bad_xml=b""
    )
    command(
        "model not XML",
        "does not load",
        "--model",
        "{dir}/bad.xml",
        *recordings,
        *out,
        bad_xml=b"hello",
    )
    command(
        "model cut off",
        "does not load",
        "--model",
        "{dir}/bad.xml",
        *recordings,
        *out,
        bad_xml=ARM.encode()[:400],
    )
    command(
        "model with an unknown element",
        "does not load",
        "--model",
        "{dir}/bad.xml",
        *recordings,
        *out,
        bad_xml=ARM.replace("<motor", "<engine", 1).encode(),
    )
    command(
        "model without a mesh's file",
        "does not load",
        "--model",
        "{dir}/bad.xml",
        *recordings,
        *out,
        bad_xml=b'<mujoco><asset><mesh file="gone.stl"/></asset><worldbody/></mujoco>',
    )
    command(
        "model without joints",
        "no joints",
        "--model",
        "{dir}/bad.xml",
        *recordings,
        *out,
        bad_xml=b"<mujoco><worldbody/></mujoco>",
    )
    command(
        "model that blows up",
        "blows up",
        "--model",
        "{dir}/bad.xml",
        *recordings,
        *out,
        bad_xml=ARM.replace('damping="0.05"', 'stiffness="-1e9"')
        .replace("implicitfast", "Euler")
        .encode(),
    )
    command("no such environment", "does not load", "--env", "NoSuchEnv-v9", *recordings, *out)
    command(
        "environment without MuJoCo", "does not load", "--env", "CartPole-v1", *recordings, *out
    )
    command("out is a file", "not a folder", *model, *recordings, "--out", "{dir}/run.csv")
    command(
        "out below a file", "not a folder", *model, *recordings, "--out", "{dir}/run.csv/report"
    )
    command("no arguments", "--help")
    command("no recordings", "recordings", *model, *out)
    command("recordings named by nobody", "recordings", *model, "--recordings", *out)
    command("neither model nor environment", "--model", *recordings, *out)
    command("both model and environment", "--env", *model, "--env", "Hopper-v5", *recordings, *out)
    command("unknown option", "--colour", *model, *recordings, *out, "--colour", "red")
    command(
        "a recording twice", "twice", *model, "--recordings", "{dir}/run.csv", "{dir}/run.csv", *out
    )
    command(
        "held out and fitted", "held out", *model, *recordings, "--held-out", "{dir}/run.csv", *out
    )
    command(
        "held out is empty",
        "empty",
        *model,
        *recordings,
        "--held-out",
        "{dir}/more.csv",
        *out,
        more_csv=b"",
    )
    command(
        "second recording is bad",
        "more.csv",
        *model,
        "--recordings",
        "{dir}/run.csv",
        "{dir}/more.csv",
        *out,
        more_csv=text(good)[:-20],
    )
    return found | of_robots(good)


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
