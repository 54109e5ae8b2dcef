"""The controller interface: what a controller sees, what it answers, and what it says of itself."""

from pathlib import Path
from typing import Literal, NamedTuple, Protocol, get_args, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from wbc_bench.episodes.protocol import EvalProtocol

Array = NDArray[np.float64]
Signal = Literal["proprioception", "ee_pose", "base_pose", "privileged"]
SIGNALS: tuple[Signal, ...] = get_args(Signal)
CommandPart = Literal["kp", "kd", "qd", "torque", "action"]
COMMAND_PARTS: tuple[CommandPart, ...] = get_args(CommandPart)  # what a command may carry beside positions
DEPLOYABLE: frozenset[Signal] = frozenset({"proprioception", "ee_pose"})  # what the paper's policy may see


class ControllerInfo(NamedTuple):
    """What a controller says of itself.

    Signals that it does not declare are not passed to it; undeclared parts of a command are refused.
    """

    name: str
    signals: frozenset[Signal]
    control_period: float  # [s]
    source: str  # paper, package or file it comes from
    files: tuple[Path, ...] = ()  # weights and the like: other contents make another controller
    commands: frozenset[CommandPart] = frozenset()  # parts of `JointCommand` that it uses beside `q`


class Proprioception(NamedTuple):
    """Noisy onboard measurements of N robots."""

    base_ang_vel_b: Array  # (N, 3) [rad/s] gyro
    gravity_b: Array  # (N, 3) unit vector pointing down, in the base frame
    joint_pos: Array  # (N, 14) [rad]
    joint_vel: Array  # (N, 14) [rad/s]
    joint_torque: Array  # (N, 14) [N m] estimated from motor current


class EePose(NamedTuple):
    """Noisy end-effector pose in the base frame."""

    pos_b: Array  # (N, 3) [m]
    rot6_b: Array  # (N, 6) first two columns of the rotation


class BasePose(NamedTuple):
    """True pose and velocity of the base."""

    pos_w: Array  # (N, 3) [m]
    rot_w: Array  # (N, 3, 3)
    lin_vel_w: Array  # (N, 3) [m/s]


class Privileged(NamedTuple):
    """What only a simulation knows."""

    friction: Array  # (N,)
    base_mass: Array  # (N,) [kg] added to the base
    kp_scale: Array  # (N, 14)
    kd_scale: Array  # (N, 14)
    foot_force_w: Array  # (N, 2, 3) [N] ground on left and right sole
    base_lin_vel_b: Array  # (N, 3) [m/s]
    joint_torque: Array  # (N, 14) [N m] without noise
    foot_pos_b: Array  # (N, 2, 3) [m] left and right sole
    # mean rates over the last control period, zero at the start; the end-effector's is seen from the world
    joint_acc: Array  # (N, 14) [rad/s^2]
    ee_lin_vel_b: Array  # (N, 3) [m/s]
    ee_ang_vel_b: Array  # (N, 3) [rad/s]
    # what an episode draws and hides, see `wbc_bench.episodes.protocol.Randomization`
    payload: Array  # (N,) [kg] in the hand
    payload_offset: Array  # (N, 3) [m] from the end-effector, in the frame of its link
    motor_strength: Array  # (N,)
    joint_offset: Array  # (N, 14) [rad]
    imu_tilt: Array  # (N, 2) [rad] rotation vector
    command_delay: Array  # (N,) [s]
    observation_delay: Array  # (N,) [s]
    odometry_delay: Array  # (N,) [s]
    odometry_error_b: Array  # (N, 3) [m] how far its drift puts the base off


class Observation(NamedTuple):
    """What a controller sees of N episodes at one control step; undeclared signals are None."""

    time: float  # [s] since the start of the episode
    active: NDArray[np.bool_]  # (N,) episodes still running; commands of the others are ignored
    proprioception: Proprioception | None
    ee_pose: EePose | None
    base_pose: BasePose | None
    privileged: Privileged | None


def signal_of(field: str) -> Signal | None:
    """The signal that has a field of this name; the first of `SIGNALS` where two have it."""
    kinds = Proprioception, EePose, BasePose, Privileged
    return next((s for s, kind in zip(SIGNALS, kinds, strict=True) if field in kind._fields), None)


class Target(NamedTuple):
    """The end-effector pose asked for, in the instantaneous base frame."""

    pos_b: Array  # (N, 3) [m]
    rot_b: Array  # (N, 3, 3)


class JointCommand(NamedTuple):
    """What the 500 Hz PD loop tracks until the next control step.

    The motors exert kp (q - joint_pos) + kd (qd - joint_vel) + torque, within the torque limits and the motor
    model of the robot's variant. Where kp or kd is None it is the variant's, where qd or torque is None it is
    zero. An episode's random factors on gains multiply commanded gains, too.
    """

    q: Array  # (N, 14) [rad]
    infeasible: NDArray[np.bool_] | None = None  # (N,) steps on which a solver found nothing
    kp: Array | None = None  # (N, 14) [N m/rad] zero or more
    kd: Array | None = None  # (N, 14) [N m s/rad] zero or more
    qd: Array | None = None  # (N, 14) [rad/s]
    torque: Array | None = None  # (N, 14) [N m] feed-forward
    action: Array | None = None  # (N, A) [1] normalised by the controller's own scales, for metrics alone


@runtime_checkable
class ProtocolAware(Protocol):
    """A controller that reads the protocol: its reference decays at the protocol's rate, for example."""

    def prepare(self, protocol: EvalProtocol) -> None:
        """Called once, before the first reset. Raises: BenchError, what of the protocol it cannot meet."""
        ...


@runtime_checkable
class UsesRandomness(Protocol):
    """A controller that draws at random, from a stream of its own.

    Draws from the global generators of `random`, NumPy and PyTorch are repeatable as well: for the time of a
    controller's code they are seeded anew for every shard, and restored afterwards.
    """

    def seed(self, rng: np.random.Generator) -> None:
        """Called before each reset; the stream depends on the episodes alone."""
        ...


@runtime_checkable
class Exportable(Protocol):
    """A controller that can be written to a file for other runtimes."""

    formats: tuple[str, ...]

    def export(self, path: Path, format: str) -> None:
        """Write it in one of its formats."""
        ...


@runtime_checkable
class HasLatent(Protocol):
    """A controller that shows what it infers of the robot's dynamics and acts upon, for a picture of it."""

    def latent(self) -> Array:
        """(N, D) behind the latest commands. Raises: BenchError, this variant infers nothing."""
        ...


@runtime_checkable
class SeededFactory(Protocol):
    """A factory whose variants may stand for several controllers, e.g. one training seed a replicate."""

    def variant_for(self, variant: str, replicate: int) -> str:
        """The variant that meets the episodes of one replicate."""
        ...


@runtime_checkable
class HasVariants(Protocol):
    """A factory that names its variants, for `wbc-bench list`."""

    def variants(self) -> list[tuple[str, str]]:
        """Return (variant, description); the variant "" is the controller's name alone."""
        ...


class Controller(Protocol):
    """A batched controller. It is built by calling its factory with the `Robot` it will drive."""

    info: ControllerInfo

    def reset(self, episodes: NDArray[np.int64], obs: Observation, target: Target) -> None:
        """Forget everything and start the episodes with these numbers, (N,)."""
        ...

    def act(self, obs: Observation, target: Target) -> JointCommand:
        """The commands of one control step."""
        ...
