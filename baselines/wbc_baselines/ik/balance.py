"""Contact forces that keep robots upright, and the joint torques that produce them."""

import daqp
import numpy as np
from numpy.typing import NDArray

from wbc_baselines.ik.geometry import cross, rotate, transposed

Array = NDArray[np.float64]
TOLERANCE = 1e-9  # [N] of a force that should not pull; choice


def friction_rays(friction: float) -> Array:
    """Edges (4, 3) of the pyramid inside the friction cone of a contact with the ground, z up."""
    m = friction / np.sqrt(2)
    return np.array([(m, m, 1.0), (m, -m, 1.0), (-m, m, 1.0), (-m, -m, 1.0)])


def distribute_contact_forces(
    points: Array, rays: Array, wrench: Array, weight: Array, damping: float
) -> Array:
    """Forces (N, P, 3) [N] at points (N, P, 3) [m], relative to the centres of mass, nearest to wrenches.

    wrench: (N, 6) force [N] over moment [N m] about the centre of mass; weight: (6,) on its rows. Minimises
    |W (G f - wrench)|^2 + |damping f|^2 over f = sum of non-negative multiples of the rays (R, 3).
    Source: Ott et al. 2011 (contact forces for balancing).
    """
    count, size = len(points), points.shape[1] * len(rays)
    force = np.broadcast_to(rays, (count, points.shape[1], *rays.shape))
    columns = np.concatenate([force, cross(points[:, :, None], rays)], axis=-1).reshape(count, size, 6)
    columns *= weight  # (N, P R, 6)
    hessian = columns @ transposed(columns)
    hessian.reshape(count, -1)[:, :: size + 1] += damping**2
    slope = -rotate(columns, weight * wrench)
    lower, upper, sense = np.zeros(size), np.full(size, 1e30), np.zeros(size, dtype=np.intc)
    no_rows = np.empty((0, size))
    multiples = np.array(
        [
            daqp.solve(h, s, no_rows, upper, lower, sense, primal_tol=TOLERANCE)[0]
            for h, s in zip(hessian, slope, strict=True)
        ]
    )
    multiples = np.maximum(multiples, 0.0)  # rounding
    return multiples.reshape(count, points.shape[1], len(rays)) @ rays
