"""Submissions: what is packed comes back, and whatever was changed on the way is one line."""

import hashlib
import io
import re
import stat
import zipfile
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

import wbc_bench
from tiny_protocol import write_tiny
from wbc_bench.files import folder_name
from wbc_bench.results import submission
from wbc_bench.results.store import ResultStore, Run
from wbc_bench.results.submission import MANIFEST, SubmissionError, pack, public_spec, read_submission

OWN = f"{Path(__file__).parents[2] / 'examples' / 'own_controller.py'}:GentleArm"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> ResultStore:
    folder = tmp_path_factory.mktemp("tiny")
    for spec in ("hold", OWN):
        wbc_bench.evaluate(spec, str(write_tiny(folder)), out=folder)
    return ResultStore(folder)


def runs_of(store: ResultStore, spec: str) -> list[Run]:
    return [run for run in store.runs() if run.record.controller == spec]


@pytest.fixture
def packed(store: ResultStore) -> bytes:
    return pack("mine", runs_of(store, "hold"), "what it is\n")


def files_of(data: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def archive(files: dict[str, bytes], change: Callable[[zipfile.ZipInfo], None] = lambda info: None) -> bytes:
    """Files as an archive; `change` may change how each is stored."""
    sink = io.BytesIO()
    with zipfile.ZipFile(sink, "w") as written:
        for name, data in files.items():
            info = zipfile.ZipInfo(name)
            change(info)
            written.writestr(info, data)
    return sink.getvalue()


def resealed(files: dict[str, bytes], **changes: object) -> bytes:
    """An archive whose manifest fits its files, as who makes one up would write it."""
    manifest = msgspec.json.decode(files[MANIFEST])
    digests = {name: hashlib.sha256(data).hexdigest() for name, data in files.items() if name != MANIFEST}
    text = msgspec.json.encode(manifest | {"files": digests} | changes)
    return archive({**files, MANIFEST: text})


def refused(data: bytes, folder: Path) -> str:
    """The one line on a submission, of which nothing was written beside the folder that it may use."""
    path, inner = folder / "one.zip", folder / "unpacked" / "inner"
    path.write_bytes(data)
    inner.mkdir(parents=True)
    with pytest.raises(SubmissionError) as refusal:
        read_submission(path, inner)
    line = str(refusal.value)
    assert str(path) in line and str(inner) not in line and "\n" not in line
    assert sorted(file.name for file in folder.iterdir()) == ["one.zip", "unpacked"]
    assert [file.name for file in inner.parent.iterdir()] == ["inner"]
    return line


def test_what_is_packed_comes_back(store: ResultStore, packed: bytes, tmp_path: Path) -> None:
    (tmp_path / "one.zip").write_bytes(packed)
    read = read_submission(tmp_path / "one.zip", tmp_path / "inner")
    assert (read.name, read.card, read.sha256) == ("mine", "what it is\n", hashlib.sha256(packed).hexdigest())
    runs = runs_of(store, "hold")
    assert [run.record for run in read.runs] == [run.record for run in runs]
    assert all(one.episodes().equals(run.episodes()) for one, run in zip(read.runs, runs, strict=True))
    first = runs[0].record
    assert read.manifest.card.digests == {"hold": first.controller_sha256}
    digests = read.manifest.protocols["tiny"]
    assert (digests.protocol_digest, digests.manifest_sha256) == (
        first.protocol_digest,
        first.manifest_sha256,
    )
    assert not digests.sealed


def test_equal_runs_give_equal_bytes_in_any_order(store: ResultStore, packed: bytes) -> None:
    assert pack("mine", runs_of(store, "hold")[::-1], "what it is\n") == packed


def test_a_path_of_the_user_is_not_packed(store: ResultStore, tmp_path: Path) -> None:
    runs = runs_of(store, OWN)
    data = pack("mine", runs)
    assert str(Path(OWN.partition(":")[0]).parent).encode() not in data
    (tmp_path / "one.zip").write_bytes(data)
    read = read_submission(tmp_path / "one.zip", tmp_path / "inner")
    assert {run.record.controller for run in read.runs} == {"own_controller.py:GentleArm"}
    assert all(one.episodes().equals(run.episodes()) for one, run in zip(read.runs, runs, strict=True))


@pytest.mark.parametrize(
    ("spec", "public"),
    [
        ("ik:standing", "ik:standing"),
        ("learned:transformer_gru@0", "learned:transformer_gru@0"),
        ("examples/own.py:Arm?gain=0.5", "examples/own.py:Arm?gain=0.5"),
        ("/home/a/own.py:Arm?file=/home/a/w.pt&n=3", "own.py:Arm?file=w.pt&n=3"),
        ("policy:~/cards/walk.toml", "policy:walk.toml"),
        ("policy:../a/walk.toml", "policy:walk.toml"),
        (r"C:\Users\a\own.py:Arm", "own.py:Arm"),
        ("remote:tcp://192.168.1.7:5555", "remote"),
    ],
)
def test_a_public_spec_tells_nothing_of_its_user(spec: str, public: str) -> None:
    assert public_spec(spec) == public
    assert public_spec(public) == public


def test_runs_that_are_not_one_row_are_not_packed(store: ResultStore) -> None:
    runs = runs_of(store, "hold")
    with pytest.raises(SubmissionError, match="two controllers: controller is"):
        pack("mine", [*runs, *runs_of(store, OWN)])
    with pytest.raises(SubmissionError, match="no run, valid: at least one"):
        pack("mine", [])
    with pytest.raises(SubmissionError, match="as of a folder"):
        pack("a/b", runs)
    with pytest.raises(SubmissionError, match="bytes, valid: at most 65536"):
        pack("mine", runs, "x" * 65537)


@pytest.mark.parametrize(
    ("field", "problem"),
    [
        ("controller_sha256", "replicates 0 and 1 of 'hold' under tiny were evaluated with different code"),
        ("software_sha256", "digest of the software of 'hold' is another"),
        ("manifest_sha256", "protocol or its manifest is another"),
    ],
)
def test_digests_are_not_mixed(packed: bytes, tmp_path: Path, field: str, problem: str) -> None:
    files = files_of(packed)
    name = next(name for name in files if name.endswith("replicate_1/run.json"))
    record = msgspec.json.decode(files[name]) | {field: "a" * 64}
    assert problem in refused(resealed({**files, name: msgspec.json.encode(record)}), tmp_path)


def test_an_altered_record_is_refused(packed: bytes, tmp_path: Path) -> None:
    files = files_of(packed)
    name = next(name for name in files if name.endswith("replicate_0/run.json"))
    changed = files[name].replace(b'"wall_time_s": ', b'"wall_time_s": 1')
    assert f"'{name}' was changed, its sha256 is" in refused(archive({**files, name: changed}), tmp_path)


def test_altered_episodes_are_refused_also_where_the_manifest_fits(packed: bytes, tmp_path: Path) -> None:
    files = files_of(packed)
    one, two = (name for name in sorted(files) if name.endswith(".parquet"))
    line = refused(resealed({**files, one: files[two]}), tmp_path)
    assert "is not what its run.json was written for" in line


def test_an_altered_hash_is_refused(packed: bytes, tmp_path: Path) -> None:
    files = files_of(packed)
    manifest = msgspec.json.decode(files[MANIFEST])
    manifest["files"] |= {next(iter(manifest["files"])): "b" * 64}
    assert "the manifest says bbbb" in refused(
        archive({**files, MANIFEST: msgspec.json.encode(manifest)}), tmp_path
    )


@pytest.mark.parametrize("part", ["card", "protocols"])
def test_a_manifest_says_what_the_records_do(packed: bytes, tmp_path: Path, part: str) -> None:
    files = files_of(packed)
    said = msgspec.json.decode(files[MANIFEST])[part]
    said = said | {"name": "better"} if part == "card" else {"tiny": said["tiny"] | {"sealed": True}}
    assert "says other than the records do" in refused(resealed(files, **{part: said}), tmp_path)


def test_a_missing_and_an_extra_file_are_refused(packed: bytes, tmp_path: Path) -> None:
    files = files_of(packed)
    name = next(name for name in files if name.endswith("replicate_0/episodes.parquet"))
    less = {key: data for key, data in files.items() if key != name}
    (tmp_path / "a").mkdir()
    assert f"'{name}' is not in its archive" in refused(archive(less), tmp_path / "a")
    more = {**files, name.replace("replicate_0", "replicate_7"): b"x"}
    (tmp_path / "b").mkdir()
    assert "is not in its manifest" in refused(archive(more), tmp_path / "b")


@pytest.mark.parametrize(
    "name",
    [
        "../outside.txt",
        "/tmp/outside.txt",
        "runs/../../outside/replicate_0/run.json",
        "runs/tiny/../replicate_0/run.json",
        "runs/tiny/hold/replicate_0/shards.parquet",
        "mine.py",
        "runs/tiny/hold/",
    ],
)
def test_a_name_that_leads_elsewhere_is_refused(packed: bytes, tmp_path: Path, name: str) -> None:
    line = refused(archive({**files_of(packed), name: b""}), tmp_path)
    assert "is no name of a submission's file" in line or "is a link or no file" in line


def test_a_link_is_refused(packed: bytes, tmp_path: Path) -> None:
    def link(info: zipfile.ZipInfo) -> None:
        if info.filename.endswith("replicate_0/run.json"):
            info.create_system, info.external_attr = 3, (stat.S_IFLNK | 0o777) << 16

    assert "run.json' is a link or no file" in refused(archive(files_of(packed), link), tmp_path)


def test_a_submission_that_is_a_link_is_refused(packed: bytes, tmp_path: Path) -> None:
    (tmp_path / "one.zip").write_bytes(packed)
    (tmp_path / "two.zip").symlink_to(tmp_path / "one.zip")
    with pytest.raises(SubmissionError, match="is a link, valid: a file"):
        read_submission(tmp_path / "two.zip", tmp_path / "inner")


def test_a_bomb_is_refused_before_it_is_unpacked(packed: bytes, tmp_path: Path) -> None:
    def deflated(info: zipfile.ZipInfo) -> None:
        info.compress_type = zipfile.ZIP_DEFLATED

    bomb = archive({**files_of(packed), "card.txt": bytes(50_000_000)}, deflated)
    assert len(bomb) < 1_000_000
    assert "is compressed" in refused(bomb, tmp_path)


def test_files_that_overlap_are_refused(packed: bytes, tmp_path: Path) -> None:
    """All entries of the directory lead to one file, so that a small archive would hold many large ones."""
    entries = 40
    name = "runs/tiny/hold/replicate_{}/run.json"
    whole = archive(
        {MANIFEST: b"{}", **{name.format(10 + k): b"" for k in range(entries)}, "card.txt": bytes(9999)}
    )
    at, size = whole.index(bytes(9999)), (9999).to_bytes(4, "little")
    with zipfile.ZipFile(io.BytesIO(whole)) as read:
        start = read.start_dir
    head, directory = whole[:start], bytearray(whole[start:])
    place = 0
    for _ in range(entries + 1):  # sizes and the place of the data of every entry but the last
        if directory[place + 46 :].startswith(b"runs/"):
            directory[place + 20 : place + 28] = size + size
            directory[place + 42 : place + 46] = (at - 38).to_bytes(4, "little")
        place += 46 + directory[place + 28]
    assert "files that overlap" in refused(head + bytes(directory), tmp_path)


def test_too_many_files_two_of_a_name_and_no_archive_are_refused(
    packed: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders = iter("abcde")

    def line(data: bytes) -> str:
        folder = tmp_path / next(folders)
        folder.mkdir()
        return refused(data, folder)

    assert "not a zip archive" in line(b"no archive at all")
    assert "damaged or not a zip archive" in line(packed[: len(packed) // 2])
    assert f"no {MANIFEST}" in line(archive({"card.txt": b""}))
    with pytest.warns(UserWarning, match="Duplicate name"):
        sink = io.BytesIO(packed)
        with zipfile.ZipFile(sink, "a") as more:
            more.writestr("card.txt", b"another")
    assert "two files of one name" in line(sink.getvalue())
    monkeypatch.setattr(submission, "MOST_FILES", 3)
    assert "valid: at most 3" in line(packed)


def test_a_record_with_a_path_is_refused(packed: bytes, tmp_path: Path) -> None:
    files, spec = files_of(packed), "/etc/own.py:Arm"
    moved = {}
    for name, data in files.items():
        text = data.replace(b'"controller": "hold"', f'"controller": "{spec}"'.encode())
        moved[name.replace("/hold/", f"/{folder_name(spec)}/")] = text
    line = refused(resealed(moved), tmp_path)
    assert re.search("was written for controller 'hold'|has a path, valid: one without", line)
