"""Random and mutated bytes into every parser: no exception escapes, no buffer grows."""

from __future__ import annotations

import json
import random
import struct
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import can
import pytest

from aquaflow.drivers.link import LinkCounters
from aquaflow.drivers.protocol.packets import PacketDecoder
from aquaflow.drivers.samples import plausible
from aquaflow.drivers.telemetry import decoder_of
from aquaflow.drivers.transport.can import EXTENDED, RECORD, pack
from aquaflow.sim_drivers.devices.nmea_talker import sentence
from aquaflow.sim_drivers.devices.nucleus import packet as framed
from aquaflow.sim_drivers.devices.pd0 import ensemble
from aquaflow.sim_drivers.devices.ping import frame as ping_frame
from aquaflow.sim_drivers.devices.vectornav import binary as vectornav_binary
from aquaflow.sim_drivers.devices.vectornav import line as vectornav_line
from aquaflow.sim_drivers.devices.waterlinked import line
from tests.drivers.simulated_links import RIGS, motion, telemetry_config

DIALECT = import_module("pymavlink.dialects.v20.ardupilotmega")
PROTOCOLS = [name for name in RIGS if name not in ("mavlink_udp", "nmea2000_multicast")]
FIELD_LETTERS = "0123456789.-+eEnaif,;TMAFVyWNDPCHROL "

Rng = random.Random


def anything(rng: Rng) -> bytes:
    return rng.randbytes(rng.randrange(300))


def mutated(rng: Rng, packets: list[bytes]) -> bytes:
    """A few good packets with bytes changed, cut out, put in, or the end cut off."""
    data = bytearray(b"".join(rng.choices(packets, k=rng.randrange(1, 4))))
    for _ in range(rng.randrange(8)):
        at = rng.randrange(len(data) + 1)
        change = rng.randrange(4)
        if change == 0:
            data[at : at + 1] = rng.randbytes(1)
        elif change == 1:
            del data[at : at + rng.randrange(1, 9)]
        elif change == 2:
            data[at:at] = rng.randbytes(rng.randrange(9))
        elif rng.random() < 0.3:
            del data[at:]
    return bytes(data)


def text(rng: Rng) -> str:
    return "".join(rng.choices(FIELD_LETTERS, k=rng.randrange(60)))


USED = (2, 24, 27, 30, 32, 36, 105, 111, 132, 137)
"""Messages that the driver reads."""


def mavlink_packet(rng: Rng) -> bytes:
    """Any message with any payload of any length, and the right checksum."""
    number = rng.choice((*USED, rng.choice([*DIALECT.mavlink_map])))
    payload = rng.choice((bytes(40), b"\xff" * 40, rng.randbytes(255)))[: rng.randrange(256)]
    ids = bytes([rng.choice((1, 255)), rng.choice((1, 190))])
    if number < 256 and rng.random() < 0.3:
        header = bytes([len(payload), 0]) + ids + bytes([number])
        mark = b"\xfe"
    else:
        header = bytes([len(payload), 0, 0, 0]) + ids + number.to_bytes(3, "little")
        mark = b"\xfd"
    seed = bytes([DIALECT.mavlink_map[number].crc_extra])
    crc = DIALECT.x25crc(header + payload + seed).crc
    return mark + header + payload + crc.to_bytes(2, "little")


def nmea_packet(rng: Rng) -> bytes:
    kinds = (
        "SDDBT",
        "SDDPT",
        "SDDBS",
        "HEHDT",
        "HCHDG",
        "HEROT",
        "VDVBW",
        "PRDID",
        "PASHR",
        "YXXDR",
        "GPGGA",
        "GPRMC",
        "GPGST",
        "GPZDA",
        "",
    )
    return sentence(f"{rng.choice(kinds)},{text(rng)}")


def waterlinked_packet(rng: Rng) -> bytes:
    return line(f"{rng.choice(('wrz', 'wrx', 'wrp', 'wrs', 'w'))},{text(rng)}")


def json_value(rng: Rng, depth: int = 0) -> object:
    scalars: list[object] = [None, True, -1, 10**400, 1e308, float("nan"), "text", rng.random()]
    if depth > 2 or rng.random() < 0.7:
        return rng.choice(scalars)
    if rng.random() < 0.5:
        return [json_value(rng, depth + 1) for _ in range(rng.randrange(4))]
    return {str(k): json_value(rng, depth + 1) for k in range(rng.randrange(4))}


def json_packet(rng: Rng) -> bytes:
    keys = ("vx", "vy", "vz", "fom", "altitude", "velocity_valid", "time_of_validity",
            "time_of_transmission", "roll", "pitch", "yaw")  # fmt: skip
    report = {key: json_value(rng) for key in keys if rng.random() < 0.9}
    report["type"] = rng.choice(("velocity", "position_local", None, []))
    report["velocity_valid"] = rng.choice((True, False, report.get("velocity_valid")))
    return json.dumps(report).encode() + b"\n"


def pd0_packet(rng: Rng) -> bytes:
    parts = []
    for identifier in rng.sample((0x0000, 0x0080, 0x0600, 0x0100), k=rng.randrange(1, 5)):
        body = rng.choice((bytes(100), b"\xff" * 100, rng.randbytes(100)))[: rng.randrange(101)]
        parts.append(identifier.to_bytes(2, "little") + body)
    return ensemble(*parts)


