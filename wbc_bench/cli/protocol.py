"""`wbc-bench protocol`: freeze, reveal, verify or show a protocol."""

from dataclasses import dataclass, field
from pathlib import Path

from tyro.conf import Positional

from wbc_bench.cli.common import UsageError, at_least_one, cores


@dataclass(frozen=True)
class Freeze:
    """Draw the manifest of a protocol and write it beside the protocol file, or draw a sealed set of it."""

    name: Positional[str]
    """Name of a released protocol, or path of a .toml file."""
    workers: int = field(default_factory=cores)
    """Number of worker processes; the manifest does not depend on it."""
    sealed: bool = False
    """Draw another set of the same distribution from a secret, and write it to --out with a commitment that
    can be published beforehand."""
    secret_file: Path | None = None
    """File of at least 16 random bytes that the seed of a sealed set is derived from; it is only read."""
    out: Path | None = None
    """Folder to write a sealed set to."""

    def run(self) -> None:
        from wbc_bench.episodes.freeze import freeze
        from wbc_bench.episodes.manifest import manifest_path
        from wbc_bench.episodes.protocol import find_protocol
        from wbc_bench.files import SEALED
        from wbc_bench.progress import Progress

        at_least_one("--workers", self.workers)
        for option, given in (("--secret-file", self.secret_file), ("--out", self.out)):
            if (given is not None) != self.sealed:
                raise UsageError(f"{option} and --sealed: valid: both or neither")
        protocol, path = find_protocol(self.name)
        if self.secret_file is not None and self.out is not None:
            from wbc_bench.episodes.sealed import seal

            with Progress("draws") as progress:
                commitment, sha256 = seal(protocol, self.secret_file, self.out, progress.update, self.workers)
            print(f"{sha256}  {protocol.name}{SEALED}.parquet")
            print(f"publish {commitment}; keep the secret and the other files until the set is revealed")
            return
        with Progress("draws") as progress:
            sha256 = freeze(protocol, manifest_path(path), progress.update, self.workers)
        print(f"{sha256}  {manifest_path(path)}")


@dataclass(frozen=True)
class Reveal:
    """Prove that a sealed set is the committed one, and write its protocol and manifest for publication."""

    commitment: Path
    """Commitment that was published when the set was sealed."""
    secret_file: Path
    """File with the secret that the set was drawn from; it is only read."""
    out: Path
    """Folder to write the protocol and its manifest to."""
    protocol: str | None = None
    """Name or path of the public protocol; the released one that the commitment names when not given."""
    manifest: Path | None = None
    """The sealed .parquet file; it is drawn anew when not given."""
    sample: int = 30
    """Number of rows of the file given by --manifest that are drawn again to check it."""
    workers: int = field(default_factory=cores)
    """Number of worker processes that draw; the manifest does not depend on it."""

    def run(self) -> None:
        from wbc_bench.episodes.sealed import reveal
        from wbc_bench.progress import Progress

        at_least_one("--workers", self.workers)
        at_least_one("--sample", self.sample)
        with Progress("draws") as progress:
            path, sha256 = reveal(
                *(self.commitment, self.secret_file, self.out, self.protocol, self.manifest, self.sample),
                *(progress.update, self.workers),
            )
        print(f"{sha256}  {path.with_suffix('.parquet')}")
        how = "all of it was drawn anew" if self.manifest is None else "a sample of rows was drawn again"
        print(f"its hash is the committed one ({how}); publish {path}, its manifest and the secret")


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
        from wbc_bench.files import made_whole
        from wbc_bench.publish import target_frame
        from wbc_bench.results.figures.targets import write_targets

        protocol, path = find_protocol(self.name)
        print(f"# digest {protocol.digest}")
        print(msgspec.json.format(msgspec.json.encode(protocol), indent=2).decode())
        manifest, sha256 = read_manifest(protocol, manifest_path(path))
        print(f"# manifest sha256 {sha256}")
        print(target_frame(manifest).groupby("stratum").describe().T.to_string())
        with made_whole(self.out) as (made, paths):
            write_targets(target_frame(manifest), protocol.name, made)
        print(*paths, sep="\n")
