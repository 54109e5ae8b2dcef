"""The MuJoCo model of the robot on a plane, built from the facts file."""

import mujoco
import numpy as np

from wbc_bench.robot.facts import (
    Facts,
    Geom,
    Joint,
    Link,
    RobotConfig,
    Vec3,
    effort_of,
    gain_of,
    mount_of,
    tcp_of,
)
from wbc_bench.robot.scene import Scene

GROUND = 1  # collision bits: what may touch the ground,
BODY = 2  # and what may touch other parts of the robot
_TYPES = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
}
_COLOURS = {  # by the first word of a geom's name; legs take the last
    "base": (0.80, 0.82, 0.85, 1),
    "arm": (0.90, 0.56, 0.20, 1),
    "grip": (0.30, 0.33, 0.40, 1),
    "tron1computer": (0.45, 0.55, 0.62, 1),
    "foot": (0.22, 0.24, 0.28, 1),
    "": (0.36, 0.46, 0.60, 1),
}


def build_spec(facts: Facts, config: RobotConfig, timestep: float = 0.002) -> mujoco.MjSpec:
    """An editable model: robot with a free base over a plane at z = 0, PD position actuators, sensors.

    Bodies carry the link names; sites `tcp`, `imu`, `sole_L`, `sole_R`; one touch sensor `ground_<link>` for
    each link that must not touch the ground, and the net contact force of each sole.
    """
    spec = mujoco.MjSpec()
    spec.modelname = facts.name
    spec.compiler.autolimits = True
    spec.compiler.degree = False
    spec.option.timestep = timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    # the sparse Newton Hessian of MuJoCo 4.0.0 is wrong; this model is small enough for dense anyway
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960
    world = spec.worldbody
    _add_surroundings(spec)
    world.add_geom(
        name="ground",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, 0.05],
        contype=GROUND,
        conaffinity=GROUND,
        friction=_friction(facts),
        material="ground",
    )
    links = {link.name: link for link in facts.links}
    base = _add_link(world, links[facts.base], (0.0, 0.0, facts.nominal_base_height))
    base.add_freejoint(name="base")
    bodies = {facts.base: base}

    mount = mount_of(facts, config)
    for lump in mount.lumps:
        _add_link(base, lump, (0.0, 0.0, 0.0))
    fixed = dict(facts.fixed) | {"arm_base": mount.xyz}

    for joint in facts.joints:
        # created at its first child, so that MuJoCo's depth-first joint order is the order of the facts
        if joint.parent not in bodies:
            bodies[joint.parent] = _add_link(base, links[joint.parent], fixed.pop(joint.parent))
        body = _add_link(bodies[joint.parent], links[joint.child], joint.xyz)
        bodies[joint.child] = body
        body.add_joint(
            name=joint.name,
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=joint.axis,
            range=joint.range,
            armature=joint.armature,
            damping=[joint.damping, 0, 0],
            frictionloss=joint.frictionloss if facts.variant.joint_friction else 0.0,
        )
        _add_motor(spec, facts, joint, config)

    for name, xyz in fixed.items():
        _add_link(base, links[name], xyz)

    for side in "LR":
        _add_foot(bodies[f"ankle_{side}_Link"], facts, side)
    for name, frame in facts.frames.items():
        bodies[frame.link].add_site(name=name, pos=frame.xyz, size=[0.01, 0.01, 0.01])
    tcp = tcp_of(facts, config)
    bodies[tcp.link].add_site(name="tcp", pos=tcp.xyz, quat=_quat(tcp.rpy), size=[0.01, 0.01, 0.01])

    _exclude_neighbours(spec, facts)
    _add_sensors(spec)
    return spec


def build_model(
    facts: Facts, config: RobotConfig, timestep: float = 0.002, scene: Scene | None = None
) -> mujoco.MjModel:
    """The compiled model of `build_spec`, in a scene if one is given."""
    spec = build_spec(facts, config, timestep)
    if scene is not None:
        scene.furnish(spec)
    return spec.compile()


def _add_surroundings(spec: mujoco.MjSpec) -> None:
    """What only a picture needs: light, a pale sky, and a ground grid of 0.5 m."""
    spec.visual.headlight.ambient = (0.42, 0.42, 0.42)
    spec.visual.headlight.diffuse = (0.35, 0.35, 0.35)
    spec.visual.headlight.specular = (0.05, 0.05, 0.05)
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=[1, 2, 4],
        dir=[-0.55, -0.25, -0.8],
        diffuse=[0.45, 0.45, 0.45],
        specular=[0.1, 0.1, 0.1],
    )
    builtin, kind = mujoco.mjtBuiltin, mujoco.mjtTexture
    spec.add_texture(
        name="sky",
        type=kind.mjTEXTURE_SKYBOX,
        builtin=builtin.mjBUILTIN_GRADIENT,
        rgb1=[1, 1, 1],
        rgb2=[0.85, 0.89, 0.94],
        width=32,
        height=192,
    )
    spec.add_texture(
        name="ground",
        type=kind.mjTEXTURE_2D,
        builtin=builtin.mjBUILTIN_FLAT,
        mark=mujoco.mjtMark.mjMARK_EDGE,
        rgb1=[0.93, 0.93, 0.92],
        markrgb=[0.72, 0.74, 0.77],
        width=128,
        height=128,
    )
    material = spec.add_material(name="ground", texrepeat=[2, 2], texuniform=True)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "ground"


