"""A dive recognised in an earlier one goes on in its frame; one that is not stays as it is."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest

from aquaflow.geometry.alignment import align
from aquaflow.geometry.similarity import Sim3
from aquaflow.slam import Slam
from aquaflow.tracking.base import open_base
from tests.tracking.base.two_dives import (
    TRACKED_ONLY,
    first_way,
    in_other_light,
    second_way,
    swum,
    written_base,
)
from tests.tracking.tracking_scenes import SeaFloor, filmed

FLOOR = SeaFloor(3)


def digest(folder: Path) -> dict[str, str]:
    return {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.iterdir())
    }


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[int, Sim3]]:
    folder = tmp_path_factory.mktemp("dives") / "yesterday"
    return folder, written_base(folder, FLOOR)


def aligned(poses: dict[int, Sim3], truth: list[Sim3]) -> Sim3:
    """The similarity from the base's frame to the truth, by its own poses alone."""
    found = np.array([poses[i].t for i in sorted(poses)])
    true = np.array([truth[i].t for i in sorted(poses)])
    return align(found, true, with_scale=True).T_target_source


def test_a_dive_in_other_light_turned_and_higher_goes_on_in_the_frame_of_the_first(
    base: tuple[Path, dict[int, Sim3]],
) -> None:
    folder, first = base
    before, slam = digest(folder), Slam(TRACKED_ONLY)
    slam.localise_in(open_base(folder))
    try:
        second = swum(in_other_light(filmed(FLOOR, second_way())), slam)
        assert slam.in_base is not None
        assert slam.in_base.first is not None
        assert slam.in_base.first.frame <= 10
    finally:
        slam.close()
    to_truth = aligned(first, first_way())
    error = [
        np.linalg.norm(to_truth.apply(T.t) - second_way()[index].t) for index, T in second.items()
    ]
    assert len(error) > 10
    assert np.sqrt(np.mean(np.square(error))) < 0.01  # m, of a way of 1.2
    assert digest(folder) == before


def test_a_dive_elsewhere_is_what_it_would_be_without(
    base: tuple[Path, dict[int, Sim3]],
) -> None:
    elsewhere = filmed(SeaFloor(4), second_way()[:9])
    alone, looking = Slam(TRACKED_ONLY), Slam(TRACKED_ONLY)
    looking.localise_in(open_base(base[0]))
    try:
        plain, found = swum(elsewhere, alone), swum(elsewhere, looking)
        assert looking.in_base is not None
        assert not looking.in_base.recognised
        assert looking.in_base.looked_up == len(looking.keyframes)
    finally:
        alone.close()
        looking.close()
    assert plain.keys() == found.keys()
    assert all((plain[i].matrix == found[i].matrix).all() for i in plain)
