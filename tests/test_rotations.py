"""Rotations: group axioms, round trips over every angle, and agreement with SciPy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wbc_bench.rotations import (
    geodesic_angle,
    matrix_from_rho6,
    matrix_from_rotvec,
    matrix_from_rpy,
    matrix_from_wxyz,
    rho6,
    rotvec_from_matrix,
    rpy_from_matrix,
    wxyz_from_matrix,
    wxyz_from_xyzw,
    xyzw_from_wxyz,
)

COUNT = 200
SCIPY = Rotation.random(COUNT, rng=np.random.default_rng(0))
ROT = SCIPY.as_matrix()
AXES = np.random.default_rng(1).normal(size=(COUNT, 3))
AXES /= np.linalg.norm(AXES, axis=1, keepdims=True)
ANGLES = (0.0, 1e-12, 1e-9, 1e-6, 0.1, np.pi / 2, 3.0, np.pi - 1e-6, np.pi - 1e-9, np.pi)


def close(a: np.ndarray, b: np.ndarray, atol: float = 1e-14) -> None:
    np.testing.assert_allclose(a, b, rtol=0, atol=atol)


def test_group_axioms() -> None:
    a, b, c = ROT, np.roll(ROT, 1, axis=0), np.roll(ROT, 2, axis=0)
    qa, qb, qab = (matrix_from_wxyz(wxyz_from_matrix(m)) for m in (a, b, a @ b))
    close(qa @ qb, qab)  # closed, and the map keeps the product
    close((qa @ qb) @ c, qa @ (qb @ c))
    close(matrix_from_wxyz(np.array([1.0, 0, 0, 0])), np.eye(3))
    close(qa @ np.swapaxes(qa, 1, 2), np.broadcast_to(np.eye(3), qa.shape))
    close(np.linalg.det(qa), np.ones(COUNT))
    close(matrix_from_rotvec(0.7 * AXES) @ matrix_from_rotvec(0.5 * AXES), matrix_from_rotvec(1.2 * AXES))
    close(matrix_from_rotvec(-AXES), np.swapaxes(matrix_from_rotvec(AXES), 1, 2))


def test_agrees_with_scipy() -> None:
    quat = SCIPY.as_quat(canonical=True)  # xyzw, w >= 0
    close(xyzw_from_wxyz(wxyz_from_matrix(ROT)), quat)
    close(matrix_from_wxyz(wxyz_from_xyzw(quat)), ROT)
    close(matrix_from_wxyz(-wxyz_from_xyzw(quat)), ROT)  # both signs are the same rotation
    close(rotvec_from_matrix(ROT), SCIPY.as_rotvec(), 1e-13)
    close(matrix_from_rotvec(SCIPY.as_rotvec()), ROT)
    rpy = np.random.default_rng(2).uniform(-4, 4, (COUNT, 3))
    close(matrix_from_rpy(rpy), Rotation.from_euler("xyz", rpy).as_matrix())  # lower case: fixed axes
    close(rpy_from_matrix(ROT), SCIPY.as_euler("xyz"))
    angle = (SCIPY[:-1].inv() * SCIPY[1:]).magnitude()
    close(geodesic_angle(ROT[:-1], ROT[1:]), angle, 1e-12)


@pytest.mark.parametrize("angle", ANGLES)
def test_round_trips_at_every_angle(angle: float) -> None:
    vec = angle * AXES
    rot = matrix_from_rotvec(vec)
    close(rot, Rotation.from_rotvec(vec).as_matrix())
    back = rotvec_from_matrix(rot)
    if angle > np.pi - 1e-7:  # the axis is known up to its sign where half a turn either way is the same
        back *= np.sign(np.sum(back * AXES, axis=1, keepdims=True))
    close(back, vec, 2e-15 if angle < 0.01 else 1e-14)
    quat = wxyz_from_matrix(rot)
    close(np.linalg.norm(quat, axis=1), np.ones(COUNT))
    assert (quat[:, 0] >= 0).all()
    close(matrix_from_wxyz(quat), rot)
    close(matrix_from_rotvec(rotvec_from_matrix(rot)), rot)


@pytest.mark.parametrize("axis", np.eye(3))
def test_half_turns_about_the_axes(axis: np.ndarray) -> None:
    rot = 2 * np.outer(axis, axis) - np.eye(3)  # exactly half a turn
    close(np.abs(rotvec_from_matrix(rot)), np.pi * axis, 1e-15)
    assert geodesic_angle(rot, np.eye(3)) == pytest.approx(np.pi, abs=1e-15)


def test_quaternion_order() -> None:
    close(xyzw_from_wxyz(np.array([1.0, 2, 3, 4])), np.array([2.0, 3, 4, 1]))
    close(wxyz_from_xyzw(np.array([2.0, 3, 4, 1])), np.array([1.0, 2, 3, 4]))


@pytest.mark.parametrize("angle", ANGLES)
def test_geodesic_angle_at_every_angle(angle: float) -> None:
    turned = ROT @ matrix_from_rotvec(angle * AXES)
    # d angle / d chord = 1 / cos(angle / 2): near pi an error of eps is one of sqrt(eps) in the angle
    close(
        geodesic_angle(ROT, turned), np.full(COUNT, angle), 1e-7 if angle > 3.1 else 4e-15 / np.cos(angle / 2)
    )


def test_geodesic_angle_is_a_metric() -> None:
    a, b, c = ROT, np.roll(ROT, 1, axis=0), np.roll(ROT, 2, axis=0)
    assert (geodesic_angle(a, a) == 0).all()
    close(geodesic_angle(a, b), geodesic_angle(b, a), 0)
    assert (geodesic_angle(a, c) <= geodesic_angle(a, b) + geodesic_angle(b, c) + 1e-12).all()
    close(geodesic_angle(c @ a, c @ b), geodesic_angle(a, b), 1e-12)  # the same in every frame
    assert (geodesic_angle(a, b) <= np.pi).all()


def test_rho6_and_back_also_of_noisy_columns() -> None:
    np.testing.assert_allclose(matrix_from_rho6(rho6(ROT)), ROT, atol=1e-12)
    noisy = matrix_from_rho6(rho6(ROT) + 0.05 * np.random.default_rng(3).normal(size=(len(ROT), 6)))
    np.testing.assert_allclose(
        np.swapaxes(noisy, -1, -2) @ noisy, np.broadcast_to(np.eye(3), ROT.shape), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(noisy), 1.0, atol=1e-12)


def test_rho6_is_two_columns_that_give_the_third() -> None:
    first, second = rho6(ROT)[:, :3], rho6(ROT)[:, 3:]
    close(first, ROT @ [1, 0, 0], 0)
    close(second, ROT @ [0, 1, 0], 0)
    close(np.cross(first, second), ROT[:, :, 2])


def test_any_batch_shape() -> None:
    grid = ROT.reshape(4, 50, 3, 3)
    assert wxyz_from_matrix(grid).shape == (4, 50, 4)
    assert matrix_from_rotvec(rotvec_from_matrix(grid)).shape == grid.shape
    assert rho6(grid).shape == (4, 50, 6)
    assert geodesic_angle(grid, ROT[0]).shape == (4, 50)
    assert rotvec_from_matrix(ROT[0]).shape == (3,)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_matrix_that_is_not_finite_spoils_no_other(value: float) -> None:
    spoilt = ROT.copy()
    spoilt[1, 0, 2] = value
    for inverse in (wxyz_from_matrix, rotvec_from_matrix):
        found, expected = inverse(spoilt), inverse(ROT)
        assert np.isnan(found[1]).all()
        np.testing.assert_array_equal(np.delete(found, 1, axis=0), np.delete(expected, 1, axis=0))
    assert np.isnan(wxyz_from_matrix(np.full((3, 3), value))).all()
