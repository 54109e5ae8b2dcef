"""The MuJoCo model of a protocol's episodes: its robot, a payload, and the ground."""

import mujoco

from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.episodes.terrain import uneven
from wbc_bench.robot import Scene, build_spec, load_robot, tcp_of

PAYLOAD = "payload"  # body in the hand, massless until an episode gives it its mass
_CONES = {
    "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC,
    "pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL,
}
# One robot is one island: looking for more takes time and leaves every bit as it is. Without the mid-phase
# the engine is quicker, but contacts come in another order, and after a fall the last bits differ.
_IDLE = mujoco.mjtDisableBit.mjDSBL_ISLAND


def world_model(protocol: EvalProtocol, scene: Scene | None = None) -> mujoco.MjModel:
    """The compiled model of a protocol, in a scene if one is given.

    A protocol without payload and bumps has the robot's own model, to the bit, but for a part of the engine
    that has nothing to do where there is no scene.
    """
    robot = load_robot(protocol.robot)
    spec = build_spec(robot.facts, robot.config, protocol.physics.timestep)
    spec.option.cone = _CONES[protocol.physics.cone]
    spread = protocol.randomization
    if spread.payload[1] > 0:
        tcp = tcp_of(robot.facts, robot.config)
        hand = spec.body(tcp.link).add_body(name=PAYLOAD, pos=tcp.xyz)
        hand.explicitinertial = True
    if spread.step_height > 0:
        uneven(spec, spread.step_height)
    if scene is None:
        spec.option.disableflags |= _IDLE
    else:
        scene.furnish(spec)
    return spec.compile()
