"""Tables: numbers against hand arithmetic, counts that add up, text that says what is missing."""

import io

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from rich.console import Console

from synthetic import FakeRun, FakeStore, frame_of, methods_in, reach_store, record, study_store
from wbc_bench.errors import StoreError, UnknownNameError
from wbc_bench.outcomes import SuccessRule
from wbc_bench.results import analysis, stats
from wbc_bench.results.figures.study import error_cdf
from wbc_bench.results.formatting import NONE
from wbc_bench.results.gallery import order_text
from wbc_bench.results.study import find_study, methods_of
from wbc_bench.results.table import Table, read_markdown
from wbc_bench.results.tables.pairs import compare_table, pair_table
from wbc_bench.results.tables.paper import paper_table
from wbc_bench.results.tables.reach import height_table, reach_table
from wbc_bench.results.tables.strata import outcome_table
from wbc_bench.results.tables.write import write_compare_table, write_reach_tables, write_study_tables

ABLATION = find_study("ablation_v1")
REACH = find_study("reach_v1")
RULE = SuccessRule()


@pytest.fixture(autouse=True)
def few_resamples(monkeypatch):
    monkeypatch.setattr(stats, "RESAMPLES", 200)  # these tests read the tables, not the intervals


def small_store() -> FakeStore:
    """Two replicates of four episodes of `ik`, one of them a fall far away."""
    runs = []
    for replicate, near in ((0, 0.01), (1, 0.03)):
        outcome = np.array(["success", "success", "missed", "fell"], dtype=object)
        frame = frame_of(
            *(replicate, outcome),
            position_error=[near, near, 0.06, 1.0],
            orientation_error=np.deg2rad([1.0, 1.0, 4.0, 90.0]),
            action_variation=[0.1, 0.2, 0.3, 9.0],
        )
        runs.append(FakeRun(record("ik", replicate, frame), frame))
    return FakeStore(runs)


def cells(table: Table, method: str) -> dict[str, str]:
    row = next(row for row in table.rows if method in row)
    return dict(zip(table.header, row, strict=True))


def test_the_papers_columns_by_hand():
    row = cells(paper_table(ABLATION, methods_in(small_store())), "Whole-body IK")
    assert row["Episodes"] == "8/8" and row["Errors over"] == "6"
    assert row["Success ↑ (%)"] == "50.00 ± 0.00"
    # Means without the fall: 8/3 cm and 4 cm; their deviation is half the difference times sqrt 2.
    assert row["Pos. mean ↓ (cm)"] == f"3.33 ± {(4 - 8 / 3) / np.sqrt(2):.2f}"
    # P95 of (1, 1, 6) is 5.5, of (3, 3, 6) is 5.7 (linear between the order statistics).
    assert row["Pos. P95 ↓ (cm)"] == "5.60 ± 0.14"
    assert row["Ori. mean ↓ (deg)"] == "2.00 ± 0.00"
    assert row["Action variation ↓"] == "0.200 ± 0.000"


def test_falls_count_in_the_second_table():
    row = cells(paper_table(ABLATION, methods_in(small_store()), terminated=True), "Whole-body IK")
    assert row["Errors over"] == "8" and row["Success ↑ (%)"] == "50.00 ± 0.00"
    assert row["Pos. mean ↓ (cm)"].startswith(f"{(27 + 28) / 2:.2f}")


def test_the_papers_numbers_stand_beside_ours_and_absence_has_a_reason():
    table = paper_table(ABLATION, methods_in(small_store()))
    k = next(k for k, row in enumerate(table.rows) if "Matched additive" in row)
    assert "not evaluated: no checkpoint" in table.rows[k]
    assert "82.73 ± 0.93" in table.rows[k + 1] and "14.35 ± 0.25" in table.rows[k + 1]
    assert "not evaluated: no run" in next(row for row in table.rows if "Hold posture" in row)


def test_one_replicate_has_no_deviation():
    store = FakeStore(small_store().all_runs[:1])
    assert cells(paper_table(ABLATION, methods_in(store)), "Whole-body IK")["Success ↑ (%)"] == "50.00"


def test_missing_episodes_show():
    frame = frame_of(0, np.array(["success"] * 4, dtype=object))
    store = FakeStore([FakeRun(record("ik", 0, frame, requested=10), frame)])
    assert cells(paper_table(ABLATION, methods_in(store)), "Whole-body IK")["Episodes"] == "4/10"


def test_a_method_that_always_falls_has_no_error_rather_than_zero():
    frame = frame_of(0, np.array(["fell"] * 4, dtype=object))
    store = FakeStore([FakeRun(record("ik", 0, frame), frame)])
    row = cells(paper_table(ABLATION, methods_in(store)), "Whole-body IK")
    assert row["Pos. mean ↓ (cm)"] == NONE and row["Success ↑ (%)"] == "0.00"


