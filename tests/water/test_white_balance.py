"""Restored pictures: near things keep their colours, and nothing is amplified beyond reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.render.views import View
from aquaflow.water.medium import MAX_RESTORED, WaterParameters
from aquaflow.water.model import Trial
from aquaflow.water.nearest import GAINS, Nearest, kept_by, nearest_of
from aquaflow.water.observations import run_to_end
from aquaflow.water.sightings import PosedPicture
from aquaflow.water.white_balance import (
    CONTRAST,
    GREY,
    PICTURE_NOISE,
    VEIL_ERROR,
    WhiteBalance,
)
from tests.water.water_observations import B_INF, B_RES, BETA, B, D, fitted, sighted

WATER = WaterParameters(
    torch.tensor([0.8, 0.3, 0.2]),
    torch.tensor([0.05, 0.3, 0.4]),
    torch.tensor([0.8, 0.4, 0.3]),
    torch.full((3,), 0.01),
    torch.ones(3),
)
NEAR = torch.tensor(0.5)
GAIN = WATER.transmission(NEAR) + WATER.backscatter(NEAR) / 0.3
"""By which a colour of 0.3 looks as it does at the near range."""
BALANCE = WhiteBalance(
    near_range=0.5, mean=(0.3, 0.3, 0.3), gain=tuple(GAIN.tolist()), attenuation_sigma=0.1
)


def seen(J: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
    return J * WATER.transmission(z) + WATER.backscatter(z)


def test_what_is_nearest_keeps_the_camera_s_colours() -> None:
    z = torch.full((4, 5), 0.5)
    image = seen(torch.full((4, 5, 3), 0.3), z)
    restored = BALANCE.recover(image, z, WATER).picture
    torch.testing.assert_close(restored, image, atol=0.01, rtol=0.0)


def test_grey_things_stay_grey_at_any_range_that_light_comes_from() -> None:
    z = torch.linspace(0.5, 2.5, 40).reshape(4, 10)
    J = 0.4 / GAIN * torch.ones(4, 10, 3)  # grey in the near white balance
    restored = BALANCE.recover(seen(J, z), z, WATER).picture
    assert float((restored - restored.mean(dim=-1, keepdim=True)).abs().max()) < 0.06


def recovered_by_matrices(
    image: torch.Tensor, z: torch.Tensor, water: WaterParameters
) -> tuple[torch.Tensor, torch.Tensor]:
    """J-hat before the gain and tr(G A) / 3, by the matrices of the module's text."""
    T, veil, mean = water.transmission(z), water.backscatter(z), torch.tensor(BALANCE.mean).to(z)
    depth = water.beta_a * (z[..., None] - BALANCE.near_range).clamp_min(0.0)
    uncertain = BALANCE.attenuation_sigma * depth * mean * T
    N = PICTURE_NOISE**2 + (VEIL_ERROR * veil) ** 2 + uncertain**2
    deviation = CONTRAST * mean
    S = GREY * torch.outer(deviation, deviation) + (1.0 - GREY) * torch.diag(deviation**2)
    A = torch.diag_embed(T)
    G = S @ A @ torch.linalg.inv(A @ S @ A + torch.diag_embed(N))
    J = (G @ (image - veil)[..., None] + (mean[:, None] - G @ A @ mean[:, None]))[..., 0]
    return J, (G @ A).diagonal(dim1=-2, dim2=-1).sum(dim=-1) / 3.0


def test_the_mean_of_what_may_be_is_that_of_the_matrices() -> None:
    numbers = (WATER.beta_a, WATER.B_inf, WATER.b, WATER.B_res, WATER.d)
    water = WaterParameters(*(each.double() for each in numbers))
    generator = torch.Generator().manual_seed(0)
    z = torch.rand(9, 11, generator=generator, dtype=torch.float64) * 12.0
    image = torch.rand(9, 11, 3, generator=generator, dtype=torch.float64)
    J, confidence = recovered_by_matrices(image, z, water)
    found = BALANCE.recover(image, z, water)
    white = torch.tensor(BALANCE.white, dtype=torch.float64)
    shown = (J * white).clamp(0.0, MAX_RESTORED)
    torch.testing.assert_close(found.picture, shown, atol=1e-6, rtol=0.0)
    torch.testing.assert_close(found.confidence, confidence, atol=1e-6, rtol=0.0)


