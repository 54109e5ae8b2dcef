"""Training: gradients stay apart, sequences stay whole, a resumed run is bit-equal, files survive a kill."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import nullcontext
from dataclasses import asdict, replace

import msgspec
import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("rsl_rl")

from mujoco.batch import Batch
from tensordict import TensorDict

from trainers import STEPS, TINY, assert_equal, trainer
from training_targets import TARGETS, manifest_of
from wbc_baselines.learned.policy import checkpoint
from wbc_baselines.learned.policy.average import average
from wbc_baselines.learned.policy.estimators.latent import LatentEstimator
from wbc_baselines.learned.policy.methods import METHODS
from wbc_baselines.learned.training import run_folder as runs
from wbc_baselines.learned.training.backends import cpu
from wbc_baselines.learned.training.backends.cpu import CpuBackend
from wbc_baselines.learned.training.campaign import is_done, standing
from wbc_baselines.learned.training.cli import main
from wbc_baselines.learned.training.config import TrainConfig, TrainingError
from wbc_baselines.learned.training.curves import curves_figure, measured_scores, smooth, write_curves
from wbc_baselines.learned.training.environment import PRIVILEGED_COLUMNS, Environment
from wbc_baselines.learned.training.history import History
from wbc_baselines.learned.training.make import make_environment
from wbc_baselines.learned.training.precision import fast_products
from wbc_baselines.learned.training.resets import sample_episodes
from wbc_baselines.learned.training.returns import generalized_advantages
from wbc_baselines.learned.training.run_folder import RunFolder, run
from wbc_baselines.learned.training.throughput import measure
from wbc_baselines.learned.training.trainer import Trainer
from wbc_bench.episodes.protocol import Noise, Push, find_protocol
from wbc_bench.errors import UnknownNameError
from wbc_bench.evaluation import simulation
from wbc_bench.evaluation.rollout import rollout
from wbc_bench.randomness import stream
from wbc_bench.registry import load_controller
from wbc_bench.results.figures.style import GREEN, SKY
from wbc_bench.results.study import labels_of, released_rows
from wbc_bench.robot import load_robot


@pytest.mark.parametrize("method", METHODS)
def test_two_and_two_iterations_are_four(method, tmp_path):
    """Every method, through the resume file: networks, optimisers, normalisers, physics and draws."""
    unbroken, broken = trainer(method=method), trainer(method=method)
    for _ in range(2):
        broken.iterate()
    folder = RunFolder(tmp_path / broken.config.name)
    folder.open(broken.config)
    runs.save_resume(broken, folder, 1.0)
    resumed = trainer(method=method)
    assert runs.load_resume(resumed, folder) == 1.0
    last = [unbroken.iterate() for _ in range(4)][-1]
    again = [resumed.iterate() for _ in range(2)][-1]
    assert_equal(unbroken.save(), resumed.save())
    for name, value in last.items():
        if not name.startswith("time/"):
            np.testing.assert_equal(again[name], value, err_msg=name)


def test_equal_seeds_are_equal_and_others_are_not():
    one, same, other = trainer(seed=1), trainer(seed=1), trainer(seed=2)
    for each in (one, same, other):
        each.iterate()
    assert_equal(dict(one.actor().state_dict()), dict(same.actor().state_dict()))
    assert not torch.equal(one.actor().mlp[0].weight, other.actor().mlp[0].weight)


@pytest.mark.parametrize("method", ["no_latent", "oracle"])
def test_mirror_images_double_every_minibatch(method):
    """The images of images are the samples, and PPO sees both."""
    t = trainer(method=method, symmetry_augmentation=True)
    assert t.ppo.symmetry
    augment, seen = t.ppo.symmetry.data_augmentation_func, t._observations()
    action = torch.randn(len(seen), 14)
    both, actions = augment(None, seen, action)
    again, back = augment(None, both[len(seen) :], actions[len(seen) :])
    for name in seen.keys():  # noqa: SIM118
        assert torch.equal(again[name][len(seen) :], seen[name])
        assert not torch.equal(both[name][len(seen) :], seen[name])
    assert torch.equal(back[len(seen) :], action) and not torch.equal(actions[len(seen) :], action)
    sizes = []
    forward = t.ppo.critic.forward
    t.ppo.critic.forward = lambda obs, **more: sizes.append(len(obs)) or forward(obs, **more)
    found = t.iterate()
    assert all(np.isfinite(value) for name, value in found.items() if name.startswith("loss/"))
    assert sizes[-1] == 2 * TINY.num_envs * TINY.num_steps_per_env // TINY.num_mini_batches


def test_a_mirror_needs_inputs_that_have_one():
    with pytest.raises(
        TrainingError, match="--symmetry-augmentation with --method transformer_gru: valid: no_latent, oracle"
    ):
        replace(TINY, method="transformer_gru", symmetry_augmentation=True).check()


def test_the_policys_gradient_never_reaches_the_estimator():
    """PPO's update leaves the estimator without gradient, weights as they were; and the other way round."""
    t = trainer(method="transformer_gru")
    weights = {name: value.clone() for name, value in t.estimator.state_dict().items()}
    t.environment.begin_rollout(0, TINY.num_steps_per_env)
    rollout = t.collect_rollout()[0]
    assert rollout
    assert not t.ppo.storage.observations["context"].requires_grad
    with torch.no_grad():
        t.ppo.compute_returns(t._observations())
    t.ppo.update()
    assert all(p.grad is None for p in t.estimator.parameters())
    assert_equal(weights, dict(t.estimator.state_dict()))
    mine = {id(p) for p in t.estimator.parameters()}
    assert not mine & {id(p) for group in t.ppo.optimizer.param_groups for p in group["params"]}
    policy = {name: value.clone() for name, value in t.ppo.actor.state_dict().items()}
    t.update_estimator(rollout)
    assert_equal(policy, dict(t.ppo.actor.state_dict()))
    assert any(not torch.equal(weights[name], value) for name, value in t.estimator.state_dict().items())


