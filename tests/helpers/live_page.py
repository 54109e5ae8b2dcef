"""The live page, served on a thread, and what a crafted page would send to it."""

import http.client
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

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


def get(page: Served, path: str, **headers: str) -> tuple[int, str, str]:
    """Status, body and cookie of a request to the page."""
    place = urlsplit(page.url)
    connection = http.client.HTTPConnection(place.hostname or "", place.port, timeout=20)
    names = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request("GET", path, headers={"Host": place.netloc} | names)
    answer = connection.getresponse()
    return answer.status, answer.read().decode(errors="replace"), answer.getheader("Set-Cookie") or ""


def cookie_of(page: Served) -> str:
    """What a browser sends that has opened the page by its address."""
    return get(page, f"/?{urlsplit(page.url).query}")[2].split(";")[0]


def connect(page: Served, origin: str | None, cookie: str | None) -> Any:
    """A socket of the page, as viser's client opens one."""
    from websockets.sync.client import connect as open_socket

    return open_socket(
        f"ws://{urlsplit(page.url).netloc}",
        origin=origin,  # pyright: ignore[reportArgumentType]
        additional_headers={"Cookie": cookie} if cookie else {},
        subprotocols=["viser-v1.1.1"],  # pyright: ignore[reportArgumentType]
        max_size=None,
    )


CAMERA = {  # the first message of a client, without which it counts as not yet connected
    **{"wxyz": [1.0, 0.0, 0.0, 0.0], "position": [1.0, 1.0, 1.0], "fov": 1.0, "near": 0.1, "far": 10.0},
    **{"image_height": 10, "image_width": 10, "look_at": [0.0, 0.0, 0.0], "up_direction": [0.0, 0.0, 1.0]},
}


@contextmanager
def crafting(page: Served) -> Iterator[Callable[..., None]]:
    """A client that has the token and sends what it likes: `send(type, field=value, ...)`."""
    msgpack = pytest.importorskip("msgspec").msgpack
    with connect(page, f"http://{urlsplit(page.url).netloc}", cookie_of(page)) as client:
        threading.Thread(target=lambda: [None for _ in client], daemon=True).start()  # it reads, and forgets

        def send(kind: str, **fields: Any) -> None:
            client.send(msgpack.encode({"type": kind, **fields}))

        send("ViewerCameraMessage", **CAMERA)
        wait_for(lambda: len(page.server.get_clients()) == 1, 60, "the client is connected")
        yield send


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
