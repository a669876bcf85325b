"""A merged site in the viewer: its dives in one world, each with its path and its pictures."""

from __future__ import annotations

import json
import shutil
import time
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.config.service import ViewerConfig
from aquaflow.dive.dive import Dive
from aquaflow.dive.ply import read_ply
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.site.merged_file import NAME as MERGED
from aquaflow.survey.site.merging import add_to_site, merge
from aquaflow.survey.viewer.finished import finished_dive
from aquaflow.survey.viewer.levels import RANGE
from aquaflow.survey.viewer.moments import PICTURE
from aquaflow.survey.viewer.packing import NAME as PACKED
from aquaflow.survey.viewer.page import ViewerPage
from aquaflow.survey.viewer.site_dives import read_shown
from aquaflow.survey.viewer.site_page import DIVE, map_of_site, open_site
from tests.small_recording import GIVE_UP_S

CONFIG = ViewerConfig(port=0)
MOVE = Sim3.exp(np.array([0.4, -0.2, 0.1, 0.0, 0.0, 0.5, 0.3]))
"""By which the second dive is put elsewhere than the first."""


@pytest.fixture
def site(small_dive: Path, tmp_path: Path) -> Path:
    """Two dives of one place, the second of which the merge is made to have put by ``MOVE``."""
    dives = [Path(shutil.copytree(small_dive, tmp_path / name)) for name in ("monday", "tuesday")]
    with (dives[1] / "trajectory.tum").open("a") as path:
        path.write("# no copy of the first, which a merge would leave out\n")
    add_to_site(tmp_path / "site", dives)
    merge(tmp_path / "site")
    path = tmp_path / "site" / MERGED
    stated = json.loads(path.read_text("utf-8"))
    for sub_map in stated["sub_maps"]:
        T = MOVE if sub_map["dive"] == "tuesday" else Sim3.identity()
        sub_map["T_sn"] = {
            "scale": T.scale, "rotation": T.R.tolist(), "translation": T.t.tolist(),
        }  # fmt: skip
    path.write_text(json.dumps(stated), "utf-8")
    return path.parent


def scene_of(page: ViewerPage) -> dict[str, object]:
    with urlopen(f"{page.address}scene.json") as answer:
        return dict(json.load(answer))


def test_maps_and_paths_of_all_dives_are_where_the_merge_put_them(
    site: Path, small_dive: Path
) -> None:
    own = finished_dive(Dive(small_dive), 10**6)
    shown = read_shown(site, None, 10**6)
    found = map_of_site(shown, 10**6)
    monday, tuesday = (found.splats.among(found.splats.levels[DIVE] == k) for k in (0, 1))
    assert len(monday) == len(tuesday) == len(own.splats)
    here = read_ply(own.ply).means
    for splats, T in ((monday, Sim3.identity()), (tuesday, MOVE)):
        there = np.sort(T.apply(here), axis=0)
        assert np.allclose(np.sort(splats.centres, axis=0), there, atol=1e-4)
    assert np.isclose(tuesday.scales.sum(), MOVE.scale * monday.scales.sum(), rtol=1e-4)
    places = [placed.path.places for placed in shown.dives]
    assert np.allclose(places[0], own.path.places)
    assert np.allclose(places[1], MOVE.apply(own.path.places))
    assert np.allclose(shown.dives[1].path.poses[3].R, MOVE.R @ own.path.poses[3].R)
    assert found.splats.levels[RANGE].max() > 0


def test_a_budget_keeps_what_covers_most_of_all_dives_together(site: Path) -> None:
    found = map_of_site(read_shown(site, None, 100), 100)
    assert len(found.splats) == 100
    weights = found.splats.weights()
    assert (np.diff(weights) <= 1e-9).all()
    assert found.total > 200


def test_the_page_says_whose_a_pose_and_a_picture_is(site: Path, small_dive: Path) -> None:
    own = finished_dive(Dive(small_dive), 100)
    page = open_site(site, CONFIG)
    try:
        said = scene_of(page)
        count = len(own.path.poses)
        path = said["path"]
        assert isinstance(path, dict)
        assert path["count"] == 2 * count
        assert [(part["name"], part["first"]) for part in path["parts"]] == [
            ("monday", 0), ("tuesday", count),
        ]  # fmt: skip
        assert path["parts"][1]["fx"] == own.camera.fx
        assert "2 dives" in str(said["health"])
        with urlopen(f"{page.address}path/{path['number']}") as answer:
            rows = np.frombuffer(answer.read(), np.float32).reshape(2 * count, -1)
        numbers = rows[:, 8 + PICTURE]
        assert numbers[:count].max() < numbers[count:].min()
        first = page._exhibit.pictures[int(numbers[0])]
        other = page._exhibit.pictures[int(numbers[count])]
        assert (first.name, first.parents[1].name) == (other.name, "monday")
        assert other.parents[1].name == "tuesday"
    finally:
        page.close()


def test_the_packed_map_is_kept_in_the_site_until_it_is_merged_anew(site: Path) -> None:
    def version() -> str:
        page = open_site(site, CONFIG)
        try:
            found = scene_of(page)["map"]
            assert isinstance(found, dict)
            end_s = time.monotonic() + GIVE_UP_S
            while not (site / PACKED).is_file():
                assert time.monotonic() < end_s
                time.sleep(0.05)
            return str(found["version"])
        finally:
            page.close()

    first = version()
    kept = (site / PACKED).stat().st_mtime_ns
    assert version() == first
    assert (site / PACKED).stat().st_mtime_ns == kept
    path = site / MERGED
    path.write_text(path.read_text("utf-8").replace('"scale": 1.0', '"scale": 1.5', 1), "utf-8")
    assert version() != first


def test_a_dive_that_changed_since_the_merge_is_left_out_and_named(site: Path) -> None:
    tuesday = site.with_name("tuesday")
    (tuesday / "trajectory.tum").write_text("# another\n")
    page = open_site(site, CONFIG)
    try:
        assert "tuesday is not shown" in str(scene_of(page)["health"])
    finally:
        page.close()
    shutil.rmtree(site.with_name("monday"))
    with pytest.raises(InputError, match="site merge"):
        open_site(site, CONFIG)


def test_what_is_no_merged_site_or_component_is_refused(site: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="components 0 to 0, not 3"):
        open_site(site, CONFIG, 3)
    (site / MERGED).unlink()
    with pytest.raises(InputError, match="site merge"):
        open_site(site, CONFIG)
