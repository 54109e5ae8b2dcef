"""Batched geometry and kinematics against Pinocchio and SciPy, row by row."""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial import ConvexHull

from wbc_baselines.ik.geometry import Pose, cross, log3, rotate, rotate_back, skew, turn
from wbc_baselines.ik.kinematics import GRAVITY, Configuration, Kinematics
from wbc_baselines.ik.model import WholeBodyModel, configuration
from wbc_baselines.ik.rows import Rows, on_part
from wbc_baselines.ik.stance import Stance, half_planes
from wbc_bench.robot import RobotConfig, load_robot
from wbc_bench.rotations import yaw_matrix

RNG = np.random.default_rng(0)
TURNS = [0.0, 1e-9, 1e-5, 1e-4, 0.3, 1.6, 3.0, 3.1, np.pi - 1e-6]  # [rad]


def rotvecs() -> np.ndarray:
    axes = RNG.normal(size=(len(TURNS), 3))
    return axes / np.linalg.norm(axes, axis=1, keepdims=True) * np.array(TURNS)[:, None]


def test_logarithm_undoes_the_exponential():
    rotvec = rotvecs()
    rot = np.array([pin.exp3(v) for v in rotvec])
    np.testing.assert_allclose(log3(rot), rotvec, atol=1e-9)
    np.testing.assert_allclose(log3(np.stack([rot, rot]))[1], rotvec, atol=1e-9)


def test_products_are_those_of_vectors_and_matrices():
    a, b = RNG.normal(size=(2, 4, 5, 3))
    np.testing.assert_allclose(cross(a, b), np.cross(a, b), atol=1e-12)
    np.testing.assert_allclose(rotate(skew(a), b), np.cross(a, b), atol=1e-12)
    np.testing.assert_allclose(rotate_back(skew(a), b), np.cross(b, a), atol=1e-12)


def test_a_pose_moves_along_its_twist():
    rotvec = rotvecs()
    twist = np.concatenate([RNG.normal(size=rotvec.shape), rotvec], axis=1)
    start = Pose(
        RNG.normal(size=rotvec.shape), np.array([pin.exp3(v) for v in RNG.normal(size=rotvec.shape)])
    )
    moved = start.moved(twist)
    for i, step in enumerate(twist):
        wanted = pin.SE3(start.rot[i], start.pos[i]) * pin.exp6(step)
        np.testing.assert_allclose(moved.pos[i], wanted.translation, atol=1e-9)
        np.testing.assert_allclose(moved.rot[i], wanted.rotation, atol=1e-9)


def test_half_a_turn_and_the_other_half_make_the_whole():
    start, end = (np.array([pin.exp3(v) for v in RNG.uniform(-1, 1, (6, 3))]) for _ in range(2))
    np.testing.assert_allclose(turn(turn(start, end, 0.5), end, 1.0), end, atol=1e-12)
    np.testing.assert_allclose(turn(start, end, np.zeros(6)), start, atol=1e-12)


@pytest.mark.parametrize("variant", ["paper", "limx_adapter"])
def test_kinematics_are_pinocchios(variant: str):
    robot = load_robot(RobotConfig(variant=variant))
    model, kinematics = WholeBodyModel(robot), Kinematics(robot)
    joints = robot.default_q + RNG.uniform(-0.5, 0.5, (6, 14))
    bodies = kinematics.at(joints)
    chains = (slice(8, 14), slice(0, 4), slice(4, 8))
    assert kinematics.mass == pytest.approx(model.mass)
    base = Pose(RNG.normal(size=(6, 3)), np.array([pin.exp3(v) for v in RNG.uniform(-1, 1, (6, 3))]))
    q = Configuration(base, joints)
    hand, com = q.hand(bodies), q.com(bodies)
    for i in range(len(joints)):
        model.update(model.at(joints[i]))
        for k, (frame, chain) in enumerate(zip([model.tcp, *model.soles], chains, strict=True)):
            pos, rot = model.pose(frame)
            jacobian = model.jacobian(frame)[:, 6:][:, chain]
            np.testing.assert_allclose(bodies.pos[i, k], pos, atol=1e-12)
            np.testing.assert_allclose(bodies.rot[i, k], rot, atol=1e-12)
            np.testing.assert_allclose(bodies.linear[i, chain], jacobian[:3].T, atol=1e-12)
            np.testing.assert_allclose(bodies.axis[i, chain], jacobian[3:].T, atol=1e-12)
        com_jacobian = pin.jacobianCenterOfMass(model.model, model.data)
        np.testing.assert_allclose(bodies.com_linear[i], com_jacobian[:, 6:].T, atol=1e-12)
        lifted = kinematics.mass * GRAVITY * com_jacobian[2, 6:]
        np.testing.assert_allclose(model.gravity_torques(model.at(joints[i]))[6:], lifted, atol=1e-9)
        whole = configuration(base.pos[i], base.rot[i], joints[i])
        np.testing.assert_allclose(com[i], model.com_of(whole), atol=1e-12)
        np.testing.assert_allclose(hand.pos[i], model.ee_of(whole)[0], atol=1e-12)


