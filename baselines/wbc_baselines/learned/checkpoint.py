"""Checkpoints: weights and normalisers as safetensors, and beside them a JSON card that says what they are.

Everything on the card is checked when a checkpoint is loaded: transfers fail in silence where joint order,
gains, limits, default posture or end-effector frame of the robot are not those of the training.
"""

import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import torch
from safetensors import SafetensorError
from safetensors.torch import load as tensors_of
from safetensors.torch import save as bytes_of

from wbc_baselines.learned import inputs
from wbc_baselines.learned.estimators import Estimator, make_estimator
from wbc_baselines.learned.methods import METHODS
from wbc_baselines.learned.networks import Actor
from wbc_bench import provenance
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.errors import BenchError, UnknownNameError
from wbc_bench.files import write_atomic
from wbc_bench.robot import JOINT_NAMES, Robot, load_robot, mount_of, tcp_of

FORMAT = 2
CHECKPOINTS = Path(__file__).with_name("checkpoints")  # METHOD@SEED.safetensors and .json
Numbers = tuple[float, ...]


class CheckpointError(BenchError):
    """A checkpoint that is missing, damaged, or not for this robot or protocol."""


class RobotFacts(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What of robot and protocol a policy depends on; per joint in `joints` order."""

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
    """Columns of inputs and outputs."""

    observation: int
    command: int
    history: int  # control steps
    history_term: int
    context: int
    state: int
    actions: int


class Card(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a checkpoint is and where it comes from."""

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
    start: str = ""  # name and SHA-256 of the checkpoint that it began with
    teacher: str = ""  # and of the one that it imitated at first
    sha256: str = ""  # of the safetensors file


class Checkpoint(NamedTuple):
    """A loaded checkpoint."""

    card: Card
    actor: Actor
    estimator: Estimator


def robot_facts(robot: Robot, control_period: float) -> RobotFacts:
    """The facts of a robot that is commanded every `control_period` [s]."""
    facts, tcp = robot.facts, tcp_of(robot.facts, robot.config)
    mount = mount_of(facts, robot.config)
    bodies = [facts.base, facts.fixed, facts.foot, facts.links, facts.joints, mount.lumps]
    built = msgspec.json.encode(_unsourced(msgspec.to_builtins(bodies)), order="deterministic")
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
    """What episodes of a protocol are like: `section.field` by value, as JSON holds it.

    Left out is what no policy meets (names, counts, seed, the rule of success), what `RobotFacts` holds, and
    the physics step, which is longer in training than in any evaluation.
    """
    sections = msgspec.to_builtins(protocol)
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


def other_conditions(card: Card, protocol: EvalProtocol) -> str:
    """`field: trained X, here Y` of every condition of a protocol that differs from the training's."""
    trained, here, lines = card.conditions, conditions(protocol), []
    names, kind = trained.keys() | here.keys(), "targets.type"
    if trained.get(kind) != here[kind]:  # then the other fields of targets have nothing in common
        names = {name for name in names if name == kind or not name.startswith("targets.")}
    for name in sorted(names):
        then, now = trained.get(name, "not set"), here.get(name, "not set")
        if then != now:
            lines.append(f"{name}: trained {_short(then)}, here {_short(now)}")
    return "; ".join(lines)


def new_card(method: str, seed: int, samples: int, wall_time: float, protocol: EvalProtocol) -> Card:
    """The card of a policy trained here, by this code: control steps and wall time [s] it took."""
    facts = robot_facts(load_robot(protocol.robot), protocol.control_period)
    commit, dirty = provenance.commit()
    return Card(
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
        dimensions=_dimensions(make_estimator(METHODS[method].estimator)),
    )


def save(path: Path, actor: Actor, estimator: Estimator, card: Card) -> None:
    """Write PATH.safetensors and its card; a card never stands beside weights that are not its own."""
    tensors = {f"actor.{name}": value for name, value in actor.state_dict().items()}
    tensors |= {f"estimator.{name}": value for name, value in estimator.state_dict().items()}
    data = bytes_of({name: value.detach().cpu().contiguous() for name, value in tensors.items()})
    card = msgspec.structs.replace(card, sha256=hashlib.sha256(data).hexdigest())
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, data)
    text = msgspec.json.format(msgspec.json.encode(card), indent=2)
    write_atomic(card_path(path), text + b"\n")


