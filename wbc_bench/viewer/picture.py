"""A picture of the robot, drawn without a window."""

import io
import os
import sys
import warnings
from pathlib import Path

import mujoco
import numpy as np
from matplotlib import image
from numpy.typing import NDArray

from wbc_bench.errors import BenchError
from wbc_bench.files import write_atomic
from wbc_bench.robot import Robot

Array = NDArray[np.float64]
BONE_RADIUS, BONE_COLOUR = 0.014, (0.55, 0.58, 0.62, 1.0)  # [m]
AXIS_LENGTH, AXIS_RADIUS = 0.16, 0.006  # [m] of the frame drawn at the end-effector
AXIS_COLOURS = ((0.84, 0.15, 0.16, 1.0), (0.17, 0.63, 0.17, 1.0), (0.12, 0.35, 0.78, 1.0))  # x, y, z


def render(robot: Robot, path: Path, q: Array | None = None, size: tuple[int, int] = (960, 720)) -> None:
    """Write a picture of the robot standing on the ground, `size` pixels (width, height).

    `q` are joint positions (14,) [rad], by default the default posture; the base is level.

    Raises:
        BenchError: this machine cannot draw without a window, or the file cannot be written.
    """
    width, height = size
    model = robot.model()
    model.vis.global_.offwidth, model.vis.global_.offheight = size
    data = mujoco.MjData(model)
    _stand(robot, model, data, robot.default_q if q is None else q)

    camera = mujoco.MjvCamera()
    low, high = _extent(model, data)
    camera.lookat = (low + high) / 2
    camera.azimuth, camera.elevation = 218.0, -17.0  # [deg] from the front left, from above
    camera.distance = 1.25 * float(np.linalg.norm(high - low))
    scene = mujoco.MjvScene(model, maxgeom=200)
    mujoco.mjv_updateScene(
        model, data, mujoco.MjvOption(), None, camera, mujoco.mjtCatBit.mjCAT_ALL.value, scene
    )
    add_bones(scene, model, data)
    add_axes(scene, data.site("tcp").xpos, data.site("tcp").xmat.reshape(3, 3))
    scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0  # software renderers draw them in stripes

    # no text in the file: equal pictures are equal bytes
    with Canvas(model, width, height) as canvas:
        write_png(canvas.draw(scene), path)


def write_png(pixels: NDArray[np.uint8], path: Path) -> None:
    """Write a picture (height, width, 3), whole or not at all. Raises: StoreError."""
    buffer = io.BytesIO()
    image.imsave(buffer, pixels, format="png", pil_kwargs={"pnginfo": None})
    write_atomic(path, buffer.getvalue())


class Canvas:
    """Draws scenes of one model without a window, by EGL where there is no display and no MUJOCO_GL."""

    def __init__(self, model: mujoco.MjModel, width: int, height: int) -> None:
        """Raises: BenchError when this machine cannot draw without a window."""
        chosen = any(os.environ.get(name) for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"))
        try:
            if sys.platform == "linux" and not chosen:
                # MuJoCo chose its own backend when it was imported, too early to ask for this one
                from mujoco.egl import GLContext
            else:
                from mujoco.gl_context import GLContext
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # GLFW warns of the missing display, and goes on
                self._window = GLContext(width, height)
                self._window.make_current()
                self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        except Exception as error:  # each backend fails in its own way: missing library, driver, display
            raise BenchError(
                f"no OpenGL on this machine to draw with ({error}): install EGL or OSMesa and set MUJOCO_GL "
                "to egl or osmesa"
            ) from error
        self._viewport = mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)

    def __enter__(self) -> "Canvas":
        return self

    def __exit__(self, *_: object) -> None:
        self._context.free()
        self._window.free()

    def draw(self, scene: mujoco.MjvScene) -> NDArray[np.uint8]:
        """The scene in pixels (height, width, 3)."""
        self._window.make_current()  # another canvas may have drawn since
        pixels = np.empty((self._viewport.height, self._viewport.width, 3), dtype=np.uint8)
        mujoco.mjr_render(self._viewport, scene, self._context)
        mujoco.mjr_readPixels(pixels, None, self._viewport, self._context)
        return pixels[::-1]  # OpenGL counts rows from below


def _stand(robot: Robot, model: mujoco.MjModel, data: mujoco.MjData, q: Array) -> None:
    """Place the level base so that the lower sole touches the ground."""
    data.qpos[:] = [0, 0, 0, 1, 0, 0, 0, *q]
    mujoco.mj_kinematics(model, data)
    feet = [i for i in range(model.ngeom) if model.geom(i).name.startswith("foot_")]
    spheres = [i for i in feet if model.geom_type[i] == mujoco.mjtGeom.mjGEOM_SPHERE]
    data.qpos[2] = -(data.geom_xpos[spheres, 2] - model.geom_size[spheres, 0]).min()
    mujoco.mj_forward(model, data)


def _extent(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[Array, Array]:
    """Corners (3,) [m] of a box around the robot in the world."""
    parts = np.flatnonzero(model.geom_bodyid > 0)
    centre, radius = data.geom_xpos[parts], model.geom_rbound[parts, None]
    return (centre - radius).min(axis=0), (centre + radius).max(axis=0)


def add_bones(scene: mujoco.MjvScene, model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Rods between joints: the collision shapes leave gaps there."""
    for child in range(2, model.nbody):
        parent = model.body_parentid[child]
        kind = mujoco.mjtGeom.mjGEOM_CAPSULE
        add_connector(scene, kind, BONE_RADIUS, data.xpos[parent], data.xpos[child], BONE_COLOUR)


def add_axes(scene: mujoco.MjvScene, origin: Array, rot_w: Array) -> None:
    """A frame (3,) [m], (3, 3) as three arrows."""
    for axis, colour in zip(rot_w.T, AXIS_COLOURS, strict=True):
        kind = mujoco.mjtGeom.mjGEOM_ARROW
        add_connector(scene, kind, AXIS_RADIUS, origin, origin + AXIS_LENGTH * axis, colour)


def add_connector(
    scene: mujoco.MjvScene, kind: mujoco.mjtGeom, radius: float, start: Array, end: Array, colour
) -> None:
    """A shape of a radius [m] between two points (3,) [m], its colour RGBA."""
    geom = scene.geoms[scene.ngeom]
    rgba = np.array(colour, dtype=np.float32)
    mujoco.mjv_initGeom(geom, kind.value, np.zeros(3), np.zeros(3), np.zeros(9), rgba)
    mujoco.mjv_connector(geom, kind.value, radius, start, end)
    scene.ngeom += 1
