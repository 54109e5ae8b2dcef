"""The store: atomic, resumable, and never mixing runs of different keys."""

import errno
import hashlib
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from synthetic import FakeRun, episodes, record
from wbc_bench.errors import StoreError, UnknownNameError
from wbc_bench.files import (
    STALE,
    ensure_file_writable,
    ensure_writable,
    folder_name,
    made_whole,
    scratch_folder,
    write_atomic,
)
from wbc_bench.outcomes import SuccessRule
from wbc_bench.results import store as store_module
from wbc_bench.results.analysis import collect
from wbc_bench.results.run_writer import RunWriter
from wbc_bench.results.store import ResultStore, RunKey, ShardCost

FACTS = {
    **{"controller_name": "a", "signals": [], "source": "test", "checkpoint_sha256": None},
    **{"git_commit": None, "git_dirty": False, "versions": {}, "machine": {}, "workers": 1, "engine": "loky"},
    **{"wall_time_s": 1.0, "created": "2026-01-01T00:00:00+00:00"},
}
COST = ShardCost(0.5, 100.0)


def key(**changes) -> RunKey:
    values = {
        **{"protocol": "p", "protocol_digest": "d" * 64, "manifest_sha256": "m" * 64, "controller": "a:b"},
        **{"replicate": 0, "requested": 7, "shard_episodes": 3, "software_sha256": "s" * 64},
    }
    return RunKey(**(values | changes))


def rows(numbers: range, seed: int = 0) -> pa.Table:
    value = np.random.default_rng(seed).normal(size=100)[list(numbers)]
    return pa.table({"episode": list(numbers), "outcome": ["success"] * len(numbers), "value": value})


def fill(writer: RunWriter, seed: int = 0) -> None:
    for shard in writer.missing:
        writer.write(shard, rows(writer.rows(shard), seed), COST)


def finished(root: Path, seed: int = 0, **changes) -> ResultStore:
    store = ResultStore(root)
    writer = RunWriter(store, key(**changes))
    fill(writer, seed)
    writer.finish(FACTS)
    writer.close()
    return store


def test_a_run_is_its_shards_in_order_and_nothing_else_is_left(tmp_path):
    store = ResultStore(tmp_path)
    writer = RunWriter(store, key())
    assert writer.missing == [0, 1, 2]
    assert [list(writer.rows(shard)) for shard in writer.missing] == [[0, 1, 2], [3, 4, 5], [6]]
    for shard in (2, 0, 1):
        writer.write(shard, rows(writer.rows(shard)), COST)
    record = writer.finish(FACTS).record
    writer.close()
    assert (record.requested, record.completed, sum(record.outcomes.values())) == (7, 7, 7)
    assert record.compute_time_s == 1.5
    (run,) = store.runs("p")
    assert run.episodes()["episode"].tolist() == list(range(7))
    assert sorted(p.name for p in run.path.iterdir()) == ["episodes.parquet", "run.json"]


def test_bytes_do_not_depend_on_order_interruption_or_software(tmp_path):
    one = finished(tmp_path / "one").runs()[0].path / "episodes.parquet"
    store = ResultStore(tmp_path / "two")
    changed = key(software_sha256="t" * 64)
    writer = RunWriter(store, changed)
    writer.write(2, rows(writer.rows(2)), COST)
    writer.close()
    writer = RunWriter(store, changed)
    assert (writer.missing, writer.resumed) == ([0, 1], 1)
    fill(writer)
    two = writer.finish(FACTS).path / "episodes.parquet"
    writer.close()
    assert one.read_bytes() == two.read_bytes()


