"""A merged site as the base in which another dive is looked for."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.keyframes.place import NAME, PlacesFile
from aquaflow.survey.site.merging import add_to_site, merge
from aquaflow.tracking.base import base_of


@pytest.fixture
def site(small_dive: Path, tmp_path: Path) -> Path:
    """Of one dive, a copy."""
    dive = Path(shutil.copytree(small_dive, tmp_path / "monday"))
    add_to_site(tmp_path / "site", [dive])
    return tmp_path / "site"


def test_the_keyframes_of_a_merged_site_are_places_in_its_world(
    site: Path, small_dive: Path
) -> None:
    merge(site)
    base, own = base_of(site), PlacesFile(small_dive / NAME)
    assert len(base.places) == len(own.places)
    first = own.keypoints(own.places[0].number)
    assert (base.keypoints(base.places[0].number).keypoints.pixels == first.keypoints.pixels).all()
    assert np.allclose(base.frame(0).T_nm.matrix, np.eye(4))
    assert base.name == "site"
    assert base.prior


def test_a_site_that_was_never_merged_is_refused(site: Path) -> None:
    with pytest.raises(InputError, match="site merge"):
        base_of(site)


def test_a_dive_that_changed_since_the_merge_is_left_out(site: Path) -> None:
    merge(site)
    (site.with_name("monday") / "trajectory.tum").write_text("# another\n")
    with pytest.raises(InputError, match="as it was merged"):
        base_of(site)


def test_a_dive_alone_is_a_base_too(small_dive: Path) -> None:
    base = base_of(small_dive)
    assert base.name == small_dive.name
    found = base.map_of(base.places[0].number)
    assert found is not None
    path, T_sb = found
    assert path == small_dive / "map.aqf"
    assert np.allclose(T_sb.matrix, np.eye(4))


def test_the_maps_of_a_merged_site_lie_in_its_world(site: Path) -> None:
    merged = merge(site)
    base, monday = base_of(site), site.with_name("monday")
    for place in base.places:
        found = base.map_of(place.number)
        assert found is not None
        assert found[0] == monday / "map.aqf"
        assert np.allclose(found[1].matrix, merged.sub_maps[0].T_sm.matrix)
    (monday / "map.aqf").unlink()
    assert base_of(site).map_of(base.places[0].number) is None
