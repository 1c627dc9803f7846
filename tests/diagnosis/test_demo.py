"""The demo: its files are sound, the same each time, and hold what they are said to hide."""

import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np

from diagnosis import demo
from diagnosis.recordings import plausibility
from diagnosis.recordings.recording import load

ROOT = Path(__file__).resolve().parents[2]


def test_the_folder_is_one_that_a_diagnosis_takes(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "diagnosis.demo", str(tmp_path / "new/demo")],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=True,
    )
    assert done.stdout.startswith("python -m diagnosis --model ")
    folder = tmp_path / "new/demo"
    model = mujoco.MjModel.from_xml_path(str(folder / "arm.xml"))
    recordings = load(sorted(map(str, folder.glob("run*.csv"))), model)
    assert plausibility.check(recordings, model) == [] and len(recordings) == demo.RUNS
    plausibility.enough(recordings)


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    command = [sys.executable, "-m", "diagnosis.demo", str(tmp_path / "file/demo")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "demo: " in done.stderr


def test_what_is_hidden_is_in_the_motion_and_not_in_the_model():
    """Stock MuJoCo with the hidden values repeats a run to its noise; the model does not."""
    table = demo.run(demo.real_arm(), 1)
    errors = []
    for model in (demo.real_arm(), mujoco.MjModel.from_xml_string(demo.ARM)):
        data, gaps = mujoco.MjData(model), []
        for row in table[:50]:
            gaps.append(data.qpos - row[1:3])
            data.ctrl[:] = row[3:]
            mujoco.mj_step(model, data, nstep=5)
        errors.append(np.sqrt(np.mean(np.square(gaps))))
    assert errors[0] < 1.3 * demo.NOISE and errors[1] > 20 * demo.NOISE
