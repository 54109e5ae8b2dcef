"""A recording by the name of its file: `FILE?episode=K&rate=HZ&frame=FRAME&tool=TOOL&feature=NAME`."""

import csv
import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from wbc_bench.errors import SourceError, UnknownNameError
from wbc_bench.files import real_path
from wbc_bench.readers import is_file, read_bytes, read_parquet, reading
from wbc_bench.rotations import matrix_from_rotvec
from wbc_bench.sources.diffusion.zarr_archive import episode_slices, read_archive
from wbc_bench.sources.recorded import array_pickle
from wbc_bench.sources.recorded.columns import TIMES, pose_columns, poses_of
from wbc_bench.sources.recorded.lerobot import is_dataset, read_lerobot
from wbc_bench.sources.recorded.recording import (
    LARGEST,
    MAX_ROWS,
    PLACES,
    TOOLS,
    Facts,
    Poses,
    Recording,
    recording_of,
)

if TYPE_CHECKING:
    import pyarrow as pa

Array = NDArray[np.float64]
KIND = "trajectory"
SUFFIXES = (".csv", ".parquet", ".zip", ".pkl")
MAX_CSV = 64 << 20  # [bytes]; text takes several times as much when it is read
MAX_HEADER = 1000  # columns
UMI_RATE = 200.0  # [Hz] of a pickle. Source: real-stanford/umi-on-legs@d75c9c1 mani-centric-wbc/docs/wbc.md


