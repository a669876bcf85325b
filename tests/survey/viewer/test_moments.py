"""What the time slider says of a pose: when, how deep, which way, and which picture is nearest."""

from __future__ import annotations

import shutil
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from aquaflow.dive.dive import Dive
from aquaflow.dive.trajectory_csv import NAME, read_trajectory_csv, write_trajectory_csv
from aquaflow.survey.viewer.dive_path import moments_of_dive, pictures_of_dive
from aquaflow.survey.viewer.moments import moments

T_S = np.array([10.0, 10.5, 11.0, 11.5])
NONE = np.full(4, np.nan)


def test_each_pose_gets_the_picture_that_is_nearest_in_the_dive() -> None:
    found = moments(T_S, NONE, NONE, np.array([100, 105, 110, 115]), [101, 112])
    assert found[:, 0].tolist() == [0.0, 0.5, 1.0, 1.5]
    assert found[:, 3].tolist() == [101.0, 101.0, 112.0, 112.0]
    assert np.allclose(found[:, 4], [0.1, 0.1, 1.2, 1.2])


def test_what_is_not_known_is_no_number() -> None:
    without = moments(T_S, NONE, NONE, np.array([0, 1, 2, 3]), [])
    assert np.isnan(without[:, 1:]).all()
    unnumbered = moments(T_S, NONE, NONE, np.array([-1, 1, 2, 3]), [2])
    assert np.isnan(unnumbered[0, 3:]).all()
    assert unnumbered[1:, 3].tolist() == [2.0, 2.0, 2.0]
    assert moments(T_S[:0], NONE[:0], NONE[:0], np.zeros(0, np.int64), [3]).shape == (0, 5)


def test_time_depth_and_heading_come_from_the_table_of_the_path(
    small_dive: Path, tmp_path: Path
) -> None:
    dive = shutil.copytree(small_dive, tmp_path / "dive")
    rows = read_trajectory_csv(dive / NAME)
    utc = datetime(2026, 11, 24, 3, 0, 2, tzinfo=timezone.utc)
    told = [
        type(row)(**vars(row) | {"depth_m": 4.5, "heading_deg": 90.0, "utc": utc if i else None})
        for i, row in enumerate(rows)
    ]
    write_trajectory_csv(dive / NAME, told)
    t_s = np.array([row.t_s for row in rows])
    index = np.array([row.index for row in rows], np.int64)
    found, began = moments_of_dive(Dive(dive), t_s, index, pictures_of_dive(Dive(dive)))
    assert set(found[:, 1].tolist()) == {4.5}
    assert set(found[:, 2].tolist()) == {90.0}
    assert began is not None
    assert (utc - began).total_seconds() == np.round(rows[1].t_s - rows[0].t_s, 6)


def test_a_dive_without_that_table_shows_times_alone(small_dive: Path, tmp_path: Path) -> None:
    found, began = moments_of_dive(Dive(tmp_path), T_S, np.arange(4), [])
    assert found[:, 0].tolist() == [0.0, 0.5, 1.0, 1.5]
    (tmp_path / NAME).write_text("damaged")
    again, _ = moments_of_dive(Dive(tmp_path), T_S, np.arange(4), [])
    assert np.array_equal(found, again, equal_nan=True)
    assert began is None
