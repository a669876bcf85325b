"""trajectory.csv is read back as it was written, and says nothing where nothing is known."""

from __future__ import annotations

from datetime import datetime, timedelta, timezone
from pathlib import Path

import pytest

from aquaflow.base.errors import InputError
from aquaflow.dive.trajectory_csv import COLUMNS, PoseRow, read_trajectory_csv, write_trajectory_csv

WHEN = datetime(2026, 11, 22, 14, 3, 5, 250_000, timezone(timedelta(hours=1)))
FULL = PoseRow(
    7, 0.7, WHEN, 1, 1.25, -2.5, 3.125, "m", 63.430001234, 10.39, 3.2, 1.8, 359.5, -1.5, 2.25,
    0.4, 0.05, 1.5,
)  # fmt: skip
BARE = PoseRow(8, 0.8, None, 0, 0.0, -1e-9, 1.0, "map units")


def test_rows_are_read_back_as_they_were(tmp_path: Path) -> None:
    path = tmp_path / "trajectory.csv"
    write_trajectory_csv(path, [FULL, BARE])
    full, bare = read_trajectory_csv(path)
    assert full == FULL
    assert bare == PoseRow(8, 0.8, None, 0, 0.0, 0.0, 1.0, "map units")


def test_times_are_utc_and_what_is_unknown_is_empty(tmp_path: Path) -> None:
    path = tmp_path / "trajectory.csv"
    write_trajectory_csv(path, [FULL, BARE])
    header, full, bare = path.read_text().splitlines()
    assert header.split(",")[:4] == ["index", "t_s", "utc", "sub_map"]
    assert full.split(",")[2] == "2026-11-22T13:03:05.250000Z"
    assert bare == "8,0.800000000,,0,0.000000,0.000000,1.000000,map units" + "," * 10


@pytest.mark.parametrize(
    "text",
    ["", "index,t_s\n1,2\n", ",".join(COLUMNS) + "\n1,2\n", ",".join(COLUMNS) + "\n" + "," * 17],
)
def test_what_is_no_such_table_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "trajectory.csv").write_text(text)
    with pytest.raises(InputError, match="map the dive again"):
        read_trajectory_csv(tmp_path / "trajectory.csv")
