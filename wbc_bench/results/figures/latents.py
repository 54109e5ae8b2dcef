"""The latent of a controller by phase of the task: t-SNE and LDA side by side."""

from pathlib import Path

import msgspec
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from wbc_bench.files import folder_name, write_atomic
from wbc_bench.results import stats
from wbc_bench.results.analysis import FloatArray
from wbc_bench.results.figures.style import BLUE, ORANGE, VERMILION, save, styled
from wbc_bench.results.formatting import CM
from wbc_bench.results.latents import (
    LOCOMOTION_ABOVE,
    PHASES,
    IntArray,
    Samples,
    Separation,
    _sklearn,
    separate,
)

PHASE_COLOURS = {"precision": BLUE, "approach": ORANGE, "locomotion": VERMILION}
DRAWN = 1500  # points of a picture; of so many, t-SNE takes most of a minute


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
        f"  precision below {samples.precision_below * CM:g} cm",
        "  approach between",
        f"  locomotion from {LOCOMOTION_ABOVE * CM:.0f} cm",
    ]


def latent_figure(name: str, samples: Samples, found: Separation, seed: int) -> Figure:
    """t-SNE of all episodes, LDA of the held-out ones, and the numbers beside them."""
    rng, phase = np.random.default_rng(seed), samples.phase
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
    spec: str, protocol: str, samples: Samples, seed: int, out_dir: Path, label: str | None = None
) -> tuple[Separation, list[Path]]:
    """Writes `latent_<controller>.png`, .svg and .json (numbers and caption) into a folder.

    `label` is the name of the controller in all figures of a report; its spec when not given.

    Raises: LatentError.
    """
    found = separate(samples, np.random.default_rng(seed))
    with styled():
        figure = latent_figure(label or spec, samples, found, seed)
        paths = save(figure, f"latent_{folder_name(spec)}", out_dir)
    accuracy = found.accuracy
    episodes = found.train_episodes + accuracy.num_episodes
    caption = (
        f"Latent of {label or spec} on {protocol}, {episodes} episodes, coloured by the phase of the task: "
        f"precision below {samples.precision_below * CM:g} cm of position error, locomotion from "
        f"{LOCOMOTION_ABOVE * CM:.0f} cm, approach between. A linear discriminant names "
        f"{_percent(accuracy)} of the steps of held-out episodes right, phases weighing alike; "
        f"chance is {100 * found.chance:.0f} %."
    )
    facts = {
        **{"caption": caption, "controller": spec, "protocol": protocol, "seed": seed},
        **{"columns": samples.latent.shape[1], "samples": len(samples.error)},
        **{"train_episodes": found.train_episodes, "held_out_episodes": accuracy.num_episodes},
        **{"balanced_accuracy": accuracy.point, "low": accuracy.low, "high": accuracy.high},
        **{"chance": found.chance, "thresholds_m": [samples.precision_below, LOCOMOTION_ABOVE]},
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
