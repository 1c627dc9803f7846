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


def merge(path, others):
    """The rows of a CSV and of another (or of a list): of a run that both
    hold, the ones that went further."""
    found = {}
    for rows in (read(path), others if isinstance(others, list) else read(others)):
        runs = {}
        for row in rows:
            runs.setdefault(tuple(str(row[k]) for k in SAME), []).append(row)
        for key, run in runs.items():
            if len(run) >= len(found.get(key, ())):
                found[key] = run
    return [row for run in found.values() for row in run]


def finished(path, job, version):
    """Whether a CSV holds every grounding step of a job."""
    key = {
        "experiment": job.arm.experiment,
        "arm": job.arm.name,
        "settings": job.arm.key,
        "version": version,
        "seed": str(job.seed),
    }
    mine = [row for row in read(path) if all(row[k] == v for k, v in key.items())]
    return any(int(row["grounding_step"]) >= job.steps for row in mine)


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
