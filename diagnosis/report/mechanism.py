"""Pictures of a mechanism: still, with the places of findings marked, and moving.

    svg = mechanism(model, poses, places, labels)
    figure = animation(model, {"measured": qpos, "nominal": qpos}, seconds)

What is drawn is a list of shapes; templates/drawing.svg turns them into markup.
"""

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from diagnosis.report.outlines import GEOM, JOINT, Paper, outlines, posed, view
from diagnosis.report.page import path, render

MARGIN, LINE = 40, 15  # pixels around the drawing, and from one label to the next


@dataclass(frozen=True)
class Path:
    """An SVG path; look: its classes."""

    look: str
    d: str


@dataclass(frozen=True)
class Circle:
    """A circle about (x, y) in pixels."""

    look: str
    x: float
    y: float
    r: float


@dataclass(frozen=True)
class Words:
    """A line of text; anchor: start or end."""

    look: str
    x: float
    y: float
    anchor: str
    words: str


def mechanism(
    model: mujoco.MjModel,
    poses: list[np.ndarray],
    places: list[dict],
    labels: list[str],
    width: int = 380,
    height: int = 300,
) -> str:
    """SVG of the model in poses[0] (other poses faintly behind), the places of the findings
    coloured and labelled.

    poses: list of (nq,). places: the findings' places; labels: a few words for each.
    """
    axes, towards = view(model, poses[0])
    first, *others = (outlines(model, qpos, axes, towards) for qpos in poses)
    others = [[o for _, o, _ in other] for other in others]
    data = posed(model, poses[0])
    anchors = data.xanchor @ axes.T if model.njnt else np.zeros((0, 2))
    inside, ghosts = _near([*(o for _, o, _ in first), anchors, data.xipos[1:] @ axes.T], others)
    paper = Paper(inside, width, height, MARGIN)
    coloured, points = set(), []
    for place in places:
        bad, where = marked(model, place)
        coloured.update(int(g) for g in bad)
        points.append(None if where is None else paper(where(data) @ axes.T))
    shapes = _ground(model, data, axes, towards, paper, coloured)
    shapes += [Path("part ghost", path(paper(o), True)) for ghost in ghosts for o in ghost]
    shapes += _links(model, data, axes, paper)
    for g, outline, _ in first:
        shapes.append(Path(f"part{' bad' * (g in coloured)}", path(paper(outline), True)))
    for j in range(model.njnt):
        shapes += _joint(model, data, j, axes, paper)
    shapes += _labelled(labels, points, paper)
    label = "drawing of the mechanism" + (f"; marked: {', '.join(labels)}" if labels else "")
    return _drawing(shapes, paper, label, "mechanism")


def _drawing(shapes, paper, label, look=""):
    size = {"width": paper.width, "height": paper.height}
    return render("drawing.svg", shapes=shapes, label=label, look=look, **size)


def _near(first, others):
    """Points (n, 2) to fit, and the poses that are shown behind the first: those so near that it
    does not shrink to a dot."""
    inside = np.concatenate(first)
    size, ghosts = np.ptp(inside, axis=0).max(), []
    for ghost in others:
        wider = np.concatenate([inside, *ghost])
        if np.ptp(wider, axis=0).max() < 3 * size:
            inside, ghosts = wider, [*ghosts, ghost]
    return inside, ghosts


def _labelled(labels, points, paper):
    """A ring at each point, and its words beside it, where no other words are."""
    shapes, used = [], []
    for words, point in zip(labels, points):
        x, y = (0, 34) if point is None else point  # what is wrong everywhere stands in the corner
        right = x < paper.width * 0.5
        ty = float(np.clip(y - 18, 16, paper.height - 10))
        while any(abs(ty - other) < LINE for other in used) and len(used) < paper.height // LINE:
            ty = ty + LINE if ty + LINE < paper.height - 8 else 16
        used.append(ty)
        room = 6.3 * len(words)
        tx = min(x + 20, paper.width - room - 4) if right else max(x - 20, room + 4)
        tx = max(4, tx) if right else min(paper.width - 4, tx)
        if point is not None:
            side = 1 if right else -1
            leader = [(x + 8 * side, y - 8), (tx - 3 * side, ty - 4)]
            shapes += [Circle("badmark", x, y, 11), Path("leader", path(leader))]
        shapes.append(Words("badlabel", tx, ty, "start" if right else "end", words))
    return shapes


