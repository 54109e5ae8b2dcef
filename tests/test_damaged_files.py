"""Damaged files: whatever is done to one, its reader answers in one line, and leaves the folder as it was."""

import traceback
from pathlib import Path

import pytest

pytest.importorskip("torch")
from damaged_readers import READERS, trial

TRIALS = 40  # of each reader; .ci/fuzz.py makes thousands


@pytest.mark.parametrize("name", READERS)
def test_damage_is_one_line(name: str, tmp_path: Path) -> None:
    sound = tmp_path / "sound"
    sound.mkdir()
    READERS[name].write(sound)
    READERS[name].read(sound)
    for seed in range(TRIALS):
        done, fault = trial(name, seed, sound, tmp_path / "damaged")
        assert fault is None, f"{done}\n{''.join(traceback.format_exception(fault))}"
