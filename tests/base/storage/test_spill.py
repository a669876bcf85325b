"""Things that wait in files: they come back bit for bit, and a failing disk loses none of them."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of

from aquaflow.base.errors import InputError
from aquaflow.base.storage import spill
from aquaflow.base.storage.archive import Arrays, read_arrays, write_arrays
from aquaflow.base.storage.spill import Spill, read_item

Thing = npt.NDArray[np.int64]


def pack(thing: Thing) -> Arrays:
    return {"thing": thing}


def unpack(number: int, arrays: Arrays) -> Thing:
    return arrays["thing"]


def spill_of(folder: Path | None, resident: int = 2) -> Spill[Thing]:
    return Spill(folder, resident, pack, unpack)


def filled(folder: Path | None, count: int = 5, resident: int = 2) -> Spill[Thing]:
    things = spill_of(folder, resident)
    for number in range(count):
        things[number] = np.full(3, number)
    return things


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []


Writes = list[str]


@pytest.fixture
def writes(monkeypatch: pytest.MonkeyPatch) -> Writes:
    """Names of the files written, in order."""
    names: Writes = []

    def write(path: Path, arrays: Arrays, of: str) -> None:
        names.append(path.name)
        write_arrays(path, arrays, of)

    monkeypatch.setattr(spill, "write_arrays", write)
    return names


# --- the file -------------------------------------------------------------------------------------

DTYPES = st.sampled_from(["u1", "b1", "f2", "<f4", "f8", ">f8", "i8"])


@given(
    st.dictionaries(
        st.text(max_size=8),
        DTYPES.flatmap(
            lambda dtype: arrays_of.arrays(
                dtype, arrays_of.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=5)
            )
        ),
        max_size=4,
    )
)
def test_arrays_come_back_bit_for_bit(arrays: Arrays) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "x.arrays"
        write_arrays(path, arrays)
        back = read_arrays(path)
    assert list(back) == list(arrays)
    for name, array in arrays.items():
        assert back[name].dtype == array.dtype
        assert back[name].shape == array.shape
        assert back[name].tobytes() == array.tobytes()
        assert back[name].flags.writeable


def test_a_transposed_array_comes_back_in_its_own_order(tmp_path: Path) -> None:
    array = np.arange(12).reshape(3, 4).T
    write_arrays(tmp_path / "x", {"a": array})
    np.testing.assert_array_equal(read_arrays(tmp_path / "x")["a"], array)


def test_a_file_that_cannot_be_finished_leaves_the_one_before(tmp_path: Path) -> None:
    path = tmp_path / "x"
    write_arrays(path, {"a": np.arange(3)})
    with pytest.raises(TypeError, match="references"):
        write_arrays(path, {"a": np.arange(4), "b": np.array([None])})
    assert files(tmp_path) == ["x"]
    assert len(read_arrays(path)["a"]) == 3


def cut_short(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


def emptied(path: Path) -> None:
    path.write_bytes(b"")


def garbled(path: Path) -> None:
    path.write_bytes(b'{"a": 3}\n')


def listed(path: Path) -> None:
    path.write_bytes(b"[1, 2]\n")


@pytest.mark.parametrize("damage", [Path.unlink, cut_short, emptied, garbled, listed])
def test_a_damaged_file_is_named_in_one_sentence(
    tmp_path: Path, damage: Callable[[Path], None]
) -> None:
    path = tmp_path / "x"
    write_arrays(path, {"a": np.arange(3)})
    damage(path)
    with pytest.raises(InputError, match=f"cannot read back {path}: [A-Za-z ]+; leave"):
        read_arrays(path)


@given(st.integers(0, 10_000), st.integers(0, 7))
@example(at=2250, bit=4)  # the name of a type becomes a comma
def test_no_flipped_bit_goes_unnoticed(at: int, bit: int) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "x"
        write_arrays(path, {"a": np.arange(30.0).reshape(5, 6), "b": np.zeros(3, bool)})
        data = bytearray(path.read_bytes())
        data[at % len(data)] ^= 1 << bit
        path.write_bytes(data)
        with pytest.raises(InputError, match="it is damaged"):
            read_arrays(path)


def test_files_that_were_swapped_are_noticed(tmp_path: Path) -> None:
    filled(tmp_path).save()
    one, other = tmp_path / "000000.arrays", tmp_path / "000001.arrays"
    one.replace(tmp_path / "spare")
    other.replace(one)
    with pytest.raises(InputError, match="it is damaged"):
        read_item(one)


# --- memory and files -----------------------------------------------------------------------------


def test_only_the_last_used_are_in_memory(tmp_path: Path) -> None:
    things = filled(tmp_path / "work", count=50, resident=4)
    assert things.resident_bytes == 4 * 3 * 8
    assert len(files(tmp_path / "work")) == 46


def test_the_least_recently_used_leaves_first(tmp_path: Path) -> None:
    things = filled(tmp_path, count=3, resident=3)
    _ = things[0]
    things[3] = np.zeros(3, int)
    assert files(tmp_path) == ["000001.arrays"]


def test_without_a_folder_everything_stays_and_stays_itself() -> None:
    things, first = spill_of(None), np.zeros(3, int)
    things[0] = first
    for number in range(1, 50):
        things[number] = np.zeros(3, int)
    assert things[0] is first
    assert things.resident_bytes == 50 * 3 * 8
    things.close()


def test_what_was_never_set_is_not_found(tmp_path: Path) -> None:
    with pytest.raises(KeyError):
        filled(tmp_path)[9]


def test_a_short_dive_makes_no_folder(tmp_path: Path) -> None:
    filled(tmp_path / "work", count=2, resident=2)
    assert files(tmp_path) == []


def test_what_was_only_read_is_not_written_again(tmp_path: Path, writes: Writes) -> None:
    things = filled(tmp_path, count=4, resident=1)
    for number in (0, 1, 2, 0, 3, 1):
        assert things[number][0] == number
    assert writes == [f"{number:06d}.arrays" for number in range(4)]


def test_memory_is_given_back_now_and_then(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    released: list[int] = []
    monkeypatch.setattr(spill, "release_memory", released.append)
    filled(tmp_path, count=2 + 3 * spill.RELEASE_EVERY, resident=2)
    filled(None, count=2 + 3 * spill.RELEASE_EVERY, resident=2)
    assert released == [0, 0, 0]


class Step(NamedTuple):
    kind: str
    number: int
    value: int


STEPS = st.builds(
    Step,
    st.sampled_from(["set", "get", "pin", "mutate", "forget"]),
    st.integers(0, 5),
    st.integers(0, 1 << 60),
)


@settings(max_examples=50)
@given(st.lists(STEPS, max_size=40), st.integers(1, 4), st.integers(0, 12))
def test_it_holds_what_a_dictionary_holds_whenever_the_disk_fills(
    steps: list[Step], resident: int, room: int
) -> None:
    wanted: dict[int, int] = {}
    pinned: int | None = None
    written = 0

    def write(path: Path, arrays: Arrays, of: str) -> None:
        nonlocal written
        written += 1
        if written > room:
            raise OSError(28, "No space left on device")
        write_arrays(path, arrays, of)

    with TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr(spill, "write_arrays", write)
        things: Spill[Thing] = spill_of(Path(folder) / "work", resident)
        for kind, number, value in steps:
            if kind == "set":
                things[number], wanted[number] = np.array([value]), value
            elif kind == "mutate" and pinned is not None:
                things[pinned][0] = wanted[pinned] = value
            elif number in wanted and kind == "pin":
                things.pin(number)
                pinned = number
            elif number in wanted and kind == "forget" and number != pinned:
                del things[number], wanted[number]
            elif number in wanted and kind == "get":
                assert things[number][0] == wanted[number]
        assert {number: int(things[number][0]) for number in wanted} == wanted
        assert [number for number in range(6) if number in things] == sorted(wanted)


def test_what_is_forgotten_leaves_its_number_and_no_file(tmp_path: Path) -> None:
    things = filled(tmp_path / "work")
    for number in range(4):
        del things[number]
    things.save()
    assert files(tmp_path / "work") == ["000004.arrays", "let_go.txt"]
    assert spill_of(tmp_path / "work").removed_numbers() == {0, 1, 2}  # 3 was in memory alone
    with pytest.raises(KeyError):
        _ = things[0]


def test_the_pinned_one_may_be_changed_in_place_for_as_long_as_it_is_pinned(
    tmp_path: Path,
) -> None:
    things = filled(tmp_path)
    things.pin(0)
    pinned = things[0]
    for number in range(5, 30):
        things[number] = np.zeros(3, int)
    pinned[:] = 77
    assert things[0] is pinned
    things.pin(1)
    for number in range(5, 30):
        _ = things[number]
    assert things[0] is not pinned
    np.testing.assert_array_equal(things[0], 77)


# --- a disk that fails ----------------------------------------------------------------------------


def fill_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spill, "RESERVE_BYTES", 1 << 62)


def test_an_unwritable_folder_is_told_once_and_costs_nothing_but_memory(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_text("not a folder")
    with caplog.at_level(logging.WARNING):
        things = filled(tmp_path / "file" / "work", count=40)
    assert [int(things[number][0]) for number in range(40)] == list(range(40))
    (record,) = caplog.records
    assert str(tmp_path / "file" / "work") in record.getMessage()
    assert "Not a directory" in record.getMessage()
    things.close()


def test_room_is_left_for_what_the_dive_writes_at_its_end(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    things = filled(tmp_path, count=5, resident=2)
    fill_the_disk(monkeypatch)
    for number in range(5, 20):
        things[number] = np.full(3, number)
    assert len(files(tmp_path)) == 3
    (record,) = caplog.records
    assert "No space left on device" in record.getMessage()
    assert [int(things[number][0]) for number in range(20)] == list(range(20))


def test_on_a_full_disk_what_has_a_file_still_leaves_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    things = filled(tmp_path, count=30, resident=2)
    fill_the_disk(monkeypatch)
    for number in range(30):
        _ = things[number]
    assert things.resident_bytes <= 3 * 3 * 8  # two that could not be written, one that was read


def test_on_a_full_disk_the_pinned_one_may_still_be_changed_in_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    things = filled(tmp_path, count=5, resident=2)
    fill_the_disk(monkeypatch)
    things[5] = np.zeros(3, int)  # neither this one nor two before it can leave memory
    things.pin(0)
    things[0][:] = 77
    for number in range(1, 6):
        _ = things[number]
    np.testing.assert_array_equal(things[0], 77)


# --- the end --------------------------------------------------------------------------------------


def test_closing_removes_its_files_and_no_others(tmp_path: Path) -> None:
    things = filled(tmp_path / "work")
    (tmp_path / "work" / "notes.txt").write_text("somebody's")
    things.close()
    assert files(tmp_path / "work") == ["notes.txt"]


def test_closing_removes_a_folder_of_its_own(tmp_path: Path) -> None:
    things = filled(tmp_path / "work")
    del things[0]
    things.close()
    assert files(tmp_path) == []


def test_on_request_everything_is_kept_in_files(tmp_path: Path) -> None:
    things = filled(tmp_path)
    things.close(keep=True)
    assert files(tmp_path) == [f"{number:06d}.arrays" for number in range(5)]
    assert [int(read_item(tmp_path / name)["thing"][0]) for name in files(tmp_path)] == [
        0, 1, 2, 3, 4,
    ]  # fmt: skip
