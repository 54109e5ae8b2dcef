#!/bin/sh
# mujoco 4.0.0: a `dcmotor` in position mode has its speed-torque curve only if its *controller* is given a voltage limit.
#
# Behaviour: with nominal voltage, stall torque and no-load speed, and with `saturation` voltage too, the torque is the PD
# law without any limit: at twice the no-load speed a motor still pushes beyond its stall torque. Given the sixth number of
# `controller`, the same motor follows the curve: tau_stall (1 - speed / no-load speed).
# Why it matters: whoever models the speed limits of a robot's joints finds joints that turn as fast as before, and no
# message. The gains are in units of torque in both cases, although the controller is said to put out a voltage.
# A good guess: the nominal voltage, or the saturation voltage, is what the controller can put out.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q mujoco==4.0.0
"$folder/venv/bin/python" - <<'PY'
import mujoco


def torque(speed, saturation, limit):
    """Of a motor of 24 V, 40 N m and 15 rad/s that is asked to go 2 rad further, kp 45, kd 0.8."""
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body()
    body.mass, body.fullinertia, body.explicitinertial = 1, [0.02, 0.02, 0.02, 0, 0, 0], True
    body.add_joint(name="j", type=mujoco.mjtJoint.mjJNT_HINGE)
    motor = spec.add_actuator(target="j", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    motor.set_to_dcmotor(
        motorconst=[0, 0], resistance=0, nominal=[24, 40, 15], saturation=[0, 0, saturation],
        controller=[45, 0, 0.8, 0, 0, limit], ctrlspec=mujoco.mjtCtrlInput.mjINPUT_POS,
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qvel[0], data.ctrl[0] = speed, 2.0
    mujoco.mj_forward(model, data)
    return round(float(data.actuator_force[0]), 3)


for speed in (0, 5, 12, 30):
    print(speed, "rad/s: nominal", torque(speed, 0, 0), "saturation", torque(speed, 24, 0), "controller", torque(speed, 24, 24))
assert [torque(s, 24, 0) for s in (0, 5, 12, 30)] == [90.0, 86.0, 80.4, 66.0], "this has changed"
assert [torque(s, 24, 24) for s in (0, 5, 12, 30)] == [40.0, 26.667, 8.0, -40.0], "this has changed"
PY
# Seen:
# 0 rad/s: nominal 90.0 saturation 90.0 controller 40.0
# 5 rad/s: nominal 86.0 saturation 86.0 controller 26.667
# 12 rad/s: nominal 80.4 saturation 80.4 controller 8.0
# 30 rad/s: nominal 66.0 saturation 66.0 controller -40.0
