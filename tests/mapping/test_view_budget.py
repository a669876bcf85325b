"""Views of a long dive: some go, those that stay are spread, and a map without them is whole."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from aquaflow.config import parse_config
from aquaflow.mapping.maps import Maps, drop_surplus, same_group
from aquaflow.mapping.work import Growth
from aquaflow.render.views import View, ViewStore
from tests.mapping.mapping_scenes import CAMERA, view_of

MOST = 4
SETTINGS = parse_config(
    {
        "threads": 1,
        "mapping": {
            "views_per_keyframe": MOST,
            "held_out_most": MOST,
            "medium": {"enabled": False},
            "optimiser": {"steps_common": 1},
        },
    },
    "test",
)


def view(index: int, keyframe: int = 0, robust: bool = True) -> View:
    picture = np.full((CAMERA.height, CAMERA.width, 3), index % 256, np.uint8)
    made = view_of(picture, index=index, robust=robust)
    made.keyframe = keyframe
    return made


def indices(views: list[View]) -> list[int]:
    return [each.frame_index for each in views]


def test_within_the_budget_nothing_goes() -> None:
    views = [view(i) for i in range(MOST)]
    drop_surplus(views, views, MOST)
    assert indices(views) == [0, 1, 2, 3]


def test_of_a_long_stay_first_last_and_an_even_spread_are_kept() -> None:
    views: list[View] = []
    for index in range(1000):
        views.append(view(index))
        drop_surplus(views, views, 16)
    kept = np.array(indices(views))
    assert (kept[0], kept[-1], len(kept)) == (0, 999, 16)
    assert np.diff(kept)[:-1].max() <= 4 * 1000 / 16


def test_views_that_came_late_are_thinned_by_their_time_and_keep_their_places() -> None:
    views = [view(i) for i in (10, 11, 30, 20, 0)]
    drop_surplus(views, views, 4)
    assert indices(views) == [10, 30, 20, 0]


def test_only_views_of_the_same_keyframe_and_kind_share_a_budget() -> None:
    views = [view(i, keyframe=i % 2, robust=i % 3 > 0) for i in range(12)]
    assert indices(same_group(views[1], views)) == [1, 5, 7, 11]


def grown(maps: Maps, views: list[View]) -> Maps:
    for each in views:
        maps.grow(Growth(each, 0, 1))
    return maps


def test_a_place_that_is_seen_for_long_keeps_few_views_and_their_files(tmp_path: Path) -> None:
    maps = Maps(SETTINGS, work=tmp_path)
    maps.views = ViewStore(tmp_path, resident=2)
    grown(maps, [view(i, keyframe=i // 40) for i in range(80)])
    mapped = maps.mappers[0].views
    assert len(mapped) == 2 * MOST
    assert [int(each.image[0, 0, 0]) for each in mapped] == indices(mapped)
    maps.views.save()
    assert len(list((tmp_path / "views").glob("*.arrays"))) == 2 * MOST


def test_held_out_views_have_a_budget_of_their_own_over_merged_maps_too() -> None:
    maps = Maps(SETTINGS)
    for index in range(20):
        maps.hold_out(view(index), sub_map=index // 10)
    assert [len(views) for views in maps.held_out.values()] == [MOST, MOST]
    maps.correct({}, {1: 0})
    assert len(maps.held_out[0]) == MOST
    assert (maps.held_out[0][0].frame_index, maps.held_out[0][-1].frame_index) == (0, 19)


def test_a_view_that_was_let_go_of_is_no_longer_held(tmp_path: Path) -> None:
    store = ViewStore(tmp_path)
    first, second, stranger = (view(i) for i in range(3))
    store.keep(first)
    store.keep(second)
    first.delete_pixels()
    assert [store.holds(each) for each in (first, second, stranger)] == [False, True, False]
    with pytest.raises(KeyError):
        _ = first.image


def test_a_restart_does_without_the_views_that_were_let_go_of_since(tmp_path: Path) -> None:
    before = ViewStore(tmp_path)
    views = [before.keep(view(i)) for i in range(3)]
    before.save()
    views[1].delete_pixels()
    again = [view(i) for i in range(3)]
    after = ViewStore(tmp_path)
    assert indices(after.restore(again)) == [0, 2]
    assert after.lost == set()


def test_views_whose_files_are_gone_are_left_out_and_known_as_lost(tmp_path: Path) -> None:
    store = ViewStore(tmp_path)
    assert store.restore([view(7), view(8)]) == []
    assert store.lost == {7, 8}
