"""What is diagnosed: a simulator and recordings, read, cleaned and split.

given = prepared("sim.xml", ["run1.csv", "run2.csv"])
identify(given.world, given.train, given.held_out, given.kept_back)
"""

import dataclasses
import os

import mujoco
import numpy as np

from diagnosis.estimation import windowing
from diagnosis.nominal.model import ModelError, gains_of, load_world, together, with_gains
from diagnosis.recordings import plausibility
from diagnosis.recordings import recording as recorded
from diagnosis.recordings.cleaning import without_defects
from diagnosis.recordings.column_map import load_layout
from diagnosis.recordings.layout import Layout
from diagnosis.recordings.quality import assess, evenly_stamped, told

TINY = 1e-30  # rad² or m²: no error


@dataclasses.dataclass(frozen=True)
class Prepared:
    """A World and lists of Recording: train, to fit to; held_out, to predict; kept_back, which
    decide what is handed over. notes: what was found and mended, in words."""

    world: object
    train: list
    held_out: list
    kept_back: list
    notes: list


def prepared(
    model,
    recordings,
    held_out=None,
    *,
    columns=None,
    degrees=False,
    kp=None,
    kd=None,
    skip_meshes=False,
):
    """The Prepared of a model and recordings. Arguments and errors are those of
    command.diagnose()."""
    world = load_world(model, skip_meshes)
    gains = gains_of({"kp": kp, "kd": kd}, world.model)
    layout = load_layout(columns, degrees, frozenset(gains))
    train, held = _recordings(recordings, held_out, world.model, layout)
    world = with_gains(world, together(gains, train + held))
    assessed = [dataclasses.replace(r, quality=assess(r, world.model)) for r in train + held]
    given, notes = without_defects(assessed, world.model)
    notes += plausibility.check(given, world.model)
    given = [evenly_stamped(r) for r in given]
    train, held = given[: len(train)], given[len(train) :]
    notes += _runs(world.model, given) + told(given, world.model)
    train, kept = _kept_back(world, train) if held else split(world, train)
    plausibility.enough(train)
    return Prepared(world, train, held or kept, kept, notes)


def _kept_back(world, recordings):
    """(for fitting, to decide what is handed over): as split(); all for both where they are
    short."""
    try:
        return split(world, recordings)
    except recorded.RecordingError:
        return recordings, recordings


def split(world, recordings):
    """(for fitting, held out): every third recording is kept back, or the last 30 % of each of one
    or two. One that stands out, which the nominal model misses by more beyond the others than these
    scatter, is fitted to, and the one before it kept back: what acts in one recording alone is seen
    there or nowhere.

    Such a last part keeps the rows before its `start`: actuator states and delayed controls run on
    from them.
    """
    if len(recordings) >= 3:
        kept, missed = {*range(2, len(recordings), 3)}, _missed(world, recordings)
        most = int(np.argmax(missed))
        others = np.delete(missed, most)
        if missed[most] - others.max() > np.ptp(others):
            kept = {i - (i == most) for i in kept}
        return [[r for i, r in enumerate(recordings) if (i in kept) == back] for back in (0, 1)]
    parts = []
    for recording in recordings:
        cut = int(np.searchsorted(recording.time, recording.time[0] + 0.7 * np.ptp(recording.time)))
        if min(cut, len(recording.time) - cut) < 10:
            raise recorded.RecordingError(
                f"{recording.name}: not enough data to hold 30 % back: {len(recording.time)} "
                f"rows; record again, longer "
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


def _missed(world, recordings):
    """How far off the nominal model is in each recording, a while ahead of recorded states: log
    squared errors, the mean over windows, summed over degrees of freedom."""
    out = []
    for windows in map(windowing.consecutive, recordings):
        gap, known = windowing.gaps(world.model, windows, windowing.predict(world, {}, windows)[0])
        square = (gap**2).sum(1) / np.maximum(known.sum(1), 1)
        out.append(np.log(np.clip(square, TINY, 1 / TINY)).mean(0).sum())
    return out


def _recordings(recordings, held_out, model, layout=Layout()):
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
        _apart(_loaded(some, paths, model, layout))
        for some, paths in ((given, files), (more, further))
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


def _loaded(given, paths, model, layout):
    """What was given as Recording objects, from files what was given as paths: those first."""
    read = recorded.load(paths, model, layout) if paths else []
    return read + [recorded.accepted(x, model) for x in given if isinstance(x, recorded.Recording)]


def _runs(model, recordings):
    """Run the nominal model for 0.3 s from states of the recordings; notes on where it fails.
    Raises ModelError where it fails in most."""
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
            f"the model blows up within 0.3 s of {failed} of {tried} recorded states (first "
            f"{example}); reduce its "
            "time step, or check its masses and gains, and the units of the recordings"
        )
    return (
        [
            f"the model blows up within 0.3 s of {failed} of {tried} recorded states (first "
            f"{example})"
        ]
        if failed
        else []
    )
