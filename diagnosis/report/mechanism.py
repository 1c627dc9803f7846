"""A mechanism drawn from its model: geoms in parallel projection as flat outlines, joints as marks, no OpenGL.

A planar mechanism is seen along its hinge axes, anything else from the side and a little above.
"""

import html
import json

import mujoco
import numpy as np

GEOM, JOINT = mujoco.mjtGeom, mujoco.mjtJoint
CIRCLE = np.stack(
    [
        np.cos(np.linspace(0, 2 * np.pi, 24, endpoint=False)),
        np.sin(np.linspace(0, 2 * np.pi, 24, endpoint=False)),
    ],
    axis=1,
)
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)


def view(model, qpos):
    """(2, 3) world directions of right and up on paper, and (3,) the one towards the viewer."""
    data = _posed(model, qpos)
    hinges = data.xaxis[model.jnt_type == int(JOINT.mjJNT_HINGE)]
    slides = data.xaxis[model.jnt_type == int(JOINT.mjJNT_SLIDE)]
    free = model.nq != model.nv
    normal = hinges[0] if len(hinges) else np.array([0.0, 1.0, 0.0])
    planar = (
        not free
        and (np.abs(hinges @ normal) > 0.98).all()
        and (np.abs(slides @ normal) < 0.05).all()
    )
    if not planar:
        azimuth, elevation = np.deg2rad(-60), np.deg2rad(20)
        towards = np.array(
            [
                np.cos(elevation) * np.cos(azimuth),
                np.cos(elevation) * np.sin(azimuth),
                np.sin(elevation),
            ]
        )
    else:  # look from -y, +x or +z, so that x (or y) points right and z (or y) up
        towards = (
            normal
            * (1 if max(normal, key=abs) > 0 else -1)
            * (-1 if np.argmax(np.abs(normal)) == 1 else 1)
        )
    up = np.array([0.0, 0, 1]) if abs(towards[2]) < 0.9 else np.array([0.0, 1, 0])
    right = np.cross(up, towards)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(towards, right)]), towards


def _posed(model, qpos):
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return data


def outlines(model, qpos, axes, towards):
    """[(geom id, (n, 2) outline, depth)] of every visible geom that is not a plane; far ones first."""
    data = _posed(model, qpos)
    found = []
    for g in range(model.ngeom):
        kind, size, centre = GEOM(model.geom_type[g]), model.geom_size[g], data.geom_xpos[g]
        frame = data.geom_xmat[g].reshape(3, 3)
        if (
            kind in (GEOM.mjGEOM_PLANE, GEOM.mjGEOM_HFIELD)
            or model.geom_rgba[g, 3] == 0
            and model.geom_matid[g] < 0
        ):
            continue
        ring = size[0] * CIRCLE @ axes  # the outline of a sphere, whatever the view
        if kind == GEOM.mjGEOM_SPHERE:
            points = centre + ring
        elif kind == GEOM.mjGEOM_CAPSULE:
            points = np.concatenate(
                [centre + ring + end * size[1] * frame[:, 2] for end in (-1, 1)]
            )
        elif kind == GEOM.mjGEOM_CYLINDER:
            flat = np.concatenate(
                [np.column_stack([size[0] * CIRCLE, np.full(24, end * size[1])]) for end in (-1, 1)]
            )
            points = centre + flat @ frame.T
        elif kind == GEOM.mjGEOM_ELLIPSOID:
            body = (
                frame * size
            )  # columns: half axes; the outline is where the normal is square to the view
            square = axes @ body
            u, s, _ = np.linalg.svd(square, full_matrices=False)
            found.append((g, axes @ centre + CIRCLE * s @ u.T, centre @ towards))
            continue
        elif kind == GEOM.mjGEOM_MESH:
            mesh = model.geom_dataid[g]
            start = model.mesh_vertadr[mesh]
            points = centre + model.mesh_vert[start : start + model.mesh_vertnum[mesh]] @ frame.T
        else:  # a box, or anything else by its half sizes
            points = centre + CORNERS * size @ frame.T
        found.append((g, hull(points @ axes.T), centre @ towards))
    return sorted(found, key=lambda item: item[2])


def hull(points):
    """(n, 2) points to their convex hull, anticlockwise (Andrew's monotone chain)."""
    points = sorted(set(map(tuple, np.round(points, 9))))
    if len(points) < 3:
        return np.array(points)
    chains = []
    for ordered in (points, points[::-1]):
        chain = []
        for p in ordered:
            while (
                len(chain) > 1
                and (
                    (chain[-1][0] - chain[-2][0]) * (p[1] - chain[-2][1])
                    - (chain[-1][1] - chain[-2][1]) * (p[0] - chain[-2][0])
                )
                <= 0
            ):
                chain.pop()
            chain.append(p)
        chains += chain[:-1]
    return np.array(chains)


def marked(model, place):
    """(geom ids, point function, label) of a finding's place: what to colour and where to point."""
    kind, name = place["kind"], place["name"]
    joint = None
    if kind == "world":
        return [], None
    if kind == "joint":
        joint = _id(model.joint, name)
    elif kind == "actuator":
        actuator = _id(model.actuator, name)
        if actuator is not None:
            joint, site = _end(model, actuator)
            if site is not None:
                return [], lambda data: data.site_xpos[site]
    elif kind == "sensor":
        sensor = _id(model.sensor, name)
        if sensor is not None and model.sensor_objtype[sensor] == mujoco.mjtObj.mjOBJ_JOINT:
            joint = int(model.sensor_objid[sensor])
    elif kind == "geom":
        geom = _id(model.geom, name)
        if geom is None:
            return [], None
        if model.geom_type[geom] == GEOM.mjGEOM_PLANE:
            return [geom], lambda data: _under(data, geom)
        return [geom], lambda data: data.geom_xpos[geom]
    elif kind == "body":
        body = _id(model.body, name)
        if body is not None:
            return list(np.flatnonzero(model.geom_bodyid == body)), lambda data: data.xipos[body]
    return [], (None if joint is None else lambda data: data.xanchor[joint])


def _end(model, actuator):
    """(joint id, None) or (None, site id) that an actuator pulls at, of a tendon the last; (None, None) for any other."""
    kind, i = (
        mujoco.mjtTrn(model.actuator_trntype[actuator]),
        int(model.actuator_trnid[actuator, 0]),
    )
    joint, site = kind == mujoco.mjtTrn.mjTRN_JOINT, kind == mujoco.mjtTrn.mjTRN_SITE
    if kind == mujoco.mjtTrn.mjTRN_TENDON:
        last = model.tendon_adr[i] + model.tendon_num[i] - 1
        wrap, i = mujoco.mjtWrap(model.wrap_type[last]), int(model.wrap_objid[last])
        joint, site = wrap == mujoco.mjtWrap.mjWRAP_JOINT, wrap == mujoco.mjtWrap.mjWRAP_SITE
    return (i if joint else None), (i if site else None)


def _id(named, name):
    """Index of a named (or, where it has no name, numbered) part of a model; None where there is none."""
    try:
        return named(name).id
    except KeyError:
        try:
            return named(int(name)).id
        except (ValueError, KeyError, IndexError):
            return None


class Paper:
    """World coordinates on paper to SVG pixels: fits points (n, 2) into `width` and at most `height`, with a margin."""

    def __init__(self, points, width, height, margin):
        low, high = points.min(axis=0), points.max(axis=0)
        size = np.maximum(high - low, 1e-6 + 0.02 * (high - low).max())
        self.scale = min((width - 2 * margin) / size[0], (height - 2 * margin) / size[1])
        self.width, self.height = (
            width,
            int(min(height, max(0.45 * height, self.scale * size[1] + 2 * margin))),
        )
        self.middle, self.centre = (low + high) / 2, np.array([width, self.height]) / 2

    def __call__(self, points):
        return self.centre + (np.asarray(points) - self.middle) * self.scale * [1, -1]


def _path(points):
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points) + "Z"


