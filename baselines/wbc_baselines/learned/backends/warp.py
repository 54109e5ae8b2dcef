"""mujoco_warp on a GPU: thousands of simulations of the same model, in single precision.

Runs on a GPU are not deterministic, so it is for training alone. A world's buffers are of fixed size: an
overflow is undefined behaviour, and ends the run with one line. At the start of an episode no contact has
been solved yet, so the soles' forces are zero there, where `mujoco.batch` has those of its forward pass.
"""

from typing import Any

import mujoco
import mujoco_warp as mjw  # pyright: ignore[reportMissingImports]
import numpy as np
import torch
import warp as wp  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray
from torch import Tensor

from wbc_baselines.learned.backends.base import Start, State, state_of
from wbc_baselines.learned.settings import TrainingError
from wbc_bench.protocol import EvalProtocol
from wbc_bench.robot import NUM_LEG_JOINTS, load_robot
from wbc_bench.simulation import places_of

# Per world: 8 contacts of the soles, and room for what meets in a fall; 3 rows a contact, 14 joint limits.
CONTACTS, ROWS = 24, 96
_MODEL = ("geom_friction", "body_mass", "body_inertia", "actuator_gainprm", "actuator_biasprm")
_DERIVED = ("body_subtreemass", "body_invweight0", "dof_invweight0")  # of the base's mass
_STATE = ("qpos", "qvel", "ctrl", "qacc_warmstart", "time")
# Reaching an iteration limit is not an overflow of memory
_HARMLESS = int(mjw.OverflowType.ITERATIONS | mjw.OverflowType.LS_ITERATIONS)


class WarpBackend:
    """N worlds on a GPU, or on a CPU for a test."""

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
        self._fields = {name: wp.to_torch(getattr(self._m, name)) for name in _MODEL}
        outputs = ("site_xpos", "site_xmat", "actuator_force", "sensordata", "overflow")
        self._out = {name: wp.to_torch(getattr(self._d, name)) for name in outputs}
        self._places = places_of(model)
        self._base = model.body(self._robot.facts.base).id
        robot = self._robot
        self._default_q, self._kp, self._kd, self._effort = (
            self._tensor(a) for a in (robot.default_q, robot.kp, robot.kd, robot.effort)
        )
        self._graph: Any = None

    def _advance(self) -> None:
        """One control period, and the kinematics of the new state."""
        for _ in range(self._decimation):
            mjw.step(self._m, self._d)
        mjw.kinematics(self._m, self._d)

    def _launch(self) -> None:
        if self.device.type == "cpu":
            self._advance()
            return
        if self._graph is None:
            before = self.save()
            with wp.ScopedDevice(self._device):
                self._advance()  # compiles what a capture must not
                with wp.ScopedCapture() as capture:
                    self._advance()
            self._graph = capture.graph
            self._restore(before)
            torch.cuda.synchronize(self.device)
        # on torch's stream, so that neither library reads what the other is still writing
        wp.capture_launch(self._graph, stream=wp.stream_from_torch(torch.cuda.current_stream(self.device)))

    def reset(self, ids: NDArray[np.int64], start: Start) -> State:
        rows = torch.from_numpy(ids).to(self.device)
        self._randomise(rows, start)
        default, count = self._default_q, len(ids)
        qpos, qvel = torch.zeros(count, 21, device=self.device), torch.zeros(count, 20, device=self.device)
        qpos[:, 2], qpos[:, 3], qpos[:, 7:] = self._tensor(start.base_height), 1.0, default
        qpos[:, 7 : 7 + NUM_LEG_JOINTS] += self._tensor(start.leg_q)
        qvel[:, :6], qvel[:, 6 : 6 + NUM_LEG_JOINTS] = (
            self._tensor(start.base_vel),
            self._tensor(start.leg_qd),
        )
        self._state["qpos"][rows], self._state["qvel"][rows] = qpos, qvel
        self._state["ctrl"][rows] = default
        self._state["qacc_warmstart"][rows] = 0.0
        self._state["time"][rows] = 0.0
        self._on_torchs_stream(mjw.kinematics)
        # no forward pass for a few worlds of many: the PD law gives its torque
        torque = self._kp * self._tensor(start.kp_scale) * (default - qpos[:, 7:])
        torque -= self._kd * self._tensor(start.kd_scale) * qvel[:, 6:]
        self._out["actuator_force"][rows] = torque.clamp(-self._effort, self._effort)
        self._out["sensordata"][rows] = 0.0
        return self._read(rows)

    def _randomise(self, rows: Tensor, start: Start) -> None:
        """Friction, base mass and gains become model fields, as in the evaluation's simulation."""
        model, fields, base = self._host, self._fields, self._base
        # the larger coefficient of a pair counts, so both sides carry the draw
        fields["geom_friction"][rows, :, 0] = self._tensor(start.friction)[:, None]
        mass = self._tensor(model.body_mass[base] + start.base_mass)
        fields["body_mass"][rows, base] = mass
        inertia = self._tensor(model.body_inertia[base])
        fields["body_inertia"][rows, base] = inertia * (mass / float(model.body_mass[base]))[:, None]
        kp, kd = self._tensor(start.kp_scale), self._tensor(start.kd_scale)
        fields["actuator_gainprm"][rows, :, 0] = self._tensor(model.actuator_gainprm[:, 0]) * kp
        fields["actuator_biasprm"][rows, :, 1] = self._tensor(model.actuator_biasprm[:, 1]) * kp
        fields["actuator_biasprm"][rows, :, 2] = self._tensor(model.actuator_biasprm[:, 2]) * kd
        self._on_torchs_stream(mjw.set_const)

    def _on_torchs_stream(self, function: Any) -> None:
        if self.device.type == "cpu":
            function(self._m, self._d)
            return
        with wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(self.device))):
            function(self._m, self._d)

    def push(self, ids: Tensor, velocity_w: Tensor) -> None:
        self._state["qvel"][ids, :2] += velocity_w

    def step(self, command: Tensor) -> State:
        self._state["ctrl"][:] = command
        self._launch()
        over = int((self._out["overflow"] & ~_HARMLESS).max())
        if over:
            raise TrainingError(
                f"mujoco_warp: a world's buffer overflowed ({mjw.OverflowType(over)!r}); "
                f"larger CONTACTS than {CONTACTS} or ROWS than {ROWS} are needed"
            )
        return self._read(slice(None))

    def _read(self, ids: Tensor | slice) -> State:
        def take(name: str) -> Tensor:
            array = self._out.get(name, self._state.get(name))
            assert array is not None
            return array[ids].clone()

        qpos, qvel, sensor = take("qpos"), take("qvel"), take("sensordata")
        pos, rot = take("site_xpos"), take("site_xmat")
        return state_of(self._places, qpos, qvel, take("actuator_force"), pos, rot, sensor)

    def save(self) -> dict[str, NDArray]:
        return {name: array.cpu().numpy().copy() for name, array in (self._state | self._fields).items()}

    def load(self, saved: dict[str, NDArray]) -> None:
        self._restore(saved)
        self._on_torchs_stream(mjw.set_const)
        self._restore(saved)

    def _restore(self, saved: dict[str, NDArray]) -> None:
        for name, array in (self._state | self._fields).items():
            array.copy_(torch.from_numpy(saved[name]))

    def _tensor(self, array: NDArray[np.float64] | float) -> Tensor:
        return torch.tensor(np.asarray(array), dtype=torch.float32, device=self.device)
