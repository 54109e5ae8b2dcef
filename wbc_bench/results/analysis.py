"""What tables and plots both ask of a store: runs grouped by controller, strata, and the rule of reach.

Pure functions of the episode records; no file is written here.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from wbc_bench.errors import StoreError
from wbc_bench.outcomes import STRATA, TERMINATED, Outcome, SuccessRule

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

PAPER_SIGNALS = frozenset({"proprioception", "ee_pose"})  # what the paper's policy may see (its Table I)
END_ZONE = 0.10  # [m] "near an end" of the range: two steps of 5 cm to either side


class RunLike(Protocol):
    @property
    def record(self) -> Any: ...
    def episodes(self) -> pd.DataFrame: ...


@dataclass(frozen=True)
class Evaluated:
    """All replicates of one controller under one protocol."""

    spec: str
    records: tuple[Any, ...]
    episodes: pd.DataFrame  # the episode record, replicates concatenated
    label: str = ""  # what the studies call it

    @property
    def name(self) -> str:
        """Its label, or its spec where no study lists it."""
        return self.label or self.spec

    def first(self, episodes: int) -> "Evaluated":
        """The same, with the first episodes of each replicate alone."""
        chosen = column(self.episodes, "episode") < episodes
        return self if chosen.all() else replace(self, episodes=subset(self.episodes, chosen))

    @property
    def requested(self) -> int:
        return sum(record.requested for record in self.records)

    @property
    def completed(self) -> int:
        return len(self.episodes)

    @property
    def counts(self) -> str:
        return f"{self.completed}/{self.requested}"

    @property
    def extra_signals(self) -> list[str]:
        """Signals it reads and the paper's policy does not."""
        return sorted(set(self.records[0].signals) - PAPER_SIGNALS)

    @property
    def commands(self) -> list[str]:
        """Parts of its commands beside positions."""
        return sorted(self.records[0].commands)

    @property
    def rule(self) -> SuccessRule:
        """The one of the protocol, whose digest all records share."""
        return self.records[0].rule

    @property
    def trained(self) -> bool:
        return any(record.checkpoint_sha256 for record in self.records)

    @property
    def not_terminated(self) -> Mask:
        return not_terminated(self.episodes)


def collect(runs: Iterable[RunLike], labels: Mapping[str, str] | None = None) -> dict[str, Evaluated]:
    """Spec -> its runs, sorted by spec, of runs under one protocol; reads their episodes, so call it once.

    `labels` maps a spec to its name in tables and figures. One that it does not list is called what the
    controller calls itself, unless two specs go by one name.

    Raises: StoreError when two runs under one name were evaluated with different protocols or manifests.
    """
    runs = sorted(runs, key=lambda run: (run.record.controller, run.record.replicate))
    first: dict[str, tuple[str, str]] = {}  # what must agree -> (value, the first run that said so)
    for record in (run.record for run in runs):
        for key, value in (
            ("protocol digest", record.protocol_digest),
            (f"manifest of replicate {record.replicate}", record.manifest_sha256),
        ):
            known, owner = first.setdefault(key, (value, record.controller))
            if known != value:
                raise StoreError(
                    f"runs of '{record.protocol}' were evaluated with different manifests: {key} is {known} "
                    f"for '{owner}' and {value} for '{record.controller}'; evaluate both again under one "
                    "protocol"
                )
    grouped: dict[str, list[Any]] = {}
    for run in runs:
        grouped.setdefault(run.record.controller, []).append(run)
    for group in grouped.values():
        _refuse_two_versions([run.record for run in group])
    labels = _own_names(grouped) | dict(labels or {})
    return {
        spec: Evaluated(
            spec,
            tuple(run.record for run in group),
            pd.concat([_episodes(run) for run in group], ignore_index=True),
            label_of(spec, labels),
        )
        for spec, group in grouped.items()
    }


def label_of(spec: str, labels: Mapping[str, str]) -> str:
    """The label of a spec; of one seed of a method that has one, `METHOD@SEED`, with the seed; else empty."""
    method, _, seed = spec.rpartition("@")
    return labels.get(spec) or (f"{labels[method]}, seed {seed}" if method in labels else "")


