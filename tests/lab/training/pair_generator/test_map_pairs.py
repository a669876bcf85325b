"""Pairs from maps: matches show the same place, what was not seen is not learnt from, and files."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch.nn import functional as F

from aquaflow.base.errors import InputError
from aquaflow.geometry.camera import CameraModel
from aquaflow.lab.training.pair_generator import map_pairs
from aquaflow.lab.training.pair_generator.map_pairs import (
    ATTEMPTS,
    LEAST_COVERED,
    LEAST_OVERLAP,
    MapPairs,
    MappedScene,
    drawn_pair,
    widest_view_deg,
)
from aquaflow.lab.training.pair_generator.noise import Draw
from aquaflow.lab.training.pair_generator.stored_pairs import SHARD
from aquaflow.lab.training.pairs import Pair, correspondences, join, overlap
from tests.lab.training.small_maps import small_dive
from tests.mapping.mapping_scenes import FLOOR_M, path, pose

pytestmark = pytest.mark.usefixtures("one_thread")

WIDTH, HEIGHT = 48, 36


def silent(stage: str, done: int, total: int) -> None:
    """No progress bar."""


def pairs_of(dives: list[Path], folder: Path, seed: int = 1) -> MapPairs:
    return MapPairs(dives, folder, seed, WIDTH, HEIGHT, count=SHARD)


@pytest.fixture(scope="module")
def dive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_dive(tmp_path_factory.mktemp("dives") / "one")


@pytest.fixture(scope="module")
def scene(dive: Path) -> MappedScene:
    return MappedScene(dive / "map.aqf")


@pytest.fixture(scope="module")
def pair(scene: MappedScene) -> Pair:
    """Some that the map covers."""
    draw = Draw(3)
    drawn = [drawn_pair(draw, scene, WIDTH, HEIGHT) for _ in range(24)]
    return join([each for each in drawn if each is not None])


def level_K(focal_px: float) -> torch.Tensor:
    return torch.tensor([[focal_px, 0, WIDTH / 2], [0, focal_px, HEIGHT / 2], [0, 0, 1.0]])[None]


def test_matches_show_the_same_place(pair: Pair) -> None:
    found = correspondences(pair)
    size = torch.tensor([WIDTH, HEIGHT])
    seen, beside = (
        F.grid_sample(pair.b.image, (found.pixels + shift) / size * 2 - 1, align_corners=False)
        for shift in (0.0, 2.0)
    )
    error, shifted = ((picture - pair.a.image).abs().mean(1) for picture in (seen, beside))
    assert float(found.visible.float().mean()) > LEAST_OVERLAP * LEAST_COVERED
    assert float(error[found.visible].median()) < 0.03
    assert float(shifted[found.visible].median()) > 3.0 * float(error[found.visible].median())


def test_pairs_are_covered_overlap_and_have_baselines(pair: Pair) -> None:
    for view in (pair.a, pair.b):
        assert bool((view.valid.flatten(1).float().mean(1) >= LEAST_COVERED).all())
    assert bool((overlap(pair) >= LEAST_OVERLAP).all())
    baselines = (pair.a.T_wc[:, :3, 3] - pair.b.T_wc[:, :3, 3]).norm(dim=1) / FLOOR_M
    assert float(baselines.max()) > 0.05
    assert len(torch.unique(pair.a.K[:, 0, 0])) > 1


def test_depth_is_that_along_the_optical_axis_and_pictures_are_averaged(
    scene: MappedScene,
) -> None:
    for focal_px in (20.0, 55.0):  # drawn three times as large, and as it is
        view = scene.view(level_K(focal_px), torch.eye(4)[None], WIDTH, HEIGHT)
        middle = view.depth[0, 8:-8, 12:-12]
        assert torch.allclose(middle, torch.full_like(middle, FLOOR_M), rtol=0.02)


def test_what_the_map_does_not_show_is_open_water(scene: MappedScene) -> None:
    turned = torch.eye(4)[None].clone()
    turned[:, 0, 0] = turned[:, 2, 2] = -1.0
    view = scene.view(level_K(40.0), turned, WIDTH, HEIGHT)
    assert not bool(view.valid.any())
    assert float(view.depth.abs().max()) == float(view.image.max()) == 0.0


def test_what_too_few_views_saw_is_shown_and_not_learnt_from(tmp_path: Path) -> None:
    away = [pose((100.0 + x, 0.0, 0.0)) for x in (0.0, 0.1)]
    lonely = MappedScene(small_dive(tmp_path / "lonely", poses=[path(1)[0], *away]) / "map.aqf")
    seen = MappedScene(small_dive(tmp_path / "seen", poses=path(3)) / "map.aqf")
    here = torch.eye(4)[None]
    alone, known = (each.view(level_K(55.0), here, WIDTH, HEIGHT) for each in (lonely, seen))
    assert torch.equal(alone.image, known.image)
    assert not bool(alone.valid.any())
    assert float(alone.depth.min()) > 0.0
    assert float(known.valid.float().mean()) > 0.9


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dive that has kept some of its pictures."""
    return small_dive(tmp_path_factory.mktemp("dives") / "kept", kept=4)


def test_kept_pictures_stand_where_the_map_says_at_its_ranges(kept: Path) -> None:
    scene = MappedScene(kept / "map.aqf")
    assert scene.photographed == [0, 1, 2, 3]
    taken = [scene.photograph(number, WIDTH, HEIGHT) for number in (0, 3)]
    for view in taken:
        drawn = scene.view(view.K, view.T_wc, WIDTH, HEIGHT)
        assert torch.equal(view.depth, drawn.depth)
        assert torch.equal(view.valid, drawn.valid)
        error = (view.image - drawn.image).abs().mean(1)
        assert float(error[view.valid].median()) < 0.03
    found = correspondences(Pair(*taken))
    size = torch.tensor([WIDTH, HEIGHT])
    there = F.grid_sample(taken[1].image, found.pixels / size * 2 - 1, align_corners=False)
    error = (there - taken[0].image).abs().mean(1)
    assert float(error[found.visible].median()) < 0.05


