"""Every constant of the IK controller. Tuned on `tuning_*` manifests that no table uses (see README.md here)."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Weights:
    """Of the inverse-kinematics program; errors in m and rad per step."""

    ee_position: float = 1.0
    ee_orientation: float = 0.3
    com: float = 0.3  # horizontal centring, beside the polygon that must not be left
    posture: float = 1e-3
    foot_flat: float = 0.1  # roll and yaw of the right sole, which the hard constraints leave free
    regularization: float = 1e-5
    joint_margin: float = 0.02  # [rad] kept from the joint limits
    speed_fraction: float = 0.5  # of the joint speed limits
    com_margin: float = 0.045  # [m] of the centre of mass inside the soles' hull


@dataclass(frozen=True)
class Settings:
    """Of the controller around it."""

    weights: Weights = field(default_factory=Weights)
    # the way of the target
    slew_linear: float = 0.2  # [m/s]
    slew_angular: float = 0.6  # [rad/s]
    slew_ramp: float = 1.0  # [s] from rest to full speed
    slew_gain: float = 2.0  # [1/s] slowing down near the end
    settle: float = 0.3  # [s] of standing still before the target moves
    target_filter: float = 0.3  # [s]
    stance_filter: float = 0.5  # [s]
    ee_integral: float = 0.3  # [1/s] on the measured error of the hand
    ee_integral_limit: float = 0.08  # [m, rad]
    # balance
    feedforward: bool = True
    feedback: bool = True
    kp_com: float = 15.0  # [1/s^2]
    kd_com: float = 7.5  # [1/s]
    kp_rot: float = 60.0  # [1/s^2]
    kd_rot: float = 15.0  # [1/s]
    height_gain: float = 1.0  # vertical over horizontal gains
    rejection: float = 1.0  # part of the estimated disturbance that is compensated
    ki_rot: float = 30.0  # [1/s^3]
    rot_integral_limit: float = 10.0  # [rad/s^2]
    inertia: float = 1.5  # [kg m^2] of the upper body about its centre
    moment_weight: float = 3.0  # [1/m] of moment errors over force errors
    yaw_weight: float = 0.2
    damping: float = 0.02  # on the contact forces
    compliance: float = 0.8  # part of the legs' posture stiffness that is taken away
    friction: float = 0.4  # the lowest of the protocol's range
    sole_x: float = 1.0  # parts of the sole used for the contact forces
    sole_y: float = 0.7
    # estimation
    joint_acceleration: float = 10.0  # [rad/s^2] process noise of a joint
    com_noise: float = 0.005  # [m] of the centre of mass from joint noise
    com_acceleration: float = 1.0  # [m/s^2] process noise of the centre of mass
    com_drift: float = 1.0  # [m/s^2/sqrt(s)] of the disturbance
    com_threshold: float = 3.0
    com_jump: float = 0.3  # [m/s] a push


TUNED = Settings()
