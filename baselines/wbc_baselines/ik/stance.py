"""Where the two soles stand: the anchor between the robot and the world. Batched over episodes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wbc_baselines.ik.geometry import Pose, cross, dot, norm, rotate
from wbc_baselines.ik.kinematics import SOLES, Bodies
from wbc_baselines.ik.rows import Rows
from wbc_bench.rotations import yaw_matrix

Array = NDArray[np.float64]
COLLINEAR = 1e-12  # [m^2] of a triangle whose corners count as lying on one line


@dataclass
class Stance(Rows):
    """Ground poses of the soles of N robots in the anchor frame, left before right."""

    xy: Array  # (N, 2, 2) [m]
    yaw: Array  # (N, 2) [rad]

    def pos(self) -> Array:
        """Positions (N, 2, 3) [m] of the soles on the ground."""
        return np.concatenate([self.xy, np.zeros((*self.yaw.shape, 1))], axis=-1)

    def rot(self) -> Array:
        """Rotations (N, 2, 3, 3) of the soles, flat on the ground."""
        return yaw_matrix(self.yaw)

    def toward(self, other: "Stance", fraction: float) -> "Stance":
        """A step from this stance to another."""
        return Stance(self.xy + fraction * (other.xy - self.xy), self.yaw + fraction * (other.yaw - self.yaw))

    def moved(self, side: NDArray[np.int64], xy: Array) -> "Stance":
        """With soles `side` (N,) at other places (N, 2) [m], turned like the others."""
        places, yaw, rows = self.xy.copy(), self.yaw.copy(), np.arange(len(side))
        places[rows, side], yaw[rows, side] = xy, yaw[rows, 1 - side]
        return Stance(places, yaw)

    def width(self) -> Array:
        """Distances (N,) [m] between the soles across their mean heading."""
        yaw = 0.5 * (self.yaw[:, 0] + self.yaw[:, 1])
        line = self.xy[:, 0] - self.xy[:, 1]
        return line[:, 1] * np.cos(yaw) - line[:, 0] * np.sin(yaw)

    def hull(self, corners: Array) -> "Hull":
        """Convex hulls of sole corners (C, 3) given in the sole frame."""
        places = self.xy[:, :, None] + corners[:, :2] @ self.rot()[:, :, :2, :2].swapaxes(-1, -2)
        return Hull.of(places.reshape(len(self.yaw), -1, 2))


@dataclass
class Hull(Rows):
    """Convex hulls of C points each, one half-plane `normal x <= offset` a point.

    Of a point inside the hull the normal is zero and the offset infinite.
    """

    points: Array  # (N, C, 2) [m]
    following: NDArray[np.int64]  # (N, C) the next corner counter-clockwise, -1 of a point inside
    normal: Array  # (N, C, 2) outward, of unit length
    offset: Array  # (N, C) [m]
    centre: Array  # (N, 2) [m] mean of the corners

    @classmethod
    def of(cls, points: Array) -> "Hull":
        """The hulls of points (N, C, 2): no point is right of an edge, nor beyond it on its line."""
        way = points[:, None] - points[:, :, None]  # (N, C, C, 2) from each to each
        first, other = way[:, :, :, None], way[:, :, None]
        area = first[..., 0] * other[..., 1] - first[..., 1] * other[..., 0]  # (N, C, C, C)
        along = dot(first, other)
        between = (area <= COLLINEAR) & (along >= 0.0) & (along <= dot(first, first))
        edge = ((area > COLLINEAR) | ((area >= -COLLINEAR) & between)).all(axis=-1)
        edge &= dot(way, way) > COLLINEAR
        corner = np.logical_or.reduce(edge, axis=-1)
        following = np.where(corner, edge.argmax(axis=-1), -1)
        line = np.take_along_axis(points, np.maximum(following, 0)[..., None], axis=1) - points
        outward = np.stack([line[..., 1], -line[..., 0]], axis=-1)
        normal = np.where(corner[..., None], outward / np.maximum(norm(line), 1e-9)[..., None], 0.0)
        offset = np.where(corner, dot(normal, points), np.inf)
        share = corner / np.count_nonzero(corner, axis=1)[:, None]
        return cls(points, following, normal, offset, (share[:, None] @ points)[:, 0])

    def moved(self, by: Array) -> "Hull":
        """Shifted by (N, 2) [m]."""
        offset = self.offset + (self.normal @ by[..., None])[..., 0]
        return Hull(self.points + by[:, None], self.following, self.normal, offset, self.centre + by)

    def corners(self, row: int) -> Array:
        """Corners (V, 2) [m] of one hull, counter-clockwise."""
        following = self.following[row]
        order = [int(np.argmax(following >= 0))]
        while following[order[-1]] != order[0]:
            order.append(int(following[order[-1]]))
        return self.points[row, order]

    def outside(self, point: Array) -> Array:
        """How far (N,) [m] points (N, 2) are outside; negative inside."""
        return ((self.normal @ point[..., None])[..., 0] - self.offset).max(axis=1)


def half_planes(corners: Array) -> tuple[Array, Array]:
    """Outward unit normals (V, 2) and offsets (V,) [m] of one counter-clockwise polygon (V, 2)."""
    edge = np.roll(corners, -1, axis=0) - corners
    normal = np.stack([edge[:, 1], -edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1)[:, None]
    return normal, (normal * corners).sum(axis=1)


def measured_stance(base: Pose, bodies: Bodies) -> Stance:
    """The flat stances nearest to the soles of N bases in the anchor frame."""
    level = base.rot[:, None, :2]
    heading = (level @ bodies.rot[:, SOLES, :, :1])[..., 0]  # (N, 2, 2)
    places = base.pos[:, None, :2] + (level @ bodies.pos[:, SOLES, :, None])[..., 0]
    return Stance(places, np.arctan2(heading[..., 1], heading[..., 0]))


def base_from_stance(bodies: Bodies, up_b: Array, stance: Stance | None) -> Pose:
    """Base poses in the anchor frame from the soles and the vertical (N, 3), both seen from the base.

    Roll and pitch come from the vertical, yaw from the line between the soles, position from their mean.
    Without a stance the anchor is the mean of the soles with x along their mean heading.
    """
    left, right = bodies.pos[:, SOLES[0]], bodies.pos[:, SOLES[1]]
    line = left - right
    y = line - up_b * dot(up_b, line)[:, None]
    y /= norm(y)[:, None]
    level = np.stack([cross(y, up_b), y, up_b], axis=1)  # base to a level frame along the line
    if stance is None:
        heading = rotate(level, bodies.rot[:, SOLES[0], :, 0] + bodies.rot[:, SOLES[1], :, 0])
        yaw = -np.arctan2(heading[:, 1], heading[:, 0])
        centre = np.zeros((len(yaw), 2))
    else:
        along = stance.xy[:, 0] - stance.xy[:, 1]
        yaw = np.arctan2(-along[:, 0], along[:, 1])
        centre = 0.5 * (stance.xy[:, 0] + stance.xy[:, 1])
    return _standing(yaw_matrix(yaw) @ level, 0.5 * (left + right), centre)


def base_from_sole(sole_b: Pose, up_b: Array, xy: Array, yaw: Array) -> Pose:
    """Base poses in the anchor frame from the vertical (N, 3) and the one sole that stands, both in the base.

    xy: (N, 2) [m] where that sole stands in the anchor frame; yaw: (N,) [rad].
    """
    heading = sole_b.rot[..., 0]
    x = heading - up_b * dot(up_b, heading)[:, None]
    x /= norm(x)[:, None]
    return _standing(yaw_matrix(yaw) @ np.stack([x, cross(up_b, x), up_b], axis=1), sole_b.pos, xy)


def _standing(rot: Array, point_b: Array, xy: Array) -> Pose:
    """The base whose point (N, 3) lies on the ground at (N, 2) [m]."""
    pos = -rotate(rot, point_b)
    pos[:, :2] += xy
    return Pose(pos, rot)
