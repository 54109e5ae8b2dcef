"""METRICS: one number per episode, each with its unit, its direction and the place its formula comes from.

Pure NumPy. A value that is undefined (an episode of no steps, a window too short) is NaN, never 0.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wbc_bench.outcomes import EpisodeBatch, Outcome

FloatArray = NDArray[np.float64]

PAPER = "Chen et al., Learning Holistic Whole-Body Loco-Manipulation, Sec. IV-B"
SPARC_PAPER = "Balasubramanian et al. 2015, J. NeuroEng. Rehabil. 12:112, eqs. 4-6"

# Defaults of the SPARC paper (its Sec. "Modified spectral arc length").
SPARC_CUTOFF = (
    10.0  # [Hz] faster than any movement of the arm, below the 25 Hz Nyquist limit of 50 Hz control
)
SPARC_THRESHOLD = 0.05  # of the peak of the spectrum
SPARC_PADDING = 4  # the spectrum is sampled 2**4 times as finely as the window asks for

AFTER_PUSH = 2.0  # [s] choice: the quiet end of the released protocols, where no second push comes


class Metric(NamedTuple):
    """One column of the episode record."""

    name: str
    unit: str  # of the stored value; "1" is dimensionless
    better: Literal["higher", "lower", "none"]
    source: str
    compute: Callable[[EpisodeBatch], FloatArray]  # -> (N,)


def mean_where(values: FloatArray, mask: NDArray[np.bool_]) -> FloatArray:
    """Mean over the second axis where `mask` holds; (N, T) -> (N,), NaN where nothing does."""
    count = mask.sum(axis=1)
    total = np.where(mask, values, 0.0).sum(axis=1)
    return np.divide(total, count, out=np.full(len(count), np.nan), where=count > 0)


def window_mask(batch: EpisodeBatch) -> NDArray[np.bool_]:
    """(N, T): the last `window` completed steps of each episode, or what there is of them."""
    t = np.arange(batch.position_error.shape[1])  # (T,) [control steps]
    return (t >= batch.steps[:, None] - batch.window) & (t < batch.steps[:, None])


def success(batch: EpisodeBatch) -> FloatArray:
    return np.array([outcome == Outcome.SUCCESS for outcome in batch.outcome], dtype=np.float64)


def position_error(batch: EpisodeBatch) -> FloatArray:
    return mean_where(batch.position_error, window_mask(batch))  # [m]


def orientation_error(batch: EpisodeBatch) -> FloatArray:
    return mean_where(batch.orientation_error, window_mask(batch))  # [rad]


def action_variation(batch: EpisodeBatch) -> FloatArray:
    """Mean over t >= 1 of ||a_t - a_{t-1}||^2, actions normalised by the policy's scales."""
    return _mean_squared_change(batch.action, batch)  # [1]


def action_variation_rad(batch: EpisodeBatch) -> FloatArray:
    """As `action_variation`, of the commands themselves: it does not depend on an action scale."""
    return _mean_squared_change(batch.command, batch)  # [rad^2]


def _mean_squared_change(values: FloatArray, batch: EpisodeBatch) -> FloatArray:
    """Mean over t >= 1 of the squared norm of what (N, T, K) `values` change from a step to the next."""
    change = np.sum(np.diff(values, axis=1) ** 2, axis=2)  # (N, T-1)
    return mean_where(change, _completed(batch)[:, 1:])


def command_rate(batch: EpisodeBatch) -> FloatArray:
    """Root mean square over joints and steps of the rate at which commands change."""
    return np.sqrt(action_variation_rad(batch) / batch.command.shape[2]) / batch.control_period  # [rad/s]


