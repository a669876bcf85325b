"""COLMAP and nerfstudio folders: their readers put each point where the map has it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from typer.testing import CliRunner

from aquaflow.base.errors import InputError
from aquaflow.cli import app
from aquaflow.dive.dive import Dive
from aquaflow.dive.restored import WriteModel, export_posed_pictures
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.restoration import to_bytes
from aquaflow.survey.export.posed_pictures import write_colmap, write_nerfstudio
from tests.mapping.mapping_scenes import CAMERA
from tests.survey.export.small_dive import (
    FRAMES,
    SCALE,
    north_up_frame,
    write_recording,
    write_small_dive,
)

Array = npt.NDArray[np.float64]
WRITERS = (write_colmap, write_nerfstudio)


class MappedDive:
    """A small dive on the earth, its recording and its map."""

    def __init__(self, folder: Path) -> None:
        self.path, self.recording = folder / "dive", folder / "pictures"
        self.mapper = write_small_dive(self.path, north_up_frame())
        self.pictures = write_recording(self.recording, self.mapper)

    def export(self, out: Path, write: WriteModel, restored: bool = False) -> Path:
        export_posed_pictures(Dive(self.path), out, write, self.recording, restored)
        return out


@pytest.fixture
def dive(tmp_path: Path) -> MappedDive:
    return MappedDive(tmp_path)


def in_the_map(mapper: Mapper, frame: int) -> Array:
    """[N, 2] px where the map's own view of the frame has the centres of the Gaussians."""
    view = next(view for view in mapper.views if view.frame_index == frame)
    means = mapper.scene.gaussians.means.detach().numpy().astype(float)
    return view.camera.project(view.T_wc.inverse().apply(means))


def picture_of(out: Path, frame: int) -> npt.NDArray[np.uint8]:
    return np.asarray(cv2.imread(str(out / "images" / f"{frame:06d}.png"))[..., ::-1], np.uint8)


def agreement(
    picture: npt.NDArray[np.uint8],  # [H, W, 3]
    pixels: Array,  # [N, 2]
    colours: npt.NDArray[np.uint8],  # [N, 3]
) -> float:
    """Correlation of the points' colours with those of the picture where the points lie."""
    u, v = np.floor(pixels).astype(int).T
    inside = (u >= 2) & (u < CAMERA.width - 2) & (v >= 2) & (v < CAMERA.height - 2)
    assert inside.sum() > 300
    seen, stated = picture[v[inside], u[inside]].astype(float), colours[inside].astype(float)
    return float(np.mean([np.corrcoef(seen[:, c], stated[:, c])[0, 1] for c in range(3)]))


def by_pycolmap(out: Path) -> Any:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap has no wheel for this machine")
    return pycolmap.Reconstruction(str(out / "sparse" / "0"))


def test_colmap_projects_every_point_to_where_the_map_has_it(
    dive: MappedDive, tmp_path: Path
) -> None:
    model = by_pycolmap(dive.export(tmp_path / "out", write_colmap))
    assert (model.num_images(), model.num_cameras(), model.num_points3D()) == (3, 1, 1200)
    points = [model.points3D[n].xyz for n in sorted(model.points3D)]
    for frame in FRAMES:
        image = model.find_image_with_name(f"{frame:06d}.png")
        in_camera = np.array([image.cam_from_world() * point for point in points])
        pixels = np.array(model.cameras[image.camera_id].img_from_cam(in_camera))
        np.testing.assert_allclose(pixels, in_the_map(dive.mapper, frame), atol=1e-3)


def test_colmaps_points_have_the_colours_that_its_pictures_have_there(
    dive: MappedDive, tmp_path: Path
) -> None:
    out = dive.export(tmp_path / "out", write_colmap, restored=True)
    model = by_pycolmap(out)
    numbers = sorted(model.points3D)
    colours = np.array([model.points3D[n].color for n in numbers])
    for frame in FRAMES:
        pixels = in_the_map(dive.mapper, frame)
        mirrored = np.array([CAMERA.width, 0.0]) - pixels * [1.0, -1.0]
        assert agreement(picture_of(out, frame), pixels, colours) > 0.8
        assert agreement(picture_of(out, frame), mirrored, colours) < 0.3


def test_colmaps_camera_is_a_pinhole_of_the_pictures_size(dive: MappedDive, tmp_path: Path) -> None:
    (camera,) = by_pycolmap(dive.export(tmp_path / "out", write_colmap)).cameras.values()
    assert camera.model.name == "PINHOLE"
    assert (camera.width, camera.height) == (CAMERA.width, CAMERA.height)
    np.testing.assert_array_equal(camera.params, [CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy])


def test_colmap_reads_and_writes_the_model_in_its_own_newest_form(
    dive: MappedDive, tmp_path: Path
) -> None:
    model = by_pycolmap(dive.export(tmp_path / "out", write_colmap))
    again = tmp_path / "again"
    again.mkdir()
    model.write(str(again))
    assert {path.name for path in again.iterdir()} >= {"cameras.bin", "images.bin", "points3D.bin"}
    assert model.is_valid()


