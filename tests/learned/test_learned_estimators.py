"""Estimators: their mathematics against a second implementation, and one step at a time against sequences."""

import pytest
import torch
from torch import nn
from torch.distributions import Normal, kl_divergence

from policies import batch
from wbc_baselines.learned.policy.architecture import sinusoids
from wbc_baselines.learned.policy.estimators import ESTIMATORS, make_estimator
from wbc_baselines.learned.policy.estimators.latent import (
    KL_WEIGHT,
    LatentEstimator,
    kl_to_standard,
    masked_mean,
    split,
)
from wbc_baselines.learned.policy.estimators.memory import Memory
from wbc_baselines.learned.policy.estimators.window import Layer, WindowEncoder

LATENT = ("cenet", "gru", "transformer", "transformer_gru")


def make(name: str) -> LatentEstimator:
    torch.manual_seed(0)
    estimator = make_estimator(name)
    assert isinstance(estimator, LatentEstimator)
    return estimator


def linear(inputs: int, outputs: int) -> int:
    return (inputs + 1) * outputs


LAYER = linear(128, 384) + linear(128, 128) + linear(128, 512) + linear(512, 128) + 2 * 2 * 128
WINDOW = linear(57, 128) + 2 * LAYER + linear(128, 131)
MEMORY = 3 * 131 * (131 + 131 + 2) + linear(131, 131)  # GRU: input and hidden, each with its bias; f_out
DECODER = linear(64, 256) + linear(256, 128) + linear(128, 49)
PARAMETERS = {
    "none": 0,
    "oracle": 0,
    "cenet": linear(285, 128) + linear(128, 64) + linear(64, 35)
    + linear(19, 64) + linear(64, 128) + linear(128, 49),
    "gru": linear(57, 131) + MEMORY + DECODER,
    "transformer": WINDOW + DECODER,
    "transformer_gru": WINDOW + MEMORY + DECODER,
}  # fmt: skip
CONTEXT = {"none": 0, "oracle": 107, "cenet": 19, "gru": 67, "transformer": 67, "transformer_gru": 67}


@pytest.mark.parametrize("name", ESTIMATORS)
def test_parameter_counts_and_widths(name):
    estimator = make_estimator(name)
    assert sum(p.numel() for p in estimator.parameters()) == PARAMETERS[name]
    assert estimator.context_dim == CONTEXT[name]
    assert estimator.state_dim == (131 if name.endswith("gru") else 0)
    assert estimator.trainable == (name in LATENT)


@pytest.mark.parametrize("name", ("none", *LATENT))
def test_shapes_of_a_step(name):
    estimator = make_estimator(name)
    state = torch.zeros(3, estimator.state_dim)
    context, after = estimator.step(torch.randn(3, 10, 57), state)
    assert context.shape == (3, estimator.context_dim) and after.shape == state.shape


def test_window_encoder_is_torch_s_transformer():
    torch.manual_seed(0)
    mine = WindowEncoder(131).double()
    layer = nn.TransformerEncoderLayer(128, 8, 512, dropout=0.0, batch_first=True)
    theirs = nn.TransformerEncoder(layer, 2, enable_nested_tensor=False).double()
    for a, b in zip(theirs.layers, mine.layers, strict=True):
        assert isinstance(b, Layer)
        nn.init.normal_(b.qkv.bias)
        a.self_attn.load_state_dict(
            {
                **{"in_proj_weight": b.qkv.weight, "in_proj_bias": b.qkv.bias},
                **{"out_proj.weight": b.out.weight, "out_proj.bias": b.out.bias},
            }
        )
        for name, part in (
            ("linear1", b.widen),
            ("linear2", b.narrow),
            ("norm1", b.norm1),
            ("norm2", b.norm2),
        ):
            getattr(a, name).load_state_dict(part.state_dict())
    window = torch.randn(7, 10, 57, dtype=torch.float64)
    expected = mine.read_out(theirs(mine.embed(window) + mine.positions)[:, -1])
    torch.testing.assert_close(mine(window), expected, atol=1e-10, rtol=0)


