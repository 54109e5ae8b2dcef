"""Messages, the clutch, silence and abuse of the stream; most of it with clocks of the test's own."""

import itertools
import math
import pickle
import re
import socket as sockets
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
import zmq

from robot_states import seen_at
from stream_wire import HAND, PERIOD, QUICK, SEEN, offset, wire
from wbc_bench import sources
from wbc_bench.errors import SourceError
from wbc_bench.rotations import geodesic_angle, matrix_from_rpy, matrix_from_wxyz
from wbc_bench.sources import StampedTarget, load_source, replayed_stream, to_world
from wbc_bench.sources.latency import stream_latency
from wbc_bench.sources.message import MAX_BYTES, MessageStatus
from wbc_bench.sources.slew import Limits
from wbc_bench.sources.stream import StreamSource, is_local
from wbc_bench.sources.stream_filter import Status, StreamConfig

DOCUMENT = Path(sources.__file__).with_name("STREAM.md")


# following


def test_the_latest_wins_and_nothing_moves_before() -> None:
    w = wire()
    np.testing.assert_array_equal(w.step()[0], HAND)
    assert w.status is Status.WAITING
    assert w.send(offset(x=0.1)) is w.send(offset(x=0.2), rpy=(0.0, 0.3, 0.0)) is MessageStatus.ACCEPTED
    pos, rot = w.step()
    np.testing.assert_allclose(pos, offset(x=0.2))
    np.testing.assert_allclose(rot, matrix_from_rpy(np.array([0.0, 0.3, 0.0])), atol=1e-12)
    assert w.status is Status.FOLLOWING


def test_frames_of_messages() -> None:
    w, seen = wire(), seen_at(0.4, (0.1, 0.2, 0.8))
    w.filter.reset(seen)
    assert w.send((0.4, 0.1, 0.3), frame="base", seen=seen) is MessageStatus.ACCEPTED
    np.testing.assert_allclose(w.step(seen=seen)[0], seen.base_pos_w + seen.base_rot_w @ [0.4, 0.1, 0.3])
    assert w.send((0.4, 0.1, 0.3), frame="arm_mount", seen=seen) is MessageStatus.ACCEPTED
    np.testing.assert_allclose(w.step(seen=seen)[0], seen.base_pos_w + seen.base_rot_w @ [0.42, 0.1, 0.33])


def test_no_faster_than_the_limits() -> None:
    """0.3 m away at 0.2 m/s: 1.5 s, in steps of 4 mm."""
    w, before = wire(StreamConfig(limits=Limits(0.2, 0.5))), HAND
    for k in range(1, 80):
        assert w.send(offset(y=0.3), rpy=(0.0, 0.0, 1.0)) is MessageStatus.ACCEPTED
        pos, rot = w.step()
        assert np.linalg.norm(pos - before) <= 0.2 * PERIOD + 1e-12
        assert pos[1] == pytest.approx(min(0.3, 0.2 * PERIOD * k))
        assert geodesic_angle(rot, np.eye(3)) == pytest.approx(min(1.0, 0.5 * PERIOD * k), abs=1e-6)
        before = pos


# the clutch


def test_relative_motion_anchors_where_it_is_engaged() -> None:
    """The device is somewhere else altogether, turned by 1 rad; only its motion counts."""
    w, there = wire(), np.array([5.0, -3.0, 1.0])
    assert w.send(there, rpy=(0.0, 0.0, 1.0), relative=True) is MessageStatus.ACCEPTED
    pos, rot = w.step()
    np.testing.assert_allclose(pos, HAND)
    np.testing.assert_allclose(rot, np.eye(3), atol=1e-12)
    w.send(there + np.array([0.0, 0.1, 0.05]), rpy=(0.0, 0.0, 1.2), relative=True)
    pos, rot = w.step()
    np.testing.assert_allclose(pos, offset(y=0.1, z=0.05))
    np.testing.assert_allclose(rot, matrix_from_rpy(np.array([0.0, 0.0, 0.2])), atol=1e-12)


