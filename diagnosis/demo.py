"""A folder to try the diagnosis on: the model of a two-link arm, and recordings of a "real" one.

    python -m diagnosis.demo demo
    cd demo && rgat-diagnose --model arm.xml --recordings run*.csv --out report

The real arm has a heavier forearm and dry friction in its elbow. Whoever wants to guess first does
not read on: the answer is in HIDDEN below.
"""

import argparse
import sys
from pathlib import Path

import mujoco
import numpy as np

from diagnosis.common.atomic_files import WriteError, write_together

HIDDEN = {"elbow friction": 0.04, "forearm mass": 0.5}  # N·m, kg; the model says 0 and 0.4
RUNS, SECONDS, ROW, NOISE = 4, 5.0, 0.01, 5e-4  # files, s each, s between rows, rad
COLUMNS = "time qpos:shoulder qpos:elbow ctrl:shoulder_motor ctrl:elbow_motor".split()
ARM = """
<mujoco model="arm">
  <option timestep="0.002" integrator="implicitfast"/>
  <default>
    <geom type="capsule" size="0.02" contype="0" conaffinity="0"/>
    <joint axis="0 1 0" damping="0.02" armature="0.002"/>
  </default>
  <worldbody>
    <body name="upper_arm">
      <joint name="shoulder"/>
      <geom fromto="0 0 0 0 0 -0.3" mass="0.8"/>
      <body name="forearm" pos="0 0 -0.3">
        <joint name="elbow"/>
        <geom fromto="0 0 0 0 0 -0.25" mass="0.4"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="shoulder_motor" joint="shoulder"/>
    <motor name="elbow_motor" joint="elbow"/>
  </actuator>
</mujoco>
"""


def real_arm() -> mujoco.MjModel:
    """The arm with what is hidden in it."""
    spec = mujoco.MjSpec.from_string(ARM)
    spec.body("forearm").geoms[0].mass = HIDDEN["forearm mass"]
    elbow = spec.joint("elbow")
    elbow.frictionloss = HIDDEN["elbow friction"]
    elbow.solref_friction[:2] = 0.004, 1.0  # nearly rigid: MuJoCo's default creeps when it sticks
    elbow.solimp_friction[:3] = 0.999, 0.9999, 0.001
    return spec.compile()


def run(model: mujoco.MjModel, seed: int) -> np.ndarray:
    """(T, 5) rows of COLUMNS: torques of four sines for each motor, positions with noise."""
    rng, rows = np.random.default_rng(seed), round(SECONDS / ROW)
    time = ROW * np.arange(rows)
    tones, phases = rng.uniform(0.2, 2.0, (4, 2, 1)), rng.uniform(0, 2 * np.pi, (4, 2, 1))
    torque = np.sin(2 * np.pi * tones * time + phases).sum(axis=0).T * [0.5, 0.12]
    data, table = mujoco.MjData(model), np.empty((rows, len(COLUMNS)))
    for row in range(rows):
        table[row] = [time[row], *data.qpos, *torque[row]]
        data.ctrl[:] = torque[row]
        mujoco.mj_step(model, data, nstep=round(ROW / model.opt.timestep))
    table[:, 1:3] += NOISE * rng.normal(size=(rows, 2))
    return table


def files() -> dict[str, str]:
    """{name: text} of the model and the recordings."""
    made, model = {"arm.xml": ARM.lstrip()}, real_arm()
    for number in range(1, RUNS + 1):
        lines = [",".join(f"{value:.6g}" for value in row) for row in run(model, number)]
        made[f"run{number}.csv"] = "\n".join([",".join(COLUMNS), *lines]) + "\n"
    return made


def main() -> int:
    """The command: fills a folder, says what to do with it. Returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m diagnosis.demo", description=__doc__)
    parser.add_argument("folder", type=Path, help="made, and filled")
    folder = parser.parse_args().folder
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_together({folder / name: text for name, text in files().items()})
    except (OSError, WriteError) as error:
        print(f"demo: {error}; name another folder", file=sys.stderr)
        return 2
    runs = f"{folder}/run*.csv"
    print(f"python -m diagnosis --model {folder}/arm.xml --recordings {runs} --out {folder}/report")
    return 0


if __name__ == "__main__":
    sys.exit(main())
