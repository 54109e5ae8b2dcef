"""Breaking points and margins: values by hand, a second implementation, coverage, what must not matter."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import isotonic_regression

from climbs import climb, factor, ladder, made_up
from wbc_bench.results.margins import (
    NOT_REACHED,
    Robustness,
    analyse,
    breaking_position,
    isotonic,
    margin_difference,
    relative_area,
    robustness,
    severity_at,
)
from wbc_bench.results.stress import Climb, LadderRecord

PAYLOAD = ladder(factor("payload", 0.0, 1.0, 2.0, 4.0))


def measured(one: Climb, of: LadderRecord = PAYLOAD, seed: int = 0) -> Robustness:
    return robustness(one, of, np.random.default_rng(seed))


def test_the_fit_is_the_one_of_pool_adjacent_violators():
    rates = np.random.default_rng(0).random((300, 7))
    for row, fit in zip(rates, isotonic(rates), strict=True):
        np.testing.assert_allclose(fit, isotonic_regression(row, increasing=False).x, atol=1e-12)


def test_a_curve_that_crosses_exactly_at_a_level():
    curve = measured(climb("a", 16, payload=[16, 12, 8, 4])).curves["payload"]
    assert curve.breaking.point == 2.0  # 8 of 20 is half of 16 of 20
    # trapezoids over 0, 1, 2, 4 kg: (14 + 10 + 2 * 6) / 20, relative to 4 * 16 / 20
    assert curve.area.point == pytest.approx(36 / 64)


def test_a_curve_that_crosses_between_levels():
    curve = measured(climb("a", 16, payload=[16, 12, 12, 2])).curves["payload"]
    assert curve.breaking.point == pytest.approx(2.0 + 2.0 * (12 - 8) / (12 - 2))


def test_a_curve_that_never_crosses():
    curve = measured(climb("a", 16, payload=[16, 16, 16, 16])).curves["payload"]
    assert tuple(curve.breaking) == (NOT_REACHED, NOT_REACHED, NOT_REACHED)
    assert curve.area.point == 1.0 and curve.area.low == curve.area.high == 1.0


def test_a_curve_that_is_below_at_the_first_level():
    curve = measured(climb("a", 16, payload=[4, 2, 2, 0])).curves["payload"]
    assert tuple(curve.breaking) == (0.0, 0.0, 0.0)
    strength = ladder(factor("strength", 0.9, 0.7, 0.5))
    assert measured(climb("a", 16, strength=[4, 2, 0]), strength).curves["strength"].breaking.point == 0.9


def test_data_that_rise_are_pooled():
    curve = measured(climb("a", 16, payload=[16, 4, 12, 2])).curves["payload"]
    np.testing.assert_allclose(curve.fit * 20, [16, 8, 8, 2])  # 4 and 12 share their mean
    assert curve.breaking.point == 1.0  # where the fit first is at half
    assert curve.successes.tolist() == [16, 4, 12, 2]


def test_severities_that_fall():
    falling = ladder(factor("strength", 1.0, 0.8, 0.4))
    curve = measured(climb("a", 20, strength=[20, 15, 5]), falling).curves["strength"]
    assert curve.breaking.point == pytest.approx(0.6)
    assert curve.area.point == pytest.approx((0.2 * 17.5 + 0.4 * 10) / (0.6 * 20))
    low, high = curve.breaking.low, curve.breaking.high
    assert low >= curve.breaking.point >= high  # from mild to severe


def test_the_end_of_an_interval_may_not_be_reached():
    curve = measured(climb("a", 20, payload=[20, 20, 20, 10])).curves["payload"]
    assert curve.breaking.point == 4.0 and curve.breaking.high == NOT_REACHED
    assert curve.breaking.low <= 4.0


def test_a_controller_that_solves_nothing_has_no_breaking_point():
    result = measured(climb("a", 0, payload=[0, 0, 0, 0]))
    assert result.base.point == 0.0
    assert np.isnan([*result.margin, *result.curves["payload"].breaking]).all()


def test_one_episode_has_no_interval():
    result = measured(climb("a", 1, episodes=1, payload=[1, 1, 0, 0]))
    assert result.curves["payload"].breaking.point == 1.5
    assert np.isnan([result.margin.low, result.margin.high]).all()


def test_the_margin_is_the_mean_over_the_factors():
    two = ladder(factor("payload", 0.0, 1.0), factor("slope", 0.0, 0.5))
    result = measured(climb("a", 10, payload=[10, 0], slope=[10, 10]), two)
    assert result.margin.point == pytest.approx((0.5 + 1.0) / 2)
    only = measured(climb("a", 10, payload=[10, 0]), two)  # the other factor is not whole
    assert only.margin.point == pytest.approx(0.5) and list(only.curves) == ["payload"]


def test_differences_are_paired():
    """Two controllers that solve the same episodes at every level do not differ in any resample."""
    a, b = climb("a", 16, payload=[16, 12, 8, 4]), climb("b", 16, payload=[16, 12, 8, 4])
    same = margin_difference(a, b, PAYLOAD, np.random.default_rng(0))
    assert tuple(same.interval) == (0.0, 0.0, 0.0) and same.episodes == 20
    worse = climb("c", 16, payload=[16, 8, 4, 0])
    found = margin_difference(a, worse, PAYLOAD, np.random.default_rng(0)).interval
    expected = measured(a).margin.point - measured(worse).margin.point
    assert found.point == pytest.approx(expected) and found.low > 0
    back = margin_difference(worse, a, PAYLOAD, np.random.default_rng(0)).interval
    assert (back.low, back.high) == (pytest.approx(-found.high), pytest.approx(-found.low))


def test_differences_are_on_what_both_have():
    two = ladder(factor("payload", 0.0, 1.0), factor("slope", 0.0, 0.5))
    a = climb("a", 10, payload=[10, 0], slope=[10, 10])
    b = climb("b", 5, episodes=12, payload=[5, 5])
    found = margin_difference(a, b, two, np.random.default_rng(0))
    assert (found.episodes, found.factors) == (12, 1)
    assert found.interval.point == pytest.approx(0.5 - 1.0)


def test_intervals_cover():
    """Of the truth of a known curve: 95 % nominally, and no less than 88 % in 120 draws of 60 episodes."""
    chance, base = np.array([0.9, 0.7, 0.5, 0.2]), 0.9
    severities = PAYLOAD.factors[0].severities
    area = float(relative_area(chance, np.array(base), severities))
    position = breaking_position(chance, np.array(base))
    breaking = float(severity_at(position, severities))
    rng, inside = np.random.default_rng(1), []
    for _ in range(120):
        solved = rng.random((60, 5)) < [base, *chance]
        one = Climb("a", "a", (), solved[:, 0].astype(float), {"payload": solved[:, 1:].astype(float)})
        curve = measured(one, seed=2).curves["payload"]
        inside.append(
            (curve.area.low <= area <= curve.area.high, curve.breaking.low <= breaking <= curve.breaking.high)
        )
    assert (np.mean(inside, axis=0) >= 0.88).all() and (np.mean(inside, axis=0) < 1.0).all()


def test_neither_the_order_of_controllers_nor_of_factors_matters():
    stress = made_up()
    found = analyse(stress)
    turned = replace(stress, climbs=stress.climbs[::-1])
    assert _text(analyse(turned)["c0"]) == _text(found["c0"])
    alone = replace(stress, climbs=stress.climbs[:1])
    assert _text(analyse(alone)["c0"]) == _text(found["c0"])
    one = stress.climbs[0]
    shuffled = replace(one, levels=dict(list(one.levels.items())[::-1]))
    again = measured(shuffled, stress.ladder)
    assert _text(again) == _text(found["c0"]) and again.margin == found["c0"].margin


def _text(result: Robustness) -> str:
    curves = result.curves.items()
    return repr([(name, curve.breaking, curve.area, curve.fit.tolist()) for name, curve in curves])
