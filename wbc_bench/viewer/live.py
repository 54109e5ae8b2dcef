"""The robot in a browser, in real time: `wbc-bench live`.

One thread steps and draws; what a person does in the page arrives on other threads and waits in a queue.
"""

import contextlib
import time as clocks
from collections import deque
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np

from wbc_bench.errors import BenchError
from wbc_bench.robot import Scene
from wbc_bench.viewer.guard import Guard
from wbc_bench.viewer.moment import Moment
from wbc_bench.viewer.panel import SPEEDS, Panel
from wbc_bench.viewer.scene import SceneView, serving
from wbc_bench.viewer.session import Session, hand_pose

DRAW_PERIOD, PANEL_PERIOD = 0.04, 0.25  # [s]
TRAIL_PIECES = 60
GIZMO = 0.22  # [m]
FARTHEST = 10.0  # [m] of a goal from the middle of the ground
MAX_LAG = 0.5  # [s] behind real time that is made up for; more is let go


class LiveView:
    """A session and its page."""

    def __init__(self, server: Any, session: Session) -> None:
        self.session = session
        self._commands: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self.paused, self.waiting, self.speed = False, False, 1.0
        self._fault = ""  # of the controller or the source at the last step
        self.scene = SceneView(server, session.robot, session.protocol.success, TRAIL_PIECES)
        self._server = server
        self._place_gizmo()
        self.panel = Panel(server, self)
        self._pace: deque[tuple[float, float]] = deque(maxlen=100)  # (wall, simulated) [s]
        self._drawn: Moment | None = None
        self._surroundings: Scene | None = None
        self._begin()

    # what the page asks for, from its threads

    def ask(self, command: Callable[[], None]) -> None:
        """Let a command run between two steps; what is wrong with it is shown in the page."""
        self._commands.put(command)

    def set_goal(self, pos_w: np.ndarray, wxyz: np.ndarray) -> None:
        """A goal that did not come from the gizmo, (3,) [m] and (4,): the gizmo goes there."""
        self.gizmo.position, self.gizmo.wxyz = pos_w, wxyz
        self._goal_moved()

    def restart(self, spec: str | None = None, source: str | None = None) -> None:
        """See `Session.restart`."""
        self.session.restart(spec, source)
        self._begin()

    def wait(self) -> None:
        """Let time begin with the first goal."""
        self.paused = self.waiting = True

    def step_once(self) -> None:
        """Pause, and take one step."""
        self.paused = True
        self._step()

    # the loop

    def run(self, stop: Callable[[], bool]) -> None:
        """Step, draw and obey until it is time to stop."""
        due = drawn = told = clocks.monotonic()
        while not stop():
            self._obey()
            now = clocks.monotonic()
            if self.paused or not self.session.running:
                due = now + 0.02
                self._pace.clear()
            elif now >= due:
                self._step()
                due = max(due + self.session.period / self.speed, now - MAX_LAG)
            if now - drawn >= DRAW_PERIOD:
                drawn = now
                self._draw()
            if now - told >= PANEL_PERIOD:
                told = now
                self.panel.update(self.real_time_factor)
            clocks.sleep(max(0.0, due - clocks.monotonic()))

    @property
    def doing(self) -> str:
        """In a word, what the page shows."""
        if not self.session.running:
            return self.session.status
        return "waiting for the first drag" if self.waiting else "paused" if self.paused else "standing"

    @property
    def real_time_factor(self) -> float:
        """Simulated by elapsed time over the last steps; NaN when nothing moves."""
        if len(self._pace) < 2:
            return float("nan")
        (wall, simulated), (wall_now, simulated_now) = self._pace[0], self._pace[-1]
        return (simulated_now - simulated) / max(wall_now - wall, 1e-9)

    def _step(self) -> None:
        """One step; a controller or source that fails pauses the view, which says why and goes on."""
        self.waiting = False
        try:
            self.session.step()
        except BenchError as error:
            self.paused, self._fault = True, str(error)
            self.panel.say(self._fault)
            return
        if self._fault:
            self._fault = ""
            self.panel.say("")
        self._pace.append((clocks.monotonic(), self.session.moment.time))
        self.panel.record(self.session.moment)

    def _draw(self) -> None:
        if self._drawn is not self.session.moment:
            self._drawn = self.session.moment
            self.scene.show(self._drawn)

    def _obey(self) -> None:
        while True:
            try:
                command = self._commands.get_nowait()
            except Empty:
                return
            mistake = ""
            try:
                command()
            except BenchError as error:
                mistake = str(error)
            self.panel.say(mistake or self._fault)

    def _begin(self) -> None:
        self._pace.clear()
        self._fault = ""
        self.scene.clear()
        if self._surroundings is not self.session.surroundings:
            self._surroundings = self.session.surroundings
            self.scene.furnish(self._surroundings)
        self.gizmo.position, self.gizmo.wxyz = hand_pose(self.session.moment)
        self.gizmo.visible = self.session.dragged
        self.panel.begin()
        self._draw()

    def set_speed(self, speed: float) -> None:
        """Simulated by elapsed time. Raises: BenchError when it is not one of the slider's."""
        low, high = SPEEDS
        if not low <= speed <= high:  # not so of NaN either
            raise BenchError(f"speed {speed:g}, valid: {low:g} to {high:g}")
        self.speed = speed

    def _place_gizmo(self) -> None:
        """A gizmo at the hand; a new one, since one whose pose is no pose cannot be told another."""
        pos_w, wxyz = hand_pose(self.session.moment)
        self.gizmo = self._server.scene.add_transform_controls(
            "/goal", scale=GIZMO, line_width=4.0, depth_test=False, position=pos_w, wxyz=wxyz
        )
        self.gizmo.visible = self.session.dragged
        self.gizmo.on_update(lambda _: self.ask(self._goal_moved))

    def _goal_moved(self) -> None:
        pos_w, wxyz = np.full(3, np.nan), np.zeros(4)
        with contextlib.suppress(TypeError, ValueError):  # what arrived is not numbers
            pos_w, wxyz = np.array(self.gizmo.position, float), np.array(self.gizmo.wxyz, float)
        length = float(np.linalg.norm(wxyz))
        shapes = pos_w.shape == (3,) and wxyz.shape == (4,)
        if not (shapes and (np.abs(pos_w) <= FARTHEST).all() and 0.5 < length < 2):  # not so of NaN either
            self._place_gizmo()
            raise BenchError(f"a goal that is no pose within {FARTHEST:g} m")
        turned = wxyz / length
        self.session.set_goal(pos_w, turned)
        if self.waiting:
            self.paused = self.waiting = False
        self.panel.show_goal(pos_w, turned)


def serve(
    host: str,
    port: int,
    session: Session,
    ready: Callable[[str], None],
    once: bool = False,
) -> None:
    """Show a session in a page, whose address with its token `ready` is given, and close it in the end.

    `once`: its time begins with the first goal, and it is shown no longer than it lasts.

    Raises: BenchError without viser, or when the port is taken.
    """
    try:
        guard = Guard(remote=host == "0.0.0.0")
        with serving(host, port, guard) as server:
            if server.get_port() != port:
                raise BenchError(f"port {port} is in use, valid: another --port, e.g. {server.get_port()}")
            view = LiveView(server, session)
            if once:
                view.wait()
            ready(guard.address(host, port))
            view.run(lambda: once and not session.running)
    finally:
        session.close()
