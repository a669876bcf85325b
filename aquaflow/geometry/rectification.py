"""Distorted pictures made pinhole pictures of a chosen width."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from aquaflow.errors import ConfigError
from aquaflow.geometry.camera import CameraModel

BORDER_SAMPLES = 200
"""Points per picture edge that decide how far to zoom in."""

NEWTON_ITERATIONS = 50
"""Limit of the search for the point that is distorted to a given one."""
MAX_UNDISTORTION_ERROR_PX = 0.01
"""Error up to which that search counts as successful; beyond, the lens model has no inverse
there."""


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


def undistort_points(
    pixels: npt.NDArray[np.float64],  # [M, 2] px, distorted
    camera: CameraModel,
) -> npt.NDArray[np.float64]:
    """Points [M, 2] at z = 1 on the rays of distorted pixels; NaN where there is no such ray.

    OpenCV's own inverse of ``radtan`` stops after five rounds, pixels away at wide corners.
    """
    import cv2

    coefficients = np.asarray(camera.distortion, dtype=np.float64)
    if camera.distortion_model == "fisheye":
        points = cv2.fisheye.undistortPoints(pixels[:, None], camera.K, coefficients)[:, 0]
        # OpenCV marks what did not converge with -1e6.
        lost = np.abs(points).max(1, keepdims=True) > 1e5
        return np.where(lost, np.nan, points).astype(np.float64)
    points = camera.unproject(pixels)[:, :2]
    for _ in range(NEWTON_ITERATIONS):
        found, J = _distort(points, camera)
        error = np.nan_to_num(found - pixels, posinf=1e9, neginf=-1e9)
        step = np.einsum("nij,nj->ni", np.linalg.pinv(J), error)
        # Half a radian at most: far out the polynomial sends Newton anywhere.
        points = points - step / np.maximum(1.0, 2.0 * np.linalg.norm(step, axis=1))[:, None]
    found, _ = _distort(points, camera)
    close = np.linalg.norm(found - pixels, axis=1) < MAX_UNDISTORTION_ERROR_PX
    return np.where((close & _unfolded(points, camera))[:, None], points, np.nan)


def _distort(
    points: npt.NDArray[np.float64],  # [M, 2] at z = 1
    camera: CameraModel,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Pixels [M, 2] where ``radtan`` sees the points, and their derivative [M, 2, 2]."""
    import cv2

    rays = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    zero, coefficients = np.zeros(3), np.asarray(camera.distortion, dtype=np.float64)
    pixels, J = cv2.projectPoints(rays, zero, zero, camera.K, coefficients)
    # With the identity as pose, moving the camera by (tx, ty) moves the point by as much.
    derivative = np.nan_to_num(np.asarray(J[:, 3:5], dtype=np.float64)).reshape(-1, 2, 2)
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2), derivative


def _unfolded(
    points: npt.NDArray[np.float64],  # [M, 2] at z = 1
    camera: CameraModel,
) -> npt.NDArray[np.bool_]:
    """[M] True where the way from the centre to the point never turns back in the picture."""
    unfolded = np.ones(len(points), dtype=bool)
    for share in np.linspace(0.05, 1.0, 20):
        unfolded &= np.linalg.det(_distort(share * points, camera)[1]) > 0.0
    return unfolded


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