@pytest.mark.parametrize("method", ["cenet", "gru", "transformer_gru"])
def test_the_rollout_gives_the_contexts_back(method, monkeypatch):
    """Unrolled from stored state and resets, the windows yield the contexts the actor saw."""
    monkeypatch.setattr(torch, "randn", lambda *size, device=None: torch.zeros(*size))
    monkeypatch.setattr("wbc_baselines.learned.training.trainer.fast_products", nullcontext)
    t = trainer(method=method)
    t.environment._episode.step[:] = t.environment.protocol.num_steps - torch.tensor(
        [2, 3, 4, 5, 8, 9, 10, 11]
    )
    contexts, estimate = [], t._estimate

    def estimated():
        contexts.append(t._context)  # the one that the step before has used
        return estimate()

    monkeypatch.setattr(t, "_estimate", estimated)
    for _ in range(2):  # the second rollout begins in the middle of episodes
        contexts.clear()
        t.environment.begin_rollout(t.iteration, TINY.num_steps_per_env)
        rollout = t.collect_rollout()[0]
        assert rollout and isinstance(t.estimator, LatentEstimator)
        t.iteration += 1
        t.ppo.storage.clear()
        seen = torch.stack(contexts)[:, rollout.ids]
        (batch,) = rollout.batches(1)
        e = t.estimator.encode(batch)
        torch.testing.assert_close(e[..., : seen.shape[-1]], seen, atol=1e-5, rtol=1e-5)
        assert batch.start.any() and not batch.valid.all()


def test_the_next_observation_is_of_the_next_step():
    """Where valid, what step t's decoder is to predict is what step t + 1 begins with."""
    t = trainer(method="cenet")
    t.environment._episode.step[:] = t.environment.protocol.num_steps - torch.tensor([2, 4, *[100] * 6])
    t.environment.begin_rollout(0, TINY.num_steps_per_env)
    rollout = t.collect_rollout()[0]
    assert rollout
    (batch,) = rollout.batches(1)
    # columns shared by the noisy term and the clean observation, up to the noise
    newest = batch.history[1:, :, -1, 6:20]
    assert ((newest - batch.next_observation[:-1, :, 6:20]).abs() <= 0.01 + 1e-6).all()
    assert torch.equal(batch.start[1:], ~batch.valid[:-1])


def test_the_learning_rate_has_a_floor():
    t = trainer(desired_kl=((0.0, 1e-9),), min_learning_rate=((0.0, 2e-4),))
    t.iterate()
    assert t.ppo.learning_rate >= 2e-4
    assert t.ppo.optimizer.param_groups[0]["lr"] >= 2e-4


def test_time_outs_are_bootstrapped():
    """A time-out's reward grows by gamma V(s), a fall's does not."""
    t = trainer()
    env = t.environment
    env._episode.step[:] = 0
    env._episode.step[0] = env.protocol.num_steps - 1
    env._backend._state["qpos"][1, 2] = 0.2
    env.begin_rollout(0, 1)
    observations = t._observations()
    step = env.step(t.ppo.act(observations))
    assert t.ppo.transition.values is not None
    values = t.ppo.transition.values[:, 0].clone()
    t.ppo.process_env_step(t._observations(), step.reward, step.done, {"time_outs": step.time_out})
    stored = t.ppo.storage.rewards[0, :, 0]
    assert step.time_out[0] and step.done[1] and not step.time_out[1]
    torch.testing.assert_close(stored[0], step.reward[0] + TINY.gamma * values[0])
    torch.testing.assert_close(stored[1:], step.reward[1:])


