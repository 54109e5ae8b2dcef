"""Frozen manifests: equal bytes, refused when altered, and every released one verified."""

import hashlib
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from wbc_bench.episodes.freeze import build_manifest, freeze
from wbc_bench.episodes.kinds import kind_of
from wbc_bench.episodes.manifest import EpisodeManifest, manifest_path, read_manifest, write_manifest
from wbc_bench.episodes.protocol import find_protocol, protocol_names, read_protocol
from wbc_bench.episodes.static_solver import static_solver
from wbc_bench.episodes.targets import BEYOND
from wbc_bench.episodes.verify import verify
from wbc_bench.errors import ManifestError, ProtocolError
from wbc_bench.files import PROTOCOLS

SMOKE, SMOKE_FILE = find_protocol("smoke_v1")

LITTLE_LADDER = """
name = "ladder"
description = "two heights"
[episodes]
replicates = 1
per_replicate = 8
horizon = 2.0
seed = 3
[targets]
type = "reach"
heights = [1.0, 2.5, 1.5]
per_height = 2
dither = 0.01
orientations = ["horizontal"]
conditions = ["nominal", "randomised"]
[randomization]
leg_q = 0.1
[noise]
gravity = 0.05
"""


@pytest.fixture(scope="module")
def smoke() -> EpisodeManifest:
    return build_manifest(SMOKE)


@pytest.fixture
def frozen(smoke: EpisodeManifest, tmp_path: Path) -> Path:
    """The manifest of `smoke_v1`, written and recorded in a folder of its own."""
    path = tmp_path / "smoke_v1.parquet"
    record(smoke, path)
    return path


def record(manifest: EpisodeManifest, path: Path) -> None:
    write_manifest(manifest, SMOKE, path)
    path.with_suffix(".sha256").write_text(hashlib.sha256(path.read_bytes()).hexdigest())


def same(a: EpisodeManifest, b: EpisodeManifest) -> bool:
    return all(
        np.array_equal(x, y) if x.dtype == object else np.array_equal(x, y, equal_nan=True)
        for x, y in zip(vars(a).values(), vars(b).values(), strict=True)
    )


def test_what_is_written_is_what_is_read(smoke: EpisodeManifest, frozen: Path) -> None:
    manifest, sha256 = read_manifest(SMOKE, frozen)
    assert sha256 == hashlib.sha256(frozen.read_bytes()).hexdigest()
    assert same(manifest, smoke) and len(manifest) == kind_of(SMOKE).num_rows(SMOKE) == 12
    frozen.with_suffix(".sha256").unlink()
    with pytest.raises(ManifestError, match="none recorded"):
        read_manifest(SMOKE, frozen)


def test_freezing_twice_gives_equal_bytes_at_any_number_of_workers(tmp_path: Path) -> None:
    done = []
    files = [tmp_path / f"{k}.parquet" for k in range(2)]
    hashes = [freeze(SMOKE, file, lambda *d: done.append(d), workers=k + 1) for k, file in enumerate(files)]
    assert files[0].read_bytes() == files[1].read_bytes() and hashes[0] == hashes[1]
    assert done[-1] == (12, 12)
    assert files[1].with_suffix(".sha256").read_text() == f"{hashes[1]}  1.parquet\n"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["0.parquet", "0.sha256", "1.parquet", "1.sha256"]


