"""CAN: frames as records, NMEA 2000 groups, and DBC files with a signal map."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aquaflow.base.errors import ConfigError
from aquaflow.config.instruments import DbcConfig, Nmea2000Config
from aquaflow.drivers.protocol.dbc import DbcDecoder
from aquaflow.drivers.protocol.nmea2000 import Nmea2000Decoder, group_of
from aquaflow.drivers.transport.can import EXTENDED, RECORD
from aquaflow.types import Altitude, Attitude, Depth, Position, UtcTime, Velocity
from tests.drivers.simulated_links import DBC, DBC_SIGNALS

NOW = 9_000_000_000
LINK = {"kind": "can", "channel": "can0"}
DVL_ID = 2566834709


def n2k(**settings) -> Nmea2000Decoder:
    return Nmea2000Decoder("bus", Nmea2000Config.model_validate({"link": LINK, **settings}))


def group(number: int, data: bytes, source: int = 35) -> bytes:
    return RECORD.pack(EXTENDED | 2 << 26 | number << 8 | source, len(data), data)


def euler_rad(attitude: Attitude) -> np.ndarray:
    return Rotation.from_quat(np.roll(attitude.wxyz, -1)).as_euler("ZYX")[::-1]


def test_published_water_depth_is_read():
    # can1.py and the nmea2000 library agree on this frame: 12.34 m.
    (altitude,) = n2k().feed(RECORD.pack(2314537763, 8, bytes.fromhex("ffd2040000000aff")), NOW)

    assert altitude == Altitude(NOW, NOW, "bus/128267", 12.34)


def test_group_numbers_leave_out_the_addressee():
    assert group_of(2 << 26 | 128267 << 8 | 35) == 128267
    assert group_of(6 << 26 | 59904 << 8 | 0xAB << 8 | 35) == 59904


def test_attitude_comes_as_yaw_pitch_roll():
    data = struct.pack("<B3hx", 0, 15000, -1000, 2500)

    (attitude,) = n2k().feed(group(127257, data), NOW)

    assert euler_rad(attitude) == pytest.approx([0.25, -0.1, 1.5])


def test_an_attitude_without_yaw_completes_the_heading():
    tilt = struct.pack("<B3hx", 0, 0x7FFF, -1000, 2500)
    heading = struct.pack("<BHhhB", 0, 15000, 0x7FFF, 0x7FFF, 0xFC)

    (attitude,) = n2k().feed(group(127257, tilt) + group(127250, heading), NOW)

    assert euler_rad(attitude) == pytest.approx([0.25, -0.1, 1.5])


@pytest.mark.parametrize(
    ("reference", "yaw"), [(0xFC, 1.5), (0xFD, 1.5 + 0.02 - 0.05)], ids=["true", "magnetic"]
)
def test_a_magnetic_heading_is_corrected(reference, yaw):
    data = struct.pack("<BHhhB", 0, 15000, 200, -500, reference)

    assert n2k().feed(group(127250, data), NOW) == []
    (attitude,) = n2k(assume={"level": True}).feed(group(127250, data), NOW)
    assert euler_rad(attitude)[2] == pytest.approx(yaw)


def test_rate_of_turn_and_speed_need_assumptions():
    rate = group(127251, struct.pack("<Bi3x", 0, round(0.1 / 3.125e-8)))
    speed = group(128259, struct.pack("<BHHBH", 0, 300, 150, 0, 0xFFFF))

    assert n2k().feed(rate + speed, NOW) == []
    assert len(n2k(assume={"level": True}).feed(rate + speed, NOW)) == 1
    turn, velocity = n2k(assume={"level": True, "no_side_slip": True}).feed(rate + speed, NOW)
    assert turn.rate_rad_s == pytest.approx((0, 0, 0.1))
    assert velocity.velocity_m_s == (1.5, 0, 0)


@pytest.mark.parametrize(
    ("number", "data"),
    [
        (128267, struct.pack("<BIhB", 0, 0xFFFF_FFFF, 0, 0)),
        (128267, struct.pack("<BIhB", 0, 0xFFFF_FFFE, 0, 0)),
        (127250, struct.pack("<BHhhB", 0, 0xFFFF, 0, 0, 0xFC)),
        (127250, struct.pack("<BHhhB", 0, 100, 0, 0, 0xFE)),
        (127251, struct.pack("<Bi3x", 0, 0x7FFF_FFFF)),
        (127257, struct.pack("<B3hx", 0, 0, 0x7FFF, 0)),
        (127257, b"\x00\x01"),
        (127250, b""),
        (126992, struct.pack("<BBHI", 0, 0, 0xFFFF, 0)),
        (126992, struct.pack("<BBHI", 0, 0, 0, 0)),
        (129025, bytes(8)),
        (129025, struct.pack("<ii", 910_000_000, 0)),
    ],
)
def test_values_that_are_not_available_are_counted(number, data):
    receiver = n2k(assume={"level": True})

    assert receiver.feed(group(number, data), NOW) == []
    assert receiver.counters.invalid_values == 1


def at(latitude: int) -> bytes:
    return group(129025, struct.pack("<ii", latitude, 1_748_000_000))


HERE = at(-412_500_000)


def dilution(modes: int, hdop: int) -> bytes:
    return group(129539, struct.pack("<BBhhh", 0, modes, hdop, 0, 0))


def test_a_position_is_as_accurate_as_the_dilution_says():
    receiver = n2k(position_lag_s=0.4)

    (usual,) = receiver.feed(at(1) + at(1), NOW)
    (fix,) = receiver.feed(dilution(0b010_010, 100) + HERE, NOW)
    (unstated,) = receiver.feed(dilution(0b010_010, 0x7FFF) + at(1), NOW)
    (later,) = receiver.feed(HERE, NOW + 6 * 10**9)

    assert isinstance(fix, Position)
    assert (fix.latitude_deg, fix.longitude_deg) == pytest.approx((-41.25, 174.8), abs=1e-9)
    assert (fix.t_ns, fix.arrival_ns, fix.source) == (NOW - 400_000_000, NOW, "bus/129025")
    assert fix.sigma_m == pytest.approx(5.1 / 2**0.5)
    assert usual.sigma_m == unstated.sigma_m == later.sigma_m == pytest.approx(2 * fix.sigma_m)


@pytest.mark.parametrize("mode", [0, 7])
def test_a_position_without_a_fix_is_none(mode):
    empty = group(129025, struct.pack("<ii", 0x7FFF_FFFF, 0x7FFF_FFFF))
    receiver = n2k()

    assert receiver.feed(dilution(mode << 3 | 2, 100) + HERE + empty, NOW) == []
    assert receiver.counters.invalid_values == 0


def test_system_time_is_utc_unless_only_a_crystal_keeps_it():
    # 2026-11-22 is day 20779 since 1970.
    clock = struct.pack("<HI", 20_779, 43_200_0000 + 5)
    satellites, crystal = (group(126992, bytes([0, source]) + clock) for source in (0xF0, 0xF5))

    (utc,) = n2k().feed(satellites + crystal, NOW)

    assert utc == UtcTime(NOW, NOW, "bus/126992", (1_795_348_800 * 10_000 + 5) * 100_000)


def test_other_groups_and_short_identifiers_are_counted():
    receiver = n2k()
    paddle_wheel = group(128259, struct.pack("<BHHBH", 0, 300, 0xFFFF, 0, 0xFFFF))

    assert receiver.feed(group(130306, bytes(8)) + RECORD.pack(0x123, 8, bytes(8)), NOW) == []
    assert receiver.feed(paddle_wheel, NOW) == []
    assert (receiver.counters.messages, receiver.counters.invalid_values) == (3, 0)


def test_records_are_found_again_behind_a_broken_one():
    good = group(128267, struct.pack("<BIhB", 0, 250, 0, 0xFF))
    receiver = n2k()

    assert len(receiver.feed(b"\xff" * 5 + good + good[:3] + good, NOW)) == 2
    assert receiver.counters.garbage_bytes == 5 + 3


def dbc(tmp_path, samples=DBC_SIGNALS, text=DBC) -> DbcDecoder:
    path = tmp_path / "rov.dbc"
    path.write_text(text)
    config = {"link": LINK, "database": str(path), "samples": samples}
    return DbcDecoder("bus", DbcConfig.model_validate(config))


def test_mapped_signals_become_samples_in_si(tmp_path):
    velocity_frame = RECORD.pack(DVL_ID, 8, struct.pack("<3h2x", 400, -100, 50))
    depth_frame = RECORD.pack(291, 4, struct.pack("<i", 12_345))

    velocity, depth = dbc(tmp_path).feed(velocity_frame + depth_frame, NOW)

    assert velocity == Velocity(NOW, NOW, "bus/Dvl", (0.4, -0.1, 0.05), 0.02)
    assert depth == Depth(NOW, NOW, "bus/Pressure", 12.345)


@pytest.mark.parametrize(
    ("sample", "count"),
    [
        ("attitude", 4), ("euler", 3), ("angular_rate", 3), ("acceleration", 3), ("altitude", 1),
        ("lights", 1), ("position", 2),
    ],
)  # fmt: skip
def test_every_kind_of_sample_can_be_mapped(tmp_path, sample, count):
    signals = "".join(f' SG_ S{k} : {16 * k}|16@1- (0.001,0) [-30|30] "" ROV\n' for k in range(4))
    text = f'VERSION ""\nNS_ :\nBS_:\nBU_: ROV\nBO_ 100 All: 8 ROV\n{signals}'
    mapping = {"message": "All", "sample": sample, "signals": [f"S{k}" for k in range(count)]}

    (made,) = dbc(tmp_path, [mapping], text).feed(
        RECORD.pack(100, 8, struct.pack("<4h", 500, 0, 0, 0)), NOW
    )

    told = next(
        value for key, value in vars(made).items() if key not in ("t_ns", "arrival_ns", "source")
    )
    expected = {
        "attitude": (1, 0, 0, 0),
        "euler": (math.cos(0.25), math.sin(0.25), 0, 0),
        "altitude": 0.5,
        "lights": 0.5,
        "position": 0.5,
    }.get(sample, (0.5, 0, 0))
    assert told == pytest.approx(expected)


def test_signs_and_axes_are_the_scales_business(tmp_path):
    turned = [{**DBC_SIGNALS[0], "signals": ["Vy", "Vx", "Vz"], "scale": [1, 1, -1]}]
    frame = RECORD.pack(DVL_ID, 8, struct.pack("<3h2x", 400, -100, 50))

    (velocity,) = dbc(tmp_path, turned).feed(frame, NOW)

    assert velocity.velocity_m_s == pytest.approx((-0.1, 0.4, -0.05))


def test_a_frame_that_is_too_short_is_counted(tmp_path):
    receiver = dbc(tmp_path)

    assert receiver.feed(RECORD.pack(291, 2, b"\x01\x02"), NOW) == []
    assert receiver.counters.invalid_values == 1


def test_signals_that_are_multiplexed_away_make_no_sample(tmp_path):
    text = (
        'VERSION ""\nNS_ :\nBS_:\nBU_: ROV\nBO_ 100 Mux: 8 ROV\n'
        ' SG_ Page M : 0|8@1+ (1,0) [0|1] "" ROV\n'
        ' SG_ Depth m1 : 8|16@1+ (0.01,0) [0|600] "m" ROV\n'
        ' SG_ Heat m0 : 8|16@1+ (0.01,0) [0|600] "C" ROV\n'
    )
    receiver = dbc(tmp_path, [{"message": "Mux", "sample": "depth", "signals": ["Depth"]}], text)
    pages = [RECORD.pack(100, 8, struct.pack("<BH5x", page, 250)) for page in (0, 1)]

    assert [s.depth_m for s in receiver.feed(b"".join(pages), NOW)] == [2.5]
    assert receiver.counters.invalid_values == 0


@pytest.mark.parametrize(
    ("mapping", "sentence"),
    [
        ({"message": "Dlv", "sample": "depth", "signals": ["Vx"]}, "no message 'Dlv'"),
        ({"message": "Dvl", "sample": "depth", "signals": ["V"]}, "no signal 'V'.*Vx, Vy, Vz"),
    ],
)
def test_a_map_that_does_not_fit_the_file_is_refused(tmp_path, mapping, sentence):
    with pytest.raises(ConfigError, match=sentence):
        dbc(tmp_path, [mapping])


@pytest.mark.parametrize("text", ["BO_ 1 Dvl", "\x00\xff"])
def test_a_file_that_is_no_dbc_is_refused(tmp_path, text):
    with pytest.raises(ConfigError, match=r"cannot read the DBC file .*rov\.dbc"):
        dbc(tmp_path, text=text)


def test_a_missing_file_is_refused(tmp_path):
    config = {"link": LINK, "database": str(tmp_path / "no.dbc"), "samples": DBC_SIGNALS}
    with pytest.raises(ConfigError, match=r"no\.dbc"):
        DbcDecoder("bus", DbcConfig.model_validate(config))
