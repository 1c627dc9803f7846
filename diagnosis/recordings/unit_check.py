"""Does a recording make sense to the model in another unit, turned round, or with columns
exchanged, and only then?

The test is Newton's second law, M(q) a = F(q, v, ctrl), on smoothed positions. A mistake of unit
(57 times, 1000 times), of sign or of column leaves the two sides unrelated, whatever small physics
the model lacks; the right reading relates them.
"""

from dataclasses import replace
from typing import NamedTuple

import mujoco
import numpy as np

from diagnosis.effects.base import HINGE, SLIDE
from diagnosis.recordings import inverse_dynamics
from diagnosis.recordings.columns import columns_of

CENTRES = 400  # rows at which the law is tested
HALVES = (
    inverse_dynamics.HALF,
    4 * inverse_dynamics.HALF,
)  # s, of the smoothing: for fast motion, and for slow motion under much noise
# imbalance (0: the law holds, 1: one side dwarfs the other) above which a reading can be wrong;
UNLIKE = 0.35
UNIT_GAIN, SWAP_GAIN, LIKE = (
    2,
    3,
    0.1,
)  # the right one divides it by so much, and leaves or makes it small in the other dofs
# (missing friction alone reaches 0.7, but no wrong reading betters that so)
# degrees or mm: who records a joint in these moves it farther; one that sticks would look like one
# in degrees
WIDE = 3.0
FREE = int(mujoco.mjtJoint.mjJNT_FREE)


class Reading(NamedTuple):
    """Another way to read a recording: what to tell, the dofs whose imbalance must fall, by how
    much, and the states."""

    message: str
    dofs: list
    gain: float
    states: tuple


def suspect(recording, model):
    """One line that says which unit, sign or columns seem wrong, or None. Silent for models with
    actuator states or joints that were not measured, and where contacts act."""
    if model.na or model.nq == 0 or np.isnan(recording.qpos).all(axis=0).any():
        return None
    for half in HALVES:
        states = inverse_dynamics.smooth(model, recording, CENTRES, half)[1:]
        if len(states[0]) < 20:
            continue
        now = _imbalance(model, *states)
        if not (now > UNLIKE).any():
            continue
        for reading in _readings(recording, model, states, half):
            before = now[reading.dofs]
            if (before > UNLIKE).any():
                bound = np.where(before > UNLIKE, before / reading.gain, np.maximum(before, LIKE))
                if (_imbalance(model, *reading.states)[reading.dofs] < bound).all():
                    return reading.message
    return None


