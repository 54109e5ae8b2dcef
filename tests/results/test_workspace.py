"""Success over the workspace: every episode in one bin, rates by hand, and which controllers are shown."""

import numpy as np
import pytest

from synthetic import FakeRun, FakeStore, episodes, frame_of, methods_in, record, study_store
from wbc_bench.errors import UnknownNameError
from wbc_bench.results import analysis
from wbc_bench.results.figures import workspace
from wbc_bench.results.study import find_study, methods_of

ABLATION = find_study("ablation_v1")


def method(frame) -> analysis.Evaluated:
    return analysis.Evaluated("ik", (record("ik", 0, frame),), frame)


def scattered(skill: float = 0.5) -> FakeStore:
    """Two controllers on 300 targets drawn over a box."""
    rng = np.random.default_rng(3)
    places = {
        "target_x": rng.uniform(-0.5, 0.8, 300),
        "target_y": rng.uniform(-0.6, 0.6, 300),
        "height": rng.uniform(0.1, 1.7, 300),
    }
    frames = {name: episodes(0, 300, s, 1).assign(**places) for name, s in (("a", skill), ("b", 0.9))}
    return FakeStore([FakeRun(record(name, 0, frame), frame) for name, frame in frames.items()])


def test_rates_by_hand():
    frame = frame_of(
        *(0, np.array(["success", "missed", "success"])),
        target_x=[0.01, 0.02, -0.01],
        height=[0.55, 0.56, 0.55],
    )
    one = method(frame)
    edges = workspace.bin_edges(np.array([-0.01, 0.02]), 0.1), workspace.bin_edges(np.array([0.55]), 0.1)
    np.testing.assert_allclose(edges[0], [-0.1, 0.0, 0.1])
    np.testing.assert_allclose(edges[1], [0.5, 0.6])
    grid = workspace.success_grid(one, "height", edges)
    np.testing.assert_array_equal(grid.episodes, [[1], [2]])
    np.testing.assert_array_equal(grid.rate, [[1.0], [0.5]])


def test_no_episode_falls_out_of_the_bins_and_none_is_not_zero():
    one = method(scattered().all_runs[0].frame)
    size = workspace.bin_size(one)
    edges = [workspace.bin_edges(analysis.column(one.episodes, n), size) for n in ("target_x", "target_y")]
    grid = workspace.success_grid(one, "target_y", (edges[0], edges[1]))
    assert grid.episodes.sum() == 300 and grid.successes.sum() == one.episodes["success"].sum()
    assert np.isnan(grid.rate[grid.episodes == 0]).all() and not np.isnan(grid.rate[grid.episodes > 0]).any()


def test_more_episodes_allow_finer_bins():
    rng = np.random.default_rng(0)
    sizes = []
    for count in (50, 500, 5000):
        places = {name: rng.uniform(0.0, 1.0, count) for name in ("target_x", "target_y", "height")}
        sizes.append(workspace.bin_size(method(frame_of(0, np.full(count, "missed"), **places))))
    assert sizes == sorted(sizes, reverse=True) and sizes[0] > sizes[-1]


def test_the_best_two_or_those_named():
    methods = methods_of(ABLATION, methods_in(study_store()))
    assert {m.spec for _, m in workspace.best(methods)} == {"ik", "ik:osqp"}
    assert [m.spec for _, m in workspace.chosen(methods, ["hold", "ik"])] == ["hold", "ik"]
    with pytest.raises(UnknownNameError, match=r"'ikk' \(--workspace\).*did you mean ik"):
        workspace.chosen(methods, ["ikk"])


def test_same_store_same_bytes(tmp_path):
    for folder in ("one", "two"):
        paths = workspace.write_workspace(ABLATION, methods_in(scattered()), tmp_path / folder)
        assert [path.name for path in paths] == ["ablation_v1_workspace.png", "ablation_v1_workspace.svg"]
    for path in paths:
        assert path.read_bytes() == (tmp_path / "one" / path.name).read_bytes()
    assert workspace.write_workspace(ABLATION, {}, tmp_path) == []
