"""A severity ladder: disturbances that grow level by level, one factor at a time, over one base protocol.

A ladder is a TOML file. Each of its levels is a protocol derived from the base: one field is changed, all
else is the base's, and since every quantity has a random stream of its own, so are all other draws.
"""

import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import numpy as np

from wbc_bench.episodes.manifest import manifest_path, read_manifest, write_manifest
from wbc_bench.episodes.protocol import (
    MAX_EPISODES,
    EvalProtocol,
    check_protocol,
    find_protocol,
)
from wbc_bench.episodes.randomization import draw_columns
from wbc_bench.episodes.rows import EpisodeManifest
from wbc_bench.errors import BenchError, UnknownNameError
from wbc_bench.files import LONGEST_NAME, PROTOCOLS, is_folder_name
from wbc_bench.readers import read_toml, reading

FOLDER = PROTOCOLS / "ladders"
TABLES = ("randomization", "push", "noise")  # of a protocol: what may grow and leaves the targets as they are
LONGEST_LADDER = 100  # levels of a factor
BASE = "base"


class LadderError(BenchError):
    """A ladder file that cannot be read, contradicts itself, or asks for more episodes than its base has."""


class _Block(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A part of a ladder file."""


class FactorFile(_Block, frozen=True):
    """One disturbance and its severities, from mild to severe."""

    field: str  # dotted path in the protocol, e.g. `randomization.payload`
    # What a severity v is in the field: `value` v, `range` [v, v], `spread` [1 - v, 1 + v], `scale` the
    # number of the base, or every number of its table, times v.
    mapping: Literal["value", "range", "spread", "scale"]
    levels: Annotated[tuple[float, ...], msgspec.Meta(min_length=2, max_length=LONGEST_LADDER)]
    label: str  # in tables and figures
    unit: str = ""  # of a severity


class LadderFile(_Block, frozen=True):
    """A whole ladder file."""

    name: str  # of the folder of records, of tables and figures
    description: str
    protocol: str  # the base: a released one, or a .toml file beside this one
    episodes: Annotated[
        int, msgspec.Meta(ge=1, le=MAX_EPISODES)
    ]  # of each level, the first ones of replicate 0
    factors: Annotated[dict[str, FactorFile], msgspec.Meta(min_length=1)]


class Level(NamedTuple):
    """One severity of a factor, and the protocol that has it; the base's own where the two are the same."""

    severity: float
    protocol: EvalProtocol


@dataclass(frozen=True)
class Factor:
    """A disturbance that grows."""

    name: str
    label: str
    unit: str
    levels: tuple[Level, ...]


@dataclass(frozen=True)
class Ladder:
    """A ladder with the protocols of its levels."""

    name: str
    description: str
    source: EvalProtocol  # the protocol that the ladder is built on
    source_path: Path  # its file
    base: EvalProtocol  # its first episodes, undisturbed by the ladder
    factors: tuple[Factor, ...]

    @property
    def episodes(self) -> int:
        """Episodes of each level."""
        return self.base.episodes.per_replicate

    def only(self, names: Iterable[str]) -> "Ladder":
        """The same ladder with some of its factors, in its own order; with all of them where none is named.

        Raises:
            UnknownNameError: It has no factor of that name (with the nearest names).
        """
        known = {factor.name: factor for factor in self.factors}
        wanted = set(names)
        for name in sorted(wanted - known.keys()):
            raise UnknownNameError("factor", name, known, f"--factors, of ladder {self.name}")
        return replace(self, factors=tuple(f for f in self.factors if f.name in wanted or not wanted))

    def protocols(self) -> list[EvalProtocol]:
        """The base, then the other levels, each once."""
        levels = (level.protocol for factor in self.factors for level in factor.levels)
        return list({protocol.name: protocol for protocol in (self.base, *levels)}.values())


def ladder_names() -> list[str]:
    """Names of the released ladders."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def find_ladder(name: str) -> Ladder:
    """A ladder by the name of a released one or by the path of a file.

    Raises:
        UnknownNameError: There is no released ladder of that name (with the nearest names).
        LadderError, ProtocolError: See `load_ladder`.
    """
    if name.endswith(".toml"):
        return load_ladder(Path(name))
    if name not in ladder_names():
        raise UnknownNameError("ladder", name, ladder_names(), "--ladder")
    return load_ladder(FOLDER / f"{name}.toml")


def load_ladder(path: Path) -> Ladder:
    """Read a ladder file and derive the protocols of all its levels.

    Raises:
        LadderError: The file is missing or unreadable, or a value of it is not valid; names the field.
        UnknownNameError, ProtocolError: Its base protocol cannot be found or read, or a level contradicts the
            other fields of it.
    """
    file = read_toml(path, LadderFile, "ladder", LadderError)
    for problem, where in _mistakes(file):
        raise LadderError(f"ladder {path}: {problem} - at `$.{where}`")
    beside = file.protocol.endswith(".toml")
    source, source_path = find_protocol(str(path.parent / file.protocol) if beside else file.protocol)
    most = source.episodes.per_replicate
    if file.episodes > most:
        raise LadderError(
            f"ladder {path}: {file.episodes} episodes, valid: 1 to {most} (episodes per replicate of "
            f"{source.name}) - at `$.episodes`"
        )
    episodes = msgspec.structs.replace(source.episodes, replicates=1, per_replicate=file.episodes)
    base = msgspec.structs.replace(source, name=f"{file.name}@{BASE}", episodes=episodes)
    check_protocol(base, source_path)
    factors = [
        Factor(name, factor.label, factor.unit, tuple(_levels(base, file.name, name, factor, path)))
        for name, factor in file.factors.items()
    ]
    return Ladder(file.name, file.description, source, source_path, base, tuple(factors))


def _levels(base: EvalProtocol, ladder: str, name: str, factor: FactorFile, path: Path) -> Iterator[Level]:
    """The protocols of one factor's levels.

    Raises: LadderError, ProtocolError: a severity that the field cannot have.
    """
    for severity in factor.levels:
        where = f"{path}, level {severity:g} of factor '{name}'"
        fields = msgspec.to_builtins(base)
        *tables, last = factor.field.split(".")
        place: Any = fields
        for table in tables:
            place = place.get(table) if isinstance(place, dict) else None
        if not isinstance(place, dict) or last not in place:
            raise LadderError(
                f"ladder {path}: no field '{factor.field}' in a protocol - at `$.factors.{name}.field`"
            )
        with reading("ladder", where, "", LadderError):
            place[last] = _value(factor.mapping, severity, place[last])
            protocol = msgspec.convert(fields, EvalProtocol)
        named = msgspec.structs.replace(protocol, name=f"{ladder}@{name}@{severity:g}")
        check_protocol(named, where)
        yield Level(severity, base if protocol == base else named)


def _value(mapping: str, severity: float, base: Any) -> Any:
    """What a severity is in the field of a protocol that the base gives the value `base`."""
    if mapping == "range":
        return [severity, severity]
    if mapping == "spread":
        return [1.0 - severity, 1.0 + severity]
    if mapping == "value":
        return severity
    if isinstance(base, dict):
        return {name: _value(mapping, severity, value) for name, value in base.items()}
    if isinstance(base, list):
        return [_value(mapping, severity, value) for value in base]
    return base * severity


def _mistakes(file: LadderFile) -> Iterator[tuple[str, str]]:
    """(what is wrong, path of the field), what the types of the fields cannot say."""
    letters = "ASCII letters, digits, '_' and '@', with '.' and '-' between them"
    if not is_folder_name(file.name):
        yield f"'{file.name}' cannot name a folder of results, valid: {letters}", "name"
    for name, factor in file.factors.items():
        where = f"factors.{name}"
        longest = max((f"{file.name}@{name}@{level:g}" for level in factor.levels), key=len)
        if not is_folder_name(longest):
            valid = f"{letters}, at most {LONGEST_NAME} with the ladder's name and a level"
            yield f"'{name}' cannot name folders of results, valid: {valid}", where
        if factor.field.partition(".")[0] not in TABLES:
            yield f"'{factor.field}', valid: fields of {', '.join(TABLES)}", f"{where}.field"
        steps = np.diff(factor.levels)
        if not (np.isfinite(factor.levels).all() and ((steps > 0).all() or (steps < 0).all())):
            yield f"{list(factor.levels)} neither rise nor fall, from mild to severe", f"{where}.levels"
        for k, level in enumerate(factor.levels):
            if float(f"{level:g}") != level:
                yield f"{level!r} has more than six digits, which name its records", f"{where}.levels[{k}]"


@dataclass(frozen=True)
class FrozenLevel:
    """The episodes of one level, as they are evaluated and kept."""

    protocol: EvalProtocol
    manifest: EpisodeManifest
    manifest_sha256: str
    path: Path  # of the protocol's file, its manifest and hash beside it


def ladder_rows(ladder: Ladder) -> EpisodeManifest:
    """The episodes of the ladder's base, from the frozen manifest of its protocol.

    Raises: ManifestError: There is no valid one.
    """
    source, _ = read_manifest(ladder.source, manifest_path(ladder.source_path))
    return source.of_replicate(0, ladder.episodes)


def freeze_levels(ladder: Ladder, rows: EpisodeManifest, folder: Path) -> list[FrozenLevel]:
    """Write protocol, manifest and hash of the base and of every level into a folder.

    All of them have the targets of `rows` (`ladder_rows`); only what an episode draws besides is drawn for
    the level. So nothing is solved, and a level takes a tenth of a second.

    Raises: OSError: The folder cannot be written.
    """
    drawn: dict[tuple, dict[str, np.ndarray]] = {}  # what draws depend on -> draws: noise is no draw
    frozen = []
    for protocol in ladder.protocols():
        depends = protocol.randomization, protocol.push
        if depends not in drawn:
            drawn[depends] = draw_columns(protocol, rows)
        manifest = replace(rows, **drawn[depends])
        path = folder / f"{protocol.name}.toml"
        path.write_text(protocol_toml(protocol), encoding="utf-8")
        file = manifest_path(path)
        write_manifest(manifest, protocol, file)
        sha256 = hashlib.sha256(file.read_bytes()).hexdigest()
        file.with_suffix(".sha256").write_text(f"{sha256}  {file.name}\n")
        frozen.append(FrozenLevel(protocol, manifest, sha256, path))
    return frozen


def protocol_toml(protocol: EvalProtocol) -> str:
    """A protocol as a TOML file that `read_protocol` reads back."""
    fields = msgspec.to_builtins(protocol)
    return "".join(f"{name} = {_toml(value)}\n" for name, value in fields.items())


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        pairs = (f'"{name}" = {_toml(item)}' for name, item in value.items() if item is not None)
        return "{ " + ", ".join(pairs) + " }"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml, value))}]"
    return msgspec.json.encode(value).decode()  # numbers, strings and booleans look alike in both