def _own_names(grouped: Mapping[str, list[Any]]) -> dict[str, str]:
    """Spec -> what its controller calls itself, where that tells it from every other."""
    names = {spec: {run.record.controller_name for run in group} for spec, group in grouped.items()}
    single = {spec: next(iter(found)) for spec, found in names.items() if len(found) == 1}
    # `learned:METHOD` stands for `learned:METHOD@0` and further seeds
    own = {spec: name for spec, name in single.items() if not name.startswith(spec)}
    taken = Counter([*own.values(), *(spec for spec in grouped if spec not in own)])
    return {spec: name for spec, name in own.items() if taken[name] == 1}


TEXTS = ("stratum", "condition", "orientation", "outcome")  # columns of every file of episodes
FINITE = ("replicate", "episode", "height", "target_x", "target_y", "success")
NUMBERS = ("position_error", "orientation_error", "action_variation", "ee_speed_rms", "ee_sparc", "duration")
# what records before 0.1.0 do not have
MOTION = (
    "action_variation_rad",
    "command_rate",
    "time_to_reach",
    "energy",
    "mean_power",
    "torque_limit_share",
    "speed_limit_share",
    "foot_slip",
    "push_error",
)


def _episodes(run: RunLike) -> pd.DataFrame:
    """Episodes of a run, with every column that tables and figures are made of; NaN for those of MOTION that
    an old record lacks.

    Raises: StoreError when one is missing, of another type, or contradicts the record.
    """
    episodes, record = run.episodes(), run.record
    where = f"episodes of {record.protocol}/{record.controller}/replicate_{record.replicate}"
    for name in (*TEXTS, *FINITE, *NUMBERS, *MOTION):
        if name in MOTION and name not in episodes:
            episodes[name] = np.nan
        if name not in episodes:
            raise StoreError(
                f"{where} have no column {name}, valid: {', '.join((*TEXTS, *FINITE, *NUMBERS))}"
            )
        values = episodes[name]
        if name in TEXTS:
            if not all(isinstance(value, str) for value in values):
                raise StoreError(f"{where}: column {name} holds {values.dtype}, valid: text in every row")
        elif values.dtype.kind not in "iuf":
            raise StoreError(f"{where}: column {name} holds {values.dtype}, valid: numbers")
        elif np.isinf(column(episodes, name)).any():
            raise StoreError(f"{where}: column {name} holds an infinite number")
        elif name in FINITE and not np.isfinite(column(episodes, name)).all():
            raise StoreError(f"{where}: column {name} holds a number that is not finite")
    if not (column(episodes, "replicate") == record.replicate).all():
        raise StoreError(f"{where}: column replicate holds others, valid: {record.replicate} in every row")
    if not np.array_equal(episodes["success"] == 1, episodes["outcome"] == Outcome.SUCCESS):
        raise StoreError(f"{where}: column success contradicts outcome, valid: 1 where it is a success")
    return episodes


def _refuse_two_versions(records: Sequence[Any]) -> None:
    """Replicates that one and the same controller met must have met the same code and files of it.

    Raises: StoreError, otherwise a row would pool, say, two checkpoints. Records before 0.1.0 do not tell.
    """
    first: dict[str, tuple[str, int]] = {}
    for record in records:
        if record.resolved_controller and record.controller_sha256:
            seen = first.setdefault(record.resolved_controller, (record.controller_sha256, record.replicate))
            if seen[0] != record.controller_sha256:
                raise StoreError(
                    f"replicates {seen[1]} and {record.replicate} of '{record.controller}' under "
                    f"{record.protocol} were evaluated with different code or files of the controller; "
                    "evaluate one of them again with --overwrite"
                )


def collect_all(
    runs: Iterable[RunLike], labels: Mapping[str, str] | None = None
) -> dict[str, dict[str, Evaluated]]:
    """Protocol -> spec -> its runs, both sorted; every file of episodes is read once.

    Raises: StoreError, see `collect`.
    """
    grouped: dict[str, list[RunLike]] = {}
    for run in sorted(runs, key=lambda run: run.record.protocol):
        grouped.setdefault(run.record.protocol, []).append(run)
    return {protocol: collect(group, labels) for protocol, group in grouped.items()}


def rule_of(evaluated: Mapping[str, Evaluated]) -> SuccessRule:
    """The success rule that the controllers of one protocol share."""
    return next((method.rule for method in evaluated.values()), SuccessRule())


