"""Fish and an arm in a synthetic dive: seen, in the truth, and nothing of the scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from aquaflow.lab.synthetic import objects
from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.dive import write_dive
from aquaflow.lab.synthetic.truth import Truth, read_truth

BARE = {"supersampling": 1, "snow_per_m3": 0.0, "noise_sigma": 0.0, "width": 64, "height": 48}


def written(out: Path, **asked: object) -> Truth:
    write_dive(out, SyntheticConfig.model_validate({"frames": 4, **BARE, **asked}), None)
    return read_truth(out)


def ellipsoid(*size: float) -> objects.Solid:
    grey, half, centre = (0.3, 0.3, 0.3), (size[0], size[1], size[2]), np.array([0.0, 0.0, 5.0])
    return objects.Solid("ellipsoid", centre, np.eye(3), half, grey, grey, 0.0)


@pytest.fixture(scope="module")
def still(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    return written(tmp_path_factory.mktemp("still"))


@pytest.fixture(scope="module")
def crowded(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    return written(tmp_path_factory.mktemp("crowded"), fish=6, arm=True)


def test_a_ray_meets_an_ellipsoid_where_its_equation_says() -> None:
    rng = np.random.default_rng(3)
    size = np.array([0.5, 1.0, 2.0])
    rays = rng.normal([0.0, 0.0, 1.0], [0.15, 0.15, 0.0], (200, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    t = objects.hit(ellipsoid(*size), torch.zeros(3), torch.tensor(rays.T, dtype=torch.float32))
    met = np.isfinite(t.numpy())
    assert 0 < met.sum() < len(rays)
    at = (t.numpy()[met, None] * rays[met] - [0.0, 0.0, 5.0]) / size
    np.testing.assert_allclose(np.linalg.norm(at, axis=1), 1.0, atol=1e-4)
    apart = np.cross(-np.array([0.0, 0.0, 5.0]) / size, rays / size)
    missed = np.linalg.norm(apart, axis=1) > np.linalg.norm(rays / size, axis=1)
    np.testing.assert_array_equal(missed, ~met)


def test_bodies_change_only_the_pixels_that_the_truth_calls_moving(
    still: Truth, crowded: Truth
) -> None:
    seen = 0
    for k in range(len(still)):
        moving = crowded.moving(k)
        assert not still.moving(k).any()
        seen += int(moving.sum())
        np.testing.assert_array_equal(crowded.range_m(k)[~moving], still.range_m(k)[~moving])
        assert (crowded.range_m(k)[moving] < still.range_m(k)[moving]).all()
        # A body's outline counts in how fine the floor's texture is read next to it.
        apart = cv2.dilate(moving.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0
        np.testing.assert_array_equal(crowded.clean(k)[apart], still.clean(k)[apart])
    assert seen > 0


def test_a_body_keeps_its_pattern_while_it_moves() -> None:
    here, texture = ellipsoid(0.3, 0.3, 0.3), objects.object_texture(np.random.default_rng(0))
    looks = []
    for x in (0.0, 0.4):
        centre = here.centre + np.array([x, 0.0, 0.0])
        shape = replace(here, centre=centre, growth=(0.0, 0.0, 0.0), covered=0.5, pattern_m=0.7)
        origin, ray = torch.tensor([x, 0.0, 0.0]), torch.tensor([[0.02], [0.03], [0.999]])
        t = objects.hit(shape, origin, ray)
        looks.append(objects.radiance(shape, texture, origin, ray, t, 1e-3).numpy())
    np.testing.assert_allclose(looks[0], looks[1], rtol=1e-4)


def test_fish_move_through_the_world_and_the_arm_with_the_camera(tmp_path: Path) -> None:
    fish = written(tmp_path / "fish", fish=1, seed=2, frames=6)
    arm = written(tmp_path / "arm", arm=True, seed=2, frames=6)
    shares = [[float(t.moving(k).mean()) for k in range(6)] for t in (fish, arm)]
    assert max(shares[0]) > 0.0
    assert min(shares[1]) > 0.01
    assert np.ptp(shares[1]) < 0.5 * np.mean(shares[1])
