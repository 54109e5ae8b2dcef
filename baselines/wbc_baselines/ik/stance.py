"""Where the two soles stand: the anchor between the robot and the world."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

Array = NDArray[np.float64]


class Stance(NamedTuple):
    """Ground poses of the soles in the anchor frame, left over right."""

    xy: Array  # (2, 2) [m]
    yaw: Array  # (2,) [rad]

    def poses(self) -> list[tuple[Array, Array]]:
        """Position (3,) and rotation (3, 3) of each sole, flat on the ground."""
        return [
            (np.array([xy[0], xy[1], 0.0]), yaw_matrix(yaw))
            for xy, yaw in zip(self.xy, self.yaw, strict=True)
        ]

    def toward(self, other: "Stance", fraction: float) -> "Stance":
        """A step from this stance to another."""
        return Stance(self.xy + fraction * (other.xy - self.xy), self.yaw + fraction * (other.yaw - self.yaw))

    def moved(self, side: int, xy: Array) -> "Stance":
        """With one sole at another place (2,) [m], turned like the other."""
        places, yaw = self.xy.copy(), self.yaw.copy()
        places[side], yaw[side] = xy, yaw[1 - side]
        return Stance(places, yaw)

    def width(self) -> float:
        """Distance [m] between the soles across their mean heading."""
        yaw = self.yaw.mean()
        return float((self.xy[0] - self.xy[1]) @ [-np.sin(yaw), np.cos(yaw)])

    def hull(self, corners: Array) -> Array:
        """Convex hull (V, 2) [m], counter-clockwise, of sole corners (C, 3) given in the sole frame."""
        points = np.concatenate([pos + corners @ rot.T for pos, rot in self.poses()])[:, :2]
        return points[ConvexHull(points).vertices]


def half_planes(hull: Array) -> tuple[Array, Array]:
    """Outward unit normals (V, 2) and offsets (V,) [m] of a counter-clockwise polygon: normal x <= offset."""
    edge = np.roll(hull, -1, axis=0) - hull
    normal = np.stack([edge[:, 1], -edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1)[:, None]
    return normal, (normal * hull).sum(axis=1)


def yaw_matrix(yaw: float) -> Array:
    """Rotation (3, 3) about the vertical by an angle [rad]."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def measured_stance(soles: list[tuple[Array, Array]]) -> Stance:
    """The flat stance nearest to two sole poses."""
    return Stance(
        np.array([pos[:2] for pos, _ in soles]),
        np.array([np.arctan2(rot[1, 0], rot[0, 0]) for _, rot in soles]),
    )


def base_from_stance(
    soles_b: list[tuple[Array, Array]], up_b: Array, stance: Stance | None
) -> tuple[Array, Array]:
    """Base pose in the anchor frame from the soles and the vertical, both seen from the base.

    Roll and pitch come from the vertical, yaw from the line between the soles, position from their mean.
    Without a stance the anchor is the mean of the soles with x along their mean heading.
    """
    line = soles_b[0][0] - soles_b[1][0]
    y = line - up_b * (up_b @ line)
    y /= np.sqrt(y @ y)
    x = np.array(
        [y[1] * up_b[2] - y[2] * up_b[1], y[2] * up_b[0] - y[0] * up_b[2], y[0] * up_b[1] - y[1] * up_b[0]]
    )
    level = np.stack([x, y, up_b])  # base to a level frame along the line
    if stance is None:
        heading = level @ (soles_b[0][1][:, 0] + soles_b[1][1][:, 0])
        yaw = -np.arctan2(heading[1], heading[0])
        centre = np.zeros(2)
    else:
        along = stance.xy[0] - stance.xy[1]
        yaw = np.arctan2(-along[0], along[1])
        centre = stance.xy.mean(axis=0)
    rot = yaw_matrix(yaw) @ level
    pos = -rot @ (0.5 * (soles_b[0][0] + soles_b[1][0]))
    pos[:2] += centre
    return pos, rot


def base_from_sole(sole_b: tuple[Array, Array], up_b: Array, xy: Array, yaw: float) -> tuple[Array, Array]:
    """Base pose in the anchor frame from the vertical and the one sole that stands, at `xy` (2,) [m]."""
    heading = sole_b[1][:, 0]
    x = heading - up_b * (up_b @ heading)
    x /= np.sqrt(x @ x)
    rot = yaw_matrix(yaw) @ np.stack([x, np.cross(up_b, x), up_b])
    pos = -rot @ sole_b[0]
    pos[:2] += xy
    return pos, rot