def mechanism(model, poses, places, labels, width=380, height=300):
    """SVG of the model in poses[0] (other poses faintly behind), the places of the findings coloured and labelled.

    poses: list of (nq,). places: the findings' places; labels: a few words for each.
    """
    axes, towards = view(model, poses[0])
    drawn = [outlines(model, qpos, axes, towards) for qpos in poses]
    data = _posed(model, poses[0])
    anchors = data.xanchor @ axes.T if model.njnt else np.zeros((0, 2))
    first = np.concatenate(
        [points for _, points, _ in drawn[0]] + [anchors, data.xipos[1:] @ axes.T]
    )
    size = np.ptp(first, axis=0).max()
    inside, ghosts = (
        first,
        [],
    )  # the other poses, unless they are so far apart that the first would shrink to a dot
    for ghost in drawn[1:]:
        wider = np.concatenate([inside] + [points for _, points, _ in ghost])
        if np.ptp(wider, axis=0).max() < 3 * size:
            inside, ghosts = wider, [*ghosts, ghost]
    paper = Paper(inside, width, height, 40)
    height = paper.height
    coloured, points = set(), []
    for place in places:
        geoms, where = marked(model, place)
        coloured.update(int(g) for g in geoms)
        points.append(None if where is None else paper(where(data) @ axes.T))
    parts = [
        f'<svg viewBox="0 0 {width} {height}" role="img" class="mechanism" aria-label="drawing of the mechanism'
        f'{"; marked: " + html.escape(", ".join(labels), quote=True) if labels else ""}">'
    ]
    parts += _ground(model, data, axes, towards, paper, width, coloured)
    for ghost in ghosts:
        parts += [
            f'<path class="part ghost" d="{_path(paper(points_))}"/>' for _, points_, _ in ghost
        ]
    parts += _links(model, data, axes, paper)
    for g, outline, _ in drawn[0]:
        parts.append(
            f'<path class="part{" bad" if g in coloured else ""}" d="{_path(paper(outline))}"/>'
        )
    for j in range(model.njnt):
        parts.append(_joint(model, data, j, axes, paper))
    used = []
    for label, point in zip(labels, points):
        if point is not None:
            parts.append(
                f'<circle class="badmark" cx="{point[0]:.1f}" cy="{point[1]:.1f}" r="11"/>'
            )
        x, y = (0, 34) if point is None else point  # what is wrong everywhere stands in the corner
        right = x < width * 0.5
        ty = float(np.clip(y - 18, 16, height - 10))
        while any(abs(ty - other) < 15 for other in used):
            ty = ty + 15 if ty + 15 < height - 8 else 16
        used.append(ty)
        room = 6.3 * len(label)
        tx = min(x + 20, width - room - 4) if right else max(x - 20, room + 4)
        tx = max(4, tx) if right else min(width - 4, tx)
        if point is not None:
            side = 1 if right else -1
            parts.append(
                f'<path class="leader" d="M{x + 8 * side:.1f} {y - 8:.1f}L{tx - 3 * side:.1f} {ty - 4:.1f}"/>'
            )
        anchor = "start" if right else "end"
        parts.append(
            f'<text class="badlabel" x="{tx:.1f}" y="{ty:.1f}" text-anchor="{anchor}">{html.escape(label)}</text>'
        )
    return "".join(parts) + "</svg>"


def _ground(model, data, axes, towards, paper, width, coloured):
    """Planes: a line where seen edge-on, else a sheet."""
    parts = []
    for g in np.flatnonzero(model.geom_type == int(GEOM.mjGEOM_PLANE)):
        frame, centre = data.geom_xmat[g].reshape(3, 3), data.geom_xpos[g]
        bad = " bad" if int(g) in coloured else ""
        if abs(frame[:, 2] @ towards) < 0.1:
            along = axes @ np.cross(frame[:, 2], towards)
            a, b = (
                paper(axes @ centre - 1e3 / paper.scale * along),
                paper(axes @ centre + 1e3 / paper.scale * along),
            )
            parts.append(
                f'<path class="ground{bad}" d="M{a[0]:.1f} {a[1]:.1f}L{b[0]:.1f} {b[1]:.1f}"/>'
            )
        elif abs(frame[:, 2] @ towards) < 0.95:  # face-on it would only be a background
            reach, middle = 0.4 * width / paper.scale, _under(data, g)
            corners = [
                middle + reach * (x * frame[:, 0] + y * frame[:, 1])
                for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))
            ]
            parts.append(
                f'<path class="sheet{bad}" d="{_path(paper(np.array(corners) @ axes.T))}"/>'
            )
    return parts


def _under(data, plane):
    """(3,) the point of a plane beneath the mechanism: its own centre can be far away."""
    normal, middle = data.geom_xmat[plane].reshape(3, 3)[:, 2], data.xipos[1:].mean(axis=0)
    return middle - ((middle - data.geom_xpos[plane]) @ normal) * normal


