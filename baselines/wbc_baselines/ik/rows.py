"""Arrays with one row per episode: a part of the episodes is taken out, changed, and put back."""

from collections.abc import Callable
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]
Found = TypeVar("Found", bound=NDArray[Any] | None)


class Rows:
    """Base of dataclasses whose fields are arrays (N, ...), or such dataclasses again."""

    def take(self, rows: NDArray[Any]) -> Self:
        """A copy of some episodes: indices, or a mask (N,)."""
        parts = vars(self).values()
        return type(self)(*(part.take(rows) if isinstance(part, Rows) else part[rows] for part in parts))

    def put(self, rows: NDArray[Any], part: Self) -> None:
        """Write back what `take` gave."""
        for mine, given in zip(vars(self).values(), vars(part).values(), strict=True):
            if isinstance(mine, Rows):
                mine.put(rows, given)
            else:
                mine[rows] = given


def on_part(mask: Mask, step: Callable[..., Found], state: Rows, *seen: Rows) -> Found:
    """Call a step on the episodes of a mask (N,), which has one at least, and keep what it changed of them.

    Returns:
        What the step returned, a row for each episode of the mask.
    """
    if mask.all():
        return step(state, *seen)
    part = state.take(mask)
    found = step(part, *(other.take(mask) for other in seen))
    state.put(mask, part)
    return found
