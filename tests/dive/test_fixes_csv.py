"""fixes.csv has every fix with the error that the fit leaves, and which were rejected."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.dive.fixes_csv import (
    COLUMNS,
    FixRow,
    fix_numbers,
    fix_rows,
    read_fixes_csv,
    write_fixes_csv,
)
from aquaflow.dive.frames_csv import FrameRow
from aquaflow.telemetry.world_frame import FixErrors, Origin, WorldFrame

ORIGIN = Origin(-31.7, 115.0, "usbl", 0.05)
ERRORS = FixErrors(
    "=usbl",
    np.array([0.0, 1.0, 2.25]),
    np.array([[0.0, 0.0], [1.0, 2.0], [3.0, -4.0]]),
    np.array([0.05, 0.05, 0.1]),
    np.array([[0.03, 0.04], [0.0, -0.1], [6.0, 8.0]]),
    np.array([False, False, True]),
)
FRAME = replace(WorldFrame.unknown(), origin=ORIGIN, fixes=(ERRORS,))
PICTURES = [FrameRow(k, f"{k}.jpg", float(k), "common", 0, 0, 1.0, "") for k in (1, 0, 3)]


def rows() -> list[FixRow]:
    return fix_rows({0: FRAME}, PICTURES)


def test_a_row_has_the_picture_the_error_and_how_many_sigmas_that_is() -> None:
    first, second, third = rows()
    assert [each.picture for each in (first, second, third)] == ["0.jpg", "1.jpg", ""]
    assert (first.error_east_m, first.error_north_m) == pytest.approx((0.04, 0.03))
    assert (first.error_m, first.error_sigmas) == pytest.approx((0.05, 1.0 / np.sqrt(2.0)))
    assert (first.latitude_deg, first.longitude_deg) == pytest.approx((-31.7, 115.0))
    assert [each.rejected for each in (first, second, third)] == [False, False, True]


def test_rows_are_read_back_as_they_were(tmp_path: Path) -> None:
    write_fixes_csv(tmp_path / "fixes.csv", rows())
    for read, written in zip(read_fixes_csv(tmp_path / "fixes.csv"), rows(), strict=True):
        assert read == replace(written, **{
            name: pytest.approx(getattr(written, name), abs=1e-4)
            for name in COLUMNS
            if isinstance(getattr(written, name), float)
        })  # fmt: skip


def test_an_error_that_is_rounded_to_zero_has_no_sign() -> None:
    row = replace(rows()[0], error_east_m=-0.00001)
    assert dict(zip(COLUMNS, row.cells(), strict=True))["error_east_m"] == "0.0000"


def test_numbers_are_of_the_fixes_that_took_part() -> None:
    numbers = fix_numbers({0: FRAME})
    assert numbers is not None
    assert (numbers["count"], numbers["rejected"]) == (3, 1)
    assert numbers["largest_m"] == pytest.approx(0.1)
    assert numbers["rms_m"] == pytest.approx(np.sqrt(0.5 * (0.05**2 + 0.1**2)))
    assert fix_numbers({0: WorldFrame.unknown()}) is None


@pytest.mark.parametrize("text", ["", "t_s\n1\n", ",".join(COLUMNS) + "\n" + "," * 11])
def test_what_is_no_such_table_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "fixes.csv").write_text(text)
    with pytest.raises(InputError, match="map the dive again"):
        read_fixes_csv(tmp_path / "fixes.csv")
