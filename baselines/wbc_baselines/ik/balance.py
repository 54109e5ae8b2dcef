"""Contact forces that keep the robot upright, and the joint torques that produce them."""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

Array = NDArray[np.float64]


def friction_rays(friction: float) -> Array:
    """Edges (4, 3) of the pyramid inside the friction cone of a contact with the ground, z up."""
    m = friction / np.sqrt(2)
    return np.array([(m, m, 1.0), (m, -m, 1.0), (-m, m, 1.0), (-m, -m, 1.0)])


def distribute_contact_forces(
    points: Array, rays: Array, wrench: Array, weight: Array, damping: float
) -> Array:
    """Forces (P, 3) [N] at points (P, 3) [m], relative to the centre of mass, that come closest to a wrench.

    wrench: (6,) force [N] over moment [N m] about the centre of mass; weight: (6,) on its rows. Minimises
    |W (G f - wrench)|^2 + |damping f|^2 over f = sum of non-negative multiples of the rays (R, 3).
    Source: Ott et al. 2011 (contact forces for balancing); Lawson & Hanson 1974 (NNLS).
    """
    px, py, pz = points.T[:, :, None]
    fx, fy, fz = rays.T[:, None, :]
    size = len(points) * len(rays)
    columns = np.empty((6 + size, size))
    rows = columns[:6].reshape(6, len(points), len(rays))
    rows[0], rows[1], rows[2] = fx, fy, fz
    rows[3], rows[4], rows[5] = py * fz - pz * fy, pz * fx - px * fz, px * fy - py * fx
    columns[:6] *= weight[:, None]
    columns[6:] = 0.0
    columns[np.arange(6, 6 + size), np.arange(size)] = damping
    goal = np.zeros(6 + size)
    goal[:6] = weight * wrench
    multiples, _ = nnls(columns, goal)
    return multiples.reshape(len(points), len(rays)) @ rays
