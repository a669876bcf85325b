"""The CAN driver on a real SocketCAN bus, with can-utils as the other end."""

from __future__ import annotations

import struct
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice

import pytest

from aquaflow.config.link import CanConfig
from aquaflow.config.telemetry import parse_telemetry
from aquaflow.drivers.telemetry import LinkTelemetry
from aquaflow.drivers.transport import opener
from aquaflow.types import Altitude, TelemetrySample
from tests.kernel.virtual_machine import in_guest

pytest.importorskip("can", reason="python-can is not installed")

GIVE_UP_S = 120.0

WATER_DEPTH = "09F50B23#00E8030000000000FF"
"""NMEA 2000 PGN 128267: 10.00 m below the transducer."""


def shell(*command: str) -> None:
    subprocess.run(command, check=True, timeout=30)


@contextmanager
def instruments() -> Iterator[LinkTelemetry]:
    link = {"kind": "can", "interface": "socketcan", "channel": "vcan0"}
    devices = {"sounder": {"kind": "nmea2000", "link": link}}
    telemetry = LinkTelemetry(parse_telemetry({"devices": devices}, "test"))
    alarm = threading.Timer(GIVE_UP_S, telemetry.close)
    alarm.start()
    try:
        yield telemetry
    finally:
        alarm.cancel()
        telemetry.close()


def heard(telemetry: LinkTelemetry, count: int) -> list[TelemetrySample]:
    """Samples of a sounder that speaks until ``count`` of them came."""
    enough = threading.Event()

    def speak() -> None:
        while not enough.wait(0.1):
            subprocess.run(["cansend", "vcan0", WATER_DEPTH], check=False, timeout=30)

    speaker = threading.Thread(target=speak)
    speaker.start()
    try:
        return list(islice(telemetry.samples(), count))
    finally:
        enough.set()
        speaker.join()


@in_guest
def test_what_cansend_sends_becomes_samples() -> None:
    with instruments() as telemetry:
        samples = heard(telemetry, 3)
    assert len(samples) == 3
    for sample in samples:
        assert isinstance(sample, Altitude)
        assert sample.altitude_m == pytest.approx(10.0)
        assert sample.arrival_ns - sample.t_ns >= 0


@in_guest
def test_the_bus_goes_down_and_comes_up_again() -> None:
    with instruments() as telemetry:
        heard(telemetry, 1)
        shell("ip", "link", "set", "vcan0", "down")
        shell("ip", "link", "set", "vcan0", "up")
        assert len(heard(telemetry, 3)) == 3


@in_guest
def test_candump_sees_what_the_link_writes() -> None:
    record = struct.pack("<IB3x8s", 0x123, 4, bytes.fromhex("DEADBEEF"))
    dump = subprocess.Popen(
        ["candump", "-n", "1", "-T", "30000", "vcan0"], stdout=subprocess.PIPE, text=True
    )
    link = opener("link", CanConfig(channel="vcan0"))()
    try:
        while dump.poll() is None:  # until it listens
            link.write(record)
            time.sleep(0.1)
    finally:
        link.close()
    printed, _ = dump.communicate(timeout=30)
    assert "123   [4]  DE AD BE EF" in printed
