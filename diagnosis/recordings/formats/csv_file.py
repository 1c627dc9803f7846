"""CSV: a header of column names, then one row of numbers for each time.

Rows are counted as an editor counts them: the header is row 1 where no comments stand above it.
"""

import csv
import io

import numpy as np

from diagnosis.recordings.columns import Names, RecordingError
from diagnosis.recordings.layout import Layout, Raw


class CsvFile:
    """Reads text with a header; what no other format claims."""

    def read(self, path, name, data, model, layout: Layout) -> list[Raw]:
        """The one run of a file whose bytes are `data`. Raises RecordingError."""
        header, body, first_row = _parts(path, data)
        used = _checked(path, header, model, layout)
        columns = dict(zip(header, _table(path, body, header, first_row, used).T))
        return [Raw(path, name, columns, {column: column for column in header}, first_row)]


def _parts(path, data):
    """(the header's cells, the text below it, that text's first row) of a CSV file's bytes."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise RecordingError(f"{path}: written as UTF-16; save it as UTF-8 CSV")
    if b"\x00" in data:
        raise RecordingError(
            f"{path}: binary data, not CSV; give a text file with a header, or an NPZ"
        )
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        row = data.count(b"\n", 0, error.start) + 1
        raise RecordingError(
            f"{path}: row {row}: not UTF-8 text; save the file as UTF-8 CSV"
        ) from None
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    above, first, body = _header_line(text)
    try:
        header = [cell.strip() for cell in next(csv.reader([first], strict=True), [])]
        header = [
            cell[1:-1] if len(cell) > 1 and cell[0] == cell[-1] == '"' else cell for cell in header
        ]  # quoted after a space
    except csv.Error as error:
        raise RecordingError(
            f"{path}: row {above + 1}: the header cannot be read ({error}); write plain column "
            f"names"
        ) from None
    if "time" not in header:
        for mark, name in ((";", "semicolons"), ("\t", "tabs"), ("|", "bars"), (" ", "spaces")):
            if "time" in [cell.strip(' "') for cell in first.split(mark)]:
                raise RecordingError(
                    f"{path}: row {above + 1}: columns are separated by {name}; separate them by "
                    f"commas"
                )
        if all(_number(cell) is not None for cell in header):
            raise RecordingError(
                f"{path}: row {above + 1}: no header; the first line must name the columns "
                "(time,qpos:<joint>,...)"
            )
    return header, body, above + 2


def _table(path, body, header, first_row, used):
    """(T, columns) of the text below the header; columns that are not of `used` may be NaN."""
    if not body.strip():
        raise RecordingError(f"{path}: a header and no rows; record again or leave it out")
    try:
        if "\n\n" in "\n" + body.rstrip():
            raise ValueError
        table = np.loadtxt(io.StringIO(body), delimiter=",", ndmin=2, comments=None)
        if table.shape[1] != len(header):
            raise ValueError
        return table
    except (
        ValueError,
        OverflowError,
    ):  # something is odd: read it slowly, to say where, or to accept empty cells
        return _slow(path, body, header, first_row, used)


def _checked(path, header, model, layout):
    """The columns that are read, complete for the model. Raises RecordingError on unknown, repeated
    or missing ones, before any row is read."""
    known = Names(model)
    seen = []
    for position, name in enumerate(header, start=1):
        ours = known.canonical(name)
        if ours is None and not layout.mapped:
            raise RecordingError(f"{path}: column {position} ({name!r}): {known.unknown(name)}")
        if name in seen or ours in seen:
            raise RecordingError(
                f"{path}: column {position} ({name!r}): stands twice in the header; remove one"
            )
        seen.append(ours or name)
    plan = layout.plan(path, header, {column: column for column in header}, model)
    if not layout.mapped:
        return set(header)
    return {source.column for source in plan.sources.values()}


def _header_line(text):
    """(lines above it, the header, all that follows): comments may stand above, and numpy.savetxt
    writes "# time,..."."""
    above, rest = 0, text
    while True:
        first, _, rest = rest.partition("\n")
        bare = first.lstrip("# \t")
        if not first.startswith("#") or "time" in [cell.strip() for cell in bare.split(",")]:
            return above, bare if first.startswith("#") else first, rest
        above += 1


def _slow(path, body, names, first_row, used):
    """(T, columns) of a CSV body cell by cell: empty cells are NaN, as are columns that are not of
    `used`, which may hold words; anything else odd raises RecordingError."""
    rows = []
    lines = body.rstrip().split("\n")
    for row, line in enumerate(lines, start=first_row):
        if not line.strip():
            raise RecordingError(
                f"{path}: row {row}: an empty line inside the recording; remove it"
            )
        cells = [cell.strip().strip('"') for cell in line.split(",")]
        if len(cells) != len(names):
            why = (
                " (is the file cut off?)"
                if row == len(lines) + first_row - 1
                else " (is a decimal comma used?)"
                if len(cells) > len(names)
                else ""
            )
            raise RecordingError(
                f"{path}: row {row}: {len(cells)} cells where the header has {len(names)}; repair "
                f"the "
                f"row{why}"
            )
        values = [
            _number(cell) if cell and name in used else float("nan")
            for name, cell in zip(names, cells)
        ]
        if None in values:
            k = values.index(None)
            raise RecordingError(
                f"{path}: row {row}, column {names[k]!r}: {cells[k][:40]!r} is not a number; "
                "write nan for what was not measured"
            )
        rows.append(values)
    return np.array(rows, dtype=float)


def _number(cell):
    try:
        return None if "_" in cell else float(cell)  # Python alone reads 1_000 as a number
    except ValueError:
        return None
