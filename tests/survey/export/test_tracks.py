"""Tracks of exported pictures: measured in the pictures, placed by the poses, read by COLMAP."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.dive.placement import placement
from aquaflow.dive.ply import PlyGaussians
from aquaflow.dive.point_cloud import PointCloud, PosedView
from aquaflow.dive.tum import read_tum
from aquaflow.geometry.alignment import align
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.survey.export.posed_pictures import write_colmap
from aquaflow.survey.export.tracks import MOST_ERROR_PX, Tracks, find_tracks
from aquaflow.telemetry.world_frame import WorldFrame
from tests.command_line import Cli
from tests.small_recording import HASTY

Array = npt.NDArray[np.float64]
Picture = npt.NDArray[np.uint8]

CAMERA = CameraModel(240, 180, 220.0, 220.0, 120.0, 90.0)
TEXEL = 0.005
"""Side of the floor's pixels; one of the pictures covers twice as much."""
SIDE = 1200
"""Pixels of the floor, which lies at z = 0; the cameras look down from 2."""
DOWN = np.diag([1.0, -1.0, -1.0])
"""Upright axes from those of a camera that looks straight down."""


def floor_picture() -> Picture:
    rng = np.random.default_rng(0)
    total = np.zeros((SIDE, SIDE, 3), np.float32)
    for cell in (4, 9, 20):
        coarse = rng.uniform(0.0, 85.0, (SIDE // cell, SIDE // cell, 3)).astype(np.float32)
        total += cv2.resize(coarse, (SIDE, SIDE), interpolation=cv2.INTER_CUBIC)
    return np.clip(total, 0, 255).astype(np.uint8)


class Floor:
    """A flat floor and eight pictures of it, whose poses are known."""

    def __init__(self) -> None:
        rng = np.random.default_rng(1)
        self.views = [
            PosedView(
                3 * number, CAMERA,
                Sim3(
                    DOWN @ so3_exp(rng.normal(0.0, 0.06, 3)),
                    np.array([0.12 * (number % 4) - 0.2, 0.3 * (number // 4) - 0.15, 2.0])
                    + rng.normal(0.0, 0.03, 3),
                ),
            )
            for number in range(8)
        ]  # fmt: skip
        texture = floor_picture()
        self.pictures = {view.frame_index: self._seen(texture, view) for view in self.views}
        x, y = np.meshgrid(np.linspace(-1.2, 1.2, 40), np.linspace(-1.2, 1.2, 40))
        means = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]).astype(np.float32)
        count = len(means)
        self.cloud = PointCloud(
            PlyGaussians(
                means, np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
                np.full((count, 3), 0.02, np.float32), np.full(count, 0.9, np.float32),
                np.full((count, 3), 0.5, np.float32),
            ),
            self.views, placement(WorldFrame.unknown()),
        )  # fmt: skip

    @staticmethod
    def _seen(texture: Picture, view: PosedView) -> Picture:
        T_cu = view.T_uc.inverse()
        K = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1.0]])
        from_floor = K @ np.column_stack([T_cu.R[:, 0], T_cu.R[:, 1], T_cu.t])
        half = 0.5 * SIDE * TEXEL
        to_floor = np.array([[TEXEL, 0, -half], [0, TEXEL, -half], [0, 0, 1.0]])
        centre = np.array([[1.0, 0, 0.5], [0, 1.0, 0.5], [0, 0, 1.0]])  # OpenCV's is at 0
        H = np.linalg.inv(centre) @ from_floor @ to_floor @ centre
        seen = cv2.warpPerspective(texture, H, (CAMERA.width, CAMERA.height))
        return np.asarray(seen, np.uint8)

    def tracks(self, views: list[PosedView] | None = None) -> Tracks:
        return find_tracks(
            views or self.views, self.cloud, lambda view: self.pictures[view.frame_index]
        )


@pytest.fixture
def site() -> Floor:
    return Floor()


def moved(views: list[PosedView], sigma: float, seed: int = 2) -> list[PosedView]:
    rng = np.random.default_rng(seed)
    return [
        replace(view, T_uc=Sim3(view.T_uc.R, view.T_uc.t + rng.normal(0.0, sigma, 3)))
        for view in views
    ]


def test_points_lie_where_they_are_and_were_seen_in_several_pictures(site: Floor) -> None:
    tracks = site.tracks()
    assert len(tracks) > 150
    assert tracks.mean_length > 3.0
    assert np.median(np.abs(tracks.points[:, 2])) < 0.01
    assert tracks.mean_error_px < 0.4
    pairs = set(zip(tracks.track.tolist(), tracks.view.tolist(), strict=True))
    assert len(pairs) == len(tracks.track)  # once in a picture


def test_the_error_is_that_of_the_poses_not_of_the_map(site: Floor) -> None:
    exact, wrong = site.tracks().mean_error_px, site.tracks(moved(site.views, 0.01)).mean_error_px
    assert wrong > exact + 0.3
    assert wrong < MOST_ERROR_PX


def test_what_moves_and_what_is_masked_has_no_track(site: Floor) -> None:
    patch = np.random.default_rng(3).integers(0, 255, (40, 40, 3), np.uint8)
    for number, view in enumerate(site.views):
        picture = site.pictures[view.frame_index]
        picture[20:60, 20 + 6 * number : 60 + 6 * number] = patch  # a fish that swims along
        alpha = np.full((*picture.shape[:2], 1), 255, np.uint8)
        alpha[120:] = 0
        site.pictures[view.frame_index] = np.concatenate([picture, alpha], axis=2)
    tracks = site.tracks()
    assert len(tracks) > 40
    assert (tracks.pixels[:, 1] < 121).all()
    off_patch = [
        (abs(tracks.pixels[tracks.view == n] - (40 + 6 * n, 40)) > 18).any(axis=1)
        for n in range(len(site.views))
    ]
    assert np.concatenate(off_patch).mean() > 0.97


