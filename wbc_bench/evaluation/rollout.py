"""One shard of episodes, from the manifest rows to the time series: the loop that every controller meets."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from wbc_bench.controller import Controller
from wbc_bench.episodes.manifest import EpisodeManifest
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.evaluation.control_loop import RUNNING, ControlLoop
from wbc_bench.evaluation.simulation import State
from wbc_bench.outcomes import EpisodeBatch, Outcome
from wbc_bench.robot import NUM_JOINTS
from wbc_bench.rotations import geodesic_angle, matrix_from_wxyz

LOADED = 30.0  # [N] on a sole, a tenth of the robot's weight: it stands and does not just touch


def rollout(
    controller: Controller,
    protocol: EvalProtocol,
    rows: EpisodeManifest,
    on_step: Callable[[ControlLoop], None] | None = None,
) -> EpisodeBatch:
    """Run a controller through the episodes of `rows`, all on this thread.

    `on_step` is called with the loop at the start and after every control step; it may read everything but
    change nothing.

    Raises:
        ControllerError: the control period is not the protocol's, or a command has the wrong shape.
    """
    period, count, num_steps = protocol.control_period, len(rows), protocol.num_steps
    loop = ControlLoop(controller, protocol, rows)
    target_rot_w = matrix_from_wxyz(rows.target_quat_w)

    position_error, orientation_error = np.full((2, count, num_steps), np.nan)
    commands = np.full((count, num_steps, NUM_JOINTS), np.nan)
    actions: NDArray[np.float64] | None = None  # (N, T, A) of commands that are more than positions
    work, slip = np.full((2, count, num_steps), np.nan)
    at_torque_limit, at_speed_limit = np.zeros((2, count, num_steps), dtype=bool)
    ee_pos_w = np.full((count, num_steps, 3), np.nan)
    steps = np.zeros(count, dtype=np.int64)
    infeasible = np.zeros((count, num_steps), dtype=bool)

    if on_step is not None:
        on_step(loop)
    before = loop.state
    for number, (stepped, q, stuck, action) in enumerate(loop.run()):
        if not stepped.any():
            break
        if on_step is not None:
            on_step(loop)
        state = loop.state
        step, part = divmod(number, loop.parts)
        commands[stepped, step] = q[stepped]
        if action is not None:
            if actions is None:
                actions = np.full((count, num_steps, action.shape[1]), np.nan)
            actions[stepped, step] = action[stepped]
        load, slipped = loop.simulation.load, _slip(before, state)
        before = state
        if part == 0:
            steps[stepped] += 1
            work[stepped, step] = load.work[stepped]
            slip[stepped, step] = slipped[stepped]
        else:
            work[stepped, step] += load.work[stepped]
            slip[stepped, step] += slipped[stepped]
        at_torque_limit[:, step] |= load.at_torque_limit
        at_speed_limit[:, step] |= load.at_speed_limit
        if stuck is not None:
            infeasible[:, step] |= stuck
        position_error[stepped, step] = np.linalg.norm(state.ee_pos_w - rows.target_pos_w, axis=1)[stepped]
        orientation_error[stepped, step] = geodesic_angle(state.ee_rot_w, target_rot_w)[stepped]
        ee_pos_w[stepped, step] = state.ee_pos_w[stepped]

    window = protocol.window_steps
    inside = (position_error < protocol.success.position) & (orientation_error < protocol.success.orientation)
    outcome = _classify(loop.ended, inside, infeasible, window)
    return EpisodeBatch(
        control_period=period,
        window=window,
        steps=steps,
        outcome=outcome,
        position_error=position_error,
        orientation_error=orientation_error,
        action=loop.simulation.robot.action_of(commands) if actions is None else actions,
        command=commands,
        ee_pos_w=ee_pos_w,
        inside=inside,
        work=work,
        at_torque_limit=at_torque_limit,
        at_speed_limit=at_speed_limit,
        slip=slip,
        push_step=loop.push_step,
        infeasible_steps=(infeasible & ~np.isnan(position_error)).sum(axis=1),
    )


def _slip(before: State, now: State) -> NDArray[np.float64]:
    """Way (N,) [m] of the soles along the ground in a control step, of those loaded at both of its ends."""
    loaded = (before.foot_force_w[:, :, 2] > LOADED) & (now.foot_force_w[:, :, 2] > LOADED)  # (N, 2)
    way = np.linalg.norm((now.foot_pos_w - before.foot_pos_w)[:, :, :2], axis=2)
    return np.where(loaded, way, 0.0).sum(axis=1)


def _classify(
    ended: NDArray[np.object_], inside: NDArray[np.bool_], infeasible: NDArray[np.bool_], window: int
) -> NDArray[np.object_]:
    """The outcome of each episode, (N,), from how it ended and its (N, T) steps inside the tolerance."""
    outcome = ended.copy()
    not_terminated = ended == RUNNING
    held = inside[:, -window:].all(axis=1)
    reached = inside.any(axis=1)
    stuck = infeasible[:, -window:].any(axis=1)
    outcome[not_terminated] = Outcome.MISSED
    outcome[not_terminated & reached] = Outcome.DRIFTED
    outcome[not_terminated & stuck] = Outcome.QP_INFEASIBLE
    outcome[not_terminated & held] = Outcome.SUCCESS
    return outcome
