"""What the README shows works as it is printed there."""

import re
from pathlib import Path

from wbc_bench.episodes.manifest import manifest_path, read_manifest
from wbc_bench.episodes.protocol import find_protocol
from wbc_bench.evaluation.rollout import rollout
from wbc_bench.registry import load_controller
from wbc_bench.robot import load_robot

README = Path(__file__).parents[1] / "README.md"


def test_the_controller_of_the_readme_runs(tmp_path: Path) -> None:
    code = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert len(code) == 1
    file = tmp_path / "lean_from_readme.py"
    file.write_text(code[0])
    protocol, path = find_protocol("smoke_v1")
    rows, _ = read_manifest(protocol, manifest_path(path))
    controller = load_controller(f"{file}:Lean", load_robot(protocol.robot))
    batch = rollout(controller, protocol, rows.take(slice(2)))
    assert (batch.steps > 5).all()
    assert abs(batch.action[:, 0, 9]).max() > 0.1


def test_every_command_of_the_readme_exists() -> None:
    from wbc_bench.cli import main as cli

    source = Path(cli.__file__).read_text()
    for command in re.findall(r"^wbc-bench (\w+)", README.read_text(), re.MULTILINE):
        assert f'"{command}"' in source, command
