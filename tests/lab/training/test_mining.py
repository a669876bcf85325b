"""Pairs: enough overlap, the right pixels, and nothing that moved."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from aquaflow.base.errors import InputError
from aquaflow.lab.training import mining
from aquaflow.lab.training.datasets.posed import Frames, Posed
from aquaflow.lab.training.datasets.simulated import tartanair
from aquaflow.lab.training.mining import (
    MinedPairs,
    is_moved,
    load_index,
    mine,
    save_index,
    valid_pixels,
    view_of,
)
from aquaflow.lab.training.pairs import overlap, true_pointmaps
from tests.lab.training.data_trees import FOCAL, STEP_M, WIDTH, depth_at, write_tartanair

pytestmark = pytest.mark.usefixtures("one_thread")


def silent(stage: str, done: int, total: int) -> None:
    """No progress bar."""


@pytest.fixture(scope="module")
def dive(tmp_path_factory: pytest.TempPathFactory) -> Frames:
    """24 pictures, 3.5 m long; the view is 6 m wide."""
    root = tmp_path_factory.mktemp("tartanair")
    write_tartanair(root, count=24)
    return tartanair(root)[0]


def test_pairs_overlap_by_thirty_percent_and_no_more_are_looked_for(dive: Frames) -> None:
    pairs = mine([dive], silent)
    assert pairs
    assert all(0.3 <= pair.overlap <= 0.95 for pair in pairs)
    gaps = {pair.b - pair.a for pair in pairs}
    assert gaps == {2, 3, 5, 8, 13, 21}  # 1: nothing new; 34 is longer than the dive
    expected = 1.0 - 8 * STEP_M / (WIDTH / FOCAL * 3.0)
    eight = [pair.overlap for pair in pairs if pair.b - pair.a == 8]
    assert np.median(eight) == pytest.approx(expected, abs=0.08)


def test_beyond_the_first_gap_without_overlap_nothing_is_looked_for(
    dive: Frames, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mining, "LEAST_OVERLAP", 0.6)
    assert {pair.b - pair.a for pair in mine([dive], silent)} == {2, 3, 5, 8, 13}


def test_a_picture_that_cannot_be_read_costs_itself(dive: Frames) -> None:
    def gone() -> Posed:
        raise InputError("gone")

    readers = (*dive.readers[:4], gone, *dive.readers[5:])
    pairs = mine([Frames("broken", readers)], silent)
    assert pairs
    assert all(4 not in (pair.a, pair.b) for pair in pairs)


def test_each_picture_is_read_once(dive: Frames) -> None:
    read: list[int] = []

    def counted(number: int) -> Posed:
        read.append(number)
        return dive[number]

    mine([Frames("counted", tuple(partial(counted, n) for n in range(12)))], silent)
    assert sorted(read) == list(range(12))


def test_a_batch_has_the_true_points_in_the_first_views_frame(dive: Frames) -> None:
    pairs = MinedPairs([dive], mine([dive], silent), 64, 48)
    pair = pairs.pair([0, 7])
    assert pair.a.image.shape == (2, 3, 48, 64)
    torch.testing.assert_close(pair.a.T_wc, torch.eye(4).repeat(2, 1, 1))
    points = torch.cat([x[v] for x, v in zip(true_pointmaps(pair), (pair.a.valid, pair.b.valid),
                                             strict=True)])  # fmt: skip
    slope = 0.2 * points[:, 0] - points[:, 2]
    # The plane seen from each first view stands 0.2 x further away the further right it is.
    assert float(slope.std()) < 0.3
    assert (overlap(pair) > 0.3).all()


def test_a_picture_is_cut_to_the_shape_wanted_and_its_camera_with_it(dive: Frames) -> None:
    view = view_of(dive[0], 32, 32)
    assert view.image.shape == (1, 3, 32, 32)
    K = view.K[0].numpy()
    assert K[0, 0] == pytest.approx(FOCAL * 32 / 48, rel=0.02)
    assert K[0, 2] == pytest.approx(16.0, abs=0.5)
    row = view.depth[0, 16]
    at = np.linspace(0, WIDTH - 1, 43).astype(int)[5:37]
    np.testing.assert_allclose(row[8:24], depth_at(0.0)[0, at][8:24], rtol=0.03)


def test_unknown_depth_highlights_and_veil_are_not_valid(dive: Frames) -> None:
    posed = dive[0]
    image, depth = posed.image.copy(), posed.depth.copy()
    depth[:4, :4], depth[:4, 4:8], depth[:4, 8:12] = np.nan, 0.0, 5000.0
    image[20:23, 30:33] = 255
    image[30:48, 0:30] = 90
    valid = valid_pixels(replace(posed, image=image, depth=depth))
    assert not valid[:4, :12].any()
    assert not valid[19:24, 29:34].any()
    assert not valid[40:46, 8:20].any()
    assert valid[10:18, 40:60].all()


def test_what_moved_between_two_pictures_is_not_valid(dive: Frames) -> None:
    first, second = dive[0], dive[3]
    fish = first.depth.copy()
    fish[20:28, 30:40] = 1.0
    a, b = view_of(replace(first, depth=fish), 64, 48), view_of(second, 64, 48)
    gone = is_moved(a, b)[0].numpy()
    assert gone[20:28, 30:40].mean() > 0.9
    gone[20:28, 30:40] = False
    assert gone.mean() < 0.02
    assert not is_moved(b, a)[0].any()  # the floor is hidden by the fish there, and did not move


def test_a_list_of_pairs_comes_back_and_a_damaged_one_is_named(
    dive: Frames, tmp_path: Path
) -> None:
    pairs = mine([dive], silent)
    save_index(pairs, tmp_path / "pairs.jsonl")
    assert load_index(tmp_path / "pairs.jsonl") == pairs
    (tmp_path / "pairs.jsonl").write_text('{"a": 1}\n')
    with pytest.raises(InputError, match="delete it"):
        load_index(tmp_path / "pairs.jsonl")
