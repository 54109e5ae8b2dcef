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


def world_model(protocol: EvalProtocol, scene: Scene | None = None) -> mujoco.MjModel:
    """The compiled model of a protocol, in a scene if one is given.

    A protocol without payload and bumps has the robot's own model, to the bit.
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
    if scene is not None:
        scene.furnish(spec)
    return spec.compile()
