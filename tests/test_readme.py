"""What README and documentation show works as it is printed there."""

import re
import tomllib
from pathlib import Path

import msgspec
import pytest

from wbc_bench.cli.main import main
from wbc_bench.cli.policy import term_table
from wbc_bench.cli.robot import joint_table
from wbc_bench.episodes.manifest import manifest_path, read_manifest
from wbc_bench.episodes.protocol import find_protocol
from wbc_bench.evaluation.rollout import rollout
from wbc_bench.policies.card import PolicyCard, check_card
from wbc_bench.registry import load_controller
from wbc_bench.robot import RobotConfig, load_robot

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
PAGES = [
    README,
    ROOT / "baselines" / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").glob("*.md")),
]
PROGRAMS = {
    "wbc-bench": ROOT / "wbc_bench" / "cli" / "main.py",
    "wbc-train": ROOT / "baselines" / "wbc_baselines" / "learned" / "training" / "cli.py",
}


def test_the_script_of_the_readme_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert len(code) == 1
    monkeypatch.chdir(ROOT)  # as its reader: in the checkout
    short = code[0].replace('"episodes": 20', '"episodes": 2').replace("build/readme", str(tmp_path))
    assert str(tmp_path) in short
    exec(compile(short, str(README), "exec"), {"__name__": "__main__"})
    printed = capsys.readouterr().out
    assert "| gentle_arm | 2/2 |" in printed
    assert "## nominal_v2: A = examples/own_controller.py:GentleArm against B = ik:standing\n" in printed


def test_the_controller_of_the_guide_runs() -> None:
    protocol, path = find_protocol("smoke_v1")
    rows, _ = read_manifest(protocol, manifest_path(path))
    controller = load_controller(f"{ROOT / 'docs' / 'snippets' / 'lean.py'}:Lean", load_robot(protocol.robot))
    batch = rollout(controller, protocol, rows.take(slice(2)))
    assert (batch.steps > 5).all()
    assert abs(batch.action[:, 0, 9]).max() > 0.1


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_of_a_page_exists(page: Path) -> None:
    code = "\n".join(re.findall(r"```.*?```|`[^`]+`", page.read_text(), re.DOTALL))
    for program, source in PROGRAMS.items():
        for command in re.findall(rf"\b{program} ([a-z]\w*)", code):
            assert f'"{command}"' in source.read_text(), f"{program} {command}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_of_a_page_into_the_repository_leads_somewhere(page: Path) -> None:
    text = page.read_text()
    for link in re.findall(r'\]\(([^)#\s]+)|src="([^"]+)"', text):
        target = "".join(link)
        assert "://" in target or (page.parent / target).exists(), target


def test_all_numbers_of_a_release_agree() -> None:
    """The version stands in four files."""
    from wbc_bench import __version__

    assert tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"] == __version__
    citation = (ROOT / "CITATION.cff").read_text()
    assert f"version: {__version__}\n" in citation
    date = re.search(r"date-released: (\S+)", citation)
    assert date and f"## {__version__} - {date[1]}\n" in (ROOT / "CHANGELOG.md").read_text()


@pytest.mark.parametrize(
    ("page", "variant"),
    [("README.md", "paper"), ("docs/robot.md", "paper"), ("docs/robot.md", "limx_adapter")],
)
def test_joint_tables_are_those_of_the_facts(page: str, variant: str) -> None:
    table = joint_table(load_robot(RobotConfig(variant=variant))).markdown()
    assert "\n".join(table.splitlines()[2:]) in (ROOT / page).read_text()


def test_joints_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    main(["robot", "show", "--joints", "--variant", "paper"])
    assert "| 3 | ankle_L_Joint | -1.15 to 1.57 | 0 | 0.6 | 45 | 0.8 | 40 | 15 |" in capsys.readouterr().out


def test_the_vocabulary_on_its_page_is_that_of_the_code() -> None:
    page = (ROOT / "docs" / "policies.md").read_text()
    assert "\n".join(term_table().markdown().splitlines()[2:]) in page


def test_the_card_on_its_page_is_one() -> None:
    text = re.findall(r"```toml\n(.*?)```", (ROOT / "docs" / "policies.md").read_text(), re.DOTALL)
    check_card(msgspec.toml.decode(text[0], type=PolicyCard), "docs/policies.md")
