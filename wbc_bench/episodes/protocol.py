"""The evaluation protocol: everything that two evaluations must share to be compared.

A protocol is a TOML file; every field is checked when it is decoded, and a mistake names the field's path.
Its digest covers the meaning of the file, not its layout or comments.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, ClassVar, Literal, NoReturn

import msgspec

from wbc_bench.errors import ProtocolError, UnknownNameError
from wbc_bench.files import LONGEST_NAME, PROTOCOLS, is_folder_name, real_path
from wbc_bench.readers import read_toml
from wbc_bench.robot import RobotConfig, load_facts
from wbc_bench.schema import meaning_digest

Positive = Annotated[float, msgspec.Meta(gt=0)]
NonNegative = Annotated[float, msgspec.Meta(ge=0)]
Count = Annotated[int, msgspec.Meta(ge=1)]
Range = tuple[float, float]  # (low, high)
PositiveRange = tuple[Positive, Positive]
Delay = Annotated[float, msgspec.Meta(ge=0, le=0.2)]  # [s] more than any control stack has
Angle = Annotated[float, msgspec.Meta(ge=0, le=0.5)]  # [rad] beyond it nothing stands
DelayRange = tuple[Delay, Delay]
REACH_X = (0.0, 1.0)  # [m] ahead of the base, where reach targets are; the arm is 0.8 m long

# Limits of what an evaluation holds in memory
LONGEST = 600.0  # [s] of an episode, whose noise and pushes are drawn in advance
MAX_STEPS = 30_000  # control steps of an episode: 0.25 GB of time series in a shard of 50 episodes
MAX_EPISODES = 100_000  # of a protocol: 0.1 GB of rows in its manifest

MAX_PUSHES = 2  # columns of a manifest; `read_protocol` refuses a schedule with room for more


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    pass


class Episodes(_Table, frozen=True):
    """How many episodes, how long, and the seed of every draw in them."""

    replicates: Annotated[int, msgspec.Meta(ge=1, le=1000)]
    per_replicate: Annotated[int, msgspec.Meta(ge=1, le=MAX_EPISODES)]
    horizon: Annotated[float, msgspec.Meta(gt=0, le=LONGEST)]  # [s]
    seed: Annotated[int, msgspec.Meta(ge=0)]


class Physics(_Table, frozen=True):
    """PD runs at every physics step; the controller at every `decimation`-th."""

    LATER: ClassVar[frozenset[str]] = frozenset({"cone"})

    timestep: Annotated[float, msgspec.Meta(ge=1e-4, le=0.02)] = 0.002  # [s]
    decimation: Annotated[int, msgspec.Meta(ge=1, le=1000)] = 10
    cone: Literal["elliptic", "pyramidal"] = "elliptic"  # of the friction; docs/protocols.md says why


class WorkspaceTargets(_Table, frozen=True, tag="workspace"):
    """Targets all over the whole-body workspace, in equal parts or by weight of stratum.

    Ranges are of candidate poses about the initial base, heights above the ground.
    """

    x: Range  # [m]
    y: Range  # [m]
    height: Range  # [m]
    roll: Range  # [rad]
    pitch: Range  # [rad]
    yaw: Range  # [rad]
    weights: dict[Literal["arm", "posture", "step"], Annotated[int, msgspec.Meta(ge=1, le=1000)]]
    step_distance: Range  # [m] how far the stance of a `step` target is displaced
    step_yaw: Range  # [rad] and how far it is turned
    com_margin: NonNegative = 0.02  # [m] of the centre of mass inside the soles' hull

    def mistakes(self, episodes: Episodes) -> Iterator[tuple[str, str]]:
        """(what is wrong, path of the field), what the types of the fields cannot say."""
        if self.height[0] < 0:
            yield f"low {self.height[0]:g} m is below the ground", "targets.height"
        if self.step_distance[0] < 0:
            yield f"low {self.step_distance[0]:g} m must not be negative", "targets.step_distance"
        if not self.weights:
            yield "no stratum has a weight, valid: arm, posture, step", "targets.weights"


class ReachTargets(_Table, frozen=True, tag="reach"):
    """Targets straight ahead over a ladder of heights."""

    heights: tuple[float, float, Positive]  # [m] (lowest, highest, spacing)
    per_height: Annotated[int, msgspec.Meta(ge=1, le=MAX_EPISODES)]
    dither: NonNegative  # [m] uniform offset of each episode's target, so that no two are the same
    orientations: tuple[Literal["free", "horizontal"], ...]
    conditions: tuple[Literal["nominal", "randomised"], ...]
    com_margin: NonNegative = 0.02  # [m]

    @property
    def num_heights(self) -> int:
        """Rungs of the ladder, both ends included where the spacing allows."""
        low, high, spacing = self.heights
        return math.floor((high - low) / spacing + 1e-9) + 1

    @property
    def num_episodes(self) -> int:
        """Episodes of the whole ladder."""
        return len(self.orientations) * len(self.conditions) * self.per_height * self.num_heights

    def mistakes(self, episodes: Episodes) -> Iterator[tuple[str, str]]:
        """(what is wrong, path of the field), what the types of the fields cannot say."""
        low, high, spacing = self.heights
        if not 0 <= low <= high:
            yield f"heights {low:g} to {high:g} m, valid: 0 <= low <= high", "targets.heights"
        if (high - low) / spacing > MAX_EPISODES:
            yield f"spacing {spacing:g} m makes more than {MAX_EPISODES} heights", "targets.heights"
        for name in ("orientations", "conditions"):
            names = getattr(self, name)
            if not names or len(set(names)) < len(names):
                yield f"{list(names)} must name at least one, each once", f"targets.{name}"
        if (episodes.replicates, episodes.per_replicate) != (1, self.num_episodes):
            yield (
                f"{episodes.replicates} x {episodes.per_replicate} episodes, "
                f"the ladder has 1 x {self.num_episodes}",
                "episodes.per_replicate",
            )


class Randomization(_Table, frozen=True):
    """Ranges of the uniform draws of an episode. Source: the paper names the quantities, not the ranges.

    What came later, from `command_delay` on, is constant through an episode and hidden from the controller.
    """

    LATER: ClassVar[frozenset[str]] = frozenset(
        {
            "command_delay",
            "observation_delay",
            "odometry_delay",
            "odometry_drift",
            "payload",
            "payload_offset",
            "motor_strength",
            "joint_offset",
            "gravity_tilt",
            "slope",
            "step_height",
        }
    )

    friction: Range = (0.8, 0.8)  # sliding coefficient
    base_mass: Range = (0.0, 0.0)  # [kg] added to the base
    base_lin_vel: NonNegative = 0.0  # [m/s] at reset, each axis +-
    base_ang_vel: NonNegative = 0.0  # [rad/s]
    leg_q: NonNegative = 0.0  # [rad] about the default posture
    leg_qd: NonNegative = 0.0  # [rad/s]
    gain: Range = (1.0, 1.0)  # factor on kp and on kd, one a joint
    command_delay: DelayRange = (0.0, 0.0)  # [s] from a command to the motors, in whole physics steps
    observation_delay: DelayRange = (0.0, 0.0)  # [s] age of proprioception and end-effector pose
    odometry_delay: DelayRange = (
        0.0,
        0.0,
    )  # [s] age of the base pose that places the target
    odometry_drift: NonNegative = 0.0  # [m/sqrt(s)] random walk of that pose, along each axis
    payload: tuple[NonNegative, NonNegative] = (0.0, 0.0)  # [kg] point mass in the hand
    payload_offset: NonNegative = 0.0  # [m] of the point from the end-effector, each axis +-
    motor_strength: PositiveRange = (1.0, 1.0)  # factor on the torque limits, one for all joints
    joint_offset: NonNegative = 0.0  # [rad] error of the encoders, each joint +-
    gravity_tilt: Angle = 0.0  # [rad] of the IMU about a horizontal axis
    slope: Angle = 0.0  # [rad] steepest slope of the ground
    step_height: Annotated[float, msgspec.Meta(ge=0, le=0.2)] = 0.0  # [m] highest bump of an uneven ground


class Push(_Table, frozen=True):
    """Jumps of the base's velocity."""

    LATER: ClassVar[frozenset[str]] = frozenset({"vertical_speed", "angular_speed"})

    speed: NonNegative = 0.0  # [m/s] each axis +-; 0 for no pushes
    interval: tuple[Positive, Positive] = (4.0, 6.0)  # [s]
    quiet_end: NonNegative = 2.0  # [s] at the end of an episode without a push
    vertical_speed: NonNegative = 0.0  # [m/s] +-
    angular_speed: NonNegative = 0.0  # [rad/s] each axis of the base +-

    @property
    def some(self) -> bool:
        """Whether there are pushes at all."""
        return self.speed > 0 or self.vertical_speed > 0 or self.angular_speed > 0


