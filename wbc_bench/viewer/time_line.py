"""What happened in an episode, and when: pushes, limits, slips, lost balance and the end."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wbc_bench.episodes.conditions import conditions_of, pushes_of
from wbc_bench.evaluation.rollout import LOADED
from wbc_bench.outcomes import TERMINATED
from wbc_bench.robot import JOINT_NAMES
from wbc_bench.viewer.moment import Moment, Skeleton
from wbc_bench.viewer.rerun import Rerun

Array = NDArray[np.float64]
GRAVITY = 9.81  # [m/s^2]
LIMIT = 0.01  # [rad] from a joint's limit: it stands at it; choice
SLIP, SLIP_SECONDS = 0.02, 0.1  # [m] in [s]: more than a sole rolls when it touches down; choice
HELD = 0.1  # [s] that a joint at its limit or a capture point outside lasts before it counts; choice


class Event(NamedTuple):
    """Something that happened."""

    time: float  # [s] since the start, when it began
    text: str
    wrong: bool  # a push is none of the robot's faults, and the end has a name of its own


def events_of(again: Rerun) -> list[Event]:
    """What happened in an episode, in order of time: each kind of fault once, when it happened first."""
    found = [Event(time, f"push of {speed:.2f} m/s", False) for time, speed in pushes_of(again.drawn, 0)]
    end = again.moments[-1].time
    found = [event for event in found if event.time <= end]
    found += filter(None, (_limit(again), _slip(again.moments), _capture(again)))
    outcome = str(again.stored["outcome"]).replace("_", " ")
    terminated = again.stored["outcome"] in {str(each) for each in TERMINATED}
    return [*sorted(found, key=lambda event: event.time), Event(end, outcome, terminated)]


def first_fault(events: Sequence[Event]) -> Event | None:
    """What went wrong first, before the end; None where nothing did."""
    return next((event for event in events[:-1] if event.wrong), None)


def story_of(again: Rerun, events: Sequence[Event]) -> str:
    """What the episode drew, and what of its `events_of` went wrong first, in a sentence each."""
    fault = first_fault(events)
    first = (
        f"First went wrong, at {fault.time:.2f} s: {fault.text}."
        if fault
        else "Nothing went wrong before the end."
    )
    return f"Drawn: {', '.join(conditions_of(again.drawn, 0))}. {first}"


def _limit(again: Rerun) -> Event | None:
    """A joint stands at an end of its range at which the default posture does not have it."""
    robot, moments = again.robot, again.moments
    q = np.array([moment.qpos[7:] for moment in moments])
    low, high = robot.lower + LIMIT, robot.upper - LIMIT
    at = ((q < low) & (robot.default_q >= low)) | ((q > high) & (robot.default_q <= high))
    found = [
        Event(moments[start].time, f"{JOINT_NAMES[joint]} at the end of its range", True)
        for joint in range(q.shape[1])
        if (start := _began(at[:, joint], moments)) is not None
    ]
    return min(found, default=None)


def _slip(moments: Sequence[Moment]) -> Event | None:
    """A loaded sole moves along the ground."""
    loaded = np.array([moment.foot_force_w[:, 2] for moment in moments]) > LOADED  # (T, 2)
    place = np.array([moment.foot_pos_w[:, :2] for moment in moments])  # (T, 2, 2)
    way = np.linalg.norm(np.diff(place, axis=0), axis=2) * (loaded[1:] & loaded[:-1])
    span = _steps(SLIP_SECONDS, moments)
    sums = np.cumsum(np.vstack([np.zeros((1, 2)), way]), axis=0)
    for k in range(span, len(moments)):
        slid = sums[k] - sums[k - span]
        if slid.max() > SLIP:
            side = ("left", "right")[int(slid.argmax())]
            return Event(moments[k - span].time, f"{side} sole slips {slid.max() * 100:.0f} cm", True)
    return None


def _capture(again: Rerun) -> Event | None:
    """The capture point leaves the hull of both soles: without a step, the robot falls.

    Source: Pratt et al. 2006, "Capture point: a step toward humanoid push recovery", eq. 9.
    """
    moments, skeleton = again.moments, Skeleton(again.robot.model())
    com = np.array([moment.com_w for moment in moments])
    clock = np.array([moment.time for moment in moments])
    if len(moments) < 3:
        return None
    velocity = np.gradient(com, clock, axis=0)
    outside = np.zeros(len(moments), dtype=bool)
    for k, moment in enumerate(moments):
        skeleton.place(moment)
        corners = skeleton.support(np.full((2, 3), np.inf))  # of both soles, standing or not
        height = com[k, 2] - moment.foot_pos_w[:, 2].min()
        point = com[k, :2] + velocity[k, :2] * np.sqrt(max(height, 0.0) / GRAVITY)
        outside[k] = len(corners) > 0 and not _inside(point, corners)
    start = _began(outside, moments)
    return None if start is None else Event(moments[start].time, "capture point outside the soles", True)


def _inside(point: Array, corners: Array) -> bool:
    """Whether a point (2,) is in a convex polygon (K, 2) whose corners go counter-clockwise."""
    edge, to = np.roll(corners, -1, axis=0) - corners, point - corners
    return bool((edge[:, 0] * to[:, 1] - edge[:, 1] * to[:, 0] >= 0).all())


def _began(happens: NDArray[np.bool_], moments: Sequence[Moment]) -> int | None:
    """When something that lasts for HELD [s] began first."""
    span = _steps(HELD, moments)
    run = 0
    for k, now in enumerate(happens):
        run = run + 1 if now else 0
        if run > span:
            return k - span
    return None


def _steps(seconds: float, moments: Sequence[Moment]) -> int:
    """Moments that a time takes."""
    if len(moments) < 2:
        return 1
    return max(1, round(seconds / (moments[1].time - moments[0].time)))
