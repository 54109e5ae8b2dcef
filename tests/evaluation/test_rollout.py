"""The loop: outcomes, failing controllers, independence of the batch, and the numbers that are recorded."""

import dataclasses
from collections.abc import Callable

import msgspec
import numpy as np
import pytest
from conftest import CalmRows
from threadpoolctl import threadpool_info, threadpool_limits

from wbc_bench.controller import ControllerInfo, JointCommand, Observation, Signal, Target
from wbc_bench.episodes.manifest import EpisodeManifest, manifest_path, read_manifest
from wbc_bench.episodes.protocol import EvalProtocol, Termination, find_protocol
from wbc_bench.errors import ControllerError
from wbc_bench.evaluation.rollout import RUNNING, _classify, rollout
from wbc_bench.outcomes import EpisodeBatch, Outcome
from wbc_bench.registry import load_controller
from wbc_bench.robot import Robot, load_robot
from wbc_bench.rotations import matrix_from_wxyz

Rows = slice | np.ndarray
SERIES = ("position_error", "orientation_error", "action", "ee_pos_w")


class Recorder:
    """Runs a function of (robot, step, observation, target) as a controller and keeps what it was shown."""

    def __init__(
        self, act: Callable | None = None, signals: tuple[Signal, ...] = (), period: float = 0.02
    ) -> None:
        self.info = ControllerInfo("recorder", frozenset(signals), period, "tests")
        self.robot, self._act = load_robot(), act

    def reset(self, episodes: np.ndarray, obs: Observation, target: Target) -> None:
        self.episodes, self.first, self.seen = episodes, (obs, target), []

    def act(self, obs: Observation, target: Target) -> JointCommand:
        self.seen.append((obs, target))
        q = np.tile(self.robot.default_q, (len(obs.active), 1))
        return JointCommand(
            q if self._act is None else self._act(self.robot, len(self.seen) - 1, obs, target, q)
        )


def proportional(robot: Robot, step: int, obs: Observation, target: Target, q: np.ndarray) -> np.ndarray:
    """Turns arm and ankles in proportion to noisy errors: something that feeds everything it sees back."""
    assert obs.ee_pose and obs.proprioception
    error = target.pos_b - obs.ee_pose.pos_b  # (N, 3) [m]
    q[:, 8] += np.arctan2(target.pos_b[:, 1], target.pos_b[:, 0])
    q[:, 9:11] += error[:, ::2]
    q[:, [3, 7]] += (
        2.0 * obs.proprioception.gravity_b[:, :1] + 0.1 * obs.proprioception.base_ang_vel_b[:, 1:2]
    )
    return q


def follower() -> Recorder:
    return Recorder(proportional, ("proprioception", "ee_pose"))


@pytest.fixture(scope="module")
def disturbed(smoke: EvalProtocol) -> EpisodeManifest:
    return read_manifest(smoke, manifest_path(find_protocol("smoke_v1")[1]))[0].take(slice(0, 6))


@pytest.fixture(scope="module")
def short(smoke: EvalProtocol) -> EvalProtocol:
    """Half a second: the robot still stands."""
    episodes = msgspec.structs.replace(smoke.episodes, horizon=0.5)
    success = msgspec.structs.replace(smoke.success, window=0.1)
    return msgspec.structs.replace(smoke, episodes=episodes, success=success)


def same(a: EpisodeBatch, b: EpisodeBatch, rows_a: Rows = slice(None), rows_b: Rows = slice(None)) -> None:
    for name in (*SERIES, "steps", "outcome", "infeasible_steps"):
        np.testing.assert_array_equal(getattr(a, name)[rows_a], getattr(b, name)[rows_b], err_msg=name)


# outcomes


