"""Open water in the pictures as observations of the backscatter at infinity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import torch

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.render.views import View
from aquaflow.water.estimation import estimating
from aquaflow.water.model import Trial
from aquaflow.water.observations import run_to_end
from aquaflow.water.open_sightings import COLUMNS, ROWS, with_open_water
from aquaflow.water.sightings import PosedPicture
from tests.water.water_observations import B_INF, B_RES, BETA, B, D, fitted, sighted

CAMERA = CameraModel(width=160, height=120, fx=140.0, fy=140.0, cx=80.0, cy=60.0)
NOTHING = np.zeros(5)
MEAN = np.array([0.4, 0.5, 0.3])


def trial(views: int) -> Trial:
    return Trial(BETA, B, B_INF, NOTHING, NOTHING, np.zeros((views, 3)))


def picture(
    colour: npt.NDArray[np.float64],  # [3] of the open water above the floor
    mask: npt.NDArray[np.bool_] | None = None,  # [H, W]
) -> PosedPicture:
    """Open water in the upper half, a floor with texture below."""
    image = np.zeros((120, 160, 3), np.uint8)
    image[:] = np.rint(255.0 * colour)
    image[60:] = np.random.default_rng(0).integers(20, 200, (60, 160, 3))
    view = View(0, image, CAMERA, Sim3(np.eye(3), np.zeros(3)), 0, robust=False, mask=mask)
    return PosedPicture(view, torch.ones(120, 160), torch.ones(120, 160))


def test_each_open_cell_is_an_observation_at_infinity() -> None:
    seen = sighted(points=120)
    extended = run_to_end(with_open_water(seen, [picture(B_INF)] * 2, trial(2), MEAN))
    rows = slice(len(seen.z), None)
    open_rows = COLUMNS * (ROWS // 2 - 1)  # the cells that touch the floor are not all open
    assert 2 * open_rows <= extended.points - seen.points <= 2 * COLUMNS * ROWS // 2
    np.testing.assert_allclose(
        extended.colour[rows], np.tile(B_INF, (len(extended.z[rows]), 1)), atol=0.01
    )
    assert extended.z[rows].min() > 100.0 * seen.z.max()
    assert extended.xy[rows, 1].max() < 0.1
    assert set(extended.view[rows].tolist()) == {0, 1}
    assert extended.surface == seen.points
    assert extended.median_range == seen.median_range


def test_observations_of_one_views_open_water_share_their_errors() -> None:
    seen = sighted(points=120)
    extended = run_to_end(with_open_water(seen, [picture(B_INF)] * 2, trial(2), MEAN))
    shared = extended.errors_shared[len(seen.z) :]
    assert len(set(shared.tolist())) == 2
    assert min(shared) > max(extended.errors_shared[: len(seen.z)])


def test_pictures_without_open_water_add_nothing() -> None:
    seen = sighted(points=120)
    red = picture(np.array([0.9, 0.8, 0.1]))
    assert run_to_end(with_open_water(seen, [red], trial(1), MEAN)) is seen
    assert run_to_end(with_open_water(seen, [], trial(1), MEAN)) is seen


def test_a_masked_vehicle_is_no_open_water() -> None:
    seen = sighted(points=120)
    mask = np.ones((120, 160), bool)
    mask[:60] = False
    assert run_to_end(with_open_water(seen, [picture(B_INF, mask)], trial(1), MEAN)) is seen


def test_open_water_pins_what_the_surface_leaves_open() -> None:
    """Points that are all near say little of B_inf."""
    near = sighted(noise=0.01)
    near = replace(near, z=0.3 * near.z)
    path = near.z[:, None]
    J = np.random.default_rng(0).uniform(0.1, 0.8, (near.points, 3))[near.point]
    noise = 0.01 * np.random.default_rng(1).normal(size=J.shape)
    near = replace(near, colour=J * np.exp(-BETA * path) - B_INF * np.expm1(-B * path) + noise)
    without = fitted(near)
    found = run_to_end(estimating(near, B_RES, D, pictures=[picture(B_INF)] * 4))
    assert found is not None
    errors = [np.abs(np.log(each.B_inf / B_INF)).max() for each in (without, found)]
    assert errors[1] < 0.1
    assert errors[1] < errors[0]