def test_kinematics_do_not_depend_on_the_batch():
    robot = load_robot()
    joints = robot.default_q + RNG.uniform(-0.5, 0.5, (5, 14))
    together = Kinematics(robot).at(joints)
    for i in range(5):
        for name, alone in vars(Kinematics(robot).at(joints[i : i + 1])).items():
            np.testing.assert_array_equal(alone[0], getattr(together, name)[i], err_msg=name)


def test_hulls_are_qhulls():
    """Of soles anywhere, in line, and side by side as in the default posture, where corners are collinear."""
    corners = np.array([(x, y, 0.0) for x in (-0.08, 0.09) for y in (-0.02, 0.02)])
    xy, yaw = RNG.uniform(-0.2, 0.2, (40, 2, 2)), RNG.uniform(-0.5, 0.5, (40, 2))
    xy[:2], yaw[:2] = [[[0.0, 0.1], [0.0, -0.1]], [[0.2, 0.0], [-0.1, 0.0]]], 0.0
    hull = Stance(xy, yaw).hull(corners)
    for i, points in enumerate(hull.points):
        wanted = points[ConvexHull(points).vertices]
        found = hull.corners(i)
        shift = int(np.argmin(np.linalg.norm(found - wanted[0], axis=1)))
        np.testing.assert_allclose(np.roll(found, -shift, axis=0), wanted, atol=1e-12)
        np.testing.assert_allclose(hull.centre[i], wanted.mean(axis=0), atol=1e-12)
        normal, offset = half_planes(wanted)
        away = RNG.uniform(-0.5, 0.5, (10, 2))
        outside = (away @ normal.T - offset).max(axis=1)
        alike = hull.take(np.full(10, i))
        np.testing.assert_allclose(alike.outside(away), outside, atol=1e-12)
        # a sole away moves the hull, as it does its points
        np.testing.assert_allclose(alike.moved(away).outside(2 * away), alike.outside(away), atol=1e-12)
    assert [len(hull.corners(i)) for i in (0, 1)] == [4, 4]


@dataclass
class Inner(Rows):
    value: np.ndarray


@dataclass
class Outer(Rows):
    count: np.ndarray
    inner: Inner


def test_a_part_is_changed_and_the_rest_left():
    state = Outer(np.arange(4), Inner(np.zeros((4, 2))))

    def step(part: Outer, other: Inner) -> np.ndarray:
        part.count, part.inner.value = part.count + 10, other.value
        return part.count

    seen = Inner(np.ones((4, 2)))
    np.testing.assert_array_equal(on_part(np.array([True, False, True, False]), step, state, seen), [10, 12])
    np.testing.assert_array_equal(state.count, [10, 1, 12, 3])
    np.testing.assert_array_equal(state.inner.value[:, 0], [1, 0, 1, 0])
    np.testing.assert_array_equal(on_part(np.ones(4, dtype=bool), step, state, seen), [20, 11, 22, 13])


def test_yaw_turns_about_the_vertical():
    np.testing.assert_allclose(yaw_matrix(np.array([0.3])), pin.exp3(np.array([0.0, 0.0, 0.3]))[None])
