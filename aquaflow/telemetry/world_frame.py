"""Where a sub-map lies in the world, and how well that is known.

The world frame n is local north-east-down: x points north (or along the initial heading, where no
compass is trusted), y to the right of it, z down. Its origin is the body at the dive's first pose,
at the water surface where depth is measured. Without gravity z points into the ground where the
cameras look squarely at one, and x north where fixes say so; else a map stays as it is, and T_nm is
the identity but for the scale.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.similarity import Sim3, Sim3Batch, hat

Array = npt.NDArray[np.float64]

North: TypeAlias = Literal["true north", "magnetic north", "initial heading", "first keyframe"]
"""What the x axis of n points to; the camera axes of the first keyframe where nothing is known."""

LARGEST_SCALE_SIGMA = 0.1
"""Relative 1 sigma of the scale up to which lengths are called metres: judgement, a ruler that may
be 10 % off is still one for a pilot; beyond, the map keeps its own unit."""
LARGEST_TILT_SIGMA = float(np.radians(5.0))
"""1 sigma of gravity's direction, rad, up to which the world is turned level: judgement."""
UNKNOWN_SIGMA = 1e3
"""1 sigma, in m, rad and log-scale, of a direction that nothing has measured."""
MAP_UNIT = "the median depth of the first keyframe is 1 map unit"
"""The unit of length of a map whose scale is unknown (see tracking/initialisation)."""

PICTURE_TOP = "first picture's top"
"""What x points to where z points into the ground."""

MARKED = "marked by hand"
"""Reason in the report of what a person marked in a finished dive: something better replaces it."""
LENGTH, GRAVITY = "length", "gravity"
"""Kinds of it."""


@dataclass(frozen=True)
class SourceReport:
    """What became of one source of telemetry."""

    source: str
    """The device's name."""
    kind: str
    """As in a recording, such as ``depth``."""
    used: int = 0
    """Samples that took part."""
    rejected: int = 0
    """Samples that contradicted the others, by chi-square."""
    reason: str = ""
    """Why nothing of it, or not all, was used; else empty."""


@dataclass(frozen=True)
class Origin:
    """The point of the earth where n has its origin (WGS 84)."""

    latitude_deg: float
    longitude_deg: float
    source: str
    sigma_m: float
    """1 sigma of the horizontal position."""


@dataclass(frozen=True)
class FixErrors:
    """Where the fit leaves the path at every position fix of one source, less the fix."""

    source: str
    t_s: Array
    """[N] s of the dive's clock."""
    fixes_n: Array
    """[N, 2] m north and east of n's origin."""
    sigma_m: Array
    """[N] 1 sigma of each horizontal direction, as the fix states it."""
    errors_n: Array
    """[N, 2] m north and east: the body in the dive less the fix."""
    rejected: npt.NDArray[np.bool_]
    """[N] fixes that contradicted those around them, and took no part."""

    @property
    def errors_m(self) -> Array:
        """[N] horizontal distances."""
        return np.asarray(np.linalg.norm(self.errors_n, axis=1))

    @property
    def in_sigmas(self) -> Array:
        """[N] root mean square of the two directions over the stated sigma."""
        return np.asarray(self.errors_m / (np.sqrt(2.0) * self.sigma_m))