def time_to_reach(batch: EpisodeBatch) -> FloatArray:
    """When the end-effector comes inside both tolerances and stays for a window's length; NaN if never."""
    window = batch.window
    total = np.cumsum(np.pad(batch.inside, ((0, 0), (1, 0))), axis=1)  # steps inside before t
    held = total[:, window:] - total[:, :-window] == window  # (N, T - window + 1), by the first step
    first = (held.argmax(axis=1) + 1) * batch.control_period  # [s] the state after the first step counts
    return np.where(held.any(axis=1), first, np.nan)


def energy(batch: EpisodeBatch) -> FloatArray:
    """Positive mechanical work of the motors: what a drive that recovers nothing takes, heat aside."""
    return _total(batch.work, batch)  # [J]


def mean_power(batch: EpisodeBatch) -> FloatArray:
    return energy(batch) / duration(batch)  # [W]


def torque_limit_share(batch: EpisodeBatch) -> FloatArray:
    return mean_where(batch.at_torque_limit.astype(np.float64), _completed(batch))


def speed_limit_share(batch: EpisodeBatch) -> FloatArray:
    return mean_where(batch.at_speed_limit.astype(np.float64), _completed(batch))


def foot_slip(batch: EpisodeBatch) -> FloatArray:
    return _total(batch.slip, batch)  # [m]


def _total(values: FloatArray, batch: EpisodeBatch) -> FloatArray:
    """Sum of (N, T) `values` over the completed steps; NaN without a step."""
    total = np.where(np.isnan(values), 0.0, values).sum(axis=1)
    return np.where(batch.steps > 0, total, np.nan)


def push_error(batch: EpisodeBatch) -> FloatArray:
    """Largest position error after a push that met the end-effector inside the tolerances.

    It is searched from the push on for AFTER_PUSH, or to the end of the episode. NaN where no push met it
    so: on the way to the target the error says nothing of the push.
    """
    after = round(AFTER_PUSH / batch.control_period)
    t = np.arange(batch.inside.shape[1])
    start = batch.push_step[:, :, None]  # (N, P, 1)
    met = np.take_along_axis(batch.inside, np.maximum(batch.push_step - 1, 0), axis=1)  # (N, P)
    met &= (batch.push_step > 0) & (batch.push_step < batch.steps[:, None])
    searched = ((t >= start) & (t < start + after) & met[..., None]).any(axis=1)  # (N, T)
    searched &= _completed(batch)
    largest = np.where(searched, batch.position_error, -np.inf).max(axis=1)
    return np.where(searched.any(axis=1), largest, np.nan)  # [m]


def _completed(batch: EpisodeBatch) -> NDArray[np.bool_]:
    """(N, T): the control steps that an episode made."""
    return np.arange(batch.inside.shape[1]) < batch.steps[:, None]


