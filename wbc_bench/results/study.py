"""A study: the methods that share a table, and the pairs of them that are tested."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from wbc_bench.results.analysis import (
    Evaluated,
)


class Row(NamedTuple):
    """One method of a study."""

    heading: str
    label: str
    spec: str
    absent: str = "no checkpoint"  # why, when the store holds no run of it


@dataclass(frozen=True)
class Study:
    """The methods that share a table, and the pairs of them that are tested against each other."""

    protocol: str
    rows: Sequence[Row | tuple[str, str, str]]
    pairs: Sequence[tuple[str, str]] = ()  # (spec, spec), named before the results are seen; () is every pair


ABLATION = Study(
    protocol="ablation_v1",
    rows=(
        Row("Model-based", "Hold posture", "hold", "no run"),
        Row("Model-based", "Whole-body IK", "ik", "no run"),
        Row("Model-based", "IK, kinematic only", "ik:kinematic", "no run"),
        Row("Model-based", "IK on OSQP", "ik:osqp", "no run"),
        Row("Reward", "Matched additive", "learned:transformer_gru_additive"),
        Row("Reward", "Reward gating", "learned:transformer_gru"),
        Row("Temporal context", "No latent", "learned:no_latent"),
        Row("Temporal context", "DreamWaQ/CENet", "learned:cenet"),
        Row("Temporal context", "GRU only", "learned:gru"),
        Row("Temporal context", "Transformer only", "learned:transformer"),
        Row("Temporal context", "Transformer + GRU", "learned:transformer_gru"),
        Row("Upper bound", "Privileged oracle", "learned:oracle"),
    ),
    pairs=(
        ("ik", "hold"),
        ("ik", "ik:kinematic"),
        ("ik", "ik:osqp"),
        ("learned:transformer_gru", "ik"),
        ("learned:transformer_gru", "learned:transformer_gru_additive"),
        ("learned:transformer_gru", "learned:no_latent"),
        ("learned:transformer_gru", "learned:cenet"),
        ("learned:transformer_gru", "learned:gru"),
        ("learned:transformer_gru", "learned:transformer"),
        ("learned:oracle", "learned:transformer_gru"),
    ),
)


def study_rows(study: Study, evaluated: Mapping[str, Evaluated]) -> list[Row]:
    """The study's rows, then whatever else the store holds: a user's own controller needs no list."""
    rows = [Row(*row) for row in study.rows]
    named = {row.spec for row in rows}
    heading = "Other" if rows else "Evaluated"
    return rows + [Row(heading, spec, spec) for spec in evaluated if spec not in named]


def methods_of(study: Study, evaluated: Mapping[str, Evaluated]) -> list[tuple[str, Evaluated]]:
    """Evaluated methods, once each (a method may stand under two headings)."""
    rows = {row.spec: row.label for row in reversed(study_rows(study, evaluated))}
    return [(label, evaluated[spec]) for spec, label in reversed(rows.items()) if spec in evaluated]