def _links(model, data, axes, paper):
    """Bodies without geoms: a line from the parent's origin, and a dot for the centre of mass."""
    parts = []
    for b in range(1, model.nbody):
        if model.body_geomnum[b]:
            continue
        here, mass = paper(axes @ data.xpos[b]), paper(axes @ data.xipos[b])
        parts.append(
            f'<path class="link" d="M{here[0]:.1f} {here[1]:.1f}L{mass[0]:.1f} {mass[1]:.1f}"/>'
            f'<circle class="part" cx="{mass[0]:.1f}" cy="{mass[1]:.1f}" r="4"/>'
        )
        parent = model.body_parentid[b]
        if parent:
            there = paper(axes @ data.xpos[parent])
            parts.append(
                f'<path class="link" d="M{there[0]:.1f} {there[1]:.1f}L{here[0]:.1f} {here[1]:.1f}"/>'
            )
    return parts


def _joint(model, data, j, axes, paper):
    """A hinge as a small ring, a slide as a double arrow along its axis."""
    x, y = paper(axes @ data.xanchor[j])
    kind = JOINT(model.jnt_type[j])
    if kind in (JOINT.mjJNT_HINGE, JOINT.mjJNT_BALL):
        return f'<circle class="hinge" cx="{x:.1f}" cy="{y:.1f}" r="3.5"/>'
    if kind == JOINT.mjJNT_SLIDE:
        direction = axes @ data.xaxis[j] * [1, -1]
        length = np.linalg.norm(direction)
        if length < 0.2:
            return ""
        dx, dy = 26 * direction / length
        tips = "".join(
            f"M{x + end * dx:.1f} {y + end * dy:.1f}l{-end * (0.25 * dx + side * 0.15 * dy):.1f} "
            f"{-end * (0.25 * dy - side * 0.15 * dx):.1f}"
            for end in (1, -1)
            for side in (1, -1)
        )
        return (
            f'<path class="slide" d="M{x - dx:.1f} {y - dy:.1f}L{x + dx:.1f} {y + dy:.1f}{tips}"/>'
        )
    return ""


def animation(model, motions, seconds, width=380, height=300):
    """HTML of an animation: {"measured": (F, nq), "nominal": ..., "corrected": ...} drawn over each other, F frames that
    last `seconds`. The first frame stands without a script; the button and the slider need the page's script."""
    frames = {look: np.asarray(qpos) for look, qpos in motions.items()}
    axes, towards = view(model, next(iter(frames.values()))[0])
    drawn = {
        look: [outlines(model, qpos, axes, towards) for qpos in motion]
        for look, motion in frames.items()
    }
    points = [outline for motion in drawn.values() for frame in motion for _, outline, _ in frame]
    if not points:
        return ""
    everything = np.concatenate(points)
    recorded = np.concatenate([outline for frame in drawn["measured"] for _, outline, _ in frame])
    low, high = recorded.min(axis=0), recorded.max(axis=0)
    reach = (
        0.6 * (high - low).max()
    )  # a simulation that runs away leaves the picture instead of shrinking it
    paper = Paper(np.clip(everything, low - reach, high + reach), width, height, 20)
    height = paper.height
    paths = {
        look: [
            "".join(
                "M" + "L".join(f"{x:.0f} {y:.0f}" for x, y in paper(outline)) + "Z"
                for _, outline, _ in frame
            )
            for frame in motion
        ]
        for look, motion in drawn.items()
    }
    data = _posed(model, frames["measured"][0])
    ground = "".join(_ground(model, data, axes, towards, paper, width, set()))
    layers = "".join(
        f'<path class="{look} layer" d="{motion[0]}"/>' for look, motion in paths.items()
    )
    return (
        f'<figure class="animation" data-seconds="{seconds:.3f}"><svg viewBox="0 0 {width} {height}" role="img" '
        f'aria-label="recorded, nominal and corrected motion over each other">{ground}{layers}</svg>'
        '<div class="controls"><button type="button">pause</button><input type="range" min="0" '
        f'max="{len(frames["measured"]) - 1}" value="0" aria-label="moment"></div>'
        f'<script type="application/json">{json.dumps(paths)}</script></figure>'
    )
