"""One simulated episode driven by a source instead of a manifest: what `wbc-bench track` runs."""

import math
import time as clocks
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wbc_bench import provenance
from wbc_bench.controller import Controller
from wbc_bench.episodes.manifest import EpisodeManifest
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.episodes.single import CONDITIONS, LONGEST, UNSCRIPTED, _protocol, _row, episode_of
from wbc_bench.errors import SourceError, UnknownNameError
from wbc_bench.evaluation.control_loop import RUNNING, ControlLoop
from wbc_bench.evaluation.simulation import Simulation, State
from wbc_bench.results.tracking import STOOD, Series, Tracked
from wbc_bench.robot import Robot, load_robot, mount_of
from wbc_bench.sources.interface import SceneSource, Seen, Source, to_world
from wbc_bench.sources.message import MessageStatus
from wbc_bench.sources.recorded.recording import RecordedSource
from wbc_bench.sources.registry import recorded_name
from wbc_bench.sources.replayed_stream import ReplayedStream
from wbc_bench.sources.scripted import ScriptedSource

Array = NDArray[np.float64]
STAY = 2.0  # [s] after the end of a script
MIN_USED = 0.5  # of the messages that came in a run that is scored; choice


def track(
    controller: Controller, source: Source, condition: str, seed: int, duration: float | None = None
) -> tuple[Tracked, float]:
    """Let a controller follow a source for `duration` [s], by default until the script ends; on this thread.

    Returns: the series, and the seconds asked for.

    Raises:
        UnknownNameError: no such condition.
        SourceError: a duration that is not positive, or a run that says nothing of the controller: no message
            came, or fewer than MIN_USED of those of a known clock were accepted.
        ControllerError: see `ControlLoop`.
    """
    if condition not in CONDITIONS:
        raise UnknownNameError("condition", condition, CONDITIONS, "--condition")
    if duration is None:
        duration = natural_duration(source)
    episode, before = episode_of(duration, seed, condition), dict(source.counters)
    tracked = follow(controller, source, *episode)
    _check_used({name: count - before[name] for name, count in source.counters.items()})
    return tracked, duration


def _check_used(counts: Mapping[str, int]) -> None:
    """Refuse to score the target that stood still because its messages were refused."""
    # what waited for its reader, or came before its clock was known, says nothing of the run
    judged = sum(counts.values()) - counts.get(MessageStatus.CLOCK_UNKNOWN, 0)
    if counts and counts[MessageStatus.ACCEPTED] < max(MIN_USED * judged, 1):
        raise SourceError(
            f"{counters_text(counts)}; valid: at least one message and {MIN_USED:.0%} of all accepted, "
            "less those of an unknown clock; a run of fewer is not scored"
        )


def counters_text(counts: Mapping[str, int]) -> str:
    """Messages of a run by what became of them, as one line."""
    parts = [f"{count} {name}" for name, count in counts.items() if count]
    return f"{sum(counts.values())} messages: {', '.join(parts) or 'none'}"


class Moment(NamedTuple):
    """One control step as a source met it."""

    seen: Seen
    target_pos_w: Array  # (3,) [m]
    target_rot_w: Array  # (3, 3)
    scenery: Array  # (K,) positions of the joints that the source's scene added


def follow(
    controller: Controller,
    source: Source,
    protocol: EvalProtocol,
    row: EpisodeManifest,
    on_step: Callable[[Moment], None] = lambda moment: None,
) -> Tracked:
    """The series of one episode (a manifest of one row, whose target nobody looks at).

    `on_step` is called after every control step that was taken.
    """
    furnished = source if isinstance(source, SceneSource) else None
    loop = ControlLoop(controller, protocol, row, furnished.scene if furnished else None)
    period = loop.period
    robot = loop.simulation.robot
    seen, scenery = seen_of(loop.state, robot), loop.simulation.scenery[0]
    if furnished:
        furnished.look(scenery)
    source.reset(seen)
    series, start = Series(period), clocks.monotonic()
    for step in range(protocol.num_steps * loop.parts):
        if source.live:
            clocks.sleep(max(0.0, start + step * period - clocks.monotonic()))
        if furnished:
            furnished.look(scenery)
        pos_w, rot_w = to_world(source.target(step * period, seen), seen)
        target = loop.target(pos_w[None], rot_w[None])
        if step == 0:
            loop.reset(target)
        if not loop.advance(target).stepped.any():
            break
        on_step(Moment(seen, pos_w, rot_w, scenery))
        series.add(pos_w, rot_w, seen.ee_pos_w, seen.ee_rot_w)
        if not loop.active.any():
            break
        seen, scenery = seen_of(loop.state, robot), loop.simulation.scenery[0]
    return series.tracked(outcome_of(loop))


def outcome_of(loop: ControlLoop) -> str:
    """How the one episode of a loop has ended so far."""
    ended = loop.ended[0]
    return STOOD if ended == RUNNING else str(ended)


def seen_of(state: State, robot: Robot, index: int = 0) -> Seen:
    """One row of a state, as a source sees it."""
    return Seen(
        ee_pos_w=state.ee_pos_w[index],
        ee_rot_w=state.ee_rot_w[index],
        base_pos_w=state.base_pos_w[index],
        base_rot_w=state.base_rot_w[index],
        arm_mount_b=np.array(mount_of(robot.facts, robot.config).xyz),
    )


def natural_duration(source: Source) -> float:
    """[s] until a script or recording has ended, begun from the default posture, and STAY; else UNSCRIPTED.

    Raises: SourceError, it lasts longer than an episode may.
    """
    if isinstance(source, ScriptedSource | ReplayedStream):
        played = ScriptedSource(source.script)
    elif isinstance(source, RecordedSource):
        played = source
    else:
        return UNSCRIPTED
    protocol = _protocol(UNSCRIPTED, seed=0)
    state = Simulation(protocol, _row(protocol, "nominal")).state()
    played.reset(seen_of(state, load_robot(protocol.robot)))
    if not played.path.duration + STAY <= LONGEST:
        raise SourceError(
            f"it lasts {played.path.duration:.4g} s, valid: at most {LONGEST - STAY:g} s, "
            "or a duration that plays a part of it"
        )
    return math.ceil(played.path.duration + STAY)


def _digest(source: Source) -> str | None:
    """SHA-256 of the script, the recording or the policy that decides the targets."""
    if isinstance(source, ScriptedSource | ReplayedStream):
        return source.script.digest
    return source.digest if isinstance(source, SceneSource | RecordedSource) else None


def facts(controller: Controller, spec: str, source: Source, condition: str, seed: int) -> dict:
    """What the record of a run says beside its series."""
    digest = _digest(source)
    return {
        "source": recorded_name(source.name, digest),
        "source_sha256": digest,
        "controller": spec,
        "signals": sorted(controller.info.signals),
        "commands": sorted(controller.info.commands),
        "condition": condition,
        "seed": seed,
        "counters": dict(source.counters),
        **provenance.facts(controller),
    }
