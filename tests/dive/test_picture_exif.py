"""Where and when exported pictures were taken, read back with a library that did not write it."""

from __future__ import annotations

import io
import json
import math
import struct
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aquaflow.dive.dive import Dive
from aquaflow.dive.picture_exif import exif_of_views
from aquaflow.dive.placement import to_geodetic
from aquaflow.dive.trajectory_csv import PoseRow, write_trajectory_csv
from aquaflow.geometry.similarity import Sim3
from aquaflow.telemetry.metric_file import write_metric_file
from tests.command_line import Cli
from tests.survey.export.small_dive import (
    FRAMES,
    ORIGIN,
    north_up_frame,
    write_recording,
    write_small_dive,
)

tifffile = pytest.importorskip("tifffile")

TAKEN = datetime(2026, 6, 1, 23, 59, 58, 250_000, tzinfo=timezone.utc)


def placed_dive(folder: Path) -> Dive:
    mapper = write_small_dive(folder / "dive", north_up_frame())
    write_recording(folder / "pictures", mapper)
    rows = [PoseRow(index, float(index), TAKEN, 0, 0.0, 0.0, 0.0, "m") for index in FRAMES]
    write_trajectory_csv(folder / "dive" / "trajectory.csv", rows)
    return Dive(folder / "dive")


def gps_of(picture: Path) -> dict[str, Any]:
    """The receiver's directory of a PNG, found in the file and read as the TIFF that it is."""
    data, at = picture.read_bytes(), 8
    while at < len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        if kind == b"eXIf":
            with tifffile.TiffFile(io.BytesIO(data[at + 8 : at + 8 + length])) as exif:
                tags = exif.pages.first.tags
                return {**tags["GPSTag"].value, **tags["ExifTag"].value} if tags else {}
        at += 12 + length
    return {}


def degrees(parts: tuple[int, ...]) -> float:
    return sum(parts[2 * n] / parts[2 * n + 1] / 60.0**n for n in range(3))


@pytest.mark.parametrize(
    ("words", "names"),
    [
        (("colmap",), "colmap/images/{:06d}.png"),
        (("nerfstudio", "--restored"), "nerfstudio/images/{:06d}.png"),
        (("restored",), "restored/{:06d}.png"),
    ],
)
def test_exported_pictures_say_where_and_when_they_were_taken(
    aquaflow: Cli, tmp_path: Path, words: tuple[str, ...], names: str
) -> None:
    dive = placed_dive(tmp_path)
    recorded = ("--recording", tmp_path / "pictures")
    ran = aquaflow("export", dive.path, "--format", *words, *recorded)
    assert "Each says in EXIF where it was taken." in ran.out, ran.err
    views = {view.frame_index: view for view in dive.map().views}
    for index in FRAMES:
        gps = gps_of(dive.path / names.format(index))
        pose = dive.frame.pose(views[index].T_wc)
        latitude, longitude = to_geodetic(ORIGIN, pose.t[None])
        assert degrees(gps["GPSLatitude"]) == pytest.approx(latitude[0], abs=1e-9)
        assert degrees(gps["GPSLongitude"]) == pytest.approx(longitude[0], abs=1e-9)
        assert (gps["GPSLatitudeRef"], gps["GPSLongitudeRef"]) == ("N", "E")
        above, below = gps["GPSAltitude"]
        assert above / below == pytest.approx(pose.t[2], abs=1e-6)
        assert int.from_bytes(bytes([gps["GPSAltitudeRef"]]), "big") == 1  # below sea level
        turned = gps["GPSImgDirection"][0] / gps["GPSImgDirection"][1]
        assert abs((turned + 180.0) % 360.0 - 180.0) < 5.0  # straight down, north on top
        assert gps["GPSImgDirectionRef"] == "T"
        assert gps["GPSDateStamp"] == "2026:06:01"
        hour, minute, second = (
            gps["GPSTimeStamp"][n] / gps["GPSTimeStamp"][n + 1] for n in (0, 2, 4)
        )
        assert (hour, minute, second) == (23, 59, pytest.approx(58.25))
        assert gps["OffsetTimeOriginal"] == "+00:00"


def test_pictures_of_a_dive_without_a_place_have_no_tag_and_it_is_said(
    aquaflow: Cli, tmp_path: Path
) -> None:
    dive = placed_dive(tmp_path)
    lost = replace(dive.frame, origin=None)
    write_metric_file(dive.path, {0: lost}, main=0)
    asked = ("export", dive.path, "--format", "colmap", "--recording", tmp_path / "pictures")
    ran = aquaflow(*asked)
    assert "None says in EXIF where it was taken" in ran.out
    assert "it lacks a position" in ran.out
    assert gps_of(dive.path / "colmap" / "images" / "000000.png") == {}
    assert json.loads(aquaflow(*asked, "--json").out)["geotagged"] is False


@pytest.mark.parametrize("below_deg", [20.0, 60.0, 89.0])
@pytest.mark.parametrize("heading_deg", [0.0, 135.0, 350.0])
def test_the_heading_is_where_the_camera_looks_or_its_top_when_it_looks_down(
    tmp_path: Path, heading_deg: float, below_deg: float
) -> None:
    dive = placed_dive(tmp_path)
    view = dive.map().views[0]
    heading, below = math.radians(heading_deg), math.radians(below_deg)
    ahead = np.array([math.cos(heading), math.sin(heading), 0.0])
    down = np.array([0.0, 0.0, 1.0])
    looks = math.cos(below) * ahead + math.sin(below) * down
    bottom = math.cos(below) * down - math.sin(below) * ahead
    R_nc = np.column_stack([np.cross(bottom, looks), bottom, looks])
    T_nm = dive.frame.T_nm
    view.T_wc = Sim3(T_nm.R.T @ R_nc, view.T_wc.t)
    exif = exif_of_views(dive, [view])[view.frame_index]
    with tifffile.TiffFile(io.BytesIO(exif)) as file:
        above, under = file.pages.first.tags["GPSTag"].value["GPSImgDirection"]
    assert (above / under - heading_deg + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=1e-4)
