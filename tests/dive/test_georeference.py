"""Latitude and longitude against formulas written here, which a published example checks."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.dive.placement import georeference, to_geodetic, utm_epsg
from aquaflow.telemetry.world_frame import Origin, WorldFrame
from tests.metric_scenes import TRONDHEIM, metric_frame

A, F = 6378137.0, 1.0 / 298.257223563
"""WGS 84: semi-major axis, m, and flattening."""


def geocentric(latitude_deg: float, longitude_deg: float, height_m: float) -> np.ndarray:
    e2, (phi, lam) = F * (2.0 - F), np.radians([latitude_deg, longitude_deg])
    n = A / np.sqrt(1.0 - e2 * np.sin(phi) ** 2)
    across = (n + height_m) * np.cos(phi)
    return np.array(
        [across * np.cos(lam), across * np.sin(lam), (n * (1.0 - e2) + height_m) * np.sin(phi)]
    )


def ned(place: tuple[float, float, float], origin: tuple[float, float, float]) -> np.ndarray:
    """North, east and down, m, of a place (degrees, degrees, m) from an origin."""
    phi, lam = np.radians(origin[:2])
    north = [-np.sin(phi) * np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi)]
    east = [-np.sin(lam), np.cos(lam), 0.0]
    down = [-np.cos(phi) * np.cos(lam), -np.cos(phi) * np.sin(lam), -np.sin(phi)]
    return np.array([north, east, down]) @ (geocentric(*place) - geocentric(*origin))


def test_the_formulas_of_this_test_give_the_published_example() -> None:
    """IOGP Publication 373-7-2, geographic/topocentric conversions (EPSG method 9837)."""
    place = (53 + 48 / 60 + 33.82 / 3600, 2 + 7 / 60 + 46.38 / 3600, 73.0)
    north, east, down = ned(place, (55.0, 5.0, 200.0))
    assert (east, north, -down) == pytest.approx((-189013.869, -128642.040, -4220.171), abs=0.01)


@pytest.mark.parametrize("origin", [TRONDHEIM, Origin(-33.9, 151.2, "usbl", 1.0)])
def test_places_are_those_of_the_formulas(origin: Origin) -> None:
    middle = (origin.latitude_deg, origin.longitude_deg, 0.0)
    steps = ((0.0, 0.0, 0.0), (0.01, -0.02, 40.0), (-0.003, 0.004, 6.0))  # degrees, degrees, m
    places = [(middle[0] + dy, middle[1] + dx, -depth) for dy, dx, depth in steps]
    points_n = np.array([ned(place, middle) for place in places])
    latitude, longitude = to_geodetic(origin, points_n)
    np.testing.assert_allclose(latitude, [p[0] for p in places], atol=1e-10)
    np.testing.assert_allclose(longitude, [p[1] for p in places], atol=1e-10)


@pytest.mark.parametrize(
    ("latitude", "longitude", "epsg"),
    [
        (63.43, 10.39, 32632),  # Trondheim
        (34.69, 135.19, 32653),  # Kobe
        (60.39, 5.32, 32632),  # Bergen: zone 31 by its longitude
        (78.22, 15.65, 32633),  # Longyearbyen
        (78.92, 11.93, 32633),  # Ny-Alesund: zone 32 by its longitude
        (-33.9, 151.2, 32756),  # Sydney
        (0.0, -180.0, 32601),
        (0.0, 180.0, 32601),
        (85.0, 0.0, None),
        (-80.5, 0.0, None),
    ],
)
def test_the_zone_of_a_place(latitude: float, longitude: float, epsg: int | None) -> None:
    assert utm_epsg(latitude, longitude) == epsg


def test_the_origin_on_the_grid() -> None:
    """On a zone's central meridian: the meridian's arc of 45 degrees, and no convergence."""
    middle = metric_frame(origin=Origin(45.0, 9.0, "gnss", 1.0))
    content = georeference({0: middle}, 0)
    assert content is not None
    utm = content["utm"]
    assert (utm["epsg"], utm["zone"]) == (32632, "32N")
    assert utm["easting_m"] == pytest.approx(500_000.0, abs=1e-3)
    assert utm["northing_m"] == pytest.approx(0.9996 * 4_984_944.378, abs=0.01)
    assert utm["convergence_deg"] == pytest.approx(0.0, abs=1e-9)


def test_the_convergence_is_that_of_the_meridian() -> None:
    content = georeference({0: metric_frame()}, 0)
    assert content is not None
    phi, lam = np.radians([63.43, 10.39 - 9.0])
    sphere = np.degrees(np.arctan(np.tan(lam) * np.sin(phi)))
    assert content["utm"]["convergence_deg"] == pytest.approx(sphere, abs=1e-3)


def test_the_file_is_there_only_where_a_position_was_heard() -> None:
    assert georeference({0: metric_frame(origin=None)}, 0) is None
    assert georeference({}, 0) is None
    frames = {0: WorldFrame.unknown(), 1: metric_frame(depth_known=False)}
    content = georeference(frames, main=0)
    assert content is not None
    assert content["origin"]["depth_m"] is None
    assert [each["georeferenced"] for each in content["sub_maps"].values()] == [False, True]
    near_the_pole = georeference({0: metric_frame(origin=Origin(88.0, 0.0, "gnss", 1.0))}, 0)
    assert near_the_pole is not None
    assert near_the_pole["utm"] is None
