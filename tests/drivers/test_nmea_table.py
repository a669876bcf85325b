"""Thousands of NMEA sentences by pynmea2's encoder, and of those it does not know by their text."""

from __future__ import annotations

import logging
import math
import random
from collections.abc import Callable
from datetime import datetime, timezone
from importlib import import_module
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aquaflow.config.telemetry import NmeaConfig
from aquaflow.drivers.protocol.nmea import NmeaDecoder
from aquaflow.sim_drivers.devices.nmea_talker import sentence
from aquaflow.types import Attitude, Position, TelemetrySample, UtcTime

pynmea2: Any = import_module("pynmea2")
COUNT = 2000
NOW = 9_000_000_000
LINK = {"kind": "serial", "port": "/dev/null"}
Case = tuple[bytes, list[Any]]
"""A sentence, and the values that it holds."""


def decoder(**settings: Any) -> NmeaDecoder:
    return NmeaDecoder("box", NmeaConfig.model_validate({"link": LINK, **settings}))


def encoded(talker: str, kind: str, *fields: str) -> bytes:
    message = getattr(pynmea2, kind)(talker, kind, fields)
    return bytes(message.render(newline=True).encode())


def angle(degrees: float, width: int) -> tuple[str, float]:
    """``ddmm.mmmmm``, and what it is in degrees."""
    whole, minutes = int(degrees), f"{degrees % 1.0 * 60.0:08.5f}"
    if minutes == "60.00000":
        whole, minutes = whole + 1, "00.00000"
    return f"{whole:0{width}d}{minutes}", whole + float(minutes) / 60.0


def place(draw: random.Random) -> tuple[list[str], tuple[float, float]]:
    north, lat = angle(draw.uniform(0.0, 89.0), 2)
    east, lon = angle(draw.uniform(0.0, 179.0), 3)
    ns, ew = draw.choice("NS"), draw.choice("EW")
    return [north, ns, east, ew], (lat if ns == "N" else -lat, lon if ew == "E" else -lon)


def moment(draw: random.Random) -> datetime:
    at = datetime.fromtimestamp(draw.randint(1_000_000_000, 4_000_000_000), timezone.utc)
    return at.replace(microsecond=draw.randint(0, 99) * 10_000)


def clock_of(at: datetime) -> str:
    return f"{at:%H%M%S}.{at.microsecond // 10_000:02d}"


def nanoseconds(at: datetime) -> int:
    return int(at.timestamp()) * 10**9 + at.microsecond * 1000


def gga(draw: random.Random) -> Case:
    fields, here = place(draw)
    quality, hdop = draw.randint(0, 8), round(draw.uniform(0.5, 9.0), 2)
    rest = (str(quality), "9", f"{hdop}", "0.0", "M", "0.0", "M", "", "")
    sigma_m = hdop * 5.1 / math.sqrt(2.0)
    return encoded("GP", "GGA", "120000.00", *fields, *rest), (
        [(*here, sigma_m)] if 1 <= quality <= 5 else []
    )


def rmc(draw: random.Random) -> Case:
    fields, here = place(draw)
    at, status = moment(draw).replace(year=2000 + draw.randint(0, 99), day=1), draw.choice("AV")
    body = (clock_of(at), status, *fields, "1.0", "90.0", f"{at:%d%m%y}", "", "", "A")
    values = [nanoseconds(at), (*here, 2.0 * 5.1 / math.sqrt(2.0))]
    return encoded("GN", "RMC", *body), values if status == "A" else []


def zda(draw: random.Random) -> Case:
    at = moment(draw)
    day = (f"{at:%d}", f"{at:%m}", f"{at:%Y}", "00", "00")
    return encoded("GP", "ZDA", clock_of(at), *day), [nanoseconds(at)]


def hdm(draw: random.Random) -> Case:
    degrees = round(draw.uniform(0.0, 359.9), 1)
    return encoded("HC", "HDM", f"{degrees}", "M"), [(degrees + 3.5) % 360.0]


def hdg(draw: random.Random) -> Case:
    degrees, deviation = round(draw.uniform(0.0, 359.9), 1), round(draw.uniform(0.0, 5.0), 1)
    variation, side = draw.choice([None, round(draw.uniform(0.0, 20.0), 1)]), draw.choice("EW")
    stated = ("", "") if variation is None else (f"{variation}", side)
    east = 3.5 if variation is None else variation * (1.0 if side == "E" else -1.0)
    return (
        encoded("HC", "HDG", f"{degrees}", f"{deviation}", "W", *stated),
        [(degrees - deviation + east) % 360.0],
    )


def ths(draw: random.Random) -> Case:
    degrees, status = round(draw.uniform(0.0, 359.99), 2), draw.choice("AEMSV")
    return sentence(f"HETHS,{degrees},{status}"), [degrees] if status == "A" else []


def psimssb(draw: random.Random) -> Case:
    lat, lon = round(draw.uniform(-1.5, 1.5), 9), round(draw.uniform(-3.1, 3.1), 9)
    status, system, kind = draw.choice("AV"), draw.choice("RRCPU"), draw.choice("MFP")
    accuracy_m = round(draw.uniform(0.1, 5.0), 3)
    body = f"PSIMSSB,180554.43,B42,{status},,{system},N,{kind},{lat},{lon},34.0,{accuracy_m},T,,"
    good = (status, system) == ("A", "R") and kind != "P"
    return sentence(body), [(math.degrees(lat), math.degrees(lon), accuracy_m)] if good else []


def value_of(sample: TelemetrySample) -> Any:
    if isinstance(sample, Attitude):
        rotation = Rotation.from_quat(np.roll(sample.wxyz, -1))
        return float(rotation.as_euler("ZYX", degrees=True)[0] % 360.0)
    if isinstance(sample, Position):
        return (sample.latitude_deg, sample.longitude_deg, sample.sigma_m)
    assert isinstance(sample, UtcTime)
    return sample.utc_ns


def agree(found: Any, expected: Any) -> bool:
    if isinstance(expected, int):  # ns: to the hundredth of a second that was sent
        return bool(abs(found - expected) < 1000)
    if isinstance(expected, float):
        return abs((found - expected + 180.0) % 360.0 - 180.0) < 1e-9
    return bool(found == pytest.approx(expected, rel=1e-12))


@pytest.mark.parametrize("drawn", [gga, rmc, zda, hdm, hdg, ths, psimssb])
def test_every_sentence_means_what_was_encoded(drawn: Callable[[random.Random], Case]) -> None:
    draw = random.Random(drawn.__name__)
    receiver = decoder(assume={"level": True}, variation_deg=3.5)
    mismatches = 0
    for _ in range(COUNT):
        data, expected = drawn(draw)
        found = [value_of(sample) for sample in receiver.feed(data, NOW)]
        alike = len(found) == len(expected) and all(map(agree, found, expected))
        mismatches += not alike
    assert mismatches == 0
    assert receiver.counters.messages == COUNT
    assert receiver.counters.bad_checksums == 0


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("HCHDM,235.1,M", "HDM states no variation"),
        ("HCHDG,235.1,,,,", "HDG states no variation"),
        ("PSIMSSB,1,B1,A,,C,H,M,1.0,2.0,3.0,0.1,N,,", "coordinates 'C'"),
    ],
)
def test_what_a_sentence_lacks_is_said_once(
    body: str, said: str, caplog: pytest.LogCaptureFixture
) -> None:
    receiver = decoder()
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            receiver.feed(sentence(body), NOW)
    [record] = caplog.records
    assert said in record.getMessage()
