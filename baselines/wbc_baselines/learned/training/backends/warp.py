"""mujoco_warp on a GPU: thousands of simulations of the same model, in single precision.

Runs on a GPU are not deterministic, so this backend is for training only. Buffers have a fixed size: a world
whose constraints overflow counts as diverged, and an overflow of the contacts of all worlds ends the run. At
the start of an episode no contact has been solved yet, so the forces on the soles are zero there, where
`mujoco.batch` has those of its forward pass.
"""

import itertools
from collections.abc import Callable
from typing import Any

import mujoco
import mujoco_warp as mjw  # pyright: ignore[reportMissingImports]
import numpy as np
import torch
import warp as wp  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray
from torch import Tensor

from wbc_baselines.learned.training.backends.base import (
    Reading,
    ResetState,
    State,
    columns_of,
    state_of,
)
from wbc_baselines.learned.training.config import TrainingError
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.episodes.world import PAYLOAD, world_model
from wbc_bench.evaluation.simulation import places_of, scale_gains
from wbc_bench.robot import NUM_LEG_JOINTS, load_robot

# Per world: 8 contacts of the soles, and room for what meets in a fall; 3 rows a contact, 14 joint limits.
CONTACTS, ROWS = 32, 128
_GAINS = ("actuator_gainprm", "actuator_biasprm")
_MODEL = (*_GAINS, "actuator_forcerange", "geom_friction", "body_mass", "body_inertia", "body_ipos")
# What follows from the masses of base and payload, by `mj_setConst`; tabulated, since mujoco_warp finds it
# for all worlds at once or for none. Between two of KNOTS masses it is linear to 1e-5. The payload's place in
# the hand is left out: it changes no mass, only how soft contacts and limits are.
_DERIVED = ("body_subtreemass", "body_invweight0", "dof_invweight0")
KNOTS, PAYLOAD_KNOTS = 65, 9
_STATE = ("qpos", "qvel", "ctrl", "qacc_warmstart", "time")
# Overflows of what all worlds share, and of one world's memory; the others cost accuracy at most.
_OF_ALL = int(mjw.OverflowType.BROADPHASE | mjw.OverflowType.NARROWPHASE)
_OF_ONE = int(mjw.OverflowType.NEFC | mjw.OverflowType.NJMAX_NNZ | mjw.OverflowType.CONTACT_MATCH)


