"""Frames, the library of scripts, and sources without a network."""

import threading
from pathlib import Path

import numpy as np
import pytest

from robot_states import seen_at
from wbc_bench.episodes.static_solver import StaticSolver, static_solver
from wbc_bench.episodes.targets import classify
from wbc_bench.errors import SourceError, UnknownNameError
from wbc_bench.robot import RobotConfig
from wbc_bench.rotations import geodesic_angle, matrix_from_rpy, matrix_from_wxyz, wxyz_from_matrix
from wbc_bench.sources import FRAMES, StampedTarget, from_world, load_source, to_world
from wbc_bench.sources.live import LiveSource
from wbc_bench.sources.paths import laps, line, minimum_jerk
from wbc_bench.sources.registry import SCRIPTS, script_names
from wbc_bench.sources.scripted import ScriptedSource, load_script
from wbc_bench.sources.slew import Limits, Pose, slew

PERIOD = 0.02  # [s]


# frames


def test_frames_by_hand() -> None:
    """A base at (1, 2, 3) that looks along +y: its x is the world's y."""
    seen = seen_at(np.pi / 2, (1.0, 2.0, 3.0))
    identity = np.array([1.0, 0.0, 0.0, 0.0])
    where = {
        frame: to_world(StampedTarget(0.0, frame, np.array([0.5, 0.0, 0.1]), identity), seen)
        for frame in FRAMES
    }
    np.testing.assert_allclose(where["world"][0], [0.5, 0.0, 0.1])
    np.testing.assert_allclose(where["base"][0], [1.0, 2.5, 3.1])
    np.testing.assert_allclose(where["arm_mount"][0], [1.0, 2.52, 3.13])
    np.testing.assert_allclose(where["base"][1], where["arm_mount"][1])
    np.testing.assert_allclose(where["base"][1] @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-15)


@pytest.mark.parametrize("frame", FRAMES)
def test_from_world_is_the_inverse(frame) -> None:
    seen = seen_at(0.7, (0.3, -0.2, 0.8))
    rot = matrix_from_rpy(np.array([0.3, -0.4, 0.5]))
    pos, turned = from_world(np.array([0.5, 0.2, 1.0]), rot, frame, seen)
    back = to_world(StampedTarget(0.0, frame, pos, wxyz_from_matrix(turned)), seen)
    np.testing.assert_allclose(back[0], [0.5, 0.2, 1.0], atol=1e-14)
    np.testing.assert_allclose(back[1], rot, atol=1e-14)


# paths


def test_minimum_jerk_has_the_derivatives_of_its_name() -> None:
    """At rest at both ends, and the largest slope is 15/8 in the middle."""
    step = 1e-5
    assert [minimum_jerk(s) for s in (0.0, 0.5, 1.0)] == [0.0, 0.5, 1.0]
    for s in (0.0, 1.0):
        assert abs(minimum_jerk(s + step) - minimum_jerk(s - step)) / (2 * step) < 1e-8
    assert (minimum_jerk(0.5 + step) - minimum_jerk(0.5 - step)) / (2 * step) == pytest.approx(15 / 8)


def test_a_line_is_as_slow_as_its_slower_part() -> None:
    here = Pose(np.zeros(3), np.eye(3))
    there = Pose(np.array([0.3, 0.4, 0.0]), matrix_from_rpy(np.array([0.0, 0.0, 1.0])))
    assert line(here, there, Limits(0.1, 10.0)).duration == pytest.approx(15 / 8 * 0.5 / 0.1)
    assert line(here, there, Limits(10.0, 0.1)).duration == pytest.approx(15 / 8 * 1.0 / 0.1)
    middle = line(here, there, Limits(0.1, 0.1)).pose(15 / 8 * 10.0 / 2)
    np.testing.assert_allclose(middle.pos, [0.15, 0.2, 0.0])
    np.testing.assert_allclose(middle.rot, matrix_from_rpy(np.array([0.0, 0.0, 0.5])), atol=1e-12)
    np.testing.assert_array_equal(
        line(here, here, Limits()).pose(0.0).rot, here.rot
    )  # nothing divided by zero


def test_laps_close_and_keep_the_limit() -> None:
    """A circle of 0.1 m at 0.1 m/s: 2 pi s a lap, one ramp more for both ends, and it ends where it began."""
    centre = Pose(np.array([0.4, 0.0, 1.0]), np.eye(3))
    curve = laps(centre, np.array([0.0, 0.1, 0.0]), np.array([0, 1, 0]), 2, Limits(0.1, 1.0))
    assert curve.duration == pytest.approx(2 * 2 * np.pi + 1.0, rel=2e-3)
    np.testing.assert_allclose(curve.pose(curve.duration).pos, centre.pos, atol=1e-12)
    assert curve.phase(curve.duration) == pytest.approx(4 * np.pi)


