"""Where does a simulator differ from recordings of the real system, which physics does it lack, and what is it with it?

    python diagnose.py --model sim.xml --recordings real/*.csv [--held-out more/*.csv] --out report/
    python diagnose.py --env Hopper-v4 --recordings runs/*.npz --out report/

    diagnosis = diagnose("sim.xml", ["run1.csv", "run2.csv"])
    diagnosis.summary["findings"]

Writes report.html (to look at), diagnosis.json (to compute with) and corrected.xml (to simulate with). Exit status: 0 a
diagnosis was made, whatever it says; 2 bad input or not enough data, 1 a fault of this program, 130 stopped by Ctrl-C, with one
line on stderr.
"""

import argparse
import dataclasses
import glob
import os
import sys
import traceback

import mujoco
import numpy as np
from tqdm import tqdm

from diagnosis.common.mujoco_warnings import quiet
from diagnosis.estimator import identify
from diagnosis.recordings import plausibility
from diagnosis.recordings import recording as recorded
from diagnosis.recordings.cleaning import without_defects
from diagnosis.report import text as wording
from diagnosis.report import writer
from diagnosis.simulation.simulator import World


class ModelError(ValueError):
    """The simulator cannot be used. One line: which, why, and what to do."""

    def __init__(self, message):
        super().__init__(" ".join(str(message).split()))


def diagnose(model, recordings, held_out=None, progress=None):
    """Compare a simulator with recordings of the real system and return a Diagnosis.

    model: MJCF path, gymnasium MuJoCo id, or mujoco.MjSpec. recordings: paths, or Recording objects. held_out: the same,
    never used for fitting; None keeps back every third recording, or the last 30 % of each where there are fewer than
    three. progress: called with (fraction done, what is being done).
    Raises RecordingError, ModelError (both ValueError, one line).
    """
    world = _world(model)
    train, held = _recordings(recordings, held_out, world.model)
    given, notes = without_defects(train + held, world.model)
    train, held = given[: len(train)], given[len(train) :]
    notes += plausibility.check(given, world.model)
    notes += _runs(world.model, given)
    if not held:
        train, held = split(train)
    plausibility.enough(train)
    diagnosis = identify(world, train, held, progress=progress)
    return dataclasses.replace(
        diagnosis, summary={**diagnosis.summary, "warnings": notes + diagnosis.summary["warnings"]}
    )


def split(recordings):
    """(for fitting, held out): every third recording is kept back, or the last 30 % of each of one or two.

    Such a last part keeps the rows before its `start`: actuator states and delayed controls run on from them.
    """
    if len(recordings) >= 3:
        return [r for i, r in enumerate(recordings) if i % 3 != 2], [
            r for i, r in enumerate(recordings) if i % 3 == 2
        ]
    parts = []
    for recording in recordings:
        cut = int(np.searchsorted(recording.time, recording.time[0] + 0.7 * np.ptp(recording.time)))
        if min(cut, len(recording.time) - cut) < 10:
            raise recorded.RecordingError(
                f"{recording.name}: not enough data to hold 30 % back: {len(recording.time)} rows; record again, longer "
                f"({plausibility.ENOUGH}), or give --held-out"
            )
        early = dataclasses.replace(
            recording,
            start=0,
            time=recording.time[:cut],
            qpos=recording.qpos[:cut],
            qvel=recording.qvel[:cut],
            ctrl=recording.ctrl[:cut],
            sensors={name: values[:cut] for name, values in recording.sensors.items()},
        )
        parts += [early, dataclasses.replace(recording, start=max(cut, recording.start))]
    return parts[::2], parts[1::2]


def _world(model):
    """The nominal simulator of an MJCF path, a gymnasium id, or an MjSpec."""
    if isinstance(model, mujoco.MjSpec):
        what, make = "the given MjSpec", World
    elif os.path.isfile(model := os.fspath(model)) or model.endswith(".xml"):
        what, make = model, World.load
        if not os.path.isfile(model):
            raise ModelError(f"{model}: no such model file; check the path")
    else:
        what, make = model, World.from_env
    try:
        world = make(model)
    except (
        ValueError,
        OSError,
        TypeError,
        AttributeError,
        ImportError,
        mujoco.FatalError,
    ) as error:
        do = (
            "correct the file"
            if make is World.load
            else "give the id of a gymnasium MuJoCo environment, or --model file.xml"
        )
        raise ModelError(f"{what}: the model does not load ({error}); {do}") from None
    if world.model.nq == 0:
        raise ModelError(
            f"{what}: the model has no joints, so nothing in it can move; give the model of the recorded "
            "mechanism"
        )
    return world


def _recordings(recordings, held_out, model):
    """Both lists as Recording objects, with names that tell them apart, and none in both."""
    one = (str, os.PathLike, recorded.Recording)
    given, more = ([x] if isinstance(x, one) else list(x or []) for x in (recordings, held_out))
    if not given:
        raise recorded.RecordingError("no recordings given: name at least one CSV or NPZ file")
    files, further = (
        [x for x in some if not isinstance(x, recorded.Recording)] for some in (given, more)
    )
    where = [os.path.realpath(path) for path in files]
    for path in further:
        if os.path.realpath(path) in where:
            raise recorded.RecordingError(
                f"{path}: given both for fitting and as held out; give it once"
            )
    train, held = (
        _apart(_loaded(some, paths, model)) for some, paths in ((given, files), (more, further))
    )
    taken = {recording.name for recording in train}
    return train, [
        dataclasses.replace(r, name=f"held out {r.name}") if r.name in taken else r for r in held
    ]


