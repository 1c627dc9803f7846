"""The three files of a diagnosis: diagnosis.json to compute with, corrected.xml to simulate with,
report.html to look at (sections)."""

import html
import itertools
import json
import math
import os
import re

import numpy as np

from diagnosis.common.atomic_files import WriteError, write_together
from diagnosis.report.cards import unknown_curves
from diagnosis.report.sections import html_page, reads_files


class ReportError(ValueError):
    """The report cannot be written. One line: where, why, and what to do."""


def check_folder(out):
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


def write(diagnosis, out):
    """Write report.html, diagnosis.json, corrected.xml and a curve for each unknown force into
    folder `out`; their names.

    A curve is unknown_<n>.csv, the first n that is free, and named in its finding as `saved_as`;
    those of the earlier diagnosis in the folder go. All are complete under temporary names before
    the first takes its own. Raises ReportError where that fails; what was in the folder before is
    then unchanged.
    """
    summary, earlier = plain(diagnosis.summary), _earlier(out)
    names = (f"unknown_{n}.csv" for n in itertools.count(1))
    free = (
        name for name in names if name in earlier or not os.path.lexists(os.path.join(out, name))
    )
    saved = {name: curve for name, curve in zip(free, unknown_curves(diagnosis))}
    for name, curve in saved.items():
        summary["findings"][curve["finding"]]["saved_as"] = name
    files = {
        "report.html": html_page(diagnosis),
        "diagnosis.json": json.dumps(summary, indent=2, allow_nan=False, ensure_ascii=False) + "\n",
        "corrected.xml": portable(diagnosis.corrected_xml, out),
        **{name: _csv(curve) for name, curve in saved.items()},
    }
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
    return list(files)


def portable(xml, out):
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
    """The curves in folder `out` that an earlier diagnosis there says are its own."""
    try:
        with open(os.path.join(out, "diagnosis.json"), encoding="utf-8") as stream:
            names = {str(finding.get("saved_as")) for finding in json.load(stream)["findings"]}
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return set()
    return {
        name
        for name in names
        if re.fullmatch(r"unknown_\d+\.csv", name) and os.path.isfile(os.path.join(out, name))
    }


def _csv(curve):
    """A curve as it acts: its variable, what it is multiplied by, if anything (at -1 and at 1: it
    is proportional), force."""
    factor, levels = curve["factor"], (-1.0, 1.0) if curve["factor"] else (1.0,)
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
    return f"sign({factor})" if factor.startswith("velocity") else factor


def plain(value):
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
