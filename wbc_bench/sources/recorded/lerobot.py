"""Poses of a LeRobot dataset of version 3: a folder with `meta/info.json`.

Names of files are those of the layout, never those that a dataset gives itself.
"""

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from wbc_bench.errors import SourceError, UnknownNameError
from wbc_bench.readers import decode_parquet, is_file, read_bytes, read_json, reading
from wbc_bench.results.lerobot import DATA, EPISODES, INFO
from wbc_bench.sources.recorded.columns import VALID, poses_of, rotation_of
from wbc_bench.sources.recorded.recording import MAX_ROWS, Facts, Poses

if TYPE_CHECKING:
    import pyarrow as pa

Array = NDArray[np.float64]
KIND = "LeRobot dataset"
MAX_FILES = 100  # of episodes' descriptions that are looked through
WHERE: tuple[str, ...] = ("episode_index", "data/chunk_index", "data/file_index", "length")


class _Feature(msgspec.Struct):
    dtype: str
    shape: list[int]
    names: Any = None  # a list, or {"axes": list}, or none

    @property
    def columns(self) -> list[str]:
        """Names of its numbers; none where they have none."""
        names = self.names
        if isinstance(names, dict) and len(names) == 1:
            names = next(iter(names.values()))
        texts = isinstance(names, list) and all(isinstance(name, str) for name in names)
        whole = texts and len(self.shape) == 1 and self.shape[0] == len(names) == len(set(names))
        return list(names) if whole else []


class _Info(msgspec.Struct):
    codebase_version: str
    fps: Annotated[float, msgspec.Meta(ge=0.1, le=10_000)]
    total_episodes: Annotated[int, msgspec.Meta(ge=1)]
    features: dict[str, _Feature]
    wbc_bench: dict[str, Any] = {}


def is_dataset(name: str) -> bool:
    """Whether a folder holds a dataset."""
    return is_file(Path(name) / INFO)


def read_lerobot(folder: Path, episode: int, feature: str | None) -> Poses:
    """The poses of an episode.

    Args:
        folder: Of the dataset.
        episode: Its index.
        feature: Name of the feature that holds the pose; None for `action`, or for the only one that does.

    Raises:
        UnknownNameError: There is no such feature.
        SourceError: Another version; a file is missing or damaged; no such episode; no pose.
    """
    info, where = read_json(folder / INFO, _Info, KIND, SourceError), f"{KIND} '{folder}'"
    if not info.codebase_version.startswith("v3."):
        raise SourceError(f"{where} is of version '{info.codebase_version[:20]}', valid: v3.0")
    name = _feature(info, feature, where)
    if not episode < info.total_episodes:
        raise SourceError(f"{where} has no episode {episode}, valid: 0 to {info.total_episodes - 1}")
    place, length = _find(folder, episode, where)
    file = folder / DATA.format(**place)
    data = read_bytes(file, KIND, SourceError)
    table = decode_parquet(
        data, file, KIND, SourceError, {"episode_index": "int64"}, only=["episode_index", name]
    )
    with reading(KIND, file, "one of its features", SourceError):
        table = table.filter(np.asarray(table["episode_index"]) == episode)
        if len(table) != length or not 1 <= length <= MAX_ROWS:
            raise SourceError(f"{where} has {len(table)} frames of episode {episode}, valid: {length}")
        columns = _columns(table, name, info.features[name].columns, where)
    used = (*_used(info.features[name].columns),)
    pos, rot = poses_of({column: columns[column] for column in used}, f"{where}: {name}")
    said = {key: info.wbc_bench[key] for key in ("frame", "tool") if key in info.wbc_bench}
    with reading(KIND, folder / INFO, "", SourceError):
        facts = msgspec.convert({"rate": info.fps} | said, Facts)
    content = hashlib.sha256(data + name.encode() + msgspec.json.encode(info)).hexdigest()
    return Poses(pos, rot, None, facts, content)


def _used(names: list[str]) -> tuple[str, ...]:
    rotation = rotation_of(names)
    return ("x", "y", "z", *(rotation or ()))


def _feature(info: _Info, wanted: str | None, where: str) -> str:
    poses = [name for name, feature in info.features.items() if rotation_of(feature.columns)]
    if wanted is not None:
        if wanted not in info.features:
            raise UnknownNameError("feature", wanted, info.features, where)
        if wanted not in poses:
            names = info.features[wanted].columns
            raise SourceError(
                f"{where}: {wanted} has names {', '.join(names)[:300] or 'none'}, valid: {VALID}"
            )
        return wanted
    if "action" in poses:
        return "action"
    if len(poses) != 1:
        found = ", ".join(poses)[:300] or "none"
        raise SourceError(f"{where}: features with a pose: {found}, valid: one, or name it: feature=NAME")
    return poses[0]


def _find(folder: Path, episode: int, where: str) -> tuple[dict[str, int], int]:
    """Indices of the file that holds an episode, and its number of frames."""
    first = Path(EPISODES.format(chunk_index=0, file_index=0))
    files = sorted((folder / first).parents[1].glob("chunk-*/file-*.parquet"))
    if not files:
        raise SourceError(f"{where} has no {first}")
    for path in files[:MAX_FILES]:
        kinds = dict[str, str].fromkeys(WHERE, "int64")
        data = read_bytes(path, KIND, SourceError)
        table = decode_parquet(data, path, KIND, SourceError, kinds, only=list(WHERE))
        found = np.flatnonzero(np.asarray(table["episode_index"]) == episode)
        if len(found):
            row = table.slice(int(found[0]), 1).to_pylist()[0]
            place = {"chunk_index": row[WHERE[1]], "file_index": row[WHERE[2]]}
            if not all(0 <= index < 1_000_000 for index in place.values()):
                raise SourceError(f"{where}: episode {episode} is in file {place}, valid: 0 to 999999")
            return place, int(row["length"])
    raise SourceError(f"{where}: no file of {first.parents[1]} names episode {episode}")


def _columns(table: "pa.Table", name: str, names: list[str], where: str) -> dict[str, Array]:
    """The numbers of a feature of vectors, by their names."""
    import pyarrow as pa
    import pyarrow.compute as pc

    if name not in table.column_names:
        raise SourceError(f"{where} has no column {name} of data, though its {INFO} names it")
    column = table[name].combine_chunks()
    if column.null_count or not np.all(np.asarray(pc.list_value_length(column)) == len(names)):
        raise SourceError(f"{where}: {name} holds other than {len(names)} numbers in a frame")
    values = np.asarray(column.flatten().cast(pa.float64())).reshape(-1, len(names))
    return dict(zip(names, values.T, strict=True))