def column(episodes: pd.DataFrame, name: str) -> FloatArray:
    """One numeric column, (N,)."""
    return np.asarray(episodes[name], dtype=np.float64)


def subset(episodes: pd.DataFrame, mask: Mask) -> pd.DataFrame:
    """The rows where `mask` holds."""
    return episodes.take(np.flatnonzero(mask))


def not_terminated(episodes: pd.DataFrame) -> Mask:
    """Which episodes did not terminate, (N,)."""
    return ~np.isin(np.asarray(episodes["outcome"], dtype=str), [str(outcome) for outcome in TERMINATED])


def median(values: FloatArray) -> float:
    """Median of the defined values; NaN without one."""
    known = values[~np.isnan(values)]
    return float(np.median(known)) if len(known) else float("nan")


def strata_of(episodes: pd.DataFrame) -> list[str]:
    """Strata present, in the usual order; `beyond` (no feasible pose exists) comes last."""
    present = set(episodes["stratum"])
    return [s for s in (*STRATA, "beyond") if s in present] + sorted(present - {*STRATA, "beyond"})


class HeightRange(NamedTuple):
    low: float  # [m], NaN when nothing was reached
    high: float
    reached: int  # heights reached, also outside the longest run


def reached(episodes: pd.DataFrame, rule: SuccessRule) -> bool:
    """Whether the median error over the episodes of one height is below the tolerance of success.

    A terminated episode, or one without a value, counts as infinitely far: fewer than half may.
    """
    error = column(episodes, "position_error")
    return bool(
        np.median(np.where(not_terminated(episodes) & ~np.isnan(error), error, np.inf)) < rule.position
    )


def by_height(episodes: pd.DataFrame) -> list[tuple[float, pd.DataFrame]]:
    """(height [m], its episodes), lowest first."""
    # Rounded to 1 mm: heights are a grid of centimetres that went through floating point.
    height = column(episodes, "height").round(3)
    order = np.argsort(height, kind="stable")
    ordered = episodes.take(order)  # once; the parts are then slices of it
    heights, starts = np.unique(height[order], return_index=True)
    ends = [*starts[1:], len(ordered)]
    return [(float(h), ordered.iloc[a:b]) for h, a, b in zip(heights, starts, ends, strict=True)]


def contiguous_range(heights: Sequence[float], good: Sequence[bool]) -> HeightRange:
    """Longest run of neighbouring heights of the grid that are all good; the lower of two equals."""
    best, start = (0, 0), None
    for k, ok in enumerate([*good, False]):
        if ok and start is None:
            start = k
        elif not ok and start is not None:
            if k - start > best[1] - best[0]:
                best = (start, k)
            start = None
    if best[0] == best[1]:
        return HeightRange(np.nan, np.nan, 0)
    return HeightRange(heights[best[0]], heights[best[1] - 1], int(sum(good)))


def reach_range(episodes: pd.DataFrame, rule: SuccessRule, strict: bool = False) -> HeightRange:
    """Range of heights reached; strict asks that more than half of a height's episodes succeed."""
    groups = by_height(episodes)
    good = [column(g, "success").mean() > 0.5 if strict else reached(g, rule) for _, g in groups]
    return contiguous_range([height for height, _ in groups], good)


def oscillation(episodes: pd.DataFrame, span: HeightRange, metric: str) -> tuple[float, float, float]:
    """Median of a metric near the low end of a range, between, and near the high end.

    Terminated episodes are left out. Near is within END_ZONE on either side, so also just outside the range.
    """
    kept = subset(episodes, not_terminated(episodes))
    height, values = column(kept, "height"), column(kept, metric)
    zone = END_ZONE + 1e-6  # the grid went through floating point
    low, high = np.abs(height - span.low) <= zone, np.abs(height - span.high) <= zone
    middle = (height > span.low) & (height < span.high) & ~low & ~high
    return median(values[low]), median(values[middle]), median(values[high])


def variants(episodes: pd.DataFrame) -> list[tuple[str, str, pd.DataFrame]]:
    """(condition, orientation, episodes), in alphabetical order: nominal before randomised."""
    condition, orientation = (np.asarray(episodes[name], dtype=str) for name in ("condition", "orientation"))
    keys = sorted(set(zip(condition, orientation, strict=True)))
    return [(str(c), str(o), subset(episodes, (condition == c) & (orientation == o))) for c, o in keys]
