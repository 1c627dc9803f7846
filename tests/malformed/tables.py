"""Recordings as CSV that must be refused."""

import gzip

import numpy as np
from arm import HEADER, archive, text, whole

from malformed.case import CTRL, ELBOW, EVERY, MODEL, ONE, OUT, QPOS, QVEL, TIME, Case, both, put


def no_tables(add):
    """CSV files that hold no table."""
    integers = lambda seed, low: np.random.default_rng(seed).integers(low, 256, 4000)
    latin = add.text.replace(b"qpos:elbow", "qpos:élbow".encode("latin-1"), 1)
    add.csv("empty file", b"", "empty")
    add.csv("only white space", b" \n\n  \n", "empty")
    add.csv("header only", (",".join(HEADER) + "\n").encode(), "no rows")
    add.csv("one row", text(add.good[:1]), "not enough data")
    add.csv("binary rubbish", integers(0, 0).astype(np.uint8).tobytes(), "binary")
    add.csv("rubbish without zeros", integers(1, 128).astype(np.uint8).tobytes(), "UTF-8")
    add.csv("UTF-16", add.text.decode().encode("utf-16"), "UTF-16")
    add.csv("latin-1 comment", latin, "UTF-8")
    add.csv("prose", b"Dear colleague,\nthe recordings are attached.\n", "not a column")
    add.csv("JSON", b'{"time": [0, 1], "qpos": [[0, 1], [2, 3]]}', "not a column")


def other_separators(add):
    """Tables that are not separated by commas, or not whole."""
    good = add.good
    add.csv("no header", add.text.split(b"\n", 1)[1], "header")
    add.csv("semicolons", text(good, separator=";"), "semicolons")
    add.csv("tabs", text(good, separator="\t"), "tabs")
    add.csv("spaces", text(good, separator=" "), "separated by spaces")
    add.csv("only comments", b"# a recording\n# of nothing\n", "no header")
    add.csv("gzip", gzip.compress(add.text), "gunzip")
    add.csv("decimal commas", add.text.replace(b".", b","), "cells")
    add.csv("unbalanced quote", b'"time,qpos:shoulder\n0,1\n', "header")
    add.csv("an NPZ called CSV, cut off", archive(**whole(good))[:300], "NPZ")
    add.csv("cut off in a row", add.text[:-20], "cells")


def other_files(add):
    """Folders, copies and devices in the place of a recording."""
    sound, copy = {"run.csv": add.text}, "{dir}/copy.csv"
    twice = {**sound, "copy.csv": add.text}
    folder = [*MODEL, "--recordings", "{dir}", *OUT]
    pattern = [*MODEL, "--recordings", "{dir}/*.csv", *OUT]
    device = [*MODEL, "--recordings", "/dev/null", *OUT]
    add.found |= {
        "a folder": Case({}, "folder", folder),
        "a folder of recordings": Case(sound, "name the files in it", folder),
        "a copy under another name": Case(twice, "same rows", [*MODEL, *ONE, copy, *OUT]),
        "a fitted file held out as a copy": Case(
            twice, "same rows", [*MODEL, *ONE, "--held-out", copy, *OUT]
        ),
        "no such file": Case({}, "no such file"),
        "unmatched pattern": Case({}, "no such file", pattern),
        "a device": Case({}, "regular file", device),
    }


def headers(add):
    """Columns that the model does not know, and columns that are missing."""
    good = add.good
    add.renamed("misspelt joint", "qpos:elbow", "qpos:elbwo", "did you mean 'qpos:elbow'")
    add.renamed("joint of another model", "qpos:elbow", "qpos:slider", "qpos:slider")
    motor = "ctrl:elbow_motor"
    add.renamed("misspelt actuator", motor, "ctrl:elbow", "did you mean 'ctrl:elbow_motor'")
    add.renamed("unknown sensor", "qvel:elbow", "sensor:gyro", "sensor")
    add.renamed("unknown kind", "qvel:elbow", "torque:elbow", "torque:elbow")
    add.renamed("component of a hinge", "qpos:elbow", "qpos:elbow:0", "qpos:elbow:0")
    add.renamed("column twice", "qpos:elbow", "qpos:shoulder", "twice")
    add.renamed("time twice", "qvel:elbow", "time", "twice")
    add.renamed("nameless column", "qvel:elbow", "", "no name")
    add.csv("no time", text(good[:, 1:], HEADER[1:]), "'time'")
    others = [name for name in HEADER if name != "qpos:elbow"]
    without = text(np.delete(good, ELBOW, 1), others)
    add.csv("no position of the elbow", without, "'qpos:elbow' is missing")
    add.csv("no control", text(good[:, :5], HEADER[:5]), "ctrl:shoulder_motor")


