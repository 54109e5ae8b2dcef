"""The learned controllers: policies with a context estimator, their training, checkpoints and export.

`learned:METHOD@SEED` is a checkpoint of this package, that of the robot to control, and
`learned:PATH.safetensors` one in a file.
`learned:METHOD` stands for all seeds of a method: replicate k of a protocol is evaluated with seed k.
"""

import msgspec

from wbc_baselines.learned.packaged import CHECKPOINTS
from wbc_bench.controller import Controller
from wbc_bench.errors import ControllerError
from wbc_bench.readers import read_json
from wbc_bench.robot import Robot


class _Training(msgspec.Struct, frozen=True):
    """What `variants` reads of a `policy.card.PolicyCard`."""

    method: str
    seed: int
    samples: int  # control steps of training


class Learned:
    """The entry point of learned controllers, which are evaluated by NumPy alone."""

    def __call__(self, robot: Robot, variant: str = "") -> Controller:
        """Create the controller of a checkpoint, see `policy.controller.from_checkpoint`."""
        from wbc_baselines.learned.policy.controller import from_checkpoint

        return from_checkpoint(robot, variant)

    def variant_for(self, variant: str, replicate: int) -> str:
        """Return `METHOD@k` for `METHOD`; the name of a single checkpoint is returned unchanged."""
        one = "@" in variant or variant.endswith(".safetensors")
        return variant if one else f"{variant}@{replicate}"

    def variants(self) -> list[tuple[str, str]]:
        """Return METHOD and METHOD@SEED of every packaged checkpoint, with its training."""
        trained: dict[str, dict[str, list[str]]] = {}  # by method and by METHOD@SEED
        for path in sorted(CHECKPOINTS.glob("*/*@*.json")):
            card = read_json(path, _Training, "checkpoint card", ControllerError)
            told = f"for {path.parent.name} {card.samples:,} control steps"
            trained.setdefault(card.method, {}).setdefault(f"{card.method}@{card.seed}", []).append(told)
        found = []
        for method, seeds in trained.items():
            numbers = ", ".join(name.partition("@")[2] for name in seeds)
            found.append((method, f"Replicate k is evaluated with training seed k, one of: {numbers}."))
            for name, told in seeds.items():
                seed = name.partition("@")[2]
                found.append((name, f"Training seed {seed}; trained {', '.join(told)}."))
        return [*found, ("FILE.safetensors", "A checkpoint of your own, see `wbc-train --help`.")]


class Onnx:
    """The entry point of exported controllers; onnxruntime is imported only when one is created."""

    def __call__(self, robot: Robot, variant: str = "") -> Controller:
        """Create the controller of an exported file `onnx:FILE`, see `policy.controller.from_onnx`."""
        from wbc_baselines.learned.policy.controller import from_onnx

        return from_onnx(robot, variant)

    def variants(self) -> list[tuple[str, str]]:
        """Return the form of a variant, with its description."""
        return [("FILE.onnx", "A learned controller that the command `export` wrote.")]


make = Learned()
make_onnx = Onnx()
