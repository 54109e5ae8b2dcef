"""Training on MuJoCo's batch API, the engine of the evaluation, on several CPU threads."""

from types import SimpleNamespace

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from numpy.typing import NDArray
from torch import Tensor

from wbc_baselines.learned.training.backends.base import (
    Reading,
    ResetState,
    State,
    columns_of,
    state_of,
)
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.episodes.world import PAYLOAD, world_model
from wbc_bench.evaluation.simulation import FATAL_WARNINGS, places_of, scale_gains
from wbc_bench.robot import NUM_LEG_JOINTS, load_robot

_STAGE_NONE, _STAGE_VEL = mujoco.mjtStage.mjSTAGE_NONE, mujoco.mjtStage.mjSTAGE_VEL
_STATE = ("qpos", "qvel", "ctrl", "qacc_warmstart", "time")
_GAINS = ("actuator_gainprm", "actuator_biasprm")
_MODEL = (*_GAINS, "actuator_forcerange", "geom_friction", "body_mass", "body_inertia", "body_ipos")


class CpuBackend:
    """N simulations on `threads` threads; the result does not depend on the number of threads."""

    def __init__(self, protocol: EvalProtocol, num_envs: int, threads: int) -> None:
        self.num_envs, self.device = num_envs, torch.device("cpu")
        self._robot = robot = load_robot(protocol.robot)
        self._model = model = world_model(protocol)
        self._decimation = protocol.physics.decimation
        self._batch = batch = Batch(model, num_envs, nthread=threads, persistent=True)
        self._state = {name: batch.bind(name) for name in _STATE}
        self._fields = {name: batch.expand(name) for name in _MODEL}
        outputs = {name: batch.bind(name) for name in ("site_xpos", "site_xmat", "sensordata")}
        self._out = outputs | {"actuator_force": batch.bind("actuator_force")}
        self._columns = columns_of(places_of(model), self.device)
        self._base = model.body(robot.facts.base).id
        self._hand = model.body(PAYLOAD).id if protocol.randomization.payload[1] else None

    def reset(self, ids: Tensor, reset: ResetState) -> State:
        rows: NDArray[np.int64] = ids.numpy()
        drawn = SimpleNamespace(**{name: column.numpy() for name, column in reset._asdict().items()})
        self._randomise(rows, drawn)
        self._batch.reset(rows, stage=_STAGE_NONE)
        default = self._robot.default_q
        qpos, qvel = np.zeros((len(rows), 21)), np.zeros((len(rows), 20))
        qpos[:, 2], qpos[:, 3], qpos[:, 7:] = drawn.base_height, 1.0, default
        qpos[:, 7 : 7 + NUM_LEG_JOINTS] += drawn.leg_q
        qvel[:, :6], qvel[:, 6 : 6 + NUM_LEG_JOINTS] = drawn.base_vel, drawn.leg_qd
        self._state["qpos"][rows], self._state["qvel"][rows] = qpos, qvel
        self._state["ctrl"][rows] = default - drawn.joint_offset
        self._batch.forward(rows)
        return self._read(rows)

    def _randomise(self, ids: NDArray[np.int64], reset: SimpleNamespace) -> None:
        """Draws of the robot and its ground become model fields, as in the evaluation's simulation."""
        model, fields, base = self._model, self._fields, self._base
        # the larger coefficient of a pair counts, so both sides carry the draw
        fields["geom_friction"][ids, :, 0] = reset.friction[:, None]
        mass = model.body_mass[base] + reset.base_mass
        fields["body_mass"][ids, base] = mass
        fields["body_inertia"][ids, base] = model.body_inertia[base] * (mass / model.body_mass[base])[:, None]
        gains = {name: np.tile(getattr(model, name), (len(ids), 1, 1)) for name in _GAINS}
        scale_gains(self._robot, gains.__getitem__, reset.kp_scale, reset.kd_scale)
        for name, scaled in gains.items():
            fields[name][ids] = scaled
        fields["actuator_forcerange"][ids] = model.actuator_forcerange * reset.motor_strength[:, None, None]
        if self._hand is not None:
            fields["body_mass"][ids, self._hand] = reset.payload
            fields["body_ipos"][ids, self._hand] = reset.payload_offset
        self._batch.set_const(ids)

    def push(self, velocity: Tensor) -> None:
        self._state["qvel"][:, :6] += velocity.numpy()

    def step(self, commands: Tensor) -> tuple[list[Reading], State]:
        *earlier, last = commands.numpy()
        nstep, readings = self._decimation // len(commands), []
        for command in earlier:
            self._state["ctrl"][:] = command
            self._batch.step(nstep=nstep, stage=_STAGE_NONE)
            arrays = self._state["qpos"], self._state["qvel"], self._out["actuator_force"]
            readings.append(Reading(*(torch.from_numpy(array.astype(np.float32)) for array in arrays)))
        self._state["ctrl"][:] = last
        self._batch.step(nstep=nstep, stage=_STAGE_VEL)
        return readings, self._read(slice(None))

    def _read(self, ids: NDArray[np.int64] | slice) -> State:
        def take(array: NDArray[np.float64]) -> Tensor:
            return torch.from_numpy(array[ids].astype(np.float32))

        qpos, qvel = take(self._state["qpos"]), take(self._state["qvel"])
        pos, rot = take(self._out["site_xpos"]), take(self._out["site_xmat"]).unflatten(-1, (3, 3))
        sensor = take(self._out["sensordata"])
        state = state_of(self._columns, qpos, qvel, take(self._out["actuator_force"]), pos, rot, sensor)
        fatal = torch.from_numpy((self._batch.warning[ids][:, FATAL_WARNINGS, 1] > 0).any(1))
        return state._replace(diverged=state.diverged | fatal)

    def check(self) -> None:
        pass  # the engine's warnings are read at every step

    def save(self) -> dict[str, NDArray]:
        return {name: array.copy() for name, array in (self._state | self._fields).items()}

    def load(self, saved: dict[str, NDArray]) -> None:
        for name, array in self._fields.items():
            array[:] = saved[name]
        self._batch.set_const()
        self._batch.reset(stage=_STAGE_NONE)
        for name, array in self._state.items():
            array[:] = saved[name]
        self._batch.forward(stage=_STAGE_VEL)
        # forward leaves the solver's warm start as the reset found it
        self._state["qacc_warmstart"][:] = saved["qacc_warmstart"]
