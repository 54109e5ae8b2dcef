"""The live view: the session without a page, and the page in a headless browser."""

import socket
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from live_page import Served, crafting, free_port, session_of, wait_for
from wbc_bench.episodes.single import episode_of
from wbc_bench.errors import BenchError, SourceError, UnknownNameError
from wbc_bench.results.tracking import STOOD
from wbc_bench.sources.slew import Limits
from wbc_bench.viewer.session import Session

AWAY = np.array([0.06, -0.08, 0.04])  # [m] from the hand, within reach of the arm


def seconds(session: Session, duration: float) -> None:
    for _ in range(round(duration / session.period)):
        session.step()


def test_the_hand_stays_until_it_is_told_and_then_follows() -> None:
    session = session_of("ik", "live")
    start = session.moment
    seconds(session, 1.0)
    assert session.moment.position_error < 0.01 and session.status == "standing"
    session.set_goal(start.ee_pos_w + AWAY, np.array([1.0, 0.0, 0.0, 0.0]))
    seconds(session, 0.1)
    moved = np.linalg.norm(session.moment.target_pos_w - start.ee_pos_w)
    assert 0 < moved <= Limits().linear * 0.1 + 1e-9  # the target goes there, it does not jump
    seconds(session, 3.0)
    assert np.allclose(session.moment.target_pos_w, start.ee_pos_w + AWAY)
    assert session.moment.position_error < 0.02


def test_the_same_steps_give_the_same_bits_and_a_restart_forgets() -> None:
    session = session_of("ik", "figure_eight", "randomised", 3)
    seconds(session, 0.5)
    first = session.moment
    session.restart()
    assert session.moment.time == 0.0
    seconds(session, 0.5)
    assert all(np.array_equal(a, b) for a, b in zip(first, session.moment, strict=True))


def test_a_push_is_felt_and_seen() -> None:
    session = session_of("hold", "live")
    before = session.moment.qpos[:2].copy()
    session.push(np.array([0.0, 0.5]))
    session.step()
    moved = session.moment.qpos[:2] - before
    assert moved[1] > 0.005 > abs(moved[0])  # 0.5 m/s for 0.02 s is 0.01 m
    assert np.array_equal(session.moment.push_w, [0.0, 0.5])
    seconds(session, 0.5)
    assert not session.moment.push_w.any()


def test_it_ends_with_a_fall_and_goes_on_after_a_restart() -> None:
    session = session_of("hold", "live")
    for _ in range(4):
        session.push(np.array([2.0, 0.0]))
        seconds(session, 0.5)
    assert session.status in ("fell", "illegal contact") and not session.running
    ended = session.moment.time
    session.step()
    assert session.moment.time == ended
    session.restart("ik")
    seconds(session, 1.0)
    assert session.running and session.controller.info.name == "ik"


def test_what_cannot_be_loaded_changes_nothing() -> None:
    session = session_of("hold", "live")
    seconds(session, 0.1)
    for change in ({"spec": "holt"}, {"source": "figure_nine"}):
        with pytest.raises(UnknownNameError, match="did you mean"):
            session.restart(**change)
    assert session.moment.time == pytest.approx(0.1) and session.dragged
    with pytest.raises(SourceError, match="finite"):
        session.set_goal(np.array([np.nan, 0, 0]), np.array([1.0, 0, 0, 0]))
    with pytest.raises(UnknownNameError, match="condition"):
        session_of("hold", "live", "perturbed")


def test_a_door_is_seen_by_its_policy_and_drawn() -> None:
    pytest.importorskip("torch")
    session = session_of("hold", "live")
    assert session.surroundings is None and len(session.moment.scenery) == 0
    session.restart(source="diffusion")
    (angle,) = session.moment.scenery
    assert 0.3 < angle < 0.9  # [rad] as doors are drawn
    hand = session.moment.ee_pos_w
    seconds(session, 0.5)
    assert np.linalg.norm(session.moment.target_pos_w - hand) > 0.01  # the policy has set off
    session.restart(source="live")
    assert session.surroundings is None and len(session.moment.scenery) == 0


# --- the page -------------------------------------------------------------------------------------------