class Noise(_Table, frozen=True):
    """Half-widths of the uniform noise on what a controller observes."""

    base_ang_vel: NonNegative = 0.0  # [rad/s]
    gravity: NonNegative = 0.0  # of the unit vector
    joint_pos: NonNegative = 0.0  # [rad]
    joint_vel: NonNegative = 0.0  # [rad/s]
    joint_torque: NonNegative = 0.0  # [N m]
    ee_pos: NonNegative = 0.0  # [m]
    ee_rot: NonNegative = 0.0  # of the entries of the rotation's first two columns


class Termination(_Table, frozen=True):
    """An episode ends, failed, when any of these is passed. Deterministic."""

    tilt: Positive = 1.2566370614359172  # [rad] 0.4 pi between the base's and the world's vertical
    base_height: NonNegative = 0.30  # [m]
    illegal_contact: bool = True  # base, shank or arm on the ground

    @property
    def min_upright(self) -> float:
        """Smallest cosine between the two verticals that does not end an episode.

        A cosine comes round again beyond pi, where no tilt is, and rounding may push it below -1: from pi on
        the limit is -inf.
        """
        return math.cos(self.tilt) if self.tilt < math.pi else -math.inf


class Success(_Table, frozen=True):
    """Both errors stay inside the tolerances throughout the final window. Source: paper, section IV-B."""

    position: Positive = 0.05  # [m]
    orientation: Positive = 0.12217304763960307  # [rad] 7 degrees
    window: Positive = 1.0  # [s]


