"""Runs that a store does not hold yet: the shards that are missing are computed, written, and merged."""

import hashlib
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np

from wbc_bench import provenance
from wbc_bench.controller import Controller
from wbc_bench.episodes.manifest import EpisodeManifest
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.evaluation.shard import SHARD_EPISODES
from wbc_bench.evaluation.time_left import TimeLeft
from wbc_bench.evaluation.workers import Engine, Result, Task, results
from wbc_bench.outcomes import SuccessRule
from wbc_bench.progress import Progress
from wbc_bench.provenance import Software
from wbc_bench.registry import build_controller, spec_of_replicate
from wbc_bench.results.run_writer import RunWriter
from wbc_bench.results.store import ResultStore, Run, RunKey
from wbc_bench.robot import RobotConfig, load_robot


@dataclass(frozen=True)
class Job:
    """Some replicates of one protocol under one controller."""

    protocol: EvalProtocol
    manifest: EpisodeManifest
    manifest_sha256: str
    spec: str  # of the controller, or the name of one that was handed over as an object
    replicates: Sequence[int]
    episodes: int  # of each replicate
    packed: bytes | None = None  # the object, see `registry.pack_controller`


def run_jobs(jobs: Sequence[Job], store: ResultStore, engine: Engine, overwrite: bool = False) -> list[Run]:
    """Evaluate what the store does not hold yet; finished shards of an interrupted evaluation are reused.

    Raises:
        StoreError: the store holds a different evaluation under the same name, is in use or is full.
        ControllerError: a controller cannot be built or breaks the interface.
        ExecutionError: workers cannot be started or keep dying.
    """
    with ExitStack() as stack:
        runs = []
        # (robot, object, spec) -> controller and what computes it: jobs of many protocols share one
        built: dict[tuple[RobotConfig, bytes | None, str], tuple[Controller, Software]] = {}
        for job in jobs:
            for replicate in job.replicates:
                # one controller may meet all replicates, or another one each
                spec = job.spec if job.packed else spec_of_replicate(job.spec, replicate)
                of = job.protocol.robot, job.packed, spec
                if of not in built:
                    controller = build_controller(job.packed or spec, load_robot(job.protocol.robot))
                    built[of] = controller, _software(controller, job.packed)
                runs.append(_Run(job, spec, *built[of], replicate, store, overwrite))
                stack.callback(runs[-1].writer.close)
        tasks = (task for number, run in enumerate(runs) for task in run.tasks(number))
        shared = {
            **{"workers": engine.workers, "engine": engine.name},
            **{"versions": provenance.versions(), "machine": provenance.machine()},
        }
        shared["git_commit"], shared["git_dirty"] = provenance.commit()
        several = len({job.protocol.name for job in jobs}) > 1
        if several:
            _report_reused(runs)
        for run in runs:
            if not several:
                run.report_reused()
            run.finish_if_whole(shared)  # killed between the last shard and the merge
        missing: dict[str, int] = {}  # controller -> episodes
        for run in runs:
            count = sum(len(run.writer.rows(shard)) for shard in run.writer.missing)
            missing[run.job.spec] = missing.get(run.job.spec, 0) + count
        total = sum(missing.values())
        left = TimeLeft(missing, None if engine.address else engine.workers)
        if total:
            with Progress("episodes") as progress:
                for result in results(tasks, engine):
                    run = runs[result.run]
                    run.accept(result)
                    done = progress.done + len(result.episodes)
                    left.add(run.job.spec, len(result.episodes), result.started, result.cost.seconds)
                    part = f"under {run.job.protocol.name}" if several else f"replicate {run.replicate}"
                    name = f"{run.job.spec} {part}"
                    progress.update(done, total, name, left.text())
                    run.finish_if_whole(shared)
        return [run.writer.finished for run in runs if run.writer.finished]


def _software(controller: Controller, packed: bytes | None) -> Software:
    """What computes a controller's episodes; of an object also its state."""
    software = provenance.software(controller)
    if packed is None:
        return software
    return software._replace(controller=hashlib.sha256(software.controller.encode() + packed).hexdigest())


