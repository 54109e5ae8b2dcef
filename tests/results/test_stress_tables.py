"""Tables, figure and report section of a severity ladder."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from climbs import climb, factor, ladder, made_up
from tiny_ladder import write_ladder
from wbc_bench.episodes.ladder import find_ladder
from wbc_bench.errors import StoreError
from wbc_bench.evaluation.stress import evaluate_stress
from wbc_bench.evaluation.workers import Engine
from wbc_bench.publish import publish
from wbc_bench.results.figures.stress import write_stress_figure
from wbc_bench.results.margins import analyse
from wbc_bench.results.store import ResultStore
from wbc_bench.results.stress import RECORD, Stress
from wbc_bench.results.tables.stress import (
    breaking_table,
    curve_table,
    difference_table,
    margin_table,
    write_stress_tables,
)

TWO = Stress(
    ladder(factor("payload", 0.0, 1.0, 2.0, 4.0), factor("slope", 0.0, 0.1, unit="rad")),
    (
        climb("a", 16, payload=[16, 12, 8, 4], slope=[16, 16]),
        climb("b", 16, payload=[16, 16, 16, 16]),
        climb("none", 0, payload=[0, 0, 0, 0], slope=[0, 0]),
    ),
)
FOUND = analyse(TWO)


def test_breaking_points_are_grouped_by_factor():
    rows = breaking_table(TWO, FOUND).rows
    assert [row[:4] for row in rows] == [
        ("Payload (kg) 0 to 4", "a", "80.0", "20.0"),
        ("", "b", "80.0", "80.0"),
        ("", "none", "0.0", "0.0"),
        ("Slope (rad) 0 to 0.1", "a", "80.0", "80.0"),
        ("", "none", "0.0", "0.0"),
    ]
    assert rows[0][4].startswith("2 [") and rows[0][5].startswith("0.56 [")
    assert rows[1][4:] == ("not reached [not reached, not reached]", "1.00 [1.00, 1.00]")
    assert rows[2][4:] == ("–", "–")
    data = breaking_table(TWO, FOUND).data
    assert data["breaking"].tolist()[:2] == [2.0, np.inf] and np.isnan(data["breaking"][2])


def test_margins_say_how_many_factors_they_are_over():
    rows = margin_table(TWO, FOUND).rows
    assert [(row[0], row[1], row[3]) for row in rows] == [
        ("a", "20", "2/2"),
        ("b", "20", "1/2"),
        ("none", "20", "2/2"),
    ]
    assert rows[0][4].startswith("0.78 [") and rows[1][4] == "1.00 [1.00, 1.00]" and rows[2][4] == "–"


def test_differences_are_over_what_both_have():
    rows = difference_table(TWO).rows
    assert [row[:3] for row in rows] == [
        ("a vs b", "20", "1"),
        ("a vs none", "20", "2"),
        ("b vs none", "20", "1"),
    ]
    assert rows[0][3].startswith("−0.44 [−") and rows[1][3] == "–"


def test_curves_have_a_row_for_every_level_and_controller():
    table = curve_table(TWO, FOUND)
    assert table.rows[0][:2] == ("Base", "") and table.rows[1][:3] == ("Payload (kg)", "0", "80 [58, 92]")
    assert table.rows[5][:2] == ("Slope (rad)", "0") and table.rows[5][3] == "–"
    data = table.data
    assert len(data) == 3 + 3 * 4 + 2 * 2
    here = data[(data["factor"] == "payload") & (data["controller"] == "a")]
    assert here["success_rate"].tolist() == [0.8, 0.6, 0.4, 0.2] == here["fit"].tolist()


def test_equal_records_give_equal_files(tmp_path):
    stress = made_up()
    turned = replace(stress, climbs=tuple(replace(one) for one in stress.climbs))
    for name, each in (("a", stress), ("b", turned)):
        write_stress_tables(each, analyse(each), tmp_path / name)
        write_stress_figure(each, analyse(each), tmp_path / name)
    files = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert {"made.md", "made_breaking.tex", "made_curves.csv", "made_pairs.md", "made_ladders.svg"} <= set(
        files
    )
    for name in files:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    curves = pd.read_csv(tmp_path / "a" / "made_curves.csv")
    assert set(curves["controller"]) == {"c0", "c1", "c2"}


def test_margins_of_the_made_up_controllers_rank_by_skill():
    margins = [result.margin.point for result in analyse(made_up()).values()]
    assert all(0 < margin <= 1.1 for margin in margins)


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("climbed")
    evaluate_stress(["hold"], find_ladder(str(write_ladder(folder))), folder / "out", Engine())
    return folder / "out"


def test_a_report_is_made_of_the_records_alone(evaluated, tmp_path):
    made = [publish(ResultStore(evaluated), tmp_path / name) for name in ("a", "b")]
    names = [path.relative_to(tmp_path / "a") for path in made[0]]
    assert [str(name) for name in names] == [
        *("figures/climb_ladders.png", "figures/climb_ladders.svg", "report.html"),
        *(
            f"tables/climb{part}.{end}"
            for part in ("", "_breaking", "_curves")
            for end in ("csv", "md", "tex")
        ),
    ]
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    text = (tmp_path / "a" / "report.html").read_text()
    assert ">climb</h2>" in text and "climb: breaking points" in text and '<h2 id="s1">Where' in text
    assert "24 episodes" in text


def test_names_of_ladders_and_protocols_must_differ(evaluated, tmp_path):
    folder = tmp_path / "stress" / "ablation_v1"
    folder.mkdir(parents=True)
    record = (evaluated / "stress" / "climb" / RECORD).read_text()
    source = evaluated / "stress" / "climb" / "runs"
    for path in source.rglob("*"):
        if path.is_file():
            copy = folder / "runs" / path.relative_to(source)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(path.read_bytes())
    (folder / RECORD).write_text(record)
    with pytest.raises(StoreError, match="is the folder a copy"):
        publish(ResultStore(tmp_path), tmp_path / "out")
    (folder / RECORD).write_text(record.replace('"name": "climb"', '"name": "ablation_v1"'))
    with pytest.raises(StoreError, match="ladder 'ablation_v1' has the name of"):
        publish(ResultStore(tmp_path), tmp_path / "out")