@pytest.mark.parametrize("how", ["clutch", "silence"])
def test_engaging_again_does_not_jump(how: str) -> None:
    w = wire()
    w.send((0.0, 0.0, 0.0), relative=True)
    w.send((0.1, 0.0, 0.0), relative=True)
    w.step()
    if how == "clutch":
        assert w.send((3.0, 0.0, 0.0), relative=True, engaged=False) is MessageStatus.ACCEPTED
        assert w.status is Status.DISENGAGED
    else:
        w.step(1.0)
        assert w.status is Status.HOLDING
    np.testing.assert_allclose(w.step()[0], offset(x=0.1))
    assert w.send((3.0, 0.0, 0.0), relative=True) is MessageStatus.ACCEPTED
    np.testing.assert_allclose(w.step()[0], offset(x=0.1))
    w.send((3.0, 0.0, -0.2), relative=True)
    np.testing.assert_allclose(w.step()[0], offset(x=0.1, z=-0.2))


def test_an_absolute_target_rests_while_the_clutch_is_out() -> None:
    w = wire(StreamConfig(limits=Limits(0.1, 1.0)))
    w.send(offset(x=0.3))
    pos, _ = w.step()
    w.send(offset(x=9.0), engaged=False)
    np.testing.assert_allclose(w.step()[0], pos)
    w.send(offset(x=0.3))
    np.testing.assert_allclose(w.step()[0], pos + np.array([0.1 * PERIOD, 0.0, 0.0]))


# silence


def test_silence_holds_then_retreats() -> None:
    s = StreamConfig(limits=Limits(0.1, 1.0), retreat=Limits(0.05, 0.4), hold_after=0.2, retreat_after=2.0)
    w = wire(s)
    w.send(offset(x=0.3))
    moving = [w.step()[0] for _ in range(10)][-1]
    assert w.status is Status.FOLLOWING
    held, _ = w.step()
    assert w.status is Status.HOLDING
    np.testing.assert_array_equal(held, moving)  # on the way to 0.3 m, and no further
    for _ in range(80):
        np.testing.assert_allclose(w.step()[0], held, atol=1e-12)
    before = held
    for _ in range(60):
        pos, _ = w.step()
        assert np.linalg.norm(pos - before) <= 0.05 * PERIOD + 1e-12
        before = pos
    assert w.status is Status.RETREATING
    np.testing.assert_allclose(before, HAND, atol=1e-9)
    assert w.send(offset(x=0.1)) is MessageStatus.ACCEPTED  # and a message takes over again
    w.step()
    assert w.status is Status.FOLLOWING


def test_the_safe_pose_goes_with_the_base() -> None:
    w, moved = wire(), seen_at(0.3, (0.5, 0.0, 0.8))
    w.send(offset(x=0.1))
    w.step()
    w.step(10.0, seen=moved)
    pos, rot = w.step(10.0, seen=moved)
    np.testing.assert_allclose(pos, moved.ee_pos_w, atol=1e-9)
    np.testing.assert_allclose(rot, moved.ee_rot_w, atol=1e-9)


# what is refused


