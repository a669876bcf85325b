"""Steps of the optimiser on the GPU: those of the processor, and a GPU that fails between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from aquaflow.config import MappingConfig
from aquaflow.mapping import gpu_steps
from aquaflow.mapping.mapper import Mapper
from aquaflow.render.contract import Renderer
from aquaflow.render.cpu import CpuRenderer
from aquaflow.render.transfer_counts import transfers
from aquaflow.render.views import View
from aquaflow.render.webgpu import WgpuRenderer
from aquaflow.render.webgpu_map import MapOnGpu
from tests.mapping.mapping_scenes import CAMERA, cloud, floor, path, picture, view_of
from tests.render.lost_device import LostError, lose_after
from tests.render.render_scenes import needs_adapter, needs_compiler, relative_error

pytestmark = [needs_adapter, needs_compiler]

WATER = ((0.3, 0.15, 0.1), (0.05, 0.15, 0.2), (0.4, 0.3, 0.2))
BRIGHTER_ABOVE = torch.tensor([0.1, -0.6, -0.1, 0.0, 0.2])


@dataclass(frozen=True)
class Case:
    """What the views, the water and the light of a map are like."""

    robust: bool = False
    ranges: bool = False
    mask: bool = False
    water: bool = False
    uneven: bool = False
    light: bool = False
    directional: bool = False


PLAIN = Case()
CASES = {
    "plain": PLAIN,
    "common frames": Case(robust=True),
    "ranges of the prior": Case(ranges=True),
    "a mask": Case(mask=True, robust=True),
    "water": Case(water=True, ranges=True),
    "uneven water and shading": Case(water=True, uneven=True),
    "exposure and sunlight": Case(water=True, light=True, robust=True),
    "directional water": Case(water=True, directional=True),
}


def mapped(renderer: Renderer, case: Case = PLAIN, prune_every: int = 200) -> Mapper:
    """A cloud that shall become a floor, seen from three places."""
    medium = {"enabled": case.water, "directional": case.directional, "rate": 1e-3}
    settings = {
        "medium": medium,
        "sunlight": {"enabled": case.light},
        "optimiser": {"prune_every": prune_every},
    }
    mapper = Mapper(MappingConfig.model_validate(settings), renderer, seed=0)
    mapper.scene.gaussians = cloud(count=300)
    turned = torch.Generator().manual_seed(2)  # a ball's rotation has no gradient but rounding
    mapper.gaussians.parameters["quats"] = torch.randn(300, 4, generator=turned)
    mapper.gaussians.parameters["log_scales"] += torch.randn(300, 3, generator=turned)
    mapper.optimiser.make_whole()
    if case.water:
        unevenness = BRIGHTER_ABOVE if case.uneven else None
        mapper.medium.set_water(*(torch.tensor(values) for values in WATER), unevenness)
    if case.uneven:
        mapper.scene.shading[:2] = 0.2, -0.1
    mapper.scene.exposes = case.light
    mapper.scene.sunlight.columns = 8 if case.light else 0
    rng = np.random.default_rng(0)
    for index, at in enumerate(path(3)):
        view = view_of(picture(floor(), at), at, index, case.robust)
        if case.mask:
            view.mask = rng.random((CAMERA.height, CAMERA.width)) > 0.2
        if case.ranges:
            shape = (CAMERA.height, CAMERA.width)
            view.inverse_range = torch.from_numpy(rng.uniform(-0.3, 1, shape).astype(np.float32))
            view.range_confidence = torch.from_numpy(rng.random(shape, np.float32))
        mapper.views.append(view)
    return mapper


def take_steps(mapper: Mapper, count: int, refine_poses: bool = True) -> None:
    with mapper.optimiser.stepping():
        for k in range(count):
            mapper.optimiser.step(mapper.views[k % 3], refine_poses)


@pytest.mark.parametrize("name", CASES)
def test_a_step_on_the_gpu_is_that_of_the_processor(name: str) -> None:
    here, there = mapped(CpuRenderer(1), CASES[name]), mapped(WgpuRenderer(1), CASES[name])
    for mapper in (here, there):
        take_steps(mapper, 1)
    assert there.renderer.name == "wgpu"
    assert (here.steps, here.undone) == (there.steps, there.undone) == (1, 0)
    assert torch.equal(here.optimiser.adam.steps, there.optimiser.adam.steps)
    for key in here.gaussians.NAMES:  # after one step they are the gradient and its square
        for moments in ("first_moments", "second_moments"):
            ours, theirs = (getattr(each.optimiser.adam, moments)[key] for each in (here, there))
            assert relative_error(theirs, ours) < 1e-3, (moments, key)
    ours, theirs = here.views[0], there.views[0]
    assert np.allclose(ours.T_wc.t, theirs.T_wc.t, atol=1e-7)
    assert np.allclose(ours.log_gain, theirs.log_gain, atol=1e-5)
    assert torch.equal(explained(ours), explained(theirs))
    for own, other in zip(here.medium.parameters(), there.medium.parameters(), strict=True):
        assert (own.grad is None) == (other.grad is None)
        if own.grad is not None and other.grad is not None and own.grad.any():
            assert relative_error(other.grad, own.grad) < 1e-3


def explained(view: View) -> torch.Tensor:
    assert view.explained is not None
    return view.explained


@pytest.mark.parametrize("name", CASES)
def test_many_steps_on_the_gpu_lead_to_the_same_picture(name: str) -> None:
    here, there = mapped(CpuRenderer(1), CASES[name]), mapped(WgpuRenderer(1), CASES[name])
    before = here.show(here.views[0]).image
    for mapper in (here, there):
        take_steps(mapper, 15)
    assert there.renderer.name == "wgpu"
    assert (here.steps, here.undone) == (there.steps, there.undone)
    for ours, theirs in zip(here.views, there.views, strict=True):
        wanted, found = here.show(ours).image, there.show(theirs).image
        assert (found - wanted).abs().mean() < 1e-4
    assert (wanted - before).abs().mean() > 0.03


def test_gaussians_are_pruned_and_added_between_steps_as_on_the_processor() -> None:
    mappers = [mapped(each, PLAIN, 3) for each in (CpuRenderer(1), WgpuRenderer(1))]
    for mapper in mappers:
        mapper.gaussians.parameters["opacity_logits"][::7] = -6.0
        take_steps(mapper, 4)
        count = len(mapper.gaussians)
        assert count < 300
        mapper.gaussians.extend(cloud(5, 40).parameters, keyframe=0)
        mapper.optimiser.extend(40, None)
        take_steps(mapper, 4)
        assert len(mapper.gaussians) <= count + 40
    here, there = mappers
    assert len(here.gaussians) == len(there.gaussians)
    assert (here.gaussians.means - there.gaussians.means).abs().max() < 1e-4


def test_a_step_moves_the_picture_up_and_numbers_down() -> None:
    mapper = mapped(WgpuRenderer(1), Case(robust=True, ranges=True))
    pixels, gaussians = CAMERA.width * CAMERA.height, 64 * len(mapper.gaussians)
    with mapper.optimiser.stepping():
        for k in range(3):  # each view's first look is at all of it
            mapper.optimiser.step(mapper.views[k], refine_pose=True)
        before = moved()
        mapper.optimiser.step(mapper.views[0], refine_pose=True)
        stepped = moved()
    settled = moved()
    up, down = (after - first for first, after in zip(before, stepped, strict=True))
    assert 12 * pixels <= up < 12 * pixels + 600
    assert down < 200
    assert settled == (stepped[0], stepped[1] + 3 * gaussians)


def moved() -> tuple[int, int]:
    """Bytes that wgpu moved so far, up and down."""
    counts = transfers()
    return counts["wgpu bytes up"], counts["wgpu bytes down"]


def test_a_loss_that_is_not_finite_moves_nothing() -> None:
    mapper = mapped(WgpuRenderer(1))
    mapper.gaussians.parameters["log_scales"][5] = 80.0
    before = {name: each.clone() for name, each in mapper.gaussians.parameters.items()}
    take_steps(mapper, 1)
    assert (mapper.steps, mapper.undone) == (0, 1)
    assert len(mapper.gaussians) == 299
    kept = torch.arange(300) != 5
    assert all(torch.equal(mapper.gaussians.parameters[k], before[k][kept]) for k in before)
    take_steps(mapper, 1)
    assert mapper.steps == 1


@pytest.mark.parametrize("calls", range(0, 120, 6))
def test_a_device_that_is_lost_at_any_call_leaves_a_whole_map(
    monkeypatch: pytest.MonkeyPatch, calls: int
) -> None:
    monkeypatch.setattr(gpu_steps, "SAVE_EVERY", 4)
    mapper, here = mapped(WgpuRenderer(1)), mapped(CpuRenderer(1))
    lose_after(monkeypatch, calls, "submit", "read", "write")
    for each in (mapper, here):
        take_steps(each, 12)
    assert mapper.renderer.name == "cpu"
    assert mapper.steps == 12
    assert len(mapper.gaussians) == len(mapper.optimiser.adam.steps) == 300
    assert all(torch.isfinite(each).all() for each in mapper.gaussians.parameters.values())
    lost = int((here.optimiser.adam.steps - mapper.optimiser.adam.steps).max())
    assert lost <= 4


def test_a_device_that_is_lost_when_gaussians_are_pruned_leaves_a_whole_map(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mapper = mapped(WgpuRenderer(1), PLAIN, prune_every=3)
    mapper.gaussians.parameters["opacity_logits"][::7] = -6.0

    def fail(*_: object) -> None:
        raise LostError

    monkeypatch.setattr(MapOnGpu, "radius_px", fail)
    take_steps(mapper, 4)
    assert mapper.renderer.name == "cpu"
    assert mapper.steps == 4
    assert 0 < len(mapper.gaussians) < 300
    assert len(mapper.gaussians) == len(mapper.optimiser.adam.steps)


def test_a_map_with_a_decoder_or_a_lamp_takes_its_steps_on_the_host(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mapper = mapped(WgpuRenderer(1), Case(water=True))
    steps = mapper.optimiser._gpu
    assert steps is not None
    assert steps.works
    mapper.scene.lamp = object()  # type: ignore[assignment]
    assert not steps.works


def view_light(view: View) -> torch.Tensor:
    assert view.light is not None
    return view.light


def test_light_is_learned_from_the_gpus_picture() -> None:
    case = Case(light=True)
    here, there = mapped(CpuRenderer(1), case), mapped(WgpuRenderer(1), case)
    for mapper in (here, there):
        take_steps(mapper, 3)
    for ours, theirs in zip(here.views, there.views, strict=True):
        assert view_light(ours).any()
        assert torch.allclose(view_light(ours), view_light(theirs), atol=1e-4)
