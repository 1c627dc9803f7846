"""Where something touches, as far as positions are known: no smooth map tells of a force there.

free = ~touching(model, qpos, reach)        # (N,)
"""

from copy import copy

import mujoco
import numpy as np

from diagnosis.effects.base import HINGE, SLIDE
from diagnosis.effects.environment import collides


def touching(model, qpos, reach):
    """Rows (N,) of positions (N, nq) at or after which something touches, or a joint lies at the
    end of its travel. reach (nv,) or (N, nv): how far each coordinate may be off."""
    reach = np.broadcast_to(reach, (len(qpos), model.nv))
    ends = (model.jnt_limited != 0) & np.isin(model.jnt_type, (HINGE, SLIDE))
    at, off = qpos[:, model.jnt_qposadr[ends]], reach[:, model.jnt_dofadr[ends]]
    low, high = model.jnt_range[ends].T
    touch = ((at < low + off) | (at > high - off)).any(1)
    if collides(model):
        touch |= _near(model, qpos, reach)
    return touch | np.append(touch[1:], False)


def _near(model, qpos, reach):
    """Rows (N,) in which a contact may be made, as far as its distance is known."""
    wide = copy(model)  # which finds contacts before they are made
    most = np.linalg.norm(reach, axis=1).max(initial=0.0) * max(model.stat.extent, 1.0)
    wide.geom_margin[:] += most / 2  # those of two that touch are summed
    wide.flex_margin[:] += most / 2
    wide.pair_margin[:] += most
    data, out = mujoco.MjData(wide), np.zeros(len(qpos), bool)
    for row, (q, off) in enumerate(zip(qpos, reach)):
        data.qpos[:] = q
        mujoco.mj_kinematics(wide, data)
        mujoco.mj_comPos(wide, data)
        mujoco.mj_collision(wide, data)
        gaps = ((c, c.dist - c.includemargin + most) for c in data.contact)
        out[row] = any(gap < _off(model, data, c, off) for c, gap in gaps)
    return out


def _off(model, data, contact, reach):
    """How far a contact's distance, m, may be off where coordinates are by reach (nv,),
    independently; 0 of flexible bodies."""
    if min(contact.geom) < 0:
        return 0.0
    slope, jacobian = np.zeros(model.nv), np.empty((3, model.nv))
    for sign, body in zip((-1.0, 1.0), model.geom_bodyid[contact.geom]):
        mujoco.mj_jac(model, data, jacobian, None, contact.pos, body)
        slope += sign * contact.frame[:3] @ jacobian
    return float(np.linalg.norm(slope * reach))
