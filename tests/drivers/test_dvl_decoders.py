"""Doppler velocity logs: published examples, signs, times, and what they call invalid."""

from __future__ import annotations

import json

import pytest

from aquaflow.config.instruments import Pd0Config, WaterLinkedJsonConfig, WaterLinkedSerialConfig
from aquaflow.drivers.protocol.pd0 import Pd0Decoder
from aquaflow.drivers.protocol.waterlinked_json import WaterLinkedJsonDecoder
from aquaflow.drivers.protocol.waterlinked_serial import WaterLinkedSerialDecoder, crc8
from aquaflow.sim_drivers.devices.pd0 import Pd0Dvl, ensemble
from aquaflow.sim_drivers.devices.waterlinked import line
from aquaflow.types import Altitude, Attitude, Velocity

NOW = 90_000_000_000
LINK = {"kind": "serial", "port": "/dev/null"}
COVARIANCE = "1e-07;0;1.4;0;1.2;0;0.2;0;1e+09"


def serial_dvl(**settings) -> WaterLinkedSerialDecoder:
    config = WaterLinkedSerialConfig.model_validate({"link": LINK, **settings})
    return WaterLinkedSerialDecoder("dvl", config)


def json_dvl(**settings) -> WaterLinkedJsonDecoder:
    config = WaterLinkedJsonConfig.model_validate({"link": LINK, **settings})
    return WaterLinkedJsonDecoder("dvl", config)


def pd0_dvl(**settings) -> Pd0Decoder:
    return Pd0Decoder("dvl", Pd0Config.model_validate({"link": LINK, **settings}))


def test_the_checksum_is_the_standard_crc_8():
    assert crc8(b"123456789") == 0xF4


def test_a_published_velocity_report_is_read():
    text = f"wrz,0.120,-0.400,2.000,y,1.30,1.855,{COVARIANCE},7,14,123.00,1*50\r\n"

    velocity, altitude = serial_dvl().feed(text.encode(), NOW)

    t_ns = NOW - 7_000
    assert velocity == Velocity(t_ns, NOW, "dvl/wrz", (0.12, -0.4, 2.0), 1.855)
    assert altitude == Altitude(t_ns, NOW, "dvl/wrz", 1.3)


def test_the_report_of_older_firmware_is_read():
    velocity, altitude = serial_dvl().feed(line("wrx,112.83,0.007,0.017,0.006,0.1,0.93,y,0"), NOW)

    assert velocity.velocity_m_s == (0.007, 0.017, 0.006)
    assert (velocity.figure_of_merit_m_s, altitude.altitude_m) == (0.1, 0.93)


def test_a_velocity_that_the_dvl_calls_invalid_is_counted_and_dropped():
    receiver = serial_dvl()
    no_lock = line(f"wrz,0,0,0,n,-1.00,1.855,{COVARIANCE},7,14,123.00,1")
    altitude_only = line(f"wrz,0,0,0,n,2.00,1.855,{COVARIANCE},7,14,123.00,1")

    assert receiver.feed(no_lock, NOW) == []
    assert [type(s) for s in receiver.feed(altitude_only, NOW)] == [Altitude]
    assert receiver.counters.invalid_values == 2


@pytest.mark.parametrize(("validity", "sent"), [(14, 7), (0, 10**12)])
def test_a_latency_that_cannot_be_is_not_believed(validity, sent):
    text = line(f"wrz,0.1,0,0,y,-1,0.01,{COVARIANCE},{validity},{sent},123.00,1")

    (velocity,) = serial_dvl().feed(text, NOW)

    assert velocity.t_ns == NOW


def test_the_attitude_of_dead_reckoning_is_used_only_if_asked_for():
    text = line("wrp,49056.809,0.41,0.15,1.23,0.4,53.9,14.0,13.1,0")

    assert serial_dvl().feed(text, NOW) == []
    assert [type(s) for s in serial_dvl(attitude=True).feed(text, NOW)] == [Attitude]


@pytest.mark.parametrize(
    "body", ["wrz,1,2,3,y", "wrz,x,2,3,y,1,1,0,1,2,3,0", "wrz,1e9,0,0,y,-1,1,0,1,2,3,0"]
)
def test_a_report_that_makes_no_sense_is_counted(body):
    receiver = serial_dvl()

    assert receiver.feed(line(body), NOW) == []
    assert receiver.counters.invalid_values == 1


def test_replies_to_commands_are_counted():
    receiver = serial_dvl()

    assert receiver.feed(line("wra") + line("wrv,2.5.0") + b"wrw,dvl-a50*00\r\n", NOW) == []
    assert (receiver.counters.messages, receiver.counters.bad_checksums) == (2, 1)


REPORT = {
    "type": "velocity", "vx": -0.1, "vy": 0.2, "vz": 0.3, "fom": 0.002, "altitude": 0.5,
    "velocity_valid": True, "time_of_validity": 1_000_000, "time_of_transmission": 1_012_000,
}  # fmt: skip


def encoded(**changes) -> bytes:
    return json.dumps({**REPORT, **changes}).encode() + b"\r\n"


def test_a_json_report_is_read_with_its_latency():
    velocity, altitude = json_dvl().feed(encoded(), NOW)

    t_ns = NOW - 12_000_000
    assert velocity == Velocity(t_ns, NOW, "dvl/velocity", (-0.1, 0.2, 0.3), 0.002)
    assert altitude == Altitude(t_ns, NOW, "dvl/velocity", 0.5)


def test_json_without_times_is_stamped_with_its_arrival():
    data = json.dumps({k: v for k, v in REPORT.items() if "time" not in k}).encode() + b"\n"

    assert [s.t_ns for s in json_dvl().feed(data, NOW)] == [NOW, NOW]


