"""An older version of the diagnosis as a tool, from this repository's history.

    python benchmarks/entrants/version.py dc17a0f {model} {recordings} {out}

The commit is unpacked once into a folder of the system's temporary files.
"""

import os
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

from command_line import words  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]


def unpacked(commit):
    """Folder with the files of a commit; made whole by whoever comes first."""
    git = ["git", "-C", str(ROOT)]
    name = subprocess.check_output([*git, "rev-parse", "--short=12", f"{commit}^{{commit}}"])
    folder = Path(tempfile.gettempdir()) / f"rgat-{os.getuid()}-{name.decode().strip()}"
    if not folder.exists():
        fresh = Path(tempfile.mkdtemp(dir=folder.parent))
        with subprocess.Popen([*git, "archive", commit], stdout=subprocess.PIPE) as process:
            with tarfile.open(fileobj=process.stdout, mode="r|") as archive:
                archive.extractall(fresh, filter="data")
        try:
            fresh.rename(folder)
        except OSError:  # another trial was faster
            pass
    return folder


def main():
    """Run that version's diagnose.py in place of this process."""
    args = words(main.__doc__, commit={"help": "of this repository"})
    script = unpacked(args.commit) / "diagnose.py"
    line = [script, "--model", args.model, "--recordings", *args.recordings, "--out", args.out]
    os.execv(sys.executable, [sys.executable, *map(str, line)])


if __name__ == "__main__":
    main()
