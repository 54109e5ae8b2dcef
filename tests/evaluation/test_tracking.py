"""Following a moving target: scores, the loop, records, table and figure, and the command."""

import dataclasses
import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import zmq

from commands import fails
from wbc_bench.cli.main import main
from wbc_bench.controller import ControllerInfo, JointCommand, Observation, Target
from wbc_bench.episodes.single import _protocol, _row
from wbc_bench.errors import SourceError, StoreError
from wbc_bench.evaluation.rollout import rollout
from wbc_bench.evaluation.tracking import follow, natural_duration, track
from wbc_bench.registry import load_controller
from wbc_bench.results.figures.tracking import write_tracking
from wbc_bench.results.tracking import (
    STOOD,
    Tracked,
    lag,
    read_tracks,
    score,
    smoothness,
    tracking_table,
    write_track,
)
from wbc_bench.robot import load_robot
from wbc_bench.rotations import matrix_from_wxyz
from wbc_bench.sources import Seen, StampedTarget, load_source
from wbc_bench.sources.registry import find_policy, find_script, recorded_name

PERIOD = 0.02  # [s]
IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])


def curve(time: np.ndarray) -> np.ndarray:
    """(T, 3) [m]: nothing periodic, or two shifts would be as good."""
    return np.stack([0.2 * np.sin(time), 0.1 * np.sin(1.7 * time + 1), 0.05 * time], axis=1)


def tracked(delay: float = 0.0, outcome: str = STOOD, steps: int = 600) -> Tracked:
    """A hand that repeats its target after a delay [s]."""
    time = np.arange(steps) * PERIOD
    target, hand = curve(time), curve(time - delay)
    error = np.linalg.norm(hand - target, axis=1)
    return Tracked(PERIOD, outcome, target, hand, error, np.linspace(0.0, 0.1, steps))


FACTS = {
    **{
        "source": "figure_eight",
        "source_sha256": "0" * 64,
        "controller": "ik",
        "signals": ["proprioception"],
    },
    **{"condition": "nominal", "seed": 0, "requested_s": 12.0, "counters": {}, "software_sha256": "1" * 64},
    **{"git_commit": None, "git_dirty": False, "versions": {}, "machine": {}, "created": "2026-01-01"},
}


# scores


@pytest.mark.parametrize("delay", [0.0, 0.02, 0.4, 2.0])
def test_lag_is_found(delay: float) -> None:
    run = tracked(delay)
    assert lag(run.target_pos_w, run.ee_pos_w, PERIOD) == pytest.approx((delay, 0.0), abs=1e-9)


def test_lag_of_a_noisy_and_displaced_hand() -> None:
    """An offset of 3 cm stays as the residual; noise does not move the shift."""
    run = tracked(0.4)
    noise = np.random.default_rng(0).normal(0, 0.002, run.ee_pos_w.shape)
    delay, residual = lag(run.target_pos_w, run.ee_pos_w + noise + [0.0, 0.0, 0.03], PERIOD)
    assert delay == pytest.approx(0.4, abs=0.1) and residual == pytest.approx(0.03, rel=0.1)


def test_lag_of_what_does_not_follow() -> None:
    run = tracked()
    still = np.tile(run.target_pos_w[:1], (600, 1))
    assert np.isnan(lag(run.target_pos_w, still, PERIOD)).all()  # a statue
    assert np.isnan(lag(still, run.target_pos_w, PERIOD)).all()  # a target that rests
    late = tracked(4.0)
    assert np.isnan(lag(late.target_pos_w, late.ee_pos_w, PERIOD)).all()
    assert np.isnan(lag(run.target_pos_w[:200], run.ee_pos_w[:200], PERIOD)).all()  # too short to tell


def test_scores_by_hand() -> None:
    line = np.zeros((5, 3))
    run = Tracked(PERIOD, "fell", line, line, np.array([0.0, 0.1, 0.2, 0.3, 0.4]), np.full(5, 0.5))
    s = score(run)
    assert s.position_mean == pytest.approx(0.2) and s.position_p95 == pytest.approx(0.38)
    assert s.orientation_mean == s.orientation_p95 == 0.5
    assert np.isnan([s.lag, s.residual, s.sparc, s.target_sparc]).all()
    empty = Tracked(PERIOD, "invalid", line[:0], line[:0], np.zeros(0), np.zeros(0))
    assert np.isnan(score(empty)).all()


