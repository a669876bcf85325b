"""Pictures that simulated cameras send as H.264 are those that a decoder shows."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.recordings.h264 import decode_units, is_key
from aquaflow.sim_drivers.h264_writer import access_unit
from aquaflow.sim_drivers.rtp_camera import LARGEST, Packetizer


def picture(number: int, width: int = 64, height: int = 48) -> np.ndarray:
    ramp = np.linspace(0.0, 200.0, width)[None, :, None] * np.ones((height, 1, 3))
    return (ramp * [1.0, 0.5, 0.8] + number).astype(np.uint8)


def test_every_picture_is_a_key_frame_and_comes_back_as_it_was() -> None:
    pictures = [picture(number) for number in range(20)]
    coded = [(number, access_unit(image, number)) for number, image in enumerate(pictures)]
    assert all(is_key(unit) for _, unit in coded)
    decoded = list(decode_units(iter(coded)))
    assert [number for number, _ in decoded] == list(range(20))
    for (_, shown), image in zip(decoded, pictures, strict=True):
        assert shown is not None
        assert np.abs(shown.astype(int) - image).max() <= 4


def test_a_size_that_is_no_whole_number_of_blocks_is_refused() -> None:
    with pytest.raises(ValueError, match="64 x 50 px are no whole macroblocks"):
        access_unit(picture(0, height=50), 0)


def test_packets_are_numbered_marked_at_the_end_and_fit_into_ethernet() -> None:
    packetizer = Packetizer(payload_type=97)
    units = [b"\x67abc", b"\x68de", bytes([0x65]) + bytes(5000)]
    first, second = packetizer.packets(units, 10**9), packetizer.packets(units, 10**9 + 10**8)
    both = [*first, *second]
    assert [int.from_bytes(packet[2:4], "big") for packet in both] == list(range(len(both)))
    assert [packet[1] for packet in first] == [97] * (len(first) - 1) + [0x80 | 97]
    assert {int.from_bytes(packet[4:8], "big") for packet in second} == {99_000}
    assert max(len(packet) for packet in both) <= 12 + LARGEST
    fragments = first[1:]
    assert b"".join(packet[14:] for packet in fragments) == bytes(5000)
    assert [packet[13] >> 6 for packet in fragments] == [0b10, 0b00, 0b00, 0b01]
