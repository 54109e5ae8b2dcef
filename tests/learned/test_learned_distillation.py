"""A teacher beside training: which actions it gives, who acts, what is learned, and that a run resumes."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("rsl_rl")

from policies import write
from trainers import STEPS, TINY, assert_equal, trainer
from wbc_baselines.learned.policy import checkpoint
from wbc_baselines.learned.policy.card import CheckpointError
from wbc_baselines.learned.training import distillation as losses
from wbc_baselines.learned.training import run_folder as runs
from wbc_baselines.learned.training.config import TrainingError
from wbc_baselines.learned.training.distillation import (
    DEPARTURE_REFERENCE,
    ENCODERS,
    GAINS,
    PAYLOAD,
    PLACE,
    SAMPLE_FRACTION,
    TARGET_STEP,
    ArmIKLoss,
    Distillation,
    SupervisedUpdate,
)
from wbc_baselines.learned.training.environment import PRIVILEGED_COLUMNS
from wbc_baselines.learned.training.run_folder import RunFolder
from wbc_baselines.learned.training.state_view import ARRIVAL_REFERENCE
from wbc_baselines.learned.training.trainer import Trainer
from wbc_bench.robot import load_robot

REFERENCE = 57  # column of d_ref
ROBOT = load_robot()


def distilled(**changes) -> tuple[Trainer, Distillation]:
    t = trainer(**changes)
    assert t.distillation
    return t, t.distillation


def with_arm_ik(**changes) -> tuple[Trainer, ArmIKLoss]:
    t = trainer(**({"arm_ik_loss": (0.0, 3 * STEPS)} | changes))
    updates = t.auxiliary_losses["arm_ik_loss"]
    assert isinstance(updates, ArmIKLoss)
    return t, updates


@pytest.mark.parametrize("method", ["no_latent", "oracle"])
def test_the_answer_is_the_teachers_own(method, tmp_path):
    path = write(tmp_path, method)
    t, distillation = distilled(teacher=str(path), method="transformer_gru")
    seen = t.environment.observations
    parts = [seen.policy] + [seen.critic[:, PRIVILEGED_COLUMNS]] * (method == "oracle")
    wanted = checkpoint.load(path).actor(torch.cat(parts, -1))
    assert torch.equal(distillation.actions(t._observations()), wanted)


def test_the_teacher_drives_fewer_and_fewer_environments(tmp_path, monkeypatch):
    t, distillation = distilled(teacher=str(write(tmp_path, "no_latent")), distillation_steps=4 * STEPS)
    t.ppo.log_std.fill_(-20.0)
    done, answers = [], []
    step, answer = t.environment.step, distillation.actions
    monkeypatch.setattr(t.environment, "step", lambda action: done.append(action) or step(action))
    monkeypatch.setattr(distillation, "actions", lambda seen: answers.append(answer(seen)) or answers[-1])
    shares = []
    for _ in range(4):
        done.clear()
        answers.clear()
        t.environment.begin_rollout(t.iteration, TINY.num_steps_per_env)
        t.collect_rollout()
        t.samples += STEPS
        t.ppo.storage.clear()
        same = [(a - w).abs().amax(-1) < 1e-4 for a, w in zip(done, answers, strict=False)]
        shares.append(float(torch.stack(same).float().mean()) if same else 0.0)
    assert shares == [1.0, 0.5, 0.0, 0.0]


def test_the_policy_learns_from_the_answers_alone_and_then_from_returns(tmp_path, monkeypatch):
    t = trainer(teacher=str(write(tmp_path, "no_latent", seed=1)), distillation_steps=3 * STEPS)
    losses = [t.iterate()["loss/distillation"] for _ in range(3)]
    assert losses[2] < losses[0]
    before = [p.clone() for p in t.ppo.actor.mlp.parameters()]
    monkeypatch.setattr(t.distillation, "update", None)  # would be called
    assert "loss/distillation" not in t.iterate()
    assert not all(map(torch.equal, before, t.ppo.actor.mlp.parameters()))


def test_returns_do_not_touch_the_policy_while_it_is_distilled(tmp_path, monkeypatch):
    t = trainer(teacher=str(write(tmp_path, "no_latent")), distillation_steps=3 * STEPS)
    monkeypatch.setattr(t.distillation, "update", lambda seen, way: {})
    before = [p.clone() for p in t.ppo.actor.mlp.parameters()]
    critic = [p.clone() for p in t.ppo.critic.parameters()]
    t.iterate()
    assert all(map(torch.equal, before, t.ppo.actor.mlp.parameters()))
    assert not any(map(torch.equal, critic, t.ppo.critic.parameters()))


def test_then_it_advises_beside_returns_less_and_less(tmp_path, monkeypatch):
    changes = {"distillation_steps": STEPS, "kickstart_steps": 3 * STEPS}
    t, distillation = distilled(teacher=str(write(tmp_path, "no_latent")), **changes)
    weights = []
    monkeypatch.setattr(distillation, "kickstart", lambda seen, weight: weights.append(weight) or {})
    epochs = []
    update = t.ppo.update
    monkeypatch.setattr(t.ppo, "update", lambda: epochs.append(t.ppo.num_learning_epochs) or update())
    for _ in range(4):
        t.iterate()
    assert weights == [1.0, 0.5]
    assert epochs == [1] + 3 * [t.config.num_learning_epochs]
    assert (
        t.config.kickstart_weight(0) == 1.0 and trainer(kickstart_steps=1e6).config.kickstart_weight(0) == 0.0
    )


def test_an_advice_moves_a_share_of_the_answers_a_part_of_the_way(tmp_path, monkeypatch):
    t, distillation = distilled(teacher=str(write(tmp_path, "no_latent")))
    t.environment.begin_rollout(0, TINY.num_steps_per_env)
    t.collect_rollout()
    seen = t.ppo.storage.observations.flatten(0, 1)
    own, answer = t.ppo.actor(seen).detach(), distillation.actions(seen)
    updates = []

    def keep(self, seen, action, *a, **k) -> float:
        updates.append((seen["policy"], action))
        return 0.0

    monkeypatch.setattr(SupervisedUpdate, "update", keep)
    distillation.kickstart(t.ppo.storage.observations, 0.5)
    states, wanted = updates[0]
    assert len(states) == round(SAMPLE_FRACTION * STEPS)
    row = torch.cdist(states, seen["policy"]).argmin(-1)  # which state of the rollout each is
    assert len(row.unique()) == len(row) and not torch.equal(row, row.sort().values)
    torch.testing.assert_close(wanted, own[row] + 0.5 * TARGET_STEP * (answer[row] - own[row]))


def test_a_run_with_every_loss_resumes_bit_by_bit(tmp_path):
    changes = {"teacher": str(write(tmp_path, "oracle")), "distillation_steps": 3 * STEPS, "method": "gru"}
    changes |= {"arm_ik_loss": (STEPS, 4 * STEPS), "kickstart_steps": 6 * STEPS}
    changes |= {"posture_loss": (0.0, 4 * STEPS)}
    unbroken, broken = trainer(**changes), trainer(**changes)
    folder = RunFolder(tmp_path / "gru@0")
    folder.open(broken.config)
    for _ in range(2):
        broken.iterate()
    runs.save_resume(broken, folder, 1.0)
    resumed = trainer(**changes)
    runs.load_resume(resumed, folder)
    for _ in range(4):
        unbroken.iterate()
    for _ in range(2):
        resumed.iterate()
    assert_equal(unbroken.save(), resumed.save())


def test_a_teacher_has_no_memory(tmp_path):
    with pytest.raises(CheckpointError, match="is of gru, valid: a method without an estimated context"):
        checkpoint.load_teacher(str(write(tmp_path, "gru")), "limx_adapter")
    with pytest.raises(TrainingError, match="--distillation-steps 0: valid: more than 0"):
        trainer(distillation_steps=0)
    with pytest.raises(TrainingError, match="--arm-ik-loss 2 1: valid: 0 <= begin <= end"):
        trainer(arm_ik_loss=(2.0, 1.0))


def test_the_arm_sets_out_as_the_reference_falls_and_bears_its_weight():
    t, distillation = with_arm_ik()
    observations = t._observations()
    critic = observations["critic"]
    scale, kp = ROBOT.action_scale[8:], ROBOT.kp[8:]
    q = ROBOT.default_q[8:] + critic[:, 14:20].numpy()
    hidden = critic[:, PRIVILEGED_COLUMNS]
    generator = torch.Generator().manual_seed(0)
    factors, errors = (0.2 * torch.rand(2, len(critic), 14, generator=generator) - 0.1).unbind()
    payload, place = torch.rand(len(critic), 1, generator=generator), torch.full((len(critic), 3), 0.02)
    hidden[:, GAINS], hidden[:, ENCODERS] = 1 + factors, errors
    hidden[:, PAYLOAD], hidden[:, PLACE] = payload, place
    torque = distillation._arm.holding_torque(torch.tensor(q).float(), critic[:, 3:6], payload, place)
    weight = torque.numpy() / (kp * (1 + factors[:, 8:].numpy())) + errors[:, 8:].numpy()
    critic[:, REFERENCE] = DEPARTURE_REFERENCE
    np.testing.assert_allclose(distillation.actions(observations)[0], weight / scale, atol=1e-5)
    critic[:, REFERENCE] = ARRIVAL_REFERENCE
    arrived = distillation.actions(observations)[0].numpy() * scale - weight
    there = distillation._arm.solve(torch.tensor(q).float(), critic[:, 58:67]).numpy()
    np.testing.assert_allclose(arrived, there - ROBOT.default_q[8:], atol=1e-4)
    critic[:, REFERENCE] = (DEPARTURE_REFERENCE + ARRIVAL_REFERENCE) / 2
    half = distillation.actions(observations)[0].numpy() * scale - weight
    np.testing.assert_allclose(half, arrived / 2, atol=1e-4)


def test_a_lesson_moves_the_arm_a_part_of_the_way_where_it_reaches_and_leaves_the_legs(monkeypatch):
    t, arm = with_arm_ik()
    t.environment.begin_rollout(0, TINY.num_steps_per_env)
    t.collect_rollout()
    t.ppo.storage.observations["critic"][0, :, 58] = 3.0  # [m] ahead
    seen = t.ppo.storage.observations.flatten(0, 1)
    own, (answer, reached) = t.ppo.actor(seen).detach(), arm.actions(seen)
    assert not reached[: TINY.num_envs].any() and reached.any()
    monkeypatch.setattr(losses, "sample_states", lambda seen: seen.flatten(0, 1))
    updates = []
    monkeypatch.setattr(arm.supervised, "update", lambda seen, action, *a, **k: updates.append(action))
    arm.update(t.ppo.storage.observations)
    torch.testing.assert_close(updates[0][:, :8], own[reached, :8])
    torch.testing.assert_close(updates[0][:, 8:], (own[:, 8:] + TARGET_STEP * (answer - own[:, 8:]))[reached])
    t.ppo.storage.observations["critic"][..., 58] = 3.0
    assert arm.update(t.ppo.storage.observations) == {} and len(updates) == 1


def test_legs_move_a_part_of_their_posture_error(monkeypatch):
    """A fiftieth, in actions, where there is an error; the arm stays."""
    t = trainer(posture_loss=(0.0, 3 * STEPS))
    legs = t.auxiliary_losses["posture_loss"]
    assert legs
    t.environment.begin_rollout(0, TINY.num_steps_per_env)
    t.collect_rollout()
    seen = t.ppo.storage.observations
    seen["leg_posture_error"][:] = 0.0
    assert legs.update(seen) == {}
    leg_posture_error = torch.linspace(-0.5, 0.5, 16).reshape(2, 8)
    seen["leg_posture_error"][1, 2:4] = leg_posture_error
    own = t.ppo.actor(seen[1, 2:4]).detach()
    updates = []
    monkeypatch.setattr(legs.supervised, "update", lambda seen, action, *a, **k: updates.append(action))
    found = legs.update(seen)
    scale = torch.tensor(ROBOT.action_scale[:8], dtype=torch.float32)
    torch.testing.assert_close(updates[0][:, :8], own[:, :8] + 0.02 * leg_posture_error / scale)
    torch.testing.assert_close(updates[0][:, 8:], own[:, 8:])
    assert found["posture"] == pytest.approx(float(leg_posture_error.square().mean().sqrt()), rel=1e-5)


def test_the_arm_imitates_beside_ppo_during_its_interval():
    steps = 4 * STEPS  # four times the environments, so that some state of every rollout is imitated
    t, _ = with_arm_ik(arm_ik_loss=(steps, 3 * steps), num_envs=32)
    active = ["loss/arm_ik" in t.iterate() for _ in range(4)]
    assert active == [False, True, True, False]


def test_the_arm_comes_nearer_to_its_inverse_kinematics():
    t, _ = with_arm_ik(arm_ik_loss=(0.0, 1e6), learning_rate=1e-5, min_learning_rate=((0.0, 1e-5),))
    misses = [t.iterate().get("loss/arm_ik", np.nan) for _ in range(60)]
    assert np.nanmean(misses[-10:]) < 0.9 * np.nanmean(misses[:10])