@dataclass(frozen=True)
class WorldFrame:
    """The similarity from a sub-map's world m to n, its covariance, and what is known of it."""

    T_nm: Sim3
    """Scale 1 and the map's unit where the scale is unknown."""
    covariance: Array
    """[7, 7] of the left tangent of ``T_nm``: translation (m), rotation (rad), log-scale."""
    metric: bool = False
    """True if lengths are metres."""
    level: bool = False
    """True if z points down."""
    north: North = "first keyframe"
    depth_known: bool = False
    """True if z = 0 is the water surface."""
    origin: Origin | None = None
    T_bc: Sim3 | None = None
    """Camera to body (forward, right, down), m, as corrected; None if the mounting is unknown."""
    scale_source: str = ""
    """Devices that the scale comes from, or why there is none."""
    sources: tuple[SourceReport, ...] = ()
    fixes: tuple[FixErrors, ...] = ()
    """Of each source of fixes, where it is georeferenced; a frame that was read back has none, as
    fixes.csv keeps them."""
    clock_offset_s: float = 0.0
    """Pictures' time less that of telemetry's stamps, as rotations show it now and as it was
    corrected; 0 where none was found."""
    scale_confirmed: bool = True
    """False while too little of the path shows whether a source whose clock nothing shows fits the
    pictures: nothing that steers may use the scale."""
    site: str = ""
    """The earlier dive whose frame n is, where this one was recognised in it; empty otherwise."""
    on_ground: bool = False
    """True if z points into the ground instead, about across its mean plane, and x to the top of
    the first picture unless ``north`` is known: gravity is unknown."""

    @staticmethod
    def unknown(reason: str = "") -> WorldFrame:
        """A map of which telemetry, if there is any, says nothing (``reason``: why): its own unit,
        the first keyframe's camera axes."""
        covariance = np.diag(np.full(7, UNKNOWN_SIGMA**2))
        said = f"none: {reason}; {MAP_UNIT}" if reason else f"none: {MAP_UNIT}"
        return WorldFrame(Sim3.identity(), covariance, scale_source=said)

    @property
    def is_identity(self) -> bool:
        """True if n is the sub-map's internal world, number for number."""
        T = self.T_nm
        return bool(T.scale == 1.0 and not T.t.any() and (np.eye(3) == T.R).all())

    @property
    def has_vertical(self) -> bool:
        """True if -z is up: against gravity, or for want of it away from the ground."""
        return self.level or self.on_ground

    @property
    def ahead(self) -> str:
        """What x points to, in words; empty where n has no vertical."""
        if self.on_ground and self.north == "first keyframe":
            return PICTURE_TOP
        return self.north if self.has_vertical else ""

    @property
    def axes(self) -> str:
        """The axes of n in words."""
        if not self.has_vertical:
            return "x right, y down, z forward of the first keyframe's camera"
        z = "down" if self.level else "into the ground"
        return f"x to {self.ahead}, y to the right of it, z {z}"

    @property
    def georeferenced(self) -> bool:
        """True if every point of n has a latitude and a longitude."""
        known = self.origin is not None and self.metric and self.has_vertical
        return known and self.north == "true north"

    @property
    def has_heading(self) -> bool:
        """True if something says which way x of n points, and so how well that is known."""
        return self.level or self.georeferenced

    def is_marked(self, kind: str) -> bool:
        """True if a person marked the ``kind``: LENGTH or GRAVITY."""
        return any((source.kind, source.reason) == (kind, MARKED) for source in self.sources)

    @property
    def gravity_measured(self) -> bool:
        """True if telemetry has measured gravity."""
        return self.level and not self.is_marked(GRAVITY)

    def turn(
        self,
        R: Array,  # [3, 3] from n
    ) -> WorldFrame:
        """The same with other axes, about the same origin."""
        T = Sim3(R, np.zeros(3))
        carried = Sim3Batch.of([T]).adjoint()[0]
        covariance = carried @ self.covariance @ carried.T
        return replace(self, T_nm=T @ self.T_nm, covariance=covariance)

    def pose(self, T_mc: Sim3) -> Sim3:
        """T_nc of a camera: rigid, as lengths in n have one unit; the same object if n is m."""
        if self.is_identity:
            return T_mc
        T_nc = self.T_nm @ T_mc
        return Sim3(T_nc.R, T_nc.t)

    @property
    def unit(self) -> str:
        """Unit of lengths in n."""
        return "m" if self.metric else "map units"

    @property
    def scale_sigma(self) -> float:
        """Relative 1 sigma of the scale."""
        return float(np.sqrt(self.covariance[6, 6]))

    @property
    def tilt_sigma_rad(self) -> float:
        """1 sigma of gravity's direction, the larger of its two axes."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[3:5, 3:5])[-1]))

    @property
    def heading_sigma_rad(self) -> float:
        """1 sigma of the turn about the vertical, against what ``north`` says."""
        return float(np.sqrt(self.covariance[5, 5]))

    def position_covariance(
        self,
        p_n: Array,  # [3] in n
    ) -> Array:
        """[3, 3] m^2 of a point in n that follows from the frame alone: first order."""
        J = moved_by_frame(p_n)
        return np.asarray(J @ self.covariance @ J.T)


def moved_by_frame(
    p_n: Array,  # [3] m in n
) -> Array:
    """[3, 7] change of a point in n with the frame's place, turn and log-scale."""
    return np.hstack([np.eye(3), -hat(p_n), p_n[:, None]])
