"""A check of a card names the one thing that is wrong with it; a first card is made of what others write."""

import json
from pathlib import Path

import numpy as np
import pytest

from small_networks import front, layer, weights
from wbc_bench.cli.main import main
from wbc_bench.errors import BenchError
from wbc_bench.evaluation import policy_check
from wbc_bench.evaluation.policy_check import check_policy
from wbc_bench.policies.card import read_card
from wbc_bench.policies.normalizer import symmetry_by_order
from wbc_bench.registry import load_controller
from wbc_bench.robot import JOINT_NAMES, load_robot

ROBOT = load_robot()
PAIRS = [name for pair in zip(JOINT_NAMES[:4], JOINT_NAMES[4:8], strict=True) for name in pair]
FOREIGN = """
name = "foreign"
robot = "limx_adapter"
quaternion = "wxyz"

[[observation]]
name = "last"
terms = [{ term = "last_action" }]
[[observation]]
name = "phase"
terms = [{ term = "phase_reference" }]
[[observation]]
name = "goal"
terms = [{ term = "ee_target", frame = "base" }]
[[observation]]
name = "past"
history = 10
history_order = "oldest_first"
history_layout = "frame"
terms = [
    { term = "base_ang_vel" }, { term = "projected_gravity" }, { term = "joint_pos_rel" },
    { term = "joint_vel_rel" }, { term = "joint_effort" }, { term = "ee_pos", frame = "base" },
    { term = "ee_rot6", frame = "base" },
]
[[network]]
file = "front.onnx"
inputs = { goal = "goal", past = "past" }
outputs = { command = "command", newest = "newest", window = "window", body = "body", hand = "hand" }
[[network]]
file = "bare.onnx"
[network.inputs]
observation = ["body", "last", "hand", "phase"]
command = "command"
term = "newest"
window = "window"
[network.outputs]
action = "action"
[[network.state]]
input = "state"
output = "next_state"
[action]
scale = [0.6, 0.6, 0.6, 0.6, 0.6, 0.6, 0.6, 0.6, 0.3, 0.3, 0.3, 0.2, 0.2, 0.2]
"""
SCALE = FOREIGN[FOREIGN.index("scale = [") : FOREIGN.rindex("]") + 1]
FAULTS = {
    "joint order": [("quaternion", f"joints = {[*PAIRS, *JOINT_NAMES[8:]]}\nquaternion")],
    "sign": [('"projected_gravity"', '"projected_gravity", scale = -1.0')],
    "frame": [('frame = "base"', 'frame = "world"')],
    "gains": [(SCALE, f"{SCALE}\nkp = 4.0")],
    "quaternion order": [('quaternion = "wxyz"', 'quaternion = "xyzw"')],
    "history order": [('"oldest_first"', '"newest_first"')],
    "action scale": [(SCALE, "scale = 1.0")],
    "default posture": [(SCALE, f"{SCALE}\noffset = 0.0")],
}


@pytest.fixture(scope="module")
def foreign(own_policy: Path) -> Path:
    front(own_policy / "front.onnx", 10, 57)
    return own_policy


def planted(folder: Path, fault: str) -> Path:
    text = FOREIGN
    for old, new in FAULTS.get(fault, ()):
        assert old in text
        text = text.replace(old, new)
    path = folder / f"{fault.replace(' ', '_') or 'right'}.toml"
    path.write_text(text)
    return path


