"""Bad recordings through the real command line: one sentence, or a dive that says what it lacks."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.command_line import Cli, refused
from tests.small_recording import HASTY


def rows(dive: Path) -> list[dict[str, str]]:
    with (dive / "frames.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def pictures(recording: Path) -> list[Path]:
    return sorted((recording / "images").glob("*.png"))


def write_video(path: Path, codec: str, recording: Path) -> None:
    frames = [cv2.imread(str(file)) for file in pictures(recording)]
    height, width = frames[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 10.0, (width, height))
    assert writer.isOpened()
    for frame in frames:
        writer.write(frame)
    writer.release()


def cut(path: Path, share: float) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])


# --- recordings that cannot be opened -----------------------------------------------------------


def make_nothing(_path: Path) -> None:
    """Leave the path empty."""


def make_text(path: Path) -> None:
    path.write_text("this is no video\n" * 50)


def make_empty_file(path: Path) -> None:
    path.touch()


@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("missing.mp4", make_nothing),
        ("text.mp4", make_text),
        ("empty.mp4", make_empty_file),
        ("notes.txt", make_text),
        ("folder", Path.mkdir),
    ],
)
def test_what_is_no_recording_is_refused(
    aquaflow: Cli, tmp_path: Path, name: str, make: Callable[[Path], None]
) -> None:
    source, out = tmp_path / name, tmp_path / "out"
    make(source)
    refused(aquaflow("map", source, "--out", out), source)
    assert not out.exists()


def test_a_video_cut_before_its_index_is_refused(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    source = tmp_path / "cut.mp4"
    write_video(source, "mp4v", small_recording)
    cut(source, 0.7)
    refused(aquaflow("map", source, "--out", tmp_path / "out"), source, "has no index")


def test_a_video_that_ends_early_is_mapped_as_far_as_it_goes(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    source, dive = tmp_path / "cut.avi", tmp_path / "out"
    write_video(source, "MJPG", small_recording)
    cut(source, 0.7)
    calibration = small_recording / "camera.yaml"
    ran = aquaflow("map", source, "--calib", calibration, "--out", dive, *HASTY)
    assert ran.code == 0
    assert "ends after" in ran.out
    assert "ends after" in (dive / "report.html").read_text()
    assert 10 < len(rows(dive)) < len(pictures(small_recording))


# --- recordings that hold something else than expected -------------------------------------------


def test_pictures_of_another_size_are_left_out_and_named(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    source, dive = tmp_path / "mixed", tmp_path / "out"
    shutil.copytree(small_recording / "images", source)
    shutil.copy(small_recording / "camera.yaml", source)
    odd = pictures(small_recording)[5].name
    cv2.imwrite(str(source / odd), np.zeros((60, 80, 3), np.uint8))
    ran = aquaflow("map", source, "--out", dive, *HASTY)
    assert ran.code == 0
    assert "1 of 24 pictures were left out" in ran.out
    (left_out,) = [row for row in rows(dive) if row["class"] == "dropped"]
    assert left_out["source"] == odd
    assert "80 x 60" in left_out["reason"]
    assert odd in (dive / "report.html").read_text()


def test_a_black_clip_gives_no_map(aquaflow: Cli, tmp_path: Path) -> None:
    source, out = tmp_path / "black", tmp_path / "out"
    source.mkdir()
    for i in range(12):
        cv2.imwrite(str(source / f"{i}.png"), np.zeros((120, 160, 3), np.uint8))
    ran = aquaflow("map", source, "--out", out)
    assert (ran.code, ran.out) == (1, "")
    *before, after = ran.err.splitlines()
    assert before[0] == "Note: before mapping: 10 of 10 pictures are nearly black."
    assert source.name in after
    assert "nearly black" in after
    assert all(row["reason"] for row in rows(out))


def test_a_clip_of_three_frames_is_mapped_or_refused_with_its_name(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    source, out = tmp_path / "three", tmp_path / "out"
    source.mkdir()
    for file in pictures(small_recording)[:3]:
        shutil.copy(file, source)
    ran = aquaflow("map", source, "--out", out, *HASTY)
    if ran.code == 0:
        assert json.loads((out / "metrics.json").read_text())["tracked"] == 3
    else:
        refused(ran, source.name)
    assert len(rows(out)) == 3


def test_black_motionless_and_short_clips_are_told_apart(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    random = np.random.default_rng(0)
    scenes = [cv2.resize(random.uniform(0, 255, (15, 20, 3)), (160, 120)) for _ in range(3)]
    first = cv2.imread(str(pictures(small_recording)[0]))
    still = [first + random.normal(0.0, 1.0, first.shape) for _ in range(12)]
    for name, frames, words in (
        ("black", [np.zeros((120, 160, 3))] * 12, "12 of 12 pictures are nearly black"),
        ("still", still, "of them: duplicate: moved by 0.0"),
        ("short", scenes, "(3 of them: no pose found)"),
    ):
        path = tmp_path / f"{name}.avi"
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (160, 120))
        for frame in frames:
            writer.write(np.clip(frame, 0, 255).astype(np.uint8))
        writer.release()
        ran = aquaflow("map", path, "--tracking-only", "--out", tmp_path / name)
        assert ran.code == 1
        assert words in ran.err
        assert (", for which 3 frames are few" in ran.err) == (name == "short")
    live = aquaflow("map", path, "--realtime", "--tracking-only", "--out", tmp_path / "live")
    assert live.code == 3
    assert live.err.startswith("live")  # how many of the frames that came, and why


def test_a_clip_of_two_frames_is_too_short(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    ran = aquaflow("map", small_recording, "--stop", 2, *HASTY, "--out", tmp_path / "out")
    refused(ran, small_recording.name, "at least 3")


def test_a_range_without_frames_says_so(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    ran = aquaflow("map", small_recording, "--start", 500, "--out", tmp_path / "out")
    refused(ran, small_recording.name, "500", "24 frames")
