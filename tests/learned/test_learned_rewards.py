"""Every reward term against a value worked out by hand."""

import math

import pytest

torch = pytest.importorskip("torch")

from torch import Tensor

from wbc_baselines.learned.policy.methods import Reward
from wbc_baselines.learned.training import rewards as r
from wbc_baselines.learned.training.resets import DECAY
from wbc_baselines.learned.training.target_set import read_target_set
from wbc_bench.episodes.protocol import find_protocol
from wbc_bench.robot import load_robot
from wbc_bench.rotations import geodesic_angle, matrix_from_wxyz

PERIOD = 0.02
BODY = r.Body(
    lower=torch.full((14,), -1.0),
    upper=torch.full((14,), 2.0),
    arm_middle=torch.full((6,), 0.5),
    nominal_feet=torch.tensor([[0.0, 0.1], [0.0, -0.1]]),
)


def signals(**changes) -> r.Signals:
    """One robot at rest on its target, in the nominal stance, with nothing to be punished for."""
    rest = {
        "pos_error": torch.zeros(1),
        "rot_error": torch.zeros(1),
        "best_pos_error": torch.zeros(1),
        "best_rot_error": torch.zeros(1),
        "d_ref": torch.zeros(1),
        "feet_h": BODY.nominal_feet[None],
        "base_height": torch.full((1,), 0.8),
        "gravity_b": torch.tensor([[0.0, 0.0, -1.0]]),
        "joint_pos": torch.full((1, 14), 0.5),
        "foot_contact": torch.ones(1, 2),
        "foot_vel_w": torch.zeros(1, 2, 2),
        "foot_up_w": torch.zeros(1, 2, 2),
        "terminated": torch.zeros(1, dtype=torch.bool),
    }
    for name in ("base_lin_vel", "base_ang_vel", "ee_lin_vel", "ee_ang_vel"):
        rest[name] = torch.zeros(1, 3)
    for name in ("joint_vel", "joint_torque", "action", "previous_action"):
        rest[name] = torch.zeros(1, 14)
    return r.Signals(**(rest | changes))


def term(name: str, kind: Reward = "gated", **changes) -> float:
    """A term per second, before its scale."""
    _, terms, _ = r.rewards(signals(**changes), BODY, kind, PERIOD)
    return float(terms[name]) / (r.SCALES[name] * PERIOD)


def column(index: int, value: float, width: int = 3) -> Tensor:
    x = torch.zeros(1, width)
    x[0, index] = value
    return x


G0 = 1 / (1 + math.exp(5))  # gate at d_ref = 0


def test_at_rest_on_the_target():
    """s_m = s_l = 1: every tracking term at its best, everything else zero."""
    total, terms, gates = r.rewards(signals(), BODY, "gated", PERIOD)
    open_ = (1 - G0) * 1.4
    assert float(gates["manipulation"]) == pytest.approx(open_)
    expected = {
        "position": 6 * open_ * 2,
        "orientation_coarse": 6,
        "orientation_fine": 6 * open_,
        "reference": 10 * G0 * 1.4,
        "progress": 0,
        "safety": 2,
    }
    for name, value in terms.items():
        assert float(value) == pytest.approx(0.02 * expected.get(name, 0.0), abs=1e-7), name
    assert float(total) == pytest.approx(0.02 * sum(expected.values()), rel=1e-6)


def test_position():
    """e = 0.1 m: exp(-0.2) + exp(-1)."""
    value = term("position", pos_error=torch.tensor([0.1])) / ((1 - G0) * 1.4)
    assert value == pytest.approx(math.exp(-0.2) + math.exp(-1.0), rel=1e-5)


def test_orientation():
    """e_R = 0.75 rad: exp(-0.25); e_R = 0.25 rad at 0.5 m: exp(-1) exp(-1)."""
    assert term("orientation_coarse", rot_error=torch.tensor([0.75])) == pytest.approx(math.exp(-0.25))
    fine = term("orientation_fine", pos_error=torch.tensor([0.5]), rot_error=torch.tensor([0.25]))
    assert fine / ((1 - G0) * 1.4) == pytest.approx(math.exp(-2.0), rel=1e-5)


