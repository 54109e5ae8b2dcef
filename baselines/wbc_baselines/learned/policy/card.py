"""The card of a checkpoint: the policy's method, its training, and the robot that it was trained for.

The card is checked whenever a checkpoint is loaded, because a policy fails silently if joint order, gains,
limits, default posture or end-effector frame of the robot differ from those of the training.
"""

import hashlib
from pathlib import Path
from typing import Any

import msgspec

from wbc_baselines.learned.policy import inputs
from wbc_baselines.learned.policy.architecture import ORACLE_CONTEXTS, SIZES
from wbc_baselines.learned.policy.methods import METHODS
from wbc_bench import provenance
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.errors import BenchError, UnknownNameError
from wbc_bench.readers import decode_json, is_file, read_bytes
from wbc_bench.robot import JOINT_NAMES, Robot, load_robot, mount_of, tcp_of, without_sources
from wbc_bench.schema import meaning

FORMAT = 2
Numbers = tuple[float, ...]


class CheckpointError(BenchError):
    """A checkpoint that is missing, damaged, or not for this robot or protocol."""


class RobotFacts(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The properties of robot and protocol that a policy depends on; joint values in `joints` order."""

    joints: tuple[str, ...]
    default_q: Numbers  # [rad]
    action_scale: Numbers  # [rad]
    kp: Numbers  # [N m/rad]
    kd: Numbers  # [N m s/rad]
    effort: Numbers  # [N m]
    lower: Numbers  # [rad]
    upper: Numbers  # [rad]
    velocity: Numbers  # [rad/s]
    mount: str
    mount_xyz: Numbers  # [m] arm base in the base frame
    ee_link: str
    ee_xyz: Numbers  # [m] tool centre point in the frame of its link
    control_period: float  # [s]
    bodies: str  # SHA-256 over masses, inertias, geometry and joint frames


class Dimensions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Numbers of columns of the inputs and outputs."""

    observation: int
    command: int
    history: int  # control steps
    history_frame: int = msgspec.field(name="history_term")
    context: int
    state: int
    actions: int


class PolicyCard(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The identity and origin of a checkpoint. The JSON file keeps the first names of renamed fields."""

    format: int
    method: str
    seed: int
    samples: int  # control steps of training
    wall_time: float  # [s] of training
    machine: dict[str, str | int | float]
    protocol: str
    protocol_digest: str
    conditions: dict[str, Any]  # of `protocol`, `section.field` by value
    robot_digest: str  # SHA-256 over `robot`
    robot: RobotFacts
    git_commit: str | None
    git_dirty: bool
    dimensions: Dimensions
    # name and SHA-256 of the checkpoint that initialized it, and of the one it was distilled from
    init_checkpoint: str = msgspec.field(default="", name="start")
    teacher: str = ""
    sha256: str = ""  # of the safetensors file
    # control steps and SHA-256 of the checkpoints whose mean it is, see `average`
    mean_of: tuple[str, ...] = ()


def robot_facts(robot: Robot, control_period: float) -> RobotFacts:
    """Collect the facts of a robot that is commanded every `control_period` [s]."""
    facts, tcp = robot.facts, tcp_of(robot.facts, robot.config)
    mount = mount_of(facts, robot.config)
    bodies = [facts.base, facts.fixed, facts.foot, facts.links, facts.joints, mount.lumps]
    later = [facts.variant.motor, facts.variant.joint_friction, tcp.rpy]
    if later != [None, False, (0.0, 0.0, 0.0)]:  # cards from before these facts keep their digest
        bodies += later
    built = msgspec.json.encode(without_sources(msgspec.to_builtins(bodies)), order="deterministic")
    return RobotFacts(
        joints=JOINT_NAMES,
        **{
            name: tuple(getattr(robot, name).tolist())
            for name in ("default_q", "action_scale", "kp", "kd", "effort", "lower", "upper", "velocity")
        },
        mount=robot.config.mount or facts.default_mount,
        mount_xyz=mount.xyz,
        ee_link=tcp.link,
        ee_xyz=tcp.xyz,
        control_period=control_period,
        bodies=hashlib.sha256(built).hexdigest(),
    )


def conditions(protocol: EvalProtocol) -> dict[str, Any]:
    """Collect the conditions of a protocol's episodes, `section.field` by value, in the types of JSON.

    Properties that no policy can notice are left out (names, counts, seed, the rule of success), as are those
    in `RobotFacts`, and the physics step, which is longer in training than in any evaluation.
    """
    sections = meaning(protocol)
    for name in ("name", "description", "success", "robot", "physics"):
        del sections[name]
    sections["episodes"] = {"horizon": sections["episodes"]["horizon"]}
    found = {}
    for section, value in sections.items():
        if isinstance(value, dict):
            found |= {f"{section}.{field}": item for field, item in value.items()}
        else:
            found[section] = value
    return msgspec.json.decode(msgspec.json.encode(found))


def other_conditions(card: PolicyCard, protocol: EvalProtocol) -> str:
    """Describe all conditions of a protocol that differ from the training, `field: trained X, here Y`."""
    trained, here, lines = card.conditions, conditions(protocol), []
    names, kind = trained.keys() | here.keys(), "targets.type"
    if trained.get(kind) != here[kind]:  # then the other fields of targets have nothing in common
        names = {name for name in names if name == kind or not name.startswith("targets.")}
    for name in sorted(names):
        then, now = trained.get(name, "not set"), here.get(name, "not set")
        if then != now:
            lines.append(f"{name}: trained {_short(then)}, here {_short(now)}")
    return "; ".join(lines)


def new_card(method: str, seed: int, samples: int, wall_time: float, protocol: EvalProtocol) -> PolicyCard:
    """Create the card of a policy that this code has trained.

    Args:
        method: Method of the study.
        seed: Seed of the training.
        samples: Control steps of the training.
        wall_time: Duration of the training [s].
        protocol: Protocol of the training.

    Returns:
        The card, without the digest of the weights.
    """
    facts = robot_facts(load_robot(protocol.robot), protocol.control_period)
    commit, dirty = provenance.commit()
    return PolicyCard(
        format=FORMAT,
        method=method,
        seed=seed,
        samples=samples,
        wall_time=wall_time,
        machine=provenance.machine(),
        protocol=protocol.name,
        protocol_digest=protocol.digest,
        conditions=conditions(protocol),
        robot_digest=_digest(facts),
        robot=facts,
        git_commit=commit,
        git_dirty=dirty,
        dimensions=_dimensions(method),
    )


def read_card(path: Path) -> PolicyCard:
    """Read and check the card beside a safetensors file.

    Args:
        path: The safetensors file.

    Returns:
        The card, of a method and dimensions that exist here.

    Raises:
        CheckpointError: A file is missing, or the card is damaged or of other dimensions.
        UnknownNameError: There is no such method.
    """
    beside = card_path(path)
    for file in (path, beside):
        if not is_file(file):
            raise CheckpointError(f"checkpoint '{path}': there is no file '{file}'")
    return decode_card(read_bytes(beside, "checkpoint card", CheckpointError), str(beside))


def decode_card(text: bytes, where: str) -> PolicyCard:
    """Decode and check a card.

    Args:
        text: JSON text.
        where: Name of its file, for error messages.

    Returns:
        The card, of a method and dimensions that exist here.

    Raises:
        CheckpointError: The card is damaged, altered, or of another format or other dimensions.
        UnknownNameError: There is no such method.
    """
    version = decode_json(text, where, _Version, "checkpoint card", CheckpointError).format
    if version != FORMAT:
        raise CheckpointError(f"checkpoint card '{where}' has format {version}, valid: {FORMAT}")
    card = decode_json(text, where, PolicyCard, "checkpoint card", CheckpointError)
    if card.method not in METHODS:
        raise UnknownNameError("method", card.method, METHODS, where)
    here = _dimensions(card.method, card.dimensions.context)
    if differences := _differences(card.dimensions, here):
        raise CheckpointError(f"checkpoint card '{where}' has other dimensions: {differences}")
    if card.robot_digest != _digest(card.robot):
        raise CheckpointError(f"checkpoint card '{where}' was altered: its robot does not match its digest")
    if not card.robot.control_period > 0:
        raise CheckpointError(
            f"checkpoint card '{where}': control period {card.robot.control_period:g} s, valid: above 0"
        )
    return card


def check_fit(card: PolicyCard, robot: Robot | None, control_period: float | None, where: str) -> None:
    """Check that a policy fits a robot and a control period.

    Args:
        card: Card of the policy.
        robot: Robot to control; None to leave it unchecked.
        control_period: Control period [s]; None to leave it unchecked.
        where: Name of the checkpoint, for error messages.

    Raises:
        CheckpointError: Robot or control period differ from the training; all differing fields are listed.
    """
    period = card.robot.control_period if control_period is None else control_period
    here = robot_facts(robot, period) if robot else msgspec.structs.replace(card.robot, control_period=period)
    if differences := _differences(card.robot, here):
        raise CheckpointError(f"checkpoint '{where}' was trained on another robot: {differences}")


def card_path(path: Path) -> Path:
    """Return the path of the card of a safetensors file, which is stored beside it."""
    return path.with_suffix(".json")


class _Version(msgspec.Struct):
    format: int


def _dimensions(method: str, context: int | None = None) -> Dimensions:
    """Those of a method; of an oracle, those with as many columns of context as it has, if there are such."""
    sizes = SIZES[METHODS[method].estimator]
    return Dimensions(
        observation=inputs.OBSERVATION,
        command=inputs.COMMAND,
        history=inputs.HISTORY,
        history_frame=inputs.HISTORY_FRAME,
        context=context if method == "oracle" and context in ORACLE_CONTEXTS else sizes.context,
        state=sizes.state,
        actions=inputs.ACTIONS,
    )


def _differences(trained: msgspec.Struct, here: msgspec.Struct) -> str:
    """`name: trained X, here Y` of every field that differs; of a tuple, its first entry that does."""
    lines = []
    for name in trained.__struct_fields__:
        then, now = getattr(trained, name), getattr(here, name)
        if then == now:
            continue
        if isinstance(then, tuple) and len(then) == len(now):
            k = next(k for k, pair in enumerate(zip(then, now, strict=True)) if pair[0] != pair[1])
            others = sum(a != b for a, b in zip(then, now, strict=True)) - 1
            more = f" and {others} more" if others else ""
            lines.append(f"{name}[{k}]: trained {then[k]}, here {now[k]}{more}")
        elif name == "bodies":
            lines.append(f"bodies (masses, inertias or geometry): trained {then[:12]}, here {now[:12]}")
        else:
            lines.append(f"{name}: trained {then}, here {now}")
    return "; ".join(lines)


def _short(value: Any) -> str:
    return value if isinstance(value, str) else msgspec.json.encode(value).decode()


def _digest(facts: RobotFacts) -> str:
    return hashlib.sha256(msgspec.json.encode(facts)).hexdigest()
