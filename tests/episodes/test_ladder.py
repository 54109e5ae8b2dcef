"""Severity ladders: what a level changes, that it changes nothing else, and what is refused."""

from dataclasses import fields, replace

import numpy as np
import pytest

from tiny_ladder import write_ladder
from wbc_bench.episodes.ladder import (
    FOLDER,
    FrozenLevel,
    Ladder,
    LadderError,
    find_ladder,
    freeze_levels,
    ladder_names,
    ladder_rows,
)
from wbc_bench.episodes.manifest import manifest_path, read_manifest
from wbc_bench.episodes.protocol import read_protocol
from wbc_bench.episodes.rows import EpisodeManifest
from wbc_bench.errors import BenchError, ProtocolError, UnknownNameError

# Factor of the released ladder -> columns of the manifest that it may change. Noise is no draw of a manifest.
COLUMNS = {
    "command_delay": {"command_delay"},
    "observation_delay": {"observation_delay"},
    "payload": {"payload"},
    "motor_strength": {"motor_strength"},
    "gains": {"kp_scale", "kd_scale"},
    "friction": {"friction"},
    "push": {"push_time", "push_vel"},
    "noise": set(),
    "joint_offset": {"joint_offset"},
    "gravity_tilt": {"imu_tilt"},
    "odometry_drift": {"odometry_drift"},
    "slope": {"slope", "base_height"},
}


def differing(a: EpisodeManifest, b: EpisodeManifest) -> set[str]:
    names = (field.name for field in fields(EpisodeManifest))
    pairs = {name: (getattr(a, name), getattr(b, name)) for name in names}
    return {name for name, (x, y) in pairs.items() if not np.array_equal(x, y, equal_nan=x.dtype.kind == "f")}


@pytest.fixture(scope="module")
def released(tmp_path_factory) -> tuple[Ladder, dict[str, FrozenLevel]]:
    """The mildest and the most severe level of every factor of the released ladder, twelve episodes each."""
    folder = tmp_path_factory.mktemp("levels")
    text = (FOLDER / "stress_v2.toml").read_text()
    path = folder / "short.toml"
    path.write_text(text.replace("episodes = 100", "episodes = 12"))
    ladder = find_ladder(str(path))
    ends = (replace(factor, levels=factor.levels[:: len(factor.levels) - 1]) for factor in ladder.factors)
    short = replace(ladder, factors=tuple(ends))
    frozen = freeze_levels(short, ladder_rows(short), folder)
    return short, {level.protocol.name: level for level in frozen}


@pytest.mark.parametrize("name", COLUMNS)
def test_a_level_differs_from_another_in_its_factor_alone(released, name):
    ladder, frozen = released
    (factor,) = (factor for factor in ladder.factors if factor.name == name)
    mild, severe = (frozen[level.protocol.name] for level in factor.levels)
    base = frozen[ladder.base.name]
    changed = differing(mild.manifest, severe.manifest)
    assert changed <= COLUMNS[name] and bool(changed) == bool(COLUMNS[name])
    assert differing(base.manifest, severe.manifest) <= COLUMNS[name]


def test_the_base_is_the_beginning_of_its_protocol(released):
    ladder, frozen = released
    protocol, path = ladder.source, ladder.source_path
    first = read_manifest(protocol, manifest_path(path), check_values=False)[0].of_replicate(0, 12)
    assert differing(frozen[ladder.base.name].manifest, first) == set()
    changed = {
        name for name in protocol.__struct_fields__ if getattr(protocol, name) != getattr(ladder.base, name)
    }
    assert changed == {"name", "episodes"}


@pytest.mark.parametrize(("name", "base"), [("stress_v1", "ablation_v1"), ("stress_v2", "ablation_v2")])
def test_a_released_ladder_has_every_factor_and_six_levels(name, base):
    ladder = find_ladder(name)
    assert name in ladder_names() and ladder.source.name == base
    assert {factor.name for factor in ladder.factors} == COLUMNS.keys()
    assert {len(factor.levels) for factor in ladder.factors} == {6}
    assert ladder.episodes == 100


def test_a_level_that_is_the_base_is_evaluated_once(tmp_path):
    ladder = find_ladder(str(write_ladder(tmp_path)))
    _, noise, delay = ladder.factors
    assert noise.levels[0].protocol == delay.levels[0].protocol == ladder.base
    assert [protocol.name for protocol in ladder.protocols()] == [
        *("climb@base", "climb@friction@0.8", "climb@friction@0.4"),
        *("climb@noise@2", "climb@noise@4", "climb@delay@0.02"),
    ]


