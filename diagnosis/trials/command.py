"""The public benchmark: physics hidden in robots that nobody tuned on, any tool may enter.

    python prove.py run --development --seed 1 --trials 60 --jobs 2 --out results/development.csv
    python prove.py show --seed 1 --trial 15 --folder /tmp/t15       # draw a development trial

    python prove.py seal --trials 600 --out results/final.seals --publish
    python prove.py run --seals results/final.seals --out results/proof_final.csv
    python prove.py audit results/proof_final.csv --seals results/final.seals
    python prove.py page results/proof_final.csv --out results/proof_final.html

`--tool "command {model} {recordings} {out}"` enters another tool: it finds the nominal MJCF at
{model}, the CSV files {recordings}, and writes diagnosis.json, corrected.xml, or both into {out}.
docs/validation.md has the protocol and the rules.
"""

import argparse
import math
import sys
from pathlib import Path

from diagnosis.common.atomic_files import WriteError, write_whole
from diagnosis.trials import page as proof_page
from diagnosis.trials.audit import audit
from diagnosis.trials.drawing import draw_trial
from diagnosis.trials.folder import answer_text, write_folder
from diagnosis.trials.kept import is_kept
from diagnosis.trials.robots import DEVELOPMENT
from diagnosis.trials.sealing import (
    SealError,
    checked_out,
    git,
    new_keys,
    publishing_commit,
    read_pairs,
    seal,
    seals_text,
    trial_key,
)
from diagnosis.trials.table import Task, cores, read_rows, run_tasks
from diagnosis.trials.tools import DIAGNOSE, ROOT, expand


def main():
    """Run the command line; bad input ends with one line on stderr and status 2."""
    options = parse(sys.argv[1:])
    try:
        {"seal": do_seal, "run": do_run, "show": do_show, "audit": do_audit, "page": do_page}[
            options.command
        ](options)
    except (SealError, WriteError, OSError) as error:
        print(f"prove.py {options.command}: {error}", file=sys.stderr)
        sys.exit(2)