def _report_reused(runs: Sequence["_Run"]) -> None:
    """Say what is not evaluated again, in one line per controller: of many protocols there are many runs."""
    for spec in dict.fromkeys(run.job.spec for run in runs):
        own = [run for run in runs if run.job.spec == spec]
        reused = sum(run.writer.finished is not None for run in own)
        resumed = sum(run.writer.resumed > 0 for run in own)
        others = sum(run.by_other_code for run in own)
        if reused or resumed:
            line = f"{spec}: {reused} of {len(own)} runs reused, {resumed} resumed"
            if others:
                line += f"; {others} by other code or packages than now; --overwrite evaluates them again"
            print(line, file=sys.stderr)


class _Run:
    """One run of a job while it is evaluated."""

    def __init__(
        self,
        job: Job,
        spec: str,
        controller: Controller,
        software: Software,
        replicate: int,
        store: ResultStore,
        overwrite: bool,
    ) -> None:
        self.job, self.replicate = job, replicate
        self._spec, self._software = spec, software  # of the controller that meets this replicate
        self._controller = controller
        self._rows = job.manifest.of_replicate(replicate, job.episodes)
        self._started = float("inf")
        key = RunKey(
            protocol=job.protocol.name,
            protocol_digest=job.protocol.digest,
            manifest_sha256=job.manifest_sha256,
            controller=job.spec,
            replicate=replicate,
            requested=len(self._rows),
            shard_episodes=SHARD_EPISODES,
            software_sha256=software.digest,
            controller_sha256=software.controller,
        )
        self.writer = RunWriter(store, key, overwrite)

    def tasks(self, number: int) -> Iterator[Task]:
        for shard in self.writer.missing:
            rows = self._rows.take(np.asarray(self.writer.rows(shard)))
            packed = self.job.packed
            software = "" if packed else self._software.digest  # the bytes are what was asked for
            yield Task(number, shard, packed or self._spec, self.job.protocol, rows, software)

    def report_reused(self) -> None:
        """Say what is not evaluated again, and whether other code made it: nobody may take it for new."""
        writer, name = self.writer, f"{self.job.spec} replicate {self.replicate}"
        if writer.finished:
            record = writer.finished.record
            line = f"{name}: reused, evaluated {record.created}"
            if record.requested > writer.key.requested:
                line += f", {record.requested} episodes, of which {writer.key.requested} are asked for"
            if self.by_other_code:
                line += ", by other code or packages than now; --overwrite evaluates it again"
            print(line, file=sys.stderr)
        elif writer.resumed:
            print(f"{name}: resumed after {writer.resumed} of {writer.num_shards} shards", file=sys.stderr)

    @property
    def by_other_code(self) -> bool:
        """Whether it is reused and was evaluated by other code or packages."""
        found = self.writer.finished
        return found is not None and found.record.software_sha256 != self._software.digest

    def accept(self, result: Result) -> None:
        self._started = min(self._started, result.started)
        self.writer.write(result.shard, result.episodes, result.cost)

    def finish_if_whole(self, shared: dict[str, Any]) -> None:
        if self.writer.finished or self.writer.missing:
            return
        now, info = time.time(), self._controller.info
        protocol = self.job.protocol
        success, horizon = protocol.success, protocol.episodes.horizon
        self.writer.finish(
            {
                "controller_name": info.name,
                "resolved_controller": self._spec,
                "signals": sorted(info.signals),
                "commands": sorted(info.commands),
                "source": info.source,
                "checkpoint_sha256": getattr(self._controller, "checkpoint_sha256", None),
                "wall_time_s": round(max(0.0, now - self._started), 3),  # 0 when only the merge was left
                "created": datetime.fromtimestamp(now, UTC).isoformat(timespec="seconds"),
                "rule": SuccessRule(success.position, success.orientation, success.window, horizon),
                **shared,
            }
        )
