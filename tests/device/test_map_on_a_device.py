"""A whole map lives on the device of its renderer, and comes out as on the CPU."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
import torch

from aquaflow.api.map import Map
from aquaflow.base.errors import AquaFlowError
from aquaflow.mapping import state
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.state import copy_map
from aquaflow.render.contract import CPU
from aquaflow.render.cpu import CpuRenderer
from aquaflow.survey.viewer.live_viewer import pack_for_browser
from tests.device.device_scenes import (
    SMALL,
    WHERE,
    again,
    assert_alike,
    on_host,
)
from tests.mapping.mapping_scenes import (
    flat_pointmap,
    floor,
    picture,
    pose,
    view_of,
    water,
)
from tests.pretended_device import PRETENDED, Device

pytestmark = pytest.mark.usefixtures("nothing_strays")

STEPS = 8
IN_GSPLATS_PLACE = "render/reference.py"
"""What gsplat's kernels do in its place does not wait."""


def test_a_map_grown_on_a_device_is_that_of_the_cpu(twins: tuple[Mapper, Mapper]) -> None:
    wanted, got = twins
    assert got.steps == wanted.steps == 20
    assert not got.failures.kinds
    assert_alike(on_host(got), on_host(wanted))


def test_everything_a_map_is_made_of_is_on_its_device(twins: tuple[Mapper, Mapper]) -> None:
    _, away = twins
    assert away.neural is not None
    adam = away.optimiser.adam
    tensors = [*away.gaussians.parameters.values(), away.gaussians.keyframes, adam.steps]
    tensors += [*adam.first_moments.values(), *adam.second_moments.values()]
    tensors += [*away.medium.state_dict().values(), *away.neural.decoder.state_dict().values()]
    tensors += [getattr(away.neural.groups, name) for name in state.GROUPS]
    for view in away.views:
        tensors += [view.target(), view.scene_mask(), view.log_gain, view.viewmat(), view.K()]
        tensors += [
            each for each in (view.light, view.explained, view.inverse_range) if each is not None
        ]
    assert {tensor.device for tensor in tensors} == {PRETENDED}


def test_a_view_is_taken_to_the_device_once_and_not_at_every_look(
    twins: tuple[Mapper, Mapper], device: Device
) -> None:
    view = twins[1].views[0]
    view.target()
    moved = device.moved_in
    assert torch.equal(view.target().cpu(), torch.from_numpy(view.image) / 255.0)
    assert device.moved_in == moved


def test_the_final_refinement_is_that_of_the_cpu(twins: tuple[Mapper, Mapper]) -> None:
    wanted, got = (again(mapper, where) for mapper, where in zip(twins, WHERE, strict=True))
    for mapper in (wanted, got):
        mapper.refine()
        assert not mapper.failures.kinds
    assert_alike(on_host(got), on_host(wanted))


def test_a_held_out_view_is_registered_as_on_the_cpu(twins: tuple[Mapper, Mapper]) -> None:
    poses = []
    for mapper in twins:
        T_wc = pose((0.11, 0.02, 0.0))
        view = view_of(picture(floor(), T_wc, water(), SMALL), T_wc, 2, camera=SMALL)
        mapper.register(view)
        poses.append(view.world_to_camera())
    np.testing.assert_allclose(*poses, atol=1e-6)
    assert not np.allclose(poses[0], np.linalg.inv(pose((0.11, 0.02, 0.0)).matrix))


def test_a_map_file_from_a_device_is_read_on_the_cpu_and_the_other_way_round(
    twins: tuple[Mapper, Mapper],
) -> None:
    wanted, got = twins
    for mapper, where in ((wanted, PRETENDED), (got, CPU)):
        there = again(mapper, where)
        assert there.gaussians.means.device == where
        assert_alike(on_host(there), on_host(mapper))


def test_a_checkpoint_goes_on_as_if_the_map_had_never_been_away(
    twins: tuple[Mapper, Mapper],
) -> None:
    first, second = again(twins[1], PRETENDED), again(again(twins[1], PRETENDED), PRETENDED)
    for mapper in (first, second):
        mapper.optimise(3)
    assert_alike(on_host(second), on_host(first))


