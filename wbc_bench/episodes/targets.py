"""Targets, feasible by construction, each with the stratum that says what it asks of the robot.

The strata, decided by `static_solver.StaticSolver` in this order:

- `arm`: a static configuration reaches the pose with base and legs exactly at the default posture.
- `posture`: not `arm`, and a configuration with both soles where the default posture has them reaches it.
- `step`: none with the soles in place, and one (arm or posture) from a stance displaced in the plane.

A configuration counts when joint limits, centre of mass over the soles, clearance, self-collision, torques
and the termination limits all hold with the margins stated in `static_solver.py`. It is kept as the target's
witness.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.episodes.randomization import draw
from wbc_bench.episodes.static_solver import StaticSolver, Witness, static_solver

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]  # (done, total)

BEYOND = "beyond"  # a reach target at a height where no pose is feasible
MAX_ATTEMPTS = 20_000  # candidates for one target; the rarest stratum, arm, takes 22 on average


class TargetDraw(NamedTuple):
    """A target in the world and a configuration that reaches it."""

    stratum: str
    pos_w: Array  # (3,) [m]
    quat_w: Array  # (4,) wxyz
    feasible_qpos: Array  # (21,), NaN if none
    attempts: int  # candidates drawn until this one was taken


def solver_of(protocol: EvalProtocol) -> StaticSolver:
    """The static solver with the margins and limits of a protocol."""
    end = protocol.termination
    return static_solver(protocol.robot, protocol.targets.com_margin, end.tilt, end.base_height)


def classify(solver: StaticSolver, pos: Array, rot: Array) -> tuple[str, Witness] | None:
    """Stratum and witness of a pose (3,), (3, 3) in the ground frame; None if the feet would have to move."""
    witness = solver.solve_arm(pos, rot)
    if witness is not None:
        return "arm", witness
    witness = solver.solve_posture(pos, rot)
    return None if witness is None else ("posture", witness)


def manifest_row(
    protocol: EvalProtocol, replicate: int, episode: int, target: TargetDraw, **labels
) -> dict[str, object]:
    """The columns of one episode: its target, its draws, and what else a kind of target says of it."""
    draws = draw(protocol, replicate, episode, labels.get("condition", ""))
    return {
        "replicate": replicate,
        "episode": episode,
        "stratum": target.stratum,
        "condition": "",
        "orientation": "",
        "height": float(target.pos_w[2]),
        "target_pos_w": target.pos_w,
        "target_quat_w": target.quat_w,
        "feasible_qpos": target.feasible_qpos,
        **draws._asdict(),
        **labels,
    }