def test_the_middle_of_a_kept_picture_is_taken_where_the_shape_differs(kept: Path) -> None:
    scene = MappedScene(kept / "map.aqf")
    square = scene.photograph(0, 36, 36)
    assert square.image.shape == (1, 3, 36, 36)
    assert square.K[0, :2, 2].tolist() == [18.0, 18.0]
    whole = scene.photograph(0, WIDTH, HEIGHT)
    assert torch.equal(square.image, whole.image[..., 6:42])


def test_half_of_the_pairs_are_kept_pictures_if_there_are_any(
    kept: Path, dive: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(map_pairs, "photographed_pair", lambda *given: None)
    for folder, least, most in ((kept, 0.2, 0.8), (dive, 0.0, 0.0)):
        scene, draw = MappedScene(folder / "map.aqf"), Draw(1)
        monkeypatch.setattr(scene, "view", lambda *given: pytest.fail("drawn"))
        photographed = 0
        for _ in range(40):
            try:
                photographed += drawn_pair(draw, scene, WIDTH, HEIGHT) is None
            except pytest.fail.Exception:
                continue
        assert least <= photographed / 40 <= most


def test_a_kept_picture_that_changed_makes_other_pairs(kept: Path, tmp_path: Path) -> None:
    dive = small_dive(tmp_path / "dive", kept=2)
    before = pairs_of([dive], tmp_path).maps[0].name
    next((dive / "pictures").iterdir()).unlink()
    assert pairs_of([dive], tmp_path).maps[0].name != before


def test_files_keep_which_depths_are_not_to_be_learnt(dive: Path, tmp_path: Path) -> None:
    maps = pairs_of([dive], tmp_path)
    rendered = maps.maps[0].render(0)
    stored = maps.maps[0].pairs(torch.arange(SHARD))
    assert torch.equal(stored.b.valid, rendered.b.valid)
    assert bool((~stored.b.valid & (stored.b.depth > 0)).any())
    assert torch.allclose(stored.b.depth, rendered.b.depth, rtol=1e-3)
    assert torch.equal(stored.a.T_wc, rendered.a.T_wc)


def test_what_is_rendered_follows_from_map_seed_and_number(dive: Path, tmp_path: Path) -> None:
    one, again, other = (
        pairs_of([dive], tmp_path / name, seed) for name, seed in (("a", 1), ("b", 1), ("c", 2))
    )
    for maps in (one, again, other):
        maps.render(silent)
    [a], [b], [c] = (sorted((tmp_path / name).iterdir()) for name in "abc")
    assert a.name == b.name != c.name
    assert a.read_bytes() == b.read_bytes() != c.read_bytes()
    assert torch.equal(one.pairs(Draw(5), 3).a.image, again.pairs(Draw(5), 3).a.image)


def test_a_map_is_read_only_if_pairs_are_missing(
    dive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pairs_of([dive], tmp_path).render(silent)
    monkeypatch.setattr(map_pairs, "MappedScene", None)
    again = pairs_of([dive], tmp_path)
    again.render(silent)
    assert again.pairs(Draw(1), 2).a.image.shape == (2, 3, HEIGHT, WIDTH)


def test_pairs_come_from_all_maps(dive: Path, tmp_path: Path) -> None:
    maps = pairs_of([dive, small_dive(tmp_path / "two", seed=1)], tmp_path / "pool")
    steps: list[tuple[int, int]] = []
    maps.render(lambda stage, done, total: steps.append((done, total)))
    assert steps == [(1, 2), (2, 2)]
    assert len(list((tmp_path / "pool").iterdir())) == 2
    drawn = maps.pairs(Draw(1), 8)
    whole = [pool.pairs(torch.arange(SHARD)).a.image for pool in maps.maps]
    found = [
        [bool((row == images).flatten(1).all(1).any()) for images in whole] for row in drawn.a.image
    ]
    assert {tuple(row) for row in found} == {(True, False), (False, True)}


def test_a_folder_without_a_map_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="give the folder of a finished dive"):
        pairs_of([tmp_path / "missing"], tmp_path)


def test_a_map_that_is_damaged_or_of_two_views_is_refused(tmp_path: Path) -> None:
    two = small_dive(tmp_path / "two", poses=path(2))
    with pytest.raises(InputError, match="too few views"):
        pairs_of([two], tmp_path / "pool").render(silent)
    (two / "map.aqf").write_bytes(b"no map")
    with pytest.raises(InputError, match="no whole AquaFlow map"):
        pairs_of([two], tmp_path / "pool").render(silent)


def test_a_map_that_shows_too_little_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(map_pairs, "ATTEMPTS", ATTEMPTS // 100)
    aside = small_dive(tmp_path / "aside", poses=[pose((1.6 + x, 0.0, 0.0)) for x in (0, 0.1, 0.2)])
    with pytest.raises(InputError, match="too few places"):
        pairs_of([aside], tmp_path / "pool").render(silent)


def test_the_widest_view_fits_into_the_mapped_picture() -> None:
    wide = CameraModel(200, 50, 100.0, 100.0, 100.0, 25.0)
    tall = CameraModel(50, 200, 100.0, 100.0, 25.0, 100.0)
    assert widest_view_deg(wide, 80, 40) == pytest.approx(53.13, abs=0.01)
    assert widest_view_deg(tall, 80, 40) == pytest.approx(28.07, abs=0.01)
