"""``aquaflow site map``: the one map's files, and the viewer that shows them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from aquaflow.dive.ply import read_ply
from aquaflow.survey.site.manifest import fingerprint
from aquaflow.survey.site.merged_file import NAME as MERGED
from aquaflow.survey.site.merging import add_to_site, merge
from aquaflow.survey.site.site_map_file import names_of
from aquaflow.survey.viewer.site_dives import read_shown
from aquaflow.survey.viewer.site_page import DIVE, map_of_site
from tests.command_line import Cli

MOST = 10**6


@pytest.fixture
def site(small_dive: Path, tmp_path: Path) -> Path:
    """The same dive under two names, merged."""
    dives = [Path(shutil.copytree(small_dive, tmp_path / name)) for name in ("monday", "tuesday")]
    with (dives[1] / "trajectory.tum").open("a") as path:
        path.write("# no copy of the first, which a merge would leave out\n")
    add_to_site(tmp_path / "site", dives)
    merge(tmp_path / "site")
    return tmp_path / "site"


def test_the_later_of_two_dives_of_one_place_is_the_map(
    command: Cli, site: Path, small_dive: Path
) -> None:
    dives = [site.with_name(name) for name in ("monday", "tuesday")]
    before = [fingerprint(dive) for dive in dives]
    said = json.loads(command("site", "map", site, "--json").out)
    monday, tuesday = said["dives"]
    whole, own = read_ply(Path(said["map"])), read_ply(small_dive / "map_clear.ply")
    assert len(whole.means) == monday["gaussians"] + tuesday["gaussians"]
    assert monday["gaussians"] < 0.5 * len(own.means) < tuesday["gaussians"]
    assert tuesday["gone"] == 0
    assert tuesday["gains"] == [1.0, 1.0, 1.0]
    assert np.allclose(monday["gains"], 1.0, atol=0.05)
    assert [fingerprint(dive) for dive in dives] == before
    first = names_of(site, 0)[0].read_bytes()
    in_words = command("site", "map", site, "--component", "0").out
    assert "monday:" in in_words
    assert names_of(site, 0)[0].read_bytes() == first


def test_the_viewer_shows_it_until_the_dives_lie_elsewhere(command: Cli, site: Path) -> None:
    apart = len(map_of_site(read_shown(site, None, MOST), MOST).splats)
    counts = [
        each["gaussians"]
        for each in json.loads(command("site", "map", site, "--json").out)["dives"]
    ]
    shown = read_shown(site, None, MOST)
    assert shown.one_map is not None
    found = map_of_site(shown, MOST).splats
    assert len(found) == sum(counts) < apart
    assert [int((found.levels[DIVE] == k).sum()) for k in (0, 1)] == counts
    path = site / MERGED
    stated = json.loads(path.read_text("utf-8"))
    stated["sub_maps"][1]["T_sn"]["scale"] *= 1.5
    path.write_text(json.dumps(stated), "utf-8")
    moved = read_shown(site, None, MOST)
    assert moved.one_map is None
    assert len(map_of_site(moved, MOST).splats) == apart


def test_damaged_files_cost_the_one_map_and_not_the_view(command: Cli, site: Path) -> None:
    apart = len(map_of_site(read_shown(site, None, MOST), MOST).splats)
    command("site", "map", site)
    ply, about = names_of(site, 0)
    ply.write_bytes(ply.read_bytes()[:-100])
    assert len(map_of_site(read_shown(site, None, MOST), MOST).splats) == apart
    command("site", "map", site)
    ply.write_bytes((site.with_name("monday") / "map.ply").read_bytes())
    assert len(map_of_site(read_shown(site, None, MOST), MOST).splats) == apart
    about.write_text("{}")
    assert read_shown(site, None, MOST).one_map is None


def test_a_dive_that_is_not_what_was_merged_costs_itself(command: Cli, site: Path) -> None:
    (site.with_name("monday") / "trajectory.tum").write_text("# another\n")
    said = json.loads(command("site", "map", site, "--json").out)
    assert [each["name"] for each in said["dives"]] == ["tuesday"]
    assert "is not what it was when the site was merged" in said["left_out"]["monday"]
    assert (
        len(map_of_site(read_shown(site, None, MOST), MOST).splats) == said["dives"][0]["gaussians"]
    )
    (site.with_name("tuesday") / "map.aqf").unlink()
    refused = command("site", "map", site)
    assert refused.code == 1
    assert "nothing to make a map of" in refused.err


def test_sites_without_a_merge_or_the_component_are_refused(command: Cli, site: Path) -> None:
    assert "components 0 to 0, not 2" in command("site", "map", site, "--component", "2").err
    (site / MERGED).unlink()
    assert "never merged" in command("site", "map", site).err


@pytest.mark.ci
def test_the_one_map_is_refined_on_the_pictures_of_all_dives(
    command: Cli, site: Path, small_dive: Path
) -> None:
    dives = [site.with_name(name) for name in ("monday", "tuesday")]
    before = [fingerprint(dive) for dive in dives]
    said = json.loads(command("site", "map", site, "--refine-steps", 60, "--json").out)
    assert said["refined"]["steps"] == 60
    for dive, name in zip(said["refined"]["dives"], ("monday", "tuesday"), strict=True):
        assert dive["name"] == name
        assert dive["views"] > 10
        assert dive["held_out"] > 0
        assert dive["psnr_after"] > dive["psnr_before"] - 0.1
        assert dive["reason"] == ""
    whole, own = read_ply(Path(said["map"])), read_ply(small_dive / "map_clear.ply")
    assert len(whole.means) == sum(part["gaussians"] for part in said["dives"])
    assert np.abs(np.median(whole.means, axis=0) - np.median(own.means, axis=0)).max() < 0.1
    assert np.abs(np.median(whole.colours, axis=0) - np.median(own.colours, axis=0)).max() < 0.05
    assert [fingerprint(dive) for dive in dives] == before


@pytest.mark.ci
def test_a_dive_without_its_recording_costs_only_its_pictures(command: Cli, site: Path) -> None:
    metrics = site.with_name("monday") / "metrics.json"
    stated = json.loads(metrics.read_text()) | {"recording": "/nowhere/monday.mp4"}
    metrics.write_text(json.dumps(stated))
    told = command("site", "map", site, "--refine-steps", 6, "--refine-seconds", 300).out
    assert "monday: nothing was learned from its pictures: its recording is not where" in told
    assert "tuesday: " in told
    assert "dB after" in told
