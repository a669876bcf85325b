"""Ranges of held-out views, whole and damaged."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from aquaflow.lab.evaluation.restoration import held_out_ranges

SIZE = (4, 6)


def write_ranges(dive: Path, index: int, size: tuple[int, int] = SIZE) -> Path:
    (dive / "heldout").mkdir(exist_ok=True)
    path = dive / "heldout" / f"{index:06d}_range.npz"
    np.savez_compressed(path, z=np.full(size, index, np.float32))
    return path


def test_the_ranges_come_in_the_order_of_the_views(tmp_path: Path) -> None:
    for index in (8, 16):
        write_ranges(tmp_path, index)
    found = held_out_ranges(tmp_path, [8, 16], SIZE)
    assert found is not None
    assert found.shape == (2, *SIZE)
    assert found[:, 0, 0].tolist() == [8.0, 16.0]


def test_a_missing_file_or_one_of_another_size_gives_none(tmp_path: Path) -> None:
    write_ranges(tmp_path, 8)
    assert held_out_ranges(tmp_path, [8, 16], SIZE) is None
    write_ranges(tmp_path, 16, (2, 3))
    assert held_out_ranges(tmp_path, [8, 16], SIZE) is None


@pytest.mark.parametrize("damage", ["empty", "text", "cut", "flipped", "other key", "one array"])
def test_a_damaged_file_gives_none(tmp_path: Path, damage: str) -> None:
    path = write_ranges(tmp_path, 8)
    whole = path.read_bytes()
    if damage == "other key":
        np.savez(path, range=np.zeros(SIZE))
    elif damage == "one array":
        with path.open("wb") as stream:
            np.save(stream, np.zeros(SIZE))
    else:
        middle = len(whole) // 3
        flipped = bytes(byte ^ 255 for byte in whole[middle : middle + 30])
        path.write_bytes(
            {
                "empty": b"",
                "text": b"no ranges",
                "cut": whole[: len(whole) // 2],
                "flipped": whole[:middle] + flipped + whole[middle + 30 :],
            }[damage]
        )
    assert held_out_ranges(tmp_path, [8], SIZE) is None
