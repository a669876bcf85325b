"""Medium-guided insertion: where new Gaussians go, and how they start."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
import torch

from aquaflow.config import InsertionConfig
from aquaflow.mapping.gaussians import (
    COVERED_ALPHA,
    MAX_SPACING_WIDTHS,
    SCALE_OF_SPACING,
    density_for,
    insertion_probability,
    new_gaussians,
    select,
    structure,
    thin,
)
from aquaflow.render.contract import radiance
from tests.mapping.mapping_scenes import CAMERA, pose, view_of

SIZE = (CAMERA.height, CAMERA.width)
CONFIG = InsertionConfig()
PRINTED = InsertionConfig(norm="l2", gain=1.0, averaged=False)
"""Eq. 17 of the paper, as it is printed."""
FLAT = torch.full((*SIZE, 3), 0.4)
EDGE = FLAT.clone()
EDGE[:, 32:] = 0.8
BARE, SOLID = torch.zeros(SIZE), torch.ones(SIZE)


def random() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def born(
    rows: list[int],
    columns: list[int],
    z: torch.Tensor,
    P: float = 0.5,
    confidence: float = 1.0,
    density: float = 1.0,
    **keys: float,
) -> dict[str, torch.Tensor]:
    image = np.zeros((*SIZE, 3), np.uint8)
    view = view_of(image, pose((0.3, -0.2, 0.5), (0.1, 0.2, -0.3)))
    return new_gaussians(
        view,
        torch.tensor(rows),
        torch.tensor(columns),
        z,
        EDGE,
        torch.full(SIZE, confidence),
        torch.full(SIZE, P),
        density,
        InsertionConfig.model_validate(keys),
    )


# --- probability ----------------------------------------------------------------------------------


def test_a_flat_picture_asks_for_the_bare_probability_and_no_more() -> None:
    P = insertion_probability(FLAT, torch.zeros_like(FLAT), BARE, CONFIG)
    torch.testing.assert_close(P, torch.full(SIZE, CONFIG.bare_probability))


def test_an_edge_asks_for_more_on_both_its_sides_and_not_far_from_it() -> None:
    P = insertion_probability(EDGE, torch.zeros_like(EDGE), BARE, CONFIG)
    assert (P[:, 30:34] > 5.0 * CONFIG.bare_probability).all()
    torch.testing.assert_close(P[:, :20], torch.full((SIZE[0], 20), CONFIG.bare_probability))


def test_pixels_that_the_map_explains_ask_for_nothing() -> None:
    assert not insertion_probability(EDGE, EDGE, SOLID, CONFIG).any()


def test_structure_that_only_the_map_has_asks_for_nothing() -> None:
    assert not insertion_probability(FLAT, EDGE, SOLID, CONFIG).any()


def test_the_map_covers_from_the_configured_alpha_on() -> None:
    alpha = torch.full(SIZE, COVERED_ALPHA)
    assert not insertion_probability(FLAT, FLAT, alpha, CONFIG).any()
    assert insertion_probability(FLAT, FLAT, alpha - 0.01, CONFIG).all()


def test_structure_saturates_at_one_and_is_never_negative() -> None:
    board = 2.0 * ((torch.arange(SIZE[0])[:, None] + torch.arange(SIZE[1])[None]) % 2).float()
    wild = structure(board[..., None].repeat(1, 1, 3), InsertionConfig(sigma_px=0.6))
    assert float(wild.max()) == 1.0
    assert float(wild.min()) >= 0.0


def test_the_papers_operator_is_the_euclidean_norm_of_the_laplacian_pixel_by_pixel() -> None:
    seen = structure(EDGE, PRINTED)[24]
    smooth = cv2.GaussianBlur(EDGE.numpy(), (0, 0), PRINTED.sigma_px)
    response = cv2.Laplacian(smooth, cv2.CV_32F)[24]
    torch.testing.assert_close(seen, torch.from_numpy(np.sqrt((response**2).sum(axis=-1))))


@pytest.mark.parametrize(
    ("key", "value", "share"), [("norm", "l1", math.sqrt(3.0)), ("gain", 3.0, 3.0)]
)
def test_norm_and_gain_of_a_grey_edge_raise_its_response_by_what_they_say(
    key: str, value: object, share: float
) -> None:
    ours = PRINTED.model_copy(update={key: value})
    torch.testing.assert_close(structure(EDGE, ours), share * structure(EDGE, PRINTED))


def test_only_averaged_does_the_zero_crossing_on_an_edge_count_as_structure() -> None:
    ramp = torch.linspace(0.0, 1.0, 5)[None, :, None].expand(SIZE[0], 5, 3)
    edge = torch.cat([torch.zeros(SIZE[0], 30, 3), ramp, torch.ones(SIZE[0], 29, 3)], dim=1)
    averaged = structure(edge, PRINTED.model_copy(update={"averaged": True}))
    printed = structure(edge, PRINTED)
    assert float(printed[24, 32]) < 1e-4 < 0.1 * float(printed[24].max())
    assert float(averaged[24, 32]) > 0.5 * float(averaged[24].max())


# --- selection ------------------------------------------------------------------------------------


def test_a_probability_at_tau_a_is_not_selected() -> None:
    config = InsertionConfig(tau_a=0.3)
    at = torch.full(SIZE, 0.3)
    assert len(select(at, torch.ones(SIZE, dtype=torch.bool), 1.0, config, random())[0]) == 0
    above, allowed = torch.ones(SIZE), torch.ones(SIZE, dtype=torch.bool)
    assert len(select(above, allowed, 1.0, config, random())[0]) == 64 * 48


def test_an_empty_map_is_filled_densely_and_a_full_one_as_the_paper_does() -> None:
    densities = [density_for(5.0, filled) for filled in (0.0, 0.4, 0.8, 0.95, 1.0)]
    assert densities == pytest.approx([5.0, 3.0, 1.0, 1.0, 1.0])
    assert {density_for(0.5, filled) for filled in (0.0, 0.6, 1.0)} == {0.5}


def test_only_allowed_pixels_are_selected() -> None:
    allowed = torch.zeros(SIZE, dtype=torch.bool)
    allowed[10:20, 5:9] = True
    rows, columns = select(torch.ones(SIZE), allowed, 1.0, InsertionConfig(), random())
    assert sorted(zip(rows.tolist(), columns.tolist(), strict=True)) == [
        (row, column) for row in range(10, 20) for column in range(5, 9)
    ]


def test_pixels_are_drawn_with_probability_times_density() -> None:
    everywhere = torch.ones(200, 200, dtype=torch.bool)
    chosen = select(torch.full((200, 200), 0.4), everywhere, 0.5, InsertionConfig(), random())
    assert len(chosen[0]) == pytest.approx(0.2 * 40_000, abs=5 * math.sqrt(0.16 * 40_000))


def test_thinning_keeps_as_many_as_there_is_room_for_from_all_over_the_picture() -> None:
    rows, columns = torch.nonzero(torch.ones(SIZE), as_tuple=True)
    kept_rows, kept_columns = thin(rows, columns, 300, random())
    assert len(kept_rows) == len(set(zip(kept_rows.tolist(), kept_columns.tolist()))) == 300  # noqa: B905
    assert 0.3 < float((kept_rows >= SIZE[0] // 2).float().mean()) < 0.7
    assert len(thin(rows, columns, 0, random())[0]) == 0
    assert len(thin(rows, columns, -5, random())[0]) == 0


def test_thinning_draws_nothing_where_there_is_room() -> None:
    rows, columns, generator = torch.tensor([1, 2]), torch.tensor([3, 4]), random()
    state = generator.get_state()
    assert thin(rows, columns, 2, generator) == (rows, columns)
    assert torch.equal(generator.get_state(), state)


# --- start values ---------------------------------------------------------------------------------


def test_new_gaussians_lie_on_the_ray_of_their_pixels_centre_at_its_range() -> None:
    rng = np.random.default_rng(0)
    rows, columns = rng.integers(0, 48, 40).tolist(), rng.integers(0, 64, 40).tolist()
    z = torch.from_numpy(rng.uniform(0.5, 4.0, SIZE)).float()
    new = born(rows, columns, z)
    view = view_of(np.zeros((*SIZE, 3), np.uint8), pose((0.3, -0.2, 0.5), (0.1, 0.2, -0.3)))
    local = view.T_wc.inverse().apply(new["means"].double().numpy())
    wanted = np.stack([columns, rows], -1) + 0.5
    np.testing.assert_allclose(CAMERA.project(local), wanted, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(local, axis=1), z[rows, columns], rtol=1e-5)


def test_a_new_gaussian_is_as_wide_as_the_expected_spacing_at_its_range() -> None:
    z = torch.full(SIZE, 1.0)
    z[:, 32:] = 3.0
    scales = torch.exp(born([5, 5], [10, 50], z, P=0.5, density=0.5)["log_scales"])
    wanted = 0.6 * 2.0 / 55.0  # spacing 1 / sqrt(0.25)
    torch.testing.assert_close(
        scales, torch.tensor([[wanted] * 3, [3 * wanted] * 3]), rtol=1e-4, atol=0
    )


def test_sparser_pixels_get_wider_gaussians_up_to_a_limit() -> None:
    z = torch.ones(SIZE)
    widths = [float(born([5], [5], z, P=P)["log_scales"][0, 0].exp()) for P in (1.0, 0.3, 0.1)]
    assert widths == sorted(widths)
    assert widths[0] < 0.6 * widths[-1]
    limit = SCALE_OF_SPACING * MAX_SPACING_WIDTHS * CAMERA.width / CAMERA.fx
    rare = born([5], [5], z, P=0.0)["log_scales"][0, 0].exp()
    assert float(rare) == pytest.approx(limit, rel=1e-4)


def test_opacity_follows_confidence_and_stays_off_both_ends() -> None:
    z = torch.ones(SIZE)
    for confidence, opacity, wanted in ((0.5, 0.6, 0.3), (0.0, 0.5, 0.05), (1.0, 0.99, 0.95)):
        logit = born([5], [5], z, confidence=confidence, opacity=opacity)["opacity_logits"]
        assert float(torch.sigmoid(logit)) == pytest.approx(wanted, abs=1e-4)


def test_the_colour_is_the_restored_one_and_the_rotation_none() -> None:
    new = born([5, 5], [10, 50], torch.ones(SIZE))
    wanted = torch.tensor([[0.4] * 3, [0.8] * 3])
    torch.testing.assert_close(radiance(new["raw_colours"]), wanted, atol=1e-4, rtol=0.0)
    assert new["quats"].tolist() == [[1.0, 0.0, 0.0, 0.0]] * 2
