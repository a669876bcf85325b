"""NMEA 0183: units, signs, validity, and what a partial instrument may be taken for."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aquaflow.config.telemetry import NmeaConfig
from aquaflow.drivers.protocol.nmea import NmeaDecoder
from aquaflow.sim_drivers.devices.nmea_talker import sentence
from aquaflow.types import Altitude, AngularRate, Attitude, Depth, Position, UtcTime, Velocity

NOW = 9_000_000_000
LINK = {"kind": "serial", "port": "/dev/null"}


def decoder(**settings) -> NmeaDecoder:
    return NmeaDecoder("box", NmeaConfig.model_validate({"link": LINK, **settings}))


def hear(*bodies: str, **settings) -> list:
    return decoder(**settings).feed(b"".join(sentence(body) for body in bodies), NOW)


def euler_deg(attitude: Attitude) -> np.ndarray:
    """Roll, pitch, yaw."""
    rotation = Rotation.from_quat(np.roll(attitude.wxyz, -1))
    return rotation.as_euler("ZYX", degrees=True)[::-1]


def test_a_published_sentence_is_read():
    (altitude,) = decoder().feed(b"$SDDBT,7.8,f,2.4,M,1.3,F*0D\r\n", NOW)

    assert altitude == Altitude(NOW, NOW, "box/DBT", 2.4)


@pytest.mark.parametrize(
    ("body", "metres"),
    [
        ("SDDBT,,f,3.5,M,,F", 3.5),
        ("SDDBT,10.0,f,,M,,F", 3.048),
        ("SDDBT,,f,,M,2.0,F", 3.6576),
        ("SDDPT,4.25,0.5", 4.25),
        ("SDDPT,4.25,0.5,100", 4.25),
        ("SDDBK,,f,1.5,M,,F", 1.5),
    ],
)
def test_an_echo_sounder_tells_the_altitude(body, metres):
    (altitude,) = hear(body)

    assert isinstance(altitude, Altitude)
    assert altitude.altitude_m == pytest.approx(metres)


def test_the_config_says_which_sentence_is_the_vehicles_own_depth():
    bodies = ("SDDBS,,f,12.5,M,,F", "SDDPT,3.0,0.0")

    assert [type(s) for s in hear(*bodies)] == [Depth, Altitude]
    assert [type(s) for s in hear(*bodies, depth_sentences=["DPT"])] == [Altitude, Depth]


def test_rdi_attitude_has_the_bodys_signs():
    (attitude,) = hear("PRDID,-5.5,12.25,271.0")

    assert euler_deg(attitude) == pytest.approx([12.25, -5.5, -89.0])


def test_ashtech_attitude_has_the_bodys_signs():
    (attitude,) = hear("PASHR,123456.00,271.0,T,+12.25,-5.50,+0.10,0.1,0.1,0.1,1")

    assert euler_deg(attitude) == pytest.approx([12.25, -5.5, -89.0])


def test_a_heading_takes_roll_and_pitch_from_the_same_line():
    _, attitude = hear("PRDID,-5.5,12.25,271.0", "HEHDT,90.0,T")

    assert euler_deg(attitude) == pytest.approx([12.25, -5.5, 90.0])


@pytest.mark.parametrize("names", [("PTCH", "ROLL"), ("Pitch", "Roll")])
def test_a_heading_takes_roll_and_pitch_from_transducers(names):
    pitch, roll = names
    body = f"YXXDR,A,-5.5,D,{pitch},A,12.25,D,{roll},C,17.0,C,TEMP"

    (attitude,) = hear(body, "HEHDT,90.0,T")

    assert euler_deg(attitude) == pytest.approx([12.25, -5.5, 90.0])


def test_transducers_that_tell_only_one_angle_complete_nothing():
    assert hear("YXXDR,A,-5.5,D,PTCH", "HEHDT,90.0,T") == []
    assert hear("YXXDR,A,-5.5,D", "YXXDR", "HEHDT,90.0,T") == []


def test_roll_and_pitch_of_long_ago_are_not_taken():
    receiver = decoder()
    receiver.feed(sentence("PRDID,-5.5,12.25,271.0"), NOW)

    assert receiver.feed(sentence("HEHDT,90.0,T"), NOW + 10**9) == []


def test_what_is_known_in_part_makes_no_sample_unless_the_rest_is_assumed():
    bodies = ("HEHDT,90.0,T", "HEROT,60.0,A", "VDVBW,,,V,2.0,-1.0,A")

    assert hear(*bodies) == []
    attitude, rate, velocity = hear(*bodies, assume={"level": True, "speed_sigma_m_s": 0.3})
    assert euler_deg(attitude) == pytest.approx([0, 0, 90])
    assert isinstance(rate, AngularRate)
    assert rate.rate_rad_s == pytest.approx((0, 0, math.radians(1)))
    assert isinstance(velocity, Velocity)
    assert velocity.velocity_m_s == pytest.approx((2 * 0.514444, -0.514444, 0), abs=1e-5)
    assert velocity.figure_of_merit_m_s == 0.3


@pytest.mark.parametrize(
    ("body", "yaw"),
    [
        ("HCHDG,100.0,,,,", 100),
        ("HCHDG,100.0,2.0,E,3.0,E", 105),
        ("HCHDG,100.0,2.0,W,3.0,W", 95),
    ],
)
def test_a_magnetic_heading_is_corrected_to_the_east(body, yaw):
    (attitude,) = hear(body, assume={"level": True})

    assert euler_deg(attitude)[2] == pytest.approx(yaw)


@pytest.mark.parametrize(
    "body",
    [
        "SDDBT,,f,,M,,F",
        "SDDBT,deep,f,,M,,F",
        "SDDPT,,0.0",
        "SDDPT",
        "HEHDT,,T",
        "HEHDT,nan,T",
        "HEHDT,inf,T",
        "HCHDG,100.0,2.0,X,,",
        "HEROT,5.0,V",
        "VDVBW,1,1,A,1,1,V",
        "PRDID,1,2",
        "SDDPT,-4.0,0.0",
        "SDDPT,1e300,0.0",
        "GPGGA,120000,4807.038,X,01131.000,E,1,08,0.9,,M,,M,,",
        "GPGGA,120000,4877.038,N,01131.000,E,1,08,0.9,,M,,M,,",
        "GPGGA,120000,9107.038,N,01131.000,E,1,08,0.9,,M,,M,,",
        "GPGGA,120000,,,,,1,08,0.9,,M,,M,,",
        "GPGGA,120000,4807.038,N,01131.000,E,,08,0.9,,M,,M,,",
        "GPGGA,120000",
        "GPRMC,120000,A,4807.038,N,01131.000,E,,,321326,,",
        "GPRMC,1200,A,4807.038,N,01131.000,E,,,221126,,",
        "GPRMC,120000,A,4807.038,N,01131.000,E,,,,,",
        "GPZDA,120099.00,22,11,2026,00,00",
        "GPZDA,120000.00,06,01,1980,00,00",
        "GPGST,120000,,,,,x,1.0,",
    ],
)
def test_what_is_invalid_is_counted_and_dropped(body):
    receiver = decoder(assume={"level": True})

    assert receiver.feed(sentence(body), NOW) == []
    assert receiver.counters.messages == 1
    assert receiver.counters.invalid_values == 1


GGA = "GPGGA,123519,4807.038,N,01131.000,W,1,08,0.9,545.4,M,46.9,M,,"
RMC = "GPRMC,123519.250,A,4807.038,S,01131.000,E,022.4,084.4,230326,003.1,W"


def test_a_fix_has_the_accuracy_of_its_dilution():
    elsewhere = GGA.replace("4807", "4808")
    fix, unstated = hear(GGA, GGA, elsewhere.replace("0.9,", ","), position_lag_s=0.25)

    assert isinstance(fix, Position)
    assert (fix.latitude_deg, fix.longitude_deg) == pytest.approx((48.1173, -11.516666667))
    assert (fix.t_ns, fix.arrival_ns, fix.source) == (NOW - 250_000_000, NOW, "box/GGA")
    assert fix.sigma_m == pytest.approx(0.9 * 5.1 / 2**0.5)
    assert unstated.sigma_m == pytest.approx(2.0 * 5.1 / 2**0.5)


def test_a_published_fix_is_read():
    line = b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n"

    (fix,) = decoder().feed(line, NOW)

    assert (fix.latitude_deg, fix.longitude_deg) == pytest.approx((48.1173, 11.516666667))


def test_the_accuracy_that_a_receiver_states_is_used_while_it_is_new():
    receiver = decoder()
    accuracy, empty = sentence("GPGST,123519,2,,,,0.6,0.8,1"), sentence("GPGST,123519,,,,,,,")

    (stated,) = receiver.feed(accuracy + sentence(GGA), NOW)
    (old,) = receiver.feed(sentence(GGA.replace("4807", "4808")), NOW + 6 * 10**9)
    (withdrawn,) = receiver.feed(accuracy + empty + sentence(GGA), NOW)
    (known,) = hear("GPGST,123519,2,,,,0.6,0.8,1", GGA, position_sigma_m=0.1)

    assert stated.sigma_m == pytest.approx(0.5**0.5)
    assert old.sigma_m == withdrawn.sigma_m == pytest.approx(0.9 * 5.1 / 2**0.5)
    assert known.sigma_m == 0.1


def test_rmc_gives_utc_and_a_fix_only_where_gga_does_not():
    receiver = decoder(position_lag_s=0.25)

    utc, fix = receiver.feed(sentence(RMC), NOW)
    moved = sentence(RMC.replace("4807", "4808"))
    both = receiver.feed(sentence(GGA) + moved, NOW)
    later = receiver.feed(moved + moved, NOW + 6 * 10**9)

    assert (fix.latitude_deg, fix.longitude_deg) == pytest.approx((-48.1173, 11.516666667))
    # 2026-03-23 12:35:19.25, and the fix is of that moment.
    assert utc == UtcTime(NOW - 250_000_000, NOW, "box/RMC", 1_774_269_319_250_000_000)
    assert [s.source for s in both] == ["box/GGA", "box/RMC"]
    assert [type(s) for s in later] == [UtcTime, Position, UtcTime]


def test_zda_gives_utc():
    (utc,) = hear("GPZDA,235959.50,31,12,2026,00,00")

    assert utc == UtcTime(NOW, NOW, "box/ZDA", 1_798_761_599_500_000_000)


@pytest.mark.parametrize(
    "body",
    [
        "GPGGA,123519,,,,,0,00,,,M,,M,,",
        GGA.replace("W,1,", "W,6,"),
        GGA.replace("W,1,", "W,7,"),
        GGA.replace("W,1,", "W,8,"),
        "GPRMC,,V,,,,,,,,,,N",
        RMC.replace(",A,", ",V,"),
        RMC + ",E",
        RMC + ",S",
        "GPZDA,,,,,,",
    ],
)
def test_a_receiver_without_a_fix_gives_nothing_and_is_not_at_fault(body):
    receiver = decoder()

    assert receiver.feed(sentence(body), NOW) == []
    assert receiver.counters.invalid_values == 0


def test_sentences_that_tell_nothing_of_motion_are_counted():
    receiver = decoder()

    assert receiver.feed(sentence("YXMTW,17.75,C") + sentence("PSIMSNS,,B01,A,,C"), NOW) == []
    assert (receiver.counters.messages, receiver.counters.invalid_values) == (2, 0)


def test_a_missing_checksum_is_accepted_only_where_the_config_says_so():
    line = b"$SDDPT,4.25,0.5\r\n"
    strict, lenient = decoder(), decoder(require_checksum=False)

    assert strict.feed(line, NOW) == []
    assert strict.counters.bad_checksums == 1
    assert len(lenient.feed(line, NOW)) == 1
    assert lenient.feed(line.replace(b"\r", b"*00\r"), NOW) == []
