"""The builds of the robot: what they have in common, what the paper's own has, and their digests."""

import msgspec
import mujoco
import numpy as np
import pytest

from wbc_bench.episodes.manifest import manifest_path, read_manifest
from wbc_bench.episodes.protocol import EvalProtocol, find_protocol
from wbc_bench.errors import ManifestError, UnknownNameError
from wbc_bench.robot import JOINT_NAMES, Robot, RobotConfig, load_facts, load_robot
from wbc_bench.robot.kinematics import ArmKinematics

PAPER = RobotConfig(variant="paper")


def test_the_paper_s_robot_has_the_constants_of_its_public_code() -> None:
    """Each value as the public sources write it; see the facts file."""
    robot = load_robot(PAPER)
    model = robot.model()
    assert model.body_mass.sum() == pytest.approx(27.05, abs=0.005)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    mount = data.body("arm_base").xpos - data.body("base_Link").xpos
    np.testing.assert_allclose(mount, [0, 0, 0.1123], atol=1e-12)
    np.testing.assert_allclose(data.site("tcp").xpos, data.body("arm_link6").xpos, atol=1e-12)
    leg, arm = [40, 40, 40, 45] * 2, [18, 18, 18, 4, 4, 4]
    np.testing.assert_array_equal(robot.kp, leg + arm)
    np.testing.assert_array_equal(robot.kd, [1.8, 1.8, 1.8, 0.8] * 2 + [1, 1, 1, 0.5, 0.5, 0.5])
    np.testing.assert_array_equal(robot.effort, [80, 80, 80, 40] * 2 + [18, 18, 18, 3, 3, 3])
    np.testing.assert_array_equal(robot.default_q, [0] * 8 + [0, 0.5, 0, 0, 0, 0])
    ankle = model.joint("ankle_L_Joint").dofadr[0]
    assert model.dof_frictionloss[ankle] == 0.33 and model.dof_frictionloss.sum() == 0.66


def test_the_first_variant_is_the_robot_of_the_first_protocols() -> None:
    assert RobotConfig().variant == "limx_adapter"
    assert load_robot().digest == load_robot(RobotConfig(variant="limx_adapter")).digest
    assert load_robot().facts.variant.motor is None
    assert load_robot().model().dof_frictionloss.sum() == 0


def test_unknown_variants_are_one_line() -> None:
    with pytest.raises(UnknownNameError, match=r"unknown robot variant 'papr' .*did you mean paper\?"):
        load_robot(RobotConfig(variant="papr"))


@pytest.mark.parametrize("variant", load_facts().variants)
def test_every_variant_names_its_sources_and_keeps_the_joints(variant: str) -> None:
    facts = load_facts(variant)
    assert tuple(joint.name for joint in facts.joints) == JOINT_NAMES
    blocks = [*facts.variant.links, *facts.variant.joints, facts.variant.gains, facts.variant.motor]
    assert all(block.src for block in blocks if block is not None)


@pytest.mark.parametrize("variant", load_facts().variants)
def test_soles_carry_the_facts_friction(variant: str) -> None:
    """Of two surfaces the larger coefficient counts: a sole of MuJoCo's default would hide the ground's."""
    robot = load_robot(RobotConfig(variant=variant))
    model = robot.model()
    touching = ["ground", *(f"foot_{side}_{corner}" for side in "LR" for corner in range(4))]
    assert {model.geom(name).friction[0] for name in touching} == {robot.facts.friction.slide}


@pytest.mark.parametrize("variant", load_facts().variants)
def test_urdf_and_mjcf_list_the_joints_in_one_order(variant: str) -> None:
    """Also for a reader that takes the URDF's order as it is, which MuJoCo does."""
    robot = load_robot(RobotConfig(variant=variant))
    model = mujoco.MjModel.from_xml_string(robot.urdf())
    assert tuple(model.joint(i).name for i in range(model.njnt)) == JOINT_NAMES


def test_digests_tell_robots_apart() -> None:
    configs = [RobotConfig(), PAPER, RobotConfig(ankle_effort=40.0), RobotConfig(tcp="link6")]
    assert len({load_robot(config).digest for config in configs}) == len(configs)
    robot = load_robot()
    facts = robot.facts
    heavier = msgspec.structs.replace(facts.links[0], mass=facts.links[0].mass + 0.001)
    sourced = msgspec.structs.replace(facts.links[0], src="elsewhere")

    def with_first(link) -> str:
        links = (link, *facts.links[1:])
        changed = {**vars(robot), "facts": msgspec.structs.replace(facts, links=links)}
        return Robot(**changed).digest

    assert with_first(heavier) != robot.digest == with_first(sourced)


def test_a_manifest_of_a_robot_whose_facts_changed_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    protocol, path = find_protocol("smoke_v1")
    read_manifest(protocol, manifest_path(path))
    monkeypatch.setattr(Robot, "digest", "0" * 64)
    with pytest.raises(ManifestError, match=r"another|robot of digest .* facts have changed, make it again"):
        read_manifest(protocol, manifest_path(path))


@pytest.mark.parametrize(
    "config",
    [RobotConfig(), PAPER, RobotConfig(tcp="umi_on_tron_das_optical")],
    ids=lambda c: c.variant + c.tcp,
)
def test_arm_kinematics_are_mujoco_s(config: RobotConfig) -> None:
    robot = load_robot(config)
    model = robot.model()
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    q = rng.uniform(robot.lower[8:], robot.upper[8:], (20, 6))
    pos, rot = ArmKinematics(robot).pose(q)
    for i in range(len(q)):
        data.qpos[:7], data.qpos[7:15], data.qpos[15:] = [0, 0, 0, 1, 0, 0, 0], 0, q[i]
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(pos[i], data.site("tcp").xpos, atol=1e-12)
        np.testing.assert_allclose(rot[i].ravel(), data.site("tcp").xmat, atol=1e-12)


def test_the_arm_s_jacobian_is_that_of_finite_differences() -> None:
    arm, rng, h = ArmKinematics(load_robot()), np.random.default_rng(0), 1e-6
    q = rng.uniform(-1.0, 1.0, (5, 6))
    _, rot, jacobian = arm.pose_and_jacobian(q)
    for k in range(6):
        step = h * np.eye(6)[k]
        (p1, r1), (p0, r0) = arm.pose(q + step), arm.pose(q - step)
        np.testing.assert_allclose((p1 - p0) / (2 * h), jacobian[:, :3, k], atol=1e-8)
        turn = (r1 - r0) / (2 * h) @ np.swapaxes(rot, 1, 2)
        axis = np.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], axis=1)
        np.testing.assert_allclose(axis, jacobian[:, 3:, k], atol=1e-8)


def test_mjcf_export_keeps_the_motor() -> None:
    from wbc_bench.robot import build_spec

    robot = load_robot(PAPER)
    spec = build_spec(robot.facts, robot.config)
    spec.compile()
    again, model = mujoco.MjModel.from_xml_string(spec.to_xml()), robot.model()
    for name in ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange", "dof_frictionloss"):
        np.testing.assert_allclose(getattr(again, name), getattr(model, name), rtol=1e-5, atol=1e-9)


def test_protocol_digests_of_released_protocols_do_not_move() -> None:
    """Fields that joined later stay out of the digest while they have their defaults."""
    protocol: EvalProtocol = find_protocol("ablation_v1")[0]
    assert protocol.digest[:16] == DIGEST
    for config in (PAPER, RobotConfig(ankle_effort=40.0)):
        assert msgspec.structs.replace(protocol, robot=config).digest != protocol.digest


DIGEST = "4f611cb821f797a8"
