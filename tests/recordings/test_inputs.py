"""The table of inputs: what is read is what was recorded, and poses are those of plain pictures."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.recordings.inputs import Row, dive_of
from tests.recordings.inputs.judge import Judge, all_rows

MOST_ROTATION_DEG = 0.5
"""Between poses of a row and of the same pictures read plainly."""
MAPPED_IN_CI = frozenset({
    "film libx265 10-bit.mov", "film interlaced, fields of two moments", "film 4:3 pixels H.264",
    "film GoPro chapters", "film variable frame rate .mkv",
    "folder 16 bits colour .png, first picture dark", "folder with EXIF orientation 6",
    "bag bayer_rggb8", "bag CameraInfo of a part of the sensor, binned",
    "bag CameraInfo equidistant", "MCAP Foxglove CompressedVideo", "calibration OpenCV XML",
    "calibration Kalibr equidistant", "calibration COLMAP OPENCV", "calibration Metashape",
    "log NMEA with the UTC of its sentences",
})  # fmt: skip
"""Where geometry, time or values of pixels could be misread; ``make test-all`` maps all rows."""
ROWS = [row for row in all_rows() if not row.refuses]


@pytest.fixture(scope="module")
def judge(small_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Judge:
    return Judge(dive_of(small_recording), tmp_path_factory.mktemp("plain"))


def _named(rows: list[Row]) -> list[object]:
    return [pytest.param(row, id=row.name) for row in rows]


def test_the_table_has_every_row_once_and_ci_maps_what_is_there() -> None:
    names = [row.name for row in all_rows()]
    assert len(set(names)) == len(names) >= 60
    assert {row.name for row in ROWS} >= MAPPED_IN_CI


@pytest.mark.ci
@pytest.mark.parametrize("row", _named(ROWS))
def test_what_is_read_is_what_was_recorded(judge: Judge, row: Row, tmp_path: Path) -> None:
    judge.read(row, judge.made(row, tmp_path))


@pytest.mark.ci
@pytest.mark.parametrize("row", _named([row for row in all_rows() if row.refuses]))
def test_a_refusal_names_the_cause(judge: Judge, row: Row, tmp_path: Path, contained: None) -> None:
    judge.refusal(row, tmp_path)


@pytest.mark.parametrize(
    "row",
    [
        pytest.param(
            row,
            id=row.name,
            marks=pytest.mark.ci if row.name in MAPPED_IN_CI else pytest.mark.slow,
        )
        for row in ROWS
    ],
)
def test_poses_are_those_of_the_plain_reading(judge: Judge, row: Row, tmp_path: Path) -> None:
    found = judge.figures(judge.made(row, tmp_path), tmp_path)
    assert found.frames == found.wanted
    assert found.rotation_deg <= MOST_ROTATION_DEG
    assert found.ratio <= row.most_ratio
