"""What a controller's latent tells of the phase of the task: t-SNE without labels, LDA with, and how well.

Phases follow from the position error of the moment, as in the paper's figure; it prints no thresholds, so
ours are the success rule and the middle of the reward's gate.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wbc_bench.errors import BenchError, missing_extra
from wbc_bench.outcomes import SuccessRule
from wbc_bench.results import stats
from wbc_bench.results.analysis import FloatArray

IntArray = NDArray[np.int64]

PHASES = ("precision", "approach", "locomotion")  # by growing error
# d = 2 e_p + e_R is at the centre of the gate, mu = 1, where e_p = 0.5 m and e_R = 0: beyond, the reward asks
# for locomotion. Source: paper, eq. rfm_phase; mu of SPIRAL-EDWIN/JC_umi-on-tron @f83d62e
LOCOMOTION_ABOVE = 0.5  # [m]
LEAST_EPISODES = 4  # half of them are held out


class LatentError(BenchError):
    """Samples of which no picture can be made."""


class Samples(NamedTuple):
    """The latent at M control steps, and where in the task the robot was."""

    latent: FloatArray  # (M, D)
    error: FloatArray  # (M,) [m] position of the end-effector off its target
    episode: IntArray  # (M,) number of the episode
    time: FloatArray  # (M,) [s] since its start
    precision_below: float = SuccessRule().position  # [m] tolerance of the protocol's success rule

    @property
    def phase(self) -> IntArray:
        """Index into PHASES, (M,)."""
        return phase_of(self.error, self.precision_below)


class Separation(NamedTuple):
    """How well a linear discriminant tells phases of episodes it has not seen."""

    phases: tuple[str, ...]  # those met in training
    recall: FloatArray  # (P,) share of a phase's held-out samples that are named right; NaN without any
    samples: IntArray  # (P,) held-out samples
    accuracy: stats.Estimate  # mean of the recalls, interval over held-out episodes
    chance: float  # 1 / P, what guessing gives
    train_episodes: int
    held_out: NDArray[np.bool_]  # (M,)
    axes: FloatArray  # (M, P - 1) projection


def phase_of(error: FloatArray, precision_below: float) -> IntArray:
    """Index into PHASES, (M,), of position errors (M,) [m]."""
    return np.digitize(error, [precision_below, LOCOMOTION_ABOVE])


def held_out(episode: IntArray, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Which samples, (M,), are of the half of the episodes that is held out.

    Whole episodes: neighbouring steps are nearly equal, and one in either half would give the answer away.
    """
    episodes = rng.permutation(np.unique(episode))
    return np.isin(episode, episodes[len(episodes) // 2 :])


def separate(samples: Samples, rng: np.random.Generator) -> Separation:
    """Fits a linear discriminant, phases weighing alike, on half of the episodes and tests it on the rest.

    Raises: LatentError, too few episodes, a constant latent, or fewer than two phases.
    """
    analysis = _sklearn("discriminant_analysis")
    count = len(np.unique(samples.episode))
    if count < LEAST_EPISODES:
        raise LatentError(f"{count} episodes: valid: {LEAST_EPISODES} or more, half of them are held out")
    if not np.isfinite(samples.latent).all() or not np.ptp(samples.latent, axis=0).any():
        raise LatentError("the latent is not finite or never changes: there is nothing to project")
    phase, tested = samples.phase, held_out(samples.episode, rng)
    kinds = np.unique(phase[~tested])
    if len(kinds) < 2:
        raise LatentError(
            f"{count - count // 2} episodes met one phase alone ({PHASES[kinds[0]]}): nothing to tell apart, "
            "give more episodes or another protocol"
        )
    model = analysis.LinearDiscriminantAnalysis(priors=np.full(len(kinds), 1.0 / len(kinds)))
    model.fit(samples.latent[~tested], phase[~tested])
    right = model.predict(samples.latent) == phase
    # hits and samples of each held-out episode and phase, (E, P)
    episodes = np.unique(samples.episode[tested])
    row = np.searchsorted(episodes, samples.episode[tested])
    total, hits = np.zeros((2, len(episodes), len(PHASES)))
    np.add.at(total, (row, phase[tested]), 1)
    np.add.at(hits, (row, phase[tested]), right[tested])
    total, hits = total[:, kinds], hits[:, kinds]
    ones = np.ones((1, len(episodes)))
    weights = rng.multinomial(len(episodes), ones[0] / len(episodes), size=stats.RESAMPLES)
    draws = _balanced(weights.astype(float), hits, total)
    low, high = np.nanquantile(draws, [(1 - stats.CONFIDENCE) / 2, (1 + stats.CONFIDENCE) / 2])
    point = float(_balanced(ones, hits, total)[0])
    method = "bootstrap 95 % over held-out episodes"
    return Separation(
        phases=tuple(PHASES[k] for k in kinds),
        recall=_ratio(hits.sum(axis=0), total.sum(axis=0)),
        samples=total.sum(axis=0).astype(np.int64),
        accuracy=stats.Estimate(point, float(low), float(high), 1, len(episodes), method),
        chance=1.0 / len(kinds),
        train_episodes=count // 2,
        held_out=tested,
        axes=model.transform(samples.latent),
    )


def _ratio(part: FloatArray, whole: FloatArray) -> FloatArray:
    return np.divide(part, whole, out=np.full(whole.shape, np.nan), where=whole > 0)


def _balanced(weights: FloatArray, hits: FloatArray, total: FloatArray) -> FloatArray:
    """Mean recall over the phases that occur, (B,), of episodes weighted (B, E)."""
    recall = _ratio(weights @ hits, weights @ total)  # (B, P)
    return _ratio(np.nansum(recall, axis=1), (~np.isnan(recall)).sum(axis=1).astype(float))


def _sklearn(module: str):
    import importlib

    try:
        return importlib.import_module(f"sklearn.{module}")
    except ImportError as error:
        raise LatentError(missing_extra("the picture of a latent", "figures", error)) from error
