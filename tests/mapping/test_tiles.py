"""Tiles of a map that wait in files: they come back as they left, and the budget is held."""

from __future__ import annotations

import itertools
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from aquaflow.base.clocks.deadline import Deadline
from aquaflow.config import Config, MappingConfig
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.keyframes import Pointmap
from aquaflow.lab.synthetic.survey import ALTITUDE_M, SurveyPictures
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.maps import Maps
from aquaflow.mapping.tiles import KEPT_SHARE, Sphere, TileFiles, Tiles
from aquaflow.mapping.work import Growth
from aquaflow.render.views import View
from tests.mapping.mapping_scenes import settings

pytestmark = pytest.mark.usefixtures("contained", "one_thread")

STEP = 8
"""Pictures from one keyframe to the next: 0.4 m of the way."""
ROOM = 1000
SURVEY = SurveyPictures(64)
KEPT_LOOKS = ("z", "factor", "veil")
"""Not in files of tiles written before 2026-11-29."""


def config(room: int = ROOM, **optimiser: int) -> MappingConfig:
    return settings(optimiser=optimiser).model_copy(update={"max_gaussians": room})


def view_at(index: int) -> View:
    T_wc = SURVEY.T_wc(index)
    T_wc = Sim3(T_wc.R, T_wc.t / ALTITUDE_M)
    return View(index, SURVEY.frame(index).image, SURVEY.camera, T_wc, index // STEP, False)


def growth_at(index: int) -> Growth:
    rho = (ALTITUDE_M / SURVEY.depth(index)).astype(np.float64)
    pointmap = Pointmap(SURVEY.camera, rho, (0.02 * rho) ** 2)
    return Growth(view_at(index), 0, 2, pointmap)


def mapped(keyframes: int, work: Path | None, room: int = ROOM) -> Maps:
    """A line of the survey, at its true poses."""
    maps = Maps(Config(threads=1, mapping=config(room)), work=work)
    for number in range(keyframes):
        maps.grow(growth_at(STEP * number))
    assert maps.failures.to_json() == []
    return maps


def files_in(work: Path) -> list[Path]:
    return sorted((work / "tiles").glob("*.arrays"))


def state_of(mapper: Mapper) -> dict[str, Tensor]:
    """All rows of Gaussians and optimiser, ordered by keyframe and place."""
    adam, gaussians = mapper.optimiser.adam, mapper.gaussians
    means = gaussians.means.numpy()
    order = np.lexsort((*means.T, gaussians.keyframes.numpy()))
    rows = {"keyframes": gaussians.keyframes, "steps": adam.steps} | gaussians.parameters
    rows |= {f"first.{name}": each for name, each in adam.first_moments.items()}
    rows |= {f"second.{name}": each for name, each in adam.second_moments.items()}
    return {name: each.detach()[torch.from_numpy(order.copy())] for name, each in rows.items()}


def equal(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    return all(torch.equal(a[name], b[name]) for name in a)


def test_tiles_leave_and_come_back_bit_for_bit(tmp_path: Path) -> None:
    mapper = mapped(8, tmp_path, 100_000).mappers[0]
    before, count = state_of(mapper), len(mapper.gaussians)
    mapper._release([0, 3, 4])
    assert set(mapper.tiles.waiting) == {0, 3, 4}
    assert len(mapper.gaussians) < count == mapper.count
    assert len(files_in(tmp_path)) == 3
    mapper.gather()
    assert mapper.tiles.waiting == {}
    assert files_in(tmp_path) == []
    assert equal(before, state_of(mapper))


def test_tiles_of_before_and_since_looks_are_kept_come_back_together(tmp_path: Path) -> None:
    mapper = mapped(8, tmp_path, 100_000).mappers[0]
    before = state_of(mapper)
    mapper._release([0, 3, 4])
    number = mapper.tiles.waiting[3].number
    older = {k: v for k, v in mapper.tiles.files.read(number).items() if k not in KEPT_LOOKS}
    mapper.tiles.files._spill[number] = older
    mapper.gather()
    assert equal(before, state_of(mapper))


def test_memory_is_held_and_the_map_grows_with_the_ground(tmp_path: Path) -> None:
    maps = mapped(30, tmp_path)
    mapper = maps.mappers[0]
    assert len(mapper.gaussians) <= ROOM
    assert mapper.count > 1.3 * ROOM
    maps.refine()
    assert len(mapper.gaussians) == mapper.count > 1.3 * ROOM
    assert maps.failures.to_json() == []


def test_a_map_without_a_folder_is_held_at_its_cap() -> None:
    mapper = mapped(30, None).mappers[0]
    assert mapper.count == len(mapper.gaussians) <= ROOM


def test_a_short_dive_is_the_same_with_and_without_a_folder(tmp_path: Path) -> None:
    with_folder, without = mapped(8, tmp_path, 100_000), mapped(8, None, 100_000)
    for maps in (with_folder, without):
        maps.refine()
    assert equal(state_of(with_folder.mappers[0]), state_of(without.mappers[0]))
    assert not (tmp_path / "tiles").exists()


def test_ground_that_is_seen_again_is_in_memory(tmp_path: Path) -> None:
    maps = mapped(30, tmp_path)
    mapper = maps.mappers[0]
    assert 0 in mapper.tiles.waiting
    assert not any(view.keyframe == 0 for view in mapper._here or [])
    maps.grow(Growth(view_at(1), 0, 0, growth_at(0).pointmap))
    assert 0 not in mapper.tiles.waiting
    assert any(view.keyframe == 0 for view in mapper._here or [])
    assert len(mapper.gaussians) <= ROOM


def test_steps_are_taken_on_ground_of_which_nothing_waits(tmp_path: Path) -> None:
    mapper = mapped(30, tmp_path).mappers[0]
    assert mapper._here
    for view in mapper._here:
        assert mapper.tiles.near(mapper.tiles.seen[view.keyframe]) == []


def learned_while_refining(mapper: Mapper, monkeypatch: pytest.MonkeyPatch) -> Counter[int]:
    """Steps of refining on each keyframe's views; no waiting tile lies in what they see."""
    steps = Counter[int]()
    step = mapper.optimiser.step

    def counted(view: View, refine_pose: bool) -> None:
        assert mapper.tiles.near(mapper.tiles.seen[view.keyframe]) == []
        steps[view.keyframe] += 1
        step(view, refine_pose)

    monkeypatch.setattr(mapper.optimiser, "step", counted)
    return steps


def test_refining_comes_to_all_ground_though_memory_has_no_room_for_a_neighbourhood(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mapper = mapped(30, tmp_path).mappers[0]
    mapper.config = config(ROOM // 20, refine_steps=20)  # for each of 72 memories
    steps = learned_while_refining(mapper, monkeypatch)
    mapper.refine()
    assert set(steps) == set(range(30))


def test_a_map_of_several_memories_has_the_steps_of_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mapper = mapped(30, tmp_path).mappers[0]
    steps, told = learned_while_refining(mapper, monkeypatch), list[tuple[int, int]]()
    expected = mapper.config.optimiser.refine_steps * mapper.count / ROOM
    assert expected > 1.3 * mapper.config.optimiser.refine_steps
    mapper.refine(lambda done, whole: told.append((done, whole)))
    assert steps.total() == round(expected)
    assert told == [(done + 1, round(expected)) for done in range(round(expected))]


def test_grounds_share_the_time_of_refining(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mapper, ticks = mapped(30, tmp_path).mappers[0], itertools.count()
    mapper.config = config(refine_steps=10_000)
    steps = learned_while_refining(mapper, monkeypatch)
    mapper.refine(until=Deadline(300.0, lambda: float(next(ticks))))
    assert set(steps) == set(range(30))
    assert max(steps.values()) < 0.2 * steps.total()


def test_a_tile_that_waited_is_where_its_keyframe_was_moved_to(tmp_path: Path) -> None:
    turn = Sim3(so3_exp(np.array([0.1, 0.2, 0.3])), np.array([1.0, 2.0, 3.0]), 1.1)
    shift = Sim3(np.eye(3), np.array([0.5, 0.0, -0.5]))
    mapper = mapped(4, tmp_path, 100_000).mappers[0]
    expected = mapper.gaussians.means[mapper.gaussians.keyframes == 1].clone()
    for move in (turn, shift):
        expected = torch.from_numpy(move.apply(expected.numpy().astype(np.float64)))
    mapper._release([1])
    mapper.move({1: turn})
    mapper.move({1: shift, 2: shift})
    sphere = mapper.tiles.waiting[1].sphere
    mapper.gather()
    found = mapper.gaussians.means[mapper.gaussians.keyframes == 1]
    assert torch.allclose(found.double(), expected.double(), atol=1e-5)
    assert np.abs(found.double().mean(0).numpy() - sphere.centre).max() < 1e-5


def test_a_tile_whose_file_is_lost_costs_itself(tmp_path: Path, contained: object) -> None:
    maps = mapped(6, tmp_path, 100_000)
    mapper = maps.mappers[0]
    mapper._release([1, 2])
    files_in(tmp_path)[0].unlink()
    mapper._bring([1])
    mapper.gather()
    assert mapper.tiles.waiting == {}
    assert {1, 2} & set(mapper.gaussians.keyframes.tolist()) == {2}
    assert [entry["stage"] for entry in maps.failures.to_json()] == ["tile of the map"]
    mapper.optimise(2)


def test_a_dive_that_goes_on_has_the_tiles_that_waited(tmp_path: Path) -> None:
    maps = mapped(30, tmp_path)
    facts, arrays = maps.serialise()
    waiting = dict(maps.mappers[0].tiles.waiting)
    maps.grow(Growth(view_at(1), 0, 0, growth_at(0).pointmap))  # after the checkpoint
    maps.save_pictures()
    maps.close(keep=True)
    again = Maps(Config(threads=1, mapping=config()), work=tmp_path)
    again.restore(facts, arrays)
    mapper = again.mappers[0]
    assert {n: tile.number for n, tile in mapper.tiles.waiting.items()} == {
        n: tile.number for n, tile in waiting.items()
    }
    count = mapper.count
    mapper.gather()
    assert len(mapper.gaussians) == count
    assert again.failures.to_json() == []


def test_files_that_two_checkpoints_may_name_are_kept(tmp_path: Path) -> None:
    files = TileFiles(tmp_path)

    def there() -> set[int]:
        return {int(path.stem) for path in files_in(tmp_path)}

    first, second = (files.write({"x": np.arange(3)}) for _ in range(2))
    files.take_back(first)
    assert there() == {second}
    files.checkpoint()
    files.take_back(second)
    files.checkpoint()
    files.checkpoint()
    assert there() == {second}  # the one before the last may not have been written
    files.checkpoint()
    assert there() == set()
    assert files.write({"x": np.arange(3)}) not in (first, second)


def test_what_leaves_is_the_farthest_and_never_what_is_seen(tmp_path: Path) -> None:
    mapper = mapped(20, tmp_path, 100_000).mappers[0]
    ground = mapper.tiles.seen[19]
    leaving = mapper.tiles.far(mapper.gaussians, ground, len(mapper.gaussians))
    assert leaving[0] == 0
    assert 19 not in leaving
    few = mapper.tiles.far(mapper.gaussians, ground, 1)
    assert few == leaving[:1]
    assert KEPT_SHARE < 1.0


def test_a_sphere_moves_with_its_keyframe() -> None:
    move = Sim3(np.eye(3), np.array([1.0, 0.0, 0.0]), 2.0)
    moved = Sphere(np.array([1.0, 1.0, 0.0]), 3.0).moved(move)
    assert moved.centre.tolist() == [3.0, 2.0, 0.0]
    assert moved.radius == 6.0


def test_corrections_of_what_waits_cost_no_file(tmp_path: Path) -> None:
    mapper = mapped(6, tmp_path, 100_000).mappers[0]
    mapper._release([1])
    (path,) = files_in(tmp_path)
    before = path.read_bytes()
    mapper.move({1: Sim3(np.eye(3), np.array([1.0, 0.0, 0.0]))})
    assert path.read_bytes() == before


def test_a_map_that_is_absorbed_brings_its_tiles(tmp_path: Path) -> None:
    maps = mapped(6, tmp_path, 100_000)
    mapper = maps.mappers[0]
    mapper._release([1])
    other = Mapper(config(), mapper.renderer, 1, maps.failures, maps.tiles)
    other.views, other.tiles = [view_at(STEP * 20)], Tiles(maps.tiles)
    other.tiles.waiting, mapper.tiles.waiting = mapper.tiles.waiting, {}
    mapper.absorb(other)
    assert set(mapper.tiles.waiting) == {1}
    before = len(mapper.gaussians)
    mapper.gather()
    assert len(mapper.gaussians) > before


def test_a_keyframe_whose_tile_waits_keeps_what_it_inserts_later(tmp_path: Path) -> None:
    mapper = mapped(12, tmp_path, 100_000).mappers[0]
    before = int((mapper.gaussians.keyframes == 0).sum())
    mapper._release([0])
    again = {name: tensor[:5].clone() for name, tensor in mapper.gaussians.parameters.items()}
    again["means"] -= 100.0
    mapper.gaussians.extend(again, 0)
    mapper.optimiser.extend(5, None)
    ground = mapper.tiles.seen[11]
    assert 0 not in mapper.tiles.far(mapper.gaussians, ground, 10**6)
    assert 0 not in mapper.tiles.around(mapper.gaussians, ground, 0)[0]
    mapper.gather()
    assert int((mapper.gaussians.keyframes == 0).sum()) == before + 5
