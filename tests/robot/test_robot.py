"""The robot: MuJoCo and Pinocchio agree on it, and what the facts say arrives in both models."""

import itertools
import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco
import numpy as np
import pytest

from wbc_bench.errors import BenchError, ProtocolError, UnknownNameError
from wbc_bench.robot import JOINT_NAMES, Robot, RobotConfig, build_spec, load_facts, load_robot
from wbc_bench.robot.facts import FACTS_FILE
from wbc_bench.rotations import wxyz_from_matrix, xyzw_from_wxyz
from wbc_bench.viewer import picture

FACTS = load_facts()
NUM_SAMPLES = 20
CONFIGS = [
    *(
        RobotConfig(mount=mount, tcp=tcp)
        for mount, tcp in itertools.product(FACTS.mounts, FACTS.tcp.variants)
    ),
    *(RobotConfig(variant=variant) for variant in FACTS.variants),
]
GRAVITY = 9.81


class Both:
    """The two models of a robot in the same random configuration.

    MuJoCo's generalised velocity is [base linear, world; base angular, body; joints], Pinocchio's free-flyer
    has both base velocities in the body frame: v_pin = T v_mj, hence M_mj = T^T M_pin T and g_mj = T^T g_pin.
    """

    def __init__(self, robot: Robot) -> None:
        self.pin = pytest.importorskip("pinocchio")
        self.robot = robot
        self.mj = robot.model()
        self.mj_data = mujoco.MjData(self.mj)
        self.model = self.pin.buildModelFromXML(robot.urdf(), self.pin.JointModelFreeFlyer())
        joints = [self.model.joints[self.model.getJointId(name)] for name in JOINT_NAMES]
        self.q_index = [joint.idx_q for joint in joints]
        self.v_index = [joint.idx_v for joint in joints]
        armature = np.zeros(self.model.nv)
        armature[self.v_index] = robot.armature
        self.model.armature = armature
        self.data = self.model.createData()

    def place(self, rng: np.random.Generator) -> None:
        pos, quat = rng.normal(size=3), rng.normal(size=4)
        quat /= np.linalg.norm(quat)  # wxyz
        joints = rng.uniform(self.robot.lower, self.robot.upper)
        self.mj_data.qpos[:] = [*pos, *quat, *joints]
        self.mj_data.qvel[:] = 0
        mujoco.mj_forward(self.mj, self.mj_data)
        self.q = np.zeros(self.model.nq)
        self.q[:3], self.q[3:7], self.q[self.q_index] = pos, xyzw_from_wxyz(quat), joints
        self.pin.forwardKinematics(self.model, self.data, self.q)
        self.pin.updateFramePlacements(self.model, self.data)
        rot_w = np.zeros(9)
        mujoco.mju_quat2Mat(rot_w, quat)
        self.T = np.zeros((self.model.nv, self.mj.nv))
        self.T[:3, :3], self.T[3:6, 3:6] = rot_w.reshape(3, 3).T, np.eye(3)
        self.T[self.v_index, np.arange(6, self.mj.nv)] = 1

    def frame(self, name: str):
        return self.data.oMf[self.model.getFrameId(name)]


@pytest.fixture(scope="module", params=CONFIGS, ids=lambda c: "-".join([c.variant, c.mount, c.tcp]))
def both(request: pytest.FixtureRequest) -> Both:
    return Both(load_robot(request.param))


def samples(both: Both):
    rng = np.random.default_rng(0)
    for _ in range(NUM_SAMPLES):
        both.place(rng)
        yield


def test_forward_kinematics_agree(both: Both) -> None:
    for _ in samples(both):
        for name in ("tcp", "sole_L", "sole_R", "imu", "camera"):
            site, frame = both.mj_data.site(name), both.frame(name)
            np.testing.assert_allclose(site.xpos, frame.translation, rtol=0, atol=1e-9)
            np.testing.assert_allclose(site.xmat.reshape(3, 3), frame.rotation, rtol=0, atol=1e-9)


