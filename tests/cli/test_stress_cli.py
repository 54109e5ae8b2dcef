"""`wbc-bench stress`: what it prints, what it writes, and every mistake in one line."""

from pathlib import Path

import pytest

from commands import fails
from tiny_ladder import write_ladder
from wbc_bench.cli.main import main


@pytest.fixture
def tiny(tmp_path) -> Path:
    return write_ladder(tmp_path)


def words(ladder: object, out: Path, *more: object, controller: str = "hold") -> list[str]:
    given = ["stress", "--controller", controller, "--ladder", ladder, "--out", out, "--workers", 1, *more]
    return [str(word) for word in given]


def test_a_ladder_from_start_to_report(capsys, tiny, tmp_path):
    out = tmp_path / "out"
    main(words(tiny, out, "--episodes", 2, "--factors", "noise", "delay"))
    text = capsys.readouterr().out
    assert "## climb: breaking points" in text and "| 2/3 |" in text
    made = {
        path: path.read_bytes()
        for path in (*out.glob("tables/*"), *out.glob("figures/*"), out / "report.html")
    }
    assert len(made) == 12
    for path in made:
        path.unlink()
    main(["report", "--results", str(out)])
    assert {path: path.read_bytes() for path in made} == made
    capsys.readouterr()
    level = out / "stress" / "climb"
    page = tmp_path / "page.html"
    run = "climb@noise@4/hold/replicate_0"
    main(["replay", run, "--episode", "1", "--results", str(level), "-o", str(page)])
    assert "verified" in capsys.readouterr().out and page.exists()


def test_list_names_the_ladders(capsys, tmp_path):
    main(["list", "--results", str(tmp_path)])
    assert "| stress_v1 |" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--factors", "nois"], "unknown factor 'nois' (--factors, of ladder climb): did you mean noise?"),
        (["--episodes", 9], "--episodes 9: valid: 1 to 4"),
        (["--episodes", 0], "--episodes 0: valid: 1 to 4"),
        (["--workers", 0], "--workers 0: valid: 1 or more"),
        (["--engine", "lokey"], "unknown engine 'lokey'"),
    ],
)
def test_mistakes_are_one_line(capsys, tiny, tmp_path, more, message):
    assert message in fails(capsys, *words(tiny, tmp_path / "out", *more))
    assert not (tmp_path / "out").exists()


def test_a_level_out_of_range_is_one_line(capsys, tmp_path):
    path = write_ladder(tmp_path, "[0.0, 0.02]", "[-0.02, 0.02]")
    line = fails(capsys, *words(path, tmp_path / "out"))
    assert "level -0.02 of factor 'delay'" in line and "`$.randomization.command_delay" in line
    assert not (tmp_path / "out").exists()


def test_an_unknown_ladder_comes_with_the_nearest(capsys, tmp_path):
    line = fails(capsys, *words("stres_v1", tmp_path / "out"))
    assert "unknown ladder 'stres_v1' (--ladder): did you mean stress_v1 or stress_v2?" in line
    line = fails(capsys, *words(tmp_path / "none.toml", tmp_path / "out"))
    assert "none.toml' does not exist" in line


def test_an_unknown_controller_comes_with_the_nearest(capsys, tiny, tmp_path):
    line = fails(capsys, *words(tiny, tmp_path / "out", controller="hodl"))
    assert "unknown controller 'hodl'" in line and "did you mean hold?" in line
    assert not (tmp_path / "out").exists()