@pytest.fixture
def short_trials(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(policy_check, "EPISODES", 1)


@pytest.mark.parametrize("fault", FAULTS)
def test_a_planted_fault_is_named(foreign: Path, short_trials: None, fault: str) -> None:
    verdict = check_policy(planted(foreign, fault))
    assert not verdict.good and verdict.edit is not None and verdict.edited is not None
    assert verdict.edit.fault == fault
    assert verdict.edited.upright == 1.0 and verdict.edited.score > verdict.trial.score + policy_check.CLEARLY


def test_a_right_card_has_no_fault(
    foreign: Path, short_trials: None, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["policy", "check", str(planted(foreign, ""))])
    printed = capsys.readouterr().out
    assert "no fault found" in printed and "upright 100% of the time" in printed
    assert "| past | 13 | joint_pos_rel, 9 before | ankle_R_Joint |" in printed
    assert "| bare.onnx | observation | 58 | body + last + hand + phase |" in printed


def test_what_the_normaliser_knows_is_printed(
    own_policy: Path, short_trials: None, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["policy", "check", str(own_policy / "card.toml")])
    printed = capsys.readouterr().out
    assert "no fault found" in printed and "| bare.onnx | command | 9 | command |" in printed
    assert "| 3 | ankle_L_Joint | 0 | 45 | 0.8 | 0.6 |" in printed
    # gravity points down in the normaliser, too
    row = next(line for line in printed.splitlines() if line.startswith("| observation | 5 |"))
    assert float(row.split("|")[5]) < -0.9
    assert "left-right asymmetry of the normaliser's mean of joint_pos_rel in 'observation'" in printed


def test_a_missing_term_is_named_at_once(foreign: Path) -> None:
    path = foreign / "short.toml"
    path.write_text(FOREIGN.replace('{ term = "joint_effort" }, ', ""))
    with pytest.raises(BenchError, match="reads 570 numbers as 'past', the card gives 430: past 430"):
        check_policy(path)


def test_antisymmetry_tells_orders_apart() -> None:
    """Means of mirrored legs: alike up to the sign in the right order, and in none that mixes the legs."""
    mean = np.zeros(14)
    mean[:8] = [0.1, 0.2, 0.3, 0.4, -0.1, -0.2, -0.3, 0.4]
    right = symmetry_by_order(mean, JOINT_NAMES, ROBOT)
    assert right["as in the card"] < 1e-12 and max(right.values()) > 0.2
    mixed = (*PAIRS, *JOINT_NAMES[8:])
    assert symmetry_by_order(mean, mixed, ROBOT)["as in the card"] > 0.2


# first cards


def imported(folder: Path, text: str | None, capsys: pytest.CaptureFixture[str], **metadata: str) -> str:
    layer(folder / "walk.onnx", weights(0, 34, 8), **metadata)
    options = []
    if text is not None:
        (folder / "deploy.yaml").write_text(text)
        options = ["--description", str(folder / "deploy.yaml")]
    main(["policy", "import", str(folder / "walk.onnx"), *options])
    return capsys.readouterr().out


LEGS = list(JOINT_NAMES[:8])
UNITREE = f"""
joint_ids_map: [0, 1, 2, 3, 4, 5, 6, 7]
step_dt: 0.02
stiffness: {[40.0] * 8}
damping: {[1.5] * 8}
default_joint_pos: {[0.1] * 8}
actions:
  JointPositionAction:
    {{ clip: null, joint_names: {json.dumps(LEGS)}, scale: {[0.25] * 8}, offset: {[0.1] * 8} }}
observations:
  base_ang_vel: {{ params: {{}}, clip: null, scale: [0.2, 0.2, 0.2], history_length: 1 }}
  projected_gravity: {{ params: {{}}, clip: null, scale: [1.0, 1.0, 1.0], history_length: 1 }}
  joint_pos_rel: {{ params: {{}}, clip: [-100, 100], scale: {[1.0] * 8}, history_length: 1 }}
  joint_vel_rel: {{ params: {{}}, clip: null, scale: {[0.05] * 8}, history_length: 1 }}
  last_action: {{ params: {{}}, clip: null, scale: {[1.0] * 8}, history_length: 1 }}
"""
ISAAC = f"""
articulations:
  robot:
    joint_names: {json.dumps(LEGS)}
    default_joint_pos: {[0.1] * 8}
    default_joint_stiffness: {[40.0] * 8}
    default_joint_damping: {[1.5] * 8}
scene: {{ physics_dt: 0.005, decimation: 4, dt: 0.02 }}
actions:
- {{ name: joint_pos, joint_names: {json.dumps(LEGS)}, scale: 0.25, offset: {[0.1] * 8} }}
observations:
  policy:
  - {{ name: base_ang_vel, shape: [3], overloads: {{ scale: 0.2, clip: null, history_length: 0 }} }}
  - {{ name: projected_gravity, shape: [3], overloads: {{ scale: null, clip: null, history_length: 0 }} }}
  - {{ name: joint_pos_rel, shape: [8], joint_names: {json.dumps(LEGS)}, overloads: {{ clip: [-100, 100] }} }}
  - {{ name: joint_vel_rel, shape: [8], overloads: {{ scale: 0.05 }} }}
  - {{ name: last_action, shape: [8], overloads: {{}} }}
"""


@pytest.mark.parametrize("text", [UNITREE, ISAAC], ids=["Unitree", "Isaac Lab"])
def test_a_card_of_a_description(tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str) -> None:
    """Complete, but for what the description cannot say: the 30 numbers become 34 with a command."""
    printed = imported(tmp_path, text, capsys)
    card = read_card(tmp_path / "walk.toml")
    assert card.joints == tuple(LEGS) and card.control_period == 0.02 and "missing" not in printed
    assert card.action.kp == (40.0,) * 8 and card.action.scale == 0.25 and card.action.offset == 0.1
    terms = card.observation[0].terms
    assert [term.term for term in terms][-1] == "last_action" and terms[0].scale == 0.2
    assert terms[2].clip == (-100.0, 100.0) and card.default_posture["ankle_L_Joint"] == 0.1
    with pytest.raises(BenchError, match="reads 34 numbers as 'obs', the card gives 30"):
        load_controller(f"policy:{tmp_path / 'walk.toml'}", ROBOT)
    text, last = (tmp_path / "walk.toml").read_text(), '{ "term" = "last_action"'
    whole = text.replace(last, '{ term = "constant", value = [0, 0, 0, 0] }, ' + last)
    (tmp_path / "walk.toml").write_text(whole)
    controller = load_controller(f"policy:{tmp_path / 'walk.toml'}", ROBOT)
    assert controller.info.commands == {"kp", "kd", "action"}


def test_a_card_of_metadata(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    printed = imported(
        tmp_path,
        None,
        capsys,
        joint_names=",".join(LEGS),
        observation_names="base_ang_vel,projected_gravity,joint_pos,joint_vel,actions,foot_height",
        action_scale="0.25",
        joint_stiffness=",".join(["40.0"] * 8),
        default_joint_pos=",".join(["0.1"] * 8),
    )
    assert "missing: term 'foot_height' of the description, valid: base_ang_vel" in printed
    assert "missing: control_period" in printed
    text = (tmp_path / "walk.toml").read_text()
    assert "# missing: control_period" in text and '"joint_vel_rel"' in text
    with pytest.raises(BenchError, match="unknown term 'foot_height'"):
        read_card(tmp_path / "walk.toml")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: [1, 2", "is damaged or not YAML"),
        ("just text", "holds str, valid: a table of YAML"),
        ("a: 1", "has a, valid: an Isaac Lab IO descriptor or a Unitree deploy.yaml"),
        ("a: !!python/object/apply:os.system ['touch executed']", "is damaged or not YAML"),
        ("step_dt: soon", "is damaged or not"),
    ],
)
def test_a_wrong_description_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, text: str, said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        imported(tmp_path, text, capsys)
    error = capsys.readouterr().err
    assert ended.value.code == 2 and said in error and len(error.strip().splitlines()) == 1
    assert not (tmp_path / "walk.toml").exists() and not (tmp_path / "executed").exists()
