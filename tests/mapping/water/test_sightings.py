"""Sightings: colours that the camera saw over each Gaussian's own footprint."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from aquaflow.mapping.gaussians.gaussians import GaussianMap
from aquaflow.mapping.views import View
from aquaflow.mapping.water import sightings
from aquaflow.mapping.water.observations import Observations
from aquaflow.mapping.water.sightings import MIN_VIEWS, sight
from tests.mapping.mapping_scenes import CAMERA, gaussians_at, pose, renderer, view_of

STEPS = [pose((0.0, 0.0, -0.15 * i)) for i in range(MIN_VIEWS)]
"""Cameras that back away from the points."""


def isolated() -> GaussianMap:
    """Twelve points of different colours and depths, far apart in the picture."""
    x, y = torch.meshgrid(
        torch.linspace(-0.36, 0.36, 4), torch.linspace(-0.24, 0.24, 3), indexing="ij"
    )
    rays = torch.stack([x.reshape(-1), y.reshape(-1), torch.ones(12)], 1)
    depth = torch.linspace(1.8, 2.2, 12)[:, None]
    colours = torch.rand(12, 3, generator=torch.Generator().manual_seed(0))
    return gaussians_at(rays * depth, colours, 0.055)


def painted(gaussians: GaussianMap, colours: torch.Tensor) -> list[View]:
    """Pictures in which every pixel has the colour of the nearest Gaussian."""
    views = []
    for i, T_wc in enumerate(STEPS):
        at = CAMERA.project(T_wc.inverse().apply(gaussians.means.double().numpy()))
        distance = np.linalg.norm(CAMERA.pixel_centres()[:, :, None] - at, axis=-1)
        image = (colours.numpy()[distance.argmin(-1)] * 255.0).round().astype(np.uint8)
        views.append(view_of(image, T_wc, i))
    return views


def looked(gaussians: GaussianMap, views: list[View], beta_a: float = 0.0) -> Observations:
    random, water = torch.Generator().manual_seed(0), np.full(3, beta_a)
    return sight(lambda view: gaussians.parameters, views, renderer(), random, water)


def test_the_sighted_colour_is_the_pictures_and_not_the_maps() -> None:
    gaussians = isolated()
    colours = torch.rand(12, 3, generator=torch.Generator().manual_seed(5))
    seen = looked(gaussians, painted(gaussians, colours))
    assert seen.points == 12
    assert len(seen.point) == 12 * MIN_VIEWS
    np.testing.assert_allclose(seen.colour, colours[seen.point], atol=0.01)


def test_the_blend_is_what_neighbours_add_to_a_point_from_afar() -> None:
    gaussians = isolated()
    alone = looked(gaussians, painted(gaussians, gaussians.colours))
    bright = gaussians_at(
        gaussians.means + torch.tensor([0.08, 0.0, 0.0]), torch.ones(12, 3), 0.055
    )
    gaussians.extend(bright.parameters, keyframe=0)
    crowded = looked(gaussians, painted(gaussians, gaussians.colours))
    few, many = (float(np.abs(seen.blend).mean()) for seen in (alone, crowded))
    assert many > 2.0 * few
    sums = np.stack([np.bincount(crowded.point, crowded.blend[:, c]) for c in range(3)])
    np.testing.assert_allclose(sums, 0.0, atol=1e-6)


def test_the_blend_is_as_it_looks_through_the_maps_own_water_at_the_mean_range() -> None:
    gaussians = isolated()
    views = painted(gaussians, gaussians.colours)
    in_air, in_water = looked(gaussians, views), looked(gaussians, views, beta_a=0.7)
    mean = np.bincount(in_air.point, in_air.z) / MIN_VIEWS
    faded = in_air.blend * np.exp(-0.7 * mean[in_air.point])[:, None]
    np.testing.assert_allclose(in_water.blend, faded, rtol=1e-9)


def test_range_and_place_are_those_of_the_gaussians_centre() -> None:
    gaussians = isolated()
    seen = looked(gaussians, painted(gaussians, gaussians.colours))
    means = gaussians.means.double().numpy()
    for i, T_wc in enumerate(STEPS):
        rows = slice(12 * i, 12 * (i + 1))
        assert seen.point[rows].tolist() == list(range(12))
        np.testing.assert_allclose(seen.z[rows], np.linalg.norm(means - T_wc.t, axis=1), rtol=1e-6)
        at = CAMERA.project(T_wc.inverse().apply(means)) / (32.0, 24.0) - 1.0
        np.testing.assert_allclose(seen.xy[rows], at, atol=1e-6)


def test_a_gaussian_behind_others_is_not_sighted() -> None:
    front = torch.tensor([[0.0, 0.0, 1.5 + 0.01 * i] for i in range(4)])
    hidden = torch.tensor([[0.0, 0.0, 2.2]])
    wall = gaussians_at(front, torch.full((4, 3), 0.5), 0.3, opacity=0.98)
    behind = gaussians_at(hidden, torch.full((1, 3), 0.5), 0.055)
    alone = [view_of(np.zeros((48, 64, 3), np.uint8), T) for T in STEPS]
    assert looked(behind, alone).points == 1
    behind.extend(wall.parameters, keyframe=0)
    seen = looked(behind, alone)
    assert seen.z.max() < 2.2
    assert seen.points >= 1


@pytest.mark.parametrize(
    "mean",
    [
        (0.0, 0.0, -2.0),  # behind, on the axis: it projects to the centre
        (5.0, 0.0, 2.0),
        (32.0 / 55.0 * 2.0, 0.0, 2.0),  # cut in half by the picture's edge
    ],
)
def test_what_is_not_wholly_in_the_picture_is_not_sighted(mean: tuple[float, ...]) -> None:
    outside = gaussians_at(torch.tensor([mean]), torch.full((1, 3), 0.5), 0.055)
    still = [view_of(np.zeros((48, 64, 3), np.uint8)) for _ in range(MIN_VIEWS)]
    assert looked(outside, still).points == 0


def test_points_in_too_few_views_are_left_out() -> None:
    gaussians = isolated()
    views = painted(gaussians, gaussians.colours)[: MIN_VIEWS - 1]
    seen = looked(gaussians, views)
    assert seen.points == 0
    assert seen.colour.shape == (0, 3)


def test_no_more_points_are_taken_than_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sightings, "POINTS", 5)
    gaussians = isolated()
    seen = looked(gaussians, painted(gaussians, gaussians.colours))
    assert seen.points == 5
    assert len(seen.point) == 5 * MIN_VIEWS
