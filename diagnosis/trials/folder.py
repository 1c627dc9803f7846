"""The folder that a tool gets of a trial: the nominal MJCF file and the training recordings."""

import csv
import io
import json

import mujoco
import numpy as np

from diagnosis.common.atomic_files import write_together
from diagnosis.trials.mjcf import to_mjcf


def write_folder(trial, folder):
    """Write sim.xml and the training recordings into `folder`; returns their names."""
    model = mujoco.MjModel.from_xml_string(to_mjcf(trial.nominal))
    files = {folder / "sim.xml": to_mjcf(trial.nominal)}
    names = []
    for run in trial.train:
        names.append(f"train_{run.number}.csv")
        files[folder / names[-1]] = to_csv(run, model)
    write_together(files)
    return names


def to_csv(run, model):
    """One Run as the contract's CSV text."""
    header, columns = ["time"], [run.time]
    for index in range(model.njnt):
        joint = model.joint(index)
        q, v = joint.qposadr[0], joint.dofadr[0]
        free = model.jnt_type[index] == mujoco.mjtJoint.mjJNT_FREE
        tags = lambda n: [f":{k}" for k in range(n)] if free else [""]
        for k, tag in enumerate(tags(7)):
            header.append(f"qpos:{joint.name}{tag}")
            columns.append(run.qpos[:, q + k])
        if np.isfinite(run.qvel).all():
            for k, tag in enumerate(tags(6)):
                header.append(f"qvel:{joint.name}{tag}")
                columns.append(run.qvel[:, v + k])
    for k in range(model.nu):
        header.append(f"ctrl:{model.actuator(k).name}")
        columns.append(run.ctrl[:, k])
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(header)
    writer.writerows([f"{value:.9g}" for value in row] for row in np.column_stack(columns))
    return text.getvalue()


def answer_text(answer):
    """The answer as one line of JSON, the same for the same answer."""
    return json.dumps(answer, sort_keys=True)
