"""The house: imports run downward only, and what is written fits on a screen.

`tests/house_debt.csv` lists the functions of more than 50 lines that stay, and why. Nobody adds
any, nor lines of more than 100 columns.
"""

import ast
import csv
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
COLUMNS, LINES = 100, 50
# Rooms from the ground up. A room may import from those above it in this list, and from itself.
FLOORS = (
    ("models", "envs", "diagnosis.common", "diagnosis.effects"),
    ("trpo", "diagnosis.recordings", "diagnosis.simulation", "diagnosis.trials", "diagnosis.demo"),
    ("rgat", "diagnosis.estimation", "diagnosis.nominal", "diagnosis.report", "prove"),
    ("diagnosis.selection", "diagnosis.handover", "diagnosis.design", "diagnosis.preparation"),
    ("diagnosis.unnamed",),
    ("diagnosis.findings",),
    ("diagnosis.estimator",),
    ("diagnosis.command",),
    ("diagnosis.__init__", "diagnosis.__main__", "diagnose", "training"),
    ("train", "reproduce"),
    ("benchmarks",),
)
FLOOR = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms}


def sources():
    """Every Python file of the project."""
    skipped = {".venv", "build", "dist", "runs", "__pycache__"}
    return [
        path
        for path in sorted(ROOT.rglob("*.py"))
        if not skipped & set(path.relative_to(ROOT).parts)
    ]


def room_of(path):
    """The package below `diagnosis`, the folder, or the module at the root that a file belongs
    to."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    if parts[0] == "diagnosis":
        return ".".join(parts[:2])
    return parts[0]


def imported(path):
    """Files of the project that a file imports, anywhere in it."""
    names = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            inside = [f"{node.module}.{alias.name}" for alias in node.names]
            found = [name for name in inside if file_of(name)]
            names += found or [node.module]
    return [file for file in map(file_of, names) if file]


def file_of(module):
    """The file of a module of this project, or None."""
    place = ROOT.joinpath(*module.split("."))
    files = (place.with_suffix(".py"), place / "__init__.py")
    return next((file for file in files if file.is_file()), None)


def arrows():
    """{file: [files it imports]}, tests and CI scripts left out."""
    return {
        path: imported(path)
        for path in sources()
        if path.relative_to(ROOT).parts[0] not in ("tests", ".ci")
    }


def test_imports_run_downward_only():
    upward = set()
    for path, targets in arrows().items():
        here = room_of(path)
        for there in map(room_of, targets):
            assert {here, there} <= set(FLOOR), f"{here} or {there}: give it a floor"
            if here != there and FLOOR[there] >= FLOOR[here]:
                upward.add((here, there))
    assert upward == set()


def test_no_circle_of_files():
    graph, done = arrows(), set()

    def visit(path, way):
        assert path not in way, " -> ".join(str(p.relative_to(ROOT)) for p in [*way, path])
        if path not in done:
            for target in graph.get(path, ()):
                visit(target, [*way, path])
            done.add(path)

    for path in graph:
        if path.name != "__init__.py":
            visit(path, [])


def test_trials_share_no_physics_with_what_they_judge():
    rooms = {room_of(t) for p, ts in arrows().items() if "trials" in p.parts for t in ts}
    assert rooms <= {"diagnosis.trials", "diagnosis.common"}


def measured():
    """{(file, "columns"): lines that are too long} and {(file, function): its lines, if too
    many}."""
    found = {}
    for path in sources():
        text, name = path.read_text(encoding="utf-8"), str(path.relative_to(ROOT))
        found[name, "columns"] = sum(len(line) > COLUMNS for line in text.splitlines())
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                length = node.end_lineno - node.lineno + 1
                key = name, node.name
                found[key] = max(found.get(key, 0), length if length > LINES else 0)
    return {key: count for key, count in found.items() if count}


def test_nothing_new_is_too_long():
    with open(ROOT / "tests/house_debt.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    debt = {(row["file"], row["what"]): int(row["most"]) for row in rows}
    grown = {key: n for key, n in measured().items() if n > debt.get(key, 0)}
    assert grown == {}, "wrap these lines, cut these functions; the list is not to grow"
    assert all(row["why"] for row in rows)


if __name__ == "__main__":  # takes off the list what is mended: python tests/test_house.py
    with open(ROOT / "tests/house_debt.csv", newline="") as stream:
        why = {(row["file"], row["what"]): row["why"] for row in csv.DictReader(stream)}
    with open(ROOT / "tests/house_debt.csv", "w", newline="") as stream:
        rows = csv.writer(stream, lineterminator="\n")
        rows.writerow(("file", "what", "most", "why"))
        rows.writerows((*key, n, why.get(key, "")) for key, n in sorted(measured().items()))
