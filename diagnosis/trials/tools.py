"""Running whatever tool is entered, as a user would: its own process, a bare environment, one
folder.

answer = run_tool("python diagnose.py --model {model} --recordings {recordings} --out {out}",
                  folder, ["train_0.csv"], limit=900)
"""

import json
import os
import resource
import shlex
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CLOCK = 10  # seconds of the clock that a tool gets for each of the processor: cores may be busy
FRONT = ROOT / "diagnose.py"  # of a clone; where the package is installed there is none
DIAGNOSE = (
    f"{{python}} {FRONT if FRONT.exists() else '-m diagnosis'} "
    "--model {model} --recordings {recordings} --out {out}"
)


@dataclass(frozen=True)
class ToolRun:
    """exit: status, negative for a signal; seconds of the clock and of the processor; note: the
    last line of stderr; report: the folder that the tool was to fill."""

    exit: int
    seconds: float
    cpu_seconds: float
    note: str
    report: Path

    def summary(self):
        """diagnosis.json as a dict; None where the tool wrote none, or none that can be read."""
        try:
            summary = json.loads((self.report / "diagnosis.json").read_text())
            return summary if isinstance(summary.get("findings"), list) else None
        except (OSError, ValueError, AttributeError):
            return None


def expand(template, model, recordings, out):
    """A command line from a template with {model}, {recordings}, {out} and {python}."""
    fields = {"{model}": [model], "{recordings}": recordings, "{out}": [out]}
    words = []
    for word in shlex.split(template):
        word = word.replace("{python}", sys.executable)
        words += fields.get(word, [word])
    return words


def run_tool(template, folder, recordings, limit):
    """Run a tool inside `folder` for at most `limit` processor seconds; returns its ToolRun."""
    environment = {"PATH": os.defpath, "HOME": str(folder), "OMP_NUM_THREADS": "1"}
    begun, used = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    try:
        done = subprocess.run(
            expand(template, "sim.xml", recordings, "report"),
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            errors="replace",
            stdin=subprocess.DEVNULL,
            timeout=CLOCK * limit,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (limit, limit)),
        )
        status, text = done.returncode, done.stderr
    except subprocess.TimeoutExpired:
        status, text = -9, f"no answer in {CLOCK * limit} s"
    except OSError as error:
        status, text = 127, f"cannot be started: {error}"
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    note = (text.strip().splitlines() or [""])[-1]
    if status < 0:
        note = f"stopped by signal {-status}"
    cpu = after.ru_utime + after.ru_stime - used.ru_utime - used.ru_stime
    return ToolRun(status, time.monotonic() - begun, cpu, note[:300], Path(folder) / "report")