def test_jacobians_agree(both: Both) -> None:
    """Of the end-effector in world axes: the test of the velocity conventions themselves."""
    mine = np.zeros((6, both.mj.nv))
    aligned = both.pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    for _ in samples(both):
        mujoco.mj_jacSite(both.mj, both.mj_data, mine[:3], mine[3:], both.mj.site("tcp").id)
        frame = both.model.getFrameId("tcp")
        theirs = both.pin.computeFrameJacobian(both.model, both.data, both.q, frame, aligned) @ both.T
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-9)


def test_mass_matrices_agree(both: Both) -> None:
    mine = np.zeros((both.mj.nv, both.mj.nv))
    for _ in samples(both):
        mujoco.mj_fullM(both.mj, both.mj_data, mine)
        theirs = np.triu(both.pin.crba(both.model, both.data, both.q))
        theirs = theirs + np.triu(theirs, 1).T
        np.testing.assert_allclose(mine, both.T.T @ theirs @ both.T, rtol=0, atol=1e-6)


def test_gravity_torques_agree(both: Both) -> None:
    for _ in samples(both):
        theirs = both.T.T @ both.pin.computeGeneralizedGravity(both.model, both.data, both.q)
        np.testing.assert_allclose(both.mj_data.qfrc_bias, theirs, rtol=0, atol=1e-6)
        assert theirs[2] == pytest.approx(both.mj.body_mass.sum() * GRAVITY)  # the base carries it all


def test_total_mass() -> None:
    assert load_robot().model().body_mass.sum() == pytest.approx(25.05, abs=0.005)
    stacked = load_robot(RobotConfig(mount="pc_stack")).model().body_mass.sum()
    assert stacked == pytest.approx(25.05 - 0.17 + 2.139, abs=0.005)  # another plate, and a computer


def test_joint_order() -> None:
    legs = [f"{part}_{side}_Joint" for side in "LR" for part in ("abad", "hip", "knee", "ankle")]
    assert list(JOINT_NAMES) == legs + [f"J{i}" for i in range(1, 7)]
    model = load_robot().model()
    assert [model.joint(i).name for i in range(model.njnt)] == ["base", *JOINT_NAMES]
    assert [model.actuator(i).name for i in range(model.nu)] == list(JOINT_NAMES)
    assert [model.jnt_qposadr[model.actuator_trnid[i, 0]] for i in range(model.nu)] == list(range(7, 21))


def test_legs_mirror_each_other() -> None:
    robot = load_robot()
    model = robot.model()
    data = mujoco.MjData(model)
    rng, mirror = np.random.default_rng(3), np.array([1.0, -1.0, 1.0])
    sign = np.array(
        [-1, -1, -1, 1]
    )  # abad about x; hip and knee about opposite axes, the ankles about the same
    for _ in range(NUM_SAMPLES):
        left = rng.uniform(robot.lower[:4], robot.upper[:4])
        data.qpos[:] = [0, 0, 1, 1, 0, 0, 0, *left, *(sign * left), *np.zeros(6)]
        mujoco.mj_forward(model, data)
        a, b = data.site("sole_L"), data.site("sole_R")
        np.testing.assert_allclose(a.xpos, mirror * b.xpos, atol=1e-12)
        flipped = np.outer(mirror, mirror) * b.xmat.reshape(3, 3)
        np.testing.assert_allclose(a.xmat.reshape(3, 3), flipped, atol=1e-12)
        for part in ("abad", "hip", "knee", "ankle"):
            com = [data.body(f"{part}_{side}_Link").xipos for side in "LR"]
            np.testing.assert_allclose(com[0], mirror * com[1], atol=1e-4)  # as the vendor rounded them


def test_limits_are_radians_in_both_models() -> None:
    """MjSpec reads ranges as degrees unless told otherwise; URDF is always in radians."""
    robot = load_robot()
    ranges = np.array([joint.range for joint in FACTS.joints])
    np.testing.assert_array_equal(robot.model().jnt_range[1:], ranges)
    assert robot.model().jnt_limited[1:].all()
    assert np.abs(ranges).max() < 2 * np.pi and np.abs(ranges).max(axis=1).min() > 1
    root = ET.fromstring(robot.urdf())
    for joint, name in zip(FACTS.joints, JOINT_NAMES, strict=True):
        limit = root.find(f"joint[@name='{name}']/limit")
        assert limit is not None
        values = [float(limit.attrib[key]) for key in ("lower", "upper", "effort", "velocity")]
        assert values == [*joint.range, joint.effort, joint.velocity]
    np.testing.assert_array_equal(np.stack([robot.lower, robot.upper], axis=1), ranges)


