"""Every constant of the IK controller.

Tuned on the `tuning_*` protocols, which no table uses; the tuning and its budget are in docs/training-log.md.
"""

from dataclasses import dataclass, field, replace


@dataclass(frozen=True)
class Weights:
    """Of the inverse-kinematics program; errors in m and rad per step."""

    ee_position: float = 1.0
    ee_orientation: float = 0.3
    com: float = 1.0  # horizontal centring over the soles, beside the polygon that must not be left
    upright: float = 1e-3  # of the base
    standing_posture: float = 1e-3  # towards the default posture, before the hand moves
    posture: float = 1e-2  # towards the planned posture, on the way
    planning_posture: float = (
        1e-4  # towards a start, while planning: small, for it pulls the hand off its target
    )
    foot_flat: float = 0.1  # roll and yaw of the right sole, which the hard constraints leave free
    regularization: float = 1e-3  # below this the program takes steps of a radian near singular legs
    joint_margin: float = 0.02  # [rad] kept from the joint limits
    speed_fraction: float = 0.5  # of the joint speed limits
    collision: float = 1e3
    collision_margin: float = 0.01  # [m]
    collision_trigger: float = 0.04  # [m]
    com_margin: float = 0.04  # [m] of the centre of mass inside the soles' hull


@dataclass(frozen=True)
class IKConfig:
    """Of the controller around the program."""

    weights: Weights = field(default_factory=Weights)
    # the way of the target
    slew_linear: float = 0.3  # [m/s]
    slew_angular: float = 0.9  # [rad/s]
    slew_ramp: float = 0.8  # [s] from rest to full speed
    slew_gain: float = 2.0  # [1/s] slowing down near the end
    settle: float = 0.3  # [s] of standing still before the target moves
    target_filter: float = 0.3  # [s]
    stance_filter: float = 0.5  # [s]
    # the hand
    hand_blend: float = 1.5  # [s] before arrival, within one second, the hand's servo takes over
    hand_damping: float = 0.05  # of the arm's inverse kinematics near singular postures
    hand_limit: float = 0.5  # [rad] an arm joint may leave the whole-body solution
    hand_integral: float = 0.05  # [1/s] on the measured error of the hand
    hand_integral_limit: float = 0.08  # [m, rad]
    # balance
    feedforward: bool = True  # torques that carry the weight, sent as torque / kp
    feedback: bool = True  # of centre of mass, base orientation and hand
    kp_com: float = 15.0  # [1/s^2] about omega^2 = g / h
    kd_com: float = 7.5  # [1/s] about 2 omega
    kp_rot: float = 60.0  # [1/s^2]
    kd_rot: float = 15.0  # [1/s]
    ki_rot: float = 30.0  # [1/s^3] against an unknown mass and gains that are not the nominal ones
    rot_integral_limit: float = 10.0  # [rad/s^2]
    inertia: float = 1.5  # [kg m^2] of the upper body about its centre
    roll_weight: float = 3.0  # [1/m] of moment errors over force errors
    pitch_weight: float = 3.0
    yaw_weight: float = 0.2
    damping: float = 0.02  # on the contact forces
    compliance: float = 0.5  # part of the legs' posture stiffness that is taken away
    friction: float = 0.4  # the lowest of the protocol's range
    sole_width: float = 0.7  # part of the sole's width that carries contact forces
    # what measured torques say of the robot
    observe_torques: bool = True
    payload_time: float = 3.0  # [s] of the observer of the payload
    payload_limit: float = 3.0  # [kg]
    payload_after: float = 0.2  # [s] from which on it is observed
    gain_time: float = 5.0  # [s] of forgetting
    gain_prior: float = 200.0  # [(N m)^2] weight of the nominal gain
    gain_limit: float = 0.2  # of the nominal gain
    # stepping
    stepping: bool = True
    step_trigger: float = 0.0  # [m] of the capture point outside the soles' hull
    step_wait: float = 0.1  # [s] of standing before a step
    step_duration: float = 0.25  # [s]
    step_height: float = 0.06  # [m]
    step_prepare: float = 0.28  # [m] between the soles, below which a foot is set further out to begin with
    step_prepare_time: float = 0.6  # [s] of standing before that
    step_prepare_way: float = 0.1  # [s] at full speed that the hand must still have to go
    step_prepare_error: float = 0.01  # [m + 0.3 m/rad] of the plan from there
    step_press: float = 0.01  # [m] below the ground that the landing foot is sent to
    step_length: float = 0.35  # [m] from the standing foot, either way
    step_width: tuple[float, float] = (0.17, 0.40)  # [m] between the soles
    step_beside: float = 0.11  # [m] of the landing sole outside the capture point
    step_aim: float = 0.1  # [s] before landing the place is fixed
    # estimation; noise half-widths are those of the paper's lineage, see the protocols
    gyro_noise: float = 0.2  # [rad/s]
    gravity_noise: float = 0.05
    joint_pos_noise: float = 0.01  # [rad]
    joint_vel_noise: float = 1.5  # [rad/s]
    joint_acceleration: float = 10.0  # [rad/s^2] process noise of a joint
    com_noise: float = 0.003  # [m] of the centre of mass from joint noise
    com_tilt: float = (
        0.5  # part of the vertical's error that counts as noise: the rest stays from step to step
    )
    com_acceleration: float = 2.0  # [m/s^2] process noise of the centre of mass
    com_jump: float = 0.3  # [m/s] a push


TUNED = IKConfig()
# by variant of the robot; the stiff arm of the first one needs no observers
TUNED_FOR = {
    "paper": TUNED,
    "limx_adapter": replace(
        TUNED,
        slew_linear=0.25,
        slew_angular=0.75,
        hand_integral=0.3,
        observe_torques=False,
        com_tilt=1.0,
        com_acceleration=1.0,
    ),
}
