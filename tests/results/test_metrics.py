"""Metrics against hand-computed values on small batches, SPARC against its own claims."""

import numpy as np
import pytest

from wbc_bench.outcomes import EpisodeBatch, Outcome
from wbc_bench.results import metrics

PERIOD = 0.02  # [s]


def batch_of(steps, total=6, window=2, **changes) -> EpisodeBatch:
    """Errors grow by 1 a step; NaN after the end, as a rollout leaves them."""
    steps = np.asarray(steps, dtype=np.int64)
    t = np.arange(total, dtype=float)
    error = np.where(t < steps[:, None], t, np.nan)  # (N, T)
    action = np.where(t[:, None] < steps[:, None, None], (t**2)[:, None] * np.ones(14), np.nan)
    position = np.stack([error * 0.1, np.zeros_like(error), np.ones_like(error)], axis=2)
    values = {
        **{
            "control_period": PERIOD,
            "window": window,
            "steps": steps,
            "infeasible_steps": np.full(len(steps), 3),
        },
        **{"outcome": np.array([Outcome.MISSED] * len(steps), dtype=object), "position_error": error},
        **{"orientation_error": 2 * error, "action": action, "ee_pos_w": position},
        **{"command": 0.5 * action, "inside": error < 2, "work": error, "slip": 0.01 * error},
        **{"at_torque_limit": error == 1, "at_speed_limit": error < 0},
        "push_step": np.full((len(steps), 2), -1),
    }
    return EpisodeBatch(**(values | changes))


def test_errors_are_means_over_the_last_completed_steps():
    values = metrics.compute(batch_of([6, 4, 1]))
    assert values["position_error"] == pytest.approx([4.5, 2.5, 0.0])  # steps 4,5; 2,3; the only one
    assert values["orientation_error"] == pytest.approx([9.0, 5.0, 0.0])


def test_action_variation_is_the_mean_squared_change():
    values = metrics.compute(batch_of([3, 2, 1]))["action_variation"]
    # a = t^2 in 14 components: changes 1 and 3, so 14 (1 + 9) / 2; then 14; one step has no change
    assert values[:2] == pytest.approx([70.0, 14.0])
    assert np.isnan(values[2])


def test_speed_is_taken_within_the_window():
    values = metrics.compute(batch_of([6, 1], window=3))["ee_speed_rms"]
    assert values[0] == pytest.approx(0.1 / PERIOD)  # [m/s]
    assert np.isnan(values[1])


def test_an_episode_without_a_step_has_no_value_but_did_not_succeed():
    batch = batch_of([0, 6])
    for name, values in metrics.compute(batch).items():
        if name == "success":
            assert values[0] == 0.0
        else:
            assert np.isnan(values[0]), name
        assert values.dtype == np.float64 and values.shape == (2,)


def test_success_and_duration():
    outcome = np.array([Outcome.SUCCESS, Outcome.DRIFTED], dtype=object)
    values = metrics.compute(batch_of([6, 4], outcome=outcome))
    assert list(values["success"]) == [1.0, 0.0]
    assert values["duration"] == pytest.approx([0.12, 0.08])


def test_values_do_not_depend_on_the_rest_of_the_batch():
    together = metrics.compute(batch_of([6, 4, 5], window=4))
    for k, steps in enumerate([6, 4, 5]):
        alone = metrics.compute(batch_of([steps], window=4))
        for name, values in together.items():
            np.testing.assert_array_equal(values[k : k + 1], alone[name])


def minimum_jerk_speed(samples: int = 49) -> np.ndarray:
    """Speed of x(s) = 10 s^3 - 15 s^4 + 6 s^5 over one second."""
    s = np.linspace(0.0, 1.0, samples)
    return 30 * s**2 - 60 * s**3 + 30 * s**4