def test_the_gizmo_sets_the_target_and_the_field_shows_it(served: Served) -> None:
    view, session = served.view, served.session
    goal = session.moment.ee_pos_w + AWAY
    view.gizmo.position, view.gizmo.wxyz = goal, (1.0, 0.0, 0.0, 0.0)
    view.ask(view._goal_moved)  # what viser calls after a drag
    wait_for(lambda: bool(np.linalg.norm(session.moment.ee_pos_w - goal) < 0.02), 60, "the hand is there")
    assert np.allclose(view.panel._pos.value, goal, atol=1e-3)
    view.ask(lambda: view.restart("holt"))
    wait_for(lambda: "did you mean" in view.panel._message.content, 20, "the mistake is shown")
    view.ask(view.restart)
    wait_for(lambda: not view.panel._message.visible, 20, "it is forgotten")
    wait_for(lambda: session.moment.time < 5.0, 20, "a new episode")


def test_the_time_of_a_scored_run_begins_with_the_first_drag() -> None:
    pytest.importorskip("viser")
    from wbc_bench.viewer.live import LiveView
    from wbc_bench.viewer.scene import serving

    session, stop = Session("ik", "live", *episode_of(1.0, 0, "nominal")), threading.Event()
    with serving(port=free_port()) as server:
        view = LiveView(server, session)
        view.wait()
        thread = threading.Thread(target=view.run, args=(lambda: stop.is_set() or not session.running,))
        thread.start()
        time.sleep(0.3)
        assert session.moment.time == 0.0 and "waiting" in view.panel._state.content
        view.gizmo.position = session.moment.ee_pos_w + AWAY
        view.ask(view._goal_moved)  # what viser calls after a drag
        thread.join(30)
        stop.set()
    tracked = session.tracked
    assert tracked.outcome == STOOD and len(tracked.position_error) == 50
    distance = np.linalg.norm(tracked.target_pos_w - tracked.ee_pos_w, axis=1)
    assert np.allclose(tracked.position_error, distance)
    assert np.linalg.norm(tracked.target_pos_w[-1] - tracked.target_pos_w[0] - AWAY) < 1e-6


def test_a_scene_is_drawn_with_what_surrounds_the_robot() -> None:
    pytest.importorskip("viser")
    pytest.importorskip("torch")
    from wbc_bench.viewer.live import LiveView
    from wbc_bench.viewer.scene import serving

    with serving(port=free_port()) as server:
        session = session_of("hold", "live")
        view = LiveView(server, session)
        bare = set(server.scene._handle_from_node_name)
        view.restart(source="diffusion")
        furnished = set(server.scene._handle_from_node_name)
        added = {name for name in furnished - bare if "trail" not in name}
        assert {"/body/cabinet", "/body/cabinet/cabinet", "/body/door", "/body/door/door"} <= added
        view.restart(source="live")
        assert {name for name in server.scene._handle_from_node_name if "/body/" in name} == {
            name for name in bare if "/body/" in name
        }


FAILS = """
import numpy as np
from wbc_bench.controller import ControllerInfo, JointCommand

class Mine:
    def __init__(self, robot):
        self.info = ControllerInfo("stumbles", frozenset(), 0.02, "this test")
        self.q = robot.default_q

    def reset(self, episodes, obs, target):
        self.step = 0
        assert METHOD != "reset", "a mistake of its author"

    def act(self, obs, target):
        self.step += 1
        assert METHOD != "act" or self.step < 10, "a mistake of its author"
        return JointCommand(np.tile(self.q, (len(obs.active), 1)))
"""


@pytest.mark.parametrize(("method", "step"), [("act", 9), ("reset", 0)])
def test_a_controller_that_raises_pauses_the_page_which_says_why(
    served: Served, tmp_path: Path, method: str, step: int
) -> None:
    view, session, panel = served.view, served.session, served.view.panel
    file = tmp_path / f"fails_in_{method}.py"
    file.write_text(f"METHOD = {method!r}\n{FAILS}")

    def says_why() -> bool:
        words = panel._message.content.replace("\\", "")
        return panel._message.visible and f"failed in `{method}` at control step {step} of" in words

    view.ask(lambda: view.restart(f"{file}:Mine"))
    wait_for(lambda: view.paused and says_why(), 60, "it is paused, and says why")
    assert "a mistake of its author" in panel._message.content
    done = threading.Event()
    view.ask(view._goal_moved)  # a drag that goes on
    view.ask(done.set)
    assert done.wait(20)
    wait_for(lambda: view.paused and says_why(), 20, "it still says why")
    view.ask(panel._toggle)
    wait_for(lambda: view.paused and says_why(), 20, "it was tried again")
    view.ask(lambda: view.restart("hold"))
    view.ask(lambda: setattr(view, "paused", False))
    wait_for(lambda: session.moment.time > 0.3, 60, "it goes on with another controller")
    assert not panel._message.visible


