"""A source by its name."""

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING

from wbc_bench.episodes.protocol import EvalProtocol, find_protocol
from wbc_bench.errors import SourceError, UnknownNameError, missing_extra
from wbc_bench.files import PROTOCOLS
from wbc_bench.sources.interface import Source
from wbc_bench.sources.live import LIVE, LiveSource
from wbc_bench.sources.recorded.files import is_recording, load_recording
from wbc_bench.sources.recorded.recording import RecordedSource
from wbc_bench.sources.replayed_stream import ReplayedStream
from wbc_bench.sources.scripted import Script, ScriptedSource, load_script
from wbc_bench.sources.stream import ADDRESS, StreamSource
from wbc_bench.sources.stream_filter import StreamConfig

if TYPE_CHECKING:
    from wbc_bench.sources.diffusion.policy import DoorPolicyCard, Policy

SCRIPTS = PROTOCOLS / "scripts"
POLICY = Path(__file__).parent / "diffusion" / "door.safetensors"  # of `diffusion` without a file


def script_names() -> list[str]:
    """Names of the library of scripts."""
    return sorted(path.stem for path in SCRIPTS.glob("*.toml"))


def source_names() -> list[str]:
    """Everything that `load_source` knows by name, as far as it is not a stream of a script."""
    return [*script_names(), LIVE, "stream", "diffusion"]


def find_script(name: str) -> Script:
    """A script of the library, or of a .toml file.

    Raises: UnknownNameError (with the nearest names), SourceError.
    """
    if name.endswith(".toml"):
        return load_script(Path(name))
    if name not in script_names():
        raise UnknownNameError(
            "source", name, source_names(), "--source; or give the file of a script or a recording"
        )
    return load_script(SCRIPTS / f"{name}.toml")


def recorded_name(name: str, digest: str | None) -> str:
    """The name of a source in a record: what does not ship under a name carries the beginning of its digest.

    So two scripts or two policies of one name never replace each other, and are never averaged.
    """
    if digest is None or digest in _shipped_digests(name.removeprefix("stream:")):
        return name
    return f"{name}@{digest[:8]}"


def _shipped_digests(name: str) -> set[str]:
    if name == "diffusion":
        return {hashlib.sha256(POLICY.read_bytes()).hexdigest()}
    return {find_script(name).digest} if name in script_names() else set()


def check_source(name: str) -> None:
    """Whether `load_source` knows a name, without opening anything.

    Raises: UnknownNameError (with the nearest names), SourceError.
    """
    if _is_diffusion(name):
        find_policy(name.partition(":")[2])
    elif is_recording(name):
        load_recording(name)
    elif name not in (LIVE, "stream"):
        find_script(name.removeprefix("stream:"))


def load_source(
    name: str,
    address: str = ADDRESS,
    allow_remote: bool = False,
    protocol: EvalProtocol | None = None,
    config: StreamConfig = StreamConfig(),  # noqa: B008  (immutable)
) -> Source:
    """The source of a name: `live`, `stream`, a script of the library or of a .toml file, `stream:SCRIPT`,
    a recording (see `recorded.files`), or `diffusion[:FILE]`, which stands in front of the first door of the
    protocol's seed.

    Address, `allow_remote` and `config` are those of a stream.

    Raises: UnknownNameError (with the nearest names), SourceError.
    """
    if _is_diffusion(name):
        policy, _, digest = find_policy(name.partition(":")[2])  # first: it says what is not installed
        from wbc_bench.sources.diffusion.scene import draw_door
        from wbc_bench.sources.diffusion.source import DiffusionSource

        protocol = protocol or find_protocol("ablation_v1")[0]
        seed = protocol.episodes.seed
        return DiffusionSource(policy, draw_door(protocol, seed, 0), seed, digest=digest)
    if is_recording(name):
        return RecordedSource(load_recording(name))
    if name == LIVE:
        return LiveSource()
    if name == "stream":
        return StreamSource(address, config, allow_remote)
    if name.startswith("stream:"):
        script = ScriptedSource(find_script(name.removeprefix("stream:")))
        return ReplayedStream(script, StreamSource(address, config, allow_remote))
    return ScriptedSource(find_script(name))


def find_policy(file: str = "") -> "tuple[Policy, DoorPolicyCard, str]":
    """The diffusion policy of a file, by default the packaged one, its card and its SHA-256.

    Raises: SourceError when the file is missing or damaged, or torch or safetensors is not installed.
    """
    try:
        from wbc_bench.sources.diffusion.policy import load_policy
    except ImportError as error:
        raise SourceError(missing_extra("a diffusion policy", "diffusion", error)) from error
    return load_policy(Path(file) if file else POLICY)


def _is_diffusion(name: str) -> bool:
    return name.partition(":")[0] == "diffusion"
