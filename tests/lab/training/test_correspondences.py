"""True matches: a plane moves by its disparity, the hidden and the unknown have none."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from aquaflow.lab.training.pairs import Pair, correspondences, overlap, true_pointmaps
from tests.lab.training.plane_pairs import FOCAL_PX, plane_view, shifted_pair

pytestmark = pytest.mark.usefixtures("one_thread")


def test_a_plane_moves_by_its_disparity() -> None:
    found = correspondences(shifted_pair(0.5))
    disparity = FOCAL_PX * 0.5 / 2.0
    grid = torch.arange(20.0).double() + 0.5
    assert torch.allclose(found.pixels[0, :, :, 0], (grid - disparity).expand(20, 20))
    assert torch.allclose(found.pixels[0, :, :, 1], grid[:, None].expand(20, 20))
    assert torch.equal(found.visible[0, 3], grid - disparity >= 0)


def test_what_something_hides_has_no_match() -> None:
    pair = shifted_pair(0.5)
    depth = pair.b.depth.clone()
    depth[0, :, 4:8] = 0.5  # a post right before the second camera
    hidden = correspondences(Pair(pair.a, replace(pair.b, depth=depth)))
    assert not hidden.visible[0, :, 9:13].any()
    assert hidden.visible[0, :, 13:].all()


@pytest.mark.parametrize("which", ["a", "b"])
def test_pixels_without_truth_have_no_match(which: str) -> None:
    pair = shifted_pair(0.0)
    view = getattr(pair, which)
    valid = view.valid.clone()
    valid[0, 2, 5] = False
    found = correspondences(replace(pair, **{which: replace(view, valid=valid)}))
    assert int(found.visible.sum()) == 20 * 20 - 1
    assert not found.visible[0, 2, 5]


@pytest.mark.parametrize(("x", "share"), [(0.0, 1.0), (0.5, 0.75), (1.0, 0.5), (9.0, 0.0)])
def test_overlap_is_the_share_that_both_see(x: float, share: float) -> None:
    assert overlap(shifted_pair(x)).tolist() == [pytest.approx(share)]


def test_back_to_back_cameras_share_nothing() -> None:
    pair = Pair(plane_view(0.0), plane_view(0.0, turned=math.pi))
    assert overlap(pair).tolist() == [0.0]


def test_a_view_without_any_truth_overlaps_with_nothing() -> None:
    pair = shifted_pair(0.0)
    nothing = torch.zeros_like(pair.a.valid)
    assert overlap(Pair(replace(pair.a, valid=nothing), pair.b)).tolist() == [0.0]


def test_pointmaps_of_both_views_lie_on_the_plane_in_the_frame_of_a() -> None:
    pair = shifted_pair(0.5)
    X_a, X_b = true_pointmaps(pair)
    assert torch.allclose(X_a[..., 2], torch.tensor(2.0).double())
    assert torch.allclose(X_b - X_a, torch.tensor([0.5, 0.0, 0.0]).double())


def test_depth_that_is_no_number_costs_its_pixel_only() -> None:
    pair = shifted_pair(0.0)
    depth, valid = pair.a.depth.clone(), pair.a.valid.clone()
    depth[0, 4, 4], valid[0, 4, 4] = math.nan, False
    found = correspondences(Pair(replace(pair.a, depth=depth, valid=valid), pair.b))
    assert int(found.visible.sum()) == 20 * 20 - 1