@pytest.mark.parametrize("damage", ["truncated", "flipped bit", "empty", "short", "a pipe", "a value"])
def test_a_damaged_shard_is_computed_again(tmp_path, damage):
    store = ResultStore(tmp_path)
    writer = RunWriter(store, key())
    fill(writer)
    path = writer.path / "shards" / "shard_00001.parquet"
    data = bytearray(path.read_bytes())
    if damage == "short":
        writer.write(1, rows(range(3, 5)), COST)
    elif damage == "a pipe":
        path.unlink()
        os.mkfifo(path)
    elif damage == "a value":  # as a whole file of the right key
        table = pq.read_table(path)
        pq.write_table(table.set_column(0, table.column_names[0], pa.array([9] * len(table))), path)
    else:
        data[8] ^= 1 if damage == "flipped bit" else 0
        path.write_bytes({"truncated": data[:-20], "flipped bit": data, "empty": b""}[damage])
    writer.close()
    writer = RunWriter(store, key())
    assert writer.missing == [1]
    writer.close()


def test_leftovers_of_a_killed_writer_are_removed(tmp_path):
    store = ResultStore(tmp_path)
    writer = RunWriter(store, key())
    writer.write(0, rows(range(3)), COST)
    leftover = writer.path / "shards" / ".shard_00001.parquet.123.tmp"
    leftover.write_bytes(b"half")
    writer.close()
    writer = RunWriter(store, key())
    assert not leftover.exists()
    assert writer.missing == [1, 2]
    writer.close()


def test_killed_between_record_and_clean_up(tmp_path):
    store = ResultStore(tmp_path)
    writer = RunWriter(store, key())
    fill(writer)
    shutil.copytree(writer.path / "shards", tmp_path / "kept")
    run = writer.finish(FACTS)
    writer.close()
    shutil.copytree(tmp_path / "kept", run.path / "shards")
    writer = RunWriter(store, key())
    assert writer.missing == [] and writer.finished
    writer.close()
    assert not (run.path / "shards").exists()


@pytest.mark.parametrize("field", ["protocol_digest", "manifest_sha256", "controller"])
@pytest.mark.parametrize("whole", [True, False])
def test_a_run_of_another_key_is_refused(tmp_path, field, whole):
    if whole:
        store = finished(tmp_path)
    else:
        store = ResultStore(tmp_path)
        writer = RunWriter(store, key())
        writer.write(0, rows(range(3)), COST)
        writer.close()
    # "a-b" shares the folder of "a:b"
    other = {"controller": "a-b"}.get(field, "x" * 64)
    with pytest.raises(StoreError, match=field):
        RunWriter(store, key(**{field: other}))
    RunWriter(store, key(**{field: other}), overwrite=True).close()


def test_shards_of_other_software_are_refused_but_a_whole_run_is_kept(tmp_path):
    store = ResultStore(tmp_path)
    writer = RunWriter(store, key())
    writer.write(0, rows(range(3)), COST)
    writer.close()
    with pytest.raises(StoreError, match="software_sha256"):
        RunWriter(store, key(software_sha256="t" * 64))
    whole = finished(tmp_path / "whole")
    writer = RunWriter(whole, key(software_sha256="t" * 64))
    assert writer.finished
    writer.close()


def test_load_refuses_to_mix_digests(tmp_path):
    store = finished(tmp_path)
    finished(tmp_path, replicate=1)
    assert len(store.load("p", "a:b")) == 14
    finished(tmp_path, replicate=2, protocol_digest="e" * 64)
    with pytest.raises(StoreError, match=f"{'d' * 64}.*{'e' * 64}"):
        store.load("p", "a:b")
    with pytest.raises(UnknownNameError, match="a:b"):
        store.load("p", "a:c")


def test_a_copied_folder_is_not_counted_twice(tmp_path):
    store = finished(tmp_path)
    (run,) = store.runs()
    shutil.copytree(run.path, run.path.with_name("replicate_5"))
    with pytest.raises(StoreError, match=r"replicate_5' holds the run of p/a-b/replicate_0"):
        store.runs()
    record = msgspec.json.decode((run.path / "run.json").read_bytes()) | {"replicate": 5}
    (run.path.with_name("replicate_5") / "run.json").write_bytes(msgspec.json.encode(record))
    (_, copy) = store.runs()
    with pytest.raises(StoreError, match=r"replicate_5.* was written for replicate '0', .* says '5'"):
        copy.episodes()


