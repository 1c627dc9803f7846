"""The three files of a diagnosis: diagnosis.json to compute with, corrected.xml to simulate with,
report.html to look at (sections)."""

import csv
import html
import io
import itertools
import json
import math
import os
import re
from typing import Any

import numpy as np

from diagnosis.common.atomic_files import WriteError, write_together
from diagnosis.report import Diagnosis
from diagnosis.report.cards import unknown_curves
from diagnosis.report.force import courses
from diagnosis.report.sections import html_page, reads_files


class ReportError(ValueError):
    """The report cannot be written. One line: where, why, and what to do."""


def check_folder(out: str | os.PathLike) -> None:
    """Raises ReportError where a folder `out` cannot be written, before any computing is done."""
    if not out:
        raise ReportError("--out: no folder given; give the name of one to write")
    here = os.path.abspath(out)
    while not os.path.lexists(here):
        here = os.path.dirname(here)
    if not os.path.isdir(here):
        what = "is" if here == os.path.abspath(out) else f"{here} is"
        raise ReportError(f"{out}: {what} a file, not a folder; give another --out")
    if not os.access(here, os.W_OK | os.X_OK):
        raise ReportError(
            f"{out}: cannot be written; give another --out or change the permissions of {here}"
        )


def write(diagnosis: Diagnosis, out: str | os.PathLike) -> list[str]:
    """Write the report into folder `out`; the names of its files.

    report.html, diagnosis.json, corrected.xml, where needed corrected.py, a curve for each unknown
    force, named in its finding as `saved_as`, and one for each joint's missing force, named there
    as `curve`. A curve takes a name that is free; files of the earlier diagnosis in the folder go.
    All are complete under temporary names before the first takes its own. Raises ReportError where
    that fails; what was in the folder before is then unchanged.
    """
    summary, earlier = plain(diagnosis.summary), _earlier(out)
    free = _names(out, earlier)
    curves = {}
    for curve in unknown_curves(diagnosis):
        name = free("unknown_1.csv")
        curves[name] = _csv(curve)
        summary["findings"][curve["finding"]]["saved_as"] = name
    for joint, some in _by_joint(courses(diagnosis)).items():
        entry = summary["missing_force"]
        if isinstance(entry, dict) and joint in entry:
            name = free(f"force_{re.sub(r'[^A-Za-z0-9_.-]', '_', joint)}.csv")
            curves[name] = _course_table(some)
            entry[joint]["curve"] = name
    files = {
        "report.html": html_page(diagnosis),
        "diagnosis.json": json.dumps(summary, indent=2, allow_nan=False, ensure_ascii=False) + "\n",
        "corrected.xml": portable(diagnosis.corrected_xml, out),
    }
    if script := getattr(diagnosis, "corrected_py", ""):
        files["corrected.py"] = script
    files |= curves
    _replace(out, files, earlier)
    return list(files)


def _replace(out, files, earlier):
    """Write {name: text} into folder `out`, together, and remove the others of `earlier`."""
    made = not os.path.isdir(out)
    try:
        os.makedirs(out, exist_ok=True)
        write_together({os.path.join(out, name): text for name, text in files.items()})
        for name in earlier - set(files):
            os.remove(os.path.join(out, name))
    except (OSError, WriteError) as error:
        if made and os.path.isdir(out) and not os.listdir(out):
            os.rmdir(out)
        raise ReportError(f"the report is not written: {error}") from None


def _names(out, earlier):
    """A function that gives a name no other file of the folder has: the one it is asked for, or
    the same with the next number that is free."""
    taken = set()

    def free(name):
        stem, number = re.fullmatch(r"(.*?)(?:_(\d+))?\.csv", name).groups()
        others = (f"{stem}_{n}.csv" for n in itertools.count(int(number or 1) + 1))
        for candidate in itertools.chain([name], others):
            path = os.path.join(out, candidate)
            if candidate not in taken and (candidate in earlier or not os.path.lexists(path)):
                taken.add(candidate)
                return candidate

    return free


def _by_joint(courses):
    """{joint: its courses}, in their order."""
    return {c.joint: [other for other in courses if other.joint == c.joint] for c in courses}


def _course_table(courses):
    """The missing force of one joint as CSV, its recordings one after the other."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(("recording", "time", "force", "sd", "position", "velocity"))
    for c in courses:
        for values in zip(c.time, c.force, c.sd, c.position, c.velocity):
            rows.writerow((c.recording, *(f"{v:.9g}" if math.isfinite(v) else "" for v in values)))
    return text.getvalue()


def portable(xml: str, out: str | os.PathLike) -> str:
    """MJCF for folder `out`: where it reads files, folders of meshes and textures as seen from
    there, else without them."""
    reads = reads_files(xml)

    def seen(match):
        attribute, folder = match[1], html.unescape(match[2])
        if not reads:
            return ""
        try:
            folder = os.path.relpath(os.path.realpath(folder), os.path.realpath(out)).replace(
                os.sep, "/"
            )
        except ValueError:  # on another drive
            pass
        return f' {attribute}="{html.escape(folder)}"'

    return re.sub(
        r"(?<=<compiler)[^>]*",
        lambda head: re.sub(r'\s(meshdir|texturedir)="([^"]*)"', seen, head[0]),
        xml,
    )


def _earlier(out):
    """The files in folder `out`, besides the three, that an earlier diagnosis says are its own."""
    try:
        with open(os.path.join(out, "diagnosis.json"), encoding="utf-8") as stream:
            summary = json.load(stream)
        findings, force = summary["findings"], summary.get("missing_force")
        names = {str(finding.get("saved_as")) for finding in findings}
        if isinstance(force, dict):
            names |= {str(joint.get("curve")) for joint in force.values()}
        if any(finding.get("written_as") == "python" for finding in findings):
            names.add("corrected.py")
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return set()
    ours = re.compile(r"unknown_\d+\.csv|force_[A-Za-z0-9_.-]+\.csv|corrected\.py")
    return {n for n in names if ours.fullmatch(n) and os.path.isfile(os.path.join(out, n))}


def _csv(curve):
    """A curve as it acts: its variable, what it is multiplied by, if anything (at -1, or 0, and at
    1: it is proportional), force."""
    factor, levels = curve["factor"], (-1.0, 1.0) if curve["factor"] else (1.0,)
    if factor and factor.startswith("speed"):
        levels = (0.0, 1.0)
    head = [curve["variable"]] + ([_multiplier(factor)] if factor else []) + ["force"]
    rows = [
        [x, *([level] if factor else []), level * force]
        for level in levels
        for x, force in zip(curve["x"], curve["force"])
    ]
    return (
        "\n".join([",".join(head), *(",".join(f"{value:.15g}" for value in row) for row in rows)])
        + "\n"
    )


def _multiplier(factor):
    if factor.startswith("speed"):
        return f"abs({factor.replace('speed', 'velocity')})"
    return f"sign({factor})" if factor.startswith("velocity") else factor


def plain(value: Any) -> Any:
    """Strict JSON: numpy to Python, and null for what is not a finite number."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [plain(item) for item in value]
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return value