def test_a_trembling_hand_is_less_smooth() -> None:
    run = tracked()
    trembling = run.ee_pos_w + 0.005 * np.sin(2 * np.pi * 4 * run.time)[:, None]
    assert smoothness(trembling, PERIOD) < smoothness(run.ee_pos_w, PERIOD) - 1.0 < 0.0
    s = score(run)
    assert s.sparc == s.target_sparc == smoothness(run.target_pos_w, PERIOD)


# the loop


class Still:
    """A source that stays at a given pose in the world."""

    live, name, counters = False, "still", {}

    def __init__(self, pos_w: np.ndarray) -> None:
        self.pos_w, self.times = pos_w, []

    def reset(self, seen: Seen) -> None:
        self.seen = [seen]

    def target(self, time: float, seen: Seen) -> StampedTarget:
        self.times.append(time)
        self.seen.append(seen)
        return StampedTarget(time, "world", self.pos_w, IDENTITY)

    def close(self) -> None: ...


class Swing:
    """Turns the arm by what it sees of the target."""

    def __init__(self) -> None:
        self.info = ControllerInfo("swing", frozenset({"proprioception"}), PERIOD, "tests")
        self.robot = load_robot()

    def reset(self, episodes: np.ndarray, obs: Observation, target: Target) -> None: ...

    def act(self, obs: Observation, target: Target) -> JointCommand:
        assert obs.proprioception
        q = np.tile(self.robot.default_q, (len(obs.active), 1))
        q[:, 8] += np.arctan2(target.pos_b[:, 1], target.pos_b[:, 0]) + obs.proprioception.gravity_b[:, 0]
        return JointCommand(q)


@pytest.mark.parametrize("condition", ["nominal", "randomised"])
def test_a_target_that_rests_is_an_evaluation(condition: str) -> None:
    """The same episode by `evaluate`, bit for bit: the hand after a step is what the next step sees."""
    pos_w = np.array([0.5, 0.3, 1.0])
    protocol = _protocol(0.6, seed=3)
    row = dataclasses.replace(_row(protocol, condition), target_pos_w=pos_w[None])
    run = follow(Swing(), Still(pos_w), protocol, row)
    batch = rollout(Swing(), protocol, row)
    steps = int(batch.steps[0])
    assert len(run.time) == steps > 10
    np.testing.assert_array_equal(run.ee_pos_w[1:], batch.ee_pos_w[0, : steps - 1])
    np.testing.assert_allclose(run.position_error[1:], batch.position_error[0, : steps - 1], atol=1e-15)
    # the quaternion of the target is read once more: 1e-8 of an angle is what an arcsine leaves of 1e-16
    np.testing.assert_allclose(run.orientation_error[1:], batch.orientation_error[0, : steps - 1], atol=1e-7)


def test_a_source_sees_where_the_robot_is() -> None:
    source = Still(np.array([0.5, 0.0, 1.1]))
    run = follow(Swing(), source, _protocol(0.3, 0), _row(_protocol(0.3, 0), "nominal"))
    assert source.times == pytest.approx(np.arange(15) * PERIOD)
    np.testing.assert_array_equal([seen.ee_pos_w for seen in source.seen[1:]], run.ee_pos_w)
    np.testing.assert_allclose(source.seen[0].base_pos_w[:2], 0.0)
    assert source.seen[0].arm_mount_b[2] == pytest.approx(0.0225)  # of the facts file


def test_conditions_differ_and_seeds_count() -> None:
    source = load_source("figure_eight")

    def hand(condition: str, seed: int) -> np.ndarray:
        return track(load_controller("hold", load_robot()), source, condition, seed, 0.5)[0].ee_pos_w

    same = min(len(hand("randomised", 1)), len(hand("randomised", 2)))
    assert np.abs(hand("randomised", 1)[:same] - hand("randomised", 2)[:same]).max() > 1e-3
    np.testing.assert_array_equal(hand("randomised", 1), hand("randomised", 1))
    np.testing.assert_array_equal(hand("nominal", 1), hand("nominal", 2))


def test_a_run_lasts_until_its_script_has_ended() -> None:
    source = load_source("shelf_reach")
    assert 10.0 < natural_duration(source) < 30.0
    _, asked = track(load_controller("hold", load_robot()), source, "nominal", 0)
    assert asked == natural_duration(source) == pytest.approx(np.ceil(source.path.duration + 2.0))  # pyright: ignore[reportAttributeAccessIssue]


