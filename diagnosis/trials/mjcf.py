"""A drawn robot as MJCF, the nominal model that a tool is given.

mujoco.MjModel.from_xml_string(to_mjcf(robot))        # robot: a Robot of robots.py
"""


def to_mjcf(robot):
    """The Robot as MJCF text that stock MuJoCo loads; frictionloss with constraints that hold."""
    numbers = lambda values: " ".join(f"{v:.9g}" for v in values)
    lines = [
        '<mujoco model="robot">',
        '  <compiler angle="radian" autolimits="true"/>',
        f'  <option timestep="{robot.step:g}" integrator="{robot.integrator}"'
        f' gravity="{numbers(robot.gravity)}" density="{robot.density:.9g}"'
        f' wind="{numbers(robot.wind)}"/>',
        "  <default>",
        '    <joint solreffriction="0.004 1" solimpfriction="0.999 0.9999 0.001"/>',
        '    <geom contype="0" conaffinity="0"/>',
        "  </default>",
        "  <worldbody>",
    ]
    if robot.ground:
        lines.append(
            f'    <geom name="ground" type="plane" size="20 20 1" pos="0 0'
            f' {robot.ground_height:.9g}" contype="1" conaffinity="2" priority="1"'
            f' friction="{robot.sliding:.9g} 0.005 0.0001" solref="{-robot.contact_stiffness:.9g}'
            f' {-robot.contact_damping:.9g}"/>'
        )
    children = {}
    for index, link in enumerate(robot.links):
        children.setdefault(link.parent, []).append(index)
    for index in children.get(-1, []):
        lines += _body_lines(robot, index, children, 2, numbers)
    lines.append("  </worldbody>")
    if robot.actuators:
        lines.append("  <actuator>")
        lines += [_actuator_line(robot, actuator, numbers) for actuator in robot.actuators]
        lines.append("  </actuator>")
    return "\n".join([*lines, "</mujoco>", ""])


def _body_lines(robot, index, children, depth, numbers):
    link, pad = robot.links[index], "  " * depth
    lines = [
        f'{pad}<body name="{link.name}" pos="{numbers(link.position)}"'
        f' quat="{numbers(link.quaternion)}">',
        f'{pad}  <inertial pos="{numbers(link.center_of_mass)}" mass="{link.mass:.9g}"'
        f' diaginertia="{numbers(link.inertia)}"/>',
    ]
    if link.joint == "free":
        lines.append(f'{pad}  <freejoint name="{link.joint_name}"/>')
    else:
        limits = f' range="{numbers(link.range)}"' if link.range else ""
        lines.append(
            f'{pad}  <joint name="{link.joint_name}" type="{link.joint}"'
            f' axis="{numbers(link.axis)}" armature="{link.armature:.9g}"'
            f' damping="{link.damping:.9g}" frictionloss="{link.frictionloss:.9g}"'
            f' stiffness="{link.stiffness:.9g}" springref="{link.rest:.9g}"{limits}/>'
        )
    lines.append(
        f'{pad}  <geom name="{link.name.replace("link", "shell")}" type="capsule"'
        f' fromto="0 0 0 0 0 {link.length:.9g}" size="{link.radius:.9g}" mass="0"/>'
    )
    if link.foot:
        lines.append(
            f'{pad}  <geom name="{link.name.replace("link", "foot")}" type="sphere"'
            f' pos="0 0 {link.length:.9g}" size="{link.radius:.9g}" mass="0"'
            ' contype="2" conaffinity="1"/>'
        )
    for child in children.get(index, []):
        lines += _body_lines(robot, child, children, depth + 1, numbers)
    return [*lines, f"{pad}</body>"]


def _actuator_line(robot, actuator, numbers):
    gain = actuator.gain
    if actuator.kind == "motor":
        law = f'gainprm="{gain:.9g}" biastype="affine" biasprm="{actuator.bias:.9g} 0 0"'
    elif actuator.kind == "position":
        law = (
            f'gainprm="{gain * actuator.kp:.9g}" biastype="affine"'
            f' biasprm="{actuator.bias:.9g} {-gain * actuator.kp:.9g} {-gain * actuator.kv:.9g}"'
        )
    else:
        law = (
            f'gainprm="{gain * actuator.kv:.9g}" biastype="affine"'
            f' biasprm="{actuator.bias:.9g} 0 {-gain * actuator.kv:.9g}"'
        )
    joint = robot.links[actuator.link].joint_name
    return (
        f'    <general name="{actuator.name}" joint="{joint}" {law}'
        f' forcerange="{-actuator.limit:.9g} {actuator.limit:.9g}"/>'
    )
