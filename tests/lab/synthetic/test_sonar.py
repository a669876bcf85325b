"""The beam of an echo sounder: its first return is the nearest ground within it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from aquaflow.lab.synthetic.relief import Area
from aquaflow.lab.synthetic.telemetry.sonar import Sonar

BEAM_RAD = np.radians(25.0)
AREA = Area(-4.0, -4.0, 0.05, (160, 160))


def ground(height: float = 0.0) -> npt.NDArray[np.float32]:
    return np.full(AREA.shape, height, np.float32)


def distance(
    height: npt.NDArray[np.float32], up_m: float, tilt_deg: float = 0.0, longest_m: float = 100.0
) -> float:
    """First return ``up_m`` above z = 0, over the middle of the area, leaning by ``tilt_deg``."""
    R = Rotation.from_euler("y", tilt_deg, degrees=True).as_matrix()[None]
    origin = np.array([[0.0, 0.0, -up_m]])
    return float(Sonar(AREA, height).first_return(origin, R, BEAM_RAD, longest_m)[0])


@pytest.mark.parametrize("tilt_deg", [0.0, 5.0, -12.0])
def test_leaning_less_than_half_the_beam_does_not_change_the_range(tilt_deg: float) -> None:
    assert distance(ground(0.5), 2.5, tilt_deg) == pytest.approx(2.0, rel=5e-4)


def test_leaning_further_the_nearest_edge_of_the_beam_counts() -> None:
    edge = 2.0 / np.cos(np.radians(20.0 - 12.5))
    assert distance(ground(), 2.0, 20.0) == pytest.approx(edge, rel=1e-3)


def test_a_box_at_the_edge_of_the_beam_is_heard_before_the_floor() -> None:
    height = ground()
    x = AREA.x0 + (np.arange(AREA.shape[1]) + 0.5) * AREA.cell
    height[:, x > 0.2] = 0.5
    # Its nearest point is its upper edge, 1.5 m down and 0.2 m aside: 7.6 degrees off the axis.
    assert distance(height, 2.0) == pytest.approx(np.hypot(1.5, 0.2), abs=0.03)
    height[:, x <= 0.4] = 0.0
    # Out of the beam of 12.5 degrees at that height; its side further down is in it.
    assert 1.75 < distance(height, 2.0) < 2.0


def test_nothing_is_heard_beyond_the_longest_range_or_above_the_horizon() -> None:
    assert distance(ground(), 5.0, longest_m=4.0) == np.inf
    assert distance(ground(), 5.0, tilt_deg=110.0) == np.inf


def test_the_ground_goes_on_beyond_its_area() -> None:
    origin, R = np.array([[50.0, 50.0, -3.0]]), np.eye(3)[None]
    heard = Sonar(AREA, ground()).first_return(origin, R, BEAM_RAD, 100.0)
    assert heard[0] == pytest.approx(3.0, rel=1e-3)
