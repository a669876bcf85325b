"""Velocities in a Teledyne DVL's own axes, from those along its beams or in those of the earth.

Instrument axes of a head that looks down: x from beam 1 to beam 2 (starboard), y from beam 4 to
beam 3 (forward), z towards its face (up). Teledyne RD Instruments, "ADCP Coordinate Transformation:
Formulas and Calculations" (P/N 951-6079-00); fields by its Pathfinder DVL Guide (2018), tables 33,
34 and 40.
"""

from __future__ import annotations

import math
import struct
from typing import NamedTuple

from aquaflow.drivers.rotation import Vector, from_euler, inverse, rotate

BEAM_ANGLES_DEG = (15.0, 20.0, 30.0, None)
"""By bits 8 and 9 of the system's configuration; the last: another."""
CONVEX, FACES_UP = 0x08, 0x80
"""Bits of that configuration."""
JANUS = (0b0100, 0b0101, 0b1111)
"""Its bits 12 to 15 where four beams lean out to four sides, with or without a fifth between."""
TILTS_USED = 0x04
"""Bit of the coordinates: pitch and roll were used on the way to ship or earth axes."""
BAD_VELOCITY = -32_768
"""mm/s; what the DVL writes for a velocity that it could not measure."""
CENTIDEGREE = math.pi / 18_000.0
"""rad."""


class UnusableError(ValueError):
    """Why velocities cannot be brought into instrument axes, and what to set."""


class Pd0Head(NamedTuple):
    """What the fixed leader says of the head."""

    configuration: int
    tilts_used: bool
    alignment_deg: float
    """EA: from beam 3 to the ship's bow."""

    @classmethod
    def of(cls, leader: bytes) -> Pd0Head:
        """From the fixed leader, 29 bytes of it at least."""
        (configuration,) = struct.unpack_from("<H", leader, 4)
        (alignment,) = struct.unpack_from("<h", leader, 26)
        return cls(configuration, bool(leader[25] & TILTS_USED), alignment * 0.01)

    def beam_angle(self, known_deg: float | None) -> float:
        """Between each beam and the head's axis, rad; ``known_deg`` is that of the config."""
        if self.configuration & FACES_UP:
            raise UnusableError("it faces up")
        stated_deg = BEAM_ANGLES_DEG[self.configuration >> 8 & 0b11]
        if self.configuration >> 12 not in JANUS:
            stated_deg = None
        angle_deg = known_deg or stated_deg
        if angle_deg is None:
            raise UnusableError(
                "it does not state the angle of its beams, and nor does beam_angle_deg"
            )
        return math.radians(angle_deg)


def from_beams(
    beams: tuple[int, int, int, int], head: Pd0Head, known_deg: float | None
) -> tuple[float, float, float, float]:
    """x, y, z and error velocity from those towards beams 1 to 4, all in their unit; the error is
    0 where one beam is bad and the three others tell the velocity.

    Raises:
        UnusableError: the head's geometry is not known.
        ValueError: more than one beam is bad.
    """
    angle = head.beam_angle(known_deg)
    one, two, three, four = _complete(beams)
    a, b = 1.0 / (2.0 * math.sin(angle)), 1.0 / (4.0 * math.cos(angle))
    c = 1.0 if head.configuration & CONVEX else -1.0
    error = (one + two - three - four) * a / math.sqrt(2.0)
    return c * a * (one - two), c * a * (four - three), b * (one + two + three + four), error


def from_earth(velocity: Vector, head: Pd0Head, leader: bytes) -> Vector:
    """x, y, z from east, north, up, by the heading and tilts of the variable leader, with which
    the DVL turned them: what is wrong with its compass cancels.

    Raises:
        UnusableError: the head is turned against the ship, or faces up.
    """
    if head.configuration & FACES_UP:
        raise UnusableError("it faces up")
    if head.alignment_deg:
        raise UnusableError(
            f"its heading alignment (EA) of {head.alignment_deg:g} degrees may or may not be in "
            "its heading"
        )
    heading, tilt_1, tilt_2 = struct.unpack_from("<Hhh", leader, 18)
    pitch, roll = 0.0, 0.0
    if head.tilts_used:
        # Tilt 1 leans in the head's own plane, which roll has turned out of the vertical.
        roll = tilt_2 * CENTIDEGREE
        pitch = math.atan(math.tan(tilt_1 * CENTIDEGREE) * math.cos(roll))
    q = from_euler(roll, pitch, heading * CENTIDEGREE)
    east, north, up = velocity
    forward, right, down = rotate(inverse(q), (north, east, -up))
    return right, forward, -down


def _complete(beams: tuple[int, int, int, int]) -> tuple[int, int, int, int]:
    """With a bad one replaced by what makes the error velocity 0."""
    bad = [k for k, value in enumerate(beams) if value == BAD_VELOCITY]
    if not bad:
        return beams
    if len(bad) > 1:
        raise ValueError("the velocity needs three beams")
    whole = list(beams)
    (k,) = bad
    pair, others = (0, 1) if k < 2 else (2, 3), (2, 3) if k < 2 else (0, 1)
    partner = pair[0] + pair[1] - k
    whole[k] = whole[others[0]] + whole[others[1]] - whole[partner]
    return whole[0], whole[1], whole[2], whole[3]