def refusals() -> Iterator[tuple[str, dict, MessageStatus]]:
    nan, inf = math.nan, math.inf
    yield "nan position", {"pos": [nan, 0.0, 1.0]}, MessageStatus.NOT_FINITE
    yield "infinite position", {"pos": [0.0, -inf, 1.0]}, MessageStatus.NOT_FINITE
    yield "nan quaternion", {"quat_wxyz": [nan, 0.0, 0.0, 0.0]}, MessageStatus.NOT_FINITE
    yield "nan time", {"time": nan}, MessageStatus.NOT_FINITE
    yield "long quaternion", {"quat_wxyz": [1.0, 0.1, 0.0, 0.0]}, MessageStatus.NOT_UNIT
    yield "zero quaternion", {"quat_wxyz": [0.0, 0.0, 0.0, 0.0]}, MessageStatus.NOT_UNIT
    yield "huge quaternion", {"quat_wxyz": [1e308, 1e308, 0.0, 0.0]}, MessageStatus.NOT_UNIT
    yield "old", {"time": 999.0}, MessageStatus.LATE
    yield "of the future", {"time": 1001.0}, MessageStatus.EARLY
    yield "same sequence", {"sequence": 1}, MessageStatus.REPLAYED
    yield "older sequence", {"sequence": 0}, MessageStatus.REPLAYED
    yield "another session", {"session": 8}, MessageStatus.OCCUPIED
    yield "beyond reach", {"pos": [30.0, 0.0, 1.0]}, MessageStatus.FAR
    yield "a jump", {"pos": [0.39, 0.6, 1.15]}, MessageStatus.FAR
    yield "a turn", {"quat_wxyz": [0.0, 0.0, 0.0, 1.0]}, MessageStatus.FAR
    yield "a device at infinity", {"pos": [1e300, 0.0, 0.0], "relative": True}, MessageStatus.FAR
    yield "huge position", {"pos": [1e308, 1e308, 1e308]}, MessageStatus.FAR
    yield "two coordinates", {"pos": [0.3, 0.0]}, MessageStatus.MALFORMED
    yield "text for a number", {"pos": ["0.3", 0.0, 1.0]}, MessageStatus.MALFORMED
    yield "no frame of ours", {"frame": "camera"}, MessageStatus.MALFORMED
    yield "another version", {"version": 2}, MessageStatus.MALFORMED
    yield "negative sequence", {"sequence": -1}, MessageStatus.MALFORMED
    yield "huge sequence", {"sequence": 2**63}, MessageStatus.MALFORMED
    yield "a field too many", {"quat_xyzw": [0.0, 0.0, 0.0, 1.0]}, MessageStatus.MALFORMED
    yield "a number for a truth", {"engaged": 1}, MessageStatus.MALFORMED


@pytest.mark.parametrize(
    ("fields", "status"), [row[1:] for row in refusals()], ids=[row[0] for row in refusals()]
)
@pytest.mark.filterwarnings("error")
def test_refused_messages_change_nothing_but_their_count(fields: dict, status: MessageStatus) -> None:
    w = wire()
    assert w.send(offset(x=0.1)) is MessageStatus.ACCEPTED
    before = w.step(0.0)
    w.sequence += 1
    assert w.raw(msgspec.msgpack.encode(w.message(offset(x=0.2)) | fields)) is status
    after = w.step(0.0)
    np.testing.assert_array_equal(after[0], before[0])
    np.testing.assert_array_equal(after[1], before[1])
    expected = dict.fromkeys(map(str, MessageStatus), 0) | {"accepted": 1, str(status): 1}
    assert w.filter.counters == expected
    assert (
        w.raw(msgspec.msgpack.encode(w.message(offset(x=0.2)))) is MessageStatus.ACCEPTED
    )  # its number is still free


def test_bytes_that_are_no_message() -> None:
    w = wire()
    good = msgspec.msgpack.encode(w.message())
    missing = w.message()
    del missing["frame"]
    for parts in (
        [b""],
        [good, good],
        [],
        [good[:-1]],
        [good + b"\0"],
        [b"\x81" * 1000],  # maps in maps in maps
        [good + b" " * MAX_BYTES],
        [pickle.dumps({"pos": [0.0, 0.0, 0.0]})],
        [msgspec.json.encode(w.message())],
        [msgspec.msgpack.encode(missing)],
        [msgspec.msgpack.encode([1, 2, 3])],
    ):
        assert w.raw(*parts) is MessageStatus.MALFORMED
    assert w.raw(good) is MessageStatus.ACCEPTED
    assert w.filter.counters["malformed"] == 11


def test_sessions_follow_one_another_and_do_not_come_back() -> None:
    w = wire()
    assert w.send(session=1) is MessageStatus.ACCEPTED
    assert w.send(session=2) is MessageStatus.OCCUPIED
    w.step(1.0)
    assert (
        w.send(session=2, sequence=0) is MessageStatus.ACCEPTED
    )  # a client that has started anew counts from zero
    w.step(1.0)
    assert w.send(session=1) is MessageStatus.REPLAYED
    w.filter.reset(SEEN)  # nor in another episode
    assert (
        w.send(session=1) is MessageStatus.REPLAYED
        and w.send(session=2, sequence=0) is MessageStatus.REPLAYED
    )