def test_noise_and_curriculum_follow_the_samples():
    t = trainer(curriculum=96.0, std_legs=((48.0, 0.4), (144.0, 0.1)), std_arm=((48.0, 1.0), (144.0, 0.01)))
    noise, ramp = [], []
    while not t.done:
        found = t.iterate()
        noise.append((found["policy/std_legs"], found["policy/std_arm"]))
        ramp.append(t.environment.curriculum)
        std = t.ppo.log_std.exp()
        torch.testing.assert_close(std, torch.tensor([noise[-1][0]] * 8 + [noise[-1][1]] * 6))
    np.testing.assert_allclose(noise, [(0.4, 1.0), (0.4, 1.0), (0.2, 0.1), (0.1, 0.01)])
    np.testing.assert_allclose(ramp, [0, 0.5, 1, 1])


def test_disturbances_rise_with_the_samples():
    t = trainer(disturbance_ramp=(48.0, 144.0))
    assert t.environment.disturbance_scale == 0.0
    found = [t.iterate()["episode/disturbance_scale"] for _ in range(4)]
    np.testing.assert_allclose(found, [0.0, 0.0, 0.5, 1.0])
    assert trainer().environment.disturbance_scale == 1.0
    for ramp in ((5.0, 2.0), (3.0, 3.0), (-1.0, 5.0)):
        with pytest.raises(TrainingError, match=r"--disturbance-ramp .*valid: 0 <= begin"):
            replace(TINY, disturbance_ramp=ramp).check()


def test_policy_and_critic_have_rates_of_their_own():
    t = trainer(critic_learning_rate=7e-3, min_learning_rate=((0.0, 3e-3),))
    t.iterate()
    rates = [group["lr"] for group in t.ppo.optimizer.param_groups]
    assert rates[0] == t.ppo.learning_rate >= 3e-3 and rates[1] == 7e-3
    mine = {id(p) for p in t.ppo.actor.parameters()}
    assert {id(p) for p in t.ppo.optimizer.param_groups[0]["params"]} == mine
    assert t.ppo.log_std not in t.ppo.optimizer.state  # it follows the schedule alone


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("std_legs", ((6.0, 0.1), (4.0, 0.1)), "6 0.1 4 0.1: valid: control steps from 0 on that rise"),
        ("std_legs", ((0.0, 0.1), (4.0, 0.0)), "0 0.1 4 0: valid: .* a value above 0"),
        ("std_arm", ((-1.0, 0.1),), "-1 0.1: valid: control steps from 0 on"),
        ("desired_kl", (), ": valid: control steps"),
    ],
)
def test_noise_that_cannot_be_is_refused(name, value, words):
    with pytest.raises(TrainingError, match=f"--{name.replace('_', '-')} {words}"):
        replace(TINY, **{name: value}).check()


@pytest.mark.parametrize("method", ["no_latent", "cenet", "transformer_gru", "oracle"])
def test_the_evaluation_takes_the_same_actions(method, tmp_path):
    """Without noise, the checkpoint in the bench commands what the trained networks command in training."""
    t = trainer(method=method)
    for _ in range(2):
        t.iterate()
    path = tmp_path / "trained.safetensors"
    t.write_checkpoint(path, 1.0)

    protocol, _ = find_protocol("ablation_v1")
    episodes = msgspec.structs.replace(protocol.episodes, horizon=1.0)
    protocol = msgspec.structs.replace(protocol, noise=Noise(), push=Push(), episodes=episodes)
    env = Environment(protocol, CpuBackend(protocol, 4, 1), TARGETS, "gated", 7)
    target = sample_episodes(protocol, TARGETS, 4, stream(7, "training start", 0)).target  # what it has drawn
    start = sample_episodes(protocol, TARGETS, 4, stream(7, "training start", 0)).reset
    episode = env._episode
    episode.d_ref[:] = 2 * env._derived.pos_error + env._derived.rot_error
    episode.step[:], episode.decay[:] = 0, protocol.reference_decay

    env.observations = env._observe()  # of a new episode
    history, state = History(env.observations.frame), torch.zeros(4, t.estimator.state_dim)
    env.begin_rollout(0, 25)
    expected = []
    with torch.no_grad():
        for _ in range(25):
            context = env.observations.critic[:, PRIVILEGED_COLUMNS]
            if method != "oracle":
                context, state = t.estimator.step(history.window, state)
            groups = {"policy": env.observations.policy, "context": context}
            action = t.ppo.actor(TensorDict(groups, batch_size=[4]))
            expected.append(action)
            env.step(action)
            history.push(env.observations.frame)

    controller = load_controller(f"learned:{path}", load_robot(protocol.robot))
    found = rollout(controller, protocol, manifest_of(start, target))
    lasted = min(25, int(found.steps.min()))
    assert lasted > 10
    np.testing.assert_allclose(
        found.action[:, :lasted], torch.stack(expected, 1)[:, :lasted].numpy(), atol=2e-4, rtol=0
    )


