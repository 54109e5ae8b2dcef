"""How long an evaluation still takes, from what its finished shards cost."""

from collections.abc import Mapping

ENOUGH = 2  # shards of a controller before its speed is relied on: one alone may be of easy episodes


class TimeLeft:
    """An estimate per controller, since their speeds differ by an order of magnitude."""

    def __init__(self, missing: Mapping[str, int], workers: int | None) -> None:
        """`missing` episodes by controller; `workers` that compute them, None where nobody knows how many."""
        self._missing = dict(missing)
        self._workers = workers
        self._cost: dict[str, list[tuple[int, float]]] = {controller: [] for controller in missing}
        self._begin, self._end = float("inf"), 0.0  # [s] Unix time of what was computed

    def add(self, controller: str, episodes: int, started: float, seconds: float) -> None:
        """Count a finished shard in: its episodes, its start [Unix s] and how long it took [s]."""
        self._missing[controller] -= episodes
        self._cost[controller].append((episodes, seconds))
        self._begin, self._end = min(self._begin, started), max(self._end, started + seconds)

    def text(self) -> str:
        """What can be said: the time, a lower bound while controllers have not been measured, or nothing."""
        known, unknown = 0.0, 0
        for controller, episodes in self._missing.items():
            shards = self._cost[controller]
            if episodes and len(shards) < ENOUGH:
                unknown += 1
            elif episodes:
                known += episodes * sum(s for _, s in shards) / sum(n for n, _ in shards)
        seconds = known / (self._workers or self._concurrency())
        if not unknown:
            return f"{seconds:.0f} s left"
        more = f"{unknown} {'controller' if unknown == 1 else 'controllers'} not measured yet"
        return f"at least {seconds:.0f} s left, {more}" if known else "time left unknown"

    def _concurrency(self) -> float:
        """Shards that were computed at a time, on average."""
        busy = sum(seconds for shards in self._cost.values() for _, seconds in shards)
        return max(busy / max(self._end - self._begin, 1e-9), 1.0)
