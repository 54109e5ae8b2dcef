"""The static solver against MuJoCo and against mechanics, and the targets that it admits."""

import mujoco
import numpy as np
import pytest

from wbc_bench.episodes.ground_frame import GroundFrame, from_ground_frame, to_ground_frame
from wbc_bench.episodes.planar import two_link
from wbc_bench.episodes.protocol import WorkspaceTargets, find_protocol
from wbc_bench.episodes.reach_targets import ReachPose, best_reach_pose, reach_poses
from wbc_bench.episodes.static_solver import CLEARANCE, EFFORT_SHARE, JOINT_MARGIN, StaticSolver
from wbc_bench.episodes.targets import classify, solver_of
from wbc_bench.episodes.workspace_targets import draw_workspace_target, stratum_of
from wbc_bench.robot import NUM_LEG_JOINTS, RobotConfig, load_robot
from wbc_bench.rotations import geodesic_angle, matrix_from_rpy, matrix_from_wxyz

SMOKE = find_protocol("smoke_v1")[0]


@pytest.fixture(scope="module")
def solver() -> StaticSolver:
    return solver_of(SMOKE)


@pytest.fixture(scope="module")
def found(solver: StaticSolver) -> list:
    """(stratum, witness, pos, rot) of poses that the box of the protocol holds."""
    rng, results = np.random.default_rng(5), []
    while len(results) < 40:
        pos = rng.uniform([-0.8, -0.8, 0.1], [0.8, 0.8, 2.0])
        rot = matrix_from_rpy(rng.uniform([-1.5, -0.8, -1.5], [1.5, 0.8, 1.5]))
        result = classify(solver, pos, rot)
        if result is not None:
            results.append((*result, pos, rot))
    return results


def test_two_links_close_the_chain() -> None:
    rng = np.random.default_rng(0)
    first, second, goal = rng.normal(size=2), rng.normal(size=2), rng.normal(size=(200, 2))
    a, b, bend = two_link(first, second, goal)

    def turn(pitch: np.ndarray, v: np.ndarray) -> np.ndarray:
        # Ry(pitch) on (x, z), written out independently
        rot = matrix_from_rpy(np.stack([0 * pitch, pitch, 0 * pitch], axis=-1))
        return rot[..., ::2, ::2] @ v

    reachable = np.isfinite(a)
    ends = turn(np.nan_to_num(a), first) + turn(np.nan_to_num(b), second)
    np.testing.assert_allclose(ends[reachable], np.broadcast_to(goal, ends.shape)[reachable], atol=1e-12)
    r1, r2, far = np.hypot(*first), np.hypot(*second), np.hypot(*goal.T)
    np.testing.assert_array_equal(reachable[0], (far <= r1 + r2) & (far >= abs(r1 - r2)))
    np.testing.assert_allclose(bend[0], -bend[1])


@pytest.mark.parametrize("variant", ["limx_adapter", "paper"])
@pytest.mark.parametrize("mount", ["limx_adapter", "pc_stack"])
@pytest.mark.parametrize("tcp", ["sdk_L5_umi", "umi_on_tron_das_camera", "umi_on_tron_das_optical"])
def test_closed_form_arm_inverts_mujoco(variant: str, mount: str, tcp: str) -> None:
    config = RobotConfig(variant=variant, mount=mount, tcp=tcp)
    solver = StaticSolver(load_robot(config), 0.02, 1.25, 0.3)
    robot, rng = solver.robot, np.random.default_rng(1)
    arm = slice(NUM_LEG_JOINTS, None)
    for _ in range(50):
        q = robot.default_q.copy()
        q[arm] = rng.uniform(robot.lower[arm], robot.upper[arm])
        pos, rot = solver.ee_pose(np.concatenate([[0, 0, 0, 1, 0, 0, 0], q]))
        branches, _ = solver.arm_branches(pos[None], rot[None])
        assert np.nanmin(np.abs(branches[:, 0] - q[arm]).max(-1)) < 1e-6  # one of them is where we came from
        for branch in branches[np.isfinite(branches[:, 0]).all(-1), 0]:
            q[arm] = branch
            again_pos, again_rot = solver.ee_pose(np.concatenate([[0, 0, 0, 1, 0, 0, 0], q]))
            np.testing.assert_allclose(again_pos, pos, atol=1e-7)
            assert geodesic_angle(again_rot, rot) < 1e-7


def test_centre_of_mass_of_the_arm_is_mujocos(solver: StaticSolver) -> None:
    robot, rng = solver.robot, np.random.default_rng(2)
    model = robot.model()
    data = mujoco.MjData(model)
    q = rng.uniform(robot.lower, robot.upper, (20, 14))
    moments = solver.arm_first_moment(q[:, NUM_LEG_JOINTS:])
    first = model.body("arm_link1").id
    for row, moment in zip(q, moments, strict=True):
        data.qpos[:] = [0, 0, 0, 1, 0, 0, 0, *row]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        np.testing.assert_allclose(
            moment, model.body_subtreemass[first] * data.subtree_com[first], atol=1e-12
        )


