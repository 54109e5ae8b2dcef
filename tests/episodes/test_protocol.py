"""Protocol files: what is refused, with which words, and what a digest covers."""

import math
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import wbc_bench
from wbc_bench.episodes.protocol import Termination, find_protocol, protocol_names, read_protocol
from wbc_bench.errors import ProtocolError, UnknownNameError
from wbc_bench.files import PROTOCOLS

ROOT = Path(__file__).parents[2]
SMOKE = (PROTOCOLS / "smoke_v1.toml").read_text()
REACH = (PROTOCOLS / "reach_v1.toml").read_text()


def written(folder: Path, text: str) -> Path:
    path = folder / "mine.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("seed = 7", "seed = 7\nsede = 8", r"unknown field `sede` - at `\$\.episodes`"),
        ('name = "smoke_v1"', 'name = "smoke_v1"\nnmae = 1', r"unknown field `nmae`"),
        ("leg_q = 0.1", 'leg_q = "0.1"', r"Expected `float`, got `str` - at `\$\.randomization\.leg_q`"),
        ("replicates = 2", "replicates = 2.5", r"Expected `int`.* - at `\$\.episodes\.replicates`"),
        ("per_replicate = 6", "per_replicate = 0", r">= 1 - at `\$\.episodes\.per_replicate`"),
        ("horizon = 2.0", "horizon = -2.0", r"> 0.0 - at `\$\.episodes\.horizon`"),
        ("horizon = 2.0", "horizon = 2.013", r"2.013 s is not a whole .* - at `\$\.episodes\.horizon`"),
        ("window = 0.5", "window = 3.0", r"longer than the horizon of 2 s - at `\$\.success\.window`"),
        ("x = [-0.8, 0.8]", "x = [0.8, -0.8]", r"low 0.8 is above high -0.8 - at `\$\.targets\.x`"),
        ("x = [-0.8, 0.8]", "x = [-0.8]", r"length 2, got 1 - at `\$\.targets\.x`"),
        ("height = [0.1, 2.0]", "height = [-0.1, 2.0]", r"below the ground - at `\$\.targets\.height`"),
        ("arm = 1", "arms = 1", r"Invalid enum value 'arms' - at `key.* in `\$\.targets\.weights`"),
        ("arm = 1", "arm = 0", r">= 1 - at `\$\.targets\.weights\[\.\.\.\]`"),
        ("step_distance = [0.1", "step_distance = [-0.1", r"negative - at `\$\.targets\.step_distance`"),
        ("friction = [0.4, 1.0]", "friction = [0, 1.0]", r"positive - at `\$\.randomization\.friction`"),
        (
            "friction = [0.4, 1.0]",
            "friction = [nan, 1.0]",
            r"nan is not .* - at `\$\.randomization\.friction`",
        ),
        ("gain = [0.9, 1.1]", "gain = [-0.9, 1.1]", r"positive - at `\$\.randomization\.gain`"),
        ("base_mass = [-1.0", "base_mass = [-20.0", r"leaves no base.* - at `\$\.randomization\.base_mass`"),
        (
            "interval = [0.5, 0.9]",
            "interval = [0.1, 0.9]",
            r"more than 2 pushes .* - at `\$\.push\.interval`",
        ),
        ("seed = 7", "seed = 9223372036854775808", r"too large.* - at `\$\.episodes\.seed`"),
        ('type = "workspace"', 'type = "moon"', r"Invalid value 'moon' - at `\$\.targets\.type`"),
        ("[noise]", "[noise", r"mine\.toml: "),
        ('name = "smoke_v1"', 'name = "протокол"', r"'протокол' cannot name a folder.* - at `\$\.name`"),
        ('name = "smoke_v1"', 'name = "протокол-1"', r"cannot name a folder.*ASCII.* - at `\$\.name`"),
        ('name = "smoke_v1"', 'name = ""', r"cannot name a folder of results.* - at `\$\.name`"),
        ('name = "smoke_v1"', 'name = "mine/../../etc"', r"cannot name a folder.* - at `\$\.name`"),
        ('name = "smoke_v1"', f'name = "{"n" * 121}"', r"1 to 120 ASCII letters.* - at `\$\.name`"),
        ("horizon = 2.0", "horizon = 600.02", r"<= 600.0 - at `\$\.episodes\.horizon`"),
        ("replicates = 2", "replicates = 1001", r"<= 1000 - at `\$\.episodes\.replicates`"),
        ("per_replicate = 6", "per_replicate = 1000000", r"<= 100000 - at `\$\.episodes\.per_replicate`"),
        ("per_replicate = 6", "per_replicate = 50001", r"2 x 50001 episodes, valid: at most 100000"),
        ("arm = 1", "arm = 1001", r"<= 1000 - at `\$\.targets\.weights\[\.\.\.\]`"),
        ("[noise]", "[physics]\ntimestep = 1e-9\n[noise]", r">= 0.0001 - at `\$\.physics\.timestep`"),
        ("[noise]", "[physics]\ndecimation = 1001\n[noise]", r"<= 1000 - at `\$\.physics\.decimation`"),
    ],
)
def test_a_mistake_names_its_field(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in SMOKE
    path = written(tmp_path, SMOKE.replace(old, new, 1))
    with pytest.raises(ProtocolError) as caught:
        read_protocol(path)
    text = str(caught.value)
    assert re.search(message, text), text
    assert str(path) in text and "\n" not in text


def test_control_steps_of_an_episode_are_limited(tmp_path: Path) -> None:
    text = SMOKE.replace("horizon = 2.0", "horizon = 300.0") + "\n[physics]\ndecimation = 1\n"
    with pytest.raises(ProtocolError, match=r"300 s has more than 30000 control periods of 0.002 s - at"):
        read_protocol(written(tmp_path, text))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("heights = [0.0, 2.0", "heights = [2.0, 0.0", r"heights 2 to 0 m.* - at `\$\.targets\.heights`"),
        ("heights = [0.0, 2.0, 0.05", "heights = [0.0, 2.0, 0.0", r"> 0.0 - at `\$\.targets\.heights\[2\]`"),
        ("0.05]", "1e-300]", r"makes more than 100000 heights - at `\$\.targets\.heights`"),
        ('["free", "horizontal"]', "[]", r"at least one.* - at `\$\.targets\.orientations`"),
        ('["free", "horizontal"]', '["free", "free"]', r"each once - at `\$\.targets\.orientations`"),
        ('["free", "horizontal"]', '["down"]', r"'down' - at `\$\.targets\.orientations\[0\]`"),
        ("per_height = 20", "per_height = 21", r"the ladder has 1 x 3444 - at `\$\.episodes\.per_replicate`"),
    ],
)
def test_a_mistake_in_a_ladder_names_its_field(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in REACH
    with pytest.raises(ProtocolError) as caught:
        read_protocol(written(tmp_path, REACH.replace(old, new, 1)))
    assert re.search(message, str(caught.value)), str(caught.value)


def test_unknown_protocol_is_told_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="did you mean smoke_v1"):
        find_protocol("smoke_v2")
    with pytest.raises(ProtocolError, match="does not exist"):
        find_protocol(str(tmp_path / "none.toml"))


