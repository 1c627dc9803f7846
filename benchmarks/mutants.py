"""One-line faults put into the paper's files, and the test that catches each.

    python benchmarks/mutants.py                   # results/mutants.csv, a few minutes a fault
    python benchmarks/mutants.py --only envs.py    # those of one file
    python benchmarks/mutants.py --check           # does every edit still fit the code?

Each fault is made in a copy of the code, in which the named tests run until one fails. A row that
is there already for the same edit is not made again.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from training.results import read  # noqa: E402

CSV = ROOT / "results" / "mutants.csv"
TESTS = {
    "train.py": "test_algorithm_1.py",
    "training/settings.py": "test_algorithm_1.py",
    "trpo.py": "test_trpo.py",
    "rgat.py": "test_rgat.py",
    "models.py": "test_models.py test_trpo.py",
    "envs.py": "test_envs.py",
}
FAULTS = ROOT / "benchmarks" / "mutants.toml"


def faults():
    """[(file, what is wrong, the code, the fault)] of mutants.toml."""
    by_file = tomllib.loads(FAULTS.read_text(encoding="utf-8"))
    keys = "what", "code", "fault"
    return [(file, *(each[key] for key in keys)) for file, made in by_file.items() for each in made]


def faulty(file, code, fault):
    """The text of a file with a fault in it. Raises SystemExit where the code has changed under the
    edit."""
    text = (ROOT / file).read_text()
    if text.count(code) != 1:
        sys.exit(f"{file}: {text.count(code)} places hold {code!r}: renew this edit in {FAULTS}")
    return text.replace(code, fault)


def caught_by(file, code, fault):
    """The first test that fails with the fault, or ""."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "code"
        leave_out = shutil.ignore_patterns(
            ".git", "results", "docs", "runs", "__pycache__", ".venv"
        )
        shutil.copytree(ROOT, copy, ignore=leave_out)
        (copy / file).write_text(faulty(file, code, fault))
        tests = [f"tests/{name}" for name in TESTS[file].split()]
        done = subprocess.run(
            [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests],
            cwd=copy,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
        )
    failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return failed[0].split()[1] if failed else ""


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", help="a file")
    parser.add_argument("--check", action="store_true", help="run nothing")
    args = parser.parse_args()
    from benchmarks.rows import append

    done = {(row["file"], row["fault"]) for row in read(CSV)}
    for file, what, code, fault in faults():
        faulty(file, code, fault)
        if args.check or (file, what) in done or args.only not in (None, file):
            continue
        test = caught_by(file, code, fault)
        append(CSV, [{"file": file, "fault": what, "caught": bool(test), "by": test}])
        print(f"{file}: {what}: {test or 'NOT CAUGHT'}", flush=True)
    rows = read(CSV)
    print(f"{sum(row['caught'] == 'True' for row in rows)} of {len(rows)} faults are caught")


if __name__ == "__main__":
    main()
