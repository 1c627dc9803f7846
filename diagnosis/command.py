"""Where does a simulator differ from recordings of the real system, which physics does it lack, and
what is it with it?

    python diagnose.py --model sim.xml --recordings real/*.csv [--held-out more/*.csv] --out report/
    python diagnose.py --env Hopper-v4 --recordings runs/*.npz --out report/

    diagnosis = diagnose("sim.xml", ["run1.csv", "run2.csv"])
    diagnosis.summary["findings"]

Writes report.html (to look at), diagnosis.json (to compute with) and corrected.xml (to simulate
with). Exit status: 0 a diagnosis was made, whatever it says; 2 bad input or not enough data, 1 a
fault of this program, 130 stopped by Ctrl-C, with one line on stderr.
"""

import argparse
import dataclasses
import glob
import json
import os
import sys
import traceback

import mujoco
import numpy as np
from tqdm import tqdm

from diagnosis.common.atomic_files import WriteError, write_together, write_whole
from diagnosis.common.mujoco_warnings import quiet
from diagnosis.design.explanations import DesignError, reached_by
from diagnosis.design.output import write_next
from diagnosis.estimator import identify
from diagnosis.nominal.model import ModelError
from diagnosis.nominal.urdf import is_urdf, with_dynamics
from diagnosis.preparation import prepared
from diagnosis.recordings import recording as recorded
from diagnosis.report import text as wording
from diagnosis.report import writer
from diagnosis.report.per_recording import with_each_recording

REFUSED = (  # what the user can mend
    recorded.RecordingError,
    ModelError,
    writer.ReportError,
    WriteError,
    DesignError,
    mujoco.FatalError,
    MemoryError,
)


@quiet()
def diagnose(
    model,
    recordings,
    held_out=None,
    progress=None,
    *,
    columns=None,
    degrees=False,
    kp=None,
    kd=None,
    skip_meshes=False,
):
    """Compare a simulator with recordings of the real system and return a Diagnosis.

    model: MJCF or URDF path, gymnasium MuJoCo id, or mujoco.MjSpec. recordings: paths, or Recording
    objects. held_out: the same, never used for fitting; None keeps back every third recording, or
    the last 30 % of each where there are fewer than three. progress: called with (fraction done,
    what is being done). columns: path of a column map (TOML). degrees: angles in the files are. kp,
    kd: gains of the position controllers whose targets the controls of motors are, one number or
    {joint: number}. skip_meshes: go on without meshes of a URDF that are not found. Raises
    RecordingError, ModelError (both ValueError, one line).
    """
    files = {"columns": columns, "degrees": degrees, "skip_meshes": skip_meshes}
    given = prepared(model, recordings, held_out, kp=kp, kd=kd, **files)
    lists = given.train, given.held_out, given.kept_back
    diagnosis = identify(given.world, *lists, progress=progress)
    each = diagnosis.world, diagnosis.settings, diagnosis.train
    summary = with_each_recording(*each, diagnosis.summary)
    summary = {**summary, "warnings": given.notes + summary["warnings"]}
    return dataclasses.replace(diagnosis, summary=summary)


class _Parser(argparse.ArgumentParser):
    def error(self, message):
        raise ModelError(f"{message}; see --help")


