"""The report: one self-contained file with every table, figure and run."""

import re
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from synthetic import FakeStore, methods_in, reach_store, record, study_store
from wbc_bench.errors import StoreError
from wbc_bench.results import gallery, report, stats
from wbc_bench.results.analysis import collect_all
from wbc_bench.results.figures.reach import write_reach_figures
from wbc_bench.results.study import find_study
from wbc_bench.results.tables.write import write_reach_tables, write_study_tables

ABLATION = find_study("ablation_v1")
REACH = find_study("reach_v1")


@pytest.fixture(autouse=True)
def few_resamples(monkeypatch):
    monkeypatch.setattr(stats, "RESAMPLES", 200)  # these tests read the tables, not the intervals


def full_store() -> FakeStore:
    return FakeStore(study_store(count=30).all_runs + reach_store().all_runs)


def report_of(store: FakeStore, made: Path, beside: Path | None = None) -> str:
    """The page that is written of a store."""
    return report.write(collect_all(store.runs()), made, beside).read_text(encoding="utf-8")


def test_report_holds_everything_and_loads_nothing(tmp_path):
    store = full_store()
    write_study_tables(ABLATION, methods_in(store), tmp_path / "tables")
    write_reach_tables(REACH, methods_in(store, "reach_v1"), tmp_path / "tables")
    write_reach_figures(REACH, methods_in(store, "reach_v1"), tmp_path / "figures")
    path = report.write(collect_all(store.runs()), tmp_path)
    text = path.read_text(encoding="utf-8")
    assert path == tmp_path / "report.html"
    assert "88.30 ± 2.50" in text and "Whole-body IK vs Hold posture" in text and "38–163" in text
    assert text.count("<img ") == 1 and "data:image/svg+xml;base64," in text
    # Nothing is fetched: every source is inside, every link stays on the page.
    assert all(source.startswith("data:") for source in re.findall(r'src="([^"]*)"', text))
    assert all(link.startswith("#") for link in re.findall(r'href="([^"]*)"', text))
    assert text.count("Worst episodes of") == 5 and "wbc-bench replay ablation_v1/ik/replicate_" in text
    assert text.count("d" * 12) >= 12 and "a" * 64 in text  # a digest a run
    before = path.read_bytes()
    assert report.write(collect_all(store.runs()), tmp_path).read_bytes() == before


def test_each_table_stands_under_its_own_protocol(tmp_path):
    store = full_store()
    write_study_tables(ABLATION, methods_in(store), tmp_path / "tables")
    write_reach_tables(REACH, methods_in(store, "reach_v1"), tmp_path / "tables")
    text = report_of(store, tmp_path)
    ablation, reach = text.index('<h2 id="s0">ablation_v1'), text.index('<h2 id="s1">reach_v1')
    assert ablation < text.index("Whole-body IK vs Hold posture") < reach < text.index("38–163")


def test_an_empty_store_says_so(tmp_path):
    assert "No run yet" in report.write(collect_all(FakeStore([]).runs()), tmp_path).read_text(
        encoding="utf-8"
    )


def test_dirty_trees_and_markup_in_records_show_as_text(tmp_path):
    run = study_store(count=4, replicates=1).all_runs[0]
    dirty = type(run)(record("<b>mine</b>", 0, run.frame, git_dirty=True), run.frame)
    text = report_of(FakeStore([dirty]), tmp_path)
    assert "uncommitted changes" in text
    assert "<b>mine</b>" not in text and "&lt;b&gt;mine" in text and "&lt;made up&gt;" in text


def picture(path, caption: str = "") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Figure(figsize=(1, 1)).savefig(path)
    if caption:
        path.with_suffix(".txt").write_text(caption, encoding="utf-8")


def test_figures_that_no_record_makes_are_shown_with_their_captions(tmp_path):
    made, beside = tmp_path / "made", tmp_path / "out"
    picture(beside / "figures" / "strip_fall.png", "A <fall> in ten frames")
    picture(beside / "figures" / "latent_a.png")
    (beside / "figures" / "latent_a.json").write_text('{"caption": "Two clusters", "accuracy": 0.5}')
    picture(beside / "figures" / "old_success.png")  # of an earlier report: not given, and not made now
    text = report_of(full_store(), made, beside)
    assert "A &lt;fall&gt; in ten frames" in text and "Two clusters" in text and "old_success" not in text
    assert text.index("Successive frames</h2>") < text.index("strip_fall") < text.index("Latent spaces</h2>")
    assert text.count("<img ") == 2


def test_a_caption_that_cannot_be_read_is_named(tmp_path):
    picture(tmp_path / "figures" / "strip_a.png")
    (tmp_path / "figures" / "strip_a.json").write_text('{"title": "a"}')
    with pytest.raises(StoreError, match=r"strip_a\.png.*caption"):
        report.write(collect_all(full_store().runs()), tmp_path)


def test_a_replay_beside_the_report_is_linked(tmp_path):
    frame = study_store(count=4, replicates=1).all_runs[0].frame
    page = tmp_path / gallery.replay_path("ablation_v1", "hold", 0, int(frame["episode"].iloc[0]))
    page.parent.mkdir(parents=True)
    page.write_text("")
    store = FakeStore(study_store(count=4, replicates=1).all_runs[:1])
    text = report.write(collect_all(store.runs()), tmp_path / "made", tmp_path).read_text(encoding="utf-8")
    assert re.findall(r'<a href="(replays[^"]*)"', text) == [page.relative_to(tmp_path).as_posix()]
