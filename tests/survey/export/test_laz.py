"""Points of a dive as LAZ: read back by laspy, compared with what the scene is."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyproj import CRS, Geod, Transformer
from typer.testing import CliRunner

from aquaflow.base.errors import ArgumentError, InputError
from aquaflow.base.storage import archive
from aquaflow.cli import app
from aquaflow.dive import point_cloud
from aquaflow.dive.dive import Dive
from aquaflow.dive.ply import PlyFile, PlyGaussians, Which, read_ply
from aquaflow.dive.point_cloud import (
    PosedView,
    nearest_cameras,
    read_point_cloud,
    read_posed_views,
)
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.survey.export.point_clouds import write_laz
from tests.survey.export.small_dive import (
    ORIGIN,
    SCALE,
    SHIFT,
    SPREAD,
    THICKNESS,
    north_up_frame,
    write_small_dive,
)

laspy = pytest.importorskip("laspy", reason="laspy is not installed")
pytest.importorskip("lazrs", reason="lazrs is not installed")


@pytest.fixture
def dive(tmp_path: Path) -> Path:
    write_small_dive(tmp_path / "dive", north_up_frame())
    return tmp_path / "dive"


def written(dive: Path, path: Path, water: bool = False) -> Any:
    write_laz(path, read_point_cloud(Dive(dive), water))
    return laspy.read(path)


def test_a_point_on_the_earth_is_within_a_millimetre_of_its_utm_coordinates(
    dive: Path, tmp_path: Path
) -> None:
    cloud = written(dive, tmp_path / "a.laz")
    north, east, down = read_ply(dive / "map_clear.ply").means.astype(float).T
    azimuth, distance = np.degrees(np.arctan2(east, north)), np.hypot(east, north)
    start = np.full_like(north, ORIGIN.longitude_deg), np.full_like(north, ORIGIN.latitude_deg)
    longitude, latitude, _ = Geod(ellps="WGS84").fwd(*start, azimuth, distance)
    grid = Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True)
    easting, northing = grid.transform(longitude, latitude)
    assert len(cloud.x) == 40 * 30
    assert np.abs(cloud.x - easting).max() < 1e-3
    assert np.abs(cloud.y - northing).max() < 1e-3
    assert np.abs(cloud.z + down).max() < 1e-3


def test_the_file_names_its_grid_as_las_1_4_asks(dive: Path, tmp_path: Path) -> None:
    header = written(dive, tmp_path / "a.laz").header
    assert str(header.version) == "1.4"
    assert header.point_format.id == 7
    assert header.global_encoding.wkt
    assert header.parse_crs() == CRS.from_epsg(32632)
    assert header.vlrs.get("WktCoordinateSystemVlr")[0].string.startswith("PROJCS[")
    assert header.scales.max() <= 1e-3


def test_normals_face_the_camera_and_point_as_the_grid_does(dive: Path, tmp_path: Path) -> None:
    cloud = written(dive, tmp_path / "a.laz")
    normals = np.stack([cloud.NormalX, cloud.NormalY, cloud.NormalZ], axis=1)
    np.testing.assert_allclose(normals, np.tile([0.0, 0.0, 1.0], (len(normals), 1)), atol=1e-6)


def test_directions_turn_to_the_grid_as_positions_do(dive: Path) -> None:
    where = read_point_cloud(Dive(dive)).placement
    ahead = np.array([[0.0, 100.0, 0.0]])
    moved = where.on_grid(ahead)[0] - where.on_grid(np.zeros((1, 3)))[0]
    turned = where.turned_to_grid(ahead)[0]
    assert abs(turned[0]) > 1.0  # 1.4 degrees between true north and the grid's
    np.testing.assert_allclose(moved / np.linalg.norm(moved), turned / 100.0, atol=1e-5)


def test_sigma_is_the_spread_along_the_ray(dive: Path, tmp_path: Path) -> None:
    views, _ = read_posed_views(Dive(dive), Dive(dive).views())
    cloud = read_point_cloud(Dive(dive))
    points = next(cloud.chunks())
    rays = points.positions - nearest_cameras(points.positions, views)
    cosine = np.abs(rays[:, 2]) / np.linalg.norm(rays, axis=1)
    expected = SCALE * np.hypot(THICKNESS * cosine, SPREAD * np.sqrt(1.0 - cosine**2))
    found = written(dive, tmp_path / "a.laz").sigma
    np.testing.assert_allclose(found, expected, rtol=1e-3)
    assert found.min() < 1.05 * SCALE * THICKNESS


def test_colours_are_those_of_the_clear_map_or_of_the_map_in_water(
    dive: Path, tmp_path: Path
) -> None:
    for water, name in ((False, "map_clear.ply"), (True, "map.ply")):
        cloud = written(dive, tmp_path / "a.laz", water)
        found = np.stack([cloud.red, cloud.green, cloud.blue], axis=1) / 65535.0
        expected = np.clip(read_ply(dive / name).colours, 0.0, 1.0)
        assert np.abs(found - expected).max() < 0.51 / 255.0


def test_a_dive_in_map_units_says_so_and_has_no_grid(tmp_path: Path) -> None:
    write_small_dive(tmp_path / "dive")
    cloud = written(tmp_path / "dive", tmp_path / "a.laz")
    assert cloud.header.parse_crs() is None
    text = next(v for v in cloud.header.vlrs if v.record_id == 3 and v.user_id == "LASF_Spec")
    assert b"map units" in text.record_data
    assert np.abs(cloud.y - 2.0).max() < 1e-3  # the floor is two units before the camera
    assert np.abs(cloud.z).max() < 1.1


def test_memory_holds_a_chunk_of_the_map_and_the_views_alone(
    dive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(point_cloud, "CHUNK", 97)
    held: list[int] = []
    arrays: list[str] = []
    rows, read = PlyFile.rows, archive.read_array

    def counted(file: PlyFile, which: Which) -> PlyGaussians:
        found = rows(file, which)
        held.append(len(found))
        return found

    def named(file: Any, name: str, most_bytes: int | None = None) -> Any:
        arrays.append(name)
        return read(file, name, most_bytes)

    monkeypatch.setattr(PlyFile, "rows", counted)
    monkeypatch.setattr(archive, "read_array", named)
    assert len(written(dive, tmp_path / "a.laz").x) == 1200
    assert max(held) == 97
    assert "views.poses" in arrays
    assert not any(name.startswith("gaussians.") for name in arrays)


def test_each_point_has_the_nearest_camera_that_shows_it() -> None:
    camera = CameraModel(64, 48, 80.0, 80.0, 32.0, 24.0)
    rng = np.random.default_rng(0)
    views = [
        PosedView(k, camera, Sim3(so3_exp(rng.normal(0.0, 0.4, 3)), rng.uniform(-3.0, 3.0, 3)))
        for k in range(60)
    ]
    points = rng.uniform((-4.0, -4.0, 0.0), (4.0, 4.0, 8.0), (400, 3))
    found = nearest_cameras(points, views)
    unseen = 0
    for point, centre in zip(points, found, strict=True):
        local = [(point[None] - view.T_uc.t) @ view.T_uc.R for view in views]
        shows = [view for view, at in zip(views, local, strict=True) if view.shows(at)[0]]
        unseen += not shows
        among = np.array([view.T_uc.t for view in shows or views])
        best = among[np.linalg.norm(among - point, axis=1).argmin()]
        np.testing.assert_array_equal(centre, best)
    assert 0 < unseen < 200


def test_chunks_change_nothing(dive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = written(dive, tmp_path / "a.laz")
    monkeypatch.setattr(point_cloud, "CHUNK", 97)
    steps: list[tuple[int, int]] = []
    write_laz(tmp_path / "b.laz", read_point_cloud(Dive(dive)), lambda *step: steps.append(step))
    parts = laspy.read(tmp_path / "b.laz")
    np.testing.assert_array_equal(whole.points.array, parts.points.array)
    assert steps[0] == (97, 1200)
    assert steps[-1] == (1200, 1200)


def test_a_camera_that_does_not_see_a_point_is_taken_only_where_none_does(dive: Path) -> None:
    views, _ = read_posed_views(Dive(dive), Dive(dive).views())
    first = next(view for view in views if view.frame_index == 0)
    below = first.T_uc.apply(np.array([[0.0, 0.0, 3.0], [0.0, 0.0, -3.0]]))
    seen, unseen = nearest_cameras(below, [first])
    np.testing.assert_allclose(seen, [SHIFT[1], SHIFT[0], -SHIFT[2]], atol=1e-12)
    np.testing.assert_allclose(unseen, seen)
    behind = views[0].T_uc.apply(np.array([[0.0, 0.0, -0.5]]))
    assert not any(view.shows(view.T_uc.inverse().apply(behind))[0] for view in views)


def test_a_map_of_haze_alone_gives_no_points(dive: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(point_cloud, "LEAST_OPACITY", 0.95)
    with pytest.raises(InputError, match=r"has an opacity of 0\.95 or more"):
        read_point_cloud(Dive(dive))


def test_a_missing_package_is_named_with_what_installs_it(
    dive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "lazrs", None)
    with pytest.raises(InputError, match=r"lazrs.*pip install 'aquaflow\[survey\]'"):
        write_laz(tmp_path / "a.laz", read_point_cloud(Dive(dive)))
    assert not list(tmp_path.glob("*.laz"))


def test_the_command_writes_into_the_dive_and_says_where_the_points_lie(dive: Path) -> None:
    asked = ["export", str(dive), "--format", "laz"]
    result = CliRunner().invoke(app, [*asked, "--json"])
    assert result.exit_code == 0, result.output
    said = json.loads(result.output)
    assert said["out"] == str(dive / "points.laz")
    assert (said["points"], said["unit"], said["epsg"]) == (1200, "m", 32632)
    assert laspy.read(dive / "points.laz").header.point_count == 1200
    assert "1200 points" in CliRunner().invoke(app, asked).output


def test_an_option_of_another_format_is_refused(dive: Path) -> None:
    asked = ["export", str(dive), "--format", "restored", "--water"]
    result = CliRunner().invoke(app, asked)
    assert isinstance(result.exception, ArgumentError)
    assert "knows no --water" in str(result.exception)