def marked(model: mujoco.MjModel, place: dict) -> tuple[list[int], Callable | None]:
    """(geom ids, function of MjData or None) of a finding's place: what to colour, and the point
    (3,) to mark."""
    kind, name = place["kind"], place["name"]
    if kind == "geom":
        geom = _id(model.geom, name)
        if geom is None:
            return [], None
        if model.geom_type[geom] == GEOM.mjGEOM_PLANE:
            return [geom], lambda data: _under(data, geom)
        return [geom], lambda data: data.geom_xpos[geom]
    if kind == "body":
        body = _id(model.body, name)
        if body is None:
            return [], None
        return list(np.flatnonzero(model.geom_bodyid == body)), lambda data: data.xipos[body]
    joint, site = _joint_or_site(model, kind, name)
    if site is not None:
        return [], lambda data: data.site_xpos[site]
    return [], (None if joint is None else lambda data: data.xanchor[joint])


def _joint_or_site(model, kind, name):
    """(joint id or None, site id or None) of a joint, an actuator, or a joint's sensor."""
    if kind == "joint":
        return _id(model.joint, name.partition("+")[0]), None
    if kind == "actuator" and (actuator := _id(model.actuator, name)) is not None:
        return _end(model, actuator)
    if kind == "sensor" and (sensor := _id(model.sensor, name)) is not None:
        if model.sensor_objtype[sensor] == mujoco.mjtObj.mjOBJ_JOINT:
            return int(model.sensor_objid[sensor]), None
    return None, None


def _end(model, actuator):
    """(joint id, None) or (None, site id) that an actuator pulls at, of a tendon the last; (None,
    None) for any other."""
    kind = mujoco.mjtTrn(model.actuator_trntype[actuator])
    i = int(model.actuator_trnid[actuator, 0])
    joint, site = kind == mujoco.mjtTrn.mjTRN_JOINT, kind == mujoco.mjtTrn.mjTRN_SITE
    if kind == mujoco.mjtTrn.mjTRN_TENDON:
        last = model.tendon_adr[i] + model.tendon_num[i] - 1
        wrap, i = mujoco.mjtWrap(model.wrap_type[last]), int(model.wrap_objid[last])
        joint, site = wrap == mujoco.mjtWrap.mjWRAP_JOINT, wrap == mujoco.mjtWrap.mjWRAP_SITE
    return (i if joint else None), (i if site else None)


def _id(named, name):
    """Index of a named (or, where it has no name, numbered) part of a model; None for no such."""
    try:
        return named(name).id
    except KeyError:
        try:
            return named(int(name)).id
        except (ValueError, KeyError, IndexError):
            return None


def _ground(model, data, axes, towards, paper, coloured):
    """Planes: a line where seen edge-on, else a sheet."""
    shapes = []
    for g in np.flatnonzero(model.geom_type == int(GEOM.mjGEOM_PLANE)):
        frame, centre = data.geom_xmat[g].reshape(3, 3), data.geom_xpos[g]
        bad = " bad" if int(g) in coloured else ""
        facing = abs(frame[:, 2] @ towards)
        if facing < 0.1:
            along = 1e3 / paper.scale * axes @ np.cross(frame[:, 2], towards)
            ends = paper(axes @ centre + np.stack([-along, along]))
            shapes.append(Path(f"ground{bad}", path(ends)))
        elif facing < 0.95:  # face-on it would only be a background
            reach, middle = 0.4 * paper.width / paper.scale, _under(data, g)
            corners = [(-1, -1), (1, -1), (1, 1), (-1, 1)] @ frame[:, :2].T
            sheet = paper((middle + reach * corners) @ axes.T)
            shapes.append(Path(f"sheet{bad}", path(sheet, True)))
    return shapes


