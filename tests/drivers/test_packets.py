"""Packets in a stream: however it is cut, whatever lies between them."""

from __future__ import annotations

import pytest

from aquaflow.drivers.link import LinkCounters
from aquaflow.drivers.protocol.nmea import framing
from aquaflow.drivers.protocol.packets import PacketReader
from aquaflow.drivers.telemetry import decoder_of
from aquaflow.drivers.transport.can import pack
from aquaflow.sim_drivers.devices.nmea_talker import sentence
from tests.drivers.simulated_links import RIGS, STEPS, motion, telemetry_config

A, B = sentence("IIHDT,271.3,T"), sentence("SDDBT,9.8,f,3.0,M,1.6,F")
PROTOCOLS = [name for name in RIGS if name not in ("mavlink_udp", "nmea2000_multicast")]


def reader() -> PacketReader:
    return PacketReader(framing(require_checksum=True), LinkCounters())


def stream_of(rig) -> bytes:
    """All that the device says of a motion, as the driver's link delivers it."""
    said = [packet for sample in motion() for packet in rig.protocol.encode(sample, 10**9, 10**9)]
    return b"".join(p if isinstance(p, bytes) else b"".join(pack(p)) for p in said)


@pytest.mark.parametrize("name", PROTOCOLS)
def test_the_cut_of_the_stream_does_not_matter(name, tmp_path):
    rig = RIGS[name](tmp_path)
    config = telemetry_config(rig).devices["device"]
    stream = stream_of(rig)
    rig.wire.close()
    whole, bytewise = decoder_of("device", config), decoder_of("device", config)

    expected = whole.feed(stream, 7)
    told = [sample for byte in stream for sample in bytewise.feed(bytes([byte]), 7)]

    assert told == expected
    assert len(told) >= STEPS
    assert whole.counters == bytewise.counters
    assert whole.reader.pending == 0


@pytest.mark.parametrize("name", PROTOCOLS)
def test_garbage_between_packets_costs_no_packet(name, tmp_path):
    rig = RIGS[name](tmp_path)
    config = telemetry_config(rig).devices["device"]
    stream = stream_of(rig)
    rig.wire.close()
    clean, dirty = decoder_of("device", config), decoder_of("device", config)
    garbage = b"\n\xff\xff\xff\xff half a pack\r\n"

    expected = clean.feed(stream * 3, 7)

    assert [s for _ in range(3) for s in dirty.feed(garbage + stream, 7)] == expected
    assert dirty.counters.messages == clean.counters.messages
    assert dirty.counters.garbage_bytes >= 3 * len(garbage.strip(b"\r\n")) - 3


def test_a_damaged_packet_is_counted_once_and_costs_only_itself():
    packets = reader()

    assert packets.feed(A + A.replace(b"271", b"272") + B) == [A[:-1], B[:-1]]
    assert packets.counters.bad_checksums == 1
    assert packets.counters.garbage_bytes == len(A) - 2
    assert packets.counters.messages == 2


def test_the_start_of_a_packet_whose_end_was_lost_costs_only_itself():
    packets = reader()

    assert packets.feed(A[:9] + B) == [B[:-1]]
    assert packets.counters.bad_checksums == 1


def test_a_line_that_never_ends_is_given_up():
    packets = reader()

    packets.feed(b"$" + b"A" * 100_000)

    assert packets.pending == 0
    assert packets.counters.garbage_bytes == 100_001
    assert packets.feed(A) == [A[:-1]]


def test_the_half_packet_of_a_lost_link_is_forgotten():
    packets = reader()

    packets.feed(A[:9])
    packets.reset()

    assert packets.counters.garbage_bytes == 9
    assert packets.feed(A) == [A[:-1]]
    assert packets.counters.bad_checksums == 0
