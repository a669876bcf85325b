"""Rectification: points land where the distortion model says, and no border is black."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.base.errors import ConfigError
from aquaflow.geometry.camera import CameraModel, DistortionModel
from aquaflow.geometry.optics import pixels_of_points, undistort_points
from aquaflow.geometry.port import DomePort, FlatPort
from aquaflow.geometry.rectification import Rectifier

Array = npt.NDArray[np.float64]

RADTAN = CameraModel(
    320,
    240,
    260.0,
    262.0,
    157.0,
    123.0,
    distortion_model="radtan",
    distortion=(-0.25, 0.06, 0.001, -0.002),
)
FISHEYE = CameraModel(
    320,
    240,
    200.0,
    201.0,
    163.0,
    118.0,
    distortion_model="fisheye",
    distortion=(0.05, -0.01, 0.002, 0.0),
)
WIDE = CameraModel(
    320,
    240,
    160.0,
    160.0,
    160.0,
    120.0,
    distortion_model="radtan",
    distortion=(-0.35, 0.12, 0.0, 0.0),
)
"""Corners 51 degrees off the axis: OpenCV's own inverse is 40 px off there."""
PINCUSHION = CameraModel(
    320, 240, 260.0, 260.0, 160.0, 120.0, distortion_model="radtan", distortion=(0.2, 0.0, 0.0, 0.0)
)
DISTORTED = pytest.mark.parametrize(
    "camera",
    [RADTAN, WIDE, FISHEYE, PINCUSHION],
    ids=["radtan", "wide radtan", "fisheye", "pincushion"],
)


def distorted(rays: Array, camera: CameraModel) -> Array:
    """[M, 2] px of rays [M, 3] at z = 1: the model's formulas, written out."""
    x, y = rays[:, 0], rays[:, 1]
    r2 = x**2 + y**2
    k = camera.distortion
    if camera.distortion_model == "fisheye":
        r = np.sqrt(r2)
        theta = np.arctan(r)
        bent = theta * (1 + sum(c * theta ** (2 * i + 2) for i, c in enumerate(k)))
        factor = np.where(r > 1e-12, bent / np.maximum(r, 1e-12), 1.0)
        xd, yd = x * factor, y * factor
    else:
        radial = 1 + k[0] * r2 + k[1] * r2**2
        xd = x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x**2)
        yd = y * radial + k[2] * (r2 + 2 * y**2) + 2 * k[3] * x * y
    return np.stack([camera.fx * xd + camera.cx, camera.fy * yd + camera.cy], -1)


def spots(pixels: Array, camera: CameraModel) -> npt.NDArray[np.uint8]:
    """[H, W, 3] picture with one soft spot at each pixel position."""
    grid = camera.pixel_centres()
    image = np.zeros((camera.height, camera.width))
    for pixel in pixels:
        image += np.exp(-0.5 * ((grid - pixel) ** 2).sum(-1) / 2.0**2)
    return np.repeat((255 * np.clip(image, 0, 1)).astype(np.uint8)[..., None], 3, axis=2)


def spot_at(image: npt.NDArray[np.uint8], near: Array, camera: CameraModel) -> Array:
    """[2] px centre of gravity of the spot next to ``near``."""
    grid = camera.pixel_centres()
    weight = image[..., 0] * (np.linalg.norm(grid - near, axis=-1) < 9.0)
    return np.asarray((grid * weight[..., None]).sum((0, 1)) / weight.sum())


@DISTORTED
def test_undistorting_undoes_the_distortion_model(camera: CameraModel) -> None:
    rng = np.random.default_rng(0)
    rays = np.concatenate([rng.uniform(-0.4, 0.4, (50, 2)), np.ones((50, 1))], 1)
    found = undistort_points(distorted(rays, camera), camera)
    np.testing.assert_allclose(found, rays[:, :2], atol=2e-5)


