"""Targets over ZeroMQ on this machine: `wbc-bench track --source stream`; the messages are in STREAM.md."""

import ipaddress
import os
import socket as sockets
import stat
from collections.abc import Mapping

from wbc_bench.errors import SourceError, missing_extra
from wbc_bench.sources.interface import Seen, StampedTarget
from wbc_bench.sources.stream_filter import Status, StreamConfig, StreamFilter

ADDRESS = "tcp://127.0.0.1:5601"
MAX_DRAIN = 5000  # transmissions taken in at once: a flood must not stop the control loop
MAX_TRANSMISSION = 4096  # [bytes] ZeroMQ drops a client that sends more in one part; a message may have 1024
MAX_WAITING = 256  # transmissions of a client that wait to be read, 1 MiB; the others wait at the client


def is_local(address: str) -> bool:
    """Whether only this machine can reach a ZeroMQ address."""
    transport, _, rest = address.partition("://")
    if transport in ("ipc", "inproc"):
        return True
    host = rest.rpartition(":")[0].strip("[]")
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False  # a name, an interface or `*`


def has_port(address: str) -> bool:
    """Whether a TCP address ends in a port; ZeroMQ itself takes 99999 for 34463."""
    transport, _, rest = address.partition("://")
    port = rest.rpartition(":")[2]
    return transport != "tcp" or port == "*" or (port.isdecimal() and int(port) < 1 << 16)


def check_free(address: str) -> None:
    """Whether an ipc address is free: ZeroMQ removes whatever file is in its way, and whoever listens there.

    Raises: SourceError, a file stands there that is no socket, or one that is in use.
    """
    transport, _, path = address.partition("://")
    if transport != "ipc" or path.startswith(("@", "*")):  # abstract, or any free name
        return
    try:
        mode = os.lstat(path).st_mode
    except (OSError, ValueError):
        return  # nothing there, or no name of a file: binding says so
    if not stat.S_ISSOCK(mode):
        raise SourceError(
            f"stream address '{address}': '{path}' exists and is no socket, valid: a path that does not exist"
        )
    with sockets.socket(sockets.AF_UNIX) as probe:
        try:
            probe.connect(path)
        except OSError:
            return  # left behind by a process that has ended
    raise SourceError(f"stream address '{address}' cannot be opened: Address already in use")


class StreamSource:
    """Binds a PULL socket; clients connect with PUSH. Every transmission is read, the latest good one wins.

    CONFLATE would do the same for the target, but what it drops could not be counted.
    """

    live = True

    def __init__(
        self,
        address: str = ADDRESS,
        config: StreamConfig = StreamConfig(),  # noqa: B008  (immutable)
        allow_remote: bool = False,
    ) -> None:
        """Raises: SourceError when pyzmq is missing, or the address is not local, not valid, or in use."""
        self.name = "stream"
        self.filter = StreamFilter(config)
        if not has_port(address):
            raise SourceError(
                f"stream address '{address}' has no port, valid: 0 to 65535, or * for a free one"
            )
        if not allow_remote and not is_local(address):
            raise SourceError(
                f"stream address '{address}' can be reached from other machines, valid: loopback, "
                f"e.g. {ADDRESS}; --allow-remote opens it to whoever can send there"
            )
        check_free(address)
        try:
            import zmq
        except ImportError as error:
            raise SourceError(missing_extra("a stream", "live", error)) from error
        self._zmq = zmq
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.PULL)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.MAXMSGSIZE, MAX_TRANSMISSION)
        self._socket.setsockopt(zmq.RCVHWM, MAX_WAITING)
        try:
            self._socket.bind(address)
        except zmq.ZMQError as error:
            self.close()
            raise SourceError(f"stream address '{address}' cannot be opened: {error.strerror}") from error
        self.address: str = self._socket.getsockopt_string(zmq.LAST_ENDPOINT)

    @property
    def counters(self) -> Mapping[str, int]:
        """Messages by what became of them."""
        return self.filter.counters

    @property
    def status(self) -> Status:
        """What the target is doing."""
        return self.filter.status

    def reset(self, seen: Seen) -> None:
        """Begin where the hand is."""
        self.filter.reset(seen)

    def target(self, time: float, seen: Seen) -> StampedTarget:
        """Take in what has come, then say where the target is at `time` [s]."""
        for _ in range(MAX_DRAIN):
            try:
                parts = self._socket.recv_multipart(self._zmq.NOBLOCK)
            except self._zmq.Again:
                break
            self.filter.take(parts, seen)
        return self.filter.target(time, seen)

    def close(self) -> None:
        """Free the address."""
        self._socket.close()
        self._context.term()
