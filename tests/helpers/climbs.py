"""Made-up controllers on a severity ladder; nothing here is a result."""

import numpy as np
from numpy.typing import ArrayLike

from wbc_bench.results.stress import Climb, FactorRecord, LadderRecord, LevelRecord, Stress


def factor(name: str, *severities: float, unit: str = "kg") -> FactorRecord:
    levels = tuple(LevelRecord(float(v), f"made@{name}@{v:g}", "d" * 64) for v in severities)
    return FactorRecord(name, name.capitalize(), unit, levels)


def ladder(*factors: FactorRecord, episodes: int = 20) -> LadderRecord:
    return LadderRecord("made", "ablation_v1", LevelRecord(0.0, "made@base", "d" * 64), episodes, factors)


def climb(spec: str, base: int, episodes: int = 20, **levels: ArrayLike) -> Climb:
    """A controller that solves the first so many episodes, at the base and at every level of a factor."""
    order = np.arange(episodes)

    def solved(count: ArrayLike) -> np.ndarray:
        return (order[:, None] < np.asarray(count)).astype(np.float64)

    return Climb(spec, spec, (), solved(base)[:, 0], {name: solved(n) for name, n in levels.items()})


def made_up(controllers: int = 3, factors: int = 3, episodes: int = 40) -> Stress:
    """Controllers of different skill whose success falls with the level; some episodes are hard for all."""
    falling = [factor(f"f{k}", *np.linspace(0.0, 2.0, 6)) for k in range(factors - 1)]
    record = ladder(*falling, factor("strength", 1.0, 0.9, 0.7, 0.5), episodes=episodes)
    rng = np.random.default_rng(5)
    hardness = rng.random(episodes)
    climbs = []
    for k in range(controllers):
        skill = 0.95 - 0.1 * k
        levels = {
            each.name: (hardness[:, None] + 0.1 * rng.random((episodes, len(each.levels))))
            < skill * np.linspace(1.0, 0.15 * j + 0.1 * k, len(each.levels))
            for j, each in enumerate(record.factors)
        }
        solved = {name: value.astype(np.float64) for name, value in levels.items()}
        climbs.append(Climb(f"c{k}", f"Controller {k}", (), (hardness < skill).astype(np.float64), solved))
    return Stress(record, tuple(climbs))
