"""Late commands and states: against a queue of every physics step, and against MuJoCo's own delays."""

from typing import NamedTuple

import msgspec
import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

from wbc_bench.episodes.manifest import EpisodeManifest, manifest_path, read_manifest
from wbc_bench.episodes.protocol import EvalProtocol, find_protocol
from wbc_bench.evaluation import simulation as simulation_module
from wbc_bench.evaluation.delays import LateCommands, LateStates
from wbc_bench.evaluation.rollout import rollout
from wbc_bench.registry import load_controller
from wbc_bench.robot import build_spec, load_robot

DECIMATION = 10
DELAYS = np.array([0, 1, 4, 9, 10, 11, 20, 37])


class Clock(NamedTuple):
    """A state that is nothing but its own time, twice."""

    time: np.ndarray
    pair: np.ndarray


def test_commands_act_as_from_a_queue() -> None:
    late = LateCommands(DELAYS, DECIMATION, np.array([-1.0]))
    given: list[float] = []
    for step in range(8):
        late.give(np.full((len(DELAYS), 1), float(step)))
        given += [float(step)] * DECIMATION
        acting = None
        for offset in range(DECIMATION):
            if offset == 0 or offset in late.offsets:
                acting = late.acting(offset)[:, 0]
            now = step * DECIMATION + offset
            expected = [given[now - d] if now >= d else -1.0 for d in DELAYS]
            np.testing.assert_array_equal(acting, expected)


def test_states_are_seen_as_old_as_asked() -> None:
    late = LateStates[Clock](DELAYS, DECIMATION)

    def at(time: int) -> Clock:
        times = np.full(len(DELAYS), float(time))
        return Clock(times, np.stack([times, times], axis=1))

    assert late.start(at(0)).time[0] == 0
    for step in range(1, 9):
        late.begin_step()
        for offset in sorted(late.offsets):
            late.sample(offset, at((step - 1) * DECIMATION + offset))
        seen, now = late.seen(), step * DECIMATION
        np.testing.assert_array_equal(seen.time, np.maximum(now - DELAYS, 0))
        np.testing.assert_array_equal(seen.pair, np.maximum(now - DELAYS, 0)[:, None] * [1, 1])


@pytest.fixture(scope="module")
def twenty(smoke: EvalProtocol) -> EpisodeManifest:
    protocol, path = find_protocol("tuning_v1")
    return read_manifest(protocol, manifest_path(path))[0].take(slice(0, 20))


@pytest.mark.parametrize("spec", ["hold", "learned:transformer_gru@0"])
def test_bit_equal_to_the_delay_of_the_engine(
    spec: str, twenty: EpisodeManifest, monkeypatch: pytest.MonkeyPatch
) -> None:
    """8 ms late, 20 episodes of 2 s with everything drawn.

    MuJoCo looks a command up by accumulated time, which is why its delay is placed between two steps; a reset
    fills its buffer with zeros, which is why the buffer is filled here.
    """
    protocol = find_protocol("tuning_v1")[0]
    episodes = msgspec.structs.replace(protocol.episodes, horizon=2.0)
    protocol = msgspec.structs.replace(protocol, episodes=episodes)
    robot, steps = load_robot(protocol.robot), 4
    count = len(twenty)

    def run(delay: float):
        rows = EpisodeManifest(**(vars(twenty) | {"command_delay": np.full(count, delay)}))
        return rollout(load_controller(spec, robot), protocol, rows)

    ours = run(steps * protocol.physics.timestep)

    def world(protocol: EvalProtocol, scene=None) -> mujoco.MjModel:
        spec = build_spec(robot.facts, robot.config, protocol.physics.timestep)
        for actuator in spec.actuators:
            actuator.nsample = steps + 4
            actuator.delay = (steps - 0.5) * protocol.physics.timestep
        return spec.compile()

    class Filled(Batch):
        def forward(self, *args, **kwargs):
            history = self.bind("history")
            ctrl = self.bind("ctrl")
            for i in range(len(ctrl)):
                data = self.get_data(i)
                for k in range(self.model.nu):
                    size = self.model.actuator_history[k, 0]
                    mujoco.mj_initCtrlHistory(self.model, data, k, None, np.full(size, ctrl[i, k]))
                history[i] = data.history
            return super().forward(*args, **kwargs)

    monkeypatch.setattr(simulation_module, "world_model", world)
    monkeypatch.setattr(simulation_module, "Batch", Filled)
    native = run(0.0)
    for name in ("position_error", "orientation_error", "action", "ee_pos_w", "outcome"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(native, name), err_msg=name)
    monkeypatch.undo()
    prompt = run(0.0)
    assert np.array_equal(prompt.ee_pos_w, ours.ee_pos_w, equal_nan=True) == (spec == "hold")
