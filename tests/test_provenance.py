"""Digests: what computes an episode counts, and nothing else does."""

import os
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path
from types import SimpleNamespace

import pytest

from wbc_bench import provenance
from wbc_bench.controller import ControllerInfo
from wbc_bench.errors import ControllerError

ROOT = Path(__file__).parents[1]

DIGEST = """
import wbc_bench.evaluation.shard
from wbc_bench import provenance
from wbc_bench.registry import load_controller
from wbc_bench.robot import load_robot
print(provenance.software(load_controller({spec!r}, load_robot())).digest)
"""


@pytest.fixture(scope="module")
def copy(tmp_path_factory) -> Path:
    """The sources in a folder of their own, to be edited."""
    folder = tmp_path_factory.mktemp("copy")
    ignore = shutil.ignore_patterns("__pycache__", "*.parquet", "checkpoints")
    for name in ("wbc_bench", "baselines", "protocols"):
        shutil.copytree(ROOT / name, folder / name, ignore=ignore)
    return folder


def digest_in(folder: Path, spec: str, *more: Path) -> str:
    """Of a controller, by the code in a folder."""
    paths = ":".join(map(str, (folder, folder / "baselines", *more)))
    done = subprocess.run(
        [sys.executable, "-c", DIGEST.format(spec=spec)],
        cwd=folder,  # the first place that is searched
        env={"PYTHONPATH": paths, "PATH": ""},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def remark(path: Path) -> str:
    """Append a comment; the text before."""
    before = path.read_text()
    path.write_text(before + "# a remark\n")
    return before


@pytest.mark.parametrize(
    ("file", "counts"),
    [
        ("wbc_bench/results/figures/style.py", False),
        ("wbc_bench/results/tables/paper.py", False),
        ("wbc_bench/results/store.py", False),
        ("wbc_bench/viewer/live.py", False),
        ("wbc_bench/cli/main.py", False),
        ("wbc_bench/episodes/freeze.py", False),
        ("baselines/wbc_baselines/learned/training/trainer.py", False),
        ("baselines/wbc_baselines/ik/controller.py", False),
        ("wbc_bench/evaluation/simulation.py", True),
        ("wbc_bench/results/metrics.py", True),
        ("wbc_bench/robot/tron1_l5.toml", True),
        ("baselines/wbc_baselines/hold.py", True),
    ],
)
def test_a_remark_counts_where_an_episode_is_computed(copy, file, counts):
    before = digest_in(copy, "hold")
    text = remark(copy / file)
    try:
        assert (digest_in(copy, "hold") != before) == counts
    finally:
        (copy / file).write_text(text)
    assert digest_in(copy, "hold") == before


USERS = """
from pathlib import Path
import numpy as np
from wbc_bench.controller import ControllerInfo, JointCommand

HERE = Path(__file__).parent

class Mine:
    def __init__(self, robot):
        import helper  # inside a function
        self.info = ControllerInfo(
            "mine", frozenset({"proprioception"}), 0.02, "a test", files=(HERE / "weights.bin",)
        )

    def digest(self):
        return (HERE / "state").read_text()
"""


@pytest.mark.parametrize(
    ("file", "counts"),
    [("mine.py", True), ("helper.py", True), ("deeper.py", True), ("weights.bin", True), ("state", True),
     ("unrelated.py", False)],
)  # fmt: skip
def test_a_users_controller_counts_with_all_that_it_depends_on(tmp_path, file, counts):
    (tmp_path / "mine.py").write_text(USERS)
    (tmp_path / "helper.py").write_text("from deeper import GAIN\n")
    (tmp_path / "deeper.py").write_text("GAIN = 1\n")
    for name in ("weights.bin", "state", "unrelated.py"):
        (tmp_path / name).write_text("")
    spec = f"{tmp_path / 'mine.py'}:Mine"
    before = digest_in(ROOT, spec, tmp_path)
    remark(tmp_path / file)
    assert (digest_in(ROOT, spec, tmp_path) != before) == counts


class Declares:
    """A controller with a file."""

    def __init__(self, *files: Path) -> None:
        self.info = ControllerInfo("declares", frozenset(), 0.02, "a test", files=files)

    def act(self) -> None: ...


def test_a_declared_file_that_is_missing_is_named(tmp_path):
    with pytest.raises(ControllerError, match=r"nowhere\.bin.*info\.files"):
        provenance.software(Declares(tmp_path / "nowhere.bin"))
    os.mkfifo(tmp_path / "pipe")  # which would wait for its writer
    with pytest.raises(ControllerError, match=r"pipe'.* is not a file"):
        provenance.software(Declares(tmp_path / "pipe"))


def test_a_controller_inside_a_controller_counts(tmp_path):
    file = tmp_path / "weights"
    file.write_text("a")
    outer = Declares()
    outer.inner = Declares(file)  # type: ignore[attr-defined]
    before = provenance.software(outer).controller
    file.write_text("b")
    assert provenance.software(outer).controller != before


def test_imports_for_type_checkers_and_relative_ones(tmp_path, monkeypatch):
    package = tmp_path / "pack"
    (package / "inner").mkdir(parents=True)
    for name in ("__init__.py", "inner/__init__.py", "inner/near.py", "far.py", "typed.py", "loose.py"):
        (package / name).write_text("")
    (package / "inner" / "start.py").write_text(
        textwrap.dedent("""
        from typing import TYPE_CHECKING
        from . import near
        from ..far import x
        if TYPE_CHECKING:
            from pack.typed import y
        """)
    )
    (package / "far.py").write_text("x = 1\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    __import__("pack.inner.start")
    found = [path.relative_to(package).as_posix() for path in provenance.sources("pack.inner.start")]
    assert found == ["__init__.py", "far.py", "inner/__init__.py", "inner/near.py", "inner/start.py"]


def test_a_declared_file_whose_name_none_can_have_is_one_line():
    class Odd:
        info = SimpleNamespace(files=("a\0b",))

    with pytest.raises(ControllerError, match=r"'a\\x00b', declared in `info.files`, cannot be read"):
        provenance.software(Odd())