def test_the_mappings_by_hand(tmp_path):
    base = find_ladder("stress_v1").base
    levels = {factor.name: factor.levels[-1].protocol for factor in find_ladder("stress_v1").factors}
    assert levels["friction"].randomization.friction == (0.1, 0.1)
    assert levels["gains"].randomization.gain == (0.5, 1.5)
    assert levels["push"].push.speed == 1.25 and levels["push"].push.interval == base.push.interval
    assert levels["joint_offset"].randomization.joint_offset == 0.1
    assert levels["noise"].noise.joint_vel == 4 * base.noise.joint_vel
    assert levels["noise"].noise.gravity == 4 * base.noise.gravity


def test_kept_levels_are_read_back_as_they_were(tmp_path):
    ladder = find_ladder(str(write_ladder(tmp_path)))
    folder = tmp_path / "levels"
    folder.mkdir()
    for level in freeze_levels(ladder, ladder_rows(ladder), folder):
        protocol = read_protocol(level.path)
        assert protocol == level.protocol and protocol.digest == level.protocol.digest
        manifest, sha256 = read_manifest(protocol, manifest_path(level.path))
        assert sha256 == level.manifest_sha256 and differing(manifest, level.manifest) == set()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[0.0, 0.02]", "[-0.01, 0.02]", r"level -0.01 of factor 'delay': Expected `float` >= 0.0 - at "
         r"`\$\.randomization\.command_delay"),
        ("[0.8, 0.4]", "[0.8, -0.4]", r"level -0.4 of factor 'friction'.*must be positive"),
        ("[0.0, 0.02]", "[0.0, 0.5]", r"level 0.5 of factor 'delay': Expected `float` <= 0.2"),
        ("[1.0, 2.0, 4.0]", "[1.0, 4.0, 2.0]", r"neither rise nor fall.*`\$\.factors\.noise\.levels`"),
        ("[1.0, 2.0, 4.0]", "[1.0, 1.0, 2.0]", r"neither rise nor fall"),
        ("[1.0, 2.0, 4.0]", "[1.0, nan]", r"neither rise nor fall"),
        ("[1.0, 2.0, 4.0]", "[1.0]", r"length >= 2 - at `\$\.factors"),
        ("[0.0, 0.02]", "[0.0, 0.0123456789]", r"more than six digits.*`\$\.factors\.delay\.levels\[1\]`"),
        ("randomization.friction", "randomization.frictoin", r"no field .*`\$\.factors\.friction\.field`"),
        ("randomization.friction", "episodes.seed", r"'episodes.seed', valid: fields of randomization"),
        ("randomization.friction", "randomization.friction.low", r"no field .* in a protocol"),
        ('mapping = "scale"', 'mapping = "value"', r"level 1 of factor 'noise': Expected `object`"),
        ('mapping = "scale"', 'mapping = "times"', r"Invalid enum value 'times' - at `\$\.factors"),
        ("factors.noise]", 'factors."a/b"]', r"'a/b' cannot name folders"),
        ('name = "climb"', 'name = "../climb"', r"'../climb' cannot name a folder"),
        ("episodes = 4", "episodes = 7", r"7 episodes, valid: 1 to 6 .*`\$\.episodes`"),
        ("episodes = 4", "episodes = 0", r"Expected `int` >= 1 - at `\$\.episodes`"),
        ('protocol = "tiny.toml"', 'protocol = "none.toml"', r"none.toml' does not exist"),
        ("label =", "labl =", r"unknown field `labl`|missing required field `label`"),
    ],
)  # fmt: skip
def test_mistakes_are_one_line_with_the_field(tmp_path, old, new, message):
    path = write_ladder(tmp_path, old, new)
    with pytest.raises((LadderError, ProtocolError), match=message) as caught:
        find_ladder(str(path))
    assert len(str(caught.value).splitlines()) == 1
    assert "climb.toml" in str(caught.value) or "none.toml" in str(caught.value)


def test_unknown_names_come_with_the_nearest(tmp_path):
    with pytest.raises(UnknownNameError, match="did you mean stress_v2"):
        find_ladder("stres_v2")
    ladder = find_ladder(str(write_ladder(tmp_path)))
    with pytest.raises(UnknownNameError, match="did you mean friction"):
        ladder.only(["frictoin"])
    assert [factor.name for factor in ladder.only(["noise", "friction"]).factors] == ["friction", "noise"]
    assert ladder.only([]) == ladder
    with pytest.raises(BenchError, match="does not exist"):
        find_ladder(str(tmp_path / "none.toml"))
