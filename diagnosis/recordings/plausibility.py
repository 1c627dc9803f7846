"""Recordings that cannot be what they claim: refuse the evident mistakes, warn about what looks
wrong.

for warning in check(recordings, model):
    print(warning)
"""

import math

import mujoco
import numpy as np

from diagnosis.recordings.agreement import check_rates, check_targets
from diagnosis.recordings.columns import WIDTHS, RecordingError, columns_of
from diagnosis.recordings.unit_check import suspect

HIGH = 10  # order of differences that leave nothing of fast motion
FAST = 8.0  # noises, of which white noise spans 4.7 between the quantiles
LOOKED_AT = 5  # recordings in which units, signs and columns are doubted
ENOUGH = "10 s of varied motion sampled at 50 Hz or more is a good start"


def check(recordings, model):
    """What looks wrong, one line each: for the user to read before believing a diagnosis.

    Raises RecordingError where the evidence is beyond doubt (a time in ms, a joint in degrees,
    swapped columns in most recordings, a gap, nothing that moves) since a diagnosis would then
    describe the mistake and not the machine.
    """
    found = {}  # message -> [(recording's name, share of its rows)] of those it holds for

    def warn(recording, message, share=None):
        found.setdefault(message, []).append((recording.name, share))

    for recording in recordings:
        for note in recording.notes:
            warn(recording, note)
        _check_time(recording, model, warn)
        _check_values(recording, model, warn)
        check_rates(recording, model, warn)
        check_targets(recording, model)
        _check_overlap(recording, model, warn)
    moving = enough(recordings)
    for recording in recordings:
        if not any(recording is other for other in moving):
            warn(recording, "nothing moves beyond the sensors' noise; it says little")
    doubts = [(recording, suspect(recording, model)) for recording in moving[:LOOKED_AT]]
    for recording, doubt in doubts:
        if doubt and 2 * [other for _, other in doubts].count(doubt) > len(doubts):
            raise RecordingError(f"{recording.name}: {doubt}")
        if doubt:  # not in the others, which are written alike: what the model lacks may look so
            warn(recording, doubt)
    return grouped(found)


def enough(recordings):
    """The recordings in which something moves. Raises RecordingError where they are too little, or
    one is another's copy."""
    moving = [recording for recording in recordings if _moves(recording)]
    everything = recordings[0].name + _more(recordings)
    rows, seconds = sum(len(r.time) for r in moving), sum(r.time[-1] - r.time[0] for r in moving)
    _check_copies(moving)
    if not moving:
        raise RecordingError(
            f"{everything}: not enough data: nothing moves beyond the sensors' noise; move every "
            f"joint of "
            f"interest ({ENOUGH})"
        )
    if rows < 20 or seconds < 0.6:
        raise RecordingError(
            f"{everything}: not enough data: {rows} rows over {seconds:.2g} s; at least 20 rows "
            f"over 0.6 s "
            f"are needed, and {ENOUGH}"
        )
    return moving


def grouped(found):
    """{message: [(recording's name, share of its rows), ...]} in lines, one for all recordings;
    "{}" becomes the share."""
    return [
        f"{places[0][0]}{_more(places)}: {message.replace('{}', _share(places))}"
        for message, places in found.items()
    ]


def _more(places):
    return f" and {len(places) - 1} more" if len(places) > 1 else ""


def _share(places):
    """The share of rows that a warning concerns, in words: the largest of its recordings."""
    largest = max(share or 0 for _, share in places)
    return (
        "less than 1 %"
        if largest < 0.01
        else f"{'up to ' if len(places) > 1 else ''}{100 * largest:.0f} %"
    )


def _check_copies(recordings):
    """Raises RecordingError where two recordings are the same: one would be judged by its own
    copy."""
    known = {}
    for recording in recordings:
        content = recording.qpos.tobytes(), recording.ctrl.tobytes()
        if content in known:
            raise RecordingError(
                f"{recording.name}: holds the same rows as {known[content]}; give it once"
            )
        known[content] = recording.name


def _moves(recording):
    """Whether any position leaves the band of its own noise."""
    return any(_leaves_noise(values[~np.isnan(values)]) for values in recording.qpos.T)


