"""A dive's map is packed once: the next look takes it from the dive's folder."""

from __future__ import annotations

import json
import os
import shutil
import urllib.request
from pathlib import Path

import pytest

from aquaflow.config.service import ViewerConfig
from aquaflow.dive.dive import Dive
from aquaflow.survey.viewer import finished
from aquaflow.survey.viewer.finished import FinishedDive, finished_dive, prepare, show_dive
from aquaflow.survey.viewer.packing import NAME, key_of, read_packed
from aquaflow.survey.viewer.page import ViewerPage

BUDGET = 500


@pytest.fixture
def dive(small_dive: Path, tmp_path: Path) -> Path:
    return shutil.copytree(small_dive, tmp_path / "dive")


def looked_at(dive: Path) -> tuple[FinishedDive, ViewerPage]:
    """Shown once, until what is done behind the page is done."""
    found = finished_dive(Dive(dive), BUDGET)
    page = show_dive(found, ViewerConfig(port=0))
    prepare(dive, found.key, found.packed, found.map, page).join(60.0)
    return found, page


def served(page: ViewerPage) -> tuple[dict[str, object], list[bytes]]:
    def get(path: str) -> bytes:
        with urllib.request.urlopen(page.address + path, timeout=20) as answer:
            return bytes(answer.read())

    scene = json.loads(get("scene.json"))
    about = scene["map"]
    return scene, [get(f"map/{about['version']}/{n}") for n in range(len(about["ends"]))]


def test_the_second_look_sends_the_same_without_reading_the_map(
    dive: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, page = looked_at(dive)
    first = served(page)
    page.close()
    monkeypatch.setattr(finished, "read_map", lambda *_: pytest.fail("the map was read"))
    found = finished_dive(Dive(dive), BUDGET)
    assert found.packed is not None
    page = show_dive(found, ViewerConfig(port=0))
    again = served(page)
    page.close()
    assert again == first


def test_who_points_at_a_packed_map_gets_its_gaussians(dive: Path) -> None:
    found, page = looked_at(dive)
    page.close()
    again, page = looked_at(dive)
    page.close()
    assert again.packed is not None
    assert len(again.splats) == len(found.splats) == again.packed.count


@pytest.mark.parametrize("name", ["map.ply", "coverage.npz", "metric.json"])
def test_another_file_of_the_dive_makes_it_pack_anew(dive: Path, name: str) -> None:
    looked_at(dive)[1].close()
    assert read_packed(dive, key_of(dive, BUDGET)) is not None
    assert read_packed(dive, key_of(dive, BUDGET + 1)) is None
    (dive / name).touch()
    os.utime(dive / name, ns=(1, 1))
    assert read_packed(dive, key_of(dive, BUDGET)) is None
    assert looked_at(dive)[0].packed is None
    assert read_packed(dive, key_of(dive, BUDGET)) is not None


@pytest.mark.parametrize("keep", [0, 100, 0.9])
def test_a_damaged_packed_map_is_made_anew(dive: Path, keep: float) -> None:
    looked_at(dive)[1].close()
    whole = (dive / NAME).read_bytes()
    (dive / NAME).write_bytes(whole[: int(keep * len(whole)) if keep < 1 else int(keep)])
    found, page = looked_at(dive)
    page.close()
    assert found.packed is None
    assert (dive / NAME).stat().st_size == len(whole)


def test_a_packed_map_that_is_replaced_while_it_is_shown_sends_no_mixture(dive: Path) -> None:
    looked_at(dive)[1].close()
    packed = read_packed(dive, key_of(dive, BUDGET))
    assert packed is not None
    assert packed.chunk(0)
    assert packed.chunk(len(packed.about["ends"])) is None
    (dive / NAME).unlink()
    assert packed.chunk(0) is None