def test_pictures_that_show_nothing_have_no_tracks(site: Floor) -> None:
    site.pictures = {index: np.full_like(each, 90) for index, each in site.pictures.items()}
    assert len(site.tracks()) == 0
    assert len(find_tracks([], site.cloud, lambda _: site.pictures[0])) == 0


def test_colmaps_files_hold_each_observation_with_its_error(site: Floor, tmp_path: Path) -> None:
    tracks = site.tracks()
    write_colmap(tmp_path, site.views, site.cloud, tracks)
    images, points = read_images(tmp_path), read_points(tmp_path)
    assert len(points) == len(tracks) + len(site.cloud)
    tracked = {number: point for number, point in points.items() if point["track"]}
    assert len(tracked) == len(tracks)
    for number, point in tracked.items():
        off = []
        for image, keypoint in point["track"]:
            pixel, back = images[image][keypoint]
            assert back == number
            view = site.views[image - 1]
            seen = view.camera.project(view.T_uc.inverse().apply(point["xyz"]))
            off.append(np.linalg.norm(seen - pixel))
        assert np.mean(off) == pytest.approx(point["error"], abs=1e-6)
    assert sum(len(each) for each in images.values()) == len(tracks.track)
    others = [point for point in points.values() if not point["track"]]
    assert {point["error"] for point in others} == {-1.0}


def read_images(out: Path) -> dict[int, list[tuple[Array, int]]]:
    """Of images.bin: each image's keypoints with the point that each shows."""
    data = (out / "sparse" / "0" / "images.bin").read_bytes()
    (count,), at = struct.unpack_from("<Q", data), 8
    images = {}
    for _ in range(count):
        number = struct.unpack_from("<I", data, at)[0]
        at = data.index(b"\0", at + 64) + 1
        (length,) = struct.unpack_from("<Q", data, at)
        rows = [struct.unpack_from("<2dQ", data, at + 8 + 24 * row) for row in range(length)]
        images[number] = [(np.array(row[:2]), row[2]) for row in rows]
        at += 8 + 24 * length
    assert at == len(data)
    return images


def read_points(out: Path) -> dict[int, Any]:
    """Of points3D.bin, by number."""
    data = (out / "sparse" / "0" / "points3D.bin").read_bytes()
    (count,), at = struct.unpack_from("<Q", data), 8
    points = {}
    for _ in range(count):
        number, x, y, z, _, _, _, error, length = struct.unpack_from("<Q3d3BdQ", data, at)
        pairs = struct.unpack_from(f"<{2 * length}I", data, at + 51)
        track = list(zip(pairs[::2], pairs[1::2], strict=True))
        points[number] = {"xyz": np.array([x, y, z]), "error": error, "track": track}
        at += 51 + 8 * length
    assert at == len(data)
    return points


def test_colmaps_bundle_adjustment_brings_wrong_poses_back(site: Floor, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap has no wheel for this machine")
    wrong = moved(site.views, 0.01)
    write_colmap(tmp_path, wrong, site.cloud, site.tracks(wrong))
    model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = False
    pycolmap.bundle_adjustment(model, options)
    centres = np.array([model.images[n].projection_center() for n in sorted(model.images)])
    true = np.array([view.T_uc.t for view in site.views])
    before = np.array([view.T_uc.t for view in wrong])
    assert error(centres, true) < 0.3 * error(before, true)


@pytest.mark.ci
def test_an_exported_dive_is_adjusted_and_stays_as_right_as_it_was(
    aquaflow: Cli, tmp_path: Path
) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap has no wheel for this machine")
    recording, dive = tmp_path / "recording", tmp_path / "dive"
    size = ("--width", 240, "--height", 180)
    said = {}
    for name, words in {
        "synth": ("lab", "synth", recording, "--scene", "survey", "--frames", 8, *size),
        "map": ("map", recording, "--out", dive, *HASTY, "--width", 240),
        "export": ("export", dive, "--format", "colmap", "--json"),
    }.items():
        ran = aquaflow(*words)
        assert ran.code == 0, ran.err
        said[name] = ran.out
    facts = json.loads(said["export"])
    assert facts["tracks"] > 100
    assert facts["track_length"] > 2.0
    assert facts["error_px"] < 1.0
    model = pycolmap.Reconstruction(str(dive / "colmap" / "sparse" / "0"))
    truth = read_tum(recording / "poses.tum").positions
    names = {int(Path(image.name).stem): image for image in model.images.values()}
    true = np.array([truth[index] for index in sorted(names)])

    def centres() -> Array:
        return np.array([names[index].projection_center() for index in sorted(names)])

    before = centres()
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = False
    pycolmap.bundle_adjustment(model, options)
    close = 2e-3 * float(np.linalg.norm(np.diff(true, axis=0), axis=1).sum())
    assert error(before, true) < close  # measured: 0.6 thousandths of the path
    assert error(centres(), before) < close  # 1.1
    assert error(centres(), true) < close  # 0.7


def error(centres: Array, true: Array) -> float:
    """Root mean square distance once the two are aligned."""
    off = align(centres, true, with_scale=True).T_target_source.apply(centres) - true
    return float(np.sqrt((off**2).sum(axis=1).mean()))