def load(path: Path, robot: Robot | None = None, protocol: EvalProtocol | None = None) -> Checkpoint:
    """The checkpoint of a file, fit for a robot and a protocol where they are given.

    Protocols may differ in targets, noise, randomisation, pushes and physics step: a policy is evaluated
    under many. Robot and control period must be those of the training.

    Raises:
        CheckpointError: missing, truncated or altered file, other dimensions, robot or control period.
        UnknownNameError: a method that does not exist.
    """
    card = read_card(path)
    data = path.read_bytes()
    found = hashlib.sha256(data).hexdigest()
    if found != card.sha256:
        raise CheckpointError(
            f"checkpoint '{path}' is truncated or altered: SHA-256 {found[:12]} of {len(data)} bytes, "
            f"its card says {card.sha256[:12]}"
        )
    if protocol is not None:
        robot = load_robot(protocol.robot)
    check_fit(card, robot, protocol.control_period if protocol else None, str(path))
    estimator = make_estimator(METHODS[card.method].estimator)
    actor = Actor(estimator.context_dim)
    try:
        tensors = tensors_of(data)
    except SafetensorError as error:
        raise CheckpointError(f"checkpoint '{path}' is not a safetensors file: {error}") from error
    _fill(path, {"actor": actor, "estimator": estimator}, tensors)
    return Checkpoint(card, actor.eval(), estimator.eval())


def identity(name: str) -> str:
    """Name and SHA-256 of a checkpoint's weights, for the card of one that comes from it; "" of no name."""
    return f"{find(name).stem} {read_card(find(name)).sha256}" if name else ""


def load_start(name: str, estimator: str) -> Checkpoint:
    """A checkpoint that a method with this estimator can begin with; see `shared_context`.

    Raises: CheckpointError, its estimator is a third one; and see `load`.
    """
    found = load(find(name))
    theirs = METHODS[found.card.method]
    if theirs.estimates and theirs.estimator != estimator:
        raise CheckpointError(
            f"--start '{name}' is of {found.card.method}, valid: a method without a context, the oracle, "
            f"or a method with the estimator '{estimator}'"
        )
    return found


def shared_context(start: Estimator, mine: Estimator) -> int:
    """First columns of the context that mean the same in two policies: all, or the velocity, or none."""
    if type(start) is type(mine):
        return mine.context_dim
    return inputs.VELOCITY if start.context_dim and mine.trainable else 0


def load_teacher(name: str) -> Checkpoint:
    """A checkpoint whose answer to a state does not depend on those before it.

    Raises: CheckpointError, its context is estimated; and see `load`.
    """
    found = load(find(name))
    if found.estimator.trainable:
        raise CheckpointError(
            f"--teacher '{name}' is of {found.card.method}, valid: a method without an estimated context"
        )
    return found


def read_card(path: Path) -> Card:
    """The card beside a safetensors file, itself whole and of a method and dimensions that exist here.

    Raises: CheckpointError, UnknownNameError.
    """
    beside = card_path(path)
    for file in (path, beside):
        if not file.is_file():
            raise CheckpointError(f"checkpoint '{path}': there is no file '{file}'")
    return decode_card(beside.read_bytes(), str(beside))


