"""Doors pushed shut in closed loop: an expert whose episodes are recorded, and policies that are scored."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from wbc_bench import provenance
from wbc_bench.controller import Controller
from wbc_bench.episodes.single import door_protocol, episode_of
from wbc_bench.errors import SourceError
from wbc_bench.evaluation.tracking import Moment, follow
from wbc_bench.files import ensure_writable
from wbc_bench.parallel import in_parallel
from wbc_bench.registry import load_controller
from wbc_bench.results.doors import write_doors
from wbc_bench.results.tracking import STOOD
from wbc_bench.robot import load_robot
from wbc_bench.sources.diffusion.demonstrations import Demonstration, write_demonstrations
from wbc_bench.sources.diffusion.expert import ExpertSource
from wbc_bench.sources.diffusion.scene import CLOSED, Door, draw_door
from wbc_bench.sources.diffusion.zarr_archive import MAX_ROWS
from wbc_bench.sources.interface import SceneSource
from wbc_bench.sources.registry import find_policy, recorded_name
from wbc_bench.sources.slew import Pose

Array = NDArray[np.float64]
DURATION = 12.0  # [s] of an episode: the expert takes 7 to 11


class DoorEpisode(NamedTuple):
    """What became of one door."""

    door: Door
    outcome: str  # STOOD or one of episodes.TERMINATED
    steps: int  # control steps completed
    final_angle: float  # [rad] as the last control step began; NaN without a step
    first_closed: float  # [s] when the door was first closed; NaN if it never was
    moments: list[Moment]

    @property
    def success(self) -> bool:
        """The door is closed at the end, and the robot stands."""
        return self.outcome == STOOD and self.final_angle < CLOSED


def run_door(
    controller: Controller, source: SceneSource, door: Door, condition: str, seed: int, number: int
) -> DoorEpisode:
    """One episode: the controller follows a source that stands in front of a door."""
    protocol, row = episode_of(DURATION, seed, condition, number)
    moments: list[Moment] = []
    tracked = follow(controller, source, protocol, row, moments.append)
    angle = np.array([moment.scenery[0] for moment in moments])
    closed = np.flatnonzero(angle < CLOSED)
    return DoorEpisode(
        door=door,
        outcome=tracked.outcome,
        steps=len(moments),
        final_angle=float(angle[-1]) if len(angle) else np.nan,
        first_closed=float(closed[0] * protocol.control_period) if len(closed) else np.nan,
        moments=moments,
    )


def record(
    path: Path,
    spec: str,
    seed: int,
    count: int,
    workers: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> int:
    """Write the expert's undisturbed episodes that closed their door; how many those are.

    The file depends neither on `workers` nor on when it is written.

    Raises: SourceError when no door was closed, or a file could not hold all; ControllerError, StoreError.
    """
    period = episode_of(DURATION, seed, "nominal")[0].control_period
    most = int(MAX_ROWS / round(DURATION / period))
    if count > most:
        raise SourceError(f"{count} episodes to record, valid: at most {most}, of {MAX_ROWS} steps in all")
    load_controller(spec, load_robot())
    episodes = list(_run_all(None, spec, "nominal", seed, count, workers, progress))
    kept = [episode for episode in episodes if episode.success]
    if not kept:
        raise SourceError(f"'{spec}' closed none of {count} doors of seed {seed}: nothing to write")
    attributes = {
        "control_period": period,
        "controller": spec,
        "seed": seed,
        "episodes_asked": count,
        "doors": [list(episode.door) for episode in kept],
    }
    write_demonstrations(path, [demonstration_of(episode) for episode in kept], attributes)
    return len(kept)


def evaluate(
    root: Path,
    policy: str | None,
    spec: str,
    condition: str,
    seed: int,
    count: int,
    workers: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Path:
    """Write the record of a policy's file ("" for the packaged one; None for the expert); its folder.

    Raises:
        SourceError: a policy that cannot be used, or the seed is that of its demonstrations.
        ControllerError, StoreError.
    """
    digest = None
    if policy is not None:
        _, card, digest = find_policy(policy)
        if card.demonstrations_seed == seed:
            raise SourceError(
                f"seed {seed}: the policy was trained on these doors, valid: any other than {seed}"
            )
    controller = load_controller(spec, load_robot())
    ensure_writable(root)
    episodes = list(_run_all(policy, spec, condition, seed, count, workers, progress))
    return write_doors(
        root,
        episode_table(episodes),
        source="expert" if policy is None else recorded_name("diffusion", digest),
        policy_sha256=digest,
        controller=spec,
        signals=sorted(controller.info.signals),
        commands=sorted(controller.info.commands),
        condition=condition,
        seed=seed,
        requested=count,
        duration=DURATION,
        closed_below=CLOSED,
        **provenance.facts(controller),
    )


def _run_all(
    policy: str | None,
    spec: str,
    condition: str,
    seed: int,
    count: int,
    workers: int,
    progress: Callable[[int, int], None],
) -> Iterator[DoorEpisode]:
    """Doors 0 to count - 1 in their order, a worker an episode at a time."""

    def run_one(number: int) -> DoorEpisode:
        return _run_one(policy, spec, condition, seed, number)

    for done, episode in enumerate(in_parallel(workers, run_one, range(count)), 1):
        progress(done, count)
        yield episode


def _run_one(policy: str | None, spec: str, condition: str, seed: int, number: int) -> DoorEpisode:
    controller = load_controller(spec, load_robot())
    door = draw_door(door_protocol(seed), seed, number)
    return run_door(controller, _source(policy, door, seed, number), door, condition, seed, number)


def _source(policy: str | None, door: Door, seed: int, number: int) -> SceneSource:
    if policy is None:
        return ExpertSource(door)
    from wbc_bench.sources.diffusion.source import DiffusionSource

    network, _, digest = find_policy(policy)
    return DiffusionSource(network, door, seed, number, digest)


def episode_table(episodes: list[DoorEpisode]) -> pd.DataFrame:
    """A row an episode, without its time series."""
    rows = [
        episode.door._asdict()
        | {name: getattr(episode, name) for name in ("outcome", "steps", "final_angle", "first_closed")}
        | {"success": episode.success}
        for episode in episodes
    ]
    return pd.DataFrame(rows)


def demonstration_of(episode: DoorEpisode) -> Demonstration:
    """What is kept of an episode."""
    moments, door = episode.moments, episode.door
    angle = np.array([moment.scenery[0] for moment in moments])
    panels = [door.panel(a) for a in angle]

    def stacked(pairs: list[tuple[Array, Array]]) -> Pose:
        pos, rot = zip(*pairs, strict=True)
        return Pose(np.stack(pos), np.stack(rot))

    return Demonstration(
        ee=stacked([(moment.seen.ee_pos_w, moment.seen.ee_rot_w) for moment in moments]),
        target=stacked([(moment.target_pos_w, moment.target_rot_w) for moment in moments]),
        panel=stacked([(panel.pos, panel.rot) for panel in panels]),
        angle=angle,
    )
