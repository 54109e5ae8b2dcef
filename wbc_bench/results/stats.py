"""Intervals and paired tests. Randomness comes in as a generator; empty input raises, undefined is NaN."""

import math
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

CONFIDENCE = 0.95
Z = NormalDist().inv_cdf((1.0 + CONFIDENCE) / 2.0)  # 1.96 standard deviations
RESAMPLES = 5000  # the Monte-Carlo error of a 2.5 % tail is then 0.2 %
CHUNK_VALUES = 2_000_000  # resampled values held at once: 16 MB


class Estimate(NamedTuple):
    """A number and its interval."""

    point: float
    low: float
    high: float
    num_seeds: int  # replicates behind it; the interval covers episodes, see `method`
    num_episodes: int
    method: str


class Spread(NamedTuple):
    """A number over replicates, as the paper prints it."""

    mean: float
    sd: float  # sample standard deviation (n - 1); NaN for one replicate
    num_seeds: int


class PairedTest(NamedTuple):
    """McNemar's exact test on the same episodes."""

    only_a: int  # episodes that a alone solved
    only_b: int
    p_value: float


def wilson(successes: int, trials: int, num_seeds: int = 1) -> Estimate:
    """Wilson score interval of a proportion, 95 %.

    Raises: ValueError without trials or when successes are not in 0..trials.
    Source: Wilson 1927, JASA 22:209.
    """
    if trials <= 0 or not 0 <= successes <= trials:
        raise ValueError(
            f"{successes} successes of {trials} trials: need trials > 0 and 0 <= successes <= trials"
        )
    rate, z2 = successes / trials, Z**2
    centre = (successes + z2 / 2.0) / (trials + z2)
    half = Z / (trials + z2) * math.sqrt(trials * rate * (1.0 - rate) + z2 / 4.0)
    # At no or every success one end is exactly 0 or 1, which rounding would miss.
    low = 0.0 if successes == 0 else centre - half
    high = 1.0 if successes == trials else centre + half
    return Estimate(rate, low, high, num_seeds, trials, "Wilson 95 %")


def newcombe(a: Estimate, b: Estimate) -> Estimate:
    """Difference a - b of two proportions over different episodes, with its 95 % hybrid score interval.

    Args:
        a: One proportion with its Wilson interval, of `wilson`.
        b: The other one; its episodes are independent of those of `a`.

    Source: Newcombe 1998, Statistics in Medicine 17:873, method 10.
    """
    difference = a.point - b.point
    low = difference - math.hypot(a.point - a.low, b.high - b.point)
    high = difference + math.hypot(a.high - a.point, b.point - b.low)
    seeds, episodes = min(a.num_seeds, b.num_seeds), a.num_episodes + b.num_episodes
    return Estimate(difference, low, high, seeds, episodes, "Newcombe 95 %")


def spread(values: ArrayLike) -> Spread:
    """Mean and sample standard deviation over replicates, (R,). Raises: ValueError without a value."""
    x = _filled(values)
    return Spread(float(x.mean()), float(x.std(ddof=1)) if len(x) > 1 else float("nan"), len(x))


def bootstrap_mean(values: ArrayLike, rng: np.random.Generator, num_seeds: int = 1) -> Estimate:
    """Mean over episodes with its percentile bootstrap interval, 95 %; NaN for the ends with one episode.

    Raises: ValueError if empty.
    """
    x = _filled(values)
    draws = np.concatenate([sample.mean(axis=1) for sample in _resample(x, rng)])
    return _percentile(float(x.mean()), draws, num_seeds, len(x), "bootstrap 95 %")


def bootstrap_quantile(values: ArrayLike, q: float, rng: np.random.Generator, num_seeds: int = 1) -> Estimate:
    """Quantile over episodes with its percentile bootstrap interval, 95 %; NaN for the ends with one episode.

    Raises: ValueError if empty.
    """
    x = _filled(values)
    draws = np.concatenate([np.quantile(sample, q, axis=1) for sample in _resample(x, rng)])
    return _percentile(float(np.quantile(x, q)), draws, num_seeds, len(x), "bootstrap 95 %")