@pytest.mark.parametrize("start", [0.0, 5e6])
def test_auxiliary_losses_keep_pace_with_the_noise_wherever_a_run_starts(start):
    """A run that begins at little noise has the rates of a long one whose noise has fallen to it."""
    fallen = replace(TINY, std_legs=((start, 0.27), (10e6, 0.09)))
    little = replace(TINY, std_legs=((0.0, 0.09),))
    assert fallen.pace(0) == 1.0 and fallen.pace(10_000_000) == pytest.approx(
        little.pace(0)
    ) == pytest.approx(1 / 3)
    assert replace(TINY, std_legs=((0.0, 0.4),)).pace(0) == 1.0  # never beyond the rates that were found


# ---- files -----------------------------------------------------------------------------------------------


def test_a_run_leaves_metrics_and_goes_on(tmp_path):
    """Every reward term is logged; a longer budget goes on; other settings are refused by name."""
    folder = RunFolder(tmp_path / TINY.name)
    schedules = {
        "std_legs": ((0.0, 0.27), (150.0, 0.05)),
        "curriculum": 150.0,
        "disturbance_ramp": (48.0, 144.0),
    }
    config = replace(TINY, **schedules)  # which do not know the budget
    run(replace(config, budget=2 * 48), folder, tensorboard=False)
    assert is_done(folder, replace(config, budget=96)) and not is_done(folder, config)
    with folder.metrics.open("a") as file:
        file.write('{"iteration": 3, "samp')  # as a kill would leave it
    run(config, folder)
    rows = folder.read_metrics()
    assert [row["iteration"] for row in rows] == [1, 2, 3, 4]
    assert [row["samples"] for row in rows] == [48, 96, 144, 192]
    from wbc_baselines.learned.training.rewards import SCALES

    assert {f"reward/{name}" for name in SCALES} <= rows[0].keys()
    assert any((folder.path / "tensorboard").iterdir())
    assert not folder.claim.exists()
    unbroken = trainer(**schedules)
    while not unbroken.done:
        unbroken.iterate()
    resumed = trainer(**schedules)
    runs.load_resume(resumed, folder)
    assert_equal(unbroken.save(), resumed.save())
    assert checkpoint.load(folder.checkpoint).card.samples == 192
    with pytest.raises(TrainingError, match=r"gamma 0\.99 -> 0\.9"):
        run(replace(config, gamma=0.9), folder)


def test_checkpoints_that_are_kept_can_be_averaged(tmp_path):
    folder = RunFolder(tmp_path / TINY.name)
    run(replace(TINY, budget=4 * 48), folder, tensorboard=False, keep_every=2 * 48)
    kept = [folder.kept(samples) for samples in (96, 192)]
    assert sorted(folder.path.glob("kept/*.safetensors")) == sorted(kept)
    assert [checkpoint.load(path).card.samples for path in kept] == [96, 192]
    assert kept[1].read_bytes() == folder.checkpoint.read_bytes()
    average(kept, tmp_path / "mean.safetensors")
    assert len(checkpoint.load(tmp_path / "mean.safetensors").card.mean_of) == 2


def test_a_killed_run_resumes(tmp_path):
    """SIGKILL at any moment leaves a folder that the same command finishes."""
    code = (
        "import sys; from pathlib import Path; from wbc_baselines.learned.training import run_folder as runs;"
        "from wbc_baselines.learned.training.config import TrainConfig; runs.CHECKPOINT_PERIOD = 0.0;"
        f"runs.run(TrainConfig(**{asdict(replace(TINY, budget=1e9))}), runs.RunFolder(Path(sys.argv[1])),"
        "tensorboard=False)"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)], env=os.environ | {"OMP_NUM_THREADS": "1"}
    )
    folder = RunFolder(tmp_path)
    deadline = time.monotonic() + 600  # on a busy machine
    while len(folder.read_metrics()) < 3 and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    done = len(folder.read_metrics())
    assert done >= 3 and folder.claim.exists()
    config = replace(TINY, budget=48 * (done + 2))
    run(config, folder, tensorboard=False)
    assert [row["iteration"] for row in folder.read_metrics()] == list(range(1, done + 3))


