"""What a controller's latent tells of the phase of the task: t-SNE without labels, LDA with, and how well.

Phases follow from the position error of the moment, as in the paper's figure; it prints no thresholds, so
ours are the success rule and the middle of the reward's gate.
"""

from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from wbc_bench import stats
from wbc_bench.analysis import REACH_TOLERANCE, FloatArray
from wbc_bench.errors import BenchError
from wbc_bench.files import folder_name, write_atomic
from wbc_bench.formatting import CM
from wbc_bench.plots import BLUE, ORANGE, VERMILION, save, styled

IntArray = NDArray[np.int64]

PHASES = ("precision", "approach", "locomotion")  # by growing error
PRECISION_BELOW = REACH_TOLERANCE  # [m] Source: paper, section IV-B, the success rule
# d = 2 e_p + e_R is at the centre of the gate, mu = 1, where e_p = 0.5 m and e_R = 0: beyond, the reward asks
# for locomotion. Source: paper, eq. rfm_phase; mu of SPIRAL-EDWIN/JC_umi-on-tron @f83d62e
LOCOMOTION_ABOVE = 0.5  # [m]
PHASE_COLOURS = {"precision": BLUE, "approach": ORANGE, "locomotion": VERMILION}
DRAWN = 1500  # points of a picture; of so many, t-SNE takes most of a minute
LEAST_EPISODES = 4  # half of them are held out


class LatentError(BenchError):
    """Samples of which no picture can be made."""


class Samples(NamedTuple):
    """The latent at M control steps, and where in the task the robot was."""

    latent: FloatArray  # (M, D)
    error: FloatArray  # (M,) [m] position of the end-effector off its target
    episode: IntArray  # (M,) number of the episode
    time: FloatArray  # (M,) [s] since its start


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


def phase_of(error: FloatArray) -> IntArray:
    """Index into PHASES, (M,), of position errors [m]."""
    return np.digitize(error, [PRECISION_BELOW, LOCOMOTION_ABOVE])


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
    phase, tested = phase_of(samples.error), held_out(samples.episode, rng)
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


def embed(latent: FloatArray, seed: int) -> FloatArray:
    """t-SNE of latents (M, D), each column over its standard deviation: (M, 2), equal for equal seeds."""
    spread = latent.std(axis=0)
    scaled = (latent - latent.mean(axis=0)) / np.where(spread > 0, spread, 1.0)
    perplexity = min(30.0, (len(latent) - 1) / 3)  # scikit-learn's default, less for few samples
    model = _sklearn("manifold").TSNE(perplexity=perplexity, init="pca", random_state=seed)
    return np.asarray(model.fit_transform(scaled), dtype=np.float64)


def draw_sample(of: IntArray, rng: np.random.Generator) -> IntArray:
    """At most DRAWN of the indices, in random order: no phase lies above another in a picture."""
    return rng.permutation(of)[:DRAWN]


def scatter_phases(ax: Axes, points: FloatArray, phase: IntArray) -> Axes:
    """Points (M, 2), coloured by phase."""
    colours = np.array([PHASE_COLOURS[name] for name in PHASES])[phase]
    ax.scatter(points[:, 0], points[:, 1], s=7, lw=0, alpha=0.6, c=list(colours), rasterized=True)
    return ax


def summary(samples: Samples, found: Separation) -> list[str]:
    """What a reader of the picture must know, line by line."""
    accuracy = found.accuracy
    lines = [
        "LDA, held-out episodes",
        f"balanced accuracy {_percent(accuracy)}",
        f"chance {100 * found.chance:.0f} %",
        "",
        "recall of a phase (held-out steps)",
    ]
    for phase, recall, count in zip(found.phases, found.recall, found.samples, strict=True):
        lines.append(f"  {phase} " + ("–" if np.isnan(recall) else f"{100 * recall:.0f} %") + f" ({count})")
    return [
        *lines,
        "",
        f"fitted on {found.train_episodes} episodes,",
        f"tested on {accuracy.num_episodes}; {samples.latent.shape[1]} columns",
        "",
        "phase by position error",
        f"  precision below {PRECISION_BELOW * CM:.0f} cm",
        "  approach between",
        f"  locomotion from {LOCOMOTION_ABOVE * CM:.0f} cm",
    ]


