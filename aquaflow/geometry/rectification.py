"""Distorted pictures made pinhole pictures of a chosen width."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from aquaflow.errors import ConfigError
from aquaflow.geometry.camera import CameraModel

BORDER_SAMPLES = 200
"""Points per picture edge that decide how far to zoom in."""


class Rectifier:
    """Resizes and undistorts; the result has square corners of real pixels, no black border."""

    def __init__(self, camera: CameraModel, width: int) -> None:
        """Prepare for pictures of ``camera``, to be made ``width`` pixels wide.

        Raises:
            ConfigError: the distortion folds the picture over itself.
        """
        height = max(1, round(width * camera.height / camera.width))
        self._source = camera.scaled(width, height)
        self._maps = None
        self.camera = self._source
        """The camera of the rectified pictures."""
        if camera.is_distorted:
            self.camera = _pinhole_inside(self._source)
            self._maps = _maps(self._source, self.camera)

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
            image = cv2.remap(image, *self._maps, cv2.INTER_CUBIC)  # type: ignore[assignment]
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


def undistort_points(
    pixels: npt.NDArray[np.float64],  # [M, 2] px, distorted
    camera: CameraModel,
) -> npt.NDArray[np.float64]:
    """Points [M, 2] at z = 1 on the rays of distorted pixels."""
    import cv2

    undistort = (
        cv2.fisheye.undistortPoints
        if camera.distortion_model == "fisheye"
        else cv2.undistortPoints
    )
    coefficients = np.asarray(camera.distortion, dtype=np.float64)
    return np.asarray(undistort(pixels[:, None], camera.K, coefficients)[:, 0], dtype=np.float64)


def _pinhole_inside(camera: CameraModel) -> CameraModel:
    """The widest pinhole camera all of whose pixels lie inside the distorted picture."""
    W, H = float(camera.width), float(camera.height)
    along = np.linspace(0.0, 1.0, BORDER_SAMPLES)
    zero, one = np.zeros_like(along), np.ones_like(along)
    edges = {
        "left": np.stack([zero, along * H], -1),
        "right": np.stack([one * W, along * H], -1),
        "top": np.stack([along * W, zero], -1),
        "bottom": np.stack([along * W, one * H], -1),
    }
    ray = {name: undistort_points(pixels, camera) for name, pixels in edges.items()}
    # Each edge of the new picture must not reach past the nearest point of the old one's edge.
    needed = [
        camera.cx / -ray["left"][:, 0].max(),
        (W - camera.cx) / ray["right"][:, 0].min(),
        camera.cy / -ray["top"][:, 1].max(),
        (H - camera.cy) / ray["bottom"][:, 1].min(),
    ]
    if not np.isfinite(needed).all() or min(needed) <= 0.0:
        raise ConfigError(
            f"the distortion {camera.distortion} folds a {camera.width} x {camera.height} picture "
            "over itself; check the coefficients and their order in camera.yaml"
        )
    focal = float(max(needed))
    return replace(camera, fx=focal, fy=focal, distortion_model="none", distortion=())


def _maps(source: CameraModel, target: CameraModel) -> tuple[npt.NDArray, npt.NDArray]:  # type: ignore[type-arg]
    import cv2

    # OpenCV counts pixel centres from 0, this package from 0.5.
    shift = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
    coefficients = np.asarray(source.distortion, dtype=np.float64)
    initialise = (
        cv2.fisheye.initUndistortRectifyMap
        if source.distortion_model == "fisheye"
        else cv2.initUndistortRectifyMap
    )
    size = (target.width, target.height)
    first, second = initialise(
        source.K - shift, coefficients, np.eye(3), target.K - shift, size, cv2.CV_32FC1
    )
    return first, second