def _readings(recording, model, states, half):
    """Every Reading worth a try, one after the other."""
    names = [model.joint(j).name or str(j) for j in range(model.njnt)]
    single = [j for j in range(model.njnt) if model.jnt_type[j] in (HINGE, SLIDE)]
    free = [j for j in range(model.njnt) if model.jnt_type[j] == FREE]
    q, v = model.jnt_qposadr, model.jnt_dofadr
    units = {
        j: ("degrees; convert to rad", np.pi / 180)
        if model.jnt_type[j] == HINGE
        else ("mm; convert to m", 1e-3)
        for j in single
    }
    wide = [j for j in single if np.ptp(states[0][:, q[j]]) > WIDE]
    for j in wide:
        yield Reading(
            f"column 'qpos:{names[j]}' seems to be in {units[j][0]}",
            [v[j]],
            UNIT_GAIN,
            _scaled(model, states, {j: units[j][1]}),
        )
    if len(single) > 1 and wide:
        yield Reading(
            "the positions seem to be in "
            + " or ".join(sorted({unit for unit, _ in units.values()})),
            [v[j] for j in single],
            UNIT_GAIN,
            _scaled(model, states, {j: factor for j, (_, factor) in units.items()}),
        )
    for j in free:
        yield Reading(
            f"columns 'qpos:{names[j]}:0' to ':2' seem to be in mm; convert to m",
            list(range(v[j], v[j] + 3)),
            UNIT_GAIN,
            _scaled(model, states, {j: 1e-3}),
        )
    yield Reading(
        "column 'time' seems to be in ms; convert to s",
        list(range(model.nv)),
        UNIT_GAIN,
        (states[0], states[1] * 1e3, states[2] * 1e6, states[3]),
    )
    for j in single:
        yield Reading(
            f"column 'qpos:{names[j]}' seems to have the wrong sign; turn it round",
            [v[j]],
            SWAP_GAIN,
            _scaled(model, states, {j: -1.0}),
        )
    for j in single:
        if model.jnt_type[j] == HINGE:
            for degrees in (180, 90, -90):
                turned = states[0].copy()
                turned[:, q[j]] += np.deg2rad(degrees)
                yield Reading(
                    f"column 'qpos:{names[j]}' seems to count from another zero than the model; "
                    f"add {degrees} degrees "
                    f"({np.deg2rad(degrees):.4f}), or set the joint's ref",
                    [v[j]],
                    SWAP_GAIN,
                    (turned, *states[1:]),
                )
    controls, signs = (
        [c for c in columns_of(model) if c.startswith("ctrl:")],
        1.0 - 2.0 * np.eye(model.nu),
    )
    moments = _moments(model)
    driven = [np.flatnonzero(moment) for moment in moments]
    gears = np.abs(
        model.actuator_gear[np.repeat(np.arange(model.nactuator), model.actuator_ctrlnum)]
    ).max(axis=1, initial=1e-9)
    for divisor, what in (
        (
            gears,
            "forces in the joints; divide each by its actuator's gear",
        ),  # the smaller first: nearly
        (100.0, "100 times too large for the model (percent?)"),  # no control fits well, too
        (1000.0, "1000 times too large for the model"),
    ):
        if np.any(divisor != 1.0):
            yield Reading(
                f"the 'ctrl:' columns seem to be {what}",
                np.flatnonzero(moments.any(axis=0)),
                SWAP_GAIN,
                (*states[:3], states[3] / divisor),
            )
    for a, column in enumerate(controls):
        yield Reading(
            f"column '{column}' seems to have the wrong sign; turn it round",
            driven[a],
            SWAP_GAIN,
            (*states[:3], states[3] * signs[a]),
        )
    for a, column in enumerate(controls):
        for j in single:
            if driven[a].tolist() == [v[j]]:
                yield Reading(
                    f"columns 'qpos:{names[j]}' and '{column}' do not fit the signs of the others; "
                    "turn both round, or "
                    "that joint's axis in the model",
                    driven[a],
                    SWAP_GAIN,
                    (*_scaled(model, states, {j: -1.0})[:3], states[3] * signs[a]),
                )
    for i in single:
        for j in single[: single.index(i)]:
            if model.jnt_type[i] == model.jnt_type[j]:
                places, dofs = np.arange(model.nq), np.arange(model.nv)
                places[[q[i], q[j]]], dofs[[v[i], v[j]]] = places[[q[j], q[i]]], dofs[[v[j], v[i]]]
                yield Reading(
                    f"columns 'qpos:{names[j]}' and 'qpos:{names[i]}' seem to be exchanged",
                    [v[i], v[j]],
                    SWAP_GAIN,
                    (states[0][:, places], states[1][:, dofs], states[2][:, dofs], states[3]),
                )
    for i in range(model.nu):
        for j in range(i):
            order = np.arange(model.nu)
            order[[i, j]] = j, i
            yield Reading(
                f"columns '{controls[j]}' and '{controls[i]}' seem to be exchanged",
                np.flatnonzero(moments[i] - moments[j]),
                SWAP_GAIN,
                (*states[:3], states[3][:, order]),
            )
    for j in range(model.njnt):
        if j not in single:
            first = q[j] + (3 if j in free else 0)
            other = recording.qpos.copy()
            other[:, first : first + 4] = np.roll(other[:, first : first + 4], 1, axis=1)
            turned = inverse_dynamics.smooth(model, replace(recording, qpos=other), CENTRES, half)[
                1:
            ]
            yield Reading(
                f"column 'qpos:{names[j]}:{first - q[j]}' and the next three seem to be x y z w; "
                "order is w x y z",
                list(range(v[j], v[j] + (6 if j in free else 3))),
                SWAP_GAIN,
                turned,
            )


def _moments(model):
    """(nu, nv) moment arms in the reference pose of the actuator behind each control; small ones
    count as none."""
    data, out = mujoco.MjData(model), np.zeros((model.nu, model.nv))
    mujoco.mj_forward(model, data)
    for a in range(model.nactuator):
        row = model.actuator_outadr[a]
        start, width = data.moment_rowadr[row], data.moment_rownnz[row]
        for u in range(
            model.actuator_ctrladr[a], model.actuator_ctrladr[a] + model.actuator_ctrlnum[a]
        ):
            out[u, data.moment_colind[start : start + width]] = data.actuator_moment[
                start : start + width
            ]
    return np.where(np.abs(out) > 1e-9, out, 0.0)


def _scaled(model, states, factors):
    """The states with the positions of joints times {joint: factor}; of a free joint, those of its
    origin."""
    qpos, qvel, qacc, ctrl = (x.copy() for x in states)
    for j, factor in factors.items():
        for x, first in (
            (qpos, model.jnt_qposadr[j]),
            (qvel, model.jnt_dofadr[j]),
            (qacc, model.jnt_dofadr[j]),
        ):
            x[:, first : first + (3 if model.jnt_type[j] == FREE else 1)] *= factor
    return qpos, qvel, qacc, ctrl


def _imbalance(model, qpos, qvel, qacc, ctrl):
    """(nv,) rms(M a - F) / (rms(M a) + rms(F)) over the rows without contact; nan where those are
    few."""
    data = mujoco.MjData(model)
    inertial, force, product = [], [], np.zeros(model.nv)
    for q, v, a, u in zip(qpos, qvel, qacc, ctrl):
        data.qpos[:], data.qvel[:], data.ctrl[:] = q, v, u
        mujoco.mj_forward(model, data)
        if data.ncon:
            continue
        mujoco.mj_mulM(model, data, product, a)
        inertial.append(product.copy())
        force.append(data.qfrc_actuator + data.qfrc_passive - data.qfrc_bias)
    if len(inertial) < max(
        20, 0.8 * len(qpos)
    ):  # contacts act: nothing can be said, and every comparison with nan is false
        return np.full(model.nv, np.nan)
    inertial, force = np.array(inertial), np.array(force)

    def rms(x):
        return np.sqrt((x * x).mean(axis=0))

    return rms(inertial - force) / (rms(inertial) + rms(force) + 1e-300)
