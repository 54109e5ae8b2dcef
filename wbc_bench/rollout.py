"""One shard of episodes, from the manifest rows to the time series: the loop that every controller meets."""

import numpy as np
from numpy.typing import NDArray

from wbc_bench.controller import Controller, ProtocolAware
from wbc_bench.episodes import EpisodeBatch, Outcome
from wbc_bench.errors import ControllerError
from wbc_bench.manifest import EpisodeManifest
from wbc_bench.observation import Sensors
from wbc_bench.protocol import EvalProtocol
from wbc_bench.robot import NUM_JOINTS
from wbc_bench.rotations import geodesic_angle, matrix_from_wxyz
from wbc_bench.simulation import Simulation, State

RUNNING = ""


def evaluate(controller: Controller, protocol: EvalProtocol, rows: EpisodeManifest) -> EpisodeBatch:
    """Run a controller through the episodes of `rows`, all on this thread.

    Raises:
        ControllerError: the control period is not the protocol's, or a command has the wrong shape.
    """
    period, count, num_steps = protocol.control_period, len(rows), protocol.num_steps
    if abs(controller.info.control_period - period) > 1e-9:
        raise ControllerError(
            f"controller '{controller.info.name}' runs every {controller.info.control_period:g} s, "
            f"protocol {protocol.name} asks for {period:g} s"
        )
    if isinstance(controller, ProtocolAware):
        controller.prepare(protocol)
    simulation = Simulation(protocol, rows)
    sensors = Sensors(protocol, rows, controller.info.signals)
    target_rot_w = matrix_from_wxyz(rows.target_quat_w)
    push_step = np.full(rows.push_time.shape, -1)
    planned = np.isfinite(rows.push_time)
    push_step[planned] = np.round(rows.push_time[planned] / period)
    push_vel = rows.push_vel.reshape(count, -1, 2)

    position_error, orientation_error = np.full((2, count, num_steps), np.nan)
    action = np.full((count, num_steps, NUM_JOINTS), np.nan)
    ee_pos_w = np.full((count, num_steps, 3), np.nan)
    steps = np.zeros(count, dtype=np.int64)
    infeasible = np.zeros((count, num_steps), dtype=bool)
    ended = np.full(count, RUNNING, dtype=object)

    active = np.ones(count, dtype=bool)
    state = simulation.state()
    observation, target = sensors.observe(0, 0.0, state, active), sensors.target(state)
    controller.reset(rows.episode, observation, target)
    for step in range(num_steps):
        command = controller.act(observation, target)
        q = np.asarray(command.q)
        if q.shape != (count, NUM_JOINTS):
            raise ControllerError(
                f"controller '{controller.info.name}' returned commands of shape {q.shape}, "
                f"expected ({count}, {NUM_JOINTS})"
            )
        finite = np.isfinite(q).all(axis=1)
        ended[active & ~finite] = Outcome.INVALID
        active &= finite
        if not active.any():
            break
        action[active, step] = simulation.robot.action_of(q[active])
        if command.infeasible is not None:
            infeasible[:, step] = command.infeasible

        pushed = push_step == step
        if pushed.any():
            simulation.push(np.where(pushed[..., None] & active[:, None, None], push_vel, 0.0).sum(axis=1))
        simulation.step(q, active)
        state = simulation.state()
        steps[active] += 1
        position_error[active, step] = np.linalg.norm(state.ee_pos_w - rows.target_pos_w, axis=1)[active]
        orientation_error[active, step] = geodesic_angle(state.ee_rot_w, target_rot_w)[active]
        ee_pos_w[active, step] = state.ee_pos_w[active]
        for outcome, where in _terminations(protocol, state):
            ended[active & where] = outcome
            active &= ~where
        if not active.any():
            break
        observation = sensors.observe(step + 1, (step + 1) * period, state, active)
        target = sensors.target(state)

    window = protocol.window_steps
    inside = (position_error < protocol.success.position) & (orientation_error < protocol.success.orientation)
    outcome = _classify(ended, inside, infeasible, window)
    return EpisodeBatch(
        control_period=period,
        window=window,
        steps=steps,
        outcome=outcome,
        position_error=position_error,
        orientation_error=orientation_error,
        action=action,
        ee_pos_w=ee_pos_w,
        infeasible_steps=(infeasible & ~np.isnan(position_error)).sum(axis=1),
    )


def _terminations(protocol: EvalProtocol, state: State) -> list[tuple[Outcome, NDArray[np.bool_]]]:
    """Ways an episode ends early; the first that holds counts. Source: the paper, made deterministic."""
    limits = protocol.termination
    tilted = state.base_rot_w[:, 2, 2] < np.cos(limits.tilt)
    low = state.base_pos_w[:, 2] < limits.base_height
    return [
        (Outcome.INVALID, state.diverged),
        (Outcome.ILLEGAL_CONTACT, state.ground_contact & limits.illegal_contact),
        (Outcome.FELL, tilted | low),
    ]


def _classify(
    ended: NDArray[np.object_], inside: NDArray[np.bool_], infeasible: NDArray[np.bool_], window: int
) -> NDArray[np.object_]:
    """The outcome of each episode, (N,), from how it ended and its (N, T) steps inside the tolerance."""
    outcome = ended.copy()
    stood = ended == RUNNING
    held = inside[:, -window:].all(axis=1)
    reached = inside.any(axis=1)
    stuck = infeasible[:, -window:].any(axis=1)
    outcome[stood] = Outcome.MISSED
    outcome[stood & reached] = Outcome.DRIFTED
    outcome[stood & stuck] = Outcome.QP_INFEASIBLE
    outcome[stood & held] = Outcome.SUCCESS
    return outcome
