"""Which controllers are installed, without loading any of them."""

from functools import cache
from importlib.metadata import EntryPoint, entry_points

ENTRY_POINTS = "wbc_bench.controllers"
# the harness itself brings no controller, but what makes one of a file or of an address
OWN = (
    EntryPoint("policy", "wbc_bench.policies:make", ENTRY_POINTS),
    EntryPoint("remote", "wbc_bench.remote:make", ENTRY_POINTS),
)


@cache
def controllers() -> dict[str, EntryPoint]:
    """Installed controllers by name."""
    return {point.name: point for point in (*OWN, *entry_points(group=ENTRY_POINTS))}


def is_installed(spec: str) -> bool:
    """Whether a spec names an installed controller, or a variant of one, and not code of a user."""
    return spec.partition(":")[0] in controllers()
