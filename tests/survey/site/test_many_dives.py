"""Many dives over one reef, added one after the other, lie as the truth says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aquaflow.dive.tum import read_tum
from aquaflow.geometry.alignment import align
from aquaflow.survey.site import links
from aquaflow.survey.site.merging import add_to_site, merge
from aquaflow.survey.site.place_index import MOST_CANDIDATES
from aquaflow.tracking.loops import Verified, verify_keypoints
from tests.survey.site.visits import Visit, map_visit

DIVES, SIDE_M = 12, 2.0


@pytest.mark.slow
def test_dives_of_one_reef_join_one_by_one_at_the_same_effort(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = [0] * DIVES

    def counted(*arguments: Any) -> Verified | None:
        tried[number] += 1
        return verify_keypoints(*arguments)

    monkeypatch.setattr(links, "verify_keypoints", counted)
    site = tmp_path / "site"
    for number in range(DIVES):
        add_to_site(site, [map_visit(number, tmp_path / f"dive_{number}", SIDE_M)])
        merged = merge(site)
    keyframes = np.bincount(merged.keyframes["dive"])
    assert (np.array(tried) <= MOST_CANDIDATES * keyframes).all()
    assert [each["dives"] for each in merged.components] == [
        sorted(f"dive_{number}" for number in range(DIVES))
    ]
    paths = [read_tum(site / "paths" / f"dive_{number}_0.tum") for number in range(DIVES)]
    found = np.concatenate([path.positions for path in paths])
    visits = [Visit(number, SIDE_M) for number in range(DIVES)]
    true = np.concatenate(
        [visit.true_positions(path.t_s) for visit, path in zip(visits, paths, strict=True)]
    )
    off = align(found, true, with_scale=True).T_target_source.apply(found) - true
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.012, "of 2 m that each dive travelled"
