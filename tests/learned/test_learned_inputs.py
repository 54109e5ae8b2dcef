"""Inputs: every column where the layout says, windows, the reference and the normaliser."""

import numpy as np
import pytest
import torch

from wbc_baselines.learned.policy import inputs, reference
from wbc_baselines.learned.policy.normalizer import FLOOR, Normalizer
from wbc_baselines.learned.training import poses
from wbc_baselines.learned.training.history import History
from wbc_baselines.learned.training.rewards import gate
from wbc_bench.cli.main import main
from wbc_bench.rotations import geodesic_angle, matrix_from_rotvec, rho6

N = 4


def numbered(layout: inputs.Layout) -> list[torch.Tensor]:
    """One block a term, each filled with its own number."""
    return [torch.full((N, term.size), float(k)) for k, term in enumerate(layout)]


def expected(layout: inputs.Layout) -> torch.Tensor:
    return torch.cat([torch.full((term.size,), float(k)) for k, term in enumerate(layout)])


def ee(pos: torch.Tensor, rot: torch.Tensor) -> torch.Tensor:
    return torch.cat([pos, rot], -1)


def test_dimensions_are_the_paper_s():
    widths = (inputs.OBSERVATION, inputs.COMMAND, inputs.HISTORY, inputs.HISTORY_FRAME, inputs.CONTEXT_MAX)
    assert widths == (58, 9, 10, 57, 67)
    assert (inputs.NEXT_OBSERVATION, inputs.PAPER_PRIVILEGED, inputs.ACTIONS) == (49, 80, 14)
    assert inputs.PRIVILEGED == 80 + 1 + 3 + 1 + 14 + 2 + 3 + 3  # and the hidden disturbances


def test_terms_stand_where_the_layout_says():
    w, g, q, qd, action, pos, rot, d_ref = numbered(inputs.OBSERVATION_LAYOUT)
    found = inputs.observation(w, g, q, qd, action, ee(pos, rot), d_ref[:, 0])
    torch.testing.assert_close(found, expected(inputs.OBSERVATION_LAYOUT).expand(N, -1))
    w, g, q, qd, torque, pos, rot = numbered(inputs.HISTORY_LAYOUT)
    found = inputs.history_frame(w, g, q, qd, torque, ee(pos, rot))
    torch.testing.assert_close(found, expected(inputs.HISTORY_LAYOUT).expand(N, -1))
    w, g, q, qd, pos, rot, feet = numbered(inputs.NEXT_OBSERVATION_LAYOUT)
    found = inputs.next_observation(w, g, q, qd, ee(pos, rot), feet)
    torch.testing.assert_close(found, expected(inputs.NEXT_OBSERVATION_LAYOUT).expand(N, -1))
    parts = [part[:, 0] if part.shape[1] == 1 else part for part in numbered(inputs.PRIVILEGED_LAYOUT)]
    found = inputs.privileged(*parts)
    torch.testing.assert_close(found, expected(inputs.PRIVILEGED_LAYOUT).expand(N, -1))


def test_command_is_rho6_of_the_harness():
    rot = matrix_from_rotvec(np.random.default_rng(0).normal(size=(N, 3)))
    pos = np.arange(3.0 * N).reshape(N, 3)
    found = inputs.command(torch.from_numpy(pos), torch.from_numpy(rot))
    np.testing.assert_allclose(found, np.concatenate([pos, rho6(rot)], -1))


def test_wrong_width_is_refused():
    with pytest.raises(ValueError, match=r"13 \+ 9 columns"):
        inputs.history_frame(*[torch.zeros(N, k) for k in (3, 3, 14, 14, 13, 9)])


def test_window_keeps_the_last_ten_and_refills_on_reset():
    terms = [torch.full((2, 57), float(k)) for k in range(13)]
    history = History(terms[0])
    assert (history.window == 0).all()
    for term in terms[1:12]:
        history.push(term)
    assert history.window[:, :, 0].tolist() == [list(range(2, 12))] * 2
    before = history.window
    history.push(terms[12])
    assert before[0, -1, 0] == 11  # what a rollout has stored is not overwritten
    history.reset(torch.tensor([1]), torch.full((1, 57), -1.0))
    assert history.window[:, :, 0].tolist() == [list(range(3, 13)), [-1.0] * 10]


def test_reference_by_hand():
    d_ref = reference.initial_reference(torch.tensor([0.5, 0.01]), torch.tensor([0.2, 0.0]))
    torch.testing.assert_close(d_ref, torch.tensor([1.2, 0.02]))
    for _ in range(10):
        d_ref = reference.advance(d_ref, 1.4, 0.02)
    torch.testing.assert_close(d_ref, torch.tensor([0.92, 0.0]))  # 1.2 - 10 * 0.028; never below zero
    found = gate(torch.tensor([1.0, 1.2, 0.0]))
    torch.testing.assert_close(found, torch.tensor([0.5, 0.7310586, 0.0066929]))  # sigmoid of 0, 1, -5


def test_pose_errors_agree_with_the_harness():
    rng = np.random.default_rng(1)
    a, b = (matrix_from_rotvec(rng.normal(size=(50, 3))) for _ in range(2))
    pos, goal = rng.normal(size=(2, 50, 3))
    found = poses.pose_errors(*(torch.from_numpy(x) for x in (pos, a, goal, b)))
    np.testing.assert_allclose(found[0], np.linalg.norm(pos - goal, axis=1))
    np.testing.assert_allclose(found[1], geodesic_angle(a, b), atol=1e-7)


def test_gram_schmidt_restores_rotations_and_makes_noisy_ones_proper():
    rot = matrix_from_rotvec(np.random.default_rng(2).normal(size=(20, 3)))
    columns = torch.from_numpy(rho6(rot))
    np.testing.assert_allclose(poses.rotation_from_rho6(columns), rot, atol=1e-12)
    noisy = poses.rotation_from_rho6(columns + 0.05 * torch.randn(20, 6, generator=torch.Generator()))
    eye = noisy.transpose(1, 2) @ noisy
    torch.testing.assert_close(eye, torch.eye(3, dtype=eye.dtype).expand(20, 3, 3), atol=1e-12, rtol=0)
    assert torch.linalg.det(noisy).sub(1).abs().max() < 1e-12


def test_normaliser_merges_samples_exactly():
    draw = torch.Generator().manual_seed(0)
    x = 3 + 2 * torch.randn(1000, 5, generator=draw, dtype=torch.float64)
    normalizer = Normalizer(5).double()
    for part in x.split([1, 300, 7, 692]):
        normalizer.update(part)
    torch.testing.assert_close(normalizer.mean, x.mean(0))
    torch.testing.assert_close(normalizer.std, x.std(0, correction=0))
    torch.testing.assert_close(normalizer(x), (x - x.mean(0)) / (x.std(0, correction=0) + FLOOR))
    assert set(normalizer.state_dict()) == {"mean", "std"}


def test_list_inputs_prints_every_dimension(capsys):
    main(["list", "--inputs"])
    text = capsys.readouterr().out
    for vector, layout in inputs.LAYOUTS.items():
        assert f"| {vector} | all | {inputs.width(layout)} |" in text
    assert "0..2 | 3 | base angular velocity" in text and "| 57 | 1 | task-progress reference" in text