def test_a_damaged_configuration_is_one_line(tmp_path):
    folder = RunFolder(tmp_path)
    folder.config.write_text('{"method": "no_la')
    with pytest.raises(TrainingError, match=r"config\.json' is damaged"):
        run(TINY, folder, tensorboard=False)


@pytest.mark.parametrize(
    "text", [b"[" * 100_000, b"[1]", b"1", b"\xff"], ids=["nested", "list", "number", "bytes"]
)
def test_a_configuration_that_is_no_configuration_is_one_line(tmp_path, text):
    folder = RunFolder(tmp_path)
    folder.config.write_bytes(text)
    with pytest.raises(TrainingError, match=r"config\.json' is damaged"):
        run(TINY, folder, tensorboard=False)


def test_the_status_of_damaged_folders(tmp_path, capsys):
    """What is no row is left out, what is no run is not listed, and a damaged note is one line."""
    folder = RunFolder(tmp_path / "no_latent@0")
    folder.open(TINY)
    folder.append({"iteration": 1, "samples": 48, "seconds": 7200.0, "episode/success": 0.5})
    with folder.metrics.open("ab") as file:
        for line in (b"[1]", b"3", b'{"iteration": 2}', b'{"samples": 9}', b"[" * 100_000, b"\xff\xfe"):
            file.write(line + b"\n")
        file.write(b'{"iteration": null, "samples": 1}\n{"iteration": 2, "samples": "x"}\n')
    for name in ("moon@0", "no_latent@x", "no_latent@", "@0"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.json").write_text("{}")
        (tmp_path / name / "metrics.jsonl").write_text('{"iteration": 1, "samples": 1}\n')
    main(["status", "--out", str(tmp_path)])
    told = capsys.readouterr().out
    assert "| no_latent@0 | interrupted | 0.0 | 2.00 | 50.0 |  |" in told and "moon" not in told
    assert [s.name for s in standing(tmp_path)] == ["no_latent@0"]
    assert len(write_curves(tmp_path, tmp_path / "figures")) == 2
    folder.finished.write_text('{"samples": "many"}')
    with pytest.raises(TrainingError, match=r"finished\.json' is damaged"):
        is_done(folder, TINY)
    folder.metrics.unlink()
    folder.metrics.mkdir()
    with pytest.raises(SystemExit) as stopped:
        main(["status", "--out", str(tmp_path)])
    told = capsys.readouterr().err
    assert stopped.value.code == 2 and told.count("\n") == 1 and "metrics.jsonl' is not a file" in told


@pytest.mark.parametrize("text", [b"", b"PK\x03\x04", b"\x80\x02."])
def test_a_resume_file_that_is_none_is_one_line(tmp_path, text):
    folder, t = RunFolder(tmp_path / TINY.name), trainer()
    folder.open(TINY)
    folder.resume.write_bytes(text)
    with pytest.raises(TrainingError, match=r"resume file .*resume\.pt' is damaged") as caught:
        runs.load_resume(t, folder)
    assert "\n" not in str(caught.value)
    torch.save([1, 2], folder.resume)
    with pytest.raises(TrainingError, match=r"resume\.pt' is damaged"):
        runs.load_resume(t, folder)
    torch.save({"seconds": 1.0}, folder.resume)
    with pytest.raises(TrainingError, match="of another version of the code"):
        runs.load_resume(t, folder)


def test_claims(tmp_path):
    """One process at a time; a dead process's claim and a stale one are taken over."""
    one, two = RunFolder(tmp_path), RunFolder(tmp_path)
    assert one.take() and not two.take()
    one.release()
    assert two.take()
    dead = subprocess.Popen(["true"])
    dead.wait()
    one.claim.write_text(one.claim.read_text().split()[0] + f" {dead.pid}")
    assert one.take()
    # a container that is started again: the same number, another process
    one.claim.write_text(f"{socket.gethostname()} {os.getpid()} 1")
    assert two.take()
    one.claim.write_text("elsewhere 1")
    assert not two.take()
    os.utime(one.claim, (0, 0))
    assert two.take()


def episode_of(saved: dict) -> dict:
    return saved["episodes"]["environment"]["episode"]


@pytest.mark.parametrize(
    "change",
    [
        lambda saved: episode_of(saved).pop("stratum"),
        lambda saved: episode_of(saved).update(old=torch.zeros(1)),
        lambda saved: saved.update(settings=saved.pop("config")),  # as files before 0.1.0 call it
    ],
)
def test_a_resume_file_of_another_version_is_one_line(tmp_path, change):
    t, folder = trainer(), RunFolder(tmp_path / TINY.name)
    folder.open(TINY)
    runs.save_resume(t, folder, 0.0)
    saved = torch.load(folder.resume)
    change(saved)
    torch.save(saved, folder.resume)
    with pytest.raises(TrainingError, match="is of another version of the code"):
        runs.load_resume(t, folder)


def test_a_changed_run_keeps_what_it_has_learned(tmp_path):
    """Other environments, rates and losses: networks and counters stay, episodes are new ones."""
    folder = RunFolder(tmp_path / TINY.name)
    run(replace(TINY, budget=2 * STEPS), folder, tensorboard=False)
    before = torch.load(folder.resume)
    other = replace(TINY, budget=2 * STEPS + 24, num_envs=4, learning_rate=1e-4, arm_ik_loss=(0.0, 1e6))
    with pytest.raises(
        TrainingError, match=r"num_envs 8 -> 4, learning_rate 0.0003 -> 0.0001, .*or --change"
    ):
        folder.open(other)
    folder.open(other, change=True)
    (row,) = map(json.loads, folder.changes.read_text().splitlines())
    assert row["samples"] == 2 * STEPS and row["changed"]["num_envs"] == [8, 4]
    folder.open(other, change=True)  # nothing is new any more
    assert len(folder.changes.read_text().splitlines()) == 1
    t = Trainer(other, make_environment(other))
    runs.load_resume(t, folder)
    assert (t.iteration, t.samples, t.done) == (2, 2 * STEPS, False)
    assert_equal(t.ppo.save()["actor_state_dict"], before["ppo"]["actor_state_dict"])
    assert_equal(t.ppo.save()["critic_state_dict"], before["ppo"]["critic_state_dict"])
    # a kill before the first save leaves the same to go on with: the same draws, not those of the beginning
    again = Trainer(other, make_environment(other))
    fresh = again.environment.save()
    runs.load_resume(again, folder)
    assert_equal(t.save(), again.save())
    assert not torch.equal(
        fresh["episode"]["target_pos_w"], t.save()["episodes"]["environment"]["episode"]["target_pos_w"]
    )
    run(other, folder, tensorboard=False)
    assert [r["samples"] for r in folder.read_metrics()] == [STEPS, 2 * STEPS, 2 * STEPS + 24]
    with pytest.raises(TrainingError, match=r"seed 0 -> 1; .*but for method, seed, protocol"):
        folder.open(replace(other, seed=1), change=True)
    folder.claim.write_text("elsewhere 1")
    files = folder.config.read_bytes(), folder.changes.read_bytes()
    with pytest.raises(TrainingError, match="is being trained by elsewhere"):
        run(replace(other, gamma=0.9), folder, change=True)
    assert files == (folder.config.read_bytes(), folder.changes.read_bytes())


def test_what_a_kill_has_lost_is_no_longer_read(tmp_path):
    folder = RunFolder(tmp_path)
    for iteration, samples in ((1, 10), (2, 20), (3, 30), (2, 15)):  # 2 and 3 came after the last resume file
        folder.append({"iteration": iteration, "samples": samples})
    assert [row["samples"] for row in folder.read_metrics()] == [10, 15]


def test_a_damaged_resume_file_is_one_line(tmp_path):
    t, folder = trainer(), RunFolder(tmp_path / TINY.name)
    folder.open(TINY)
    runs.save_resume(t, folder, 0.0)
    folder.resume.write_bytes(folder.resume.read_bytes()[:1000])
    with pytest.raises(TrainingError, match="cannot be read"):
        runs.load_resume(t, folder)


def test_smoothing_weighs_by_episodes():
    """A moving mean over 3 % of the samples: neighbours far apart stay apart, equal samples pool."""
    rows = [
        {"samples": s, "x": x, "episode/count": n} for s, x, n in ((1, 0.0, 1), (100, 1.0, 3), (101, 0.0, 1))
    ]
    samples, values = smooth(rows, "x")
    np.testing.assert_allclose(samples, [1, 100, 101])
    np.testing.assert_allclose(values, [0, 0.75, 0.75])


def test_rewards_of_different_scales_have_axes_of_their_own():
    """And a policy has the name and the colour that it has in the figures of the study."""

    def run(name: str, best: float) -> tuple[str, list[dict]]:
        values = {"episode/success": 0.5, "episode/falls": 0.1, "episode/pos_error": 0.02, "episode/count": 4}
        return name, [{"samples": s, "episode/return": best * s, **values} for s in (1, 2)]

    runs = [
        run("transformer_gru@0", 1.0),
        run("transformer_gru@1", 1.1),
        run("transformer_gru_additive@0", 9.0),
    ]
    drawn = [ax for ax in curves_figure(runs).axes if ax.get_lines()]
    gated, additive, *others = drawn
    assert "gated" in gated.get_ylabel() and "additive" in additive.get_ylabel()
    assert [len(ax.get_lines()) for ax in drawn] == [2, 1, 3, 3, 3]
    highest = [float(np.max(np.asarray(ax.get_lines()[0].get_ydata()))) for ax in (gated, additive)]
    assert highest == [2.0, 18.0]
    for ax in others:
        assert [line.get_color() for line in ax.get_lines()] == [SKY, SKY, GREEN]
    (one, *rest) = curves_figure(runs[:2]).axes
    assert len(rest) == 3 and "gated" in one.get_ylabel()


def test_methods_are_called_what_the_study_calls_them():
    labels = labels_of(released_rows())
    for name, method in METHODS.items():
        assert labels[f"learned:{name}"] == method.label


def test_the_scores_are_means_where_their_gate_is_open():
    """Of g = 0.25, (1 - g) s_m = 0.9 and g s_l = 0.3 on average: 1.2 and 1.2."""
    early = {"gate/phase": 1.0, "gate/manipulation": 0.0, "gate/reference": 9.0}
    late = [
        {"gate/phase": phase, "gate/manipulation": m, "gate/reference": ref}
        for phase, m, ref in ((0.2, 1.0, 0.2), (0.3, 0.8, 0.4))
    ]
    np.testing.assert_allclose(measured_scores([*[early] * 18, *late]), (0.25, 1.2, 1.2))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"num_envs": 0}, "--num-envs 0"),
        ({"num_mini_batches": 49}, "1 to 48"),
        ({"estimator_mini_batches": 5}, "1 to 4"),
        ({"estimator_share": 0.125}, r"share 0\.125\): give --estimator-mini-batches 1"),
    ],
)
def test_impossible_settings_are_refused(changes, words):
    with pytest.raises(TrainingError, match=words):
        replace(TINY, **changes).check()


