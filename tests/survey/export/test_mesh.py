"""The surface of a dive as PLY, OBJ and GLB: read back by trimesh, compared with the ground."""

from __future__ import annotations

import json
import struct
import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import torch
from typer.testing import CliRunner

from aquaflow.base.errors import InputError
from aquaflow.cli import app
from aquaflow.dive.dive import Dive
from aquaflow.dive.map_file import write_map_file
from aquaflow.dive.placement import placement
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.export.mesh import export_mesh as export_module
from aquaflow.survey.export.mesh.export_mesh import export_mesh
from aquaflow.telemetry.world_frame import WorldFrame
from tests.metric_scenes import metric_frame
from tests.survey.export.small_dive import WATER, small_mapper, write_small_dive
from tests.survey.export.survey_scenes import (
    ALTITUDE_M,
    DEPTH_M,
    colour,
    height,
    on_utm,
    surveyed,
    write_survey,
)

pytest.importorskip("skimage", reason="scikit-image is not installed")
trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed")
KINDS = ("ply", "obj", "glb")
TEXTURED_M = 0.06
"""Resolution of the meshes with a texture, which takes longer the more triangles there are."""
Array = npt.NDArray[np.float64]


@pytest.fixture(scope="module", autouse=True)
def _xatlas() -> None:
    pytest.importorskip("xatlas", reason="xatlas is not installed")


@pytest.fixture(scope="module")
def dive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """In local metres, x east, y north."""
    frame = metric_frame(origin=None)
    return write_survey(tmp_path_factory.mktemp("mesh") / "dive", surveyed(frame), frame)


