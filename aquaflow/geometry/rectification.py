"""Distorted and refracted pictures made pinhole pictures of a chosen width."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import ConfigError
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.optics import (
    pixels_of_points,
    points_at_depth,
    undistort_points,
    virtual_centre,
)

Array = npt.NDArray[np.float64]
Map = npt.NDArray[np.float32]

BORDER_SAMPLES = 200
"""Points per picture edge that decide how far to zoom in."""
KNOT_PX = 4.0
"""Between the pixels at which the maps are computed; the spline errs by less than 0.001 px."""
MIN_KNOTS = 8
"""Along a side of a small picture; a cubic spline needs four."""


class Rectifier:
    """Resizes and undistorts, the port's refraction included.

    The result has square corners of real pixels, no black border.
    """

    def __init__(self, camera: CameraModel, width: int) -> None:
        """Prepare for pictures of ``camera``, to be made ``width`` pixels wide.

        Raises:
            ConfigError: the distortion folds the picture over itself.
        """
        height = max(1, round(width * camera.height / camera.width))
        self._source = camera.resize(width, height)
        self._maps = None
        self.camera = self._source
        """The camera of the rectified pictures."""
        self.centre_m = virtual_centre(self._source)
        """[3] where that camera has its centre, in the frame of the real one; not zero behind a
        port."""
        if not camera.is_pinhole:
            self.camera = _pinhole_inside(self._source, self.centre_m)
            port, target = camera.port, self.camera
            self._maps = (
                _undistortion(self._source, target)
                if port is None
                else _refraction(self._source, target, self.centre_m, port.range_m)
            )

    def __call__(
        self,
        image: npt.NDArray[np.uint8],  # [H, W, 3]
    ) -> npt.NDArray[np.uint8]:
        """[height, width, 3]"""
        import cv2

        size = (self.camera.width, self.camera.height)
        shrinking = image.shape[1] > size[0]
        if (image.shape[1], image.shape[0]) != size:
            image = cv2.resize(  # type: ignore[assignment]
                image, size, interpolation=cv2.INTER_AREA if shrinking else cv2.INTER_CUBIC
            )
        if self._maps is not None:
            # The outermost half pixel lies between the last centres and the picture's edge.
            image = cv2.remap(  # type: ignore[assignment]
                image, *self._maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
            )
        return np.ascontiguousarray(image)

    def mask(
        self,
        mask: npt.NDArray[np.bool_],  # [H, W]
    ) -> npt.NDArray[np.bool_]:
        """[height, width] the same for a validity mask, without interpolation."""
        import cv2

        size = (self.camera.width, self.camera.height)
        grey = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        if self._maps is not None:
            grey = cv2.remap(grey, *self._maps, cv2.INTER_NEAREST)
        return np.asarray(grey) > 0


def _pinhole_inside(
    camera: CameraModel,
    centre_m: Array,  # [3] of the pinhole camera
) -> CameraModel:
    """The widest pinhole camera all of whose pixels lie inside the distorted picture."""
    left, right, top, bottom = np.split(_slopes(_outline(camera), camera, centre_m), 4)
    # Each edge of the new picture must not reach past the nearest point of the old one's edge.
    needed = [
        camera.cx / -left[:, 0].max(),
        (camera.width - camera.cx) / right[:, 0].min(),
        camera.cy / -top[:, 1].max(),
        (camera.height - camera.cy) / bottom[:, 1].min(),
    ]
    if not np.isfinite(needed).all() or min(needed) <= 0.0:
        raise ConfigError(_no_pinhole(camera))
    focal = float(max(needed))
    return replace(camera, fx=focal, fy=focal, distortion_model="none", distortion=(), port=None)


def _outline(camera: CameraModel) -> Array:
    """[4 N, 2] px along the left, right, upper and lower edge of the picture."""
    W, H = float(camera.width), float(camera.height)
    along = np.linspace(0.0, 1.0, BORDER_SAMPLES)
    x, y = along * W, along * H
    edges = [(0 * y, y), (0 * y + W, y), (x, 0 * x), (x, 0 * x + H)]
    return np.concatenate([np.stack(edge, axis=-1) for edge in edges])


def _no_pinhole(camera: CameraModel) -> str:
    if camera.is_distorted and not np.isfinite(undistort_points(_outline(camera), camera)).all():
        wide = "; of 180 degrees and more take a part with --crop"
        return (
            f"the distortion {camera.distortion} folds a {camera.width} x {camera.height} picture "
            "over itself; check the coefficients and their order in camera.yaml"
            f"{wide if camera.distortion_model == 'fisheye' else ''}"
        )
    return (
        "the camera cannot look through the port that camera.yaml describes with its whole "
        "picture; check the port's measures, and that fx and fy were measured in air"
    )


def _slopes(
    pixels: Array,  # [M, 2] px, distorted
    camera: CameraModel,
    centre_m: Array,  # [3]
) -> Array:
    """Points [M, 2] at z = 1 where a pinhole camera at ``centre_m`` sees what ``pixels`` show."""
    if camera.port is None:
        return undistort_points(pixels, camera)
    from_centre = points_at_depth(camera, pixels, camera.port.range_m) - centre_m
    return np.asarray(from_centre[:, :2] / from_centre[:, 2:])


def _undistortion(source: CameraModel, target: CameraModel) -> tuple[Map, Map]:
    """For ``cv2.remap``: x and y [H, W] in the picture of ``source``, whose first centre is 0."""
    import cv2

    # OpenCV counts pixel centres from 0, this package from 0.5.
    shift = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
    coefficients = source.coefficients
    initialise = (
        cv2.fisheye.initUndistortRectifyMap
        if source.distortion_model == "fisheye"
        else cv2.initUndistortRectifyMap
    )
    size = (target.width, target.height)
    first, second = initialise(
        source.K - shift, coefficients, np.eye(3), target.K - shift, size, cv2.CV_32FC1
    )
    return np.asarray(first, np.float32), np.asarray(second, np.float32)


def _refraction(
    source: CameraModel,
    target: CameraModel,
    centre_m: Array,  # [3] of the target
    range_m: float,
) -> tuple[Map, Map]:
    """The same for a camera behind a port, with its distortion.

    Both maps are smooth: they are computed at every few pixels, with a cubic spline between.
    """
    from scipy.interpolate import RectBivariateSpline

    u, v = _knots(target.width), _knots(target.height)
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    points = centre_m + (range_m - centre_m[2]) * target.unproject(pixels)
    found = pixels_of_points(source, points).reshape(len(v), len(u), 2)
    rows, columns = np.arange(target.height) + 0.5, np.arange(target.width) + 0.5
    x, y = (RectBivariateSpline(v, u, found[..., k])(rows, columns) - 0.5 for k in (0, 1))
    return np.asarray(x, np.float32), np.asarray(y, np.float32)


def _knots(side: int) -> Array:
    """Pixel coordinates from one edge of the picture to the other."""
    return np.linspace(0.0, float(side), max(MIN_KNOTS, math.ceil(side / KNOT_PX) + 1))