# the library


@pytest.fixture(scope="module")
def solver() -> StaticSolver:
    return static_solver(RobotConfig(), 0.02, 0.4 * np.pi, 0.30)


@pytest.mark.parametrize("name", script_names())
def test_library_keeps_its_limits_and_does_not_jump(name: str) -> None:
    source, seen = load_source(name), seen_at()
    assert isinstance(source, ScriptedSource) and source.name == name
    source.reset(seen)
    times = np.arange(0.0, source.path.duration + 2 * PERIOD, PERIOD).tolist()
    poses = [source.path.pose(time) for time in times]
    np.testing.assert_allclose(poses[0].pos, seen.ee_pos_w)
    limits = source.script.limits
    speed = np.linalg.norm(np.diff([pose.pos for pose in poses], axis=0), axis=1) / PERIOD
    turning = (
        geodesic_angle(np.array([p.rot for p in poses[:-1]]), np.array([p.rot for p in poses[1:]])) / PERIOD
    )
    assert speed.max() <= limits.linear * (1 + 1e-9) and turning.max() <= limits.angular * (1 + 1e-6)
    assert speed.max() > 0.8 * limits.linear or turning.max() > 0.8 * limits.angular  # not needlessly slow
    np.testing.assert_array_equal(poses[-1].pos, poses[-2].pos)  # the last pose is held


@pytest.mark.parametrize("name", script_names())
def test_library_is_feasible(name: str, solver: StaticSolver) -> None:
    """Along the script, the way to it included, the robot can stand with its feet where they are."""
    source = load_source(name)
    assert isinstance(source, ScriptedSource)
    source.reset(seen_at())
    for time in np.linspace(0.0, source.path.duration, 9).tolist():
        pose = source.path.pose(time)
        assert classify(solver, pose.pos, pose.rot) is not None, (time, pose)


def test_a_script_in_the_base_frame_moves_with_the_base(tmp_path: Path) -> None:
    file = tmp_path / "base.toml"
    text = (SCRIPTS / "figure_eight.toml").read_text()
    file.write_text('frame = "base"\n' + text.replace("1.20", "0.36"))
    source = ScriptedSource(load_script(file))
    seen, moved = seen_at(), seen_at(0.5, (0.2, 0.1, 0.7))
    source.reset(seen)
    start = to_world(source.target(0.0, seen), seen)
    np.testing.assert_allclose(start[0], seen.ee_pos_w, atol=1e-12)
    np.testing.assert_allclose(to_world(source.target(0.0, moved), moved)[0], moved.ee_pos_w, atol=1e-12)


GOOD = """
name = "x"
description = "x"
[limits]
linear = 0.1
angular = 0.2
[path]
type = "waypoints"
[[path.points]]
pos = [0.4, 0.0, 1.0]
"""


@pytest.mark.parametrize(
    ("old", "new", "where"),
    [
        ("linear = 0.1", "linear = 0.0", "$.limits.linear"),
        ("linear = 0.1", "speed = 0.1", "$.limits"),
        ("pos = [0.4, 0.0, 1.0]", "pos = [0.4, 0.0]", "$.path.points[0].pos"),
        ("pos = [0.4, 0.0, 1.0]", "pos = [0.4, nan, 1.0]", "$.path.points[0].pos[1]"),
        ('type = "waypoints"', 'type = "spiral"', "$.path.type"),
        ('name = "x"', 'name = "x"\nframe = "camera"', "$.frame"),
        ("[limits]", "[limits", ""),
        ('name = "x"', 'name = "---"', "$.name"),
        (
            GOOD[GOOD.index("type") :],
            'type = "curve"\ncentre = [0.4, 0.0, 1.0]\namplitude = [0.1, 0.0, 0.0]\ncycles = [0, 1, 1]\n',
            "$.path.amplitude",
        ),
        ('type = "waypoints"', 'type = "waypoints"\nloops = 1001', "$.path.loops"),
        ('type = "waypoints"', 'type = "waypoints"\nloops = 4000000000000', "$.path.loops"),
        (
            'type = "waypoints"',
            'type = "waypoints"\nloops = 1000\n' + "[[path.points]]\npos = [0.4, 0.0, 1.0]\n" * 10,
            "11 points in 1000 loops are 11000 poses, valid: at most 10000 - at `$.path.loops",
        ),
        (
            GOOD[GOOD.index("type") :],
            'type = "curve"\ncentre = [0.4, 0.0, 1.0]\namplitude = [0.1, 0.0, 0.0]\ncycles = [1, 0, 0]\n'
            "laps = 1001\n",
            "$.path.laps",
        ),
        (
            GOOD[GOOD.index("type") :],
            'type = "board"\ncentre = [0.4, 0.0, 1.0]\nwidth = 0.1\nheight = 0.1\nstrokes = 1001\n',
            "$.path.strokes",
        ),
        ("pos = [0.4, 0.0, 1.0]", "pos = [0.4, 0.0, 1e300]", "$.path.points[0].pos[2]"),
    ],
)
def test_bad_scripts_name_the_field(tmp_path: Path, old: str, new: str, where: str) -> None:
    assert old in GOOD
    file = tmp_path / "bad.toml"
    file.write_text(GOOD.replace(old, new))
    with pytest.raises(SourceError) as caught:
        load_script(file)
    assert "bad.toml" in str(caught.value) and where in str(caught.value)