def test_digest_covers_meaning_not_layout(tmp_path: Path) -> None:
    plain = read_protocol(PROTOCOLS / "smoke_v1.toml")
    assert (
        read_protocol(written(tmp_path, "# why\n" + SMOKE.replace("0.5, 0.9", "0.50,  0.9"))).digest
        == plain.digest
    )
    described = SMOKE.replace("Twelve", "A dozen")
    assert read_protocol(written(tmp_path, described)).digest == plain.digest
    spelled_out = SMOKE + "\n[physics]\ntimestep = 0.002\n"  # the default
    assert read_protocol(written(tmp_path, spelled_out)).digest == plain.digest
    for old, new in (("seed = 7", "seed = 8"), ("0.5, 0.9", "0.5, 0.8"), ("smoke_v1", "smoke_v9")):
        assert read_protocol(written(tmp_path, SMOKE.replace(old, new))).digest != plain.digest


def test_steps_and_windows() -> None:
    smoke = find_protocol("smoke_v1")[0]
    assert smoke.control_period == pytest.approx(0.02)
    assert (smoke.num_steps, smoke.window_steps) == (100, 25)


def test_released_protocols_load_under_their_names() -> None:
    assert {"ablation_v1", "reach_v1", "smoke_v1", "tuning_v1"} <= set(protocol_names())
    for name in protocol_names():
        assert find_protocol(name)[0].name == name


