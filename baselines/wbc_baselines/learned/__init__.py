"""The learned family: policies with a context estimator, their training, checkpoints and export.

`learned:METHOD@SEED` is a checkpoint of this package, `learned:PATH.safetensors` one of a file.
`learned:METHOD` stands for all seeds of a method: replicate k of a protocol is met by seed k.
"""

from wbc_bench.controller import Controller
from wbc_bench.robot import Robot


class Learned:
    """The entry point; torch is imported when a controller is built, not before."""

    def __call__(self, robot: Robot, variant: str = "") -> Controller:
        """The controller of a checkpoint. Raises: CheckpointError, UnknownNameError."""
        from wbc_baselines.learned.policy.controller import from_checkpoint

        return from_checkpoint(robot, variant)

    def of_replicate(self, variant: str, replicate: int) -> str:
        """`METHOD@k` for `METHOD`; what names one checkpoint stays as it is."""
        one = "@" in variant or variant.endswith(".safetensors")
        return variant if one else f"{variant}@{replicate}"


def make_onnx(robot: Robot, variant: str = "") -> Controller:
    """The controller of an exported file, `onnx:FILE`. Raises: CheckpointError."""
    from wbc_baselines.learned.policy.controller import from_onnx

    return from_onnx(robot, variant)


make = Learned()
