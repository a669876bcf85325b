"""Tracking's result for a frame: its class, its pose, and the pose's quality."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap
from aquaflow.prior.contract import PairGeometry
from aquaflow.types import Frame


class FrameClass(str, Enum):
    """What a frame is used for (paper, Sec. 3.2), or why it is not used."""

    KEYFRAME = "keyframe"
    """Few matches are left with the keyframe before; joins the graph and brings Gaussians."""
    MAPPING = "mapping"
    """Seen with enough parallax since the last mapped frame; brings Gaussians."""
    COMMON = "common"
    """Neither; refines the Gaussians that are there."""
    SKIPPED = "skipped"
    """Refused by the gate: dark, blurred, blinded, or nothing moved."""
    LOST = "lost"
    """No pose was found."""
    DROPPED = "dropped"
    """Could not be read, or a live run had no time for it."""


@dataclass(frozen=True)
class Quality:
    """Quality of a pose."""

    inlier_share: float = 1.0
    residual_px: float = 0.0
    matched_share: float = 1.0
    conditioning: float = 1.0


@dataclass(frozen=True)
class KeyframeEdge:
    """Relative-pose edge from a new keyframe to its parent."""

    keyframe: int
    """Number of the earlier keyframe."""
    T_fk: Sim3
    """Earlier keyframe to new one."""
    covariance: npt.NDArray[np.float64]
    """[6, 6] of the left tangent [translation, rotation]."""
    pair: PairGeometry | None = None
    """The matches that it was solved from, earlier to new; let go once they were sampled."""


@dataclass(frozen=True)
class Revisit:
    """Relative pose and scale of two keyframes that one frame was matched to."""

    keyframe: int
    earlier: int
    T_ke: Sim3
    """Earlier keyframe to the other."""
    covariance: npt.NDArray[np.float64]
    """[6, 6] of the left tangent [translation, rotation]."""
    scale_sigma: float
    """Of the logarithm of the scale."""


@dataclass(frozen=True)
class Tracked:
    """A frame with its pose, or the reason why it has none."""

    frame: Frame
    frame_class: FrameClass
    sub_map: int
    keyframe: int | None = None
    """Number of the keyframe that the pose is relative to."""
    T_wc: Sim3 | None = None
    quality: Quality = Quality()
    pointmap: Pointmap | None = None
    """Depth of this frame's own pixels; present for keyframes and mapping frames."""
    reason: str = ""

    @staticmethod
    def as_lost(frame: Frame, sub_map: int, reason: str = "no pose found") -> Tracked:
        """A frame that got no pose."""
        return Tracked(frame, FrameClass.LOST, sub_map, reason=reason)

    def bare(self) -> Tracked:
        """A copy without picture and pointmap, small enough to keep for every frame."""
        return replace(self, frame=without_pictures(self.frame), pointmap=None)


@dataclass(frozen=True)
class Step:
    """What tracking found out with a frame: plain data for the graph, the maps and the table."""

    frames: list[Tracked] = field(default_factory=list)
    """Finished by it, each with its pose or why it has none: that frame, and some before it."""
    links: dict[int, KeyframeEdge] = field(default_factory=dict)
    """Of the new keyframes that continue a sub-map, by their numbers."""
    revisits: list[Revisit] = field(default_factory=list)


def without_pictures(frame: Frame) -> Frame:
    """A frame's index, times and camera: its picture and mask are empty."""
    nothing = np.empty((0, 0, 3), np.uint8)
    return replace(frame, image=nothing, mask=None, encoded=None)
