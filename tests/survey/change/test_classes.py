"""What is called gained, lost, moved, bleached or not seen, on a ground of known changes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from aquaflow.dive.placement import Placement
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.change.change_picture import WORDS, bands_of, change_figure, grid_of
from aquaflow.survey.change.comparison import (
    BLEACHED,
    GAINED,
    LOST,
    MOVED_AWAY,
    MOVED_HERE,
    NOT_SEEN,
    UNCHANGED,
)
from aquaflow.survey.change.find_changes import COLUMNS, csv_of, row_of
from aquaflow.survey.change.patches import NAMES
from aquaflow.survey.export.ortho.grid import NODATA
from aquaflow.survey.export.ortho.ground import Ground
from tests.survey.change.sites import HALF, RESOLUTION, TALL, changes, day, views_of

HERE = (0.05, -0.05)
VOLUME = TALL * (2.0 * HALF) ** 2
WHERE = Placement(Sim3.identity(), "m", ("right", "forward"))
GROUND = Ground(Sim3.identity(), WHERE, (0.0, 0.0), 1.0, "up", "0")


def test_an_unchanged_ground_under_other_light_has_no_patches(tmp_path: Path) -> None:
    for seed in range(4):
        patches, found = changes(day(tmp_path, seed), day(tmp_path, 50 + seed, light=0.6))
        assert patches == []
        assert set(np.unique(found.kinds)) <= {UNCHANGED, NOT_SEEN}
        np.testing.assert_allclose(found.colours.gains, 0.6, rtol=0.02)


def test_the_same_day_twice_has_no_patches(tmp_path: Path) -> None:
    one = day(tmp_path, 3, HERE)
    assert changes(one, one)[0] == []


@pytest.mark.parametrize("sign", [1, -1])
def test_a_thing_that_was_added_or_removed_is_measured(tmp_path: Path, sign: int) -> None:
    days = [day(tmp_path, 1), day(tmp_path, 2, HERE)]
    [patch], found = changes(*days[::sign])
    assert patch.kind == (GAINED if sign > 0 else LOST)
    np.testing.assert_allclose(patch.place[:2], HERE, atol=0.03)
    assert abs(patch.volume - sign * VOLUME) < 0.3 * VOLUME
    assert abs(patch.distance - sign * TALL) < 0.1 * TALL
    assert patch.chance < 0.05
    assert (found.kinds == patch.kind).sum() == len(patch.which)


def test_a_thing_that_moved_is_one_pair_with_its_displacement(tmp_path: Path) -> None:
    there = (HERE[0] + 0.2, HERE[1] + 0.1)
    patches, found = changes(day(tmp_path, 1, HERE), day(tmp_path, 2, there))
    assert sorted(patch.kind for patch in patches) == [MOVED_AWAY, MOVED_HERE]
    for number, patch in enumerate(patches):
        assert patch.partner == 1 - number
        assert patch.displacement is not None
        assert patch.displacement_sigma is not None
        np.testing.assert_allclose(patch.displacement, (0.2, 0.1, 0.0), atol=1.2 * RESOLUTION)
        assert 0.0 < patch.displacement_sigma < 0.03
    assert {MOVED_AWAY, MOVED_HERE} <= set(np.unique(found.kinds))


def test_a_patch_that_bleached_is_found_by_its_colour_alone(tmp_path: Path) -> None:
    [patch], _ = changes(day(tmp_path, 1), day(tmp_path, 2, light=0.7, bleached=0.25))
    assert patch.kind == BLEACHED
    np.testing.assert_allclose(patch.place[:2], 0.0, atol=0.05)
    assert patch.lighter > 0.2
    assert patch.purer < -0.05
    assert np.isnan(patch.volume)


def test_what_got_darker_or_purer_is_not_bleached(tmp_path: Path) -> None:
    assert changes(day(tmp_path, 1, bleached=0.25), day(tmp_path, 2))[0] == []


def test_what_the_other_day_did_not_look_past_is_not_seen_and_never_lost(tmp_path: Path) -> None:
    """The second day's map lacks the box, but its pictures show it."""
    blind = day(tmp_path, 2, None, views=views_of(HERE, tmp_path))
    patches, found = changes(day(tmp_path, 1, HERE), blind)
    assert patches == []
    inside = (np.abs(found.places[:, :2] - HERE) < 0.8 * HALF).all(axis=1)
    assert (found.kinds[inside] == NOT_SEEN).mean() > 0.9


def test_raster_and_table_hold_what_was_found(tmp_path: Path) -> None:
    [patch], found = changes(day(tmp_path, 1), day(tmp_path, 2, HERE))
    bands = bands_of(found, grid_of(found))
    assert set(np.unique(bands[2]).tolist()) <= {-9999.0, -1.0, 0.0, 1.0}
    assert (bands[2] == GAINED).sum() >= 0.6 * len(patch.which)
    assert abs(bands[0][bands[2] == GAINED].mean() - TALL) < 0.02
    row = row_of(1, patch, GROUND)
    assert row["class"] == NAMES[GAINED]
    assert row["moved"] is None
    lines = csv_of([row]).decode().splitlines()
    assert lines[0].split(",") == list(COLUMNS)
    assert lines[1].startswith("1,gained,")


def test_the_picture_names_every_colour_that_it_shows(tmp_path: Path) -> None:
    days = day(tmp_path, 1), day(tmp_path, 2, HERE)
    patches, found = changes(*days)
    figure = change_figure(found, patches, *days, "m")
    named = {text.get_text() for legend in figure.legends for text in legend.get_texts()}
    shown = set(np.unique(bands_of(found, grid_of(found))[2]).tolist()) - {float(NODATA)}
    assert named == {WORDS[int(kind)] for kind in shown} >= {"unchanged", "gained"}
