"""Entrants of the benchmark, run as the benchmark runs them, on a pendulum with a known fault."""

import csv
import json
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
MODEL = """<mujoco><option timestep="0.002"/><worldbody><body name="link0">
<inertial pos="0 0 -0.2" mass="0.5" diaginertia="0.01 0.01 0.001"/>
<joint name="joint0" axis="0 1 0" damping="{damping}"/></body></worldbody><actuator>
<motor name="drive0" joint="joint0" forcerange="-5 5"/></actuator></mujoco>"""
DAMPING, NOMINAL = 0.08, 0.02


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """sim.xml, and two recordings of the same pendulum with four times the damping."""
    folder = tmp_path_factory.mktemp("trial")
    (folder / "sim.xml").write_text(MODEL.format(damping=NOMINAL))
    model = mujoco.MjModel.from_xml_string(MODEL.format(damping=DAMPING))
    for number in range(2):
        rng, data = np.random.default_rng(number), mujoco.MjData(model)
        phase = rng.uniform(0, 6, 2)
        with open(folder / f"train_{number}.csv", "w", newline="") as file:
            rows = csv.writer(file)
            rows.writerow(("time", "qpos:joint0", "ctrl:drive0"))
            for k in range(160):
                data.ctrl[:] = 0.6 * np.sin(np.array((5.0, 2.3)) * 0.01 * k + phase).sum()
                noisy = data.qpos[0] + 3e-4 * rng.normal()
                rows.writerow((0.01 * k, noisy, data.ctrl[0]))
                mujoco.mj_step(model, data, 5)
    return folder


def run(folder, script, *words, recordings=2):
    """The folder that a script has written its report into."""
    out = folder / "_".join((Path(script).stem, *words))
    recordings = sorted(map(str, folder.glob("train_*.csv")))[:recordings]
    script = ROOT / "benchmarks" / "entrants" / script
    command = [sys.executable, str(script), *words, str(folder / "sim.xml"), *recordings, str(out)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, timeout=120)
    assert done.returncode == 0, done.stderr
    return out


def damping(report):
    """(value, low, high) of the damping that a report names at the joint."""
    found = json.loads((report / "diagnosis.json").read_text())["findings"]
    here = [f for f in found if f["effect"] == "viscous_damping"]
    assert len(here) == 1 and here[0]["place"] == {"kind": "joint", "name": "joint0"}
    return [here[0]["parameters"][0][name] for name in ("value", "low", "high")]


def test_sparse_regression_finds_the_damping_and_writes_it(folder):
    report = run(folder, "sparse.py")
    assert damping(report)[0] == pytest.approx(DAMPING, rel=0.15)
    model = mujoco.MjModel.from_xml_path(str(report / "corrected.xml"))
    assert model.dof_damping[0] == pytest.approx(damping(report)[0], rel=1e-4)


def test_sysid_by_bic_finds_the_damping(folder):
    pytest.importorskip("mujoco.sysid._src.optimize")
    value, low, high = damping(run(folder, "sysid.py", "usual", recordings=1))
    assert value == pytest.approx(DAMPING, rel=0.1) and low < value < high


def test_the_network_adds_a_force_against_the_motion(folder):
    pytest.importorskip("torch")
    report = run(folder, "network.py")
    model = mujoco.MjModel.from_xml_path(str(report / "corrected.xml"))
    scope = {"__file__": str(report / "corrected.py")}
    exec((report / "corrected.py").read_text(), scope)
    data = mujoco.MjData(model)
    for speed in (2.0, -2.0):
        data.qpos[:], data.qvel[:], data.ctrl[:] = 0.3, speed, 0.1
        scope["step"](model, data)
        lacking = -(DAMPING - NOMINAL) * speed
        assert data.qfrc_applied[0] == pytest.approx(lacking, rel=0.35)
        assert not (report / "diagnosis.json").exists()
