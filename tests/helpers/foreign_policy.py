"""A policy of this project as a file of somebody else."""

from pathlib import Path

import pytest

from wbc_bench.cli.main import main

OWN = """
name = "again"
robot = "limx_adapter"

[[observation]]
name = "observation"
terms = [
    { term = "base_ang_vel" }, { term = "projected_gravity" }, { term = "joint_pos_rel" },
    { term = "joint_vel_rel" }, { term = "last_action" }, { term = "ee_pos" }, { term = "ee_rot6" },
    { term = "phase_reference" },
]
[[observation]]
name = "command"
terms = [{ term = "target_pos" }, { term = "target_rot6" }]
[[observation]]
name = "term"
terms = [
    { term = "base_ang_vel" }, { term = "projected_gravity" }, { term = "joint_pos_rel" },
    { term = "joint_vel_rel" }, { term = "joint_effort" }, { term = "ee_pos" }, { term = "ee_rot6" },
]
[[network]]
file = "bare.onnx"
inputs = { observation = "observation", command = "command", term = "term" }
outputs = { action = "action" }
state = [
    { input = "window", output = "next_window", initial = "term" },
    { input = "state", output = "next_state" },
]
[action]
scale = [0.6, 0.6, 0.6, 0.6, 0.6, 0.6, 0.6, 0.6, 0.3, 0.3, 0.3, 0.2, 0.2, 0.2]
"""


@pytest.fixture(scope="session")
def own_policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a policy of this project, as a file of somebody else: without its card."""
    pytest.importorskip("torch")
    from small_networks import strip

    folder = tmp_path_factory.mktemp("own")
    main(["export", "--controller", "learned:transformer_gru@0", "-o", str(folder / "sealed.onnx")])
    strip(folder / "sealed.onnx", folder / "bare.onnx")
    (folder / "card.toml").write_text(OWN)
    return folder
