"""A teacher beside training: what it answers, who drives, what is learned, and that a run resumes."""

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("rsl_rl")

from learned import write  # noqa: E402
from test_learned_training import TINY, assert_equal, trainer  # noqa: E402

from wbc_baselines.learned import checkpoint, runs  # noqa: E402
from wbc_baselines.learned.checkpoint import CheckpointError  # noqa: E402
from wbc_baselines.learned.environment import PRIVILEGED_COLUMNS  # noqa: E402
from wbc_baselines.learned.runs import RunFolder  # noqa: E402
from wbc_baselines.learned.settings import TrainingError  # noqa: E402

STEPS = TINY.envs * TINY.steps  # of an iteration


@pytest.mark.parametrize("method", ["no_latent", "oracle"])
def test_the_answer_is_the_teachers_own(method, tmp_path):
    path = write(tmp_path, method)
    t = trainer(teacher=str(path), method="transformer_gru")
    seen = t.environment.seen
    parts = [seen.policy] + [seen.critic[:, PRIVILEGED_COLUMNS]] * (method == "oracle")
    wanted = checkpoint.load(path).actor(torch.cat(parts, -1))
    assert torch.equal(t.teaching.answer(t._observations()), wanted)


def test_the_teacher_drives_fewer_and_fewer_environments(tmp_path, monkeypatch):
    t = trainer(teacher=str(write(tmp_path, "no_latent")), teacher_steps=4 * STEPS)
    t._log_std.fill_(-20.0)
    done, answers = [], []
    step, answer = t.environment.step, t.teaching.answer
    monkeypatch.setattr(t.environment, "step", lambda action: done.append(action) or step(action))
    monkeypatch.setattr(t.teaching, "answer", lambda seen: answers.append(answer(seen)) or answers[-1])
    shares = []
    for _ in range(4):
        done.clear()
        answers.clear()
        t.environment.begin_rollout(t.iteration, TINY.steps)
        t._roll_out()
        t.iteration += 1
        t.ppo.storage.clear()
        same = [(a - w).abs().amax(-1) < 1e-4 for a, w in zip(done, answers, strict=False)]
        shares.append(float(torch.stack(same).float().mean()) if same else 0.0)
    assert shares == [1.0, 0.5, 0.0, 0.0]


def test_the_policy_learns_from_the_answers_alone_and_then_from_returns(tmp_path, monkeypatch):
    t = trainer(teacher=str(write(tmp_path, "no_latent", seed=1)), teacher_steps=3 * STEPS)
    losses = [t.iterate()["loss/teaching"] for _ in range(3)]
    assert losses[2] < losses[0]
    before = [p.clone() for p in t.ppo.actor.mlp.parameters()]
    monkeypatch.setattr(t.teaching, "update", None)  # would be called
    assert "loss/teaching" not in t.iterate()
    assert not all(map(torch.equal, before, t.ppo.actor.mlp.parameters()))


def test_returns_do_not_touch_the_policy_while_it_is_taught(tmp_path, monkeypatch):
    t = trainer(teacher=str(write(tmp_path, "no_latent")), teacher_steps=3 * STEPS)
    monkeypatch.setattr(t.teaching, "update", lambda seen, way: {})
    before = [p.clone() for p in t.ppo.actor.mlp.parameters()]
    critic = [p.clone() for p in t.ppo.critic.parameters()]
    t.iterate()
    assert all(map(torch.equal, before, t.ppo.actor.mlp.parameters()))
    assert not any(map(torch.equal, critic, t.ppo.critic.parameters()))


def test_a_taught_run_resumes_bit_by_bit(tmp_path):
    changes = {"teacher": str(write(tmp_path, "oracle")), "teacher_steps": 3 * STEPS, "method": "gru"}
    unbroken, broken = trainer(**changes), trainer(**changes)
    folder = RunFolder(tmp_path / "gru@0")
    folder.open(broken.settings)
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
        checkpoint.load_teacher(str(write(tmp_path, "gru")))
    with pytest.raises(TrainingError, match="--teacher-steps 0: valid: more than 0"):
        trainer(teacher_steps=0)
