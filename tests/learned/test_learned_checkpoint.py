"""Checkpoints: what is written comes back bit for bit; every damage or mismatch is one clear line."""

import dataclasses
import json
import re
from pathlib import Path

import msgspec
import pytest
import torch
from safetensors.torch import load_file, save_file

from policies import networks, write
from wbc_baselines.learned.policy import checkpoint, weights
from wbc_baselines.learned.policy.average import average
from wbc_baselines.learned.policy.card import FORMAT, CheckpointError, check_fit, read_card
from wbc_baselines.learned.policy.methods import METHODS
from wbc_bench.episodes.protocol import find_protocol
from wbc_bench.errors import BenchError, UnknownNameError
from wbc_bench.registry import load_controller, spec_of_replicate
from wbc_bench.robot import RobotConfig, load_robot


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> Path:
    return write(tmp_path_factory.mktemp("sound"), "cenet", seed=3)


@pytest.fixture
def path(sound, tmp_path) -> Path:
    """A copy to damage."""
    for file in (sound, sound.with_suffix(".json")):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    return tmp_path / sound.name


def edit(path: Path, **fields) -> None:
    card = json.loads(path.with_suffix(".json").read_text())
    path.with_suffix(".json").write_text(json.dumps(card | fields))


def replace_weights(path: Path, tensors: dict[str, torch.Tensor]) -> None:
    """Other weights under a card that vouches for them."""
    save_file(tensors, path)
    card = read_card(path)
    digest = checkpoint.hashlib.sha256(path.read_bytes()).hexdigest()
    path.with_suffix(".json").write_bytes(msgspec.json.encode(msgspec.structs.replace(card, sha256=digest)))


def refused(path: Path, *words: str, kind: type[BenchError] = CheckpointError) -> None:
    with pytest.raises(kind) as caught:
        checkpoint.load(path, load_robot())
    line = str(caught.value)
    assert "\n" not in line
    for word in words:
        assert word in line, line


@pytest.mark.parametrize("method", METHODS)
def test_weights_and_normalisers_come_back(tmp_path, method):
    path = write(tmp_path, method, seed=1)
    card, actor, estimator = checkpoint.load(path, load_robot(), find_protocol("ablation_v1")[0])
    assert (card.method, card.seed, card.samples, card.protocol) == (method, 1, 1000, "smoke_v1")
    for mine, theirs in zip(networks(method, 1), (actor, estimator), strict=True):
        assert mine.state_dict().keys() == theirs.state_dict().keys()
        for name, value in mine.state_dict().items():
            assert torch.equal(value, theirs.state_dict()[name]), name


def test_names_of_the_tensors(sound):
    names = set(load_file(sound))
    assert {
        "actor.mlp.0.weight",
        "actor.mlp.6.bias",
        "actor.normalizer.mean",
        "actor.normalizer.std",
    } <= names
    assert {"estimator.normalizer.mean", "estimator.normalizer.std"} <= names
    assert all(name.startswith(("actor.", "estimator.")) for name in names)


def test_equal_networks_give_equal_bytes(tmp_path, sound):
    (tmp_path / "again").mkdir()
    again = write(tmp_path / "again", "cenet", seed=3)
    assert again.read_bytes() == sound.read_bytes()


def test_the_card_writes_the_robot_out(sound):
    card = json.loads(sound.with_suffix(".json").read_text())
    robot = load_robot()
    assert card["robot"]["joints"][0] == "abad_L_Joint" and card["robot"]["kp"] == robot.kp.tolist()
    assert card["robot"]["default_q"] == robot.default_q.tolist()
    assert card["robot"]["ee_xyz"] == [0.235, 0.0, 0.0] and card["robot"]["control_period"] == 0.02
    assert card["protocol_digest"] == find_protocol("smoke_v1")[0].digest
    assert card["dimensions"]["context"] == 19 and card["format"] == FORMAT


def test_missing_files(path, tmp_path):
    refused(tmp_path / "none.safetensors", "no file", "none.safetensors")
    path.with_suffix(".json").unlink()
    refused(path, "no file", "cenet@3.json")


