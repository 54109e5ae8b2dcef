"""Targets straight ahead over a ladder of heights, dithered about the best pose of each height."""

from collections import Counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wbc_bench.episodes.protocol import REACH_X, EvalProtocol, ReachTargets
from wbc_bench.episodes.rows import EpisodeManifest
from wbc_bench.episodes.static_solver import StaticSolver
from wbc_bench.episodes.targets import (
    BEYOND,
    MAX_ATTEMPTS,
    Progress,
    TargetDraw,
    classify,
    manifest_row,
    solver_of,
)
from wbc_bench.errors import ManifestError, ProtocolError
from wbc_bench.parallel import in_parallel
from wbc_bench.randomness import stream
from wbc_bench.rotations import matrix_from_rpy, wxyz_from_matrix

Array = NDArray[np.float64]
Pair = tuple[float, float]

# Search for the best pose of a height: (spacing, reach) about the best so far. Straight up and down included.
REACH_PITCH = (-np.pi / 2, np.pi / 2)  # [rad]
ROUNDING = 1e-9  # [m] of a sum
COARSE = (0.1, np.pi / 12)  # [m], [rad]
FINE = (0.025, np.pi / 48)


class ReachPose(NamedTuple):
    """The pose straight ahead that a height is tried with."""

    x: float  # [m]
    pitch: float  # [rad]
    margin: float  # NaN if no pose is feasible and this one is borrowed from the nearest height that has one
    height: float  # [m] at which it is feasible


def ladder(targets: ReachTargets) -> Array:
    """The heights (H,) [m]."""
    low, _, spacing = targets.heights
    return np.array([round(low + spacing * i, 9) for i in range(targets.num_heights)])


def best_reach_pose(solver: StaticSolver, height: float, orientation: str) -> ReachPose | None:
    """The pose straight ahead with the largest margin (`Witness.margin`), gripper level or at any pitch.

    A coarse grid over distance and pitch, refined around its best; where the coarse grid holds nothing, the
    fine one is searched as a whole.
    """
    best = _search(solver, height, orientation, REACH_X, REACH_PITCH, COARSE)
    if best is None:
        return _search(solver, height, orientation, REACH_X, REACH_PITCH, FINE)
    around_x = max(REACH_X[0], best.x - COARSE[0]), min(REACH_X[1], best.x + COARSE[0])
    around_pitch = (
        max(REACH_PITCH[0], best.pitch - COARSE[1]),
        min(REACH_PITCH[1], best.pitch + COARSE[1]),
    )
    return _search(solver, height, orientation, around_x, around_pitch, FINE) or best


def _search(
    solver: StaticSolver, height: float, orientation: str, xs: Pair, pitches: Pair, step: Pair
) -> ReachPose | None:
    best = None
    for pitch in _spaced(*pitches, step[1]) if orientation == "free" else [0.0]:
        rot = matrix_from_rpy(np.array([0.0, pitch, 0.0]))
        for x in _spaced(*xs, step[0]):
            witness = solver.solve_posture(np.array([x, 0.0, height]), rot)
            if witness is not None and (best is None or round(witness.margin, 9) > best.margin):
                best = ReachPose(x, pitch, round(witness.margin, 9), height)
    return best


def _spaced(low: float, high: float, spacing: float) -> list[float]:
    return [low + spacing * i for i in range(round((high - low) / spacing) + 1)]


def reach_poses(heights: Array, best: list[ReachPose | None]) -> list[ReachPose]:
    """A pose for every height (H,): where none is feasible, that of the nearest height with one, shifted."""
    feasible = [pose for pose in best if pose is not None]
    if not feasible:
        raise ProtocolError("no height of the ladder has a feasible pose - at `$.targets.heights`")
    poses = []
    for height, pose in zip(heights, best, strict=True):
        nearest = min(feasible, key=lambda p: abs(p.height - height))
        poses.append(pose or nearest._replace(margin=np.nan))
    return poses


def draw_reach_target(
    protocol: EvalProtocol, orientation: str, index: int, k: int, pose: ReachPose
) -> TargetDraw:
    """Target `k` of the height with this `index`: its pose, dithered, drawn again until it is feasible.

    The conditions of a protocol share it.

    Raises:
        ProtocolError: no dithered pose in MAX_ATTEMPTS is feasible.
    """
    targets, solver = protocol.targets, solver_of(protocol)
    assert isinstance(targets, ReachTargets)
    rng = stream(protocol.episodes.seed, f"target {orientation}", index, k)
    centre = np.array([pose.x, 0.0, ladder(targets)[index]])
    rot = matrix_from_rpy(np.array([0.0, pose.pitch, 0.0]))
    for attempt in range(1, MAX_ATTEMPTS + 1):
        pos = centre + rng.uniform(-targets.dither, targets.dither, 3)
        if np.isnan(pose.margin):
            return TargetDraw(BEYOND, pos, wxyz_from_matrix(rot), np.full(21, np.nan), attempt)
        found = classify(solver, pos, rot)
        if found is not None:
            return TargetDraw(found[0], pos, wxyz_from_matrix(rot), found[1].qpos, attempt)
    raise ProtocolError(
        f"protocol {protocol.name}: no feasible target within {targets.dither:g} m of height {centre[2]:g} m "
        "- at `$.targets.dither`"
    )


