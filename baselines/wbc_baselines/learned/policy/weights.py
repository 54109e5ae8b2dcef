"""The files of checkpoints: where they are, and the card and tensors in them.

Reading them needs no torch; `checkpoint` makes networks of torch of them and writes them.
"""

import hashlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wbc_baselines.learned.packaged import CHECKPOINTS
from wbc_baselines.learned.policy.architecture import tensor_shapes
from wbc_baselines.learned.policy.card import CheckpointError, PolicyCard, check_fit, read_card
from wbc_baselines.learned.policy.methods import METHODS
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.errors import UnknownNameError
from wbc_bench.readers import is_file, read_bytes
from wbc_bench.robot import Robot, load_robot
from wbc_bench.tensors import decode_tensors


class Weights(NamedTuple):
    """The content of a checkpoint."""

    card: PolicyCard
    tensors: dict[str, NDArray[np.float32]]  # `architecture.tensor_shapes` of its method


def read(path: Path, robot: Robot | None = None, protocol: EvalProtocol | None = None) -> Weights:
    """Read a checkpoint and check it.

    A policy may be evaluated with other targets, noise, randomization, pushes and physics steps than those of
    its training. Robot and control period must be the same.

    Args:
        path: PATH.safetensors.
        robot: Robot to control; None to leave it unchecked.
        protocol: Protocol whose robot and control period are checked; None to leave them unchecked.

    Returns:
        Card and tensors.

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
    wanted = tensor_shapes(METHODS[card.method].estimator, card.dimensions.context)
    return Weights(card, decode_tensors(data, path, "checkpoint", CheckpointError, wanted))


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