def test_parameters_reach_the_actuators() -> None:
    arm = tuple((float(i), i / 10) for i in range(1, 7))
    config = RobotConfig(ankle_effort=33.0, leg_gain=(51.0, 2.5), ankle_gain=(61.0, 0.7), arm_gain=arm)  # type: ignore[arg-type]
    robot = load_robot(config)
    model = robot.model()
    kp = [51, 51, 51, 61, 51, 51, 51, 61, 1, 2, 3, 4, 5, 6]
    kd = [2.5, 2.5, 2.5, 0.7, 2.5, 2.5, 2.5, 0.7, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
    effort = [80, 80, 80, 33, 80, 80, 80, 33, 30, 40, 30, 15, 10, 10]
    np.testing.assert_allclose(model.actuator_gainprm[:, 0], kp)
    np.testing.assert_allclose(model.actuator_biasprm[:, 1:3], -np.array([kp, kd]).T)
    np.testing.assert_allclose(model.actuator_forcerange, np.outer(effort, [-1, 1]))
    for mine, expected in ((robot.kp, kp), (robot.kd, kd), (robot.effort, effort)):
        np.testing.assert_allclose(mine, expected)
    assert f'effort="{33.0!r}"' in robot.urdf()
    default = load_robot().model()
    ankles = [JOINT_NAMES.index(f"ankle_{side}_Joint") for side in "LR"]
    assert (default.actuator_forcerange[ankles] == [-20, 20]).all()


def test_actuators_are_a_pd_loop_within_effort() -> None:
    robot = load_robot()
    model = robot.model()
    data = mujoco.MjData(model)
    rng = np.random.default_rng(4)
    data.qpos[7:] = rng.uniform(robot.lower, robot.upper)
    data.qvel[6:] = rng.normal(size=14)
    data.ctrl[:] = data.qpos[7:] + rng.normal(size=14)
    mujoco.mj_forward(model, data)
    torque = robot.kp * (data.ctrl - data.qpos[7:]) - robot.kd * data.qvel[6:]
    assert (np.abs(torque) > robot.effort).any()
    np.testing.assert_allclose(data.actuator_force, np.clip(torque, -robot.effort, robot.effort))


def test_armature_reaches_the_joints() -> None:
    robot = load_robot()
    np.testing.assert_array_equal(robot.model().dof_armature[6:], robot.armature)
    assert (robot.armature > 0).all()


def test_actions_and_commands_are_inverse() -> None:
    robot = load_robot()
    action = np.random.default_rng(5).normal(size=(3, 7, 14))
    np.testing.assert_allclose(robot.action_of(robot.command_of(action)), action, atol=1e-14)
    assert (robot.action_of(robot.default_q) == 0).all()
    np.testing.assert_allclose(
        robot.command_of(np.ones(14)) - robot.default_q, [0.6] * 8 + [0.3] * 3 + [0.2] * 3
    )


def test_every_number_has_a_source() -> None:
    blocks = {f"link {link.name}": link.src for link in FACTS.links}
    blocks |= {f"geom {geom.name}": geom.src for link in FACTS.links for geom in link.geoms}
    blocks |= {f"joint {joint.name}": joint.src for joint in FACTS.joints}
    blocks |= {f"frame {name}": frame.src for name, frame in FACTS.frames.items()}
    blocks |= {f"mount {name}": mount.src for name, mount in FACTS.mounts.items()}
    blocks |= {name: getattr(FACTS, name).src for name in ("foot", "friction", "gains", "tcp")}
    assert [name for name, src in blocks.items() if not src.strip()] == []


def test_inertias_are_those_of_real_bodies() -> None:
    for link in [*FACTS.links, *(lump for mount in FACTS.mounts.values() for lump in mount.lumps)]:
        xx, yy, zz, xy, xz, yz = link.inertia
        moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        assert link.mass > 0 and moments[0] > 0, link.name
        assert moments[2] <= moments[0] + moments[1] + 1e-9, link.name  # the triangle inequality


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (RobotConfig(mount="limx_adaptor"), r"unknown mount 'limx_adaptor' .*did you mean limx_adapter\?"),
        (
            RobotConfig(tcp="sdk_l5_umi"),
            r"unknown tcp 'sdk_l5_umi' .*did you mean sdk_X5_umi or sdk_L5_umi\?",
        ),
    ],
)
def test_unknown_names(config: RobotConfig, message: str) -> None:
    with pytest.raises(UnknownNameError, match=message):
        load_robot(config)


