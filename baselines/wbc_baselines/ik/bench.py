"""`wbc-bench bench ik`: the entry point of `solve_times.py` that can be imported without the solvers."""

import pandas as pd

from wbc_bench.errors import BenchError, missing_extra


def ik_solve_times(targets: int = 20, steps: int = 60) -> pd.DataFrame:
    """Solve times of the packages, see `solve_times.solve_times`.

    Args:
        targets: Number of targets that every package walks to.
        steps: Number of inverse-kinematics steps per target.

    Returns:
        One row per package.

    Raises:
        BenchError: A package that the IK controller itself needs is not installed.
    """
    try:
        from wbc_baselines.ik.solve_times import solve_times
    except ImportError as error:
        raise BenchError(missing_extra("benchmark 'ik'", "bench", error)) from error
    return solve_times(targets, steps)
