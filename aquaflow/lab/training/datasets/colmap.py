"""COLMAP's dense workspaces, such as reconstructions of sweet-corals' photographs.

``{images/<name>, sparse/cameras.bin, sparse/images.bin, stereo/depth_maps/<name>.geometric.bin}``:
undistorted pinhole pictures. Depth is metric where the reconstruction was scaled, with markers say.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from aquaflow.base.errors import InputError
from aquaflow.lab.training.datasets.posed import (
    Array,
    Depth,
    Frames,
    Posed,
    nothing_in,
    pinhole,
    pose,
    read_image,
)

SIMPLE_PINHOLE, PINHOLE = 0, 1
"""COLMAP's numbers of the camera models that undistorted pictures have."""
PARAMETERS = {SIMPLE_PINHOLE: 3, PINHOLE: 4}
"""Number of parameters of the camera models without distortion."""
POINT_BYTES = 24
"""Of a 2D point in images.bin: x, y, and the 3D point's number."""


@dataclass(frozen=True)
class _ColmapCamera:
    width: int
    height: int
    K: Array


def colmap(root: Path) -> list[Frames]:
    """One sequence for every dense workspace under ``root``, in the order of the pictures' names.

    Raises:
        InputError: there is none, or a file of it cannot be read.
    """
    workspaces = sorted(path.parents[1] for path in root.rglob("sparse/images.bin"))
    if not workspaces:
        raise nothing_in(root, "COLMAP dense workspace (sparse/images.bin)")
    return [_workspace(folder, root) for folder in workspaces]


def _workspace(folder: Path, root: Path) -> Frames:
    try:
        cameras = _cameras((folder / "sparse" / "cameras.bin").read_bytes())
        images = _images((folder / "sparse" / "images.bin").read_bytes())
    except (OSError, struct.error, ValueError, KeyError) as error:
        raise InputError(
            f"{folder / 'sparse'} is no undistorted COLMAP model; run its image_undistorter"
        ) from error
    readers = []
    for name in sorted(images):
        camera, T_wc = images[name]
        depth = folder / "stereo" / "depth_maps" / f"{name}.geometric.bin"
        if depth.is_file() and camera in cameras:
            readers.append(partial(_frame, folder / "images" / name, depth, cameras[camera], T_wc))
    return Frames(str(folder.relative_to(root)), tuple(readers))


def _frame(
    image: Path,
    depth: Path,
    camera: _ColmapCamera,
    T_wc: Array,  # [4, 4] in the model's unit
) -> Posed:
    picture, metres = read_image(image), read_depth_map(depth)
    height, width = picture.shape[:2]
    if metres.shape != (height, width):
        raise InputError(f"{depth} does not fit its picture; run COLMAP's stereo again")
    scale = np.diag([width / camera.width, height / camera.height, 1.0])
    return Posed(picture, metres, scale @ camera.K, T_wc)


def read_depth_map(path: Path) -> Depth:
    """[H, W] z: ``width&height&1&`` and the numbers row by row.

    Raises:
        InputError: it is no depth map.
    """
    try:
        data = path.read_bytes()
        width, height, channels, rest = data.split(b"&", 3)
        shape = (int(channels), int(height), int(width))
        return np.array(np.frombuffer(rest, "<f4").reshape(shape)[0], dtype=np.float32)
    except (OSError, ValueError) as error:
        raise InputError(f"{path} is no depth map of COLMAP's; run its stereo again") from error


def _cameras(data: bytes) -> dict[int, _ColmapCamera]:
    cameras, at = {}, 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        number, model, width, height = struct.unpack_from("<iiQQ", data, at)
        count = PARAMETERS[model]
        values = struct.unpack_from(f"<{count}d", data, at + 24)
        fx, fy, cx, cy = values if model == PINHOLE else (values[0], *values)
        cameras[number] = _ColmapCamera(width, height, pinhole(fx, fy, cx, cy))
        at += 24 + 8 * count
    return cameras


def _images(data: bytes) -> dict[str, tuple[int, Array]]:
    """By name: number of the camera, and T_wc."""
    images: dict[str, tuple[int, Array]] = {}
    at = 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        values = struct.unpack_from("<i7di", data, at)
        end = data.index(b"\0", at + 64)
        name = data[at + 64 : end].decode()
        T_wc = np.asarray(np.linalg.inv(pose(values[5:8], values[1:5])), dtype=np.float64)
        images[name] = (values[8], T_wc)
        at = end + 9 + POINT_BYTES * struct.unpack_from("<Q", data, end + 1)[0]
    return images
