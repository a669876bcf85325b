"""Pictures out of RTP packets: complete with the last packet, and known to be whole or not."""

from __future__ import annotations

import struct
from itertools import chain, pairwise

import pytest

from aquaflow.drivers.stream.rtp_capture import Depacketizer, ReceivedPicture
from aquaflow.sim_drivers.rtp_camera import Packetizer

NS = 1_000_000_000
SMALL, LARGE = b"\x67abc", bytes([0x65]) + bytes(range(256)) * 20


def sent(count: int = 4, start_ns: int = 10 * NS) -> list[list[bytes]]:
    """The packets of ``count`` pictures, 40 ms apart, each with its number in it."""
    packetizer = Packetizer()
    return [
        packetizer.packets([SMALL, b"\x68%d" % n, LARGE], start_ns + n * NS // 25)
        for n in range(count)
    ]


def joined(pictures: list[list[bytes]]) -> list[bytes]:
    return list(chain.from_iterable(pictures))


def received(packets: list[bytes]) -> list[ReceivedPicture]:
    depacketizer = Depacketizer(96)
    return [
        picture for at, packet in enumerate(packets) for picture in depacketizer.add(packet, at)
    ]


def told(pictures: list[ReceivedPicture]) -> list[tuple[str, bool]]:
    """Which picture it is, and whether it is whole."""
    names = [next(unit[1:] for unit in each.units if unit[0] == 0x68) for each in pictures]
    return [(name.decode(), each.is_whole) for name, each in zip(names, pictures, strict=True)]


def test_a_picture_is_there_with_its_last_packet_in_the_units_that_were_sent() -> None:
    depacketizer = Depacketizer(96)
    for number, packets in enumerate(sent()):
        assert [depacketizer.add(packet, 100 * number) for packet in packets[:-1]] == [
            [] for _ in packets[:-1]
        ]
        (picture,) = depacketizer.add(packets[-1], 100 * number + 50)
        assert picture.units == [SMALL, b"\x68%d" % number, LARGE]
        assert picture.is_whole
        assert picture.stream_ns == number * NS // 25
        assert picture.arrival_ns == 100 * number


@pytest.mark.parametrize("missing", [1, 2, -2])
def test_a_missing_packet_costs_its_picture(missing: int) -> None:
    packets = sent()
    del packets[1][missing]
    assert told(received(joined(packets))) == [("0", True), ("1", False), ("2", True), ("3", True)]


def test_a_missing_last_packet_ends_the_picture_with_the_next_and_casts_doubt_on_both() -> None:
    packets = sent()
    del packets[1][-1]
    found = told(received(joined(packets)))
    assert found == [("0", True), ("1", False), ("2", False), ("3", True)]


def test_a_picture_of_which_nothing_came_costs_the_next() -> None:
    packets = sent()
    del packets[1]
    assert told(received(joined(packets))) == [("0", True), ("2", False), ("3", True)]


def test_packets_that_come_twice_or_late_are_passed_over() -> None:
    packets = joined(sent())
    twice = [packet for packet in packets for _ in range(2)]
    assert told(received(twice)) == [(str(n), True) for n in range(4)]
    packets[2], packets[3] = packets[3], packets[2]
    assert [is_whole for _, is_whole in told(received(packets))].count(False) == 1


def test_numbers_and_times_go_on_where_they_wrap() -> None:
    wrapping_ns = (2**32 - 4500) * NS // 90_000
    packetizer = Packetizer()
    packetizer._number = 65_534
    pictures = [
        packetizer.packets([SMALL, b"\x68%d" % n, LARGE], wrapping_ns + n * NS // 25)
        for n in range(4)
    ]
    found = received(joined(pictures))
    assert told(found) == [(str(n), True) for n in range(4)]
    steps = [after.stream_ns - before.stream_ns for before, after in pairwise(found)]
    assert steps == pytest.approx([NS // 25] * 3, abs=20_000)


def test_headers_with_extensions_sources_and_padding_are_read() -> None:
    head = struct.pack(">BBHII", 0x80 | 0x20 | 0x10 | 2, 0x80 | 96, 7, 90, 1)
    extension = struct.pack(">HH", 0xBEDE, 2) + bytes(8)
    packet = head + bytes(8) + extension + b"\x41slice" + b"\0\0\3"
    ((picture,), nothing) = (Depacketizer(96).add(each, 0) for each in (packet, packet[:12]))
    assert picture.units == [b"\x41slice"]
    assert nothing == []


@pytest.mark.parametrize("kind", [0, 25, 27, 30])
def test_units_of_other_modes_make_no_whole_picture(kind: int) -> None:
    head = struct.pack(">BBHII", 0x80, 96, 1, 90, 1)
    last = struct.pack(">BBHII", 0x80, 0x80 | 96, 2, 90, 1)
    (picture,) = received([head + bytes([kind]) + b"abc", last + b"\x41slice"])
    assert (picture.units, picture.is_whole) == ([b"\x41slice"], False)


def test_other_payload_types_are_passed_over() -> None:
    other = struct.pack(">BBHII", 0x80, 0x80 | 97, 1, 90, 1) + b"\x41slice"
    assert received([other]) == []
