"""Tables of finished runs: which rows there are, of which version, and how
those of two machines come together."""

import csv
import json
from pathlib import Path

from diagnosis.common.atomic_files import write_table
from training.run_folder import PROGRESS

KEY = "experiment arm env policy algo settings version commit seed".split()
ROUNDS = [*KEY, *PROGRESS]
JUDGED = [
    *KEY,
    "grounding_step",
    "episodes",
    "real_return_deterministic",
    "se",
    "before_grounding",
    "trained_on_real",
]
SAME = "experiment arm settings version seed".split()  # what makes two rows rows of one run


def read(path):
    """The rows of a CSV as dicts; none where there is no file."""
    path = Path(path)
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def write(path, rows, columns):
    """Write rows whole, in an order of their own."""
    path.parent.mkdir(parents=True, exist_ok=True)
    order = lambda row: (
        row["experiment"],
        row["arm"],
        row["version"],
        int(row["seed"]),
        int(row["grounding_step"]),
    )
    write_table(path, columns, sorted(rows, key=order))


def merge(tables, others):
    """The rows of two CSVs, rounds and judged, and of two others (lists of rows): of a run that
    both hold, those of the side that went further in rounds, of equal ones the judged side."""
    found = {}
    for rounds, judged in (map(read, tables), others):
        runs = {}
        for table, rows in enumerate((rounds, judged)):
            for row in rows:
                run = tuple(str(row[k]) for k in SAME)
                runs.setdefault(run, ([], []))[table].append(row)
        for key, run in runs.items():
            if key not in found or [len(rows) for rows in run] >= [len(r) for r in found[key]]:
                found[key] = run
    return tuple([row for run in found.values() for row in run[table]] for table in (0, 1))


def finished(tables, job, version):
    """Whether two CSVs, rounds and judged, hold every grounding step of a job and its verdict."""
    key = {
        "experiment": job.arm.experiment,
        "arm": job.arm.name,
        "settings": job.arm.key,
        "version": version,
        "seed": str(job.seed),
    }
    rounds, judged = (
        [row for row in read(path) if all(row[k] == v for k, v in key.items())] for path in tables
    )
    return bool(judged) and any(int(row["grounding_step"]) >= job.steps for row in rounds)


def rows_of(job, version, commit):
    """What a job's folder holds: rows for rounds.csv, and for
    judged.csv where the run has ended."""
    s = job.settings
    key = dict(
        zip(
            KEY,
            (
                job.arm.experiment,
                job.arm.name,
                s.env,
                s.policy,
                s.algo,
                job.arm.key,
                version,
                commit,
                str(job.seed),
            ),
        )
    )
    rounds = [{**key, **row} for row in read(job.folder / "progress.csv")]
    try:
        best, lines = (
            json.loads((job.folder / n).read_text()) for n in ("best.json", "lines.json")
        )
    except FileNotFoundError:
        return rounds, []
    before = rounds[0]["real_return_deterministic"]
    judged = {
        **key,
        **best,
        "before_grounding": before,
        "trained_on_real": lines["trained on real"],
    }
    return rounds, [{k: judged[k] for k in JUDGED}]