def ee_speed(batch: EpisodeBatch) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Speed between successive steps, (N, T-1) [m/s], and where both of them are in the window."""
    speed = np.linalg.norm(np.diff(batch.ee_pos_w, axis=1), axis=2) / batch.control_period  # [m/s]
    inside = window_mask(batch)
    return speed, inside[:, 1:] & inside[:, :-1]


def ee_speed_rms(batch: EpisodeBatch) -> FloatArray:
    speed, inside = ee_speed(batch)
    return np.sqrt(mean_where(speed**2, inside))  # [m/s]


def ee_sparc(batch: EpisodeBatch) -> FloatArray:
    """Smoothness of the end-effector's speed in the window; 0 is smoothest.

    NaN unless the episode filled the whole window: the arc length depends on the duration, so that a
    shorter window would not compare.
    """
    result = np.full(len(batch.steps), np.nan)
    full = (batch.steps >= batch.window) & (batch.window > 2)
    if full.any():
        speed, inside = ee_speed(batch)
        profile = speed[full][inside[full]].reshape(-1, batch.window - 1)
        result[full] = spectral_arc_length(profile, 1.0 / batch.control_period)
    return result


def spectral_arc_length(speed: FloatArray, rate: float) -> FloatArray:
    """Negative arc length of the normalised amplitude spectrum of a speed profile.

    Args: speed (N, T) [m/s], sampled at `rate` [Hz]. Returns (N,) [1], NaN where nothing moves.
    Source: Balasubramanian et al. 2015, eqs. 4-6; the band ends at the last frequency whose amplitude
    reaches the threshold, and both axes are scaled to 0..1, hence neither the amplitude nor the width
    of the band matters, only the shape.
    """
    samples = 2 ** (int(np.ceil(np.log2(speed.shape[1]))) + SPARC_PADDING)
    frequency = np.arange(samples // 2 + 1) * rate / samples  # (F,) [Hz]
    band = frequency <= SPARC_CUTOFF
    frequency = frequency[band]
    amplitude = np.abs(np.fft.rfft(speed, n=samples, axis=1))
    peak = amplitude.max(axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        amplitude = amplitude[:, band] / peak  # (N, F) [1]
        above = amplitude >= SPARC_THRESHOLD
        first = above.argmax(axis=1)
        last = above.shape[1] - 1 - above[:, ::-1].argmax(axis=1)
        width = frequency[last] - frequency[first]  # (N,) [Hz]
        df = (frequency[1] - frequency[0]) / width[:, None]  # [1]
        arc = np.sqrt(df**2 + np.diff(amplitude, axis=1) ** 2)
    k = np.arange(arc.shape[1])
    inside = (k >= first[:, None]) & (k < last[:, None])
    length = np.where(inside, arc, 0.0).sum(axis=1)
    return np.where(above.any(axis=1) & (width > 0.0), -length, np.nan)


def duration(batch: EpisodeBatch) -> FloatArray:
    return np.where(batch.steps > 0, batch.steps * batch.control_period, np.nan)  # [s]


def infeasible_steps(batch: EpisodeBatch) -> FloatArray:
    return np.where(batch.steps > 0, batch.infeasible_steps.astype(np.float64), np.nan)


METRICS = (
    # An episode that ended at once did not succeed: success alone is defined without a step.
    Metric("success", "1", "higher", PAPER, success),
    Metric(
        "position_error", "m", "lower", f"{PAPER}: Euclidean distance; mean of the window", position_error
    ),
    Metric(
        "orientation_error", "rad", "lower", f"{PAPER}: geodesic angle; mean of the window", orientation_error
    ),
    Metric("action_variation", "1", "lower", PAPER, action_variation),
    Metric("ee_speed_rms", "m/s", "lower", "root mean square of |dp/dt| in the window", ee_speed_rms),
    Metric("ee_sparc", "1", "higher", SPARC_PAPER, ee_sparc),
    Metric("duration", "s", "none", "steps x control period", duration),
    Metric("infeasible_steps", "1", "lower", "control steps without a solution", infeasible_steps),
    Metric("action_variation_rad", "rad^2", "lower", "mean |q*_t - q*_(t-1)|^2", action_variation_rad),
    Metric("command_rate", "rad/s", "lower", "root mean square of dq*/dt", command_rate),
    Metric("time_to_reach", "s", "lower", "first entry that is held for the window", time_to_reach),
    Metric("energy", "J", "lower", "sum of max(tau qd, 0) dt over physics steps and joints", energy),
    Metric("mean_power", "W", "lower", "energy / duration", mean_power),
    Metric(
        "torque_limit_share",
        "1",
        "lower",
        "control steps with a joint at its torque limit",
        torque_limit_share,
    ),
    Metric(
        "speed_limit_share", "1", "lower", "control steps with a joint at its speed limit", speed_limit_share
    ),
    Metric("foot_slip", "m", "lower", "way of the loaded soles along the ground", foot_slip),
    Metric("push_error", "m", "lower", "largest position error in the 2 s after a push", push_error),
)


def compute(batch: EpisodeBatch) -> dict[str, FloatArray]:
    """Every metric of a batch: name -> (N,)."""
    return {metric.name: metric.compute(batch) for metric in METRICS}