def latent_figure(name: str, samples: Samples, found: Separation, seed: int) -> Figure:
    """t-SNE of all episodes, LDA of the held-out ones, and the numbers beside them."""
    rng, phase = np.random.default_rng(seed), phase_of(samples.error)
    all_of_them = draw_sample(np.arange(len(phase)), rng)
    unseen = draw_sample(
        np.flatnonzero(found.held_out & np.isin(phase, [PHASES.index(p) for p in found.phases])), rng
    )
    figure = Figure(figsize=(10.0, 4.2))
    left, right, beside = figure.subplots(1, 3, width_ratios=(1, 1, 0.62))
    scatter_phases(left, embed(samples.latent[all_of_them], seed), phase[all_of_them])
    left.set(title="t-SNE, all episodes", xticks=[], yticks=[], xlabel="Axes without a unit", ylabel="")
    flat = found.axes.shape[1] == 1  # two phases have one axis
    second = samples.time if flat else found.axes[:, 1]
    scatter_phases(right, np.column_stack([found.axes[:, 0], second])[unseen], phase[unseen])
    right.set(title="LDA, held-out episodes", xlabel="First discriminant")
    right.set_ylabel("Time in the episode (s)" if flat else "Second discriminant")
    beside.axis("off")
    beside.text(
        0.0, 1.0, "\n".join(summary(samples, found)), va="top", fontsize=8, transform=beside.transAxes
    )
    handles = [
        left.plot([], [], "o", ms=5, color=PHASE_COLOURS[name], label=name)[0] for name in reversed(PHASES)
    ]
    figure.legend(handles=handles, loc="outside lower left", ncols=3)
    figure.suptitle(f"{name}: latent of the context estimator", x=0.01, ha="left", weight="bold")
    return figure


def write_latents(
    spec: str, protocol: str, samples: Samples, seed: int, out_dir: Path
) -> tuple[Separation, list[Path]]:
    """Writes latent_<controller>.png, .svg and .json (numbers and caption) into a folder.

    Raises: LatentError.
    """
    found = separate(samples, np.random.default_rng(seed))
    with styled():
        figure = latent_figure(spec, samples, found, seed)
        paths = save(figure, f"latent_{folder_name(spec)}", out_dir)
    accuracy = found.accuracy
    episodes = found.train_episodes + accuracy.num_episodes
    caption = (
        f"Latent of {spec} on {protocol}, {episodes} episodes, coloured by the phase of the task: precision "
        f"below {PRECISION_BELOW * CM:.0f} cm of position error, locomotion from "
        f"{LOCOMOTION_ABOVE * CM:.0f} cm, approach between. A linear discriminant names "
        f"{_percent(accuracy)} of the steps of held-out episodes right, phases weighing alike; "
        f"chance is {100 * found.chance:.0f} %."
    )
    facts = {
        **{"caption": caption, "controller": spec, "protocol": protocol, "seed": seed},
        **{"columns": samples.latent.shape[1], "samples": len(samples.error)},
        **{"train_episodes": found.train_episodes, "held_out_episodes": accuracy.num_episodes},
        **{"balanced_accuracy": accuracy.point, "low": accuracy.low, "high": accuracy.high},
        **{"chance": found.chance, "thresholds_m": [PRECISION_BELOW, LOCOMOTION_ABOVE]},
        "recall": {
            p: None if np.isnan(r) else r for p, r in zip(found.phases, found.recall.tolist(), strict=True)
        },
        "held_out_samples": dict(zip(found.phases, found.samples.tolist(), strict=True)),
    }
    sidecar = paths[0].with_suffix(".json")
    write_atomic(sidecar, msgspec.json.format(msgspec.json.encode(facts), indent=2) + b"\n")
    return found, [*paths, sidecar]


def _percent(value: stats.Estimate) -> str:
    return f"{100 * value.point:.0f} % [{100 * value.low:.0f}, {100 * value.high:.0f}]"


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
        raise LatentError(
            f"the latent's picture needs scikit-learn: pip install wbc-bench[figures] ({error})"
        ) from error
