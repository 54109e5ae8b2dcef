"""Who may open the live page: only whoever was given its address.

The page moves a robot and starts controllers, and any page of a browser can reach all ports of its machine.
So each request must name the served address as its host (a name that was bound to this machine behind the
browser's back does not), come from that address where it says where from, and carry the token of the printed
address: in the address itself, or in the cookie that this sets.
"""

import http.client
import ipaddress
import secrets
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from typing import Any
from unittest import mock
from urllib.parse import parse_qs, urlsplit

from wbc_bench.errors import BenchError

GUARDED = "1.1.1"  # version of viser whose servers are known
KNOCK_TIMEOUT = 10.0  # [s] for a server of this process to answer
Answer = Any  # websockets' Response, or None to go on
_PATCHING = threading.Lock()


class Guard:
    """Lets requests through that bear the token and come from the page itself."""

    def __init__(self, remote: bool) -> None:
        """`remote`: the page may be opened under any address of this machine, not only as localhost."""
        self._remote = remote
        self._token = secrets.token_urlsafe(16)

    def address(self, host: str, port: int) -> str:
        """The address of the page, token included."""
        return f"http://{'localhost' if host == '0.0.0.0' else host}:{port}/?token={self._token}"

    def refusal(self, path: str, headers: Any) -> str:
        """Why a request is refused; empty when it is not."""
        try:
            return self._refusal(path, headers)
        except (ValueError, LookupError):  # no address, no text, or two headers where there is one
            return "the request cannot be read"

    def _refusal(self, path: str, headers: Any) -> str:
        host = headers.get("Host", "")
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:  # no address at all
            name = ""
        if not self._is_here(name):
            return f"host {host!a} is not the address of this page"
        origin = headers.get("Origin")
        if origin is not None and origin != f"http://{host}":
            return f"origin {origin!a} is not this page"
        if origin is None and headers.get("Upgrade", "").lower() == "websocket":
            return "a socket of no page"
        given = parse_qs(urlsplit(path).query).get("token", [""])[0] or self._cookie(headers, host)
        if not secrets.compare_digest(given.encode(), self._token.encode()):
            return "the token of the printed address is missing"
        return ""

    def cookie(self, host: str) -> str:
        """What a browser that gave the token shall send from now on, and no other site may make it send."""
        return f"{_cookie_name(host)}={self._token}; Path=/; HttpOnly; SameSite=Strict"

    def _is_here(self, name: str) -> bool:
        if name in ("localhost", "127.0.0.1", "::1"):
            return True
        if not self._remote:
            return False
        # a name that another site chose could be bound to this machine: an address or its own name cannot
        return _is_address(name) or name in (socket.gethostname().lower(), socket.getfqdn().lower())

    def _cookie(self, headers: Any, host: str) -> str:
        """The token in the cookie; other servers of this machine have cookies too, of whatever form."""
        for part in ";".join(headers.get_all("Cookie")).split(";"):
            name, _, value = part.strip().partition("=")
            if name == _cookie_name(host):
                return value
        return ""


@contextmanager
def guarded(guard: Guard) -> Iterator[None]:
    """Servers of viser that are begun inside answer no request that the guard refuses.

    viser 1.1.1 hands its own `process_request` to websockets and has no place for another, so the call is
    caught on its way there; `check_guarded` notices a version that takes another way.
    """
    import websockets.asyncio.server as server

    serve = server.serve

    def serve_guarded(*args: Any, process_request: Callable | None = None, **options: Any) -> Any:
        def process(connection: Any, request: Any) -> Answer:
            refused = guard.refusal(request.path, request.headers)
            if refused:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"refused: {refused}\n")
            answer = None if process_request is None else process_request(connection, request)
            if answer is not None:
                answer.headers["Set-Cookie"] = guard.cookie(request.headers.get("Host", ""))
                answer.headers["Referrer-Policy"] = "no-referrer"
            return answer

        return serve(*args, process_request=process, **options)

    with _PATCHING, mock.patch.object(server, "serve", serve_guarded):
        yield


def check_guarded(host: str, port: int) -> None:
    """Knock without a token, as a page and as a socket: another version of viser may go around the hook.

    Raises: BenchError, it lets in who must stay out.
    """
    place = "127.0.0.1" if host == "0.0.0.0" else host
    socket_headers = {
        **{"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"},
        **{"Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==", "Sec-WebSocket-Protocol": "viser-v1.1.1"},
    }
    for headers in ({}, socket_headers):
        connection = http.client.HTTPConnection(place, port, timeout=KNOCK_TIMEOUT)
        try:
            connection.request("GET", "/", headers=headers)
            status = connection.getresponse().status
        except (OSError, http.client.HTTPException):
            status = None  # not let in, at least not with an answer of the guard
        finally:
            connection.close()
        if status != http.HTTPStatus.FORBIDDEN:
            raise BenchError(_unknown_viser("lets in who does not have the address of the page"))


def accept_values_only(server: Any) -> None:
    """Let what a page sends change the value of a control and nothing else of it.

    viser 1.1.1 sets whatever attribute of a control a message names, its label or its callbacks too.

    Raises: BenchError, this viser takes its messages in another way.
    """
    try:
        from viser._messages import GuiUpdateMessage

        handlers = server.gui._websock_interface._incoming_handlers[GuiUpdateMessage]
    except (ImportError, AttributeError, KeyError) as error:
        raise BenchError(_unknown_viser(f"takes messages in another way ({error})")) from error

    def strip(_: Any, message: Any) -> None:
        message.updates = {name: value for name, value in message.updates.items() if name == "value"}

    handlers.insert(0, strip)


def _unknown_viser(what: str) -> str:
    return f"viser {version('viser')} {what}: nothing is served; valid: viser {GUARDED}"


def _cookie_name(host: str) -> str:
    """Browsers share cookies between the ports of a machine."""
    port = host.rpartition(":")[2]
    return f"wbc_bench_{port if port.isdigit() else 80}"


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
