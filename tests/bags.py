"""Small ROS 2 bags, written by rosbags."""

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = STORE.types


def joint_state(nanoseconds, names, position, velocity, effort):
    """A sensor_msgs/JointState stamped at a time in ns; 0: without a stamp."""
    stamp = TYPES["builtin_interfaces/msg/Time"](*divmod(int(nanoseconds), 10**9))
    arrays = (np.asarray(x, dtype=float) for x in (position, velocity, effort))
    return TYPES["sensor_msgs/msg/JointState"](
        TYPES["std_msgs/msg/Header"](stamp, ""), list(names), *arrays
    )


def write_bag(folder, topics, storage="sqlite3"):
    """{topic: [(time of recording in ns, JointState, list of floats or str)]} into a bag at
    `folder`, a Path, returned."""
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    with Writer(folder, version=9, storage_plugin=plugin) as bag:
        for topic, messages in topics.items():
            kind = {list: "Float64MultiArray", str: "String"}.get(type(messages[0][1]))
            kind = f"std_msgs/msg/{kind}" if kind else "sensor_msgs/msg/JointState"
            connection = bag.add_connection(topic, kind, typestore=STORE)
            for time, message in messages:
                if isinstance(message, list):
                    layout = TYPES["std_msgs/msg/MultiArrayLayout"]([], 0)
                    message = TYPES[kind](layout, np.asarray(message, dtype=float))
                elif isinstance(message, str):
                    message = TYPES[kind](message)
                bag.write(connection, time, STORE.serialize_cdr(message, kind))
    return folder
