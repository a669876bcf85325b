"""MAVLink: units, whose messages count, and clocks."""

from __future__ import annotations

from collections import Counter
from importlib import import_module

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aquaflow.config.telemetry import MavlinkConfig
from aquaflow.drivers.protocol.mavlink import MavlinkDecoder
from aquaflow.drivers.protocol.mavlink_frames import MavlinkFraming
from aquaflow.types import (
    Acceleration,
    Altitude,
    AngularRate,
    Attitude,
    Depth,
    Lights,
    Position,
    UtcTime,
    Velocity,
)

DIALECT = import_module("pymavlink.dialects.v20.ardupilotmega")
G = 9.80665
NOW = 50_000_000_000
LINK = {"kind": "udp", "port": 14550}


def decoder(**settings) -> MavlinkDecoder:
    return MavlinkDecoder("rov", MavlinkConfig.model_validate({"link": LINK, **settings}))


def packet(name: str, *, system: int = 1, component: int = 1, version: int = 2, **fields) -> bytes:
    wire = DIALECT.MAVLink(None, srcSystem=system, srcComponent=component)
    message = getattr(DIALECT, f"MAVLink_{name}_message")(**fields)
    return bytes(message.pack(wire, force_mavlink1=version == 1))


def unpacked(data: bytes) -> list:
    return DIALECT.MAVLink(None).parse_buffer(data) or []


ATTITUDE = {"time_boot_ms": 900, "roll": 0.1, "pitch": -0.2, "yaw": 2.5, "rollspeed": 0.01,
            "pitchspeed": 0.02, "yawspeed": -0.03}  # fmt: skip


@pytest.mark.parametrize("version", [1, 2])
def test_attitude_is_the_bodys_in_ned_with_its_rates(version):
    attitude, rate = decoder().feed(packet("attitude", version=version, **ATTITUDE), NOW)

    expected = Rotation.from_euler("ZYX", [2.5, -0.2, 0.1]).as_matrix()
    assert isinstance(attitude, Attitude)
    told = Rotation.from_quat(np.roll(attitude.wxyz, -1)).as_matrix()
    np.testing.assert_allclose(told, expected, atol=1e-6)
    assert isinstance(rate, AngularRate)
    assert rate.rate_rad_s == pytest.approx((0.01, 0.02, -0.03))
    assert (attitude.source, attitude.t_ns, attitude.arrival_ns) == ("rov/ATTITUDE", NOW, NOW)


def test_a_quaternion_is_normalised_and_a_zero_one_is_no_attitude():
    settings = {"messages": ["ATTITUDE_QUATERNION"]}
    fields = {"time_boot_ms": 1, "rollspeed": 0, "pitchspeed": 0, "yawspeed": 0}
    receiver = decoder(**settings)

    attitude, _ = receiver.feed(
        packet("attitude_quaternion", q1=2, q2=0, q3=0, q4=2, **fields), NOW
    )
    nothing = receiver.feed(packet("attitude_quaternion", q1=0, q2=0, q3=0, q4=0, **fields), NOW)

    assert attitude.wxyz == pytest.approx((0.5**0.5, 0, 0, 0.5**0.5))
    assert nothing == []
    assert receiver.counters.invalid_values == 1


def test_depth_is_the_pressure_of_the_water_over_the_surfaces():
    pressure = {"time_boot_ms": 1, "press_diff": 0, "temperature": 1200}
    hull = packet("scaled_pressure", press_abs=1500, **pressure)
    water = packet("scaled_pressure2", press_abs=1010 + 997 * G * 7 / 100, **pressure)
    fresh = {"water_density_kg_m3": 997, "surface_pressure_pa": 101_000}

    (depth,) = decoder(**fresh).feed(hull + water, NOW)
    (swapped,) = decoder(**fresh, external_pressure="SCALED_PRESSURE").feed(hull + water, NOW)

    assert isinstance(depth, Depth)
    assert depth.depth_m == pytest.approx(7.0, abs=1e-4)
    assert swapped.depth_m == pytest.approx(49_000 / (997 * G), abs=1e-4)
    assert decoder(external_pressure=None).feed(hull + water, NOW) == []


