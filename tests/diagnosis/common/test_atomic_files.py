"""Files are written whole or not at all."""

import csv
import errno
import os
import stat

import pytest

from diagnosis.common.atomic_files import WriteError, write_table, write_together, write_whole


def test_text_and_bytes(tmp_path, monkeypatch):
    write_whole(tmp_path / "a.txt", "N·m\n")
    write_whole(str(tmp_path / "b.bin"), b"\x00\xff")
    assert (tmp_path / "a.txt").read_bytes() == "N·m\n".encode() and (
        tmp_path / "b.bin"
    ).read_bytes() == b"\x00\xff"
    write_whole(tmp_path / "a.txt", "new")
    monkeypatch.chdir(tmp_path)
    write_whole("c.txt", "here")
    assert (
        sorted(os.listdir(tmp_path)) == ["a.txt", "b.bin", "c.txt"]
        and (tmp_path / "a.txt").read_text() == "new"
    )
    mask = os.umask(0)
    os.umask(mask)
    assert stat.S_IMODE(os.stat("c.txt").st_mode) == 0o666 & ~mask


@pytest.mark.parametrize("fails", ["fsync", "replace"])
def test_what_was_there_before_stays(tmp_path, monkeypatch, fails):
    (tmp_path / "a").write_text("old")

    def full(*args):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, fails, full)
    with pytest.raises(
        WriteError, match="cannot write .*a: No space left on device; free some space"
    ) as error:
        write_together({tmp_path / "a": "new", tmp_path / "b": "new"})
    assert "\n" not in str(error.value)
    assert os.listdir(tmp_path) == ["a"] and (tmp_path / "a").read_text() == "old"


def test_nothing_is_replaced_where_a_folder_is_in_the_way(tmp_path):
    (tmp_path / "a").write_text("old")
    (tmp_path / "b").mkdir()
    with pytest.raises(WriteError, match="cannot write .*b: a folder has that name"):
        write_together({tmp_path / "a": "new", tmp_path / "b": "new"})
    assert sorted(os.listdir(tmp_path)) == ["a", "b"] and (tmp_path / "a").read_text() == "old"


def test_who_stops_it_leaves_no_parts(tmp_path, monkeypatch):
    def stopped(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", stopped)
    with pytest.raises(KeyboardInterrupt):
        write_whole(tmp_path / "a", "new")
    assert os.listdir(tmp_path) == []


def test_no_such_folder(tmp_path):
    with pytest.raises(WriteError, match="cannot write .*missing/a: No such file"):
        write_whole(tmp_path / "missing/a", "")


def test_table(tmp_path):
    write_table(tmp_path / "t.csv", ("a", "b"), [{"a": 1, "c": 2}, {"a": "x,y", "b": 3}])
    with open(tmp_path / "t.csv", newline="") as stream:
        assert list(csv.DictReader(stream)) == [{"a": "1", "b": ""}, {"a": "x,y", "b": "3"}]
