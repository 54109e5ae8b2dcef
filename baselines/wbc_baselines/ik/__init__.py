from wbc_baselines.ik.controller import IKController
from wbc_baselines.ik.settings import TUNED


def make(robot, variant=""):
    from wbc_baselines.ik.placo_ik import PlacoIK
    return IKController(robot, PlacoIK(robot, TUNED.weights, 0.02), TUNED)
