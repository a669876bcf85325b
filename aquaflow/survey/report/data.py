"""What a report is made of: values only, so that it can be built again from a dive folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from aquaflow.dive.fixes_csv import FixRow
from aquaflow.dive.medium import Rgb
from aquaflow.survey.coverage.page_view import PageView
from aquaflow.survey.export.ortho.ground import ALONG_GRAVITY
from aquaflow.telemetry.world_frame import SourceReport
from aquaflow.water.mounting import Lamp

FocalSource = Literal["calibrated", "guessed", "refined"]


@dataclass(frozen=True)
class CameraSummary:
    """The camera in the units of a data sheet."""

    width: int
    height: int
    """Pixels of the mapped pictures."""
    focal_px: float
    focal_source: FocalSource
    """``refined``: guessed at first, then estimated from the dive."""
    distortion_model: str = "none"


@dataclass(frozen=True)
class PathPlot:
    """The camera's path."""

    positions: npt.NDArray[np.floating]
    """[M, 3] camera centres, world."""
    classes: list[str]
    """[M] ``keyframe``, ``mapping``, ``common`` or ``skipped``."""
    sub_maps: list[int]
    """[M] sub-map of each pose; unless ``placed``, they share no frame of reference."""
    unit: str = "map units"
    """``m`` where the scale is known."""
    up: str = ""
    """What x points to, where z points down in all sub-maps: then the path is seen from above."""
    depth_known: bool = False
    """True if z = 0 is the water surface."""
    placed: bool = False
    """True if all sub-maps lie in one frame of reference, level and in metres."""
    truth: npt.NDArray[np.floating] | None = None
    """[K, 3] true positions, already aligned to the map's world."""


@dataclass(frozen=True)
class Measures:
    """Lengths with their uncertainty, gravity, north, and the telemetry that they come from."""

    rows: list[tuple[str, str]]
    """What, and its value in words."""
    sources: Sequence[SourceReport] = ()


@dataclass(frozen=True)
class ReefRow:
    """A number of the ground, the path or the water, in words."""

    label: str
    value: str
    """With 1 sigma."""
    interval: str
    """That holds the truth with 95 %."""
    meaning: str


@dataclass(frozen=True)
class HeldOutExample:
    """A frame that the mapper never saw, and what the map shows from there."""

    caption: str
    """The frame's name."""
    real: npt.NDArray[np.uint8]
    """[H, W, 3] RGB, as all three pictures; ``restored`` may have alpha."""
    rendered: npt.NDArray[np.uint8]
    restored: npt.NDArray[np.uint8] | None = None
    """Without water; None if the medium is off."""
    psnr: float | None = None
    """dB."""
    ssim: float | None = None
    confidence: npt.NDArray[np.uint8] | None = None
    """[H, W] grey, 255 where ``restored`` is wholly the picture's."""


@dataclass(frozen=True)
class MediumCurves:
    """Water, mean over the dive: I = J exp(-beta z) + B_inf (1 - exp(-b z)) + B_res exp(-d z)."""

    beta: Rgb
    b: Rgb
    B_inf: Rgb
    B_res: Rgb
    d: Rgb
    range_p5: float
    range_p95: float
    """Span of ranges z that the dive saw; outside it the curves are extrapolated."""
    unit: str = "map units"
    """Unit of z; beta, b and d are per unit."""
    white: tuple[str, Rgb, Rgb] | None = None
    """White balance of restored pictures: name, gain on top of the camera's, and the relative 1
    sigma of that; None: the camera's."""
    lightness: tuple[float, float] | None = None
    """L* of the same ground, far over near: as the camera saw it, and restored."""
    lamp: Lamp | None = None
    """Light from beside the camera; None where none was found."""
    beta_sigma: Rgb | None = None
    """Relative 1 sigma of beta; None where the ranges that were seen allowed no fit."""


@dataclass(frozen=True)
class DepthProfile:
    """Depth and altitude over time; NaN where unknown."""

    t_s: npt.NDArray[np.floating]
    """[N] seconds of the recording."""
    depth: npt.NDArray[np.floating]
    """[N]"""
    altitude: npt.NDArray[np.floating]
    """[N] above the bottom."""
    depth_is: str
    """What ``depth`` is, in words."""
    unit: str = "m"


@dataclass(frozen=True)
class LeftOut:
    """Frames that are not in the map for one reason."""

    kind: str
    """``skipped``, ``lost`` or ``dropped``."""
    reason: str
    """With N for its numbers."""
    count: int


@dataclass(frozen=True)
class ReportData:
    """Everything that the report shows; empty parts are left out of it."""

    name: str
    camera: CameraSummary
    metrics: Mapping[str, Any]
    """``metrics.json``."""
    path: PathPlot | None = None
    measures: Measures | None = None
    fixes: Sequence[FixRow] = ()
    """Of fixes.csv."""
    reef: list[ReefRow] = field(default_factory=list)
    timeline: list[str] = field(default_factory=list)
    """Class of every frame in order, also ``skipped``, ``lost`` and ``dropped``."""
    examples: list[HeldOutExample] = field(default_factory=list)
    medium: MediumCurves | None = None
    """None if the medium is off."""
    coverage: PageView | None = None
    """Of the largest sub-map."""
    overview: bytes | None = None
    """PNG file of the map from above."""
    vertical: str = ALONG_GRAVITY
    """What is above on it and in ``reef``, in words."""
    profile: DepthProfile | None = None
    left_out: Sequence[LeftOut] = ()
    stages: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Stage -> ``count``, ``total``, ``p50``, ``p95``; times in ms."""
    warnings: list[str] = field(default_factory=list)
    """Why the result is poor, and what to do: shown first."""
    notes: list[str] = field(default_factory=list)
    """Sentences about what went wrong or was left out."""
    written: str = ""
    """Date for the footer; empty, by default, so that the same dive gives the same bytes."""
