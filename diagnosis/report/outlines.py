"""The shape of a mechanism on paper: geoms of a model in parallel projection as flat outlines.

    axes, towards = view(model, qpos)
    for geom, outline, depth in outlines(model, qpos, axes, towards): ...

A planar mechanism is seen along its hinge axes, anything else from the side and a little above.
No OpenGL is needed.
"""

import mujoco
import numpy as np
from scipy.spatial import ConvexHull, QhullError

GEOM, JOINT = mujoco.mjtGeom, mujoco.mjtJoint
_TURN = np.linspace(0, 2 * np.pi, 24, endpoint=False)
CIRCLE = np.stack([np.cos(_TURN), np.sin(_TURN)], axis=1)
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
AZIMUTH, ELEVATION = np.deg2rad(-60), np.deg2rad(20)  # from where spatial mechanisms are seen


def posed(model: mujoco.MjModel, qpos: np.ndarray) -> mujoco.MjData:
    """MjData with the kinematics of a pose (nq,)."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return data


def view(model: mujoco.MjModel, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(2, 3) world directions of right and up on paper, and (3,) the one towards the viewer."""
    data = posed(model, qpos)
    hinges = data.xaxis[model.jnt_type == int(JOINT.mjJNT_HINGE)]
    slides = data.xaxis[model.jnt_type == int(JOINT.mjJNT_SLIDE)]
    normal = hinges[0] if len(hinges) else np.array([0.0, 1.0, 0.0])
    planar = (
        model.nq == model.nv  # no free or ball joint
        and (np.abs(hinges @ normal) > 0.98).all()
        and (np.abs(slides @ normal) < 0.05).all()
    )
    if planar:  # look from -y, +x or +z, so that x (or y) points right and z (or y) up
        flip = -1 if np.argmax(np.abs(normal)) == 1 else 1
        towards = normal * flip * (1 if max(normal, key=abs) > 0 else -1)
    else:
        flat = np.cos(ELEVATION)
        towards = np.array(
            [flat * np.cos(AZIMUTH), flat * np.sin(AZIMUTH), np.sin(ELEVATION)],
        )
    up = np.array([0.0, 0, 1]) if abs(towards[2]) < 0.9 else np.array([0.0, 1, 0])
    right = np.cross(up, towards)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(towards, right)]), towards


def outlines(
    model: mujoco.MjModel, qpos: np.ndarray, axes: np.ndarray, towards: np.ndarray
) -> list[tuple[int, np.ndarray, float]]:
    """[(geom id, (n, 2) outline, depth)] of every visible geom that is not a plane; far ones
    first."""
    data, found = posed(model, qpos), []
    for g in range(model.ngeom):
        flat = GEOM(model.geom_type[g]) in (GEOM.mjGEOM_PLANE, GEOM.mjGEOM_HFIELD)
        hidden = model.geom_rgba[g, 3] == 0 and model.geom_matid[g] < 0
        if not flat and not hidden:
            found.append((g, _outline(model, data, g, axes), data.geom_xpos[g] @ towards))
    return sorted(found, key=lambda item: item[2])


def _outline(model, data, g, axes):
    """(n, 2) outline of one geom."""
    kind, size, centre = GEOM(model.geom_type[g]), model.geom_size[g], data.geom_xpos[g]
    frame = data.geom_xmat[g].reshape(3, 3)
    ring = size[0] * CIRCLE @ axes  # the outline of a sphere, whatever the view
    if kind == GEOM.mjGEOM_ELLIPSOID:  # where its normal is square to the view
        u, s, _ = np.linalg.svd(axes @ (frame * size), full_matrices=False)
        return axes @ centre + CIRCLE * s @ u.T
    if kind == GEOM.mjGEOM_SPHERE:
        points = centre + ring
    elif kind == GEOM.mjGEOM_CAPSULE:
        points = np.concatenate([centre + ring + e * size[1] * frame[:, 2] for e in (-1, 1)])
    elif kind == GEOM.mjGEOM_CYLINDER:
        ends = [
            np.column_stack([size[0] * CIRCLE, np.full(len(CIRCLE), e * size[1])]) for e in (-1, 1)
        ]
        points = centre + np.concatenate(ends) @ frame.T
    elif kind == GEOM.mjGEOM_MESH:
        mesh = model.geom_dataid[g]
        first = model.mesh_vertadr[mesh]
        points = centre + model.mesh_vert[first : first + model.mesh_vertnum[mesh]] @ frame.T
    else:  # a box, or anything else by its half sizes
        points = centre + CORNERS * size @ frame.T
    return hull(points @ axes.T)


def hull(points: np.ndarray) -> np.ndarray:
    """(n, 2) points to the corners of their convex hull, anticlockwise; of a line its two ends."""
    points = np.unique(np.round(points, 9), axis=0)
    if len(points) < 3:
        return points
    try:
        return points[ConvexHull(points).vertices]
    except QhullError:  # they lie on a line, along which `unique` has sorted them
        return points[[0, -1]]


class Paper:
    """World coordinates on paper to SVG pixels: fits points (n, 2) into `width` and at most
    `height`, with a margin."""

    def __init__(self, points, width, height, margin):
        low, high = points.min(axis=0), points.max(axis=0)
        size = np.maximum(high - low, 1e-6 + 0.02 * (high - low).max())
        self.scale = min((width - 2 * margin) / size[0], (height - 2 * margin) / size[1])
        self.width = width
        self.height = int(min(height, max(0.45 * height, self.scale * size[1] + 2 * margin)))
        self.middle, self.centre = (low + high) / 2, np.array([width, self.height]) / 2

    def __call__(self, points):
        """(..., 2) pixels, y downward."""
        return self.centre + (np.asarray(points) - self.middle) * self.scale * [1, -1]
