"""Geometry in the vertical plane of the legs and of the arm: chains of two links in closed form."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def two_link(first: Array, second: Array, goal: Array) -> tuple[Array, Array, Array]:
    """Pitch angles of two links in the x-z plane whose chain ends at a goal.

    Ry(a) first + Ry(b) second = goal, for both signs of the bend. Source: law of cosines.

    Args:
        first, second: (2,) links (x, z) at zero angle [m].
        goal: (..., 2) [m].

    Returns:
        a, b, bend: (2, ...) [rad]; bend is the angle from the first link to the second, zero when straight,
        one sign a branch; NaN where the goal is out of reach.
    """
    r1, r2 = np.hypot(*first), np.hypot(*second)
    cos_bend = ((goal**2).sum(-1) - r1**2 - r2**2) / (2 * r1 * r2)
    bend = np.arccos(np.where(np.abs(cos_bend) <= 1, cos_bend, np.nan))
    bend = np.stack([bend, -bend])
    # a positive pitch lowers the polar angle in the x-z plane
    polar = np.arctan2(goal[..., 1], goal[..., 0]) - np.arctan2(
        r2 * np.sin(bend), r1 + r2 * np.cos(bend)
    )  # of the first link
    a = np.arctan2(first[1], first[0]) - polar
    b = np.arctan2(second[1], second[0]) - (polar + bend)
    return a, b, bend


def turn(pitch: Array, vector: Array) -> Array:
    """Ry(pitch) applied to (x, z) vectors: (...,) and (..., 2) to (..., 2)."""
    cos, sin = np.cos(pitch), np.sin(pitch)
    x, z = vector[..., 0], vector[..., 1]
    return np.stack([cos * x + sin * z, cos * z - sin * x], axis=-1)


def wrap(angle: Array) -> Array:
    """Into [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi
