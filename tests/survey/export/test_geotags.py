"""`aquaflow export --format geotags,odm`: where each picture was taken, on the map's grid."""

from __future__ import annotations

import csv
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pyproj import Geod, Proj
from scipy.spatial.transform import Rotation

from aquaflow.base.errors import InputError
from aquaflow.dive.dive import Dive
from aquaflow.survey.export.formats import ExportFormat, all_formats
from aquaflow.survey.export.geotags import attitudes, read_geotags, write_geo_txt
from aquaflow.telemetry.metric_file import write_metric_file
from tests.command_line import Cli, refused
from tests.metric_scenes import TRONDHEIM
from tests.survey.export.survey_scenes import UTM_32

CAMERA_FROM_BODY = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Right, down, forward from top of the picture, right, viewing direction."""


@pytest.fixture
def placed(small_dive: Path, tmp_path: Path) -> Dive:
    """The small dive, off Trondheim, its compass taken for one of true north."""
    folder = Path(shutil.copytree(small_dive, tmp_path / "dive"))
    frame = replace(Dive(folder).frame, north="true north", origin=TRONDHEIM)
    write_metric_file(folder, {0: frame}, main=0)
    return Dive(folder)


def test_tables_say_where_the_pictures_were_taken(
    placed: Dive, command: Cli, tmp_path: Path
) -> None:
    ran = command("export", placed.path, "--format", "geotags,odm", "--out", tmp_path / "out")
    assert ran.code == 0, ran.err
    assert f"EPSG:{UTM_32}, heights above the water surface" in ran.out
    with (tmp_path / "out" / "geotags.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    poses = placed.trajectory
    assert [row["file"] for row in rows] == [
        row.source for row in placed.frames if row.sub_map == 0
    ]
    to_grid, geod = Proj(f"EPSG:{UTM_32}"), Geod(ellps="WGS84")
    origin = TRONDHEIM.longitude_deg, TRONDHEIM.latitude_deg
    turned = to_grid.get_factors(*origin).meridian_convergence
    for row, (north, east, down), R_nc in zip(rows, poses.positions, poses.R_wc, strict=True):
        number = {name: float(text) for name, text in row.items() if name != "file"}
        bearing = np.degrees(np.arctan2(east, north))
        longitude, latitude, _ = geod.fwd(*origin, bearing, np.hypot(north, east))
        easting, northing = to_grid(longitude, latitude)
        assert number["longitude_deg"] == pytest.approx(longitude, abs=2e-9)
        assert number["latitude_deg"] == pytest.approx(latitude, abs=2e-9)
        assert number["easting_m"] == pytest.approx(easting, abs=1e-3)
        assert number["northing_m"] == pytest.approx(northing, abs=1e-3)
        assert number["height_m"] == pytest.approx(-down, abs=1e-4)
        angles = [number[f"{name}_deg"] for name in ("yaw", "pitch", "roll")]
        to_true = Rotation.from_euler("z", turned, degrees=True)
        R = to_true * Rotation.from_euler("ZYX", angles, degrees=True)
        np.testing.assert_allclose(R.as_matrix() @ CAMERA_FROM_BODY.T, R_nc, atol=1e-4)
        assert TRONDHEIM.sigma_m <= number["sigma_horizontal_m"] < 2.0 * TRONDHEIM.sigma_m


def test_opendronemap_s_table_has_the_same_in_its_order(
    placed: Dive, command: Cli, tmp_path: Path
) -> None:
    out = tmp_path / "geo.txt"
    ran = command("export", placed.path, "--format", "odm", "--out", out)
    assert ran.code == 0, ran.err
    projection, *lines = out.read_text().splitlines()
    tags = read_geotags(placed)
    assert projection == f"EPSG:{UTM_32}"
    assert [line.split()[0] for line in lines] == list(tags.files)
    numbers = np.array([[float(each) for each in line.split()[1:]] for line in lines])
    expected = np.hstack([tags.places, tags.angles, tags.sigmas])
    np.testing.assert_allclose(numbers, expected, atol=6e-5)


@pytest.mark.parametrize(
    ("looks", "top", "angles"),
    [
        ((0, 0, 1), (1, 0, 0), (0.0, 0.0, 0.0)),
        ((0, 0, 1), (0, 1, 0), (90.0, 0.0, 0.0)),
        ((0.6, 0, 0.8), (0.8, 0, -0.6), (0.0, 36.8699, 0.0)),
        ((0, 0.6, 0.8), (1, 0, 0), (0.0, 0.0, -36.8699)),
    ],
)
def test_angles_are_those_that_metashape_means(
    looks: tuple[float, ...], top: tuple[float, ...], angles: tuple[float, ...]
) -> None:
    """Zero looks down with north on top; yaw is clockwise, and a pitch looks ahead."""
    z, y = np.array(looks, float), -np.array(top, float)
    R_nc = np.column_stack([np.cross(y, z), y, z])
    np.testing.assert_allclose(attitudes(np.eye(3), R_nc[None])[0], angles, atol=1e-3)


def test_a_dive_without_a_place_is_refused_with_what_it_lacks(
    small_dive: Path, command: Cli, tmp_path: Path
) -> None:
    out = tmp_path / "geotags.csv"
    ran = command("export", small_dive, "--format", "geotags", "--out", out)
    refused(ran, small_dive, "it lacks true north, a position", "--telemetry")
    assert not out.exists()


def test_all_formats_have_geotags_only_where_there_are_some(placed: Dive, small_dive: Path) -> None:
    tables = {ExportFormat.geotags, ExportFormat.odm}
    assert tables < set(all_formats(placed))
    assert set(all_formats(Dive(small_dive))) == set(ExportFormat) - tables


def test_a_name_that_opendronemap_would_split_is_refused(placed: Dive, tmp_path: Path) -> None:
    tags = replace(read_geotags(placed), files=["my dive.png"])
    with pytest.raises(InputError, match=r"'my dive\.png' with its spaces"):
        write_geo_txt(tmp_path / "geo.txt", tags)
    assert not (tmp_path / "geo.txt").exists()