@DISTORTED
def test_known_points_land_where_the_pinhole_camera_sees_them(camera: CameraModel) -> None:
    rectifier = Rectifier(camera, camera.width)
    pinhole = rectifier.camera
    assert not pinhole.is_distorted
    wanted = np.array([[60.0, 50.0], [250.0, 60.0], [160.0, 120.0], [70.0, 190.0], [260.0, 180.0]])
    image = spots(distorted(pinhole.unproject(wanted), camera), camera)

    rectified = rectifier(image)

    for pixel in wanted:
        np.testing.assert_allclose(spot_at(rectified, pixel, pinhole), pixel, atol=0.15)


@DISTORTED
def test_a_straight_line_of_the_world_is_straight_in_the_picture(camera: CameraModel) -> None:
    rectifier = Rectifier(camera, camera.width)
    pinhole = rectifier.camera
    along = np.linspace(0.1, 0.9, 7)
    line = np.stack([40 + 240 * along, 20 + 40 * along], -1)
    raw = distorted(pinhole.unproject(line), camera)

    rectified = rectifier(spots(raw, camera))
    found = np.array([spot_at(rectified, pixel, pinhole) for pixel in line])

    def bend(points: Array) -> float:
        return float(
            np.abs(np.polyval(np.polyfit(*points.T, 1), points[:, 0]) - points[:, 1]).max()
        )

    assert bend(found) < 0.15
    assert bend(raw) > 0.4


@DISTORTED
@pytest.mark.parametrize("width", [320, 200, 480])
def test_the_rectified_picture_has_no_black_border(camera: CameraModel, width: int) -> None:
    rectifier = Rectifier(camera, width)
    white = np.full((camera.height, camera.width, 3), 255, np.uint8)
    result = rectifier(white)
    assert result.shape == (rectifier.camera.height, width, 3)
    assert result.min() >= 253
    # The mask's border is False outside the picture, whatever the picture's own border repeats.
    assert rectifier.mask(np.ones((camera.height, camera.width), bool)).all()


def outline(camera: CameraModel) -> Array:
    """[200, 2] px along the picture's four edges."""
    W, H = float(camera.width), float(camera.height)
    along = np.linspace(0.0, 1.0, 50)[:, None]
    edges = [
        (along * W, 0 * along),
        (along * W, 0 * along + H),
        (0 * along, along * H),
        (0 * along + W, along * H),
    ]
    return np.concatenate([np.concatenate(edge, 1) for edge in edges])


@DISTORTED
@pytest.mark.parametrize(("zoom", "inside"), [(1.001, True), (0.97, False)])
def test_the_rectified_picture_reaches_just_to_the_edge_of_the_raw_one(
    camera: CameraModel, zoom: float, inside: bool
) -> None:
    pinhole = Rectifier(camera, camera.width).camera.with_focal_scaled(zoom)
    source = distorted(pinhole.unproject(outline(pinhole)), camera)
    size = [camera.width, camera.height]
    assert bool(((source >= 0.0) & (source <= size)).all()) is inside


@DISTORTED
def test_undistorting_is_exact_up_to_the_corners(camera: CameraModel) -> None:
    edges = outline(camera)
    points = undistort_points(edges, camera)
    rays = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    np.testing.assert_allclose(distorted(rays, camera), edges, atol=0.02)


def test_a_picture_without_distortion_is_only_resized() -> None:
    camera = CameraModel(320, 240, 260.0, 260.0, 160.0, 120.0)
    image = np.random.default_rng(0).integers(0, 256, (240, 320, 3), dtype=np.uint8)
    rectifier = Rectifier(camera, 160)
    assert rectifier.camera == camera.resize(160, 120)
    np.testing.assert_array_equal(
        rectifier(image), cv2.resize(image, (160, 120), interpolation=cv2.INTER_AREA)
    )
    np.testing.assert_array_equal(Rectifier(camera, 320)(image), image)