STOOD = [  # last steps inside the tolerance (window of 3), steps without a solution -> outcome
    ("......", "......", Outcome.MISSED),
    ("...+++", "......", Outcome.SUCCESS),
    ("++++++", "......", Outcome.SUCCESS),
    ("+.....", "......", Outcome.DRIFTED),
    ("++++.+", "......", Outcome.DRIFTED),
    (".....+", "......", Outcome.DRIFTED),  # arrived too late to hold it
    ("......", "...x..", Outcome.QP_INFEASIBLE),
    ("......", "..x...", Outcome.MISSED),  # a gap before the window is not why it missed
    ("++....", ".....x", Outcome.QP_INFEASIBLE),
    ("...+++", "...xxx", Outcome.SUCCESS),  # it held the last command, and that was right
]


def test_outcomes_of_those_who_stood() -> None:
    inside = np.array([[c == "+" for c in text] for text, _, _ in STOOD])
    infeasible = np.array([[c == "x" for c in text] for _, text, _ in STOOD])
    ended = np.full(len(STOOD), RUNNING, dtype=object)
    outcome = _classify(ended, inside, infeasible, window=3)
    assert list(outcome) == [expected for _, _, expected in STOOD]
    assert (ended == RUNNING).all()  # the input is left alone


@pytest.mark.parametrize("how", [Outcome.FELL, Outcome.ILLEGAL_CONTACT, Outcome.INVALID])
def test_an_early_end_is_final(how: Outcome) -> None:
    """Whatever the series say: an episode that held the target and fell afterwards has fallen."""
    ended = np.array([how, how, RUNNING], dtype=object)
    inside = np.array([[True] * 4, [False] * 4, [True] * 4])
    infeasible = np.array([[False] * 4, [True] * 4, [False] * 4])
    assert list(_classify(ended, inside, infeasible, window=2)) == [how, how, Outcome.SUCCESS]


def test_every_episode_has_one_outcome(smoke: EvalProtocol, disturbed: EpisodeManifest) -> None:
    batch = rollout(Recorder(), smoke, disturbed)
    assert all(isinstance(outcome, Outcome) for outcome in batch.outcome)


def test_targets_held_missed_and_left(short: EvalProtocol, calm_rows: CalmRows) -> None:
    """A statue that turns its arm once: targets where its hand ends, beside that, and where it began."""
    still = {"kp_scale": np.full((3, 14), 40.0), "kd_scale": np.full((3, 14), 20.0)}

    def turn(robot: Robot, step: int, obs: Observation, target: Target, q: np.ndarray) -> np.ndarray:
        q[:, 8] += 0.3 if step > 5 else 0.0
        return q

    begin, end = rollout(Recorder(turn), short, calm_rows(3, **still)).ee_pos_w[0, [3, -1]]
    targets = np.array([end, begin, begin])
    targets[1, 1] += 0.2
    assert np.linalg.norm(end - begin) > 0.08

    def outcomes(orientation: float) -> list[Outcome]:
        success = msgspec.structs.replace(short.success, orientation=orientation)
        protocol = msgspec.structs.replace(short, success=success)
        return list(rollout(Recorder(turn), protocol, calm_rows(3, target_pos_w=targets, **still)).outcome)

    assert outcomes(orientation=0.5) == [Outcome.SUCCESS, Outcome.MISSED, Outcome.DRIFTED]
    assert outcomes(orientation=1e-3) == [Outcome.MISSED] * 3  # both errors count


# ends


def test_falling_over(smoke: EvalProtocol, calm_rows: CalmRows) -> None:
    spin = np.zeros((2, 6))
    spin[1, 4] = 6.0  # [rad/s] nose down
    protocol = msgspec.structs.replace(smoke, termination=Termination(illegal_contact=False))
    controller = Recorder(signals=("base_pose",))
    batch = rollout(controller, protocol, calm_rows(2, base_vel=spin))
    assert batch.outcome[1] == Outcome.FELL
    last = batch.steps[1]
    assert 5 < last < batch.steps[0] <= protocol.num_steps
    obs = controller.seen[last][0]  # the first observation after the end
    assert not obs.active[1] and obs.active[0]
    tilt = np.arccos(obs.base_pose.rot_w[1, 2, 2])
    low = obs.base_pose.pos_w[1, 2] < protocol.termination.base_height
    assert tilt > protocol.termination.tilt or low
    before = controller.seen[last - 1][0].base_pose
    assert np.arccos(before.rot_w[1, 2, 2]) <= protocol.termination.tilt
    assert before.pos_w[1, 2] >= protocol.termination.base_height


