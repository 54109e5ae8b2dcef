"""`protocol freeze --sealed` and `protocol reveal`: what they print, and every mistake in one line."""

from pathlib import Path

import pytest

from commands import fails
from tiny_protocol import write_tiny
from wbc_bench.cli.main import main


def run(*words: object) -> None:
    main([str(word) for word in words])


@pytest.fixture
def tiny(tmp_path) -> Path:
    """A protocol of two episodes, with targets that take no time to draw."""
    path = write_tiny(tmp_path, replicates=1, episodes=2)
    (tmp_path / "secret").write_bytes(bytes(range(32)))
    return path


@pytest.fixture
def words(tiny) -> list[object]:
    folder = tiny.parent
    return ["--secret-file", folder / "secret", "--out", folder / "kept", "--workers", 1]


def test_a_set_is_sealed_evaluated_and_revealed(capsys, tiny, words):
    folder = tiny.parent
    run("protocol", "freeze", tiny, "--sealed", *words)
    line, told = capsys.readouterr().out.splitlines()
    sha256, name = line.split()
    assert (
        name == "tiny_sealed.parquet"
        and f"{sha256}  {name}\n" == (folder / "kept" / "tiny_sealed.sha256").read_text()
    )
    commitment = folder / "kept" / "tiny_sealed.commitment.json"
    assert str(commitment) in told and sha256 in commitment.read_text()

    for protocol in (tiny, folder / "kept" / "tiny_sealed.toml"):
        run(
            *("eval", "--controller", "hold", "--protocol", protocol),
            *("--out", folder / "runs", "--workers", 1),
        )
    assert (folder / "runs" / "runs" / "tiny_sealed" / "hold" / "replicate_0" / "run.json").exists()
    capsys.readouterr()

    given = ["--commitment", commitment, "--secret-file", folder / "secret", "--protocol", tiny]
    run("protocol", "reveal", *given, "--out", folder / "public", "--workers", 1)
    assert capsys.readouterr().out.startswith(f"{sha256}  {folder / 'public' / 'tiny_sealed.parquet'}\n")
    file = folder / "kept" / "tiny_sealed.parquet"
    run("protocol", "reveal", *given, "--manifest", file, "--out", folder / "again")
    assert "a sample of rows" in capsys.readouterr().out
    run("protocol", "verify", folder / "again" / "tiny_sealed.toml")


def test_mistakes_are_one_line(capsys, tiny, words):
    folder = tiny.parent
    freeze = ["protocol", "freeze", tiny]
    assert "--secret-file and --sealed" in fails(capsys, *freeze, "--sealed")
    assert "--out and --sealed" in fails(capsys, *freeze, "--sealed", *words[:2])
    assert "--secret-file and --sealed" in fails(capsys, *freeze, *words)
    assert "does not exist" in fails(
        capsys, *freeze, "--sealed", "--secret-file", folder / "none", *words[2:]
    )
    (folder / "short").write_bytes(b"0123456789abcde")
    short = ["--secret-file", folder / "short"]
    assert "15 bytes, valid: at least 16" in fails(capsys, *freeze, "--sealed", *short, *words[2:])
    out = ["--out", tiny / "out"]
    assert "cannot be written" in fails(capsys, *freeze, "--sealed", *words[:2], *out)
    assert not (folder / "kept").exists()

    run(*freeze, "--sealed", *words)
    capsys.readouterr()
    kept = folder / "kept" / "tiny_sealed.toml"
    assert "is sealed already" in fails(capsys, "protocol", "freeze", kept, "--sealed", *words)
    commitment = kept.with_suffix(".commitment.json")
    reveal = ["protocol", "reveal", "--commitment", commitment, "--out", folder / "public"]
    mine = ["--protocol", tiny]
    assert "give its file with --protocol" in fails(capsys, *reveal, *words[:2])
    assert "is of protocol tiny with digest" in fails(capsys, *reveal, *words[:2], "--protocol", "smoke_v1")
    (folder / "wrong").write_bytes(bytes(32))
    wrong = ["--secret-file", folder / "wrong"]
    assert "the secret is another one" in fails(capsys, *reveal, *wrong, *mine, "--workers", 1)
    manifest = ["--manifest", tiny.with_suffix(".parquet")]
    assert "was changed" in fails(capsys, *reveal, *words[:2], *mine, *manifest)
    assert "--sample 0" in fails(capsys, *reveal, *words[:2], *mine, "--sample", 0)
    assert list((folder / "public").iterdir()) == []
