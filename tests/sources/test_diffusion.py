"""Doors pushed shut: scene, demonstrations, diffusion against closed forms, training, closed loop."""

import json
import zipfile
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
import zarr

from commands import fails
from wbc_bench.cli.main import main
from wbc_bench.episodes.single import door_protocol, episode_of
from wbc_bench.errors import SourceError, StoreError
from wbc_bench.evaluation import doors as demo
from wbc_bench.evaluation.simulation import Simulation
from wbc_bench.evaluation.tracking import track
from wbc_bench.registry import load_controller
from wbc_bench.results.doors import door_table, read_doors
from wbc_bench.robot import build_spec, load_robot
from wbc_bench.rotations import matrix_from_rotvec
from wbc_bench.sources import Seen, load_source
from wbc_bench.sources.diffusion import demonstrations, denoising, poses, training
from wbc_bench.sources.diffusion.demonstrations import (
    Demonstration,
    read_demonstrations,
    write_demonstrations,
)
from wbc_bench.sources.diffusion.expert import ExpertSource
from wbc_bench.sources.diffusion.policy import (
    ACTION,
    HORIZON,
    LOOK,
    LOOKS,
    DoorPolicyCard,
    Policy,
    load_policy,
    save_policy,
)
from wbc_bench.sources.diffusion.scene import CLOSED, GRIP, STANDOFF, Door, DoorScene, draw_door
from wbc_bench.sources.diffusion.source import DiffusionSource
from wbc_bench.sources.registry import POLICY
from wbc_bench.sources.slew import Pose

DOOR = Door(x=0.68, y=0.1, z=1.1, yaw=0.1, angle=0.6)


def random_poses(rng: np.random.Generator, *shape: int) -> Pose:
    return Pose(rng.normal(size=(*shape, 3)), matrix_from_rotvec(rng.normal(size=(*shape, 3))))


def demonstration(seed: int = 0, steps: int = 60) -> Demonstration:
    """A hand that goes straight to where a closing door is pushed; numbers, no physics."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0.5 + 0.1 * rng.uniform(), 0.0, steps)
    part = np.linspace(0.0, 1.0, steps)[:, None]
    goal = DOOR.hand(0.0)
    pos = np.array([0.4, 0.0, 1.15]) + 0.02 * rng.normal(size=3)
    ee = Pose(pos + part * (goal.pos - pos), np.tile(goal.rot, (steps, 1, 1)))
    panels = [DOOR.panel(a) for a in angle]
    panel = Pose(np.stack([p.pos for p in panels]), np.stack([p.rot for p in panels]))
    return Demonstration(ee, Pose(ee.pos + 0.01, ee.rot), panel, angle)


def seen_at(hand: Pose) -> Seen:
    return Seen(hand.pos, hand.rot, np.array([0.0, 0.0, 0.84]), np.eye(3), np.zeros(3))


def card(**changed) -> DoorPolicyCard:
    facts = {"format": 1, "seed": 0, "demonstrations": 1, "demonstrations_seed": 0, "samples": 1, "steps": 1}
    facts |= {"demonstrations_sha256": "0" * 64, "batch": 1, "hidden": 16, "git_commit": None}
    return DoorPolicyCard(**facts | {"git_dirty": False, "torch": "0"} | changed)  # pyright: ignore[reportArgumentType]


# the scene


def test_the_scene_leaves_the_robot_as_it_is() -> None:
    """Without it the model is what it was, byte for byte; with it, the robot's part is."""

    def bytes_of(model: mujoco.MjModel) -> bytes:
        buffer = np.zeros(mujoco.mj_sizeModel(model), dtype=np.uint8)
        mujoco.mj_saveModel(model, None, buffer)
        return buffer.tobytes()

    robot = load_robot()
    plain = build_spec(robot.facts, robot.config).compile()
    furnished = robot.model(scene=DoorScene(DOOR))
    assert bytes_of(robot.model()) == bytes_of(plain) and plain.nq == 21
    assert furnished.nq == 22 and furnished.nu == 14
    for name in (
        "body_mass",
        "body_inertia",
        "body_pos",
        "geom_size",
        "geom_pos",
        "geom_contype",
        "jnt_range",
    ):
        own = getattr(plain, name)
        np.testing.assert_array_equal(getattr(furnished, name)[: len(own)], own)
    np.testing.assert_array_equal(furnished.qpos0[:21], plain.qpos0)
    assert furnished.qpos0[21] == DOOR.angle


