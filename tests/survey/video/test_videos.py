"""Videos of the small dive, read by OpenCV and by Chromium."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.base.errors import InputError
from aquaflow.base.errors.crash_report import MISUSED
from aquaflow.dive.deliverables import read_finished_frames
from aquaflow.dive.dive import Dive
from aquaflow.dive.restored import restored_frames, seen_frames, tone_without_water
from aquaflow.mapping.restoration import to_bytes
from aquaflow.survey.video.every_frame import (
    LONGEST_GAP_S,
    CameraPoses,
    EveryFrame,
    restore_every_frame,
    side_by_side,
)
from aquaflow.survey.video.fly_through import FPS, fly_through
from aquaflow.survey.video.overlay import GROUND
from aquaflow.telemetry.metric_file import read_frame_of_map
from tests.browser import needs_browser
from tests.command_line import Cli, refused
from tests.small_recording import FRAMES, HEIGHT, WIDTH
from tests.survey.video.player import played, stated_times

Picture = npt.NDArray[np.uint8]
LOST_IN_VIDEO = 6.0
"""Of 255; mean difference of the means of 8 x 8 pixels: chroma has half the resolution, and the
encoder takes noise away."""


def pictures_of(path: Path) -> list[Picture]:
    reader, found = cv2.VideoCapture(str(path)), []
    while (read := reader.read())[0]:
        found.append(np.asarray(read[1][..., ::-1], np.uint8))
    return found


def blocks(picture: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Means over 8 x 8 pixels."""
    height, width = (side // 8 * 8 for side in picture.shape[:2])
    cut = picture[:height, :width].reshape(height // 8, 8, width // 8, 8, 3)
    return np.asarray(cut.mean(axis=(1, 3)), float)


def difference(one: npt.NDArray[Any], two: npt.NDArray[Any]) -> float:
    return float(np.abs(blocks(one) - blocks(two)).mean())


@pytest.fixture(scope="module")
def restored(small_dive: Path, small_recording: Path) -> dict[int, Picture]:
    """The restored mapped frames by index."""
    mapper = Dive(small_dive).map()
    tone = tone_without_water(Dive(small_dive), mapper)
    return {
        index: picture.picture_bytes(tone)[..., :3]
        for index, picture in restored_frames(Dive(small_dive), mapper, small_recording)
    }


@pytest.fixture(scope="module")
def beside(
    small_dive: Path, small_recording: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    path = tmp_path_factory.mktemp("beside") / "dive.mp4"
    side_by_side(Dive(small_dive), path, small_recording)
    return path


def test_each_mapped_frame_is_shown_at_its_own_time(
    beside: Path, restored: dict[int, Picture], small_dive: Path
) -> None:
    times = {frame.row.index: frame.row.t_s for frame in read_finished_frames(Dive(small_dive))}
    begun, end = times[min(restored)], times[max(restored)]
    stated = stated_times(beside)
    assert len(pictures_of(beside)) == len(stated) == round((end - begun) * 10.0) + 1
    assert stated[-1] == pytest.approx(end - begun, abs=0.05)


def test_left_is_the_camera_right_without_water_and_words_are_below(
    beside: Path, restored: dict[int, Picture], small_recording: Path
) -> None:
    first = pictures_of(beside)[0]
    recorded = cv2.imread(str(sorted((small_recording / "images").iterdir())[min(restored)]))
    assert first.shape[1] == 2 * WIDTH
    assert difference(first[:HEIGHT, :WIDTH], recorded[..., ::-1]) < LOST_IN_VIDEO
    assert difference(first[:HEIGHT, WIDTH:], restored[min(restored)]) < LOST_IN_VIDEO
    below = first[HEIGHT:].astype(int)
    assert 0.02 < (np.abs(below - GROUND).sum(axis=2) > 150).mean() < 0.5


def test_the_words_go_on_with_the_dive(beside: Path) -> None:
    found = pictures_of(beside)
    changed = np.abs(found[0][HEIGHT:].astype(int) - found[-1][HEIGHT:]).sum(axis=2) > 150
    assert changed.any()
    assert not changed[:, : 2 * WIDTH // 3][: changed.shape[0] // 2].any()  # the halves' names


@needs_browser
def test_a_browser_plays_it_in_its_colours(
    beside: Path, restored: dict[int, Picture], small_dive: Path, tmp_path: Path
) -> None:
    times = {frame.row.index: frame.row.t_s for frame in read_finished_frames(Dive(small_dive))}
    chosen = sorted(restored)[:: len(restored) // 2][:3]
    asked = [times[index] - times[min(restored)] + 0.05 for index in chosen]
    duration, shown = played(beside, tmp_path / "profile", asked)
    assert duration == pytest.approx(len(stated_times(beside)) / 10.0, abs=0.02)
    for picture, index in zip(shown, chosen, strict=True):
        assert picture.shape[1] == 2 * WIDTH
        assert difference(picture[:HEIGHT, WIDTH:], restored[index]) < LOST_IN_VIDEO


def test_without_a_recording_the_map_is_on_the_left(small_dive: Path, tmp_path: Path) -> None:
    side_by_side(Dive(small_dive), tmp_path / "a.mp4")
    first = pictures_of(tmp_path / "a.mp4")[0]
    seen = next(seen_frames(Dive(small_dive), Dive(small_dive).map(), None))
    drawn = to_bytes(seen.shown.image.numpy())
    assert difference(first[:HEIGHT, :WIDTH], drawn) < LOST_IN_VIDEO


Restored = tuple[Path, EveryFrame, list[tuple[int, int]]]
"""A video, what was said of it, and its steps of progress."""


@pytest.fixture(scope="module")
def with_gaps(
    small_dive: Path, small_recording: Path, tmp_path_factory: pytest.TempPathFactory
) -> Restored:
    """Of the small dive, of which every other pose and the last three are missing."""
    folder = tmp_path_factory.mktemp("gaps") / "dive"
    shutil.copytree(small_dive, folder)
    lines = (folder / "trajectory.tum").read_text().splitlines()
    head = [line for line in lines if line.startswith("#")]
    poses = [line for line in lines if not line.startswith("#")]
    assert len(poses) == FRAMES
    (folder / "trajectory.tum").write_text("\n".join([*head, *poses[:-3:2]]) + "\n")
    path, steps = folder.with_name("all.mp4"), list[tuple[int, int]]()
    wrote = restore_every_frame(
        Dive(folder), path, small_recording, progress=lambda *step: steps.append(step)
    )
    return path, wrote, steps


def test_every_frame_is_restored_from_a_pose_in_between(
    with_gaps: Restored, restored: dict[int, Picture]
) -> None:
    path, wrote, steps = with_gaps
    found = pictures_of(path)
    assert (wrote.frames, wrote.restored) == (FRAMES, FRAMES - 3)
    assert len(found) == FRAMES
    assert steps[-1] == (FRAMES, FRAMES)
    assert stated_times(path) == pytest.approx([0.1 * i for i in range(FRAMES)], abs=2e-3)
    between = [index for index in restored if index % 2 and index < FRAMES - 3]
    assert len(between) > 5
    for index in between:
        assert difference(found[index], restored[index]) < LOST_IN_VIDEO


def test_a_frame_without_a_pose_is_shown_as_it_is_with_a_mark(
    with_gaps: Restored, small_recording: Path
) -> None:
    last = pictures_of(with_gaps[0])[-1]
    recorded = cv2.imread(str(sorted((small_recording / "images").iterdir())[-1]))[..., ::-1]
    assert difference(last[HEIGHT // 4 :], recorded[HEIGHT // 4 :]) < LOST_IN_VIDEO
    corner = last[:9, :40].astype(int)
    assert (np.abs(corner - GROUND).sum(axis=2) < 90).mean() > 0.3


def test_a_wider_video_shows_the_same_scene(
    small_dive: Path, small_recording: Path, restored: dict[int, Picture], tmp_path: Path
) -> None:
    restore_every_frame(Dive(small_dive), tmp_path / "a.mp4", small_recording, width=96)
    found = pictures_of(tmp_path / "a.mp4")[0]
    assert found.shape == (72, 96, 3)
    small = cv2.resize(restored[0], (96, 72), interpolation=cv2.INTER_AREA)
    assert difference(found, small) < 2 * LOST_IN_VIDEO


def test_a_pose_in_between_lies_between_and_a_long_gap_has_none(small_dive: Path) -> None:
    frames = read_finished_frames(Dive(small_dive))
    T_nm = read_frame_of_map(small_dive / "map.aqf").T_nm
    poses, views = CameraPoses(frames, T_nm), Dive(small_dive).map().views
    by_index = {frame.row.index: frame for frame in frames}
    for view in views:  # the map's own world
        pose = poses.at(by_index[view.frame_index].t_ns)
        assert pose is not None
        np.testing.assert_allclose(pose.t, view.T_wc.t, atol=1e-6)
        np.testing.assert_allclose(pose.R, view.T_wc.R, atol=1e-6)
    first, second = poses.at(frames[0].t_ns), poses.at(frames[1].t_ns)
    middle = poses.at((frames[0].t_ns + frames[1].t_ns) // 2)
    assert first is not None
    assert second is not None
    assert middle is not None
    np.testing.assert_allclose(middle.t, 0.5 * (first.t + second.t), atol=1e-9)
    np.testing.assert_allclose(middle.R @ first.R.T @ middle.R, second.R, atol=1e-6)
    assert poses.at(frames[-1].t_ns + 1) is None
    assert poses.at(frames[0].t_ns - 1) is None
    far = [frames[0], frames[int(LONGEST_GAP_S * 10.0) + 1]]
    assert CameraPoses(far, T_nm).at(frames[3].t_ns) is None
    near = [frames[0], frames[int(LONGEST_GAP_S * 10.0)]]
    assert CameraPoses(near, T_nm).at(frames[3].t_ns) is not None


@pytest.mark.parametrize("water", [False, True])
def test_a_flight_begins_with_what_the_first_frame_shows(
    small_dive: Path, tmp_path: Path, water: bool
) -> None:
    path = tmp_path / "fly.mp4"
    assert fly_through(Dive(small_dive), path, seconds=0.4, water=water) == 0.4 * FPS
    found = pictures_of(path)
    assert len(found) == len(stated_times(path)) == 0.4 * FPS
    mapper = Dive(small_dive).map()
    seen = next(seen_frames(Dive(small_dive), mapper, None))
    shown = to_bytes(seen.shown.image.numpy())
    if not water:
        tone = tone_without_water(Dive(small_dive), mapper)
        shown = next(restored_frames(Dive(small_dive), mapper, None))[1].picture_bytes(tone)
    # The camera's way is smoothed and colours are bounded: the scene is the same, not every pixel.
    assert difference(found[0], shown[..., :3]) < 12.0
    assert difference(found[0], found[-1]) > 5.0


def test_the_same_dive_gives_the_same_bytes(
    beside: Path, small_dive: Path, small_recording: Path, tmp_path: Path
) -> None:
    side_by_side(Dive(small_dive), tmp_path / "again.mp4", small_recording)
    assert (tmp_path / "again.mp4").read_bytes() == beside.read_bytes()


def test_another_recording_is_refused_and_leaves_no_file(
    small_dive: Path, pictures: Path, tmp_path: Path
) -> None:
    for make in (side_by_side, restore_every_frame):
        folder = tmp_path / "out"
        folder.mkdir(exist_ok=True)
        with pytest.raises(InputError, match="no readable frame"):
            make(Dive(small_dive), folder / "a.mp4", pictures)
        assert list(folder.iterdir()) == []


def test_the_command_says_what_it_wrote_and_refuses_what_makes_no_sense(
    command: Cli, small_dive: Path, tmp_path: Path
) -> None:
    out = tmp_path / "fly.mp4"
    ran = command("export", "video", small_dive, "--kind", "fly-through", "--seconds", "0.2",
                  "--out", out, "--width", "80", "--json")  # fmt: skip
    assert ran.code == 0, ran.err
    assert json.loads(ran.out) == {"out": str(out), "frames": 5}
    assert len(pictures_of(out)) == 5
    other = ("--out", tmp_path / "b.mp4")
    refused(command("export", "video", small_dive, "--water", *other), "--water", code=MISUSED)
    ran = command("export", "video", small_dive, "--kind", "restored", "--out", tmp_path / "r.mp4")
    assert ran.code == 0, ran.err  # the dive says where its recording is
    ran = command("export", "video", small_dive, "--out", tmp_path / "b.avi")
    refused(ran, "b.avi", ".mp4", code=MISUSED)
    for wrong in ("0", "nan", "1e9"):
        flight = ("--kind", "fly-through", "--seconds", wrong)
        refused(command("export", "video", small_dive, *flight, *other), "--seconds", code=MISUSED)
    refused(
        command("export", "video", small_dive, "--kind", "fly-through", "--width", "8", *other),
        "--width",
        code=MISUSED,
    )
    refused(command("export", "video", tmp_path, *other), "no finished dive")
    assert sorted(path.name for path in tmp_path.glob("*.mp4")) == ["fly.mp4", "r.mp4"]
