"""Sealed blind trials of the diagnosis: hide an effect, diagnose as a user would, reveal, score.

    python prove.py run --seed 1 --trials 40 --out results/proof_dev.csv
    python prove.py show --seed 1 --trial 15 --folder /tmp/t15       # draw a development trial again
    python prove.py score results/proof.csv                          # again, by the present rules
    python prove.py page results/proof.csv --out results/proof.html

A trial is concealed here (conceal.py); SHA-256 of answer and salt goes to OUT.sealed; then
diagnose.py runs in its own process with nothing but the folder of nominal model and recordings;
then the answer is revealed, the seal checked, and the row of OUT written. Trials already in OUT are
not run again.

Scored as the contract counts: a finding is right when it is named or stands in also_possible;
time_step is no false alarm beside a right finding, nor where the truth was integrated finer.
"""

import argparse
import csv
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import Queue
from pathlib import Path

import mujoco
import numpy as np
from tqdm import tqdm

from diagnosis.common.atomic_files import write_table
from diagnosis.trials import page as proof_page
from diagnosis.trials.conceal import DEPENDS_ON, FINAL_SEED, conceal, seal
from diagnosis.trials.mechanisms import MECHANISMS, UNKNOWNS
from diagnosis.trials.reference_error import dof_noise, hand_error, stock_error
from diagnosis.trials.true_system import Real

ROOT = Path(__file__).resolve().parents[2]
COLUMNS = (
    "seed",
    "trial",
    "commitment",
    "salt",
    "answer",
    "kind",
    "mechanism",
    "noise",
    "finer",
    "over_noise",
    "exit",
    "seconds",
    "cpu_seconds",
    "verdict",
    "findings",
    "found",
    "first",
    "extras",
    "parameters",
    "error_before",
    "error_after",
    "error_floor",
    "reported_before",
    "reported_after",
    "remeasured_after",
    "note",
)
PARAMETERS = {
    "mass": ("mass",),
    "center_of_mass": ("x", "y", "z"),
    "inertia": ("ixx", "iyy", "izz"),
    "stribeck_friction": ("coulomb", "static", "velocity"),
    "joint_stop": ("low", "high"),
    "cogging": ("amplitude", "poles", "phase"),
    "backlash": ("gap",),
    "gravity": ("x", "y", "z"),
    "wind": ("x", "y", "z"),
    "external_force": ("x", "y", "z"),
    "payload_change": ("mass",),
}  # others have one
VECTORS = ("center_of_mass", "inertia", "gravity", "wind", "external_force")


def over_noise(answer, runs, without):
    """How far the hidden items `without` (indices) move the prediction of Runs, in units of noise."""
    rest = [item for index, item in enumerate(answer["hidden"]) if index not in without]
    coarse = any(answer["hidden"][index]["effect"] == "time_step" for index in without)
    real = Real(MECHANISMS[answer["mechanism"]], rest, 1 if coarse else answer["finer"])
    return hand_error(real, runs, answer["noise"], True)


# the diagnosis, as a user would run it


def diagnose(command, folder, limit=900):
    """Run diagnose.py in `folder` with a bare environment, for at most `limit` CPU seconds.

    Returns the columns exit, seconds (of the clock), cpu_seconds and note (stderr's last line).
    """
    environment = {"PATH": os.defpath, "HOME": str(folder), "OMP_NUM_THREADS": "1"}
    begun, used = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, str(ROOT / "diagnose.py"), *command, "--out", "report"],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (limit, limit)),
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    note = (done.stderr.strip().splitlines() or [""])[-1]
    note = note if done.returncode >= 0 else f"stopped by signal {-done.returncode}"
    return {
        "exit": done.returncode,
        "seconds": time.monotonic() - begun,
        "note": note[:300],
        "cpu_seconds": after.ru_utime + after.ru_stime - used.ru_utime - used.ru_stime,
    }


# scoring


def names(finding):
    """Every (effect, place) that a finding holds possible, its own first."""
    return [
        (f["effect"], f["place"]["kind"], f["place"]["name"])
        for f in [finding, *finding.get("also_possible", [])]
    ]