def test_stance_leaves_the_base_three_freedoms(solver: StaticSolver) -> None:
    """To first order the stance lets the base roll, to second order it does not: the claim of posture.py."""
    model, data = solver.model, solver.data

    def soles(qpos: np.ndarray) -> np.ndarray:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        return np.concatenate(
            [
                np.r_[data.site_xpos[i], data.site_xmat[i][[1, 2, 3, 5, 6, 7]]]
                for i in (model.site("sole_L").id, model.site("sole_R").id)
            ]
        )

    qpos = np.r_[0, 0, solver.default_height, 1, 0, 0, 0, solver.robot.default_q]
    rows = []
    for dof in range(6 + NUM_LEG_JOINTS):
        step = []
        for sign in (1, -1):
            moved, velocity = qpos.copy(), np.zeros(model.nv)
            velocity[dof] = sign * 1e-6
            mujoco.mj_integratePos(model, moved, velocity, 1)
            step.append(soles(moved))
        rows.append((step[0] - step[1]) / 2e-6)
    assert np.linalg.matrix_rank(np.array(rows), tol=1e-6) == 10  # 14 - 10 = x, height, pitch and roll
    roll = 0.2
    tilted = qpos.copy()
    tilted[3:5] = np.cos(roll / 2), np.sin(roll / 2)
    tilted[[7, 11]] -= roll  # abduction keeps the soles flat
    width = np.diff(soles(tilted)[[10, 1]])[0]
    assert width == pytest.approx(np.diff(soles(qpos)[[10, 1]])[0] * np.cos(roll))


def test_witness_has_the_pose_and_meets_every_constraint(solver: StaticSolver, found: list) -> None:
    assert {stratum for stratum, *_ in found} == {"arm", "posture"}
    model, robot = solver.robot.model(), solver.robot
    data = mujoco.MjData(model)
    ground = model.geom("ground").id
    feet = [i for i in range(model.ngeom) if model.geom(i).name.startswith("foot")]
    corners = [i for i in feet if model.geom_type[i] == mujoco.mjtGeom.mjGEOM_SPHERE]
    others = [i for i in range(model.ngeom) if i != ground and i not in feet]
    for stratum, witness, pos, rot in found:
        data.qpos[:] = witness.qpos
        mujoco.mj_forward(model, data)
        tcp = data.site("tcp")
        np.testing.assert_allclose(tcp.xpos, pos, atol=1e-9)
        assert geodesic_angle(tcp.xmat.reshape(3, 3), rot) < 1e-9
        q = witness.qpos[7:]
        assert (q >= robot.lower + JOINT_MARGIN).all() and (q <= robot.upper - JOINT_MARGIN).all()
        corners = [i for i in range(model.ngeom) if model.geom(i).name.startswith("foot") and i % 1 == 0]
        soles = np.array(
            [data.geom_xpos[i] for i in corners if model.geom_type[i] == mujoco.mjtGeom.mjGEOM_SPHERE]
        )
        com = data.subtree_com[0, :2]
        # the hull of two parallel rectangles side by side is the rectangle around them
        inside = np.r_[com - soles[:, :2].min(0), soles[:, :2].max(0) - com].min()
        assert inside >= SMOKE.targets.com_margin - 1e-9
        away = [mujoco.mj_geomDistance(model, data, i, ground, 1.0, None) for i in others]
        assert min(away) >= CLEARANCE - 1e-6
        if stratum == "arm":
            np.testing.assert_allclose(q[:NUM_LEG_JOINTS], robot.default_q[:NUM_LEG_JOINTS], atol=1e-12)
        assert solver.violations(witness.qpos) == []


def test_static_forces_balance_gravity(solver: StaticSolver, found: list) -> None:
    """Newton-Euler: with the corner forces applied, inverse dynamics at rest asks for just these torques."""
    model = solver.robot.model()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    data = mujoco.MjData(model)
    for _, witness, *_ in found[:10]:
        forces, torque, unbalanced = solver.static_forces(witness.qpos)
        assert (forces >= 0).all() and unbalanced < 1e-6
        data.qpos[:], data.qvel[:], data.qacc[:] = witness.qpos, 0, 0
        mujoco.mj_forward(model, data)
        applied = np.zeros(model.nv)
        for k, force in enumerate(forces):
            geom = model.geom(f"foot_{'LR'[k // 4]}_{k % 4}").id
            point = data.geom_xpos[geom] - [0, 0, model.geom_size[geom, 0]]
            mujoco.mj_applyFT(
                model, data, np.array([0, 0, force]), np.zeros(3), point, model.geom_bodyid[geom], applied
            )
        data.qacc[:] = 0
        mujoco.mj_inverse(model, data)
        left = data.qfrc_inverse - applied
        np.testing.assert_allclose(left[:6], 0, atol=1e-3)  # [N], [N m] of 246 N
        np.testing.assert_allclose(left[6:], torque, atol=1e-9)
        assert (np.abs(torque) <= EFFORT_SHARE * solver.robot.effort + 1e-9).all()


