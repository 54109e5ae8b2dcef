"""Kill evaluations at random and check what their stores hold: nothing lost, doubled or mixed.

    nice python .ci/kills.py --seconds 600       # --seed repeats a series of kills and changes

Each trial evaluates a cheap controller in 12 shards, with two processes of loky or of dask in turn. It is
killed (its process alone, or all of its group) while it starts, while shards are written, or at a merge. In
between, the controller's file, a module that it imports or a file of settings may change. After each kill
every finished replicate must be that of an evaluation that was never killed, of one of the versions there
were. What resumes must find all shards that were written. At the end the whole store must be that of the
present version. Exit code 1 when anything differs.
"""

import argparse
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
REPLICATES, EPISODES, SHARDS = 3, 200, 4  # shards of a replicate
LONGEST = 180.0  # [s] of one evaluation

CONTROLLER = """
import json
from pathlib import Path
import helper
import numpy as np
from wbc_bench.controller import ControllerInfo, JointCommand

SETTINGS = Path(__file__).with_name("settings.json")

class Mine:
    info = ControllerInfo("mine", frozenset({{"proprioception"}}), 0.02, "kills", (SETTINGS,))

    def __init__(self, robot):
        self.q = robot.default_q + 0.02 * {controller} + json.loads(SETTINGS.read_text())["offset"]

    def reset(self, episodes, obs, target):
        pass

    def act(self, obs, target):
        return JointCommand(0.9 * self.q + helper.SHARE * obs.proprioception.joint_pos)
"""
Version = tuple[int, int, int]  # of controller, helper and settings, each 0 or 1


class Trials:
    """Evaluations in folders below `scratch`, and what those that were never killed gave."""

    def __init__(self, scratch: Path, rng: np.random.Generator) -> None:
        from tiny_protocol import write_tiny

        self._scratch, self._rng, self.counts = scratch, rng, Counter()
        self._protocol = write_tiny(scratch, REPLICATES, EPISODES)
        self._code = scratch / "code"
        self._code.mkdir()
        self._wanted: dict[Version, dict[int, bytes]] = {}
        self.version: Version = (0, 0, 0)
        self._evaluations = 0
        self._write()

    def run(self, number: int) -> None:
        """One store, killed one to five times, and finished. Raises: AssertionError, something differs."""
        store, engine = self._scratch / f"store_{number}", ("loky", "dask")[number % 2]
        versions, overwrite = {self.version}, False
        for _ in range(self._rng.integers(1, 6)):
            written = _shards(store)
            killed, code, said = self._killed(store, engine, overwrite)
            self._check_resumed(written, said, overwrite)
            self._check_finished(store, versions)
            if not killed and code == 2:  # another version stands there: it must be said, in one line
                assert len(versions) > 1 and "--overwrite" in said, said
                overwrite = True
            elif not killed:
                assert code == 0, said
            if self._rng.random() < 0.4:
                self._change()
                versions.add(self.version)
                overwrite = False
        code, said = self._finish(store, engine, overwrite)
        if code == 2:
            assert len(versions) > 1 and "--overwrite" in said, said
            self.counts["refused to mix"] += 1
            code, said = self._finish(store, engine, True)
        assert code == 0, said
        assert self._check_finished(store, {self.version}) == REPLICATES
        left = [path for path in store.rglob("*") if path.suffix == ".tmp" or "shards" in path.parts]
        assert not left, left
        self.counts[f"stores whole, {engine}"] += 1

    def _killed(self, store: Path, engine: str, overwrite: bool) -> tuple[bool, int, str]:
        """Begin an evaluation and kill it; whether that was possible, its exit code and what it said."""
        rng, phase = self._rng, str(self._rng.choice(["start", "middle", "merge"]))
        said = self._heard()
        with said.open("w") as file:
            process = self._begin(store, engine, overwrite, file)
        end = time.monotonic() + (rng.uniform(0.0, 4.0) if phase == "start" else LONGEST)
        begun, enough = sum(map(len, _shards(store).values())), rng.integers(1, REPLICATES * SHARDS)
        records = _records(store)
        while process.poll() is None and time.monotonic() < end:
            now = _shards(store)
            if phase == "middle" and sum(map(len, now.values())) >= begun + enough:
                break
            if phase == "merge" and (_records(store) != records or SHARDS in map(len, now.values())):
                time.sleep(rng.uniform(0.0, 0.03))
                break
            time.sleep(0.001)
        if process.poll() is None:
            if rng.random() < 0.5:
                os.killpg(process.pid, signal.SIGKILL)
            else:  # its workers see that it is gone, and leave
                process.kill()
            process.wait()
            self.counts[f"{engine}, {phase}"] += 1
            return True, -signal.SIGKILL, said.read_text()
        return False, process.returncode, said.read_text()

    def _heard(self) -> Path:
        """A new file for what an evaluation says: the orphans of a killed one go on to write to theirs."""
        self._evaluations += 1
        return self._scratch / f"stderr_{self._evaluations}"

    def _finish(self, store: Path, engine: str, overwrite: bool) -> tuple[int, str]:
        written, said = _shards(store), self._heard()
        with said.open("w") as file:
            code = self._begin(store, engine, overwrite, file).wait(LONGEST)
        self._check_resumed(written, said.read_text(), overwrite)
        return code, said.read_text()

    def _begin(self, store: Path, engine: str, overwrite: bool, said) -> subprocess.Popen:
        words = ["--controller", f"{self._code / 'killed.py'}:Mine", "--protocol", str(self._protocol)]
        words += ["--out", str(store), "--workers", "2", "--engine", engine]
        words += ["--overwrite"] if overwrite else []
        command = [sys.executable, "-m", "wbc_bench", "eval", *words]
        return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=said, start_new_session=True)

    def _check_resumed(self, written: dict[int, list[str]], said: str, overwrite: bool) -> None:
        """No shard that was written is computed again by the same version."""
        for replicate, total in re.findall(r"replicate (\d+): resumed after (\d+) of", said):
            found = len(written.get(int(replicate), []))
            assert int(total) == found or (overwrite and int(total) <= found), f"{total} of {found} shards"
            self.counts["resumed replicates"] += 1

    def _check_finished(self, store: Path, versions: set[Version]) -> int:
        """Every finished replicate is one that was never killed; how many there are."""
        records = _records(store)
        for replicate, path in records.items():
            data = path.with_name("episodes.parquet").read_bytes()
            assert any(data == self.wanted(version)[replicate] for version in versions), (
                f"{path.parent}: replicate {replicate} is none of {len(versions)} versions"
            )
        return len(records)

    def wanted(self, version: Version) -> dict[int, bytes]:
        """Episodes of the replicates of an evaluation of a version that was never killed, in one process."""
        if version not in self._wanted:
            now, self.version = self.version, version
            self._write()
            store = self._scratch / f"unkilled_{len(self._wanted)}"
            command = [sys.executable, "-m", "wbc_bench", "eval", "--out", str(store), "--workers", "1"]
            command += ["--controller", f"{self._code / 'killed.py'}:Mine", "--protocol", str(self._protocol)]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            paths = {k: path.with_name("episodes.parquet") for k, path in _records(store).items()}
            self._wanted[version] = {k: path.read_bytes() for k, path in paths.items()}
            self.version = now
            self._write()
        return self._wanted[version]

    def _change(self) -> None:
        part = self._rng.integers(3)
        self.version = tuple(1 - x if k == part else x for k, x in enumerate(self.version))  # pyright: ignore
        self.counts[f"changed {('the controller', 'a module it imports', 'a setting')[part]}"] += 1
        self._write()

    def _write(self) -> None:
        controller, helper, setting = self.version
        texts = {
            "killed.py": CONTROLLER.format(controller=controller),
            "helper.py": f"SHARE = {(0.1, 0.2)[helper]}\n",
            "settings.json": f'{{"offset": {(0.0, 0.3)[setting]}}}\n',
        }
        for name, text in texts.items():
            path = self._code / name
            if not path.exists() or path.read_text() != text:
                path.write_text(text)