def test_positions_by_hand():
    found = sinusoids(10, 128)
    assert found[0].tolist() == [0.0, 1.0] * 64
    angle = torch.tensor(3 / 10000 ** (6 / 128))
    torch.testing.assert_close(torch.from_numpy(found)[3, 6:8], torch.stack([angle.sin(), angle.cos()]))


@pytest.mark.parametrize("name", LATENT)
def test_window_order_matters_and_old_terms_only_where_they_are_read(name):
    """Against an encoder that loses the positions, or a window read from the wrong end."""
    estimator = make(name)
    window = torch.randn(2, 10, 57)
    state = torch.zeros(2, estimator.state_dim)

    def differs(other: torch.Tensor) -> bool:
        return not torch.allclose(
            estimator.step(window, state)[0], estimator.step(other, state)[0], atol=1e-6
        )

    reads = {"cenet": 5, "gru": 1}.get(name, 10)
    for k in range(10):
        other = window.clone()
        other[:, k] += 1.0
        assert differs(other) == (k >= 10 - reads)
    if reads > 1:
        swapped = window.clone()
        swapped[:, [7, 8]] = swapped[:, [8, 7]]
        assert differs(swapped)


@pytest.mark.parametrize("name", LATENT)
def test_one_step_at_a_time_is_the_whole_sequence(name):
    """With episodes that start inside the rollout, in double precision."""
    estimator = make(name).double()
    rollout, _ = batch(estimator, steps=20)
    rollout = rollout._replace(
        **{k: getattr(rollout, k).double() for k in ("history", "state", "velocity", "next_observation")}
    )
    assert rollout.start[1:].any()
    velocity, mean, _ = split(estimator.encode(rollout))
    state = rollout.state
    for t in range(20):
        state = state * ~rollout.start[t, :, None]
        context, state = estimator.step(rollout.history[t], state)
        torch.testing.assert_close(context, torch.cat([velocity[t], mean[t]], -1), atol=1e-12, rtol=0)


@pytest.mark.parametrize("name", ("gru", "transformer_gru"))
def test_an_episode_does_not_see_the_one_before(name):
    estimator = make(name)
    rollout, _ = batch(estimator)
    start = torch.zeros_like(rollout.start)
    start[6] = True
    changed = rollout.history.clone()
    changed[:6] += 1.0
    a = estimator.encode(rollout._replace(start=start))
    b = estimator.encode(rollout._replace(start=start, history=changed, state=rollout.state + 1.0))
    assert not torch.equal(a[:6], b[:6])
    assert torch.equal(a[6:], b[6:])
    carried = estimator.encode(rollout._replace(start=torch.zeros_like(start), history=changed))
    assert not torch.allclose(a[6:], carried[6:])


def test_memory_is_torch_s_gru_and_a_residual():
    torch.manual_seed(0)
    memory = Memory(131)
    gru = nn.GRU(131, 131)
    gru.load_state_dict({f"{name}_l0": value for name, value in memory.cell.state_dict().items()})
    u, state = torch.randn(9, 4, 131), torch.randn(4, 131)
    expected = u + memory.out(gru(u, state[None])[0])
    found = memory.unroll(u, state, torch.zeros(9, 4, dtype=torch.bool))
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)


def test_split_and_floor_of_the_variance():
    e = torch.arange(131.0)[None] / 100
    e[0, 67] = -50.0
    velocity, mean, variance = split(e)
    assert torch.equal(velocity, e[:, :3]) and torch.equal(mean, e[:, 3:67])
    torch.testing.assert_close(variance[:, 1:], e[:, 68:].exp() + 1e-4)
    assert variance[0, 0] == 1e-4


