"""FLSea-stereo (Randall and Treibitz, 2023): real dives with depth from photogrammetry.

``rock_garden1/{imgs/LFT/*, imgs/RGT/*, depth/LFT/*.tif}``: the left camera's pictures and its depth
in metres, whose names begin alike; 0 or NaN where unknown. The left camera goes into
``camera.yaml`` at the root, in AquaFlow's format, once converted from the set's MATLAB files. Poses
do not come with it: they follow from keypoints and depth (chaining.py).
"""

from __future__ import annotations

from bisect import bisect_left
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from aquaflow.base.errors import InputError
from aquaflow.geometry.camera import CameraModel, load_camera
from aquaflow.lab.training.datasets.chaining import chained
from aquaflow.lab.training.datasets.posed import Frames, Posed, nothing_in, read_image

PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
"""Suffixes of pictures."""


def flsea(root: Path) -> list[Frames]:
    """Stretches of every dive in which each picture's pose follows from the one before.

    Raises:
        InputError: there is none, or no calibration.
    """
    folders = sorted(path.parents[1] for path in root.rglob("depth/LFT"))
    if not folders:
        raise nothing_in(root, "FLSea-stereo dive (depth/LFT)")
    camera = load_camera(root / "camera.yaml")
    stretches = []
    for folder in folders:
        frames = _dive(folder, root, camera)
        stretches += chained(frames)
    return stretches


def _dive(folder: Path, root: Path, camera: CameraModel) -> Frames:
    depths = sorted((folder / "depth" / "LFT").glob("*.tif*"))
    names = [path.stem for path in depths]
    readers = []
    for image in sorted((folder / "imgs" / "LFT").iterdir()):
        at = bisect_left(names, image.stem)
        if image.suffix.lower() not in PICTURES or at == len(names):
            continue
        if names[at].startswith(image.stem):
            readers.append(partial(_frame, image, depths[at], camera))
    return Frames(str(folder.relative_to(root)), tuple(readers))


def _frame(image: Path, depth: Path, camera: CameraModel) -> Posed:
    """Undistorted; its pose is not known yet."""
    picture, metres = read_image(image), cv2.imread(str(depth), cv2.IMREAD_UNCHANGED)
    if metres is None or metres.shape != picture.shape[:2]:
        raise InputError(f"{depth} does not fit its picture; unpack the data set again")
    height, width = picture.shape[:2]
    sized = camera.scaled(width, height)
    depth_m = np.nan_to_num(np.asarray(metres, dtype=np.float32), posinf=0.0, neginf=0.0)
    if sized.is_distorted:
        maps = _undistorting(sized)
        picture = np.asarray(cv2.remap(picture, *maps, cv2.INTER_CUBIC), dtype=np.uint8)
        depth_m = np.asarray(cv2.remap(depth_m, *maps, cv2.INTER_NEAREST), dtype=np.float32)
    return Posed(picture, depth_m, sized.K, np.eye(4))


def _undistorting(camera: CameraModel) -> tuple[np.ndarray, np.ndarray]:  # type: ignore[type-arg]
    """Maps to a pinhole camera of the same K."""
    K, D, size = camera.K, np.array(camera.distortion), (camera.width, camera.height)
    K[:2, 2] -= 0.5
    undistorting = (
        cv2.fisheye.initUndistortRectifyMap
        if camera.distortion_model == "fisheye"
        else cv2.initUndistortRectifyMap
    )
    u, v = undistorting(K, D, np.eye(3), K, size, cv2.CV_32FC1)
    return u, v
