"""The robot and what concerns its target as a viser scene; the live view and the replay draw the same one."""

import io
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from wbc_bench.episodes.protocol import Success
from wbc_bench.errors import BenchError, missing_extra
from wbc_bench.robot import Robot, Scene
from wbc_bench.rotations import wxyz_from_matrix
from wbc_bench.viewer.guard import Guard, accept_values_only, check_guarded, guarded
from wbc_bench.viewer.moment import Moment, Skeleton, force_arrows, push_arrow

Array = NDArray[np.float64]
Colour = tuple[int, int, int]

INSIDE, OUTSIDE = (36, 150, 90), (226, 128, 30)  # of the tolerance
HAND, TARGET = (40, 100, 200), OUTSIDE  # trails
GROUND, CELL = (244, 245, 247), (205, 210, 216)
LIGHT, FIELD_OF_VIEW = 1.6, 0.75  # [1], [rad]
SUPPORT, COM, FORCE, PUSH = (90, 170, 230), (24, 36, 64), (44, 150, 150), (210, 50, 110)
BONE_RADIUS, BONE = 0.014, (140, 148, 158)  # [m] rods between joints: the collision shapes leave gaps there
CHUNK = 5  # points in one piece of a trail
NEW_POINT = 0.004  # [m] a trail grows only where something moves
FACE = 6e-4  # [m] that a box is larger than the one before, three times in four
FLOOR = 0.002  # [m] above the ground, so that nothing flickers in it


@contextmanager
def serving(host: str = "127.0.0.1", port: int = 8080, guard: Guard | None = None) -> Iterator[Any]:
    """A viser server without a scene yet; on a port above, where the one asked for is taken.

    It answers only whom the guard lets through; without one it is for nobody but this process.

    Raises: BenchError when viser is missing, cannot listen or lets in everybody.
    """
    try:
        import viser
    except ImportError as error:
        raise BenchError(missing_extra("a page of the robot", "view", error)) from error
    with redirect_stdout(io.StringIO()):  # its banner, whatever `verbose` says
        try:
            with guarded(guard or Guard(remote=False)):
                server = viser.ViserServer(host=host, port=port, verbose=False)
        except OSError as error:
            raise BenchError(f"cannot listen on {host}, port {port}: {error}") from error
    try:
        check_guarded(host, server.get_port())
        accept_values_only(server)
        yield server
    finally:
        with redirect_stdout(io.StringIO()):
            server.stop()


class SceneView:
    """Draws moments of one robot; `success` says when the hand is at its target."""

    def __init__(self, server: Any, robot: Robot, success: Success, trail_chunks: int | None = None) -> None:
        """`trail_chunks` is the length of the trails in pieces of CHUNK points; None keeps all of it."""
        scene, self._success = server.scene, success
        self._robot = robot
        scene.set_up_direction("+z")
        # software renderers draw shadows and reflections slowly, and in stripes
        scene.configure_default_lights(enabled=True, cast_shadow=False)
        scene.configure_environment_map(None)
        scene.add_light_hemisphere("/light", ground_color=(190, 190, 190), intensity=LIGHT)
        camera = server.initial_camera
        camera.position, camera.look_at, camera.fov = (2.3, -2.2, 1.5), (0.15, 0.0, 0.68), FIELD_OF_VIEW
        scene.add_grid(
            "/ground",
            *(8.0, 8.0),
            **{"cell_size": 0.5, "cell_color": CELL, "section_size": 0.5, "section_color": CELL},
            **{"plane_color": GROUND, "plane_opacity": 1.0, "shadow_opacity": 0.0},
        )
        self._draw, self._bodies, self._parts = scene, {}, []
        self.furnish(None)
        self._target = scene.add_frame("/target", axes_length=0.16, axes_radius=0.006, origin_radius=0.0)
        radius = success.position
        self._tolerance = scene.add_icosphere("/target/tolerance", radius, OUTSIDE, opacity=0.3)
        self._hand = scene.add_frame("/hand", axes_length=0.09, axes_radius=0.004, origin_radius=0.0)
        fan = np.array([[0, k, k + 1] for k in range(1, 7)], dtype=np.uint32)  # eight corners at most
        flat = {"opacity": 0.45, "side": "double", "flat_shading": True}
        self._support = scene.add_mesh_simple(
            "/support", np.zeros((8, 3)), fan, color=SUPPORT, visible=False, **flat
        )
        self._com = scene.add_icosphere("/com", 0.018, COM)
        self._forces = [_add_arrow(scene, f"/force_{k}", FORCE, 0.008) for k in range(2)]
        self._push = [_add_arrow(scene, "/push", PUSH, 0.012)]
        self._trails = (
            _Trail(scene, "/trail_hand", HAND, trail_chunks),
            _Trail(scene, "/trail_target", TARGET, trail_chunks),
        )

    def furnish(self, surroundings: Scene | None) -> None:
        """Draw the robot in its surroundings from now on, or on bare ground."""
        for part in self._parts:
            part.remove()
        self.skeleton = Skeleton(self._robot.model(scene=surroundings))
        self._bodies, self._parts = _add_bodies(self._draw, self.skeleton.model)

    def clear(self) -> None:
        """Forget what was before."""
        for trail in self._trails:
            trail.clear()

    def show(self, moment: Moment) -> None:
        """Draw a moment, which is later than the one before or follows a `clear`."""
        self.skeleton.place(moment)
        data = self.skeleton.data
        for number, handle in self._bodies.items():
            handle.position, handle.wxyz = data.xpos[number], data.xquat[number]
        for handle, pos_w, rot_w in (
            (self._target, moment.target_pos_w, moment.target_rot_w),
            (self._hand, moment.ee_pos_w, moment.ee_rot_w),
        ):
            handle.position, handle.wxyz = pos_w, wxyz_from_matrix(rot_w)
        for trail, pos_w in zip(self._trails, (moment.ee_pos_w, moment.target_pos_w), strict=True):
            trail.add(pos_w)
        inside = (
            moment.position_error < self._success.position
            and moment.orientation_error < self._success.orientation
        )
        self._tolerance.color = INSIDE if inside else OUTSIDE
        self._com.position = (*moment.com_w[:2], FLOOR)
        self._show_contacts(moment)

    def _show_contacts(self, moment: Moment) -> None:
        corners = self.skeleton.support(moment.foot_force_w)
        self._support.visible = len(corners) > 0
        if len(corners):
            ring = np.concatenate([corners, np.repeat(corners[-1:], 8 - len(corners), axis=0)])
            self._support.vertices = np.column_stack([ring, np.full(8, FLOOR)]).astype(np.float32)
        push = push_arrow(moment)
        _place_arrows(self._forces, force_arrows(moment))
        _place_arrows(self._push, [push] if push else [])


