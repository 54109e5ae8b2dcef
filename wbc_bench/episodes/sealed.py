"""Sealed episodes: an unpublished set of a protocol's distribution whose hash is published beforehand.

The seed of the set is derived from a secret, and all else is the protocol's, so its manifest is a function of
both alone. A commitment, which may be published at once, holds the SHA-256 of the manifest; with the secret
anybody can check later that the episodes were fixed before they were used.
"""

import hashlib
import hmac
from pathlib import Path
from typing import Annotated

import msgspec

from wbc_bench.episodes.freeze import freeze
from wbc_bench.episodes.kinds import kind_of
from wbc_bench.episodes.ladder import protocol_toml
from wbc_bench.episodes.manifest import check_robot, digest_made_for
from wbc_bench.episodes.protocol import EvalProtocol, check_protocol, find_protocol, protocol_names
from wbc_bench.episodes.targets import Progress
from wbc_bench.episodes.verify import verify
from wbc_bench.errors import BenchError
from wbc_bench.files import PROTOCOLS, SEALED, ensure_writable, real_path, scratch_folder, write_atomic
from wbc_bench.readers import decode_parquet, read_bytes, read_json

LEAST_SECRET = 16  # [B] 128 bits, which nobody can try one by one
Digest = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]


class SealError(BenchError):
    """Sealed episodes that cannot be drawn, or are not those of their commitment."""


