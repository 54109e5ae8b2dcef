"""How much disturbance a controller takes: breaking points and margins, with paired bootstrap intervals.

Success at each level, from mild to severe, is fitted by the closest curve that never rises (isotonic
regression, equal weights). All of it is computed for every resample of the episodes at once.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wbc_bench.results import stats
from wbc_bench.results.stress import Climb, LadderRecord, Stress

FloatArray = NDArray[np.float64]

BOOTSTRAP_SEED = 0
LOST = 0.5  # share of the base's success that is lost at the breaking point
NOT_REACHED = np.inf
ROUNDING = 1e-9  # of a number of successes that is a mean over levels


class Interval(NamedTuple):
    """A number and its 95 % percentile interval; NaN where it is undefined."""

    point: float
    low: float
    high: float


class Curve(NamedTuple):
    """What a controller's success becomes as one factor grows."""

    successes: NDArray[np.int64]  # (L,) of the climb's episodes
    fit: FloatArray  # (L,) success rate that never rises
    breaking: Interval  # severity, NOT_REACHED beyond the last level
    area: Interval  # under the fit, relative to the base's success


class Robustness(NamedTuple):
    """All curves of a controller and their mean area."""

    base: stats.Estimate  # success without the ladder
    curves: dict[str, Curve]  # by factor
    margin: Interval  # mean area over the factors


def isotonic(values: FloatArray) -> FloatArray:
    """The closest sequences that never rise, in least squares, (..., L) to (..., L).

    fit_i is the minimum over s <= i of the maximum over t >= i of the mean of s..t.
    Source: Robertson, Wright & Dykstra 1988, Order Restricted Statistical Inference, theorem 1.4.4.
    """
    count = values.shape[-1]
    total = np.concatenate([np.zeros((*values.shape[:-1], 1)), np.cumsum(values, axis=-1)], axis=-1)
    fit = np.full_like(values, np.inf)
    for s in range(count):
        means = (total[..., s + 1 :] - total[..., s : s + 1]) / np.arange(1, count - s + 1)  # of s..t
        largest = np.maximum.accumulate(means[..., ::-1], axis=-1)[..., ::-1]  # over t >= i
        fit[..., s:] = np.minimum(fit[..., s:], largest)
    return fit


def breaking_position(fit: FloatArray, base: FloatArray) -> FloatArray:
    """Where curves (..., L) that never rise have lost half of the base's success (...), in levels from 0.

    Linear between levels. 0 where the first level is below already, NOT_REACHED where none is, NaN for a
    base without a success.
    """
    threshold = (1.0 - LOST) * base[..., None]
    below = fit <= threshold + ROUNDING
    index = below.argmax(axis=-1)[..., None]  # the first one, 0 where there is none
    after = np.take_along_axis(fit, index, axis=-1)
    before = np.take_along_axis(fit, np.maximum(index - 1, 0), axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        position = index - 1 + (before - threshold) / (before - after)
    position = np.where(index == 0, 0.0, position)[..., 0]
    position = np.where(below.any(axis=-1), position, NOT_REACHED)
    return np.where(base > 0, position, np.nan)


def severity_at(position: FloatArray, severities: FloatArray) -> FloatArray:
    """Severity [unit of the factor] at a position between levels; NOT_REACHED and NaN stay."""
    inside = np.interp(position, np.arange(len(severities)), severities)
    return np.where(np.isfinite(position), inside, position)


def relative_area(fit: FloatArray, base: FloatArray, severities: FloatArray) -> FloatArray:
    """Area under curves (..., L) over the severities (L,), relative to the base's success (...) throughout.

    1 is a controller that loses nothing; NaN for a base without a success.
    """
    span = severities[-1] - severities[0]
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.trapezoid(fit, severities, axis=-1) / (span * base)


def resamples(episodes: int, rng: np.random.Generator) -> FloatArray:
    """How often each episode is drawn, (R + 1, N); the first row is the episodes themselves, each once."""
    drawn = rng.multinomial(episodes, np.full(episodes, 1.0 / episodes), stats.RESAMPLES)
    return np.concatenate([np.ones((1, episodes)), drawn.astype(np.float64)])


def robustness(climb: Climb, ladder: LadderRecord, rng: np.random.Generator) -> Robustness:
    """Curves, breaking points and margin of a controller; every level has the same resamples."""
    counts = resamples(climb.episodes, rng)
    base, fits = _fits(climb, counts)
    areas, curves = [], {}
    for factor in ladder.factors:
        if factor.name not in fits:
            continue
        fit, severities = fits[factor.name], factor.severities
        position = _interval(breaking_position(fit, base), climb.episodes)
        areas.append(relative_area(fit, base, severities))
        curves[factor.name] = Curve(
            climb.levels[factor.name].sum(axis=0).astype(np.int64),
            fit[0] / climb.episodes,
            Interval(*severity_at(np.array(position), severities).tolist()),
            _interval(areas[-1], climb.episodes),
        )
    rate = stats.wilson(int(climb.base.sum()), climb.episodes)
    margin = np.mean(areas, axis=0) if areas else np.full(len(counts), np.nan)
    return Robustness(rate, curves, _interval(margin, climb.episodes))


def analyse(stress: Stress) -> dict[str, Robustness]:
    """Spec -> what is measured of it; equal numbers of episodes have the same resamples."""
    return {
        climb.spec: robustness(climb, stress.ladder, np.random.default_rng(BOOTSTRAP_SEED))
        for climb in stress.climbs
    }


class Difference(NamedTuple):
    """Margin of a controller minus that of another, on the episodes and factors that both have."""

    interval: Interval
    episodes: int
    factors: int


def margin_difference(a: Climb, b: Climb, ladder: LadderRecord, rng: np.random.Generator) -> Difference:
    """The difference of two margins; both controllers have the same resamples of episodes."""
    episodes = min(a.episodes, b.episodes)
    counts = resamples(episodes, rng)
    shared = [factor for factor in ladder.factors if factor.name in a.levels and factor.name in b.levels]
    margins = []
    for climb in (a.first(episodes), b.first(episodes)):
        base, fits = _fits(climb, counts)
        areas = [relative_area(fits[factor.name], base, factor.severities) for factor in shared]
        margins.append(np.mean(areas, axis=0) if areas else np.full(len(counts), np.nan))
    return Difference(_interval(margins[0] - margins[1], episodes), episodes, len(shared))


def _fits(climb: Climb, counts: FloatArray) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Successes at the base (R,) and their isotonic fits (R, L) by factor, of every resample (R, N).

    Whole numbers rather than rates: half of a base is then met exactly.
    """
    return counts @ climb.base, {name: isotonic(counts @ solved) for name, solved in climb.levels.items()}


def _interval(values: FloatArray, episodes: int) -> Interval:
    """The first value, and the interval over the others that are defined."""
    point, draws = float(values[0]), values[1:][~np.isnan(values[1:])]
    if np.isnan(point) or episodes == 1:  # every resample is that episode: a width of 0 would claim certainty
        return Interval(point, np.nan, np.nan)
    tails = [(1.0 - stats.CONFIDENCE) / 2.0, (1.0 + stats.CONFIDENCE) / 2.0]
    # order statistics: between a severity and NOT_REACHED there is nothing to interpolate
    low, high = np.sort(draws)[[math.ceil(tail * len(draws)) - 1 for tail in tails]]
    return Interval(point, float(low), float(high))