def test_the_panel_is_where_the_door_says() -> None:
    """Frames of the formulas against those of MuJoCo, at the opening angle and elsewhere."""
    model = load_robot().model(scene=DoorScene(DOOR))
    data = mujoco.MjData(model)
    for angle in (DOOR.angle, 0.0, 1.2):
        data.qpos[:] = model.qpos0
        data.qpos[21] = angle
        mujoco.mj_kinematics(model, data)
        pos, rot = DOOR.panel(angle)
        np.testing.assert_allclose(data.body("door").xpos, pos, atol=1e-12)
        np.testing.assert_allclose(data.body("door").xmat.reshape(3, 3), rot, atol=1e-12)
        face = data.geom("door").xpos - rot[:, 0] * model.geom("door").size[0]  # middle of the outer face
        touch = DOOR.hand(angle)
        assert abs((touch.pos - face) @ rot[:, 0]) < 1e-12
        assert np.linalg.norm(touch.pos - pos) == pytest.approx(GRIP)


def test_a_door_that_is_left_alone_stays_open() -> None:
    protocol, row = episode_of(1.0, 0, "nominal")
    simulation = Simulation(protocol, row, DoorScene(DOOR))
    hold = simulation.robot.default_q[None]
    for _ in range(25):
        simulation.step(hold, np.ones(1, dtype=bool))
    assert simulation.scenery[0] == pytest.approx([DOOR.angle], abs=1e-3)
    assert simulation.state().joint_pos.shape == (1, 14)


def test_doors_depend_on_seed_and_number_alone() -> None:
    protocol = door_protocol(0)
    doors = [draw_door(protocol, 3, k) for k in range(4)]
    assert draw_door(protocol, 3, 2) == doors[2] and len(set(doors)) == 4
    assert draw_door(protocol, 4, 2) != doors[2]
    hand = np.array([0.391, 0.0, 1.152])
    for door in doors:
        pos, rot = door.panel(door.angle)
        assert -(hand - pos) @ rot[:, 0] > STANDOFF - 2e-3


def test_the_expert_begins_at_the_hand_and_keeps_to_the_arc() -> None:
    expert, hand = ExpertSource(DOOR), Pose(np.array([0.39, 0.0, 1.15]), np.eye(3))
    seen = seen_at(hand)
    expert.reset(seen)
    np.testing.assert_allclose(expert.target(0.0, seen).pos, hand.pos)
    hinge = np.array([DOOR.x, DOOR.y])
    start, arc = expert.path.pieces[0].duration + expert.path.pieces[1].duration, expert.path.pieces[2]
    for time in np.linspace(start, start + arc.duration, 7):
        radius = np.linalg.norm(expert.target(float(time), seen).pos[:2] - hinge)
        assert radius == pytest.approx(np.hypot(GRIP, 0.015))
    last = expert.target(60.0, seen).pos
    assert (DOOR.panel(0.0).pos - last) @ DOOR.panel(0.0).rot[:, 0] == pytest.approx(0.12)


# poses


def test_relative_poses_and_their_numbers_come_back() -> None:
    rng = np.random.default_rng(0)
    pose, base = random_poses(rng, 5), random_poses(rng, 5)
    for back, expected in (
        (poses.absolute(poses.relative(pose, base), base), pose),
        (poses.pose_of(poses.numbers(pose)), pose),
        (poses.hand(poses.tool(pose)), pose),
    ):
        np.testing.assert_allclose(back.pos, expected.pos, atol=1e-12)
        np.testing.assert_allclose(back.rot, expected.rot, atol=1e-12)
    here = poses.numbers(poses.relative(pose, pose))
    np.testing.assert_allclose(here, np.tile([0, 0, 0, 1, 0, 0, 0, 1, 0], (5, 1)), atol=1e-12)


