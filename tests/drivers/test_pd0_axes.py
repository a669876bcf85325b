"""PD0 in beam and earth coordinates: thousands of ensembles by a head of direction vectors."""

from __future__ import annotations

import logging
import math
import re
import struct
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aquaflow.config.instruments import Pd0Config
from aquaflow.drivers.protocol.pd0 import Pd0Decoder
from aquaflow.sim_drivers.devices.pd0 import ensemble
from aquaflow.types import Altitude, Velocity

COUNT = 3000
NOW = 90_000_000_000
LINK = {"kind": "serial", "port": "/dev/null"}
ANGLE_BITS = {15.0: 0, 20.0: 1, 30.0: 2}
CONVEX, UP = 0x08, 0x80
FROM_FRD = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""Forward, right, down to x starboard, y forward, z up, and back."""


def dvl(**settings: Any) -> Pd0Decoder:
    return Pd0Decoder("dvl", Pd0Config.model_validate({"link": LINK, **settings}))


def leader(coordinates: int, configuration: int, alignment: int = 0) -> bytes:
    fixed = bytearray(58)
    struct.pack_into("<H", fixed, 4, configuration)
    fixed[25] = coordinates
    struct.pack_into("<h", fixed, 26, alignment)
    return bytes(fixed)


def packet(fixed: bytes, told: Any, angles_deg: tuple[float, ...] = (0.0, 0.0, 0.0)) -> bytes:
    variable, bottom = bytearray(77), bytearray(81)
    struct.pack_into("<H", variable, 0, 0x0080)
    struct.pack_into("<Hhh", variable, 18, *(round(100.0 * angle) for angle in angles_deg))
    struct.pack_into("<H", bottom, 0, 0x0600)
    struct.pack_into("<4H", bottom, 16, *[250] * 4)
    struct.pack_into("<4h", bottom, 24, *(round(float(value)) for value in told))
    return ensemble(fixed, bytes(variable), bytes(bottom))


def beams(angle_deg: float) -> np.ndarray:
    """[4, 3] directions of beams 1 to 4 in x, y, z: to port, starboard, bow, stern, and down."""
    out, down = math.sin(math.radians(angle_deg)), math.cos(math.radians(angle_deg))
    return np.array([[-out, 0, -down], [out, 0, -down], [0, out, -down], [0, -out, -down]])


@pytest.mark.parametrize("angle_deg", [15.0, 20.0, 30.0, 25.0])
@pytest.mark.parametrize("bad_beam", [None, 0, 1, 2, 3])
def test_velocities_along_beams_are_those_of_the_vehicle(angle_deg, bad_beam):
    rng = np.random.default_rng(int(angle_deg))
    janus = 0x4000 | ANGLE_BITS.get(angle_deg, 3) << 8
    receiver = dvl(beam_angle_deg=angle_deg) if angle_deg == 25.0 else dvl()
    mismatches = 0
    for k in range(COUNT // 5):
        velocity = rng.uniform(-2.0, 2.0, 3)  # of the vehicle: forward, right, down
        past = -FROM_FRD @ velocity  # of the bottom in x, y, z
        towards = -beams(angle_deg) @ past * 1000.0
        if bad_beam is not None:
            towards[bad_beam] = -32768
        data = packet(leader(0, janus | CONVEX), towards)
        found, altitude = receiver.feed(data, NOW + k)
        assert isinstance(found, Velocity)
        assert isinstance(altitude, Altitude)
        mismatches += np.abs(found.velocity_m_s - velocity).max() > 0.006
    assert mismatches == 0
    assert receiver.counters.invalid_values == 0


@pytest.mark.parametrize("tilts_used", [True, False])
def test_velocities_in_earth_axes_are_turned_back_by_the_dvls_own_attitude(tilts_used):
    rng = np.random.default_rng(7)
    receiver, mismatches = dvl(), 0
    for k in range(COUNT):
        velocity = rng.uniform(-2.0, 2.0, 3)
        yaw, pitch, roll = rng.uniform((-180, -25, -25), (180, 25, 25))
        used = [yaw, pitch, roll] if tilts_used else [yaw, 0.0, 0.0]
        north, east, down = Rotation.from_euler("ZYX", used, degrees=True).apply(velocity)
        told = 1000.0 * np.array([-east, -north, down, 0.0])
        # A pendulum that swings in the head's plane through beams 3 and 4.
        gravity = Rotation.from_euler("ZYX", [0, pitch, roll], degrees=True).inv().apply([0, 0, 1])
        tilt = math.degrees(math.atan2(-gravity[0], gravity[2]))
        data = packet(leader(3 << 3 | (4 if tilts_used else 0), 0x424B), told,
                      (yaw % 360.0, tilt, roll))  # fmt: skip
        found, _ = receiver.feed(data, NOW + k)
        assert isinstance(found, Velocity)
        mismatches += np.abs(found.velocity_m_s - velocity).max() > 0.002
    assert mismatches == 0


def test_a_concave_head_turns_its_horizontal_axes():
    along = (100, -100, 50, -50)
    convex, _ = dvl().feed(packet(leader(0, 0x4100 | CONVEX), along), NOW)
    concave, _ = dvl().feed(packet(leader(0, 0x4100), along), NOW)
    assert isinstance(convex, Velocity)
    assert isinstance(concave, Velocity)
    assert concave.velocity_m_s[:2] == pytest.approx([-v for v in convex.velocity_m_s[:2]])


def test_the_error_velocity_of_beams_adds_to_the_figure_of_merit():
    velocity, _ = dvl(sigma_m_s=0.01).feed(packet(leader(0, 0x424B), (30, 30, -30, -30)), NOW)
    assert isinstance(velocity, Velocity)
    assert velocity.figure_of_merit_m_s == pytest.approx(math.hypot(0.01, 0.12 / math.sqrt(2.0)))


def test_two_bad_beams_leave_the_altitude_only():
    receiver = dvl()
    data = packet(leader(0, 0x424B), (-32768, 10, -32768, 10))
    assert [type(s) for s in receiver.feed(data, NOW)] == [Altitude]
    assert receiver.counters.invalid_values == 1


@pytest.mark.parametrize(
    ("fixed", "said"),
    [
        (leader(0, 0x4300 | CONVEX), "in beam coordinates, are not used: it does not state"),
        (leader(0, 0x0200 | CONVEX), "in beam coordinates, are not used: it does not state"),
        (leader(0, 0x4200 | CONVEX | UP), "in beam coordinates, are not used: it faces up"),
        (leader(3 << 3, 0x4200 | CONVEX | UP), "in earth coordinates, are not used: it faces up"),
        (leader(3 << 3, 0x424B, 4500), r"its heading alignment \(EA\) of 45 degrees"),
    ],
)
def test_what_cannot_be_turned_honestly_is_counted_and_said_once(fixed, said, caplog):
    receiver = dvl()
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            samples = receiver.feed(packet(fixed, (1, 2, 3, 4)), NOW)
            assert [type(s) for s in samples] == [Altitude]
    assert receiver.counters.invalid_values == 3
    [record] = caplog.records
    assert "EX10000" in record.getMessage()
    assert re.search(said, record.getMessage())


def test_a_stated_angle_counts_where_the_dvl_states_none():
    receiver = dvl(beam_angle_deg=25.0)
    velocity, _ = receiver.feed(packet(leader(0, 0x0300 | CONVEX), (100, 100, 100, 100)), NOW)
    assert isinstance(velocity, Velocity)
    down = 0.1 / math.cos(math.radians(25.0))
    assert velocity.velocity_m_s == pytest.approx((0.0, 0.0, down))
