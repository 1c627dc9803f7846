"""The contest's table and figures, on made rows."""

import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))

contest = pytest.importorskip("contest", reason="needs mujoco.sysid")


def row(who, error, rig="leg", unit="rad"):
    values = {"rig": rig, "entrant": who, "unit": unit, "error": error}
    return dict.fromkeys(contest.COLUMNS, "") | values


def test_scatter_is_the_median_of_shares_and_none_of_one_recording():
    alone = {"a": (2.0, [1.0, 3.0]), "b": (-1.0, [-1.0, -1.2]), "c": (5.0, [5.0]), "d": (None, [])}
    shares = np.sqrt(2.0) / 2, 0.1 * np.sqrt(2)
    assert contest.spread(alone) == pytest.approx(np.mean(shares))
    assert np.isnan(contest.spread({"c": (5.0, [5.0])}))


def test_the_page_keeps_its_words_and_the_least_error_is_bold():
    rows = [row("nominal", "0.02"), row("ours", "0.004"), row("nominal", "3", unit="m")]
    text = f"before\n{contest.BEGIN}\nold\n{contest.END}\nafter\n"
    once = contest.put_into(text, rows)
    assert once.startswith("before\n") and once.endswith("\nafter\n") and "old" not in once
    assert "**0.004 rad**" in once and "**3 m**" in once and "**0.02 rad**" not in once
    assert contest.put_into(once, rows) == once


def test_every_rig_is_drawn(tmp_path):
    rows = [row(who, e, rig) for rig in ("leg", "cart") for who, e in (("nominal", 1), ("PACE", 2))]
    contest.draw(rows, tmp_path / "contest.png")
    assert (tmp_path / "contest.png").read_bytes().startswith(b"\x89PNG")


def test_the_table_on_the_page_is_that_of_the_csv():
    rows = contest.read(ROOT / "results" / "contest.csv")
    assert contest.table(rows) in contest.PAGE.read_text(encoding="utf-8")