class EvalProtocol(_Table, frozen=True):
    """A whole protocol."""

    name: str
    description: str
    episodes: Episodes
    targets: WorkspaceTargets | ReachTargets
    physics: Physics = Physics()
    randomization: Randomization = Randomization()
    push: Push = Push()
    noise: Noise = Noise()
    termination: Termination = Termination()
    success: Success = Success()
    reference_decay: Positive = 1.0  # [1/s] v_ref of the task-progress reference
    robot: RobotConfig = RobotConfig()

    @property
    def control_period(self) -> float:
        """[s]"""
        return self.physics.timestep * self.physics.decimation

    @property
    def num_steps(self) -> int:
        """Control steps of a whole episode."""
        return round(self.episodes.horizon / self.control_period)

    @property
    def window_steps(self) -> int:
        """Control steps of the success window."""
        return round(self.success.window / self.control_period)

    @property
    def digest(self) -> str:
        """SHA-256 over the canonical JSON of every field but the description."""
        return meaning_digest(self)


def read_protocol(path: Path) -> EvalProtocol:
    """The protocol of a TOML file.

    Raises:
        ProtocolError: unreadable, an unknown key, a wrong type or an impossible range; names the field.
    """
    protocol = read_toml(path, EvalProtocol, "protocol", ProtocolError)
    check_protocol(protocol, path)
    return protocol


def find_protocol(name: str) -> tuple[EvalProtocol, Path]:
    """A protocol by the name of a released one or by the path of a file, and where it stands.

    Raises:
        UnknownNameError: no such released protocol (with the nearest names).
        ProtocolError: see `read_protocol`.
    """
    if name.endswith(".toml"):
        path = Path(name)
    else:
        path = PROTOCOLS / f"{name}.toml"
        if name not in protocol_names():
            raise UnknownNameError("protocol", name, protocol_names(), "--protocol")
    protocol = read_protocol(path)
    released = PROTOCOLS / f"{protocol.name}.toml"
    own = real_path(path) != real_path(released)
    if own and protocol.name in protocol_names() and protocol.digest != read_protocol(released).digest:
        raise ProtocolError(
            f"protocol {path}: '{protocol.name}' is the name of a released protocol, and this one differs: "
            "give it another - at `$.name`"
        )
    return protocol, path


