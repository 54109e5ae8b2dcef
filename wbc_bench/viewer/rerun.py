"""An episode of a stored run once more: it is deterministic, so that its record is enough to see it."""

import shlex
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from wbc_bench.episodes.manifest import EpisodeManifest, manifest_path, read_manifest
from wbc_bench.episodes.protocol import EvalProtocol, find_protocol, protocol_names
from wbc_bench.errors import StoreError
from wbc_bench.evaluation.control_loop import ControlLoop
from wbc_bench.evaluation.rollout import rollout
from wbc_bench.evaluation.shard import episode_table
from wbc_bench.installed import is_installed
from wbc_bench.provenance import machine
from wbc_bench.readers import is_file
from wbc_bench.registry import load_controller, spec_of_replicate
from wbc_bench.results.store import ResultStore, Run
from wbc_bench.robot import Robot, load_robot
from wbc_bench.rotations import matrix_from_wxyz
from wbc_bench.viewer.moment import PUSH_SECONDS, Moment, moment_of

Row = dict[str, Any]
EVERY = 2  # control steps a picture of a film or a replay: 25 a second
ShowProgress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Rerun:
    """An episode as it was seen again."""

    run: Run
    protocol: EvalProtocol
    robot: Robot
    episode: int  # number inside the replicate
    stored: Row  # of episodes.parquet
    again: Row  # what the rerun measured
    drawn: EpisodeManifest  # (1) the episode's row
    moments: list[Moment]  # (T + 1) the start, and after every control step

    @property
    def title(self) -> str:
        """Which episode, in a few words."""
        of = self.run.record
        return f"{of.controller} · {of.protocol} · replicate {of.replicate} · episode {self.episode}"

    @property
    def differences(self) -> dict[str, tuple[Any, Any]]:
        """Column -> (stored, again) of what is not equal to the last bit; None for what is not measured."""
        pairs = {name: (value, self.again.get(name)) for name, value in self.stored.items()}
        return {name: pair for name, pair in pairs.items() if not _same(*pair)}

    @property
    def verdict(self) -> str:
        """One line: verified, or by how much it differs."""
        differences = self.differences
        if not differences:
            return f"verified: all {len(self.stored)} recorded values are the same to the last bit"
        there, here = self.run.record.machine.get("processor"), machine().get("processor")
        reason = f" (recorded on {there}, this is {here})" if there != here else ""
        changed = [f"{name} {b} (recorded {a})" for name, (a, b) in differences.items() if not _finite(a, b)]
        changes = {
            name: abs(b / a - 1) if a else abs(b) for name, (a, b) in differences.items() if _finite(a, b)
        }
        if changes:
            worst = max(changes, key=lambda name: changes[name])
            changed.append(f"{worst} by {changes[worst]:.1e} of its value, others less")
        same = "another outcome" if "outcome" in differences else "the same outcome"
        count = f"{len(differences)} of {len(self.stored)} values"
        return f"{same}, but {count} are not the same bits{reason}: {', '.join(changed)}"


def rerun(
    run: Run,
    episode: int,
    protocol_name: str | None = None,
    progress: ShowProgress | None = None,
    controller: str | None = None,
) -> Rerun:
    """Run one episode of a run again, and measure it as the run did.

    Alone first, which is fast: equal bits prove that it is the same episode. A controller that computes all
    episodes of its shard at once may round otherwise alone; then its whole shard is run. Where the run comes
    from another processor, which rounds in its own way, there are no bits to be gained by that.

    `protocol_name` names the .toml file of a protocol that is neither a released one nor kept beside the run.
    `controller` is the spec of the controller that shall run, as the user gives it; None for the one of the
    record, which must then be installed: a record comes from anywhere, and a file or module that it names is
    not run for that alone.

    Raises:
        StoreError: no such episode, the protocol or manifest is not the run's, or its controller is not an
            installed one.
        UnknownNameError, ProtocolError, ManifestError, ControllerError: what the run needs is not here.
    """
    record = run.record
    protocol, path = find_protocol(protocol_name or _protocol_of(run))
    manifest, sha256 = read_manifest(protocol, manifest_path(path))
    for what, here, there in (
        ("protocol digest", protocol.digest, record.protocol_digest),
        ("manifest sha256", sha256, record.manifest_sha256),
    ):
        if here != there:
            raise StoreError(f"'{run.path}' cannot be run again: its {what} is {there}, here it is {here}")
    rows = manifest.of_replicate(record.replicate, record.requested)
    found = np.flatnonzero(rows.episode == episode)
    if not len(found):
        raise StoreError(
            f"episode {episode} is not in '{run.path}', valid: {rows.episode.min()} to {rows.episode.max()}"
        )
    place = int(found[0])
    start = place - place % record.shard_episodes
    shard = slice(start, min(start + record.shard_episodes, len(rows)))
    stored = run.episodes().iloc[[place]].to_dict("records")[0]
    robot = load_robot(protocol.robot)
    if controller is None and not is_installed(record.controller):
        raise StoreError(
            f"'{run.path}' was made by '{record.controller}', which is not an installed controller: give "
            f"`--controller {shlex.quote(record.controller)}` to run that code"
        )
    spec = spec_of_replicate(controller or record.controller, record.replicate)

    def of(part: slice) -> Rerun:
        row = place - part.start
        moments, table = _watched(spec, robot, protocol, rows.take(part), row, progress)
        measured = table.slice(row, 1).to_pylist()[0]
        drawn = rows.take(slice(place, place + 1))
        return Rerun(run, protocol, robot, episode, stored, measured, drawn, moments)

    alone = of(slice(place, place + 1))
    elsewhere = record.machine.get("processor") != machine().get("processor")
    whole = shard.stop - shard.start == 1
    return alone if not alone.differences or elsewhere or whole else of(shard)


def _protocol_of(run: Run) -> str:
    """The protocol of a run: a released one, or the user's own as it was kept beside the runs."""
    kept = ResultStore(run.path.parents[3]).protocol_path(run.record.protocol)
    return str(kept) if run.record.protocol not in protocol_names() and is_file(kept) else run.record.protocol


def _watched(
    spec: str,
    robot: Robot,
    protocol: EvalProtocol,
    rows: EpisodeManifest,
    row: int,
    progress: ShowProgress | None,
) -> tuple[list[Moment], pa.Table]:
    """Episodes under a controller of their own, one of them watched."""
    pos_w, rot_w = rows.target_pos_w[row], matrix_from_wxyz(rows.target_quat_w[row])
    push_time = rows.push_time[row]  # [s] NaN for none
    push_vel = rows.push_vel[row].reshape(-1, 2)
    moments: list[Moment] = []

    def on_step(loop: ControlLoop) -> None:
        since = loop.step * loop.period - push_time  # [s]
        pushed = push_vel[(since > 0) & (since <= PUSH_SECONDS)].sum(axis=0)
        moments.append(moment_of(loop, row, pos_w, rot_w, pushed))
        if progress is not None:
            progress(loop.step, protocol.num_steps, "running the episode again")

    batch = rollout(load_controller(spec, robot), protocol, rows, on_step)
    seen = moments[: int(batch.steps[row]) + 1]
    return [moment for moment in seen if np.isfinite(moment.qpos).all()], episode_table(rows, batch)


def _same(a: Any, b: Any) -> bool:
    """Equal, where NaN equals NaN."""
    return a == b or (a != a and b != b)


def _finite(a: Any, b: Any) -> bool:
    return isinstance(a, float) and isinstance(b, float) and bool(np.isfinite([a, b]).all())