def test_a_device_that_loses_track_is_not_followed() -> None:
    w = wire()
    w.send((0.0, 0.0, 0.0), relative=True)
    assert w.send((0.9, 0.0, 0.0), relative=True) is MessageStatus.FAR
    np.testing.assert_allclose(w.step()[0], HAND)
    assert w.send((0.1, 0.0, 0.0), relative=True) is MessageStatus.ACCEPTED
    np.testing.assert_allclose(w.step()[0], offset(x=0.1))


# fuzzing, through a real socket


@pytest.fixture
def stream() -> Iterator[StreamSource]:
    source = StreamSource("tcp://127.0.0.1:*")
    source.reset(SEEN)
    yield source
    source.close()


@pytest.fixture
def client(stream: StreamSource) -> Iterator[zmq.Socket]:
    with zmq.Context() as context, context.socket(zmq.PUSH) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        socket.connect(stream.address)
        yield socket


def drain(stream: StreamSource, count: int, step: float) -> None:
    """Ask for targets until `count` messages have been counted; none of them may move."""
    deadline = time.monotonic() + 20.0
    while sum(stream.counters.values()) < count:
        assert time.monotonic() < deadline, stream.counters
        pos, rot = to_world(stream.target(step, SEEN), SEEN)
        np.testing.assert_allclose(pos, HAND, atol=1e-9)
        np.testing.assert_allclose(rot, SEEN.ee_rot_w, atol=1e-9)


def fuzzed(rng: np.random.Generator) -> list[bytes]:
    """A message that is broken in a random way: bytes cut or drawn, parts doubled, fields made nonsense."""
    valid = wire().message() | {"time": time.time(), "session": 1, "sequence": int(rng.integers(2**62))}
    nonsense = [
        None,
        -1,
        2**64 - 1,
        math.nan,
        math.inf,
        "",
        "wörld",
        b"\xff",
        [],
        [[]],
        {},
        {"a": {}},
        True,
        1e308,
    ]
    kind = rng.integers(5)
    if kind == 0:
        return [rng.bytes(int(rng.integers(0, 2 * MAX_BYTES)))]
    data = msgspec.msgpack.encode(valid)
    if kind == 1:
        return [data[: rng.integers(len(data))]]
    if kind == 2:
        return [data] * int(rng.integers(2, 4))
    name = list(valid)[rng.integers(len(valid))]
    value = nonsense[rng.integers(len(nonsense))]
    if kind == 3:
        where = rng.choice(["pos", "quat_wxyz"])
        items = list(valid[where])
        items[rng.integers(len(items))] = value if value is not True and value != -1 else math.nan
        return [msgspec.msgpack.encode(valid | {where: items})]
    broken = valid | {name: value}
    if name in ("session", "sequence") and value == 2**64 - 1:
        broken[name] = -1
    if name == "time":
        broken[name] = value if isinstance(value, float) else "now"
    return [msgspec.msgpack.encode(broken)]


@pytest.mark.filterwarnings("error")
def test_ten_thousand_fuzzed_messages_neither_crash_nor_move(
    stream: StreamSource, client: zmq.Socket
) -> None:
    rng, count = np.random.default_rng(0), 10_000
    for k in range(count):
        client.send_multipart(fuzzed(rng))
        if k % 250 == 249:
            drain(stream, k + 1, step=0.02 * k)
    counters = stream.counters
    assert sum(counters.values()) == count and counters["accepted"] == 0, counters
    assert all(counters[name] > 100 for name in ("malformed", "not_finite")), counters
    pos, deadline, sequence = HAND, time.monotonic() + 5.0, 0
    while stream.counters["accepted"] == 0 and time.monotonic() < deadline:  # and it still listens
        target = StampedTarget(time.time(), "world", offset(x=0.1), np.array([1.0, 0.0, 0.0, 0.0]))
        client.send(sources.message.encode(target, session=3, sequence=sequence))
        time.sleep(0.01)
        pos, _ = to_world(stream.target(1000.0 + sequence, SEEN), SEEN)
        sequence += 1
    assert stream.counters["accepted"] >= 1
    np.testing.assert_allclose(pos, offset(x=0.1))


