"""All products of one dive lie in one frame, with gravity and without: each is read with the
library that its users read it with, and lies over the ortho and the elevations to a pixel."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import pytest
from mcap.reader import make_reader

from aquaflow.config.service import ViewerConfig
from aquaflow.dive.dive import read_dive
from aquaflow.survey.viewer.finished import open_dive
from tests.command_line import Cli
from tests.made_once import made_once
from tests.small_recording import HASTY

rasterio = pytest.importorskip("rasterio")
laspy = pytest.importorskip("laspy")
pye57 = pytest.importorskip("pye57")
trimesh = pytest.importorskip("trimesh")
decoder = pytest.importorskip("mcap_ros2.decoder")

pytestmark = pytest.mark.ci

Array = npt.NDArray[np.float64]

FORMATS = "ortho,dem,laz,e57,ply,glb,nerfstudio,mcap"
SYNTHETIC = ("--scene", "survey", "--frames", 6, "--width", 160, "--height", 120)
LARGEST_SHIFT_PX = 4
"""That is looked for, in both directions."""
HEIGHT_PX = 2.0
"""Of points and triangles against the elevations: upper Gaussians hide lower ones, whose centres
are points too."""


Raster: TypeAlias = tuple[Array, Any]
"""[H, W] values, NaN in holes, and the affine map from its columns and rows to x and y."""


@dataclass(frozen=True)
class Products:
    """A dive and what is exported of it."""

    dive: Path
    folder: Path

    def file(self, name: str) -> Path:
        """Of the products, wherever it is."""
        return next(self.folder.rglob(name))

    def raster(self, name: str) -> Raster:
        """The first band."""
        with rasterio.open(self.file(name)) as dataset:
            band = dataset.read(1, masked=True).astype(np.float64)
            return band.filled(np.nan), dataset.transform

    def grey(self) -> Raster:
        """The mean of the ortho's colours."""
        with rasterio.open(self.file("ortho.tif")) as dataset:
            bands = dataset.read().astype(np.float64)
            return np.where(bands[3] > 0, bands[:3].mean(axis=0), np.nan), dataset.transform


@pytest.fixture(scope="module", params=["with gravity", "without gravity"])
def products(
    request: pytest.FixtureRequest, aquaflow: Cli, tmp_path_factory: pytest.TempPathFactory
) -> Products:
    """An AUV looks straight down; without its telemetry nothing knows gravity."""

    def make(folder: Path) -> None:
        ran = aquaflow("lab", "synth", folder / "recording", *SYNTHETIC)
        assert ran.code == 0, ran.err
        if request.param == "without gravity":
            (folder / "recording" / "telemetry.csv").unlink()
        for words in (
            ("map", folder / "recording", "--out", folder / "dive", *HASTY),
            ("export", folder / "dive", "--format", FORMATS, "--out", folder / "products"),
        ):
            ran = aquaflow(*words)
            assert ran.code == 0, ran.err

    folder = made_once(tmp_path_factory, f"products {request.param}", make)
    return Products(folder / "dive", folder / "products")


def on_pixels(
    places: Array,  # [N, 2] x, y
    values: Array,  # [N]
    raster: Raster,
) -> Array:
    """[H, W] mean of the values in each pixel; NaN where there are none."""
    (height, width), transform = raster[0].shape, raster[1]
    columns = np.floor((places[:, 0] - transform.c) / transform.a).astype(int)
    rows = np.floor((places[:, 1] - transform.f) / transform.e).astype(int)
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    at = rows[inside] * width + columns[inside]
    count = np.bincount(at, minlength=height * width)
    total = np.bincount(at, values[inside], height * width)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).reshape(height, width)


def shift_px(seen: Array, ortho: Array) -> tuple[int, int]:
    """Rows and columns by which ``seen`` fits the ortho best, both [H, W]."""
    reach, found = LARGEST_SHIFT_PX, {}
    inner = np.s_[reach:-reach, reach:-reach]
    for rows in range(-reach, reach + 1):
        for columns in range(-reach, reach + 1):
            moved = np.roll(seen, (rows, columns), (0, 1))[inner]
            both = np.isfinite(moved) & np.isfinite(ortho[inner])
            found[rows, columns] = float(np.corrcoef(moved[both], ortho[inner][both])[0, 1])
    return max(found, key=lambda each: found[each])


def lies_over(products: Products, points: Array, colours: Array) -> None:
    """Points [N, 3] with colours [N, 3] or more lie on the ortho's picture and on the heights."""
    ortho, heights = products.grey(), products.raster("dem.tif")
    grey = on_pixels(points[:, :2], colours[:, :3].astype(np.float64).mean(axis=1), ortho)
    assert shift_px(grey, ortho[0]) == (0, 0)
    off = on_pixels(points[:, :2], points[:, 2], heights) - heights[0]
    assert np.isfinite(off).sum() > 0.2 * np.isfinite(heights[0]).sum()
    assert abs(np.nanmedian(off)) < HEIGHT_PX * heights[1].a


