"""Contact forces that keep the robot upright, and the joint torques that produce them."""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

Array = NDArray[np.float64]


def friction_rays(friction: float) -> Array:
    """Edges (4, 3) of the pyramid inside the friction cone, for a contact on the ground (z up)."""
    m = friction / np.sqrt(2)
    return np.array([(m, m, 1.0), (m, -m, 1.0), (-m, m, 1.0), (-m, -m, 1.0)])


def distribute(points: Array, com: Array, wrench: Array, rays: Array, weight: Array, damping: float) -> Array:
    """Forces (P, 3) [N] at ground points (P, 3) [m] that come closest to a wrench about the centre of mass.

    wrench: (6,) force [N] over moment [N m]; weight: (6,) on its rows. Minimises
    |W (G f - wrench)|^2 + |damping f|^2 over f = sum of non-negative multiples of the rays.
    Source: non-negative least squares, Lawson & Hanson 1974; Ott et al. 2011 for its use in balancing.
    """
    arm = points - com
    columns = np.concatenate(
        [np.broadcast_to(rays, (len(points), *rays.shape)), np.cross(arm[:, None, :], rays[None])], axis=2
    ).reshape(-1, 6)
    matrix = np.vstack([columns.T * weight[:, None], damping * np.eye(len(columns))])
    multiples, _ = nnls(matrix, np.concatenate([weight * wrench, np.zeros(len(columns))]))
    return multiples.reshape(len(points), len(rays)) @ rays
