"""Orthos and elevations of a dive over a ground of known height and colour."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import rasterio
import torch
from scipy.ndimage import map_coordinates
from typer.testing import CliRunner

from aquaflow.base.errors import ArgumentError, InputError
from aquaflow.cli import app
from aquaflow.dive.dive import Dive
from aquaflow.dive.shown_views import on_ground
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.export.formats import ExportFormat
from aquaflow.survey.export.ortho import grid as grid_module
from aquaflow.survey.export.ortho.survey import export_survey
from aquaflow.telemetry.world_frame import WorldFrame
from tests.metric_scenes import metric_frame
from tests.survey.export.survey_scenes import (
    ALTITUDE_M,
    DEPTH_M,
    LOOKS_DOWN,
    SIDE_M,
    UTM_32,
    colour,
    height,
    on_utm,
    surveyed,
    write_survey,
)

Array = npt.NDArray[np.float64]

NODATA = -9999.0
LOCAL = {"origin": None, "north": "initial heading"}
"""What a level, metric frame without a place on the earth differs in."""


@pytest.fixture(scope="module")
def dive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_survey(tmp_path_factory.mktemp("survey") / "dive", surveyed())


@pytest.fixture(scope="module")
def local_dive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    frame = metric_frame(**LOCAL)
    return write_survey(tmp_path_factory.mktemp("local") / "dive", surveyed(frame), frame)


def read(path: Path) -> tuple[Array, rasterio.DatasetReader]:
    with rasterio.open(path) as dataset:
        return dataset.read().astype(np.float64), dataset


def ground_points() -> tuple[Array, Array]:
    """North and east of points of the ground that three views at least see."""
    steps = np.linspace(0.5, SIDE_M - 0.9, 60)
    north, east = np.meshgrid(steps, steps)
    return north.ravel(), east.ravel()


def at(
    band: Array,  # [h, w]
    dataset: rasterio.DatasetReader,
    places: Array,  # [N, 2] raster coordinates
) -> Array:
    to = dataset.transform
    at_pixels = [(places[:, 1] - to.f) / to.e - 0.5, (places[:, 0] - to.c) / to.a - 0.5]
    return np.asarray(map_coordinates(band, at_pixels, order=1))


def tags(path: Path) -> dict[str, str]:
    with rasterio.open(path) as dataset:
        return dict(dataset.tags())


def test_heights_and_places_are_those_of_the_ground(dive: Path, tmp_path: Path) -> None:
    export_survey(Dive(dive), {"dem": tmp_path})
    bands, dataset = read(tmp_path / "dem.tif")
    assert dataset.crs.to_epsg() == UTM_32
    north, east = ground_points()
    truth = height(north, east) - DEPTH_M
    places = on_utm(np.column_stack([north, east, -truth]))
    found, views = at(bands[0], dataset, places), at(bands[2], dataset, places)
    assert (views >= 3.0).mean() > 0.95
    error = (found - truth)[views >= 3.0]
    assert np.sqrt(np.mean(error**2)) < 0.01 * ALTITUDE_M
    assert abs(np.median(error)) < 0.003
    assert tags(tmp_path / "dem.tif")["HEIGHT_ZERO"] == "the water surface"


def test_stated_heights_hold_the_truth_and_are_wider_where_the_map_is_rough(
    local_dive: Path, tmp_path: Path
) -> None:
    frame = metric_frame(**LOCAL)
    rough = surveyed(frame)
    means = rough.scene.gaussians.parameters["means"]
    down = torch.from_numpy(frame.T_nm.inverse().R[:, 2] * (0.03 / frame.T_nm.scale))
    noise = torch.randn(len(means), 1, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        means += (noise * down).to(means.dtype)
    north, east = ground_points()
    sigmas = []
    for number, dive in enumerate((local_dive, write_survey(tmp_path / "dive", rough, frame))):
        export_survey(Dive(dive), {"dem": tmp_path / str(number)})
        bands, dataset = read(tmp_path / str(number) / "dem.tif")
        found, sigma = (at(band, dataset, np.column_stack([east, north])) for band in bands[:2])
        if dive == local_dive:
            error = np.abs(found - (height(north, east) - DEPTH_M))
            assert (error < 1.96 * sigma).mean() > 0.95
        sigmas.append(float(np.median(sigma)))
    # Half a pixel of a view is 7 mm of ground, which the angles of this survey make 10.
    assert sigmas[0] == pytest.approx(0.010, abs=0.002)
    assert sigmas[1] > 1.5 * sigmas[0]


def test_colours_lie_where_the_ground_has_them(dive: Path, tmp_path: Path) -> None:
    export_survey(Dive(dive), {"ortho": tmp_path})
    bands, dataset = read(tmp_path / "ortho.tif")
    north, east = ground_points()
    places = on_utm(np.column_stack([north, east, DEPTH_M - height(north, east)]))
    found = np.column_stack([at(band, dataset, places) for band in bands[:3]]) / 255.0
    assert np.abs(found - colour(north, east)).mean() < 0.01
    assert (at(bands[3], dataset, places) > 254.9).mean() > 0.99


def test_tiles_leave_no_seams(dive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    export_survey(Dive(dive), {"ortho": tmp_path / "whole"})
    monkeypatch.setattr(grid_module, "TILE_PX", 48)
    steps: list[tuple[str, int, int]] = []
    export_survey(
        Dive(dive), {"ortho": tmp_path / "tiled"}, progress=lambda *step: steps.append(step)
    )
    whole, tiled = (read(tmp_path / name / "ortho.tif")[0] for name in ("whole", "tiled"))
    assert steps[-1][0] == "tiles"
    assert steps[-1][1] == steps[-1][2] > 9
    both = (whole[3] == 255.0) & (tiled[3] == 255.0)
    assert both.sum() > 0.995 * (whole[3] == 255.0).sum()
    assert np.abs(whole - tiled)[:3, both].max() <= 4.0


def test_a_coarser_raster_has_the_same_heights(local_dive: Path, tmp_path: Path) -> None:
    survey = export_survey(Dive(local_dive), {"dem": tmp_path}, resolution=0.05)
    bands, dataset = read(tmp_path / "dem.tif")
    assert dataset.res == (0.05, 0.05)
    assert survey.resolution == 0.05
    north, east = ground_points()
    places = np.column_stack([east, north])
    error = at(bands[0], dataset, places) - (height(north, east) - DEPTH_M)
    assert np.sqrt(np.mean(error**2)) < 0.01 * ALTITUDE_M


def test_holes_are_nodata_and_transparent(dive: Path, tmp_path: Path) -> None:
    for kind in ("ortho", "dem"):
        survey = export_survey(Dive(dive), {kind: tmp_path})  # type: ignore[arg-type]
        assert 0.3 < survey.covered < 1.0
    heights, dem = read(tmp_path / "dem.tif")
    colours, _ = read(tmp_path / "ortho.tif")
    quality, _ = read(tmp_path / "ortho_quality.tif")
    assert dem.nodata == NODATA
    holes = heights[0] == NODATA
    assert holes.any()
    np.testing.assert_array_equal(holes, colours[3] == 0.0)
    assert not colours[:3, holes].any()
    assert (heights[:, holes] == NODATA).all()
    assert (quality[:, holes] == NODATA).all()
    assert (quality[0, ~holes] >= 2.0).all()
    np.testing.assert_array_equal(quality[1], heights[1])


def test_files_are_cloud_optimised_and_say_what_they_are(dive: Path, tmp_path: Path) -> None:
    survey = export_survey(Dive(dive), {"ortho": tmp_path}, resolution=0.005)
    assert [path.name for path in survey.files["ortho"]] == ["ortho.tif", "ortho_quality.tif"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ortho.tif", "ortho_quality.tif"]
    for path in survey.files["ortho"]:
        with rasterio.open(path) as dataset:
            assert dataset.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
            assert dataset.block_shapes[0] == (512, 512)
            assert dataset.overviews(1)
            assert all(dataset.descriptions)
    with rasterio.open(survey.files["ortho"][0]) as dataset:
        assert [each.name for each in dataset.colorinterp] == ["red", "green", "blue", "alpha"]
    said = tags(survey.files["ortho"][0])
    assert said["VERTICAL"] == "along gravity"
    assert said["COLOURS"] == "without water"
    assert "poses are taken as exact" in said["SIGMA"]


def test_a_dive_without_a_place_has_no_eastings(local_dive: Path, tmp_path: Path) -> None:
    """Readers of a GeoTIFF call the axes of any local system easting and northing."""
    survey = export_survey(Dive(local_dive), {"dem": tmp_path})
    _, dataset = read(tmp_path / "dem.tif")
    assert survey.ground.epsg is None
    assert dataset.crs is None
    said = tags(tmp_path / "dem.tif")
    assert (said["UNIT"], said["AXES"]) == ("m", "x to the right, y initial heading, z up; m")


def test_a_dive_that_knows_north_but_no_place_lies_in_local_metres(tmp_path: Path) -> None:
    frame = metric_frame(T_nm=Sim3.identity(), origin=None)
    dive = write_survey(tmp_path / "d", surveyed(frame), frame)
    export_survey(Dive(dive), {"dem": tmp_path})
    _, dataset = read(tmp_path / "dem.tif")
    assert dataset.crs.to_epsg() is None
    assert 'UNIT["metre",1' in dataset.crs.to_wkt()
    assert "x east, y north" in dataset.crs.to_wkt()


def test_a_dive_without_metres_and_gravity_says_so(tmp_path: Path) -> None:
    mapper = surveyed(metric_frame(T_nm=Sim3.identity()))
    frame = on_ground(WorldFrame.unknown(), mapper)
    survey = export_survey(Dive(write_survey(tmp_path / "d", mapper, frame)), {"dem": tmp_path})
    bands, dataset = read(tmp_path / "dem.tif")
    assert dataset.crs is None
    assert tags(tmp_path / "dem.tif")["UNIT"] == "map units"
    assert "gravity is unknown" in tags(tmp_path / "dem.tif")["VERTICAL"]
    north, east = ground_points()
    to_ground = survey.ground.T_gm.R  # n is the sub-map's world
    truth = np.column_stack([north, east, DEPTH_M - height(north, east)]) @ to_ground.T
    error = at(bands[0], dataset, truth[:, :2]) - truth[:, 2]
    assert np.sqrt(np.nanmean(error[np.abs(error) < 1.0] ** 2)) < 0.01 * ALTITUDE_M
    assert (np.abs(error) < 1.0).mean() > 0.95  # the rest are holes, of -9999


def test_views_that_look_all_around_have_no_vertical(tmp_path: Path) -> None:
    mapper = surveyed(metric_frame(T_nm=Sim3.identity()))
    for number, view in enumerate(mapper.views):
        turn = Sim3.exp(np.array([0.0, 0.0, 0.0, 0.5 * np.pi * number, 0.0, 0.0, 0.0]))
        view.T_wc = Sim3(turn.R @ LOOKS_DOWN, view.T_wc.t)
    frame = on_ground(WorldFrame.unknown(), mapper)
    dive = write_survey(tmp_path / "d", mapper, frame)
    with pytest.raises(InputError, match="says which way is down"):
        export_survey(Dive(dive), {"dem": tmp_path})


def test_with_water_the_ground_is_seen_from_the_median_range(tmp_path: Path) -> None:
    mapper = surveyed()
    murk = [torch.tensor(v) for v in ((0.5, 0.3, 0.2), (0.1, 0.25, 0.3), (0.5, 0.4, 0.3))]
    mapper.medium.set_water(*murk)
    dive = write_survey(tmp_path / "d", mapper)
    survey = export_survey(Dive(dive), {"ortho": tmp_path}, water=True)
    assert survey.water_range == pytest.approx(ALTITUDE_M, rel=0.1)
    bands, dataset = read(tmp_path / "ortho.tif")
    assert "of water" in tags(tmp_path / "ortho.tif")["COLOURS"]
    north, east = ground_points()
    places = on_utm(np.column_stack([north, east, DEPTH_M - height(north, east)]))
    z = torch.tensor([survey.water_range / metric_frame().T_nm.scale])
    water = mapper.scene.water(mapper.views[0])
    assert water is not None
    with torch.no_grad():
        T, B = water.transmission(z).numpy(), water.backscatter(z).numpy()
    found = np.column_stack([at(band, dataset, places) for band in bands[:3]]) / 255.0
    assert np.abs(found - (colour(north, east) * T + B)).mean() < 0.01


def test_too_many_pixels_are_refused(dive: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="coarser --resolution"):
        export_survey(Dive(dive), {"dem": tmp_path}, resolution=1e-6)
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_written_to_is_refused(dive: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match="give a folder with room"):
        export_survey(Dive(dive), {"dem": tmp_path / "file" / "out"})


def test_without_rasterio_one_sentence_says_what_to_install(
    dive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rasterio", None)
    with pytest.raises(InputError, match=r"pip install 'aquaflow\[survey\]'"):
        export_survey(Dive(dive), {"dem": tmp_path})


def test_the_command_prints_one_object(dive: Path, tmp_path: Path) -> None:
    arguments = ["export", str(dive), "--format", "dem", "--out", str(tmp_path), "--json"]
    ran = CliRunner().invoke(app, arguments)
    assert ran.exit_code == 0, ran.output
    said = json.loads(ran.stdout)
    names = ["dem.tif", "dem_hillshade.tif", "dem_contours.geojson"]
    assert said["files"] == [str(tmp_path / name) for name in names]
    assert said["epsg"] == UTM_32
    assert said["unit"] == "m"
    assert 0.3 < said["covered"] < 1.0


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["ortho", "--recording", "clip.mp4"], "knows no --recording"),
        (["restored", "--resolution", "0.01"], "knows no --resolution"),
        (["dem", "--water"], "knows no --water"),
        (["dem", "--resolution", "0"], "--resolution 0 is no size"),
        (["ortho", "--resolution", "nan"], "--resolution nan is no size"),
    ],
)
def test_options_that_do_not_go_together_are_refused(
    dive: Path, options: list[str], sentence: str
) -> None:
    ran = CliRunner().invoke(app, ["export", str(dive), "--format", *options])
    assert isinstance(ran.exception, ArgumentError)
    assert sentence in str(ran.exception)


@pytest.mark.parametrize("format", list(ExportFormat))
def test_a_folder_without_a_map_is_no_dive_in_any_format(
    format: ExportFormat, tmp_path: Path
) -> None:
    ran = CliRunner().invoke(app, ["export", str(tmp_path), "--format", format.value])
    assert isinstance(ran.exception, InputError)
    assert "holds no finished dive: " in str(ran.exception)
    assert " is missing" in str(ran.exception)


def test_a_dive_with_an_empty_map_is_refused(tmp_path: Path) -> None:
    mapper = surveyed()
    mapper.views = []
    dive = write_survey(tmp_path / "d", mapper)
    with pytest.raises(InputError, match="is empty"):
        export_survey(Dive(dive), {"dem": tmp_path})


def test_a_frame_that_is_not_metric_keeps_its_unit(tmp_path: Path) -> None:
    frame = replace(metric_frame(**LOCAL), metric=False)
    survey = export_survey(Dive(write_survey(tmp_path / "d", surveyed(), frame)), {"dem": tmp_path})
    assert survey.ground.unit == "map units"
    assert survey.ground.vertical == "along gravity"