def test_reference():
    """d_ref = 3, d = 2 x 0.4 + 0.2 = 1: e_ref = 2 - 0.5 = 1.5, so exp(-3); inside the dead zone 1."""
    late = term(
        "reference", d_ref=torch.tensor([3.0]), pos_error=torch.tensor([0.4]), rot_error=torch.tensor([0.2])
    )
    g3 = 1 / (1 + math.exp(-10))
    assert late == pytest.approx(g3 * 1.4 * math.exp(-3), rel=1e-5)
    near = term("reference", d_ref=torch.tensor([1.4]), pos_error=torch.tensor([0.5]))
    assert near == pytest.approx(1.4 / (1 + math.exp(-2)), rel=1e-5)


def test_progress():
    """0.5 -> 0.4 m and 1.0 -> 0.7 rad: 2 x 0.1 exp(-0.8) + 0.3 exp(-1.4); nothing when an error grows."""
    s = signals(
        pos_error=torch.tensor([0.4, 0.6]),
        rot_error=torch.tensor([0.7, 1.1]),
        best_pos_error=torch.tensor([0.5, 0.5]),
        best_rot_error=torch.tensor([1.0, 1.0]),
    )
    value = r.progress(s)
    assert float(value[0]) == pytest.approx(0.2 * math.exp(-0.8) + 0.3 * math.exp(-1.4), rel=1e-5)
    assert float(value[1]) == 0
    gated = term("progress", pos_error=torch.tensor([0.4]), best_pos_error=torch.tensor([0.5]))
    assert gated == pytest.approx(1.4 * (0.25 + 0.75 * G0) * 0.2 * math.exp(-0.8), rel=1e-5)


@pytest.mark.parametrize(
    ("changes", "manipulation", "locomotion"),
    [
        # one sole 0.1 m outward and 0.2 m ahead, the other 0.05 m inward: 0.5 + 1 + 0.5
        ({"feet_h": torch.tensor([[[0.2, 0.2], [0.0, -0.05]]])}, 2.0, 1.0),
        ({"feet_h": torch.tensor([[[9.0, 0.1], [0.0, -0.1]]])}, 8.0, 4.0),  # 45, clipped at 8
        ({"base_height": torch.tensor([0.7])}, 0.25, 0.5),
        ({"gravity_b": torch.tensor([[0.0, -0.2, -0.98]])}, 1.0, 2.0),
        ({"gravity_b": torch.tensor([[0.425, 0.0, -0.9]])}, 0.125, 0.5),
        ({"base_lin_vel": column(0, 1.0)}, 2.0, 0.0),
        ({"base_ang_vel": column(2, -0.6)}, 0.5, 0.0),
        ({"ee_lin_vel": column(1, 0.3)}, 0.5, 0.0),
        ({"ee_ang_vel": column(1, 6.28)}, 2.0, 0.0),
        ({"joint_vel": torch.full((1, 14), -0.7)}, 0.7, 0.0),
        ({"joint_pos": torch.full((1, 14), 2.0)}, 1.0, 0.0),  # 6 x 1.5 / 9
    ],
)
def test_safety_scores(changes, manipulation, locomotion):
    """E sums normalised, weighted deviations over Z = 13 and 6; s = exp(-E / 0.5)."""
    s_m, s_l = r.safety_scores(signals(**changes), BODY)
    assert float(s_m) == pytest.approx(math.exp(-manipulation / 13 / 0.5), rel=1e-5)
    assert float(s_l) == pytest.approx(math.exp(-locomotion / 6 / 0.5), rel=1e-5)


def test_safety_mixes_by_phase():
    """At d_ref = mu the gate is one half."""
    value = term("safety", base_lin_vel=column(0, 1.0), d_ref=torch.tensor([1.0]))
    assert value == pytest.approx(0.5 * math.exp(-2 / 6.5) + 0.5, rel=1e-5)


