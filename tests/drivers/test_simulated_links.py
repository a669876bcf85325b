"""Every telemetry driver hears a simulated device through a real pty, socket or CAN bus."""

from __future__ import annotations

import numpy as np
import pytest

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
from tests.drivers.simulated_links import RIGS, motion, running, until, values

TOLERANCE = {
    Acceleration: 0.006,  # RAW_IMU has milli-g
    AngularRate: 1e-3,
    Attitude: 2e-4,
    Altitude: 0.006,
    Depth: 0.006,
    Velocity: 0.006,
    Lights: 1e-3,
    Position: 1e-7,
    UtcTime: 0.011,  # ZDA has hundredths of a second
}
"""Resolution of the coarsest protocol."""

SIGMA_M = {"mavlink_udp": 1.6 * 5.1 / 2**0.5, "nmea2000": 1.6 * 5.1 / 2**0.5}
"""Of the protocols that state only an HDOP; the others state the fix's own 2.5 m."""


@pytest.mark.parametrize("name", RIGS)
def test_a_driver_tells_what_its_device_measured(name, tmp_path):
    rig = RIGS[name](tmp_path)
    log = motion()
    with running(rig, log) as session:
        session.play()
        until(lambda: session.counters.messages >= session.device.sent)
        heard = session.fetched()

    counters = session.counters
    assert {type(sample) for sample in heard} == rig.kinds
    for kind in rig.kinds:
        truth = np.array([values(sample) for sample in log if type(sample) is kind])
        told = np.array([values(sample) for sample in heard if type(sample) is kind])
        told = _known_part(name, kind, told, truth)
        distance = np.abs(told[:, None] - truth[None]).max(2)
        assert distance.min(1).max() <= TOLERANCE[kind], f"{kind.__name__} was never measured"
        assert distance.min(0).max() <= TOLERANCE[kind], f"{kind.__name__} was lost"
    sigma_m = SIGMA_M.get(name if "mavlink" in name else name.split("_")[0], 2.5)
    sigmas_m = [sample.sigma_m for sample in heard if isinstance(sample, Position)]
    assert sigmas_m == pytest.approx([sigma_m] * len(sigmas_m))
    assert counters.samples == len(heard)
    assert (counters.bad_checksums, counters.garbage_bytes, counters.invalid_values) == (0, 0, 0)
    assert (counters.dropped_samples, counters.reconnects) == (0, 0)
    assert all(sample.t_ns <= sample.arrival_ns for sample in heard)
    assert all(sample.source.startswith("device/") for sample in heard)


def _known_part(name, kind, told, truth):
    """Speed logs and rate gyros tell one or two components; the others are compared as true."""
    known = {
        ("nmea_pty", AngularRate): [2],
        ("nmea_pty", Velocity): [0, 1],
        ("nmea2000", AngularRate): [2],
        ("nmea2000", Velocity): [0],
    }.get((name if name == "nmea_pty" else name.split("_")[0], kind))
    if known is None:
        return told
    full = np.broadcast_to(truth[0], told.shape).copy()
    full[:, known] = told[:, known]
    return full
