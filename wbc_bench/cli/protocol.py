"""`wbc-bench protocol`: freeze, verify or show a protocol."""

from dataclasses import dataclass, field
from pathlib import Path

from tyro.conf import Positional

from wbc_bench.cli.common import at_least_one, cores


@dataclass(frozen=True)
class Freeze:
    """Draw the manifest of a protocol and write it beside the protocol file."""

    name: Positional[str]
    """Name of a released protocol, or path of a .toml file."""
    workers: int = field(default_factory=cores)
    """Number of worker processes; the manifest does not depend on it."""

    def run(self) -> None:
        from wbc_bench.episodes.freeze import freeze
        from wbc_bench.episodes.manifest import manifest_path
        from wbc_bench.episodes.protocol import find_protocol
        from wbc_bench.progress import Progress

        at_least_one("--workers", self.workers)
        protocol, path = find_protocol(self.name)
        with Progress("draws") as progress:
            sha256 = freeze(protocol, manifest_path(path), progress.update, self.workers)
        print(f"{sha256}  {manifest_path(path)}")


@dataclass(frozen=True)
class Verify:
    """Check the manifest of a protocol: hash, counts, ranges, feasibility of a sample."""

    name: Positional[str]
    """Name of a released protocol, or path of a .toml file."""

    def run(self) -> None:
        from wbc_bench.episodes.manifest import manifest_path
        from wbc_bench.episodes.protocol import find_protocol
        from wbc_bench.episodes.verify import verify
        from wbc_bench.errors import ManifestError

        protocol, path = find_protocol(self.name)
        checks = verify(protocol, manifest_path(path))
        for check in checks:
            print(f"{'ok    ' if check.ok else 'FAILED'} {check.name}: {check.detail}")
        failed = [check for check in checks if not check.ok]
        if failed:
            names = "; ".join(f"{check.name}: {check.detail}" for check in failed)
            raise ManifestError(f"manifest of {protocol.name} does not hold what it promises: {names}")


@dataclass(frozen=True)
class Show:
    """Print what a protocol asks for and draw its targets."""

    name: Positional[str]
    """Name of a released protocol, or path of a .toml file."""
    out: Path = Path()
    """Folder to write the pictures to; the current one when not given."""

    def run(self) -> None:
        import msgspec

        from wbc_bench.episodes.manifest import manifest_path, read_manifest
        from wbc_bench.episodes.protocol import find_protocol
        from wbc_bench.files import ensure_writable
        from wbc_bench.publish import target_frame
        from wbc_bench.results.figures.targets import write_targets

        protocol, path = find_protocol(self.name)
        print(f"# digest {protocol.digest}")
        print(msgspec.json.format(msgspec.json.encode(protocol), indent=2).decode())
        manifest, sha256 = read_manifest(protocol, manifest_path(path))
        print(f"# manifest sha256 {sha256}")
        print(target_frame(manifest).groupby("stratum").describe().T.to_string())
        ensure_writable(self.out)
        for picture in write_targets(target_frame(manifest), protocol.name, self.out):
            print(picture)