def test_truncated_and_altered_weights(path):
    data = path.read_bytes()
    path.write_bytes(data[:-100])
    refused(path, "truncated or altered", "SHA-256")
    flipped = bytearray(data)
    flipped[-1] ^= 1
    path.write_bytes(flipped)
    refused(path, "truncated or altered")


@pytest.mark.parametrize(
    ("text", "word"),
    [
        (b"", "cannot be read"),
        (b"\xff\xfe", "cannot be read"),
        (b'{"format": 2}', "method"),
        (b'{"format": 99}', "format 99, valid: 2"),
    ],
    ids=["empty", "binary", "incomplete", "another format"],
)
def test_damaged_card(path, text, word):
    path.with_suffix(".json").write_bytes(text)
    refused(path, word, "cenet@3.json")


def test_unknown_method_names_the_nearest(path):
    edit(path, method="transfomer")
    refused(path, "unknown method 'transfomer'", "did you mean transformer", kind=UnknownNameError)


def test_another_method_or_dimension(path):
    edit(path, method="gru")
    refused(path, "other dimensions", "context: trained 19, here 67", "state: trained 0, here 131")


def test_altered_facts_on_the_card(path):
    card = json.loads(path.with_suffix(".json").read_text())
    card["robot"]["kp"][0] = 40.0
    edit(path, robot=card["robot"])
    refused(path, "altered", "digest")


def test_weights_that_do_not_fit_the_card(path):
    tensors = load_file(path)
    last = tensors.pop("actor.mlp.6.bias")
    replace_weights(path, tensors)
    refused(path, "lacks actor.mlp.6.bias (1 in all)")
    replace_weights(path, tensors | {"actor.mlp.6.bias": last[:-1].clone()})
    refused(path, "wrong shape of actor.mlp.6.bias")
    replace_weights(path, tensors | {"actor.mlp.6.bias": last, "extra": last.clone()})
    refused(path, "does not know, extra")
    replace_weights(path, tensors | {"actor.mlp.6.bias": last * float("nan")})
    refused(path, "not a number in actor.mlp.6.bias")


def test_not_safetensors(path):
    path.write_bytes(b"PK")
    edit(path, sha256=checkpoint.hashlib.sha256(b"PK").hexdigest())
    refused(path, "not a safetensors file")


@pytest.mark.parametrize(
    ("config", "words"),
    [
        (RobotConfig(leg_gain=(40.0, 1.5)), ["kp[0]: trained 45.0, here 40.0 and 5 more"]),
        (RobotConfig(ankle_effort=40.0), ["effort[3]: trained"]),
        (RobotConfig(tcp="link6"), ["ee_xyz[0]: trained 0.235, here 0.0"]),
        (RobotConfig(tcp="link6", leg_gain=(45.0, 2.0)), ["kd[0]", "ee_xyz[0]"]),
    ],
    ids=["gains", "limits", "end-effector", "two at once"],
)
def test_another_robot_lists_what_differs(sound, config, words):
    with pytest.raises(CheckpointError) as caught:
        checkpoint.load(sound, load_robot(config))
    for word in words:
        assert word in str(caught.value)
    named = re.findall(r"(\w+)\[\d+\]: trained", str(caught.value))
    assert named == [word.partition("[")[0] for word in words]  # and nothing else


def test_posture_joints_and_bodies_are_compared(sound):
    robot = load_robot()
    with pytest.raises(CheckpointError, match=r"default_q\[9\]: trained 0.5, here 0.6"):
        default_q = robot.default_q.copy()
        default_q[9] = 0.6
        checkpoint.load(sound, dataclasses.replace(robot, default_q=default_q))
    heavier = [
        msgspec.structs.replace(link, mass=link.mass + (k == 0)) for k, link in enumerate(robot.facts.links)
    ]
    facts = msgspec.structs.replace(robot.facts, links=tuple(heavier))
    with pytest.raises(CheckpointError, match=r"bodies \(masses, inertias or geometry\)"):
        checkpoint.load(sound, dataclasses.replace(robot, facts=facts))
    card = read_card(sound)
    swapped = msgspec.structs.replace(card.robot, joints=(*card.robot.joints[1::-1], *card.robot.joints[2:]))
    with pytest.raises(
        CheckpointError, match=r"joints\[0\]: trained hip_L_Joint, here abad_L_Joint and 1 more"
    ):
        check_fit(msgspec.structs.replace(card, robot=swapped), robot, None, "x")