class _Trail:
    """A line in pieces, each of them sent once: what has been drawn is not sent again with every point."""

    def __init__(self, scene: Any, name: str, colour: Colour, chunks: int | None) -> None:
        self._scene, self._name, self._colour, self._chunks = scene, name, colour, chunks
        self._handles: list[Any] = []
        self._points: list[Array] = []
        self._number = 0

    def add(self, pos_w: Array) -> None:
        if self._points and np.linalg.norm(pos_w - self._points[-1]) < NEW_POINT:
            return
        self._points.append(pos_w.copy())
        if len(self._points) <= CHUNK:
            return
        points = np.array(list(pairwise(self._points)), dtype=np.float32)
        self._points = self._points[-1:]
        name = f"{self._name}/{self._number:06d}"
        self._handles.append(self._scene.add_line_segments(name, points, self._colour, thickness=0.006))
        self._number += 1
        if self._chunks is not None and len(self._handles) > self._chunks:
            self._handles.pop(0).remove()

    def clear(self) -> None:
        for handle in self._handles:
            handle.remove()
        self._handles, self._points = [], []


def _add_bodies(scene: Any, model: mujoco.MjModel) -> tuple[dict[int, Any], list[Any]]:
    """Body number -> the frame that its shapes move with; and everything that was added."""
    bodies, parts = {}, []
    for body in range(1, model.nbody):
        name = f"/body/{model.body(body).name}"
        bodies[body] = scene.add_frame(name, show_axes=False)
        for geom in np.flatnonzero(model.geom_bodyid == body):
            parts.append(_add_geom(scene, f"{name}/{model.geom(geom).name}", model, geom))
    for child in range(2, model.nbody):
        parent, offset = model.body_parentid[child], model.body_pos[child]
        length = float(np.linalg.norm(offset))
        if parent == 0 or length < BONE_RADIUS:
            continue
        quat = np.zeros(4)
        mujoco.mju_quatZ2Vec(quat, offset)
        name = f"/body/{model.body(parent).name}/to_{model.body(child).name}"
        parts.append(_add_round(scene, name, length, BONE_RADIUS, True, BONE, position=offset / 2, wxyz=quat))
    return bodies, [*parts, *bodies.values()]


def _add_geom(scene: Any, name: str, model: mujoco.MjModel, geom: int) -> Any:
    kind, size = model.geom_type[geom], model.geom_size[geom]
    colour = tuple(int(255 * c) for c in model.geom_rgba[geom, :3])
    pose = {"position": model.geom_pos[geom], "wxyz": model.geom_quat[geom]}
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        # boxes that share a face would flicker there
        return scene.add_box(name, colour, tuple(2 * size + FACE * (geom % 4)), **pose)
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return scene.add_icosphere(name, float(size[0]), colour, subdivisions=1, **pose)
    round_ends = kind == mujoco.mjtGeom.mjGEOM_CAPSULE
    return _add_round(scene, name, 2 * float(size[1]), float(size[0]), round_ends, colour, **pose)


def _add_round(
    scene: Any, name: str, length: float, radius: float, round_ends: bool, colour: Any, **pose: Any
) -> Any:
    """A capsule or cylinder along z."""
    from trimesh import creation

    if round_ends:
        mesh = creation.capsule(height=length, radius=radius, count=[20, 10])
        return scene.add_mesh_simple(name, mesh.vertices, mesh.faces, color=colour, **pose)
    return scene.add_cylinder(name, radius, length, colour, **pose)


def _add_arrow(scene: Any, name: str, colour: Colour, radius: float) -> Any:
    sizes = {"shaft_radius": radius, "head_radius": 2.2 * radius, "head_length": 5 * radius}
    return scene.add_arrows(name, np.zeros((1, 2, 3)), colour, visible=False, **sizes)


def _place_arrows(handles: list[Any], arrows: list[tuple[Array, Array]]) -> None:
    for k, handle in enumerate(handles):
        handle.visible = k < len(arrows)
        if handle.visible:
            handle.points = np.array([arrows[k]], dtype=np.float32)
