"""Files written whole or not at all: a reader, and whoever stops the program, never sees half of
one.

write_whole(path, "text or bytes")
write_together({path: "text", other: b"bytes"})     # none takes its name before all are complete
write_table("rows.csv", ("name", "value"), [{"name": "mass", "value": 1.0}])
"""

import csv
import errno
import io
import os


class WriteError(ValueError):
    """A file that cannot be written. One line: which, why, and what to do."""


def write_whole(path, data):
    """Write text (as UTF-8) or bytes under a temporary name, then rename. Raises WriteError."""
    write_together({path: data})


def write_together(files):
    """Write {path: text or bytes}, each under a temporary name beside it; the names change once all
    are on the disk.

    Raises WriteError, and then leaves what was there before (but where the change of names itself
    fails half-way).
    """
    waiting = {}
    try:
        for path in files:
            if os.path.isdir(path):
                raise IsADirectoryError(errno.EISDIR, "a folder has that name", path)
        for path, data in files.items():
            folder, name = os.path.split(os.fspath(path))
            partial = os.path.join(folder, f".{name}.{os.getpid()}.partial")
            with open(partial, "wb") as stream:
                waiting[partial] = path
                stream.write(data.encode() if isinstance(data, str) else data)
                stream.flush()
                os.fsync(stream.fileno())
        for partial, path in waiting.items():
            os.replace(partial, path)
    except BaseException as error:  # whoever stops the program leaves nothing behind either
        for partial in waiting:
            if os.path.exists(partial):
                os.remove(partial)
        if not isinstance(error, OSError):
            raise
        raise WriteError(
            f"cannot write {path}: {error.strerror or error}; free some space or choose another "
            "folder"
        ) from None


def write_table(path, columns, rows):
    """A CSV: a header, then the dicts of rows; missing cells stay empty, other keys are left out.
    Raises WriteError."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, restval="", extrasaction="ignore")
    writer.writeheader()
    writer.writerows(rows)
    write_whole(path, text.getvalue())