def load_protocol(name: str) -> EvalProtocol:
    """A protocol by the name of a released one or by the path of a file. Raises: see `find_protocol`."""
    return find_protocol(name)[0]


def protocol_names() -> list[str]:
    """Names of the released protocols."""
    return sorted(path.stem for path in PROTOCOLS.glob("*.toml"))


def check_protocol(protocol: EvalProtocol, path: Path | str) -> None:
    """Check what a type cannot say: finite numbers, ranges in order, windows inside episodes.

    Args:
        protocol: The protocol.
        path: Its file, or where else it comes from.

    Raises:
        ProtocolError: A value is not valid; names the field.
    """

    def refuse(problem: str, where: str) -> NoReturn:
        raise ProtocolError(f"protocol {path}: {problem} - at `$.{where}`")

    def walk(value: object, where: str) -> None:
        if isinstance(value, msgspec.Struct):
            for field in value.__struct_fields__:
                walk(getattr(value, field), f"{where}.{field}")
        elif isinstance(value, float) and not math.isfinite(value):
            refuse(f"{value} is not a finite number", where)
        elif isinstance(value, tuple):
            for item in value:
                walk(item, where)
            pair = len(value) == 2 and all(isinstance(item, float) for item in value)
            if pair and not where.startswith("robot") and value[0] > value[1]:  # gains are pairs, not ranges
                refuse(f"low {value[0]:g} is above high {value[1]:g}", where)

    for field in protocol.__struct_fields__:
        walk(getattr(protocol, field), field)

    if not is_folder_name(protocol.name):
        refuse(
            f"'{protocol.name}' cannot name a folder of results, valid: 1 to {LONGEST_NAME} ASCII letters, "
            "digits, '_' and '@', with '.' and '-' between them",
            "name",
        )
    episodes = protocol.episodes
    if episodes.replicates * episodes.per_replicate > MAX_EPISODES:
        refuse(
            f"{episodes.replicates} x {episodes.per_replicate} episodes, valid: at most {MAX_EPISODES}",
            "episodes.per_replicate",
        )
    horizon, period = protocol.episodes.horizon, protocol.control_period
    for name, seconds in (("episodes.horizon", horizon), ("success.window", protocol.success.window)):
        if seconds / period > MAX_STEPS:
            refuse(f"{seconds:g} s has more than {MAX_STEPS} control periods of {period:g} s", name)
        if abs(seconds / period - round(seconds / period)) > 1e-6 or seconds < period / 2:
            refuse(f"{seconds:g} s is not a whole number of control periods of {period:g} s", name)
    if protocol.success.window > horizon:
        refuse(f"{protocol.success.window:g} s is longer than the horizon of {horizon:g} s", "success.window")
    if protocol.episodes.seed >= 2**63:
        refuse(f"seed {protocol.episodes.seed} is too large, valid: below 2^63", "episodes.seed")

    spread, push, targets = protocol.randomization, protocol.push, protocol.targets
    for name in ("friction", "gain"):
        if getattr(spread, name)[0] <= 0:
            refuse(f"low {getattr(spread, name)[0]:g} must be positive", f"randomization.{name}")
    facts = load_facts(protocol.robot.variant)
    lightest = -next(link.mass for link in facts.links if link.name == facts.base)
    if spread.base_mass[0] <= lightest:
        refuse(
            f"low {spread.base_mass[0]:g} kg leaves no base, valid: above {lightest:g} kg",
            "randomization.base_mass",
        )
    if push.some and (MAX_PUSHES + 1) * push.interval[0] < horizon - push.quiet_end - 1e-9:
        refuse(
            f"{push.interval[0]:g} s leaves room for more than {MAX_PUSHES} pushes an episode",
            "push.interval",
        )

    if spread.step_height > 0 and "nominal" in getattr(targets, "conditions", ()):
        refuse("nominal episodes have a level floor, and one model serves all", "randomization.step_height")
    for problem, where in targets.mistakes(protocol.episodes):
        refuse(problem, where)
