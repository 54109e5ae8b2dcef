"""What an episode drew and what went wrong in it, told from moments made by hand and from a real one."""

import dataclasses

import numpy as np
import pytest

from runs import evaluated
from wbc_bench.episodes.conditions import conditions_of, pushes_of
from wbc_bench.episodes.rows import EpisodeManifest
from wbc_bench.robot import JOINT_NAMES
from wbc_bench.viewer.film import strip_caption
from wbc_bench.viewer.moment import Moment, Skeleton
from wbc_bench.viewer.replay import _time_line
from wbc_bench.viewer.rerun import Rerun, rerun
from wbc_bench.viewer.time_line import GRAVITY, events_of, first_fault, story_of

PERIOD = 0.02  # [s]
WEIGHT = np.array([[0.0, 0.0, 130.0], [0.0, 0.0, 130.0]])  # [N] on both soles


@pytest.fixture(scope="module")
def fallen(tmp_path_factory: pytest.TempPathFactory) -> Rerun:
    return rerun(evaluated(tmp_path_factory.mktemp("store"), "hold"), 0)


@pytest.fixture
def standing(fallen: Rerun) -> Rerun:
    """Two seconds in the default posture, balanced between the soles, without a push."""
    robot = fallen.robot
    skeleton = Skeleton(robot.model())
    start = fallen.moments[0]._replace(
        qpos=np.concatenate([[0.0, 0.0, 0.8, 1.0, 0.0, 0.0, 0.0], robot.default_q]), foot_force_w=WEIGHT
    )
    skeleton.place(start)
    corners = skeleton.support(np.full((2, 3), np.inf))
    middle = corners.mean(axis=0)
    soles = np.array([[middle[0], middle[1] + 0.1, 0.0], [middle[0], middle[1] - 0.1, 0.0]])
    start = start._replace(com_w=np.array([*middle, 0.7]), foot_pos_w=soles)
    drawn = fallen.drawn.take(np.array([0]))
    drawn = dataclasses.replace(drawn, push_time=np.full_like(drawn.push_time, np.nan))
    moments = [start._replace(time=k * PERIOD) for k in range(101)]
    return dataclasses.replace(
        fallen, moments=moments, drawn=drawn, stored={**fallen.stored, "outcome": "success"}
    )


def with_moments(again: Rerun, change) -> Rerun:
    """The same with each moment changed by `change(k, moment)`."""
    return dataclasses.replace(again, moments=[change(k, moment) for k, moment in enumerate(again.moments)])


def faults(again: Rerun) -> list[tuple[float, str]]:
    return [(event.time, event.text) for event in events_of(again) if event.wrong]


def test_of_a_robot_that_stands_there_is_nothing_to_tell(standing: Rerun) -> None:
    assert faults(standing) == []
    assert [event.text for event in events_of(standing)] == ["success"]
    assert story_of(standing, events_of(standing)).endswith("Nothing went wrong before the end.")


@pytest.mark.parametrize("way, slips", [(0.015, False), (0.03, True)])
def test_a_loaded_sole_that_moves_two_centimetres_slips(standing: Rerun, way: float, slips: bool) -> None:
    """From 1.0 s on, within a tenth of a second; one in the air moves as it likes."""

    def slide(k: int, moment: Moment) -> Moment:
        feet = moment.foot_pos_w.copy()
        feet[1, 0] += way * np.clip((moment.time - 1.0) / 0.1, 0.0, 1.0)
        return moment._replace(foot_pos_w=feet)

    found = faults(with_moments(standing, slide))
    assert len(found) == slips
    if slips:
        assert 0.98 <= found[0][0] <= 1.0 and found[0][1].startswith("right sole slips")

    def in_the_air(k: int, moment: Moment) -> Moment:
        return slide(k, moment)._replace(foot_force_w=WEIGHT * [[1.0], [0.0]])

    assert faults(with_moments(standing, in_the_air)) == []