@pytest.mark.parametrize(
    ("name", "value", "changes"),
    [
        ("torque", 25.0, {"joint_torque": column(0, 3.0, 14) + column(5, 4.0, 14)}),
        (
            "power",
            11.0,
            {
                "joint_torque": column(0, 3.0, 14) + column(5, -4.0, 14),
                "joint_vel": torch.ones(1, 14) * column(0, 1.0, 14) + column(5, 2.0, 14),
            },
        ),
        ("action_variation", 5.0, {"action": column(0, 1.0, 14), "previous_action": column(1, 2.0, 14)}),
        # the left sole slides at (3, 4) m/s; the right one is in the air
        (
            "foot_slip",
            25.0,
            {
                "foot_contact": torch.tensor([[1.0, 0.0]]),
                "foot_vel_w": torch.tensor([[[3.0, 4.0], [9.0, 9.0]]]),
            },
        ),
        (
            "non_flat",
            0.05,
            {
                "foot_contact": torch.tensor([[1.0, 0.0]]),
                "foot_up_w": torch.tensor([[[0.1, 0.2], [0.9, 0.0]]]),
            },
        ),
        ("leg_separation", 0.04, {"feet_h": torch.tensor([[[0.0, 0.05], [0.0, -0.05]]])}),
        ("joint_limits", 0.7, {"joint_pos": column(0, 2.5, 14) + column(9, -1.2, 14)}),
        ("termination", 1.0, {"terminated": torch.ones(1, dtype=torch.bool)}),
    ],
)
def test_regularisation(name, value, changes):
    assert term(name, **changes) == pytest.approx(value, rel=1e-5)
    assert term(name, "additive", **changes) == pytest.approx(value, rel=1e-5)


def test_scales_are_the_papers():
    """The reward table, and the control period: a fall costs 100 x 0.02."""
    assert list(r.SCALES.values()) == [6, 6, 6, 10, 15, 2, -1e-5, -2e-5, -2e-2, -0.5, -1, -10, -1, -100]
    _, terms, _ = r.rewards(signals(terminated=torch.ones(1, dtype=torch.bool)), BODY, "gated", PERIOD)
    assert float(terms["termination"]) == pytest.approx(-2.0)


def test_additive_gates_are_constant():
    """Neither phase nor motion changes an additive weight; the safety scores still count."""
    for name, changes in (
        ("position", {}),
        ("orientation_fine", {}),
        ("reference", {"pos_error": torch.zeros(1)}),
    ):
        calm = term(name, "additive", **changes)
        wild = term(name, "additive", base_lin_vel=column(0, 2.0), **changes)
        assert calm == wild
    assert term("position", "additive") == pytest.approx(2 * r.ADDITIVE.manipulation)
    assert term("safety", "additive", base_lin_vel=column(0, 1.0)) == pytest.approx(
        (1 - r.PHASE) * math.exp(-2 / 6.5) + r.PHASE, rel=1e-5
    )


def test_mean_gate():
    """Of d_ref falling from 2 at 1/s over 2 s: the integral of the logistic function is a softplus."""
    exact = (math.log1p(math.exp(5.0)) - math.log1p(math.exp(-5.0))) / 5 / 2
    assert float(r.mean_gate(torch.tensor(2.0), torch.tensor(1.0), 2.0, 4000)) == pytest.approx(
        exact, abs=1e-3
    )
    assert float(r.mean_gate(torch.tensor(0.0), torch.tensor(1.0), 10.0)) == pytest.approx(
        float(r.gate(torch.zeros(())))
    )


def test_the_additive_phase_is_the_schedules_mean():
    """PHASE over the targets of ablation_v1, from the default posture, with decays over their range."""
    protocol, _ = find_protocol("ablation_v1")
    targets, robot = read_target_set(protocol), load_robot()
    import mujoco
    import numpy as np

    model = robot.model()
    data = mujoco.MjData(model)
    data.qpos[:] = [0, 0, robot.facts.nominal_base_height, 1, 0, 0, 0, *robot.default_q]
    mujoco.mj_kinematics(model, data)
    site = data.site("tcp")
    pos = np.linalg.norm(targets.pos_w - site.xpos, axis=1)
    rot = geodesic_angle(matrix_from_wxyz(targets.quat_w.astype(float)), site.xmat.reshape(3, 3))
    start = torch.tensor(2 * pos + rot)
    decay = torch.linspace(*DECAY, 19, dtype=torch.float64)
    mean = r.mean_gate(start[::4, None], decay[None], protocol.episodes.horizon, 250).mean()
    assert float(mean) == pytest.approx(r.PHASE, abs=5e-4)


def test_the_sum_is_bounded():
    total, _, _ = r.rewards(signals(joint_torque=torch.full((1, 14), 1e6)), BODY, "gated", PERIOD)
    assert float(total) == -r.BOUND