def cells(add):
    """Cells that are no numbers, and rows of another length."""
    add.cell("a word", 17, 2, "abc", "row 17, column 'qpos:elbow'")
    add.cell("a unit in a cell", 30, 1, "0.5rad", "row 30")
    add.cell("a date as time", 5, 0, "2024-05-01", "row 5, column 'time'")
    add.cell("a hexadecimal number", 9, 1, "0x1F", "row 9")
    add.cell("an underscore in a number", 9, 1, "1_000", "row 9")
    add.line("a row too short", 40, ["0.38,0.1,0.2"], "row 40")
    add.line("a row too long", 40, ["0.38,0,0,0,0,0,0,0"], "row 40")
    long = np.column_stack([add.good, add.good[:, 0]])
    add.csv("all rows too long", text(long, HEADER), "cells")
    add.line("an empty line", 40, ["", "0.38,0,0,0,0,0,0"], "row 40")
    add.line("a header again", 100, [",".join(HEADER)], "row 100")


def infinities(add):
    """Numbers that cannot be."""
    add.cell("time missing", 12, 0, "", "row 12, column 'time'")
    add.cell("time nan", 12, 0, "nan", "row 12, column 'time'")
    add.cell("time infinite", 12, 0, "inf", "row 12, column 'time'")
    add.cell("control nan", 20, 5, "nan", "row 20, column 'ctrl:shoulder_motor'")
    add.cell("control empty", 20, 6, "", "row 20, column 'ctrl:elbow_motor'")
    add.cell("control infinite", 20, 6, "-inf", "row 20, column 'ctrl:elbow_motor'")
    add.cell("position infinite", 21, 1, "inf", "row 21, column 'qpos:shoulder'")
    add.cell("huge position", 22, 1, "1e30", "row 22, column 'qpos:shoulder'")
    add.cell("huge velocity", 22, 3, "-7e22", "row 22, column 'qvel:shoulder'")
    add.cell("huge control", 23, 5, "1e200", "row 23")
    add.cell("beyond floating point", 23, 1, "1e999", "row 23")


def times(add):
    """Time that stands still, goes back, or counts something else than seconds."""
    times_of = lambda factor: put(EVERY, TIME, lambda x: x[:, 0] * factor)
    add.table("repeated time", "repeats", put(50, TIME, lambda x: x[49, 0]))
    add.table("almost repeated time", "remove one", put(50, TIME, lambda x: x[49, 0] + 1e-8))
    rounded = put(EVERY, TIME, lambda x: np.round(x[:, 0], 1))
    add.table("time with too few digits", "more digits", rounded)
    add.table("backward time", "backward", put(50, TIME, lambda x: x[48, 0] + 0.001))
    add.table("two runs in one file", "backward", lambda x: np.vstack([x, x]))
    add.table("time reversed", "backward", lambda x: x[::-1])
    add.table("time constant", "repeats", put(EVERY, TIME, 1.0))
    add.table("time in ms", "milliseconds", times_of(1e3))
    add.table("time in us", "microseconds", times_of(1e6))
    add.table("time in ns", "nanoseconds", times_of(1e9))
    days = put(EVERY, TIME, lambda x: x[:, 0] / 86400 / 100)
    add.table("time in days", "seconds", days)
    add.table("a gap", "gap", lambda x: np.delete(x, slice(100, 200), 0))


def units(add):
    """Degrees, and controls in thousandths."""
    no_speed = put(EVERY, QVEL, np.nan)
    in_degrees = lambda column: put(EVERY, column, lambda x: np.rad2deg(x[:, column]))
    wrap = lambda x: (x[:, 1] + 6 * x[:, 0] + np.pi) % (2 * np.pi) - np.pi
    add.table("positions in degrees", "degrees", both(in_degrees(QPOS), no_speed))
    add.table("one position in degrees", "degrees", both(in_degrees(1), no_speed))
    add.table("positions in degrees beside velocities", "degrees", in_degrees(1))
    add.table("velocities in degrees", "degrees", in_degrees(QVEL))
    add.table("wrapped angle", "unwrap", both(put(EVERY, 1, wrap), no_speed))
    add.table("control in mN m", "range", put(EVERY, CTRL, lambda x: 1000 * x[:, CTRL]))


def exchanges(add):
    """Columns under another's name, or turned round."""
    add.table("velocities exchanged", "swapped", lambda x: x[:, [0, 1, 2, 4, 3, 5, 6]])
    add.table("velocity turned round", "opposite sign", put(EVERY, 3, lambda x: -x[:, 3]))
    add.table("positions exchanged", "exchanged", lambda x: x[:, [0, 2, 1, 4, 3, 5, 6]])


def too_little(add):
    """Too little was measured, or nothing moves."""
    noise = lambda x: np.random.default_rng(0).normal(size=(len(x), 4)) * 1e-3
    add.table("nothing measured", "no position", put(EVERY, QPOS, np.nan))
    add.table("too few rows", "not enough data", lambda x: x[:12])
    add.table("too short to hold back", "not enough data", lambda x: x[:25])
    add.table("still", "not enough data", put(EVERY, slice(1, 7), 0.0))
    trembling = both(put(EVERY, CTRL, 0.0), put(EVERY, slice(1, 5), noise))
    add.table("only noise", "not enough data", trembling)
