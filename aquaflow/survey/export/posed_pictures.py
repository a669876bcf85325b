"""Pictures with poses as training programs read them: a COLMAP folder, and nerfstudio's.

COLMAP: its documentation, "Output Format", of the files that every version reads (cameras.bin,
images.bin, points3D.bin; little-endian). Poses are world to camera, quaternions wxyz; the camera
looks along z with y down, and the centre of the top left pixel is (0.5, 0.5), both as here.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from aquaflow.base.storage.atomic import atomic_write, write_json
from aquaflow.dive.point_cloud import PointCloud, PosedView
from aquaflow.dive.restored import IMAGES, picture_name
from aquaflow.geometry.camera import CameraModel
from aquaflow.survey.export.tracks import Tracks, rows_by

MODEL = Path("sparse") / "0"
"""Where COLMAP, gsplat, nerfstudio and OpenSplat look for the model."""
PINHOLE = 1
"""Number of the camera model with fx, fy, cx, cy."""
NO_ERROR = -1.0
"""What COLMAP writes of a point whose reprojection error was not computed."""
POINT = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")]
)
"""Of points3D.bin, before the observations of its track."""
OBSERVATION = np.dtype([("image", "<u4"), ("keypoint", "<u4")])
"""Of a track."""
KEYPOINT = np.dtype([("pixel", "<f8", 2), ("point", "<u8")])
"""Of images.bin."""


def write_colmap(
    out: Path, views: Sequence[PosedView], cloud: PointCloud, tracks: Tracks | None = None
) -> None:
    """Write ``out/sparse/0``: a camera for each that differs, a pose for each view, and points:
    first the ``tracks`` with their observations, then those of the map, which have none.

    World is the upright frame.

    Raises:
        InputError: a file cannot be written.
    """
    folder = out / MODEL
    folder.mkdir(parents=True, exist_ok=True)
    tracks = tracks or Tracks.none()
    numbers = {camera: n for n, camera in enumerate(dict.fromkeys(v.camera for v in views), 1)}
    _write_cameras(folder / "cameras.bin", numbers)
    _write_images(folder / "images.bin", views, numbers, tracks)
    _write_points(folder / "points3D.bin", cloud, tracks)


def _write_cameras(path: Path, numbers: dict[CameraModel, int]) -> None:
    with atomic_write(path) as stream:
        stream.write(struct.pack("<Q", len(numbers)))
        for camera, number in numbers.items():
            stream.write(struct.pack("<IiQQ", number, PINHOLE, camera.width, camera.height))
            stream.write(struct.pack("<4d", camera.fx, camera.fy, camera.cx, camera.cy))


def _write_images(
    path: Path, views: Sequence[PosedView], numbers: dict[CameraModel, int], tracks: Tracks
) -> None:
    with atomic_write(path) as stream:
        stream.write(struct.pack("<Q", len(views)))
        for number, view in enumerate(views, start=1):
            T_cu = view.T_uc.inverse()
            stream.write(struct.pack("<I7d", number, *T_cu.quaternion, *T_cu.t))
            stream.write(struct.pack("<I", numbers[view.camera]))
            stream.write(picture_name(view.frame_index).encode("ascii") + b"\0")
            seen = np.flatnonzero(tracks.view == number - 1)
            keypoints = np.zeros(len(seen), KEYPOINT)
            keypoints["pixel"], keypoints["point"] = tracks.pixels[seen], tracks.track[seen] + 1
            stream.write(struct.pack("<Q", len(seen)))
            stream.write(keypoints.tobytes())


def _write_points(path: Path, cloud: PointCloud, tracks: Tracks) -> None:
    with atomic_write(path) as stream:
        stream.write(struct.pack("<Q", len(tracks) + len(cloud)))
        _write_tracks(stream, tracks)
        first = len(tracks) + 1
        for points in cloud.chunks():
            rows = np.zeros(len(points.positions), POINT)
            rows["id"] = np.arange(first, first + len(rows))
            rows["xyz"], rows["rgb"], rows["error"] = points.positions, points.colours, NO_ERROR
            stream.write(rows.tobytes())
            first += len(rows)


def _write_tracks(stream: IO[bytes], tracks: Tracks) -> None:
    observations = np.zeros(len(tracks.track), OBSERVATION)
    observations["image"] = tracks.view + 1
    for _, rows in rows_by(tracks.view):
        observations["keypoint"][rows] = np.arange(len(rows))
    starts = np.searchsorted(tracks.track, np.arange(len(tracks) + 1))
    points = np.zeros(len(tracks), POINT)
    points["id"], points["length"] = np.arange(1, len(tracks) + 1), np.diff(starts)
    points["xyz"], points["rgb"], points["error"] = tracks.points, tracks.colours, tracks.errors
    for number, point in enumerate(points):
        stream.write(point.tobytes())
        stream.write(observations[starts[number] : starts[number + 1]].tobytes())


# --------------------------------------------------------------------------------------------------
# A nerfstudio folder: transforms.json and a PLY of points, beside the pictures.
#
# Format: nerfstudio's documentation, "Data conventions"; OpenSplat and Brush read it too. Poses are
# camera to world with OpenGL's camera axes (x right, y up, z backward); the world's z is up.

TRANSFORMS = "transforms.json"
POINTS = "points.ply"
OPENGL_FROM_CAMERA = np.diag([1.0, -1.0, -1.0, 1.0])
"""From x right, y down, z forward; its own inverse."""
NERFSTUDIO_POINT = np.dtype([("xyz", "<f4", 3), ("normal", "<f4", 3), ("rgb", "u1", 3)])
"""Of points.ply."""
PROPERTIES = (
    *(f"float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")),
    *(f"uchar {name}" for name in ("red", "green", "blue")),
)


def write_nerfstudio(out: Path, views: Sequence[PosedView], cloud: PointCloud) -> None:
    """Write ``out/transforms.json`` and ``out/points.ply``, both in the upright frame.

    Raises:
        InputError: a file cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    write_points(out / POINTS, cloud)
    frames = [
        {
            "file_path": f"{IMAGES}/{picture_name(view.frame_index)}",
            "transform_matrix": (view.T_uc.matrix @ OPENGL_FROM_CAMERA).tolist(),
            **_intrinsics(view.camera),
        }
        for view in views
    ]
    write_json(
        out / TRANSFORMS,
        # nerfstudio's name of a camera with radtan coefficients, which are zero here
        {"camera_model": "OPENCV", "ply_file_path": POINTS, "frames": frames},
    )


def _intrinsics(camera: CameraModel) -> dict[str, Any]:
    return {
        **{"w": camera.width, "h": camera.height},
        **{"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy},
        **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
    }


def write_points(path: Path, cloud: PointCloud) -> None:
    """A binary PLY of the points with normals and colours.

    Raises:
        InputError: the file cannot be written.
    """
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(cloud)}"]
    header += [f"property {each}" for each in PROPERTIES]
    with atomic_write(path) as stream:
        stream.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii"))
        for points in cloud.chunks():
            rows = np.zeros(len(points.positions), NERFSTUDIO_POINT)
            rows["xyz"], rows["normal"], rows["rgb"] = (
                points.positions, points.normals, points.colours
            )  # fmt: skip
            stream.write(rows.tobytes())
