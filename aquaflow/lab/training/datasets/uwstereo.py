"""UWStereo (Lv et al., 2024): rendered stereo pairs with the left view's disparity.

``coral reef/coral/{images/left/*.png, images/right/*.png, disparity/*.pfm}`` and the same for
``default``, ``industry`` and ``ship split``; rectified, 1280 x 720. The set does not carry its
cameras: a file ``stereo.yaml`` at its root, written by its user, gives ``fx``, ``fy``, ``cx``,
``cy`` in px and ``baseline_m``.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import cv2
import numpy as np
from pydantic import ValidationError

from aquaflow.base.errors import ConfigError, InputError
from aquaflow.base.errors.regular_file import read_mapping
from aquaflow.config.stage import StageConfig
from aquaflow.lab.training.datasets.posed import (
    Depth,
    Frames,
    Posed,
    nothing_in,
    pinhole,
    read_image,
)

CALIBRATION = "stereo.yaml"
"""File with the calibration of the rig."""


class StereoRig(StageConfig):
    """Two rectified cameras of one kind."""

    fx: float
    """px"""
    fy: float
    """px"""
    cx: float
    """px, the centre of the first pixel at 0.5"""
    cy: float
    """px"""
    baseline_m: float


def uwstereo(root: Path) -> list[Frames]:
    """One sequence of two frames, left and right, for every stereo pair.

    Raises:
        InputError: there is none, or no calibration.
    """
    found = sorted(root.rglob("disparity/*.pfm"))
    if not found:
        raise nothing_in(root, "UWStereo pair (disparity/*.pfm)")
    rig = _rig(root / CALIBRATION)
    return [_pair(disparity, rig, root) for disparity in found]


def _pair(disparity: Path, rig: StereoRig, root: Path) -> Frames:
    folder = disparity.parents[1]
    name = f"{disparity.stem}.png"
    readers = (
        partial(_left_picture, folder / "images" / "left" / name, disparity, rig),
        partial(_right, folder / "images" / "right" / name, disparity, rig),
    )
    return Frames(str(disparity.relative_to(root)), readers)


def _left_picture(image: Path, disparity: Path, rig: StereoRig) -> Posed:
    depth = depth_of(read_pfm(disparity), rig)
    return Posed(read_image(image), depth, pinhole(rig.fx, rig.fy, rig.cx, rig.cy), np.eye(4))


def _right(image: Path, disparity: Path, rig: StereoRig) -> Posed:
    found = read_pfm(disparity)
    T_wc = np.eye(4)
    T_wc[0, 3] = rig.baseline_m
    depth = seen_from_right(depth_of(found, rig), found)
    return Posed(read_image(image), depth, pinhole(rig.fx, rig.fy, rig.cx, rig.cy), T_wc)


def depth_of(
    disparity: Depth,  # [H, W] px
    rig: StereoRig,
) -> Depth:
    """[H, W] m; 0 where the disparity is none."""
    known = np.isfinite(disparity) & (disparity > 0.0)
    depth = rig.fx * rig.baseline_m / np.where(known, disparity, 1.0)
    return np.where(known, depth, 0.0).astype(np.float32)


def seen_from_right(
    depth: Depth,  # [H, W] m, of the left view
    disparity: Depth,  # [H, W] px
) -> Depth:
    """[H, W] m: where two points fall on one pixel, the nearer; 0 where none does."""
    width = depth.shape[1]
    v, u = np.nonzero(depth > 0.0)
    column = np.floor(u + 0.5 - disparity[v, u]).astype(np.int64)
    inside = (column >= 0) & (column < width)
    v, u, column = v[inside], u[inside], column[inside]
    far_first = np.argsort(-depth[v, u], kind="stable")
    right = np.zeros_like(depth)
    right[v[far_first], column[far_first]] = depth[v[far_first], u[far_first]]
    return right


def read_pfm(path: Path) -> Depth:
    """[H, W]

    Raises:
        InputError: it is no such file.
    """
    values = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.is_file() else None
    if values is None or values.ndim != 2:
        raise InputError(f"cannot read the disparity {path}; unpack the data set again")
    return np.asarray(values, dtype=np.float32)


def _rig(path: Path) -> StereoRig:
    try:
        return StereoRig.model_validate(read_mapping(path, "cameras", "write them"))
    except (InputError, ConfigError, ValidationError) as error:
        raise InputError(
            f"UWStereo does not carry its cameras: write fx, fy, cx, cy in px and baseline_m to "
            f"{path}"
        ) from error