def test_more_signals_than_the_paper_are_marked():
    frame = frame_of(0, np.array(["success"] * 4, dtype=object))
    signals = ["base_pose", "ee_pose", "proprioception"]
    table = paper_table(
        ABLATION, methods_in(FakeStore([FakeRun(record("ik", 0, frame, signals=signals), frame)]))
    )
    assert any("Whole-body IK †" in row for row in table.rows)
    assert any("Whole-body IK: base_pose" in note for note in table.notes)
    assert not any("†" in note for note in paper_table(ABLATION, methods_in(small_store())).notes)


def test_a_users_controller_joins_the_table():
    frame = frame_of(0, np.array(["success"] * 4, dtype=object))
    store = FakeStore([FakeRun(record("mine:Controller", 0, frame), frame)])
    assert any(
        "Other" in row and "mine:Controller" in row for row in paper_table(ABLATION, methods_in(store)).rows
    )


@pytest.mark.parametrize("changed", ["protocol_digest", "manifest_sha256"])
def test_digests_are_not_mixed(changed):
    frame = frame_of(0, np.array(["success"] * 4, dtype=object))
    other = FakeRun(record("hold", 0, frame, **{changed: "f" * 64}), frame)
    with pytest.raises(StoreError, match="f" * 64):
        paper_table(ABLATION, methods_in(FakeStore([*small_store().all_runs, other])))


def test_outcomes_add_up():
    table = outcome_table(ABLATION, methods_in(study_store()))
    outcomes = [
        c for c in table.data if c not in ("controller", "stratum", "episodes", "success_rate", "low", "high")
    ]
    assert (table.data[outcomes].sum(axis=1) == table.data["episodes"]).all()
    for _, group in table.data.groupby("controller"):
        strata = group[group["stratum"] != "all"]
        assert strata["episodes"].sum() == group.loc[group["stratum"] == "all", "episodes"].item() == 360


def test_pairs_are_the_studys_own_and_use_the_same_episodes():
    table = pair_table(ABLATION, methods_in(study_store()))
    assert list(table.data["A vs B".lower()]) == [
        f"Whole-body IK vs {name}" for name in ("Hold posture", "IK, kinematic only", "IK on OSQP")
    ]
    first = table.data.iloc[0]
    assert first["success_diff_pp"] > 0 and first["success_p_holm"] >= first["success_p"]
    frames = [methods_in(study_store())[spec].episodes for spec in ("ik", "hold")]
    only = (frames[0]["success"] > frames[1]["success"]).sum()
    assert first["only_a"] == only
    # Two methods with the same outcome on every episode: nothing to tell apart.
    same = table.data.iloc[2]
    assert same["only_a"] == same["only_b"] == 0 and same["success_p"] == 1.0


def test_compare_needs_runs_of_both():
    table = compare_table("ablation_v1", methods_in(study_store()), "ik", "hold")
    assert list(table.data["stratum"]) == ["arm", "posture", "step", "all"]
    with pytest.raises(UnknownNameError, match="nobody"):
        compare_table("ablation_v1", methods_in(study_store()), "ik", "nobody")


def test_markdown_survives_a_round_trip(tmp_path):
    table = outcome_table(ABLATION, methods_in(study_store()))
    table.write(tmp_path)
    back = read_markdown(tmp_path / f"{table.name}.md")
    assert (back.title, back.header, back.rows, back.notes) == (
        table.title,
        table.header,
        table.rows,
        table.notes,
    )


def test_latex_is_escaped_and_balanced():
    packages, text = paper_table(ABLATION, methods_in(study_store())).latex().split("\n", 1)
    assert packages == r"% needs \usepackage{booktabs} and \usepackage{graphicx}"
    body = text.replace(r"\%", "").replace(r"\_", "").replace(r"\&", "")
    assert "%" not in body and "±" not in text and "↑" not in text
    assert text.isascii()
    assert text.count(r"\begin{") == text.count(r"\end{") == 2
    rows = [line for line in text.splitlines() if line.endswith(r"\\")]
    assert {line.replace(r"\&", "").count("&") for line in rows} == {9}


@pytest.mark.parametrize("width", [60, 80, 120, 300])
def test_a_terminal_shows_every_number_and_name(width):
    methods = methods_in(study_store())
    for table in (
        paper_table(ABLATION, methods),
        outcome_table(ABLATION, methods),
        pair_table(ABLATION, methods),
    ):
        output = io.StringIO()
        Console(file=output, width=width).print(table.rich())
        lines = output.getvalue().splitlines()
        assert max(map(len, lines)) <= width and "…" not in output.getvalue()
        shown = [[cell.strip() for cell in line.split("│")] for line in lines]
        cells = {cell for line in shown for cell in line}
        names = next(k for k, number in enumerate(table.numeric) if number)
        for row in table.rows:
            assert set(row[names:]) <= cells  # whole, in one line
            for name in row[:names]:
                # a name may go over two lines of its column
                assert set("".join(name.split())) <= set(output.getvalue())
                assert name in cells or width < 120