def test_an_altered_manifest_is_refused(frozen: Path) -> None:
    data = bytearray(frozen.read_bytes())
    data[len(data) // 2] ^= 1
    frozen.write_bytes(bytes(data))
    with pytest.raises(ManifestError, match="does not match its hash"):
        read_manifest(SMOKE, frozen)
    checks = verify(SMOKE, frozen)
    assert [check.ok for check in checks] == [False] and "hash" in checks[0].detail


def test_a_manifest_of_another_protocol_is_refused(frozen: Path, tmp_path: Path) -> None:
    file = tmp_path / "other.toml"
    file.write_text(SMOKE_FILE.read_text().replace("ee_pos = 0.01", "ee_pos = 0.02"))
    with pytest.raises(ManifestError, match="was made for protocol digest"):
        read_manifest(read_protocol(file), frozen)
    with pytest.raises(ManifestError, match="wbc-bench protocol freeze"):
        read_manifest(SMOKE, tmp_path / "none.parquet")


def test_an_unwritable_folder_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(ManifestError, match="cannot be written"):
        freeze(SMOKE, tmp_path / "nowhere" / "smoke_v1.parquet")


@pytest.mark.parametrize(
    ("column", "value", "check"),
    [
        ("friction", 2.0, "range of friction"),
        ("leg_q", 0.09, "soles on the ground at reset"),
        ("target_pos_w", 0.5, "witnesses reach their targets"),
        ("feasible_qpos", 0.02, "feasibility of a sample"),
        ("stratum", "step", "counts"),
        ("push_vel", 0.1, "redrawn sample"),
        ("noise_key", 1, "redrawn sample"),
    ],
)
def test_verify_finds_a_false_value(
    smoke: EpisodeManifest, tmp_path: Path, column: str, value: object, check: str
) -> None:
    """Even where whoever altered the manifest made the hash agree."""
    columns = {name: array.copy() for name, array in vars(smoke).items()}
    columns[column][0] = value
    path = tmp_path / "smoke_v1.parquet"
    record(EpisodeManifest(**columns), path)
    failed = {line.name for line in verify(SMOKE, path, sample=12) if not line.ok}
    assert check in failed


@pytest.mark.parametrize(
    ("column", "rows", "value", "message"),
    [
        ("friction", 0, 2.0, r"friction is 0\.\d+ to 2, valid: 0.4 to 1"),
        ("friction", 0, np.nan, "friction holds a number that is not finite"),
        ("base_mass", slice(None), 0.5, "base_mass of episode 0/0 is not what the protocol's seed draws"),
        ("kp_scale", slice(None), 1.0, "kp_scale of episode 0/0 is not what"),
        ("noise_key", 3, 1, "noise_key of episode 0/3 is not what"),
        ("noise_key", 3, -1, "noise_key is -1, valid: 0 or more"),
        ("noise_scale", 0, 0.0, "noise_scale is 0 to 1, valid: 1 to 1"),
        ("base_height", slice(None), 0.9, "base_height of episode 0/0"),
        ("target_quat_w", 2, 0.5000001, "target quaternion is"),
        ("target_pos_w", 1, 57.3, "height is not that of the target"),
        ("target_pos_w", (1, 0), 57.3, "outside the protocol's box"),
        ("height", 0, 0.5, "height is not that of the target"),
        ("feasible_qpos", 0, np.nan, "feasible_qpos holds a number that is not finite"),
        ("feasible_qpos", 0, 0.1, "feasible_qpos has a quaternion whose norm is not 1"),
        ("push_time", 0, np.inf, "push_time"),
        ("push_vel", 0, 9.0, "push_vel is"),
        ("stratum", 0, "step", "strata"),
        ("stratum", 0, "moon", "strata"),
        ("condition", 0, "nominal", "conditions and orientations belong to reach targets"),
        ("episode", 0, 1, "episode does not count the rows"),
        ("replicate", slice(None), 0, "replicate does not count the rows"),
    ],
)
def test_a_value_that_the_protocol_cannot_draw_is_refused_when_read(
    smoke: EpisodeManifest,
    tmp_path: Path,
    column: str,
    rows: int | tuple[int, int] | slice,
    value: object,
    message: str,
) -> None:
    """Even where the hash agrees."""
    columns = {name: array.copy() for name, array in vars(smoke).items()}
    columns[column][rows] = value
    path = tmp_path / "smoke_v1.parquet"
    record(EpisodeManifest(**columns), path)
    with pytest.raises(ManifestError, match=message) as caught:
        read_manifest(SMOKE, path)
    assert str(path) in str(caught.value)


def test_other_columns_types_and_counts_are_refused(smoke: EpisodeManifest, frozen: Path) -> None:
    table = pq.read_table(frozen)

    def refused(changed: pa.Table, message: str) -> None:
        pq.write_table(changed, frozen)
        frozen.with_suffix(".sha256").write_text(hashlib.sha256(frozen.read_bytes()).hexdigest())
        with pytest.raises(ManifestError, match=message):
            read_manifest(SMOKE, frozen)

    place = table.column_names.index("friction")
    refused(table.drop_columns(["friction"]), "has columns .*valid: .*friction")
    refused(table.append_column("more", table["friction"]), r"\(12, 22\), valid: \(12, 21\)")
    refused(table.slice(0, 11), r"\(11, 21\), valid: \(12, 21\)")
    refused(pa.concat_tables([table, table]), r"\(24, 21\), valid")
    refused(
        table.set_column(place, "friction", table["friction"].cast("float32")),
        "friction is of type float, valid: double",
    )
    place = table.column_names.index("leg_q")
    shorter = pa.array([row[:7] for row in table["leg_q"].to_pylist()], pa.list_(pa.float64(), 7))
    refused(table.set_column(place, "leg_q", shorter), r"leg_q is of type .*\[7\], valid: .*\[8\]")
    place = table.column_names.index("stratum")
    empty = pa.array([None, *table["stratum"].to_pylist()[1:]])
    refused(table.set_column(place, "stratum", empty), "stratum has empty cells")


def test_labels_of_a_ladder_are_checked(tmp_path: Path) -> None:
    file = tmp_path / "ladder.toml"
    file.write_text(LITTLE_LADDER)
    protocol = read_protocol(file)
    whole = build_manifest(protocol)
    path = manifest_path(file)
    for column, value, message in (
        ("height", 1.5, "height of some episodes"),
        ("orientation", "free", "orientation of some episodes"),
        ("condition", "randomised", "condition of some episodes"),
        ("target_pos_w", 2.0, "not within 0.01 m of its height"),
    ):
        columns = {name: array.copy() for name, array in vars(whole).items()}
        columns[column][0] = value
        write_manifest(EpisodeManifest(**columns), protocol, path)
        path.with_suffix(".sha256").write_text(hashlib.sha256(path.read_bytes()).hexdigest())
        with pytest.raises(ManifestError, match=message):
            read_manifest(protocol, path)


def test_a_stratum_that_the_box_does_not_hold_is_an_error(tmp_path: Path, monkeypatch) -> None:
    file = tmp_path / "far.toml"
    file.write_text(SMOKE_FILE.read_text().replace("x = [-0.8, 0.8]", "x = [7.0, 8.0]"))
    monkeypatch.setattr("wbc_bench.episodes.workspace_targets.MAX_ATTEMPTS", 50)
    with pytest.raises(ProtocolError, match=r"none of 50 poses .* 'arm' .* at `\$\.targets`"):
        build_manifest(read_protocol(file))


def test_a_ladder_of_heights(tmp_path: Path) -> None:
    file = tmp_path / "ladder.toml"
    file.write_text(LITTLE_LADDER)
    protocol = read_protocol(file)
    freeze(protocol, manifest_path(file))
    manifest, _ = read_manifest(protocol, manifest_path(file))
    assert all(check.ok for check in verify(protocol, manifest_path(file)))
    assert manifest.condition.tolist() == ["nominal"] * 4 + ["randomised"] * 4
    assert manifest.height.tolist() == [1.0, 1.0, 2.5, 2.5] * 2
    # both conditions meet the same targets
    np.testing.assert_array_equal(manifest.target_pos_w[:4], manifest.target_pos_w[4:])
    np.testing.assert_array_equal(manifest.target_quat_w, [[1, 0, 0, 0]] * 8)  # horizontal
    assert (np.abs(manifest.target_pos_w[:, 2] - manifest.height) <= 0.01).all()
    assert (np.abs(manifest.target_pos_w[:, 1]) <= 0.01).all()
    beyond = manifest.stratum == BEYOND
    assert beyond.tolist() == [False, False, True, True] * 2
    assert (
        np.isnan(manifest.feasible_qpos[beyond]).all() and np.isfinite(manifest.feasible_qpos[~beyond]).all()
    )
    # no pose at 2.5 m: the one of 1.0 m is lifted
    assert (np.abs(manifest.target_pos_w[2, 0] - manifest.target_pos_w[0, 0]) <= 0.02).all()
    nominal = manifest.condition == "nominal"
    assert manifest.noise_scale.tolist() == [0, 0, 0, 0, 1, 1, 1, 1]
    assert not manifest.leg_q[nominal].any() and manifest.leg_q[~nominal].any(axis=1).all()


def test_every_released_protocol_has_its_manifest() -> None:
    for name in protocol_names():
        protocol, path = find_protocol(name)
        manifest, _ = read_manifest(protocol, manifest_path(path))
        assert len(manifest) == kind_of(protocol).num_rows(protocol)
    assert not list(PROTOCOLS.glob(".*"))


@pytest.mark.parametrize("name", ["smoke_v1", "ablation_v1", "tuning_v1"])
def test_released_manifests_verify(name: str) -> None:
    protocol, path = find_protocol(name)
    failed = [check for check in verify(protocol, manifest_path(path), sample=6) if not check.ok]
    assert failed == []


def test_the_families_share_their_targets() -> None:
    def targets(name: str) -> EpisodeManifest:
        protocol, path = find_protocol(name)
        return read_manifest(protocol, manifest_path(path))[0].of_replicate(0, 300)

    for family in (
        ("ablation_v1", "nopush_v1", "nominal_v1"),
        ("tuning_v1", "tuning_nopush_v1", "tuning_nominal_v1"),
    ):
        first, *others = [targets(name) for name in family]
        for other in others:
            np.testing.assert_array_equal(other.target_pos_w, first.target_pos_w)
            np.testing.assert_array_equal(other.feasible_qpos, first.feasible_qpos)
        np.testing.assert_array_equal(others[0].friction, first.friction)
        assert len(set(first.stratum[:3])) == 3 and (first.stratum[:3] == first.stratum[3:6]).all()


def test_a_released_manifest_is_never_written(capsys, tmp_path):
    path = PROTOCOLS / "smoke_v1.parquet"
    before = path.read_bytes()
    with pytest.raises(ManifestError, match="released and never written anew"):
        freeze(SMOKE, path)
    assert path.read_bytes() == before and not list(PROTOCOLS.glob(".smoke*"))


def test_a_protocol_of_ones_own_may_not_bear_a_released_name(tmp_path):
    text = SMOKE_FILE.read_text()
    file = tmp_path / "mine.toml"
    file.write_text(text)
    assert find_protocol(str(file))[0] == SMOKE  # a copy asks the same
    file.write_text(text.replace("seed = ", "seed = 1"))
    with pytest.raises(ProtocolError, match=r"'smoke_v1' is the name of a released.*`\$\.name`"):
        find_protocol(str(file))


def test_links_in_a_circle_are_a_manifest_that_does_not_exist(tmp_path):
    protocol, _ = find_protocol("smoke_v1")
    circle = tmp_path / "smoke_v1.parquet"
    circle.symlink_to(circle)
    with pytest.raises(ManifestError, match="does not exist: make it with"):
        read_manifest(protocol, circle)


@pytest.mark.parametrize("value", [1e300, np.inf, np.nan])
def test_a_configuration_out_of_this_world_is_a_violation(value):
    protocol, path = find_protocol("smoke_v1")
    manifest, _ = read_manifest(protocol, manifest_path(path))
    limits = protocol.termination
    solver = static_solver(protocol.robot, 0.02, limits.tilt, limits.base_height)
    for column in (0, 3, 12):
        qpos = manifest.feasible_qpos[0].copy()
        qpos[column] = value
        assert solver.violations(qpos)
