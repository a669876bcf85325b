"""Whole maps on a device that CI has: the pretended one, or the CPU without compiled kernels."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from aquaflow.config import MappingConfig
from aquaflow.mapping import state
from aquaflow.mapping.mapper import Mapper
from aquaflow.render.contract import CPU, Rendering
from aquaflow.render.reference import ReferenceRenderer
from aquaflow.render.transfer_counts import transfers
from tests.mapping.mapping_scenes import (
    CAMERA,
    flat_pointmap,
    floor,
    path,
    picture,
    pose,
    settings,
    view_of,
    water,
)
from tests.pretended_device import PRETENDED

KERNELS = ("photometric", "water", "adam", "contract")
FITTED = tuple(f"aquaflow.render.{name}" for name in KERNELS)
DECODE = "aquaflow.mapping.neural.decoder"
"""Modules that take the compiled kernels where there are any."""

ALL_PARTS: dict[str, dict[str, Any]] = {
    "medium": {"enabled": True, "first_fit_views": 6, "fit_views": 6},
    "decoder": {"enabled": True, "local_width": 4, "global_width": 4, "width": 8},
    "sunlight": {"enabled": True},
    "optimiser": {"poses": 1e-3, "refine_steps": 8, "prune_every": 10, "heldout_steps": 2},
    "insertion": {"density": 0.3},
}
"""Everything that a map can have, in few steps."""


SMALL = CAMERA.resize(32, 24)
WHERE = (CPU, PRETENDED)


class SinglePrecision:
    """The reference renderer in gsplat's place: on any device, and in float32 as gsplat is."""

    name, isa, threads = "reference", "torch", 1

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._exact = ReferenceRenderer(device)

    def __call__(self, *inputs: Any) -> Rendering:
        drawn = self._exact(*inputs)
        names = ("image", "alpha", "radius_px")
        return replace(drawn, **{name: getattr(drawn, name).float() for name in names})


def without_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let torch compute on the CPU what it computes on a device."""
    for module in (*FITTED, DECODE):
        monkeypatch.setattr(f"{module}.library_or_none", lambda: None)


def everything(**stages: dict[str, Any]) -> MappingConfig:
    return settings(**{**ALL_PARTS, **stages})


def mapped(device: torch.device, config: MappingConfig | None = None) -> Mapper:
    """A dive over the floor in water: grown, moved by a loop closure, not yet refined."""
    mapper = Mapper(config or everything(), SinglePrecision(device), seed=3)
    for number, T_wc in enumerate(path(9)):
        view = view_of(picture(floor(), T_wc, water(), SMALL), T_wc, number, number % 3 == 2, SMALL)
        mapper.add_view(view)
        if number % 4 == 0:
            mapper.insert(view, flat_pointmap(camera=SMALL))
        mapper.optimise(2)
    mapper.move({0: pose((0.01, 0.0, 0.0))})
    mapper.optimise(2)
    return mapper


def again(mapper: Mapper, device: torch.device) -> Mapper:
    """A copy of the map, whose pictures are those of the original."""
    copy = state.deserialise(*state.serialise(mapper, optimiser=True), SinglePrecision(device))
    for view, original in zip(copy.views, mapper.views, strict=True):
        view._store = original._store
    return copy


def on_host(mapper: Mapper) -> dict[str, Tensor]:
    """What a map is made of, on the CPU."""
    found = {**mapper.gaussians.parameters, **mapper.medium.state_dict()}
    if mapper.neural is not None:
        mapper.neural.settle()
        found |= mapper.neural.decoder.state_dict()
        found["shared"] = mapper.neural.groups.features
        found["local"] = mapper.gaussians.local_features
    for view in mapper.views:
        found[f"exposure {view.frame_index}"] = view.log_gain
        found[f"pose {view.frame_index}"] = torch.from_numpy(view.world_to_camera())
        if view.light is not None:
            found[f"light {view.frame_index}"] = view.light
    return {name: tensor.detach().cpu() for name, tensor in found.items()}


def assert_alike(got: dict[str, Tensor], wanted: dict[str, Tensor]) -> None:
    """The same names, shapes and values within float32's rounding."""
    assert got.keys() == wanted.keys()
    for name, tensor in wanted.items():
        torch.testing.assert_close(got[name], tensor, msg=lambda text, n=name: f"{n}: {text}")


def counted() -> int:
    """Transfers so far by the named functions."""
    return sum(transfers().values())
