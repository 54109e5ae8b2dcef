"""N episodes of training side by side: the evaluation's protocol, resets in place, everything batched."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from wbc_baselines.learned.policy import inputs
from wbc_baselines.learned.policy.methods import Reward
from wbc_baselines.learned.policy.reference import advance, initial_reference, pose_errors, twice_sine
from wbc_baselines.learned.training.backends.base import Backend, Start, State
from wbc_baselines.learned.training.resets import Draws, draw_starts, weakened
from wbc_baselines.learned.training.rewards import Body, Signals, rewards
from wbc_baselines.learned.training.target_set import TargetPool
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.outcomes import STRATA
from wbc_bench.randomness import stream
from wbc_bench.robot import NUM_JOINTS, NUM_LEG_JOINTS, Robot, load_robot
from wbc_bench.rotations import matrix_from_wxyz

STILL, STILL_TURNING = 0.15, 0.3  # [m/s], [rad/s] of the base; choice
ARRIVES = 0.5  # of the task-progress reference, below which the hand should have arrived; choice
CONTACT_FORCE = 1.0  # [N] vertical, from which a sole counts as loaded. Source: Isaac Lab's contact sensor
OUTCOMES = ("success", "fell", "diverged", "length", "return", "pos_error", "rot_error", "timed_out")


class View(NamedTuple):
    """What follows from N true states, and from those one control period before."""

    gravity_b: Tensor  # (N, 3)
    lin_vel_b: Tensor  # (N, 3) [m/s]
    ee: Tensor  # (N, 9) position [m] and two columns, base frame
    ee_vel_b: Tensor  # (N, 6) [m/s], [rad/s] over the last control period
    feet_b: Tensor  # (N, 6) [m]
    feet_h: Tensor  # (N, 2, 2) [m] heading frame
    feet_vel_w: Tensor  # (N, 2, 2) [m/s] horizontal, over the last control period
    joint_pos: Tensor  # (N, 14) [rad] about the default posture
    joint_acc: Tensor  # (N, 14) [rad/s^2] over the last control period
    command: Tensor  # (N, 9)
    pos_error: Tensor  # (N,) [m]
    rot_error: Tensor  # (N,) [rad]
    upright: Tensor  # (N,) cosine of the base's tilt


class Episode(NamedTuple):
    """The episode that each of N simulations is in."""

    target_pos_w: Tensor  # (N, 3) [m]
    target_rot_w: Tensor  # (N, 3, 3)
    posture: Tensor  # (N, 8) [rad] legs about their default in a posture that reaches the target
    stratum: Tensor  # (N,)
    decay: Tensor  # (N,) [1/s]
    push_step: Tensor  # (N, P)
    push_vel: Tensor  # (N, P, 2) [m/s]
    dynamics: Tensor  # (N, 30) factors of kp and kd, added mass [kg], friction
    step: Tensor  # (N,) control steps done
    action: Tensor  # (N, 14) of the step before
    d_ref: Tensor  # (N,)
    best_pos_error: Tensor  # (N,) [m]
    best_rot_error: Tensor  # (N,) [rad]
    inside: Tensor  # (N,) steps in a row inside the success tolerances
    earned: Tensor  # (N,) reward so far


class Seen(NamedTuple):
    """What the networks see after a step; rows that have just been reset show their new episode."""

    policy: Tensor  # (N, 67) noisy observation and command
    critic: Tensor  # (N, 147) observation without noise, command, privileged
    term: Tensor  # (N, 57) noisy term of the estimators' window
    velocity: Tensor  # (N, 3) [m/s] true, base frame
    next_observation: Tensor  # (N, 49) without noise


class Step(NamedTuple):
    """One control step of N environments."""

    seen: Seen
    reward: Tensor  # (N,)
    done: Tensor  # (N,) bool
    time_out: Tensor  # (N,) bool: done, and not by a fault of the policy
    pushed: Tensor  # (N,) bool: a push came before it


class _Bank(NamedTuple):
    """Episodes drawn ahead."""

    number: int  # of the stream
    severity: float
    curriculum: float
    taken: int = 0


PRIVILEGED_COLUMNS = slice(inputs.OBSERVATION + inputs.COMMAND, None)  # of Seen.critic


class Environment:
    """Training's environment. Draws come from streams of `seed`, by counters, so that it can be resumed."""

    def __init__(
        self,
        protocol: EvalProtocol,
        backend: Backend,
        pool: TargetPool,
        reward: Reward,
        seed: int,
        severity: float = 1.0,
    ) -> None:
        """`severity`: see `starts.weakened`."""
        self.protocol, self.num_envs, self.device = protocol, backend.num_envs, backend.device
        self.curriculum = 1.0  # part of the ramp over strata that is done
        self.severity = severity  # of the episodes that begin and of the noise, from now on
        self._backend, self._seed = backend, seed
        self._reward: Reward = reward
        self._robot = load_robot(protocol.robot)
        self._pool, self._body = pool, body_of(self._robot, self.device)
        self._default_q = self._tensor(self._robot.default_q)
        self._scale = self._tensor(self._robot.action_scale)
        self._noise = torch.zeros(1, self.num_envs, inputs.HISTORY_TERM, device=self.device)
        self._at = 0  # row of the noise
        self.clear_log()
        self.begin()

    # ---- episodes ------------------------------------------------------------------------------------------

    def begin(self, number: int = 0) -> None:
        """Episodes of all ages, so that they do not end together, from the draws of this number on."""
        count = self.num_envs
        self._draw(_Bank(number, self.severity, self.curriculum))
        start, self._episode = self._take(count)
        self._state = self._backend.reset(torch.arange(count, device=self.device), start)
        self._view = self._derive(self._state, self._state, self._episode)
        rng = stream(self._seed, "training age", number)
        age = torch.from_numpy(rng.integers(0, self.protocol.num_steps, count)).to(self.device)
        self._begin(self._episode, self._view)
        self._episode.step[:] = age
        self._episode.d_ref[:] = advance(
            self._episode.d_ref, self._episode.decay * age, self.protocol.control_period
        )
        self.seen = self._see()

    def _draw(self, bank: "_Bank") -> None:
        """Draw as many episodes as there are environments, ahead of their use: one transfer to a GPU."""
        rng = stream(self._seed, "training start", bank.number)
        protocol = weakened(self.protocol, bank.severity)
        draws = draw_starts(protocol, self._pool, self.num_envs, rng, bank.curriculum)
        self._bank = bank
        self._starts = Start(*(column.to(self.device) for column in draws.start))
        self._episodes = self._fresh_episodes(draws)

    def _take(self, count: int) -> tuple[Start, Episode]:
        """The next `count` episodes; where fewer are left, new ones are drawn and those dropped."""
        bank = self._bank
        if bank.taken + count > self.num_envs:
            self._draw(_Bank(bank.number + 1, self.severity, self.curriculum))
            bank = self._bank
        rows = slice(bank.taken, bank.taken + count)
        self._bank = bank._replace(taken=bank.taken + count)
        return Start(*(column[rows] for column in self._starts)), Episode(*(x[rows] for x in self._episodes))

    def _fresh_episodes(self, draws: Draws) -> Episode:
        start, chosen, count = draws.start, draws.target, len(draws.target)

        def zero() -> Tensor:
            return torch.zeros(count, device=self.device)

        def none() -> Tensor:
            return torch.zeros(count, dtype=torch.int64, device=self.device)

        dynamics = [start.kp_scale, start.kd_scale, start.base_mass[:, None], start.friction[:, None]]
        return Episode(
            target_pos_w=self._tensor(self._pool.pos_w[chosen]),
            target_rot_w=self._tensor(matrix_from_wxyz(self._pool.quat_w[chosen].astype(np.float64))),
            posture=self._tensor(self._pool.witness_qpos[chosen, 7 : 7 + NUM_LEG_JOINTS])
            - self._default_q[:NUM_LEG_JOINTS],
            stratum=torch.from_numpy(self._pool.stratum[chosen].astype(np.int64)).to(self.device),
            decay=draws.decay.float().to(self.device),
            push_step=draws.push_step.to(self.device),
            push_vel=draws.push_vel.float().to(self.device),
            dynamics=torch.cat(dynamics, 1).float().to(self.device),
            step=none(),
            action=torch.zeros(count, NUM_JOINTS, device=self.device),
            d_ref=zero(),
            best_pos_error=zero(),
            best_rot_error=zero(),
            inside=none(),
            earned=zero(),
        )

    def _begin(self, episode: Episode, view: View) -> None:
        episode.best_pos_error[:], episode.best_rot_error[:] = view.pos_error, view.rot_error
        episode.d_ref[:] = initial_reference(view.pos_error, view.rot_error)

    def _reset(self, done: Tensor) -> None:
        """Replace the episodes that have ended."""
        ids = done.nonzero()[:, 0]
        if len(ids) == 0:
            return
        start, episode = self._take(len(ids))
        state = self._backend.reset(ids, start)
        view = self._derive(state, state, episode)
        self._begin(episode, view)
        self._state.put(ids, state)
        for mine, theirs in zip((*self._episode, *self._view), (*episode, *view), strict=True):
            mine[ids] = theirs

    # ---- one step ------------------------------------------------------------------------------------------

    def begin_rollout(self, iteration: int, steps: int) -> None:
        """Draw the observation noise of the next `steps` steps at once, on the device."""
        seed = int(stream(self._seed, "training noise", iteration).integers(2**62))
        generator = torch.Generator(self.device).manual_seed(seed)
        shape = (steps, self.num_envs, inputs.HISTORY_TERM)
        unit = torch.rand(shape, generator=generator, device=self.device)
        half = self._tensor(noise_half_widths(weakened(self.protocol, self.severity)))
        self._noise = unit.mul_(2).sub_(1).mul_(half)
        self._at = 0
        self._backend.check()

    @torch.no_grad()
    def step(self, action: Tensor) -> Step:
        """Apply normalised actions (N, 14) for one control period."""
        protocol, episode, before = self.protocol, self._episode, self._state
        now = episode.push_step == episode.step[:, None]
        self._backend.push((episode.push_vel * now[..., None]).sum(1))
        state = self._backend.step(self._default_q + self._scale * action)
        state = state.where_sound(before)
        view = self._derive(state, before, episode)
        episode.step.add_(1)
        episode.d_ref[:] = advance(episode.d_ref, episode.decay, protocol.control_period)

        limits, success = protocol.termination, protocol.success
        fell = (view.upright < np.cos(limits.tilt)) | (state.qpos[:, 2] < limits.base_height)
        terminated = fell | (state.ground_contact & limits.illegal_contact) | state.diverged
        done = terminated | (episode.step >= protocol.num_steps)
        time_out = done & ~terminated
        inside = (view.pos_error < success.position) & (view.rot_error < success.orientation)
        episode.inside.add_(1).mul_(inside)

        signals = self._signals(state, view, action, terminated)
        reward, terms, gates = rewards(signals, self._body, self._reward, protocol.control_period)
        torch.minimum(episode.best_pos_error, view.pos_error, out=episode.best_pos_error)
        torch.minimum(episode.best_rot_error, view.rot_error, out=episode.best_rot_error)
        episode.action[:] = action
        episode.earned.add_(reward)
        self._log(terms, gates, view, done, time_out, state.diverged)

        self._state, self._view = state, view
        self._reset(done)
        self.seen = self._see()
        self._at += 1
        return Step(self.seen, reward, done, time_out, now.any(1))

    def _derive(self, state: State, before: State, episode: Episode) -> View:
        rate = 1 / self.protocol.control_period  # [1/s]
        rot_w = rotation_from_wxyz(state.qpos[:, 3:7])
        base_w = state.qpos[:, :3]
        turned = state.ee_rot_w @ before.ee_rot_w.transpose(1, 2)
        # sine of the angle turned in a period for the angle: 0.1 % off at 4 rad/s
        ee_ang_vel_w = twice_sine(turned) * (0.5 * rate)
        world = torch.cat(
            [
                torch.stack(
                    [
                        state.qvel[:, :3],
                        state.ee_pos_w - base_w,
                        (state.ee_pos_w - before.ee_pos_w) * rate,
                        ee_ang_vel_w,
                        episode.target_pos_w - base_w,
                    ],
                    -1,
                ),
                (state.feet_pos_w - base_w[:, None]).transpose(1, 2),
                state.ee_rot_w,
                episode.target_rot_w,
            ],
            -1,
        )  # (N, 3, 13) columns in the world
        lin, ee, ee_lin, ee_ang, target, left, right, *rot_b = (rot_w.transpose(1, 2) @ world).unbind(-1)
        feet_xy = (state.feet_pos_w - base_w[:, None])[..., :2]
        forward = torch.nn.functional.normalize(rot_w[:, :2, 0], dim=-1)[:, None]
        feet_h = torch.stack(
            [
                (feet_xy * forward).sum(-1),
                feet_xy[..., 1] * forward[..., 0] - feet_xy[..., 0] * forward[..., 1],
            ],
            -1,
        )
        pos_error, rot_error = pose_errors(
            state.ee_pos_w, state.ee_rot_w, episode.target_pos_w, episode.target_rot_w
        )
        return View(
            gravity_b=-rot_w[:, 2],
            lin_vel_b=lin,
            ee=torch.cat([ee, rot_b[0], rot_b[1]], -1),
            ee_vel_b=torch.cat([ee_lin, ee_ang], -1),
            feet_b=torch.cat([left, right], -1),
            feet_h=feet_h,
            feet_vel_w=(state.feet_pos_w - before.feet_pos_w)[..., :2] * rate,
            joint_pos=state.qpos[:, 7:] - self._default_q,
            joint_acc=(state.qvel[:, 6:] - before.qvel[:, 6:]) * rate,
            command=torch.cat([target, rot_b[3], rot_b[4]], -1),
            pos_error=pos_error,
            rot_error=rot_error,
            upright=rot_w[:, 2, 2],
        )

    def _signals(self, state: State, view: View, action: Tensor, terminated: Tensor) -> Signals:
        episode = self._episode
        return Signals(
            pos_error=view.pos_error,
            rot_error=view.rot_error,
            best_pos_error=episode.best_pos_error,
            best_rot_error=episode.best_rot_error,
            d_ref=episode.d_ref,
            feet_h=view.feet_h,
            base_height=state.qpos[:, 2],
            gravity_b=view.gravity_b,
            base_lin_vel=state.qvel[:, :3],
            base_ang_vel=state.qvel[:, 3:6],
            joint_pos=state.qpos[:, 7:],
            joint_vel=state.qvel[:, 6:],
            joint_torque=state.torque,
            ee_lin_vel=view.ee_vel_b[:, :3],
            ee_ang_vel=view.ee_vel_b[:, 3:],
            action=action,
            previous_action=episode.action,
            foot_contact=(state.foot_force_w[..., 2].abs() > CONTACT_FORCE).float(),
            foot_vel_w=view.feet_vel_w,
            foot_up_w=state.feet_up_w,
            terminated=terminated,
        )

    def _see(self) -> Seen:
        state, view, episode = self._state, self._view, self._episode
        ang_vel, joint_vel = state.qvel[:, 3:6], state.qvel[:, 6:]
        true = inputs.history_term(ang_vel, view.gravity_b, view.joint_pos, joint_vel, state.torque, view.ee)
        term = true + self._noise[self._at]
        privileged = inputs.privileged(
            view.lin_vel_b,
            state.torque,
            view.joint_acc,
            state.qpos[:, 2],
            view.ee_vel_b[:, :3],
            view.ee_vel_b[:, 3:],
            view.feet_b,
            episode.dynamics[:, :NUM_JOINTS],
            episode.dynamics[:, NUM_JOINTS : 2 * NUM_JOINTS],
            episode.dynamics[:, -2],
            episode.dynamics[:, -1],
            state.foot_force_w.flatten(1),
        )
        return Seen(
            policy=torch.cat([_observation(term, episode), view.command], -1),
            critic=torch.cat([_observation(true, episode), view.command, privileged], -1),
            term=term,
            velocity=view.lin_vel_b,
            next_observation=inputs.next_observation(
                ang_vel, view.gravity_b, view.joint_pos, joint_vel, view.ee, view.feet_b
            ),
        )

    def lack(self) -> Tensor:
        """What the legs lack [rad] (N, 8) of a posture that reaches the target, where robots should know it.

        That is where one stands still, need not step, and its hand is late; elsewhere 0.
        """
        state, view, episode = self._state, self._view, self._episode
        loaded = (state.foot_force_w[..., 2].abs() > CONTACT_FORCE).all(-1)
        speed = torch.linalg.vector_norm(state.qvel[:, :3], dim=-1)
        turning = torch.linalg.vector_norm(state.qvel[:, 3:6], dim=-1)
        still = loaded & (speed < STILL) & (turning < STILL_TURNING)
        late = (episode.d_ref < ARRIVES) & (view.pos_error > self.protocol.success.position)
        in_place = episode.stratum != STRATA.index("step")
        lack = episode.posture - view.joint_pos[:, :NUM_LEG_JOINTS]
        return torch.where((still & late & in_place)[:, None], lack, 0.0)

    # ---- the log -------------------------------------------------------------------------------------------

    def clear_log(self) -> None:
        """Forget what has been counted."""
        self._sums: Tensor | float = 0.0  # of the means named in `_named`
        self._named: list[str] = []
        self._steps = 0
        self._ended = torch.zeros(len(STRATA), 1 + len(OUTCOMES), dtype=torch.float64, device=self.device)

    def _log(
        self,
        terms: dict[str, Tensor],
        gates: dict[str, Tensor],
        view: View,
        done: Tensor,
        time_out: Tensor,
        diverged: Tensor,
    ) -> None:
        self._steps += 1
        named = {f"reward/{k}": v for k, v in terms.items()} | {f"gate/{k}": v for k, v in gates.items()}
        self._named = list(named)
        self._sums = self._sums + torch.stack(list(named.values())).mean(-1)
        episode = self._episode
        held = time_out & (episode.inside >= self.protocol.window_steps)
        fell = done & ~time_out & ~diverged
        nothing = torch.zeros_like(view.pos_error)
        columns = [
            *(torch.ones_like(view.pos_error), held, fell, diverged, episode.step, episode.earned),
            *(torch.where(time_out, error, nothing) for error in (view.pos_error, view.rot_error)),
            time_out,
        ]
        rows = torch.stack([torch.where(done, column, 0).double() for column in columns], -1)
        self._ended.index_add_(0, episode.stratum, rows)

    def log(self) -> dict[str, float]:
        """Means since `clear_log`: reward terms a step, gates, outcomes of the episodes that ended.

        Success and falls are shares of ended episodes; the errors those at the end of episodes that lasted.
        Where no episode ended, NaN.
        """
        sums = torch.as_tensor(self._sums).tolist() if self._named else []
        found = {name: value / self._steps for name, value in zip(self._named, sums, strict=True)}
        ended = self._ended.cpu().numpy()
        for name, row in [("", ended.sum(0)), *((f"_{s}", ended[k]) for k, s in enumerate(STRATA))]:
            episodes, success, fell, diverged, length, earned, pos, rot, lasted = row
            share = 1 / episodes if episodes else np.nan
            found |= {
                f"episode{name}/count": episodes,
                f"episode{name}/success": success * share,
                f"episode{name}/falls": fell * share,
                f"episode{name}/diverged": diverged,
                f"episode{name}/seconds": length * share * self.protocol.control_period,
                f"episode{name}/return": earned * share,
                f"episode{name}/pos_error": pos / lasted if lasted else np.nan,
                f"episode{name}/rot_error": rot / lasted if lasted else np.nan,
            }
        return found

    # ---- resuming ------------------------------------------------------------------------------------------

    def save(self) -> dict:
        """Everything that a later step depends on, between two rollouts."""
        return {
            "backend": {k: torch.from_numpy(v) for k, v in self._backend.save().items()},
            "state": self._state._asdict(),
            "episode": self._episode._asdict(),
            "view": self._view._asdict(),
            "seen": self.seen._asdict(),
            "bank": self._bank._asdict(),
        }

    def load(self, saved: dict) -> None:
        """Go on from what `save` returned."""
        self._backend.load({k: v.numpy() for k, v in saved["backend"].items()})
        for kind, name in ((State, "_state"), (Episode, "_episode"), (View, "_view"), (Seen, "seen")):
            fields = {k: v.to(self.device) for k, v in saved[name.strip("_")].items()}
            setattr(self, name, kind(**fields))
        bank = _Bank(**saved["bank"])
        self._draw(bank)

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.tensor(array, dtype=torch.float32, device=self.device)


