"""The task-progress reference, a distance that decays with time alone, and the phase derived from it."""

from typing import TYPE_CHECKING

from wbc_baselines.learned.policy.inputs import Array

if TYPE_CHECKING:  # an evaluation needs no torch
    from torch import Tensor

GATE_SLOPE = 5.0  # k. Source: SPIRAL-EDWIN/JC_umi-on-tron @f83d62e
GATE_CENTRE = 1.0  # mu, in the unit of d_ref. Source: as above


def initial_reference(pos_err: Array, rot_err: Array) -> Array:
    """Compute the initial d_ref (N,) of errors [m] and [rad]. Source: paper, eq. rfm_phase, first line."""
    return 2 * pos_err + rot_err


def advance(d_ref: Array, decay: Array | float, period: float) -> Array:
    """Advance d_ref (N,) by one control period [s]; decay [1/s].

    Source: paper, eq. rfm_phase, second line.
    """
    return (d_ref - decay * period).clip(min=0.0)


def gate(d_ref: "Tensor", k: float = GATE_SLOPE, mu: float = GATE_CENTRE) -> "Tensor":
    """Compute the phase g (N,), near 1 while approaching and near 0 at the target.

    Source: paper, eq. rfm_phase.
    """
    return (k * (d_ref - mu)).sigmoid()
