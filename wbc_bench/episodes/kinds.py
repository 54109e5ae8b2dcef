"""The kinds of targets that a protocol can ask for; each kind owns its rows, its checks and its redraws."""

from typing import Protocol

import numpy as np

from wbc_bench.episodes import reach_targets, workspace_targets
from wbc_bench.episodes.protocol import EvalProtocol, ReachTargets, WorkspaceTargets
from wbc_bench.episodes.rows import EpisodeManifest
from wbc_bench.episodes.targets import Progress


class TargetKind(Protocol):
    """What freezing and verifying ask of a kind of target; a module implements it."""

    def rows(self, protocol: EvalProtocol, progress: Progress, workers: int) -> list[dict]:
        """Every row of the manifest; equal for any number of workers."""
        ...

    def num_rows(self, protocol: EvalProtocol) -> int:
        """Episodes of a whole manifest."""
        ...

    def count_mistakes(self, protocol: EvalProtocol, manifest: EpisodeManifest) -> list[str]:
        """What is wrong with how the episodes of a manifest are divided up."""
        ...

    def target_mistakes(self, protocol: EvalProtocol, manifest: EpisodeManifest) -> list[str]:
        """What is wrong with the labels of a manifest, and with where its targets are."""
        ...

    def step_distance(self, protocol: EvalProtocol) -> tuple[float, float]:
        """Shortest and longest displacement [m] of the stance of a `step` target."""
        ...

    def redraw(self, protocol: EvalProtocol, manifest: EpisodeManifest, sample: np.ndarray) -> list[dict]:
        """Some rows drawn again: those with the sampled indices, or others that stand for them."""
        ...


_KINDS: dict[type, TargetKind] = {WorkspaceTargets: workspace_targets, ReachTargets: reach_targets}


def kind_of(protocol: EvalProtocol) -> TargetKind:
    """The kind of a protocol's targets."""
    return _KINDS[type(protocol.targets)]
