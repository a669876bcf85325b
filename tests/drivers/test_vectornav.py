"""VectorNav: thousands of messages of any groups and fields, and published examples."""

from __future__ import annotations

import math
import random
import struct
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aquaflow.config.instruments import VectorNavConfig
from aquaflow.drivers.protocol.vectornav import VectorNavDecoder
from aquaflow.sim_drivers.devices.vectornav import binary, line
from aquaflow.types import Acceleration, AngularRate, Attitude, Position, UtcTime

COUNT = 3000
NOW = 60_000_000_000
LINK = {"kind": "serial", "port": "/dev/null"}
SIZES = {
    1: "8 8 8 12 16 12 24 12 12 24 20 28 2 4 8",
    2: "8 8 8 2 8 8 8 4 4 1 1",
    3: "2 12 12 12 4 4 16 12 12 12 12 2 40",
    4: "8 8 2 1 1 24 24 12 12 12 4 4 2 28",
    5: "2 12 16 36 12 12 12 12 12 12 28 24",
    6: "2 24 24 12 12 12 12 12 12 4 4 68 64",
    7: "8 8 2 1 1 24 24 12 12 12 4 4 2 28",
}
"""Bytes of each field: UM001, page 39."""
PUBLISHED = "FA 01 08 00 93 50 2E 42 83 3E F1 3F 48 B5 04 BB 92 88"
"""UM001, page 39: yaw, pitch and roll."""


def instrument(**settings: Any) -> VectorNavDecoder:
    return VectorNavDecoder("vn", VectorNavConfig.model_validate({"link": LINK, **settings}))


def degrees(sample: Any) -> list[float]:
    turned = Rotation.from_quat(np.roll(sample.wxyz, -1))
    return [float(angle) for angle in turned.as_euler("ZYX", degrees=True)]


def test_the_published_message_is_read() -> None:
    receiver = instrument()
    [sample] = receiver.feed(bytes.fromhex(PUBLISHED), NOW)
    assert degrees(sample) == pytest.approx([43.578686, 1.8847202, -2.0249654e-3], rel=1e-6)
    assert receiver.counters.garbage_bytes == 0


