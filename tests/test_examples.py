"""Every example runs, in a folder of its own and with a few episodes."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import zmq
from onnx import helper

from small_networks import weights, write
from wbc_bench.results.store import ResultStore

EXAMPLES = Path(__file__).parents[1] / "examples"


def run(*command: str | Path, folder: Path, **environment: str) -> str:
    """What a command prints; it finds `wbc-bench` and `wbc-train` beside this interpreter."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    done = subprocess.run(
        [str(part) for part in command],
        cwd=folder,
        env={**os.environ, "PATH": path, **environment},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_own_controller_stands_and_reaches(tmp_path: Path) -> None:
    """On the arm targets among the first episodes, all of which it reaches."""
    spec = f"{EXAMPLES / 'own_controller.py'}:GentleArm"
    arguments = ("--protocol", "nominal_v1", "--replicates", "1", "--episodes", "4", "--workers", "1")
    run("wbc-bench", "eval", "--controller", spec, *arguments, "--out", tmp_path, folder=tmp_path)
    (stored,) = ResultStore(tmp_path).runs("nominal_v1")
    episodes = stored.episodes()
    assert len(episodes) == 4
    outcomes = set(zip(episodes["stratum"], episodes["outcome"], strict=True))
    assert {outcome for stratum, outcome in outcomes if stratum == "arm"} == {"success"}


def test_own_protocol_is_frozen_verified_and_used(tmp_path: Path) -> None:
    printed = run(EXAMPLES / "own_protocol" / "run.sh", tmp_path, folder=tmp_path)
    assert "ok     redrawn sample: 8 episodes, equal" in printed
    assert pq.read_metadata(tmp_path / "near.parquet").num_rows == 8
    runs = ResultStore(tmp_path).runs("near")
    assert {stored.record.controller for stored in runs} == {"hold", "ik"}


def test_compare_two_prints_intervals_and_paired_tests(tmp_path: Path) -> None:
    options = ("--a", "ik", "--b", "hold", "--episodes", "4", "--workers", "1", "--out", tmp_path)
    first = run(sys.executable, EXAMPLES / "compare_two.py", *options, folder=tmp_path)
    assert "hold: success 0.0%" in first and "A = ik against B = hold" in first
    assert run(sys.executable, EXAMPLES / "compare_two.py", *options, folder=tmp_path) == first


def test_walking_policy_s_card_fits_networks_of_its_shape(tmp_path: Path) -> None:
    card = tmp_path / "tron1_walk.toml"
    card.write_text((EXAMPLES / "walking_policy" / card.name).read_text())
    for name, rows, columns in (("encoder", 180, 3), ("policy", 44, 8)):
        node = helper.make_node("MatMul", ["mlp_input", "w"], ["mlp_output"])
        shapes = {"mlp_input": [rows]}, {"mlp_output": [columns]}
        write(tmp_path / f"{name}.onnx", [node], *shapes, {"w": weights(0, rows, columns)})
    arguments = ("--protocol", "nominal_v2", "--replicates", "1", "--episodes", "3", "--workers", "1")
    printed = run("wbc-bench", "eval", "--controller", f"policy:{card}", *arguments, folder=tmp_path)
    assert "| tron1_walk" in printed


def test_stream_client_moves_the_robot(tmp_path: Path) -> None:
    with zmq.Context() as context, context.socket(zmq.PULL) as socket:
        port = socket.bind_to_random_port("tcp://127.0.0.1")  # free now, and so in a moment
    address = f"tcp://127.0.0.1:{port}"
    client = subprocess.Popen(
        [sys.executable, EXAMPLES / "stream_client.py", "--address", address, "--seconds", "600"]
    )
    try:
        arguments = ("--controller", "hold", "--source", "stream", "--duration", "1", "--address", address)
        run("wbc-bench", "track", *arguments, "--out", tmp_path, folder=tmp_path)
    finally:
        client.kill()
        client.wait()
    (record,) = tmp_path.glob("tracks/**/*.json")
    assert json.loads(record.read_text())["counters"]["accepted"] > 0


def test_train_a_policy_leaves_a_controller(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    run(EXAMPLES / "train_a_policy.sh", tmp_path, folder=tmp_path, BUDGET="3e3", EPISODES="2")
    (stored,) = ResultStore(tmp_path / "results").runs("nominal_v1")
    assert len(stored.episodes()) == 2 and stored.record.controller.startswith("learned:")