class Refusing(Still):
    """Counts a message at every step, of which it accepts those that the test says."""

    def __init__(self, accepted: Sequence[bool]) -> None:
        super().__init__(np.array([0.4, 0.0, 1.1]))
        self.accepted = list(accepted)
        self.counters = {"accepted": 100, "early": 100}  # of an earlier run

    def target(self, time: float, seen: Seen) -> StampedTarget:
        if self.accepted:
            self.counters["accepted" if self.accepted.pop() else "early"] += 1
        return super().target(time, seen)


@pytest.mark.parametrize("accepted", [[True, False] * 3, [True]])
def test_a_run_that_used_half_of_its_messages_is_scored(accepted: list[bool]) -> None:
    track(Swing(), Refusing(accepted), "nominal", 0, 0.2)


@pytest.mark.parametrize(
    ("accepted", "said"),
    [
        ([True, False, False], "3 messages: 1 accepted, 2 early"),
        ([], "0 messages: none"),
        ([False], "1 early"),
    ],
)
def test_a_run_that_used_fewer_is_refused(accepted: list[bool], said: str) -> None:
    with pytest.raises(SourceError, match=f"{said}.*valid: at least one message and 50% of all"):
        track(Swing(), Refusing(accepted), "nominal", 0, 0.2)


def followed(name: str) -> tuple[Tracked, dict[str, int]]:
    """4 s of `ik` on a source, and what became of the messages."""
    source = load_source(name, "tcp://127.0.0.1:*")
    try:
        run, _ = track(load_controller("ik", load_robot()), source, "nominal", 0, 4.0)
    finally:
        source.close()
    return run, dict(source.counters)


def test_ik_follows_a_script_and_the_same_script_through_the_stream(monkeypatch) -> None:
    """Seconds of a slow curve: to 5 cm through a file, and through a socket along the same curve."""
    run, _ = followed("figure_eight")
    assert run.outcome == STOOD and run.position_error.max() < 0.05
    led = np.linalg.norm(np.diff(run.target_pos_w, axis=0), axis=1).sum()
    assert led > 0.1  # [m]

    # how many messages come late depends on what else the machine does
    monkeypatch.setattr("wbc_bench.evaluation.tracking.MIN_USED", 0.0)
    streamed, counters = followed("stream:figure_eight")
    assert streamed.outcome == STOOD and counters["accepted"] > 0
    assert not any(n for name, n in counters.items() if name not in ("accepted", "late"))
    away = np.linalg.norm(streamed.target_pos_w[:, None] - run.target_pos_w, axis=2).min(axis=1)
    assert away.max() < 0.005  # [m]


# records, table, figure


def test_records_come_back_and_are_checked(tmp_path: Path) -> None:
    run = tracked(0.4)
    folder = write_track(tmp_path, run, **FACTS)
    (track_read,) = read_tracks(tmp_path)
    for name in ("target_pos_w", "ee_pos_w", "position_error", "orientation_error"):
        np.testing.assert_array_equal(getattr(track_read.tracked, name), getattr(run, name))
    assert track_read.record.completed_s == 12.0 and track_read.record.outcome == STOOD
    before = (folder / "series.parquet").read_bytes()
    assert (write_track(tmp_path, run, **FACTS) / "series.parquet").read_bytes() == before
    (folder / "series.parquet").write_bytes(before[:-1] + b"x")
    with pytest.raises(StoreError, match="another sha256"):
        read_tracks(tmp_path)


def test_the_table_means_over_seeds(tmp_path: Path) -> None:
    for seed, delay in ((0, 0.2), (1, 0.4)):
        write_track(tmp_path, tracked(delay), **FACTS | {"seed": seed})
    write_track(tmp_path, tracked(0.0, "fell", steps=50), **FACTS | {"controller": "hold"})
    table = tracking_table(read_tracks(tmp_path))
    fallen, ik = (dict(zip(table.header, row, strict=True)) for row in table.rows)
    assert fallen["Source"] == "figure_eight" and ik["Source"] == ""
    assert fallen["Stood"] == "0/1" and fallen["Time (s)"] == "1.0/12.0" and fallen["SPARC ↑"] == "–"
    assert ik["Stood"] == "2/2" and ik["Lag ↓ (s)"] == "0.30" and ik["Pos. after lag ↓ (cm)"] == "0.00"
    mean = np.mean([tracked(delay).position_error.mean() for delay in (0.2, 0.4)])
    assert ik["Pos. mean ↓ (cm)"] == f"{mean * 100:.2f}"
    assert "figure\\_eight" in table.latex() and table.csv().startswith("source,controller,condition,runs,")