class Commitment(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is published before the episodes are.

    It holds neither the seed nor a digest that is quickly made of it: 2^63 seeds could be tried one by one
    against the digest of the sealed protocol, but not against a manifest, which takes minutes to draw.
    """

    protocol: str  # name of the public protocol
    protocol_digest: Digest  # and its digest
    manifest_sha256: Digest  # of the sealed manifest
    episodes: int


def sealed_protocol(protocol: EvalProtocol, secret: bytes) -> EvalProtocol:
    """The protocol with all its fields but name, description and seed.

    The seed is the upper 63 bits of HMAC-SHA256 with the secret as key and the digest of `protocol` as
    message: one secret serves several protocols, and none of their seeds tells of another.

    Source: Krawczyk, Bellare & Canetti 1997, RFC 2104.

    Raises:
        SealError: The protocol is sealed already.
        ProtocolError: Its name leaves no room for the suffix.
    """
    if protocol.name.endswith(SEALED):
        raise SealError(
            f"protocol {protocol.name} is sealed already, valid: a public one, whose name does not end in "
            f"'{SEALED}'"
        )
    code = hmac.digest(secret, protocol.digest.encode(), "sha256")
    sealed = msgspec.structs.replace(
        protocol,
        name=protocol.name + SEALED,
        description=f"A sealed set of {protocol.name}: the same distribution, other draws.",
        episodes=msgspec.structs.replace(protocol.episodes, seed=int.from_bytes(code[:8], "big") >> 1),
    )
    check_protocol(sealed, f"{protocol.name}, sealed")
    return sealed


def read_secret(path: Path) -> bytes:
    """The bytes of a secret file, as they are.

    Raises:
        SealError: It cannot be read or is too short.
    """
    secret = read_bytes(path, "secret file", SealError)
    if len(secret) < LEAST_SECRET:
        raise SealError(f"secret file '{path}' has {len(secret)} bytes, valid: at least {LEAST_SECRET}")
    return secret


def seal(
    protocol: EvalProtocol,
    secret_file: Path,
    out: Path,
    progress: Progress = lambda done, total: None,
    workers: int = 1,
) -> tuple[Path, str]:
    """Draw a sealed set and write its protocol, manifest, hash and commitment; equal for any `workers`.

    Args:
        protocol: The public protocol.
        secret_file: At least 16 bytes that nobody else knows.
        out: Folder to write to, none of released protocols; files in it of other content are kept.
        progress: Told of every episode.
        workers: Number of processes.

    Returns:
        The commitment's file, and the SHA-256 of the manifest.

    Raises:
        SealError: The secret or the protocol is not valid, or a file of other content is in the way.
        StoreError: The folder cannot be written.
        ProtocolError: See `freeze`.
    """
    sealed = sealed_protocol(protocol, read_secret(secret_file))
    _open(out, sealed)
    data = _draw(sealed, out, progress, workers)
    sha256 = hashlib.sha256(data).hexdigest()
    commitment = Commitment(protocol.name, protocol.digest, sha256, kind_of(protocol).num_rows(protocol))
    file = f"{sealed.name}.commitment.json"
    text = msgspec.json.format(msgspec.json.encode(commitment), indent=2) + b"\n"
    _place(out, {**_files(sealed, data), file: text})
    return out / file, sha256


def read_commitment(path: Path, protocol: str | None = None) -> tuple[Commitment, EvalProtocol]:
    """A commitment and its public protocol.

    Args:
        path: The commitment.
        protocol: Name or file of the protocol; the released one that the commitment names when not given.

    Raises:
        SealError: The commitment cannot be read, or is of another protocol.
        UnknownNameError, ProtocolError: See `find_protocol`.
    """
    commitment = read_json(path, Commitment, "commitment", SealError)
    if protocol is None and commitment.protocol not in protocol_names():
        raise SealError(
            f"commitment '{path}' is of '{commitment.protocol[:200]}', which is no released protocol: give "
            "its file with --protocol"
        )
    public, where = find_protocol(protocol or commitment.protocol)
    if (commitment.protocol, commitment.protocol_digest) != (public.name, public.digest):
        raise SealError(
            f"commitment '{path}' is of protocol {commitment.protocol[:200]} with digest "
            f"{commitment.protocol_digest[:16]}..., '{where}' is {public.name} with {public.digest[:16]}..."
        )
    if commitment.episodes != kind_of(public).num_rows(public):
        raise SealError(
            f"commitment '{path}' is of {commitment.episodes} episodes, valid: "
            f"{kind_of(public).num_rows(public)}, those of {public.name}"
        )
    return commitment, public


def reveal(
    commitment_file: Path,
    secret_file: Path,
    out: Path,
    protocol: str | None = None,
    manifest: Path | None = None,
    sample: int = 30,
    progress: Progress = lambda done, total: None,
    workers: int = 1,
) -> tuple[Path, str]:
    """Prove that a sealed set is the committed one, and write its protocol, manifest and hash.

    Args:
        commitment_file: The commitment that was published.
        secret_file: The secret that the set was drawn from.
        out: Folder to write to, as of `seal`.
        protocol: See `read_commitment`.
        manifest: The sealed manifest. It is drawn anew when not given, which proves all of it, but gives the
            same bytes only on a like processor and with the same versions of NumPy and pyarrow.
        sample: Rows of a given manifest that are drawn again; its hash decides which.
        progress: Told of every episode drawn.
        workers: Number of processes.

    Returns:
        The protocol's file, and the SHA-256 of the manifest.

    Raises:
        SealError: The hash is not the committed one, the episodes are not those of protocol and secret, or a
            file of other content is in the way.
        StoreError: The folder cannot be written.
        UnknownNameError, ProtocolError: See `find_protocol`.
    """
    commitment, public = read_commitment(commitment_file, protocol)
    sealed = sealed_protocol(public, read_secret(secret_file))
    given = None if manifest is None else read_bytes(manifest, "manifest", SealError)
    if given is not None:
        _check_hash(given, commitment, f"manifest '{manifest}'", "it is another one or was changed")
    _open(out, sealed)
    if given is None or manifest is None:
        data = _draw(sealed, out, progress, workers)
        why = (
            "the secret is another one, or floating point rounds differently here: give the sealed file with"
        )
        _check_hash(data, commitment, f"the manifest drawn from '{secret_file}'", f"{why} --manifest")
    else:
        data = given
        _check_values(data, manifest, sealed, out, sample)
    _place(out, _files(sealed, data))
    return out / f"{sealed.name}.toml", commitment.manifest_sha256


def _draw(sealed: EvalProtocol, out: Path, progress: Progress, workers: int) -> bytes:
    """The sealed manifest's file."""
    with scratch_folder(out) as folder:
        path = folder / f"{sealed.name}.parquet"
        freeze(sealed, path, progress, workers)
        return path.read_bytes()


def _check_hash(data: bytes, commitment: Commitment, what: str, why: str) -> None:
    sha256 = hashlib.sha256(data).hexdigest()
    if sha256 != commitment.manifest_sha256:
        raise SealError(
            f"{what} has sha256 {sha256[:16]}..., the commitment says {commitment.manifest_sha256[:16]}...: "
            f"{why}"
        )


def _check_values(data: bytes, path: Path, sealed: EvalProtocol, out: Path, sample: int) -> None:
    """Raises: SealError, ManifestError: the episodes of a committed file are not those of the secret."""
    table = decode_parquet(data, path, "manifest", SealError)
    made_for = digest_made_for(table)
    if made_for != sealed.digest:
        raise SealError(
            f"manifest '{path}' is the committed one, but was not drawn from this secret: it was made for "
            f"protocol digest {made_for[:16] or 'none'}..., the secret gives {sealed.digest[:16]}..."
        )
    remedy = "reveal it with the version of wbc-bench that sealed it"
    check_robot(table, sealed, f"manifest '{path}'", remedy)
    with scratch_folder(out) as folder:
        for name, content in _files(sealed, data).items():
            (folder / name).write_bytes(content)
        copy = folder / f"{sealed.name}.parquet"
        # The rows depend on the bytes: whoever made the file could not leave out those that are looked at.
        seed = int(hashlib.sha256(data).hexdigest()[:15], 16)
        failed = [check for check in verify(sealed, copy, sample, seed) if not check.ok]
    if failed:
        wrong = "; ".join(f"{check.name}: {check.detail}" for check in failed).replace(str(copy), str(path))
        raise SealError(f"manifest '{path}' is the committed one, but not what the secret draws: {wrong}")


def _files(sealed: EvalProtocol, data: bytes) -> dict[str, bytes]:
    """Name -> content of a sealed protocol, its manifest and its hash."""
    name = sealed.name
    note = f"{hashlib.sha256(data).hexdigest()}  {name}.parquet\n"
    return {
        f"{name}.toml": protocol_toml(sealed).encode(),
        f"{name}.parquet": data,
        f"{name}.sha256": note.encode(),
    }


def _open(out: Path, sealed: EvalProtocol) -> None:
    """Refuse a folder before minutes are spent on what cannot be kept there."""
    if real_path(out).is_relative_to(real_path(PROTOCOLS)):
        raise SealError(f"folder '{out}' is that of released protocols, valid: a folder of your own")
    ensure_writable(out)
    _refuse_other(out, {f"{sealed.name}.toml": protocol_toml(sealed).encode()})


def _refuse_other(out: Path, files: dict[str, bytes]) -> None:
    """Raises: SealError, a file of one of the names has another content."""
    for name, data in files.items():
        path = out / name
        if path.exists() and read_bytes(path, "file", SealError) != data:
            raise SealError(f"file '{path}' has another content and is not overwritten: choose another --out")


def _place(out: Path, files: dict[str, bytes]) -> None:
    """Write files, or keep those of equal content; nothing is written where one of them is another's."""
    _refuse_other(out, files)
    for name, data in files.items():
        if not (out / name).exists():
            write_atomic(out / name, data)