def paired_bootstrap(
    a: ArrayLike, b: ArrayLike, rng: np.random.Generator, num_seeds: int = 1
) -> tuple[Estimate, float]:
    """Mean of a - b over the same episodes, its percentile interval (95 %) and two-sided p-value.

    The p-value inverts the interval: the smallest level at which it excludes 0, and never below
    2 / (resamples + 1), since as many resamples cannot show less. One episode says nothing of the spread:
    interval and p-value are NaN.
    Raises: ValueError without a value or when the two differ in length.
    Source: Efron & Tibshirani 1993, ch. 13 and 15.
    """
    x, y = _filled(a), _filled(b)
    if len(x) != len(y):
        raise ValueError(f"paired values differ in length: {len(x)} and {len(y)}")
    difference = x - y
    draws = np.concatenate([sample.mean(axis=1) for sample in _resample(difference, rng)])
    tail = min(int((draws <= 0.0).sum()), int((draws >= 0.0).sum()))
    p_value = min(1.0, 2.0 * (tail + 1) / (len(draws) + 1)) if len(x) > 1 else float("nan")
    estimate = _percentile(float(difference.mean()), draws, num_seeds, len(x), "paired bootstrap 95 %")
    return estimate, p_value


def mcnemar_exact(a: ArrayLike, b: ArrayLike) -> PairedTest:
    """Do two methods solve equally many of the same episodes? Exact binomial test on the discordant ones.

    Args: a, b (N,) of 0/1. Raises: ValueError when empty or of different length.
    Source: McNemar 1947; exact form in Agresti, Categorical Data Analysis, Sec. 11.1.
    """
    x, y = _filled(a) > 0.5, _filled(b) > 0.5
    if len(x) != len(y):
        raise ValueError(f"paired outcomes differ in length: {len(x)} and {len(y)}")
    only_a, only_b = int((x & ~y).sum()), int((~x & y).sum())
    discordant = only_a + only_b
    from scipy.special import bdtr  # here: half of the time until a first episode was SciPy's import

    # Binomial(n, 1/2) is symmetric: both tails are twice the one below the smaller count.
    p_value = min(1.0, 2.0 * float(bdtr(min(only_a, only_b), discordant, 0.5))) if discordant else 1.0
    return PairedTest(only_a, only_b, p_value)


def holm(p_values: ArrayLike) -> FloatArray:
    """Holm's step-down adjusted p-values, in the order given; NaN (a test that could not be made) stays NaN.

    Source: Holm 1979, Scand. J. Statist. 6:65.
    """
    p = np.asarray(p_values, dtype=np.float64)
    adjusted = np.full(p.shape, np.nan)
    order = np.argsort(p)[: np.count_nonzero(~np.isnan(p))]  # argsort puts NaN last
    factor = len(order) - np.arange(len(order))
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(p[order] * factor))
    return adjusted


def _filled(values: ArrayLike) -> FloatArray:
    x = np.asarray(values, dtype=np.float64)
    if x.ndim != 1 or len(x) == 0:
        raise ValueError(f"need a non-empty one-dimensional array, got shape {x.shape}")
    return x


def _resample(x: FloatArray, rng: np.random.Generator):
    """Yields (<= chunk, N) draws with replacement, RESAMPLES rows in all."""
    chunk = max(1, CHUNK_VALUES // len(x))
    for start in range(0, RESAMPLES, chunk):
        yield x[rng.integers(0, len(x), size=(min(chunk, RESAMPLES - start), len(x)))]


def _percentile(point: float, draws: FloatArray, num_seeds: int, episodes: int, method: str) -> Estimate:
    low, high = np.quantile(draws, [(1.0 - CONFIDENCE) / 2.0, (1.0 + CONFIDENCE) / 2.0])
    if episodes == 1:  # every resample is that episode: a width of 0 would claim certainty
        low = high = np.nan
    return Estimate(point, float(low), float(high), num_seeds, episodes, method)