def _apart(recordings):
    """The same under names that differ: a second "run" becomes "run (2)"."""
    names = []
    for r in recordings:
        every = [r.name, *(f"{r.name} ({n})" for n in range(2, len(recordings) + 1))]
        names.append(next(name for name in every if name not in names))
    return [dataclasses.replace(r, name=name) for r, name in zip(recordings, names)]


def _loaded(given, paths, model):
    """What was given as Recording objects, from files what was given as paths: those first."""
    read = recorded.load(paths, model) if paths else []
    return read + [recorded.accepted(x, model) for x in given if isinstance(x, recorded.Recording)]


def _runs(model, recordings):
    """Run the nominal model for 0.3 s from states of the recordings; notes on where it fails. Raises ModelError where it
    fails in most."""
    data = mujoco.MjData(model)
    failed, tried, example = 0, 0, ""
    for recording in recordings[:10]:
        for row in np.linspace(0, len(recording.time) - 1, 6).astype(int)[:-1]:
            mujoco.mj_resetData(model, data)
            for known, target in (
                (recording.qpos[row], data.qpos),
                (recording.qvel[row], data.qvel),
            ):
                target[:] = np.where(np.isnan(known), target, known)
            end = data.time + 0.3
            while data.time < end:
                now = recording.time[row] + data.time
                data.ctrl[:] = recording.ctrl[
                    np.searchsorted(recording.time, now, side="right") - 1
                ]
                mujoco.mj_step(model, data)
                bad = [
                    name
                    for name in ("mjWARN_BADQPOS", "mjWARN_BADQVEL", "mjWARN_BADQACC")
                    if data.warning[getattr(mujoco.mjtWarning, name)].number
                ]
                if bad:
                    failed += 1
                    example = example or f"from {recording.name} at {recording.time[row]:.12g} s"
                    break
            tried += 1
    if failed > tried / 2:
        raise ModelError(
            f"the model blows up within 0.3 s of {failed} of {tried} recorded states (first {example}); reduce its "
            "time step, or check its masses and gains, and the units of the recordings"
        )
    return (
        [
            f"the model blows up within 0.3 s of {failed} of {tried} recorded states (first {example})"
        ]
        if failed
        else []
    )


class _Parser(argparse.ArgumentParser):
    def error(self, message):
        raise ModelError(f"{message}; see --help")


def main(argv=None):
    """The command. Returns the exit status: 0, or 2 (its input), 1 (a fault of this program) or 130 (Ctrl-C) with one line on stderr."""
    parser = _Parser(
        prog="diagnose.py",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    nominal = parser.add_mutually_exclusive_group(required=True)
    nominal.add_argument("--model", help="MJCF file of the nominal simulator")
    nominal.add_argument("--env", help="gymnasium id of a MuJoCo environment, instead of --model")
    parser.add_argument(
        "--recordings",
        nargs="+",
        action="extend",
        required=True,
        metavar="FILE",
        help="CSV, NPZ or Minari recordings to fit",
    )
    parser.add_argument(
        "--held-out",
        nargs="+",
        action="extend",
        metavar="FILE",
        help="recordings that are only predicted, never fitted",
    )
    parser.add_argument(
        "--out", required=True, metavar="FOLDER", help="where the report is written"
    )
    bar = None

    def progress(fraction, what):
        bar.set_description(what, refresh=False)
        bar.update(max(0, min(1, fraction) - bar.n))

    try:
        args = parser.parse_args(argv)
        if args.model is not None and not os.path.isfile(args.model):
            raise ModelError(f"{args.model}: no such model file; check the path")
        writer.check_folder(args.out)
        with quiet():
            if sys.stderr.isatty():
                bar = tqdm(total=1.0, bar_format="{l_bar}{bar}| {elapsed}", file=sys.stderr)
            given, held_out = _expanded(args.recordings), _expanded(args.held_out)
            diagnosis = diagnose(args.model or args.env, given, held_out, bar and progress)
            files = writer.write(diagnosis, args.out)
    except (
        recorded.RecordingError,
        ModelError,
        writer.ReportError,
        mujoco.FatalError,
        MemoryError,
    ) as error:
        if bar:
            bar.close()
        message = " ".join(str(error).split()) or "out of memory; give fewer or shorter recordings"
        print(f"diagnose.py: {message}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\ndiagnose.py: stopped; nothing was written", file=sys.stderr)
        return 130
    except Exception as error:  # a fault of the program: still no traceback at a user, but the place for who mends it
        if bar:
            bar.close()
        place = traceback.extract_tb(error.__traceback__)[-1]
        print(
            f"diagnose.py: a fault of this program, not of its input: {type(error).__name__} in "
            f"{os.path.basename(place.filename)}, line {place.lineno} ({' '.join(str(error).split())}); please report this line, "
            "with the model and recordings if they may be shown",
            file=sys.stderr,
        )
        return 1
    if bar:
        bar.close()
    if hasattr(
        sys.stdout, "reconfigure"
    ):  # a terminal that cannot show ± or ∞ still shows the rest
        sys.stdout.reconfigure(errors="replace")
    print(wording.terminal(diagnosis.summary, args.out.rstrip("/"), files))
    return 0


def _expanded(paths):
    """Patterns that the shell left as they are (Windows' does, and quotes do), replaced by the files they match."""
    found = (
        [pattern] if os.path.exists(pattern) else sorted(glob.glob(pattern)) or [pattern]
        for pattern in paths or []
    )
    return [path for some in found for path in some]