def decode_card(text: bytes, where: str) -> Card:
    """The card of a JSON text. Raises: CheckpointError, UnknownNameError."""
    try:
        version = msgspec.json.decode(text, type=_Version).format
        if version != FORMAT:
            raise CheckpointError(f"checkpoint card '{where}' has format {version}, valid: {FORMAT}")
        card = msgspec.json.decode(text, type=Card)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise CheckpointError(f"checkpoint card '{where}' cannot be read: {error}") from error
    if card.method not in METHODS:
        raise UnknownNameError("method", card.method, METHODS, where)
    here = _dimensions(make_estimator(METHODS[card.method].estimator))
    if differences := _differences(card.dimensions, here):
        raise CheckpointError(f"checkpoint card '{where}' has other dimensions: {differences}")
    if card.robot_digest != _digest(card.robot):
        raise CheckpointError(f"checkpoint card '{where}' was altered: its robot does not match its digest")
    return card


def check_fit(card: Card, robot: Robot | None, control_period: float | None, where: str) -> None:
    """Raises: CheckpointError with every field in which robot or control period [s] differ from training."""
    period = card.robot.control_period if control_period is None else control_period
    here = robot_facts(robot, period) if robot else msgspec.structs.replace(card.robot, control_period=period)
    if differences := _differences(card.robot, here):
        raise CheckpointError(f"checkpoint '{where}' was trained on another robot: {differences}")


def find(name: str) -> Path:
    """The file of `METHOD@SEED` among the checkpoints of this package, or of `PATH.safetensors`.

    Raises: UnknownNameError, no such checkpoint (with the nearest names).
    """
    if name.endswith(".safetensors"):
        return Path(name)
    path = CHECKPOINTS / f"{name}.safetensors"
    if not path.is_file():
        known = available()
        method = name.partition("@")[0]
        if method not in METHODS:
            raise UnknownNameError("checkpoint", name, known or METHODS, "METHOD@SEED or PATH.safetensors")
        raise UnknownNameError("checkpoint", name, known, f"{METHODS[method].label}: none trained or shipped")
    return path


def available() -> list[str]:
    """Names METHOD@SEED of the checkpoints of this package."""
    return sorted(path.stem for path in CHECKPOINTS.glob("*@*.safetensors"))


def card_path(path: Path) -> Path:
    """Where the card of a safetensors file stands: beside it."""
    return path.with_suffix(".json")


class _Version(msgspec.Struct):
    format: int


def _dimensions(estimator: Estimator) -> Dimensions:
    return Dimensions(
        observation=inputs.OBSERVATION,
        command=inputs.COMMAND,
        history=inputs.HISTORY,
        history_term=inputs.HISTORY_TERM,
        context=estimator.context_dim,
        state=estimator.state_dim,
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


def _fill(path: Path, modules: dict[str, torch.nn.Module], tensors: dict[str, torch.Tensor]) -> None:
    """Put tensors into modules; names and shapes must match, one to one."""
    wanted = {f"{part}.{name}": v for part, m in modules.items() for name, v in m.state_dict().items()}

    def refuse(problem: str, names: Iterable[str]) -> None:
        if names := sorted(names):
            raise CheckpointError(
                f"checkpoint '{path}': {problem} {', '.join(names[:3])} ({len(names)} in all)"
            )

    refuse("it lacks", wanted.keys() - tensors.keys())
    refuse("it has tensors that the method does not know,", tensors.keys() - wanted.keys())
    refuse("wrong shape of", [name for name, v in wanted.items() if v.shape != tensors[name].shape])
    refuse("not a number in", [name for name, v in tensors.items() if not v.isfinite().all()])
    for name, value in wanted.items():
        value.copy_(tensors[name])


def _short(value: Any) -> str:
    return value if isinstance(value, str) else msgspec.json.encode(value).decode()


def _digest(facts: RobotFacts) -> str:
    return hashlib.sha256(msgspec.json.encode(facts)).hexdigest()


def _unsourced(value):
    """Without the remarks on where a fact comes from."""
    if isinstance(value, dict):
        return {key: _unsourced(item) for key, item in value.items() if key != "src"}
    if isinstance(value, list | tuple):
        return [_unsourced(item) for item in value]
    return value