@pytest.fixture(scope="module")
def few_views(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same with the four views of one corner, for what does not depend on the ground."""
    frame = metric_frame(origin=None)
    mapper = surveyed(frame)
    mapper.views = [mapper.views[index] for index in (0, 1, 4, 5)]
    return write_survey(tmp_path_factory.mktemp("few") / "dive", mapper, frame)


@pytest.fixture(scope="module")
def written(dive: Path) -> dict[str, Path]:
    paths = {kind: dive / f"mesh.{kind}" for kind in KINDS}
    export_mesh(Dive(dive), {"ply": paths["ply"]})
    export_mesh(Dive(dive), {"obj": paths["obj"]}, TEXTURED_M)
    export_mesh(Dive(dive), {"glb": paths["glb"]}, TEXTURED_M)
    return paths


def read(path: Path) -> tuple[trimesh.Trimesh, Array]:
    """The mesh, and its vertices with z up."""
    mesh = trimesh.load(path, process=False, force="mesh")
    vertices = np.asarray(mesh.vertices, float)
    if path.suffix == ".glb":
        x, y, z = vertices.T
        vertices = np.column_stack([x, -z, y])
    return mesh, vertices


@pytest.mark.parametrize("kind", KINDS)
def test_the_surface_is_the_ground(written: dict[str, Path], kind: str) -> None:
    mesh, vertices = read(written[kind])
    truth = height(vertices[:, 1], vertices[:, 0]) - DEPTH_M
    error = vertices[:, 2] - truth
    assert np.sqrt(np.mean(error**2)) < 0.005 * ALTITUDE_M
    assert len(mesh.faces) > (20_000 if kind == "ply" else 7_000)
    up = mesh.face_normals[:, 1 if kind == "glb" else 2]
    assert (up > 0.0).mean() > 0.999
    north_east = vertices[:, :2].max(axis=0) - vertices[:, :2].min(axis=0)
    assert (north_east > 3.0).all()


@pytest.mark.parametrize("kind", ["obj", "glb"])
def test_a_texture_shows_the_colours_of_the_ground(written: dict[str, Path], kind: str) -> None:
    mesh, vertices = read(written[kind])
    material = mesh.visual.material
    image = material.baseColorTexture if kind == "glb" else material.image
    texture = np.asarray(image.convert("RGB"), float) / 255.0
    rows, columns = texture.shape[:2]
    centres = vertices[mesh.faces].mean(axis=1)
    u, v = mesh.visual.uv[mesh.faces].mean(axis=1).T
    at = (rows * (1.0 - v)).astype(int), (columns * u).astype(int)
    error = np.abs(texture[at] - colour(centres[:, 1], centres[:, 0]))
    assert error.mean() < 0.015
    assert np.quantile(error, 0.99) < 0.08


def test_vertices_of_a_ply_have_colour_normal_and_sigma(written: dict[str, Path]) -> None:
    mesh, vertices = read(written["ply"])
    found = np.asarray(mesh.visual.vertex_colors)[:, :3] / 255.0
    assert np.abs(found - colour(vertices[:, 1], vertices[:, 0])).mean() < 0.015
    plain = mesh.metadata["_ply_raw"]["vertex"]["data"]
    normals = np.column_stack([plain[name] for name in ("nx", "ny", "nz")])
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)
    # A picture's pixel is 15 mm wide on the ground, and views stand 0.8 m apart at 2 m.
    assert 0.01 < np.median(plain["sigma"]) < 0.06
    header = written["ply"].read_bytes()[:1000].decode("ascii", "replace")
    assert "comment unit: m\n" in header
    assert "comment axes: x east, y north, z up; m\n" in header


def test_a_dive_too_large_for_its_pictures_resolution_gets_a_coarser_mesh_that_says_so(
    few_views: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fine = export_mesh(Dive(few_views), {"ply": tmp_path / "fine.ply"})
    monkeypatch.setattr(export_module, "MOST_TRIANGLES", fine.triangles // 8)
    coarse = export_mesh(Dive(few_views), {"ply": tmp_path / "coarse.ply"})
    assert coarse.voxel > 1.5 * fine.voxel
    assert coarse.triangles < fine.triangles / 3
    asked = export_mesh(Dive(few_views), {"ply": tmp_path / "asked.ply"}, fine.voxel)
    assert asked.triangles == fine.triangles


def test_the_same_dive_gives_the_same_bytes(few_views: Path, tmp_path: Path) -> None:
    once, again = tmp_path / "once", tmp_path / "again"
    for folder in (once, again):
        folder.mkdir()
        for kind in KINDS:
            export_mesh(Dive(few_views), {kind: folder / f"mesh.{kind}"}, 0.1)  # type: ignore[arg-type]
    names = ["mesh.glb", "mesh.mtl", "mesh.obj", "mesh.ply", "mesh.png"]
    assert sorted(path.name for path in once.iterdir()) == names
    for name in names:
        assert (once / name).read_bytes() == (again / name).read_bytes()


def test_a_dive_on_the_earth_lies_on_its_utm_grid(tmp_path: Path) -> None:
    dive = write_survey(tmp_path / "dive", surveyed())
    mesh = export_mesh(Dive(dive), {"glb": tmp_path / "a.glb"}, resolution=0.04)
    _, vertices = read(tmp_path / "a.glb")
    north, east = (each.ravel() for each in np.meshgrid(*[np.linspace(0.8, 3.0, 12)] * 2))
    truth = on_utm(np.column_stack([north, east, DEPTH_M - height(north, east)]))
    placed = vertices[:, :2] + mesh.origin[:2]
    gap = np.linalg.norm(placed[None] - truth[:, None], axis=2)
    nearest = gap.argmin(axis=1)
    assert gap.min(axis=1).max() < 0.03
    assert np.abs(vertices[nearest, 2] - (height(north, east) - DEPTH_M)).max() < 0.05
    facts = described(tmp_path / "a.glb")["asset"]["extras"]
    assert (facts["epsg"], facts["unit"]) == (32632, "m")
    assert facts["origin"] == list(mesh.origin)
    assert facts["origin"][1] > 7e6


def described(path: Path) -> dict:  # type: ignore[type-arg]
    """The JSON of a GLB, whose lengths are checked."""
    content = path.read_bytes()
    magic, version, whole, length, kind = struct.unpack_from("<4sIII4s", content)
    assert (magic, version, whole, kind) == (b"glTF", 2, len(content), b"JSON")
    size, binary = struct.unpack_from("<I4s", content, 20 + length)
    assert (binary, 28 + length + size) == (b"BIN\0", whole)
    found = json.loads(content[20 : 20 + length])
    assert found["buffers"][0]["byteLength"] <= size
    return found  # type: ignore[no-any-return]


def test_a_glb_is_unlit_and_its_parts_are_aligned(written: dict[str, Path]) -> None:
    found = described(written["glb"])
    assert found["extensionsUsed"] == ["KHR_materials_unlit"]
    assert all(view["byteOffset"] % 4 == 0 for view in found["bufferViews"])
    for accessor in found["accessors"]:
        assert accessor["count"] > 1000


def test_a_dive_in_map_units_says_so_and_water_colours_it(tmp_path: Path) -> None:
    mapper = surveyed(metric_frame(T_nm=Sim3.identity()))
    mapper.medium.set_water(*(torch.tensor(values) for values in WATER))
    dive = write_survey(tmp_path / "dive", mapper, WorldFrame.unknown())
    clear = export_mesh(Dive(dive), {"ply": tmp_path / "clear.ply"}, 0.06)
    assert clear.where.unit == "map units"
    assert clear.seen == "without water"
    seen = export_mesh(Dive(dive), {"ply": tmp_path / "seen.ply"}, 0.06, water=True)
    assert seen.seen.endswith("map units of water")
    means = []
    for name in ("clear", "seen"):
        mesh, vertices = read(tmp_path / f"{name}.ply")
        means.append(np.asarray(mesh.visual.vertex_colors)[:, :3].mean(axis=0))
        error = DEPTH_M - vertices[:, 1] - height(vertices[:, 0], -vertices[:, 2])
        assert np.sqrt(np.mean(error**2)) < 0.005 * ALTITUDE_M  # y is forward, as z of a camera
    assert means[0][0] > 1.2 * means[1][0]  # water took the red


def test_a_larger_resolution_gives_fewer_triangles(dive: Path, tmp_path: Path) -> None:
    coarse = export_mesh(Dive(dive), {"ply": tmp_path / "a.ply"}, resolution=0.08)
    assert coarse.voxel == 0.08
    _, vertices = read(tmp_path / "a.ply")
    error = vertices[:, 2] - height(vertices[:, 1], vertices[:, 0]) + DEPTH_M
    assert np.sqrt(np.mean(error**2)) < 0.01 * ALTITUDE_M
    assert 2_000 < coarse.triangles < 8_000


def test_a_surface_of_few_voxels_is_written(dive: Path, tmp_path: Path) -> None:
    fine, coarse, coarser = (
        export_mesh(Dive(dive), {"ply": tmp_path / "a.ply"}, resolution)
        for resolution in (0.08, 0.2, 0.4)
    )
    assert coarser.triangles > 0
    assert coarse.area == pytest.approx(fine.area, rel=0.35)
    assert coarser.area == pytest.approx(fine.area, rel=0.35)


@pytest.mark.parametrize("kind", KINDS)
def test_what_fails_leaves_nothing_behind(
    few_views: Path, tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*given: object, y_up: bool = False) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(
        "aquaflow.survey.export.mesh.placed_mesh.PlacedMesh."
        + ("facts" if kind == "glb" else "comments"),
        interrupted,
    )
    with pytest.raises(KeyboardInterrupt):
        export_mesh(Dive(few_views), {kind: tmp_path / f"a.{kind}"}, 0.1)  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_a_file_is_refused_in_a_sentence(dive: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="give a folder with room"):
        export_mesh(Dive(dive), {"ply": tmp_path / "file" / "a.ply"})


def test_a_dive_without_gaussians_views_or_surface_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dive = tmp_path / "dive"
    write_small_dive(dive)
    monkeypatch.setattr(export_module, "LEAST_VIEWS", 9)
    with pytest.raises(InputError, match="too little of the map is seen well by two views"):
        export_mesh(Dive(dive), {"ply": tmp_path / "a.ply"})
    mapper = small_mapper()
    mapper.views = []
    write_map_file(dive / "map.aqf", mapper)
    with pytest.raises(InputError, match="has no views"):
        export_mesh(Dive(dive), {"ply": tmp_path / "a.ply"})
    mapper = small_mapper()
    mapper.gaussians.parameters["opacity_logits"].fill_(-9.0)
    write_map_file(dive / "map.aqf", mapper)
    with pytest.raises(InputError, match="show no surface of its map"):
        export_mesh(Dive(dive), {"ply": tmp_path / "a.ply"})
    assert not list(tmp_path.glob("*.ply"))


@pytest.mark.parametrize(("module", "kind"), [("skimage.measure", "ply"), ("xatlas", "glb")])
def test_a_missing_package_is_named_with_what_installs_it(
    dive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: str, kind: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=rf"{module}.*pip install 'aquaflow\[survey\]'"):
        export_mesh(Dive(dive), {kind: tmp_path / "a"})  # type: ignore[arg-type]


def test_the_command_writes_into_the_dive_and_says_what_it_is(dive: Path) -> None:
    asked = ["export", str(dive), "--format", "obj", "--resolution", "0.1"]
    result = CliRunner().invoke(app, [*asked, "--json"])
    assert result.exit_code == 0, result.output
    said = json.loads(result.output)
    assert said["files"] == [str(dive / f"mesh.{each}") for each in ("obj", "mtl", "png")]
    assert (said["unit"], said["epsg"], said["resolution"]) == ("m", None, 0.1)
    assert said["axes"] == placement(metric_frame(origin=None)).in_words()
    assert said["triangles"] > 2000
    assert 10.0 < said["area"] < 16.0
    words = CliRunner().invoke(app, ["export", str(dive), "--format", "ply", *asked[-2:]]).output
    assert "triangles of 0.1 m, without water" in words.replace("\n", " ")
