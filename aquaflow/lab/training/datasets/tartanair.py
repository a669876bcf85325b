"""TartanAir (Wang et al., IROS 2020): simulated dives with true depth and poses.

Version 1: ``ocean/Easy/P000/{image_left/000000_left.png, depth_left/000000_left_depth.npy,
pose_left.txt}``, 640 x 480. Version 2: ``Ocean/Data_easy/P000/{image_lcam_front/
000000_lcam_front.png, depth_lcam_front/000000_lcam_front_depth.png, pose_lcam_front.txt}``,
640 x 640, depth as the four bytes of a float32. A field of view of 90 degrees in both; poses are
``tx ty tz qx qy qz qw``, camera axes x forward, y right, z down.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import cv2
import numpy as np

from aquaflow.base.errors import InputError
from aquaflow.lab.training.datasets.posed import (
    NED_TO_OPTICAL,
    Array,
    Depth,
    Frames,
    Posed,
    nothing_in,
    pinhole,
    pose,
    read_image,
    table,
)

SIDES = ("left", "lcam_front")
"""Camera of version 1 and of version 2."""


def tartanair(root: Path) -> list[Frames]:
    """Every trajectory under ``root``.

    Raises:
        InputError: there is none, or one has not a pose for every picture.
    """
    found = [
        _trajectory(path.parent, side, root)
        for side in SIDES
        for path in sorted(root.rglob(f"pose_{side}.txt"))
    ]
    if not found:
        raise nothing_in(root, "TartanAir trajectory (pose_left.txt or pose_lcam_front.txt)")
    return found


def _trajectory(folder: Path, side: str, root: Path) -> Frames:
    poses = table(folder / f"pose_{side}.txt", 7)
    images = sorted((folder / f"image_{side}").glob(f"*_{side}.png"))
    if len(images) != len(poses):
        raise InputError(
            f"{folder} has {len(images)} pictures and {len(poses)} poses; unpack it again"
        )
    readers = []
    for image, row in zip(images, poses, strict=True):
        T_wc = pose(row[:3], np.roll(row[3:], 1)) @ NED_TO_OPTICAL
        stem = folder / f"depth_{side}" / f"{image.stem}_depth"
        readers.append(partial(_frame, image, stem, T_wc))
    return Frames(str(folder.relative_to(root)), tuple(readers))


def _frame(
    image: Path,
    depth_stem: Path,
    T_wc: Array,  # [4, 4] m
) -> Posed:
    picture = read_image(image)
    height, width = picture.shape[:2]
    K = pinhole(width / 2, width / 2, width / 2, height / 2)
    return Posed(picture, _depth(depth_stem), K, T_wc)


def _depth(stem: Path) -> Depth:
    npy, png = stem.with_name(stem.name + ".npy"), stem.with_name(stem.name + ".png")
    if npy.is_file():
        return np.asarray(np.load(npy), dtype=np.float32)
    packed = cv2.imread(str(png), cv2.IMREAD_UNCHANGED) if png.is_file() else None
    if packed is None or packed.shape[-1] != 4:
        raise InputError(f"cannot read the depth of {stem}; unpack the data set again")
    return np.asarray(np.ascontiguousarray(packed).view("<f4")[..., 0], dtype=np.float32)