IMU = {"xgyro": 10, "ygyro": -20, "zgyro": 30, "xmag": 0, "ymag": 0, "zmag": 0}


def test_milli_g_and_milli_radians_become_si():
    data = packet("raw_imu", time_usec=1, xacc=0, yacc=100, zacc=-1000, **IMU)

    acceleration, rate = decoder().feed(data, NOW)

    assert isinstance(acceleration, Acceleration)
    assert acceleration.acceleration_m_s2 == pytest.approx((0, 0.1 * G, -G))
    assert rate.rate_rad_s == pytest.approx((0.01, -0.02, 0.03))


def test_an_imu_of_zeros_is_not_there():
    zeros = dict.fromkeys(["xacc", "yacc", "zacc", *IMU], 0)
    receiver = decoder(messages=["SCALED_IMU2"])

    assert receiver.feed(packet("scaled_imu2", time_boot_ms=1, **zeros), NOW) == []
    assert receiver.counters.invalid_values == 0


def test_highres_imu_tells_only_the_fields_that_it_updated():
    rest = {"xmag": 0, "ymag": 0, "zmag": 0, "abs_pressure": 0, "diff_pressure": 0,
            "pressure_alt": 0, "temperature": 0}  # fmt: skip
    fields = {"xacc": 1, "yacc": 2, "zacc": -9, "xgyro": 0.1, "ygyro": 0.2, "zgyro": 0.3, **rest}
    gyro_only = packet("highres_imu", time_usec=1, fields_updated=0x38, **fields)
    both = packet("highres_imu", time_usec=2, fields_updated=0x3F, **fields)

    assert [type(s) for s in decoder().feed(gyro_only, NOW)] == [AngularRate]
    acceleration, _ = decoder().feed(both, NOW)
    assert acceleration.acceleration_m_s2 == pytest.approx((1, 2, -9))


def test_local_velocity_is_turned_into_the_body_by_the_last_attitude():
    local = packet("local_position_ned", time_boot_ms=901, x=0, y=0, z=4, vx=0, vy=0.5, vz=0.1)
    east = packet("attitude", **{**ATTITUDE, "roll": 0, "pitch": 0, "yaw": np.pi / 2})
    receiver = decoder(messages=["ATTITUDE", "LOCAL_POSITION_NED"], local_velocity_sigma_m_s=0.3)

    (depth,) = receiver.feed(local, NOW)
    *_, velocity = receiver.feed(east + local, NOW)

    assert depth.depth_m == 4
    assert isinstance(velocity, Velocity)
    assert velocity.velocity_m_s == pytest.approx((0.5, 0, 0.1), abs=1e-6)
    assert velocity.figure_of_merit_m_s == 0.3


def test_altitude_on_the_hud_is_negative_depth():
    hud = packet("vfr_hud", airspeed=0, groundspeed=0, heading=0, throttle=0, alt=-3.5, climb=0)

    (depth,) = decoder(messages=["VFR_HUD"]).feed(hud, NOW)

    assert depth.depth_m == 3.5


RANGE = {"time_boot_ms": 1, "min_distance": 30, "max_distance": 5000, "type": 1, "id": 0,
         "covariance": 255}  # fmt: skip


def test_only_a_range_finder_that_looks_down_tells_the_altitude():
    down = packet("distance_sensor", current_distance=250, orientation=25, **RANGE)
    ahead = packet("distance_sensor", current_distance=250, orientation=0, **RANGE)

    (altitude,) = decoder().feed(down + ahead, NOW)

    assert isinstance(altitude, Altitude)
    assert altitude.altitude_m == 2.5


@pytest.mark.parametrize("fields", [{"current_distance": 5001}, {"signal_quality": 1}])
def test_a_range_that_saw_no_bottom_is_invalid(fields):
    receiver = decoder()
    fields = {"current_distance": 250, **fields}

    assert receiver.feed(packet("distance_sensor", orientation=25, **RANGE, **fields), NOW) == []
    assert receiver.counters.invalid_values == 1