def test_the_capture_point_of_a_push_leaves_the_soles(standing: Rerun) -> None:
    """x + v sqrt(h / g): at 0.7 m a speed counts for 0.267 s of way."""
    skeleton = Skeleton(standing.robot.model())
    skeleton.place(standing.moments[0])
    corners = skeleton.support(np.full((2, 3), np.inf))
    ahead = corners[:, 0].max() - standing.moments[0].com_w[0]
    height = standing.moments[0].com_w[2]

    def moving(speed: float) -> Rerun:
        def change(k: int, moment: Moment) -> Moment:
            x = speed * max(moment.time - 1.0, 0.0)
            return moment._replace(com_w=moment.com_w + np.array([x, 0.0, 0.0]))

        return with_moments(standing, change)

    needed = ahead / np.sqrt(height / GRAVITY)
    early = faults(moving(1.05 * needed))
    assert early[0][1] == "capture point outside the soles" and early[0][0] == pytest.approx(1.0, abs=0.041)
    late = faults(moving(0.5 * needed))
    # half of the way is left for the position to make: (ahead / 2) / (needed / 2) = sqrt(h / g) later
    assert late[0][0] == pytest.approx(1.0 + np.sqrt(height / GRAVITY), abs=0.03)


@pytest.mark.parametrize("joint", [3, 9])
def test_a_joint_at_the_end_of_its_range_is_named(standing: Rerun, joint: int) -> None:
    def reach(end: float, until: float) -> Rerun:
        def change(k: int, moment: Moment) -> Moment:
            qpos = moment.qpos.copy()
            if 0.5 <= moment.time < until:
                qpos[7 + joint] = end
            return moment._replace(qpos=qpos)

        return with_moments(standing, change)

    upper = standing.robot.upper[joint]
    found = faults(reach(upper - 0.005, 3.0))
    assert found[0] == (0.5, f"{JOINT_NAMES[joint]} at the end of its range")
    assert faults(reach(upper - 0.005, 0.56)) == []  # too short
    at_home = dataclasses.replace(standing.robot, default_q=standing.robot.upper)  # no fault of the robot's
    assert faults(dataclasses.replace(reach(upper - 0.005, 3.0), robot=at_home)) == []
    assert f"{JOINT_NAMES[joint]} at the end of its range" not in [
        text for _, text in faults(reach(upper - 0.02, 3.0))
    ]


def test_a_real_fall_is_told_everywhere(fallen: Rerun) -> None:
    events = events_of(fallen)
    assert events[-1].text == str(fallen.stored["outcome"]).replace("_", " ") == "fell" and events[-1].wrong
    assert events[-1].time == fallen.moments[-1].time
    assert events == sorted(events, key=lambda event: event.time)
    first = first_fault(events)
    assert first is not None and first.time < events[-1].time
    story = story_of(fallen, events)
    assert f"at {first.time:.2f} s: {first.text}." in story and "friction" in story
    assert story in strip_caption(fallen, [0.0])
    page = _time_line(events)
    assert page.count("<rect ") == len(events) and all(event.text in page for event in events)


def test_conditions_say_what_is_on_and_nothing_else(fallen: Rerun) -> None:
    row: EpisodeManifest = fallen.drawn
    off = dict.fromkeys(("base_mass", "payload", "command_delay", "observation_delay"), np.zeros(1))
    off |= {"friction": np.array([0.5]), "kp_scale": np.ones((1, len(JOINT_NAMES)))}
    off |= {"push_time": np.full_like(row.push_time, np.nan)}
    plain = dataclasses.replace(row, **off)
    assert conditions_of(plain, 0) == ["friction 0.50"]
    push_time, push_vel, up = off["push_time"].copy(), row.push_vel * 0, row.push_vel_z * 0
    push_time[0, :2] = 5.0, 2.0
    push_vel[0, :4], up[0, 1] = [0.3, 0.4, 0.0, 0.0], 0.2
    told = dataclasses.replace(
        plain,
        push_time=push_time,
        push_vel=push_vel,
        push_vel_z=up,
        payload=np.array([0.73]),
        base_mass=np.array([-0.5]),
        command_delay=np.array([0.014]),
        motor_strength=np.array([0.93]),
        imu_tilt=np.deg2rad([[3.0, 4.0]]),
    )
    assert pushes_of(told, 0) == [(2.0, pytest.approx(0.2)), (5.0, pytest.approx(0.5))]
    assert conditions_of(told, 0) == [
        "push of 0.20 m/s at 2.0 s",
        "push of 0.50 m/s at 5.0 s",
        "friction 0.50",
        "added mass -0.5 kg",
        "payload 0.73 kg",
        "motors at 93 %",
        "commands 14 ms late",
        "IMU tilted by 5.0°",
    ]