class WarpBackend:
    """N worlds on a GPU, or on a CPU for tests."""

    def __init__(self, protocol: EvalProtocol, num_envs: int, device: str = "cuda") -> None:
        if device == "cuda" and not wp.is_cuda_available():
            raise TrainingError("--backend warp: no CUDA device was found, valid: --backend cpu")
        wp.config.quiet = True
        self.num_envs, self.device = num_envs, torch.device(device)
        self._robot = load_robot(protocol.robot)
        self._decimation = protocol.physics.decimation
        self._host = model = world_model(protocol)
        model.opt.disableflags = 0  # MuJoCo Warp refuses a flag of what it does not have
        self._device = wp.get_device(device)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        with wp.ScopedDevice(self._device):
            sizes: dict[str, int] = dict.fromkeys((*_MODEL, *_DERIVED), num_envs)
            self._m: Any = mjw.put_model(model, batch_sizes=sizes)
            self._m.opt.warn_overflow = 0  # read at every step instead
            self._d: Any = mjw.put_data(model, data, nworld=num_envs, nconmax=CONTACTS, njmax=ROWS)
        self._state = {name: wp.to_torch(getattr(self._d, name)) for name in _STATE}
        self._fields = {name: wp.to_torch(getattr(self._m, name)) for name in (*_MODEL, *_DERIVED)}
        outputs = ("site_xpos", "site_xmat", "actuator_force", "sensordata", "overflow")
        self._out = {name: wp.to_torch(getattr(self._d, name)) for name in outputs}
        self._columns = columns_of(places_of(model), self.device)
        self._base = model.body(self._robot.facts.base).id
        robot = self._robot
        self._default_q, self._kp, self._kd, self._effort = (
            self._tensor(a) for a in (robot.default_q, robot.kp, robot.kd, robot.effort)
        )
        self._mass = float(model.body_mass[self._base])
        self._inertia = self._tensor(model.body_inertia[self._base])
        fields = (*_GAINS, "actuator_forcerange")
        self._nominal = {name: self._tensor(getattr(model, name)) for name in fields}
        spread = protocol.randomization
        self._hand = model.body(PAYLOAD).id if spread.payload[1] else None
        self._knots = (
            np.linspace(*spread.base_mass, KNOTS),
            np.linspace(0.0, spread.payload[1], PAYLOAD_KNOTS if spread.payload[1] else 1),
        )
        self._derived = {name: self._tensor(a) for name, a in self._tabulate(protocol).items()}
        self._graphs: dict[Any, Any] = {}

    def _tabulate(self, protocol: EvalProtocol) -> dict[str, NDArray[np.float64]]:
        """The fields _DERIVED at the knots of the base's added mass and of the payload."""
        model = world_model(protocol)
        data, base = mujoco.MjData(model), self._base
        mass, inertia = model.body_mass[base], model.body_inertia[base].copy()
        rows: dict[str, list] = {name: [] for name in _DERIVED}
        for more, payload in itertools.product(*self._knots):
            model.body_mass[base], model.body_inertia[base] = mass + more, inertia * (1 + more / mass)
            if self._hand is not None:
                model.body_mass[self._hand] = payload
            mujoco.mj_setConst(model, data)
            for name in _DERIVED:
                rows[name].append(getattr(model, name).copy())
        shape = tuple(map(len, self._knots))
        return {name: np.stack(row).reshape(*shape, *row[0].shape) for name, row in rows.items()}

    def _advance(self) -> None:
        """One control period, and the kinematics of the new state."""
        for _ in range(self._decimation):
            mjw.step(self._m, self._d)
        self._place()

    def _advance_once(self) -> None:
        """One physics step."""
        mjw.step(self._m, self._d)

    def _finish(self) -> None:
        """The last physics step of a control period, and the kinematics of the new state."""
        mjw.step(self._m, self._d)
        self._place()

    def _place(self) -> None:
        """The kinematics of every world."""
        mjw.kinematics(self._m, self._d)

    def _launch(self, work: Callable[[], None]) -> None:
        """Run `work`; on a GPU as a captured graph, which launches thousands of small kernels at once."""
        if self.device.type == "cpu":
            work()
            return
        if work not in self._graphs:
            before = self.save()
            with wp.ScopedDevice(self._device):
                work()  # compiles what a capture must not
                with wp.ScopedCapture() as capture:
                    work()
            self._graphs[work] = capture.graph
            self.load(before)
            torch.cuda.synchronize(self.device)
        # on torch's stream, so that neither library reads what the other is still writing
        stream = wp.stream_from_torch(torch.cuda.current_stream(self.device))
        wp.capture_launch(self._graphs[work], stream=stream)

    def reset(self, ids: Tensor, reset: ResetState) -> State:
        reset = ResetState(*(column.float() for column in reset))
        self._randomise(ids, reset)
        default, count = self._default_q, len(ids)
        qpos, qvel = torch.zeros(count, 21, device=self.device), torch.zeros(count, 20, device=self.device)
        qpos[:, 2], qpos[:, 3], qpos[:, 7:] = reset.base_height, 1.0, default
        qpos[:, 7 : 7 + NUM_LEG_JOINTS] += reset.leg_q
        qvel[:, :6], qvel[:, 6 : 6 + NUM_LEG_JOINTS] = reset.base_vel, reset.leg_qd
        self._state["qpos"][ids], self._state["qvel"][ids] = qpos, qvel
        self._state["ctrl"][ids] = default - reset.joint_offset
        self._state["qacc_warmstart"][ids] = 0.0
        self._state["time"][ids] = 0.0
        self._launch(self._place)
        # no forward pass for a few worlds of many: the PD law gives its torque
        error = default - reset.joint_offset - qpos[:, 7:]
        torque = self._kp * reset.kp_scale * error - self._kd * reset.kd_scale * qvel[:, 6:]
        effort = self._effort * reset.motor_strength[:, None]
        self._out["actuator_force"][ids] = torque.clamp(-effort, effort)
        self._out["sensordata"][ids] = 0.0
        self._out["overflow"][ids] &= _OF_ALL
        return self._read(ids)

    def _randomise(self, ids: Tensor, reset: ResetState) -> None:
        """Draws of the robot and its ground become model fields, as in the evaluation's simulation."""
        fields, base = self._fields, self._base
        # the larger coefficient of a pair counts, so both sides carry the draw
        fields["geom_friction"][ids, :, 0] = reset.friction[:, None]
        mass = self._mass + reset.base_mass
        fields["body_mass"][ids, base] = mass
        fields["body_inertia"][ids, base] = self._inertia * (mass / self._mass)[:, None]
        gains = {name: self._nominal[name].repeat(len(ids), 1, 1) for name in _GAINS}
        scale_gains(self._robot, gains.__getitem__, reset.kp_scale, reset.kd_scale)
        for name, scaled in gains.items():
            fields[name][ids] = scaled
        limits = self._nominal["actuator_forcerange"] * reset.motor_strength[:, None, None]
        fields["actuator_forcerange"][ids] = limits
        if self._hand is not None:
            fields["body_mass"][ids, self._hand] = reset.payload
            fields["body_ipos"][ids, self._hand] = reset.payload_offset
        drawn = zip(self._knots, (reset.base_mass, reset.payload), strict=True)
        row, column = (_place_among(knots, values) for knots, values in drawn)
        for name, table in self._derived.items():
            fields[name][ids] = _interpolated(table, row, column)

    def push(self, velocity: Tensor) -> None:
        self._state["qvel"][:, :6] += velocity

    def step(self, commands: Tensor) -> tuple[list[Reading], State]:
        readings, one = [], len(commands) == 1
        for command in commands[:-1]:
            self._state["ctrl"][:] = command
            self._launch(self._advance_once)
            arrays = self._state["qpos"], self._state["qvel"], self._out["actuator_force"]
            readings.append(Reading(*(array.clone() for array in arrays)))
        self._state["ctrl"][:] = commands[-1]
        self._launch(self._advance if one else self._finish)
        return readings, self._read(slice(None))

    def check(self) -> None:
        if int((self._out["overflow"] & _OF_ALL).max()):
            raise TrainingError(
                f"mujoco_warp: {self.num_envs} worlds had more contacts than {CONTACTS} each: "
                "larger CONTACTS are needed"
            )

    def _read(self, ids: Tensor | slice) -> State:
        def take(name: str) -> Tensor:
            array = self._out.get(name, self._state.get(name))
            assert array is not None
            return array[ids].clone()

        qpos, qvel, sensor = take("qpos"), take("qvel"), take("sensordata")
        pos, rot = take("site_xpos"), take("site_xmat")
        state = state_of(self._columns, qpos, qvel, take("actuator_force"), pos, rot, sensor)
        return state._replace(diverged=state.diverged | ((take("overflow") & _OF_ONE) != 0))

    def save(self) -> dict[str, NDArray]:
        return {name: array.cpu().numpy().copy() for name, array in (self._state | self._fields).items()}

    def load(self, saved: dict[str, NDArray]) -> None:
        for name, array in (self._state | self._fields).items():
            array.copy_(torch.from_numpy(saved[name]))

    def _tensor(self, array: NDArray[np.float64] | float) -> Tensor:
        return torch.tensor(np.asarray(array), dtype=torch.float32, device=self.device)


def _place_among(knots: NDArray[np.float64], values: Tensor) -> Tensor:
    """Fractional index (K,) of values among knots that are evenly spaced; 0 where there is one knot."""
    span = max(float(knots[-1] - knots[0]), 1e-9)
    return ((values - float(knots[0])) / span).clamp(0, 1) * (len(knots) - 1)


def _interpolated(table: Tensor, row: Tensor, column: Tensor) -> Tensor:
    """Values (K, ...) of a table (R, C, ...) at fractional rows and columns (K,), linear between entries."""
    rows, columns = (size - 1 for size in table.shape[:2])
    r, c = row.long(), column.long()
    below, right = (r + 1).clamp(max=rows), (c + 1).clamp(max=columns)
    down, across = ((place - k).reshape(-1, *[1] * (table.ndim - 2)) for place, k in ((row, r), (column, c)))
    upper = torch.lerp(table[r, c], table[r, right], across)
    return torch.lerp(upper, torch.lerp(table[below, c], table[below, right], across), down)