def nucleus_packet(rng: Rng) -> bytes:
    number = rng.choice((0x82, 0x96, 0xAA, 0xB4, 0xD2, rng.randrange(256)))
    body = rng.choice((bytes(160), b"\xff" * 160, struct.pack("<40f", *[rng.uniform(-9, 9)] * 40)))
    return framed(
        number, rng.randrange(1 << 40), rng.choice((0x7FFF, rng.randrange(1 << 32))),
        bytes(rng.randrange(30)), body[: rng.randrange(161)],
    )  # fmt: skip


def ping_packet(rng: Rng) -> bytes:
    number = rng.choice((2, 1211, 1212, 1300, rng.randrange(1 << 16)))
    body = rng.choice((bytes(40), b"\xff" * 40, bytes([0, 9, 0, 0, 99, 0]) + rng.randbytes(300)))
    return ping_frame(number, body[: rng.randrange(len(body))])


def vectornav_packet(rng: Rng) -> bytes:
    """Any groups and fields of any length, with the right checksum."""
    if rng.random() < 0.3:
        kind = rng.choice(("VNYMR", "VNINS", "VNQTN", "VNISL", "VNIMU", "VNACC", "VNGYR", "VN"))
        return vectornav_line(f"{kind},{text(rng)}", rng.random() < 0.5)
    body = rng.choice((bytes(80), b"\xff" * 80, struct.pack("<20f", *[rng.uniform(-9, 9)] * 20)))
    groups = {
        group: {bit: body[: rng.choice((12, 24, 8, 2))] for bit in rng.sample(range(15), 3)}
        for group in rng.sample(range(1, 8), rng.randrange(1, 4))
    }
    fitting = {1: {8: body[:12], 5: body[12:24]}, 5: {1: body[:12]}}
    return vectornav_binary(rng.choice((groups, fitting)))


GROUPS = (126992, 127250, 127251, 127257, 128259, 128267, 129025, 129539)
"""Parameter groups that the driver reads."""


def can_packet(rng: Rng) -> bytes:
    group = rng.choice((*GROUPS, rng.randrange(1 << 18)))
    identifier = rng.choice((EXTENDED | 2 << 26 | group << 8 | 35, 2566834709, 291))
    data = rng.choice((b"\xff" * 8, rng.randbytes(8)))[: rng.randrange(9)]
    return RECORD.pack(identifier, len(data), data)


VALID: dict[str, Callable[[Rng], bytes]] = {
    "mavlink_pty": mavlink_packet,
    "nmea_pty": nmea_packet,
    "waterlinked_pty": waterlinked_packet,
    "waterlinked_tcp": json_packet,
    "pd0_pty": pd0_packet,
    "pd0_beams_pty": pd0_packet,
    "pd0_earth_pty": pd0_packet,
    "nucleus_pty": nucleus_packet,
    "ping_pty": ping_packet,
    "vectornav_pty": vectornav_packet,
    "vectornav_ascii_pty": vectornav_packet,
    "nmea2000_virtual": can_packet,
    "dbc_virtual": can_packet,
}


def parser_and_packets(name: str, folder: Path) -> tuple[PacketDecoder, list[bytes]]:
    rig = RIGS[name](folder)
    rig.wire.close()
    said = [packet for s in motion(10) for packet in rig.protocol.encode(s, 10**9, 10**9)]
    packets = [pack(p)[0] if isinstance(p, can.Message) else p for p in said]
    return decoder_of("device", telemetry_config(rig).devices["device"]), packets


def fuzz(name: str, folder: Path, count: int) -> LinkCounters:
    """Feed ``count`` byte strings; every sample that comes out is one that a vehicle can have."""
    decoder, packets = parser_and_packets(name, folder)
    rng = Rng(11)
    inputs = (
        lambda: anything(rng),
        lambda: mutated(rng, packets),
        lambda: VALID[name](rng),
        lambda: mutated(rng, [VALID[name](rng)]),
    )
    fed = 0
    for k in range(count):
        data = rng.choice(inputs)()
        fed += len(data)
        samples = decoder.feed(data, 10**9 + k * 10**6)
        assert all(plausible(sample) for sample in samples), data
        assert decoder.reader.pending < decoder.reader.framing.longest
        if hasattr(decoder, "outgoing"):
            assert len(decoder.outgoing(10**9 + k * 10**6)) < 2000
    assert decoder.counters.bytes == fed
    return decoder.counters


@pytest.mark.parametrize("name", PROTOCOLS)
def test_a_parser_survives_thousands_of_byte_strings(name, tmp_path):
    counters = fuzz(name, tmp_path, 3000)

    assert counters.messages > 1000
    assert counters.samples > 100
    assert counters.invalid_values > 10


@pytest.mark.slow
@pytest.mark.parametrize("name", PROTOCOLS)
def test_a_parser_survives_a_million_byte_strings(name, tmp_path):
    assert fuzz(name, tmp_path, 1_000_000).messages > 300_000


@pytest.mark.parametrize("name", PROTOCOLS)
@pytest.mark.parametrize("size", [1, 10, 20_000])
def test_a_flood_without_packets_leaves_nothing_behind(name, size, tmp_path):
    decoder, packets = parser_and_packets(name, tmp_path)
    start = packets[0][:1]

    for _ in range(3):
        decoder.feed((start * size)[:size], 1)
        decoder.feed(bytes(size), 1)
        decoder.feed(Rng(size).randbytes(size), 1)

    assert decoder.reader.pending < decoder.reader.framing.longest
    assert decoder.counters.messages <= 3 * size  # no frame of zeros may be more than itself
