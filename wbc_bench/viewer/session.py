"""One robot under one controller and one source of targets: what the live view steps."""

import numpy as np

from wbc_bench.control_loop import RUNNING, ControlLoop
from wbc_bench.controller import Controller, load_controller
from wbc_bench.errors import SourceError
from wbc_bench.observation import target_in_base
from wbc_bench.robot import Robot, load_robot
from wbc_bench.rotations import wxyz_from_matrix
from wbc_bench.sources import Source, StampedTarget, load_source, source_names, to_world
from wbc_bench.sources.interface import SceneSource
from wbc_bench.sources.live import LiveSource
from wbc_bench.track import free_episode, seen_of
from wbc_bench.viewer.moment import PUSH_SECONDS, Array, Moment, moment_of

LIVE = "live"  # the source that a person drags
HORIZON = 600.0  # [s] of an episode: the noise of a whole one is drawn in advance


def live_source_names() -> list[str]:
    """Sources that a session can be given."""
    return [LIVE, *(name for name in source_names() if name != "diffusion")]


class Session:
    """Steps a robot for as long as it stands; `moment` is the present one."""

    def __init__(self, spec: str, source: str, protocol: str, condition: str, seed: int) -> None:
        """Raises: BenchError, whatever of these is unknown or cannot be loaded."""
        self.protocol, self._row = free_episode(protocol, condition, seed, HORIZON)
        self.robot: Robot = load_robot(self.protocol.robot)
        self.spec, self.source_name = spec, source
        self.controller: Controller = load_controller(spec, self.robot)
        self._source: Source = _load(source)
        self.restart()

    def restart(self, spec: str | None = None, source: str | None = None) -> None:
        """Begin anew, with another controller or source where one is given.

        Raises: BenchError when that cannot be loaded; then everything stays as it was.
        """
        controller = load_controller(spec or self.spec, self.robot)
        loop = ControlLoop(controller, self.protocol, self._row)
        if source is not None and source != self.source_name:
            replaced, self._source, self.source_name = self._source, _load(source), source
            replaced.close()
        self.controller, self.spec, self._loop = controller, spec or self.spec, loop
        self._push, self._pushed = np.zeros(2), -np.inf  # [m/s], [s]
        self._seen = seen_of(loop.state, self.robot)
        self._source.reset(self._seen)
        self._aim()
        loop.reset(self._target())

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
    def dragged(self) -> bool:
        """Whether a person sets the target."""
        return isinstance(self._source, LiveSource)

    def set_goal(self, pos_w: Array, wxyz: Array) -> None:
        """Where a person wants the hand, (3,) [m] and (4,); from any thread, ignored by other sources.

        Raises: SourceError when it is not a pose.
        """
        if isinstance(self._source, LiveSource):
            self._source.set_target(StampedTarget(self.moment.time, "world", pos_w, wxyz))

    def push(self, velocity_w: Array) -> None:
        """Add (2,) [m/s] to the base's horizontal velocity now."""
        self._loop.simulation.push(velocity_w[None])
        self._push, self._pushed = velocity_w, self.moment.time

    def step(self) -> None:
        """One control step towards the target of the source; nothing when it is over."""
        if not self.running:
            return
        self._loop.advance(self._target())
        self._seen = seen_of(self._loop.state, self.robot)
        self._aim()

    def close(self) -> None:
        """Let go of what the source holds."""
        self._source.close()

    def _aim(self) -> None:
        """Ask the source, and see what there is now."""
        time = self._loop.step * self.period
        self._pos_w, self._rot_w = to_world(self._source.target(time, self._seen), self._seen)
        push = self._push if time - self._pushed <= PUSH_SECONDS else np.zeros(2)
        self.moment: Moment = moment_of(self._loop, 0, self._pos_w, self._rot_w, push)

    def _target(self):
        return target_in_base(self._loop.state, self._pos_w[None], self._rot_w[None])


def hand_pose(moment: Moment) -> tuple[Array, Array]:
    """Where the hand is, (3,) [m] and quaternion (4,)."""
    return moment.ee_pos_w, wxyz_from_matrix(moment.ee_rot_w)


def _load(name: str) -> Source:
    if name == LIVE:
        return LiveSource()
    source = load_source(name)
    if isinstance(source, SceneSource):
        source.close()
        raise SourceError(
            f"source '{name}' brings a scene of its own, which the live view does not draw, "
            f"valid: {', '.join(live_source_names())}, or a .toml file"
        )
    return source
