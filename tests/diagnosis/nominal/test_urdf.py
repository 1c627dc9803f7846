"""URDF as the model: names, limits and meshes kept, motors added, <dynamics> written back."""

import struct
import xml.etree.ElementTree as ElementTree

import mujoco
import numpy as np
import pytest

from diagnosis.nominal.model import ModelError, load_world
from diagnosis.nominal.urdf import is_urdf, with_dynamics

LINK = (
    '<link name="{0}"><inertial><origin xyz="0 0 -.15"/><mass value="{1}"/><inertia ixx=".01" '
    'iyy=".01" izz=".001" ixy="0" ixz="0" iyz="0"/></inertial>{2}</link>'
)
MESH = '<collision><geometry><mesh filename="{}"/></geometry></collision>'
DAE = '<visual><geometry><mesh filename="package://arm/seen.dae"/></geometry></visual>'
URDF = """<robot name="arm"><!-- ours -->
  <link name="base"/>
  {upper}
  {lower}
  <link name="tool"><inertial><mass value=".1"/>
    <inertia ixx=".001" iyy=".001" izz=".001" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
    <axis xyz="0 1 0"/><limit lower="-2" upper="1.5" effort="3" velocity="5"/>
    <dynamics damping="0.05" friction="0.1"/></joint>
  <joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/>
    <origin xyz="0 0 -.3"/><axis xyz="0 1 0"/></joint>
  <joint name="flange" type="fixed"><parent link="lower"/><child link="tool"/>
    <origin xyz="0 0 -.2"/></joint>
  {more}
</robot>"""


def urdf(folder, mesh="", more=""):
    """The path of a two-link arm; the upper link collides as `mesh` says."""
    solid = DAE + (MESH.format(mesh) if mesh else "")
    path = folder / "arm.urdf"
    upper, lower = LINK.format("upper", 1, solid), LINK.format("lower", 0.5, "")
    path.write_text(URDF.format(upper=upper, lower=lower, more=more))
    return str(path)


def stl(path):
    """A tetrahedron, 10 cm wide."""
    path.parent.mkdir(parents=True, exist_ok=True)
    corners = 0.1 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = [(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)]
    data = b"".join(
        struct.pack("<12fH", 0, 0, 0, *corners[list(face)].ravel(), 0) for face in faces
    )
    path.write_bytes(bytes(80) + struct.pack("<I", len(faces)) + data)


def test_names_limits_and_motors(tmp_path):
    path = urdf(tmp_path)
    assert is_urdf(path)
    model = load_world(path).model
    assert [model.joint(j).name for j in range(model.njnt)] == ["shoulder", "elbow"]
    np.testing.assert_allclose(model.joint("shoulder").range, [-2, 1.5])
    assert not model.jnt_limited[1]
    np.testing.assert_allclose([model.dof_damping[0], model.dof_frictionloss[0]], [0.05, 0.1])
    np.testing.assert_allclose(model.body("lower").mass, 0.6)  # the tool is fixed to it
    assert [model.actuator(a).name for a in range(model.nu)] == ["shoulder", "elbow"]
    np.testing.assert_allclose(model.actuator("shoulder").ctrlrange, [-3, 3])
    data = mujoco.MjData(model)
    data.ctrl[:] = 0.7, -0.4
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.qfrc_actuator, [0.7, -0.4])


@pytest.mark.parametrize("kind", ["transmission", "ros2_control"])
def test_only_joints_that_are_said_to_be_driven_get_a_motor(tmp_path, kind):
    path = urdf(tmp_path, more=f'<{kind} name="t"><joint name="elbow"/></{kind}>')
    model = load_world(path).model
    assert [model.actuator(a).name for a in range(model.nu)] == ["elbow"]


@pytest.mark.parametrize("address", ["www.ros.org/wiki/xacro", "wiki.ros.org/xacro"])
def test_a_xacro_is_told_by_its_elements(tmp_path, address):
    """Not by a comment, as where the expanded file says what it was made of."""
    assert load_world(urdf(tmp_path, more="<!-- from <xacro:arm/> -->")).model.njnt == 2
    path = urdf(tmp_path, more=f'<x:arm xmlns:x="http://{address}"/>')
    with pytest.raises(ModelError, match="a xacro; expand it first"):
        load_world(path)


def test_a_mesh_is_found_in_its_package(tmp_path):
    stl(tmp_path / "arm_description" / "meshes" / "upper.stl")
    (tmp_path / "arm_description" / "urdf").mkdir()
    for name in ("package://arm_description/meshes/upper.stl", "../meshes/upper.stl"):
        world = load_world(urdf(tmp_path / "arm_description" / "urdf", name))
        assert world.model.nmesh == 1
        xml, _ = world.corrected_xml({})
        assert mujoco.MjModel.from_xml_string(xml).nmesh == 1


def test_a_missing_mesh_is_named_and_can_be_left_out(tmp_path):
    path = urdf(tmp_path, "package://arm_description/meshes/gone.stl")
    with pytest.raises(ModelError, match=r"arm.urdf: mesh 'package://.*gone.stl'.*--skip-meshes"):
        load_world(path)
    model = load_world(path, skip_meshes=True).model
    assert (model.nmesh, model.njnt) == (0, 2)


def test_what_is_no_urdf(tmp_path):
    (tmp_path / "arm.urdf").write_text("<robot name='a'><link name='b'>")
    with pytest.raises(ModelError, match="not XML"):
        load_world(str(tmp_path / "arm.urdf"))
    xacro = "<robot xmlns:xacro='http://www.ros.org/wiki/xacro'><xacro:arm/></robot>"
    (tmp_path / "arm.urdf").write_text(xacro)
    with pytest.raises(ModelError, match="expand it first"):
        load_world(str(tmp_path / "arm.urdf"))
    assert not is_urdf(str(tmp_path / "absent.urdf"))
    (tmp_path / "arm.xml").write_text("<!-- a <robot> --><mujoco><worldbody/></mujoco>")
    assert not is_urdf(str(tmp_path / "arm.xml"))


def test_dynamics_are_written_back_and_the_rest_stays(tmp_path):
    path = urdf(tmp_path)
    world = load_world(path)
    setting = {
        world.candidate("coulomb_friction", "elbow"): (0.3,),
        world.candidate("viscous_damping", "shoulder"): (0.25,),
    }
    text = with_dynamics(path, world.corrected_xml(setting)[0], ("armature at joint elbow",))
    (tmp_path / "new.urdf").write_text(text)
    model = load_world(str(tmp_path / "new.urdf")).model
    np.testing.assert_allclose(model.dof_damping, [0.25, 0])
    np.testing.assert_allclose(model.dof_frictionloss, [0.1, 0.3])
    assert "ours" in text and "seen.dae" in text and "armature at joint elbow" in text
    old, new = ElementTree.parse(path).getroot(), ElementTree.fromstring(text)
    for root in (old, new):
        for joint in root.findall("joint"):
            for dynamics in joint.findall("dynamics"):
                joint.remove(dynamics)
    squeezed = ("".join(ElementTree.tostring(root, "unicode").split()) for root in (old, new))
    assert next(squeezed) == next(squeezed)
