"""The table of public and sealed success, by hand, and its place in the report."""

import numpy as np
import pytest

from runs import evaluated as run_smoke
from synthetic import FakeRun, frame_of, record
from wbc_bench.episodes.protocol import find_protocol
from wbc_bench.episodes.sealed import seal
from wbc_bench.evaluation.evaluate import evaluate
from wbc_bench.outcomes import SuccessRule
from wbc_bench.publish import publish
from wbc_bench.results.analysis import Evaluated, collect_all
from wbc_bench.results.store import ResultStore
from wbc_bench.results.tables.sealed import sealed_table
from wbc_bench.results.tables.write import write_sealed_tables


def fake(protocol: str, spec: str, successes: int, episodes: int, replicate: int = 0, **changes) -> FakeRun:
    outcome = np.array(["success"] * successes + ["missed"] * (episodes - successes), dtype=object)
    frame = frame_of(replicate, outcome)
    sealed = {"protocol_digest": "e" * 64, "manifest_sha256": "b" * 64} if protocol == "p_sealed" else {}
    return FakeRun(record(spec, replicate, frame, protocol=protocol, **sealed | changes), frame)


def methods(*runs: FakeRun) -> dict[str, dict[str, Evaluated]]:
    return collect_all(runs, {"a": "Method A"})


BOTH = [fake("p", "a", 56, 70), fake("p_sealed", "a", 28, 40), fake("p_sealed", "a", 20, 40, replicate=1)]


def test_rates_and_their_difference_by_hand():
    found = methods(*BOTH, fake("p", "b", 7, 10), fake("p_sealed", "c", 7, 10))
    table = sealed_table("p", found["p"], found["p_sealed"])
    row = ("Method A", "70/70", "80.0 [69.2, 87.7]", "80/80", "60.0 [49.0, 70.0]", "+20.0 [+5.2, +33.4]")
    assert table.rows == (row,)  # neither b nor c has runs of both
    assert table.name == "p_public_and_sealed" and any("Method A is `a`" in note for note in table.notes)
    (data,) = table.data.to_dict("records")
    assert (data["public"], data["sealed"], data["sealed_completed"]) == (0.8, 0.6, 80)
    assert [data["difference"], data["low"], data["high"]] == pytest.approx([0.2, 0.0524, 0.3339], abs=5e-5)


@pytest.mark.parametrize(("digest", "marked"), [("1" * 64, False), ("2" * 64, True)])
def test_a_controller_that_changed_in_between_is_marked(digest, marked):
    found = methods(
        fake("p", "a", 5, 10, resolved_controller="a", controller_sha256="1" * 64),
        fake("p_sealed", "a", 5, 10, resolved_controller="a", controller_sha256=digest),
    )
    table = sealed_table("p", found["p"], found["p_sealed"])
    assert table.rows[0][0] == ("Method A ‡" if marked else "Method A")
    assert any(note.startswith("‡") for note in table.notes) == marked
    assert (r"$^\ddagger$" in table.latex()) == marked and table.data["same_files"].tolist() == [not marked]


def test_a_set_with_another_rule_of_success_is_not_compared(tmp_path):
    found = methods(BOTH[0], fake("p_sealed", "a", 5, 10, rule=SuccessRule(position=0.1)))
    assert sealed_table("p", found["p"], found["p_sealed"]).rows == ()
    assert write_sealed_tables(found, tmp_path) == []


def test_tables_are_written_for_protocols_that_have_both(tmp_path):
    paths = write_sealed_tables(methods(*BOTH, fake("q", "a", 5, 10)), tmp_path)
    assert sorted(path.name for path in paths) == [
        f"p_public_and_sealed.{end}" for end in ("csv", "md", "tex")
    ]
    assert write_sealed_tables(methods(*BOTH[:1]), tmp_path) == []


def test_the_report_shows_the_table_beside_the_public_section(tmp_path):
    secret = tmp_path / "secret"
    secret.write_bytes(bytes(range(32)))
    seal(find_protocol("smoke_v1")[0], secret, tmp_path / "kept")
    run_smoke(tmp_path / "out", "hold")
    sealed = str(tmp_path / "kept" / "smoke_v1_sealed.toml")
    evaluate("hold", protocol=sealed, out=tmp_path / "out", workers=1)
    publish(ResultStore(tmp_path / "out"), tmp_path / "out")
    text = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    public, other = text.index(">smoke_v1</h2>"), text.index(">smoke_v1_sealed</h2>")
    assert public < text.index("smoke_v1: success on public and on sealed episodes") < other
    assert (tmp_path / "out" / "tables" / "smoke_v1_public_and_sealed.md").exists()
    assert (tmp_path / "out" / "tables" / "smoke_v1_sealed.md").exists()  # of the sealed runs alone