def test_a_mask_is_warped_like_its_picture_and_stays_binary() -> None:
    rectifier = Rectifier(RADTAN, RADTAN.width)
    mask = np.zeros((RADTAN.height, RADTAN.width), bool)
    mask[60:180, 80:200] = True
    image = np.repeat((255 * mask.astype(np.uint8))[..., None], 3, axis=2)
    warped = rectifier.mask(mask)
    assert warped.dtype == np.bool_
    differ = warped != (rectifier(image)[..., 0] > 127)
    outline = cv2.morphologyEx(warped.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3)))
    assert not (differ & (outline == 0)).any()


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        ("radtan", (-3.0, 0.0, 0.0, 0.0)),
        ("radtan", (-8.0, 20.0, 0.0, 0.0)),
        ("radtan", (0.0, 0.0, 3.0, 3.0)),
        ("radtan", (0.0, -1e6, 0.0, 0.0)),
        ("fisheye", (-1.0, 0.0, 0.0, 0.0)),
    ],
)
def test_a_distortion_that_folds_the_picture_is_refused(
    model: DistortionModel, coefficients: tuple[float, ...]
) -> None:
    camera = CameraModel(
        320, 240, 160.0, 160.0, 160.0, 120.0, distortion_model=model, distortion=coefficients
    )
    with pytest.raises(ConfigError, match="folds a 320 x 240 picture over itself"):
        Rectifier(camera, 320)


def test_a_fisheye_that_no_pinhole_picture_holds_is_refused_with_the_way_out() -> None:
    everything = replace(FISHEYE, fx=90.0, fy=90.0, distortion=(0.0, 0.0, 0.0, 0.0))
    with pytest.raises(ConfigError, match="of 180 degrees and more take a part with --crop"):
        Rectifier(everything, 320)


# --- behind a port --------------------------------------------------------------------------------

BEHIND_GLASS = replace(RADTAN, port=FlatPort(0.05, 0.01, range_m=1.0))
IN_A_DOME = replace(FISHEYE, port=DomePort(0.05, 0.003, (0.003, -0.002, -0.008), range_m=1.0))
PORTS = pytest.mark.parametrize("camera", [BEHIND_GLASS, IN_A_DOME], ids=["flat", "dome"])


@PORTS
def test_points_at_the_reference_range_land_where_the_virtual_camera_sees_them(
    camera: CameraModel,
) -> None:
    rectifier = Rectifier(camera, camera.width)
    pinhole = rectifier.camera
    assert pinhole.is_pinhole
    wanted = np.array([[60.0, 50.0], [250.0, 60.0], [160.0, 120.0], [70.0, 190.0], [260.0, 180.0]])
    depth = 1.0 - rectifier.centre_m[2]
    image = spots(
        pixels_of_points(camera, rectifier.centre_m + depth * pinhole.unproject(wanted)), camera
    )

    rectified = rectifier(image)

    for pixel in wanted:
        np.testing.assert_allclose(spot_at(rectified, pixel, pinhole), pixel, atol=0.15)


@PORTS
@pytest.mark.parametrize("width", [320, 200])
def test_a_picture_behind_a_port_has_no_black_border(camera: CameraModel, width: int) -> None:
    rectifier = Rectifier(camera, width)
    assert rectifier.mask(np.ones((camera.height, camera.width), bool)).all()


def test_water_lengthens_the_focal_length_by_its_index() -> None:
    port = FlatPort(0.0, 0.0, water=1.34, range_m=1.0)
    narrow = CameraModel(320, 240, 3000.0, 3000.0, 160.0, 120.0, port=port)
    assert Rectifier(narrow, 320).camera.fx == pytest.approx(1.34 * 3000.0, rel=2e-3)


def test_a_camera_that_cannot_see_through_its_port_is_refused() -> None:
    # The pane is turned by 40 degrees, and the fisheye sees 70 degrees to its left.
    turned = (float(np.sin(np.radians(40.0))), 0.0, float(np.cos(np.radians(40.0))))
    port = FlatPort(0.05, 0.01, normal=turned)
    with pytest.raises(ConfigError, match="cannot look through the port"):
        Rectifier(replace(FISHEYE, fx=130.0, fy=130.0, port=port), 320)
