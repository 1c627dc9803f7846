"""What the entrants share: reading a trial's folder, smooth states, writing what is scored.

Nothing here is the diagnosis' own: an entrant is what a user would write with other tools.
"""

import csv
import json
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.signal import savgol_filter

SMOOTHING = 0.09  # s, length of the polynomial fit behind speeds and accelerations
DEGREE = 3


@dataclass(frozen=True)
class Recording:
    """time (T,) s; qpos (T, nq), rad and m; ctrl (T, nu); all as measured."""

    time: np.ndarray
    qpos: np.ndarray
    ctrl: np.ndarray


def opened(args):
    """(MjSpec, [Recording], folder for the report) that words() names."""
    args.out.mkdir(parents=True, exist_ok=True)
    spec = mujoco.MjSpec.from_file(str(args.model))
    compiled = spec.compile()
    return spec, [read(path, compiled) for path in args.recordings], args.out


def read(path, model):
    """A Recording from the contract's CSV, columns in the model's order."""
    with open(path, newline="") as file:
        header, *rows = csv.reader(file)
    values = np.array(rows, float)
    column = {name: values[:, k] for k, name in enumerate(header)}
    names = []
    for index in range(model.njnt):
        joint = model.joint(index)
        free = model.jnt_type[index] == int(mujoco.mjtJoint.mjJNT_FREE)
        names += [f"qpos:{joint.name}:{k}" for k in range(7)] if free else [f"qpos:{joint.name}"]
    drives = [f"ctrl:{model.actuator(k).name}" for k in range(model.nu)]
    ctrl = [column[name] for name in drives]
    return Recording(
        column["time"],
        np.stack([column[name] for name in names], 1),
        np.stack(ctrl, 1) if ctrl else np.zeros((len(values), 0)),
    )


def states(recording, model):
    """(qpos (T, nq), qvel (T, nv), qacc (T, nv)): a cubic fitted through each row's neighbours."""
    time = recording.time
    row = np.median(np.diff(time))
    even = np.arange(time[0], time[-1] + 1e-9, row)
    path = np.zeros((len(time), model.nv))  # from the first row, in the tangent space
    for k in range(1, len(time)):
        step = np.empty(model.nv)
        mujoco.mj_differentiatePos(model, step, 1.0, recording.qpos[k - 1], recording.qpos[k])
        path[k] = path[k - 1] + step
    path = np.stack([np.interp(even, time, column) for column in path.T], 1)
    length = max(DEGREE + 2, 2 * int(SMOOTHING / row / 2) + 1)
    fit = lambda order: savgol_filter(path, length, DEGREE, order, delta=row, axis=0)
    back = lambda values: np.stack([np.interp(time, even, column) for column in values.T], 1)
    smooth, qpos = back(fit(0) - path), recording.qpos.copy()
    for k in range(len(time)):
        mujoco.mj_integratePos(model, qpos[k], smooth[k], 1.0)
    return qpos, back(fit(1)), back(fit(2))


def finding(effect, kind, name, parameters):
    """An entry of diagnosis.json; parameters: {name: (nominal, value, low, high)}."""
    return {
        "effect": effect,
        "place": {"kind": kind, "name": name},
        "parameters": [
            {"name": key, "nominal": v[0], "value": v[1], "low": v[2], "high": v[3]}
            for key, v in parameters.items()
        ],
        "also_possible": [],
        "depends_on": [],
    }


def write(out, spec, findings=None):
    """corrected.xml, and diagnosis.json where the tool names anything at all."""
    spec.compile()
    (out / "corrected.xml").write_text(spec.to_xml())
    if findings is not None:
        verdict = "mismatch" if findings else "match"
        summary = {"format": 2, "verdict": verdict, "findings": findings}
        (out / "diagnosis.json").write_text(json.dumps(summary))
