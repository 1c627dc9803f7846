"""An arm of two links, and a sound recording of it."""

import io

import mujoco
import numpy as np

ARM = """
<mujoco model="arm">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="0.05"/>
      <geom name="upper_rod" type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="1"
            contype="0" conaffinity="0"/>
      <body name="lower" pos="0 0 -0.3">
        <joint name="elbow" axis="0 1 0" damping="0.05" limited="true" range="-2.9 2.9"/>
        <geom name="lower_rod" type="capsule" fromto="0 0 0 0 0 -0.25" size="0.015" mass="0.5"
              contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="shoulder_motor" joint="shoulder" ctrllimited="true" ctrlrange="-3 3"/>
    <motor name="elbow_motor" joint="elbow" ctrllimited="true" ctrlrange="-1 1"/>
  </actuator>
  <sensor><jointpos name="encoder" joint="shoulder"/></sensor>
</mujoco>
"""
HEADER = [
    "time",
    "qpos:shoulder",
    "qpos:elbow",
    "qvel:shoulder",
    "qvel:elbow",
    "ctrl:shoulder_motor",
    "ctrl:elbow_motor",
]
DT = 0.01


def arm():
    """The model of ARM."""
    return mujoco.MjModel.from_xml_string(ARM)


def run(seconds=4.0, seed=0, noise=2e-4, amplitude=1.0):
    """(T, 7) a sound recording of ARM, columns as in HEADER: random smooth torques, sampled every
    DT."""
    rng = np.random.default_rng(seed)
    model = arm()
    data = mujoco.MjData(model)
    rows = int(round(seconds / DT))
    t = DT * np.arange(rows)
    tones = rng.uniform(0.4, 1.6, (2, 3)), rng.uniform(0, 2 * np.pi, (2, 3))
    ctrl = (
        amplitude
        * np.array([[1.2], [0.4]])
        * np.sin(2 * np.pi * tones[0][:, :, None] * t + tones[1][:, :, None]).mean(axis=1)
    )
    table = np.empty((rows, 7))
    for row in range(rows):
        table[row] = [t[row], *data.qpos, *data.qvel, *ctrl[:, row]]
        data.ctrl[:] = ctrl[:, row]
        mujoco.mj_step(model, data, nstep=5)
    table[:, 1:5] += rng.normal(size=(rows, 4)) * [noise, noise, 10 * noise, 10 * noise]
    return table


def text(table, header=HEADER, separator=","):
    """A CSV as bytes."""
    lines = [separator.join(header)] + [
        separator.join(f"{value:.9g}" for value in row) for row in table
    ]
    return ("\n".join(lines) + "\n").encode()


def archive(**arrays):
    """An NPZ as bytes; object arrays are pickled, as a careless writer would."""
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def whole(table):
    """The arrays of a sound NPZ."""
    return {
        "time": table[:, 0],
        "qpos": table[:, 1:3],
        "qvel": table[:, 3:5],
        "ctrl": table[:, 5:7],
    }
