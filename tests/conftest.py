"""Episodes without any disturbance, which a test then disturbs in the one way it is about."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from foreign_policy import own_policy  # noqa: F401  (a fixture)
from live_page import served  # noqa: F401  (a fixture)
from tiny_protocol import manifest
from wbc_bench.episodes.manifest import EpisodeManifest
from wbc_bench.episodes.protocol import EvalProtocol, find_protocol
from wbc_bench.episodes.randomization import nominal

CalmRows = Callable[..., EpisodeManifest]


@pytest.fixture(scope="session")
def smoke() -> EvalProtocol:
    return find_protocol("smoke_v1")[0]


@pytest.fixture(scope="session")
def calm_rows(smoke: EvalProtocol) -> CalmRows:
    """`calm_rows(count, column=values, ...)`: nominal robots at rest, without pushes or noise."""

    def rows(count: int, **columns: np.ndarray) -> EpisodeManifest:
        draws = [nominal(smoke, 0, i)._asdict() for i in range(count)]
        still = {name: np.array([draw[name] for draw in draws]) for name in draws[0]}
        return dataclasses.replace(manifest(1, count, smoke), **(still | columns))

    return rows
