"""Sightings: the same pieces of surface in all pictures that show them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
import torch

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.render.views import View
from aquaflow.water import sightings
from aquaflow.water.normals import with_normals
from aquaflow.water.observations import Observations, run_to_end
from aquaflow.water.sightings import MIN_VIEWS, MOST_VIEWS, POINTS, PosedPicture, sighting

Array = npt.NDArray[np.float64]

CAMERA = CameraModel(width=160, height=120, fx=140.0, fy=140.0, cx=80.0, cy=60.0)
WALL_Z = 2.0
BACKING = [np.array([0.05 * k, 0.0, -0.25 * k]) for k in range(6)]
"""Camera centres that back away from a wall across the z axis."""


def ranges_of_the_wall(centre: Array) -> Array:
    rays = CAMERA.unproject(CAMERA.pixel_centres())
    return np.asarray((WALL_Z - centre[2]) * np.linalg.norm(rays / rays[..., 2:], axis=-1))


def wall_picture(
    centre: Array,
    colours: npt.NDArray[np.uint8] | None = None,  # [H, W, 3]
    ranges: Array | None = None,  # [H, W] of the map; None: the wall's own
    alpha: float = 1.0,
) -> PosedPicture:
    """The wall, painted with smooth waves, from ``centre``."""
    z = ranges_of_the_wall(centre) if ranges is None else ranges
    rays = CAMERA.unproject(CAMERA.pixel_centres())
    at = centre + rays / rays[..., 2:] * (WALL_Z - centre[2])
    waves = [0.5 + 0.3 * np.sin(k * at[..., 0]) * np.cos(k * at[..., 1]) for k in (5.0, 6.0, 7.0)]
    painted = np.rint(255.0 * np.stack(waves, axis=-1)).astype(np.uint8)
    image = painted if colours is None else colours
    view = View(0, image, CAMERA, Sim3(np.eye(3), centre), keyframe=0, robust=False)
    known = torch.from_numpy(z.astype(np.float32))
    return PosedPicture(view, known, torch.full(known.shape, alpha))


def looked(pictures: list[PosedPicture]) -> Observations:
    return run_to_end(sighting(pictures, np.random.default_rng(0)))


def facing(pictures: list[PosedPicture]) -> tuple[Observations, Array]:
    """What is looked at, and its normals."""
    seen = run_to_end(with_normals(looked(pictures), pictures))
    assert seen.normal is not None
    return seen, seen.normal


def test_a_patch_has_the_same_colour_from_near_and_far() -> None:
    seen = looked([wall_picture(centre) for centre in BACKING])
    assert seen.points > 400
    mean = np.stack([np.bincount(seen.point, c) for c in seen.colour.T], axis=-1)
    mean /= np.bincount(seen.point)[:, None]
    assert np.abs(seen.colour - mean[seen.point]).max() < 0.02
    # And no contrast is lost: the far colours rise and fall with the mean as the near ones do.
    far = seen.z > np.median(seen.z)
    for rows in (far, ~far):
        slope = np.polyfit(mean[seen.point[rows], 0], seen.colour[rows, 0], 1)[0]
        assert slope == pytest.approx(1.0, abs=0.01)


def test_range_and_place_are_those_of_the_patch() -> None:
    seen = looked([wall_picture(centre) for centre in BACKING])
    for row in range(0, len(seen.z), 97):
        local = seen.positions[seen.point[row]] - BACKING[seen.view[row]]
        assert seen.z[row] == pytest.approx(np.linalg.norm(local), rel=0.01)
        at = CAMERA.project(local) / (80.0, 60.0) - 1.0
        np.testing.assert_allclose(seen.xy[row], at, atol=0.02)


def test_rays_and_normals_are_in_camera_axes_and_normals_face_the_camera() -> None:
    seen, normal = facing([wall_picture(centre) for centre in BACKING])
    assert seen.ray is not None
    local = seen.positions[seen.point] - np.array(BACKING)[seen.view]
    expected = local / np.linalg.norm(local, axis=1, keepdims=True)
    np.testing.assert_allclose(seen.ray, expected, atol=1e-6)
    np.testing.assert_allclose(normal, np.tile([0.0, 0.0, -1.0], (len(seen.z), 1)), atol=0.02)


def test_what_stands_out_of_a_surface_does_not_turn_its_normals() -> None:
    bumped = []
    for centre in BACKING:
        z = ranges_of_the_wall(centre)
        z[50:54, 76:80] *= 0.97
        bumped.append(wall_picture(centre, ranges=z))
    _, normal = facing(bumped)
    assert np.quantile(-normal[:, 2], 0.05) > 0.995


def test_observations_come_by_point_and_a_point_is_seen_once_in_a_view() -> None:
    seen = looked([wall_picture(centre) for centre in BACKING])
    assert (np.diff(seen.point) >= 0).all()
    assert len(np.unique(seen.point * 100 + seen.view)) == len(seen.point)
    assert np.bincount(seen.point).min() >= MIN_VIEWS


def test_of_many_views_the_nearest_and_the_farthest_are_among_those_used() -> None:
    centres = [np.array([0.0, 0.0, -0.05 * k]) for k in range(16)]
    seen = looked([wall_picture(centre) for centre in centres])
    assert np.bincount(seen.point).max() == MOST_VIEWS
    first = seen.view[seen.starts]
    assert (first == 0).mean() > 0.9


def test_what_is_hidden_in_a_view_is_no_observation() -> None:
    pictures = [wall_picture(centre) for centre in BACKING]
    near = np.full((120, 160), 0.5)
    pictures[2] = wall_picture(BACKING[2], ranges=near)
    seen = looked(pictures)
    assert 2 not in seen.view
    assert seen.points > 100


def test_where_the_map_has_nothing_there_are_no_patches() -> None:
    assert looked([wall_picture(centre, alpha=0.2) for centre in BACKING]).points == 0


def test_where_pixels_are_clipped_there_is_no_observation() -> None:
    pictures = [wall_picture(centre) for centre in BACKING]
    bright = np.array(pictures[0].half_size()).repeat(2, axis=0).repeat(2, axis=1) * 255.0 * 1.6
    pictures[0] = wall_picture(BACKING[0], np.rint(bright.clip(0.0, 255.0)).astype(np.uint8))
    seen = looked(pictures)
    assert (seen.view == 0).any()
    assert seen.colour.max() < sightings.CLIPPED


def test_open_water_without_texture_is_no_surface() -> None:
    blue = np.full((120, 160, 3), (20, 60, 120), np.uint8)
    assert looked([wall_picture(centre, colours=blue) for centre in BACKING]).points == 0


def test_a_masked_vehicle_is_not_sighted() -> None:
    view_mask = np.zeros((120, 160), bool)
    view_mask[:60] = True
    pictures = []
    for centre in BACKING:
        whole = wall_picture(centre)
        z = ranges_of_the_wall(centre).astype(np.float32)
        image = np.rint(whole.sample(CAMERA.pixel_centres(), np.full(120, 0.1)) * 255.0)
        view = View(0, image.astype(np.uint8), CAMERA, Sim3(np.eye(3), centre), 0, False, view_mask)
        pictures.append(PosedPicture(view, torch.from_numpy(z), torch.ones(120, 160)))
    seen = looked(pictures)
    assert seen.points > 0
    assert seen.xy[:, 1].max() < 0.05


def test_patches_in_too_few_views_are_left_out() -> None:
    seen = looked([wall_picture(centre) for centre in BACKING[: MIN_VIEWS - 1]])
    assert seen.points == 0
    assert seen.colour.shape == (0, 3)


def test_no_more_points_are_taken_than_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    assert looked([wall_picture(centre) for centre in BACKING]).points <= POINTS
    monkeypatch.setattr(sightings, "POINTS", 40)
    assert looked([wall_picture(centre) for centre in BACKING]).points <= 40


def test_ranges_that_are_not_numbers_show_nothing() -> None:
    broken = np.full((120, 160), np.nan)
    pictures = [wall_picture(centre) for centre in BACKING]
    pictures[0] = wall_picture(BACKING[0], ranges=broken)
    seen = looked(pictures)
    assert 0 not in seen.view
    assert np.isfinite(seen.z).all()
