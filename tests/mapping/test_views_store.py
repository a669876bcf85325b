"""Views whose pixels wait in files: nothing about them, or the map, is any different."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import torch

from aquaflow.geometry.camera import CameraModel
from aquaflow.mapping.mapper import Mapper
from aquaflow.render.views import View, ViewStore
from tests.mapping.mapping_scenes import (
    CAMERA,
    copied,
    filmed,
    flat_pointmap,
    floor,
    path,
    renderer,
    same,
    settings,
    view_of,
)

STEPS = {"refine_steps": 12}


def random_view(index: int, camera: CameraModel = CAMERA) -> View:
    """A view that has everything a view can have."""
    rng = np.random.default_rng(index)
    size = (camera.height, camera.width)
    view = view_of(rng.integers(0, 255, (*size, 3), dtype=np.uint8), index=index, camera=camera)
    view.mask = rng.random(size) < 0.8
    view.inverse_range = torch.from_numpy(rng.random(size, dtype=np.float32))
    view.range_confidence = torch.from_numpy(rng.random(size, dtype=np.float32))
    return view


def arrays_of(view: View) -> list[np.ndarray]:
    assert view.mask is not None
    assert view.inverse_range is not None
    assert view.range_confidence is not None
    return [
        view.image, view.mask, view.inverse_range.numpy(), view.range_confidence.numpy(),
        view.target().numpy(),
    ]  # fmt: skip


def test_all_pixels_come_back_bit_for_bit(tmp_path: Path) -> None:
    store = ViewStore(tmp_path, resident=1)
    views = [store.keep(random_view(i)) for i in range(5)]
    assert len(list((tmp_path / "views").iterdir())) == 4
    for i, view in enumerate(views):
        for got, wanted in zip(arrays_of(view), arrays_of(random_view(i)), strict=True):
            np.testing.assert_array_equal(got, wanted)
            assert got.dtype == wanted.dtype


def test_what_a_view_does_not_have_it_does_not_get(tmp_path: Path) -> None:
    store = ViewStore(tmp_path, resident=1)
    first, _ = [store.keep(view_of(random_view(i).image, index=i)) for i in range(2)]
    assert first.mask is None
    assert first.inverse_range is None
    assert first.range_confidence is None


def test_what_is_set_later_is_kept(tmp_path: Path) -> None:
    store = ViewStore(tmp_path, resident=1)
    views = [store.keep(view_of(random_view(i).image, index=i)) for i in range(3)]
    views[0].mask = np.eye(48, 64) > 0
    views[0].inverse_range = torch.full((48, 64), 0.25)
    for view in views[1:]:
        _ = view.image
    assert int(views[0].mask.sum()) == 48
    torch.testing.assert_close(views[0].inverse_range, torch.full((48, 64), 0.25))
    np.testing.assert_array_equal(views[0].image, random_view(0).image)


def mapped(store: ViewStore | None) -> Mapper:
    mapper = Mapper(settings(optimiser=STEPS), renderer(), seed=0)
    for view in filmed(floor(), path(5)):
        mapper.add_view(view if store is None else store.keep(view))
    for view in mapper.views[::2]:
        mapper.insert(view, flat_pointmap())
    mapper.optimise(6)
    mapper.refine()
    return mapper


def test_a_map_is_the_same_bit_for_bit(tmp_path: Path) -> None:
    memory, files = mapped(None), mapped(ViewStore(tmp_path, resident=1))
    assert same(copied(memory), copied(files))
    for a, b in zip(memory.views, files.views, strict=True):
        np.testing.assert_array_equal(a.T_wc.matrix, b.T_wc.matrix)
        assert a.moments[2] == b.moments[2] > 0 or a is memory.views[0]


def bytes_of_arrays() -> int:
    """Of all arrays that live, whoever holds them; what else Python holds is not this store's."""
    arrays = tracemalloc.DomainFilter(True, np.lib.tracemalloc_domain)
    return sum(trace.size for trace in tracemalloc.take_snapshot().filter_traces([arrays]).traces)


def test_memory_after_2000_views_is_that_after_500(tmp_path: Path) -> None:
    camera, store = CAMERA.resize(192, 144), ViewStore(tmp_path, resident=256)
    views: list[View] = []
    sizes, traced = [], []
    tracemalloc.start()
    for index in range(2000):
        image = np.empty((144, 192, 3), np.uint8)
        views.append(store.keep(view_of(image, None, index, True, camera)))
        if index % 4 == 3:
            _ = views[index // 2].image
        if index + 1 in (500, 2000):
            sizes.append(store.resident_bytes)
            traced.append(bytes_of_arrays())
    tracemalloc.stop()
    assert sizes[1] == sizes[0] == 256 * 144 * 192 * 3
    assert traced[1] < 1.2 * traced[0]


@pytest.mark.parametrize("keep", [False, True])
def test_closing_removes_the_files_unless_they_are_to_be_kept(tmp_path: Path, keep: bool) -> None:
    store = ViewStore(tmp_path, resident=1)
    for index in range(3):
        store.keep(random_view(index))
    store.close(keep)
    assert len(list(tmp_path.rglob("*.arrays"))) == (3 if keep else 0)
