"""The source `diffusion`: a policy that looks at hand and door and says where the hand is to go."""

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray

from wbc_bench.randomness import stream
from wbc_bench.robot import Scene
from wbc_bench.rotations import wxyz_from_matrix
from wbc_bench.sources.diffusion import poses
from wbc_bench.sources.diffusion.demonstrations import GRIPPER_WIDTH, door_state
from wbc_bench.sources.diffusion.policy import ACTION, HORIZON, PERIOD, Policy, look
from wbc_bench.sources.diffusion.scene import Door, DoorScene
from wbc_bench.sources.interface import Seen, StampedTarget
from wbc_bench.sources.slew import Pose, between

Array = NDArray[np.float64]
EXECUTED = 8  # poses of a chunk until the next one is made


class DiffusionSource:
    """Receding horizon: a chunk of poses, of which the first EXECUTED are followed, then another.

    The noise it begins each chunk with is the stream of `seed` and `episode`: equal episodes, equal targets.
    """

    live = False

    def __init__(
        self, policy: Policy, door: Door, seed: int, episode: int = 0, digest: str | None = None
    ) -> None:
        self.name, self.door, self.digest = "diffusion", door, digest
        self.scene: Scene = DoorScene(door)
        self.counters: Mapping[str, int] = {}
        self._policy, self._key = policy, (seed, episode)

    def look(self, scenery: Array) -> None:
        """The door's angle."""
        self._angle = float(scenery[0])

    def reset(self, seen: Seen) -> None:
        """Forget what was seen."""
        seed, episode = self._key
        self._rng = stream(seed, "diffusion", episode)
        self._looks: list[tuple[float, Pose, Array]] = []  # time [s], tool, door; the latest last
        self._planned = -np.inf  # [s]
        self._chunk: list[Pose] = []  # of the tool, in the world

    def target(self, time: float, seen: Seen) -> StampedTarget:
        """Between two poses of the present chunk, which is made anew when it is due."""
        self._remember(time, seen)
        if time - self._planned > EXECUTED * PERIOD - 1e-9:
            self._plan(time)
        place = (time - self._planned) / PERIOD
        k = min(int(place), HORIZON - 2)
        pos, rot = poses.hand(between(self._chunk[k], self._chunk[k + 1], place - k))
        return StampedTarget(time, "world", pos, wxyz_from_matrix(rot))

    def close(self) -> None:
        """Nothing to let go of."""

    def _remember(self, time: float, seen: Seen) -> None:
        hand = Pose(seen.ee_pos_w, seen.ee_rot_w)
        panel = self.door.panel(self._angle)
        self._looks.append((time, poses.tool(hand), door_state(panel, np.array(self._angle), hand)))
        # of the looks that are old enough, the youngest is the one that a plan needs
        while len(self._looks) > 1 and self._looks[1][0] <= time - PERIOD + 1e-9:
            self._looks.pop(0)

    def _plan(self, time: float) -> None:
        (_, before, door_before), (_, now, door_now) = self._looks[0], self._looks[-1]
        seen = torch.from_numpy(look(before, now, GRIPPER_WIDTH, door_before, door_now)).float()
        noise = torch.from_numpy(self._rng.standard_normal((1, HORIZON * ACTION))).float()
        chunk = self._policy.chunk(seen[None], noise)[0].double().numpy()
        pos, rot = poses.absolute(poses.pose_of(chunk[:, : poses.POSE]), now)
        self._chunk, self._planned = [Pose(p, r) for p, r in zip(pos, rot, strict=True)], time
