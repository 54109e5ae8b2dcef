"""The facts file of the robot: masses, geometry, limits, gains, each block with its public source."""

from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Literal

import msgspec

from wbc_bench.errors import ProtocolError, UnknownNameError
from wbc_bench.readers import read_toml

Vec3 = tuple[float, float, float]
Gain = tuple[float, float]  # (kp [N m/rad], kd [N m s/rad])
FACTS_FILE = Path(__file__).with_name("tron1_l5.toml")
DEFAULT_VARIANT = "limx_adapter"  # of the first protocols, which name none


class _Block(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    src: str = ""


class Geom(_Block, frozen=True):
    """A primitive; `size` is full edge lengths [m] of a box, `radius` and `length` [m] of the others."""

    name: str
    type: Literal["box", "capsule", "cylinder"]
    pos: Vec3
    rpy: Vec3 = (0.0, 0.0, 0.0)
    size: Vec3 | None = None
    radius: float = 0.0
    length: float = 0.0


class Link(_Block, frozen=True):
    """A rigid body; `inertia` is (xx, yy, zz, xy, xz, yz) [kg m^2] about the centre of mass `com` [m]."""

    name: str
    mass: float
    com: Vec3
    inertia: tuple[float, float, float, float, float, float]
    geoms: tuple[Geom, ...] = ()


class Joint(_Block, frozen=True):
    """A revolute joint at `xyz` [m] in the parent frame; range [rad], effort [N m], velocity [rad/s]."""

    name: str
    parent: str
    child: str
    xyz: Vec3
    axis: Vec3
    range: tuple[float, float]
    effort: float
    velocity: float
    armature: float
    damping: float
    frictionloss: float


class Frame(_Block, frozen=True):
    """A frame at `xyz` [m] in its link, turned by `rpy` [rad] about fixed axes."""

    link: str
    xyz: Vec3
    rpy: Vec3 = (0.0, 0.0, 0.0)


class Mount(_Block, frozen=True):
    """Where the arm base sits on the base, and the parts in between (their frames are the base frame)."""

    xyz: Vec3
    lumps: tuple[Link, ...] = ()


class Tool(_Block, frozen=True):
    """A tool frame that is turned: `xyz` [m] and `rpy` [rad] in the last link."""

    xyz: Vec3
    rpy: Vec3


class Tcp(_Block, frozen=True):
    """Tool frames by name; one that is parallel to its link is its origin [m] alone."""

    link: str
    variants: dict[str, Vec3 | Tool]


class Foot(_Block, frozen=True):
    """The flat part of the sole in the ankle frame [m]; a sphere at each corner carries the contact."""

    x: tuple[float, float]
    y: tuple[float, float]
    z: float
    sphere_radius: float


class Friction(_Block, frozen=True):
    slide: float


class Gains(_Block, frozen=True):
    leg: Gain
    ankle: Gain
    arm: tuple[Gain, Gain, Gain, Gain, Gain, Gain]


class ActionScale(_Block, frozen=True):
    leg: float
    arm: tuple[float, float, float, float, float, float]


class Motor(_Block, frozen=True):
    """Speed-torque curve of every motor: what is left of its torque falls to zero at the joint's speed limit.

    `stall` is the torque that the curve has at rest over the joint's torque limit: with 2 the whole limit is
    there up to half the speed limit.
    """

    stall: float


class Variant(_Block, frozen=True):
    """What one build of the robot has other than the rest of the file; links and joints replace by name."""

    description: str
    mount: str = ""
    tcp: str = ""
    default_qpos: dict[str, float] | None = None
    gains: Gains | None = None
    motor: Motor | None = None
    joint_friction: bool = False  # the joints' `frictionloss` acts
    links: tuple[Link, ...] = ()
    joints: tuple[Joint, ...] = ()


class Facts(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The whole facts file; after `load_facts` links, joints, gains and defaults are those of one variant."""

    name: str
    base: str
    nominal_base_height: float
    default_mount: str
    default_tcp: str
    default_qpos: dict[str, float]
    action_scale: ActionScale
    gains: Gains
    fixed: dict[str, Vec3]
    foot: Foot
    friction: Friction
    frames: dict[str, Frame]
    tcp: Tcp
    mounts: dict[str, Mount]
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    variants: dict[str, Variant]
    variant: Variant = Variant(description="")  # the one that was chosen


class RobotConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a protocol may change of the robot; empty strings and None mean the variant's own."""

    LATER: ClassVar[frozenset[str]] = frozenset({"variant"})  # see `schema.meaning_digest`

    variant: str = DEFAULT_VARIANT
    mount: str = ""
    tcp: str = ""
    ankle_effort: float | None = None  # [N m] 20 in the vendor's files, 40 or 80 in other public ones
    leg_gain: Gain | None = None
    ankle_gain: Gain | None = None
    arm_gain: tuple[Gain, Gain, Gain, Gain, Gain, Gain] | None = None


@cache
def load_facts(variant: str = DEFAULT_VARIANT, path: Path = FACTS_FILE) -> Facts:
    """The facts of one variant of the robot.

    Raises:
        ProtocolError: the file cannot be read or a field is wrong (its path is named).
        UnknownNameError: the file has no such variant.
    """
    facts = read_toml(path, Facts, "robot facts", ProtocolError)
    if variant not in facts.variants:
        raise UnknownNameError("robot variant", variant, facts.variants, "robot.variant")
    chosen = facts.variants[variant]
    links, joints = ({item.name: item for item in items} for items in (chosen.links, chosen.joints))
    return msgspec.structs.replace(
        facts,
        default_mount=chosen.mount or facts.default_mount,
        default_tcp=chosen.tcp or facts.default_tcp,
        default_qpos=facts.default_qpos if chosen.default_qpos is None else chosen.default_qpos,
        gains=chosen.gains or facts.gains,
        links=tuple(links.get(link.name, link) for link in facts.links),
        joints=tuple(joints.get(joint.name, joint) for joint in facts.joints),
        variant=chosen,
    )


def mount_of(facts: Facts, config: RobotConfig) -> Mount:
    """The arm mount that a configuration names."""
    name = config.mount or facts.default_mount
    if name not in facts.mounts:
        raise UnknownNameError("mount", name, facts.mounts, "robot.mount")
    return facts.mounts[name]


def tcp_of(facts: Facts, config: RobotConfig) -> Frame:
    """The end-effector frame that a configuration names."""
    name = config.tcp or facts.default_tcp
    if name not in facts.tcp.variants:
        raise UnknownNameError("tcp", name, facts.tcp.variants, "robot.tcp")
    tool = facts.tcp.variants[name]
    if isinstance(tool, Tool):
        return Frame(link=facts.tcp.link, xyz=tool.xyz, rpy=tool.rpy)
    return Frame(link=facts.tcp.link, xyz=tool)


def effort_of(joint: Joint, config: RobotConfig) -> float:
    """Largest torque [N m] of a joint."""
    if joint.name.startswith("ankle") and config.ankle_effort is not None:
        return config.ankle_effort
    return joint.effort


def gain_of(facts: Facts, joint: Joint, config: RobotConfig) -> Gain:
    """PD gains (kp [N m/rad], kd [N m s/rad]) of a joint."""
    if joint.name.startswith("J"):
        return (config.arm_gain or facts.gains.arm)[int(joint.name[1:]) - 1]
    if joint.name.startswith("ankle"):
        return config.ankle_gain or facts.gains.ankle
    return config.leg_gain or facts.gains.leg


def without_sources(value: Any) -> Any:
    """Facts in the types of JSON, without the remarks on where they come from."""
    if isinstance(value, dict):
        return {key: without_sources(item) for key, item in value.items() if key != "src"}
    if isinstance(value, list | tuple):
        return [without_sources(item) for item in value]
    return value
