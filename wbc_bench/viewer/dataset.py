"""Episodes of a stored run as a LeRobot dataset: `wbc-bench export-dataset`."""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from wbc_bench.errors import StoreError
from wbc_bench.results.lerobot import POSE, Episode, Video, picture_statistics, write_dataset
from wbc_bench.results.store import Run
from wbc_bench.robot import JOINT_NAMES
from wbc_bench.rotations import wxyz_from_matrix
from wbc_bench.viewer.film import SIZE_OF_DATA, write_frames_of
from wbc_bench.viewer.rerun import Rerun, ShowProgress, rerun

TASK = "Move the end effector to the target pose and hold it there."
NAMES = {  # feature -> names of its numbers, all in the world
    "action": POSE,  # the target of the end effector [m], unit quaternion
    "observation.state": JOINT_NAMES,  # [rad]
    "observation.ee_pose": POSE,
    "observation.base_pose": POSE,
    "observation.foot_force": tuple(f"{foot}_{axis}" for foot in ("left", "right") for axis in "xyz"),  # [N]
}


def write_episodes(
    run: Run,
    numbers: Sequence[int],
    folder: Path,
    protocol_name: str | None = None,
    progress: ShowProgress | None = None,
    controller: str | None = None,
    video: bool = False,
) -> list[Rerun]:
    """Run episodes of a stored run again and write them as a dataset, one frame per control period.

    With `video`, each frame has a picture of the scene, from where the whole episode is seen.

    Raises: see `rerun` and `write_dataset`; StoreError, the control rate is no whole number.
    """
    seen = [rerun(run, number, protocol_name, progress, controller) for number in numbers]
    protocol = seen[0].protocol
    rate = 1 / protocol.control_period  # [Hz]
    if abs(rate - round(rate)) > 1e-9 * rate:
        raise StoreError(
            f"'{run.path}' has a control rate of {rate:g} Hz, valid: whole numbers for a dataset"
        )
    about = {"protocol": run.record.protocol, "controller": run.record.controller, "frame": "world"}
    about |= {"tool": "ee", "quaternion": "qw, qx, qy, qz"}
    episodes, robot = [_episode(again) for again in seen], f"tron1_l5_{seen[0].robot.config.variant}"
    with TemporaryDirectory() as scratch:
        filmed = _film(seen, Path(scratch, "frames.mp4"), round(rate), progress) if video else None
        write_dataset(folder, episodes, NAMES, round(rate), robot, about, filmed)
    return seen


def _frames(again: Rerun) -> list[int]:
    """Which moments are frames: a controller that is faster than the protocol has several in a frame."""
    period = again.protocol.control_period
    clock = [moment.time / period for moment in again.moments]
    return [k for k, time in enumerate(clock) if abs(time - round(time)) < 1e-6]


def _film(seen: Sequence[Rerun], path: Path, rate: int, progress: ShowProgress | None) -> Video:
    pictures = write_frames_of([[(again, k) for k in _frames(again)] for again in seen], path, rate, progress)
    statistics = [picture_statistics(some) for some in (*pictures, np.concatenate(pictures))]
    return Video("observation.images.scene", path, SIZE_OF_DATA, statistics)


def _episode(again: Rerun) -> Episode:
    moments = [again.moments[k] for k in _frames(again)]
    target, hand = (
        np.array([[*pos, *wxyz_from_matrix(rot)] for pos, rot in pairs])
        for pairs in (
            [(m.target_pos_w, m.target_rot_w) for m in moments],
            [(m.ee_pos_w, m.ee_rot_w) for m in moments],
        )
    )
    qpos = np.array([m.qpos for m in moments])
    features = {
        "action": target,
        "observation.state": qpos[:, 7:21],
        "observation.ee_pose": hand,
        "observation.base_pose": qpos[:, :7],
        "observation.foot_force": np.array([m.foot_force_w.ravel() for m in moments]),
    }
    stored = again.stored
    about = {"outcome": str(stored["outcome"]), "success": bool(stored["success"])}
    about |= {"stratum": str(stored["stratum"]), "episode": again.episode}
    return Episode(TASK, features, about | {"verified": not again.differences})