def test_equal_runs_of_several_seeds_count_once(tmp_path: Path) -> None:
    for seed in range(3):
        write_track(tmp_path, tracked(0.2), **FACTS | {"seed": seed})
    table = tracking_table(read_tracks(tmp_path))
    assert dict(zip(table.header, table.rows[0], strict=True))["Stood"] == "1/1"


def test_scripts_of_one_name_are_recorded_apart(tmp_path: Path) -> None:
    shipped = find_script("figure_eight")
    assert recorded_name("figure_eight", shipped.digest) == "figure_eight"
    assert recorded_name("stream:figure_eight", shipped.digest) == "stream:figure_eight"
    assert recorded_name("figure_eight", "0123456789") == "figure_eight@01234567"
    assert recorded_name("mine", "0123456789") == "mine@01234567"
    assert recorded_name("stream", None) == "stream"
    assert recorded_name("diffusion", find_policy()[2]) == "diffusion"
    assert recorded_name("diffusion", "0123456789") == "diffusion@01234567"


def test_the_figure_is_the_same_for_the_same_runs(tmp_path: Path) -> None:
    write_track(tmp_path, tracked(0.3), **FACTS)
    write_track(tmp_path, tracked(0.0, "fell", steps=50), **FACTS | {"controller": "hold"})
    write_track(tmp_path, tracked(0.5), **FACTS | {"source": "wipe_board", "condition": "randomised"})
    one, two = (write_tracking(read_tracks(tmp_path), tmp_path / name) for name in ("a", "b"))
    assert [path.name for path in one] == ["tracking.png", "tracking.svg"]
    assert [path.read_bytes() for path in one] == [path.read_bytes() for path in two]


# the command


def run_track(out: Path, *more: object) -> None:
    words = (
        "track",
        "--controller",
        "hold",
        "--source",
        "figure_eight",
        "--duration",
        0.4,
        "--out",
        out,
        *more,
    )
    main([str(word) for word in words])


def test_track_writes_record_table_and_figure(capsys, tmp_path: Path) -> None:
    run_track(tmp_path, "--condition", "randomised", "--seed", 5)
    assert "figure_eight" in capsys.readouterr().out
    record = json.loads((tmp_path / "tracks/figure_eight/hold/randomised_5/track.json").read_text())
    assert (
        record["requested_s"] == 0.4 and record["controller"] == "hold" and len(record["source_sha256"]) == 64
    )
    for name in ("tables/tracking.md", "tables/tracking.tex", "tables/tracking.csv", "figures/tracking.svg"):
        assert (tmp_path / name).exists(), name
    before = (tmp_path / "tables/tracking.csv").read_bytes(), (tmp_path / "figures/tracking.png").read_bytes()
    main(["report", "--results", str(tmp_path)])
    after = (tmp_path / "tables/tracking.csv").read_bytes(), (tmp_path / "figures/tracking.png").read_bytes()
    assert before == after and "Tracking of moving targets" in (tmp_path / "report.html").read_text()


def test_track_says_what_became_of_the_messages(capsys, tmp_path: Path) -> None:
    run_track(tmp_path, "--source", "stream:figure_eight", "--address", "tcp://127.0.0.1:*")
    (line,) = [line for line in capsys.readouterr().out.splitlines() if " messages: " in line]
    assert re.fullmatch(r"hold, stream:figure_eight: \d+ messages: \d+ accepted.*", line), line


@pytest.mark.parametrize("sent", ["nothing", "nonsense"])
def test_a_stream_that_was_not_followed_is_no_record(capsys, tmp_path: Path, sent: str) -> None:
    with zmq.Context() as context, context.socket(zmq.PUSH) as client:
        address = f"ipc://{tmp_path / 's'}"
        client.setsockopt(zmq.LINGER, 0)
        client.connect(address)
        if sent == "nonsense":
            for _ in range(20):
                client.send(b"up, please")
        words = ("--controller", "hold", "--source", "stream", "--address", address, "--out", tmp_path)
        line = fails(capsys, "track", *words, "--duration", 0.4)
    assert "--source stream: " in line and "is not scored" in line
    assert not list(tmp_path.rglob("track.json"))


