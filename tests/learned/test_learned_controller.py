"""The learned controller: what it reads, what it remembers, and one training seed a replicate."""

import json
import warnings
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from conftest import CalmRows

from policies import TorchEngine, networks, numpy_policy, write
from tiny_protocol import write_tiny
from wbc_baselines.learned.policy import checkpoint, inputs, weights
from wbc_baselines.learned.policy.card import new_card, other_conditions
from wbc_baselines.learned.policy.controller import LearnedController
from wbc_baselines.learned.policy.methods import METHODS
from wbc_bench.cli.main import main
from wbc_bench.controller import DEPLOYABLE, Observation, Target
from wbc_bench.episodes.manifest import manifest_path, read_manifest
from wbc_bench.episodes.protocol import EvalProtocol, find_protocol
from wbc_bench.errors import BenchError
from wbc_bench.evaluation.latents import sample_latents
from wbc_bench.evaluation.observation import Sensors
from wbc_bench.evaluation.rollout import rollout
from wbc_bench.evaluation.simulation import Simulation
from wbc_bench.registry import load_controller
from wbc_bench.results.figures import latents
from wbc_bench.robot import load_robot
from wbc_bench.rotations import geodesic_angle

COUNT = 4


class Recording(TorchEngine):
    """A policy that also writes down what it was given."""

    def __init__(self, method: str) -> None:
        super().__init__(*networks(method))
        self.seen: list[dict[str, np.ndarray]] = []
        self.found: list[dict[str, np.ndarray]] = []

    def __call__(self, values, carried):
        self.seen.append({**values, **{name: value.numpy() for name, value in carried.items()}})
        found, carried = super().__call__(values, carried)
        self.found.append({**found, **{name: value.numpy() for name, value in carried.items()}})
        return found, carried


def make(method: str, engine=None) -> LearnedController:
    card = new_card(method, 0, 0, 0.0, find_protocol("smoke_v1")[0])
    policy = engine or numpy_policy(method, *networks(method))
    return LearnedController(load_robot(), card, policy, f"learned:{method}@0", "")


class Stream:
    """Observations of robots that stand in the air and fall, whatever is commanded: the same for everyone."""

    def __init__(self, protocol: EvalProtocol, calm_rows: CalmRows, count: int = COUNT) -> None:
        rng = np.random.default_rng(0)
        noisy = {"noise_scale": np.ones(count), "base_vel": rng.uniform(-0.3, 0.3, (count, 6))}
        self.protocol, self.rows = protocol, calm_rows(count, **noisy)

    def __call__(self, signals, steps: int):
        simulation = Simulation(self.protocol, self.rows)
        sensors = Sensors(self.protocol, self.rows, signals)
        active = np.ones(len(self.rows), dtype=bool)
        for step in range(steps):
            state = simulation.state()
            yield sensors.observe(step, 0.02 * step, state, active), sensors.target(state)
            simulation.step(np.tile(load_robot().default_q, (len(self.rows), 1)), active)


@pytest.fixture(scope="module")
def stream(smoke: EvalProtocol, calm_rows: CalmRows) -> Stream:
    return Stream(smoke, calm_rows)


def drive(controller: LearnedController, stream: Stream, steps: int) -> np.ndarray:
    commands = []
    for step, (obs, target) in enumerate(stream(controller.info.signals, steps)):
        if step == 0:
            controller.reset(np.arange(len(stream.rows)), obs, target)
        commands.append(controller.act(obs, target).q)
    return np.stack(commands)


@pytest.mark.parametrize("method", METHODS)
def test_reads_what_the_paper_s_policy_may_and_the_oracle_more(method):
    signals = make(method).info.signals
    assert signals == (DEPLOYABLE | {"base_pose", "privileged"} if method == "oracle" else DEPLOYABLE)


