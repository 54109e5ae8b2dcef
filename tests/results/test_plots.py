"""Figures: the same bytes for the same store, axes returned, curves that end where the episodes did."""

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from synthetic import FakeStore, methods_in, reach_store, study_store
from wbc_bench.results import analysis
from wbc_bench.results.figures.reach import write_reach_figures
from wbc_bench.results.figures.study import error_cdf, outcome_bars, success_by_stratum, write_study_figures
from wbc_bench.results.figures.style import BLACK, BLUE, controller_colours
from wbc_bench.results.figures.targets import write_targets
from wbc_bench.results.study import Row, find_study, methods_of, released_rows

ABLATION = find_study("ablation_v1")
REACH = find_study("reach_v1")


def targets() -> pd.DataFrame:
    rng = np.random.default_rng(0)
    stratum = np.array(["arm", "posture", "step"])[rng.integers(0, 3, 90)]
    x, y, height = rng.uniform(0.2, 1.0, 90), rng.uniform(-0.5, 0.5, 90), rng.uniform(0.1, 1.8, 90)
    return pd.DataFrame({"target_x": x, "target_y": y, "height": height, "stratum": stratum})


def methods() -> list[tuple[str, analysis.Evaluated]]:
    return methods_of(ABLATION, methods_in(study_store()))


def test_same_store_same_bytes(tmp_path):
    for folder in (tmp_path / "one", tmp_path / "two"):
        write_reach_figures(REACH, methods_in(reach_store(), "reach_v1"), folder)
        write_targets(targets(), "ablation_v1", folder)
    files = sorted(path.name for path in (tmp_path / "one").iterdir())
    assert len(files) == 2 * 2
    for name in files:
        data = (tmp_path / "one" / name).read_bytes()
        assert data == (tmp_path / "two" / name).read_bytes(), name


def test_files_of_a_study_carry_no_date_and_no_program(tmp_path):
    paths = write_study_figures(ABLATION, methods_in(study_store()), tmp_path)
    assert len(paths) == 2 * 3
    for path in paths:
        data = path.read_bytes()
        assert b"dc:date" not in data and b"Software" not in data and b"Matplotlib v" not in data


def test_nothing_to_draw_writes_nothing(tmp_path):
    assert write_study_figures(ABLATION, methods_in(FakeStore([])), tmp_path) == []
    assert write_reach_figures(REACH, methods_in(FakeStore([]), "reach_v1"), tmp_path) == []


def test_a_plot_returns_its_axes():
    ax = Figure().subplots()
    assert success_by_stratum(ax, methods()) is ax
    assert outcome_bars(Figure().subplots(), methods()).get_title()


def test_outcome_bars_add_up_to_100():
    ax = outcome_bars(Figure().subplots(), methods())
    bars = [bar for container in ax.containers for bar in container]
    assert sum(bar.get_width() for bar in bars) == pytest.approx(100.0 * len(methods()))


def test_a_cdf_ends_at_the_share_that_stood():
    ax = error_cdf(Figure().subplots(), methods(), "position_error")
    for line, (_, method) in zip(ax.get_lines(), methods(), strict=False):
        assert np.asarray(line.get_ydata())[-1] == pytest.approx(100.0 * method.not_terminated.mean())


def test_a_study_may_say_the_colour_of_a_name():
    rows = [Row("", "Mine", "mine", colour="blue"), Row("", "Old", "old")]
    colours = controller_colours({"mine": "Mine", "mine@0": "Mine", "b": "Other", "old": "Old"}, rows)
    assert colours["mine"] == colours["mine@0"] == BLUE
    assert len({colours["mine"], colours["b"], colours["old"]}) == 3


def test_released_studies_agree_on_the_colour_of_a_name():
    found: dict[str, set[str]] = {}
    for row in released_rows():
        if row.colour:
            found.setdefault(row.label, set()).add(row.colour)
    assert found and all(len(colours) == 1 for colours in found.values())
    assert controller_colours({"ik": "Whole-body IK"}) == {"ik": BLACK}  # also where nobody else is drawn


def test_a_controller_keeps_its_colour_whoever_else_is_drawn():
    names = {"a": "One", "a@0": "One", "b": "Two", "c": "Three"}
    colours = controller_colours(names)
    assert colours["a"] == colours["a@0"] and len(set(colours.values())) == 3
    assert colours == controller_colours(dict(reversed(names.items())))
    labels = {method.spec: label for label, method in methods()}
    mapping = controller_colours(labels)
    for chosen in (methods(), methods()[1:], methods()[:2]):
        ax = error_cdf(Figure().subplots(), chosen, "position_error", mapping)
        drawn = {line.get_label(): line.get_color() for line in ax.get_lines()}
        assert all(drawn[label] == mapping[method.spec] for label, method in chosen)


def test_no_two_controllers_share_a_colour_however_many_there_are() -> None:
    from wbc_bench.results.figures.style import METHOD_COLOURS, controller_colours

    found = controller_colours({f"c{k:02d}": f"name {k:02d}" for k in range(20)}, [])
    assert len(set(found.values())) == 20
    assert tuple(found.values())[: len(METHOD_COLOURS)] == METHOD_COLOURS