def test_what_a_table_uses_shares_no_seed_with_tuning() -> None:
    seeds = {name: find_protocol(name)[0].episodes.seed for name in protocol_names()}
    tuning = {seed for name, seed in seeds.items() if name.startswith("tuning")}
    assert len(tuning) == 1
    assert not tuning & {seed for name, seed in seeds.items() if not name.startswith("tuning")}


def test_undisturbed_protocols_ask_for_the_same_targets() -> None:
    for family in (
        ("ablation_v1", "nopush_v1", "nominal_v1"),
        ("tuning_v1", "tuning_nopush_v1", "tuning_nominal_v1"),
    ):
        first, *others = [find_protocol(name)[0] for name in family]
        for other in others:
            assert (other.targets, other.episodes.seed) == (first.targets, first.episodes.seed)
            assert (other.termination, other.success, other.robot) == (
                first.termination,
                first.success,
                first.robot,
            )
            assert other.push.speed == 0
        assert others[0].noise == first.noise and others[0].randomization == first.randomization


@pytest.mark.parametrize("where", ["a checkout", "a wheel"])
def test_released_protocols_are_found(tmp_path, where):
    """Beside the package in a checkout and an editable install, inside it in a wheel."""
    package = tmp_path / "wbc_bench"
    shutil.copytree(ROOT / "wbc_bench", package, ignore=shutil.ignore_patterns("__pycache__"))
    folder = package if where == "a wheel" else tmp_path
    shutil.copytree(ROOT / "protocols", folder / "protocols", ignore=shutil.ignore_patterns("*.parquet"))
    code = (
        "from wbc_bench.episodes.protocol import find_protocol, protocol_names;"
        "print(find_protocol('smoke_v1')[1], len(protocol_names()))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env={"PATH": ""}, capture_output=True, text=True
    )
    assert done.stdout.split()[0] == str(folder / "protocols" / "smoke_v1.toml"), done.stderr
    assert int(done.stdout.split()[1]) == len(protocol_names())


def test_an_editable_install_finds_those_of_its_checkout():
    assert PROTOCOLS in (ROOT / "protocols", Path(wbc_bench.__file__).parent / "protocols")
    assert (PROTOCOLS / "ablation_v1.parquet").is_file() and list((PROTOCOLS / "scripts").glob("*.toml"))


def test_a_tilt_limit_is_a_cosine_up_to_pi_and_none_beyond():
    assert Termination(tilt=math.pi / 3).min_upright == pytest.approx(0.5)
    for tilt in (math.pi, 3.2, 2 * math.pi, 1e9):
        assert Termination(tilt=tilt).min_upright == -math.inf


def test_postures_of_a_protocol_without_a_tilt_limit_are_valid():
    from wbc_bench.episodes.static_solver import static_solver
    from wbc_bench.robot import RobotConfig

    solver = static_solver(RobotConfig(), 0.0, 2 * math.pi / 0.9, 0.3)
    qpos = solver.model.qpos0.copy()
    qpos[3:7] = [math.cos(0.2), 0.0, math.sin(0.2), 0.0]  # 0.4 rad forward
    assert "base too tilted or too low" not in solver.violations(qpos)
    strict = static_solver(RobotConfig(), 0.0, 0.3, 0.3)
    assert "base too tilted or too low" in strict.violations(qpos)
