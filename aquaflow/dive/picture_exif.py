"""What exported pictures carry of where and when they were taken: EXIF 2.32 (CIPA DC-008-2019).

Positions and heading are those of the dive's poses, on WGS 84 and against true north; the altitude
is the height above the water surface, written as one above or below sea level, which differ by the
tide. Times are UTC.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timezone
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.dive.dive import Dive
from aquaflow.dive.placement import to_geodetic
from aquaflow.dive.trajectory_csv import NAME as TRAJECTORY_CSV
from aquaflow.render.views import View

Array = npt.NDArray[np.float64]

CAMERA, RECEIVER = 0x8769, 0x8825
"""Directories of the camera and of its receiver."""
TAKEN, SUBSECONDS, OFFSET = 0x9003, 0x9291, 0x9011
"""Of the camera's: when the picture was taken, decimals of that, and from UTC."""
VERSION = b"\x02\x03\x00\x00"
"""Of the receiver's directory."""
BELOW, ABOVE = b"\x01", b"\x00"
"""Sea level."""
LEAST_LEVEL = 0.2
"""Length of the viewing direction's level part from which it is the heading; of a camera that looks
more steeply, by 12 degrees from the vertical, that is where the top of the picture points."""


def exif_of_views(dive: Dive, views: Sequence[View]) -> dict[int, bytes]:
    """EXIF by frame index; empty where the largest sub-map has no place on the earth.

    Raises:
        InputError: a file of the dive is damaged.
    """
    frame = dive.frame
    if not frame.georeferenced or frame.origin is None or not views:
        return {}
    poses = [frame.pose(view.T_wc) for view in views]
    positions = np.array([pose.t for pose in poses])
    latitude, longitude = to_geodetic(frame.origin, positions)
    rows = dive.poses if dive.has(TRAJECTORY_CSV) else ()
    utc = {row.index: row.utc for row in rows}
    sigma = [_sigma_m(frame.position_covariance(t), frame.origin.sigma_m) for t in positions]
    return {
        view.frame_index: _exif(
            (float(latitude[n]), float(longitude[n])),
            float(positions[n, 2]) if frame.depth_known else None,
            _heading_deg(poses[n].R), sigma[n], utc.get(view.frame_index),
        )
        for n, view in enumerate(views)
    }  # fmt: skip


def _sigma_m(
    covariance: Array,  # [3, 3] m^2
    origin_m: float,
) -> float:
    return float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1] + origin_m**2))


def _heading_deg(
    R_nc: Array,  # [3, 3]
) -> float:
    looks, top = R_nc[:, 2], -R_nc[:, 1]
    north, east, _ = looks if np.hypot(looks[0], looks[1]) >= LEAST_LEVEL else top
    return float(np.degrees(np.arctan2(east, north))) % 360.0


def _exif(
    place: tuple[float, float],
    depth_m: float | None,
    heading_deg: float,
    sigma_m: float,
    utc: datetime | None,
) -> bytes:
    """As it stands in a file: without the mark that JPEG has before it."""
    from PIL.Image import Exif

    exif = Exif()
    latitude, longitude = place
    receiver: dict[int, Any] = {
        0: VERSION,
        1: "N" if latitude >= 0.0 else "S", 2: _sexagesimal(latitude),
        3: "E" if longitude >= 0.0 else "W", 4: _sexagesimal(longitude),
        16: "T", 17: _rational(heading_deg), 18: "WGS-84", 31: _rational(sigma_m),
    }  # fmt: skip
    if depth_m is not None:
        receiver |= {5: BELOW if depth_m > 0.0 else ABOVE, 6: _rational(abs(depth_m))}
    if utc is not None:
        utc = utc.astimezone(timezone.utc)
        seconds = _rational(utc.second + 1e-6 * utc.microsecond)
        receiver |= {7: (_rational(utc.hour), _rational(utc.minute), seconds)}
        receiver |= {29: f"{utc:%Y:%m:%d}"}
        exif.get_ifd(CAMERA).update(
            {TAKEN: f"{utc:%Y:%m:%d %H:%M:%S}", SUBSECONDS: f"{utc:%f}", OFFSET: "+00:00"}
        )
    exif.get_ifd(RECEIVER).update(receiver)
    return exif.tobytes().removeprefix(b"Exif\0\0")


def _sexagesimal(degrees: float) -> tuple[Any, Any, Any]:
    """Degrees, minutes, seconds; those to a micrometre on the ground."""
    minutes, seconds = divmod(round(abs(degrees) * 3600.0, 6), 60.0)
    whole, minutes = divmod(minutes, 60.0)
    return _rational(whole), _rational(minutes), _rational(seconds)


def _rational(number: float) -> Any:
    """To a millionth; EXIF holds two numbers of 32 bits."""
    from PIL.TiffImagePlugin import IFDRational

    return IFDRational(round(number * 1_000_000), 1_000_000)
