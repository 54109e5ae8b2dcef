"""Sound cards and graphs of policies of other stacks, and their readers."""

from pathlib import Path

import numpy as np

from small_networks import layer, weights
from wbc_bench.policies.controller import from_card
from wbc_bench.policies.descriptions import draft
from wbc_bench.policies.normalizer import read_normalizers
from wbc_bench.robot import load_robot

POLICY_CARD = """
name = "walker"
joints = ["J1", "J2", "J3"]
[[observation]]
name = "policy"
history = 2
terms = [
    { term = "joint_pos_rel", scale = [1.0, 0.5, 0.1] },
    { term = "projected_gravity", clip = [-1.0, 1.0] },
]
[[network]]
file = "walk.onnx"
inputs = { obs = "policy" }
outputs = { actions = "action" }
[action]
scale = 0.25
kp = [40.0, 30.0, 20.0]
"""
DEPLOY = """
step_dt: 0.02
stiffness: [40.0, 30.0, 20.0]
actions: { JointPositionAction: { joint_names: [J1, J2, J3], scale: [0.25, 0.25, 0.25] } }
observations: { joint_pos_rel: { scale: [1.0, 0.5, 0.1], history_length: 2 } }
"""


def write_policy_card(folder: Path) -> None:
    layer(folder / "walk.onnx", weights(0, 12, 3), observation_names="joint_pos,actions", action_scale="0.25")
    (folder / "card.toml").write_text(POLICY_CARD)
    (folder / "deploy.yaml").write_text(DEPLOY)


def read_policy_card(folder: Path) -> None:
    draft(folder / "walk.onnx", folder / "deploy.yaml").text()
    draft(folder / "walk.onnx", None).text()
    controller = from_card(load_robot(), folder / "card.toml")
    for network in controller.networks:
        read_normalizers(network.path, network.widths)
        network({group.name: np.zeros((2, group.size)) for group in controller.groups})
