"""The live view in headless Chromium: a person drags the target with the mouse, and the hand follows."""

import shutil
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from urllib.parse import urlsplit

import numpy as np
import pytest

from live_page import Served, wait_for
from wbc_bench.errors import BenchError

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
SOFTWARE = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)
SIZE = {"width": 1000, "height": 560}  # [px] of the page,
COARSE = 0.4  # and pixels drawn for each: a processor draws them

pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="chromium is not installed (apt-get install chromium)"
)


@pytest.fixture
def browsers() -> Iterator[list]:
    """Two, each a process of its own."""
    api = pytest.importorskip("playwright.sync_api")
    with api.sync_playwright() as playwright:
        both = [playwright.chromium.launch(executable_path=CHROMIUM, args=list(SOFTWARE)) for _ in range(2)]
        yield both
        for browser in both:
            browser.close()


def pixel_of(camera, point_w: np.ndarray) -> np.ndarray:
    """Where a point (3,) [m] in the world is in the page, (2,) [px]; z looks ahead, y down."""
    from wbc_bench.rotations import matrix_from_wxyz

    seen = matrix_from_wxyz(np.asarray(camera.wxyz)).T @ (point_w - np.asarray(camera.position))
    focal = SIZE["height"] / 2 / np.tan(camera.fov / 2)  # [px]
    return np.array([SIZE["width"], SIZE["height"]]) / 2 + focal * seen[:2] / seen[2]


def open_page(browser, url: str, problems: list[str]):
    page = browser.new_page(viewport=SIZE, device_scale_factor=COARSE)
    page.on("console", lambda m: problems.append(m.text) if m.type == "error" else None)
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.goto(url, wait_until="commit", timeout=60_000)
    page.wait_for_selector("text=position", timeout=60_000)
    return page


def test_the_hand_follows_the_dragged_gizmo_and_a_second_browser_sees_it(browsers, served: Served) -> None:
    problems: list[str] = []
    page = open_page(browsers[0], served.url, problems)
    wait_for(lambda: len(served.server.get_clients()) == 1, 60, "the page is connected")
    view, session = served.view, served.session
    camera = next(iter(served.server.get_clients().values())).camera
    start = np.array(view.gizmo.position)
    # the gizmo's axes are those of the hand; its arrows begin beside its centre
    from wbc_bench.rotations import matrix_from_wxyz
    from wbc_bench.viewer.live import GIZMO

    up_w = matrix_from_wxyz(np.array(view.gizmo.wxyz))[:, 2]
    tip, further = (pixel_of(camera, start + length * GIZMO * up_w) for length in (0.8, 1.2))
    page.mouse.move(*tip)
    page.wait_for_timeout(500)
    page.mouse.down()
    for part in np.linspace(0, 1, 6)[1:]:
        page.mouse.move(*(tip + part * (further - tip)))
        page.wait_for_timeout(200)
    page.mouse.up()
    wait_for(lambda: bool(np.linalg.norm(np.array(view.gizmo.position) - start) > 0.03), 20, "it was dragged")
    goal = np.array(view.gizmo.position)
    assert abs((goal - start) @ up_w) == pytest.approx(np.linalg.norm(goal - start), rel=0.01)
    wait_for(lambda: bool(np.linalg.norm(session.moment.ee_pos_w - goal) < 0.02), 60, "the hand is there")

    second = open_page(browsers[1], served.url, problems)
    wait_for(lambda: len(served.server.get_clients()) == 2, 60, "the second browser is connected")
    for one in (page, second):
        shown = one.locator("input").evaluate_all("all => all.map(input => input.value)")
        assert any(abs(float(value) - goal[2]) < 2e-3 for value in shown if _is_number(value)), shown
    words = "KeyError: <class 'int'> &amp; *a* _b_ `c` [d](e) <img src=f> {1 + 1}"
    view.ask(lambda: refuse(words))
    second.wait_for_selector(f'text="⚠ {words}"', timeout=20_000)  # as it is, not as Markdown or HTML
    assert not problems, problems


def test_a_page_of_another_site_in_the_same_browser_is_refused(browsers, served: Served) -> None:
    """It knows the port, and its browser has the cookie of the page: its socket and its requests fail."""
    problems: list[str] = []
    context = browsers[0].new_context(viewport=SIZE, device_scale_factor=COARSE)
    page = context.new_page()
    page.goto(served.url, wait_until="commit", timeout=60_000)
    page.wait_for_selector("text=position", timeout=60_000)
    wait_for(lambda: len(served.server.get_clients()) == 1, 60, "the page itself is connected")
    place = urlsplit(served.url)

    class Foreign(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(b"<html>a page of another site</html>")

        def log_message(self, format: str, *args) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Foreign) as foreign:
        threading.Thread(target=foreign.serve_forever, daemon=True).start()
        other = context.new_page()
        other.goto(f"http://127.0.0.1:{foreign.server_port}/")
        script = f"""() => new Promise(done => {{
            const socket = new WebSocket("ws://{place.netloc}", ["viser-v1.1.1"]);
            socket.onopen = () => done("open"); socket.onerror = () => done("refused");
        }})"""
        assert other.evaluate(script) == "refused"
        read = f"() => fetch('http://{place.netloc}/').then(() => 'read', () => 'refused')"
        assert other.evaluate(read) == "refused"
        foreign.shutdown()
    assert len(served.server.get_clients()) == 1
    assert not problems


def refuse(words: str) -> None:
    raise BenchError(words)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
