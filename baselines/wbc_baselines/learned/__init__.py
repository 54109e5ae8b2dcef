"""The learned controllers: policies with a context estimator, their training, checkpoints and export.

`learned:METHOD@SEED` is a checkpoint of this package, `learned:PATH.safetensors` one in a file.
`learned:METHOD` stands for all seeds of a method: replicate k of a protocol is evaluated with seed k.
"""

from wbc_bench.controller import Controller
from wbc_bench.errors import ControllerError, missing_extra
from wbc_bench.robot import Robot


class Learned:
    """The entry point of learned controllers; torch is imported only when a controller is created."""

    def __call__(self, robot: Robot, variant: str = "") -> Controller:
        """Create the controller of a checkpoint, see `policy.controller.from_checkpoint`."""
        try:
            from wbc_baselines.learned.policy.controller import from_checkpoint
        except ImportError as error:
            raise ControllerError(missing_extra("a learned controller", "learned", error)) from error

        return from_checkpoint(robot, variant)

    def variant_for(self, variant: str, replicate: int) -> str:
        """Return `METHOD@k` for `METHOD`; the name of a single checkpoint is returned unchanged."""
        one = "@" in variant or variant.endswith(".safetensors")
        return variant if one else f"{variant}@{replicate}"


def make_onnx(robot: Robot, variant: str = "") -> Controller:
    """Create the controller of an exported file `onnx:FILE`, see `policy.controller.from_onnx`."""
    try:
        from wbc_baselines.learned.policy.controller import from_onnx
    except ImportError as error:
        raise ControllerError(missing_extra("an exported policy", "learned", error)) from error

    return from_onnx(robot, variant)


make = Learned()
