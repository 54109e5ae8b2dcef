"""Read an exported dataset with LeRobot's own loader and compare every number.

    python -m venv build/lerobot && build/lerobot/bin/pip install lerobot==0.4.4
    wbc-bench export-dataset nominal_v1/ik/replicate_0 --results results --episodes 0 1 2 3 -o build/set
    build/lerobot/bin/python .ci/read_lerobot.py build/set

It needs an environment of its own, since LeRobot cannot be installed beside PlaCo, and is outside `.ci/run`,
since that downloads gigabytes; the tests read the same format, with videos, by Rerun's loader. Where PyTorch
is one for CPUs alone, torchvision's compiled operators are missing; the two that its import looks for are
declared first, and nothing here uses them. Exit code 1 on a difference.
"""

import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import torch


def declare_operators() -> None:
    """What torchvision's import asks for where its own build of them cannot be loaded."""
    library = torch.library.Library("torchvision", "DEF")
    for name in ("nms", "qnms"):
        library.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    globals()["_kept"] = library  # declared as long as it lives


def main() -> int:
    """Compare; the number of differences decides the exit code."""
    folder = Path(sys.argv[1])
    if not torch.version.cuda:
        declare_operators()
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    loaded = LeRobotDataset(f"local/{folder.name}", root=folder)
    table = pq.read_table(folder / "data", partitioning=None).to_pydict()
    worst = 0.0
    for k in range(len(loaded)):
        frame = loaded[k]
        for name, column in table.items():
            apart = np.abs(np.asarray(frame[name], dtype=float) - np.asarray(column[k], dtype=float)).max()
            worst = float(np.fmax(worst, np.nan_to_num(apart, nan=np.inf)))
    ok = len(loaded) == len(table["index"]) and worst < 1e-6
    print(
        f"LeRobot {loaded.meta.info['codebase_version']}: {loaded.num_episodes} episodes, "
        f"{len(loaded)} frames at {loaded.fps} Hz, {len(table)} columns, largest difference {worst:.1e}: "
        f"{'equal' if ok else 'DIFFERENT'}"
    )
    return 0 if ok else 1


if __name__ == "__main__":
    sys.exit(main())
