"""The two back ends of training agree; skipped where mujoco_warp is not installed."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")
wp = pytest.importorskip("warp")
pytest.importorskip("mujoco_warp")

from wbc_baselines.learned.training.backends.base import ResetState
from wbc_baselines.learned.training.backends.cpu import CpuBackend
from wbc_baselines.learned.training.backends.warp import WarpBackend
from wbc_baselines.learned.training.resets import sample_episodes
from wbc_baselines.learned.training.target_set import read_target_set
from wbc_bench.episodes.protocol import find_protocol
from wbc_bench.randomness import stream
from wbc_bench.robot import load_robot


# Soon after, a corner of a sole of deploy_v1 touches down a physics step earlier in one of the two; and
# where in the hand its payload is, warp leaves out of what it tabulates.
@pytest.mark.parametrize(("name", "steps", "wide"), [("ablation_v1", 15, 1.0), ("deploy_v1", 11, 5.0)])
def test_the_back_ends_agree_over_a_fifth_of_a_second(name, steps, wide, monkeypatch):
    """Two robots with their own mass, friction, gains, payload and strength, in steps of 2 ms x 10."""
    protocol = find_protocol(name)[0]
    samples = sample_episodes(protocol, read_target_set(protocol), 2, stream(4, "test"))
    start = samples.reset._replace(leg_q=0.2 * samples.reset.leg_q)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    if device == "cpu":  # optimizing the kernels would take minutes, and running them takes seconds
        monkeypatch.setattr(wp.config, "optimization_level", 0)
    cpu, warp = CpuBackend(protocol, 2, 1), WarpBackend(protocol, 2, device)
    first = [
        b.reset(torch.arange(2, device=b.device), ResetState(*(column.to(b.device) for column in start)))
        for b in (cpu, warp)
    ]
    np.testing.assert_allclose(first[0].torque, first[1].torque.cpu(), atol=1e-4)
    robot = load_robot(protocol.robot)
    default, scale = (torch.tensor(a, dtype=torch.float32) for a in (robot.default_q, robot.action_scale))
    generator = torch.Generator().manual_seed(0)
    a, b = first
    for _ in range(steps):
        command = default + 0.1 * scale * torch.randn(2, 14, generator=generator)
        (_, a), (_, b) = cpu.step(command[None]), warp.step(command.to(device)[None])
    for name, tolerance in (
        ("qpos", 2e-5),
        ("qvel", 2e-3),
        ("torque", 2e-2),
        ("ee_pos_w", 2e-5),
        ("ee_rot_w", 2e-5),
        ("feet_pos_w", 2e-5),
        ("feet_up_w", 2e-5),
        ("foot_force_w", 0.5),
        ("ground_contact", 0),
    ):
        mine, theirs = getattr(a, name), getattr(b, name).cpu()
        np.testing.assert_allclose(mine, theirs, atol=wide * tolerance, rtol=0, err_msg=name)
    assert (a.foot_force_w[..., 2].abs().sum(-1) > 50).all()  # on the ground