class Drawn:
    """A message of random groups and fields, and the samples that it makes."""

    def __init__(self, draw: random.Random) -> None:
        self.draw = draw
        self.groups: dict[int, dict[int, bytes]] = {}
        for group in draw.sample(range(1, 8), k=draw.randint(1, 4)):
            sizes = [int(size) for size in SIZES[group].split()]
            bits = draw.sample(range(len(sizes)), k=draw.randint(1, len(sizes)))
            self.groups[group] = {bit: draw.randbytes(sizes[bit]) for bit in bits}
        self.expected = [*self._attitude(), *self._sensors(), *self._place(), *self._utc()]

    def _singles(self, count: int, most: float) -> list[float]:
        return [float(np.float32(self.draw.uniform(-most, most))) for _ in range(count)]

    def _put(self, group: int, bit: int, code: str, *values: Any) -> bool:
        """Fill a field that the message has."""
        if bit not in self.groups.get(group, {}):
            return False
        self.groups[group][bit] = struct.pack("<" + code, *values)
        return True

    def _attitude(self) -> list[tuple[type, Any]]:
        found: list[tuple[type, Any]] = []
        for group, bit in ((1, 3), (5, 1)):  # yaw, pitch, roll
            yaw, pitch, roll = self._singles(3, 80.0)
            if self._put(group, bit, "3f", yaw, pitch, roll):
                found.append((Attitude, (yaw, pitch, roll)))
        quaternions = []
        for group, bit in ((1, 4), (5, 2)):
            q = Rotation.from_euler("ZYX", self._singles(3, 80.0), degrees=True)
            if self._put(group, bit, "4f", *q.as_quat()):
                quaternions.append((Attitude, tuple(q.as_euler("ZYX", degrees=True))))
        return (quaternions or found)[:1]

    def _sensors(self) -> list[tuple[type, Any]]:
        force, rate = [], []
        for group, bit in ((1, 8), (3, 9), (3, 2)):
            values = self._singles(3, 30.0)
            force += [tuple(values)] if self._put(group, bit, "3f", *values) else []
        for group, bit in ((1, 5), (3, 10), (3, 3)):
            values = self._singles(3, 5.0)
            rate += [tuple(values)] if self._put(group, bit, "3f", *values) else []
        values = self._singles(6, 5.0)
        if self._put(1, 9, "6f", *values):
            force.append(tuple(values[:3]))
            rate.append(tuple(values[3:]))
        found: list[tuple[type, Any]] = [(Acceleration, each) for each in force[:1]]
        return found + [(AngularRate, each) for each in rate[:1]]

    def _place(self) -> list[tuple[type, Any]]:
        def here() -> tuple[float, float]:
            return self.draw.uniform(-89, 89), self.draw.uniform(-179, 179)

        usual = 2.0 * 5.1 / math.sqrt(2.0)
        sigmas = [abs(value) + 0.1 for value in self._singles(3, 4.0)]
        fix, status = self.draw.choice([0, 2, 3, 8]), self.draw.choice([0, 2, 4, 5, 6, 7])
        one = abs(self._singles(1, 5.0)[0])
        of_receiver, of_filter, common = here(), here(), here()
        has_fix = self._put(4, 4, "B", fix)
        has_sigmas = self._put(4, 9, "3f", *sigmas)
        one_put = self._put(6, 9, "f", one)
        stated = self._put(6, 0, "H", status) | self._put(1, 12, "H", status)
        places = []
        if self._put(6, 1, "3d", *of_filter, 0.0):
            places.append(of_filter)
        if self._put(1, 6, "3d", *common, 0.0):
            places.append(common)
        if self._put(4, 5, "3d", *of_receiver, 0.0):
            if has_fix and fix < 3:
                return []
            north, east = sigmas[:2]
            sigma = math.sqrt((north**2 + east**2) / 2) if has_sigmas else usual
            return [(Position, (*of_receiver, sigma))]
        if not places or (stated and status != 6):
            return []
        return [(Position, (*places[0], (one if one_put else 0.0) or usual))]

    def _utc(self) -> list[tuple[type, Any]]:
        at = self.draw.randrange(1_600_000_000, 1_900_000_000)
        date = np.datetime64(at, "s").astype(object)
        fields = (date.year - 2000, date.month, date.day, date.hour, date.minute, date.second)
        ms, status = self.draw.randrange(1000), self.draw.choice([7, 7, 3, 0])
        known = self._put(2, 9, "B", status) and status == 7
        if not (self._put(2, 6, "b5BH", *fields, ms) and known):
            return []
        return [(UtcTime, at * 10**9 + ms * 10**6)]


def value_of(sample: Any) -> Any:
    match sample:
        case Attitude():
            return degrees(sample)
        case Acceleration():
            return sample.acceleration_m_s2
        case AngularRate():
            return sample.rate_rad_s
        case Position():
            return (sample.latitude_deg, sample.longitude_deg, sample.sigma_m)
    return sample.utc_ns


def test_every_combination_of_groups_and_fields_means_what_was_encoded() -> None:
    draw, receiver = random.Random(1), instrument()
    mismatches, kinds = (
        0,
        dict.fromkeys((Attitude, Acceleration, AngularRate, Position, UtcTime), 0),
    )
    for _ in range(COUNT):
        message = Drawn(draw)
        samples = receiver.feed(binary(message.groups), NOW)
        found = [(type(sample), value_of(sample)) for sample in samples]
        alike = [kind for kind, _ in found] == [kind for kind, _ in message.expected] and all(
            np.allclose(a, b, rtol=1e-6, atol=1e-4 if kind is Attitude else 1e-9)
            for (kind, a), (_, b) in zip(found, message.expected, strict=True)
        )
        mismatches += not alike
        for kind, _ in found:
            kinds[kind] += 1
    assert mismatches == 0
    assert min(kinds.values()) > 100
    counters = receiver.counters
    assert (counters.messages, counters.bad_checksums, counters.garbage_bytes) == (COUNT, 0, 0)


