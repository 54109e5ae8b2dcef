"""The latent by phase: thresholds, halves by episode, an accuracy that is chance where there is nothing."""

import json
import sys

import numpy as np
import pytest

from wbc_bench.results import latents
from wbc_bench.results.figures import latents as latent_figures
from wbc_bench.results.figures.latents import write_latents
from wbc_bench.results.latents import LatentError, Samples


def synthetic(
    separation: float, episodes: int = 24, steps: int = 60, columns: int = 8, kinds: int = 3
) -> Samples:
    """Errors that fall through the phases; a direction of the latent for each, `separation` times as far.

    A strong offset of each episode is what a split by sample would learn.
    """
    rng = np.random.default_rng(5)
    levels = np.array([0.02, 0.2, 0.8])[3 - kinds :]
    error = np.tile(np.repeat(levels[::-1], steps // kinds), episodes)
    episode = np.repeat(np.arange(episodes), steps)
    offset = rng.normal(size=(episodes, columns))[episode]
    means = np.eye(3, columns) * separation
    phase = latents.phase_of(error, 0.05)
    latent = means[phase] + rng.normal(size=(len(error), columns)) * 0.3 + offset
    return Samples(latent, error, episode, np.tile(np.arange(steps) * 0.02, episodes))  # pyright: ignore[reportArgumentType]


def test_phases_follow_the_error():
    phase = latents.phase_of(np.array([0.0, 0.049, 0.05, 0.499, 0.5, 3.0]), 0.05)
    assert [latents.PHASES[k] for k in phase] == [*["precision"] * 2, *["approach"] * 2, *["locomotion"] * 2]


def test_no_episode_is_on_both_sides():
    samples = synthetic(1.0)
    tested = latents.held_out(samples.episode, np.random.default_rng(0))
    assert not set(samples.episode[tested]) & set(samples.episode[~tested])
    assert len(set(samples.episode[tested])) == 12


def test_separable_phases_are_told_apart_and_equal_ones_are_not():
    clear = latents.separate(synthetic(30.0), np.random.default_rng(0))
    assert clear.accuracy.point > 0.99 and clear.phases == latents.PHASES and clear.axes.shape[1] == 2
    nothing = latents.separate(synthetic(0.0), np.random.default_rng(0))
    assert nothing.chance == pytest.approx(1 / 3)
    assert abs(nothing.accuracy.point - nothing.chance) < 0.1
    between = latents.separate(synthetic(2.0), np.random.default_rng(0))
    assert nothing.accuracy.point < between.accuracy.point < clear.accuracy.point
    assert between.accuracy.low < between.accuracy.point < between.accuracy.high


def test_a_latent_that_only_knows_its_episode_scores_chance():
    """A split by sample would find every phase here: each episode stays in one phase."""
    rng = np.random.default_rng(1)
    episode = np.repeat(np.arange(40), 50)
    latent = rng.normal(size=(40, 30))[episode] + 1e-3 * rng.normal(size=(2000, 30))
    error = np.array([0.02, 0.2, 0.8])[rng.integers(0, 3, 40)][episode]
    found = latents.separate(Samples(latent, error, episode, np.zeros(2000)), rng)
    assert found.accuracy.low < found.chance < found.accuracy.high


def test_phases_weigh_alike():
    """Nine in ten steps in one phase and a latent of noise: naming that phase always would score 0.9."""
    samples = synthetic(0.0, episodes=40, kinds=2)
    rng = np.random.default_rng(2)
    error = np.where(rng.random(len(samples.error)) < 0.9, 0.2, 0.8)
    found = latents.separate(samples._replace(error=error), rng)
    assert found.phases == ("approach", "locomotion") and found.chance == 0.5
    assert abs(found.accuracy.point - 0.5) < 0.05 and found.axes.shape[1] == 1


def test_what_cannot_be_separated_is_one_line():
    samples = synthetic(1.0)
    with pytest.raises(LatentError, match=r"one phase alone \(locomotion\)"):
        latents.separate(samples._replace(error=np.full_like(samples.error, 2.0)), np.random.default_rng(0))
    with pytest.raises(LatentError, match="never changes"):
        latents.separate(samples._replace(latent=np.ones_like(samples.latent)), np.random.default_rng(0))
    with pytest.raises(LatentError, match=r"3 episodes: valid: 4 or more"):
        latents.separate(synthetic(1.0, episodes=3), np.random.default_rng(0))


def test_without_scikit_learn_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "sklearn.discriminant_analysis", None)
    with pytest.raises(LatentError, match=r"scikit-learn: pip install 'wbc-bench\[figures\]'"):
        latents.separate(synthetic(1.0), np.random.default_rng(0))


@pytest.mark.parametrize("kinds", [2, 3])
def test_same_samples_same_bytes(tmp_path, monkeypatch, kinds):
    monkeypatch.setattr(latent_figures, "DRAWN", 150)
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        found, paths = write_latents("a:b", "p", synthetic(3.0, kinds=kinds), 0, tmp_path / folder)
    assert [path.name for path in paths] == [f"latent_a-b.{suffix}" for suffix in ("png", "svg", "json")]
    for path in paths:
        assert path.read_bytes() == (tmp_path / "one" / path.name).read_bytes()
    named, _ = write_latents("a:b", "p", synthetic(3.0, kinds=kinds), 0, tmp_path, "My policy")[1][:2]
    text = named.with_suffix(".json").read_text()
    assert "Latent of My policy on p" in text and json.loads(text)["controller"] == "a:b"
    facts = json.loads(paths[-1].read_text())
    assert facts["balanced_accuracy"] == pytest.approx(found.accuracy.point)
    assert f"chance is {100 * found.chance:.0f} %" in facts["caption"]
