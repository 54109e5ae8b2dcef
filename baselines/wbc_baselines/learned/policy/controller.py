"""Trained policies as controllers of the benchmark: batched, deterministic, on one thread."""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from wbc_baselines.learned.policy import inputs, weights
from wbc_baselines.learned.policy.architecture import Flow
from wbc_baselines.learned.policy.card import CheckpointError, PolicyCard, check_fit, other_conditions
from wbc_baselines.learned.policy.methods import METHODS
from wbc_baselines.learned.policy.numpy_policy import NumpyPolicy
from wbc_baselines.learned.policy.reference import advance, initial_reference
from wbc_bench.controller import ControllerInfo, JointCommand, Observation, Target
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.errors import missing_extra
from wbc_bench.robot import Robot
from wbc_bench.rotations import geodesic_angle, matrix_from_rho6

Array = NDArray[np.float32]
REFERENCE_DECAY = 1.0  # [1/s] where no protocol says otherwise. Source: default of wbc_bench.protocol


class Engine(Protocol):
    """The implementation that computes a policy: NumPy, or a runtime of exported files.

    What it carries from step to step, window and recurrent state in whatever form, is its own business.
    """

    @property
    def flow(self) -> Flow:
        """Names and shapes of what it computes an action from."""
        ...

    def begin(self, frame: Array) -> Any:
        """Begin N episodes.

        Args:
            frame: (N, 57) The first frames; the windows are filled with them.

        Returns:
            What is carried into the first step.
        """
        ...

    def __call__(self, values: Mapping[str, Array], carried: Any) -> tuple[dict[str, Array], Any]:
        """Compute one control step.

        Args:
            values: Those of `observation`, `command`, `term` and `privileged` that are in `flow.inputs`.
            carried: What the step before returned, or `begin`.

        Returns:
            `action`, and `latent` where there is one and the engine shows it; what the next step is given.
        """
        ...


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
        period = card.robot.control_period
        trained = f"{card.samples:.3g} control steps of {card.protocol}"
        self.info = ControllerInfo(
            name, METHODS[card.method].signals, period, f"wbc_baselines.learned, {trained}", files
        )
        self.card, self.checkpoint_sha256 = card, sha256
        self._robot, self._engine, self._decay = robot, engine, REFERENCE_DECAY
        self._latent: Array | None = None
        self._default_q = _float32(robot.default_q)

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

    @np.errstate(all="ignore")
    def reset(self, episodes: NDArray[np.int64], obs: Observation, target: Target) -> None:
        """Fill the windows with the first observation, and start with zero state and action."""
        assert obs.ee_pose is not None
        pos_err = np.linalg.norm(obs.ee_pose.pos_b - target.pos_b, axis=-1)
        rot_err = geodesic_angle(matrix_from_rho6(obs.ee_pose.rot6_b), target.rot_b)
        self._d_ref, self._first = initial_reference(_float32(pos_err), _float32(rot_err)), True
        self._action = np.zeros((len(episodes), inputs.ACTIONS), np.float32)
        self._carried = self._engine.begin(inputs.history_frame(*self._measured(obs)))

    @np.errstate(all="ignore")  # after a divergence the commands are no numbers, which the harness reports
    def act(self, obs: Observation, target: Target) -> JointCommand:
        """Compute the commands of one control step."""
        if not self._first:
            self._d_ref = advance(self._d_ref, self._decay, self.info.control_period)
        self._first = False
        measured, flow = self._measured(obs), self._engine.flow.inputs
        gyro, gravity, joint_pos, joint_vel, _, ee = measured
        values = {
            "observation": inputs.observation(
                gyro, gravity, joint_pos, joint_vel, self._action, ee, self._d_ref
            ),
            "command": inputs.command(_float32(target.pos_b), _float32(target.rot_b)),
        }
        if "term" in flow:
            values["term"] = inputs.history_frame(*measured)
        if "privileged" in flow:
            values["privileged"] = _privileged(obs)[:, : flow["privileged"][0]]
        found, self._carried = self._engine(values, self._carried)
        self._action, self._latent = found["action"], found.get("latent")
        return JointCommand(self._robot.command_of(self._action.astype(np.float64)))

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
        return self._latent.astype(np.float64)

    def export(self, path: Path, format: str) -> None:
        """Write the policy as an ONNX file.

        Args:
            path: File to write.
            format: Name of the format; there is only `onnx`.

        Raises:
            CheckpointError: The policy comes from an exported file already, or torch is not installed.
        """
        if not isinstance(self._engine, NumpyPolicy):
            raise CheckpointError(f"'{self.info.name}' is an exported policy already")
        try:
            from wbc_baselines.learned.policy import checkpoint
            from wbc_baselines.learned.policy.export import write_onnx
            from wbc_baselines.learned.policy.policy import Policy
        except ImportError as error:
            raise CheckpointError(missing_extra("an export", "learned", error)) from error

        card, actor, estimator = checkpoint.load(self.info.files[0])
        write_onnx(path, Policy(actor, estimator), card)

    def _measured(self, obs: Observation) -> tuple[Array, Array, Array, Array, Array, Array]:
        """Gyro, gravity, joint positions about the default, velocities, torques, end-effector pose."""
        assert obs.proprioception is not None and obs.ee_pose is not None
        gyro, gravity, joint_pos, joint_vel, torque = map(_float32, obs.proprioception)
        ee = np.concatenate([_float32(obs.ee_pose.pos_b), _float32(obs.ee_pose.rot6_b)], axis=-1)
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
    path = weights.find(variant, robot.config.variant)
    card, tensors = weights.read(path, robot)
    policy, name = NumpyPolicy(METHODS[card.method].estimator, tensors), f"learned:{card.method}@{card.seed}"
    return LearnedController(robot, card, policy, name, card.sha256, (path,))


def _float32(array: NDArray[np.float64]) -> Array:
    return array.astype(np.float32)


def _privileged(obs: Observation) -> Array:
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
    return inputs.privileged(*map(_float32, parts))


def from_onnx(robot: Robot, variant: str) -> LearnedController:
    """Create the controller of an exported policy.

    Args:
        robot: Robot to control.
        variant: ONNX file.

    Returns:
        The controller.

    Raises:
        CheckpointError: The file is damaged or does not fit the robot, or onnxruntime is not installed.
        UnknownNameError: There is no such method.
    """
    try:
        from wbc_baselines.learned.policy.onnx_engine import OnnxEngine
    except ImportError as error:
        raise CheckpointError(missing_extra("an exported policy", "learned", error)) from error

    engine = OnnxEngine(Path(variant))
    check_fit(engine.card, robot, None, variant)
    return LearnedController(robot, engine.card, engine, f"onnx:{variant}", engine.sha256, (Path(variant),))
