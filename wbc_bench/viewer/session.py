"""One robot under one controller and one source of targets: what the live view steps."""

import numpy as np

from wbc_bench.controller import Controller, Target
from wbc_bench.episodes.manifest import EpisodeManifest
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.errors import BenchError
from wbc_bench.evaluation.control_loop import RUNNING, ControlLoop
from wbc_bench.evaluation.tracking import outcome_of, seen_of
from wbc_bench.registry import load_controller
from wbc_bench.results.tracking import Series, Tracked
from wbc_bench.robot import Robot, load_robot
from wbc_bench.rotations import wxyz_from_matrix
from wbc_bench.sources import Source, StampedTarget, load_source, to_world
from wbc_bench.sources.interface import SceneSource
from wbc_bench.sources.live import LiveSource
from wbc_bench.sources.stream_filter import StreamConfig
from wbc_bench.viewer.moment import PUSH_SECONDS, Array, Moment, moment_of


class Session:
    """Steps a robot for as long as it stands; `moment` is the present one."""

    def __init__(
        self,
        spec: str,
        source: str,
        protocol: EvalProtocol,
        row: EpisodeManifest,
        stream: StreamConfig = StreamConfig(),  # noqa: B008  (immutable)
    ) -> None:
        """An episode (a manifest of one row, whose target nobody looks at); see `track.free_episode`.

        `stream` is that of a source which is one.

        Raises: BenchError, whatever of these is unknown or cannot be loaded.
        """
        self.protocol, self._row, self._stream = protocol, row, stream
        self.robot: Robot = load_robot(protocol.robot)
        self.spec, self.source_name = spec, source
        self.controller: Controller = load_controller(spec, self.robot)
        self.source: Source = self._load(source)
        self.restart()

    def restart(self, spec: str | None = None, source: str | None = None) -> None:
        """Begin anew, with another controller or source where one is given.

        Raises: BenchError when that cannot be loaded; then everything stays as it was.
        """
        controller = load_controller(spec or self.spec, self.robot)
        name = source or self.source_name
        changed = name != self.source_name
        following = self._load(name) if changed else self.source
        surroundings = following.scene if isinstance(following, SceneSource) else None
        try:
            loop = ControlLoop(controller, self.protocol, self._row, surroundings)
            seen = seen_of(loop.state, self.robot)
            _look(following, loop)
            following.reset(seen)
            aim = to_world(following.target(0.0, seen), seen)
        except BenchError:
            if changed:
                following.close()
            raise
        if changed:
            self.source.close()
            self.source, self.source_name = following, name
        self.controller, self.spec, self._loop = controller, spec or self.spec, loop
        self.surroundings = surroundings
        self._series = Series(self.period)
        self._push, self._pushed = np.zeros(2), -np.inf  # [m/s], [s]
        self._seen, (self._pos_w, self._rot_w) = seen, aim
        self._take(0.0)

    @property
    def period(self) -> float:
        """[s] of a control step."""
        return self.protocol.control_period

    @property
    def status(self) -> str:
        """Standing, or how the episode ended."""
        if self._loop.ended[0] != RUNNING:
            return str(self._loop.ended[0]).replace("_", " ")
        return "over" if self._loop.step >= self.protocol.num_steps else "standing"

    @property
    def running(self) -> bool:
        """Whether there is anything left to step."""
        return self.status == "standing"

    @property
    def tracked(self) -> Tracked:
        """How the target was followed since the start."""
        return self._series.tracked(outcome_of(self._loop))

    @property
    def dragged(self) -> bool:
        """Whether a person sets the target."""
        return isinstance(self.source, LiveSource)

    def set_goal(self, pos_w: Array, wxyz: Array) -> None:
        """Where a person wants the hand, (3,) [m] and (4,); from any thread, ignored by other sources.

        Raises: SourceError when it is not a pose.
        """
        if isinstance(self.source, LiveSource):
            self.source.set_target(StampedTarget(self.moment.time, "world", pos_w, wxyz))

    def push(self, velocity_w: Array) -> None:
        """Add (2,) [m/s] to the base's horizontal velocity now."""
        self._loop.simulation.push(velocity_w[None])
        self._push, self._pushed = velocity_w, self.moment.time

    def step(self) -> None:
        """One control step towards the target of the source; nothing when it is over.

        Raises: BenchError when the controller or the source fails; another step is another try.
        """
        if not self.running:
            return
        if self._loop.step == 0:  # not in `restart`: a controller may fail at this as at any step
            self._loop.reset(self._target())
        if self._loop.advance(self._target()).stepped.any():
            self._series.add(self._pos_w, self._rot_w, self._seen.ee_pos_w, self._seen.ee_rot_w)
        self._seen = seen_of(self._loop.state, self.robot)
        _look(self.source, self._loop)
        time = self._loop.step * self.period
        self._pos_w, self._rot_w = to_world(self.source.target(time, self._seen), self._seen)
        self._take(time)

    def close(self) -> None:
        """Let go of what the source holds."""
        self.source.close()

    def _take(self, time: float) -> None:
        """Keep what there is now, `time` [s] after the start."""
        push = self._push if time - self._pushed <= PUSH_SECONDS else np.zeros(2)
        self.moment: Moment = moment_of(self._loop, 0, self._pos_w, self._rot_w, push)

    def _target(self) -> Target:
        return self._loop.target(self._pos_w[None], self._rot_w[None])

    def _load(self, name: str) -> Source:
        return load_source(name, protocol=self.protocol, config=self._stream)


def _look(source: Source, loop: ControlLoop) -> None:
    """Show a source the scene, if it looks at one."""
    if isinstance(source, SceneSource):
        source.look(loop.simulation.scenery[0])


def hand_pose(moment: Moment) -> tuple[Array, Array]:
    """Where the hand is, (3,) [m] and quaternion (4,)."""
    return moment.ee_pos_w, wxyz_from_matrix(moment.ee_rot_w)