def test_altered_episodes_are_noticed(tmp_path):
    (run,) = finished(tmp_path / "a").runs()
    (other,) = finished(tmp_path / "b", seed=1).runs()
    shutil.copy(other.path / "episodes.parquet", run.path / "episodes.parquet")
    with pytest.raises(StoreError, match="sha256"):
        run.episodes()


def test_a_damaged_record_names_its_file(tmp_path):
    store = finished(tmp_path)
    path = store.runs()[0].path / "run.json"
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(StoreError, match=r"run\.json"):
        store.runs()


def test_two_processes_do_not_share_a_run(tmp_path):
    store = ResultStore(tmp_path)
    writer = RunWriter(store, key())
    with pytest.raises(StoreError, match="another process"):
        RunWriter(store, key())
    writer.close()
    RunWriter(store, key()).close()


def test_full_disk_at_any_write_leaves_no_part(tmp_path, monkeypatch):
    """Fail at the k-th fsync of a file, for every k: what is there is whole, and the run can go on."""
    real = os.fsync
    for failing in range(1, 6):
        store = ResultStore(tmp_path / str(failing))
        writer = RunWriter(store, key())
        calls = iter(range(1, 100))

        def fsync(descriptor, calls=calls, failing=failing):
            if not os.path.isdir(f"/proc/self/fd/{descriptor}") and next(calls) == failing:  # noqa: PTH112
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            real(descriptor)

        monkeypatch.setattr(os, "fsync", fsync)
        with pytest.raises(StoreError, match="No space left"):
            fill(writer)
            writer.finish(FACTS)
        writer.close()
        monkeypatch.setattr(os, "fsync", real)
        assert not list(writer.path.rglob("*.tmp"))
        assert store.runs() == []
        writer = RunWriter(store, key())
        assert len(writer.missing) == max(0, 4 - failing)
        fill(writer)
        run = writer.finish(FACTS)
        writer.close()
        reference = finished(tmp_path / f"reference{failing}").runs()[0]
        assert (run.path / "episodes.parquet").read_bytes() == (
            reference.path / "episodes.parquet"
        ).read_bytes()


def test_a_really_full_disk(tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "none", str(disk)]
    if subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("mounting a small disk needs root")
    try:
        whole = disk / "whole"
        write_atomic(whole, b"x" * 20_000)
        with pytest.raises(StoreError, match="No space left"):
            write_atomic(disk / "big", b"x" * 100_000)
        with pytest.raises(StoreError, match="No space left"):
            write_atomic(whole, b"y" * 100_000)
        assert [p.name for p in disk.iterdir()] == ["whole"]
        assert whole.read_bytes() == b"x" * 20_000
    finally:
        subprocess.run(["umount", str(disk)], check=True)


KILLED = {  # what a process does that is killed in the midst of it
    "probe": "wbc_bench.files.Path.unlink = kill; ensure_writable(here)",
    "half a probe": "wbc_bench.files.Path.replace = kill; ensure_writable(here)",
    "publication": "with scratch_folder(here) as made: (made / 'report.html').write_text(''); kill()",
}


