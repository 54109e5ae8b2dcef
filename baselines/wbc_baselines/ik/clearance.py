"""What keeps arm and body apart: distances of their shapes, and how fast joint motion closes them."""

import warnings

import mujoco
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from wbc_baselines.ik.geometry import dot, norm
from wbc_baselines.ik.kinematics import Kinematics
from wbc_baselines.ik.model import ARM_LINKS, BODY_LINKS
from wbc_bench.robot import Robot

Array = NDArray[np.float64]
SPHERES = 4  # that cover a cylinder of the arm: more mistake less for near, and take longer; choice


class Clearance:
    """The pairs of shapes that are kept apart: every one of the arm with every one of the body.

    The parts are convex, so the normal between nearest points is that of both: a pair closes with the
    relative velocity of these points along it. Source: Kanoun, Lamiraux & Wieber 2011, eq. 14.
    """

    def __init__(self, robot: Robot, model: pin.Model, trigger: float) -> None:
        self._model, self.trigger = model, trigger
        self._geometry = geometry = pin.buildGeomFromUrdfString(model, robot.urdf(), pin.COLLISION)
        parts = geometry.geometryObjects
        links = [model.frames[part.parentFrame].name for part in parts]
        self._joints = [part.parentJoint for part in parts]
        arms = [i for i, link in enumerate(links) if link in ARM_LINKS]
        bodies = [i for i, link in enumerate(links) if link in BODY_LINKS]
        self._pairs = [(arm, body) for arm in arms for body in bodies]
        self.names = [(parts[arm].name, parts[body].name) for arm, body in self._pairs]
        for pair in self._pairs:
            geometry.addCollisionPair(pin.CollisionPair(*pair))
        self._data = pin.GeometryData(geometry)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # deprecated, and what switches it on all the same
            for request in self._data.distanceRequests:
                # it would begin where the last call ended: distances of one robot would depend on another's
                request.enable_cached_gjk_guess = False

    def rows(self, data: pin.Data, pairs: NDArray[np.int64] | None = None) -> tuple[Array, Array]:
        """Of each pair nearer than the trigger: how fast it closes (S, 20), and its distance (S,) [m].

        data: after `computeJointJacobians`; pairs: those that may be near, all when not given.
        """
        model = self._model
        pin.updateGeometryPlacements(model, data, self._geometry, self._data)
        rows, distances = [], []
        for k in range(len(self._pairs)) if pairs is None else pairs.tolist():
            result = pin.computeDistance(self._geometry, self._data, k)
            if result.min_distance < self.trigger:
                pair, normal = self._pairs[k], result.normal  # from the first to the second nearest point
                row = np.zeros(model.nv)
                for sign, i, point in (
                    (1, pair[0], result.getNearestPoint1()),
                    (-1, pair[1], result.getNearestPoint2()),
                ):
                    jacobian = pin.getJointJacobian(model, data, self._joints[i], pin.WORLD)
                    row += sign * np.concatenate([normal, np.cross(point, normal)]) @ jacobian
                rows.append(row)
                distances.append(result.min_distance)
        return np.array(rows).reshape(-1, model.nv), np.array(distances)


class Proximity:
    """Which pairs of N robots can be nearer than the trigger, from spheres that cover the parts of the arm.

    Cylinders of the legs are replaced by capsules that contain them. MuJoCo's capsules are cylinders in the
    URDF, longer by their radius at both ends.
    """

    def __init__(self, kinematics: Kinematics, clearance: Clearance) -> None:
        self._kinematics, model = kinematics, kinematics.model
        names: dict[str, int] = {}  # of Pinocchio's shapes: link and number
        for geom in range(model.ngeom):
            link = model.body(model.geom_bodyid[geom]).name
            names[f"{link}_{sum(name.rsplit('_', 1)[0] == link for name in names)}"] = geom
        pairs = np.array([(names[arm], names[body]) for arm, body in clearance.names])
        self._arm, bodies = np.unique(pairs[:, 0]), np.unique(pairs[:, 1])
        box, size = model.geom_type == mujoco.mjtGeom.mjGEOM_BOX, model.geom_size
        self._legs, self._base = bodies[~box[bodies]], bodies[box[bodies]]
        order = [*self._legs, *self._base]
        places = {pair: k for k, pair in enumerate((a, b) for a in self._arm for b in order)}
        self._order = np.array([places[arm, body] for arm, body in pairs.tolist()])
        length = size[:, 0] + size[:, 1]  # [m] half of a cylinder's
        owner, along, radius = [], [], []
        for k, geom in enumerate(self._arm):
            count = 1 if box[geom] else SPHERES
            owner += [k] * count
            along += ((2 * np.arange(count) + 1 - count) / count * length[geom]).tolist()
            radius += [
                np.linalg.norm(size[geom]) if box[geom] else np.hypot(length[geom] / count, size[geom, 0])
            ] * count
        self._owner, self._along = np.array(owner), np.array(along)[:, None]
        self._first = np.flatnonzero(np.diff(self._owner, prepend=-1))  # sphere of each shape
        self._length, self._size = length[self._legs], size[self._base]
        near = np.array(radius)[:, None] + clearance.trigger  # (K, 1)
        self._near_legs, self._near_base = near + size[self._legs, 0], near

    def near(self, count: int) -> NDArray[np.bool_]:
        """Whether each pair (N, P) of `count` robots can be near, at the joints of the latest kinematics."""
        pos, rot = self._kinematics.shapes(count, self._arm)
        spheres = pos[:, self._owner] + self._along * rot[..., 2][:, self._owner]  # (N, K, 3)
        centre, rot = self._kinematics.shapes(count, self._legs)
        axis, apart = rot[..., 2][:, None], spheres[:, :, None] - centre[:, None]  # (N, K, B, 3)
        along = np.clip(dot(apart, axis), -self._length, self._length)
        legs = norm(apart - along[..., None] * axis) < self._near_legs
        centre, rot = self._kinematics.shapes(count, self._base)
        inside = (spheres[:, None] - centre[:, :, None]) @ rot  # (N, B, K, 3)
        base = norm(np.maximum(np.abs(inside) - self._size[:, None], 0.0)).swapaxes(1, 2) < self._near_base
        found = np.logical_or.reduceat(np.concatenate([legs, base], axis=2), self._first, axis=1)
        return found.reshape(count, -1)[:, self._order]
