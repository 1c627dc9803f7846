"""Recorded motion beside that of the nominal and the corrected model, for pictures: stock MuJoCo,
no catalogue."""

import mujoco
import numpy as np

from diagnosis.report import Diagnosis

FRAMES, SECONDS = 60, 2.0
BEFORE = 1.0  # s, over which actuator states and delayed controls run on to the start


def poses(model: mujoco.MjModel, recordings: list, count: int = 4) -> list[np.ndarray]:
    """[(nq,)] recorded poses, evenly spread over the longest recording; unmeasured joints stay at
    their reference."""
    longest = max((r.seen() for r in recordings), key=lambda recording: len(recording.time))
    rows = np.linspace(0.5, 0.98, count) * (len(longest.time) - 1)
    return [whole(model, longest.qpos[int(row)]) for row in rows]


def whole(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """(..., nq) with what was not measured at its reference."""
    return np.where(np.isnan(qpos), model.qpos0, qpos)


def simulate(model: mujoco.MjModel, recording, first: int, last: int, columns: tuple) -> np.ndarray:
    """(last - first + 1, nq) from the recorded state of row `first` under the recorded control.
    columns: (qpos, dof) indices of the recorded coordinates within `model`. NaN from where the
    simulation blows up.

    Actuator states and delayed controls come from the control before `first`, the mechanism held
    where it was recorded; before the recording's first row it is that row's."""
    data = mujoco.MjData(model)
    before = (
        round(BEFORE / model.opt.timestep) if model.na or (model.actuator_delay > 0).any() else 0
    )  # steps
    ahead = before * model.opt.timestep
    start = recording.time[first] - ahead  # where data.time is 0
    at = lambda: max(
        0, int(np.searchsorted(recording.time, start + data.time + 1e-9, side="right")) - 1
    )

    def put(row):
        data.qpos[columns[0]] = np.where(
            np.isnan(recording.qpos[row]), data.qpos[columns[0]], recording.qpos[row]
        )
        data.qvel[columns[1]] = velocity(model, recording, row, columns)

    out = np.full((last - first + 1, recording.qpos.shape[1]), np.nan)
    broken = lambda: any(
        data.warning[k].number
        for k in (
            mujoco.mjtWarning.mjWARN_BADQPOS,
            mujoco.mjtWarning.mjWARN_BADQVEL,
            mujoco.mjtWarning.mjWARN_BADQACC,
        )
    )
    for _ in range(before):
        put(at())
        data.ctrl[: recording.ctrl.shape[1]] = recording.ctrl[at()]
        mujoco.mj_step(model, data)
        if broken():  # which sets the time back
            return out
    put(first)
    for row in range(first, last + 1):
        while data.time < recording.time[row] - start - 0.5 * model.opt.timestep:
            data.ctrl[: recording.ctrl.shape[1]] = recording.ctrl[max(first, at())]
            mujoco.mj_step(model, data)
            if broken():
                return out
        out[row - first] = data.qpos[columns[0]]
    return out


def velocity(model: mujoco.MjModel, recording, row: int, columns: tuple) -> np.ndarray:
    """(nv,) measured at `row`, else by the slope over the rows around it; 0 where neither is
    known."""
    before, after = max(0, row - 2), min(len(recording.time) - 1, row + 2)
    full = [np.array(model.qpos0) for _ in (before, after)]
    for pose, at in zip(full, (before, after)):
        pose[columns[0]] = np.where(
            np.isnan(recording.qpos[at]), pose[columns[0]], recording.qpos[at]
        )
    slope = np.zeros(model.nv)
    mujoco.mj_differentiatePos(model, slope, recording.time[after] - recording.time[before], *full)
    return np.where(np.isnan(recording.qvel[row]), slope[columns[1]], recording.qvel[row])


def columns_in(model: mujoco.MjModel, nominal: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """(qpos, dof) indices in `model` of the nominal model's coordinates: joints by name, unnamed
    ones in their order."""
    qpos, dof = [], []
    unnamed = [j for j in range(model.njnt) if not model.joint(j).name]
    for j in range(nominal.njnt):
        name = nominal.joint(j).name
        here = model.joint(name).id if name else unnamed.pop(0)
        widths = {0: (7, 6), 1: (4, 3)}.get(int(nominal.jnt_type[j]), (1, 1))
        qpos += range(model.jnt_qposadr[here], model.jnt_qposadr[here] + widths[0])
        dof += range(model.jnt_dofadr[here], model.jnt_dofadr[here] + widths[1])
    return np.array(qpos, dtype=int), np.array(dof, dtype=int)


def overlay(diagnosis: Diagnosis) -> tuple[str, float, float, dict] | None:
    """(recording's name, start in s, seconds, {"measured" | "nominal" | "corrected": (F, nq)}) of
    the held-out stretch of at most SECONDS that the nominal model predicts worst, or None where
    there is nothing to compare."""
    nominal = diagnosis.world.model
    corrected = mujoco.MjModel.from_xml_string(diagnosis.corrected_xml)
    models = {
        "nominal": (nominal, columns_in(nominal, nominal)),
        "corrected": (corrected, columns_in(corrected, nominal)),
    }
    worst = _worst(nominal, diagnosis.held_out, models["nominal"][1])
    if worst is None:
        return None
    recording, first, last = worst
    motions = {"measured": whole(nominal, recording.qpos[first : last + 1])}
    for look, (model, columns) in models.items():
        motions[look] = simulate(model, recording, first, last, columns)
    if not any(finding["written_as"] == "mjcf" for finding in diagnosis.summary["findings"]):
        del motions["corrected"]  # it is the nominal one
    rows = np.unique(np.linspace(0, last - first, min(FRAMES, last - first + 1)).astype(int))
    motions = {look: _held(qpos)[rows] for look, qpos in motions.items()}
    time = recording.time
    return recording.name, float(time[first]), float(time[last] - time[first]), motions


def _worst(model, recordings, columns):
    """(recording, first row, last row) of the stretch that a model predicts worst; None without."""
    worst, stretch = 0.0, None
    for recording in (r.seen() for r in recordings[:8]):
        time = recording.time
        end = np.searchsorted(time, time[-1] - min(SECONDS, 0.9 * np.ptp(time)))
        for first in sorted({int(k) for k in np.linspace(0, end, 6)}):
            last = int(np.searchsorted(time, time[first] + SECONDS, side="right")) - 1
            if last - first < 4:
                continue
            predicted = simulate(model, recording, first, last, columns)
            if not np.isfinite(predicted).any():
                continue
            apart = np.nanmean((predicted - recording.qpos[first : last + 1]) ** 2)
            if apart > worst:
                worst, stretch = apart, (recording, first, last)
    return stretch


def _held(qpos):
    """A motion (n, nq) in which what blew up stays where it was last."""
    for k in range(1, len(qpos)):
        qpos[k] = np.where(np.isnan(qpos[k]), qpos[k - 1], qpos[k])
    return qpos