def test_nerfstudios_cameras_see_every_point_where_the_map_has_it(
    dive: MappedDive, tmp_path: Path
) -> None:
    trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed")
    out = dive.export(tmp_path / "out", write_nerfstudio)
    said = json.loads((out / "transforms.json").read_text())
    points = np.asarray(trimesh.load(out / said["ply_file_path"]).vertices)
    homogeneous = np.hstack([points, np.ones((len(points), 1))])
    assert len(said["frames"]) == len(FRAMES)
    for frame, index in zip(said["frames"], FRAMES, strict=True):
        assert (out / frame["file_path"]).is_file()
        x, y, z, _ = np.linalg.inv(frame["transform_matrix"]) @ homogeneous.T
        assert (z < 0.0).all()  # OpenGL: the camera looks along -z, its y is up
        u, v = frame["cx"] - frame["fl_x"] * x / z, frame["cy"] + frame["fl_y"] * y / z
        np.testing.assert_allclose(
            np.stack([u, v], axis=1), in_the_map(dive.mapper, index), atol=2e-3
        )


def test_nerfstudios_world_is_metric_with_z_up(dive: MappedDive, tmp_path: Path) -> None:
    out = dive.export(tmp_path / "out", write_nerfstudio)
    poses = [
        f["transform_matrix"] for f in json.loads((out / "transforms.json").read_text())["frames"]
    ]
    centres = np.array(poses)[:, :3, 3]
    views = [view.T_wc.t for view in dive.mapper.views]
    np.testing.assert_allclose(
        np.linalg.norm(centres[1] - centres[0]), SCALE * np.linalg.norm(views[1] - views[0])
    )
    np.testing.assert_allclose(np.array(poses[0])[:3, 2], [0.0, 0.0, 1.0], atol=1e-9)  # looks down
    np.testing.assert_allclose(np.array(poses[0])[:3, 1], [0.0, 1.0, 0.0], atol=1e-9)  # top: north


def test_nerfstudios_points_have_normals_and_colours(dive: MappedDive, tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed")
    out = dive.export(tmp_path / "out", write_nerfstudio, restored=True)
    cloud = trimesh.load(out / "points.ply")
    raw = cloud.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_allclose(np.asarray(raw["nz"], float), 1.0, atol=1e-6)
    colours = np.asarray(cloud.colors)[:, :3]
    assert agreement(picture_of(out, 0), in_the_map(dive.mapper, 0), colours) > 0.8


@pytest.mark.parametrize("write", WRITERS)
def test_pictures_are_those_of_the_recording(
    dive: MappedDive, tmp_path: Path, write: WriteModel
) -> None:
    out = dive.export(tmp_path / "out", write)
    assert len(list((out / "images").iterdir())) == len(FRAMES)
    for frame in FRAMES:
        np.testing.assert_array_equal(picture_of(out, frame), dive.pictures[frame])


def test_restored_pictures_are_without_water(dive: MappedDive, tmp_path: Path) -> None:
    out = dive.export(tmp_path / "out", write_colmap, restored=True)
    clean = to_bytes(dive.mapper.show(dive.mapper.views[0]).radiance.clamp(0.0, 1.0).numpy())
    picture = picture_of(out, 0).astype(float)
    gain = np.median(picture[picture > 50] / clean[picture > 50])
    assert np.abs(picture / gain - clean).mean() < 3.0


def test_pictures_without_a_recording_are_refused_before_anything_is_written(
    dive: MappedDive, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match="add --recording"):
        export_posed_pictures(Dive(dive.path), tmp_path / "out", write_colmap, None)
    assert not (tmp_path / "out").exists()


def test_restored_pictures_are_drawn_where_there_is_no_recording(
    dive: MappedDive, tmp_path: Path
) -> None:
    count = export_posed_pictures(
        Dive(dive.path), tmp_path / "out", write_colmap, None, restored=True
    )
    assert count == len(list((tmp_path / "out" / "images").iterdir())) == 3


@pytest.mark.parametrize("name", ["colmap", "nerfstudio"])
def test_the_command_writes_a_folder_in_the_dive(dive: MappedDive, name: str) -> None:
    asked = ["export", str(dive.path), "--format", name, "--recording", str(dive.recording)]
    result = CliRunner().invoke(app, [*asked, "--json"])
    assert result.exit_code == 0, result.output
    said = json.loads(result.output)
    tracks = {
        each: said.pop(each) for each in ("tracks", "track_length", "error_px") if each in said
    }
    assert said == {
        "out": str(dive.path / name), "frames": 3, "unit": "m", "axes": "x east, y north, z up",
        "geotagged": True,
    }  # fmt: skip
    assert tracks == (
        {"tracks": 0, "track_length": None, "error_px": None} if name == "colmap" else {}
    )
    assert "3 pictures" in CliRunner().invoke(app, asked).output


@pytest.mark.parametrize("drawn", [True, False])
def test_the_command_says_why_colmaps_points_have_no_tracks(dive: MappedDive, drawn: bool) -> None:
    given = ["--restored"] if drawn else ["--recording", str(dive.recording)]
    ran = CliRunner().invoke(app, ["export", str(dive.path), "--format", "colmap", *given])
    why = "pictures that are drawn measure nothing" if drawn else "too few keypoints in common"
    assert "No point has a track: " in ran.output
    assert why in ran.output