def _leaves_noise(values):
    """Whether (T,) measured values leave the band of their own noise (five sigma, from second
    differences) for good."""
    if len(values) < 5:
        return False
    by_differences = lambda order: (
        np.median(np.abs(np.diff(values, order))) / (0.6745 * np.sqrt(math.comb(2 * order, order)))
    )
    noise = by_differences(2)
    smooth = np.convolve(values, np.ones(5) / 5, "valid")
    least = 1e-9 * (1 + np.abs(values).max())
    if np.ptp(smooth) > 5 * noise + least:
        return True
    low, high = np.quantile(
        values, (0.01, 0.99)
    )  # a motion of few rows per period looks like noise to second differences alone
    return len(values) > 2 * HIGH and high - low > FAST * by_differences(HIGH) + least


def _check_time(recording, model, warn):
    """Unit of time and gaps."""
    steps = np.diff(recording.time)
    usual = np.median(steps)
    where = f"{recording.name}: column 'time'"
    if usual >= 0.3:
        unit, factor = next(
            unit
            for unit in (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9))
            if usual < 0.3 * unit[1] or unit[1] == 1e9
        )
        raise RecordingError(
            f"{where}: rows stand {usual:g} s apart, too far to see any dynamics; if these are "
            f"{unit}, "
            f"divide by {factor:g}"
        )
    if usual < 1e-6 or usual < model.opt.timestep / 500:
        raise RecordingError(
            f"{where}: rows stand {usual:.3g} s apart against a time step of "
            f"{model.opt.timestep:g} s; "
            "write seconds"
        )
    row = int(np.argmin(steps))
    if steps[row] < 1e-4 * usual:
        raise RecordingError(
            f"{where}: the row at {recording.time[row + 1]:.12g} s stands {steps[row]:.3g} s "
            f"after the one before (others "
            f"{usual:.3g} s); no velocity can be formed from these two, remove one"
        )
    row = int(np.argmax(steps))
    if steps[row] > max(20 * usual, 0.1):
        raise RecordingError(
            f"{where}: gap of {steps[row]:.3g} s after {recording.time[row]:.12g} s "
            f"(rows are {usual:.3g} s apart); split the file there, or write the missing rows "
            f"with nan "
            "positions and their control"
        )
    if steps[row] > 5 * usual:
        warn(
            recording,
            f"gap of {steps[row]:.3g} s after {recording.time[row]:.12g} s, rows are {usual:.3g} "
            f"s apart",
        )


def _check_values(recording, model, warn):
    """Channel by channel: constant, clipped, mostly missing, wrapped, far outside the ranges."""
    for column, (kind, k) in columns_of(model).items():
        if kind not in ("qpos", "ctrl"):
            continue
        values = getattr(recording, kind)[:, k]
        missing = np.isnan(values)
        if missing.any():
            what = (
                "is not measured; it is guessed, and where it moves the others that will look like "
                "missing physics"
                if missing.all()
                else "has nan in {} of its rows"
            )
            warn(recording, f"{column} {what}", missing.mean())
        measured = values[~missing]
        if len(measured) < 2:
            continue
        if measured.min() == measured.max():
            warn(
                recording,
                f"{column} is constant at {measured[0]:g}; nothing can be said about what only it "
                "would show",
            )
            continue
        channel = Channel(recording, column, kind, k, measured, recording.time[~missing], model)
        if kind == "qpos":
            _check_motion(channel, warn)
        _check_range(channel, warn)
        _check_edges(channel, warn)


class Channel:
    """One position or control of a recording, with what the model says of it.

    values, time (N,): where it was measured; hinge: an angle; limited, span: its range.
    """

    def __init__(self, recording, column, kind, k, values, time, model):
        self.recording, self.column, self.kind = recording, column, kind
        self.values, self.time = values, time
        self.where = f"{recording.name}: column {column!r}"
        self.hinge = False
        if kind == "qpos":
            joint = int(np.searchsorted(model.jnt_qposadr, k, side="right")) - 1
            single = model.jnt_type[joint] not in WIDTHS
            self.hinge = single and model.jnt_type[joint] == 3
            self.limited, self.span = single and model.jnt_limited[joint], model.jnt_range[joint]
        else:
            self.limited, self.span = model.actuator_ctrllimited[k], model.actuator_ctrlrange[k]


