"""DAgger and warm starts: who acts, what is recorded, and that all methods begin with the same policy."""

import msgspec
import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("rsl_rl")

from tensordict import TensorDict

from policies import write
from trainers import trainer
from training_targets import TARGETS
from wbc_baselines.learned.policy import checkpoint
from wbc_baselines.learned.policy.card import CheckpointError, new_card
from wbc_baselines.learned.policy.estimators import make_estimator
from wbc_baselines.learned.policy.inputs import VELOCITY
from wbc_baselines.learned.policy.networks import Actor
from wbc_baselines.learned.training import dagger as dagger_module
from wbc_baselines.learned.training.cli import main
from wbc_baselines.learned.training.dagger import (
    DaggerController,
    ImitationDataset,
    fit,
    record,
    sample_manifest,
)
from wbc_baselines.learned.training.symmetry import input_mirror
from wbc_baselines.learned.training.warm_start import INPUTS, warm_start
from wbc_bench.controller import ControllerInfo, JointCommand
from wbc_bench.episodes.protocol import find_protocol
from wbc_bench.evaluation.control_loop import ControlLoop
from wbc_bench.robot import load_robot

JOINTS, ACTION = slice(6, 20), slice(34, 48)  # of the observation: positions; the action of the step before
TARGET_Y = 59
ROBOT = load_robot()


def short_protocol():
    protocol, _ = find_protocol("ablation_v1")
    episodes = msgspec.structs.replace(protocol.episodes, horizon=0.2)
    push = msgspec.structs.replace(protocol.push, interval=(0.05, 0.06), quiet_end=0.0)
    return msgspec.structs.replace(protocol, episodes=episodes, push=push)


def constant(value: float) -> Actor:
    actor = Actor(0)
    state = {name: torch.zeros_like(tensor) for name, tensor in actor.state_dict().items()}
    state |= {"mlp.6.bias": torch.full((14,), value), "normalizer.std": torch.ones(INPUTS)}
    actor.load_state_dict(state)
    return actor


def start_at(path, seed: int = 0) -> Actor:
    torch.manual_seed(seed)
    actor = Actor(0)
    actor.normalizer.mean.normal_()
    actor.normalizer.std.uniform_(0.5, 2.0)
    card = new_card("no_latent", 0, 0, 0.0, find_protocol("ablation_v1")[0])
    checkpoint.save(path, actor, make_estimator("none"), card)
    return actor.eval()


def test_the_teacher_answers_wherever_the_student_drives():
    protocol = short_protocol()
    own = record("hold", protocol, TARGETS, 3, seed=1)
    assert (
        own.inputs.shape == (3 * 10, INPUTS) and (own.action == 0).all()
    )  # `hold` asks for the default posture
    assert (own.inputs[:, ACTION] == 0).all()
    driven = record("hold", protocol, TARGETS, 3, seed=1, student=constant(0.5), student_fraction=1.0)
    assert (driven.action == 0).all()
    assert (driven.inputs[:3, ACTION] == 0).all() and (driven.inputs[3:, ACTION] == 0.5).all()
    # the same episodes until the student has moved them
    assert np.array_equal(own.inputs[:3], driven.inputs[:3]) and not np.array_equal(
        own.inputs[-1], driven.inputs[-1]
    )


class Asks:
    """A teacher that always asks for the same normalised action."""

    def __init__(self, robot, action):
        self.info = ControllerInfo("asks", frozenset(), 0.02, "test")
        self._q = robot.default_q + robot.action_scale * action

    def reset(self, episodes, obs, target):
        pass

    def act(self, obs, target):
        return JointCommand(np.tile(self._q, (len(obs.active), 1)))


@pytest.mark.parametrize(("joint", "kept"), [(13, True), (0, False)], ids=["arm", "leg"])
def test_far_reaches_of_the_arm_are_recorded_and_those_of_the_legs_are_not(joint, kept):
    protocol, action = short_protocol(), np.zeros(14)
    action[joint] = 6.0
    robot, rows = load_robot(protocol.robot), sample_manifest(protocol, TARGETS, 2, np.random.default_rng(0))
    controller = DaggerController(
        robot, protocol, Asks(robot, action), None, torch.zeros(2, dtype=torch.bool)
    )
    for _ in ControlLoop(controller, protocol, rows).run():
        pass
    dataset = ImitationDataset.joined(controller.recorded)
    assert len(dataset.action) == (2 * 10 if kept else 0)
    assert np.allclose(dataset.action, action, atol=1e-5)


def test_the_dataset_does_not_depend_on_the_number_of_workers():
    protocol = short_protocol()
    one, two = (record("hold", protocol, TARGETS, 30, seed=2, workers=n) for n in (1, 2))
    assert np.array_equal(one.inputs, two.inputs) and len(one.inputs) == 30 * 10


def test_fit_finds_a_linear_teacher_and_its_mirror_image():
    """All samples have the target on the left, where the first arm joint turns by one unit."""
    rng = np.random.default_rng(0)
    seen = rng.normal(0.0, 2.0, (20_000, INPUTS)).astype(np.float32)
    seen[:, TARGET_Y] = 1.0 + np.abs(seen[:, TARGET_Y])
    action = 0.2 * seen[:, JOINTS]
    action[:, 8] = 1.0
    actor, error = fit(ImitationDataset(seen, action), ROBOT, seed=0, updates=400, batch=500)
    assert error < 0.04  # [rad] of 0.20
    with torch.no_grad():
        left, right = (actor(torch.from_numpy(x))[:, 8].mean() for x in (seen, input_mirror(ROBOT)(seen)))
    assert left == pytest.approx(1.0, abs=0.2) and right == pytest.approx(-1.0, abs=0.2)
    again, same = fit(ImitationDataset(seen, action), ROBOT, seed=0, updates=400, batch=500)
    assert error == same and torch.equal(actor.mlp[0].weight, again.mlp[0].weight)


