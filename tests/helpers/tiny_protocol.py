"""A protocol and manifest of a few steps an episode, in as many shards as a test wants."""

import hashlib
from pathlib import Path

import numpy as np

from wbc_bench.episodes.manifest import EpisodeManifest, manifest_path, write_manifest
from wbc_bench.episodes.protocol import EvalProtocol, read_protocol
from wbc_bench.episodes.randomization import EpisodeDraws, sample

TOML = """
name = "tiny"
description = "A few steps."

[episodes]
replicates = {replicates}
per_replicate = {episodes}
horizon = {horizon}
seed = 1

[targets]
type = "workspace"
x = [0.0, 1.0]
y = [0.0, 1.0]
height = [0.0, 1.0]
roll = [0.0, 0.0]
pitch = [0.0, 0.0]
yaw = [0.0, 0.0]
weights = {{ arm = 1 }}
step_distance = [0.1, 0.2]
step_yaw = [0.0, 0.0]

[noise]
joint_pos = 0.01

[success]
window = 0.1
"""

RANDOMIZATION = """
[randomization]
friction = [0.5, 1.0]
base_mass = [0.0, 1.0]
base_lin_vel = 0.1
base_ang_vel = 0.1
"""


def manifest(replicates: int, episodes: int, protocol: EvalProtocol) -> EpisodeManifest:
    """Targets on a line, and the draws of the protocol: enough that no two episodes are alike."""
    count = replicates * episodes
    draws = zip(*(sample(protocol, k, i) for k in range(replicates) for i in range(episodes)), strict=True)
    return EpisodeManifest(
        replicate=np.repeat(np.arange(replicates), episodes),
        episode=np.tile(np.arange(episodes), replicates),
        stratum=np.full(count, "arm", dtype=object),
        condition=np.full(count, "", dtype=object),
        orientation=np.full(count, "", dtype=object),
        height=np.full(count, 0.9),
        target_pos_w=np.column_stack([np.linspace(0.2, 0.6, count), np.zeros(count), np.full(count, 0.9)]),
        target_quat_w=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        feasible_qpos=np.tile([0.0, 0.0, 0.85, 1.0, *[0.0] * 17], (count, 1)),
        **{name: np.array(values) for name, values in zip(EpisodeDraws._fields, draws, strict=True)},
    )


def write_tiny(folder: Path, replicates: int = 2, episodes: int = 6, horizon: float = 0.2) -> Path:
    """Write protocol, manifest and hash; the path of the protocol."""
    path = folder / "tiny.toml"
    text = TOML.format(replicates=replicates, episodes=episodes, horizon=horizon)
    path.write_text(text + RANDOMIZATION)
    frozen = manifest_path(path)
    protocol = read_protocol(path)
    write_manifest(manifest(replicates, episodes, protocol), protocol, frozen)
    sha256 = hashlib.sha256(frozen.read_bytes()).hexdigest()
    frozen.with_suffix(".sha256").write_text(f"{sha256}  {frozen.name}\n")
    return path