def test_flipped_bits_never_lead_far() -> None:
    """One random bit of a good message: it may still be good, but leads nowhere a good one could not."""
    rng, w = np.random.default_rng(1), wire()
    for k in range(2000):
        w.sequence = k
        data = bytearray(msgspec.msgpack.encode(w.message()))
        data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
        w.raw(bytes(data))
        pos, rot = w.step(0.0)
        assert np.isfinite(pos).all() and np.isfinite(rot).all()
        assert np.linalg.norm(pos - SEEN.base_pos_w) <= QUICK.max_distance + 1e-9
    assert sum(w.filter.counters.values()) == 2000
    assert w.filter.counters["malformed"] > 500 and w.filter.counters["accepted"] > 100


# addresses


@pytest.mark.parametrize(
    ("address", "local"),
    [
        ("tcp://127.0.0.1:5601", True),
        ("tcp://127.8.9.1:5601", True),
        ("tcp://localhost:5601", True),
        ("tcp://[::1]:5601", True),
        ("ipc:///tmp/x", True),
        ("inproc://x", True),
        ("tcp://*:5601", False),
        ("tcp://0.0.0.0:5601", False),
        ("tcp://192.168.1.2:5601", False),
        ("tcp://eth0:5601", False),
        ("tcp://127.0.0.1.example.org:5601", False),
        ("udp://127.0.0.1.evil:5601", False),
    ],
)
def test_which_addresses_are_local(address: str, local: bool) -> None:
    assert is_local(address) is local


def test_other_addresses_are_refused_unless_asked() -> None:
    with pytest.raises(SourceError, match=r"'tcp://\*:5601' can be reached from other machines"):
        StreamSource("tcp://*:5601")
    open_to_all = StreamSource("tcp://0.0.0.0:*", allow_remote=True)
    open_to_all.close()


@pytest.mark.parametrize(
    "address", ["tcp://127.0.0.1:99999", "tcp://127.0.0.1", "tcp://127.0.0.1:", "tcp://127.0.0.1:x"]
)
def test_addresses_that_are_none(address: str) -> None:
    with pytest.raises(SourceError, match=re.escape(address)):
        StreamSource(address)


def test_a_busy_port_is_named(stream: StreamSource) -> None:
    with pytest.raises(
        SourceError, match=re.escape(f"'{stream.address}' cannot be opened: Address already in use")
    ):
        StreamSource(stream.address)


def test_a_file_in_the_way_of_an_ipc_address_is_kept(tmp_path: Path) -> None:
    """ZeroMQ itself would remove it, and take the place of a socket that is in use."""
    for file in (tmp_path / "notes.txt", tmp_path / "link"):
        if file.name == "link":
            file.symlink_to(tmp_path / "notes.txt")
        else:
            file.write_text("mine")
        with pytest.raises(SourceError, match=re.escape(f"'{file}' exists and is no socket")):
            StreamSource(f"ipc://{file}")
        assert file.read_text() == "mine"
    with pytest.raises(SourceError, match="exists and is no socket"):
        StreamSource(f"ipc://{tmp_path}")


def test_an_ipc_address_in_use_is_named_and_one_left_behind_is_taken(tmp_path: Path) -> None:
    address = f"ipc://{tmp_path / 's'}"
    with sockets.socket(sockets.AF_UNIX) as left:  # bound, and never listened to again
        left.bind(str(tmp_path / "s"))
    source = StreamSource(address)
    try:
        with pytest.raises(SourceError, match="Address already in use"):
            StreamSource(address)
        with zmq.Context() as context, context.socket(zmq.PUSH) as client:  # and it still listens
            client.setsockopt(zmq.LINGER, 0)
            client.connect(address)
            client.send(b"no message")
            source.reset(SEEN)
            deadline = time.monotonic() + 20.0
            while source.counters["malformed"] < 1:
                assert time.monotonic() < deadline
                source.target(0.0, SEEN)
    finally:
        source.close()


