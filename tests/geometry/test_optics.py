"""Lens and port together: pixels and points there and back, and the pinhole that errs least."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.optics import (
    pixels_of_points,
    points_at_depth,
    rays_of_pixels,
    virtual_centre,
)
from aquaflow.geometry.port import DomePort, FlatPort

Array = npt.NDArray[np.float64]

FLAT, DOME = FlatPort(0.05, 0.01), DomePort(0.05, 0.003, (0.002, 0.001, -0.006))
RADTAN = CameraModel(
    320, 240, 250.0, 251.0, 158.0, 121.0, "radtan", (-0.2, 0.05, 0.001, -0.001), FLAT
)
FISHEYE = replace(RADTAN, distortion_model="fisheye", distortion=(0.03, -0.01, 0.0, 0.0), port=DOME)
CAMERAS = pytest.mark.parametrize(
    "camera",
    [RADTAN, FISHEYE, replace(RADTAN, distortion=()), replace(FISHEYE, port=None)],
    ids=["radtan, flat", "fisheye, dome", "no distortion, flat", "fisheye, no port"],
)


def grid(camera: CameraModel) -> Array:
    """[M, 2] px over the picture."""
    u, v = np.meshgrid(np.linspace(0, camera.width, 9), np.linspace(0, camera.height, 7))
    return np.stack([u, v], -1).reshape(-1, 2)


@CAMERAS
@pytest.mark.parametrize("depth", [0.2, 1.0, 30.0])
def test_a_point_on_the_ray_of_a_pixel_is_seen_there(camera: CameraModel, depth: float) -> None:
    pixels = grid(camera)
    points = points_at_depth(camera, pixels, depth)
    np.testing.assert_allclose(points[:, 2], depth)
    np.testing.assert_allclose(pixels_of_points(camera, points), pixels, atol=2e-5)


def test_without_a_port_rays_start_at_the_centre() -> None:
    origins, rays = rays_of_pixels(replace(RADTAN, port=None), grid(RADTAN))
    assert not origins.any()
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0)


@CAMERAS
def test_what_lies_behind_the_camera_is_not_seen(camera: CameraModel) -> None:
    assert np.isnan(pixels_of_points(camera, np.array([[0.1, 0.0, -1.0]]))).all()


@pytest.mark.parametrize("port", [FLAT, DOME])
def test_no_other_centre_on_the_axis_errs_less_at_other_ranges(port: FlatPort | DomePort) -> None:
    camera = replace(RADTAN, port=port)
    pixels = (np.indices((24, 24)).reshape(2, -1).T + 0.5) / 24 * (camera.width, camera.height)

    def error(centre: Array) -> float:
        near, far = (points_at_depth(camera, pixels, depth) - centre for depth in (5.0, 50.0))
        slope = near[:, :2] / near[:, 2:] - far[:, :2] / far[:, 2:]
        return float(np.sqrt(np.mean(np.sum(slope**2, axis=1))))

    best = virtual_centre(camera)
    for step in (-2e-4, 2e-4):
        assert error(best) < error(best + step * port.axis)


def test_a_pinhole_stays_where_it_is() -> None:
    np.testing.assert_array_equal(virtual_centre(replace(RADTAN, port=None)), np.zeros(3))
    centred = replace(RADTAN, port=DomePort(0.05, 0.003))
    np.testing.assert_allclose(virtual_centre(centred), np.zeros(3), atol=1e-12)
