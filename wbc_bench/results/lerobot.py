"""Layout of a LeRobot dataset, version 3: names of files and features, and how one is written.

Source: huggingface/lerobot@7427f31 src/lerobot/datasets (dataset_metadata.py, utils.py, feature_utils.py);
huggingface.co/docs/lerobot/lerobot-dataset-v3. Their library needs versions of packages beside which placo
cannot be installed, so the files are written by pyarrow.
"""

import io
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from wbc_bench.errors import StoreError
from wbc_bench.files import scratch_folder, write_atomic

VERSION = "v3.0"
INFO, STATS, TASKS = "meta/info.json", "meta/stats.json", "meta/tasks.parquet"
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
DATA, EPISODES = f"data/{FILE}.parquet", f"meta/episodes/{FILE}.parquet"
VIDEO = "videos/{video_key}/" + f"{FILE}.mp4"
POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")  # names of a pose: [m], unit quaternion
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
MAX_FRAMES = 1_000_000  # of a dataset, which is one file of data
INDICES = {  # features that every dataset has, of shape (1,)
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}


class Episode(NamedTuple):
    """T frames."""

    task: str  # in plain language
    features: Mapping[str, NDArray[np.float64]]  # name -> (T, D)
    about: Mapping[str, str | int | float | bool]  # columns of the table of episodes


Statistics = dict[str, Any]  # name of a statistic -> a number for each number of the feature


class Video(NamedTuple):
    """A picture for every frame of all episodes, one after another."""

    name: str  # of the feature
    file: Path  # MP4, H.264, which becomes part of the dataset
    size: tuple[int, int]  # [px] width, height
    statistics: Sequence[Statistics]  # of each episode, then of all; see `picture_statistics`


def write_dataset(
    folder: Path,
    episodes: Sequence[Episode],
    names: Mapping[str, Sequence[str]],
    rate: int,
    robot: str,
    about: Mapping[str, Any],
    video: Video | None = None,
) -> None:
    """Write a dataset into a folder that does not exist yet, whole or not at all; equal input, equal bytes.

    Args:
        folder: Where to.
        episodes: All with the same features, and the same keys of `about`.
        names: Feature -> name of each of its numbers.
        rate: [Hz] of the frames.
        robot: Its name.
        about: What else the file `meta/info.json` says, under the key `wbc_bench`.
        video: Pictures of the frames, if there are any.

    Raises:
        StoreError: The folder is there, cannot be written, or there are no or too many frames.
    """
    lengths = [len(next(iter(episode.features.values()))) for episode in episodes]
    if not 0 < sum(lengths) <= MAX_FRAMES or 0 in lengths:
        raise StoreError(f"{sum(lengths)} frames to write to '{folder}', valid: 1 to {MAX_FRAMES}, some each")
    if folder.exists() or folder.is_symlink():
        raise StoreError(f"'{folder}' exists, valid: a folder that does not exist yet")
    starts = np.concatenate([[0], np.cumsum(lengths)])
    tasks = list(dict.fromkeys(episode.task for episode in episodes))
    columns = _frames(episodes, lengths, tasks, names, rate)
    info = {
        "codebase_version": VERSION,
        "robot_type": robot,
        "total_episodes": len(episodes),
        "total_frames": int(starts[-1]),
        "total_tasks": len(tasks),
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": rate,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": DATA,
        "video_path": VIDEO if video else None,
        "features": {
            **{n: {"dtype": "float32", "shape": [len(of)], "names": list(of)} for n, of in names.items()},
            **{name: {"dtype": kind, "shape": [1], "names": None} for name, kind in INDICES.items()},
            **({video.name: _video_feature(video, rate)} if video else {}),
        },
        "wbc_bench": dict(about),
    }
    rows = []
    for k, episode in enumerate(episodes):
        part = {name: value[starts[k] : starts[k + 1]] for name, value in columns.items()}
        statistics = _statistics(part)
        if video:
            statistics[video.name] = video.statistics[k]
        rows.append(
            {
                "episode_index": k,
                "tasks": [episode.task],
                "length": lengths[k],
                "data/chunk_index": 0,
                "data/file_index": 0,
                "dataset_from_index": int(starts[k]),
                "dataset_to_index": int(starts[k + 1]),
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
                **episode.about,
                **(_video_columns(video, starts[k] / rate, starts[k + 1] / rate) if video else {}),
                **{
                    f"stats/{name}/{what}": number
                    for name, stats in statistics.items()
                    for what, number in stats.items()
                },
            }
        )
    first = {"chunk_index": 0, "file_index": 0}
    statistics = _statistics(columns) | ({video.name: video.statistics[-1]} if video else {})
    files = {
        INFO: msgspec.json.format(msgspec.json.encode(info)),
        STATS: msgspec.json.format(msgspec.json.encode(statistics)),
        TASKS: _task_table(tasks),
        EPISODES.format(**first): _parquet(pa.Table.from_pylist(rows)),
        DATA.format(**first): _parquet(_table(columns)),
    }
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with scratch_folder(folder.parent) as scratch:
            for name, data in files.items():
                (scratch / name).parent.mkdir(parents=True, exist_ok=True)
                write_atomic(scratch / name, data)
            if video:
                place = scratch / VIDEO.format(**first, video_key=video.name)
                place.parent.mkdir(parents=True)
                shutil.copyfile(video.file, place)
            scratch.rename(folder)
    except OSError as error:
        raise StoreError(f"cannot write '{folder}': {error.strerror}") from error