@pytest.mark.parametrize("what", KILLED)
def test_what_a_killed_process_left_is_removed_by_a_later_one(tmp_path, what):
    code = (
        "import os, signal, sys, wbc_bench.files\n"
        "from wbc_bench.files import Path, ensure_writable, scratch_folder\n"
        "kill = lambda *_, **__: os.kill(os.getpid(), signal.SIGKILL)\n"
        f"here = Path(sys.argv[1])\n{KILLED[what]}\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)])
    (left,) = tmp_path.iterdir()
    assert done.returncode == -signal.SIGKILL and left.name.startswith((".probe-", "..probe-", ".publish-"))
    ensure_writable(tmp_path)
    assert left.exists()  # its process could still be at it
    old = time.time() - 2 * STALE
    os.utime(left, (old, old))
    ensure_writable(tmp_path)
    assert not list(tmp_path.iterdir())


def test_old_files_of_the_user_with_such_names_stay(tmp_path):
    """Any folder may be written to, the working directory among them."""
    for name in (".probes", ".probe-x", "probe-12", ".publish", "data.tmp", ".probe-2024", "..probe-1.2.tmp"):
        (tmp_path / name).write_text("" if name == "..probe-1.2.tmp" else "mine")
    for name in (".publish-site", ".publish-ab12cd34", ".publish-marked", "kept"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "report.html").write_text("mine")
    (tmp_path / ".publish-marked" / ".wbc-bench").write_text("mine")
    (tmp_path / ".publish-link").symlink_to(tmp_path / "kept", target_is_directory=True)
    (tmp_path / ".probe-7").symlink_to(tmp_path / "kept" / "report.html")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    names = {path.name for path in tmp_path.iterdir()}
    old = time.time() - 2 * STALE
    for path in tmp_path.iterdir():
        os.utime(path, (old, old), follow_symlinks=False)
    ensure_writable(tmp_path)
    with scratch_folder(tmp_path):
        pass
    assert {path.name for path in tmp_path.iterdir()} == names
    assert {path: path.read_bytes() for path in before} == before


def test_ensure_writable_refuses_what_cannot_be_written(tmp_path):
    file = tmp_path / "file"
    file.write_text("")
    for root in (file, file / "below"):
        with pytest.raises(StoreError, match="cannot be written"):
            ensure_writable(root)
    ensure_writable(tmp_path / "new" / "folder")
    assert list((tmp_path / "new" / "folder").iterdir()) == []


def test_several_files_are_replaced_together_or_not_at_all(tmp_path):
    (tmp_path / "a.txt").write_text("before")
    with pytest.raises(StoreError, match="cannot write to"), made_whole(tmp_path) as (made, _):
        (made / "a.txt").write_text("after")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "before"
    with made_whole(tmp_path / "~new:") as (made, paths):
        (made / "sub").mkdir()
        (made / "sub" / "b.txt").write_text("b")
        (made / "a.txt").write_text("a")
    assert paths == [tmp_path / "~new:" / "a.txt", tmp_path / "~new:" / "sub" / "b.txt"]
    assert [path.name for path in (tmp_path / "~new:").iterdir()] in (["a.txt", "sub"], ["sub", "a.txt"])


def test_a_file_is_tried_before_it_is_made(tmp_path):
    """A folder, a pipe or a device in its place would be found out, or replaced, after the work."""
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    cases = (("folder", "is a folder, valid: a file"), ("pipe", "is a device"), ("n" * 256, "too long"))
    for name, message in cases:
        with pytest.raises(StoreError, match=message):
            ensure_file_writable(tmp_path / name)
    long = tmp_path / "new" / ("ü" * 120 + ".html")  # 245 bytes
    ensure_file_writable(long)
    write_atomic(long, b"whole")
    assert [path.read_bytes() for path in long.parent.iterdir()] == [b"whole"]


def test_record_round_trips(tmp_path):
    (run,) = finished(tmp_path).runs()
    again = msgspec.json.decode((run.path / "run.json").read_bytes(), type=store_module.RunRecord)
    assert again == run.record


def test_a_record_of_before_has_the_rule_of_v1(tmp_path):
    (run,) = finished(tmp_path).runs()
    old = msgspec.json.decode((run.path / "run.json").read_bytes())
    del old["rule"]
    (run.path / "run.json").write_bytes(msgspec.json.encode(old))
    (again,) = ResultStore(tmp_path).runs()
    assert again.record.rule == SuccessRule(0.05, np.radians(7.0), 1.0, 10.0)


@pytest.mark.parametrize(
    ("spec", "name"),
    [
        ("hold", "hold"),
        ("ik:kinematic", "ik-kinematic"),
        ("/home/me/my ctrl.py:Mine", "home-me-my-ctrl.py-Mine"),
        ("a@b_c.1-2", "a@b_c.1-2"),
    ],
)
def test_a_spec_as_a_folder_name(spec: str, name: str) -> None:
    assert folder_name(spec) == name


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"replicate": 0', '"replicate": -1', "replicate is -1, valid: 0 or more"),
        ('"completed": 7', '"completed": 6', "completed is 6, valid: 7, as many as requested"),
        ('"success": 7', '"success": 8', "sum of outcomes is 8, valid: 7"),
        ('"success": 7', '"succesr": 7', r"outcomes\.succesr is 7, valid: 0 or more of success"),
        (
            '"protocol_digest": "d',
            '"protocol_digest": "D',
            "protocol_digest is .*, valid: 64 hexadecimal",
        ),
        ('"window": 1.0', '"window": 0.0', r"rule\.window is 0.0, valid: above 0"),
        ('"shard_episodes": 3', '"shard_episodes": 0', "shard_episodes is 0, valid: 1 or more"),
        ('"requested": 7', '"reqnested": 7', "missing required field `requested`"),
        ('"source": "test"', '"source": "te\\udc00t"', "run record"),
        ('"versions": {}', '"versions": ' + "[" * 50_000, "run record"),
    ],
)
def test_a_record_that_contradicts_itself_is_one_line(tmp_path, old, new, message):
    path = finished(tmp_path).runs()[0].path / "run.json"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(StoreError, match=message) as caught:
        ResultStore(tmp_path).runs()
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_every_flipped_bit_of_a_record_is_read_or_one_line(tmp_path):
    path = finished(tmp_path).runs()[0].path / "run.json"
    data = path.read_bytes()
    for place in range(len(data)):
        changed = bytearray(data)
        changed[place] ^= 1 << place % 8
        path.write_bytes(changed)
        try:
            [run.episodes() for run in ResultStore(tmp_path).runs()]
        except StoreError as error:
            assert "\n" not in str(error)


