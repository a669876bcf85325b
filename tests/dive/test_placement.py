"""Rasters and points of a dive lie on the same place of the earth."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.dive.placement import placement
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.export.ortho.ground import ground_of
from tests.metric_scenes import metric_frame
from tests.survey.export.survey_scenes import surveyed


@pytest.mark.parametrize("placed", [True, False])
def test_a_raster_and_a_cloud_have_the_same_coordinates(placed: bool) -> None:
    frame = metric_frame(T_nm=Sim3.identity())
    if not placed:
        frame = metric_frame(T_nm=Sim3.identity(), origin=None, north="initial heading")
    ground, where = ground_of(frame, surveyed(frame)), placement(frame)
    assert (ground.epsg, ground.unit) == (where.epsg, where.unit)
    assert (ground.epsg is not None) == placed
    # Half a kilometre around; the raster is one affine map there, which costs some millimetres.
    points_n = np.random.default_rng(0).uniform((-500, -500, 0), (500, 500, 30), (50, 3))
    points_g = ground.T_gm.apply(points_n)
    raster = np.array(ground.origin) + ground.grid_scale * points_g[:, :2]
    cloud = where.on_grid(where.T_un.apply(points_n))
    np.testing.assert_allclose(raster, cloud[:, :2], rtol=0.0, atol=5e-3)
    np.testing.assert_allclose(points_g[:, 2], cloud[:, 2], rtol=0.0, atol=1e-9)


def test_directions_turn_to_the_grid_as_points_do() -> None:
    where = placement(metric_frame(T_nm=Sim3.identity()))
    step = np.array([[0.0, 0.0, 0.0], [0.6, 0.8, 0.0]])
    ends = where.on_grid(step)
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    assert abs(along[0] - 0.6) > 0.005  # true north is not the grid's
    np.testing.assert_allclose(where.turned_to_grid(step[1:])[0], along, atol=1e-5)
