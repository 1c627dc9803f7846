"""ROS 2 bags (.db3, .mcap, or their folder): positions, velocities and efforts of
sensor_msgs/JointState.

A joint's own columns are `<joint>.position`, `.velocity`, `.effort` and, from the topic of targets,
`.target`; they become qpos, qvel, effort and target of that joint. Time is the messages' stamp, or
when they were recorded where they carry none; targets and states go by one clock. In a column map,
`[ros]` may name `topic` and `targets`, and `joints` (in the order of the targets, where these are a
bare std_msgs/Float64MultiArray). Targets are JointState, Float64MultiArray or a trajectory
controller's state (its reference).
"""

import os
from pathlib import Path

import numpy as np

from diagnosis.recordings.columns import RecordingError
from diagnosis.recordings.formats.optional import library
from diagnosis.recordings.layout import Layout, Raw

STATE = "sensor_msgs/msg/JointState"
USUAL = "/joint_states"
KINDS = {"position": "qpos", "velocity": "qvel", "effort": "effort"}


class RosBag:
    """Reads bags through rosbags, which needs no ROS."""

    def read(self, path, model, layout: Layout) -> list[Raw]:
        """The one run of a bag. Raises RecordingError."""
        module = library(path, "rosbags.highlevel", "ros", "a ROS 2 bag")
        from rosbags.typesys import Stores, get_typestore

        try:
            store = get_typestore(Stores.ROS2_JAZZY)  # for bags that carry no definitions
            with module.AnyReader([_bag(path)], default_typestore=store) as bag:
                states = list(_messages(bag, _topic(path, bag, layout)))
                told = layout.ros.get("targets")
                targets = list(_messages(bag, _named(path, bag, told, layout))) if told else []
        except RecordingError:
            raise
        except Exception as error:  # whatever damaged databases make the library raise
            raise RecordingError(
                f"{path}: not a readable ROS 2 bag "
                f"({' '.join(str(error).split()) or type(error).__name__}); record it "
                "again, or repair it (ros2 bag reindex)"
            ) from None
        if not states:
            raise RecordingError(f"{path}: the topic of joint states holds no messages")
        time, columns, notes = _states(path, states)
        first = 0
        if targets:
            goals = _targets(path, targets, states, time, layout)
            columns |= goals
            first = _first(path, goals, model, layout)
        if first:
            notes += (f"rows before the first target are left out: {first}",)
            time, columns = time[first:], {name: c[first:] for name, c in columns.items()}
        seconds = (time - time[0]) * 1e-9
        natural = {"time": "time"}
        for column in columns:
            joint, _, kind = column.rpartition(".")
            natural[f"{KINDS.get(kind, kind)}:{joint}"] = column
        name = os.path.basename(os.path.normpath(path))
        return [Raw(path, name, {"time": seconds, **columns}, natural, first, notes)]


def _bag(path):
    """The folder of a bag whose one file was named beside its metadata.yaml, or the file."""
    place = Path(path)
    if place.is_dir() and not (place / "metadata.yaml").exists():
        files = sorted([*place.glob("*.mcap"), *place.glob("*.db3")])
        if len(files) > 1:
            raise RecordingError(
                f"{path}: several bag files and no metadata.yaml; name one of them, as in "
                f"{files[0]}"
            )
        return files[0]
    return place


def _topic(path, bag, layout):
    """The connections of the topic of joint states. Raises RecordingError where there is none, or
    no telling which."""
    if "topic" in layout.ros:
        return _named(path, bag, layout.ros["topic"], layout)
    topics = sorted({c.topic for c in bag.connections if c.msgtype == STATE})
    if not topics:
        has = ", ".join(sorted({f"{c.topic} ({c.msgtype})" for c in bag.connections})[:8])
        raise RecordingError(
            f"{path}: no topic of sensor_msgs/JointState; it has {has or 'no topics'}; record "
            f"/joint_states too"
        )
    if len(topics) > 1 and USUAL not in topics:
        raise RecordingError(
            f"{path}: several topics of joint states ({', '.join(topics)}); name one: --map with "
            f'[ros] topic = "..."'
        )
    return _named(path, bag, USUAL if USUAL in topics else topics[0], layout)


def _named(path, bag, topic, layout):
    """The connections of one topic. Raises RecordingError where the bag has no such."""
    found = [c for c in bag.connections if c.topic == topic]
    if not found:
        topics = ", ".join(sorted({c.topic for c in bag.connections})[:12])
        raise RecordingError(
            f"{path}: no topic {topic!r}, which {layout.label} names; it has {topics or 'none'}"
        )
    return found


def _messages(bag, connections):
    """(time of recording in ns, message) in order."""
    for connection, time, data in bag.messages(connections=connections):
        yield time, bag.deserialize(data, connection.msgtype)


def _stamps(messages):
    """(T,) int64 ns: the messages' own stamps, or when they were recorded where any has none."""
    if not _stamped(messages):
        return _received(messages)
    stamps = (m.header.stamp for _, m in messages)
    return np.array([s.sec * 10**9 + s.nanosec for s in stamps], dtype=np.int64)


