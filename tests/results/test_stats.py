"""Intervals and tests against hand-computed values, coverage and invariances."""

import numpy as np
import pytest
from scipy.stats import binomtest

from wbc_bench.results import stats
from wbc_bench.results.formatting import interval_text, p_value_text


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_wilson_against_its_formula():
    k, n, z = 8, 10, 1.959963984540054
    centre = (k + z**2 / 2) / (n + z**2)
    half = z / (n + z**2) * np.sqrt(k * (n - k) / n + z**2 / 4)
    estimate = stats.wilson(k, n, num_seeds=3)
    assert estimate.low == pytest.approx(centre - half)
    assert estimate.high == pytest.approx(centre + half)
    assert (estimate.point, estimate.num_seeds, estimate.num_episodes) == (0.8, 3, 10)


@pytest.mark.parametrize(("k", "n"), [(0, 20), (1, 1), (7, 20), (2999, 3000), (3000, 3000)])
def test_wilson_against_scipy(k, n):
    expected = binomtest(k, n).proportion_ci(0.95, method="wilson")
    assert stats.wilson(k, n)[1:3] == pytest.approx((expected.low, expected.high), abs=1e-12)


@pytest.mark.parametrize(("k", "n"), [(0, 20), (20, 20)])
def test_wilson_stays_in_0_1_and_keeps_a_width_at_the_ends(k, n):
    estimate = stats.wilson(k, n)
    assert 0.0 <= estimate.low <= estimate.point <= estimate.high <= 1.0
    assert estimate.high - estimate.low > 0.1


@pytest.mark.parametrize(("k", "n"), [(0, 0), (3, 2), (-1, 5)])
def test_wilson_refuses_impossible_counts(k, n):
    with pytest.raises(ValueError, match="trials"):
        stats.wilson(k, n)


@pytest.mark.parametrize(
    ("a", "m", "b", "n", "low", "high"),
    [  # Newcombe 1998, table II, method 10
        (56, 70, 48, 80, 0.0524, 0.3339),
        (9, 10, 3, 10, 0.1705, 0.8090),
        (6, 7, 2, 7, 0.0582, 0.8062),
        (5, 56, 0, 29, -0.0381, 0.1926),
        (0, 10, 0, 20, -0.1611, 0.2775),
        (0, 10, 0, 10, -0.2775, 0.2775),
        (10, 10, 0, 20, 0.6791, 1.0),
        (10, 10, 0, 10, 0.6075, 1.0),
    ],
)
def test_newcombe_against_its_paper(a, m, b, n, low, high):
    estimate = stats.newcombe(stats.wilson(a, m), stats.wilson(b, n))
    assert estimate[:3] == pytest.approx((a / m - b / n, low, high), abs=5.1e-5)
    assert estimate.num_episodes == m + n
    other = stats.newcombe(stats.wilson(b, n), stats.wilson(a, m))
    assert other[:3] == pytest.approx((-estimate.point, -estimate.high, -estimate.low))


def test_newcombe_covers_the_difference():
    draws = rng(3).binomial([60, 90], [0.85, 0.7], size=(2000, 2))
    found = [stats.newcombe(stats.wilson(int(x), 60), stats.wilson(int(y), 90)) for x, y in draws]
    assert 0.93 < np.mean([estimate.low <= 0.15 <= estimate.high for estimate in found]) < 0.975


def test_spread_is_the_sample_deviation():
    assert stats.spread([1.0, 2.0, 6.0]) == pytest.approx((3.0, np.sqrt((4 + 1 + 9) / 2), 3))
    assert np.isnan(stats.spread([1.0]).sd)


def test_empty_input_raises_everywhere():
    for call in (
        lambda: stats.spread([]),
        lambda: stats.bootstrap_mean([], rng()),
        lambda: stats.bootstrap_quantile([], 0.95, rng()),
        lambda: stats.paired_bootstrap([], [], rng()),
        lambda: stats.mcnemar_exact([], []),
    ):
        with pytest.raises(ValueError, match="non-empty"):
            call()


def test_bootstrap_is_its_seed():
    values = rng(1).normal(size=40)
    assert stats.bootstrap_mean(values, rng(5)) == stats.bootstrap_mean(values, rng(5))
    assert stats.bootstrap_mean(values, rng(5)) != stats.bootstrap_mean(values, rng(6))
    assert stats.bootstrap_quantile(values, 0.95, rng(5)) == stats.bootstrap_quantile(values, 0.95, rng(5))


