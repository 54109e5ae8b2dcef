"""An episode as a recording of Rerun, FILE.rrd: robot, target, forces, joints and errors over time.

The package is called `rerun`, as is running an episode again; here it is `rr`, as in its own manuals.
"""

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from wbc_bench.errors import BenchError, missing_extra
from wbc_bench.files import write_atomic
from wbc_bench.results.formatting import CM, DEG
from wbc_bench.robot import JOINT_NAMES
from wbc_bench.rotations import matrix_from_wxyz, wxyz_from_matrix
from wbc_bench.viewer.moment import METRES_A_NEWTON, Skeleton
from wbc_bench.viewer.picture import BONE_RADIUS
from wbc_bench.viewer.rerun import Rerun
from wbc_bench.viewer.time_line import events_of, story_of

Array = NDArray[np.float64]
CLOCK = "time"  # name of the axis of time, since the start of the episode
FORCE, WAY, TARGET, BONES = (43, 150, 150), (40, 100, 200), (230, 128, 30), (140, 148, 158)  # RGB


def write_rrd(again: Rerun, path: Path) -> None:
    """Write an episode that has been run again as a recording of Rerun, whole or not at all.

    Lengths are metres, angles of joints radians, forces newtons, all in the world; errors are centimetres and
    degrees. Two files of one episode hold the same values but are not the same bytes: Rerun numbers what it
    writes by the clock.

    Raises: BenchError without rerun-sdk; StoreError when it cannot be written.
    """
    try:
        import rerun as rr
        from rerun import blueprint
    except ImportError as error:
        raise BenchError(missing_extra("a recording of Rerun", "rerun", error)) from error
    stream = rr.RecordingStream("wbc-bench", recording_id=again.title)
    memory = stream.memory_recording()  # its own writer of files says in many lines that a disk is full
    stream.set_log_time_enabled(False)
    _add_words(rr, stream, again)
    _add_robot(rr, stream, again)
    _add_hand(rr, stream, again)
    _add_numbers(rr, stream, again)
    stream.send_blueprint(_layout(blueprint))
    write_atomic(path, memory.drain_as_bytes())


def _layout(blueprint: Any) -> Any:
    """The scene on the left; curves, events and words on the right."""
    scene = blueprint.Spatial3DView(
        origin="/", contents=["robot/**", "target/**", "hand/**", "force/**", "way_of_the_hand"], name="scene"
    )
    curves = [
        blueprint.TimeSeriesView(origin=name, name=title)
        for name, title in (
            ("error", "errors"),
            ("load", "forces of the ground (N)"),
            ("joint", "joints (rad)"),
        )
    ]
    words = blueprint.Horizontal(
        blueprint.TextLogView(origin="events", name="events"),
        blueprint.TextDocumentView(origin="about", name="episode"),
    )
    right = blueprint.Vertical(*curves, words)
    return blueprint.Blueprint(blueprint.Horizontal(scene, right, column_shares=[3, 2]), collapse_panels=True)


def _add_words(rr: Any, stream: Any, again: Rerun) -> None:
    """Which episode, what it drew, how it ended, and the time line."""
    about = {
        "outcome": str(again.stored["outcome"]),
        "stratum": str(again.stored["stratum"]),
        "verdict": again.verdict,
    }
    events = events_of(again)
    text = f"{again.title}\n\n{story_of(again, events)}\n\n{again.verdict}"
    stream.log("about", rr.TextDocument(text), static=True)
    stream.log("about", rr.AnyValues(**about), static=True)
    for event in events:
        stream.set_time(CLOCK, duration=event.time)
        level = rr.TextLogLevel.WARN if event.wrong else rr.TextLogLevel.INFO
        stream.log("events", rr.TextLog(event.text, level=level))
    stream.reset_time()


def _add_robot(rr: Any, stream: Any, again: Rerun) -> None:
    """A frame for each body, and its collision shapes and the rods between joints in it."""
    model = again.robot.model()
    skeleton = Skeleton(model)
    places, turns = (np.empty((len(again.moments), model.nbody, width)) for width in (3, 4))
    for k, moment in enumerate(again.moments):
        skeleton.place(moment)
        places[k], turns[k] = skeleton.data.xpos, skeleton.data.xquat
    for body in range(1, model.nbody):
        name = f"robot/{model.body(body).name}"
        quaternion = np.roll(turns[:, body], -1, axis=1)  # xyzw there
        stream.send_columns(
            name,
            [_clock(rr, again)],
            rr.Transform3D.columns(translation=places[:, body], quaternion=quaternion),
        )
        rods = [
            [np.zeros(3), model.body_pos[child]]
            for child in range(2, model.nbody)
            if model.body_parentid[child] == body
        ]
        if rods:
            stream.log(f"{name}/rods", rr.LineStrips3D(rods, radii=BONE_RADIUS, colors=BONES), static=True)
    for geom in range(model.ngeom):
        if model.geom_bodyid[geom]:
            owner = model.body(model.geom_bodyid[geom]).name
            stream.log(f"robot/{owner}/{model.geom(geom).name}", _shape(rr, model, geom), static=True)


