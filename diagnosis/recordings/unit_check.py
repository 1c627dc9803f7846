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
# s, of the smoothing: for fast motion, and for slow motion under much noise
HALVES = (inverse_dynamics.HALF, 4 * inverse_dynamics.HALF)
# imbalance (0: the law holds, 1: one side dwarfs the other) above which a reading can be wrong;
# missing friction alone reaches 0.7, but no wrong reading betters that so
UNLIKE = 0.35
# the right reading divides it by so much, and leaves it or makes it small in the other dofs
UNIT_GAIN, SWAP_GAIN, LIKE = 2, 3, 0.1
# rad or m: who records a joint in degrees or mm moves it farther; one that sticks would look like
# one in degrees
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
    unlike = np.ones(model.nv, bool)  # smoothed too much, a fast servo seems to turn round
    for half in HALVES:
        states = inverse_dynamics.smooth(model, recording, CENTRES, half)[1:]
        if len(states[0]) < 20:
            continue
        now = _imbalance(model, *states)
        unlike &= ~(now <= UNLIKE)
        doubted = unlike & (now > UNLIKE)
        if not doubted.any():
            continue
        for reading in _readings(recording, model, states, half):
            before, wrong = now[reading.dofs], doubted[reading.dofs]
            if wrong.any():
                bound = np.where(wrong, before / reading.gain, np.maximum(before, LIKE))
                if (_imbalance(model, *reading.states)[reading.dofs] < bound).all():
                    return reading.message
    return None


def _readings(recording, model, states, half):
    """Every Reading worth a try, one after the other."""
    yield from _units(model, states)
    yield from _turned_positions(model, states)
    yield from _scaled_controls(model, states)
    yield from _turned_controls(model, states)
    yield from _exchanged_positions(model, states)
    yield from _exchanged_controls(model, states)
    yield from _quaternions(recording, model, half)


def _names(model):
    """What columns call each joint."""
    return [model.joint(j).name or str(j) for j in range(model.njnt)]


def _single(model):
    """Joints of one coordinate."""
    return [j for j in range(model.njnt) if model.jnt_type[j] in (HINGE, SLIDE)]


def _units(model, states):
    """Degrees, millimetres and milliseconds."""
    names, single = _names(model), _single(model)
    q, v = model.jnt_qposadr, model.jnt_dofadr
    degrees, mm = ("degrees; convert to rad", np.pi / 180), ("mm; convert to m", 1e-3)
    units = {j: degrees if model.jnt_type[j] == HINGE else mm for j in single}
    wide = [j for j in single if np.ptp(states[0][:, q[j]]) > WIDE]
    for j in wide:
        unit, factor = units[j]
        message = f"column 'qpos:{names[j]}' seems to be in {unit}"
        yield Reading(message, [v[j]], UNIT_GAIN, _scaled(model, states, {j: factor}))
    if len(single) > 1 and wide:
        told = " or ".join(sorted({unit for unit, _ in units.values()}))
        message = f"the positions seem to be in {told}"
        factors = {j: factor for j, (_, factor) in units.items()}
        yield Reading(message, [v[j] for j in single], UNIT_GAIN, _scaled(model, states, factors))
    for j in np.flatnonzero(model.jnt_type == FREE):
        message = f"columns 'qpos:{names[j]}:0' to ':2' seem to be in mm; convert to m"
        dofs = list(range(v[j], v[j] + 3))
        yield Reading(message, dofs, UNIT_GAIN, _scaled(model, states, {j: 1e-3}))
    seconds = (states[0], states[1] * 1e3, states[2] * 1e6, states[3])
    message = "column 'time' seems to be in ms; convert to s"
    yield Reading(message, list(range(model.nv)), UNIT_GAIN, seconds)


def _turned_positions(model, states):
    """Joints that count the other way, or from another zero."""
    names, single = _names(model), _single(model)
    q, v = model.jnt_qposadr, model.jnt_dofadr
    for j in single:
        message = f"column 'qpos:{names[j]}' seems to have the wrong sign; turn it round"
        yield Reading(message, [v[j]], SWAP_GAIN, _scaled(model, states, {j: -1.0}))
    for j in single:
        for degrees in (180, 90, -90) if model.jnt_type[j] == HINGE else ():
            turned = states[0].copy()
            turned[:, q[j]] += np.deg2rad(degrees)
            message = (
                f"column 'qpos:{names[j]}' seems to count from another zero than the model; "
                f"add {degrees} degrees ({np.deg2rad(degrees):.4f}), or set the joint's ref"
            )
            yield Reading(message, [v[j]], SWAP_GAIN, (turned, *states[1:]))