def test_kl_is_that_of_torch_distributions():
    mean, variance = torch.randn(8, 64), torch.rand(8, 64) * 3 + 1e-4
    expected = kl_divergence(Normal(mean, variance.sqrt()), Normal(torch.tensor(0.0), torch.tensor(1.0)))
    torch.testing.assert_close(kl_to_standard(mean, variance), expected)


def test_masked_mean_by_hand():
    values = torch.tensor([[[1.0, 3.0], [100.0, float("nan")]], [[5.0, 7.0], [0.0, 0.0]]])
    valid = torch.tensor([[True, False], [True, False]])
    assert masked_mean(values, valid) == 4.0
    assert masked_mean(values, torch.zeros_like(valid)) == 0.0


@pytest.mark.parametrize("name", LATENT)
def test_losses_by_hand(name):
    """Every loss worked out from one step at a time, with the same noise."""
    estimator = make(name)
    rollout, noise = batch(estimator)
    found = estimator.losses(rollout, noise)
    power = 2 if name == "cenet" else 1
    velocity_error, prediction_error, kl = [], [], []
    state = rollout.state
    for t in range(len(noise)):
        state = state * ~rollout.start[t, :, None]
        velocity, mean, variance = split(
            estimator.encode(
                rollout._replace(
                    **{k: v[t : t + 1] for k, v in rollout._asdict().items() if k != "state"}, state=state
                )
            )[0]
        )
        context, state = estimator.step(rollout.history[t], state, noise[t])
        code = context if name == "cenet" else context[:, 3:]
        torch.testing.assert_close(context[:, 3:], mean + variance.sqrt() * noise[t])
        velocity_error.append((velocity - rollout.velocity[t]).abs().pow(power))
        error = (estimator.decoder(code) - rollout.next_observation[t]).abs().pow(power)
        prediction_error.append(error[rollout.valid[t]])
        kl.append(0.5 * (mean.square() + variance - 1 - variance.log()))
    expected = [torch.cat(errors).mean() for errors in (velocity_error, prediction_error, kl)]
    torch.testing.assert_close([found[k] for k in ("velocity", "prediction", "kl")], expected)
    torch.testing.assert_close(found["total"], expected[0] + expected[1] + KL_WEIGHT * expected[2])


@pytest.mark.parametrize("name", LATENT)
def test_every_parameter_learns_and_a_context_carries_no_gradient(name):
    estimator = make(name)
    rollout, noise = batch(estimator)
    estimator.losses(rollout, noise)["total"].backward()
    # the bias of the keys moves all scores alike: without effect in attention, and without gradient in its
    # last layer; everything else must learn
    still = [n for n, p in estimator.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
    assert still == []
    with torch.no_grad():
        context, state = estimator.step(rollout.history[0], rollout.state, noise[0])
    assert not context.requires_grad and not state.requires_grad


def test_a_fit_lowers_the_loss_and_finds_the_velocity():
    """Velocity is a column of the window: after a few steps it is predicted better than by its mean."""
    estimator = make("gru")  # the cheapest with a memory
    rollout, noise = batch(estimator, steps=8, count=32)
    rollout = rollout._replace(velocity=rollout.history[:, :, -1, :3])
    optimizer = torch.optim.Adam(estimator.parameters(), 1e-3)
    seen = []
    for _ in range(60):
        losses = estimator.losses(rollout, noise)
        optimizer.zero_grad()
        losses["total"].backward()
        optimizer.step()
        seen.append(losses["velocity"].item())
    assert seen[-1] < 0.5 * rollout.velocity.abs().mean()


def test_normaliser_is_updated_by_observe_alone():
    estimator = make("transformer_gru")
    rollout, noise = batch(estimator)
    before = estimator.normalizer.mean.clone()
    estimator.train().losses(rollout, noise)
    estimator.step(rollout.history[0], rollout.state)
    assert torch.equal(estimator.normalizer.mean, before)
    estimator.observe(rollout.history)
    torch.testing.assert_close(estimator.normalizer.mean, rollout.history[:, :, -1].mean((0, 1)))
