"""Checkpoints: weights and normalizers as safetensors, with a card (see `card`) beside them."""

import hashlib
from pathlib import Path
from typing import NamedTuple

import msgspec
from safetensors.torch import save as bytes_of

from wbc_baselines.learned.packaged import CHECKPOINTS
from wbc_baselines.learned.policy import inputs
from wbc_baselines.learned.policy.card import (
    CheckpointError,
    PolicyCard,
    card_path,
    check_fit,
    estimator_of,
    read_card,
)
from wbc_baselines.learned.policy.estimators import Estimator
from wbc_baselines.learned.policy.methods import METHODS
from wbc_baselines.learned.policy.networks import Actor
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.errors import UnknownNameError
from wbc_bench.files import write_atomic
from wbc_bench.readers import is_file, read_bytes
from wbc_bench.robot import Robot, load_robot
from wbc_bench.tensors import decode_tensors


class Checkpoint(NamedTuple):
    """A loaded checkpoint."""

    card: PolicyCard
    actor: Actor
    estimator: Estimator


def save(path: Path, actor: Actor, estimator: Estimator, card: PolicyCard) -> None:
    """Write a checkpoint and its card, which contains the digest of the weights.

    Args:
        path: PATH.safetensors.
        actor: Policy network.
        estimator: Estimator of its context.
        card: Card without the digest.
    """
    tensors = {f"actor.{name}": value for name, value in actor.state_dict().items()}
    tensors |= {f"estimator.{name}": value for name, value in estimator.state_dict().items()}
    data = bytes_of({name: value.detach().cpu().contiguous() for name, value in tensors.items()})
    card = msgspec.structs.replace(card, sha256=hashlib.sha256(data).hexdigest())
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, data)
    text = msgspec.json.format(msgspec.json.encode(card), indent=2)
    write_atomic(card_path(path), text + b"\n")


def load(path: Path, robot: Robot | None = None, protocol: EvalProtocol | None = None) -> Checkpoint:
    """Load a checkpoint and check it.

    A policy may be evaluated with other targets, noise, randomization, pushes and physics steps than those of
    its training. Robot and control period must be the same.

    Args:
        path: PATH.safetensors.
        robot: Robot to control; None to leave it unchecked.
        protocol: Protocol whose robot and control period are checked; None to leave them unchecked.

    Returns:
        Card and networks in evaluation mode.

    Raises:
        CheckpointError: A file is missing, truncated or altered, or dimensions, robot or control period
            differ.
        UnknownNameError: There is no such method.
    """
    card = read_card(path)
    data = read_bytes(path, "checkpoint", CheckpointError)
    found = hashlib.sha256(data).hexdigest()
    if found != card.sha256:
        raise CheckpointError(
            f"checkpoint '{path}' is truncated or altered: SHA-256 {found[:12]} of {len(data)} bytes, "
            f"its card says {card.sha256[:12]}"
        )
    if protocol is not None:
        robot = load_robot(protocol.robot)
    check_fit(card, robot, protocol.control_period if protocol else None, str(path))
    estimator = estimator_of(card)
    actor = Actor(estimator.context_dim)
    modules = {"actor": actor, "estimator": estimator}
    wanted = {f"{part}.{name}": v for part, m in modules.items() for name, v in m.state_dict().items()}
    tensors = decode_tensors(data, path, "checkpoint", CheckpointError, wanted)
    for name, value in wanted.items():
        value.copy_(tensors[name])
    return Checkpoint(card, actor.eval(), estimator.eval())


def identity(name: str, robot: str) -> str:
    """Return name and SHA-256 of a checkpoint, for the cards of those trained from it; "" for no name."""
    return f"{find(name, robot).stem} {read_card(find(name, robot)).sha256}" if name else ""


def load_init_checkpoint(name: str, estimator: str, robot: str) -> Checkpoint:
    """Load a checkpoint that can initialize a method with this estimator, see `shared_context`.

    Args:
        name: METHOD@SEED, ROBOT/METHOD@SEED or PATH.safetensors.
        estimator: Name of the estimator of the method to train.
        robot: Variant of the robot to train for.

    Returns:
        The checkpoint.

    Raises:
        CheckpointError: It has a different estimator; and see `load`.
        UnknownNameError: There is no such checkpoint.
    """
    found = load(find(name, robot))
    theirs = METHODS[found.card.method]
    if theirs.estimates and theirs.estimator != estimator:
        raise CheckpointError(
            f"--init-checkpoint '{name}' is of {found.card.method}, valid: a method without a context, "
            f"the oracle, or a method with the estimator '{estimator}'"
        )
    return found


def shared_context(init: Estimator, mine: Estimator) -> int:
    """Count the first context columns with the same meaning in two policies: all, the velocity, or none.

    Args:
        init: Estimator of the checkpoint.
        mine: Estimator of the method to train.

    Returns:
        Number of shared columns.
    """
    if type(init) is type(mine):
        return min(init.context_dim, mine.context_dim)  # an oracle's first columns are always the same
    return inputs.VELOCITY if init.context_dim and mine.trainable else 0


def load_teacher(name: str, robot: str) -> Checkpoint:
    """Load a checkpoint whose action depends on the current state only.

    Args:
        name: METHOD@SEED or PATH.safetensors.
        robot: Variant of the robot to train for.

    Returns:
        The checkpoint.

    Raises:
        CheckpointError: Its context is estimated from a history; and see `load`.
        UnknownNameError: There is no such checkpoint.
    """
    found = load(find(name, robot))
    if found.estimator.trainable:
        raise CheckpointError(
            f"--teacher '{name}' is of {found.card.method}, valid: a method without an estimated context"
        )
    return found


def find(name: str, robot: str) -> Path:
    """Find the file of a checkpoint.

    Args:
        name: METHOD@SEED of a checkpoint of this package, ROBOT/METHOD@SEED for another robot's, or
            PATH.safetensors.
        robot: Variant of the robot, of which each has checkpoints of its own.

    Returns:
        The safetensors file.

    Raises:
        UnknownNameError: There is no such checkpoint; the nearest names are listed.
    """
    if name.endswith(".safetensors"):
        return Path(name)
    their_robot, _, name = name.rpartition("/")
    robot = their_robot or robot
    path = CHECKPOINTS / robot / f"{name}.safetensors"
    if not is_file(path):
        known = available(robot)
        method = name.partition("@")[0]
        if method not in METHODS:
            raise UnknownNameError("checkpoint", name, known or METHODS, "METHOD@SEED or PATH.safetensors")
        where = f"{METHODS[method].label}: none trained or shipped for the robot '{robot}'"
        raise UnknownNameError("checkpoint", name, known, where)
    return path


def available(robot: str) -> list[str]:
    """List the checkpoints of this package for a variant of the robot as METHOD@SEED."""
    return sorted(path.stem for path in (CHECKPOINTS / robot).glob("*@*.safetensors"))