def _parser():
    """The command line."""
    parser = _Parser(
        prog="diagnose.py",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    nominal = parser.add_mutually_exclusive_group()
    nominal.add_argument("--model", help="MJCF or URDF file of the nominal simulator")
    nominal.add_argument("--env", help="gymnasium id of a MuJoCo environment, instead of --model")
    several = {"nargs": "+", "action": "extend", "metavar": "FILE"}
    what = "to fit: CSV, NPZ, ROS 2 bags, LeRobot or Minari datasets, PACE dictionaries"
    parser.add_argument("--recordings", help=f"recordings {what}", **several)
    parser.add_argument("--held-out", help="recordings only predicted, never fitted", **several)
    parser.add_argument("--out", metavar="FOLDER", help="where the report goes")
    parser.add_argument("--map", metavar="TOML", help="what the files' columns are")
    parser.add_argument("--degrees", action="store_true", help="angles in the files are in degrees")
    gain = {"nargs": "+", "metavar": "GAIN", "help": "one number, or joint=number for each"}
    parser.add_argument(
        "--kp", **{**gain, "help": f"controls are position targets: {gain['help']}"}
    )
    parser.add_argument("--kd", **gain)
    parser.add_argument(
        "--skip-meshes", action="store_true", help="go on without a URDF's missing meshes"
    )
    parser.add_argument(
        "--write-urdf", action="store_true", help="corrected.urdf too, with its <dynamics>"
    )
    parser.add_argument("--next", metavar="REPORT", help="design what to record after a report")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of that (default 10)")
    return parser


def _checked(args):
    """The arguments, where they belong together. Raises ModelError."""
    if args.next is not None:
        others = (args.model, args.env, args.recordings, args.out)
        if any(value is not None for value in others):
            raise ModelError("--next REPORT: takes --seconds, --kp and --kd, nothing else")
        if not 1 <= args.seconds <= 120:
            raise ModelError(f"--seconds {args.seconds:g}: give 1 to 120")
        return args
    if (args.model is None) == (args.env is None):
        raise ModelError("give one of --model and --env; see --help")
    for name in ("recordings", "out"):
        if getattr(args, name) is None:
            raise ModelError(f"--{name} is missing; see --help")
    return args


def gain_words(option, words):
    """None, a number, or {joint: number} of the words after --kp or --kd. Raises ModelError."""
    if not words:
        return None
    pairs = [word.rpartition("=") for word in words]
    try:
        numbers = [float(number) for *_, number in pairs]
    except ValueError:
        numbers = [float("nan")]
    named = [joint for joint, mark, _ in pairs if mark]
    if (
        not np.isfinite(numbers).all()
        or len(named) not in (0, len(words))
        or not named
        and words[1:]
    ):
        raise ModelError(
            f"{option} {' '.join(words)}: give one number, or joint=number for each joint"
        )
    return dict(zip(named, numbers)) if named else numbers[0]


def _diagnosed(args, progress):
    """Diagnose as the command line says, and write the report. Returns (diagnosis, files)."""
    model = args.model
    if model is not None and not os.path.isfile(model):
        raise ModelError(f"{model}: no such model file; check the path")
    if args.write_urdf and not (model and is_urdf(model)):
        raise ModelError("--write-urdf: the model is no URDF; leave it out")
    writer.check_folder(args.out)
    diagnosis = diagnose(
        model or args.env,
        _expanded(args.recordings),
        _expanded(args.held_out),
        progress,
        columns=args.map,
        degrees=args.degrees,
        kp=gain_words("--kp", args.kp),
        kd=gain_words("--kd", args.kd),
        skip_meshes=args.skip_meshes,
    )
    files = writer.write(diagnosis, args.out)
    write_together(_for_next(diagnosis, args.out))
    if args.write_urdf:
        text = with_dynamics(model, diagnosis.corrected_xml, _without_place(diagnosis.summary))
        write_whole(os.path.join(args.out, "corrected.urdf"), text)
        files = [*files, "corrected.urdf"]
    return diagnosis, files


def _for_next(diagnosis, out):
    """{path: text} of what --next needs beside the report: the model as it was read, and what the
    recordings reached."""
    world = diagnosis.world
    reached = reached_by(diagnosis.train + diagnosis.held_out, world.model)
    return {
        os.path.join(out, "nominal.xml"): writer.portable(world.corrected_xml({})[0], out),
        os.path.join(out, "recorded.json"): json.dumps(reached, indent=1) + "\n",
    }


def _without_place(summary):
    """The findings that <dynamics> of a URDF has no place for, in words."""
    return tuple(
        f"{finding['effect']} at {finding['place']['kind']} {finding['place']['name']}"
        for finding in summary["findings"]
        if finding["effect"] not in ("viscous_damping", "coulomb_friction")
    )


def main(argv=None):
    """The command. Returns the exit status: 0, or 2 (its input), 1 (a fault of this program) or 130
    (Ctrl-C) with one line on stderr."""
    bar = None

    def progress(fraction, what):
        bar.set_description(what, refresh=False)
        bar.update(max(0, min(1, fraction) - bar.n))

    try:
        args = _checked(_parser().parse_args(argv))
        if args.next:
            with quiet():
                gains = (gain_words(f"--{name}", getattr(args, name)) for name in ("kp", "kd"))
                print(write_next(args.next, args.seconds, *gains))
            return 0
        with quiet():
            if sys.stderr.isatty():
                bar = tqdm(total=1.0, bar_format="{l_bar}{bar}| {elapsed}", file=sys.stderr)
            diagnosis, files = _diagnosed(args, bar and progress)
    except REFUSED as error:
        message = " ".join(str(error).split()) or "out of memory; give fewer or shorter recordings"
        return _stopped(bar, 2, f"diagnose.py: {message}")
    except KeyboardInterrupt:
        return _stopped(bar, 130, "\ndiagnose.py: stopped; nothing was written")
    except Exception as error:
        return _stopped(bar, 1, _fault(error))
    if bar:
        bar.close()
    if hasattr(sys.stdout, "reconfigure"):
        # a terminal that cannot show ± or ∞ still shows the rest
        sys.stdout.reconfigure(errors="replace")
    print(wording.terminal(diagnosis.summary, args.out.rstrip("/"), files))
    return 0


def _stopped(bar, status, line):
    """The exit status, with its line on stderr."""
    if bar:
        bar.close()
    print(line, file=sys.stderr)
    return status


def _fault(error):
    """A fault of the program in a line: no traceback at a user, but the place for who mends it."""
    place = traceback.extract_tb(error.__traceback__)[-1]
    return (
        f"diagnose.py: a fault of this program, not of its input: {type(error).__name__} in "
        f"{os.path.basename(place.filename)}, line {place.lineno} "
        f"({' '.join(str(error).split())}); please report this line, with the model and recordings "
        "if they may be shown"
    )


def _expanded(paths):
    """Patterns that the shell left as they are (Windows' does, and quotes do), replaced by the
    files they match."""
    found = (
        [pattern] if os.path.exists(pattern) else sorted(glob.glob(pattern)) or [pattern]
        for pattern in paths or []
    )
    return [path for some in found for path in some]