def test_episodes_whose_hash_fits_and_whose_content_does_not(tmp_path):
    (run,) = finished(tmp_path).runs()
    path = run.path / "episodes.parquet"
    whole = pq.read_table(path)

    def refused(data: bytes, message: str) -> None:
        path.write_bytes(data)
        record = msgspec.structs.replace(run.record, episodes_sha256=hashlib.sha256(data).hexdigest())
        (run.path / "run.json").write_bytes(msgspec.json.encode(record))
        with pytest.raises(StoreError, match=message) as caught:
            ResultStore(tmp_path).load("p", "a:b")
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)

    def bytes_of(table: pa.Table) -> bytes:
        sink = pa.BufferOutputStream()
        pq.write_table(table, sink)
        return sink.getvalue().to_pybytes()

    refused(b"not parquet", "not readable parquet")
    refused(bytes_of(whole)[:-30] + b"x" * 30, "not readable parquet")
    refused(bytes_of(whole.slice(0, 6)), "6 rows, valid: 7")
    refused(bytes_of(whole.drop_columns(["outcome"])), "valid: episode, outcome")
    place = whole.column_names.index("outcome")
    fell = pa.array(["fell"] * 7)
    refused(bytes_of(whole.set_column(place, "outcome", fell)), "ended with .*fell.*, its run.json says")


def test_columns_that_tables_are_made_of(tmp_path):
    """One that is missing, of another type or not finite is one line where records are collected."""
    frame = episodes(0, 7, 1.0, 0)

    def refused(changed: pd.DataFrame, message: str) -> None:
        with pytest.raises(StoreError, match=message):
            collect([FakeRun(record("ik", 0, frame), changed)])

    refused(frame.drop(columns="height"), "have no column height, valid: .*height")
    refused(frame.assign(height="tall"), "column height holds .*, valid: numbers")
    refused(frame.assign(height=np.nan), "column height holds a number that is not finite")
    refused(frame.assign(position_error=np.inf), "column position_error holds an infinite number")
    refused(frame.assign(stratum=1), "column stratum holds int64, valid: text in every row")
    refused(frame.assign(replicate=1), "column replicate holds others, valid: 0")
    refused(frame.assign(success=0.5), "column success contradicts outcome")