def test_bootstrap_mean_agrees_with_the_normal_interval():
    values = rng(2).normal(3.0, 2.0, size=2000)
    estimate = stats.bootstrap_mean(values, rng())
    half = 1.96 * values.std() / np.sqrt(len(values))
    assert estimate.point == values.mean()
    assert estimate.low == pytest.approx(values.mean() - half, abs=0.1 * half)
    assert estimate.high == pytest.approx(values.mean() + half, abs=0.1 * half)


def test_bootstrap_quantile_brackets_the_quantile():
    values = np.arange(1000.0)
    estimate = stats.bootstrap_quantile(values, 0.95, rng())
    assert estimate.low < estimate.point == np.quantile(values, 0.95) < estimate.high


def test_chunks_of_the_resampling_do_not_show(monkeypatch):
    values = rng(3).normal(size=50)
    whole = stats.bootstrap_mean(values, rng())
    monkeypatch.setattr(stats, "CHUNK_VALUES", 700)
    assert stats.bootstrap_mean(values, rng()) == whole


def test_paired_bootstrap_sees_a_shift_that_the_spread_hides():
    base = rng(4).normal(0.0, 10.0, size=200)
    shifted = base + 0.5 + rng(5).normal(0.0, 0.5, size=200)
    estimate, p = stats.paired_bootstrap(shifted, base, rng())
    assert estimate.low > 0.0 and p < 0.01
    mirrored, q = stats.paired_bootstrap(base, shifted, rng())
    assert mirrored.point == pytest.approx(-estimate.point) and q == p


def test_paired_bootstrap_without_a_difference():
    values = rng(6).normal(size=30)
    estimate, p = stats.paired_bootstrap(values, values, rng())
    assert estimate[:3] == (0.0, 0.0, 0.0) and p == 1.0


def test_one_episode_has_no_interval():
    """Every resample of it is itself: a width of 0 and a small p-value would claim certainty."""
    estimate, p = stats.paired_bootstrap([3.0], [1.0], rng())
    one = (stats.bootstrap_mean([3.0], rng()), stats.bootstrap_quantile([3.0], 0.95, rng()), estimate)
    assert [each.point for each in one] == [3.0, 3.0, 2.0] and np.isnan(p)
    assert np.isnan([each[1:3] for each in one]).all()
    assert interval_text(estimate, 100.0, 1, "+") == "+200.0 [–, –]" and p_value_text(p) == "–"
    assert stats.mcnemar_exact([1], [0]).p_value == 1.0


def test_paired_bootstrap_p_value_agrees_with_its_interval():
    for seed in range(20):
        x = rng(seed).normal(0.25, 1.0, size=60)
        estimate, p = stats.paired_bootstrap(x, np.zeros(60), rng(100 + seed))
        if abs(p - 0.05) > 0.005:
            assert (p < 0.05) == (estimate.low > 0.0 or estimate.high < 0.0)


def test_mcnemar_by_hand():
    # Six episodes only a solved, one only b: two-sided binomial p = 2 (1 + 7) / 2^7.
    a = [1] * 6 + [0] + [1, 0]
    b = [0] * 6 + [1] + [1, 0]
    assert stats.mcnemar_exact(a, b) == pytest.approx((6, 1, 2 * 8 / 128))
    assert stats.mcnemar_exact(b, a)[:2] == (1, 6)
    assert stats.mcnemar_exact([1, 0], [1, 0]).p_value == 1.0


@pytest.mark.parametrize(("only_a", "only_b"), [(3, 3), (0, 1), (40, 17), (900, 1100)])
def test_mcnemar_against_scipy(only_a, only_b):
    a, b = np.repeat([1, 0], [only_a, only_b]), np.repeat([0, 1], [only_a, only_b])
    expected = binomtest(only_a, only_a + only_b, 0.5).pvalue
    assert stats.mcnemar_exact(a, b).p_value == pytest.approx(expected, rel=1e-9)


def test_pairs_must_be_pairs():
    with pytest.raises(ValueError, match="differ in length"):
        stats.mcnemar_exact([1, 0], [1])
    with pytest.raises(ValueError, match="differ in length"):
        stats.paired_bootstrap([1.0, 0.0], [1.0], rng())


def test_holm_by_hand():
    # Sorted 0.01, 0.02, 0.03, 0.04 times 4, 3, 2, 1 and then monotone.
    assert stats.holm([0.04, 0.01, 0.03, 0.02]) == pytest.approx([0.06, 0.04, 0.06, 0.06])
    assert stats.holm([0.6, 0.7]) == pytest.approx([1.0, 1.0])
    assert len(stats.holm([])) == 0


def test_holm_does_not_count_a_test_that_was_not_made():
    adjusted = stats.holm([0.01, np.nan, 0.03])
    assert adjusted[[0, 2]] == pytest.approx([0.02, 0.03]) and np.isnan(adjusted[1])