def test_where_no_light_comes_back_the_scene_s_mean_stands_in() -> None:
    z = torch.full((2, 2), 50.0)
    restored = BALANCE.recover(WATER.B_inf.expand(2, 2, 3), z, WATER).picture
    expected = torch.tensor(BALANCE.mean) * GAIN
    torch.testing.assert_close(restored, expected.expand(2, 2, 3), atol=0.02, rtol=0.0)


def test_a_channel_without_light_follows_the_others() -> None:
    water = replace(WATER, beta_a=torch.tensor([9.0, 0.1, 0.1]))
    z = torch.full((1, 2), 2.0)
    J = torch.tensor([[[0.1, 0.1, 0.1], [0.6, 0.6, 0.6]]])
    image = J * water.transmission(z) + water.backscatter(z)
    balance = WhiteBalance(0.0, (0.3, 0.3, 0.3), (1.0, 1.0, 1.0), 0.0)
    restored = balance.recover(image, z, water).picture
    assert float(restored[0, 1, 0]) > float(restored[0, 0, 0]) + 0.2


def test_the_confidence_falls_with_range_and_is_none_where_no_light_comes_back() -> None:
    z = torch.tensor([[0.5, 1.0, 2.0, 4.0, 8.0, 50.0]])
    confidence = BALANCE.recover(torch.full((1, 6, 3), 0.3), z, WATER).confidence[0]
    assert bool((confidence.diff() < 0.0).all())
    assert float(confidence[0]) > 0.85
    assert float(confidence[-1]) < 0.01


def test_the_confidence_counts_the_channels_that_were_seen() -> None:
    balance = WhiteBalance(0.0, (0.3, 0.3, 0.3), (1.0, 1.0, 1.0), 0.0)
    for seen_channels in range(4):
        beta_a = torch.full((3,), 20.0)
        beta_a[:seen_channels] = 0.0
        clear = torch.zeros(3)
        water = WaterParameters(beta_a, clear, clear, clear, clear)
        found = balance.recover(torch.full((1, 1, 3), 0.3), torch.ones(1, 1), water)
        assert float(found.confidence) == pytest.approx(seen_channels / 3.0, abs=0.03)


def test_the_confidence_is_the_share_of_a_change_that_is_shown() -> None:
    z = torch.full((1, 1), 2.0)
    J, shown = torch.full((1, 1, 3), 0.3), []
    for channel in range(3):
        more = J.clone()
        more[..., channel] += 0.01
        change = [BALANCE.recover(seen(each, z), z, WATER) for each in (J, more)]
        step = (change[1].picture - change[0].picture)[..., channel] / 0.01
        shown.append(float(step / GAIN[channel]))
    confidence = float(BALANCE.recover(seen(J, z), z, WATER).confidence)
    assert confidence == pytest.approx(sum(shown) / 3.0, abs=1e-3)


def test_no_channel_is_amplified_more_than_the_posterior_allows() -> None:
    z = torch.linspace(0.1, 12.0, 200).reshape(10, 20)
    found = BALANCE.recover(torch.full((10, 20, 3), 0.3), z, WATER)
    assert found.amplification is not None
    assert found.allowed is not None
    assert bool((found.amplification <= found.allowed * (1.0 + 1e-4)).all())
    # The bound is near where a channel's light is all that there is to know, and finite far away.
    assert float((found.amplification / found.allowed).max()) > 0.8
    assert float(found.allowed.max()) < 20.0