def test_sparc_ranks_a_minimum_jerk_movement_above_the_same_with_tremor():
    s = np.linspace(0.0, 1.0, 49)
    smooth = minimum_jerk_speed()
    tremor = np.abs(smooth + 0.4 * np.sin(2 * np.pi * 6.0 * s))
    a, b = metrics.spectral_arc_length(np.stack([smooth, tremor]), 1 / PERIOD)
    assert b < a - 0.4
    # The paper's value for a smooth reach; duration and sampling barely matter.
    assert a == pytest.approx(-1.4, abs=0.1)
    assert metrics.spectral_arc_length(minimum_jerk_speed(199)[None], 200.0) == pytest.approx(a, abs=0.02)


def test_sparc_ignores_the_amplitude():
    speed = np.abs(np.random.default_rng(0).normal(size=(3, 49)))
    one = metrics.spectral_arc_length(speed, 50.0)
    np.testing.assert_allclose(metrics.spectral_arc_length(speed * 37.0, 50.0), one, rtol=1e-12)
    assert np.all(one < 0.0)


def test_sparc_of_stillness_and_of_a_short_window_is_undefined():
    assert np.isnan(metrics.spectral_arc_length(np.zeros((1, 49)), 50.0)).all()
    values = metrics.compute(batch_of([6, 3], window=4))["ee_sparc"]
    assert not np.isnan(values[0]) and np.isnan(values[1])


def test_every_metric_is_described():
    names = [metric.name for metric in metrics.METRICS]
    assert len(set(names)) == len(names)
    assert all(metric.unit and metric.source for metric in metrics.METRICS)


def test_commands_in_rad_and_their_rate_do_not_depend_on_the_action_scale():
    values = metrics.compute(batch_of([3, 1]))
    # commands are half of t^2: changes of 0.5 and 1.5 in 14 joints
    assert values["action_variation_rad"][0] == pytest.approx(14 * (0.25 + 2.25) / 2)
    assert values["command_rate"][0] == pytest.approx(np.sqrt((0.25 + 2.25) / 2) / PERIOD)
    assert np.isnan(values["command_rate"][1])


def test_time_to_reach_is_the_first_entry_that_is_held():
    inside = np.array([[0, 1, 0, 1, 1, 0], [1, 1, 0, 0, 0, 0], [1, 0, 1, 0, 1, 0]], dtype=bool)
    values = metrics.compute(batch_of([6, 6, 6], inside=inside))["time_to_reach"]
    assert values[:2] == pytest.approx([4 * PERIOD, PERIOD])  # the state after the fourth step, the first
    assert np.isnan(values[2])


def test_energy_power_limits_and_slip_are_over_the_completed_steps():
    values = metrics.compute(batch_of([4, 2]))
    assert values["energy"] == pytest.approx([6.0, 1.0])  # 0 + 1 + 2 + 3; 0 + 1
    assert values["mean_power"] == pytest.approx([6 / (4 * PERIOD), 1 / (2 * PERIOD)])
    assert values["torque_limit_share"] == pytest.approx([1 / 4, 1 / 2])
    assert values["speed_limit_share"] == pytest.approx([0, 0])
    assert values["foot_slip"] == pytest.approx([0.06, 0.01])


def test_error_after_a_push_counts_only_where_the_push_met_a_hand_at_its_target():
    total = 200  # of which the two seconds after a push are 100
    inside = np.zeros((4, total), dtype=bool)
    inside[:, 9] = [True, False, True, True]
    push = np.array([[10, -1], [10, -1], [10, 50], [-1, -1]])
    error = np.tile(np.arange(total) * 0.001, (4, 1))
    batch = batch_of(
        [total, total, 60, total], total, 50, inside=inside, push_step=push, position_error=error
    )
    values = metrics.compute(batch)["push_error"]
    assert values[0] == pytest.approx(0.109)  # steps 10 to 109
    assert np.isnan(values[1]) and np.isnan(values[3])
    assert values[2] == pytest.approx(0.059)  # the episode ended; the second push met it off target
