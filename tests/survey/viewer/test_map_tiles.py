"""A map of more Gaussians than are shown at once: a base for a first picture, and tiles."""

from __future__ import annotations

import gzip
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial import KDTree

from aquaflow.dive.dive import Dive
from aquaflow.dive.ply import PlyFile, PlyGaussians, Which, read_ply, write_ply
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.viewer import dive_map, map_tiles
from aquaflow.survey.viewer.dive_map import DiveMap, read_map
from aquaflow.survey.viewer.packing import ABOUT, NAME, read_packed, write_packed
from aquaflow.telemetry.world_frame import WorldFrame

COUNT, BASE, BUDGET, MOST_IN_TILE = 6000, 500, 2000, 400
PATH = [Sim3(np.eye(3), np.array([x, 1.0, 0.0])) for x in range(40)]
CAMERA = CameraModel(64, 48, 50.0, 50.0, 32.0, 24.0)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small tiles, so that a small map has many."""
    for module in (dive_map, map_tiles):
        monkeypatch.setattr(module, "BASE", BASE)
        monkeypatch.setattr(module, "LEAST_BUDGET", 2 * BASE)
    monkeypatch.setattr(map_tiles, "MOST_IN_TILE", MOST_IN_TILE)


@pytest.fixture
def long(small: None, tmp_path: Path) -> DiveMap:
    """A strip of 40 x 2 m."""
    rng = np.random.default_rng(0)
    means = rng.uniform((0.0, 0.0, 2.0), (40.0, 2.0, 2.2), (COUNT, 3))
    splats = PlyGaussians(
        means, rng.normal(size=(COUNT, 4)), np.exp(rng.normal(-4.0, 0.4, (COUNT, 3))),
        rng.uniform(0.3, 0.9, COUNT), rng.uniform(0.1, 0.9, (COUNT, 3)),
    )  # fmt: skip
    write_ply(tmp_path / "map.ply", splats)
    return look(tmp_path)


def look(folder: Path, budget: int = BUDGET) -> DiveMap:
    dive = Dive(folder, camera=CAMERA)
    return read_map(dive, folder / "map.ply", PATH, WorldFrame.unknown(), budget)


def tiles_of(found: DiveMap) -> list[dict[str, Any]]:
    listed: list[dict[str, Any]] = found.packed.description()["tiles"]["list"]
    return listed


def places(found: DiveMap, number: int, part: int) -> npt.NDArray[np.float64]:
    """[N, 3] as client/load.js reads them."""
    tile, tiles = tiles_of(found)[number], found.packed.tiles
    assert tiles is not None
    packed = tiles.part(number, part)
    assert packed is not None
    count = np.diff([0, *tile["ends"]])[part]
    u = np.frombuffer(gzip.decompress(packed), "<u2", 3 * count).reshape(3, count).T
    u = u * (4.0 / 65535.0) - 2.0
    far = np.minimum(np.abs(u), 1.9999)
    inside = np.where(far < 1.0, u, np.sign(u) / (2.0 - far))
    return np.asarray(np.array(tile["middle"]) + np.array(tile["half"]) * inside)


def test_the_base_is_what_covers_most_of_all(long: DiveMap, tmp_path: Path) -> None:
    about = long.packed.description()
    assert (about["count"], about["tiles"]["budget"], long.at_once) == (BASE, BUDGET, BUDGET)
    largest = look(tmp_path, COUNT).splats.centres[:BASE]
    chunk = long.packed.chunk(0)
    assert chunk is not None
    u = np.frombuffer(gzip.decompress(chunk), "<u2", 3 * BASE).reshape(3, BASE).T
    found = about["middle"] + about["half"] * (u * (4.0 / 65535.0) - 2.0)
    inside = np.abs(found - about["middle"]).max(axis=1) < about["half"][0]
    np.testing.assert_allclose(found[inside], largest[inside], atol=2e-3)
    assert long.total == COUNT


def test_tiles_hold_every_gaussian_once_and_where_it_is(long: DiveMap, tmp_path: Path) -> None:
    listed = tiles_of(long)
    assert all(tile["ends"][-1] <= MOST_IN_TILE for tile in listed)
    found = np.concatenate(
        [places(long, n, k) for n, tile in enumerate(listed) for k in range(len(tile["ends"]))]
    )
    off, which = KDTree(found).query(read_ply(tmp_path / "map.ply").means)
    assert off.max() < 5e-4
    assert sorted(which.tolist()) == list(range(COUNT))


def test_a_tile_says_the_box_that_it_fills(long: DiveMap) -> None:
    for number, tile in enumerate(tiles_of(long)):
        inside = np.concatenate([places(long, number, k) for k in range(len(tile["ends"]))])
        np.testing.assert_allclose(inside.min(axis=0), tile["low"], atol=1e-3)
        np.testing.assert_allclose(inside.max(axis=0), tile["high"], atol=1e-3)
        assert inside[:, 0].max() - inside[:, 0].min() < 6.0


def test_the_first_part_covers_more_than_its_share_and_grows_for_the_rest(long: DiveMap) -> None:
    for tile in tiles_of(long):
        first, whole = tile["ends"]
        assert first == -(-whole // map_tiles.FIRST_PART)
        assert 1.0 < tile["grown"] < np.sqrt(map_tiles.FIRST_PART)


def test_a_part_reads_no_more_than_a_tile(long: DiveMap, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[int] = []
    whole = PlyFile.rows

    def counted(file: PlyFile, which: Which) -> PlyGaussians:
        found = whole(file, which)
        read.append(len(found))
        return found

    long.packed.description()
    monkeypatch.setattr(PlyFile, "rows", counted)
    tiles = long.packed.tiles
    assert tiles is not None
    for number, part in tiles.parts():
        tiles.part(number, part)
    assert sum(read) == COUNT
    assert max(read) <= MOST_IN_TILE


def test_what_there_is_not_is_not_sent(long: DiveMap) -> None:
    tiles = long.packed.tiles
    assert tiles is not None
    for number, part in ((-1, 0), (0, -1), (0, 2), (len(tiles_of(long)), 0)):
        assert tiles.part(number, part) is None


def test_a_map_that_is_shown_whole_has_no_tiles(long: DiveMap, tmp_path: Path) -> None:
    found = look(tmp_path, COUNT)
    assert "tiles" not in found.packed.description()
    assert found.at_once == len(found.splats) == COUNT


def test_the_next_look_sends_the_same_tiles_from_the_file(long: DiveMap, tmp_path: Path) -> None:
    key = {"of": "these"}
    write_packed(tmp_path, key, long.packed, long.palettes, long.total)
    again = read_packed(tmp_path, key)
    assert again is not None
    assert json.dumps(again.description()) == json.dumps(long.packed.description())
    assert (again.at_once, again.total) == (BUDGET, COUNT)
    tiles, kept = long.packed.tiles, again.tiles
    assert tiles is not None
    assert kept is not None
    for number, part in tiles.parts():
        assert kept.part(number, part) == tiles.part(number, part)
    assert kept.part(len(tiles_of(long)), 0) is None


@pytest.mark.parametrize("ends", [[0], [7, 3], [1 << 20], [1, 2, 3, 4, 5], ["1"]])
def test_a_file_whose_tiles_are_none_is_made_anew(
    long: DiveMap, tmp_path: Path, ends: list[Any]
) -> None:
    write_packed(tmp_path, {}, long.packed, long.palettes, long.total)
    with zipfile.ZipFile(tmp_path / NAME) as file:
        members = {name: file.read(name) for name in file.namelist()}
    about = json.loads(members[ABOUT])
    about["map"]["tiles"]["list"][0]["ends"] = ends
    members[ABOUT] = json.dumps(about).encode()
    with zipfile.ZipFile(tmp_path / NAME, "w") as file:
        for name, data in members.items():
            file.writestr(name, data)
    assert read_packed(tmp_path, {}) is None
