"""The task-progress reference, a distance that decays with time alone."""

from wbc_baselines.learned.policy.inputs import Array


def initial_reference(pos_err: Array, rot_err: Array) -> Array:
    """Compute the initial d_ref (N,) of errors [m] and [rad]. Source: paper, eq. rfm_phase, first line."""
    return 2 * pos_err + rot_err


def advance(d_ref: Array, decay: Array | float, period: float) -> Array:
    """Advance d_ref (N,) by one control period [s]; decay [1/s].

    Source: paper, eq. rfm_phase, second line.
    """
    return (d_ref - decay * period).clip(min=0.0)