@pytest.mark.parametrize(("num_envs", "updates"), [(8, 1), (16, 2), (768, 4)])
def test_the_defaults_fit_any_number_of_environments(num_envs, updates):
    config = TrainConfig("transformer_gru", num_envs=num_envs)
    config.check()
    assert config.estimator_updates == updates
    stored = asdict(config) | {"estimator_mini_batches": updates}  # of a run that was given the number
    assert not config.changes(stored)


def test_mistakes_name_the_valid_values():
    with pytest.raises(UnknownNameError, match="no_latent"):
        replace(TINY, method="no_latnt").check()
    with pytest.raises(TrainingError, match=r"0\.02 s"):
        make_environment(replace(TINY, timestep=0.01, decimation=3))


def test_the_command_line(tmp_path, capsys, monkeypatch):
    """`wbc-train run`, changed, `status`; a mistake is one line and code 2."""
    options = [
        "--budget",
        "4.8e1",
        "--num-envs",
        "8",
        "--num-steps-per-env",
        "6",
        "--num-mini-batches",
        "2",
        "--threads",
        "1",
    ]
    options += ["--estimator-share", "0.5", "--out", str(tmp_path)]

    def interrupted(_):
        raise KeyboardInterrupt

    main(["run", "--method", "no_latent", *options])
    more = [
        "run",
        "--method",
        "no_latent",
        *options,
        "--budget",
        "9.6e1",
        "--num-learning-epochs",
        "1",
        "--change",
    ]
    with monkeypatch.context() as patched:
        patched.setattr(Trainer, "iterate", interrupted)
        with pytest.raises(SystemExit):
            main(more)
    main(["status", "--out", str(tmp_path)])
    assert "interrupted" in capsys.readouterr().out  # not done, at the larger budget
    main(more)
    main(["run", "--method", "oracle", *options])
    main(["status", "--out", str(tmp_path)])
    told = capsys.readouterr().out
    assert all(name in told for name in ("no_latent@0", "oracle@0", "done"))
    assert RunFolder(tmp_path / "no_latent@0").read_metrics()[-1]["samples"] == 96
    with pytest.raises(SystemExit) as stopped:
        main(["run", "--method", "oracel", *options])
    error = capsys.readouterr().err
    assert stopped.value.code == 2 and "oracle" in error and error.count("\n") == 1


