"""One fault in a sound set of files, and the ways to make it."""

import io
import zipfile
from dataclasses import dataclass, field

from arm import ARM, HEADER, archive, run, text, whole

EVERY = slice(None)  # row
TIME, ELBOW, QPOS, QVEL, CTRL = 0, 2, slice(1, 3), slice(3, 5), slice(5, 7)  # columns of HEADER
MODEL = ["--model", "{dir}/arm.xml"]
ONE = ["--recordings", "{dir}/run.csv"]
OUT = ["--out", "{dir}/report"]


@dataclass
class Case:
    """files: {name: bytes} to write; argv with {dir} for their folder; says: what the line must
    hold."""

    files: dict
    says: str
    argv: list = field(default_factory=lambda: [*MODEL, *ONE, *OUT])

    def write(self, folder):
        for name, data in {"arm.xml": ARM.encode(), **self.files}.items():
            (folder / name).write_bytes(data)
        return [word.format(dir=folder) for word in self.argv]


class Exploit:
    """Unpickling it would raise; reading must refuse first."""

    def __reduce__(self):
        return (exec, ("raise SystemExit('unpickled')",))


def put(row, column, value):
    """A change of a table: cells become value, or value(table) of what they were."""

    def change(table):
        table[row, column] = value(table) if callable(value) else value

    return change


def both(*changes):
    """Changes of a table, one after the other."""

    def change(table):
        for each in changes:
            each(table)

    return change


class Builder:
    """Adds Cases to `found`, each of them the sound recording `good` (T, 7) with one fault."""

    def __init__(self):
        self.good, self.found = run(), {}
        self.text = text(self.good)

    def case(self, name, says, *argv, **files):
        """Files beside the sound run.csv as name_suffix=bytes."""
        files = {key.replace("_", "."): value for key, value in files.items()}
        self.found[name] = Case({"run.csv": self.text, **files}, says, list(argv))

    def csv(self, name, data, says):
        """A run.csv of its own, as bytes."""
        self.found[name] = Case({"run.csv": data}, says)

    def renamed(self, name, old, new, says):
        """Another name in the header."""
        header = [new if column == old else column for column in HEADER]
        self.csv(name, text(self.good, header), says)

    def table(self, name, says, change):
        """A table that `change` has spoiled in place, or has made another of."""
        spoiled = self.good.copy()
        made = change(spoiled)
        self.csv(name, text(spoiled if made is None else made), says)

    def cell(self, name, row, column, value, says):
        """Another text in one cell; row 1 is the header."""
        lines = self.text.decode().split("\n")
        cells = lines[row - 1].split(",")
        cells[column] = value
        lines[row - 1] = ",".join(cells)
        self.csv(name, "\n".join(lines).encode(), says)

    def line(self, name, row, lines, says):
        """Other lines in the place of one."""
        told = self.text.decode().split("\n")
        told[row - 1 : row] = lines
        self.csv(name, "\n".join(told).encode(), says)

    def npz(self, name, says, data=None, **arrays):
        """An archive of bytes, or of the sound arrays but for some (None: without it)."""
        if data is None:
            arrays = {**whole(self.good), **arrays}
            data = archive(**{key: value for key, value in arrays.items() if value is not None})
        argv = [*MODEL, "--recordings", "{dir}/run.npz", *OUT]
        self.found[name] = Case({"run.npz": data}, says, argv)


def zipped(name, data):
    """A ZIP archive of one file as bytes."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as z:
        z.writestr(name, data)
    return stream.getvalue()