def test_a_remark_on_a_source_is_no_other_robot(sound):
    robot = load_robot()
    facts = msgspec.structs.replace(
        robot.facts, foot=msgspec.structs.replace(robot.facts.foot, src="elsewhere")
    )
    checkpoint.load(sound, dataclasses.replace(robot, facts=facts))


def test_another_control_period(sound):
    protocol = find_protocol("smoke_v1")[0]
    slower = msgspec.structs.replace(
        protocol, physics=msgspec.structs.replace(protocol.physics, decimation=20)
    )
    with pytest.raises(CheckpointError, match=r"control_period: trained 0\.02, here 0\.04"):
        checkpoint.load(sound, protocol=slower)


def test_names_of_shipped_checkpoints(tmp_path, monkeypatch):
    monkeypatch.setattr(weights, "CHECKPOINTS", tmp_path)
    write(tmp_path / "limx_adapter", "cenet", seed=0)
    write(tmp_path / "limx_adapter", "gru", seed=1)
    assert weights.available("limx_adapter") == ["cenet@0", "gru@1"]
    assert weights.available("paper") == []
    assert load_controller("learned:cenet@0", load_robot()).info.name == "learned:cenet@0"
    with pytest.raises(UnknownNameError, match=r"unknown checkpoint 'gru@0'.*did you mean gru@1"):
        load_controller("learned:gru@0", load_robot())
    with pytest.raises(UnknownNameError, match="did you mean cenet@0"):
        load_controller("learned:cent@0", load_robot())
    with pytest.raises(UnknownNameError, match=r"cenet@0'.*none trained or shipped for the robot 'paper'"):
        load_controller("learned:cenet@0", load_robot(RobotConfig(variant="paper")))


def test_a_method_stands_for_one_seed_a_replicate():
    assert spec_of_replicate("learned:gru", 2) == "learned:gru@2"
    for spec in ("learned:gru@1", "learned:some/gru.safetensors", "hold", "module:attribute"):
        assert spec_of_replicate(spec, 2) == spec


def test_average_is_the_mean_of_weights(tmp_path: Path) -> None:
    paths = [write(tmp_path / str(seed), "transformer_gru", seed=seed) for seed in (1, 2)]
    for path, samples in zip(paths, (10, 30), strict=True):
        edit(path, samples=samples, seed=1)
    out = tmp_path / "mean.safetensors"
    average([*paths, paths[1]], out)
    parts, found = [load_file(path) for path in paths], load_file(out)
    for name, value in found.items():
        expected = (parts[0][name].double() + 2 * parts[1][name].double()) / 3
        torch.testing.assert_close(value, expected.float(), rtol=0, atol=1e-7)
    card = read_card(out)
    cards = [read_card(path) for path in paths]
    assert card.mean_of == tuple(f"{c.samples} {c.sha256}" for c in (*cards, cards[1]))
    assert card.samples == max(c.samples for c in cards)
    load_controller(f"learned:{out}", load_robot())


def test_average_refuses_what_does_not_belong_together(tmp_path: Path, sound: Path) -> None:
    other = write(tmp_path / "other", "gru", seed=3)
    with pytest.raises(
        CheckpointError, match=r"gru@3.safetensors' has the method gru, valid: that of .*cenet"
    ):
        average([sound, other], tmp_path / "mean.safetensors")
    with pytest.raises(CheckpointError, match="average of 1 checkpoints, valid: 2 or more"):
        average([sound], tmp_path / "mean.safetensors")
    assert not (tmp_path / "mean.safetensors").exists()
