"""mujoco_warp on a GPU: thousands of simulations of the same model, in single precision.

Runs on a GPU are not deterministic, so this backend is for training only. Buffers have a fixed size: a world
whose constraints overflow counts as diverged, and an overflow of the contacts of all worlds ends the run. At
the start of an episode no contact has been solved yet, so the forces on the soles are zero there, where
`mujoco.batch` has those of its forward pass.
"""

from collections.abc import Callable
from typing import Any

import mujoco
import mujoco_warp as mjw  # pyright: ignore[reportMissingImports]
import numpy as np
import torch
import warp as wp  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray
from torch import Tensor

from wbc_baselines.learned.training.backends.base import ResetState, State, columns_of, state_of
from wbc_baselines.learned.training.config import TrainingError
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.evaluation.simulation import places_of
from wbc_bench.robot import NUM_LEG_JOINTS, load_robot

# Per world: 8 contacts of the soles, and room for what meets in a fall; 3 rows a contact, 14 joint limits.
CONTACTS, ROWS = 32, 128
_MODEL = ("geom_friction", "body_mass", "body_inertia", "actuator_gainprm", "actuator_biasprm")
# What follows from the base's mass, by `mj_setConst`; tabulated, since mujoco_warp finds it for all worlds at
# once or for none. Between two of KNOTS masses it is linear to 1e-5.
_DERIVED = ("body_subtreemass", "body_invweight0", "dof_invweight0")
KNOTS = 65
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
        self._host = model = self._robot.model(protocol.physics.timestep)
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
        self._gain, self._bias = self._tensor(model.actuator_gainprm), self._tensor(model.actuator_biasprm)
        spread = protocol.randomization.base_mass
        self._lightest, self._span = spread[0], max(spread[1] - spread[0], 1e-9)
        self._derived = {name: self._tensor(a) for name, a in self._tabulate(spread).items()}
        self._graphs: dict[Any, Any] = {}

    def _tabulate(self, spread: tuple[float, float]) -> dict[str, NDArray[np.float64]]:
        """The fields _DERIVED at KNOTS masses added to the base, evenly over `spread` [kg]."""
        model = self._robot.model(self._host.opt.timestep)
        data, base = mujoco.MjData(model), self._base
        mass, inertia = model.body_mass[base], model.body_inertia[base].copy()
        rows: dict[str, list] = {name: [] for name in _DERIVED}
        for more in np.linspace(*spread, KNOTS):
            model.body_mass[base], model.body_inertia[base] = mass + more, inertia * (1 + more / mass)
            mujoco.mj_setConst(model, data)
            for name in _DERIVED:
                rows[name].append(getattr(model, name).copy())
        return {name: np.stack(row) for name, row in rows.items()}

    def _advance(self) -> None:
        """One control period, and the kinematics of the new state."""
        for _ in range(self._decimation):
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
        self._state["ctrl"][ids] = default
        self._state["qacc_warmstart"][ids] = 0.0
        self._state["time"][ids] = 0.0
        self._launch(self._place)
        # no forward pass for a few worlds of many: the PD law gives its torque
        torque = self._kp * reset.kp_scale * (default - qpos[:, 7:]) - self._kd * reset.kd_scale * qvel[:, 6:]
        self._out["actuator_force"][ids] = torque.clamp(-self._effort, self._effort)
        self._out["sensordata"][ids] = 0.0
        self._out["overflow"][ids] &= _OF_ALL
        return self._read(ids)

    def _randomise(self, ids: Tensor, reset: ResetState) -> None:
        """Friction, base mass and gains become model fields, as in the evaluation's simulation."""
        fields, base = self._fields, self._base
        # the larger coefficient of a pair counts, so both sides carry the draw
        fields["geom_friction"][ids, :, 0] = reset.friction[:, None]
        mass = self._mass + reset.base_mass
        fields["body_mass"][ids, base] = mass
        fields["body_inertia"][ids, base] = self._inertia * (mass / self._mass)[:, None]
        fields["actuator_gainprm"][ids, :, 0] = self._gain[:, 0] * reset.kp_scale
        fields["actuator_biasprm"][ids, :, 1] = self._bias[:, 1] * reset.kp_scale
        fields["actuator_biasprm"][ids, :, 2] = self._bias[:, 2] * reset.kd_scale
        place = ((reset.base_mass - self._lightest) / self._span).clamp(0, 1) * (KNOTS - 1)
        below = place.long().clamp(max=KNOTS - 2)
        for name, table in self._derived.items():
            part = (place - below).reshape(-1, *[1] * (table.ndim - 1))
            fields[name][ids] = torch.lerp(table[below], table[below + 1], part)

    def push(self, velocity_w: Tensor) -> None:
        self._state["qvel"][:, :2] += velocity_w

    def step(self, command: Tensor) -> State:
        self._state["ctrl"][:] = command
        self._launch(self._advance)
        return self._read(slice(None))

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