def test_a_wrong_facts_file_names_the_field(tmp_path: Path) -> None:
    text = FACTS_FILE.read_text()
    wrong = tmp_path / "facts.toml"
    wrong.write_text(text.replace("mass = 9.585", 'mass = "heavy"'))
    with pytest.raises(ProtocolError, match=r"facts.toml.*links\[0\]\.mass"):
        load_facts(path=wrong)
    with pytest.raises(ProtocolError, match=r"nowhere\.toml"):
        load_facts(path=tmp_path / "nowhere.toml")


def test_exported_xml_is_the_same_robot() -> None:
    robot = load_robot(RobotConfig(mount="pc_stack", ankle_effort=40.0))
    spec = build_spec(robot.facts, robot.config)
    spec.compile()
    again, model = mujoco.MjModel.from_xml_string(spec.to_xml()), robot.model()
    for name in (
        "body_mass",
        "body_inertia",
        "jnt_range",
        "actuator_gainprm",
        "actuator_forcerange",
        "geom_size",
    ):
        np.testing.assert_allclose(getattr(again, name), getattr(model, name), rtol=1e-5, atol=1e-9)
    for name in ("integrator", "cone", "jacobian", "timestep"):
        assert getattr(again.opt, name) == getattr(model.opt, name)


def test_soles_are_flat_in_the_default_posture() -> None:
    robot = load_robot()
    model = robot.model()
    data = mujoco.MjData(model)
    height = (
        FACTS.nominal_base_height - 1e-3
    )  # [m] into the ground by more than the nominal height is rounded
    data.qpos[:] = [0, 0, height, 1, 0, 0, 0, *robot.default_q]
    mujoco.mj_forward(model, data)
    for side in "LR":
        np.testing.assert_allclose(data.site(f"sole_{side}").xmat.reshape(3, 3), np.eye(3), atol=1e-12)
    tcp = wxyz_from_matrix(data.site("tcp").xmat.reshape(3, 3))
    np.testing.assert_allclose(tcp, [1, 0, 0, 0], atol=1e-12)  # J2 and J3 cancel: the gripper looks ahead
    assert data.ncon == 8  # four corners a sole, and no part touches another


def test_picture_shows_a_robot_on_the_ground(tmp_path: Path) -> None:
    from matplotlib import image

    path = tmp_path / "robot.png"
    try:
        picture.render(load_robot(), path, size=(320, 240))
    except BenchError as error:
        pytest.skip(str(error))
    pixels = image.imread(path)[..., :3]
    assert pixels.shape == (240, 320, 3)
    red, green, blue = np.moveaxis(pixels, -1, 0)
    orange = (red > 0.5) & (red > green + 0.15) & (green > blue + 0.15)  # the arm
    shoe = pixels.max(axis=-1) < 0.35  # the darkest parts
    assert 100 < orange.sum() < 20_000 and shoe.sum() > 50
    assert np.argwhere(orange)[:, 0].mean() < 120 < np.argwhere(shoe)[:, 0].max()  # arm above feet
    posture = tmp_path / "posture.png"
    picture.render(load_robot(), posture, q=np.full(14, 0.2), size=(320, 240))
    assert not np.array_equal(image.imread(posture)[..., :3], pixels)


def test_without_opengl_there_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(width: int, height: int) -> None:
        raise RuntimeError("no driver")

    monkeypatch.setattr("mujoco.gl_context.GLContext", refuse, raising=False)
    monkeypatch.setenv("MUJOCO_GL", "osmesa")  # taken as the choice of the user: not EGL
    with pytest.raises(BenchError, match=r"no OpenGL on this machine .*no driver.*MUJOCO_GL") as caught:
        picture.render(load_robot(), tmp_path / "robot.png")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "robot.png").exists()
