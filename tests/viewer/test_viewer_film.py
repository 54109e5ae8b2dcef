"""A film and a strip show the episode that was recorded, on machines that can draw."""

import dataclasses
import subprocess
from pathlib import Path

import numpy as np
import pytest

from runs import evaluated
from wbc_bench.errors import BenchError, StoreError
from wbc_bench.viewer import film
from wbc_bench.viewer.film import strip_of, write_film_of
from wbc_bench.viewer.picture import render, write_png
from wbc_bench.viewer.rerun import Rerun, rerun


@pytest.fixture(scope="module")
def again(tmp_path_factory: pytest.TempPathFactory) -> Rerun:
    return rerun(evaluated(tmp_path_factory.mktemp("store"), "hold", episodes=2), 0)


@pytest.fixture(scope="module")
def strip(again: Rerun) -> film.Pixels:
    try:
        return film.strip_of(again, times=[0.0, 1.0, 99.0])
    except BenchError as error:
        pytest.skip(str(error))


def test_a_strip_shows_the_moments_asked_for(again: Rerun, strip: film.Pixels) -> None:
    width, height = film.PANEL
    assert strip.shape == (height, 3 * width + 2 * film.GAP, 3)
    first, middle, last = (strip[:, k * (width + film.GAP) :][:, :width].astype(int) for k in range(3))
    assert np.abs(first - middle).max() > 50  # the robot has moved
    end = film.strip_of(again, times=[again.moments[-1].time])
    assert np.abs(last - end).max() <= 2  # of 255: a renderer rounds with what it drew before
    assert np.array_equal(strip, film.strip_of(again, times=[0.0, 1.0, 99.0]))
    # the ball of the tolerance is orange, for `hold` does not get there
    red, green, blue = np.moveaxis(first, -1, 0)
    assert ((red > 180) & (red - green > 40) & (green - blue > 20)).sum() > 30


def test_the_caption_of_a_strip_names_episode_end_and_times(again: Rerun) -> None:
    end = f"{again.moments[-1].time:g}"
    caption = film.strip_caption(again, times=[0.0, 99.0])
    assert caption.startswith(f"{again.title}: {again.stored['outcome']}. At 0, {end} s;")
    assert film.strip_caption(again).count(",") >= film.PANELS


def test_everything_that_matters_is_in_the_picture(again: Rerun, strip: film.Pixels) -> None:
    half = np.array([0.5, 0.4])
    view = film._view(again.moments, half)
    turn, tilt = np.deg2rad([view.azimuth, view.elevation])
    ahead = np.array([np.cos(turn) * np.cos(tilt), np.sin(turn) * np.cos(tilt), np.sin(tilt)])
    eye = view.lookat - view.distance * ahead
    edge = 0.0
    for moment in again.moments:
        for place in (moment.ee_pos_w, moment.target_pos_w, *moment.foot_pos_w):
            depth = (place - eye) @ ahead
            right = np.array([np.sin(turn), -np.cos(turn), 0.0])
            place_in_view = np.abs([(place - eye) @ right, (place - eye) @ np.cross(right, ahead)])
            edge = max(edge, (place_in_view / depth / half).max())
    assert 0.5 < edge < 1.0  # near, and nothing cut off


def test_a_film_has_a_picture_every_other_step(again: Rerun, strip: film.Pixels, tmp_path: Path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    path, seen = tmp_path / "episode.mp4", []
    film.write_film_of(again, path, lambda done, total, what: seen.append((done, total)))
    frames, seconds = ffmpeg.count_frames_and_secs(str(path))
    assert frames == -(-len(again.moments) // film.EVERY) == len(seen)
    assert seconds == pytest.approx(frames / 25, abs=0.05)
    assert [file.name for file in tmp_path.iterdir()] == ["episode.mp4"]


def test_a_grid_shows_each_episode_at_its_place_until_all_have_ended(
    again: Rerun, strip: film.Pixels, tmp_path: Path
) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    short = dataclasses.replace(again, moments=again.moments[:9])
    path, (width, height) = tmp_path / "grid.mp4", film.CELL
    film.write_grid_of([again, short, short], 2, path)
    frames, _ = ffmpeg.count_frames_and_secs(str(path))
    assert frames == -(-len(again.moments) // film.EVERY)
    reader = ffmpeg.read_frames(str(path), pix_fmt="rgb24")
    assert next(reader)["size"] == (2 * width, 2 * height)
    pictures = [
        np.frombuffer(data, np.uint8).reshape(2 * height, 2 * width, 3).astype(int) for data in reader
    ]
    first, last = pictures[0], pictures[-1]

    def cell(picture: np.ndarray, row: int, column: int) -> np.ndarray:
        return picture[row * height :, column * width :][:height, :width]

    assert cell(last, 1, 1).min() > 240  # of 255: nothing is there
    # the picture is compressed: equal views are near, others are not
    assert np.abs(cell(last, 0, 1) - cell(last, 1, 0)).mean() < 2
    assert np.abs(cell(last, 0, 0) - cell(first, 0, 0)).mean() > 4
    assert np.abs(cell(last, 0, 1) - cell(pictures[6], 0, 1)).mean() < 2  # it has ended


@pytest.mark.parametrize("what", ["film", "strip", "picture"])
def test_a_full_disk_leaves_no_broken_file(again: Rerun, tmp_path: Path, what: str) -> None:
    """And what was there stays: on a disk of 16 KiB, which none of them fits."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=16k", "none", str(disk)]
    if subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("mounting a small disk needs root")
    try:
        path = disk / ("it.mp4" if what == "film" else "it.png")
        path.write_bytes(b"before")
        with pytest.raises(StoreError, match="cannot write") as caught:
            if what == "film":
                write_film_of(again, path)
            elif what == "strip":
                write_png(strip_of(again), path)
            else:
                render(again.robot, path)
        assert "\n" not in str(caught.value)
        assert [p.name for p in disk.iterdir()] == [path.name] and path.read_bytes() == b"before"
    finally:
        subprocess.run(["umount", str(disk)], check=True)
