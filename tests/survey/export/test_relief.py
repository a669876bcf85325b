"""The hillshade and the contours beside a dive's elevations."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio

from aquaflow.survey.export.ortho import grid as grid_module
from aquaflow.survey.export.ortho.relief import INTERVAL_SIGMAS, interval, shade
from tests.command_line import Cli
from tests.survey.export.survey_scenes import UTM_32, surveyed, write_survey


def test_a_slope_is_as_light_as_it_faces_the_north_west() -> None:
    y, x = np.mgrid[0:5, 0:5].astype(float)
    falls = {"north west": x + y, "south east": -x - y, "nowhere": 0.0 * x}
    found = {name: shade(heights, 2.0) for name, heights in falls.items()}
    assert found["nowhere"].shape == (3, 3)
    np.testing.assert_array_equal(found["nowhere"], round(255.0 * np.sin(np.pi / 4.0)))
    rise = 0.5 * np.hypot(1.0, 1.0)  # over the pixels of 2
    lit = (1.0 + rise) / np.sqrt(2.0 * (1.0 + rise**2))
    np.testing.assert_allclose(found["north west"], 255.0 * lit, atol=1.0)
    assert found["south east"].max() < 80


def test_a_hole_beside_a_pixel_makes_no_cliff() -> None:
    heights = np.full((5, 5), 3.0)
    heights[2, 3] = np.nan
    np.testing.assert_array_equal(shade(heights, 1.0)[:, :2], 180)


@pytest.mark.parametrize(
    ("spread", "sigma", "wanted"), [(1.0, 0.0, 0.1), (3.0, 0.0, 0.5), (0.1, 0.02, 0.05)]
)
def test_contours_are_round_numbers_that_sigmas_allow(
    spread: float, sigma: float, wanted: float
) -> None:
    heights = np.linspace(-7.0, -7.0 + spread / 0.96, 1001)
    assert interval(heights, np.full(3, sigma)) == pytest.approx(wanted)
    assert wanted >= INTERVAL_SIGMAS * sigma


def test_flat_ground_has_no_contours() -> None:
    assert interval(np.full(5, -3.0), np.zeros(5)) == 0.0
    assert interval(np.zeros(0), np.zeros(0)) == 0.0


def test_both_lie_on_the_elevations_and_are_named_after_them(
    command: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dive = write_survey(tmp_path / "dive", surveyed())
    ran = command("export", dive, "--format", "dem", "--out", tmp_path / "reef.tif")
    assert ran.code == 0, ran.err
    with (
        rasterio.open(tmp_path / "reef.tif") as dem,
        rasterio.open(tmp_path / "reef_hillshade.tif") as shaded,
    ):
        assert shaded.transform == dem.transform
        assert shaded.crs == dem.crs
        heights, grey = dem.read(1, masked=True), shaded.read()
        np.testing.assert_array_equal(grey[3] == 255, ~np.ma.getmaskarray(heights))
        assert grey[0][grey[3] == 255].std() > 10.0
        rows = json.loads((tmp_path / "reef_contours.geojson").read_text())
        assert rows["crs"]["properties"]["name"] == f"urn:ogc:def:crs:EPSG::{UTM_32}"
        assert len(rows["features"]) >= 4
        to_pixels = ~dem.transform
        for feature in rows["features"]:
            height = feature["properties"]["height"]
            for line in feature["geometry"]["coordinates"]:
                column, row = np.floor([to_pixels * place for place in line]).astype(int).T
                near = heights[row, column].compressed()
                assert np.abs(near - height).max() < 0.1
                assert abs(near.mean() - height) < 0.01


def test_tiles_of_a_hillshade_meet_without_a_seam(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from aquaflow.dive.dive import Dive
    from aquaflow.survey.export.ortho.survey import export_survey

    dive = Dive(write_survey(tmp_path / "dive", surveyed()))
    export_survey(dive, {"dem": tmp_path / "one"}, resolution=0.03)
    monkeypatch.setattr(grid_module, "TILE_PX", 48)
    export_survey(dive, {"dem": tmp_path / "many"}, resolution=0.03)
    with (
        rasterio.open(tmp_path / "one" / "dem_hillshade.tif") as one,
        rasterio.open(tmp_path / "many" / "dem_hillshade.tif") as many,
    ):
        np.testing.assert_allclose(one.read().astype(int), many.read(), atol=1)