def right(finding, item):
    """Does a finding name the hidden item, as the contract counts it?"""
    if item["effect"] not in UNKNOWNS:
        return (item["effect"], item["place"]["kind"], item["place"]["name"]) in names(finding)
    if ("unknown", "joint", item["place"]["name"]) not in names(finding):
        return False
    parts = [variable.partition(":") for variable in finding.get("depends_on", [])]
    return set(DEPENDS_ON[item["effect"]]) <= {
        kind
        for kind, _, name in parts
        if kind in ("time", "control") or name == item["place"]["name"]
    }


def score(answer, findings):
    """found, first, extras: hidden items named anywhere / by a finding's own name / findings of what is not there."""
    hidden = answer["hidden"]
    found = [any(right(f, item) for f in findings) for item in hidden]
    first = [any(right(f | {"also_possible": []}, item) for f in findings) for item in hidden]
    spare = lambda f: f["effect"] == "time_step" and (answer["finer"] > 1 or any(found))
    extras = [f for f in findings if not any(right(f, item) for item in hidden) and not spare(f)]
    return {"found": sum(found), "first": sum(first), "extras": len(extras)}


def compare_parameters(answer, findings, runs):
    """[{effect, name, truth, size, nominal, value, low, high}] of each right first name; components that move nothing are left
    out. size: of a vector, how far all of it lies from the nominal one."""
    rows = []
    for index, item in enumerate(answer["hidden"]):
        finding = next((f for f in findings if right(f | {"also_possible": []}, item)), None)
        if finding is None or item["effect"] in UNKNOWNS:
            continue
        reported = finding["parameters"]
        wanted = PARAMETERS.get(item["effect"]) or list(item["parameters"])[:1]
        for name in wanted:
            match = reported if len(wanted) == 1 else [p for p in reported if p["name"] == name]
            size = (
                float(
                    np.linalg.norm([item["parameters"][p["name"]] - p["nominal"] for p in reported])
                )
                if item["effect"] in VECTORS
                else 0.0
            )
            if not match or size and _still(answer, index, name, size, runs):
                continue
            more = (
                match[0]["nominal"] if item["effect"] == "back_emf" else 0.0
            )  # it was hidden beside what a servo has of it
            rows.append(
                {
                    "effect": item["effect"],
                    "name": name,
                    "truth": item["parameters"][name] + more,
                    "size": size,
                    **{key: match[0].get(key) for key in ("nominal", "value", "low", "high")},
                }
            )
    return rows


def _still(answer, index, component, size, runs):
    """True where this component of a hidden vector, changed by the size of the whole, moves predictions by less than the noise."""
    item = answer["hidden"][index]
    changed = item | {
        "parameters": item["parameters"] | {component: item["parameters"][component] + size}
    }
    rest = [changed if k == index else other for k, other in enumerate(answer["hidden"])]
    real = Real(MECHANISMS[answer["mechanism"]], rest, answer["finer"])
    return hand_error(real, runs, answer["noise"], True) < 1.0


def run_trial(seed, number, sealed):
    """One sealed trial; appends its seal to the file `sealed`, returns the row of the table."""
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "bench"
        folder.mkdir()
        trial = conceal(seed, number, folder)
        with open(sealed, "a") as file:
            file.write(f"{seed} {number} {trial.commitment}\n")
        return reveal(trial, folder / "report", seed, number, diagnose(trial.command, folder))


def scoring_runs(trial):
    """(held-out Runs, those in which something comes and goes)."""
    return (
        [run for name, run in trial.runs.items() if name.startswith("held_out")],
        [run for run in trial.runs.values() if run.event.any()],
    )


def sizes(trial):
    """How far each hidden item moves predictions, in units of noise."""
    answer, (held_out, events) = json.loads(trial.answer), scoring_runs(trial)
    return [
        round(
            over_noise(answer, events if item["parameters"].get("event") else held_out, {index}), 4
        )
        for index, item in enumerate(answer["hidden"])
    ]