def _add_motor(spec: mujoco.MjSpec, facts: Facts, joint: Joint, config: RobotConfig) -> None:
    """A PD position loop within the torque limit and, if the variant has one, the speed-torque curve.

    With a controller that clamps its voltage MuJoCo's motor cancels its own back-EMF: with PD torque u,
    torque limit e, speed limit w and stall torque s e it exerts
    clip(clip(u, -s e (1 + qd/w), s e (1 - qd/w)), -e, e).
    Source: MuJoCo 4.0.0 `dcmotor`, measured in tests/robot/test_motor.py.
    """
    kp, kd = gain_of(facts, joint, config)
    effort = effort_of(joint, config)
    actuator = spec.add_actuator(
        name=joint.name,
        target=joint.name,
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        forcerange=[-effort, effort],
    )
    motor = facts.variant.motor
    if motor is None:
        actuator.set_to_position(kp=kp, kv=kd)
        return
    volt = 1.0  # of the supply; torques and speeds do not depend on it
    actuator.set_to_dcmotor(
        motorconst=[0, 0],
        resistance=0,
        nominal=[volt, motor.stall * effort, joint.velocity],
        saturation=[effort, 0, 0],
        controller=[kp, 0, kd, 0, 0, volt],
        ctrlspec=mujoco.mjtCtrlInput.mjINPUT_POS,
    )


def _add_link(parent, link: Link, xyz: tuple[float, float, float]):
    body = parent.add_body(name=link.name, pos=xyz)
    body.mass, body.ipos, body.fullinertia = link.mass, link.com, link.inertia
    body.explicitinertial = True
    for geom in link.geoms:
        _add_geom(body, geom)
    return body


def _add_geom(body, geom: Geom) -> None:
    if geom.type == "box":
        assert geom.size is not None
        size = [edge / 2 for edge in geom.size]
    else:
        size = [geom.radius, geom.length / 2, 0]
    added = body.add_geom(
        name=geom.name,
        type=_TYPES[geom.type],
        size=size,
        pos=geom.pos,
        contype=GROUND | BODY,
        conaffinity=GROUND | BODY,
        mass=0,
        rgba=_COLOURS.get(geom.name.split("_")[0], _COLOURS[""]),
    )
    added.quat = _quat(geom.rpy)


def _friction(facts: Facts) -> list[float]:
    """Sliding, torsional and rolling friction; the last two are MuJoCo's defaults and do not act here."""
    return [facts.friction.slide, 0.005, 0.0001]


def _quat(rpy: Vec3) -> np.ndarray:
    """Quaternion wxyz (4,) of URDF's roll, pitch and yaw [rad] about fixed axes."""
    quat = np.zeros(4)
    mujoco.mju_euler2Quat(quat, np.array(rpy), "XYZ")
    return quat


def _add_foot(body, facts: Facts, side: str) -> None:
    """Four spheres under the corners of the flat sole touch the ground; a box stands in for the shape."""
    foot, radius = facts.foot, facts.foot.sphere_radius
    for corner, (x, y) in enumerate([(x, y) for x in foot.x for y in foot.y]):
        body.add_geom(
            name=f"foot_{side}_{corner}",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[radius, 0, 0],
            pos=[x, y, foot.z + radius],
            contype=GROUND,
            conaffinity=GROUND,
            mass=0,
            friction=_friction(facts),  # of two surfaces that touch the larger coefficient counts
            rgba=_COLOURS["foot"],
        )
    height = 0.03  # [m] of the shoe above the sole
    body.add_geom(
        name=f"foot_{side}_box",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[(foot.x[1] - foot.x[0]) / 2, 0.035, height / 2],
        pos=[sum(foot.x) / 2, 0, foot.z + 0.004 + height / 2],
        contype=BODY,
        conaffinity=BODY,
        mass=0,
        rgba=_COLOURS["foot"],
    )


def _exclude_neighbours(spec: mujoco.MjSpec, facts: Facts) -> None:
    """Parts that overlap by construction (up to two joints apart) do not collide with each other."""
    parent = {joint.child: joint.parent for joint in facts.joints}
    pairs = set()
    for child in parent:
        ancestor = child
        for _ in range(2):
            if ancestor not in parent:
                break
            ancestor = parent[ancestor]
            pairs.add((ancestor, child))
    # the arm base is a part of the base, and so is the plate that carries it
    for name in ("arm_link1", "arm_link2"):
        pairs.add((facts.base, name))
    for a, b in sorted(pairs):
        spec.add_exclude(name=f"{a}:{b}", bodyname1=a, bodyname2=b)


def _add_sensors(spec: mujoco.MjSpec) -> None:
    contact, body, geom = mujoco.mjtSensor.mjSENS_CONTACT, mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_GEOM
    found, force, net = 0, 1, 3  # mjtConDataField and reduction codes
    for link in spec.bodies:
        if (
            any(g.contype & GROUND and not g.name.startswith("foot") for g in link.geoms)
            and link.name != "world"
        ):
            spec.add_sensor(
                name=f"ground_{link.name}",
                type=contact,
                objtype=body,
                objname=link.name,
                reftype=geom,
                refname="ground",
                intprm=[1 << found, 0, 1],
            )
    for side in "LR":
        spec.add_sensor(
            name=f"sole_{side}_force",
            type=contact,
            objtype=geom,
            objname="ground",
            reftype=body,
            refname=f"ankle_{side}_Link",
            intprm=[1 << force, net, 1],
        )
