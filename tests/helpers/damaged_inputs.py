"""Sound files that an evaluation begins with, and their readers: protocols, scripts, studies, code, facts."""

import shutil
import sys
import tempfile
from pathlib import Path

import msgspec
import numpy as np

from damage import reseal, sha256
from wbc_bench.episodes import ladder
from wbc_bench.episodes.kinds import kind_of
from wbc_bench.episodes.manifest import manifest_path, read_manifest
from wbc_bench.episodes.protocol import find_protocol, read_protocol
from wbc_bench.episodes.sealed import Commitment, read_commitment, reveal, seal
from wbc_bench.evaluation.rollout import rollout
from wbc_bench.files import PROTOCOLS
from wbc_bench.provenance import software
from wbc_bench.registry import load_controller
from wbc_bench.results.study import load_study
from wbc_bench.robot import load_robot
from wbc_bench.robot.facts import FACTS_FILE, load_facts
from wbc_bench.sources.scripted import load_script

SMOKE, SMOKE_FILE = find_protocol("smoke_v1")
SHORT = msgspec.structs.replace(SMOKE, episodes=msgspec.structs.replace(SMOKE.episodes, horizon=0.2))


def write_protocols(folder: Path) -> None:
    for name in ("smoke_v1", "reach_v1"):
        shutil.copy(PROTOCOLS / f"{name}.toml", folder)


def read_protocols(folder: Path) -> None:
    for path in sorted(folder.iterdir()):
        protocol = read_protocol(path)
        assert kind_of(protocol).num_rows(protocol) <= 100_000 and protocol.num_steps <= 30_000
        find_protocol(str(path))


def write_manifests(folder: Path) -> None:
    for suffix in ("parquet", "sha256"):
        shutil.copy(PROTOCOLS / f"smoke_v1.{suffix}", folder)


def read_manifests(folder: Path) -> None:
    path = folder / "smoke_v1.parquet"
    manifest, _ = read_manifest(SMOKE, path)
    assert len(manifest) == 12 and np.isfinite(manifest.target_pos_w).all()


def seal_manifests(folder: Path) -> None:
    (folder / "smoke_v1.sha256").write_text(f"{sha256(folder / 'smoke_v1.parquet')}  smoke_v1.parquet\n")


def write_commitments(folder: Path) -> None:
    commitment = Commitment(SMOKE.name, SMOKE.digest, "a" * 64, 12)
    (folder / "smoke_v1_sealed.commitment.json").write_bytes(msgspec.json.encode(commitment))


def read_commitments(folder: Path) -> None:
    for path in sorted(folder.iterdir()):
        commitment, _ = read_commitment(path)
        assert commitment.protocol == "smoke_v1" and commitment.episodes == 12


def write_sealed_set(folder: Path) -> None:
    (folder / "secret").write_bytes(bytes(range(32)))
    seal(SMOKE, folder / "secret", folder / "set")


def read_sealed_set(folder: Path) -> None:
    made = folder / "set" / f"{SMOKE.name}_sealed.parquet"
    with tempfile.TemporaryDirectory() as out:
        reveal(made.with_suffix(".commitment.json"), folder / "secret", Path(out), None, made, sample=1)


def seal_sealed_set(folder: Path) -> None:
    made = folder / "set" / f"{SMOKE.name}_sealed.parquet"
    reseal(made.with_suffix(".commitment.json"), "manifest_sha256", made)


def write_studies(folder: Path) -> None:
    for path in (PROTOCOLS / "studies").glob("*.toml"):
        shutil.copy(path, folder)


def read_studies(folder: Path) -> None:
    for path in sorted(folder.iterdir()):
        load_study(path)


def write_ladders(folder: Path) -> None:
    for path in ladder.FOLDER.glob("*.toml"):
        shutil.copy(path, folder)


def read_ladders(folder: Path) -> None:
    for path in sorted(folder.iterdir()):
        ladder.load_ladder(path)


def write_scripts(folder: Path) -> None:
    for path in (PROTOCOLS / "scripts").glob("*.toml"):
        shutil.copy(path, folder)


def read_scripts(folder: Path) -> None:
    for path in sorted(folder.iterdir()):
        load_script(path)


CODE = {
    "coded.py": """
from pathlib import Path
from coded_helper import SHARE
from wbc_bench.controller import ControllerInfo, JointCommand

SETTINGS = Path(__file__).with_name("coded.json")

class Mine:
    info = ControllerInfo("mine", frozenset({"proprioception"}), 0.02, "a test", (SETTINGS,))

    def __init__(self, robot):
        self.q = robot.default_q

    def reset(self, episodes, obs, target):
        self.calls = 0

    def act(self, obs, target):
        self.calls += 1
        return JointCommand((1 - SHARE) * self.q + SHARE * obs.proprioception.joint_pos)
""",
    "coded_helper.py": "SHARE = 0.5\n",
    "coded.json": '{"offset": 0.01}\n',
}


def write_code(folder: Path) -> None:
    for name, text in CODE.items():
        (folder / name).write_text(text)


def read_code(folder: Path) -> None:
    rows = read_manifest(SMOKE, manifest_path(SMOKE_FILE))[0].take(np.array([0, 1]))
    try:
        controller = load_controller(f"{folder / 'coded.py'}:Mine", load_robot())
        software(controller)
        rollout(controller, SHORT, rows)
    finally:
        sys.path[:] = [place for place in sys.path if place != str(folder)]
        for name in ("coded", "coded_helper"):
            sys.modules.pop(name, None)


def write_facts(folder: Path) -> None:
    shutil.copy(FACTS_FILE, folder)


def read_facts(folder: Path) -> None:
    load_facts.__wrapped__(path=folder / FACTS_FILE.name)