def _observation(term: Tensor, episode: Episode) -> Tensor:
    """The observation (N, 58) of the columns that it shares with a term of the window, (N, 57)."""
    ang_vel, gravity, joint_pos, joint_vel, _, ee = term.split([3, 3, *[NUM_JOINTS] * 3, 9], -1)
    return inputs.observation(ang_vel, gravity, joint_pos, joint_vel, episode.action, ee, episode.d_ref)


def rotation_from_wxyz(quat: Tensor) -> Tensor:
    """Rotation matrices (N, 3, 3) of unit quaternions (N, 4), as `wbc_bench.rotations.matrix_from_wxyz`."""
    w, x, y, z = quat.unbind(-1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def noise_half_widths(protocol: EvalProtocol) -> np.ndarray:
    """Half-widths (57,) of the uniform noise on a term of the window."""
    noise, joints = protocol.noise, NUM_JOINTS
    widths = {"base_ang_vel": 3, "gravity": 3, "joint_pos": joints, "joint_vel": joints}
    widths |= {"joint_torque": joints, "ee_pos": 3, "ee_rot": 6}
    return np.concatenate([np.full(width, getattr(noise, name)) for name, width in widths.items()])


def body_of(robot: Robot, device: torch.device) -> Body:
    """What of a robot the reward needs."""
    import mujoco

    model = robot.model()
    data = mujoco.MjData(model)
    data.qpos[:] = [0, 0, robot.facts.nominal_base_height, 1, 0, 0, 0, *robot.default_q]
    mujoco.mj_kinematics(model, data)
    feet = np.stack([data.site(f"sole_{side}").xpos[:2] for side in "LR"])
    middle = (robot.lower + robot.upper)[NUM_LEG_JOINTS:] / 2
    tensors = (torch.tensor(a, dtype=torch.float32) for a in (robot.lower, robot.upper, middle, feet))
    return Body(*(tensor.to(device) for tensor in tensors))