def test_a_dive_without_gravity_says_what_its_axes_are(products: Products) -> None:
    said = (products.dive / "trajectory.tum").read_text()
    frame = read_dive(products.dive).frame
    assert frame.axes in said.splitlines()[0]
    assert frame.on_ground != frame.level
    with rasterio.open(products.file("dem.tif")) as dataset:
        tags = dataset.tags()
    known = "along gravity" if frame.level else "perpendicular to the mean plane of the ground"
    assert tags["VERTICAL"].startswith(known)
    assert tags["AXES"].startswith(f"x to the right, y {frame.ahead}, z up")


def test_laz_lies_over_the_ortho(products: Products) -> None:
    cloud = laspy.read(products.file("points.laz"))
    lies_over(products, cloud.xyz, np.column_stack([cloud.red, cloud.green, cloud.blue]))
    with rasterio.open(products.file("dem.tif")) as dataset:
        axes = dataset.tags()["AXES"].encode()
    assert axes in {record.record_data_bytes() for record in cloud.header.vlrs}


def test_e57_lies_over_the_ortho(products: Products) -> None:
    scan = pye57.E57(str(products.file("points.e57"))).read_scan(
        0, colors=True, ignore_missing_fields=True
    )
    points = np.column_stack([scan[f"cartesian{axis}"] for axis in "XYZ"])
    colours = np.column_stack([scan[f"color{name}"] for name in ("Red", "Green", "Blue")])
    lies_over(products, points, colours)


@pytest.mark.parametrize("name", ["mesh.ply", "points.ply"])
def test_ply_lies_over_the_ortho(products: Products, name: str) -> None:
    read = trimesh.load(products.file(name), process=False)
    colours = read.colors if name == "points.ply" else read.visual.vertex_colors
    lies_over(products, np.asarray(read.vertices), np.asarray(colours))


def test_glb_lies_over_the_ortho_and_has_y_up(products: Products) -> None:
    read = trimesh.load(products.file("mesh.glb"), force="mesh", process=False)
    x, y, z = np.asarray(read.vertices).T
    colours = np.asarray(read.visual.to_color().vertex_colors)
    lies_over(products, np.column_stack([x, -z, y]), colours)
    raw = products.file("mesh.glb").read_bytes()
    length = int.from_bytes(raw[12:16], "little")
    axes = json.loads(raw[20 : 20 + length])["asset"]["extras"]["axes"]
    assert axes.startswith("x to the right, y up, -z ")


def test_mcap_lies_over_the_ortho(products: Products) -> None:
    with products.file("dive.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[decoder.DecoderFactory()])
        [(_, _, _, cloud)] = reader.iter_decoded_messages(["/aquaflow/points"])
    assert cloud.header.frame_id == "map"
    kind = np.dtype([(field.name, "<f4") for field in cloud.fields])
    points = np.frombuffer(bytes(cloud.data), kind)
    packed = points["rgb"].view("<u4")
    colours = np.column_stack([packed >> shift & 255 for shift in (16, 8, 0)])
    places = np.column_stack([points[axis] for axis in "xyz"]).astype(np.float64)
    lies_over(products, places, colours)


def test_cameras_are_where_the_trajectory_says(products: Products) -> None:
    dive = read_dive(products.dive)
    posed = json.loads(products.file("transforms.json").read_text())["frames"]
    found = {
        int(Path(each["file_path"]).stem): np.array(each["transform_matrix"])[:3, 3]
        for each in posed
    }
    rows = {row.index: row for row in dive.poses}
    assert len(found) >= 3
    for index, place in found.items():
        row = rows[index]
        np.testing.assert_allclose(place, [row.y, row.x, -row.z], atol=1e-6)


def test_viewer_and_plan_have_the_same_up(products: Products) -> None:
    page = open_dive(products.dive, ViewerConfig(port=0, splats=100))
    try:
        assert page._exhibit.scene()["up"] == (0.0, 0.0, -1.0)
    finally:
        page.close()
    plan = json.loads((products.dive / "coverage.json").read_text())["0"]
    assert plan["up"] == read_dive(products.dive).frame.ahead


def test_a_measured_point_lies_on_the_heights(products: Products, aquaflow: Cli) -> None:
    said = aquaflow(
        *("measure", products.dive, "--point", "2:70,50", "--point", "2:90,70", "--json")
    )
    heights, transform = products.raster("dem.tif")
    for x, y, z in json.loads(said.out)["points"]:
        row, column = int((x - transform.f) / transform.e), int((y - transform.c) / transform.a)
        assert heights[row, column] == pytest.approx(-z, abs=3.0 * transform.a)


def test_after_level_all_products_lie_in_the_new_frame(
    products: Products, aquaflow: Cli, tmp_path: Path
) -> None:
    if read_dive(products.dive).frame.level:
        pytest.skip("gravity is known")
    dive = shutil.copytree(products.dive, tmp_path / "dive")
    assert aquaflow("measure", "level", dive, "--camera-pitch", 90).code == 0
    out = tmp_path / "products"
    ran = aquaflow("export", dive, "--format", "ortho,dem,laz", "--out", out)
    assert ran.code == 0, ran.err
    test_laz_lies_over_the_ortho(Products(dive, out))
    assert read_dive(dive).frame.north == "initial heading"
