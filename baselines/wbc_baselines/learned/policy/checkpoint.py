"""Checkpoints as networks of torch: weights and normalizers as safetensors, with a card beside them.

See `weights` for their files and `card` for the card.
"""

import hashlib
from pathlib import Path
from typing import NamedTuple

import msgspec
import torch
from safetensors.torch import save as bytes_of

from wbc_baselines.learned.policy import inputs, weights
from wbc_baselines.learned.policy.card import CheckpointError, PolicyCard, card_path, read_card
from wbc_baselines.learned.policy.estimators import Estimator, Oracle, make_estimator
from wbc_baselines.learned.policy.methods import METHODS
from wbc_baselines.learned.policy.networks import Actor
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.files import write_atomic
from wbc_bench.robot import Robot


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
    """Load the networks of a checkpoint, see `weights.read`.

    Args:
        path: PATH.safetensors.
        robot: Robot to control; None to leave it unchecked.
        protocol: Protocol whose robot and control period are checked; None to leave them unchecked.

    Returns:
        Card and networks in evaluation mode.

    Raises:
        CheckpointError: The files are damaged, or do not fit robot or protocol.
        UnknownNameError: There is no such method.
    """
    card, tensors = weights.read(path, robot, protocol)
    estimator = make_estimator(METHODS[card.method].estimator)
    if isinstance(estimator, Oracle):
        estimator = Oracle(card.dimensions.context)  # of as many columns as it was trained with
    actor = Actor(estimator.context_dim)
    for part, module in (("actor", actor), ("estimator", estimator)):
        for name, value in module.state_dict().items():
            value.copy_(torch.from_numpy(tensors[f"{part}.{name}"]))
    return Checkpoint(card, actor.eval(), estimator.eval())


def identity(name: str, robot: str) -> str:
    """Return name and SHA-256 of a checkpoint, for the cards of those trained from it; "" for no name."""
    if not name:
        return ""
    path = weights.find(name, robot)
    return f"{path.stem} {read_card(path).sha256}"


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
    found = load(weights.find(name, robot))
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
    found = load(weights.find(name, robot))
    if found.estimator.trainable:
        raise CheckpointError(
            f"--teacher '{name}' is of {found.card.method}, valid: a method without an estimated context"
        )
    return found
