"""The gallery: which episodes are worst, by hand, and where their replays are."""

import html
import re

import numpy as np
import pytest

from synthetic import frame_of, methods_in, record, study_store
from wbc_bench.episodes.conditions import conditions_of
from wbc_bench.episodes.manifest import manifest_path, read_manifest
from wbc_bench.episodes.protocol import find_protocol
from wbc_bench.outcomes import Outcome, SuccessRule
from wbc_bench.publish import told_by
from wbc_bench.results import analysis, gallery

RULE = SuccessRule()


def method(frame, spec: str = "a:b") -> analysis.Evaluated:
    return analysis.Evaluated(spec, (record(spec, 0, frame),), frame)


def test_of_falls_the_earliest_is_worst_and_no_step_at_all_before_it():
    frame = frame_of(0, np.array(["fell"] * 4), duration=[3.0, 0.5, np.nan, 0.5], position_error=[9, 0, 0, 1])
    assert gallery.worst(frame, Outcome.FELL, RULE)["episode"].tolist() == [2, 1, 3, 0]


def test_of_misses_the_larger_error_in_units_of_its_tolerance_is_worst():
    position = [0.10, 0.06, np.nan, 0.05]  # 2, 1.2 and 1 times 5 cm
    orientation = np.radians([7.0, 21.0, 1.0, 7.0])  # 1, 3 and 1 times 7 degrees
    frame = frame_of(*(0, np.array(["missed"] * 4)), position_error=position, orientation_error=orientation)
    assert gallery.worst(frame, Outcome.MISSED, RULE)["episode"].tolist() == [2, 1, 0, 3]
    assert gallery.worst(frame, Outcome.MISSED, RULE, 2)["episode"].tolist() == [2, 1]
    assert gallery.worst(frame, Outcome.DRIFTED, RULE).empty


def test_equals_come_in_the_order_of_replicate_and_episode():
    frame = frame_of(0, np.array(["missed"] * 3)).assign(replicate=[1, 0, 0], episode=[0, 7, 2])
    chosen = gallery.worst(frame, Outcome.MISSED, RULE)
    assert list(zip(chosen["replicate"], chosen["episode"], strict=True)) == [(0, 2), (0, 7), (1, 0)]


def test_every_outcome_with_its_count_and_at_most_ten_rows(tmp_path):
    one = methods_in(study_store())["ik"]
    text = gallery.gallery_html("ablation_v1", one, tmp_path)
    counts = one.episodes["outcome"].value_counts()
    rows = len(re.findall("<tr", text)) - 1
    assert rows == sum(min(count, gallery.SHOWN) for count in counts)
    for outcome, count in counts.items():
        assert f"{str(outcome).replace('_', ' ')} ({count})" in text


@pytest.mark.parametrize("made", [False, True])
def test_a_replay_that_is_there_is_a_link_and_another_a_command(tmp_path, made):
    frame = frame_of(0, np.array(["fell"]))
    path = tmp_path / gallery.replay_path("p", "a:b", 0, 0)
    if made:
        path.parent.mkdir(parents=True)
        path.write_text("here")
    text = gallery.gallery_html("p", method(frame), tmp_path)
    command = "wbc-bench replay p/a-b/replicate_0 --episode 0 --results . -o replays/p/a-b/replicate_0/0.html"
    assert ('<a href="replays/p/a-b/replicate_0/0.html">' in text) is made
    assert (command in text) is not made


def test_a_command_leads_to_records_that_stand_elsewhere(tmp_path):
    frame = frame_of(0, np.array(["fell"]))
    text = gallery.gallery_html("p", method(frame), tmp_path, "../my records")
    assert "--results &#x27;../my records&#x27; -o replays/p/a-b" in text


def test_of_known_episodes_the_disturbances_are_told(tmp_path):
    protocol, path = find_protocol("deploy_v1")
    drawn, _ = read_manifest(protocol, manifest_path(path))
    frame = frame_of(0, np.array(["fell"] * 3))
    text = gallery.gallery_html("deploy_v1", method(frame), tmp_path, ".", told_by(drawn))
    rows = drawn.of_replicate(0)
    for row in range(3):
        assert html.escape(", ".join(conditions_of(rows, row))) in text
    assert text.count('class="drawn"') == 3