def rows(protocol: EvalProtocol, progress: Progress, workers: int) -> list[dict]:
    """Every row of the manifest: by condition, orientation and height."""
    targets = protocol.targets
    assert isinstance(targets, ReachTargets)
    heights, kinds = ladder(targets), targets.orientations
    rungs = [(orientation, float(height)) for orientation in kinds for height in heights]

    def search(rung: tuple[str, float]) -> ReachPose | None:
        return best_reach_pose(solver_of(protocol), rung[1], rung[0])

    best: list[ReachPose | None] = []
    for pose in in_parallel(workers, search, rungs):
        best.append(pose)
        progress(len(best), 2 * len(rungs))
    poses = {
        kind: reach_poses(heights, best[i * len(heights) : (i + 1) * len(heights)])
        for i, kind in enumerate(kinds)
    }

    def work(rung: tuple[str, int]) -> list[TargetDraw]:
        kind, index = rung
        return [
            draw_reach_target(protocol, kind, index, k, poses[kind][index]) for k in range(targets.per_height)
        ]

    drawn: dict[tuple[str, int], list[TargetDraw]] = {}
    keys = [(kind, index) for kind in kinds for index in range(len(heights))]
    for key, draws in zip(keys, in_parallel(workers, work, keys), strict=True):
        drawn[key] = draws
        progress(len(rungs) + len(drawn), 2 * len(rungs))
    drawn_rows = []
    for condition in targets.conditions:
        for kind, index in keys:
            for target in drawn[kind, index]:
                height = float(heights[index])
                drawn_rows.append(
                    manifest_row(
                        protocol,
                        0,
                        len(drawn_rows),
                        target,
                        condition=condition,
                        orientation=kind,
                        height=height,
                    )
                )
    return drawn_rows


def num_rows(protocol: EvalProtocol) -> int:
    """Episodes of a whole manifest."""
    targets = protocol.targets
    assert isinstance(targets, ReachTargets)
    return targets.num_episodes


def count_mistakes(protocol: EvalProtocol, manifest: EpisodeManifest) -> list[str]:
    """What is wrong with the number of episodes at each height."""
    targets = protocol.targets
    assert isinstance(targets, ReachTargets)
    cells = Counter(zip(manifest.condition, manifest.orientation, manifest.height, strict=True))
    if set(cells.values()) == {targets.per_height}:
        return []
    return [f"episodes per height: {sorted(set(cells.values()))}, {targets.per_height} expected"]


def target_mistakes(protocol: EvalProtocol, manifest: EpisodeManifest) -> list[str]:
    """Episodes out of the order of `rows`, and targets farther than the dither from their height."""
    targets, wrong = protocol.targets, []
    assert isinstance(targets, ReachTargets)
    heights, sizes = ladder(targets), (len(targets.conditions), len(targets.orientations))
    condition, orientation, rung, _ = np.indices((*sizes, len(heights), targets.per_height)).reshape(4, -1)
    for name, expected in (
        ("condition", np.array(targets.conditions, dtype=object)[condition]),
        ("orientation", np.array(targets.orientations, dtype=object)[orientation]),
        ("height", heights[rung]),
    ):
        if not np.array_equal(getattr(manifest, name), expected):
            wrong.append(f"{name} of some episodes is not the one that their number stands for")
    x, y, z = manifest.target_pos_w.T
    most = targets.dither + ROUNDING
    within = (REACH_X[0] - most <= x) & (x <= REACH_X[1] + most) & (np.abs(y) <= most)
    within &= np.abs(z - manifest.height) <= most
    if not within.all():
        i = int(within.argmin())
        wrong.append(
            f"target of episode {manifest.replicate[i]}/{manifest.episode[i]} at "
            f"{manifest.target_pos_w[i].tolist()} m "
            f"is not within {targets.dither:g} m of its height straight ahead"
        )
    return wrong


def step_distance(protocol: EvalProtocol) -> tuple[float, float]:
    """No stance is displaced."""
    return 0.0, 0.0


def redraw(protocol: EvalProtocol, manifest: EpisodeManifest, sample: np.ndarray) -> list[dict]:
    """All episodes of two heights: the search for a height's pose is too slow to repeat for every row."""
    targets = protocol.targets
    assert isinstance(targets, ReachTargets)
    heights = ladder(targets).tolist()
    feasible = sample[manifest.stratum[sample] != BEYOND]
    rungs = dict.fromkeys((str(manifest.orientation[i]), float(manifest.height[i])) for i in feasible)
    fresh = []
    for kind, height in list(rungs)[:2]:
        pose, index = best_reach_pose(solver_of(protocol), height, kind), heights.index(height)
        if pose is None:
            raise ManifestError(
                f"height {height:g} m, {kind}: the manifest has targets, and no pose is feasible"
            )
        for k in range(targets.per_height):
            target = draw_reach_target(protocol, kind, index, k, pose)
            for c, condition in enumerate(targets.conditions):
                rung = (c * len(targets.orientations) + targets.orientations.index(kind)) * len(
                    heights
                ) + index
                facts = {"condition": condition, "orientation": kind, "height": height}
                fresh.append(manifest_row(protocol, 0, rung * targets.per_height + k, target, **facts))
    return fresh
