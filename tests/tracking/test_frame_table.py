"""What is kept of every frame: it comes back as it was, and is small."""

from __future__ import annotations

import tracemalloc

import numpy as np

from aquaflow.dive.frames_csv import FrameRow, of_text, to_text
from aquaflow.geometry.camera import guess_camera
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.tracking.frame_table import CHUNK, FrameTable
from aquaflow.tracking.frames import FrameClass, Quality, Tracked
from aquaflow.types import Frame

CAMERA = guess_camera(64, 48)
PICTURE = np.zeros((48, 64, 3), np.uint8)


def tracked(index: int) -> tuple[Tracked, Sim3 | None]:
    """Every fifth frame is lost."""
    frame = Frame(index, index * 10**8, 0, PICTURE, CAMERA)
    if index % 5 == 4:
        return Tracked(frame, FrameClass.LOST, 1), None
    quality = Quality(0.1 * index, 0.5, 0.25, 3.0)
    T_kf = Sim3(so3_exp(np.array([0.1, 0.01 * index, 0.3])), np.array([1.0 / 3.0, index, 2.0]), 1.7)
    return Tracked(frame, FrameClass.COMMON, 1, index // 5, Sim3.identity(), quality), T_kf


def table_of(count: int) -> FrameTable:
    table = FrameTable()
    for index in range(count):
        table.add(*tracked(index))
    return table


def test_frames_come_back_bit_for_bit_without_their_pictures() -> None:
    for (found, pose), index in zip(table_of(12), range(12), strict=True):
        wanted, T_kf = tracked(index)
        assert found.frame.image.size == 0
        assert (found.frame.index, found.frame.t_ns) == (index, index * 10**8)
        assert (found.frame_class, found.sub_map) == (wanted.frame_class, wanted.sub_map)
        assert (found.keyframe, found.quality) == (wanted.keyframe, wanted.quality)
        assert (pose is None) == (T_kf is None)
        if pose is not None and T_kf is not None:
            assert np.array_equal(pose.matrix, T_kf.matrix)


def test_a_table_goes_on_from_its_rows() -> None:
    count = CHUNK + 7
    rows = table_of(count).rows()
    again = FrameTable.of_rows(rows, CAMERA)
    again.add(*tracked(count))
    assert len(again) == count + 1
    assert np.array_equal(again.rows(), table_of(count + 1).rows())


def test_the_parts_of_a_table_stay_as_they_were_when_it_grows() -> None:
    for count in (0, 3, CHUNK, CHUNK + 7):
        table = table_of(count)
        before, parts = table.rows(), table.parts()
        for index in range(count, count + 5):
            table.add(*tracked(index))
        assert np.array_equal(np.concatenate(parts), before)
        assert len(before) == count


def test_a_row_is_read_by_its_number() -> None:
    table = table_of(CHUNK + 7)
    for i in (0, 4, CHUNK, CHUNK + 6):
        found, pose = table[i]
        assert found.frame.index == i
        assert (pose is None) == (i % 5 == 4)


def test_an_empty_table_has_no_rows() -> None:
    assert len(FrameTable().rows()) == 0
    assert list(FrameTable.of_rows(FrameTable().rows(), CAMERA)) == []


def test_ten_thousand_frames_take_less_than_200_bytes_each() -> None:
    tracemalloc.start()
    table = table_of(10_000)
    size, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(table) == 10_000
    assert size < 200 * 10_000


def test_rows_of_frames_csv_come_back_from_their_lines() -> None:
    rows = [
        FrameRow(3, "dive, part 2.mp4#3", 0.3, "common", 0, 2, 0.512),
        FrameRow(4, "ä.png", 1.0 / 3.0, "lost", reason='blurred, and "dark"'),
    ]
    text = to_text(rows)
    assert to_text(of_text(text)) == text
    assert of_text(text)[0] == rows[0]
    assert of_text(text + "5,cut sho") == of_text(text)


def test_the_frames_of_a_keyframe_move_and_parts_handed_out_do_not() -> None:
    count = CHUNK + 7
    table, shift = table_of(count), Sim3(np.eye(3), np.array([0.0, 0.0, 1.0]))
    keyframe = CHUNK // 5
    parts = [part.copy() for part in table.parts()]
    handed_out = table.parts()
    table.move(keyframe, lambda T_kf: shift @ T_kf)
    for before, after in zip(parts, handed_out, strict=True):
        assert np.array_equal(before, after)
    for (found, pose), index in zip(table, range(count), strict=True):
        _, T_kf = tracked(index)
        if T_kf is not None:
            wanted = shift @ T_kf if found.keyframe == keyframe else T_kf
            assert pose is not None
            assert np.array_equal(pose.matrix, wanted.matrix)
