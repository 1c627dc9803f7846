"""Running trials and writing their table: one row per trial, whatever tool is entered.

    row = run_trial(Task(number=3, key=(1, 3), settings="development"), template, limit=900)

A trial is drawn, the tool gets nominal model and training recordings in a folder of its own, its
report is scored by `scoring` and replayed on held-out recordings that it never saw.
"""

import csv
import itertools
import json
import math
import os
import shutil
import sys
import tempfile
import time
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path

import mujoco
from tqdm import tqdm

from diagnosis.common.atomic_files import write_table
from diagnosis.trials.drawing import draw_trial
from diagnosis.trials.folder import answer_text
from diagnosis.trials.kept import BENCH, HELD_OUT, keep, read_answer
from diagnosis.trials.prediction import model_error
from diagnosis.trials.replay import load_runs, replay
from diagnosis.trials.robots import DEVELOPMENT, FINAL
from diagnosis.trials.scoring import Score, score_findings
from diagnosis.trials.tools import ROOT, run_tool

QUEUE = 2  # tasks given to a cluster at once, for each of its cores
SETTINGS = {"development": DEVELOPMENT, "final": FINAL}
COLUMNS = tuple(
    "number key seals version tool settings answer exit seconds cpu_seconds verdict findings "
    "needed found first listed class_sizes valued false neutral strict values unknown_right "
    "error_before error_after error_floor reported_after note".split()
)


@dataclass(frozen=True)
class Task:
    """A trial to run. key: integers it is drawn from; secret: what the seal hides, revealed in the
    row; seals: the commit that published the seals ("" in development); drawn: the folder of a
    trial that was kept, which is not drawn again."""

    number: int
    key: tuple
    settings: str
    secret: str = ""
    seals: str = ""
    version: str = ""
    drawn: str = ""


def run_trial(task, template, limit=900):
    """Draw a trial, run the tool on it, score what it wrote. Returns a row of the table."""
    # what the tool sees does not lie beside the answer
    with tempfile.TemporaryDirectory() as parent, tempfile.TemporaryDirectory() as kept:
        folder = Path(task.drawn or Path(kept) / "drawn")
        if not task.drawn:
            keep(draw_trial(task.key, SETTINGS[task.settings]), folder)
        answer, floor = read_answer(folder)
        nominal = mujoco.MjModel.from_xml_path(str(folder / BENCH / "sim.xml"))
        row = {
            "number": task.number,
            "key": task.secret or "-".join(map(str, task.key)),
            "seals": task.seals,
            "version": task.version,
            "tool": template.replace(str(ROOT), "."),
            "settings": task.settings,
            "answer": answer_text(answer),
            "error_before": model_error(nominal, nominal, *load_runs(folder / HELD_OUT)),
            "error_floor": floor,
        }
        bench = shutil.copytree(folder / BENCH, Path(parent) / "run")
        names = sorted(path.name for path in bench.glob("train_*.csv"))
        done = run_tool(template, bench, names, limit)
        row |= {"exit": done.exit, "seconds": done.seconds, "cpu_seconds": done.cpu_seconds}
        row["note"] = done.note.replace(str(ROOT), ".")
        if done.exit == 0 and (done.report / "corrected.xml").exists():
            row["error_after"] = replay(bench / "sim.xml", done.report, folder / HELD_OUT)
        summary = done.summary() if done.exit == 0 else None
    return plain(row | judged(answer, summary))


def judged(answer, summary):
    """The columns that say what a diagnosis.json (None: there is none) is worth against an
    answer."""
    try:
        score = score_findings(answer, summary["findings"] if summary else [])
        findings = summary["findings"] if summary else []
        reported = ((summary or {}).get("fit") or {}).get("held_out") or {}
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        return judged(answer, None) | {
            "note": f"diagnosis.json cannot be scored: {type(error).__name__} {error}"[:300]
        }
    row = score_columns(score)
    row["strict"] = int(score.strict and summary is not None)
    return row | {
        "verdict": (summary or {}).get("verdict", ""),
        "findings": json.dumps(findings) if summary else "",
        "reported_after": reported.get("after", ""),
    }


def score_columns(score: Score):
    """A Score as columns."""
    values = [
        {"item": m.item, **asdict(v), "near": v.near, "held": v.held}
        for m in score.matches
        if m.item in score.needed
        for v in m.values
    ]
    return {
        "needed": len(score.needed),
        "found": score.found,
        "first": score.first,
        "listed": sum(score.matches[k].listed for k in score.needed),
        "class_sizes": json.dumps([m.class_size for m in score.matches if m.finding is not None]),
        "valued": score.valued,
        "false": len(score.false),
        "neutral": len(score.neutral),
        "values": json.dumps(values),
    }


def plain(row):
    """A row with numbers as short text."""
    return {k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()}


# the table


def read_rows(path):
    """Rows of a table, as dicts of text; none where there is no such file."""
    csv.field_size_limit(10**8)
    if not Path(path).exists():
        return []
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def write_rows(path, rows):
    """The whole table, by number, at once."""
    write_table(path, COLUMNS, sorted(rows, key=lambda row: int(row["number"])))


def cores():
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()


def run_tasks(tasks, template, out, jobs, limit, ray_address=None, minutes=math.inf):
    """Run the tasks that `out` has no row of yet, in order; the table is written after each.

    minutes: after that many no further trial is begun; those under way are finished.
    """
    rows = read_rows(out)
    done = {int(row["number"]) for row in rows}
    wanted = [task for task in tasks if task.number not in done]
    Path(out).parent.mkdir(parents=True, exist_ok=True)
    waiting = until(wanted, time.monotonic() + 60 * minutes)
    results = on_ray if ray_address else on_cores
    source = results(waiting, template, limit, ray_address or jobs)
    for row in tqdm(source, total=len(wanted), disable=not sys.stderr.isatty()):
        if int(row["number"]) not in done:  # a task that a lost node had done is not counted twice
            done.add(int(row["number"]))
            rows.append(row)
            write_rows(out, rows)
    return rows


def until(tasks, deadline):
    """The tasks, as long as the clock has not passed the deadline."""
    for task in tasks:
        if time.monotonic() > deadline:
            return
        yield task


def on_cores(tasks, template, limit, jobs):
    """Rows as they come, from `jobs` processes; a task is taken when a process is free for it."""
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        begin = lambda task: pool.submit(run_trial, task, template, limit)
        running = {begin(task) for task in itertools.islice(tasks, jobs)}
        while running:
            ready, running = wait(running, return_when=FIRST_COMPLETED)
            running |= {begin(task) for task in itertools.islice(tasks, len(ready))}
            yield from (future.result() for future in ready)


def on_ray(tasks, template, limit, address):
    """Rows as they come, from a Ray cluster; what a lost node had begun is begun again
    elsewhere."""
    import ray

    root = str(Path(__file__).resolve().parents[2])
    environment = {"env_vars": {"PYTHONPATH": root, "OMP_NUM_THREADS": "1"}}
    ray.init(address=address, runtime_env=environment, log_to_driver=False)
    try:
        remote = ray.remote(num_cpus=1, max_retries=-1)(run_trial)
        begin = lambda task: remote.remote(task, template, limit)
        width = QUEUE * max(1, int(ray.cluster_resources().get("CPU", 1)))
        running = [begin(task) for task in itertools.islice(tasks, width)]
        while running:
            ready, running = ray.wait(running, num_returns=1)
            running += [begin(task) for task in itertools.islice(tasks, len(ready))]
            yield from ray.get(ready)
    finally:
        ray.shutdown()
