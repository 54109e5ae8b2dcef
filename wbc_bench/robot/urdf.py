"""The URDF of the robot, from the same facts as the MuJoCo model."""

import xml.etree.ElementTree as ET

from wbc_bench.robot.facts import Facts, Frame, Geom, Link, RobotConfig, effort_of, mount_of, tcp_of


def build_urdf(facts: Facts, config: RobotConfig) -> str:
    """URDF text: links, joints, primitive collision shapes; massless links `tcp`, `sole_L`, `sole_R`, `imu`.

    URDF has no field for the reflected inertia of a motor: set `armature` on the model that reads it.
    """
    robot = ET.Element("robot", name=facts.name)
    mount = mount_of(facts, config)
    for link in facts.links:
        _add_link(robot, link)
    for lump in mount.lumps:
        _add_link(robot, lump)
        _add_joint(robot, f"{lump.name}_fixed", facts.base, lump.name, (0.0, 0.0, 0.0))
    fixed = dict(facts.fixed) | {"arm_base": mount.xyz}
    for joint in facts.joints:
        # at its first joint, as in the MuJoCo model: readers that go by the order of the file agree on it
        if joint.parent in fixed:
            _add_joint(robot, f"{joint.parent}_fixed", facts.base, joint.parent, fixed.pop(joint.parent))
        element = _add_joint(robot, joint.name, joint.parent, joint.child, joint.xyz, kind="revolute")
        ET.SubElement(element, "axis", xyz=_text(joint.axis))
        lower, upper = joint.range
        ET.SubElement(
            element,
            "limit",
            lower=repr(lower),
            upper=repr(upper),
            effort=repr(effort_of(joint, config)),
            velocity=repr(joint.velocity),
        )
        friction = joint.frictionloss if facts.variant.joint_friction else 0.0
        ET.SubElement(element, "dynamics", damping=repr(joint.damping), friction=repr(friction))
    for name, xyz in fixed.items():
        _add_joint(robot, f"{name}_fixed", facts.base, name, xyz)
    frames: dict[str, Frame] = dict(facts.frames) | {"tcp": tcp_of(facts, config)}
    for name, frame in frames.items():
        ET.SubElement(robot, "link", name=name)
        _add_joint(robot, f"{name}_frame", frame.link, name, frame.xyz, frame.rpy)
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"


def _text(values) -> str:
    return " ".join(repr(float(value)) for value in values)


def _add_joint(robot, name: str, parent: str, child: str, xyz, rpy=(0, 0, 0), kind: str = "fixed"):
    joint = ET.SubElement(robot, "joint", name=name, type=kind)
    ET.SubElement(joint, "origin", xyz=_text(xyz), rpy=_text(rpy))
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    return joint


def _add_link(robot, link: Link) -> None:
    element = ET.SubElement(robot, "link", name=link.name)
    inertial = ET.SubElement(element, "inertial")
    ET.SubElement(inertial, "origin", xyz=_text(link.com), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=repr(link.mass))
    names = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    ET.SubElement(inertial, "inertia", dict(zip(names, map(repr, link.inertia), strict=True)))
    for geom in link.geoms:
        for tag in ("visual", "collision"):
            _add_shape(ET.SubElement(element, tag, name=geom.name), geom)


def _add_shape(element, geom: Geom) -> None:
    ET.SubElement(element, "origin", xyz=_text(geom.pos), rpy=_text(geom.rpy))
    shape = ET.SubElement(element, "geometry")
    if geom.type == "box":
        assert geom.size is not None
        ET.SubElement(shape, "box", size=_text(geom.size))
    else:
        # URDF has no capsule: a cylinder over its whole length encloses it
        length = geom.length + (2 * geom.radius if geom.type == "capsule" else 0.0)
        ET.SubElement(shape, "cylinder", radius=repr(geom.radius), length=repr(length))
