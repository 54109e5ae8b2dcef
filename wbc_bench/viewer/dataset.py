"""Episodes of a stored run as a LeRobot dataset: `wbc-bench export-dataset`."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from wbc_bench.errors import StoreError
from wbc_bench.results.lerobot import POSE, Episode, write_dataset
from wbc_bench.results.store import Run
from wbc_bench.robot import JOINT_NAMES
from wbc_bench.rotations import wxyz_from_matrix
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
) -> list[Rerun]:
    """Run episodes of a stored run again and write them as a dataset, one frame per control period.

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
    episodes = [_episode(again) for again in seen]
    write_dataset(folder, episodes, NAMES, round(rate), f"tron1_l5_{seen[0].robot.config.variant}", about)
    return seen


def _episode(again: Rerun) -> Episode:
    """One episode; a controller that is faster than the protocol has several moments in a frame."""
    period = again.protocol.control_period
    moments = [m for m in again.moments if abs(m.time / period - round(m.time / period)) < 1e-6]
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
