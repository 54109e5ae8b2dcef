"""Trained policies as controllers of the benchmark: batched, deterministic, on one thread."""

import warnings
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wbc_baselines.learned.policy import checkpoint, inputs
from wbc_baselines.learned.policy.card import CheckpointError, PolicyCard, check_fit, other_conditions
from wbc_baselines.learned.policy.methods import METHODS
from wbc_baselines.learned.policy.onnx_engine import OnnxEngine
from wbc_baselines.learned.policy.policy import Flow, Policy
from wbc_baselines.learned.policy.reference import (
    advance,
    initial_reference,
    pose_errors,
    rotation_from_rho6,
)
from wbc_bench.controller import ControllerInfo, JointCommand, Observation, Target
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.robot import Robot

REFERENCE_DECAY = 1.0  # [1/s] where no protocol says otherwise. Source: default of wbc_bench.protocol


class Engine(Protocol):
    """The implementation that computes a policy: torch, or a runtime of exported files."""

    flow: Flow

    def __call__(self, values: dict[str, Tensor]) -> dict[str, Tensor]: ...


class LearnedController:
    """Assembles the inputs of a policy, keeps its window and recurrent state, and scales its actions.

    All values are float32; latent and action are means. Rows are independent, but a matrix product may round
    differently for another number of rows: the same shard is computed bit-equal. The first actions of an
    episode alone agree with it to 1e-5; later, contacts amplify that to centimetres at the hand.
    """

    formats = ("onnx",)

    def __init__(
        self,
        robot: Robot,
        card: PolicyCard,
        engine: Engine,
        name: str,
        sha256: str,
        files: tuple[Path, ...] = (),
    ) -> None:
        torch.set_num_threads(1)
        period = card.robot.control_period
        trained = f"{card.samples:.3g} control steps of {card.protocol}"
        self.info = ControllerInfo(
            name, METHODS[card.method].signals, period, f"wbc_baselines.learned, {trained}", files
        )
        self.card, self.checkpoint_sha256 = card, sha256
        self._robot, self._engine, self._decay = robot, engine, REFERENCE_DECAY
        self._latent: Tensor | None = None
        self._default_q = _tensor(robot.default_q)

    def prepare(self, protocol: EvalProtocol) -> None:
        """Take the decay of the reference from a protocol, and warn if its conditions differ from training.

        Args:
            protocol: Protocol of the evaluation.

        Raises:
            CheckpointError: Robot or control period differ from the training, see `check_fit`.
        """
        check_fit(self.card, self._robot, protocol.control_period, self.info.name)
        if differences := other_conditions(self.card, protocol):
            warnings.warn(
                f"{self.info.name} meets conditions it was not trained on: {differences}", stacklevel=2
            )
        self._decay = protocol.reference_decay

    @torch.inference_mode()
    def reset(self, episodes: NDArray[np.int64], obs: Observation, target: Target) -> None:
        """Fill the windows with the first observation, and start with zero state and action."""
        assert obs.ee_pose is not None
        pos, rot6 = _tensor(obs.ee_pose.pos_b), _tensor(obs.ee_pose.rot6_b)
        errors = pose_errors(pos, rotation_from_rho6(rot6), _tensor(target.pos_b), _tensor(target.rot_b))
        self._d_ref, self._first = initial_reference(*errors), True
        count, flow = len(episodes), self._engine.flow.inputs
        self._action = torch.zeros(count, inputs.ACTIONS)
        self._carried: dict[str, Tensor] = {}
        if "window" in flow:
            self._carried["window"] = inputs.history_frame(*self._measured(obs))[:, None].repeat(
                1, inputs.HISTORY, 1
            )
        if "state" in flow:
            self._carried["state"] = torch.zeros(count, *flow["state"])

    @torch.inference_mode()
    def act(self, obs: Observation, target: Target) -> JointCommand:
        """Compute the commands of one control step."""
        if not self._first:
            self._d_ref = advance(self._d_ref, self._decay, self.info.control_period)
        self._first = False
        measured = self._measured(obs)
        gyro, gravity, joint_pos, joint_vel, _, ee = measured
        values = {
            "observation": inputs.observation(
                gyro, gravity, joint_pos, joint_vel, self._action, ee, self._d_ref
            ),
            "command": inputs.command(_tensor(target.pos_b), _tensor(target.rot_b)),
            **self._carried,
        }
        if "term" in self._engine.flow.inputs:
            values["term"] = inputs.history_frame(*measured)
        if "privileged" in self._engine.flow.inputs:
            values["privileged"] = _privileged(obs)[:, : self._engine.flow.inputs["privileged"][0]]
        found = self._engine(values)
        self._carried = {name: found[name] for name in self._carried}
        self._action, self._latent = found["action"], found.get("latent")
        return JointCommand(self._robot.command_of(self._action.numpy().astype(np.float64)))

    def latent(self) -> NDArray[np.float64]:
        """Return the dynamics latent of the latest commands, without the estimated velocity.

        Returns:
            Latents (N, 64), or (N, 16) for cenet.

        Raises:
            CheckpointError: The method has no estimator, or the policy is an exported one.
        """
        if self._latent is None:
            shown = ", ".join(name for name, method in METHODS.items() if method.estimates)
            raise CheckpointError(
                f"'{self.info.name}' shows no latent; valid: checkpoints (`learned:`) of {shown}"
            )
        return self._latent.numpy().astype(np.float64)

    def export(self, path: Path, format: str) -> None:
        """Write the policy as an ONNX file.

        Args:
            path: File to write.
            format: Name of the format; there is only `onnx`.

        Raises:
            CheckpointError: The policy comes from an exported file already.
        """
        if not isinstance(self._engine, Policy):
            raise CheckpointError(f"'{self.info.name}' is an exported policy already")
        from wbc_baselines.learned.policy.export import write_onnx

        write_onnx(path, self._engine, self.card)

    def _measured(self, obs: Observation) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Gyro, gravity, joint positions about the default, velocities, torques, end-effector pose."""
        assert obs.proprioception is not None and obs.ee_pose is not None
        gyro, gravity, joint_pos, joint_vel, torque = map(_tensor, obs.proprioception)
        ee = torch.cat([_tensor(obs.ee_pose.pos_b), _tensor(obs.ee_pose.rot6_b)], dim=-1)
        return gyro, gravity, joint_pos - self._default_q, joint_vel, torque, ee


def from_checkpoint(robot: Robot, variant: str) -> LearnedController:
    """Create the controller of a checkpoint.

    Args:
        robot: Robot to control.
        variant: METHOD@SEED or PATH.safetensors.

    Returns:
        The controller.

    Raises:
        CheckpointError: The checkpoint is damaged or does not fit the robot.
        UnknownNameError: There is no such checkpoint.
    """
    path = checkpoint.find(variant, robot.config.variant)
    card, actor, estimator = checkpoint.load(path, robot)
    name = f"learned:{card.method}@{card.seed}"
    return LearnedController(robot, card, Policy(actor, estimator), name, card.sha256, (path,))


def _tensor(array: NDArray[np.float64]) -> Tensor:
    return torch.from_numpy(array.astype(np.float32))


def _privileged(obs: Observation) -> Tensor:
    """The oracle's context (N, 107), of which the first oracles have the first 80 columns."""
    assert obs.privileged is not None and obs.base_pose is not None
    known = obs.privileged
    delays = np.stack([known.command_delay, known.observation_delay, known.odometry_delay], axis=1)
    parts = (
        *(known.base_lin_vel_b, known.joint_torque, known.joint_acc, obs.base_pose.pos_w[:, 2]),
        *(known.ee_lin_vel_b, known.ee_ang_vel_b, known.foot_pos_b.reshape(-1, 6)),
        *(known.kp_scale, known.kd_scale, known.base_mass, known.friction),
        *(known.foot_force_w.reshape(-1, 6), known.payload, known.payload_offset, known.motor_strength),
        *(known.joint_offset, known.imu_tilt, delays, known.odometry_error_b),
    )
    return inputs.privileged(*map(_tensor, parts))


def from_onnx(robot: Robot, variant: str) -> LearnedController:
    """Create the controller of an exported policy.

    Args:
        robot: Robot to control.
        variant: ONNX file.

    Returns:
        The controller.

    Raises:
        CheckpointError: The file is damaged or does not fit the robot.
        UnknownNameError: There is no such method.
    """
    engine = OnnxEngine(Path(variant))
    check_fit(engine.card, robot, None, variant)
    return LearnedController(robot, engine.card, engine, f"onnx:{variant}", engine.sha256, (Path(variant),))