class _Request(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What stands behind the question mark."""

    episode: Annotated[int, msgspec.Meta(ge=0)] = 0
    rate: Annotated[float, msgspec.Meta(ge=0.1, le=10_000)] | None = None
    frame: str | None = None
    tool: str | None = None
    feature: str | None = None  # of LeRobot


def is_recording(name: str) -> bool:
    """Whether the name of a source is that of a recording's file or folder."""
    file = name.partition("?")[0]
    if name.startswith("stream:") or file.endswith(".toml"):
        return False
    return Path(file).suffix in SUFFIXES or "/" in file or is_dataset(file)


def load_recording(name: str) -> Recording:
    """The recording of a name.

    Raises:
        UnknownNameError: a key behind the question mark that there is not (with the nearest ones).
        SourceError: the file is missing, damaged, too large, or none of these; a fact that is missing.
    """
    file, _, query = name.partition("?")
    request = _request(name, query)
    path, where = Path(file), f"{KIND} '{file}'"
    for what, value, valid in (("frame", request.frame, PLACES), ("tool", request.tool, TOOLS)):
        if value is not None and value not in valid:
            raise UnknownNameError(what, value, valid, f"--source {name}")
    given = msgspec.convert({"rate": request.rate, "frame": request.frame, "tool": request.tool}, Facts)
    if path.is_dir():
        found = read_lerobot(path, request.episode, request.feature)
    else:
        if path.suffix not in _READERS:
            valid = "a .csv, .parquet, .zarr.zip or .pkl file, or the folder of a LeRobot dataset"
            raise SourceError(f"{where}, valid: {valid}")
        if not is_file(path) and not path.exists():
            raise SourceError(f"{where} does not exist")
        if request.feature is not None:
            raise SourceError(f"{where}: feature '{request.feature}', valid: of a LeRobot dataset only")
        found = _READERS[path.suffix](path, request.episode)
    alone = path.suffix in (".csv", ".parquet")
    called = _plain(path) if alone else f"{_plain(path)}-{request.episode}"
    return recording_of(called, where, found, given, request.episode)


def _plain(path: Path) -> str:
    """The name of a file without its endings, in letters that a record may be named with."""
    stem = real_path(path).name.partition(".")[0]
    return "".join(c if c.isascii() and (c.isalnum() or c in "_-") else "-" for c in stem) or "recording"


def _request(name: str, query: str) -> _Request:
    found: dict[str, str] = {}
    for part in query.split("&") if query else ():
        key, equals, value = part.partition("=")
        if key not in _Request.__struct_fields__:
            raise UnknownNameError("key", key, _Request.__struct_fields__, f"--source {name}")
        if not equals or key in found:
            raise SourceError(f"source '{name}': '{part}', valid: key=value, each key once, joined by &")
        found[key] = value
    with reading("source", name, "", SourceError):
        return msgspec.convert(found, _Request, strict=False)


def _only_one(path: Path, episode: int) -> None:
    if episode:
        raise SourceError(f"{KIND} '{path}' has one episode, valid: episode=0, given {episode}")


def _read_csv(path: Path, episode: int) -> Poses:
    """Lines `# rate=50` and the like name facts, the first other line the columns."""
    _only_one(path, episode)
    data = read_bytes(path, KIND, SourceError)
    where = f"{KIND} '{path}'"
    if len(data) > MAX_CSV:
        raise SourceError(f"{where} has {len(data)} bytes, valid: at most {MAX_CSV}")
    said: dict[str, str] = {}
    rest = data
    while rest.startswith(b"#"):
        line, _, rest = rest.partition(b"\n")
        key, equals, value = line[1:].decode("utf-8", "replace").partition("=")
        if equals and key.strip() in Facts.__struct_fields__:
            said[key.strip()] = value.strip()
    with reading(KIND, path, "CSV with a line of names", SourceError):
        from pyarrow import BufferReader, float64
        from pyarrow import csv as arrow

        first = rest.partition(b"\n")[0].decode("utf-8").rstrip("\r")
        names = next(csv.reader([first]), [])
        plain = [name.strip() for name in names]
        if len(plain) > MAX_HEADER or len(set(plain)) < len(plain):
            raise SourceError(
                f"{where} has {len(plain)} columns, valid: at most {MAX_HEADER}, each name once"
            )
        if rest.count(b"\n") > MAX_ROWS + 1:
            raise SourceError(f"{where} has too many lines, valid: at most {MAX_ROWS}")
        wanted = [*pose_columns(plain, where), *(name for name in plain if name in TIMES)]
        table = arrow.read_csv(
            BufferReader(rest),
            read_options=arrow.ReadOptions(use_threads=False, column_names=plain, skip_rows=1),
            convert_options=arrow.ConvertOptions(
                include_columns=wanted, column_types=dict.fromkeys(wanted, float64())
            ),
        )
    return _of_table(path, table, said, data)


def _read_table(path: Path, episode: int) -> Poses:
    """Facts may stand in the metadata of the schema, under their names."""
    _only_one(path, episode)
    data = read_bytes(path, KIND, SourceError)
    table = read_parquet(path, KIND, SourceError)
    said = {
        key.decode("utf-8", "replace"): value.decode("utf-8", "replace")
        for key, value in (table.schema.metadata or {}).items()
    }
    return _of_table(path, table, {key: said[key] for key in Facts.__struct_fields__ if key in said}, data)


def _of_table(path: Path, table: "pa.Table", said: Mapping[str, str], data: bytes) -> Poses:
    where = f"{KIND} '{path}'"
    with reading(KIND, path, "", SourceError):
        facts = msgspec.convert(dict(said), Facts, strict=False)
    if len(set(table.column_names)) < len(table.column_names):
        raise SourceError(f"{where} has two columns of one name, valid: each once")
    names = pose_columns(table.column_names, where)
    times = [name for name in TIMES if name in table.column_names]
    if len(times) > 1:
        raise SourceError(f"{where} has columns {', '.join(times)}, valid: one of them")
    if len(table) > MAX_ROWS:
        raise SourceError(f"{where} has {len(table)} poses, valid: 1 to {MAX_ROWS}")
    with reading(KIND, path, "a table of numbers", SourceError):
        columns = {name: numbers(table[name]) for name in (*names, *times)}
    pos, rot = poses_of({name: columns[name] for name in names}, where)
    time = columns[times[0]] if times else None
    return Poses(pos, rot, time, facts, hashlib.sha256(data).hexdigest())


def numbers(column: "pa.ChunkedArray") -> Array:
    """A column (T,) as numbers, NaN where it is empty. Raises: pyarrow's errors, it holds none."""
    import pyarrow as pa

    return column.cast(pa.float64()).to_numpy(zero_copy_only=False)


def _read_zarr(path: Path, episode: int) -> Poses:
    """A file of UMI's tools, or of `demo record`, whose poses are in the world and at its control period."""
    wanted = {"data/robot0_eef_pos": 3, "data/robot0_eef_rot_axis_angle": 3, "meta/episode_ends": 0}
    found = read_archive(path, wanted)
    pos, turns = (found.arrays[name].astype(float) for name in list(wanted)[:2])
    slices = episode_slices(path, found.arrays["meta/episode_ends"].astype(np.int64))
    where = f"{KIND} '{path}'"
    if not len(pos) == len(turns) == slices[-1].stop:
        raise SourceError(f"{where} has {len(pos)} and {len(turns)} rows, valid: {slices[-1].stop} of both")
    rows = slices[_checked(where, episode, len(slices))]
    period, facts = found.attributes.get("control_period"), Facts(tool="umi")
    if isinstance(period, float) and 1e-4 <= period <= 10:
        facts = Facts(rate=1 / period, frame="world", tool="umi")
    return Poses(pos[rows], _turned(where, turns[rows]), None, facts, found.sha256)


def _read_pickle(path: Path, episode: int) -> Poses:
    """A list of dicts of UMI-on-Legs: `ee_pos` and `ee_axis_angle`, (T, 3) each, of UMI's tool frame."""
    value, where = array_pickle.load(path), f"{KIND} '{path}'"
    if not isinstance(value, list) or not value:
        raise SourceError(f"{where}: a {type(value).__name__}, valid: a list of dicts, one per episode")
    one = value[_checked(where, episode, len(value))]
    if not isinstance(one, dict) or not {"ee_pos", "ee_axis_angle"} <= one.keys():
        raise SourceError(f"{where}: episode {episode} is no dict with ee_pos and ee_axis_angle")
    pos, turns = (
        array_pickle.array(one[name], path, f"{name} of episode {episode}")
        for name in ("ee_pos", "ee_axis_angle")
    )
    for name, found in (("ee_pos", pos), ("ee_axis_angle", turns)):
        if found.ndim != 2 or found.shape[1] != 3 or len(found) != len(pos) or len(found) > MAX_ROWS:
            raise SourceError(f"{where}: {name} has shape {found.shape}, valid: (T, 3), T at most {MAX_ROWS}")
    content = hashlib.sha256(read_bytes(path, KIND, SourceError)).hexdigest()
    facts = Facts(rate=UMI_RATE, tool="umi")
    return Poses(pos.astype(float), _turned(where, turns.astype(float)), None, facts, content)


def _checked(where: str, episode: int, count: int) -> int:
    if episode >= count:
        raise SourceError(f"{where} has no episode {episode}, valid: 0 to {count - 1}")
    return episode


def _turned(where: str, rotvec: Array) -> Array:
    """Rotation matrices of rotation vectors (T, 3) [rad]. Raises: SourceError, numbers that are none."""
    if not (np.abs(rotvec) <= LARGEST).all():  # so written that NaN is refused
        raise SourceError(f"{where} holds a rotation that is not finite or beyond {LARGEST:g} rad")
    return matrix_from_rotvec(rotvec)


_READERS: dict[str, Callable[[Path, int], Poses]] = {
    ".csv": _read_csv,
    ".parquet": _read_table,
    ".zip": _read_zarr,
    ".pkl": _read_pickle,
}
