"""A study: the controllers that share a table, the pairs that are tested, and what the paper prints of them.

A study is a TOML file. The released ones are `protocols/studies/<name>.toml`; a file of a user's own has the
same form.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Literal

import msgspec

from wbc_bench.errors import BenchError, UnknownNameError
from wbc_bench.files import PROTOCOLS, folder_name
from wbc_bench.readers import read_toml
from wbc_bench.results.analysis import Evaluated

FOLDER = PROTOCOLS / "studies"

ColumnName = Literal[
    "success", "position_mean", "position_p95", "orientation_mean", "orientation_p95", "action_variation"
]
ColourName = Literal["blue", "vermilion", "green", "pink", "orange", "sky", "black", "grey"]


class StudyError(BenchError):
    """A study file that cannot be read or contradicts itself."""


class _Block(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A part of a study file."""


class Row(_Block, frozen=True):
    """One line of the study's tables."""

    heading: str  # rows that follow each other under one heading are a group
    label: str  # the name in tables and figures
    spec: str  # of the controller
    absent: str = "no run"  # what a table says when the controller has no run
    colour: ColourName | None = None  # of the label in every figure; one that is free when not given


class Paper(_Block, frozen=True):
    """Values that a paper prints for the study's controllers."""

    source: str  # the publication
    place: str  # where in it
    notes: tuple[str, ...] = ()  # what a reader must know to compare them
    seeds: int = 1  # training seeds that `sd` is over
    episodes: int = 0  # of each seed
    columns: tuple[ColumnName, ...] = ()
    mean: dict[str, tuple[float, ...]] = {}  # spec -> a value per column, in the unit of the table
    sd: dict[str, tuple[float, ...]] = {}  # spec -> their standard deviations over seeds
    ranges_cm: dict[str, tuple[float, float]] = {}  # label -> lowest and highest height reached [cm]


class Study(_Block, frozen=True):
    """The controllers that share a table, and the pairs of them that are tested against each other."""

    name: str  # of its tables and figures
    protocol: str  # its values of the paper stand under this protocol alone
    rows: tuple[Row, ...] = ()  # () is whatever was evaluated
    pairs: tuple[
        tuple[str, str], ...
    ] = ()  # (spec, spec), named before the results are seen; () is every pair
    paper: Paper | None = None


def load_study(path: Path) -> Study:
    """Read a study file.

    Raises:
        StudyError: The file is missing or unreadable, or a value of it is not valid; names the field.
    """
    study = read_toml(path, Study, "study", StudyError)
    for problem, where in _mistakes(study):
        raise StudyError(f"study {path}: {problem} - at `$.{where}`")
    return study


def find_study(name: str) -> Study:
    """A study by the name of a released one or by the path of a file.

    Args:
        name: A file name in protocols/studies without `.toml`, or the path of a .toml file.

    Raises:
        UnknownNameError: There is no released study of that name (with the nearest names).
        StudyError: See `load_study`.
    """
    if name.endswith(".toml"):
        return load_study(Path(name))
    released = study_names()
    if name not in released:
        raise UnknownNameError("study", name, released, "--study")
    return load_study(FOLDER / f"{name}.toml")


def study_names() -> list[str]:
    """Names of the released studies."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def released_studies() -> list[Study]:
    """Every study in protocols/studies, sorted by file name."""
    return [find_study(name) for name in study_names()]


def studies_of(protocol: str, studies: Iterable[Study] | None = None) -> list[Study]:
    """The studies of one protocol, or a study of whatever was evaluated where there is none.

    Args:
        protocol: Name of the protocol.
        studies: Studies to choose from; the released ones when not given.
    """
    known = released_studies() if studies is None else studies
    return [study for study in known if study.protocol == protocol] or [Study(protocol, protocol)]


def study_rows(study: Study, evaluated: Mapping[str, Evaluated]) -> list[Row]:
    """The study's rows, then whatever else was evaluated: a user's own controller needs no list."""
    named = {row.spec for row in study.rows}
    heading = "Other" if study.rows else "Evaluated"
    others = (method for spec, method in evaluated.items() if spec not in named)
    return [*study.rows, *(Row(heading, method.name, method.spec) for method in others)]


def methods_of(study: Study, evaluated: Mapping[str, Evaluated]) -> list[tuple[str, Evaluated]]:
    """Evaluated controllers with their labels, once each, in the order of their last rows."""
    labels = labels_of(study_rows(study, evaluated))
    return [(label, evaluated[spec]) for spec, label in labels.items() if spec in evaluated]


def released_rows() -> list[Row]:
    """The rows of every released study, which say how a controller is called and drawn everywhere."""
    return [row for study in released_studies() for row in study.rows]


def labels_of(rows: Iterable[Row]) -> dict[str, str]:
    """Spec -> label. A controller under several headings is called what its last row says."""
    labels: dict[str, str] = {}
    for row in rows:
        labels.pop(row.spec, None)  # to the end
        labels[row.spec] = row.label
    return labels


def _mistakes(study: Study) -> Iterable[tuple[str, str]]:
    """(what is wrong, path of the field), what the types of the fields cannot say."""
    if not study.name or folder_name(study.name) != study.name:
        yield f"'{study.name}' cannot name files, valid: letters, digits, '.', '_', '@' and '-'", "name"
    specs = {row.spec for row in study.rows}
    for k, pair in enumerate(study.pairs):
        for spec in pair:
            if spec not in specs:
                yield f"'{spec}' has no row, valid: {', '.join(sorted(specs)) or 'none'}", f"pairs[{k}]"
    if study.paper is None:
        return
    for name in ("mean", "sd"):
        for spec, values in getattr(study.paper, name).items():
            if len(values) != len(study.paper.columns):
                problem = f"{len(values)} values for {len(study.paper.columns)} columns"
                yield problem, f"paper.{name}.{spec}"
    if study.paper.mean.keys() != study.paper.sd.keys():
        yield "must name the same controllers as `paper.mean`", "paper.sd"
