"""Studies as files: what is read, what is refused in one line, and where the paper's values stand."""

from pathlib import Path

import numpy as np
import pytest

from synthetic import FakeRun, FakeStore, frame_of, methods_in, record
from wbc_bench.errors import UnknownNameError
from wbc_bench.publish import publish
from wbc_bench.results.analysis import collect, label_of
from wbc_bench.results.figures.style import controller_colours
from wbc_bench.results.store import ResultStore
from wbc_bench.results.study import Study, StudyError, find_study, labels_of, released_studies, studies_of
from wbc_bench.results.tables.paper import paper_table

MINE = """
name = "mine"
protocol = "ablation_v1"
pairs = [["a:b", "hold"]]
[[rows]]
heading = "Mine"
label = "My controller"
spec = "a:b"
[[rows]]
heading = "Floor"
label = "Hold"
spec = "hold"
[paper]
source = "A paper"
place = "Table 1"
columns = ["success"]
mean = {"a:b" = [50.0]}
sd = {"a:b" = [1.0]}
"""


def write(path: Path, text: str = MINE) -> str:
    path.write_text(text, encoding="utf-8")
    return str(path)


def store() -> FakeStore:
    frame = frame_of(0, np.array(["success", "missed"], dtype=object))
    return FakeStore([FakeRun(record(spec, 0, frame), frame) for spec in ("a:b", "hold")])


def test_released_studies_are_whole():
    for study in released_studies():
        assert [one.name for one in studies_of(study.protocol)] == [study.name]
    assert studies_of("nominal_v1") == [Study("nominal_v1", "nominal_v1")]


def test_a_users_file_is_a_study(tmp_path):
    study = find_study(write(tmp_path / "mine.toml"))
    assert [row.label for row in study.rows] == ["My controller", "Hold"]
    table = paper_table(study, methods_in(store()))
    assert table.name == "mine" and any("50.00 ± 1.00" in row for row in table.rows)


def test_the_papers_row_stands_under_its_own_protocol_alone():
    methods = methods_in(store())
    for protocol in ("nominal_v1", "smoke_v1"):
        (study,) = studies_of(protocol)
        table = paper_table(study, methods)
        assert not any("(paper)" in row for row in table.rows)
        assert not any("Paper:" in note for note in table.notes)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('["a:b", "hold"]', '["a:b", "hodl"]', r"'hodl' has no row, valid: a:b, hold - at `\$\.pairs\[0\]`"),
        ("[50.0]", "[50.0, 3.0]", r"2 values for 1 columns - at `\$\.paper\.mean\.a:b`"),
        ('sd = {"a:b" = [1.0]}', "", r"must name the same controllers .* `\$\.paper\.sd`"),
        ('"success"', '"sucess"', r"Invalid enum value 'sucess' .* `\$\.paper\.columns"),
        ("label =", "labl =", r"unknown field `labl`|missing required field `label`"),
        ('"mine"', '"../mine"', r"cannot name files"),
    ],
)
def test_mistakes_are_one_line_with_the_field(tmp_path, old, new, message):
    with pytest.raises(StudyError, match=message) as caught:
        find_study(write(tmp_path / "mine.toml", MINE.replace(old, new, 1)))
    assert "mine.toml" in str(caught.value) and len(str(caught.value).splitlines()) == 1


def test_an_unknown_study_names_the_nearest(tmp_path):
    with pytest.raises(UnknownNameError, match="did you mean ablation_v1"):
        find_study("ablation_v10")
    with pytest.raises(StudyError, match="does not exist"):
        find_study(str(tmp_path / "none.toml"))


def test_a_study_must_not_take_the_files_of_another_protocol(tmp_path):
    copy = ResultStore(Path(__file__).parents[2] / "results")
    study = find_study(write(tmp_path / "mine.toml", MINE.replace('"mine"', '"nominal_v1"')))
    with pytest.raises(StudyError, match="'nominal_v1' of ablation_v1"):
        publish(copy, tmp_path / "out", studies=[study])


def test_a_controller_has_one_name_under_every_protocol():
    study = find_study("ablation_v1")
    labels = labels_of(study.rows)
    assert labels["learned:transformer_gru"] == "Transformer + GRU"  # its last row, not "Reward gating"
    frame = frame_of(0, np.array(["success"] * 2, dtype=object))
    run = FakeRun(record("ik", 0, frame, protocol="nominal_v1"), frame)
    methods = collect([run], labels)
    table = paper_table(studies_of("nominal_v1")[0], methods)
    assert table.rows[0][:2] == ("Evaluated", "Whole-body IK")
    assert "Controllers: Whole-body IK is `ik`." in table.notes


def test_one_seed_of_a_method_goes_by_its_label_and_colour():
    labels = {"learned:oracle": "Privileged oracle", "learned:mine@2": "Mine"}
    assert label_of("learned:oracle@1", labels) == "Privileged oracle, seed 1"
    assert label_of("learned:mine@2", labels) == "Mine" and label_of("learned:mine@3", labels) == ""
    names = {"a": "Privileged oracle", "b": "Privileged oracle, seed 1", "c": "another"}
    colours = controller_colours(names)
    assert colours["a"] == colours["b"] != colours["c"]
