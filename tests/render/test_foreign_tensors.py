"""A kernel that is handed a tensor it cannot read says so; it would otherwise end the process."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from aquaflow.base.errors import AquaFlowError
from aquaflow.render.adam import SelectiveAdam
from aquaflow.render.contract import Renderer
from aquaflow.render.cpu import CpuRenderer, TileRenderer
from aquaflow.render.library import library_or_none
from aquaflow.render.native import build as native
from aquaflow.render.reference import ReferenceRenderer
from aquaflow.render.tensor_address import pointer
from aquaflow.render.water import compose_water
from tests.render.render_scenes import HEIGHT, WIDTH, random_scene

ELSEWHERE = torch.device("meta")

compiled = pytest.mark.skipif(native.find_compiler() is None, reason="no C++ compiler")


@pytest.mark.parametrize(
    ("tensor", "said"),
    [
        (torch.zeros(3, device=ELSEWHERE), "a tensor on meta"),
        (torch.zeros(3, dtype=torch.float64), "float64"),
        (torch.zeros(3, 4).T, r"strides \(1, 4\)"),
        (torch.zeros(6)[::2], r"strides \(2,\)"),
        (torch.zeros(3, 3).to_sparse(), "sparse"),
    ],
)
def test_an_address_is_given_of_contiguous_cpu_tensors_of_the_type_alone(
    tensor: Tensor, said: str
) -> None:
    with pytest.raises(AquaFlowError, match=said):
        pointer(tensor)


def test_an_address_is_given_of_the_type_that_is_asked_for() -> None:
    flags = torch.ones(3, dtype=torch.bool)
    assert pointer(flags, torch.bool) == flags.data_ptr()
    with pytest.raises(AquaFlowError, match=r"torch\.bool"):
        pointer(flags)


@compiled
@pytest.mark.parametrize("make", [CpuRenderer, TileRenderer, ReferenceRenderer])
@pytest.mark.parametrize("foreign", range(7))
def test_no_renderer_moves_what_is_on_another_device(
    make: Callable[[], Renderer], foreign: int
) -> None:
    inputs = random_scene().leaves()
    inputs[foreign] = torch.empty_like(inputs[foreign], device=ELSEWHERE)
    with pytest.raises(AquaFlowError, match="was given a tensor on meta"):
        make()(*inputs, WIDTH, HEIGHT)


@pytest.mark.skipif(library_or_none() is None, reason="no compiled kernels")
def test_water_over_a_picture_of_two_devices_is_refused() -> None:
    drawn, alpha, water = torch.zeros(4, 4, 4), torch.zeros(4, 4), torch.ones(5, 3)
    with pytest.raises(AquaFlowError, match="a tensor on meta"):
        compose_water(drawn, alpha.to(ELSEWHERE), water)


def test_an_optimiser_keeps_its_state_where_its_tensors_are() -> None:
    adam = SelectiveAdam({"means": (torch.zeros(2, 3), 0.1)})
    with pytest.raises(AquaFlowError, match="on one device"):
        adam.bind({"means": torch.zeros(2, 3, device=ELSEWHERE)})