def test_six_numbers_are_the_first_two_rows() -> None:
    rot = random_poses(np.random.default_rng(1)).rot
    np.testing.assert_array_equal(poses.numbers(Pose(np.zeros(3), rot))[3:], rot[:2].ravel())
    stretched = poses.pose_of(np.concatenate([np.zeros(3), 3 * rot[0], rot[1] + 0.2 * rot[0]]))
    np.testing.assert_allclose(stretched.rot, rot, atol=1e-12)


def test_the_tool_frame_is_that_of_umi() -> None:
    rot = poses.tool(Pose(np.zeros(3), np.eye(3))).rot  # columns: axes of the tool in the hand's
    np.testing.assert_array_equal(rot.T, [[0, -1, 0], [0, 0, -1], [1, 0, 0]])  # x right, y down, z forward


# diffusion


def test_the_schedule_falls_from_signal_to_noise() -> None:
    part = denoising.signal()
    assert part[0] == 1.0 and part[-1] < 1e-3 and bool((part.diff() < 0).all())
    s, half = 0.008, denoising.STEPS // 2
    curve = [np.cos((t / denoising.STEPS + s) / (1 + s) * np.pi / 2) ** 2 for t in (half, 0)]
    assert float(part[half]) == pytest.approx(curve[0] / curve[1], rel=1e-4)


def test_sampling_one_point_ends_there() -> None:
    """All data in one point: the best denoiser says so, whatever it is shown."""
    point = torch.tensor([[0.3, -0.7]])
    found = denoising.sample(lambda noisy, *_: point.expand_as(noisy), torch.randn(6, 2), torch.zeros(6, 0))
    torch.testing.assert_close(found, point.expand(6, 2))


def test_sampling_a_gaussian_is_of_first_order() -> None:
    """N(m, v): E[x0 | x] is linear, and the deterministic flow maps a noise z to m + sqrt(v) z.

    Half the step, half the error. Source: Song et al. 2021, section 4.3 (DDIM is an Euler method).
    """
    mean, variance = 0.1, 0.2
    part = denoising.signal()

    def best(noisy, step, _):
        a = part[step][:, None]
        gain = a.sqrt() * variance / (a * variance + 1 - a)
        return mean + gain * (noisy - a.sqrt() * mean)

    noise = torch.linspace(-1, 1, 9)[:, None]
    exact = mean + variance**0.5 * noise
    coarse, fine = (
        float((denoising.sample(best, noise, torch.zeros(9, 0), count) - exact).abs().max())
        for count in (50, 100)
    )
    assert fine / coarse == pytest.approx(0.5, abs=0.03) and fine < 0.01


def test_noise_has_the_variance_of_the_schedule() -> None:
    step = torch.full((20000,), 40)
    noise = torch.randn((20000, 1), generator=torch.Generator().manual_seed(0))
    x = denoising.noised(torch.full_like(noise, 0.5), noise, step)
    part = float(denoising.signal()[40])
    assert float(x.mean()) == pytest.approx(0.5 * part**0.5, abs=0.02)
    assert float(x.var()) == pytest.approx(1 - part, rel=0.03)


# demonstrations


def test_the_layout_is_that_of_umi(tmp_path: Path) -> None:
    path, episodes = tmp_path / "d.zarr.zip", [demonstration(0, 60), demonstration(1, 45)]
    write_demonstrations(path, episodes, {"control_period": 0.02})
    root = zarr.open_group(zarr.storage.ZipStore(path, mode="r"), mode="r", zarr_format=2)
    ends = np.asarray(root["meta/episode_ends"])
    np.testing.assert_array_equal(ends, [60, 105])
    assert ends.dtype == np.int64
    for name, (columns, kind) in demonstrations.LAYOUT.items():
        array = np.asarray(root[f"data/{name}"])
        assert array.shape == (105, columns) and array.dtype == np.dtype(kind), name
    start = np.asarray(root["data/robot0_demo_start_pose"])
    assert (start[:60] == start[0]).all() and (start[60:] == start[60]).all()
    np.testing.assert_allclose(start[60, :3], np.asarray(root["data/robot0_eef_pos"])[60], atol=1e-6)
    metadata = json.loads(zipfile.ZipFile(path).read("data/robot0_eef_pos/.zarray"))
    assert metadata["zarr_format"] == 2 and metadata["compressor"] is None


