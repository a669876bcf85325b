"""Dives merged: where their maps meet, they lie as they should; where not, they stay apart."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.dive.tum import read_tum
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes.place import NAME as PLACES
from aquaflow.survey.site import links, merging
from aquaflow.survey.site.checking import check_site
from aquaflow.survey.site.links import DiveLinks, find_links
from aquaflow.survey.site.manifest import SiteDive
from aquaflow.survey.site.merged_file import MergedSite, read_merged
from aquaflow.survey.site.merging import add_to_site, look_up, look_ups, merge
from aquaflow.survey.site.place_index import MOST_CANDIDATES
from aquaflow.telemetry.world_frame import Origin, WorldFrame
from aquaflow.tracking.loops import Verified, verify_keypoints
from tests.survey.site.site_dives import SPACING, Scene, stated_dive

WORLD = Sim3.exp(np.array([1.0, -2.0, 0.5, 0.3, -0.2, 0.7, np.log(2.5)]))
"""T_ms of the second dive."""
SIDES = np.diag([1e-4] * 7)


@pytest.fixture(scope="module")
def dives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two dives over one scene, one over another."""
    folder, scene = tmp_path_factory.mktemp("dives"), Scene(1)
    stated_dive(folder / "a", scene)
    stated_dive(folder / "b", scene, start=0.4, world=WORLD, seed=5)
    stated_dive(folder / "elsewhere", Scene(2), seed=6)
    return folder