def reveal(trial, report, seed, number, done):
    """Check the seal, score the report against the answer. done: what `diagnose` returned. Returns the row."""
    if seal(trial.answer, trial.salt) != trial.commitment:
        raise ValueError(
            f"trial {number} of seed {seed}: the answer is not the one that was sealed"
        )
    answer = json.loads(trial.answer)
    held_out, _ = scoring_runs(trial)
    nominal = MECHANISMS[answer["mechanism"]].spec().compile()
    row = {
        "seed": seed,
        "trial": number,
        "commitment": trial.commitment,
        "salt": trial.salt,
        "answer": trial.answer,
        "kind": answer["kind"],
        "mechanism": answer["mechanism"],
        "noise": answer["noise"],
        "finer": answer["finer"],
        "over_noise": json.dumps(sizes(trial)),
        **done,
        "error_before": stock_error(nominal, nominal, held_out, answer["noise"]),
        "error_floor": hand_error(
            Real(MECHANISMS[answer["mechanism"]], answer["hidden"], answer["finer"]),
            held_out,
            answer["noise"],
            False,
        ),
    }
    try:
        row |= scored(trial, report, nominal) if done["exit"] == 0 else {}
    except (
        OSError,
        ValueError,
        KeyError,
        IndexError,
        TypeError,
        mujoco.FatalError,
    ) as error:  # the report's fault: it counts as no diagnosis
        row |= {
            "exit": 1,
            "note": f"the report cannot be scored: {type(error).__name__} {error}"[:300],
        }
    return {name: f"{v:.6g}" if isinstance(v, float) else v for name, v in row.items()}


def scored(trial, report, nominal):
    """The columns of a row that say what a report is worth."""
    summary, (held_out, _) = (
        json.loads((report / "diagnosis.json").read_text()),
        scoring_runs(trial),
    )
    corrected = mujoco.MjModel.from_xml_path(str(report / "corrected.xml"))
    fit = summary["fit"]["held_out"]
    return {
        "verdict": summary["verdict"],
        "findings": json.dumps(summary["findings"]),
        **judged(trial, summary["findings"]),
        "error_after": stock_error(nominal, corrected, held_out, json.loads(trial.answer)["noise"]),
        "reported_before": fit["before"],
        "reported_after": fit["after"],
        "remeasured_after": stock_error(
            nominal, corrected, held_out, dof_noise(nominal, summary["noise"])
        ),
    }


def judged(trial, findings):
    """Of those, what the findings alone decide."""
    answer, (held_out, events) = json.loads(trial.answer), scoring_runs(trial)
    return {
        **score(answer, findings),
        "parameters": json.dumps(compare_parameters(answer, findings, events or held_out)),
    }


def again(row):
    """A row scored again by these rules, its trial drawn again. Raises ValueError where that gives another answer than was sealed."""
    with tempfile.TemporaryDirectory() as folder:
        trial = conceal(int(row["seed"]), int(row["trial"]), Path(folder))
    drawn, sealed = (
        json.loads(text, parse_float=lambda x: f"{float(x):.9g}")
        for text in (trial.answer, row["answer"])
    )
    if drawn != sealed:  # but for the last digits, which differ between processors
        raise ValueError(
            f"trial {row['trial']} of seed {row['seed']}: drawn again, the answer is not the one that was sealed"
        )
    return {
        **row,
        "over_noise": json.dumps(sizes(trial)),
        **(judged(trial, json.loads(row["findings"])) if row["exit"] == "0" else {}),
    }


# the table


def read(path):
    """Rows of a table of trials, as dicts of text."""
    csv.field_size_limit(10**8)
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def published(path):
    """{(seed, trial): [commitment, ...]} of the seals beside a table: more than one where a trial was broken off and run again."""
    seals = {}
    for line in Path(f"{path}.sealed").read_text().splitlines():
        seed, trial, commitment = line.split()
        seals.setdefault((seed, trial), []).append(commitment)
    return seals