def test_what_waits_to_be_read_is_bounded(stream: StreamSource) -> None:
    """In transmissions a client, and in bytes a transmission: 1 MiB."""
    most = stream._socket.getsockopt(zmq.RCVHWM) * stream._socket.getsockopt(zmq.MAXMSGSIZE)  # pyright: ignore[reportOperatorIssue]
    assert 0 < most <= 1 << 20 and stream._socket.getsockopt(zmq.MAXMSGSIZE) >= MAX_BYTES  # pyright: ignore[reportOperatorIssue]


def test_a_replayed_stream_that_nobody_reads_goes_on_and_can_be_closed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its client fills every buffer on the way, drops what finds no room, and ends when it is told to."""
    sent, filled = itertools.count(), threading.Event()

    def encoded(*_) -> bytes:
        if next(sent) == 8000:  # 32 MB; some 8 MB find room
            filled.set()
        return bytes(4000)

    monkeypatch.setattr(replayed_stream, "RATE", 1e9)
    monkeypatch.setattr(replayed_stream, "encode", encoded)
    source = load_source("stream:figure_eight", "tcp://127.0.0.1:*")
    source.reset(SEEN)
    assert filled.wait(60.0)
    source.close()


# documents and numbers


def test_the_client_of_the_document_moves_the_target(stream: StreamSource, tmp_path: Path) -> None:
    code = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)
    assert len(code) == 1 and len(code[0].splitlines()) <= 20
    file = tmp_path / "client.py"
    file.write_text(code[0].replace("tcp://127.0.0.1:5601", stream.address))
    client = subprocess.Popen([sys.executable, file])
    start, poses = time.monotonic(), []
    try:
        while stream.counters["accepted"] < 150 and time.monotonic() < start + 20.0:
            poses.append(to_world(stream.target(time.monotonic() - start, SEEN), SEEN)[0])
            time.sleep(0.005)
    finally:
        client.kill()
        client.wait()
    counters = dict(stream.counters)
    counters.pop("late")  # while the sockets found each other
    assert sum(counters.values()) == counters["accepted"] >= 150, stream.counters
    assert np.ptp(np.array(poses)[:, 1]) > 0.05  # it swings along y


def test_the_document_names_every_field_and_every_count() -> None:
    text = DOCUMENT.read_text()
    fields = re.findall(r"^\| `(\w+)` \| (?:int|float|str|3|4|bool)", text, re.MULTILINE)
    assert fields == list(sources.message.Message.__struct_fields__)
    for status in MessageStatus:
        assert f"`{status}`" in text, status
    s = StreamConfig()
    for number in (s.max_age, s.max_lead, s.hold_after, s.max_distance, s.max_jump, s.max_turn, *s.limits):
        assert f"{number:g}" in text, number


def test_latency() -> None:
    """The bench in short: every row has measured something, however busy the machine is."""
    frame = stream_latency(seconds=0.5)
    uses, median = (frame[name].to_numpy() for name in ("uses", "median (ms)"))
    assert (uses >= 1).all() and (median > 0).all()


def test_nothing_is_unpickled() -> None:
    folder = Path(sources.__file__).parent
    for file in folder.glob("*.py"):
        assert not re.search(r"\bpickle|recv_pyobj|send_pyobj|\beval\(|\bexec\(", file.read_text()), file


def test_rotations_of_targets_stay_rotations() -> None:
    """Slewing on and on must not shear what it turns."""
    w = wire(StreamConfig(limits=Limits(0.5, 2.0)))
    for k in range(500):
        assert (
            w.send(offset(x=0.1 * math.sin(k / 10)), rpy=(math.sin(k / 20), 0.3, math.cos(k / 15)))
            is MessageStatus.ACCEPTED
        )
        target = w.filter.target(PERIOD * (k + 1), SEEN)
        rot = matrix_from_wxyz(target.quat_wxyz)
        np.testing.assert_allclose(rot @ rot.T, np.eye(3), atol=1e-12)
