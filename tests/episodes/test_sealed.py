"""Sealed episodes: a function of protocol and secret, and a commitment that nothing else satisfies."""

import hashlib
import hmac
from pathlib import Path

import msgspec
import numpy as np
import pytest

from wbc_bench.episodes.ladder import protocol_toml
from wbc_bench.episodes.manifest import EpisodeManifest, manifest_path, read_manifest, write_manifest
from wbc_bench.episodes.protocol import find_protocol, protocol_names, read_protocol
from wbc_bench.episodes.sealed import SealError, read_commitment, reveal, seal, sealed_protocol
from wbc_bench.errors import BenchError, ProtocolError
from wbc_bench.files import PROTOCOLS

SMOKE, SMOKE_FILE = find_protocol("smoke_v1")
SECRET = bytes(range(100, 132))
NAMES = [f"smoke_v1_sealed.{end}" for end in ("commitment.json", "parquet", "sha256", "toml")]


@pytest.fixture(scope="module")
def secret(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("secret") / "secret"
    path.write_bytes(SECRET)
    return path


@pytest.fixture(scope="module")
def kept(secret: Path, tmp_path_factory) -> Path:
    """The sealed set of `smoke_v1`; tests read it only."""
    folder = tmp_path_factory.mktemp("kept")
    seal(SMOKE, secret, folder)
    return folder


@pytest.fixture
def commitment(kept: Path) -> Path:
    return kept / NAMES[0]


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def commit(folder: Path, commitment: Path, **changes: object) -> Path:
    """A commitment with other values."""
    path = folder / "commitment.json"
    path.write_bytes(msgspec.json.encode(msgspec.json.decode(commitment.read_bytes()) | changes))
    return path


def test_all_but_the_draws_is_the_protocols():
    code = hmac.new(SECRET, SMOKE.digest.encode(), hashlib.sha256).hexdigest()
    sealed = sealed_protocol(SMOKE, SECRET)
    assert (sealed.name, sealed.episodes.seed) == ("smoke_v1_sealed", int(code[:16], 16) // 2)
    episodes = msgspec.structs.replace(sealed.episodes, seed=SMOKE.episodes.seed)
    described = {"name": SMOKE.name, "description": SMOKE.description, "episodes": episodes}
    assert msgspec.structs.replace(sealed, **described) == SMOKE


def test_every_released_protocol_can_be_sealed_and_read_back(tmp_path):
    seeds = set()
    for name in protocol_names():
        sealed = sealed_protocol(find_protocol(name)[0], SECRET)
        seeds.add(sealed.episodes.seed)
        path = tmp_path / f"{sealed.name}.toml"
        path.write_text(protocol_toml(sealed))
        assert find_protocol(str(path))[0].digest == sealed.digest
    assert len(seeds) == len(protocol_names())  # also of families that share their targets in public


def test_the_seed_depends_on_secret_and_protocol():
    harder = msgspec.structs.replace(SMOKE, reference_decay=2.0)
    sealed = [sealed_protocol(p, s) for p, s in ((SMOKE, SECRET), (SMOKE, SECRET[::-1]), (harder, SECRET))]
    assert len({protocol.episodes.seed for protocol in sealed}) == 3


def test_equal_bytes_at_any_number_of_workers_and_never_the_secret(kept, secret, tmp_path):
    file, sha256 = seal(SMOKE, secret, tmp_path, workers=2)
    assert names(kept) == names(tmp_path) == NAMES and file == tmp_path / NAMES[0]
    for name in NAMES:
        data = (kept / name).read_bytes()
        assert (tmp_path / name).read_bytes() == data
        assert SECRET not in data and SECRET.hex().encode() not in data
    before = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert seal(SMOKE, secret, tmp_path)[1] == sha256  # again: nothing is written
    assert {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == before
    assert secret.read_bytes() == SECRET


def test_a_sealed_set_is_valid_and_has_no_public_episode(kept):
    path = kept / "smoke_v1_sealed.toml"
    sealed, _ = read_manifest(read_protocol(path), manifest_path(path))
    public, _ = read_manifest(SMOKE, manifest_path(SMOKE_FILE))
    assert len(sealed) == len(public) == 12
    assert not np.isin(sealed.target_pos_w, public.target_pos_w).any()
    assert not np.isin(sealed.noise_key, public.noise_key).any()
    assert not np.isin(sealed.friction, public.friction).any()


def test_a_commitment_tells_the_public_protocol_and_the_hash_alone(kept, commitment):
    sha256 = hashlib.sha256((kept / "smoke_v1_sealed.parquet").read_bytes()).hexdigest()
    assert msgspec.json.decode(commitment.read_bytes()) == {
        **{"protocol": "smoke_v1", "protocol_digest": SMOKE.digest},
        **{"manifest_sha256": sha256, "episodes": 12},
    }
    assert read_commitment(commitment)[1] == SMOKE


@pytest.mark.parametrize("given", [False, True], ids=["drawn anew", "the file"])
def test_revealed_files_are_the_sealed_ones(kept, commitment, secret, tmp_path, given):
    manifest = kept / "smoke_v1_sealed.parquet" if given else None
    path, sha256 = reveal(commitment, secret, tmp_path / "out", manifest=manifest)
    assert path == tmp_path / "out" / "smoke_v1_sealed.toml" and names(tmp_path / "out") == NAMES[1:]
    assert all((path.parent / name).read_bytes() == (kept / name).read_bytes() for name in NAMES[1:])
    assert hashlib.sha256(path.with_suffix(".parquet").read_bytes()).hexdigest() == sha256


def test_a_wrong_secret_is_refused(kept, commitment, tmp_path):
    wrong = tmp_path / "wrong"
    wrong.write_bytes(SECRET[::-1])
    with pytest.raises(SealError, match=r"drawn from '.*wrong' has sha256 .* the commitment says .* secret"):
        reveal(commitment, wrong, tmp_path / "out")
    with pytest.raises(SealError, match="committed one, but was not drawn from this secret"):
        reveal(commitment, wrong, tmp_path / "out", manifest=kept / "smoke_v1_sealed.parquet")
    assert names(tmp_path / "out") == []


def test_a_changed_manifest_is_refused(kept, commitment, secret, tmp_path):
    data = bytearray((kept / "smoke_v1_sealed.parquet").read_bytes())
    data[len(data) // 2] ^= 1
    changed = tmp_path / "changed.parquet"
    changed.write_bytes(data)
    for file in (changed, manifest_path(SMOKE_FILE)):
        with pytest.raises(SealError, match=f"'{file}' has sha256 .* the commitment says .* was changed"):
            reveal(commitment, secret, tmp_path / "out", manifest=file)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("column", "check"), [("target_pos_w", "redrawn sample"), ("friction", "values")])
def test_chosen_episodes_are_refused_even_where_the_owner_committed_to_them(
    kept, commitment, secret, tmp_path, column, check
):
    sealed = sealed_protocol(SMOKE, SECRET)
    honest, _ = read_manifest(sealed, kept / "smoke_v1_sealed.parquet")
    columns = {name: array.copy() for name, array in vars(honest).items()}
    columns[column][3] *= 0.999
    chosen = tmp_path / "chosen.parquet"
    write_manifest(EpisodeManifest(**columns), sealed, chosen)
    false = commit(tmp_path, commitment, manifest_sha256=hashlib.sha256(chosen.read_bytes()).hexdigest())
    with pytest.raises(SealError, match=f"not what the secret draws: .*{check}") as caught:
        reveal(false, secret, tmp_path / "out", manifest=chosen)
    assert "\n" not in str(caught.value)
    assert names(tmp_path / "out") == []


def test_a_set_of_another_processor_is_revealed_by_its_file_alone(kept, commitment, secret, tmp_path):
    """One that rounds the last digits differently."""
    sealed = sealed_protocol(SMOKE, SECRET)
    here, _ = read_manifest(sealed, kept / "smoke_v1_sealed.parquet")
    columns = {name: array.copy() for name, array in vars(here).items()}
    for name in ("target_pos_w", "friction", "leg_q"):
        columns[name].T[0] *= 1 + 1e-13
    there = tmp_path / "there.parquet"
    write_manifest(EpisodeManifest(**columns), sealed, there)
    other = commit(tmp_path, commitment, manifest_sha256=hashlib.sha256(there.read_bytes()).hexdigest())
    with pytest.raises(SealError, match="give the sealed file with --manifest"):
        reveal(other, secret, tmp_path / "out")
    path, _ = reveal(other, secret, tmp_path / "out", manifest=there, sample=12)
    assert path.with_suffix(".parquet").read_bytes() == there.read_bytes()
    read_manifest(read_protocol(path), path.with_suffix(".parquet"))


def test_damage_that_only_the_hash_admits_is_one_line(commitment, secret, tmp_path):
    broken = tmp_path / "broken.parquet"
    broken.write_bytes(b"PAR1")
    false = commit(tmp_path, commitment, manifest_sha256=hashlib.sha256(b"PAR1").hexdigest())
    with pytest.raises(SealError, match=r"'.*broken\.parquet' is damaged or not readable parquet"):
        reveal(false, secret, tmp_path / "out", manifest=broken)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"protocol": "reach_v1"}, "is of protocol reach_v1 with digest .* is reach_v1 with"),
        ({"protocol_digest": "f" * 64}, r"with digest f{16}\.\.\., .* is smoke_v1 with"),
        ({"protocol": "mine"}, "'mine', which is no released protocol: give its file with --protocol"),
        ({"episodes": 13}, "is of 13 episodes, valid: 12"),
        ({"manifest_sha256": "f" * 63}, "damaged or not JSON of this kind"),
        ({"seed": 7}, "damaged or not JSON of this kind"),
    ],
)
def test_a_commitment_of_another_protocol_or_damaged_is_refused(
    commitment, secret, tmp_path, changes, message
):
    with pytest.raises(BenchError, match=message):
        reveal(commit(tmp_path, commitment, **changes), secret, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_protocol_of_ones_own_is_named(secret, tmp_path):
    """A commitment says how it is called, not where it stands."""
    mine, other = tmp_path / "mine.toml", tmp_path / "other.toml"
    text = (
        SMOKE_FILE.read_text()
        .replace('"smoke_v1"', '"mine"')
        .replace("per_replicate = 6", "per_replicate = 3")
    )
    mine.write_text(text)
    other.write_text(text.replace("ee_pos = 0.01", "ee_pos = 0.02"))
    file, sha256 = seal(read_protocol(mine), secret, tmp_path / "kept")
    assert reveal(file, secret, tmp_path / "out", protocol=str(mine))[1] == sha256
    with pytest.raises(SealError, match=r"is of protocol mine with digest .*other\.toml' is mine with"):
        reveal(file, secret, tmp_path / "out", protocol=str(other))


def test_a_secret_that_is_missing_or_too_short_is_refused(tmp_path):
    short = tmp_path / "short"
    short.write_bytes(SECRET[:15])
    with pytest.raises(SealError, match=r"short' has 15 bytes, valid: at least 16"):
        seal(SMOKE, short, tmp_path / "out")
    with pytest.raises(SealError, match=r"secret file '.*none' does not exist"):
        seal(SMOKE, tmp_path / "none", tmp_path / "out")
    with pytest.raises(SealError, match="is not a file"):
        seal(SMOKE, tmp_path, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_sealed_protocol_is_not_sealed_again(kept, secret, tmp_path):
    sealed = read_protocol(kept / "smoke_v1_sealed.toml")
    with pytest.raises(SealError, match="smoke_v1_sealed is sealed already"):
        seal(sealed, secret, tmp_path / "out")
    long = msgspec.structs.replace(SMOKE, name="n" * 114)
    with pytest.raises(ProtocolError, match="cannot name a folder"):
        seal(long, secret, tmp_path / "out")


@pytest.mark.parametrize("name", NAMES)
def test_a_file_of_other_content_is_kept(kept, commitment, secret, tmp_path, name):
    (tmp_path / name).write_text("mine")
    with pytest.raises(SealError, match=f"{name}' has another content and is not overwritten"):
        seal(SMOKE, secret, tmp_path)
    assert names(tmp_path) == [name] and (tmp_path / name).read_text() == "mine"


def test_released_protocols_and_folders_that_cannot_be_written_are_left_alone(secret, tmp_path):
    before = names(PROTOCOLS)
    for folder in (PROTOCOLS, PROTOCOLS / "more"):
        with pytest.raises(SealError, match="that of released protocols"):
            seal(SMOKE, secret, folder)
    assert names(PROTOCOLS) == before
    (tmp_path / "file").touch()
    with pytest.raises(BenchError, match="cannot be written"):
        seal(SMOKE, secret, tmp_path / "file" / "out")