@pytest.fixture(scope="module")
def whole(dives: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site of all three, merged."""
    site = tmp_path_factory.mktemp("whole") / "site"
    add_to_site(site, [dives / "a", dives / "b", dives / "elsewhere"])
    merge(site)
    return site


def bytes_of(site: Path) -> dict[str, bytes]:
    """Everything but the log."""
    files = [path for path in site.rglob("*") if path.is_file() and path.name != "log.jsonl"]
    return {str(path.relative_to(site)): path.read_bytes() for path in files}


def merged(site: Path) -> MergedSite:
    found = read_merged(site)
    assert found is not None
    return found


def test_dives_that_met_lie_as_the_truth_says(whole: Path) -> None:
    a, b = (merged(whole).of_dive(name)[0] for name in ("a", "b"))
    assert a.component == b.component
    between = a.T_sm.inverse() @ b.T_sm  # from b's world to a's, which is the scene's
    off = (between @ WORLD).log()
    assert np.linalg.norm(off[:3]) < 0.01
    assert np.linalg.norm(off[3:6]) < 0.005
    assert abs(off[6]) < 0.005


def test_paths_of_dives_that_met_are_in_one_world(whole: Path) -> None:
    a, b = (read_tum(whole / "paths" / f"{name}_0.tum").positions for name in ("a", "b"))
    T_sm = merged(whole).of_dive("a")[0].T_sm
    assert np.allclose(np.diff(T_sm.inverse().apply(a)[:, 0]), SPACING, atol=0.01)
    assert np.allclose(T_sm.inverse().apply(b)[:, 0], 0.4 + SPACING * np.arange(6), atol=0.01)


def test_a_dive_of_another_place_stays_apart(whole: Path) -> None:
    found = merged(whole)
    assert [each["dives"] for each in found.components] == [["a", "b"], ["elsewhere"]]
    assert found.of_dive("elsewhere")[0].T_sm.is_finite()


def test_sub_maps_are_joined_through_another_dive(dives: Path, tmp_path: Path) -> None:
    lost = stated_dive(tmp_path / "lost", Scene(1), seed=9, sub_maps=[0, 0, 0, 1, 1, 1])
    site = tmp_path / "site"
    add_to_site(site, [dives / "a", lost])
    found = merge(site)
    assert len(found.components) == 1
    assert [each.number for each in found.of_dive("lost")] == [0, 1]


def test_merging_again_gives_the_same_bytes(dives: Path, whole: Path, tmp_path: Path) -> None:
    before = bytes_of(whole)
    merge(whole)
    assert bytes_of(whole) == before
    other = tmp_path / "site"
    add_to_site(other, [dives / "a", dives / "b", dives / "elsewhere"])
    merge(other)
    assert {n: c for n, c in bytes_of(other).items() if n != "site.json"} == {
        n: c for n, c in before.items() if n != "site.json"
    }


def test_a_killed_merge_goes_on_with_the_next_dive(
    dives: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site = tmp_path / "site"
    add_to_site(site, [dives / "a", dives / "b", dives / "elsewhere"])
    looked_up: list[str] = []

    def killed_at_the_third(*arguments: Any) -> DiveLinks:
        if len(looked_up) == 2:
            raise KeyboardInterrupt
        return counted(*arguments)

    def counted(*arguments: Any) -> DiveLinks:
        looked_up.append("once")
        return find_links(*arguments)

    monkeypatch.setattr(merging, "find_links", killed_at_the_third)
    with pytest.raises(KeyboardInterrupt):
        merge(site)
    assert read_merged(site) is None
    looked_up.clear()
    monkeypatch.setattr(merging, "find_links", counted)
    merge(site)
    assert len(looked_up) == 1
    assert (site / "merged.json").read_bytes() == (whole / "merged.json").read_bytes()


def test_look_ups_done_apart_in_any_order_give_the_same_bytes(
    dives: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site = tmp_path / "site"
    add_to_site(site, [dives / "a", dives / "b", dives / "elsewhere"])
    wanted = look_ups(site)
    assert [(each.name, len(each.among)) for each in wanted] == [("b", 1), ("elsewhere", 2)]
    for each in reversed(wanted):
        look_up(str(site), [(each.dive, each.among)])
    assert look_ups(site) == []
    monkeypatch.setattr(merging, "find_links", None)  # there is nothing left to look up
    merge(site)
    assert {n: c for n, c in bytes_of(site).items() if n != "site.json"} == {
        n: c for n, c in bytes_of(whole).items() if n != "site.json"
    }


def test_a_look_up_that_came_to_nothing_is_done_by_the_merge(tmp_path: Path) -> None:
    scene, site = Scene(1), tmp_path / "site"
    dives = [
        stated_dive(tmp_path / f"{i}", scene, start=0.2 * i, seed=i, count=4) for i in range(3)
    ]
    add_to_site(site, dives)
    last = look_ups(site)[-1]
    look_up(str(site), [(last.dive, last.among)])
    found = merge(site)
    assert [each["dives"] for each in found.components] == [["0", "1", "2"]]
    pairs = {frozenset((link["a"]["dive"], link["b"]["dive"])) for link in found.links}
    assert pairs == {frozenset("01"), frozenset("02"), frozenset("12")}


def test_no_dive_is_changed(dives: Path, whole: Path, tmp_path: Path) -> None:
    shutil.copytree(dives, tmp_path / "dives")
    before = bytes_of(tmp_path / "dives")
    add_to_site(tmp_path / "site", sorted((tmp_path / "dives").iterdir()))
    merge(tmp_path / "site")
    check_site(tmp_path / "site")
    assert bytes_of(tmp_path / "dives") == before
    assert whole.is_dir()


def test_a_dive_that_changed_or_is_damaged_is_left_out_and_said_to_be(
    dives: Path, tmp_path: Path
) -> None:
    shutil.copytree(dives, tmp_path / "dives")
    names = ["a", "b", "elsewhere"]
    site = tmp_path / "site"
    new = add_to_site(site, [tmp_path / "dives" / name for name in names])
    assert [dive.name for dive in new] == names
    (tmp_path / "dives" / "b" / "metric.json").unlink()
    (tmp_path / "dives" / "elsewhere" / PLACES).unlink()
    found = merge(site)
    assert "changed" in found.left_out["b"]
    assert "gone" in found.left_out["elsewhere"]
    assert list(found.fingerprints) == ["a"]
    said = check_site(site)
    assert any(line.startswith("b:") and "changed" in line for line in said)
    # Added again, it counts as it is now.
    assert [dive.name for dive in add_to_site(site, [tmp_path / "dives" / "b"])] == ["b"]
    assert list(merge(site).fingerprints) == ["a", "b"]


def test_a_site_without_a_usable_dive_is_refused(dives: Path, tmp_path: Path) -> None:
    shutil.copytree(dives / "a", tmp_path / "a")
    add_to_site(tmp_path / "site", [tmp_path / "a"])
    shutil.rmtree(tmp_path / "a")
    with pytest.raises(InputError, match="no dive that can be merged"):
        merge(tmp_path / "site")


def metric_frame(T_nm: Sim3, sigma: float, origin: Origin | None = None) -> WorldFrame:
    covariance = SIDES.copy()
    covariance[6, 6] = sigma**2
    north = "true north" if origin else "initial heading"
    return WorldFrame(T_nm, covariance, True, True, north, origin=origin)


def test_scale_and_place_come_from_the_dives_that_know_them(tmp_path: Path) -> None:
    """The first knows nothing; of the others one is on the earth, and both are metric, their scales
    2 % apart, the second four times as certain."""
    scene, origin = Scene(1), Origin(-12.0, 96.0, "gps", 2.0)
    on_earth = metric_frame(Sim3(np.eye(3), np.array([5.0, 6.0, 7.0]), 2.0), 0.02, origin)
    sure = metric_frame(Sim3(np.eye(3), np.zeros(3), 2.0 * 1.02), 0.01)
    folders = [
        stated_dive(tmp_path / "plain", scene, seed=1),
        stated_dive(tmp_path / "earth", scene, seed=2, frame=on_earth),
        stated_dive(tmp_path / "sure", scene, seed=3, frame=sure),
    ]
    add_to_site(tmp_path / "site", folders)
    found = merge(tmp_path / "site")
    assert len(found.components) == 1
    component = found.components[0]
    assert component["axes_of"]["dive"] == "earth"
    assert component["georeferenced"]
    assert component["origin"]["latitude_deg"] == -12.0
    scale = found.of_dive("plain")[0].T_sm.scale
    assert scale == pytest.approx(2.0 * 1.02**0.8, rel=0.003)
    assert component["scale_sigma"] == pytest.approx((0.02**-2 + 0.01**-2) ** -0.5)
    assert component["scale_chi"] == pytest.approx(0.9, abs=0.4)


def test_a_manifest_that_is_damaged_is_refused(whole: Path, tmp_path: Path) -> None:
    shutil.copytree(whole, tmp_path / "site")
    manifest = tmp_path / "site" / "site.json"
    manifest.write_text(manifest.read_text()[:-30])
    with pytest.raises(InputError, match="cannot read"):
        merge(tmp_path / "site")


@pytest.mark.parametrize("name", ["merged.json", "merged.npy"])
def test_a_damaged_result_is_refused(whole: Path, tmp_path: Path, name: str) -> None:
    shutil.copytree(whole, tmp_path / "site")
    path = tmp_path / "site" / name
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(InputError, match="site merge"):
        read_merged(tmp_path / "site")


def test_a_dive_added_twice_is_there_once(dives: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    assert len(add_to_site(site, [dives / "a", dives / "a"])) == 1
    assert add_to_site(site, [dives / "b" / ".." / "a"]) == []
    shutil.copytree(dives / "b", tmp_path / "other" / "a")
    [second] = add_to_site(site, [tmp_path / "other" / "a"])
    assert second.name == "a_2"


def test_site_and_dives_may_be_moved_together(dives: Path, tmp_path: Path) -> None:
    shutil.copytree(dives, tmp_path / "here" / "dives")
    add_to_site(tmp_path / "here" / "site", [tmp_path / "here" / "dives" / "a"])
    (tmp_path / "here").rename(tmp_path / "there")
    assert list(merge(tmp_path / "there" / "site").fingerprints) == ["a"]


def test_what_is_no_dive_adds_nothing(dives: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=PLACES):
        add_to_site(tmp_path / "site", [dives / "a", tmp_path / "empty"])
    assert not (tmp_path / "site").exists()


def test_a_folder_with_other_files_becomes_no_site(dives: Path, tmp_path: Path) -> None:
    (tmp_path / "x").write_text("mine")
    with pytest.raises(InputError, match="no site"):
        add_to_site(tmp_path, [dives / "a"])


def test_the_log_says_what_was_done(whole: Path) -> None:
    lines = [json.loads(line) for line in (whole / "log.jsonl").read_text().splitlines()]
    assert [line["event"] for line in lines][:3] == ["added"] * 3
    assert {"looked_up", "merged"} <= {line["event"] for line in lines}


def test_a_path_that_is_no_longer_in_a_component_is_removed(whole: Path, tmp_path: Path) -> None:
    shutil.copytree(whole, tmp_path / "site")
    old = tmp_path / "site" / "paths" / "a_7.tum"
    old.write_text("0 0 0 0 0 0 0 1\n")
    manifest = tmp_path / "site" / "site.json"
    stated = json.loads(manifest.read_text())
    dives = [SiteDive(**each) for each in stated["dives"]]
    for each, dive in zip(stated["dives"], dives, strict=True):
        each["path"] = str(dive.folder(whole))
    manifest.write_text(json.dumps(stated))
    merge(tmp_path / "site")
    assert not old.exists()


def test_what_is_tried_for_a_new_dive_does_not_grow_with_the_site(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[int] = []

    def counted(*arguments: Any) -> Verified | None:
        tried[-1] += 1
        return verify_keypoints(*arguments)

    monkeypatch.setattr(links, "verify_keypoints", counted)
    scene, site = Scene(1), tmp_path / "site"
    for number in range(8):
        dive = stated_dive(tmp_path / f"{number}", scene, start=0.1 * number, seed=number, count=4)
        add_to_site(site, [dive])
        tried.append(0)
        merge(site)
    assert tried[0] == 0
    assert max(tried) <= 4 * MOST_CANDIDATES
    assert tried[-1] <= tried[3]


def test_dives_added_one_by_one_give_what_all_at_once_give(tmp_path: Path) -> None:
    scene, sites = Scene(1), [tmp_path / "one_by_one", tmp_path / "at_once"]
    sure = metric_frame(Sim3(np.eye(3), np.zeros(3), 2.0), 0.01)
    frames = [None, None, sure, None]
    dives = [
        stated_dive(tmp_path / f"{i}", scene, start=0.2 * i, seed=i, count=4, frame=frame)
        for i, frame in enumerate(frames)
    ]
    for dive in dives:
        add_to_site(sites[0], [dive])
        merge(sites[0])
    add_to_site(sites[1], dives)
    merge(sites[1])
    one_by_one, at_once = (
        {name: content for name, content in bytes_of(site).items() if name != "stamps.json"}
        for site in sites
    )
    assert one_by_one == at_once


def test_the_order_of_adding_moves_dives_by_little(tmp_path: Path) -> None:
    scene = Scene(1)
    dives = [
        stated_dive(tmp_path / f"{i}", scene, start=0.2 * i, seed=i, count=4) for i in range(4)
    ]
    apart = []
    for name, order in (("forward", dives), ("back", dives[::-1])):
        add_to_site(tmp_path / name, order)
        found = merge(tmp_path / name)
        first, last = (found.of_dive(each)[0].T_sm for each in ("0", "3"))
        apart.append(first.inverse() @ last)
    assert np.abs((apart[0].inverse() @ apart[1]).log()).max() < 0.005


def test_a_dive_that_was_away_is_looked_up_in_those_added_meanwhile(tmp_path: Path) -> None:
    scene, site = Scene(1), tmp_path / "site"
    dives = [
        stated_dive(tmp_path / f"{i}", scene, start=0.2 * i, seed=i, count=4) for i in range(3)
    ]
    add_to_site(site, dives[:2])
    merge(site)
    dives[0].rename(tmp_path / "away")
    add_to_site(site, [dives[2]])
    assert list(merge(site).left_out) == ["0"]
    (tmp_path / "away").rename(dives[0])
    found = merge(site)
    pairs = [{link["a"]["dive"], link["b"]["dive"]} for link in found.links]
    assert all(pair in pairs for pair in ({"0", "1"}, {"0", "2"}, {"1", "2"}))
    keyframes = {
        tuple(sorted((link[end]["dive"], link[end]["keyframe"]) for end in "ab"))
        for link in found.links
    }
    assert len(keyframes) == len(found.links), "a pair of keyframes is proved twice"


def test_a_dive_mapped_anew_takes_its_place(dives: Path, tmp_path: Path) -> None:
    shutil.copytree(dives, tmp_path / "dives")
    site = tmp_path / "site"
    add_to_site(site, [tmp_path / "dives" / "a", tmp_path / "dives" / "b"])
    merge(site)
    shutil.rmtree(tmp_path / "dives" / "a")
    stated_dive(tmp_path / "dives" / "a", Scene(1), start=0.2, seed=8)
    add_to_site(site, [tmp_path / "dives" / "a"])
    found = merge(site)
    assert list(found.fingerprints) == ["a", "b"]
    assert len(found.components) == 1
    off = found.of_dive("a")[0].T_sm.inverse() @ found.of_dive("b")[0].T_sm @ WORLD
    assert np.linalg.norm(off.log()) < 0.02


def test_a_copy_of_a_dive_is_left_out(dives: Path, tmp_path: Path) -> None:
    shutil.copytree(dives / "a", tmp_path / "again")
    add_to_site(tmp_path / "site", [dives / "a", tmp_path / "again"])
    assert merge(tmp_path / "site").left_out == {"again": "it is a copy of a"}


@pytest.mark.parametrize("name", ["index.npz", "joint.npz", "stamps.json"])
def test_what_a_site_keeps_to_be_quick_is_made_anew_where_it_is_damaged(
    dives: Path, tmp_path: Path, name: str
) -> None:
    site = tmp_path / "site"
    add_to_site(site, [dives / each for each in ("a", "b", "elsewhere")])
    merge(site)
    before = bytes_of(site)
    (site / name).write_bytes((site / name).read_bytes()[:100])
    if name == "index.npz":
        (site / "joint.npz").unlink()
        shutil.rmtree(site / "links")
    merge(site)
    assert bytes_of(site) == before