def parse(words):
    """The options of a command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    command = commands.add_parser(
        "seal", help="make keys, write the seals that are to be published"
    )
    command.add_argument("--trials", type=int, default=600)
    command.add_argument("--out", type=Path, required=True, help="the seals; keys go to OUT.keys")
    command.add_argument("--publish", action="store_true", help="commit the seals, alone")
    command = commands.add_parser("run", help="run trials and append them to a table")
    source = command.add_mutually_exclusive_group(required=True)
    source.add_argument("--development", action="store_true", help="trials of a plain seed")
    source.add_argument("--seals", type=Path, help="published seals; keys are read from SEALS.keys")
    command.add_argument("--seed", type=int, default=1, help="of the development trials")
    command.add_argument("--trials", type=int, help="trials 0 .. N-1 (all that are sealed)")
    command.add_argument("--drawn", type=Path, help="folder where development trials are kept")
    command.add_argument("--out", type=Path, required=True, help="CSV; trials in it are not rerun")
    command.add_argument("--tool", default=DIAGNOSE, help="command line of the tool to score")
    command.add_argument("--limit", type=int, default=900, help="processor seconds for a trial")
    command.add_argument("--jobs", type=int, default=cores(), help="trials at once")
    command.add_argument("--minutes", type=float, default=math.inf, help="begin none after these")
    command.add_argument("--ray", metavar="ADDRESS", help="run on this Ray cluster instead")
    command = commands.add_parser("show", help="draw one development trial into a folder")
    command.add_argument("--seed", type=int, required=True)
    command.add_argument("--trial", type=int, required=True)
    command.add_argument("--folder", type=Path, required=True, help="made, and filled")
    command = commands.add_parser("audit", help="check a table, from a clone alone")
    command.add_argument("table", type=Path)
    command.add_argument("--seals", type=Path, required=True)
    command.add_argument("--redraw", type=int, help="trials to draw again (all)")
    command.add_argument("--jobs", type=int, default=cores())
    command = commands.add_parser("page", help="make the page of tables of the same trials")
    command.add_argument("tables", type=Path, nargs="+", help="one for each tool")
    command.add_argument("--out", type=Path, required=True)
    return parser.parse_args(words)


def do_seal(options):
    """Write seals and keys; never over older ones."""
    keys = Path(f"{options.out}.keys")
    for path in (options.out, keys):
        if path.exists():
            raise SealError(f"{path}: is there already; name another file")
    secret = new_keys(options.trials)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    write_whole(keys, "".join(f"{number} {key}\n" for number, key in enumerate(secret)))
    keys.chmod(0o600)
    write_whole(options.out, seals_text(secret))
    if not options.publish:
        print(f"{options.out}: commit it, alone. {keys}: keep it out of the history for good.")
        return
    folder, name = options.out.resolve().parent, options.out.name
    git("add", "--", name, folder=folder)
    git("commit", "-m", f"Seals of {options.trials} trials", "--", name, folder=folder)
    print(f"published by {publishing_commit(options.out)}; {keys}: keep it out of the history")


def do_run(options):
    """Run what is not in the table yet."""
    if options.development:
        count = 60 if options.trials is None else options.trials
        version = checked_out(ROOT)
        tasks = [
            Task(n, (options.seed, n), "development", version=version, drawn=kept(options, n))
            for n in range(count)
        ]
    else:
        tasks = sealed_tasks(options.seals)[: options.trials]
    run_tasks(
        tasks,
        options.tool,
        options.out,
        options.jobs,
        options.limit,
        options.ray,
        options.minutes,
    )


def kept(options, number):
    """The folder of a development trial that benchmarks/development.py has drawn; "" for none."""
    if options.drawn is None:
        return ""
    folder = options.drawn.resolve() / f"{options.seed}_{number}"
    if not is_kept(folder):
        raise SealError(f"{folder}: no drawn trial; see benchmarks/development.py draw")
    return str(folder)


def sealed_tasks(path):
    """Tasks of all published seals. Raises SealError where keys, seals and history do not fit."""
    commit = publishing_commit(path)
    published = read_pairs(path.read_text())
    keys = Path(f"{path}.keys")
    if not keys.exists():
        raise SealError(f"{keys}: not there; only who made the seals can run the trials")
    secrets = read_pairs(keys.read_text())
    version = git("rev-parse", "HEAD", folder=ROOT)
    if git("status", "--porcelain", "--untracked-files=no", folder=ROOT):
        raise SealError("the working tree differs from its commit; commit first, then run")
    for number, hashed in published.items():
        if seal(secrets.get(number, "")) != hashed:
            raise SealError(f"{keys}: the key of trial {number} is not the one that was sealed")
    return [
        Task(n, trial_key(commit, secrets[n], n), "final", secrets[n], commit, version)
        for n in sorted(published)
    ]


def do_show(options):
    """Draw a development trial, say how to diagnose it, and what it hides."""
    options.folder.mkdir(parents=True, exist_ok=True)
    trial = draw_trial((options.seed, options.trial), DEVELOPMENT)
    names = write_folder(trial, options.folder)
    print(f"cd {options.folder} &&", *expand(DIAGNOSE, "sim.xml", names, "report"))
    print(answer_text(trial.answer))


def do_audit(options):
    """Print every check that holds."""
    for line in audit(options.table, options.seals, options.redraw, options.jobs):
        print(line)


def do_page(options):
    """Write the page, and print its first table."""
    tables = {path.stem: read_rows(path) for path in options.tables}
    for name, rows in tables.items():
        if not rows:
            raise SealError(f"{name}: no trials in it; name a table that `prove.py run` made")
    proof_page.write(tables, options.out)
    for line in proof_page.headline(tables):
        print(line)


if __name__ == "__main__":
    main()
