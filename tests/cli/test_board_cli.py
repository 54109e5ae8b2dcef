"""`wbc-bench submit` and `board`: submissions side by side, and mistakes in one line that write nothing."""

import hashlib
import re
import shutil
from pathlib import Path

import msgspec
import pytest

import wbc_bench
from commands import fails
from tiny_protocol import write_tiny
from wbc_bench.cli.main import main
from wbc_bench.files import SEALED
from wbc_bench.results.store import ResultStore
from wbc_bench.results.submission import pack, renamed

ROOT = Path(__file__).parents[2]
OWN = f"{ROOT / 'examples' / 'own_controller.py'}:GentleArm"


def run(*words: object) -> None:
    main([str(word) for word in words])


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs of two controllers under a protocol of few steps, and their submissions."""
    folder = tmp_path_factory.mktemp("home")
    tiny = write_tiny(folder)
    for spec in ("hold", OWN):
        wbc_bench.evaluate(spec, str(tiny), out=folder)
    (folder / "card.md").write_text("An arm <b>that</b> waits.\n")
    sent = folder / "sent"
    run("submit", "hold", "--results", folder, "-o", sent / "first.zip", "--name", "b.still")
    run("submit", OWN, "--results", folder, "-o", sent / "second.zip", "--card", folder / "card.md")
    return folder


@pytest.fixture
def sent(home: Path, tmp_path: Path) -> Path:
    """A copy of the submissions, which a test may change."""
    return shutil.copytree(home / "sent", tmp_path / "sent")


def refused(capsys: pytest.CaptureFixture, home: Path, sent: Path, *words: object) -> str:
    """The one line on a folder of submissions, after which nothing is written."""
    before = sorted(sent.parent.iterdir())
    protocol = () if "--protocol" in words else ("--protocol", home / "tiny.toml")
    line = fails(capsys, "board", sent, "-o", sent.parent / "board", *protocol, *words)
    assert sorted(sent.parent.iterdir()) == before
    return line


@pytest.fixture(scope="module")
def board(home: Path) -> Path:
    """A board of both, of which a sample was run again."""
    run("board", home / "sent", "-o", home / "board", "--protocol", home / "tiny.toml", "--rerun", 2)
    return home / "board"


def test_two_submissions_stand_side_by_side(home, board):
    one, two = (run.record for run in ResultStore(board).runs("tiny") if run.record.replicate == 0)
    assert (one.controller, two.controller) == ("b.still", "gentle_arm")
    mine = ResultStore(home).find("tiny/hold/replicate_0").episodes()
    assert ResultStore(board).find("tiny/b.still/replicate_0").episodes().equals(mine)
    assert "| b.still vs gentle_arm | 12 |" in (board / "tables" / "tiny_pairs.md").read_text()


def test_the_page_shows_both_and_loads_nothing(home, board):
    page = (board / "index.html").read_text()
    assert "An arm &lt;b&gt;that&lt;/b&gt; waits." in page and "12 of 12" in page
    record = ResultStore(board).find("tiny/b.still/replicate_0").record
    assert record.protocol_digest in page and record.manifest_sha256 in page
    assert (board / "report.html").is_file() and 'href="report.html"' in page
    assert "<script" not in page and "http" not in page and str(home) not in page
    anchors = re.findall(r'href="#(worst[^"]*)"', page)
    assert len(anchors) == 6 and all(f'id="{anchor}"' in page for anchor in anchors)
    assert "--controller own_controller.py:GentleArm" in page and "--controller hold" in page


def test_shipped_and_given_controllers_alone_are_run_again(capsys, home, board):
    text = (board / "tables" / "submissions.md").read_text()
    assert re.search(
        r"\| b\.still \| `hold` \| `[0-9a-f]{12}` \| nothing \| 2 \| .* \| 4 of 4 episodes equal \|", text
    )
    assert re.search(r"\| gentle_arm \| `own_controller.py:GentleArm` \| .* \| not at hand \|", text)

    again = home / "again"
    words = ["--protocol", home / "tiny.toml", "--rerun", 1, "--controller", f"gentle_arm={OWN}"]
    run("board", home / "sent", "-o", again, *words)
    assert (again / "tables" / "submissions.md").read_text().count("| 2 of 2 episodes equal |") == 2
    assert capsys.readouterr().out.endswith(f"{again / 'index.html'}\n")
    one, two = (
        {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        for folder in (board, again)
    )
    differ = {path.as_posix() for path in one.keys() | two.keys() if one.get(path) != two.get(path)}
    assert differ == {"index.html", *(f"tables/submissions.{end}" for end in ("md", "tex", "csv"))}


def test_made_up_values_are_found_by_running_them_again(capsys, home, sent):
    (sent / "first.zip").write_bytes(_changed(home, position_error=lambda values: values / 2))
    assert "run again: the same outcome, but 1 of" in refused(capsys, home, sent, "--rerun", 12)


def _changed(home: Path, **columns) -> bytes:
    """A submission of `hold` with other values, whose hashes fit."""
    folder = home / "changed"
    shutil.rmtree(folder, ignore_errors=True)
    for one in ResultStore(home).runs("tiny"):
        if one.record.controller == "hold":
            table = one.table()
            for name, change in columns.items():
                place = table.column_names.index(name)
                values = change(one.episodes()[name].to_numpy())
                table = table.set_column(place, name, [values])
            record, data = renamed(one.record, table, "hold")
            path = ResultStore(folder).run_path("tiny", "hold", record.replicate)
            path.mkdir(parents=True)
            (path / "run.json").write_bytes(msgspec.json.encode(record))
            (path / "episodes.parquet").write_bytes(data)
    return pack("b.still", ResultStore(folder).runs())


@pytest.mark.parametrize("column", ["target_x", "height", "episode"])
def test_episodes_that_are_not_the_protocols_are_refused(capsys, home, sent, column):
    (sent / "first.zip").write_bytes(_changed(home, **{column: lambda values: values + 1}))
    assert f"column {column} is not that of the protocol's manifest" in refused(capsys, home, sent)


def test_another_protocol_is_refused(capsys, home, sent):
    other = sent.parent / "other"
    other.mkdir()
    for name in ("tiny.toml", "tiny.parquet", "tiny.sha256"):
        shutil.copy(home / name, other)
    assert "was evaluated under 'tiny', valid: " in refused(capsys, home, sent, "--protocol", "smoke_v1")
    path = write_tiny(other, horizon=0.3)
    line = refused(capsys, home, sent, "--protocol", path)
    assert "first.zip', tiny, replicate 0: its protocol digest is" in line and "that of the board is" in line


def test_two_of_one_name_are_refused(capsys, home, sent):
    shutil.copy(sent / "first.zip", sent / "third.zip")
    line = refused(capsys, home, sent)
    assert "first.zip' and '" in line and "are both called 'b.still'" in line


def test_damaged_submissions_are_refused(capsys, home, sent):
    whole = (sent / "second.zip").read_bytes()
    middle = len(whole) // 2
    (sent / "second.zip").write_bytes(whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :])
    assert "second.zip'" in refused(capsys, home, sent)
    (sent / "second.zip").write_bytes(whole[:middle])
    assert "is damaged or not a zip archive as `submit` writes it" in refused(capsys, home, sent)


def test_mistakes_of_the_board_are_one_line(capsys, home, sent):
    assert "--rerun -1: valid: 0 or more" in refused(capsys, home, sent, "--rerun", -1)
    assert "valid: NAME=SPEC" in refused(capsys, home, sent, "--controller", "hold")
    assert "did you mean b.still?" in refused(capsys, home, sent, "--controller", "b.stil=hold")
    (sent.parent / "board").mkdir()
    (sent.parent / "board" / "mine.txt").write_text("x")
    assert "holds files already" in refused(capsys, home, sent)
    assert "no submission in" in fails(capsys, "board", home / "runs")


def test_mistakes_of_a_submission_are_one_line(capsys, home, tmp_path):
    submit = ["submit", "hold", "--results", home, "-o", tmp_path / "x" / "a.zip"]
    assert "did you mean hold?" in fails(capsys, "submit", "hol", "--results", home)
    assert "unknown evaluated protocol 'tini'" in fails(capsys, *submit, "--protocols", "tini")
    assert "as of a folder" in fails(capsys, *submit, "--name", "a b")
    assert "does not exist" in fails(capsys, *submit, "--card", tmp_path / "none")
    assert "ends in .zip" in fails(capsys, *submit[:-1], tmp_path / "a.tar")
    (tmp_path / "card").write_text(f"see {Path.home()}/walk.onnx")
    assert "names your home folder" in fails(capsys, *submit, "--card", tmp_path / "card")
    assert [path.name for path in tmp_path.iterdir()] == ["card"]


def test_sealed_runs_are_packed_when_asked_and_checked_against_their_commitment(capsys, tmp_path):
    (tmp_path / "secret").write_bytes(bytes(range(32)))
    tiny, kept = write_tiny(tmp_path, replicates=1, episodes=2), tmp_path / "kept"
    secret = ["--secret-file", tmp_path / "secret", "--workers", 1]
    run("protocol", "freeze", tiny, "--sealed", *secret, "--out", kept)
    for protocol in (tiny, kept / f"tiny{SEALED}.toml"):
        wbc_bench.evaluate("hold", str(protocol), out=tmp_path)
    submit = ["submit", "hold", "--results", tmp_path, "-o"]
    run(*submit, tmp_path / "public" / "a.zip")
    run(*submit, tmp_path / "sent" / "a.zip", "--protocols", "tiny", f"tiny{SEALED}")
    assert f"tiny{SEALED}".encode() not in (tmp_path / "public" / "a.zip").read_bytes()
    sha256 = hashlib.sha256((kept / f"tiny{SEALED}.parquet").read_bytes()).hexdigest()
    board = ["board", tmp_path / "sent", "-o", tmp_path / "board", "--protocol", tiny]
    capsys.readouterr()
    assert "name its file with --commitment" in fails(capsys, *board)
    other = tmp_path / "other.json"
    commitment = msgspec.json.decode((kept / f"tiny{SEALED}.commitment.json").read_bytes())
    other.write_bytes(msgspec.json.encode(commitment | {"manifest_sha256": "0" * 64}))
    assert "that of the board is 0000" in fails(capsys, *board, "--commitment", other)
    assert not (tmp_path / "board").exists()
    run(*board, "--commitment", kept / f"tiny{SEALED}.commitment.json")
    page = (tmp_path / "board" / "index.html").read_text()
    assert f"sealed manifest sha256 <code>{sha256}</code>" in page