def ascii_case(draw: random.Random) -> tuple[str, list[tuple[type, Any]]]:
    angles, force = [[round(draw.uniform(-80, 80), 3) for _ in range(3)] for _ in range(2)]
    rate = [round(draw.uniform(-4, 4), 6) for _ in range(3)]
    said = [",".join(f"{value:+010.6f}" for value in values) for values in (angles, force, rate)]
    magnetic = "+1.0640,-00.2531,+03.0614"
    lat, lon = round(draw.uniform(-89, 89), 8), round(draw.uniform(-179, 179), 8)
    status, sigma = draw.choice([0x6, 0x2, 0x4, 0x106]), round(draw.uniform(0.5, 9.0), 1)
    place = [(Position, (lat, lon, sigma))] if status & 7 == 6 else []
    full = [(Attitude, angles), (Acceleration, force), (AngularRate, rate)]
    ins = (
        f"VNINS,333811.902862,1694,{status:04X},{said[0]},{lat:+.8f},{lon:+.8f},+00171.195,"
        f"-000.840,-000.396,-000.109,07.8,{sigma},0.23"
    )
    cases: list[tuple[str, list[tuple[type, Any]]]] = [
        (f"VNYPR,{said[0]}", full[:1]),
        (f"VNYMR,{said[0]},{magnetic},{said[1]},{said[2]}", full),
        (f"VNYMR,{said[0]},{magnetic},{said[1]},{said[2]},T17,S03", full),
        (f"VNACC,{said[1]}", full[1:2]),
        (f"VNGYR,{said[2]}", full[2:]),
        (f"VNIMU,{magnetic},{said[1]},{said[2]},+21.5,+101.3", full[1:]),
        (f"VNISL,{said[0]},{lat},{lon},1,0,0,0,{said[1]},{said[2]}", full),
        (ins, [*full[:1], *place]),
        ("VNMAG,+1.0,+2.0,+3.0", []),
    ]
    return draw.choice(cases)


def test_every_ascii_message_means_what_was_encoded() -> None:
    draw, receiver, mismatches = random.Random(2), instrument(), 0
    for _ in range(COUNT):
        body, expected = ascii_case(draw)
        samples = receiver.feed(line(body, wide=draw.random() < 0.5), NOW)
        found = [(type(sample), value_of(sample)) for sample in samples]
        mismatches += [kind for kind, _ in found] != [kind for kind, _ in expected] or any(
            not np.allclose(a, b, rtol=1e-9, atol=1e-9)
            for (_, a), (_, b) in zip(found, expected, strict=True)
        )
    assert mismatches == 0
    counters = receiver.counters
    assert (counters.messages, counters.bad_checksums, counters.garbage_bytes) == (COUNT, 0, 0)


def test_a_quaternion_in_ascii_has_its_scalar_last() -> None:
    [sample] = instrument().feed(line("VNQTN,+0.1,+0.2,+0.3,+0.927362"), NOW)
    assert isinstance(sample, Attitude)
    assert sample.wxyz == pytest.approx((0.927362, 0.1, 0.2, 0.3), abs=1e-6)


@pytest.mark.parametrize(
    "groups",
    [b"\x00\x01\x00", b"\x81\x01\x01\x00", b"\x01\x00\x80", b"\x08\x00\x40", b"\x02\x00\x08"],
    ids=["none", "more groups", "more fields", "satellites", "no such field"],
)
def test_fields_of_unknown_length_cost_their_message_only(groups: bytes) -> None:
    receiver = instrument()
    good = bytes.fromhex(PUBLISHED)
    assert len(receiver.feed(b"\xfa" + groups + bytes(40) + good, NOW)) == 1
    assert receiver.counters.messages == 1


def test_a_message_is_stamped_by_the_instruments_own_clock() -> None:
    receiver = instrument()
    late = []
    for k in range(40):
        measured_ns = 10**9 + k * 50_000_000
        arrival_ns = NOW + k * 50_000_000 + (1_000_000 if k % 3 else 20_000_000)
        data = binary({1: {0: struct.pack("<Q", measured_ns), 3: struct.pack("<3f", 1, 2, 3)}})
        [sample] = receiver.feed(data, arrival_ns)
        late.append(sample.t_ns - (NOW + k * 50_000_000))
    assert all(0 <= each <= 3_000_000 for each in late[5:])