def _scaled_controls(model, states):
    """Controls in percent, in thousandths, or as forces behind the gears."""
    behind = np.repeat(np.arange(model.nactuator), model.actuator_ctrlnum)
    gears = np.abs(model.actuator_gear[behind]).max(axis=1, initial=1e-9)
    driven = np.flatnonzero(_moments(model).any(axis=0))
    for divisor, what in (  # the smaller first: nearly no control fits well, too
        (gears, "forces in the joints; divide each by its actuator's gear"),
        (100.0, "100 times too large for the model (percent?)"),
        (1000.0, "1000 times too large for the model"),
    ):
        if np.any(divisor != 1.0):
            message = f"the 'ctrl:' columns seem to be {what}"
            yield Reading(message, driven, SWAP_GAIN, (*states[:3], states[3] / divisor))


def _turned_controls(model, states):
    """Actuators that push the other way, alone or together with the joint's angle."""
    names, controls = _names(model), _controls(model)
    signs = 1.0 - 2.0 * np.eye(model.nu)
    driven = [np.flatnonzero(moment) for moment in _moments(model)]
    for a, column in enumerate(controls):
        message = f"column '{column}' seems to have the wrong sign; turn it round"
        yield Reading(message, driven[a], SWAP_GAIN, (*states[:3], states[3] * signs[a]))
    for a, column in enumerate(controls):
        for j in _single(model):
            if driven[a].tolist() == [model.jnt_dofadr[j]]:
                message = (
                    f"columns 'qpos:{names[j]}' and '{column}' do not fit the signs of the others; "
                    "turn both round, or that joint's axis in the model"
                )
                turned = (*_scaled(model, states, {j: -1.0})[:3], states[3] * signs[a])
                yield Reading(message, driven[a], SWAP_GAIN, turned)


def _controls(model):
    """The columns of controls."""
    return [column for column in columns_of(model) if column.startswith("ctrl:")]


def _exchanged_positions(model, states):
    """Two joints of a kind under each other's name."""
    names, single = _names(model), _single(model)
    q, v = model.jnt_qposadr, model.jnt_dofadr
    for k, i in enumerate(single):
        for j in single[:k]:
            if model.jnt_type[i] == model.jnt_type[j]:
                places, dofs = np.arange(model.nq), np.arange(model.nv)
                places[[q[i], q[j]]], dofs[[v[i], v[j]]] = places[[q[j], q[i]]], dofs[[v[j], v[i]]]
                qpos, qvel, qacc, ctrl = states
                message = f"columns 'qpos:{names[j]}' and 'qpos:{names[i]}' seem to be exchanged"
                exchanged = (qpos[:, places], qvel[:, dofs], qacc[:, dofs], ctrl)
                yield Reading(message, [v[i], v[j]], SWAP_GAIN, exchanged)


def _exchanged_controls(model, states):
    """Two controls under each other's name."""
    controls, moments = _controls(model), _moments(model)
    for i in range(model.nu):
        for j in range(i):
            order = np.arange(model.nu)
            order[[i, j]] = j, i
            message = f"columns '{controls[j]}' and '{controls[i]}' seem to be exchanged"
            dofs = np.flatnonzero(moments[i] - moments[j])
            yield Reading(message, dofs, SWAP_GAIN, (*states[:3], states[3][:, order]))


def _quaternions(recording, model, half):
    """Orientations that begin with x."""
    names = _names(model)
    for j in sorted(set(range(model.njnt)) - set(_single(model))):
        free = model.jnt_type[j] == FREE
        at = 3 if free else 0
        rolled = recording.qpos.copy()
        turn = slice(model.jnt_qposadr[j] + at, model.jnt_qposadr[j] + at + 4)
        rolled[:, turn] = np.roll(rolled[:, turn], 1, axis=1)
        rolled = replace(recording, qpos=rolled)
        message = (
            f"column 'qpos:{names[j]}:{at}' and the next three seem to be x y z w; order is w x y z"
        )
        first = model.jnt_dofadr[j]
        dofs = list(range(first, first + (6 if free else 3)))
        states = inverse_dynamics.smooth(model, rolled, CENTRES, half)[1:]
        yield Reading(message, dofs, SWAP_GAIN, states)


def _moments(model):
    """(nu, nv) moment arms in the reference pose of the actuator behind each control; small ones
    count as none."""
    data, out = mujoco.MjData(model), np.zeros((model.nu, model.nv))
    mujoco.mj_forward(model, data)
    for a in range(model.nactuator):
        row = model.actuator_outadr[a]
        start, width = data.moment_rowadr[row], data.moment_rownnz[row]
        moment = slice(start, start + width)
        first = model.actuator_ctrladr[a]
        for u in range(first, first + model.actuator_ctrlnum[a]):
            out[u, data.moment_colind[moment]] = data.actuator_moment[moment]
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
    # where contacts act nothing can be said, and every comparison with nan is false
    if len(inertial) < max(20, 0.8 * len(qpos)):
        return np.full(model.nv, np.nan)
    inertial, force = np.array(inertial), np.array(force)

    def rms(x):
        return np.sqrt((x * x).mean(axis=0))

    return rms(inertial - force) / (rms(inertial) + rms(force) + 1e-300)