def test_what_a_page_sends_is_checked_against_what_it_offers(served: Served, tmp_path: Path) -> None:
    """A crafted message is one line in the page: nothing is imported, and time goes on."""
    view, session, panel = served.view, served.session, served.view.panel
    trap = tmp_path / "trap.py"
    trap.write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n")
    with crafting(served) as send:

        def sets(control: Any, value: Any, words: str) -> None:
            view.ask(lambda: None)  # what was said before is gone
            wait_for(lambda: not panel._message.visible, 20, "it says nothing")
            send("GuiUpdateMessage", uuid=control._impl.uuid, updates={"value": value})
            wait_for(lambda: words in panel._message.content and panel._message.visible, 20, words)

        sets(panel._spec, f"{trap}:make", "unknown choice")
        assert not (tmp_path / "ran").exists() and panel._spec.value == session.spec == "ik"
        sets(panel._source, f"{tmp_path}/script.toml", "unknown choice")
        assert panel._source.value == "live"
        for speed in (0.0, np.nan, np.inf, 1e9):
            sets(panel._speed, speed, f"speed {speed:g}, valid: 0.1 to 2")
            wait_for(lambda: panel._speed.value == served.view.speed == 1.0, 20, "the slider is back")
        sets(panel._rpy, [np.inf, 0.0, 0.0], "six finite numbers")
        sets(panel._pos, [1e300, 0.0, 0.0], "no pose within 10 m")
        send("GuiUpdateMessage", uuid=panel._push_speed._impl.uuid, updates={"value": 50.0})
        sets(panel._pushes, "forward", "a push of 50 m/s, valid: 0.1 to 1")
        sets(panel._pushes, "up", "unknown choice 'up'")
        owner = served.server.scene._owner_id
        for position in ([np.nan, 0.0, 0.0], [0.0, 0.0]):
            sets(panel._pushes, "up", "unknown choice 'up'")
            pose = {"position": position, "wxyz": [np.inf, 0.0, 0.0, 0.0]}
            send("TransformControlsUpdateMessage", name="/goal", owner=owner, **pose)
            wait_for(lambda: "no pose within 10 m" in panel._message.content, 20, "it is refused")
            wait_for(lambda: len(view.gizmo.position) == 3, 20, "the gizmo is at the hand again")
            assert np.isfinite([*view.gizmo.position, *view.gizmo.wxyz]).all()
        # of a control only its value: viser would take its label, or whom it tells, from anybody
        for name in ("props", "sync_cb", "update_cb", "removed"):
            send("GuiUpdateMessage", uuid=panel._speed._impl.uuid, updates={name: 5})
        sets(panel._speed, 7.0, "speed 7, valid: 0.1 to 2")
    before = session.moment.time
    wait_for(lambda: session.moment.time > before + 0.1, 20, "time goes on")


def test_a_port_that_is_taken_is_refused() -> None:
    pytest.importorskip("viser")
    from wbc_bench.viewer.live import serve

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(BenchError, match=f"port {port} is in use"):
            serve("127.0.0.1", port, session_of("hold", "live"), print)


@pytest.mark.parametrize(("choice", "seconds"), [("retreat", 5.0), ("hold", np.inf)])
def test_what_a_silent_stream_does_is_an_option_of_the_page_too(monkeypatch, choice, seconds) -> None:
    from wbc_bench.cli.main import main
    from wbc_bench.sources.live import LiveSource

    made = []

    def load_source(name, protocol, config):
        made.append((name, config.retreat_after))
        return LiveSource()

    monkeypatch.setattr("wbc_bench.viewer.session.load_source", load_source)
    monkeypatch.setattr("wbc_bench.viewer.live.serve", lambda host, port, session, ready: session.close())
    main(["live", "--controller", "hold", "--source", "stream", "--on-silence", choice])
    assert made == [("stream", seconds)]