def _shards(store: Path) -> dict[int, list[str]]:
    """Replicate -> names of its shards."""
    while True:
        found: dict[int, list[str]] = {}
        try:
            for path in store.glob("runs/*/*/replicate_*/shards/shard_*.parquet"):
                found.setdefault(int(path.parents[1].name.removeprefix("replicate_")), []).append(path.name)
            return found
        except FileNotFoundError:  # merged while they were listed
            continue


def _records(store: Path) -> dict[int, Path]:
    """Replicate -> its record."""
    paths = store.glob("runs/*/*/replicate_*/run.json")
    return {int(path.parent.name.removeprefix("replicate_")): path for path in paths}


def _is_kill(name: str) -> bool:
    return name.startswith(("loky, ", "dask, "))


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=600.0, help="begin no trial after that time")
    parser.add_argument("--seed", type=int, default=0, help="of the kills and changes")
    options = parser.parse_args()
    sys.path[:0] = [str(ROOT / "tests" / "helpers"), str(ROOT), str(ROOT / "baselines")]
    os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), str(ROOT / "baselines")])
    failures, number, done, end = [], 0, 0, time.monotonic() + options.seconds
    with tempfile.TemporaryDirectory() as scratch:
        trials = Trials(Path(scratch), np.random.default_rng(options.seed))
        while time.monotonic() < end:
            try:
                trials.run(number)
            except AssertionError as error:
                failures.append(f"trial {number}: {error}")
                print(failures[-1], flush=True)
            number += 1
            done = sum(n for name, n in trials.counts.items() if _is_kill(name))
            print(f"{done} kills in {number} stores", file=sys.stderr, flush=True)
        for name, count in sorted(trials.counts.items()):
            print(f"{count:6d}  {name}")
    print(f"{done} kills in {number} stores, {len(failures)} stores with something lost, doubled or mixed")
    return bool(failures)


if __name__ == "__main__":
    sys.exit(main())
