"""Seals, run and audit in a repository of its own, with a tool that says nothing and one that
lies."""

import csv
import json
import subprocess
import sys
from dataclasses import replace

import pytest

from diagnosis.trials import command as protocol
from diagnosis.trials import table
from diagnosis.trials.audit import audit
from diagnosis.trials.command import main, sealed_tasks
from diagnosis.trials.robots import DEVELOPMENT
from diagnosis.trials.sealing import SealError, publishing_commit, read_pairs, trial_key
from diagnosis.trials.table import Task, read_rows, run_trial, until, write_rows

SMALL = replace(
    DEVELOPMENT,
    joints=(1, 1),
    touching=0.0,
    run_seconds=0.7,
    train_runs=1,
    held_out_runs=1,
    noise=(1e-3, 2e-3),
)
SILENT = """import json, shutil, sys
out = sys.argv[-1]
import os; os.makedirs(out)
shutil.copy(sys.argv[1], out + "/corrected.xml")
json.dump({"format": 2, "verdict": "match", "findings": []}, open(out + "/diagnosis.json", "w"))
"""
COUNT, WHEN = 3, "2020-01-01T00:00:00Z"


def git(folder, *words):
    who = ("-c", "user.name=a", "-c", "user.email=a@b.c")
    subprocess.run(["git", *who, *words], cwd=folder, check=True, capture_output=True)


def command(monkeypatch, *words):
    monkeypatch.setattr(sys, "argv", ["prove.py", *map(str, words)])
    main()


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    """(repository with published seals and a run's table, its rows, the tool's command line)."""
    patch = pytest.MonkeyPatch()
    folder = tmp_path_factory.mktemp("repository")
    for name in ("GIT_AUTHOR_DATE", "GIT_COMMITTER_DATE"):
        patch.setenv(name, WHEN)  # the same hash each time
    git(folder, "init", "-q")
    (folder / "readme").write_text("a repository")
    (folder / "silent.py").write_text(SILENT)
    git(folder, "add", ".")
    git(folder, "commit", "-qm", "Begin")
    seals = folder / "final.seals"
    patch.setattr(protocol, "new_keys", lambda count: [f"{k:032x}" for k in range(count)])
    git(folder, "config", "user.name", "a")
    git(folder, "config", "user.email", "a@b.c")
    command(patch, "seal", "--trials", COUNT, "--out", seals, "--publish")
    patch.setitem(table.SETTINGS, "small", SMALL)
    commit = publishing_commit(seals)
    keys = read_pairs((folder / "final.seals.keys").read_text())
    tool = f"{{python}} {folder / 'silent.py'} {{model}} {{recordings}} {{out}}"
    rows = [
        run_trial(Task(n, trial_key(commit, keys[n], n), "small", keys[n], commit, commit), tool)
        for n in range(COUNT)
    ]
    write_rows(folder / "table.csv", rows)
    yield folder, read_rows(folder / "table.csv"), tool
    patch.undo()


def checked(folder, rows, **options):
    """The audit's lines for other rows of the table."""
    write_rows(folder / "other.csv", rows)
    return list(audit(folder / "other.csv", folder / "final.seals", **options))


def test_a_silent_tool_is_right_of_nulls_and_changes_no_prediction(published):
    _, rows, _ = published
    for row in rows:
        hidden = json.loads(row["answer"])["hidden"]
        assert row["strict"] == ("0" if int(row["needed"]) else "1")
        assert int(row["needed"]) <= len(hidden) and row["false"] == "0" and row["exit"] == "0"
        assert float(row["error_after"]) == pytest.approx(float(row["error_before"]), rel=1e-4)
        assert 0 < float(row["error_floor"]) < 1e3


def test_an_honest_table_passes_every_check_drawn_again(published):
    folder, rows, _ = published
    lines = checked(folder, rows)
    assert lines[-1] == f"{COUNT} trials drawn again: the same answers"


def test_a_run_that_stopped_early_says_so_and_leaves_out_none(published):
    folder, rows, _ = published
    assert any("first 2 of 3" in line for line in checked(folder, rows[:2], redraw=0))
    with pytest.raises(SealError, match="trial 0 is missing"):
        checked(folder, rows[1:])


def changed(rows, number, **values):
    return [row | values if int(row["number"]) == number else row for row in rows]


def test_what_was_tampered_with_is_found(published):
    folder, rows, _ = published
    with pytest.raises(SealError, match="not the one that was sealed"):
        checked(folder, changed(rows, 1, key=rows[0]["key"]))
    with pytest.raises(SealError, match="by the rules"):
        checked(folder, changed(rows, 1, found="7"))
    with pytest.raises(SealError, match="twice"):
        checked(folder, [*rows, rows[0]])
    answer = json.loads(rows[0]["answer"])
    easier = json.dumps(answer | {"joints": 12}, sort_keys=True)
    with pytest.raises(SealError, match="hides something else"):
        checked(folder, changed(rows, 0, answer=easier), redraw=1)


def test_seals_count_only_if_committed_alone_and_left_alone(published, tmp_path):
    git(tmp_path, "init", "-q")
    git(tmp_path, "commit", "-q", "--allow-empty", "-m", "Begin")
    path = tmp_path / "final.seals"
    path.write_text("0 abc\n")
    with pytest.raises(SealError, match="not committed"):
        publishing_commit(path)
    (tmp_path / "table.csv").write_text("number\n")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-qm", "Both at once")
    with pytest.raises(SealError, match="with other files"):
        publishing_commit(path)
    path.write_text("0 abd\n")
    git(tmp_path, "commit", "-qam", "Other seals")
    with pytest.raises(SealError, match="changed after"):
        publishing_commit(path)


def test_keys_that_are_not_the_sealed_ones_run_nothing(published, tmp_path):
    folder, *_ = published
    keys = folder / "final.seals.keys"
    kept = keys.read_text()
    keys.write_text(kept.replace(kept.split()[1], "f" * 32))
    try:
        with pytest.raises(SealError, match="trial 0 is not the one|differs from its commit"):
            sealed_tasks(folder / "final.seals")
    finally:
        keys.write_text(kept)


def test_a_diagnosis_that_cannot_be_read_is_a_row_with_a_note():
    row = table.judged({"hidden": [], "distinct": []}, {"findings": [{"place": "here"}]})
    assert row["strict"] == 0 and "cannot be scored" in row["note"]


def test_no_trial_begins_after_the_deadline():
    assert list(until(range(3), float("inf"))) == [0, 1, 2] and not list(until(range(3), 0.0))


def test_the_page_counts_the_rows(published, monkeypatch, capsys):
    folder, rows, _ = published
    command(monkeypatch, "page", folder / "table.csv", "--out", folder / "page.html")
    said = capsys.readouterr().out
    nulls = sum(json.loads(row["answer"])["kind"] == "null" for row in rows)
    line = next(line for line in said.splitlines() if "nothing hidden" in line)
    assert nulls == 0 or f"(0/{nulls}" in line
    assert "<table>" in (folder / "page.html").read_text()


def test_rows_are_a_csv_with_every_column(published):
    folder, *_ = published
    with open(folder / "table.csv", newline="") as file:
        assert next(csv.reader(file)) == list(table.COLUMNS)
