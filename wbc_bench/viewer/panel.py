"""What stands beside the scene of the live view: read-outs, charts and controls."""

import re
from collections import deque
from collections.abc import Callable
from typing import Any, Protocol, TypeVar

import numpy as np

from wbc_bench.errors import BenchError, UnknownNameError
from wbc_bench.installed import controllers
from wbc_bench.results.formatting import CM, DEG
from wbc_bench.rotations import matrix_from_rpy, matrix_from_wxyz, rpy_from_matrix, wxyz_from_matrix
from wbc_bench.sources import source_names
from wbc_bench.viewer.moment import Array, Moment
from wbc_bench.viewer.session import Session

CHART_SECONDS, CHART_EVERY = 10.0, 5  # [s], control steps a point
POSITION_COLOUR, ORIENTATION_COLOUR = "#2864c8", "#b0446e"
SPEEDS = (0.1, 2.0)  # simulated by elapsed time
PUSH_SPEEDS, PUSH_SPEED = (0.1, 1.0), 0.3  # [m/s]
PUSHES = {"forward": (1, 0), "back": (-1, 0), "left": (0, 1), "right": (0, -1)}  # world x, y


T = TypeVar("T")


class Controllable(Protocol):
    """The part of a live view that the panel shows and operates; `live.LiveView` implements it."""

    session: Session
    paused: bool
    speed: float  # simulated by elapsed time

    @property
    def doing(self) -> str:
        """The state of the view in a few words."""
        ...

    def ask(self, command: Callable[[], None]) -> None:
        """Let a command run between two control steps."""
        ...

    def set_goal(self, pos_w: Array, wxyz: Array) -> None:
        """Move the goal to a position (3,) [m] and quaternion (4,) in the world frame."""
        ...

    def restart(self, spec: str | None = None, source: str | None = None) -> None:
        """Begin a new episode, with another controller or source where one is given."""
        ...

    def set_speed(self, speed: float) -> None:
        """Set how much time is simulated per elapsed time."""
        ...

    def step_once(self) -> None:
        """Pause, and take one control step."""
        ...


