from wbc_baselines.ik.controller import IKController, Settings


def make(robot, variant=""):
    return IKController(robot)
