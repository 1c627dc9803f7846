"""Checking a table from a clone alone: seals before table, seed from the commit, trials redrawn.

for line in audit("results/proof_final.csv", "results/final.seals", redraw=20): print(line)
"""

import json
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from diagnosis.trials.drawing import draw_trial
from diagnosis.trials.sealing import (
    SealError,
    git,
    is_ancestor,
    publishing_commit,
    read_pairs,
    seal,
    trial_key,
)
from diagnosis.trials.table import SETTINGS, judged, read_rows

DIGITS = 6  # significant: the last ones differ between processors
RULES = ("needed", "found", "first", "listed", "valued", "false", "neutral", "strict")


def audit(table, seals, redraw=None, jobs=1):
    """Yield a line per check that holds; raises SealError at the first that does not.

    redraw: how many trials to draw again, evenly spread; None for all.
    """
    commit = publishing_commit(seals)
    yield f"{Path(seals).name}: published alone by commit {commit[:12]}, unchanged since"
    published = read_pairs(Path(seals).read_text())
    rows = read_rows(table)
    yield from check_history(table, seals, commit, rows)
    numbers = [int(row["number"]) for row in rows]
    if len(set(numbers)) != len(numbers):
        raise SealError(f"{table}: a trial stands there twice")
    wanted = sorted(published)[: len(numbers)]
    if sorted(numbers) != wanted:
        lacking = sorted(set(wanted) - set(numbers))
        raise SealError(f"{table}: trial {lacking[0]} is missing, though later ones were run")
    if len(numbers) < len(published):
        yield f"the first {len(numbers)} of {len(published)} sealed trials were run, none left out"
    for row in rows:
        check_row(row, published, commit)
    yield f"{len(rows)} rows: every key is the one that was sealed, every score follows the rules"
    redraw = len(rows) if redraw is None else redraw
    chosen = rows[:: max(1, len(rows) // max(1, redraw))][:redraw]
    settings = [SETTINGS[row["settings"]] for row in chosen]
    # a fork would copy the locks of this process's threads, and wait for ever on one that is held
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        for row, answer in zip(chosen, pool.map(redrawn, chosen, settings)):
            if not alike(answer, json.loads(row["answer"])):
                raise SealError(f"trial {row['number']}: drawn again, it hides something else")
    yield f"{len(chosen)} trials drawn again: the same answers"


def check_history(table, seals, commit, rows):
    """The table came into the history after the seals, by code that came after them too."""
    path = Path(table).resolve()
    log = git("log", "--format=%H", "--reverse", "--", path.name, folder=path.parent).split()
    if not log:
        yield f"{path.name}: not committed yet"
    elif log[0] == commit or not is_ancestor(commit, log[0], path.parent):
        raise SealError(f"{path.name}: its first commit {log[0][:12]} does not follow the seals'")
    else:
        yield f"{path.name}: first committed by {log[0][:12]}, after the seals"
    for version in sorted({row["version"] for row in rows}):
        if not is_ancestor(commit, version, path.parent):
            raise SealError(
                f"{path.name}: version {version[:12]} does not follow the seals' commit"
            )
    yield f"versions that ran: {', '.join(sorted({row['version'][:12] for row in rows}))}"


def check_row(row, published, commit):
    """A row's key fits its seal, its commit is the seals', its score what the rules say."""
    number = int(row["number"])
    if seal(row["key"]) != published.get(number):
        raise SealError(f"trial {number}: its key is not the one that was sealed")
    if row["seals"] != commit:
        raise SealError(f"trial {number}: drawn from commit {row['seals'][:12]}, not the seals'")
    summary = None
    if row["findings"]:
        summary = {"findings": json.loads(row["findings"])}
    again = judged(json.loads(row["answer"]), summary)
    for name in RULES:
        if str(again[name]) != row[name]:
            raise SealError(f"trial {number}: {name} is {row[name]}, by the rules {again[name]}")


def redrawn(row, settings):
    """The answer of a row's trial, drawn again by its Settings."""
    key = trial_key(row["seals"], row["key"], int(row["number"]))
    return json.loads(json.dumps(draw_trial(key, settings).answer))


def alike(one, other):
    """Are two answers the same but for the last digits of their numbers?"""
    if isinstance(one, dict):
        return (
            isinstance(other, dict)
            and one.keys() == other.keys()
            and all(alike(one[k], other[k]) for k in one)
        )
    if isinstance(one, list):
        return len(one) == len(other) and all(map(alike, one, other))
    if isinstance(one, float) and isinstance(other, int | float):
        return abs(one - other) <= 10.0**-DIGITS * max(abs(one), abs(other), 1e-6)
    return one == other