class Panel:
    """Shows a view, and asks it for what a person wants."""

    def __init__(self, server: Any, view: Controllable) -> None:
        self._view, gui = view, server.gui
        session = view.session
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(40, 100, 200))
        gui.set_panel_label("wbc-bench live")
        self._state = gui.add_markdown("")
        self._message = gui.add_markdown("", visible=False)
        self._charts = [
            _add_chart(gui, "position error [cm]", POSITION_COLOUR),
            _add_chart(gui, "orientation error [deg]", ORIENTATION_COLOUR),
        ]
        self._pause = gui.add_button("Pause")
        steps = gui.add_button_group("Time", ("single step", "reset"))
        self._speed = gui.add_slider("Speed", min=SPEEDS[0], max=SPEEDS[1], step=0.1, initial_value=1.0)
        with gui.add_folder("Goal, in the world"):
            self._pos = gui.add_vector3("x y z [m]", (0.0, 0.0, 0.0), step=0.01)
            self._rpy = gui.add_vector3("r p y [deg]", (0.0, 0.0, 0.0), step=1.0)
        with gui.add_folder("Push"):
            low, high = PUSH_SPEEDS
            self._push_speed = gui.add_slider("m/s", min=low, max=high, step=0.1, initial_value=PUSH_SPEED)
            self._pushes = gui.add_button_group("Direction", tuple(PUSHES))
        with gui.add_folder("Who and what"):
            self._specs = {name: name for name in sorted({*controllers(), session.spec})}
            self._spec = gui.add_dropdown("Controller", [*self._specs], initial_value=session.spec)
            self._sources = {name: name for name in [*source_names(), session.source_name]}
            self._source = gui.add_dropdown("Source", [*self._sources], initial_value=session.source_name)
        self._history: deque[tuple[float, float, float]] = deque(
            maxlen=round(CHART_SECONDS / session.period / CHART_EVERY)
        )
        self._steps = 0

        self._pause.on_click(lambda _: view.ask(self._toggle))
        times = {"single step": view.step_once, "reset": view.restart}
        steps.on_click(lambda event: view.ask(lambda: _chosen("Time", event.target.value, times)()))
        self._pushes.on_click(lambda event: view.ask(lambda: self._push(event.target.value)))
        # what the program itself writes into a field has no client
        for field in (self._pos, self._rpy):
            field.on_update(lambda event: view.ask(self._typed) if event.client else None)
        for field in (self._spec, self._source):
            field.on_update(lambda event: view.ask(self._choose) if event.client else None)
        self._speed.on_update(lambda event: view.ask(self._set_speed) if event.client else None)

    def begin(self) -> None:
        """A new episode."""
        self._history.clear()
        self._steps = 0
        moment = self._view.session.moment
        self.show_goal(moment.target_pos_w, wxyz_from_matrix(moment.target_rot_w))
        self.record(moment)
        self.update(float("nan"))

    def record(self, moment: Moment) -> None:
        """Remember the errors of a step."""
        if self._steps % CHART_EVERY == 0:
            errors = moment.position_error * CM, moment.orientation_error * DEG
            self._history.append((moment.time, *errors))
        self._steps += 1

    def update(self, real_time_factor: float) -> None:
        """Show the present state."""
        session, moment = self._view.session, self._view.session.moment
        info = session.controller.info
        more = f" · commands: positions, {', '.join(sorted(info.commands))}" if info.commands else ""
        pace = "–" if np.isnan(real_time_factor) else f"{real_time_factor:.2f} × real time"
        self._state.content = (
            f"**{self._view.doing}** · {moment.time:.1f} s · {pace}\n\n"
            f"position **{moment.position_error * CM:.1f} cm** · "
            f"orientation **{moment.orientation_error * DEG:.1f}°**\n\n"
            f"sees: {', '.join(sorted(info.signals)) or 'nothing'}{more}"
        )
        self._pause.label = "Continue" if self._view.paused else "Pause"
        time, position, orientation = np.array(self._history).T
        for chart, values in zip(self._charts, (position, orientation), strict=True):
            chart.data = (time, values)

    def show_goal(self, pos_w: Array, wxyz: Array) -> None:
        """Write where the gizmo is."""
        self._goal = pos_w, wxyz
        self._pos.value = tuple(float(x) for x in np.round(pos_w, 3))
        self._rpy.value = tuple(float(x) for x in np.round(rpy_from_matrix(matrix_from_wxyz(wxyz)) * DEG, 1))

    def say(self, text: str) -> None:
        """One line about what went wrong, or nothing."""
        # the page shows Markdown, and HTML inside it; these words may be anybody's, e.g. of an exception
        plain = re.sub(r"[\\`*_~<&\[{]", r"\\\g<0>", text)
        self._message.content, self._message.visible = f"⚠ {plain}", bool(text)

    def _toggle(self) -> None:
        self._view.paused = not self._view.paused
        self.update(float("nan"))

    def _set_speed(self) -> None:
        try:
            self._view.set_speed(_number(self._speed.value))
        finally:
            self._speed.value = self._view.speed

    def _push(self, direction: str) -> None:
        speed, (low, high) = _number(self._push_speed.value), PUSH_SPEEDS
        if not low <= speed <= high:  # not so of NaN either
            self._push_speed.value = PUSH_SPEED
            raise BenchError(f"a push of {speed:g} m/s, valid: {low:g} to {high:g}")
        self._view.session.push(np.array(_chosen("Direction", direction, PUSHES)) * speed)

    def _typed(self) -> None:
        pos_w, rpy = (np.array([_number(x) for x in field.value]) for field in (self._pos, self._rpy))
        if pos_w.shape != (3,) or rpy.shape != (3,) or not np.isfinite([pos_w, rpy]).all():
            self.show_goal(*self._goal)
            raise BenchError("a goal that is not six finite numbers")
        self._view.set_goal(pos_w, wxyz_from_matrix(matrix_from_rpy(rpy / DEG)))

    def _choose(self) -> None:
        session = self._view.session
        try:
            # what arrives need not be one of the choices: nothing else is ever loaded
            spec = _chosen("Controller", self._spec.value, self._specs)
            source = _chosen("Source", self._source.value, self._sources)
            self._view.restart(spec, source)
        finally:
            self._spec.value, self._source.value = session.spec, session.source_name


def _number(value: Any) -> float:
    """What a field holds. Raises: BenchError, it is no number."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        raise BenchError(f"'{value}' is not a number")
    return float(value)


def _chosen(label: str, value: Any, choices: dict[str, T]) -> T:
    """What a choice stands for. Raises: UnknownNameError, it is not one that the page offers."""
    if not isinstance(value, str) or value not in choices:
        raise UnknownNameError("choice", str(value), choices, label)
    return choices[value]


def _add_chart(gui: Any, title: str, colour: str) -> Any:
    series = ({"label": "s"}, {"label": title, "stroke": colour, "width": 2})
    # uPlot wants all of it: from 0 to 1, or to a tenth above what there is
    lower = {"pad": 0.0, "hard": 0.0, "soft": 0.0, "mode": 1}
    upper = {"pad": 0.1, "hard": 1e6, "soft": 1.0, "mode": 1}
    scales = {"x": {"time": False}, "y": {"range": {"min": lower, "max": upper}}}
    axes = ({"size": 28}, {"size": 40})
    nothing = np.zeros(1)
    return gui.add_uplot(
        *((nothing, nothing), series),
        **{
            "title": title,
            "scales": scales,
            "axes": axes,
            "legend": {"show": False},
            "height": 105,
            "padding": (8, 16, 0, 0),
        },
    )