def test_unknown_names() -> None:
    with pytest.raises(UnknownNameError, match="did you mean figure_eight"):
        load_source("figure_eigth")
    with pytest.raises(SourceError, match=r"nowhere\.toml' does not exist"):
        load_source("nowhere.toml")


# slewing, and a person


def test_slew_by_hand() -> None:
    here = Pose(np.zeros(3), np.eye(3))
    there = Pose(np.array([0.0, 0.6, 0.8]), matrix_from_rpy(np.array([1.0, 0.0, 0.0])))
    then = slew(here, there, 0.5, Limits(0.2, 0.4))  # 0.1 m and 0.2 rad of the way
    np.testing.assert_allclose(then.pos, [0.0, 0.06, 0.08])
    np.testing.assert_allclose(then.rot, matrix_from_rpy(np.array([0.2, 0.0, 0.0])), atol=1e-12)
    arrived = slew(here, there, 100.0, Limits(0.2, 0.4))
    np.testing.assert_allclose(arrived.pos, there.pos)
    np.testing.assert_allclose(arrived.rot, there.rot, atol=1e-12)


def test_live_follows_the_latest_no_faster_than_its_limits() -> None:
    source, seen = LiveSource(Limits(0.5, 1.0)), seen_at()
    source.reset(seen)
    np.testing.assert_allclose(source.target(0.0, seen).pos, seen.ee_pos_w)
    identity = np.array([1.0, 0.0, 0.0, 0.0])
    goal = seen.ee_pos_w + np.array([0.1, 0.0, 0.0])
    source.set_target(StampedTarget(0.0, "world", seen.ee_pos_w - 1.0, identity))
    source.set_target(StampedTarget(0.0, "world", goal, identity))
    np.testing.assert_allclose(source.target(0.1, seen).pos, (seen.ee_pos_w + goal) / 2)
    np.testing.assert_allclose(source.target(1.0, seen).pos, goal)


def test_live_refuses_what_is_no_pose() -> None:
    source, seen = LiveSource(), seen_at()
    source.reset(seen)
    zeros, identity = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    for frame, pos, quat in (
        ("camera", zeros, identity),
        ("world", zeros * np.nan, identity),
        ("world", zeros, 2 * identity),
        ("world", zeros, identity * np.nan),
        ("world", np.zeros(2), identity),
    ):
        with pytest.raises(SourceError):
            source.set_target(StampedTarget(0.0, frame, pos, quat))  # pyright: ignore[reportArgumentType]
    np.testing.assert_allclose(source.target(1.0, seen).pos, seen.ee_pos_w)


def test_live_is_set_from_other_threads() -> None:
    """Position and orientation always belong to the same call."""
    source, seen = LiveSource(Limits(1e9, 1e9)), seen_at()
    source.reset(seen)

    def drag(sign: float) -> None:
        for k in range(300):
            angle = sign * (k + 1) / 300
            quat = np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])
            source.set_target(StampedTarget(0.0, "world", np.array([angle, 0.0, 1.0]), quat))

    threads = [threading.Thread(target=drag, args=(sign,)) for sign in (1.0, -1.0)]
    for thread in threads:
        thread.start()
    for step in range(200):
        target = source.target(0.02 * (step + 1), seen)
        rot = matrix_from_wxyz(target.quat_wxyz)
        if abs(target.pos[0]) <= 1.0 and target.pos[2] == 1.0:
            assert np.arctan2(rot[1, 0], rot[0, 0]) == pytest.approx(target.pos[0], abs=1e-9)
    for thread in threads:
        thread.join()
    assert abs(source.target(10.0, seen).pos[0]) == pytest.approx(1.0)