def _under(data, plane):
    """The point of a plane below (or above) the middle of the bodies."""
    normal, middle = data.geom_xmat[plane].reshape(3, 3)[:, 2], data.xipos[1:].mean(axis=0)
    return middle - ((middle - data.geom_xpos[plane]) @ normal) * normal


def _links(model, data, axes, paper):
    """Bodies without geoms: a line from the parent's origin, and a dot for the centre of mass."""
    shapes = []
    for b in range(1, model.nbody):
        if model.body_geomnum[b]:
            continue
        here, mass = paper(axes @ data.xpos[b]), paper(axes @ data.xipos[b])
        shapes += [Path("link", path([here, mass])), Circle("part", *mass, 4)]
        if parent := model.body_parentid[b]:
            shapes.append(Path("link", path([paper(axes @ data.xpos[parent]), here])))
    return shapes


def _joint(model, data, j, axes, paper):
    """A hinge as a small ring, a slide as a double arrow along its axis."""
    x, y = paper(axes @ data.xanchor[j])
    kind = JOINT(model.jnt_type[j])
    if kind in (JOINT.mjJNT_HINGE, JOINT.mjJNT_BALL):
        return [Circle("hinge", x, y, 3.5)]
    direction = axes @ data.xaxis[j] * [1, -1]
    length = np.linalg.norm(direction)
    if kind != JOINT.mjJNT_SLIDE or length < 0.2:  # a slide seen along its axis is no arrow
        return []
    along = 26 * direction / length
    across = along[::-1] * [-1, 1]
    middle, lines = np.array([x, y]), [[-along, along]]
    for end in (1, -1):
        tip = end * along
        lines += [[tip, tip - 0.25 * end * along + side * 0.15 * across] for side in (1, -1)]
    return [Path("slide", "".join(path(middle + np.array(line)) for line in lines))]


def animation(
    model: mujoco.MjModel,
    motions: dict[str, np.ndarray],
    seconds: float,
    width: int = 380,
    height: int = 300,
) -> str:
    """An animation as Markup: {"measured": (F, nq), "nominal": ..., "corrected": ...} drawn over
    each other, F frames that last `seconds`. "" where nothing of the model can be seen.

    The first frame stands without a script; the button and the slider need page.js.
    """
    frames = {look: np.asarray(qpos) for look, qpos in motions.items()}
    axes, towards = view(model, next(iter(frames.values()))[0])
    drawn = {
        look: [[o for _, o, _ in outlines(model, qpos, axes, towards)] for qpos in motion]
        for look, motion in frames.items()
    }
    if not drawn["measured"][0]:
        return ""
    every = np.concatenate([o for motion in drawn.values() for frame in motion for o in frame])
    recorded = np.concatenate([o for frame in drawn["measured"] for o in frame])
    low, high = recorded.min(axis=0), recorded.max(axis=0)
    reach = 0.6 * (high - low).max()  # what runs away leaves the picture instead of shrinking it
    paper = Paper(np.clip(every, low - reach, high + reach), width, height, 20)
    paths = {
        look: ["".join(path(paper(o), True, 0) for o in frame) for frame in motion]
        for look, motion in drawn.items()
    }
    shapes = _ground(model, posed(model, frames["measured"][0]), axes, towards, paper, set())
    shapes += [Path(f"{look} layer", motion[0]) for look, motion in paths.items()]
    label = "recorded, nominal and corrected motion over each other"
    return render(
        "animation.html",
        drawing=_drawing(shapes, paper, label),
        paths=paths,
        seconds=seconds,
        last=len(frames["measured"]) - 1,
    )
