"""A robot as a newcomer has it: arm.urdf, and four ROS 2 bags of its joint states.

    python benchmarks/newcomer.py demo

The arm has two joints with motors. Its bags hold positions (an encoder of 16384 counts a turn, no
velocities) and the torques of its motors, as `effort`, at 100 Hz for 8 s. What the URDF lacks is in
HIDDEN; the bags are drawn by stock MuJoCo.
"""

import argparse
from pathlib import Path

import mujoco
import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

HIDDEN = {"shoulder": 'frictionloss="0.25"', "elbow": 'frictionloss="0.12" armature="0.01"'}
STIFF = 'solreffriction="0.004 1" solimpfriction="0.999 0.9999 0.001"'  # friction without creep
COUNT = 2 * np.pi / 16384  # rad
PERIOD, SECONDS, RUNS = 0.01, 8.0, 4
URDF = """<?xml version="1.0"?>
<robot name="arm">
  <link name="base"/>
  <link name="upper"><inertial><origin xyz="0 0 -0.15"/><mass value="1.0"/>
    <inertia ixx="0.0085" iyy="0.0085" izz="0.0005" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="lower"><inertial><origin xyz="0 0 -0.12"/><mass value="0.5"/>
    <inertia ixx="0.003" iyy="0.003" izz="0.0002" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
    <axis xyz="0 1 0"/><limit lower="-2.5" upper="2.5" effort="6" velocity="8"/>
    <dynamics damping="0.05"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/>
    <origin xyz="0 0 -0.3"/><axis xyz="0 1 0"/>
    <limit lower="-2.5" upper="2.5" effort="2" velocity="8"/><dynamics damping="0.02"/></joint>
</robot>
"""


def real_arm() -> mujoco.MjModel:
    """The arm as it is: the URDF with what is hidden."""
    spec = mujoco.MjSpec.from_string(URDF)
    xml = spec.to_xml() if spec.compile() else ""
    for joint, what in HIDDEN.items():
        xml = xml.replace(f'<joint name="{joint}"', f'<joint name="{joint}" {what} {STIFF}')
    return mujoco.MjModel.from_xml_string(xml)


def motion(model: mujoco.MjModel, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """(positions (T, 2) as the encoders show them, torques (T, 2)) of one run of smooth torques."""
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    rows = int(SECONDS / PERIOD)
    tones, phases = rng.uniform(0.2, 1.6, (2, 4)), rng.uniform(0, 2 * np.pi, (2, 4))
    time = PERIOD * np.arange(rows)[:, None, None]
    waves = np.sin(2 * np.pi * tones * time + phases).mean(axis=2)
    torques = waves * [4.0, 1.4] * np.minimum(1, 2 * time[:, 0])
    qpos = np.empty((rows, 2))
    for row in range(rows):
        qpos[row] = data.qpos
        data.qfrc_applied[:] = torques[row]
        mujoco.mj_step(model, data, nstep=round(PERIOD / model.opt.timestep))
    return COUNT * np.rint(qpos / COUNT), torques


def write_bag(folder: Path, qpos: np.ndarray, torques: np.ndarray) -> None:
    """A ROS 2 bag (MCAP) of /joint_states."""
    store = get_typestore(Stores.ROS2_JAZZY)
    kind, types = "sensor_msgs/msg/JointState", store.types
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        connection = bag.add_connection("/joint_states", kind, typestore=store)
        for row, (q, torque) in enumerate(zip(qpos, torques)):
            time = 1_700_000_000_000_000_000 + row * round(PERIOD * 1e9)
            stamp = types["builtin_interfaces/msg/Time"](*divmod(time, 10**9))
            header = types["std_msgs/msg/Header"](stamp, "")
            message = types[kind](header, ["shoulder", "elbow"], q, np.zeros(0), torque)
            bag.write(connection, time, store.serialize_cdr(message, kind))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="where arm.urdf and bags/ go")
    folder = parser.parse_args().folder
    (folder / "bags").mkdir(parents=True)
    (folder / "arm.urdf").write_text(URDF)
    model = real_arm()
    for seed in range(RUNS):
        write_bag(folder / "bags" / f"run{seed}", *motion(model, seed))
    print(f"{folder}/arm.urdf and {RUNS} bags in {folder}/bags; hidden: {HIDDEN}")


if __name__ == "__main__":
    main()
