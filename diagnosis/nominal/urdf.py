"""URDF as the model: read by MuJoCo with its joints' names and limits, and `<dynamics>` written
back.

    spec = urdf_spec("robot.urdf")                     # a motor on every joint that can be driven
    text = with_dynamics("robot.urdf", corrected_xml)  # damping and friction of the corrected model
"""

import os
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mujoco

from diagnosis.common.mujoco_warnings import quiet

MOVING = "revolute", "continuous", "prismatic"


class UrdfError(ValueError):
    """The URDF cannot be used. One line: which, why, and what to do."""


def is_urdf(path: str) -> bool:
    """Whether a file's first element is that of a URDF."""
    try:
        with open(path, encoding="utf-8", errors="replace") as stream:
            first = re.search(r"<\s*([A-Za-z]\w*)", re.sub(r"(?s)<!--.*?-->", "", stream.read()))
    except OSError:
        return False
    return bool(first) and first[1] == "robot"


def urdf_spec(path: str, skip_meshes: bool = False) -> mujoco.MjSpec:
    """The MjSpec of a URDF, with a motor named like its joint on every joint that can be driven.

    Those are the joints of its <transmission> and <ros2_control> elements, or every moving one that
    mimics no other. A joint's effort limit bounds its torque. Links joined rigidly become one body,
    as MuJoCo does it; what is only seen is left out. skip_meshes: go on without the collision
    meshes that are not found. Raises UrdfError, ValueError (MuJoCo's).
    """
    root = _parsed(path)
    _solid(path, root, skip_meshes)
    with quiet():
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
        model = spec.compile()
    driven = _driven(root)
    for joint in spec.joints:
        if joint.name not in driven or joint.type in (
            mujoco.mjtJoint.mjJNT_FREE,
            mujoco.mjtJoint.mjJNT_BALL,
        ):
            continue
        motor = spec.add_actuator(
            name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT
        )
        motor.gainprm[0] = 1.0
        its = model.joint(joint.name)
        if model.jnt_actfrclimited[its.id]:
            motor.ctrlrange = model.jnt_actfrcrange[its.id]
            motor.ctrllimited = mujoco.mjtLimited.mjLIMITED_TRUE
    return spec


def _parsed(path):
    """The root element. Raises UrdfError."""
    try:
        text = Path(path).read_text(encoding="utf-8")
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, UnicodeDecodeError, OSError) as error:
        raise UrdfError(f"{path}: the URDF is not XML ({error}); write it again") from None
    # by its elements: comments may speak of xacro, and its namespace has had several addresses
    if any(re.match(r"\{[^}]*\bxacro\}", element.tag) for element in root.iter()):
        raise UrdfError(f"{path}: a xacro; expand it first (xacro {path} > robot.urdf)")
    return root


def _solid(path, root, skip_meshes):
    """Leave what collides, its meshes under absolute paths. Raises UrdfError on one that is
    missing."""
    missing = []
    for link in root.iter("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
        for collision in link.findall("collision"):
            mesh = collision.find("geometry/mesh")
            if mesh is None:
                continue
            file = _found(path, mesh.get("filename", ""))
            if file is None:
                missing.append(mesh.get("filename", ""))
                link.remove(collision)
            else:
                mesh.set("filename", str(file))
    if missing and not skip_meshes:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise UrdfError(
            f"{path}: mesh {missing[0]!r}{more} is missing, or of a kind that MuJoCo does not "
            f"read; put the folder of "
            "its package beside the URDF, or give --skip-meshes: then these shapes collide with "
            "nothing"
        )
    extension = root.find("mujoco")
    extension = ElementTree.SubElement(root, "mujoco") if extension is None else extension
    compiler = extension.find("compiler")
    compiler = ElementTree.SubElement(extension, "compiler") if compiler is None else compiler
    compiler.set("strippath", "false")
    compiler.attrib.pop("meshdir", None)


def _found(path, name):
    """The file of a mesh: relative to the URDF, or in the folder of its package there or above.
    None: not found."""
    here = Path(path).resolve().parent
    package, _, rest = name.removeprefix("package://").partition("/")
    if name.startswith("package://"):
        places = [above / package / rest for above in (here, *here.parents)]
        places += [above / rest for above in (here, *here.parents) if above.name == package]
    else:
        places = [here / name.removeprefix("file://")]
    readable = {".stl", ".obj", ".msh"}
    return next((p for p in places if p.is_file() and p.suffix.lower() in readable), None)


def _driven(root):
    """The names of the joints that can be driven."""
    moving = {
        joint.get("name")
        for joint in root.findall("joint")
        if joint.get("type") in MOVING and joint.find("mimic") is None
    }
    named = {
        joint.get("name")
        for kind in ("transmission", "ros2_control")
        for element in root.findall(kind)
        for joint in element.findall("joint")
    }
    return moving & named or moving


def with_dynamics(path: str, corrected_xml: str, others: tuple[str, ...] = ()) -> str:
    """The text of a URDF with the damping and friction that the corrected model has, joint by
    joint.

    others: what a URDF has no place for, named in a comment. What else the file holds stays as it
    was.
    """
    builder = ElementTree.TreeBuilder(insert_comments=True)
    root = ElementTree.fromstring(
        Path(path).read_text(encoding="utf-8"), ElementTree.XMLParser(target=builder)
    )
    with quiet():
        model = mujoco.MjModel.from_xml_string(corrected_xml)
    joints = {model.joint(j).name: model.jnt_dofadr[j] for j in range(model.njnt)}
    for joint in root.findall("joint"):
        if joint.get("name") not in joints:
            continue
        dof = joints[joint.get("name")]
        dynamics = joint.find("dynamics")
        values = {"damping": model.dof_damping[dof], "friction": model.dof_frictionloss[dof]}
        if dynamics is None:
            if not any(values.values()):
                continue
            dynamics = ElementTree.SubElement(joint, "dynamics")
        for key, value in values.items():
            dynamics.set(key, f"{value:.9g}")
    if others:
        note = "; ".join(others).replace("--", "- -")
        root.insert(0, ElementTree.Comment(f" Without a place in a URDF: {note} "))
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + os.linesep