def test_json_attitude_is_used_only_if_asked_for():
    data = encoded(type="position_local", roll=1.0, pitch=2.0, yaw=3.0)

    assert json_dvl().feed(data, NOW) == []
    assert [type(s) for s in json_dvl(attitude=True).feed(data, NOW)] == [Attitude]


@pytest.mark.parametrize(
    "changes",
    [
        {"velocity_valid": False, "altitude": -1},
        {"vx": "fast", "altitude": -1},
        {"vx": None, "altitude": -1},
        {"vx": True, "altitude": -1},
        {"vx": 1e400, "altitude": -1},
        {"vx": 10**400, "altitude": -1},
        {"fom": -1, "altitude": -1},
    ],
)
def test_json_that_makes_no_sense_is_counted(changes):
    receiver = json_dvl()

    assert receiver.feed(encoded(**changes), NOW) == []
    assert receiver.counters.invalid_values == 1


@pytest.mark.parametrize("text", [b'{"a":', b"{" * 9000, b'{"a": 1}}', b"{]", b'{"\xff": 1}'])
def test_what_is_no_json_costs_only_its_line(text):
    receiver = json_dvl()

    assert len(receiver.feed(text + b"\r\n" + encoded(), NOW)) == 2
    assert receiver.counters.bad_checksums == 1


def said(**values) -> bytes:
    dvl = Pd0Dvl()
    dvl.encode(Altitude(0, 0, "log", values.get("altitude_m", 2.5)), 0, 0)
    (data,) = dvl.encode(Velocity(0, 0, "log", (0.4, 0.1, -0.05), 0.01), 0, 0)
    return data


def test_an_ensemble_tells_the_vehicles_velocity_and_altitude():
    velocity, altitude = pd0_dvl(sigma_m_s=0.02).feed(said(), NOW)

    assert velocity.velocity_m_s == pytest.approx((0.4, 0.1, -0.05))
    assert velocity.figure_of_merit_m_s == pytest.approx(0.02)
    assert altitude.altitude_m == 2.5


def test_firmware_that_sends_the_vehicles_velocity_can_be_told():
    velocity, _ = pd0_dvl(velocity_of="vehicle").feed(said(), NOW)

    assert velocity.velocity_m_s == pytest.approx((-0.4, -0.1, 0.05))


def test_ranges_beyond_655_m_use_their_third_byte():
    _, altitude = pd0_dvl().feed(said(altitude_m=800.0), NOW)

    assert altitude.altitude_m == 800.0


def test_the_shorter_bottom_track_of_old_firmware_is_read():
    fixed, variable, bottom = map(bytes, parts_of(said()))

    _, altitude = pd0_dvl().feed(ensemble(fixed, variable, bottom[:74]), NOW)

    assert altitude.altitude_m == 2.5


def parts_of(data: bytes) -> list[bytearray]:
    """Fixed leader, variable leader, bottom track."""
    return [bytearray(data[12:70]), bytearray(data[70:147]), bytearray(data[147:228])]


def test_the_error_velocity_adds_to_the_figure_of_merit():
    parts = parts_of(said())
    parts[2][30:32] = (30).to_bytes(2, "little")

    velocity, _ = pd0_dvl(sigma_m_s=0.04).feed(ensemble(*map(bytes, parts)), NOW)

    assert velocity.figure_of_merit_m_s == pytest.approx(0.05)


@pytest.mark.parametrize("velocity", [0, 2, 4])
def test_a_bad_velocity_is_counted_and_leaves_the_altitude(velocity):
    parts = parts_of(said())
    parts[2][24 + velocity : 26 + velocity] = b"\x00\x80"
    receiver = pd0_dvl()

    assert [type(s) for s in receiver.feed(ensemble(*map(bytes, parts)), NOW)] == [Altitude]
    assert receiver.counters.invalid_values == 1


def test_three_beams_tell_the_altitude_and_two_do_not():
    parts = parts_of(said())
    parts[2][16:18] = b"\0\0"
    _, altitude = pd0_dvl().feed(ensemble(*map(bytes, parts)), NOW)
    parts[2][18:20] = b"\0\0"

    assert altitude.altitude_m == 2.5
    assert [type(s) for s in pd0_dvl().feed(ensemble(*map(bytes, parts)), NOW)] == [Velocity]


def test_an_ensemble_is_stamped_by_the_clock_of_the_dvl():
    receiver, dvl = pd0_dvl(), Pd0Dvl()
    stamps = []
    for k in range(40):
        measured_ns = k * 250_000_000
        late_ns = 4_000_000 if k % 2 else 60_000_000
        (data,) = dvl.encode(Velocity(0, 0, "log", (0.1, 0, 0), 0.01), measured_ns, 0)
        (velocity,) = receiver.feed(data, NOW + measured_ns + late_ns)
        stamps.append(velocity.t_ns - NOW - measured_ns)

    assert all(abs(late) <= 10_000_000 for late in stamps[10:])


def test_a_clock_that_was_never_set_costs_no_velocity():
    parts = parts_of(said())
    parts[1][4:11] = bytes(7)

    velocity, _ = pd0_dvl().feed(ensemble(*map(bytes, parts)), NOW)

    assert velocity.t_ns == NOW


def test_an_ensemble_without_bottom_track_is_counted():
    parts = parts_of(said())
    receiver = pd0_dvl()

    assert receiver.feed(ensemble(bytes(parts[0]), bytes(parts[1])), NOW) == []
    assert receiver.counters.invalid_values == 1
