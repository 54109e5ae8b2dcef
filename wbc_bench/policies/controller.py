"""A policy of a card as a controller: observations in, networks, joint commands out."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wbc_bench.controller import (
    CommandPart,
    Controller,
    ControllerInfo,
    JointCommand,
    Observation,
    ProtocolAware,
    Signal,
    Target,
)
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.errors import ControllerError
from wbc_bench.policies.card import PolicyCard, check_card, read_card
from wbc_bench.policies.follower import Follower
from wbc_bench.policies.observations import Group, numbers
from wbc_bench.policies.onnx_network import OnnxNetwork
from wbc_bench.policies.terms import Seen
from wbc_bench.registry import load_controller
from wbc_bench.robot import JOINT_NAMES, NUM_JOINTS, Robot, RobotConfig, mount_of, tcp_of
from wbc_bench.rotations import geodesic_angle, matrix_from_rho6, matrix_from_rpy

Array = NDArray[np.float64]
REFERENCE_DECAY = 1.0  # [1/s] where no protocol says otherwise


class CardController:
    """Runs the networks of a card."""

    def __init__(self, robot: Robot, card: PolicyCard, path: Path) -> None:
        """Raises: ControllerError, UnknownNameError: the card, its files and the robot do not go together."""
        where = f"policy card {path}"
        if card.robot not in ("", robot.config.variant):
            raise ControllerError(
                f"{where} is for the robot variant '{card.robot}', the protocol has '{robot.config.variant}'"
            )
        self.card, self._robot, self._decay = card, robot, REFERENCE_DECAY
        self._tool_pos, self._tool_rot = _tool(robot, card.tcp)
        action = card.action
        names = action.joints or card.joints
        self.driven = np.array([JOINT_NAMES.index(name) for name in names], dtype=np.int64)
        size = len(names)
        self.default_q = robot.default_q.copy()
        for name, value in card.default_posture.items():
            self.default_q[JOINT_NAMES.index(name)] = value
        default = self.default_q[self.driven] if action.type == "position" else np.zeros(size)
        self.scale = numbers(action.scale, size, f"{where}: action.scale")
        self._offset = (
            default if action.offset == "default" else numbers(action.offset, size, f"{where}: action.offset")
        )
        torque = action.type == "torque"
        self._gains: dict[str, Array] = {}
        for part, own in (("kp", robot.kp), ("kd", robot.kd)):
            value = getattr(action, part)
            if torque and value is None:
                value = 0.0
            if value is not None:
                self._gains[part] = own.copy()
                self._gains[part][self.driven] = numbers(value, size, f"{where}: action.{part}")
        self.groups = [Group(group, card, size, where) for group in card.observation]
        widths = {group.name: group.size for group in self.groups}
        self.networks = [OnnxNetwork(network, path.parent, widths, where) for network in card.network]
        if widths["action"] not in (0, size):
            raise ControllerError(
                f"{where}: 'action' has {widths['action']} numbers, it drives {size} joints"
            )
        follower = card.follower
        self._follower = None
        if follower is not None:
            self._follower = Follower(robot, follower.gain, follower.limits, follower.tolerance)
        self._others: Controller | None = None
        if action.others != "hold":
            self._others = load_controller(action.others, robot)
            period = self._others.info.control_period
            if abs(period - card.control_period) > 1e-9:
                raise ControllerError(
                    f"{where}: action.others '{action.others}' runs every {period:g} s, the card every "
                    f"{card.control_period:g} s, valid: equal periods"
                )
        signals: set[Signal] = {
            signal for group in self.groups for column in group.columns for signal in column.signals
        }
        commands: set[CommandPart] = set(self._gains)  # pyright: ignore[reportAssignmentType]
        if torque:
            commands.add("torque")
        own = torque or size != NUM_JOINTS or not np.array_equal(self.scale, robot.action_scale[self.driven])
        if own or action.filter != 1:
            commands.add("action")
        if self._others is not None:
            signals |= self._others.info.signals
        files = (path, *(network.path for network in self.networks))
        self.info = ControllerInfo(
            card.name,
            frozenset(signals),
            card.control_period,
            card.source or str(path),
            files,
            frozenset(commands),
        )
        self._reads_reference = any(t.term == "phase_reference" for g in card.observation for t in g.terms)

    @property
    def gains(self) -> tuple[Array, Array]:
        """kp (14,) [N m/rad] and kd (14,) [N m s/rad] that act."""
        return self._gains.get("kp", self._robot.kp), self._gains.get("kd", self._robot.kd)

    def prepare(self, protocol: EvalProtocol) -> None:
        """Take the decay of the reference from a protocol."""
        self._decay = protocol.reference_decay
        if isinstance(self._others, ProtocolAware):
            self._others.prepare(protocol)

    def reset(self, episodes: NDArray[np.int64], obs: Observation, target: Target) -> None:
        """Forget history and states."""
        for part in (*self.groups, *self.networks):
            part.reset()
        self._last = np.zeros((len(episodes), len(self.driven)))
        self._filtered: Array | None = None
        self._steps = 0
        self._reference = np.zeros(len(episodes))
        if self._reads_reference:
            seen = self._seen(obs, target)
            # Source: paper, eq. rfm_phase, first line
            self._reference = 2 * np.linalg.norm(seen.ee_pos_b - seen.target_pos_b, axis=1)
            self._reference += geodesic_angle(seen.ee_rot_b, seen.target_rot_b)
        if self._follower is not None:
            self._follower.start(*self._seen(obs, target).in_frame(*target, "heading"))
        if self._others is not None:
            self._others.reset(episodes, obs, target)

    def act(self, obs: Observation, target: Target) -> JointCommand:
        """The commands of one control step."""
        if self._steps:
            decayed = self._reference - self._decay * self.info.control_period
            self._reference = np.maximum(decayed, 0.0)
        self._steps += 1
        seen = self._seen(obs, target)
        if self._follower is not None:
            seen = replace(seen, velocity=self._follower.command(*seen.in_frame(*target, "heading")))
        self.values = {group.name: group.compute(seen) for group in self.groups}
        for network in self.networks:
            self.values |= network(self.values)
        raw = self.values["action"]
        card = self.card.action
        action = raw if card.clip is None else np.clip(raw, *card.clip)
        self._last = raw if card.last_action == "raw" else action
        if self._filtered is not None:
            action = card.filter * action + (1 - card.filter) * self._filtered
        self._filtered = action
        count = len(obs.active)
        q, infeasible = np.tile(self.default_q, (count, 1)), None
        if self._others is not None:
            other = self._others.act(obs, target)
            q, infeasible = np.array(other.q), other.infeasible
        parts = {part: np.tile(values, (count, 1)) for part, values in self._gains.items()}
        moved = self._offset + self.scale * action
        if card.type == "torque":
            parts["torque"] = np.zeros((count, NUM_JOINTS))
            parts["torque"][:, self.driven] = moved
        else:
            q[:, self.driven] = moved
        if "action" in self.info.commands:
            parts["action"] = raw
        return JointCommand(q, infeasible, **parts)

    def _seen(self, obs: Observation, target: Target) -> Seen:
        """What terms are computed of; the tool frame is the card's."""
        count = len(obs.active)
        ee_pos, ee_rot = np.zeros((count, 3)), np.tile(np.eye(3), (count, 1, 1))
        columns = ee_rot[:, :, :2]
        if obs.ee_pose is not None:
            measured = obs.ee_pose.rot6_b
            ee_rot = matrix_from_rho6(measured)
            ee_pos = obs.ee_pose.pos_b + ee_rot @ self._tool_pos
            turned = not np.array_equal(self._tool_rot, np.eye(3))
            columns = (ee_rot @ self._tool_rot)[:, :, :2] if turned else _columns(measured)
        return Seen(
            proprioception=obs.proprioception,
            base_pose=obs.base_pose,
            ee_pos_b=ee_pos,
            ee_rot_b=ee_rot @ self._tool_rot,
            ee_columns_b=columns,
            target_pos_b=target.pos_b + target.rot_b @ self._tool_pos,
            target_rot_b=target.rot_b @ self._tool_rot,
            default_q=self.default_q,
            last_action=self._last,
            time=obs.time,
            phase_reference=self._reference,
            arm_mount_b=np.array(mount_of(self._robot.facts, self._robot.config).xyz),
            quaternion=self.card.quaternion,
        )


def from_card(robot: Robot, path: Path, card: PolicyCard | None = None) -> CardController:
    """The controller of a card in a file, or of one that was changed since it was read.

    Raises: ControllerError, UnknownNameError, see `read_card` and `CardController`.
    """
    if card is None:
        card = read_card(path)
    else:
        check_card(card, str(path))
    return CardController(robot, card, path)


def _tool(robot: Robot, name: str) -> tuple[Array, Array]:
    """Position [m] and rotation of a card's tool frame in the robot's. Raises: UnknownNameError."""
    here, config = tcp_of(robot.facts, robot.config), robot.config
    if not name:
        return np.zeros(3), np.eye(3)
    there = tcp_of(robot.facts, RobotConfig(variant=config.variant, tcp=name))
    rot = matrix_from_rpy(np.array(here.rpy))
    return (np.array(there.xyz) - np.array(here.xyz)) @ rot, rot.T @ matrix_from_rpy(np.array(there.rpy))


def _columns(rot6: Array) -> Array:
    """(N, 3, 2) of two columns (N, 6)."""
    return np.swapaxes(rot6.reshape(-1, 2, 3), 1, 2)
