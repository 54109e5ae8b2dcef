"""A trained policy: from two looks at hand and door to a chunk of hand poses, and the file it is kept in."""

import hashlib
from pathlib import Path

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import save as bytes_of
from torch import Tensor, nn

from wbc_bench.errors import SourceError
from wbc_bench.files import write_atomic
from wbc_bench.readers import decode_json, read_bytes, reading
from wbc_bench.sources.diffusion import poses
from wbc_bench.sources.diffusion.demonstrations import DOOR
from wbc_bench.sources.diffusion.denoising import Denoiser, sample
from wbc_bench.sources.slew import Pose
from wbc_bench.tensors import decode_tensors

Array = NDArray[np.float64]
FORMAT = 1
PERIOD = 0.1  # [s] between two poses of a chunk, and between the two looks
HORIZON = 16  # poses of a chunk
LOOKS = 2  # the one before, and now
ACTION = poses.POSE + 1  # a pose and the gripper's width
LOOK = poses.POSE + 1 + DOOR  # the hand as seen from where it is now, the gripper's width, the door
HIDDEN = 224  # the largest whose file stays below a megabyte
CARD = "card"  # the one entry of the file's metadata: the order of several is not determined


class DoorPolicyCard(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What a policy is and where it comes from."""

    format: int
    seed: int
    demonstrations: int
    demonstrations_seed: int | None  # of their doors
    demonstrations_sha256: str
    samples: int  # windows of the demonstrations
    steps: int  # of the optimiser
    batch: int
    hidden: int
    git_commit: str | None
    git_dirty: bool
    torch: str  # version


class _Header(msgspec.Struct):
    """What is read here of a safetensors file's header."""

    metadata: dict[str, str] = msgspec.field(default_factory=dict, name="__metadata__")


class Policy(nn.Module):
    """Normalisers and network; ranges of every number of a look and of every step's action."""

    look_middle: Tensor
    look_half: Tensor
    action_middle: Tensor
    action_half: Tensor

    def __init__(self, hidden: int = HIDDEN) -> None:
        super().__init__()
        self.denoiser = Denoiser(HORIZON * ACTION, LOOKS * LOOK, hidden)
        for name, shape in (("look", (LOOKS * LOOK,)), ("action", (HORIZON * ACTION,))):
            self.register_buffer(f"{name}_middle", torch.zeros(shape))
            self.register_buffer(f"{name}_half", torch.ones(shape))

    def look(self, looks: Tensor) -> Tensor:
        """Looks (B, LOOKS * LOOK) to about [-1, 1]."""
        return (looks - self.look_middle) / self.look_half

    def action(self, chunk: Tensor) -> Tensor:
        """Chunks (B, HORIZON * ACTION) to [-1, 1]."""
        return (chunk - self.action_middle) / self.action_half

    def chunk(self, looks: Tensor, noise: Tensor) -> Tensor:
        """Chunks (B, HORIZON, ACTION) of looks (B, LOOKS * LOOK), from noise (B, HORIZON * ACTION)."""
        with torch.no_grad():
            found = sample(self.denoiser, noise, self.look(looks))
            return (found * self.action_half + self.action_middle).reshape(-1, HORIZON, ACTION)


def look(before: Pose, now: Pose, width: float, door_before: Array, door_now: Array) -> Array:
    """What the policy sees, (LOOKS * LOOK,): hand poses in UMI's tool frame, doors as `door_state`."""
    views = [
        np.concatenate([poses.numbers(poses.relative(hand, now)), [width], door])
        for hand, door in ((before, door_before), (now, door_now))
    ]
    return np.concatenate(views)


def save_policy(path: Path, policy: Policy, card: DoorPolicyCard) -> None:
    """Write one safetensors file with the card in its metadata. Raises: StoreError."""
    tensors = {name: value.detach().contiguous() for name, value in policy.state_dict().items()}
    write_atomic(path, bytes_of(tensors, metadata={CARD: msgspec.json.encode(card).decode()}))


def load_policy(path: Path) -> tuple[Policy, DoorPolicyCard, str]:
    """A policy, its card and the SHA-256 of its file.

    Raises: SourceError when the file is missing, damaged, no policy, or of another format or size.
    """
    data = read_bytes(path, "policy", SourceError)
    card = _card(data, path)
    policy = Policy(card.hidden)
    state = policy.state_dict()
    shapes = {name: tuple(value.shape) for name, value in state.items()}
    for name, array in decode_tensors(data, path, "policy", SourceError, shapes).items():
        state[name].copy_(torch.from_numpy(array))
    return policy.eval(), card, hashlib.sha256(data).hexdigest()


def read_card(path: Path) -> DoorPolicyCard:
    """The card of a policy's file. Raises: SourceError."""
    return _card(read_bytes(path, "policy", SourceError), path)


def _card(data: bytes, path: Path) -> DoorPolicyCard:
    with reading("policy", path, "a safetensors file", SourceError):
        # the format: eight bytes with the length of a header in JSON. Source: safetensors, README
        size = int.from_bytes(data[:8], "little")
        if len(data) < 8 or size > len(data) - 8:
            raise ValueError("its header is cut short")
        metadata = msgspec.json.decode(data[8 : 8 + size], type=_Header).metadata
    if CARD not in metadata:
        raise SourceError(f"policy '{path}' has no card in its metadata: it is of another program")
    card = decode_json(metadata[CARD], path, DoorPolicyCard, "card of the policy", SourceError)
    if card.format != FORMAT or not 1 <= card.hidden <= 1 << 12:
        raise SourceError(
            f"policy '{path}': format {card.format} with {card.hidden} hidden units, "
            f"valid: {FORMAT} with 1 to 4096"
        )
    return card
