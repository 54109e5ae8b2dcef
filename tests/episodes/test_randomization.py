"""Draws of an episode: independent streams, ranges, pushes, and a reset that stands on the ground."""

import msgspec
import mujoco
import numpy as np
import pytest

from wbc_bench.episodes.protocol import MAX_PUSHES, Push, find_protocol
from wbc_bench.episodes.randomization import EpisodeDraws, draw_pushes, nominal, resting_height, sample
from wbc_bench.randomness import stream
from wbc_bench.robot import load_robot

SMOKE = find_protocol("smoke_v1")[0]


def equal(a: EpisodeDraws, b: EpisodeDraws) -> bool:
    return all(np.array_equal(x, y, equal_nan=True) for x, y in zip(a, b, strict=True))


def test_order_and_subset_do_not_matter() -> None:
    forward = {i: sample(SMOKE, 0, i) for i in range(6)}
    assert all(equal(sample(SMOKE, 0, i), forward[i]) for i in (5, 2))
    assert not equal(forward[0], forward[1])
    assert not equal(forward[0], sample(SMOKE, 1, 0))


def test_switching_one_quantity_off_leaves_the_others() -> None:
    calm = msgspec.structs.replace(
        SMOKE, push=Push(), randomization=msgspec.structs.replace(SMOKE.randomization, friction=(0.8, 0.8))
    )
    a, b = sample(SMOKE, 0, 3), sample(calm, 0, 3)
    changed = {
        name
        for name in EpisodeDraws._fields
        if not np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True)
    }
    assert changed == {"friction", "push_time", "push_vel"}


def test_draws_fill_their_ranges() -> None:
    draws = [sample(SMOKE, 0, i) for i in range(400)]
    spread = SMOKE.randomization
    for name, low, high in (
        ("friction", *spread.friction),
        ("base_mass", *spread.base_mass),
        ("leg_q", -spread.leg_q, spread.leg_q),
        ("leg_qd", -spread.leg_qd, spread.leg_qd),
        ("kp_scale", *spread.gain),
        ("kd_scale", *spread.gain),
    ):
        values = np.array([getattr(d, name) for d in draws])
        assert low <= values.min() and values.max() <= high
        # mean of n uniform draws: standard deviation (high - low) / sqrt(12 n); five of them
        slack = 5 * (high - low) / np.sqrt(12 * values.size)
        assert abs(values.mean() - (low + high) / 2) < slack
    columns = np.array([np.r_[d.friction, d.base_mass, d.leg_q, d.kp_scale, d.kd_scale] for d in draws])
    apart = np.corrcoef(columns.T) - np.eye(columns.shape[1])
    assert np.abs(apart).max() < 5 / np.sqrt(len(draws))
    assert len({d.noise_key for d in draws}) == len(draws)


def test_pushes_keep_to_the_schedule() -> None:
    push = Push(speed=0.5, interval=(1.0, 1.5), quiet_end=0.5)
    counts = []
    for i in range(200):
        time, vel = draw_pushes(push, 2.9, stream(1, "push", i))
        some = np.isfinite(time)
        counts.append(some.sum())
        assert some[0] and 1.0 <= time[0] <= 1.5
        assert (time[some] < 2.4).all()
        assert not some[1] or 1.0 <= time[1] - time[0] <= 1.5
        assert (np.abs(vel) <= 0.5).all() and (vel[np.repeat(~some, 2)] == 0).all()
    assert set(counts) == {1, MAX_PUSHES}
    time, vel = draw_pushes(Push(speed=0.0), 10.0, stream(1, "push"))
    assert np.isnan(time).all() and (vel == 0).all()


@pytest.mark.parametrize("horizon", [10.0, 26.0, 60.0])
def test_pushes_last_as_long_as_an_episode(horizon: float) -> None:
    """The last push and the quiet end are never further apart than an interval."""
    push = Push(speed=0.5, interval=(4.0, 6.0), quiet_end=2.0)
    for i in range(50):
        time, vel = draw_pushes(push, horizon, stream(2, "push", i))
        times = time[np.isfinite(time)]
        assert len(vel) == 2 * len(time) and (np.diff(times) >= 4.0).all()
        assert horizon - 2.0 - 6.0 <= times[-1] < horizon - 2.0


def test_the_nominal_robot_is_at_rest_and_undisturbed() -> None:
    calm = nominal(SMOKE, 0, 4)
    robot = load_robot()
    assert calm.friction == robot.facts.friction.slide and calm.noise_scale == 0
    assert calm.base_mass == 0 and not calm.base_vel.any() and not calm.leg_q.any() and not calm.leg_qd.any()
    assert (calm.kp_scale == 1).all() and (calm.kd_scale == 1).all() and np.isnan(calm.push_time).all()
    assert calm.base_height == pytest.approx(robot.facts.nominal_base_height, abs=1e-3)


def test_lowest_sole_touches_the_ground() -> None:
    robot = load_robot()
    model = robot.model()
    data = mujoco.MjData(model)
    ground = model.geom("ground").id
    spheres = [model.geom(f"foot_{side}_{k}").id for side in "LR" for k in range(4)]
    for i in range(5):
        leg_q = sample(SMOKE, 0, i).leg_q
        height = resting_height(SMOKE.robot, leg_q)
        data.qpos[:] = [0, 0, height, 1, 0, 0, 0, *robot.default_q]
        data.qpos[7:15] += leg_q
        mujoco.mj_forward(model, data)
        gaps = [mujoco.mj_geomDistance(model, data, g, ground, 1.0, None) for g in spheres]
        assert min(gaps) == pytest.approx(0, abs=1e-9)
