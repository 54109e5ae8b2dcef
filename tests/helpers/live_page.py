"""The live page, served on a thread."""

import socket
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from wbc_bench.episodes.single import LONGEST, free_episode
from wbc_bench.viewer.guard import Guard
from wbc_bench.viewer.session import Session


def session_of(spec: str, source: str, condition: str = "nominal", seed: int = 0) -> Session:
    return Session(spec, source, *free_episode("ablation_v1", condition, seed, LONGEST))


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Served:
    """A page that is served on a thread of its own."""

    def __init__(self) -> None:
        from wbc_bench.viewer.live import LiveView
        from wbc_bench.viewer.scene import serving

        self.session, self._stop, self._ready = session_of("ik", "live"), threading.Event(), threading.Event()

        self.guard = Guard(remote=False)

        def run() -> None:
            with serving(port=free_port(), guard=self.guard) as self.server:
                self.view = LiveView(self.server, self.session)
                self._ready.set()
                self.view.run(self._stop.is_set)

        self._thread = threading.Thread(target=run, daemon=True)
        self._thread.start()
        assert self._ready.wait(60)
        self.url = self.guard.address("127.0.0.1", self.server.get_port())

    def close(self) -> None:
        self._stop.set()
        self._thread.join(20)


@pytest.fixture
def served() -> Iterator[Served]:
    pytest.importorskip("viser")
    page = Served()
    yield page
    page.close()


def wait_for(condition: Callable[[], bool], seconds: float, what: str) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"after {seconds:g} s still not: {what}"
        time.sleep(0.05)