def write(path, rows):
    """The whole table, sorted, at once."""
    write_table(path, COLUMNS, sorted(rows, key=lambda row: (int(row["seed"]), int(row["trial"]))))


def cores():
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()


def _pin(cores):
    """Keep this worker and the diagnoses that it starts on one core, where there is more than one worker."""
    core = cores.get()
    if core is not None:
        os.sched_setaffinity(0, {core})


def run(seed, numbers, out, jobs):
    """Run the trials `numbers` of a seed that `out` does not hold yet."""
    out = Path(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    rows = read(out) if out.exists() else []
    done = {int(row["trial"]) for row in rows if int(row["seed"]) == seed}
    wanted = [number for number in numbers if number not in done]
    cores = Queue()  # one for each worker, lest threads wait for each other
    allowed = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    for job in range(jobs):
        cores.put(allowed[job % len(allowed)] if allowed and jobs > 1 else None)
    with ProcessPoolExecutor(jobs, initializer=_pin, initargs=(cores,)) as pool:
        futures = [pool.submit(run_trial, seed, number, f"{out}.sealed") for number in wanted]
        try:
            for future in tqdm(
                as_completed(futures), total=len(futures), disable=not sys.stderr.isatty()
            ):
                rows.append(future.result())
                write(out, rows)
        except BaseException:  # a fault: what has not begun is not sealed either
            pool.shutdown(cancel_futures=True)
            raise


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    command = commands.add_parser("run", help="run sealed trials and append them to a table")
    command.add_argument(
        "--seed",
        type=int,
        required=True,
        help=f"below 1000 to develop on; {FINAL_SEED} is the final one",
    )
    command.add_argument("--trials", type=int, default=400, help="trials 0 .. N-1")
    command.add_argument("--first", type=int, default=0, help="start at this trial")
    command.add_argument("--out", required=True, help="CSV; its seals go to OUT.sealed")
    command.add_argument(
        "--jobs", type=int, default=cores(), help="trials at once (all cores it may use)"
    )
    command = commands.add_parser(
        "show", help="draw one trial again: its folder, command and answer"
    )
    command.add_argument("--seed", type=int, required=True)
    command.add_argument("--trial", type=int, required=True)
    command.add_argument("--folder", required=True, help="made, and filled")
    command = commands.add_parser(
        "score",
        help="draw every trial of a table again, and score its findings by the present rules",
    )
    command.add_argument("table")
    command = commands.add_parser("page", help="make the page of figures from a table")
    command.add_argument("table")
    command.add_argument("--out", required=True)
    arguments = parser.parse_args()
    if arguments.command in ("score", "page"):
        for path in (arguments.table, f"{arguments.table}.sealed"):
            if not os.path.isfile(path) or not os.path.getsize(path):
                parser.error(
                    f"{path}: no such file, or empty; name a table that `prove.py run` made, with its seals beside it"
                )
        rows = read(arguments.table)
        if not rows:
            parser.error(
                f"{arguments.table}: no trials in it; name a table that `prove.py run` made"
            )
    if arguments.command == "run":
        run(arguments.seed, range(arguments.first, arguments.trials), arguments.out, arguments.jobs)
    elif arguments.command == "show":
        folder = Path(arguments.folder)
        folder.mkdir(parents=True, exist_ok=True)
        trial = conceal(arguments.seed, arguments.trial, folder)
        print(
            f"cd {folder} && python {ROOT / 'diagnose.py'}",
            *trial.command,
            "--out report\n" + trial.answer,
        )
    elif arguments.command == "score":
        with ProcessPoolExecutor(cores()) as pool:
            write(
                arguments.table, list(tqdm(pool.map(again, rows), disable=not sys.stderr.isatty()))
            )
    else:
        seals = published(arguments.table)
        proof_page.write(rows, seals, arguments.out)
        for line in proof_page.lines([proof_page.parse(row, seals) for row in rows]):
            print("{:100s} {:>9s} {:>8s}  {}".format(*line))