def test_illegal_contact(smoke: EvalProtocol, calm_rows: CalmRows) -> None:
    """A robot lying on its side, had tilt and height been allowed."""
    lying = msgspec.structs.replace(smoke, termination=Termination(tilt=3.2, base_height=0.0))
    spin = np.array([[0, 0, 0, 5.0, 0, 0]])
    batch = rollout(Recorder(), lying, calm_rows(1, base_vel=spin))
    assert batch.outcome[0] == Outcome.ILLEGAL_CONTACT
    assert batch.steps[0] < smoke.num_steps


def test_after_the_end_there_is_nothing(smoke: EvalProtocol, disturbed: EpisodeManifest) -> None:
    batch = rollout(follower(), smoke, disturbed)
    assert (batch.steps < smoke.num_steps).any() and (batch.steps > 0).all()
    for name in SERIES:
        series = getattr(batch, name)
        for i, steps in enumerate(batch.steps):
            assert np.isfinite(series[i, :steps]).all(), name
            assert np.isnan(series[i, steps:]).all(), name
    assert batch.position_error.shape == (6, smoke.num_steps)
    assert batch.window == smoke.window_steps == 25 and batch.control_period == pytest.approx(0.02)


def test_commands_after_the_end_are_ignored(smoke: EvalProtocol, disturbed: EpisodeManifest) -> None:
    def careless(robot: Robot, step: int, obs: Observation, target: Target, q: np.ndarray) -> np.ndarray:
        return np.where(obs.active[:, None], proportional(robot, step, obs, target, q), np.nan)

    batch = rollout(Recorder(careless, ("proprioception", "ee_pose")), smoke, disturbed)
    assert Outcome.FELL in batch.outcome
    same(batch, rollout(follower(), smoke, disturbed))


