"""Result tables that grow by finished rows: what every resumable benchmark writes and looks up."""

import csv
import io


def append(path, rows):
    """Add dicts (columns: the first one's keys) to a CSV in a single write, so that parallel runs
    do not mix theirs."""
    path.parent.mkdir(parents=True, exist_ok=True)
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    with path.open("a", newline="") as file:
        if file.tell() == 0:
            writer.writeheader()
        writer.writerows(rows)
        file.write(text.getvalue())


def finished(path, key):
    """Whether a CSV holds a row with the values of the dict key."""
    if not path.exists():
        return False
    with path.open(newline="") as file:
        return any(all(row[k] == str(v) for k, v in key.items()) for row in csv.DictReader(file))
