"""The latent of a controller while it meets episodes, step by step."""

import numpy as np

from wbc_bench.controller import Controller, HasLatent
from wbc_bench.episodes.manifest import EpisodeManifest
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.errors import ControllerError
from wbc_bench.evaluation.control_loop import ControlLoop
from wbc_bench.results.latents import Samples


def sample_latents(controller: Controller, protocol: EvalProtocol, rows: EpisodeManifest) -> Samples:
    """The latent of every control step of some episodes, and the position error that it was inferred at.

    Raises: ControllerError, the controller shows no latent, one of the wrong shape, or fails in it.
    """
    if not isinstance(controller, HasLatent):
        raise ControllerError(
            f"controller '{controller.info.name}' shows no latent: it has no method `latent`"
        )
    loop = ControlLoop(controller, protocol, rows)
    parts = []
    before = loop.state
    for step, (stepped, *_) in enumerate(loop.run()):
        error = np.linalg.norm(before.ee_pos_w - rows.target_pos_w, axis=1)  # (N,) [m]
        with loop.blamed("latent"):
            latent = np.asarray(controller.latent(), dtype=np.float64)
        if latent.ndim != 2 or len(latent) != len(rows):
            raise ControllerError(
                f"controller '{controller.info.name}' shows a latent of shape {latent.shape}, "
                f"expected ({len(rows)}, columns)"
            )
        time = np.full(stepped.sum(), step * protocol.control_period)  # [s]
        parts.append((latent[stepped], error[stepped], rows.episode[stepped], time))
        before = loop.state
    latent, error, episode, time = map(np.concatenate, zip(*parts, strict=True))
    return Samples(latent, error, episode, time, precision_below=protocol.success.position)
