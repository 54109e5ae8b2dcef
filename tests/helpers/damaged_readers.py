"""Every reader of files on damaged ones: what is not an error of this package in one line is a fault.

Used by a short test of the suite and by the long run of `.ci/fuzz.py`.
"""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

import damaged_cards as cards
import damaged_inputs as inputs
import damaged_recordings as recordings
import damaged_records as records
import damaged_training as learned
from damage import damage
from wbc_bench.errors import BenchError


class Reader(NamedTuple):
    """A reader, the sound files that it reads, and how their hashes are made to fit damaged ones."""

    write: Callable[[Path], None]
    read: Callable[[Path], object]
    seal: Callable[[Path], None] = lambda folder: None


READERS = {
    "protocol": Reader(inputs.write_protocols, inputs.read_protocols),
    "manifest": Reader(inputs.write_manifests, inputs.read_manifests, inputs.seal_manifests),
    "commitment": Reader(inputs.write_commitments, inputs.read_commitments),
    "sealed set": Reader(inputs.write_sealed_set, inputs.read_sealed_set, inputs.seal_sealed_set),
    "study": Reader(inputs.write_studies, inputs.read_studies),
    "ladder": Reader(inputs.write_ladders, inputs.read_ladders),
    "submission": Reader(records.write_submissions, records.read_submissions),
    "climb": Reader(records.write_climbs, records.read_climbs, records.seal_climbs),
    "script": Reader(inputs.write_scripts, inputs.read_scripts),
    "code": Reader(inputs.write_code, inputs.read_code),
    "facts": Reader(inputs.write_facts, inputs.read_facts),
    "run": Reader(records.write_runs, records.read_runs, records.seal_runs),
    "shards": Reader(records.write_shards, records.read_shards),
    "replay": Reader(records.write_replayed, records.read_replayed, records.seal_replayed),
    "track": Reader(records.write_tracks, records.read_all_tracks, records.seal_tracks),
    "doors": Reader(records.write_door_runs, records.read_door_runs, records.seal_door_runs),
    "report": Reader(records.write_report_parts, records.read_report_parts),
    "checkpoint": Reader(learned.write_checkpoint, learned.read_checkpoint, learned.seal_checkpoint),
    "onnx": Reader(learned.write_exported, learned.read_exported, learned.seal_exported),
    "policy card": Reader(cards.write_policy_card, cards.read_policy_card),
    "door policy": Reader(learned.write_door_policy, learned.read_door_policy),
    "training": Reader(learned.write_training, learned.read_training),
    "targets": Reader(learned.write_targets, learned.read_targets),
    "recordings": Reader(recordings.write_recordings, recordings.read_recordings),
    "demonstrations": Reader(learned.write_demonstration_files, learned.read_demonstration_files),
}


def contents(folder: Path) -> dict[str, tuple]:
    """Every file below a folder, and what it holds."""
    return {
        str(path.relative_to(folder)): (path.stat().st_size, path.read_bytes())
        if path.is_file()
        else (path.is_symlink(), path.is_dir())
        for path in sorted(folder.rglob("*"))
    }


def trial(name: str, seed: int, sound: Path, folder: Path) -> tuple[str, BaseException | None]:
    """Damage a copy of sound files and read it; what was done, and the fault if reading was no clean answer.

    Args:
        name: Of the reader.
        seed: Of the damage.
        sound: Sound files, written by the reader's `write`.
        folder: Where to copy them; it is removed afterwards.
    """
    reader, rng = READERS[name], np.random.default_rng(seed)
    shutil.copytree(sound, folder)
    try:
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        done = []
        for _ in range(rng.choice([1, 1, 1, 2])):
            path = files[rng.integers(len(files))]
            if path.is_file() and not path.is_symlink():
                done.append(f"{damage(rng, path)} in {path.relative_to(folder)}")
        if rng.random() < 0.7 and all(path.is_file() for path in files):
            reader.seal(folder)
        text, before = f"{name}, seed {seed}: {', '.join(done)}", contents(folder)
        try:
            reader.read(folder)
        except BenchError as error:
            if "\n" in str(error) or len(str(error)) > 2000:
                return text, error
        except Exception as error:
            return text, error
        if contents(folder) != before:
            return text, AssertionError("reading wrote or removed a file")
        return text, None
    finally:
        shutil.rmtree(folder)