def test_the_amplification_is_that_of_the_picture_s_own_channel() -> None:
    z, image = torch.full((1, 1), 2.0), torch.full((1, 1, 3), 0.3)
    base = BALANCE.recover(image, z, WATER)
    assert base.amplification is not None
    for channel in range(3):
        brighter = image.clone()
        brighter[..., channel] += 0.01
        step = BALANCE.recover(brighter, z, WATER).picture - base.picture
        expected = float(base.amplification[..., channel])
        assert float(step[..., channel]) / 0.01 == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("bad", [0.0, 1e9])
def test_any_range_gives_a_picture(bad: float) -> None:
    z = torch.full((2, 2), bad)
    found = BALANCE.recover(torch.full((2, 2, 3), 0.9), z, WATER)
    assert found.amplification is not None
    assert found.allowed is not None
    for part in (found.picture, found.confidence, found.amplification, found.allowed):
        assert bool(torch.isfinite(part).all())
        assert float(part.min()) >= 0.0
    assert float(found.confidence.max()) <= 1.0


def test_what_was_seen_nearest_has_on_the_mean_the_colour_that_the_camera_saw() -> None:
    seen = sighted(noise=0.0)
    estimate = fitted(seen)
    balance = estimate.balance
    assert balance is not None
    water = WaterParameters(
        *(torch.from_numpy(v).float() for v in (estimate.beta_a, estimate.B_inf, estimate.b)),
        torch.from_numpy(B_RES).float(),
        torch.from_numpy(D).float(),
    )
    near = estimate.nearest
    assert near is not None
    colours, z = torch.from_numpy(near.colour).float(), torch.from_numpy(near.z).float()
    restored = balance.recover(colours[None], z[None], water).picture
    torch.testing.assert_close(restored.mean(dim=(0, 1)), colours.mean(dim=0), atol=0.02, rtol=0.0)


def test_a_channel_that_is_black_has_a_bounded_gain() -> None:
    near = Nearest(np.zeros(4, np.int64), np.zeros((4, 2)), np.ones(4), np.full((4, 3), 0.5))
    assert kept_by(near, np.zeros((3, 4))) == (GAINS[1],) * 3


CAMERA = CameraModel(width=160, height=120, fx=140.0, fy=140.0, cx=80.0, cy=60.0)


def test_the_nearest_tenth_of_the_surface_is_kept_and_open_water_is_no_surface() -> None:
    """The map has Gaussians in open water, nearer than all else."""
    image = np.random.default_rng(0).integers(20, 200, (120, 160, 3)).astype(np.uint8)
    image[:60] = np.rint(255.0 * B_INF)
    z = np.linspace(3.0, 1.0, 120, dtype=np.float32)[:, None].repeat(160, axis=1)
    z[:60] = 0.2
    view = View(0, image, CAMERA, Sim3(np.eye(3), np.zeros(3)), 0, robust=False)
    picture = PosedPicture(view, torch.from_numpy(z), torch.ones(120, 160))
    trial = Trial(BETA, B, B_INF, np.zeros(5), np.zeros(5), np.zeros((1, 3)))
    near = run_to_end(nearest_of(sighted(points=120), [picture], trial, np.full(3, 0.4)))
    assert near.z.min() == pytest.approx(1.0, abs=0.02)
    assert near.z.max() < 1.2
    assert near.xy[:, 1].min() > 0.8
    assert set(near.view.tolist()) == {0}


def test_without_pictures_the_nearest_observations_of_each_view_are_kept() -> None:
    seen = sighted(points=200)
    trial = Trial(BETA, B, B_INF, np.zeros(5), np.zeros(5), np.zeros((4, 3)))
    near = run_to_end(nearest_of(seen, [], trial, np.full(3, 0.4)))
    for view in range(4):
        share = (near.view == view).sum() / (seen.view == view).sum()
        assert share == pytest.approx(0.1, abs=0.02)
        assert near.z[near.view == view].max() < np.quantile(seen.z[seen.view == view], 0.11)
