"""How a controller moves the robot: how soon it arrives, and what that costs."""

from collections.abc import Mapping

import numpy as np
import pandas as pd

from wbc_bench.results.analysis import MOTION, Evaluated
from wbc_bench.results.analysis import column as series
from wbc_bench.results.formatting import CM, spread_text
from wbc_bench.results.study import Study, methods_of
from wbc_bench.results.table import Table
from wbc_bench.results.tables.paper import Column, _flat, columns_over_replicates

COLUMNS = (
    Column("time_to_reach", "Time to reach ↓ (s)", "time_to_reach", None, 1.0, 2),
    Column("push_error", "Error after a push ↓ (cm)", "push_error", None, CM, 1),
    Column("foot_slip", "Foot slip ↓ (cm)", "foot_slip", None, CM, 1),
    Column("energy", "Energy ↓ (J)", "energy", None, 1.0, 0),
    Column("mean_power", "Mean power ↓ (W)", "mean_power", None, 1.0, 1),
    Column("torque_limit_share", "At a torque limit ↓ (% of steps)", "torque_limit_share", None, 100.0, 1),
    Column("speed_limit_share", "At a speed limit ↓ (% of steps)", "speed_limit_share", None, 100.0, 1),
    Column("command_rate", "Command rate ↓ (rad/s)", "command_rate", None, 1.0, 2),
    Column("action_variation_rad", "Variation ↓ (rad²)", "action_variation_rad", None, 1.0, 4),
)


def motion_table(study: Study, evaluated: Mapping[str, Evaluated]) -> Table:
    """Time to reach, errors after pushes, slip, energy, limits and rates of episodes that did not terminate.

    Controllers whose records are older than these metrics have no row.
    """
    rows, data = [], []
    for label, method in methods_of(study, evaluated):
        if all(np.isnan(series(method.episodes, name)).all() for name in MOTION):
            continue
        over = method.not_terminated
        values = columns_over_replicates(method, over, columns=COLUMNS)
        rows.append((label, str(int(over.sum())), *(spread_text(values[c.name], c.digits) for c in COLUMNS)))
        data.append({"controller": method.spec, "episodes": int(over.sum()), **_flat(values)})
    header = ("Method", "Episodes", *(column.header for column in COLUMNS))
    notes = (
        "Mean over the episodes that did not terminate, ± sample standard deviation over replicates.",
        "Time to reach: when both errors come inside the tolerances and stay there for the window of "
        "success, of the episodes in which they do. Error after a push: the largest within 2 s of a push "
        "that met the end-effector inside the tolerances.",
        "Energy: positive mechanical work of all motors over the episode. At a limit: control steps in "
        "which some joint reaches its torque limit, or its speed limit. Command rate: root mean square over "
        "joints and steps of the change of commands per second; variation: as action variation, of commands "
        "in rad, so that controllers of other action scales compare.",
    )
    title = f"{study.name}: how the robot moved"
    return Table(f"{study.name}_motion", title, header, tuple(rows), notes, pd.DataFrame(data))