def _video_feature(video: Video, rate: int) -> dict[str, Any]:
    width, height = video.size
    kind = {"video.height": height, "video.width": width, "video.codec": "h264", "video.pix_fmt": "yuv420p"}
    kind |= {"video.is_depth_map": False, "video.fps": rate, "video.channels": 3, "has_audio": False}
    names = ["height", "width", "channels"]
    return {"dtype": "video", "shape": [height, width, 3], "names": names, "info": kind}


def _video_columns(video: Video, start: float, end: float) -> dict[str, int | float]:
    """Where the pictures of an episode are: in which file, from when to when [s]."""
    of = f"videos/{video.name}"
    place = {f"{of}/chunk_index": 0, f"{of}/file_index": 0}
    return place | {f"{of}/from_timestamp": float(start), f"{of}/to_timestamp": float(end)}


def picture_statistics(pictures: NDArray[np.uint8]) -> Statistics:
    """Statistics of pictures (N, H, W, 3) as their loader takes them: a number in [0, 1] for each colour."""
    values = pictures.reshape(-1, 3) / 255.0
    stats = {"min": values.min(axis=0), "max": values.max(axis=0), "mean": values.mean(axis=0)}
    stats |= {"std": values.std(axis=0)}
    stats |= {what: np.quantile(values, part, axis=0) for what, part in QUANTILES.items()}
    shaped = {what: number.reshape(3, 1, 1).tolist() for what, number in stats.items()}
    return shaped | {"count": [len(pictures)]}


def _frames(
    episodes: Sequence[Episode],
    lengths: Sequence[int],
    tasks: Sequence[str],
    names: Mapping[str, Sequence[str]],
    rate: int,
) -> dict[str, NDArray[Any]]:
    """Columns of all frames: (F, D) of a feature, (F,) of an index."""
    frame = np.concatenate([np.arange(length) for length in lengths])
    columns: dict[str, NDArray[Any]] = {
        name: np.concatenate([episode.features[name] for episode in episodes]).astype(np.float32)
        for name in names
    }
    columns["timestamp"] = (frame / rate).astype(np.float32)
    columns["frame_index"] = frame
    columns["episode_index"] = np.repeat(np.arange(len(episodes)), lengths)
    columns["index"] = np.arange(len(frame))
    columns["task_index"] = np.repeat([tasks.index(episode.task) for episode in episodes], lengths)
    return columns


def _table(columns: Mapping[str, NDArray[Any]]) -> pa.Table:
    """A vector of numbers is a list of fixed size, as their loader declares it."""
    return pa.table(
        {
            name: pa.array(value)
            if value.ndim == 1
            else pa.FixedSizeListArray.from_arrays(pa.array(value.ravel()), value.shape[1])
            for name, value in columns.items()
        }
    )


def _statistics(columns: Mapping[str, NDArray[Any]]) -> dict[str, dict[str, list[float] | list[int]]]:
    """Of every column over its frames, a list of one number for an index."""
    found = {}
    for name, value in columns.items():
        values = value.reshape(len(value), -1).astype(np.float64)
        stats = {"min": values.min(axis=0), "max": values.max(axis=0), "mean": values.mean(axis=0)}
        stats |= {"std": values.std(axis=0)}
        stats |= {what: np.quantile(values, part, axis=0) for what, part in QUANTILES.items()}
        found[name] = {what: number.tolist() for what, number in stats.items()} | {"count": [len(values)]}
    return found


def _task_table(tasks: Sequence[str]) -> bytes:
    """The tasks, which are the index of a pandas frame there."""
    import pandas as pd

    frame = pd.DataFrame({"task_index": np.arange(len(tasks))}, index=pd.Index(list(tasks), dtype=object))
    return _parquet(pa.Table.from_pandas(frame))


def _parquet(table: pa.Table) -> bytes:
    sink = io.BytesIO()
    pq.write_table(table, sink, compression="snappy")
    return sink.getvalue()
