"""An episode as a film or as a strip of pictures, drawn without a window: `wbc-bench film`."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from functools import cache, cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from wbc_bench.errors import BenchError, StoreError, missing_extra
from wbc_bench.files import temporary
from wbc_bench.results.formatting import CM, DEG
from wbc_bench.viewer.moment import Moment, Skeleton, force_arrows, push_arrow
from wbc_bench.viewer.picture import Canvas, add_axes, add_bones, add_connector
from wbc_bench.viewer.rerun import EVERY, Rerun, ShowProgress
from wbc_bench.viewer.time_line import Event, events_of, story_of

Pixels = NDArray[np.uint8]
# [px] width, height of a film, of an episode in a grid, of a picture in a strip
SIZE, CELL, PANEL = (640, 480), (400, 304), (300, 400)
PANELS, GAP = 6, 4  # pictures in a strip; [px] between them
INSIDE, OUTSIDE = (0.14, 0.59, 0.35, 0.4), (0.89, 0.50, 0.12, 0.4)  # of the tolerance, around the target
TRAIL, FORCE, PUSH = (0.16, 0.39, 0.78, 1.0), (0.17, 0.59, 0.59, 1.0), (0.82, 0.20, 0.43, 1.0)
SUPPORT, COM = (0.35, 0.67, 0.90, 1.0), (0.09, 0.14, 0.25, 1.0)
TRAIL_PIECES = 50  # at most, evenly over the past
INK, LINE, FAULT = (27, 35, 48), (184, 190, 198), (176, 58, 30)
SIZE_OF_DATA, SAMPLED = (320, 240), 25  # [px] in a dataset; one picture in 25 counts for its statistics
TOLD = 3  # events, the last ones, in words
AZIMUTH, ELEVATION = 218.0, -14.0  # [deg]
MARGIN = 0.22  # [m] around what must be seen: half the width of a part, and the labels


def write_film_of(again: Rerun, path: Path, progress: ShowProgress | None = None) -> None:
    """Write an episode that has been run again as MP4, in real time.

    Raises: BenchError without OpenGL or imageio-ffmpeg; StoreError when it cannot be written.
    """
    _write_film([(again, again.title, TOLD)], 1, SIZE, path, progress)


def write_grid_of(
    seen: Sequence[Rerun], columns: int, path: Path, progress: ShowProgress | None = None
) -> None:
    """Write episodes side by side as one MP4, row by row; one that has ended stands still.

    Raises: BenchError without OpenGL or imageio-ffmpeg; StoreError when it cannot be written.
    """
    titles = [f"episode {again.episode}: {again.stored['outcome']}".replace("_", " ") for again in seen]
    _write_film(
        [(again, title, 1) for again, title in zip(seen, titles, strict=True)], columns, CELL, path, progress
    )


def _write_film(
    shown: Sequence[tuple[Rerun, str, int]],
    columns: int,
    size: tuple[int, int],
    path: Path,
    progress: ShowProgress | None,
) -> None:
    """Film episodes, each with its title and the number of its last events to tell, `size` pixels each."""
    rate = 1 / (EVERY * shown[0][0].protocol.control_period)  # [1/s]
    count = max(len(range(0, len(again.moments), EVERY)) for again, *_ in shown)
    whole = columns * size[0], -(-len(shown) // columns) * size[1]
    with contextlib.ExitStack() as stack:
        cameras = [stack.enter_context(Camera(again, size)) for again, *_ in shown]
        write = stack.enter_context(_writer(path, whole, rate, [], count))
        for number in range(count):
            pictures = [
                camera.picture(min(number * EVERY, len(again.moments) - 1), title, told)
                for camera, (again, title, told) in zip(cameras, shown, strict=True)
            ]
            write(_tiled(pictures, columns))
            if progress is not None:
                progress(number + 1, count, "filming")


@contextlib.contextmanager
def _writer(
    path: Path, size: tuple[int, int], rate: float, options: list[str], count: int
) -> Iterator[Callable[[Pixels], None]]:
    """What takes `count` pictures of a film, which is there in the end or not at all.

    Raises: BenchError without imageio-ffmpeg; StoreError when it cannot be written.
    """
    try:
        from imageio_ffmpeg import count_frames_and_secs, write_frames
    except ImportError as error:
        raise BenchError(missing_extra("a film", "film", error)) from error
    part = temporary(path)
    try:
        writer = write_frames(
            str(part),
            size,  # pyright: ignore[reportArgumentType]
            fps=rate,  # pyright: ignore[reportArgumentType]
            quality=7,
            ffmpeg_log_level="error",
            output_params=[*options, "-f", "mp4"],
        )
        writer.send(None)
        yield writer.send
        writer.close()
        # the encoder says nothing where its disk is full
        if count_frames_and_secs(str(part))[0] != count:
            raise OSError("the film was cut short: is the disk full?")
        part.replace(path)
    except (OSError, RuntimeError) as error:  # the second of a file that is no film
        raise StoreError(f"cannot write '{path}': {' '.join(str(error).split())[:200]}") from error
    finally:
        part.unlink(missing_ok=True)


def _tiled(pictures: list[Pixels], columns: int) -> Pixels:
    """Equal pictures row by row; places that stay empty are white."""
    empty = np.full_like(pictures[0], 255)
    filled = pictures + [empty] * (-len(pictures) % columns)
    rows = [np.concatenate(filled[k : k + columns], axis=1) for k in range(0, len(filled), columns)]
    return np.ascontiguousarray(np.concatenate(rows))


def write_frames_of(
    seen: Sequence[Sequence[tuple[Rerun, int]]], path: Path, rate: int, progress: ShowProgress | None = None
) -> list[Pixels]:
    """Film chosen moments of episodes, one episode after another, without any words.

    Args:
        seen: For each episode its moments by number.
        path: The MP4 to write; each picture can be read with at most one before it.
        rate: [Hz] of the pictures.
        progress: Told how far it is.

    Returns:
        For each episode some pictures, (N, H, W, 3) at a quarter of the size, for statistics.

    Raises: BenchError without OpenGL or imageio-ffmpeg; StoreError when it cannot be written.
    """
    count, done, kept = sum(map(len, seen)), 0, []
    with _writer(path, SIZE_OF_DATA, rate, ["-g", "2", "-bf", "0"], count) as write:
        for moments in seen:
            some = []
            with Camera(moments[0][0], SIZE_OF_DATA) as camera:
                for number, (_, k) in enumerate(moments):
                    picture = camera.picture(k, words=False)
                    write(picture)
                    if number % SAMPLED == 0:
                        some.append(picture[::4, ::4])
                    done += 1
                    if progress is not None:
                        progress(done, count, "filming")
            kept.append(np.array(some))
    return kept


def strip_of(again: Rerun, times: Sequence[float] | None = None) -> Pixels:
    """Pictures of an episode side by side, (400, W, 3), at `times` [s]: by default six, evenly over it.

    A time beyond the end shows the end. Raises: BenchError without OpenGL.
    """
    with Camera(again, PANEL, samples=4) as camera:
        pictures = [camera.picture(k) for k in _shown(again, times)]
    gap = np.full((PANEL[1], GAP, 3), 255, dtype=np.uint8)
    return np.concatenate([part for picture in pictures for part in (gap, picture)][1:], axis=1)


def strip_caption(again: Rerun, times: Sequence[float] | None = None) -> str:
    """What is to be seen in a strip, as the report prints it below."""
    at = ", ".join(f"{again.moments[k].time:g}" for k in _shown(again, times))
    outcome = str(again.stored["outcome"]).replace("_", " ")
    story = story_of(again, events_of(again))
    return (
        f"{again.title}: {outcome}. At {at} s; blue line: the way of the hand, sphere: the tolerance about "
        f"the target, green when the hand is inside it in position and orientation. {story}\n"
    )


def _shown(again: Rerun, times: Sequence[float] | None) -> list[int]:
    """The moments next to `times` [s]; by default PANELS of them, evenly over the episode."""
    clock = np.array([moment.time for moment in again.moments])
    at = np.linspace(0.0, clock[-1], PANELS).tolist() if times is None else times
    return [int(np.abs(clock - time).argmin()) for time in at]


class Camera:
    """Stands still, where it sees the whole episode."""

    def __init__(self, again: Rerun, size: tuple[int, int], samples: int = 0) -> None:
        """`size` in pixels (width, height), `samples` a pixel against jagged edges.

        Raises: BenchError when this machine cannot draw.
        """
        self._again = again
        model = again.robot.model()
        model.vis.global_.offwidth, model.vis.global_.offheight = size
        quality = model.vis.quality  # is what a processor that draws spends its time on
        quality.offsamples, quality.numslices, quality.numstacks = samples, 16, 8
        self._skeleton = Skeleton(model)
        self._scene = mujoco.MjvScene(model, maxgeom=500)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0  # and draw shadows in stripes
        half = np.tan(np.deg2rad(model.vis.global_.fovy) / 2)  # [1] height at unit distance
        self._view = _view(again.moments, np.array([half * size[0] / size[1], half]))
        self._canvas = Canvas(model, *size)

    @cached_property
    def _events(self) -> list[Event]:
        """Found only where they are told: that places the robot at every moment."""
        return events_of(self._again)

    def __enter__(self) -> "Camera":
        return self

    def __exit__(self, *_: object) -> None:
        self._canvas.__exit__()

    def picture(self, k: int, title: str = "", told: int = 0, words: bool = True) -> Pixels:
        """The k-th moment and the way to it in pixels (height, width, 3), the last `told` events in words.

        Without words it is the scene alone.
        """
        moment, scene, skeleton = self._again.moments[k], self._scene, self._skeleton
        skeleton.place(moment)
        mujoco.mj_comPos(skeleton.model, skeleton.data)
        mujoco.mj_camlight(skeleton.model, skeleton.data)
        every = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(
            skeleton.model, skeleton.data, mujoco.MjvOption(), None, self._view, every, scene
        )
        add_bones(scene, skeleton.model, skeleton.data)
        self._add_target(moment)
        self._add_contacts(moment)
        past = self._again.moments[: k + 1]
        line = [m.ee_pos_w for m in past[:: -(-len(past) // TRAIL_PIECES)]] + [moment.ee_pos_w]
        for start, end in pairwise(line):
            add_connector(scene, mujoco.mjtGeom.mjGEOM_CAPSULE, 0.004, start, end, TRAIL)
        if not words:
            return np.ascontiguousarray(self._canvas.draw(scene))
        picture = _label(self._canvas.draw(scene), moment, title)
        return _with_time_line(picture, self._events, moment.time, told) if told else picture

    def _add_target(self, moment: Moment) -> None:
        success = self._again.protocol.success
        inside = moment.position_error < success.position and moment.orientation_error < success.orientation
        add_axes(self._scene, moment.target_pos_w, moment.target_rot_w)
        _add_ball(self._scene, moment.target_pos_w, success.position, INSIDE if inside else OUTSIDE)

    def _add_contacts(self, moment: Moment) -> None:
        arrow, scene = mujoco.mjtGeom.mjGEOM_ARROW, self._scene
        corners = self._skeleton.support(moment.foot_force_w)
        ring = np.column_stack([corners, np.full(len(corners), 0.003)])
        for start, end in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            add_connector(scene, mujoco.mjtGeom.mjGEOM_CAPSULE, 0.004, start, end, SUPPORT)
        _add_ball(scene, np.array([*moment.com_w[:2], 0.003]), 0.014, COM)
        for start, end in force_arrows(moment):
            add_connector(scene, arrow, 0.010, start, end, FORCE)
        if push := push_arrow(moment):
            add_connector(scene, arrow, 0.016, *push, PUSH)


def _view(moments: Sequence[Moment], half: NDArray[np.float64]) -> mujoco.MjvCamera:
    """From the front left and above, as near as everything that matters is in the picture.

    `half` (2,) is half the width and height of the picture at unit distance.
    """
    places = np.concatenate(
        [(moment.qpos[:3], moment.ee_pos_w, moment.target_pos_w) for moment in moments]
        + [moment.foot_pos_w for moment in moments]
    )
    camera = mujoco.MjvCamera()
    camera.lookat = (places.min(axis=0) + places.max(axis=0)) / 2
    camera.azimuth, camera.elevation = AZIMUTH, ELEVATION
    turn, tilt = np.deg2rad([AZIMUTH, ELEVATION])
    ahead = np.array([np.cos(turn) * np.cos(tilt), np.sin(turn) * np.cos(tilt), np.sin(tilt)])
    right = np.array([np.sin(turn), -np.cos(turn), 0.0])
    seen = (places - camera.lookat) @ np.column_stack([right, np.cross(right, ahead), ahead])
    camera.distance = float(((np.abs(seen[:, :2]) + MARGIN) / half - seen[:, 2:]).max())
    return camera


def _add_ball(scene: mujoco.MjvScene, pos_w: NDArray[np.float64], radius: float, colour) -> None:
    ball, rgba = scene.geoms[scene.ngeom], np.array(colour, dtype=np.float32)
    kind, size = mujoco.mjtGeom.mjGEOM_SPHERE.value, np.full(3, radius)
    mujoco.mjv_initGeom(ball, kind, size, pos_w, np.eye(3).ravel(), rgba)
    scene.ngeom += 1


def _label(pixels: Pixels, moment: Moment, title: str) -> Pixels:
    """Time and errors below, the title above."""
    from PIL import Image, ImageDraw

    picture = Image.fromarray(np.ascontiguousarray(pixels))
    draw = ImageDraw.Draw(picture)
    font = _font()
    errors = f"{moment.position_error * CM:.1f} cm  {moment.orientation_error * DEG:.0f}°"
    draw.text((10, picture.height - 24), f"{moment.time:.1f} s", INK, font)
    draw.text((picture.width - 10, picture.height - 24), errors, INK, font, anchor="ra")
    draw.text((10, 8), title, INK, font)
    return np.asarray(picture)


def _with_time_line(pixels: Pixels, events: Sequence[Event], now: float, told: int) -> Pixels:
    """All events as marks on a line, faults in red, and the last `told` until `now` [s] in words."""
    from PIL import Image, ImageDraw

    picture = Image.fromarray(pixels)
    draw = ImageDraw.Draw(picture)
    left, right, line = 10, picture.width - 10, picture.height - 34

    def place(time: float) -> float:
        return left + (right - left) * min(time / max(events[-1].time, 1e-9), 1.0)

    draw.line([(left, line), (right, line)], LINE, 2)
    draw.line([(left, line), (place(now), line)], INK, 2)
    for event in events:
        x = place(event.time)
        draw.line([(x, line - 5), (x, line + 5)], FAULT if event.wrong else INK, 3)
    for row, event in enumerate([event for event in events if event.time <= now + 1e-9][-told:][::-1]):
        y = line - 26 - 18 * row
        draw.text((left, y), f"{event.time:.1f} s  {event.text}", FAULT if event.wrong else INK, _font())
    return np.asarray(picture)


@cache
def _font() -> Any:
    """That of matplotlib, which is everywhere the same."""
    from matplotlib import get_data_path
    from PIL import ImageFont

    return ImageFont.truetype(str(Path(get_data_path(), "fonts/ttf/DejaVuSans.ttf")), 14)