def test_what_the_policy_is_given(stream):
    """Columns of the observation against the signals, over a reset and 14 steps."""
    engine = Recording("transformer_gru")
    controller = make("transformer_gru", engine)
    drive(controller, stream, 15)
    robot = load_robot()
    observed = list(stream(controller.info.signals, 15))
    pairs = zip(engine.seen, observed, strict=True)
    for k, (values, (obs, target)) in enumerate(pairs):
        assert obs.proprioception is not None and obs.ee_pose is not None
        x = values["observation"]
        np.testing.assert_allclose(x[:, :3], obs.proprioception.base_ang_vel_b, rtol=1e-6)
        np.testing.assert_allclose(x[:, 6:20], obs.proprioception.joint_pos - robot.default_q, atol=1e-6)
        previous = engine.found[k - 1]["action"] if k else np.zeros((COUNT, 14))
        np.testing.assert_array_equal(x[:, 34:48], previous)
        np.testing.assert_allclose(x[:, 48:51], obs.ee_pose.pos_b, rtol=1e-6)
        np.testing.assert_allclose(values["command"][:, :3], target.pos_b, rtol=1e-6)
        np.testing.assert_allclose(values["term"][:, 34:48], obs.proprioception.joint_torque, rtol=1e-6)
    terms = np.stack([values["term"] for values in engine.seen])
    for k, found in enumerate(engine.found):
        expected = terms[[max(0, k - back) for back in range(9, -1, -1)]].swapaxes(0, 1)
        np.testing.assert_array_equal(found["window"], expected)  # filled with the first term
    assert (engine.seen[0]["state"] == 0).all() and (engine.seen[1]["state"] != 0).any()


def test_reference_starts_at_the_observed_error_and_decays(stream):
    engine = Recording("no_latent")
    controller = make("no_latent", engine)
    controller.prepare(stream.protocol)
    drive(controller, stream, 60)
    obs, target = next(iter(stream(controller.info.signals, 1)))
    assert obs.ee_pose is not None
    x, y = obs.ee_pose.rot6_b[:, :3], obs.ee_pose.rot6_b[:, 3:]
    x = x / np.linalg.norm(x, axis=1, keepdims=True)
    y = y - (x * y).sum(1, keepdims=True) * x
    y = y / np.linalg.norm(y, axis=1, keepdims=True)
    rot = np.stack([x, y, np.cross(x, y)], -1)
    start = 2 * np.linalg.norm(obs.ee_pose.pos_b - target.pos_b, axis=1) + geodesic_angle(rot, target.rot_b)
    d_ref = np.stack([values["observation"][:, 57] for values in engine.seen])
    expected = np.maximum(start - stream.protocol.reference_decay * 0.02 * np.arange(60)[:, None], 0)
    np.testing.assert_allclose(d_ref, expected, atol=1e-4)
    assert (d_ref[-1] == 0).any()


def test_the_protocol_sets_the_decay(smoke: EvalProtocol, calm_rows: CalmRows):
    slower = msgspec.structs.replace(smoke, reference_decay=0.5)
    engine = Recording("no_latent")
    rollout(make("no_latent", engine), slower, calm_rows(2))
    first, second = (values["observation"][:, 57] for values in engine.seen[:2])
    np.testing.assert_allclose(first - second, 0.01, atol=1e-5)


def test_the_oracle_is_given_the_truth(stream):
    engine = Recording("oracle")
    drive(make("oracle", engine), stream, 6)
    *_, (obs, _) = stream(make("oracle").info.signals, 6)
    assert obs.privileged is not None and obs.base_pose is not None
    found = np.split(engine.seen[-1]["privileged"], np.cumsum([t.size for t in inputs.PRIVILEGED_LAYOUT]), 1)
    known = obs.privileged
    expected = [
        *(known.base_lin_vel_b, known.joint_torque, known.joint_acc, obs.base_pose.pos_w[:, 2:]),
        *(
            known.ee_lin_vel_b,
            known.ee_ang_vel_b,
            known.foot_pos_b.reshape(-1, 6),
            known.kp_scale,
            known.kd_scale,
        ),
        *(known.base_mass[:, None], known.friction[:, None], known.foot_force_w.reshape(-1, 6)),
    ]
    for term, a, b in zip(inputs.PRIVILEGED_LAYOUT, found, expected, strict=False):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5, err_msg=term.name)
        assert np.abs(b).max() > 0 or term.name.startswith("mass added"), term.name


@pytest.mark.parametrize("method", METHODS)
def test_a_reset_forgets_everything(stream, method):
    controller = make(method)
    first = drive(controller, stream, 12)
    assert np.isfinite(first).all() and np.ptp(first, axis=0).max() > 0
    assert np.array_equal(drive(controller, stream, 12), first)