FIX = {"fix_type": 3, "lat": -412_500_000, "lon": 1_748_000_000, "alt": 0, "eph": 160, "epv": 65535,
       "vel": 0, "cog": 0, "satellites_visible": 9}  # fmt: skip
FIX_2 = {**FIX, "dgps_numch": 0, "dgps_age": 0}


def test_a_receivers_fix_is_as_accurate_as_it_says_or_as_its_dilution():
    receiver = decoder()

    fix, by_hdop, unknown = receiver.feed(
        packet("gps_raw_int", time_usec=0, h_acc=700, **FIX)
        + packet("gps_raw_int", time_usec=0, **{**FIX, "lat": 1})
        + packet("gps_raw_int", time_usec=0, **{**FIX, "lat": 2, "eph": 65535}),
        NOW,
    )
    (known,) = decoder(position_sigma_m=0.3).feed(packet("gps_raw_int", time_usec=0, **FIX), NOW)

    assert isinstance(fix, Position)
    assert (fix.latitude_deg, fix.longitude_deg) == pytest.approx((-41.25, 174.8), abs=1e-9)
    assert (fix.t_ns, fix.arrival_ns, fix.source) == (NOW, NOW, "rov/GPS_RAW_INT")
    assert fix.sigma_m == 0.7
    assert by_hdop.sigma_m == pytest.approx(1.6 * 5.1 / 2**0.5)
    assert unknown.sigma_m == pytest.approx(2.0 * 5.1 / 2**0.5)
    assert known.sigma_m == 0.3


@pytest.mark.parametrize("fix_type", [0, 1, 2])
def test_a_receiver_without_a_fix_gives_nothing_and_is_not_at_fault(fix_type):
    receiver = decoder()
    data = packet("gps_raw_int", time_usec=0, **{**FIX, "fix_type": fix_type})

    assert receiver.feed(data, NOW) == []
    assert receiver.counters.invalid_values == 0


@pytest.mark.parametrize("place", [{"lat": 0, "lon": 0}, {"lat": 910_000_000}])
def test_a_fix_that_is_nowhere_is_invalid(place):
    receiver = decoder()

    assert receiver.feed(packet("gps_raw_int", time_usec=0, **{**FIX, **place}), NOW) == []
    assert receiver.counters.invalid_values == 1


def test_a_fix_that_is_sent_again_is_the_same_fix():
    receiver = decoder(messages=["GPS_RAW_INT", "GPS2_RAW"])
    first, moved, stuck = (
        packet("gps_raw_int", time_usec=us, **{**FIX, "lat": lat})
        for us, lat in ((5_000_000, 1), (5_200_000, 2), (5_400_000, 2))
    )
    again = packet("gps_raw_int", time_usec=5_200_000, **{**FIX, "lat": 3})
    other = packet("gps2_raw", time_usec=5_000_000, **{**FIX_2, "lat": 1})

    heard = receiver.feed(first + first + other + moved + stuck + again, NOW)

    assert [(s.source, round(1e7 * s.latitude_deg)) for s in heard] == [
        ("rov/GPS_RAW_INT", 1),
        ("rov/GPS2_RAW", 1),
        ("rov/GPS_RAW_INT", 2),
        ("rov/GPS_RAW_INT", 3),
    ]
    assert receiver.counters.invalid_values == 0