def _shape(rr: Any, model: mujoco.MjModel, geom: int) -> Any:
    """A collision shape in the frame of its body."""
    size, centre = model.geom_size[geom], model.geom_pos[geom]
    quaternion = np.roll(model.geom_quat[geom], -1)
    colour = (255 * model.geom_rgba[geom][:3]).astype(np.uint8)
    look = {"colors": [colour], "quaternions": [quaternion], "fill_mode": "solid"}
    match mujoco.mjtGeom(model.geom_type[geom]):
        case mujoco.mjtGeom.mjGEOM_BOX:
            return rr.Boxes3D(half_sizes=[size], centers=[centre], **look)
        case mujoco.mjtGeom.mjGEOM_SPHERE:
            return rr.Ellipsoids3D(half_sizes=[np.full(3, size[0])], centers=[centre], **look)
        case mujoco.mjtGeom.mjGEOM_CYLINDER:
            return rr.Cylinders3D(lengths=[2 * size[1]], radii=[size[0]], centers=[centre], **look)
        case mujoco.mjtGeom.mjGEOM_CAPSULE:  # theirs begins at the centre of one of its ends
            end = centre - size[1] * matrix_from_wxyz(model.geom_quat[geom])[:, 2]
            return rr.Capsules3D(lengths=[2 * size[1]], radii=[size[0]], translations=[end], **look)
        case other:
            raise ValueError(f"shape {other} of {model.geom(geom).name} has no counterpart")


def _add_hand(rr: Any, stream: Any, again: Rerun) -> None:
    """Poses of target and hand, tolerance and way, and the forces of the ground on the soles."""
    moments = again.moments
    for name, poses in (
        ("target", [(m.target_pos_w, m.target_rot_w) for m in moments]),
        ("hand", [(m.ee_pos_w, m.ee_rot_w) for m in moments]),
    ):
        quaternion = np.array([np.roll(wxyz_from_matrix(rot), -1) for _, rot in poses])
        place = np.array([pos for pos, _ in poses])
        stream.send_columns(
            name, [_clock(rr, again)], rr.Transform3D.columns(translation=place, quaternion=quaternion)
        )
        stream.log(name, rr.TransformAxes3D(axis_length=0.16), static=True)
    radius = np.full(3, again.protocol.success.position)
    stream.log("target/tolerance", rr.Ellipsoids3D(half_sizes=[radius], colors=TARGET), static=True)
    way = np.array([moment.ee_pos_w for moment in moments])
    stream.log("way_of_the_hand", rr.LineStrips3D([way], radii=0.003, colors=WAY), static=True)
    for side, name in enumerate(("left", "right")):
        force = np.array([moment.foot_force_w[side] for moment in moments])
        sole = np.array([moment.foot_pos_w[side] for moment in moments])
        arrows = rr.Arrows3D.columns(vectors=force * METRES_A_NEWTON, origins=sole)
        stream.send_columns(f"force/{name}", [_clock(rr, again)], arrows)
        stream.log(f"force/{name}", rr.Arrows3D.from_fields(colors=[FORCE], radii=[0.01]), static=True)


def _add_numbers(rr: Any, stream: Any, again: Rerun) -> None:
    """Curves: errors, joints and vertical forces."""
    moments = again.moments
    curves = {
        "error/position_cm": [moment.position_error * CM for moment in moments],
        "error/orientation_deg": [moment.orientation_error * DEG for moment in moments],
        "load/left_n": [moment.foot_force_w[0, 2] for moment in moments],
        "load/right_n": [moment.foot_force_w[1, 2] for moment in moments],
    }
    q = np.array([moment.qpos[7:21] for moment in moments])
    curves |= {f"joint/{name}": q[:, k] for k, name in enumerate(JOINT_NAMES)}
    for name, values in curves.items():
        stream.send_columns(name, [_clock(rr, again)], rr.Scalars.columns(scalars=values))


def _clock(rr: Any, again: Rerun) -> Any:
    """When the moments were, [s]."""
    return rr.TimeColumn(CLOCK, duration=[moment.time for moment in again.moments])