# controllers that fail


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300])
def test_nan_invalidates_one_episode_only(
    short: EvalProtocol, disturbed: EpisodeManifest, bad: float, tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo logs the absurd command

    def failing(robot: Robot, step: int, obs: Observation, target: Target, q: np.ndarray) -> np.ndarray:
        q = proportional(robot, step, obs, target, q)
        if step >= 7:
            q[2, 5] = bad
        return q

    batch = rollout(Recorder(failing, ("proprioception", "ee_pose")), short, disturbed)
    others = np.array([0, 1, 3, 4, 5])
    assert batch.outcome[2] == Outcome.INVALID and Outcome.INVALID not in batch.outcome[others]
    assert batch.steps[2] == (8 if bad == 1e300 else 7)  # finite: MuJoCo refuses it, after the fact
    same(batch, rollout(follower(), short, disturbed), others, others)


def test_nan_from_the_start(short: EvalProtocol, disturbed: EpisodeManifest) -> None:
    batch = rollout(Recorder(lambda robot, step, obs, target, q: q * np.nan), short, disturbed)
    assert (batch.outcome == Outcome.INVALID).all() and (batch.steps == 0).all()
    assert all(np.isnan(getattr(batch, name)).all() for name in SERIES)
    assert (batch.infeasible_steps == 0).all()


def test_a_diverged_simulation_is_invalid(
    short: EvalProtocol, calm_rows: CalmRows, tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log
    speed = np.zeros((3, 6))
    speed[0, 0], speed[2, 2] = 1e12, 3e3
    batch = rollout(Recorder(), short, calm_rows(3, base_vel=speed))
    assert list(batch.outcome) == [Outcome.INVALID, Outcome.MISSED, Outcome.INVALID]
    assert list(batch.steps) == [1, short.num_steps, 1]


@pytest.mark.parametrize("shape", [(6, 13), (14,), (5, 14), (6, 14, 1)])
def test_a_wrong_shape_names_the_right_one(
    short: EvalProtocol, disturbed: EpisodeManifest, shape: tuple[int, ...]
) -> None:
    controller = Recorder(lambda robot, step, obs, target, q: np.zeros(shape))
    with pytest.raises(ControllerError, match=r"'recorder' returned .*expected \(6, 14\)") as caught:
        rollout(controller, short, disturbed)
    assert str(shape) in str(caught.value)


@pytest.mark.parametrize("period", [0.03, np.inf, np.nan, 0.0, -0.02])
def test_a_wrong_control_period(short: EvalProtocol, disturbed: EpisodeManifest, period: float) -> None:
    with pytest.raises(
        ControllerError,
        match=rf"'recorder' runs every {period:g} s, protocol smoke_v1 asks for 0.02 s, valid",
    ):
        rollout(Recorder(period=period), short, disturbed)


@pytest.mark.parametrize("period", [0.004, 0.01, 0.02, 0.06])
def test_other_control_periods(short: EvalProtocol, disturbed: EpisodeManifest, period: float) -> None:
    """The controller is asked at its own rate and sees the time; the record has the protocol's steps."""
    recorder = Recorder(signals=("proprioception",), period=period)
    batch = rollout(recorder, short, disturbed)
    plain = rollout(Recorder(signals=("proprioception",)), short, disturbed)
    times = [obs.time for obs, _ in recorder.seen]
    np.testing.assert_allclose(times, period * np.arange(len(times)), atol=1e-12)
    assert len(times) == int(np.ceil(0.5 / period - 1e-9))
    np.testing.assert_array_equal(batch.steps, plain.steps)
    # the same constant command: the same episode, whatever the rate; work is sampled at other physics steps
    np.testing.assert_array_equal(batch.ee_pos_w, plain.ee_pos_w)
    np.testing.assert_array_equal(batch.push_step, plain.push_step)
    np.testing.assert_allclose(np.nansum(batch.work), np.nansum(plain.work), rtol=0.3)
    assert not np.array_equal(recorder.seen[0][0].proprioception.joint_pos, 0)


# independence


@pytest.mark.parametrize(
    "make", [follower, lambda: load_controller("hold", load_robot())], ids=["user", "hold"]
)
def test_an_episode_does_not_depend_on_its_batch(
    smoke: EvalProtocol, disturbed: EpisodeManifest, make: Callable
) -> None:
    whole = rollout(make(), smoke, disturbed)
    for chosen in ([3], [4, 1], [5, 4, 3, 2, 1, 0]):
        same(whole, rollout(make(), smoke, disturbed.take(np.array(chosen))), np.array(chosen))
    same(whole, rollout(make(), smoke, disturbed))


# what is recorded, and what is shown


def test_errors_are_those_of_the_true_hand(short: EvalProtocol, disturbed: EpisodeManifest) -> None:
    """Recomputed from what a controller without noise was shown at the next step."""
    rows = dataclasses.replace(disturbed, noise_scale=np.zeros(6))
    controller = Recorder(proportional, ("proprioception", "ee_pose", "base_pose"))
    batch = rollout(controller, short, rows)
    assert batch.steps.sum() > 100
    for step, (obs, _) in enumerate(controller.seen[1:]):
        for i in np.flatnonzero(obs.active):
            rot_w, origin_w = obs.base_pose.rot_w[i], obs.base_pose.pos_w[i]
            hand_w = rot_w @ obs.ee_pose.pos_b[i] + origin_w
            np.testing.assert_allclose(batch.ee_pos_w[i, step], hand_w, atol=1e-12)
            distance = np.sqrt(((hand_w - rows.target_pos_w[i]) ** 2).sum())
            assert batch.position_error[i, step] == pytest.approx(distance, abs=1e-12)
            x, y = obs.ee_pose.rot6_b[i, :3], obs.ee_pose.rot6_b[i, 3:]
            hand_rot_w = rot_w @ np.column_stack([x, y, np.cross(x, y)])
            cosine = (np.trace(hand_rot_w.T @ matrix_from_wxyz(rows.target_quat_w[i])) - 1) / 2
            assert np.cos(batch.orientation_error[i, step]) == pytest.approx(cosine, abs=1e-9)


def test_actions_are_the_normalised_commands(short: EvalProtocol, calm_rows: CalmRows) -> None:
    robot = load_robot()
    actions = np.random.default_rng(0).uniform(-0.1, 0.1, (short.num_steps, 2, 14))
    controller = Recorder(lambda robot, step, obs, target, q: robot.command_of(actions[step]))
    batch = rollout(controller, short, calm_rows(2))
    np.testing.assert_allclose(batch.action, actions.swapaxes(0, 1), atol=1e-14)
    assert np.abs(robot.command_of(actions) - robot.default_q).max() > 0.05  # scaled, not copied


def test_infeasible_steps_are_counted_while_the_episode_runs(
    smoke: EvalProtocol, calm_rows: CalmRows
) -> None:
    class Stuck(Recorder):
        def act(self, obs: Observation, target: Target) -> JointCommand:
            command = super().act(obs, target)
            return command._replace(infeasible=np.array([False, True, True]))

    spin = np.zeros((3, 6))
    spin[2, 4] = 6.0
    batch = rollout(Stuck(), smoke, calm_rows(3, base_vel=spin))
    assert batch.outcome[2] in (Outcome.FELL, Outcome.ILLEGAL_CONTACT)
    assert list(batch.infeasible_steps) == [0, batch.steps[1], batch.steps[2]]


def test_pushes_come_at_their_step(short: EvalProtocol, calm_rows: CalmRows) -> None:
    """Each in the interval that starts at its time, and only to those whose manifest says so."""
    time, velocity = np.full((3, 2), np.nan), np.zeros((3, 4))
    time[0], velocity[0] = [0.1, 0.3], [0.4, -0.2, 0.1, 0.3]
    time[1, 0], velocity[1, :2] = 0.214, [-0.3, 0.0]  # rounds to the nearest step
    calm, pushed = Recorder(signals=("base_pose",)), Recorder(signals=("base_pose",))
    rollout(calm, short, calm_rows(3))
    rollout(pushed, short, calm_rows(3, push_time=time, push_vel=velocity))
    change = np.array(
        [
            b[0].base_pose.lin_vel_w - a[0].base_pose.lin_vel_w
            for a, b in zip(calm.seen, pushed.seen, strict=True)
        ]
    )  # (T, N, 3)
    first = [5, 11, None]
    for i, step in enumerate(first):
        assert (change[: None if step is None else step + 1, i] == 0).all()
        if step is not None:
            # after a control period the legs have taken up a part of it
            gained, pushed_by = change[step + 1, i, :2], velocity[i, :2]
            assert gained @ pushed_by > 0.3 * pushed_by @ pushed_by
    second = change[16, 0, :2] - change[15, 0, :2]
    assert second @ velocity[0, 2:] > 0.3 * velocity[0, 2:] @ velocity[0, 2:]


def test_a_controller_is_shown_what_it_declared(short: EvalProtocol, disturbed: EpisodeManifest) -> None:
    blind = Recorder()
    batch = rollout(blind, short, disturbed)
    np.testing.assert_array_equal(blind.episodes, disturbed.episode)
    assert len(blind.seen) == short.num_steps == batch.steps.max()
    for step, (obs, target) in enumerate(blind.seen):
        assert obs[2:] == (None,) * 4
        assert obs.time == pytest.approx(0.02 * step)
        assert target.pos_b.shape == (6, 3) and target.rot_b.shape == (6, 3, 3)
    assert blind.first[0] is blind.seen[0][0]  # reset sees what the first act sees


def test_matrix_products_run_on_one_thread(short: EvalProtocol, calm_rows: CalmRows) -> None:
    """Whatever the caller's process is set to, which is as it was afterwards."""

    def threads() -> set[int]:
        return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}

    found = []

    def watching(robot: Robot, step: int, obs: Observation, target: Target, q: np.ndarray) -> np.ndarray:
        found.append(threads())
        return q

    with threadpool_limits(limits=2, user_api="blas"):
        before = threads()
        rollout(Recorder(watching), short, calm_rows(2))
        assert threads() == before
    assert found and all(each == {1} for each in found)