def test_a_fix_is_as_old_as_it_says_and_by_the_stated_lag_older():
    boot_ns = 7_000_000_000
    receiver = decoder(position_lag_s=0.4)
    for k in range(30):
        attitude = {**ATTITUDE, "time_boot_ms": (NOW - boot_ns) // 10**6 + 100 * k}
        receiver.feed(packet("attitude", **attitude), NOW + k * 10**8)
    now = NOW + 30 * 10**8
    fixed_us = (now - boot_ns) // 1000 - 900_000

    (fix,) = receiver.feed(packet("gps_raw_int", time_usec=fixed_us, **FIX), now)
    before = receiver.clock.mapping.report()
    for k in range(1, 6):
        again = {**FIX, "lat": FIX["lat"] + k}
        receiver.feed(packet("gps_raw_int", time_usec=fixed_us + k, **again), now + k * 10**8)

    assert fix.t_ns == pytest.approx(now - 900_000_000 - 400_000_000, abs=1000)
    assert fix.arrival_ns == now
    assert receiver.clock.mapping.report() == before, "an old fix says nothing of the clock"


def test_a_fix_from_before_the_clock_is_known_is_dated_by_its_arrival():
    (fix,) = decoder().feed(packet("gps_raw_int", time_usec=5_000_000, **FIX), NOW)

    assert fix.t_ns == NOW


def test_a_fix_that_is_stamped_with_utc_gives_it():
    utc_us = 1_795_365_000_250_000
    data = packet("gps_raw_int", time_usec=utc_us, **FIX)

    fix, utc = decoder(position_lag_s=0.4).feed(data, NOW)

    assert isinstance(fix, Position)
    assert utc == UtcTime(NOW - 400_000_000, NOW, "rov/GPS_RAW_INT", 1000 * utc_us)


def test_the_filters_position_is_read_where_it_is_asked_for_and_not_dated_back():
    data = packet("global_position_int", time_boot_ms=0, lat=1, lon=2, alt=0, relative_alt=0, vx=0,
                  vy=0, vz=0, hdg=0)  # fmt: skip

    (position,) = decoder(messages=["GLOBAL_POSITION_INT"], position_lag_s=1).feed(data, NOW)

    assert decoder().feed(data, NOW) == []
    assert (position.latitude_deg, position.longitude_deg) == pytest.approx((1e-7, 2e-7))
    assert position.t_ns == NOW
    assert position.sigma_m == pytest.approx(2.0 * 5.1 / 2**0.5)


def test_system_time_is_utc_once_the_autopilot_knows_it():
    receiver = decoder()
    utc_us = 1_795_365_000_250_000
    data = [packet("system_time", time_unix_usec=us, time_boot_ms=9) for us in (0, utc_us, 9)]

    assert receiver.feed(data[0], NOW) == []
    assert receiver.counters.invalid_values == 0
    assert receiver.feed(data[1], NOW) == [UtcTime(NOW, NOW, "rov/SYSTEM_TIME", 1000 * utc_us)]
    assert receiver.feed(data[2], NOW) == []
    assert receiver.counters.invalid_values == 1, "1970"
    assert decoder(messages=["ATTITUDE"]).feed(data[1], NOW) == []


SERVOS = {"time_usec": 1, **{f"servo{k}_raw": 0 for k in range(1, 9)}}


def test_lights_are_the_pulse_width_of_their_channel():
    receiver = decoder(lights={"channel": 9})
    levels = [
        sample.level
        for pulse in (1100, 1300, 1900, 2100, 0)
        for sample in receiver.feed(
            packet("servo_output_raw", port=0, servo9_raw=pulse, **SERVOS), NOW
        )
    ]
    other_port = packet("servo_output_raw", port=1, servo9_raw=1900, **SERVOS)
    channels = {"time_boot_ms": 1, "chancount": 18, "rssi": 0}
    channels |= {f"chan{k}_raw": 1500 for k in range(1, 19)}
    remote = decoder(lights={"message": "RC_CHANNELS", "channel": 9})

    assert levels == pytest.approx([0, 0.25, 1, 1])
    assert receiver.feed(other_port, NOW) == []
    assert remote.feed(packet("rc_channels", **channels), NOW) == [
        Lights(NOW, NOW, "rov/RC_CHANNELS", 0.5)
    ]


def test_other_vehicles_and_ground_stations_are_counted_and_not_used():
    receiver = decoder(system_id=1)

    assert receiver.feed(packet("attitude", system=2, **ATTITUDE), NOW) == []
    assert receiver.feed(packet("attitude", component=190, **ATTITUDE), NOW) == []
    assert receiver.counters.messages == 2
    assert receiver.counters.invalid_values == 0


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
def test_impossible_values_are_counted_and_dropped(value):
    receiver = decoder(messages=["VFR_HUD", "ATTITUDE"])
    hud = packet("vfr_hud", airspeed=0, groundspeed=0, heading=0, throttle=0, alt=value, climb=0)

    assert receiver.feed(hud, NOW) == []
    assert receiver.counters.invalid_values == 1
    turning = {**ATTITUDE, "yaw": 1.0, "rollspeed": value}
    assert [type(s) for s in receiver.feed(packet("attitude", **turning), NOW)] == [Attitude]
    assert receiver.counters.invalid_values == 2


def test_a_flag_that_is_not_understood_hides_its_packet_alone():
    framing = MavlinkFraming(DIALECT)
    strange = bytearray(packet("attitude", **ATTITUDE))
    strange[2] |= 0x02
    receiver = decoder()

    assert framing.length(bytes(strange), 0) == 0
    assert len(receiver.feed(bytes(strange) + packet("attitude", **ATTITUDE), NOW)) == 2


def test_a_signed_packet_is_read():
    wire = DIALECT.MAVLink(None, srcSystem=1, srcComponent=1)
    wire.signing.secret_key = bytes(32)
    wire.signing.sign_outgoing = True
    data = bytes(DIALECT.MAVLink_attitude_message(**ATTITUDE).pack(wire))

    assert len(decoder().feed(data, NOW)) == 2


def test_a_timesync_request_is_answered_with_our_clock():
    receiver = decoder()
    receiver.feed(packet("timesync", tc1=0, ts1=1234), NOW)

    answers = [m for m in unpacked(receiver.outgoing(NOW + 5)) if m.get_type() == "TIMESYNC"]

    assert (answers[0].tc1, answers[0].ts1) == (NOW, 1234)


def test_a_flood_of_requests_is_answered_within_bounds():
    receiver = decoder()
    receiver.feed(packet("timesync", tc1=0, ts1=1234) * 10_000, NOW)

    assert len(receiver.outgoing(NOW)) < 2000


def test_round_trips_bound_the_device_clock():
    boot_ns = 7_000_000_000
    receiver = decoder()
    for second in range(3):
        sent = NOW + second * 10**9
        (request,) = [m for m in unpacked(receiver.outgoing(sent)) if m.get_type() == "TIMESYNC"]
        assert (request.tc1, request.ts1) == (0, sent)
        # 4 ms each way.
        device_ns = sent + 4_000_000 - boot_ns
        receiver.feed(packet("timesync", tc1=device_ns, ts1=sent), sent + 8_000_000)

    imu = {"xacc": 0, "yacc": 0, "zacc": -1000, **IMU}
    measured = NOW + 2 * 10**9 + 100_000_000
    late = packet("raw_imu", time_usec=(measured - boot_ns) // 1000, **imu)
    acceleration, _ = receiver.feed(late, measured + 15_000_000)

    assert abs(acceleration.t_ns - measured) < 100_000
    assert receiver.clock.mapping.report().round_trips


def test_answers_to_requests_that_were_never_sent_are_ignored():
    receiver = decoder()

    receiver.feed(packet("timesync", tc1=5, ts1=99), NOW)

    assert receiver.clock.mapping.report() is None


def test_a_link_that_shall_only_listen_says_nothing():
    receiver = decoder(talk=False)
    receiver.feed(packet("timesync", tc1=0, ts1=1), NOW)

    assert receiver.outgoing(NOW) == b""


def test_heartbeats_and_requests_go_out_once_a_second():
    receiver = decoder()
    sent = [receiver.outgoing(NOW + k * 10**8) for k in range(21)]

    kinds = Counter(message.get_type() for data in sent for message in unpacked(data))
    assert kinds == {"HEARTBEAT": 3, "TIMESYNC": 3}