@pytest.mark.parametrize("method", ["no_latent", "cenet", "transformer_gru", "oracle"])
def test_every_method_begins_with_the_same_policy(method, tmp_path):
    start = start_at(tmp_path / "start.safetensors")
    t = trainer(method=method, init_checkpoint=str(tmp_path / "start.safetensors"))
    actor = t.actor()
    seen = torch.randn(5, INPUTS)
    context = 10 * torch.randn(5, t.estimator.context_dim)
    assert torch.allclose(actor(torch.cat([seen, context], -1)), start(seen), atol=1e-6)


def test_first_only_the_critic_learns(tmp_path):
    t = trainer(critic_warmup_iterations=1)
    before = [p.clone() for p in t.ppo.actor.mlp.parameters()]
    critic = [p.clone() for p in t.ppo.critic.parameters()]
    found = t.iterate()
    assert all(map(torch.equal, before, t.ppo.actor.mlp.parameters()))
    assert not any(map(torch.equal, critic, t.ppo.critic.parameters()))
    assert found["policy/learning_rate"] == t.config.learning_rate
    t.iterate()
    assert not all(map(torch.equal, before, t.ppo.actor.mlp.parameters()))


@pytest.mark.parametrize("method", ["cenet", "transformer_gru", "oracle"])
def test_a_method_goes_on_from_a_checkpoint_of_its_own(method, tmp_path):
    path = write(tmp_path, method)
    t, start = trainer(method=method, init_checkpoint=str(path)), checkpoint.load(path)
    inputs = torch.randn(5, INPUTS + t.estimator.context_dim)
    assert torch.allclose(t.actor()(inputs), start.actor(inputs), atol=1e-6)
    weights = dict(start.estimator.state_dict())
    assert all(torch.equal(weights[name], value) for name, value in t.estimator.state_dict().items())
    if weights:
        assert t.estimator.normalizer.count == t.config.init_normalizer_count


@pytest.mark.parametrize("method", ["no_latent", "gru"])
def test_a_method_begins_with_the_oracle_whose_knowledge_is_at_its_mean(method, tmp_path):
    start = checkpoint.load(write(tmp_path, "oracle")).actor
    t = trainer(method=method, init_checkpoint=str(tmp_path / "oracle@0.safetensors"))
    seen, velocity = torch.randn(5, INPUTS), torch.randn(5, VELOCITY)
    context = torch.randn(5, t.estimator.context_dim)
    known = start.normalizer.mean[INPUTS:].expand(5, -1).clone()
    if method == "gru":
        context[:, :VELOCITY] = known[:, :VELOCITY] = velocity
    mine, theirs = t.actor()(torch.cat([seen, context], -1)), start(torch.cat([seen, known], -1))
    torch.testing.assert_close(mine, theirs, atol=1e-5, rtol=1e-5)


def test_a_start_has_no_context_or_a_known_one(tmp_path):
    path = write(tmp_path, "cenet")
    with pytest.raises(CheckpointError, match="is of cenet, valid: a method without a context, the oracle"):
        checkpoint.load_init_checkpoint(str(path), "gru", "limx_adapter")


def test_the_normaliser_of_a_start_counts():
    start = constant(0.0)
    start.normalizer.mean.fill_(2.0)
    t = trainer()
    warm_start(t.ppo.actor, start, context=0, count=1000)
    t.ppo.actor.train().update_normalization(TensorDict({"policy": torch.zeros(1000, INPUTS)}, [1000]))
    assert torch.allclose(t.actor().normalizer.mean, torch.ones(INPUTS))


def test_disturbances_rise_after_the_calm_rounds(monkeypatch):
    protocol, heard = short_protocol(), []

    def fake(spec, disturbed, target_set, episodes, key, student, fraction, *_):
        heard.append((key, disturbed.push.speed / protocol.push.speed, fraction))
        return ImitationDataset(np.zeros((100, INPUTS), np.float32), np.zeros((100, 14), np.float32))

    monkeypatch.setattr(dagger_module, "record", fake)
    dagger_module.dagger("hold", protocol, TARGETS, 2, rounds=6, seed=1, undisturbed_rounds=2, updates=1)
    keys, disturbance_scale, fraction = zip(*heard, strict=True)
    assert keys == (6, 7, 8, 9, 10, 11)
    np.testing.assert_allclose(disturbance_scale, [0, 0, 0.25, 0.5, 0.75, 1])
    np.testing.assert_allclose(fraction, [0, 0.25, 0.5, 0.75, 0.9, 0.9])


def test_imitate_writes_a_checkpoint_that_an_evaluation_reads(tmp_path, capsys):
    path = tmp_path / "start.safetensors"
    for options, message in (
        (["--path", str(tmp_path / "start.pt")], "ends in .safetensors"),
        (
            ["--path", str(path), "--rounds", "2", "--undisturbed-rounds", "2"],
            "--undisturbed-rounds 2: valid: 0 to 1",
        ),
    ):
        with pytest.raises(SystemExit) as stop:
            main(["dagger", *options])
        assert stop.value.code == 2 and message in capsys.readouterr().err
    small = (
        "--episodes",
        "2",
        "--rounds",
        "2",
        "--undisturbed-rounds",
        "1",
        "--updates",
        "20",
        "--workers",
        "1",
    )
    main(["dagger", "--path", str(path), "--teacher", "hold", *small])
    card = checkpoint.load(path).card
    assert (card.method, card.samples) == ("no_latent", 0)