def test_two_maps_on_a_device_merge_as_on_the_cpu(twins: tuple[Mapper, Mapper]) -> None:
    merged = []
    for mapper, where in zip(twins, WHERE, strict=True):
        whole, other = again(mapper, where), again(mapper, where)
        other.move({0: pose((0.5, 0.0, 0.0))})
        for view in other.views:
            view.frame_index += 100
            view._store = {view.frame_index: next(iter(view._store.values()))}  # type: ignore[union-attr]
        whole.absorb(other)
        whole.optimise(2)
        merged.append(whole)
    assert len(merged[1].gaussians) == 2 * len(twins[1].gaussians)
    assert_alike(on_host(merged[1]), on_host(merged[0]))


def test_at_the_hard_cap_gaussians_are_recycled_as_on_the_cpu(
    twins: tuple[Mapper, Mapper],
) -> None:
    counts = []
    for mapper, where in zip(twins, WHERE, strict=True):
        full = again(mapper, where)
        full.config = full.config.model_copy(update={"max_gaussians": len(full.gaussians) + 3})
        counts.append(
            (full.insert(full.views[-1], flat_pointmap(1.0, camera=SMALL)), len(full.gaussians))
        )
    assert counts[0] == counts[1]
    assert counts[0][0] > 0


def test_viewers_get_the_same_from_a_device(twins: tuple[Mapper, Mapper]) -> None:
    (wanted, *_), (got, *_) = (pack_for_browser(copy_map(mapper), 50) for mapper in twins)
    np.testing.assert_allclose(got.centres, wanted.centres, rtol=1e-5)
    np.testing.assert_allclose(got.colours, wanted.colours, atol=1e-4)
    assert set(got.levels) == {"seen", "range"}


def test_programs_get_the_same_from_a_device(twins: tuple[Mapper, Mapper]) -> None:
    maps = [Map(mapper) for mapper in twins]
    wanted, got = (each.gaussians for each in maps)
    np.testing.assert_allclose(got.means, wanted.means, rtol=1e-5)
    np.testing.assert_allclose(got.colours, wanted.colours, rtol=1e-4)
    wanted_picture, got_picture = (each.render(pose((0.1, 0.0, 0.0)), SMALL) for each in maps)
    np.testing.assert_allclose(got_picture.image, wanted_picture.image, atol=1e-5)
    assert maps[0].medium == maps[1].medium


def test_the_compiled_kernels_refuse_a_map_on_a_device(twins: tuple[Mapper, Mapper]) -> None:
    away = again(twins[1], PRETENDED)
    away.scene.renderer = CpuRenderer(1)
    with pytest.raises(AquaFlowError, match="draws on cpu and was given a tensor on meta"):
        away.show(away.views[0])


def waits_of(mapper: Mapper, device: Device) -> Counter[str]:
    """Of ``STEPS`` steps, by file and function."""
    mapper.optimiser.steps = 0  # none of them prunes
    before = Counter(device.waits)
    mapper.optimise(STEPS)
    assert mapper.steps == STEPS
    found = device.waits - before
    return Counter({place: n for place, n in found.items() if IN_GSPLATS_PLACE not in place})


def test_a_step_waits_for_the_loss_and_the_waters_gradient_alone(
    twins: tuple[Mapper, Mapper], device: Device
) -> None:
    mapper = again(twins[1], PRETENDED)
    mapper.scene.bake(mapper.views)
    waits = waits_of(mapper, device)
    checked = sum(n for place, n in waits.items() if place.endswith(": is_number"))
    assert STEPS < checked < 2 * STEPS  # the water's at full looks alone
    assert sum(waits.values()) <= 3 * STEPS, waits


def test_with_a_decoder_it_waits_once_more_and_a_few_times_for_each_trunk(
    twins: tuple[Mapper, Mapper], device: Device
) -> None:
    waits = waits_of(again(twins[1], PRETENDED), device)
    assert sum(waits.values()) <= 6 * STEPS, waits
