"""Small stored runs."""

from pathlib import Path

from wbc_bench.episodes.manifest import manifest_path, read_manifest
from wbc_bench.episodes.protocol import find_protocol
from wbc_bench.evaluation.execution import Job, run_jobs
from wbc_bench.evaluation.workers import Engine
from wbc_bench.results.store import ResultStore, Run


def evaluated(root: Path, spec: str, episodes: int = 6) -> Run:
    protocol, path = find_protocol("smoke_v1")
    manifest, sha256 = read_manifest(protocol, manifest_path(path))
    job = Job(protocol, manifest, sha256, spec, [1], episodes)
    return run_jobs([job], ResultStore(root), Engine())[0]