@pytest.mark.parametrize("method", ["no_latent", "transformer_gru", "oracle"])
def test_rows_do_not_see_each_other(stream, method):
    """Other rows may be anything, also not a number; another number of rows changes no more than rounding."""
    alone, together = make(method), make(method)
    chosen = np.array([1, 3])

    def take(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            return value[chosen]
        return type(value)(*map(take, value)) if isinstance(value, tuple) else value

    for step, (obs, target) in enumerate(stream(alone.info.signals, 12)):
        obs = Observation(obs.time, obs.active, *map(_copied, obs[2:]))
        target = Target(*map(np.copy, target))
        for array in (*(obs.ee_pose or ()), *(obs.proprioception or ()), *target):
            array[[0]] = np.nan
        if step == 0:
            together.reset(np.arange(COUNT), obs, target)
            alone.reset(chosen, take(obs), take(target))
        a, b = together.act(obs, target).q[chosen], alone.act(take(obs), take(target)).q
        np.testing.assert_allclose(a, b, atol=1e-5)


def _copied(signal: Any) -> Any:
    return signal and type(signal)(*map(np.copy, signal))


def test_command_is_default_plus_scaled_action(stream):
    engine = Recording("no_latent")
    commands = drive(make("no_latent", engine), stream, 3)
    robot = load_robot()
    scale = np.array([0.6] * 8 + [0.3] * 3 + [0.2] * 3)
    for command, found in zip(commands, engine.found, strict=True):
        np.testing.assert_allclose(command, robot.default_q + scale * found["action"], atol=1e-12)


def test_a_period_that_does_not_divide_is_refused(smoke: EvalProtocol, calm_rows: CalmRows):
    slower = msgspec.structs.replace(smoke, physics=msgspec.structs.replace(smoke.physics, decimation=15))
    with pytest.raises(BenchError, match=r"every 0\.02 s"):
        rollout(make("no_latent"), slower, calm_rows(2))


def test_one_seed_a_replicate(capsys, tmp_path, monkeypatch):
    """`learned:METHOD` is met by seed k in replicate k; a missing seed is an error."""
    monkeypatch.setattr(weights, "CHECKPOINTS", tmp_path / "shipped")
    written = [write(tmp_path / "shipped" / "limx_adapter", "cenet", seed) for seed in (0, 1)]
    tiny = write_tiny(tmp_path, replicates=3)
    out = tmp_path / "out"
    words = [
        "eval",
        "--controller",
        "learned:cenet",
        "--protocol",
        str(tiny),
        "--out",
        str(out),
        "--workers",
        "1",
    ]
    with pytest.raises(SystemExit):
        main(words)
    assert "unknown checkpoint 'cenet@2'" in capsys.readouterr().err
    main([*words, "--seeds", "2"])
    for seed, path in enumerate(written):
        record = json.loads(next(out.rglob(f"replicate_{seed}/run.json")).read_text())
        assert (record["controller"], record["replicate"]) == ("learned:cenet", seed)
        assert record["controller_name"] == f"learned:cenet@{seed}"
        assert record["checkpoint_sha256"] == checkpoint.load(path).card.sha256
    assert "| Evaluated | learned:cenet | 12/12 |" in capsys.readouterr().out


def test_the_study_says_which_seeds_are_missing(tmp_path, monkeypatch):
    from wbc_bench.evaluation.evaluate import Asked, evaluate_all
    from wbc_bench.evaluation.workers import Engine
    from wbc_bench.results.store import ResultStore

    monkeypatch.setattr(weights, "CHECKPOINTS", tmp_path)
    write(tmp_path / "limx_adapter", "gru", 1)
    store, asked = ResultStore(tmp_path / "out"), Asked.of(str(write_tiny(tmp_path, replicates=3)))
    found = evaluate_all(["learned:gru", "learned:oracle"], asked, store, Engine(), optional=True)
    assert list(found) == ["learned:gru replicate 0, 2", "learned:oracle"]
    assert "unknown checkpoint 'gru@0'" in found["learned:gru replicate 0, 2"]
    assert [run.record.resolved_controller for run in store.runs()] == ["learned:gru@1"]


def test_a_real_episode(smoke: EvalProtocol, tmp_path, calm_rows: CalmRows):
    controller = load_controller(f"learned:{write(tmp_path, 'transformer_gru')}", load_robot())
    a = rollout(controller, smoke, calm_rows(3))
    b = rollout(controller, smoke, calm_rows(3))
    assert a.steps.min() > 5 and np.array_equal(a.action, b.action, equal_nan=True)


def test_the_shard_defines_an_episode():
    """Its bits are those of the same shard; alone an episode only begins alike, contacts amplify rounding."""
    protocol, path = find_protocol("smoke_v1")
    rows = read_manifest(protocol, manifest_path(path))[0].of_replicate(0, 4)
    a, b = (rollout(load_controller("learned:transformer_gru@0", load_robot()), protocol, rows) for _ in "ab")
    np.testing.assert_array_equal(a.ee_pos_w, b.ee_pos_w)
    for row in range(len(rows)):
        controller = load_controller("learned:transformer_gru@0", load_robot())
        alone = rollout(controller, protocol, rows.take(slice(row, row + 1)))
        np.testing.assert_allclose(alone.action[0, 0], a.action[row, 0], atol=1e-5)


def test_conditions_other_than_the_training_s_are_listed():
    protocol, _ = find_protocol("ablation_v1")
    card = new_card("no_latent", 0, 0, 0.0, protocol)
    controller = LearnedController(load_robot(), card, TorchEngine(*networks("no_latent")), "mine", "")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        controller.prepare(protocol)
    with pytest.warns(UserWarning, match=r"^mine .*: push\.speed: trained 0\.5, here 0\.0$"):
        controller.prepare(find_protocol("nopush_v1")[0])
    told = other_conditions(card, find_protocol("reach_v1")[0])
    assert told == "push.speed: trained 0.5, here 0.0; targets.type: trained workspace, here reach"


def test_the_physics_step_and_the_seed_are_no_conditions():
    protocol, _ = find_protocol("ablation_v1")
    card = new_card("no_latent", 0, 0, 0.0, protocol)
    physics = msgspec.structs.replace(protocol.physics, timestep=0.01, decimation=2)
    episodes = msgspec.structs.replace(protocol.episodes, seed=1, per_replicate=7)
    other = msgspec.structs.replace(protocol, physics=physics, episodes=episodes, name="mine")
    assert other_conditions(card, other) == ""
    longer = msgspec.structs.replace(protocol, episodes=msgspec.structs.replace(episodes, horizon=20.0))
    assert other_conditions(card, longer) == "episodes.horizon: trained 10.0, here 20.0"


@pytest.mark.parametrize(("method", "columns"), [("transformer_gru", 64), ("cenet", 16)])
def test_the_latent_of_an_estimator_is_sampled_with_the_error_it_saw(method, columns):
    protocol, path = find_protocol("smoke_v1")
    rows = read_manifest(protocol, manifest_path(path))[0].of_replicate(0, 3)
    samples = sample_latents(make(method), protocol, rows)
    batch = rollout(make(method), protocol, rows)
    assert samples.latent.shape == (batch.steps.sum(), columns) and np.ptp(samples.latent, axis=0).all()
    for row, episode in enumerate(rows.episode):
        own = samples.episode == episode
        # the record's error is the one after a step, the sample's the one before it
        error = batch.position_error[row, : batch.steps[row] - 1]
        np.testing.assert_array_equal(samples.error[own][1:], error)


def test_the_latent_is_what_the_actor_reads():
    policy = Recording("transformer_gru")
    protocol, path = find_protocol("smoke_v1")
    rows = read_manifest(protocol, manifest_path(path))[0].of_replicate(0, 2)
    controller = make("transformer_gru", policy)
    rollout(controller, protocol, rows)
    window, state = policy.found[-1]["window"], policy.seen[-1]["state"]
    with torch.inference_mode():
        context, _ = policy.policy.estimator.step(torch.from_numpy(window), torch.from_numpy(state))
    np.testing.assert_array_equal(controller.latent(), context[:, 3:].numpy())


@pytest.mark.parametrize("method", ["no_latent", "oracle"])
def test_a_method_without_an_estimator_has_no_latent(method):
    protocol, path = find_protocol("smoke_v1")
    rows = read_manifest(protocol, manifest_path(path))[0].of_replicate(0, 2)
    with pytest.raises(BenchError, match=rf"learned:{method}@0' shows no latent; valid: .*transformer_gru"):
        sample_latents(make(method), protocol, rows)


def test_the_command_draws_the_latent_of_a_checkpoint(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(latents, "DRAWN", 100)
    spec = f"learned:{write(tmp_path, 'transformer_gru')}"
    words = ["latent", "--controller", spec, "--protocol", "smoke_v1", "--episodes", "6", "-o", str(tmp_path)]
    main(words)
    printed = capsys.readouterr().out
    assert "balanced accuracy" in printed and "chance" in printed
    assert (tmp_path / "latent_learned-transformer_gru@0.png").exists()
    for change, line in (({2: "hold"}, "shows no latent"), ({6: "3"}, "valid: 4 to 6")):
        with pytest.raises(SystemExit):
            main([change.get(k, word) for k, word in enumerate(words)])
        assert line in capsys.readouterr().err
