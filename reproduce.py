"""Run the paper's experiments again, and say of every claim whether it holds.

    python reproduce.py                                   # all: ten seeds, sixty processor hours
    python reproduce.py --experiments hopper --seeds 0 1 2 --jobs 8 --grounding-steps 3
    python reproduce.py --arms rgat gat --minutes 30      # stops in time; called again it goes on
    python reproduce.py --claims                          # figures and claims.csv from its rows
    python reproduce.py --merge other/results             # rows that another machine made

Runs are train.py's and lie in runs/VERSION/. results/rounds.csv has a row per grounding step,
results/judged.csv one per run, with the code's version and the commit. What is there already is not
run again; a run that was cut off goes on.
"""

import argparse
import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from tqdm import tqdm

from envs import EnvError
from training import claims_page
from training.experiments import EXPERIMENTS, version
from training.results import JUDGED, ROUNDS, finished, merge, read, rows_of, write
from training.run_folder import RunError

ROOT = Path(__file__).resolve().parent


class Job:
    """One seed of one arm, as a process of its own."""

    def __init__(self, arm, seed, steps, runs):
        self.arm, self.seed = arm, seed
        self.settings = arm.of(seed)
        self.steps = self.settings.grounding_steps if steps is None else steps
        name = "-".join((self.settings.env, arm.name.replace(" ", "_").replace(",", ""), arm.key))
        self.folder = runs / f"{name}-s{seed}"
        self.pretrained = runs / "pretrained"
        self.process = None

    def begun(self):
        return (self.folder / "progress.csv").exists()

    def command(self):
        """train.py's arguments: a new run, or one that goes on to as many grounding steps."""
        if (self.folder / "config.json").exists():
            return ["--resume", str(self.folder), "--grounding-steps", str(self.steps)]
        options = {**vars(self.arm.settings), "seed": self.seed, "threads": 1}
        options |= {
            "grounding_steps": self.steps,
            "out": self.folder,
            "pretrained": self.pretrained,
        }
        default = vars(type(self.settings)())
        return [
            word
            for name, value in options.items()
            if name not in default or value != default[name]
            for word in (f"--{name.replace('_', '-')}", str(value))
        ]

    def start(self):
        self.folder.parent.mkdir(parents=True, exist_ok=True)
        with self.folder.with_suffix(".log").open("w") as log:
            self.process = process([str(ROOT / "train.py"), *self.command()], log)

    def stop(self):
        self.process.send_signal(signal.SIGINT)
        self.process.wait()

    def said(self):
        return self.folder.with_suffix(".log").read_text().strip().splitlines()[-1:]


def process(words, log):
    """Python with some arguments, in the background. Interrupts reach it, also where a shell that
    put us into the background has them ignored."""
    return subprocess.Popen(
        [sys.executable, *words],
        stdout=log,
        stderr=log,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def run_all(jobs, width, deadline, keep):
    """Run jobs, `width` at a time; keep(job) is told each that ends. Returns the jobs that failed.

    Of jobs that begin with the same policy, one trains it while the others wait: it is shared.
    """
    waiting, running, failed = list(jobs), [], []
    bar = tqdm(total=len(jobs), unit="run", disable=None)
    try:
        while (waiting or running) and time.monotonic() < deadline:
            for job in [job for job in running if job.process.poll() is not None]:
                running.remove(job)
                keep(job)
                bar.update()
                if job.process.returncode:
                    failed.append(job)
                    bar.write(f"{job.folder.name}: {' '.join(job.said())}")
            training = {job.arm.start(job.seed) for job in running if not job.begun()}
            for job in waiting:
                if len(running) < width and job.arm.start(job.seed) not in training:
                    job.start()
                    running.append(job)
                    training.add(job.arm.start(job.seed))
            waiting = [job for job in waiting if job not in running]
            time.sleep(0.5)
    finally:
        for job in running:
            job.stop()
            keep(job)
    return failed


def commit():
    """The commit that the code is of, with + where files differ from
    it; "" outside a repository."""
    git = lambda *words: subprocess.run(
        ["git", "-C", str(ROOT), *words], capture_output=True, text=True
    )
    head = git("rev-parse", "--short=10", "HEAD").stdout.strip()
    changed = git("status", "--porcelain", "--untracked-files=no", "--", "*.py").stdout.strip()
    return head + "+" * bool(changed)


def arms_of(experiments, names):
    """The arms of experiments, all of them or the named ones. Raises RunError for a name that none
    of them has."""
    arms = [arm for name in experiments for arm in EXPERIMENTS[name]]
    unknown = set(names or ()) - {arm.name for arm in arms}
    if unknown:
        known = "; ".join(dict.fromkeys(arm.name for arm in arms))
        raise RunError(f"--arms: no {', no '.join(map(repr, sorted(unknown)))}: choose of {known}")
    return [arm for arm in arms if not names or arm.name in names]


def table_of(path):
    """The rows of another machine's table. Raises RunError where there is none."""
    if not path.is_file():
        raise RunError(f"--merge: {path} is no file: name a folder with rounds.csv and judged.csv")
    return read(path)


def keep_rows(tables, others):
    """Put others, rows for each of the tables, into them."""
    for path, columns, rows in zip(tables, (ROUNDS, JUDGED), merge(tables, others)):
        write(path, rows, columns)


def parse(argv):
    """The parsed command line."""
    parser = argparse.ArgumentParser(
        prog="reproduce.py",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--experiments",
        nargs="+",
        choices=list(EXPERIMENTS),
        metavar="NAME",
        help=f"of: {'; '.join(EXPERIMENTS)}",
    )
    parser.add_argument("--arms", nargs="+", metavar="NAME", help="only these lines of them")
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(10)))
    parser.add_argument(
        "--grounding-steps",
        type=int,
        help="fewer or more than the paper's; a later call can add to them",
    )
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time, a core each")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop after so long")
    parser.add_argument("--claims", action="store_true", help="run nothing")
    parser.add_argument("--merge", type=Path, metavar="RESULTS", help="take over another's rows")
    parser.add_argument("--runs", type=Path, default=ROOT / "runs")
    parser.add_argument("--results", type=Path, default=ROOT / "results")
    parser.add_argument(
        "--commit", default=None, help="name of the code, where there is no repository"
    )
    return parser.parse_args(argv)


def main(argv=None):
    """The command; returns its exit status.

    0: done; 1: runs failed or wait; 2: a request that cannot be met."""
    args = parse(argv)
    tables = args.results / "rounds.csv", args.results / "judged.csv"
    try:
        if args.merge:
            keep_rows(tables, [table_of(args.merge / path.name) for path in tables])
        failed, waiting = [], []
        if not args.claims and not args.merge:
            arms = arms_of(args.experiments or EXPERIMENTS, args.arms)
            name, now = args.commit or commit(), version()
            # seed by seed, so that whenever it stops every arm has the same seeds
            jobs = [
                Job(arm, seed, args.grounding_steps, args.runs / now)
                for seed in args.seeds
                for arm in arms
            ]
            todo = [job for job in jobs if not finished(tables, job, now)]

            def keep(job):
                keep_rows(tables, rows_of(job, now, name))

            failed = run_all(todo, args.jobs, time.monotonic() + 60 * args.minutes, keep)
            waiting = [job for job in todo if not finished(tables, job, now)]
            print(f"{len(jobs) - len(waiting)} of {len(jobs)} runs are in {tables[0]}")
        claims_page.report(args.results)
        return 1 if failed or waiting else 0
    except (EnvError, RunError, OSError, KeyError, csv.Error) as error:
        print(f"reproduce.py: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\nstopped; the same command goes on", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