@pytest.mark.parametrize(("choice", "seconds"), [("retreat", 5.0), ("hold", np.inf)])
def test_what_a_silent_stream_does_is_an_option(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, choice: str, seconds: float
) -> None:
    made = []

    def spied(*args, **kwargs):
        source = load_source(*args, **kwargs)
        made.append(source)
        return source

    monkeypatch.setattr("wbc_bench.sources.registry.load_source", spied)
    words = ("--source", "stream:figure_eight", "--address", "tcp://127.0.0.1:*", "--on-silence", choice)
    run_track(tmp_path, *words)
    assert [source._stream.filter._s.retreat_after for source in made] == [seconds]


def test_mistakes_are_one_line(capsys, tmp_path: Path) -> None:
    out = tmp_path / "out"
    base = ("track", "--controller", "hold", "--out", out)
    assert "did you mean figure_eight?" in fails(capsys, *base, "--source", "figure_ate")
    assert "did you mean wipe_board?" in fails(capsys, *base, "--source", "stream:wipe_bord")
    bad = tmp_path / "bad.toml"
    bad.write_text('name = "bad"\ndescription = ""\nlimits = { linear = -1, angular = 1 }\n')
    assert "$.limits.linear" in fails(capsys, *base, "--source", bad)
    bad.write_text(
        'name = "slow"\ndescription = ""\nlimits = { linear = 1e-300, angular = 1.0 }\n'
        'path = { type = "waypoints", points = [{ pos = [0.4, 0.0, 1.0] }] }\n'
    )
    assert "s, valid: at most 598 s" in fails(capsys, *base, "--source", bad)
    figure = (*base, "--source", "figure_eight")
    assert "did you mean nominal or randomised?" in fails(capsys, *figure, "--condition", "nominl")
    assert "duration -1 s" in fails(capsys, *figure, "--duration", -1)
    assert "duration nan s" in fails(capsys, *figure, "--duration", "nan")
    assert "--seed -1" in fails(capsys, *figure, "--seed", -1)
    assert "unknown controller 'hodl'" in fails(
        capsys, "track", "--controller", "hodl", "--source", "figure_eight"
    )
    stream = (*base, "--source", "stream", "--address")
    assert "can be reached from other machines" in fails(capsys, *stream, "tcp://*:5601")
    assert "has no port" in fails(capsys, *stream, "tcp://127.0.0.1")
    assert not list(out.rglob("track.json"))


def test_a_busy_port_is_one_line(capsys, tmp_path: Path) -> None:
    with zmq.Context() as context, context.socket(zmq.PULL) as taken:
        taken.bind("tcp://127.0.0.1:*")
        address = taken.getsockopt_string(zmq.LAST_ENDPOINT)
        words = ("--controller", "hold", "--source", "stream", "--address", address, "--out", tmp_path)
        assert f"'{address}' cannot be opened: Address already in use" in fails(capsys, "track", *words)


def test_list_shows_the_library(capsys, tmp_path: Path) -> None:
    main(["list", "--results", str(tmp_path)])
    shown = capsys.readouterr().out
    assert "| wipe_board | board |" in shown and "| figure_eight | curve |" in shown and "| stream |" in shown


def test_a_base_that_turns_does_not_turn_a_target_in_the_world() -> None:
    """What the controller is shown is the world's target as the base sees it, at every step."""
    shown: list[tuple[Target, np.ndarray, np.ndarray]] = []

    class Watcher(Swing):
        def __init__(self) -> None:
            super().__init__()
            self.info = self.info._replace(signals=frozenset({"base_pose", "proprioception"}))

        def act(self, obs: Observation, target: Target) -> JointCommand:
            assert obs.base_pose
            shown.append((target, obs.base_pose.pos_w[0], obs.base_pose.rot_w[0]))
            return super().act(obs, target)

    pos_w = np.array([0.5, 0.3, 1.0])
    protocol = _protocol(0.4, 1)
    follow(Watcher(), Still(pos_w), protocol, _row(protocol, "randomised"))
    assert len(shown) > 10
    for target, base_w, rot_w in shown:
        np.testing.assert_allclose(rot_w @ target.pos_b[0] + base_w, pos_w, atol=1e-12)
        np.testing.assert_allclose(rot_w @ target.rot_b[0], matrix_from_wxyz(IDENTITY), atol=1e-12)


def test_messages_of_an_unknown_clock_do_not_count_against_a_run() -> None:
    from wbc_bench.evaluation.tracking import _check_used

    _check_used({"accepted": 300, "late": 10, "clock_unknown": 5000})
    for counts in ({"accepted": 0, "clock_unknown": 5000}, {"accepted": 300, "late": 301}):
        with pytest.raises(SourceError, match="is not scored"):
            _check_used(counts)