def _check_motion(channel, warn):
    """A position that moves too fast, not at all, or jumps by a turn."""
    values, hinge = channel.values, channel.hinge
    jumps, steps = np.abs(np.diff(values)), np.diff(channel.time)
    # who turns on while not measured jumps too
    row = int(np.argmax(np.where(steps < 2 * np.median(steps), jumps, 0.0)))
    speed = np.percentile(jumps / steps, 90)
    if speed > (3000 if hinge else 340):
        raise RecordingError(
            f"{channel.where}: moves at {speed:.3g} {'rad/s' if hinge else 'm/s'} most of the "
            f"time; is it in {'degrees' if hinge else 'mm'}? convert it to "
            f"{'rad' if hinge else 'm'}, and time to s"
        )
    if not _leaves_noise(values):
        warn(
            channel.recording,
            f"{channel.column} does not move beyond the sensor's noise; nothing can be said about "
            "what only its motion would show",
        )
    if hinge and abs(jumps[row] - 2 * np.pi) < 0.5 and jumps[row] > 20 * np.median(jumps) + 1e-6:
        raise RecordingError(
            f"{channel.where}: jumps by {jumps[row]:.3g} rad after {channel.time[row]:.12g} s, a "
            "wrapped angle; unwrap it (numpy.unwrap)"
        )


def _check_range(channel, warn):
    """Values far outside the range that the model gives them."""
    if not channel.limited:
        return
    values, span, column = channel.values, channel.span, channel.column
    low, high, width = values.min(), values.max(), np.ptp(span)
    largest = max(abs(low), abs(high))
    if largest > 10 * np.abs(span).max() > 0:
        unit = "degrees" if channel.hinge else "another unit than the model's"
        raise RecordingError(
            f"{channel.where}: reaches {largest:g} where the model's range is {span[0]:g} to "
            f"{span[1]:g}; if it is in {unit}, convert it"
        )
    beyond = np.abs(values - np.mean(span)) > 0.75 * width  # stops are soft
    if channel.kind == "qpos" and beyond.mean() > 0.03:
        warn(
            channel.recording,
            f"{column} is far outside the joint's range in the model, {span[0]:g} to {span[1]:g}, "
            "in {} of its rows; check that range and where the sensor's zero is",
            beyond.mean(),
        )
    if channel.kind == "ctrl" and (low < span[0] - 1e-3 * width or high > span[1] + 1e-3 * width):
        warn(
            channel.recording,
            f"{column} leaves the model's ctrlrange {span[0]:g} to {span[1]:g}; MuJoCo clips it "
            "there",
        )


def _check_edges(channel, warn):
    """Values that stay at their extremes."""
    values, span, control = channel.values, channel.span, channel.kind == "ctrl"
    low, high, rows = values.min(), values.max(), len(channel.recording.time)
    kept = {
        edge: np.count_nonzero((values[1:] == edge) & (values[:-1] == edge)) / rows
        for edge in (low, high)
    }
    if kept[low] + kept[high] > 0.95:  # a square wave is not saturation
        return
    for edge, share in kept.items():
        limit = span[int(edge == high)]
        at_range = control and channel.limited and abs(edge - limit) < 1e-6 * (1 + abs(edge))
        if share > 0.03 and (at_range or (low == -high if control else edge)):
            why = (
                "saturated at ctrlrange"
                if at_range
                else "saturated"
                if control
                else "clipped, or at a stop"
            )
            warn(
                channel.recording,
                f"{channel.column} stays at its extreme {edge:g} in {{}} of the rows: {why}",
                share,
            )


def _check_overlap(recording, model, warn):
    """Geoms that the recorded positions put deep into each other: another origin, or another
    size."""
    rows = np.unique(np.linspace(0, len(recording.time) - 1, 40).astype(int))
    data, deep = mujoco.MjData(model), {}
    for row in rows:
        data.qpos[:] = np.where(np.isnan(recording.qpos[row]), model.qpos0, recording.qpos[row])
        mujoco.mj_fwdPosition(model, data)
        for pair in {tuple(contact.geom) for contact in data.contact if contact.geom.min() >= 0}:
            depth = -min(contact.dist for contact in data.contact if tuple(contact.geom) == pair)
            deep.setdefault(pair, []).append(depth)
    for (a, b), depths in deep.items():
        depth = np.quantile(depths, 0.1)
        size = min((r for r in model.geom_rbound[[a, b]] if r > 0), default=0.1)  # a plane has none
        if len(depths) > 0.2 * len(rows) and depth > max(0.02, 0.2 * size):
            names = " and ".join(model.geom(g).name or f"geom {g}" for g in (a, b))
            warn(
                recording,
                f"{names} overlap by {depth:.2g} m and more in {{}} of the rows; check the origin "
                f"of the positions "
                "and the model's sizes",
                len(depths) / len(rows),
            )
