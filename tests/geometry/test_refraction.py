"""Rays through ports: Snell's law by hand, there and back, and limits with closed forms."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aquaflow.geometry.optics import rays_in_water, rays_to_points, refract
from aquaflow.geometry.port import DomePort, FlatPort, Port

Array = npt.NDArray[np.float64]

TILT = np.radians(8.0)
PORTS: dict[str, Port] = {
    "flat": FlatPort(0.05, 0.01, 1.49, 1.34),
    "tilted": FlatPort(0.05, 0.01, 1.52, 1.34, (float(np.sin(TILT)), 0.0, float(np.cos(TILT)))),
    "far behind a thin window": FlatPort(0.3, 0.002, 1.59, 1.335),
    "lens at the window": FlatPort(0.0, 0.01, 1.49, 1.34),
    "decentred dome": DomePort(0.05, 0.004, (0.004, -0.003, 0.01), 1.49, 1.34),
    "dome too far back": DomePort(0.05, 0.004, (0.0, 0.0, -0.012), 1.49, 1.34),
    "centred dome": DomePort(0.05, 0.004, (0.0, 0.0, 0.0), 1.49, 1.34),
}
EVERY_PORT = pytest.mark.parametrize("port", PORTS.values(), ids=PORTS)


def towards(degrees: float, azimuth: float = 0.0) -> Array:
    """[3] unit vector at an angle from the optical axis."""
    angle, about = np.radians(degrees), np.radians(azimuth)
    aside = np.sin(angle)
    return np.array([aside * np.cos(about), aside * np.sin(about), np.cos(angle)])


def fan() -> Array:
    """[M, 3] unit vectors up to 55 degrees from the optical axis."""
    return np.array(
        [towards(d, a) for d in (0.0, 5.0, 20.0, 40.0, 55.0) for a in range(0, 360, 30)]
    )


def test_a_flat_port_bends_a_ray_as_snell_says() -> None:
    # 30 degrees in air; glass 1.5, water 1.333: sines 0.5, 1/3, 0.5/1.333.
    origin, ray = rays_in_water(FlatPort(0.05, 0.01, 1.5, 1.333), towards(30.0))
    in_glass, in_water = np.arcsin(0.5 / 1.5), np.arcsin(0.5 / 1.333)
    radius = 0.05 * np.tan(np.radians(30.0)) + 0.01 * np.tan(in_glass)
    np.testing.assert_allclose(origin, [radius, 0.0, 0.06], atol=1e-15)
    np.testing.assert_allclose(ray, [np.sin(in_water), 0.0, np.cos(in_water)], atol=1e-15)


def test_a_dome_whose_centre_is_ahead_bends_a_ray_as_snell_says() -> None:
    ahead, inner, outer, glass, water = 0.01, 0.05, 0.054, 1.49, 1.34
    origin, ray = rays_in_water(DomePort(0.05, 0.004, (0.0, 0.0, ahead), glass, water), towards(40))
    # By the sine rule in the triangle of lens, centre and point of the sphere.
    onto_glass = np.arcsin(ahead * np.sin(np.radians(40.0)) / inner)
    in_glass = np.arcsin(np.sin(onto_glass) / glass)
    out_of_glass = np.arcsin(inner * np.sin(in_glass) / outer)
    in_water = np.arcsin(glass * np.sin(out_of_glass) / water)
    angle = np.radians(40.0) + (onto_glass - in_glass) + (out_of_glass - in_water)
    np.testing.assert_allclose(ray, [np.sin(angle), 0.0, np.cos(angle)], atol=1e-14)
    assert np.linalg.norm(origin - [0.0, 0.0, ahead]) == pytest.approx(outer, abs=1e-15)


@EVERY_PORT
def test_every_ray_keeps_its_plane_and_its_length(port: Port) -> None:
    rays = fan()
    origins, in_water = rays_in_water(port, rays)
    np.testing.assert_allclose(np.linalg.norm(in_water, axis=1), 1.0, atol=1e-14)
    normals = np.cross(rays, port.axis)
    for vectors in (origins, in_water):
        np.testing.assert_allclose(np.sum(vectors * normals, axis=1), 0.0, atol=1e-15)


@EVERY_PORT
@settings(max_examples=40, deadline=None)
@given(
    degrees=st.floats(0.0, 60.0),
    azimuth=st.floats(0.0, 360.0),
    range_m=st.floats(0.01, 100.0),
)
def test_a_point_is_seen_under_the_ray_that_passes_it(
    port: Port, degrees: float, azimuth: float, range_m: float
) -> None:
    ray = towards(degrees, azimuth)
    origin, in_water = rays_in_water(port, ray)
    np.testing.assert_allclose(rays_to_points(port, origin + range_m * in_water), ray, atol=1e-9)


@EVERY_PORT
def test_the_derivative_of_seeing_a_point_is_the_inverse_of_that_of_its_ray(port: Port) -> None:
    def point(angles: Array) -> Array:
        """[2] where the ray meets z = 1 m."""
        x, y = angles
        ray = np.array([x, y, 1.0]) / np.sqrt(1.0 + x * x + y * y)
        origin, in_water = rays_in_water(port, ray)
        return np.asarray((origin + in_water * (1.0 - origin[2]) / in_water[2])[:2])

    def seen(place: Array) -> Array:
        ray = rays_to_points(port, np.array([*place, 1.0]))
        return np.asarray(ray[:2] / ray[2])

    def derivative(function: object, at: Array) -> Array:
        assert callable(function)
        steps = 1e-5 * np.eye(2)
        return np.stack([(function(at + s) - function(at - s)) / 2e-5 for s in steps], axis=1)

    at = np.array([0.35, -0.2])
    product = derivative(seen, point(at)) @ derivative(point, at)
    np.testing.assert_allclose(product, np.eye(2), atol=1e-8)


def test_a_window_at_the_lens_without_thickness_refracts_in_one_point() -> None:
    origins, in_water = rays_in_water(FlatPort(0.0, 0.0, 1.49, 1.34), fan())
    np.testing.assert_allclose(origins, 0.0, atol=1e-15)
    np.testing.assert_allclose(in_water[:, :2], fan()[:, :2] / 1.34, atol=1e-15)


def test_a_centred_dome_does_not_refract_at_all() -> None:
    origins, in_water = rays_in_water(PORTS["centred dome"], fan())
    np.testing.assert_allclose(in_water, fan(), atol=1e-14)
    np.testing.assert_allclose(origins, 0.054 * fan(), atol=1e-15)


@pytest.mark.parametrize(
    "port", [FlatPort(0.05, 0.01, 1.0, 1.0), DomePort(0.05, 0.004, (0.004, 0.0, 0.01), 1.0, 1.0)]
)
def test_without_indexes_the_camera_is_a_pinhole(port: Port) -> None:
    origins, in_water = rays_in_water(port, fan())
    np.testing.assert_allclose(in_water, fan(), atol=1e-14)
    np.testing.assert_allclose(np.cross(origins, fan()), 0.0, atol=1e-15)
    points = 2.0 * fan()
    np.testing.assert_allclose(rays_to_points(port, points), fan(), atol=1e-9)


def test_total_reflection_gives_no_ray() -> None:
    normal = np.array([0.0, 0.0, 1.0])
    assert np.isnan(refract(towards(70.0), normal, 1.34)).all()
    assert np.isfinite(refract(towards(40.0), normal, 1.34)).all()


@EVERY_PORT
def test_a_ray_that_leaves_backwards_does_not_reach_a_flat_port(port: Port) -> None:
    origin, in_water = rays_in_water(port, towards(120.0))
    assert np.isfinite(origin).all() == np.isfinite(in_water).all() == (port.kind == "dome")


@pytest.mark.parametrize(
    ("port", "point"),
    [
        (FlatPort(0.05, 0.01), [0.0, 0.0, 0.03]),
        (FlatPort(0.05, 0.01), [0.1, 0.0, -1.0]),
        (FlatPort(0.0, 0.0), [2.0, 0.0, 1.0]),  # 63 degrees: the window lets in 48
        (FlatPort(0.05, 0.01), [np.nan, 0.0, 1.0]),
        (DomePort(0.05, 0.004, (0.0, 0.0, 0.01)), [0.01, 0.0, 0.02]),
    ],
)
def test_a_point_that_no_ray_reaches_has_none(port: Port, point: list[float]) -> None:
    assert np.isnan(rays_to_points(port, np.array(point))).all()


def test_points_that_are_not_seen_leave_the_others_alone() -> None:
    port = FlatPort(0.05, 0.01)
    points = np.array([[0.2, 0.1, 1.0], [0.0, 0.0, 0.01], [np.nan, 0.0, 1.0]])
    found = rays_to_points(port, points)
    np.testing.assert_array_equal(found[0], rays_to_points(port, points[0]))
    assert np.isnan(found[1:]).all()