def test_advantages_by_hand():
    """Sums of discounted TD errors, that end with an episode, and before a push."""
    rewards = torch.tensor([[1.0], [2.0], [3.0]])
    values = torch.tensor([[10.0], [20.0], [30.0], [40.0]])
    no = torch.zeros(3, 1, dtype=torch.bool)
    # deltas with gamma 0.5: 1 + 10 - 10 = 1, 2 + 15 - 20 = -3, 3 + 20 - 30 = -7; factor 0.5 * 0.8 = 0.4
    found = generalized_advantages(rewards, values, no, no, 0.5, 0.8)
    assert found[:, 0].tolist() == pytest.approx([1 + 0.4 * (-3 + 0.4 * -7), -3 + 0.4 * -7, -7])
    done = torch.tensor([[False], [True], [False]])  # at 1: 2 - 20 = -18, and nothing from 2 on
    assert generalized_advantages(rewards, values, done, no, 0.5, 0.8)[:, 0].tolist() == pytest.approx(
        [1 + 0.4 * -18, -18, -7]
    )
    pushed = torch.tensor([[False], [True], [False]])
    assert generalized_advantages(rewards, values, no, pushed, 0.5, 0.8)[:, 0].tolist() == pytest.approx(
        [1, 0, -7]
    )


def test_advantages_without_pushes_are_rsl_rls():
    """A second implementation: with one lambda and no push the two agree; the critic's targets always do."""
    one = trainer(push_interval=(50.0, 60.0), actor_lam=0.95)
    ends = trainer(push_interval=(50.0, 60.0), actor_lam=0.5)
    for each in (one, ends):
        torch.manual_seed(0)
        each.environment.begin_rollout(0, each.config.num_steps_per_env)
        _, pushed = each.collect_rollout()
        each.ppo.compute_advantages(each._observations(), pushed)
    storage = one.ppo.storage
    expected = storage.returns - storage.values
    torch.testing.assert_close(storage.advantages, (expected - expected.mean()) / (expected.std() + 1e-8))
    torch.testing.assert_close(ends.ppo.storage.returns, storage.returns)
    assert (ends.ppo.storage.advantages - storage.advantages).abs().max() > 1e-2