def test_demonstrations_come_back(tmp_path: Path) -> None:
    path, episodes = tmp_path / "d.zarr.zip", [demonstration(0), demonstration(1)]
    write_demonstrations(path, episodes, {"seed": 4})
    found = read_demonstrations(path)
    assert found.attributes == {"seed": 4}
    for wrote, read in zip(episodes, found.episodes, strict=True):
        np.testing.assert_allclose(read.angle, wrote.angle, atol=1e-6)
        for name in ("ee", "target", "panel"):
            np.testing.assert_allclose(getattr(read, name).pos, getattr(wrote, name).pos, atol=1e-6)
            np.testing.assert_allclose(getattr(read, name).rot, getattr(wrote, name).rot, atol=1e-6)


def damaged(path: Path, how: str) -> Path:
    data = path.read_bytes()
    if how == "truncated":
        path.write_bytes(data[: len(data) // 2])
    elif how == "flipped":
        middle = data.index(b"data/action/0.0") + 40
        path.write_bytes(data[:middle] + bytes([data[middle] ^ 0xFF]) + data[middle + 1 :])
    elif how == "text":
        path.write_text("no zip")
    else:
        with zipfile.ZipFile(path) as archive:
            kept = {name: archive.read(name) for name in archive.namelist()}
        with zipfile.ZipFile(path, "w") as archive:
            for name, value in kept.items():
                if how == "without an array" and name.startswith("data/door_state"):
                    continue
                if how == "not finite" and name == "data/action/0.0":
                    value = np.full(len(value) // 4, np.nan, "<f4").tobytes()
                if how == "ends" and name == "meta/episode_ends/0":
                    value = np.array([70], "<i8").tobytes()
                archive.writestr(name, value)
    return path


@pytest.mark.parametrize(
    "how", ["truncated", "flipped", "text", "without an array", "not finite", "ends", "missing"]
)
def test_broken_demonstrations_are_one_line(capsys, tmp_path: Path, how: str) -> None:
    path, out = tmp_path / "d.zarr.zip", tmp_path / "policy.safetensors"
    if how != "missing":
        write_demonstrations(path, [demonstration()], {"control_period": 0.02})
        damaged(path, how)
    line = fails(capsys, "demo", "train", path, "-o", out)
    assert str(path) in line and not out.exists()


def test_nothing_to_write_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no demonstration"):
        write_demonstrations(tmp_path / "d.zarr.zip", [], {})


# training and the policy's file


def test_windows_see_everything_from_the_hand() -> None:
    """The first copy is the demonstration: its actions lead from the hand to the targets."""
    episode = demonstration(steps=40)
    data = training.windows([episode], 0.02, np.random.default_rng(0))
    assert data.looks.shape == (40 * training.COPIES, LOOKS * LOOK)
    assert data.chunks.shape == (40 * training.COPIES, HORIZON * ACTION)
    chunk = data.chunks[10].double().numpy().reshape(HORIZON, ACTION)
    base = poses.tool(Pose(episode.ee.pos[10], episode.ee.rot[10]))
    led = poses.hand(poses.absolute(poses.pose_of(chunk[:, : poses.POSE]), base))
    at = np.minimum(10 + 5 * np.arange(HORIZON), 39)
    np.testing.assert_allclose(led.pos, episode.target.pos[at], atol=1e-6)
    displaced = data.chunks[40 + 10].double().numpy().reshape(HORIZON, ACTION)
    assert np.abs(displaced - chunk).max() > 1e-3


def test_training_reduces_the_loss_and_repeats_itself(tmp_path: Path) -> None:
    path, out = tmp_path / "d.zarr.zip", [tmp_path / name for name in ("a.safetensors", "b.safetensors")]
    write_demonstrations(path, [demonstration(k) for k in range(3)], {"control_period": 0.02, "seed": 9})
    losses: list[float] = []
    for file in out:
        policy, found = training.train(path, 1, 60, lambda _, loss: losses.append(loss))
        save_policy(file, policy, found)
    assert np.mean(losses[50:60]) < 0.3 * np.mean(losses[:5]) and losses[:60] == losses[60:]
    assert out[0].read_bytes() == out[1].read_bytes()
    _, found, digest = load_policy(out[0])
    assert (found.demonstrations, found.demonstrations_seed, found.seed, found.steps) == (3, 9, 1, 60)
    assert found.samples == 180 * training.COPIES and len(digest) == 64


@pytest.mark.parametrize("how", ["truncated", "text", "missing", "no card", "format", "hidden", "not finite"])
def test_broken_policies_are_one_line(capsys, tmp_path: Path, how: str) -> None:
    path, out = tmp_path / "policy.safetensors", tmp_path / "out"
    policy = Policy(16)
    if how == "not finite":
        policy.action_half.fill_(torch.nan)
    if how != "missing":
        changed = {"format": {"format": 99}, "hidden": {"hidden": 17}}.get(how, {})
        save_policy(path, policy, card(**changed))
    if how == "truncated":
        path.write_bytes(path.read_bytes()[:-10])
    elif how == "text":
        path.write_text("weights")
    elif how == "no card":
        from safetensors.torch import save_file

        save_file({"a": torch.zeros(1)}, path)
    for words in (("demo", "eval", path), ("track", "--controller", "hold", "--source", f"diffusion:{path}")):
        line = fails(capsys, *words, "--out", out)
        assert str(path) in line and not out.exists()


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ("extra", "it has tensors that the method does not know, more (1 in all)"),
        ("missing", "it lacks action_half (1 in all)"),
        ("shape", "wrong shape of action_half (159,), valid: (160,)"),
        ("type", "wrong type of action_half F64, valid: F32"),
        ("infinite", "not a number in action_half"),
    ],
)
def test_weights_that_are_not_the_networks_are_one_line(
    capsys, tmp_path: Path, change: str, word: str
) -> None:
    from safetensors import safe_open
    from safetensors.torch import load_file, save_file

    path = tmp_path / "policy.safetensors"
    save_policy(path, Policy(16), card())
    tensors, half = load_file(path), Policy(16).action_half
    with safe_open(path, "pt") as file:
        metadata = file.metadata()
    tensors |= {
        "extra": {"more": torch.zeros(2)},
        "shape": {"action_half": half[:-1].clone()},
        "type": {"action_half": half.double()},
        "infinite": {"action_half": half * torch.inf},
    }.get(change, {})
    if change == "missing":
        del tensors["action_half"]
    save_file(tensors, path, metadata)
    line = fails(capsys, "track", "--controller", "hold", "--source", f"diffusion:{path}", "--out", tmp_path)
    assert str(path) in line and word in line


def test_the_doors_of_the_demonstrations_are_refused(capsys, tmp_path: Path) -> None:
    path = tmp_path / "policy.safetensors"
    save_policy(path, Policy(16), card(demonstrations_seed=5))
    line = fails(capsys, "demo", "eval", path, "--seed", 5, "--out", tmp_path / "out")
    assert "trained on these doors" in line and not (tmp_path / "out").exists()


# the source


def test_a_chunk_is_followed_and_made_anew() -> None:
    """A policy that says `0.1 m ahead, k steps later`: the target moves on, from where the hand then is."""
    policy = Policy(16)
    policy.denoiser.last[-1].weight.data.zero_()  # pyright: ignore[reportArgumentType, reportCallIssue]
    policy.denoiser.last[-1].bias.data.zero_()  # pyright: ignore[reportArgumentType, reportCallIssue]
    chunk = torch.zeros(HORIZON, ACTION)
    chunk[:, 2] = 0.01 * torch.arange(HORIZON)  # along the tool's z: forward
    chunk[:, 3], chunk[:, 7] = 1.0, 1.0
    policy.action_middle.copy_(chunk.reshape(-1))
    source = DiffusionSource(policy, DOOR, seed=0)
    hand = Pose(np.array([0.4, 0.0, 1.1]), np.eye(3))
    source.look(np.array([0.5]))
    source.reset(seen_at(hand))
    forward = [source.target(0.02 * k, seen_at(hand)).pos[0] - 0.4 for k in range(60)]
    np.testing.assert_allclose(forward[:40], 0.01 * np.arange(40) * 0.02 / 0.1, atol=1e-6)
    np.testing.assert_allclose(forward[40:], forward[:20], atol=1e-6)  # 0.8 s: planned again


def test_targets_follow_the_seed() -> None:
    policy = Policy(16)

    def targets(seed: int, episode: int = 0) -> np.ndarray:
        source = DiffusionSource(policy, DOOR, seed, episode)
        source.look(np.array([0.5]))
        source.reset(seen_at(DOOR.hand(0.5)))
        return np.array([source.target(0.02 * k, seen_at(DOOR.hand(0.5))).pos for k in range(3)])

    np.testing.assert_array_equal(targets(1), targets(1))
    for other in (targets(2), targets(1, 1)):
        assert np.abs(targets(1) - other).max() > 1e-3


# the closed loop


def test_the_expert_shuts_a_door_and_the_recording_repeats_itself(capsys, tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("a.zarr.zip", "b.zarr.zip")]
    for file, workers in zip(files, (1, 2), strict=True):
        main(["demo", "record", "-o", str(file), "--episodes", "1", "--seed", "7", "--workers", str(workers)])
    assert "1 of 1 episodes closed their door" in capsys.readouterr().out
    assert files[0].read_bytes() == files[1].read_bytes()
    found = read_demonstrations(files[0])
    assert found.episodes[0].angle[0] > 0.3 and found.episodes[0].angle[-1] < CLOSED
    assert found.attributes["controller"] == "ik" and found.attributes["control_period"] == 0.02


def test_a_controller_that_does_not_follow_closes_nothing(capsys, tmp_path: Path) -> None:
    out = tmp_path / "d.zarr.zip"
    words = ["demo", "record", "-o", out, "--episodes", 2, "--controller", "hold", "--workers", 1]
    assert "closed none of 2 doors" in fails(capsys, *words) and not out.exists()
    words = ["demo", "eval", "--expert", "--controller", "hold", "--episodes", "2", "--workers", "1"]
    main([*words, "--out", str(tmp_path)])
    (run,) = read_doors(tmp_path)
    assert run.record.successes == 0 and run.record.completed == 2 and run.record.policy_sha256 is None
    assert set(run.episodes["outcome"]) <= {"fell", "illegal_contact"} and not run.episodes["success"].any()  # pyright: ignore[reportGeneralTypeIssues]
    row = dict(zip(door_table([run]).header, door_table([run]).rows[0], strict=True))
    assert row["Closed ↑"] == "0/2" and row["Falls ↓"] == "2" and (tmp_path / "tables" / "doors.md").exists()
    beside = next(tmp_path.glob("doors/*/*/*/episodes.parquet"))
    beside.write_bytes(beside.read_bytes() + b"x")
    with pytest.raises(StoreError, match="another sha256"):
        read_doors(tmp_path)


def test_the_packaged_policy_shuts_a_door() -> None:
    robot = load_robot()
    door = draw_door(door_protocol(1), 1, 0)
    source = load_source("diffusion")
    assert isinstance(source, DiffusionSource)
    again = DiffusionSource(source._policy, door, 1)
    episode = demo.run_door(load_controller("ik", robot), again, door, "nominal", 1, 0)
    assert episode.success and episode.steps == 600
    assert 0.0 < episode.first_closed < 11.0


def test_the_packaged_policy_is_small_and_the_one_of_the_record() -> None:
    _, found, digest = load_policy(POLICY)
    assert POLICY.stat().st_size < 1 << 20 and not found.git_dirty
    runs = [run.record for run in read_doors(Path(__file__).parents[2] / "results")]
    assert {run.policy_sha256 for run in runs if run.source == "diffusion"} == {digest}
    assert all(run.seed != found.demonstrations_seed for run in runs)


def test_track_stands_in_front_of_a_door() -> None:
    run, asked = track(load_controller("hold", load_robot()), load_source("diffusion"), "nominal", 0, 0.5)
    assert asked == 0.5 and np.isfinite(run.target_pos_w).all() and len(run.time) > 5


def test_more_episodes_than_a_file_holds_are_refused_before_they_are_computed(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(demo, "_run_all", lambda *_: pytest.fail("episodes were computed"))
    with pytest.raises(SourceError, match=r"2000000 episodes to record, valid: at most [0-9]+, of 1000000"):
        demo.record(tmp_path / "d.zarr.zip", "hold", 0, 2_000_000)
