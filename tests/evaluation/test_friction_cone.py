"""Why friction cones are elliptic: the standing robot against Coulomb's law, along an axis and between."""

import msgspec
import mujoco
import numpy as np
import pytest

from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.episodes.world import world_model
from wbc_bench.robot import load_robot

SECONDS = 0.5


def frozen(model: mujoco.MjModel, q: np.ndarray) -> mujoco.MjModel:
    """The robot as one rigid body that stands on its soles at joint positions (14,) [rad]."""
    data = mujoco.MjData(model)
    data.qpos[3], data.qpos[7:] = 1.0, q
    mujoco.mj_forward(model, data)
    corners = [model.geom(f"foot_{side}_{k}").id for side in "LR" for k in range(4)]
    place, radius = data.geom_xpos[corners], float(model.geom_size[corners[0], 0])
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.cone = model.opt.timestep, model.opt.cone
    spec.option.integrator = model.opt.integrator
    friction = model.geom_friction[corners[0]]
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[5, 5, 0.1], friction=friction)
    mass, com = float(model.body_mass.sum()), data.subtree_com[0]
    body = spec.worldbody.add_body(name="robot", pos=[0, 0, radius - place[:, 2].min()])
    body.add_freejoint()
    body.explicitinertial, body.mass, body.ipos, body.inertia = True, mass, com, [1, 1, 1]
    for pos in place:
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], pos=pos, friction=friction)
    return spec.compile()


def way(protocol: EvalProtocol, cone: str, share: float, bearing: float) -> float:
    """Way [m] of the soles under a force of `share` of Coulomb's limit in the plane of the ground."""
    physics = msgspec.structs.replace(protocol.physics, cone=cone)
    model = frozen(
        world_model(msgspec.structs.replace(protocol, physics=physics)), load_robot(protocol.robot).default_q
    )
    data, body = mujoco.MjData(model), model.body("robot").id
    limit = float(model.geom_friction[0, 0] * model.body_mass[body] * 9.81)
    force = share * limit * np.array([np.cos(bearing), np.sin(bearing), 0.0])
    for _ in range(round(0.2 / model.opt.timestep)):
        mujoco.mj_step(model, data)
    start = data.qpos[:2].copy()
    for _ in range(round(SECONDS / model.opt.timestep)):
        mujoco.mj_forward(model, data)
        data.qfrc_applied[:] = 0.0
        at_ground = np.array([*data.xipos[body][:2], 0.0])  # no moment that would tip the robot over
        mujoco.mj_applyFT(model, data, force, np.zeros(3), at_ground, body, data.qfrc_applied)
        mujoco.mj_step(model, data)
    return float(np.linalg.norm(data.qpos[:2] - start))


@pytest.mark.parametrize("bearing", [0.0, np.pi / 4, np.pi / 2])
def test_elliptic_soles_hold_below_coulombs_limit_and_slide_above(smoke: EvalProtocol, bearing: float):
    assert way(smoke, "elliptic", 0.9, bearing) < 0.002
    above = way(smoke, "elliptic", 1.1, bearing)
    free = 0.5 * 0.1 * 9.81 * 0.8 * SECONDS**2  # what is left of the force accelerates the mass
    assert above == pytest.approx(free, rel=0.2)  # sideways the load moves to one foot


def test_pyramidal_soles_slide_at_four_fifths_of_the_limit_between_the_axes(smoke: EvalProtocol):
    assert way(smoke, "pyramidal", 0.9, 0.0) < 0.003
    assert way(smoke, "pyramidal", 0.8, np.pi / 4) > 0.05
