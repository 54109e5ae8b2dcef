"""The whole-body inverse kinematics as one quadratic program, in PlaCo."""

import contextlib
import json
import os
import sys
import tempfile
import weakref
from pathlib import Path

import numpy as np
import placo
from numpy.typing import NDArray

from wbc_baselines.ik.config import Weights
from wbc_baselines.ik.model import ARM_LINKS, BODY_LINKS, Pose
from wbc_bench.robot import JOINT_NAMES, Robot

Array = NDArray[np.float64]


# PlaCo 0.10.2 never frees a wrapper, of 474 KiB, and every shard builds a controller: those whose solver is
# gone serve again. Each serves one solver at a time, since it holds the configuration of a step.
_IDLE: dict[str, list[placo.RobotWrapper]] = {}  # URDF -> wrappers that no solver uses


class PlacoIK:
    """One step of differential inverse kinematics over the floating base.

    Stateless between steps: the configuration goes in and comes out, so that one program serves all episodes.
    """

    def __init__(self, robot: Robot, weights: Weights, period: float) -> None:
        urdf = robot.urdf()
        idle = _IDLE.setdefault(urdf, [])
        self._robot = wrapper = idle.pop() if idle else _load(urdf)
        weakref.finalize(self, idle.append, wrapper)
        wrapper.reset()
        margin = weights.joint_margin
        for name, lower, upper, speed in zip(
            JOINT_NAMES, robot.lower, robot.upper, robot.velocity, strict=True
        ):
            wrapper.set_joint_limits(name, lower + margin, upper - margin)
            wrapper.set_velocity_limit(name, weights.speed_fraction * speed)
        self._solver = solver = wrapper.make_solver()
        solver.dt = period
        solver.enable_joint_limits(True)
        ee = solver.add_frame_task("tcp", np.eye(4))
        ee.configure("ee", "soft", weights.ee_position, weights.ee_orientation)
        self._ee = ee.position(), ee.orientation()
        # Legs of 4 joints without an ankle roll: two 6-D feet have rank 10 of 12, and in a stance that is
        # wider or narrower than the hips no sole can be flat. Position and pitch are hard, the rest is soft.
        self._feet = []
        for side in "LR":
            position = solver.add_position_task(f"sole_{side}", np.zeros(3))
            position.configure(f"{side}_position", "hard", 1.0)
            pitch = solver.add_orientation_task(f"sole_{side}", np.eye(3))
            pitch.configure(f"{side}_pitch", "hard", 1.0)
            pitch.mask.set_axises("y", "local")
            flat = solver.add_orientation_task(f"sole_{side}", np.eye(3))
            flat.configure(f"{side}_flat", "soft", weights.foot_flat)
            self._feet.append((position, pitch, flat))
        self._centre = np.zeros(3)
        self._com = solver.add_com_task(self._centre)
        self._com.mask.set_axises("xy")  # pyright: ignore[reportCallIssue]  (the stub lacks the default)
        self._com.configure("com", "soft", weights.com)
        self._polygon = solver.add_com_polygon_constraint([np.zeros(2)] * 3, weights.com_margin)
        self._polygon.configure("polygon", "hard")
        self._corners: dict[int, list[Array]] = {}
        collisions = solver.add_avoid_self_collisions_constraint()
        collisions.configure("collisions", "soft", weights.collision)
        collisions.self_collisions_margin = weights.collision_margin
        collisions.self_collisions_trigger = weights.collision_trigger
        upright = solver.add_orientation_task("base_Link", np.eye(3))
        upright.configure("upright", "soft", weights.upright)
        self._posture = solver.add_joints_task()
        solver.add_regularization_task(weights.regularization)

    def step(
        self,
        q: Array,
        ee: Pose,
        soles: list[Pose],
        hull: Array,
        posture: Array,
        posture_weight: float,
        limit_speed: bool = True,
    ) -> Array | None:
        """The configuration (21,) one step on, or None when the program has no solution.

        q: (21,) configuration to start from; ee, soles: poses asked for; hull: (V, 2) support polygon,
        counter-clockwise; posture: (14,) joint positions preferred, by a weight. All in the anchor frame.
        """
        robot, solver = self._robot, self._solver
        robot.state.q = q
        robot.update_kinematics()
        self._ee[0].target_world, self._ee[1].R_world_frame = ee
        for (position, pitch, flat), (pos, rot) in zip(self._feet, soles, strict=True):
            position.target_world = pos
            pitch.R_world_frame = flat.R_world_frame = rot
        self._centre[:2] = np.add.reduce(hull) / len(hull)  # np.mean takes four times as long
        self._com.target_world = self._centre
        # PlaCo 0.10.2 never lets go of the arrays that it is given here: it gets the same ones every time
        corners = self._corners.setdefault(len(hull), [np.zeros(2) for _ in hull])
        for corner, point in zip(corners, hull[::-1], strict=True):  # it wants them clockwise
            corner[:] = point
        self._polygon.polygon = corners
        self._posture.set_joints(dict(zip(JOINT_NAMES, posture.tolist(), strict=True)))
        self._posture.configure("posture", "soft", posture_weight)
        solver.enable_velocity_limits(limit_speed)
        try:
            solver.solve(True)
        except RuntimeError:
            return None
        return robot.state.q.copy()


def _load(urdf: str) -> placo.RobotWrapper:
    """The robot with the pairs of parts that can meet: forearm, wrist and gripper with base and legs."""
    with tempfile.TemporaryDirectory() as folder, _quiet(Path(folder) / "log"):
        wrapper = placo.RobotWrapper("", 0, urdf)
        pairs = [[arm, body] for arm in ARM_LINKS for body in BODY_LINKS]
        file = Path(folder) / "pairs.json"
        file.write_text(json.dumps(pairs))
        wrapper.load_collision_pairs(str(file))
    return wrapper


@contextlib.contextmanager
def _quiet(log: Path):
    """PlaCo prints the overlaps of neighbouring parts from C++: send its streams to a file meanwhile."""
    sys.stdout.flush()
    streams = (1, 2)
    kept = [os.dup(stream) for stream in streams]
    with log.open("w") as file:
        for stream in streams:
            os.dup2(file.fileno(), stream)
        try:
            yield
        finally:
            for stream, copy in zip(streams, kept, strict=True):
                os.dup2(copy, stream)
                os.close(copy)
