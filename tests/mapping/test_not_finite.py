"""What is not a number enters nothing that a map keeps."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from aquaflow.config import InsertionConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.gaussians import GaussianMap, move_gaussians, move_views, new_gaussians
from aquaflow.render.views import View, refine_pose
from aquaflow.water.exposure import learn_gain, set_log_gains
from aquaflow.water.sunlight import learn_light
from tests.mapping.mapping_scenes import cloud, view_of

NOWHERE = Sim3(np.eye(3), np.array([np.nan, 0.0, 0.0]))
SOLID = torch.ones(48, 64)


def grey_view(index: int = 0) -> View:
    return view_of(np.full((48, 64, 3), 120, np.uint8), index=index)


def unchanged(gaussians: GaussianMap, before: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(gaussians.parameters[name], before[name]) for name in before)


def test_gaussians_that_are_not_finite_are_refused() -> None:
    gaussians = cloud()
    before = dict(gaussians.parameters)
    new = {name: torch.full_like(tensor[:2], torch.nan) for name, tensor in before.items()}
    with pytest.raises(ArithmeticError):
        gaussians.extend(new, 0)
    assert unchanged(gaussians, before)


def test_a_pixel_whose_range_is_unknown_gets_no_gaussian() -> None:
    z = torch.ones(48, 64)
    z[3, 5] = torch.nan
    rows, columns = torch.tensor([3, 4]), torch.tensor([5, 6])
    half = torch.full((48, 64), 0.5)
    colour = torch.full((48, 64, 3), 0.5)
    new = new_gaussians(grey_view(), rows, columns, z, colour, half, half, 1.0, InsertionConfig())
    assert {len(values) for values in new.values()} == {1}
    assert all(bool(torch.isfinite(values).all()) for values in new.values())


def test_a_correction_that_is_not_finite_moves_no_gaussian() -> None:
    gaussians = cloud()
    gaussians.keyframes = torch.zeros(len(gaussians), dtype=torch.int64)
    before = {name: tensor.clone() for name, tensor in gaussians.parameters.items()}
    with pytest.raises(ArithmeticError):
        move_gaussians(gaussians, {0: NOWHERE})
    assert unchanged(gaussians, before)


def test_a_correction_that_is_not_finite_moves_no_view() -> None:
    first, second = grey_view(), grey_view(1)
    second.keyframe = first.keyframe + 1
    moves = {first.keyframe: Sim3(np.eye(3), np.ones(3)), second.keyframe: NOWHERE}
    before = first.T_wc
    with pytest.raises(ArithmeticError):
        move_views([first, second], moves)
    assert first.T_wc is before


def test_a_pose_is_not_refined_to_nowhere(monkeypatch: pytest.MonkeyPatch) -> None:
    view = grey_view()
    before, moments = view.T_wc, view.moments
    monkeypatch.setattr("aquaflow.render.views.so3_exp", lambda w: np.full((3, 3), np.nan))
    monkeypatch.setattr(Sim3, "__matmul__", lambda self, other: self)
    with pytest.raises(ArithmeticError):
        refine_pose(view, torch.ones(4, 4), 1e-3)
    assert (view.T_wc, view.moments) == (before, moments)


def test_light_and_exposure_stay_what_they_were(monkeypatch: pytest.MonkeyPatch) -> None:
    view = grey_view()
    drawn = torch.full((48, 64, 3), 0.4)
    monkeypatch.setattr(torch.Tensor, "log", lambda self: torch.full_like(self, torch.nan))
    learn_gain(view, drawn, SOLID)
    learn_light(view, drawn, SOLID)
    assert view.light is not None
    assert bool(torch.isfinite(view.log_gain).all())
    assert bool(torch.isfinite(view.light).all())


def test_an_exposure_that_is_not_finite_is_given_to_no_view() -> None:
    views = [grey_view(), grey_view(10)]
    with pytest.raises(ArithmeticError):
        set_log_gains(views, views, np.full((2, 3), np.nan))
    assert all(bool(torch.isfinite(view.log_gain).all()) for view in views)
