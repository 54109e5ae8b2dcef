"""The training environment: N episodes of the evaluation's protocol in parallel, each reset when it ends."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from wbc_baselines.learned.policy import inputs
from wbc_baselines.learned.policy.methods import Reward
from wbc_baselines.learned.policy.reference import advance, initial_reference
from wbc_baselines.learned.training.arm_ik import ArmKinematics
from wbc_baselines.learned.training.backends.base import Backend, Reading, ResetState, State
from wbc_baselines.learned.training.episode_log import EpisodeLog
from wbc_baselines.learned.training.resets import EpisodeSamples, sample_episodes, scale_disturbances
from wbc_baselines.learned.training.rewards import Body, Signals, rewards
from wbc_baselines.learned.training.sensing import (
    Past,
    command_age,
    measure,
    measured_command,
    sample_noise,
)
from wbc_baselines.learned.training.state_view import (
    CONTACT_FORCE,
    DerivedState,
    Episode,
    Observations,
    derive_state,
    leg_posture_error,
    observe,
)
from wbc_baselines.learned.training.target_set import TargetSet
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.randomness import stream
from wbc_bench.robot import NUM_JOINTS, NUM_LEG_JOINTS, Robot, load_robot
from wbc_bench.rotations import matrix_from_rotvec, matrix_from_wxyz

PRIVILEGED_COLUMNS = slice(inputs.OBSERVATION + inputs.COMMAND, None)  # of Observations.critic


class Step(NamedTuple):
    """One control step of N environments."""

    observations: Observations
    reward: Tensor  # (N,)
    done: Tensor  # (N,) bool
    time_out: Tensor  # (N,) bool: the episode ended at the horizon
    pushed: Tensor  # (N,) bool: a push came before the step


class _EpisodeBuffer(NamedTuple):
    """Episodes that were sampled ahead of their use."""

    number: int  # of the random stream
    disturbance_scale: float
    curriculum: float
    taken: int = 0


class Environment:
    """N parallel episodes. All samples come from counted streams of one seed, so that it can be resumed.

    `curriculum`, the completed fraction of the curriculum over strata, and `disturbance_scale`, see
    `resets.scale_disturbances`, apply to the episodes that are sampled from now on and to the noise.
    """

    def __init__(
        self,
        protocol: EvalProtocol,
        backend: Backend,
        target_set: TargetSet,
        reward: Reward,
        seed: int,
        disturbance_scale: float = 1.0,
        undisturbed: float = 0.0,
    ) -> None:
        """Begin the first episodes.

        Args:
            protocol: Protocol of the episodes, with the physics step of training.
            backend: Physics of N simulations.
            target_set: Targets that episodes pick from.
            reward: Whether the reward is gated or additive.
            seed: Seed of all samples.
            disturbance_scale: Scale in [0, 1] of noise, pushes and randomization.
            undisturbed: Fraction of the episodes without any of them.
        """
        self.protocol, self.num_envs, self.device = protocol, backend.num_envs, backend.device
        self.curriculum = 1.0
        self.disturbance_scale = disturbance_scale
        self._backend, self._seed, self._undisturbed = backend, seed, undisturbed
        self._reward: Reward = reward
        self._robot = load_robot(protocol.robot)
        self._target_set, self._body = target_set, body_of(self._robot, self.device)
        self._default_q = self._tensor(self._robot.default_q)
        self._scale = self._tensor(self._robot.action_scale)
        self._noise = torch.zeros(1, self.num_envs, inputs.HISTORY_FRAME, device=self.device)
        self._drift = torch.zeros(1, self.num_envs, 3, device=self.device)
        self._at = 0  # row of the noise and of the drift
        spread, timestep = protocol.randomization, protocol.physics.timestep
        # most physics steps of delay: of commands, and of what is measured
        self._latest, *measured = (
            round(longest / timestep)
            for _, longest in (spread.command_delay, spread.observation_delay, spread.odometry_delay)
        )
        self._measured_latest = max(measured)
        self._arm = ArmKinematics(self._robot, self.device)
        self._log = EpisodeLog(protocol, self.device)
        self.begin()

    # ---- episodes ------------------------------------------------------------------------------------------

    def begin(self, number: int = 0) -> None:
        """Begin new episodes in all environments, at random ages so that they do not end together.

        Args:
            number: Number of the random stream from which samples are taken onward.
        """
        count = self.num_envs
        self._sample(_EpisodeBuffer(number, self.disturbance_scale, self.curriculum))
        reset, self._episode = self._take(count)
        self._state = self._backend.reset(torch.arange(count, device=self.device), reset)
        self._derived = self._derive(self._state, self._state, self._episode)
        rng, protocol = stream(self._seed, "training age", number), self.protocol
        depth = self._latest // protocol.physics.decimation + 2
        self._commands = Past(depth, self._default_q.repeat(count, 1))
        self._measured = Past(self._measured_latest + 1, self._measure(self._state, self._episode))
        age = torch.from_numpy(rng.integers(0, protocol.num_steps, count)).to(self.device)
        self._begin(self._episode, self._derived)
        self._episode.step[:] = age
        self._episode.d_ref[:] = advance(
            self._episode.d_ref, self._episode.decay * age, protocol.control_period
        )
        self.observations = self._observe()

    def _sample(self, buffer: _EpisodeBuffer) -> None:
        """Sample as many episodes as there are environments, ahead of their use: one transfer to a GPU."""
        rng = stream(self._seed, "training start", buffer.number)
        protocol = scale_disturbances(self.protocol, buffer.disturbance_scale)
        samples = sample_episodes(
            protocol, self._target_set, self.num_envs, rng, buffer.curriculum, self._undisturbed
        )
        self._buffer = buffer
        self._resets = ResetState(*(column.to(self.device) for column in samples.reset))
        self._episodes = self._fresh_episodes(samples)

    def _take(self, count: int) -> tuple[ResetState, Episode]:
        """The next `count` episodes; if fewer are left, they are dropped and new ones sampled."""
        buffer = self._buffer
        if buffer.taken + count > self.num_envs:
            self._sample(_EpisodeBuffer(buffer.number + 1, self.disturbance_scale, self.curriculum))
            buffer = self._buffer
        rows = slice(buffer.taken, buffer.taken + count)
        self._buffer = buffer._replace(taken=buffer.taken + count)
        reset = ResetState(*(column[rows] for column in self._resets))
        return reset, Episode(*(column[rows] for column in self._episodes))

    def _fresh_episodes(self, samples: EpisodeSamples) -> Episode:
        reset, targets, chosen = samples.reset, self._target_set, samples.target
        count = len(chosen)

        def zero() -> Tensor:
            return torch.zeros(count, device=self.device)

        def none() -> Tensor:
            return torch.zeros(count, dtype=torch.int64, device=self.device)

        dynamics = [reset.kp_scale, reset.kd_scale, reset.base_mass[:, None], reset.friction[:, None]]
        delays = samples.delays * self.protocol.physics.timestep  # [s] as they act
        hidden = [reset.payload[:, None], reset.payload_offset, reset.motor_strength[:, None]]
        hidden += [samples.imu_tilt, delays]
        imu_rot = matrix_from_rotvec(np.pad(samples.imu_tilt.numpy(), ((0, 0), (0, 1))))
        return Episode(
            target_pos_w=self._tensor(targets.pos_w[chosen]),
            target_rot_w=self._tensor(matrix_from_wxyz(targets.quat_w[chosen].astype(np.float64))),
            posture=self._tensor(targets.witness_qpos[chosen, 7 : 7 + NUM_LEG_JOINTS])
            - self._default_q[:NUM_LEG_JOINTS],
            stratum=torch.from_numpy(targets.stratum[chosen].astype(np.int64)).to(self.device),
            decay=samples.decay.float().to(self.device),
            push_step=samples.push_step.to(self.device),
            push_vel=samples.push_vel.float().to(self.device),
            dynamics=torch.cat(dynamics, 1).float().to(self.device),
            hidden=torch.cat(hidden, 1).float().to(self.device),
            joint_offset=reset.joint_offset.float().to(self.device),
            imu_rot=self._tensor(imu_rot),
            delays=samples.delays.to(self.device),
            noise_scale=samples.noise_scale.float().to(self.device),
            odometry_error_w=torch.zeros(count, 3, device=self.device),
            step=none(),
            action=torch.zeros(count, NUM_JOINTS, device=self.device),
            d_ref=zero(),
            best_pos_error=zero(),
            best_rot_error=zero(),
            steps_in_tolerance=none(),
            episode_return=zero(),
        )

    def _begin(self, episode: Episode, derived: DerivedState) -> None:
        episode.best_pos_error[:], episode.best_rot_error[:] = derived.pos_error, derived.rot_error
        episode.d_ref[:] = initial_reference(derived.pos_error, derived.rot_error)

    def _reset(self, done: Tensor) -> None:
        """Replace the episodes that have ended."""
        ids = done.nonzero()[:, 0]
        if len(ids) == 0:
            return
        reset, episode = self._take(len(ids))
        state = self._backend.reset(ids, reset)
        derived = self._derive(state, state, episode)
        self._begin(episode, derived)
        self._state.put(ids, state)
        self._commands.restart(ids, self._default_q)
        self._measured.restart(ids, self._measure(state, episode))
        for mine, theirs in zip((*self._episode, *self._derived), (*episode, *derived), strict=True):
            mine[ids] = theirs

    # ---- one step ------------------------------------------------------------------------------------------

    def begin_rollout(self, iteration: int, steps: int) -> None:
        """Sample observation noise and odometry drift of a whole rollout at once, on the device.

        Args:
            iteration: Number of the iteration, which identifies the random stream.
            steps: Control steps of the rollout.
        """
        seed = int(stream(self._seed, "training noise", iteration).integers(2**62))
        generator = torch.Generator(self.device).manual_seed(seed)
        protocol = scale_disturbances(self.protocol, self.disturbance_scale)
        self._noise, self._drift = sample_noise(protocol, steps, self.num_envs, generator)
        self._at = 0
        self._backend.check()

    @torch.no_grad()
    def step(self, action: Tensor) -> Step:
        """Apply actions for one control period, and reset the episodes that end.

        Args:
            action: (N, 14) Actions in units of the action scale.

        Returns:
            Observations, rewards and endings of the step.
        """
        protocol, episode, before = self.protocol, self._episode, self._state
        now = episode.push_step == episode.step[:, None]
        self._backend.push((episode.push_vel * now[..., None]).sum(1))
        state = self._advance(self._default_q + self._scale * action)
        derived = self._derive(state, before, episode)
        episode.step.add_(1)
        episode.d_ref[:] = advance(episode.d_ref, episode.decay, protocol.control_period)

        limits, success = protocol.termination, protocol.success
        fell = (derived.upright < limits.min_upright) | (state.qpos[:, 2] < limits.base_height)
        terminated = fell | (state.ground_contact & limits.illegal_contact) | state.diverged
        done = terminated | (episode.step >= protocol.num_steps)
        time_out = done & ~terminated
        in_tolerance = (derived.pos_error < success.position) & (derived.rot_error < success.orientation)
        episode.steps_in_tolerance.add_(1).mul_(in_tolerance)

        signals = self._signals(state, derived, action, terminated)
        reward, terms, gates = rewards(signals, self._body, self._reward, protocol.control_period)
        torch.minimum(episode.best_pos_error, derived.pos_error, out=episode.best_pos_error)
        torch.minimum(episode.best_rot_error, derived.rot_error, out=episode.best_rot_error)
        episode.action[:] = action
        episode.odometry_error_w.add_(self._drift[self._at] * episode.noise_scale[:, None])
        episode.episode_return.add_(reward)
        self._log.add(terms, gates, derived, episode, done, time_out, state.diverged)

        self._state, self._derived = state, derived
        self._reset(done)
        self.observations = self._observe()
        self._at += 1
        return Step(self.observations, reward, done, time_out, now.any(1))

    def _advance(self, command: Tensor) -> State:
        """Apply commands (N, 14) [rad] for one control period, as late and as far off as episodes say."""
        episode, decimation, before = self._episode, self.protocol.physics.decimation, self._state
        self._commands.push(command)
        parts = decimation if self._latest or self._measured_latest else 1
        delay = episode.delays[:, 0]
        acting = [self._commands.at(command_age(k, delay, decimation)) for k in range(parts)]
        readings, state = self._backend.step(torch.stack(acting) - episode.joint_offset)
        state = state.where_sound(before)
        for reading in (*readings, state):
            self._measured.push(self._measure(reading, episode))
        return state

    def _measure(self, reading: Reading | State, episode: Episode) -> Tensor:
        return measure(reading, episode, self._default_q, self._arm)

    def _derive(self, state: State, before: State, episode: Episode) -> DerivedState:
        return derive_state(state, before, episode, self._default_q, self.protocol.control_period)

    def _observe(self) -> Observations:
        episode = self._episode
        frame = self._measured.at(episode.delays[:, 1])[:, : inputs.HISTORY_FRAME]
        frame = frame + self._noise[self._at] * episode.noise_scale[:, None]
        command = measured_command(self._measured.at(episode.delays[:, 2]), episode)
        return observe(self._state, self._derived, episode, frame, command)

    def _signals(self, state: State, derived: DerivedState, action: Tensor, terminated: Tensor) -> Signals:
        episode = self._episode
        return Signals(
            pos_error=derived.pos_error,
            rot_error=derived.rot_error,
            best_pos_error=episode.best_pos_error,
            best_rot_error=episode.best_rot_error,
            d_ref=episode.d_ref,
            feet_h=derived.feet_h,
            base_height=state.qpos[:, 2],
            gravity_b=derived.gravity_b,
            base_lin_vel=state.qvel[:, :3],
            base_ang_vel=state.qvel[:, 3:6],
            joint_pos=state.qpos[:, 7:],
            joint_vel=state.qvel[:, 6:],
            joint_torque=state.torque,
            ee_lin_vel=derived.ee_vel_b[:, :3],
            ee_ang_vel=derived.ee_vel_b[:, 3:],
            action=action,
            previous_action=episode.action,
            foot_contact=(state.foot_force_w[..., 2].abs() > CONTACT_FORCE).float(),
            foot_vel_w=derived.feet_vel_w,
            foot_up_w=state.feet_up_w,
            terminated=terminated,
        )

    def leg_posture_error(self) -> Tensor:
        """Return the joint angles (N, 8) [rad] to a posture that reaches the target, see `state_view`."""
        tolerance = self.protocol.success.position
        return leg_posture_error(self._state, self._derived, self._episode, tolerance)

    # ---- log and resuming ----------------------------------------------------------------------------------

    def clear_log(self) -> None:
        """Forget what has been counted."""
        self._log.clear()

    def log(self) -> dict[str, float]:
        """Return the means since `clear_log`, see `EpisodeLog.means`."""
        return self._log.means()

    def save(self) -> dict:
        """Return everything that a later step depends on, between two rollouts."""
        return {
            "backend": {k: torch.from_numpy(v) for k, v in self._backend.save().items()},
            "state": self._state._asdict(),
            "episode": self._episode._asdict(),
            "derived": self._derived._asdict(),
            "observations": self.observations._asdict(),
            "buffer": self._buffer._asdict(),
            "commands": self._commands.values,
            "measured": self._measured.values,
        }

    def load(self, saved: dict) -> None:
        """Continue bit by bit from a saved state.

        Args:
            saved: What `save` returned.
        """
        self._backend.load({k: v.numpy() for k, v in saved["backend"].items()})
        for kind, name in (
            (State, "_state"),
            (Episode, "_episode"),
            (DerivedState, "_derived"),
            (Observations, "observations"),
        ):
            fields = {k: v.to(self.device) for k, v in saved[name.strip("_")].items()}
            setattr(self, name, kind(**fields))
        self._sample(_EpisodeBuffer(**saved["buffer"]))
        for past in ("commands", "measured"):
            getattr(self, f"_{past}").values = saved[past].to(self.device)

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.tensor(array, dtype=torch.float32, device=self.device)


def body_of(robot: Robot, device: torch.device) -> Body:
    """Collect the properties of a robot that the reward depends on.

    Args:
        robot: The robot.
        device: Device of the tensors.

    Returns:
        Joint limits, and the positions of the soles in the default posture.
    """
    import mujoco

    model = robot.model()
    data = mujoco.MjData(model)
    data.qpos[:] = [0, 0, robot.facts.nominal_base_height, 1, 0, 0, 0, *robot.default_q]
    mujoco.mj_kinematics(model, data)
    feet = np.stack([data.site(f"sole_{side}").xpos[:2] for side in "LR"])
    middle = (robot.lower + robot.upper)[NUM_LEG_JOINTS:] / 2
    tensors = (torch.tensor(a, dtype=torch.float32) for a in (robot.lower, robot.upper, middle, feet))
    return Body(*(tensor.to(device) for tensor in tensors))
