"""MAVLink: a real log, whole and damaged, against pymavlink's own reader."""

from __future__ import annotations

import random
import struct
from collections import Counter
from importlib import import_module

import pytest

from aquaflow.drivers.link import LinkCounters
from aquaflow.drivers.protocol.mavlink_frames import MavlinkFraming, header_of
from aquaflow.drivers.protocol.packets import PacketReader

DIALECT = import_module("pymavlink.dialects.v20.ardupilotmega")


def read_tlog(path) -> tuple[list[bytes], Counter]:
    """Packets, and how many of each message pymavlink's own reader finds."""
    mavutil = import_module("pymavlink.mavutil")
    log = mavutil.mavlink_connection(str(path))
    packets, kinds = [], Counter()
    while (message := log.recv_match()) is not None:
        if message.get_type() != "BAD_DATA":
            packets.append(bytes(message.get_msgbuf()))
            kinds[message.get_msgId()] += 1
    return packets, kinds


def packets_in(data: bytes) -> list[bytes]:
    receiver = PacketReader(MavlinkFraming(DIALECT), LinkCounters())
    return [p for at in range(0, len(data), 700) for p in receiver.feed(data[at : at + 700])]


@pytest.fixture(scope="module")
def tlog(shared_data):
    return read_tlog(shared_data / "vehicle_logs" / "ardusub_small.tlog")


def test_a_real_log_holds_what_pymavlinks_reader_finds(tlog, shared_data):
    _, kinds = tlog
    raw = (shared_data / "vehicle_logs" / "ardusub_small.tlog").read_bytes()

    found = Counter(header_of(p).message_id for p in packets_in(raw))

    assert found == kinds
    assert sum(found.values()) == 35_912


def test_one_percent_of_flipped_bytes_costs_only_the_packets_hit(tlog):
    packets, _ = tlog
    rng = random.Random(5)
    stream, untouched = bytearray(), []
    for k, original in enumerate(packets):
        damaged = bytearray(original)
        for at in range(len(damaged)):
            if rng.random() < 0.01:
                damaged[at] ^= rng.randrange(1, 256)
        stream += struct.pack(">I", k) + damaged
        if damaged == original:
            untouched.append(original)

    # A damaged length may reach beyond the last packet; on a live link more comes.
    found = Counter(packets_in(bytes(stream) + bytes(MavlinkFraming.longest)))

    assert 0.5 * len(packets) < len(untouched) < 0.9 * len(packets)
    assert not Counter(untouched) - found
    assert sum(found.values()) - len(untouched) <= 3  # 16 bits of checksum miss 1 in 65536
