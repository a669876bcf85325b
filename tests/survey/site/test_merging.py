"""Dives merged: where their maps meet, they lie as they should; where not, they stay apart."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.dive.tum import read_tum
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes.place import NAME as PLACES
from aquaflow.survey.site import merging
from aquaflow.survey.site.checking import check_site
from aquaflow.survey.site.joining import CrossLink
from aquaflow.survey.site.manifest import SiteDive
from aquaflow.survey.site.merged_file import MergedSite, read_merged
from aquaflow.survey.site.merging import add_to_site, merge
from aquaflow.telemetry.world_frame import Origin, WorldFrame
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


def test_a_killed_merge_goes_on_with_the_next_pair(
    dives: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site = tmp_path / "site"
    add_to_site(site, [dives / "a", dives / "b", dives / "elsewhere"])
    compared: list[str] = []
    whole_search = merging.find_links

    def killed_at_the_second(*arguments: object) -> list[CrossLink]:
        if len(compared) == 1:
            raise KeyboardInterrupt
        compared.append("first")
        return whole_search(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(merging, "find_links", killed_at_the_second)
    with pytest.raises(KeyboardInterrupt):
        merge(site)
    assert read_merged(site) is None
    compared.clear()

    def counted(*arguments: object) -> list[CrossLink]:
        compared.append("again")
        return whole_search(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(merging, "find_links", counted)
    merge(site)
    assert len(compared) == 2
    assert (site / "merged.json").read_bytes() == (whole / "merged.json").read_bytes()


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
    assert {"compared", "merged"} <= {line["event"] for line in lines}


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