def test_same_store_same_bytes(tmp_path):
    for name in ("one", "two"):
        write_study_tables(ABLATION, methods_in(study_store(count=30)), tmp_path / name)
        write_reach_tables(REACH, methods_in(reach_store(), "reach_v1"), tmp_path / name)
        write_compare_table("ablation_v1", methods_in(study_store()), "ik", "ik:kinematic", tmp_path / name)
    files = sorted(path.name for path in (tmp_path / "one").iterdir())
    assert len(files) == 3 * (5 + 2 + 1)
    assert all((tmp_path / "one" / f).read_bytes() == (tmp_path / "two" / f).read_bytes() for f in files)


# --- reach


def heights(error_cm: list[float], outcome: str = "missed") -> pd.DataFrame:
    rows = [
        frame_of(0, np.array([outcome] * 4, dtype=object), height=0.05 * k, position_error=e / 100)
        for k, e in enumerate(error_cm)
    ]
    return pd.concat(rows, ignore_index=True)


def test_the_range_is_the_longest_run_of_neighbours():
    span = analysis.reach_range(heights([1, 9, 1, 1, 4.9, 5.1, 1, 1]), RULE)
    assert (span.low, span.high) == pytest.approx((0.10, 0.20)) and span.reached == 6


def test_nothing_reached_is_no_range():
    span = analysis.reach_range(heights([9, 9]), RULE)
    assert np.isnan(span.low) and span.reached == 0


def test_a_height_at_which_half_fell_is_not_reached():
    frame = heights([1.0])
    assert analysis.reached(frame, RULE)
    assert analysis.reached(frame.assign(outcome=["fell", "missed", "missed", "missed"]), RULE)
    assert not analysis.reached(frame.assign(outcome=["fell", "fell", "missed", "missed"]), RULE)
    assert not analysis.reached(frame.assign(position_error=np.nan), RULE)


def test_strict_range_asks_for_success():
    frame = pd.concat(
        [heights([1, 1]), heights([1, 1, 1], "success").assign(height=[0.1] * 4 + [0.15] * 4 + [0.2] * 4)]
    )
    assert analysis.reach_range(frame, RULE).low == 0.0
    assert analysis.reach_range(frame, RULE, strict=True)[:2] == pytest.approx((0.10, 0.20))


def test_oscillation_near_the_ends():
    frame = heights([1.0] * 21).assign(ee_speed_rms=np.repeat(np.linspace(0.0, 0.2, 21), 4))
    span = analysis.reach_range(frame, RULE)
    low, middle, high = analysis.oscillation(frame, span, "ee_speed_rms")
    assert (low, middle, high) == pytest.approx((0.01, 0.10, 0.19))


def test_reach_table_has_the_papers_ranges_and_the_grid():
    table = reach_table(REACH, methods_in(reach_store(), "reach_v1"))
    assert [row[5] for row in table.rows] == ["38–163", "3–191", "5–185", "5–185", "5–125", "5–125"]
    assert len(height_table(REACH, methods_in(reach_store(), "reach_v1")["ik"]).rows) == 41


def test_the_rule_that_is_printed_and_applied_is_that_of_the_records():
    rule = SuccessRule(position=0.02, orientation=np.radians(3.0), window=0.5, horizon=4.0)
    frame = heights([1, 3, 1, 1])
    methods = methods_in(FakeStore([FakeRun(record("ik", 0, frame, rule=rule), frame)]))
    reach = reach_table(REACH, methods)
    assert reach.rows[-1][5] == "10–15"  # 3 cm is not within 2 cm
    for table in (reach, paper_table(ABLATION, methods), height_table(REACH, methods["ik"])):
        text = " ".join(table.notes)
        assert "final 0.5 s" in text and "1 s" not in text.replace("0.5 s", "") and "5 cm" not in text
    assert "inside 2 cm and 3 deg" in " ".join(reach.notes)
    assert "final 0.5 s of 4 s" in " ".join(paper_table(ABLATION, methods).notes)
    assert "last 0.5 s" in " ".join(paper_table(ABLATION, methods, terminated=True).notes)
    label = error_cdf(Figure().subplots(), methods_of(ABLATION, methods), "orientation_error").get_xlabel()
    assert "final 0.5 s" in label
    text = order_text(rule)
    assert "final 0.5 s" in text and "2 cm" in text and "3°" in text
