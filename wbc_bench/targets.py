"""Targets, feasible by construction, each with the stratum that says what it asks of the robot.

The strata, decided by `posture.StaticSolver` in this order:

- `arm`: a static configuration reaches the pose with base and legs exactly at the default posture.
- `posture`: not `arm`, and a configuration with both soles where the default posture has them reaches it.
- `step`: none with the soles in place, and one (arm or posture) from a stance displaced in the plane.

A configuration counts when joint limits, centre of mass over the soles, clearance, self-collision, torques
and the termination limits all hold with the margins stated in `posture.py`. It is kept as the target's
witness.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wbc_bench.errors import ProtocolError
from wbc_bench.outcomes import STRATA
from wbc_bench.posture import Stance, StaticSolver, Witness, out_of_stance, static_solver
from wbc_bench.protocol import EvalProtocol, ReachTargets, WorkspaceTargets
from wbc_bench.randomness import stream
from wbc_bench.rotations import matrix_from_rpy, matrix_from_wxyz, wxyz_from_matrix

Array = NDArray[np.float64]
Pair = tuple[float, float]

BEYOND = "beyond"  # a reach target at a height where no pose is feasible
MAX_ATTEMPTS = 20_000  # candidates for one target; the rarest stratum, arm, takes 22 on average

# Search for the best pose of a height: (spacing, reach) about the best so far. Straight up and down included.
REACH_X = (0.0, 1.0)  # [m] ahead of the base; the arm is 0.8 m long
REACH_PITCH = (-np.pi / 2, np.pi / 2)  # [rad]
COARSE = (0.1, np.pi / 12)  # [m], [rad]
FINE = (0.025, np.pi / 48)


class TargetDraw(NamedTuple):
    """A target in the world and a configuration that reaches it."""

    stratum: str
    pos_w: Array  # (3,) [m]
    quat_w: Array  # (4,) wxyz
    witness_qpos: Array  # (21,), NaN if none
    attempts: int  # candidates drawn until this one was taken


class ReachPose(NamedTuple):
    """The pose straight ahead that a height is tried with."""

    x: float  # [m]
    pitch: float  # [rad]
    margin: float  # NaN if no pose is feasible and this one is borrowed from the nearest height that has one
    height: float  # [m] at which it is feasible


def solver_of(protocol: EvalProtocol) -> StaticSolver:
    """The static solver with the margins and limits of a protocol."""
    end = protocol.termination
    return static_solver(protocol.robot, protocol.targets.com_margin, end.tilt, end.base_height)


def classify(solver: StaticSolver, pos: Array, rot: Array) -> tuple[str, Witness] | None:
    """Stratum and witness of a pose (3,), (3, 3) in the stance frame; None if the feet would have to move."""
    witness = solver.solve_arm(pos, rot)
    if witness is not None:
        return "arm", witness
    witness = solver.solve_posture(pos, rot)
    return None if witness is None else ("posture", witness)


# ---- all over the workspace --------------------------------------------------------------------------------


def stratum_of(weights: dict, episode: int) -> str:
    """The stratum an episode is to have: the weighted strata in turn, so that every beginning is balanced."""
    cycle = [name for name in STRATA for _ in range(weights.get(name, 0))]
    return cycle[episode % len(cycle)]


def draw_workspace_target(protocol: EvalProtocol, replicate: int, episode: int) -> TargetDraw:
    """The target of an episode: uniform in the box, given that it falls into the episode's stratum.

    The box is about the stance; for `step` a displaced stance is drawn with every candidate.

    Raises:
        ProtocolError: no candidate in MAX_ATTEMPTS falls into the stratum.
    """
    targets, solver = protocol.targets, solver_of(protocol)
    assert isinstance(targets, WorkspaceTargets)
    rng = stream(protocol.episodes.seed, "target", replicate, episode)
    stratum = stratum_of(targets.weights, episode)
    low, high = np.transpose([targets.x, targets.y, targets.height, targets.roll, targets.pitch, targets.yaw])
    for attempt in range(1, MAX_ATTEMPTS + 1):
        candidate = rng.uniform(low, high)
        pos, rot = candidate[:3], matrix_from_rpy(candidate[3:])
        stance, witness = Stance(), None
        if stratum == "arm":
            witness = solver.solve_arm(pos, rot)
        elif stratum == "posture":
            if solver.solve_arm(pos, rot) is None:
                witness = solver.solve_posture(pos, rot)
        else:
            stance = _draw_stance(targets, rng)
            found = classify(solver, pos, rot)
            if found is not None and classify(solver, *out_of_stance(stance, pos, rot)) is None:
                witness = found[1]
        if witness is not None:
            pos_w, rot_w = out_of_stance(stance, pos, rot)
            base_w, base_rot_w = out_of_stance(stance, witness.qpos[:3], matrix_from_wxyz(witness.qpos[3:7]))
            qpos = np.concatenate([base_w, wxyz_from_matrix(base_rot_w), witness.qpos[7:]])
            return TargetDraw(stratum, pos_w, wxyz_from_matrix(rot_w), qpos, attempt)
    raise ProtocolError(
        f"protocol {protocol.name}: none of {MAX_ATTEMPTS} poses in the box is a '{stratum}' target "
        f"(replicate {replicate}, episode {episode}) - at `$.targets`"
    )


def _draw_stance(targets: WorkspaceTargets, rng: np.random.Generator) -> Stance:
    distance, bearing = rng.uniform(*targets.step_distance), rng.uniform(-np.pi, np.pi)
    return Stance(distance * np.cos(bearing), distance * np.sin(bearing), rng.uniform(*targets.step_yaw))


# ---- a ladder of heights -----------------------------------------------------------------------------------


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