def _stamped(messages):
    """Whether all messages carry stamps of their own."""
    stamps = [m.header.stamp if hasattr(m, "header") else None for _, m in messages]
    return all(s is not None and (s.sec or s.nanosec) for s in stamps)


def _received(messages):
    """(T,) int64 ns: when messages were recorded."""
    return np.array([time for time, _ in messages], dtype=np.int64)


def _states(path, messages):
    """((T,) ns, {"<joint>.position": (T,), ...}, notes) of JointState messages; nan where a message
    leaves a joint out.

    Messages with the stamp of the one before are joined with it: several publishers may share the
    topic.
    """
    if not hasattr(messages[0][1], "position"):
        raise RecordingError(f"{path}: the topic holds no sensor_msgs/JointState")
    stamps = _stamps(messages)
    order = np.argsort(stamps, kind="stable")
    stamps, messages = stamps[order], [messages[i][1] for i in order]
    time, row = np.unique(stamps, return_inverse=True)
    joints = sorted({name for m in messages for name in m.name})
    if not joints:
        raise RecordingError(f"{path}: its JointState messages name no joints")
    columns = {f"{j}.{kind}": np.full(len(time), np.nan) for j in joints for kind in KINDS}
    for k, message in zip(row, messages):
        for kind in KINDS:
            for joint, value in zip(message.name, getattr(message, kind)):
                columns[f"{joint}.{kind}"][k] = value
    notes = []
    if (np.diff(order) < 0).any():
        notes.append("messages were recorded out of order; they are sorted by their stamps")
    columns = {
        name: _held(values) if name.endswith(".effort") else values
        for name, values in columns.items()
        if name.endswith(".position") or np.isfinite(values).any()
    }
    return time, columns, tuple(notes)


def _held(values):
    """(T,) with what is missing as it was before, or as it first is."""
    known = np.flatnonzero(np.isfinite(values))
    rows = np.clip(np.searchsorted(known, np.arange(len(values)), side="right") - 1, 0, None)
    return values[known[rows]]


def _targets(path, messages, states, time, layout):
    """{"<joint>.target": (T,)}: the last target told at or before each row, nan before the first.
    time (T,) ns: of the rows that the messages `states` make. Raises RecordingError on unknown
    messages, and where they and the states are not of the same time."""
    stamps = _stamps(messages)
    if not (_stamped(messages) and _stamped(states)):
        # one clock for both: the bag's own, less how long after its stamp it noted the median state
        late = np.sort(_received(states) - _stamps(states))
        stamps = _received(messages) - late[len(late) // 2]
    order = np.argsort(stamps, kind="stable")
    stamps, told = stamps[order], [_told(path, messages[i][1], layout) for i in order]
    if stamps[0] > time[-1] or stamps[-1] < time[0]:
        _apart(path, stamps, time)
    columns = {}
    for joint in sorted({joint for one in told for joint in one}):
        values = np.array([one.get(joint, np.nan) for one in told])
        known = np.isfinite(values)
        row = np.searchsorted(stamps[known], time, side="right")
        columns[f"{joint}.target"] = np.concatenate([[np.nan], values[known]])[row]
    return columns


def _apart(path, stamps, time):
    """Raises RecordingError: the targets' times and the states' do not overlap."""
    targets, states = (f"{t[0] * 1e-9:.2f} to {t[-1] * 1e-9:.2f} s" for t in (stamps, time))
    raise RecordingError(
        f"{path}: targets are of {targets}, joint states of {states}: never at the same time; "
        "stamp both by one clock, and record both together"
    )


def _first(path, told, model, layout):
    """The first row in which every joint of the model that is told a target at all has one. Raises
    RecordingError where one has none in any row."""
    used = {source.column for source in layout.columns.values()}
    for j in range(model.njnt):
        name = model.joint(j).name
        used.add(f"{layout.joints.get(name, name)}.target")
    first = 0
    for name in sorted(used & set(told)):
        known = np.isfinite(told[name])
        if not known.any():
            raise RecordingError(
                f"{path}: {name!r} is told after the last joint state, or never as a number; "
                "record on while targets are told"
            )
        first = max(first, int(np.argmax(known)))
    return first


def _told(path, message, layout):
    """{joint: position} that one message asks for."""
    for part in ("reference", "desired"):
        if hasattr(message, "joint_names") and hasattr(message, part):
            return dict(zip(message.joint_names, getattr(message, part).positions))
    if hasattr(message, "name") and hasattr(message, "position"):
        return dict(zip(message.name, message.position))
    if hasattr(message, "data") and np.ndim(message.data) == 1:
        joints = layout.ros.get("joints")
        if not joints:
            raise RecordingError(
                f"{path}: the targets carry no names of joints; say their order: --map with [ros] "
                f"joints = [...]"
            )
        return dict(zip(joints, message.data))
    raise RecordingError(
        f"{path}: the topic of targets holds neither JointState, Float64MultiArray nor a "
        f"controller's state"
    )