def test_the_bench_times_the_engine_and_leaves_it_as_it_was():
    config = replace(TINY, init_checkpoint="oracle@0")
    fast, slow = measure(config, ("no_latent", "cenet"), rounds=2, episodes=2)
    for found in (fast, slow):
        assert 0.0 < found.training < 1.0
        assert found.training == pytest.approx(found.steps / found.physics)  # of a single round
    assert fast.evaluation is not None and 0.0 < fast.evaluation < 1.0
    assert slow.evaluation is None  # no such policy ships
    assert cpu.Batch is simulation.Batch is Batch


def test_products_are_fast_inside_only():
    before = torch.get_float32_matmul_precision()
    with pytest.raises(ZeroDivisionError), fast_products(torch.device("cpu")):
        assert torch.get_float32_matmul_precision() == "medium"
        raise ZeroDivisionError
    assert torch.get_float32_matmul_precision() == before
    t = trainer()
    t.iterate()
    assert torch.get_float32_matmul_precision() == before


def test_a_gradient_of_fast_products_points_where_the_exact_one_does():
    """PPO's first gradient for the same rollout, in bfloat16 where the processor has it."""
    gradients = []
    for context in (fast_products, nullcontext):
        t, found = trainer(method="oracle", num_envs=64), []
        t.environment.begin_rollout(0, TINY.num_steps_per_env)
        _, pushed = t.collect_rollout()
        t.ppo.compute_advantages(t._observations(), pushed)

        def keep(*_, actor=t.ppo.actor, found=found) -> None:
            rows = [p.grad.flatten().clone() for p in actor.mlp.parameters() if p.grad is not None]
            found.append(torch.cat(rows))

        t.ppo.optimizer.register_step_pre_hook(keep)
        storage = t.ppo.storage
        with context(t.device):
            with torch.no_grad():  # the rollout's own are of fast products: a ratio of 1 for both
                t.ppo.actor(storage.observations.flatten(0, 1), stochastic_output=True)
                old = t.ppo.actor.get_output_log_prob(storage.actions.flatten(0, 1))
                storage.actions_log_prob[:] = old.reshape(storage.actions_log_prob.shape)
            torch.manual_seed(1)
            t.ppo.update()
        gradients.append(found[0])
    assert torch.nn.functional.cosine_similarity(*gradients, dim=0) > 0.99
