"""What there is to be seen of one episode at one instant."""

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from wbc_bench.evaluation.control_loop import ControlLoop
from wbc_bench.rotations import geodesic_angle

Array = NDArray[np.float64]
PUSH_SECONDS = 0.4  # [s] that a push stays to be seen
METRES_A_NEWTON, SECONDS_OF_PUSH = 1 / 500, 0.6  # lengths of arrows: [m/N], [m] a [m/s]
TOUCHES = 1.0  # [N] of a sole that stands; less is the noise of the contact solver


class Moment(NamedTuple):
    """One robot and its target."""

    time: float  # [s] since the start of the episode
    qpos: Array  # (21,) base position [m], base quaternion wxyz, joints [rad]
    scenery: Array  # (K,) positions of the joints that a scene added, e.g. of a door [rad]
    target_pos_w: Array  # (3,) [m]
    target_rot_w: Array  # (3, 3)
    ee_pos_w: Array  # (3,) [m]
    ee_rot_w: Array  # (3, 3)
    com_w: Array  # (3,) [m] centre of mass
    foot_pos_w: Array  # (2, 3) [m] left and right sole
    foot_force_w: Array  # (2, 3) [N] ground on left and right sole
    push_w: Array  # (2,) [m/s] what a push of the last PUSH_SECONDS added to the base's velocity, or zero

    @property
    def position_error(self) -> float:
        """[m]"""
        return float(np.linalg.norm(self.ee_pos_w - self.target_pos_w))

    @property
    def orientation_error(self) -> float:
        """[rad] geodesic"""
        return float(geodesic_angle(self.ee_rot_w, self.target_rot_w))


def moment_of(loop: ControlLoop, row: int, pos_w: Array, rot_w: Array, push_w: Array) -> Moment:
    """One row of a loop as it is now, with its target (3,) [m], (3, 3) and push (2,) [m/s]."""
    state = loop.state
    return Moment(
        time=loop.step * loop.period,
        qpos=loop.simulation.qpos[row],
        scenery=loop.simulation.scenery[row],
        target_pos_w=pos_w,
        target_rot_w=rot_w,
        ee_pos_w=state.ee_pos_w[row],
        ee_rot_w=state.ee_rot_w[row],
        com_w=loop.simulation.com_w[row],
        foot_pos_w=state.foot_pos_w[row],
        foot_force_w=state.foot_force_w[row],
        push_w=push_w,
    )


def force_arrows(moment: Moment) -> list[tuple[Array, Array]]:
    """From a sole to the tip of the ground's force on it, (3,) [m] each, of the soles that stand."""
    return [
        (pos_w, pos_w + METRES_A_NEWTON * force_w)
        for pos_w, force_w in zip(moment.foot_pos_w, moment.foot_force_w, strict=True)
        if force_w[2] > TOUCHES
    ]


def push_arrow(moment: Moment) -> tuple[Array, Array] | None:
    """An arrow (3,), (3,) [m] that ends at the base, while a push is to be seen."""
    base = moment.qpos[:3]
    return (base - SECONDS_OF_PUSH * np.array([*moment.push_w, 0.0]), base) if moment.push_w.any() else None


class Skeleton:
    """Where the parts of a model are; `data` is MuJoCo's, placed by `place`."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model, self.data = model, mujoco.MjData(model)
        self._corners = [[model.geom(f"foot_{side}_{k}").id for k in range(4)] for side in "LR"]

    def place(self, moment: Moment) -> None:
        """Put every body where it is at a moment."""
        self.data.qpos[:] = [*moment.qpos, *moment.scenery]
        mujoco.mj_kinematics(self.model, self.data)

    def support(self, foot_force_w: Array) -> Array:
        """Corners (K, 2) [m] of the polygon under the soles that stand, counter-clockwise; or none."""
        from scipy.spatial import ConvexHull, QhullError

        standing = [
            corner
            for corners, force in zip(self._corners, foot_force_w, strict=True)
            if force[2] > TOUCHES
            for corner in corners
        ]
        points = self.data.geom_xpos[standing, :2]
        try:
            return points[ConvexHull(points).vertices] if standing else np.empty((0, 2))
        except QhullError:  # a sole on its edge has no area
            return np.empty((0, 2))
