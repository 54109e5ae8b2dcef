"""A script sent over the stream: `--source stream:SCRIPT` goes through the socket without a person."""

import contextlib
import secrets
import threading
import time as clocks
from collections.abc import Mapping

from wbc_bench.sources.interface import Seen, StampedTarget
from wbc_bench.sources.message import encode
from wbc_bench.sources.scripted import ScriptedSource
from wbc_bench.sources.stream import StreamSource

RATE = 100  # [Hz] of sending


class ReplayedStream:
    """A stream and a client of it on a thread of its own, started at every reset."""

    live = True

    def __init__(self, script: ScriptedSource, stream: StreamSource) -> None:
        self.name = f"stream:{script.name}"
        self.script = script.script
        self._script, self._stream = script, stream
        self._done, self._client = threading.Event(), None

    @property
    def counters(self) -> Mapping[str, int]:
        """Messages by what became of them."""
        return self._stream.counters

    def reset(self, seen: Seen) -> None:
        """Begin where the hand is."""
        self._stop()
        self._stream.reset(seen)
        self._script.reset(seen)
        self._client = threading.Thread(target=self._send, args=(seen,), daemon=True)
        self._client.start()

    def target(self, time: float, seen: Seen) -> StampedTarget:
        """What the stream has brought."""
        return self._stream.target(time, seen)

    def close(self) -> None:
        """Stop sending and free the address."""
        self._stop()
        self._stream.close()

    def _stop(self) -> None:
        if self._client is not None:
            self._done.set()
            self._client.join()
            self._done.clear()

    def _send(self, seen: Seen) -> None:
        import zmq

        context = zmq.Context()
        socket = context.socket(zmq.PUSH)
        socket.setsockopt(zmq.LINGER, 0)
        socket.connect(self._stream.address)
        session, sequence, start = secrets.randbits(63), 0, clocks.monotonic()
        while not self._done.wait(1 / RATE):
            target = self._script.target(clocks.monotonic() - start, seen)
            with contextlib.suppress(zmq.Again):  # nobody reads: waiting for room would never end
                socket.send(encode(target._replace(time=clocks.time()), session, sequence), zmq.NOBLOCK)
            sequence += 1
        socket.close()
        context.term()
