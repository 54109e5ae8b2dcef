"""`wbc-bench track` and `live`: a controller follows a moving target."""

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro
from tyro.conf import FlagCreatePairsOff

from wbc_bench.errors import UnknownNameError

if TYPE_CHECKING:
    from wbc_bench.results.tracking import Tracked
    from wbc_bench.sources.stream_filter import StreamConfig
from wbc_bench.cli.common import RESULTS, UsageError, check_port, drawing, host, not_negative, print_table

Silence = Literal["retreat", "hold"]


@dataclass(frozen=True)
class Track:
    """Let controllers follow moving targets, one simulated episode each, and score how."""

    controller: tuple[str, ...] = tyro.MISSING
    """Controllers to score, each a name, name:variant, module:attribute or file.py:attribute."""
    source: tuple[str, ...] = tyro.MISSING
    """Sources of the target, each the name of a released script, the path of a .toml file, `stream`,
    `stream:SCRIPT` to send a script through a stream, `diffusion[:FILE]` for a policy in front of a door,
    FILE?KEY=VALUE&... for a recorded trajectory (.csv, .parquet, .zarr.zip, .pkl, or the folder of a LeRobot
    dataset; keys episode, rate, frame, tool, feature), or `live` for a person who drags the target in a
    page."""
    duration: float | None = None
    """Duration of each episode [s]; when not given, that of the script, and 20 s for other sources."""
    seed: int = 0
    """Seed of the draws of a randomised episode, and of the door."""
    condition: str = "nominal"
    """Condition of the episodes: nominal, or randomised (friction, mass, gains, reset state, pushes and noise
    of ablation_v1)."""
    address: str = "tcp://127.0.0.1:5601"
    """ZeroMQ address at which a stream listens."""
    on_silence: Silence = "retreat"
    """What the target of a stream does after 5 s without an accepted message: go back to where the hand was
    at the start, or stay where it is in the world."""
    port: int = 8080
    """TCP port of the page of `live`, 1 to 65535."""
    allow_remote: FlagCreatePairsOff[bool] = False
    """Let other machines reach the stream or the page, and move the robot."""
    out: Path = RESULTS
    """Folder to write records, table and figure to."""

    def run(self) -> None:
        drawing()
        from wbc_bench.episodes.single import CONDITIONS
        from wbc_bench.files import ensure_writable
        from wbc_bench.publish import publish_tracks
        from wbc_bench.registry import load_controller
        from wbc_bench.results.tracking import read_tracks, tracking_table, write_track
        from wbc_bench.robot import load_robot
        from wbc_bench.sources.live import LIVE
        from wbc_bench.sources.registry import check_source

        for option, given in (("--controller", self.controller), ("--source", self.source)):
            if not given:
                raise UsageError(f"{option}: give at least one")
        not_negative("--seed", self.seed)
        check_port(self.port)
        if self.condition not in CONDITIONS:
            raise UnknownNameError("condition", self.condition, CONDITIONS, "--condition")
        for name in self.source:
            check_source(name)
        for spec in self.controller:
            load_controller(spec, load_robot())
        ensure_writable(self.out)
        for name in dict.fromkeys(self.source):
            for spec in dict.fromkeys(self.controller):
                tracked, facts = self._drag(spec) if name == LIVE else self._play(name, spec)
                write_track(self.out, tracked, **facts)
        publish_tracks(self.out, self.out)
        print_table(tracking_table(read_tracks(self.out)))
        print(f"record, table and figure are under {self.out}")

    def _play(self, name: str, spec: str) -> "tuple[Tracked, dict]":
        """Let a controller follow a source of a name; the series, and what the record says beside it."""
        from wbc_bench.episodes.single import door_protocol
        from wbc_bench.errors import SourceError
        from wbc_bench.evaluation.tracking import counters_text, facts, track
        from wbc_bench.registry import load_controller
        from wbc_bench.robot import load_robot
        from wbc_bench.sources.registry import load_source

        controller = load_controller(spec, load_robot())
        stream = _stream(self.on_silence)
        source = load_source(name, self.address, self.allow_remote, door_protocol(self.seed), stream)
        if self.allow_remote and source.live:
            print(f"listening on {self.address}: whoever can send there moves the robot", file=sys.stderr)
        try:
            tracked, asked = track(controller, source, self.condition, self.seed, self.duration)
        except SourceError as error:
            raise UsageError(f"--source {name}: {error}") from error
        finally:
            source.close()
        if source.counters:
            print(f"{spec}, {name}: {counters_text(source.counters)}")
        return tracked, facts(controller, spec, source, self.condition, self.seed) | {"requested_s": asked}

    def _drag(self, spec: str) -> "tuple[Tracked, dict]":
        """Let a controller follow what a person drags in a page; as `_play`."""
        from wbc_bench.episodes.single import UNSCRIPTED, episode_of
        from wbc_bench.evaluation.tracking import facts
        from wbc_bench.sources.live import LIVE
        from wbc_bench.viewer.live import serve
        from wbc_bench.viewer.session import Session

        asked = UNSCRIPTED if self.duration is None else self.duration
        session = Session(spec, LIVE, *episode_of(asked, self.seed, self.condition))

        def ready(url: str) -> None:
            print(f"{url}: drag the target there; {asked:g} s from the first drag on are scored", flush=True)

        serve(host(self.allow_remote), self.port, session, ready, once=True)
        what = facts(session.controller, spec, session.source, self.condition, self.seed)
        return session.tracked, what | {"requested_s": asked}


@dataclass(frozen=True)
class Live:
    """Watch a controller in the browser, in real time, and drag its target."""

    controller: str = tyro.MISSING
    """Controller to watch: name, name:variant, module:attribute or file.py:attribute."""
    source: str = "live"
    """Source of the target: `live`, where it is dragged in the page, or any other that `track` takes."""
    protocol: str = "ablation_v1"
    """Name of a protocol, or path of its .toml file, whose physics, randomisation, noise and limits apply."""
    condition: str = "nominal"
    """Condition of the episode: nominal, or randomised (friction, mass, gains, reset state and noise of the
    protocol)."""
    seed: int = 0
    """Seed of the draws of a randomised episode."""
    on_silence: Silence = "retreat"
    """What the target of a stream does after 5 s without an accepted message: go back to where the hand was
    at the start, or stay where it is in the world."""
    port: int = 8080
    """TCP port of the page, 1 to 65535."""
    allow_remote: FlagCreatePairsOff[bool] = False
    """Let other machines open the page, and move the robot."""

    def run(self) -> None:
        drawing()
        from wbc_bench.episodes.single import LONGEST, free_episode
        from wbc_bench.viewer.live import serve
        from wbc_bench.viewer.session import Session

        check_port(self.port)
        not_negative("--seed", self.seed)
        episode = free_episode(self.protocol, self.condition, self.seed, LONGEST)
        session = Session(self.controller, self.source, *episode, _stream(self.on_silence))

        def ready(url: str) -> None:
            print(f"{url}  (Ctrl-C ends it)", flush=True)

        try:
            serve(host(self.allow_remote), self.port, session, ready)
        except KeyboardInterrupt:
            print()


def _stream(on_silence: Silence) -> "StreamConfig":
    """What a stream does, with the option for its silence."""
    from wbc_bench.sources.stream_filter import StreamConfig

    return StreamConfig(retreat_after=math.inf) if on_silence == "hold" else StreamConfig()