def test_what_is_wrong_is_named(solver: StaticSolver) -> None:
    upright = np.r_[0, 0, solver.default_height, 1, 0, 0, 0, solver.robot.default_q]
    assert solver.violations(upright) == []
    lifted = upright + np.eye(21)[2] * 0.01
    assert any("sole L" in problem for problem in solver.violations(lifted))
    bent = upright + np.eye(21)[7 + 1] * 0.3  # a hip alone turns its sole
    assert any("sole L" in problem for problem in solver.violations(bent))
    over = upright.copy()
    over[7 + NUM_LEG_JOINTS + 3] = 1.6  # J4
    assert "joint limit" in solver.violations(over)
    folded = upright.copy()
    folded[7 + NUM_LEG_JOINTS :] = [
        0,
        3.4,
        0.3,
        0,
        0,
        0,
    ]  # the arm laid down in front, into the ground or knees
    assert "collision" in solver.violations(folded) or "centre" in str(solver.violations(folded))


def test_clearance_above_the_ground(solver: StaticSolver) -> None:
    """Pointing straight down, the fingers end at the end-effector: its height is their clearance."""
    down = matrix_from_rpy(np.array([0.0, np.pi / 2, 0.0]))
    assert solver.solve_posture(np.array([0.4, 0.0, CLEARANCE + 1e-3]), down) is not None
    assert solver.solve_posture(np.array([0.4, 0.0, CLEARANCE - 1e-3]), down) is None


def test_stance_moves_poses_and_back(solver: StaticSolver) -> None:
    rng = np.random.default_rng(3)
    stance = GroundFrame(0.3, -0.2, 0.4)
    pos, rot = rng.normal(size=(7, 3)), matrix_from_rpy(rng.normal(size=(7, 3)))
    again_pos, again_rot = to_ground_frame(stance, *from_ground_frame(stance, pos, rot))
    np.testing.assert_allclose(again_pos, pos, atol=1e-12)
    np.testing.assert_allclose(again_rot, rot, atol=1e-12)
    base, turn = from_ground_frame(stance, np.array([0, 0, solver.default_height]), np.eye(3))
    half = stance.yaw / 2
    quat = np.array([np.cos(half), 0, 0, np.sin(half)])
    np.testing.assert_allclose(turn, matrix_from_wxyz(quat), atol=1e-12)
    qpos = np.r_[base, quat, solver.robot.default_q]
    assert solver.ground_frame_of(qpos) == pytest.approx(stance)
    assert solver.violations(qpos) == []


def test_strata_are_balanced_in_every_beginning() -> None:
    weights = {"step": 1, "arm": 2, "posture": 1}
    cycle = [stratum_of(weights, i) for i in range(8)]
    assert cycle == ["arm", "arm", "posture", "step"] * 2
    assert stratum_of({"step": 3}, 7) == "step"


def test_step_targets_need_a_step(solver: StaticSolver) -> None:
    targets = SMOKE.targets
    assert isinstance(targets, WorkspaceTargets)
    draw = draw_workspace_target(SMOKE, 0, 2)
    assert draw.stratum == "step"
    rot = matrix_from_wxyz(draw.quat_w)
    assert classify(solver, draw.pos_w, rot) is None
    stance = solver.ground_frame_of(draw.feasible_qpos)
    assert targets.step_distance[0] <= np.hypot(stance.x, stance.y) <= targets.step_distance[1]
    assert targets.step_yaw[0] <= stance.yaw <= targets.step_yaw[1]
    assert solver.violations(draw.feasible_qpos) == []
    assert classify(solver, *to_ground_frame(stance, draw.pos_w, rot)) is not None


def test_mirrored_targets_are_equally_feasible() -> None:
    """Left and right differ by 0.1 mm of lateral offsets and the range of J1: mirrored strata agree."""
    solver, rng, differ = solver_of(SMOKE), np.random.default_rng(8), 0
    mirror = np.diag([1.0, -1.0, 1.0])
    for _ in range(30):
        pos = rng.uniform([0.0, -0.6, 0.3], [0.8, 0.6, 1.7])
        rot = matrix_from_rpy(rng.uniform([-0.5, -0.8, -1.0], [0.5, 0.8, 1.0]))
        here, there = classify(solver, pos, rot), classify(solver, mirror @ pos, mirror @ rot @ mirror)
        differ += (here and here[0]) != (there and there[0])
    assert differ <= 1


def test_best_reach_pose_is_level_and_beats_its_neighbours(solver: StaticSolver) -> None:
    best = best_reach_pose(solver, 1.0, "horizontal")
    assert best is not None and best.pitch == 0.0
    for x in (best.x - 0.025, best.x + 0.025):
        near = solver.solve_posture(np.array([x, 0.0, 1.0]), np.eye(3))
        assert near is None or near.margin <= best.margin + 1e-9


def test_heights_without_a_pose_borrow_the_nearest() -> None:
    pose = ReachPose(x=0.4, pitch=0.1, margin=0.2, height=0.5)
    low, same, high = reach_poses(np.array([0.0, 0.5, 1.0]), [None, pose, None])
    assert same == pose
    for borrowed in (low, high):
        assert np.isnan(borrowed.margin) and borrowed[:2] == pose[:2]
