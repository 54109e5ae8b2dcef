"""The live page answers whoever has its address, and no other page of the same browser."""

from urllib.parse import urlsplit

import pytest

from live_page import Served, connect, cookie_of, free_port, get
from wbc_bench.errors import BenchError
from wbc_bench.viewer.guard import Guard


def test_the_token_opens_the_page_and_a_cookie_keeps_it_open(served: Served) -> None:
    place = urlsplit(served.url)
    status, body, cookie = get(served, f"/?{place.query}")
    assert status == 200 and "<html" in body
    assert "HttpOnly" in cookie and "SameSite=Strict" in cookie
    mine = cookie.split(";")[0]
    assert get(served, "/", Cookie=mine)[0] == 200
    for others in ("other=1", 'their={"a": 1, "b": [2]}', "no cookie at all", "a b=c", 'x="open'):
        assert get(served, "/", Cookie=f"{others}; {mine}")[0] == 200, others
        assert get(served, "/", Cookie=f"{mine}; {others}")[0] == 200, others


@pytest.mark.parametrize(
    ("headers", "words"),
    [
        ({}, "token"),
        ({"Cookie": "wbc_bench_80=x"}, "token"),
        ({"Host": "evil.example"}, "host 'evil.example'"),
        ({"Host": "[::1"}, "host '[::1'"),
        ({"Host": "localhost.evil.example:80"}, "is not the address of this page"),
        ({"Origin": "http://evil.example"}, "origin 'http://evil.example'"),
        ({"Origin": "null"}, "origin 'null'"),
    ],
)
def test_everybody_else_is_refused(served: Served, headers: dict[str, str], words: str) -> None:
    token = "" if words == "token" else f"?{urlsplit(served.url).query}"
    status, body, cookie = get(served, f"/{token}", **headers)
    assert status == 403 and words in body and not cookie


def test_a_socket_needs_the_origin_of_the_page_and_the_token(served: Served) -> None:
    pytest.importorskip("websockets.sync.client")
    from websockets.exceptions import InvalidStatus

    place, cookie = urlsplit(served.url), cookie_of(served)
    here = f"http://{place.netloc}"
    with connect(served, here, cookie):
        pass
    port = (place.port or 0) + 1
    for origin, given in (
        ("http://evil.example", cookie),
        (f"http://{place.hostname}:{port}", cookie),  # another server of this machine
        (None, cookie),
        (here, None),
    ):
        with pytest.raises(InvalidStatus) as refused, connect(served, origin, given):
            pass
        assert refused.value.response.status_code == 403


def test_a_remote_page_is_opened_by_address_or_name_but_not_by_another_s_name() -> None:
    import socket

    guard = Guard(remote=True)
    path = "/?" + urlsplit(guard.address("0.0.0.0", 8080)).query

    def refused(host: str) -> str:
        from websockets.datastructures import Headers

        return guard.refusal(path, Headers({"Host": host}))

    assert not any(map(refused, ("192.168.1.7:8080", "[fe80::1]:8080", f"{socket.gethostname()}:8080")))
    assert "host" in refused("rebound.example:8080")


def test_headers_that_are_there_twice_are_refused() -> None:
    from websockets.datastructures import Headers

    guard = Guard(remote=False)
    path = "/?" + urlsplit(guard.address("127.0.0.1", 8080)).query
    here = ("Host", "127.0.0.1:8080"), ("Origin", "http://127.0.0.1:8080")
    assert guard.refusal(path, Headers(here)) == ""
    for again in (("Host", "evil.example"), ("Origin", "http://evil.example")):
        assert "cannot be read" in guard.refusal(path, Headers([*here, again]))
    assert "cannot be read" in guard.refusal("//[" + path, Headers(here))


def test_two_pages_have_two_tokens() -> None:
    assert Guard(False).address("127.0.0.1", 1) != Guard(False).address("127.0.0.1", 1)


@pytest.mark.parametrize("kind", ["everything", "sockets", "messages"])
def test_a_viser_that_goes_around_the_guard_is_not_served(monkeypatch, kind: str) -> None:
    """As a newer one might: it hands websockets no `process_request`, or one that skips what it likes."""
    pytest.importorskip("viser")
    import websockets.asyncio.server as server
    from viser.infra import _infra

    from wbc_bench.viewer.scene import serving

    class Apart:
        """Another module with the same `serve`, out of reach of the patch."""

        @staticmethod
        def serve(*args, process_request, **options):
            def process(connection, request):
                if kind == "sockets" and "Upgrade" not in request.headers:
                    return connection.respond(403, "")
                return process_request(connection, request)

            return serve(*args, process_request=process, **options)

    serve, real = server.serve, getattr(_infra, "websockets")  # noqa: B009  (not exported)
    if kind == "messages":
        gone = "viser._messages.GuiUpdateMessage"
        monkeypatch.setattr("wbc_bench.viewer.scene.check_guarded", lambda *_: monkeypatch.delattr(gone))
    else:
        apart = type("websockets", (), {"asyncio": type("asyncio", (), {"server": Apart})})
        apart.__getattr__ = lambda self, name: getattr(real, name)
        monkeypatch.setattr(_infra, "websockets", apart())
    with pytest.raises(BenchError, match=r"viser \S+ .*valid: viser 1.1.1"), serving(port=free_port()):
        pass
